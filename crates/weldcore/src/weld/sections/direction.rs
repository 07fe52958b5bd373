//! Along which the edge step is read: the bisector of both walls at the seam.
//!
//! One station knows its walls' slopes badly: a wave of 0.04 mm over the wall in view turns them by a milliradian, and across a
//! cap of 60 mm that is 0.06 mm of step. Two pipes have one direction each, which a leaning frame shows as a slow change along
//! the view: the slopes of all stations are fitted by what an offset that grows across the seam does along it, a cosine and a
//! sine around a pipe (Huber's weights: P. Huber, Robust Statistics, 1981, 7), and what they scatter about it says how well it
//! is known.

use nalgebra::{Matrix2, Vector2};

use super::station::Station;
use crate::ground::robust::{MEDIAN_TO_SIGMA, huber, median};
use crate::weld::seam::Course;

/// With fewer stations each has its own.
const LEAST_STATIONS: usize = 6;
const ROUNDS: usize = 5;
/// Huber's bend, in scales of the residual.
const BEND: f64 = 2.0;
/// Of a direction: it leans in two ways.
const TERMS: f64 = 2.0;
/// From this angle between the walls on (0.5 degrees), the reading depends on whose direction is taken.
const ANGLE_RAD: f64 = 0.5 * std::f64::consts::PI / 180.0;

/// How a step is read at a station, as slopes across the seam.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Direction {
    pub slope: f64,
    /// Standard uncertainty of it.
    pub slope_u: f64,
    /// Half the angle between the walls where that is too large to leave the direction of reading open; else 0.
    pub spread: f64,
}

/// The directions of all stations; `None` where no wall is known.
pub(super) fn directions(stations: &[Station], course: Course) -> Vec<Option<Direction>> {
    let leans: Vec<Vector2<f64>> = stations.iter().map(|s| course.offset(s.at).into()).collect();
    let slopes: Vec<[Option<f64>; 2]> = stations.iter().map(|s| [s.slope(0), s.slope(1)]).collect();
    let doubt = |s: &Station| s.walls.iter().flatten().map(|run| run.slope_u).fold(0.0, f64::hypot);
    let of_both = |of: fn(f64, f64) -> f64, part: f64| -> Vec<Option<[f64; 2]>> {
        let each = slopes.iter().zip(stations);
        each.map(|(slopes, s)| Some([of(slopes[0]?, slopes[1]?), part * doubt(s)])).collect()
    };
    let (middles, angles) =
        (along(&of_both(|a, b| 0.5 * (a + b), 0.5), &leans), along(&of_both(|a, b| b - a, 1.0), &leans));
    (0..stations.len())
        .map(|k| {
            // Where one wall is unknown everywhere, along the other.
            let own = || Some([slopes[k][0].or(slopes[k][1])?, doubt(&stations[k])]);
            let [slope, slope_u] = middles[k].or_else(own)?;
            let spread =
                angles[k].map_or(0.0, |[angle, _]| if angle.abs() > ANGLE_RAD { 0.5 * angle.abs() } else { 0.0 });
            Some(Direction { slope, slope_u, spread })
        })
        .collect()
}

/// The direction through slopes with their standard uncertainties, and how each lean shows at every station: its slope and
/// the uncertainty of that.
fn along(values: &[Option<[f64; 2]>], leans: &[Vector2<f64>]) -> Vec<Option<[f64; 2]>> {
    let known: Vec<(Vector2<f64>, f64)> =
        values.iter().zip(leans).filter_map(|(v, lean)| Some((*lean, (*v)?[0]))).collect();
    if known.len() < LEAST_STATIONS {
        return values.to_vec();
    }
    let mut weights = vec![1.0; known.len()];
    let (mut terms, mut inverse) = (Vector2::zeros(), Matrix2::zeros());
    let mut residuals = Vec::new();
    let mut scatter = 0.0;
    for _ in 0..ROUNDS {
        let (mut normal, mut right) = (Matrix2::zeros(), Vector2::zeros());
        for (&(lean, value), &weight) in known.iter().zip(&weights) {
            normal += weight * lean * lean.transpose();
            right += weight * value * lean;
        }
        let Some(factor) = normal.cholesky() else { return values.to_vec() };
        (terms, inverse) = (factor.solve(&right), factor.inverse());
        residuals = known.iter().map(|&(lean, value)| value - lean.dot(&terms)).collect::<Vec<f64>>();
        scatter = MEDIAN_TO_SIGMA * median(&mut residuals.iter().map(|r| r.abs()).collect::<Vec<f64>>());
        residuals.iter().zip(&mut weights).for_each(|(r, w)| *w = huber(*r, BEND * scatter.max(1e-9)));
    }
    let independent =
        independent(&residuals.iter().map(|r| r.clamp(-3.0 * scatter, 3.0 * scatter)).collect::<Vec<f64>>());
    let usual = median(&mut values.iter().flatten().map(|v| v[1]).collect::<Vec<f64>>());
    // What is left scatters less than what was fitted, by the terms that were.
    let alike = known.len() as f64 / (independent - TERMS).max(1.0);
    let u = |lean: &Vector2<f64>| scatter.max(usual) * (lean.dot(&(inverse * lean)) * alike).sqrt();
    leans.iter().map(|lean| Some([lean.dot(&terms), u(lean)])).collect()
}

/// As how many values those of a row count whose neighbours share their waves: n / (1 + 2 sum of the correlations), up to the
/// first distance without any (A. Sokal, in: Functional Integration, 1997, 131, sec. 3).
fn independent(residuals: &[f64]) -> f64 {
    let n = residuals.len();
    let product = |lag: usize| residuals.iter().zip(&residuals[lag..]).map(|(a, b)| a * b).sum::<f64>();
    let power = product(0).max(f64::MIN_POSITIVE);
    let shared: f64 = (1..n).map(|lag| product(lag) / power).take_while(|&r| r > 0.0).sum();
    n as f64 / (1.0 + 2.0 * shared)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slow_change_is_followed_and_a_wave_is_not() {
        let at = |k: usize| (k as f64 - 15.0) / 20.0;
        let lean = |k: usize| 0.002 * at(k).cos() + 0.001 * at(k).sin();
        let waved = |k: usize| lean(k) + 0.001 * (k as f64 * 1.7).sin() + if k == 9 { 0.2 } else { 0.0 };
        let values: Vec<Option<[f64; 2]>> = (0..30).map(|k| (k % 7 != 3).then(|| [waved(k), 0.0005])).collect();
        let leans: Vec<Vector2<f64>> = (0..30).map(|k| Vector2::new(at(k).cos(), at(k).sin())).collect();
        for (k, found) in along(&values, &leans).into_iter().enumerate() {
            let [slope, u] = found.unwrap();
            assert!((slope - lean(k)).abs() < 3.0 * u && u < 0.0008, "{k}: {slope} {u} {}", lean(k));
        }
        // A wave as long as half of the row is not a lean: it counts as few.
        let long = |k: usize| Some([lean(k) + 0.001 * (k as f64 / 4.0).sin(), 0.0001]);
        for (k, found) in along(&(0..30).map(long).collect::<Vec<_>>(), &leans).into_iter().enumerate() {
            let [slope, u] = found.unwrap();
            assert!((slope - lean(k)).abs() < 3.0 * u, "{k}: {slope} {u} {}", lean(k));
        }
        // Halves of a row that agree throughout count as two; signs by turns as every one.
        let halves: Vec<f64> = (0..40).map(|k| if k < 20 { 1.0 } else { -1.0 }).collect();
        assert!((1.0..3.0).contains(&independent(&halves)));
        assert!(independent(&[1.0, -1.0, 1.0, -1.0]) == 4.0);
        // Too few for that: each has its own.
        assert_eq!(along(&values[..4], &leans[..4]), values[..4]);
    }
}
