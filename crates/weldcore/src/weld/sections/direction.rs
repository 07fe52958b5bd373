//! Along which the edge step is read: the bisector of both walls at the seam.
//!
//! One station knows its walls' slopes badly: a wave of 0.04 mm over the wall in view turns them by a milliradian, and across a
//! cap of 60 mm that is 0.06 mm of step. Two pipes have one direction each, which a leaning frame shows as a slow change along
//! the view: the slopes of all stations are fitted by a parabola along the seam (Huber's weights: P. Huber, Robust Statistics,
//! 1981, 7), and what they scatter about it says how well it is known.

use nalgebra::{Matrix3, Vector3};

use super::station::Station;
use crate::ground::robust::{MEDIAN_TO_SIGMA, huber, median};

/// With fewer stations each has its own.
const LEAST_STATIONS: usize = 6;
const ROUNDS: usize = 5;
/// Huber's bend, in scales of the residual.
const BEND: f64 = 2.0;
/// Of a parabola.
const TERMS: f64 = 3.0;
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
pub(super) fn directions(stations: &[Station]) -> Vec<Option<Direction>> {
    let slopes: Vec<[Option<f64>; 2]> = stations.iter().map(|s| [s.slope(0), s.slope(1)]).collect();
    let doubt = |s: &Station| s.walls.iter().flatten().map(|run| run.slope_u).fold(0.0, f64::hypot);
    let of_both = |of: fn(f64, f64) -> f64, part: f64| -> Vec<Option<[f64; 2]>> {
        let each = slopes.iter().zip(stations);
        each.map(|(slopes, s)| Some([of(slopes[0]?, slopes[1]?), part * doubt(s)])).collect()
    };
    let (middles, angles) = (along(&of_both(|a, b| 0.5 * (a + b), 0.5)), along(&of_both(|a, b| b - a, 1.0)));
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

/// A parabola through values with their standard uncertainties, along the stations: it and its uncertainty at every station.
fn along(values: &[Option<[f64; 2]>]) -> Vec<Option<[f64; 2]>> {
    let known: Vec<(usize, f64)> = values.iter().enumerate().filter_map(|(k, v)| Some((k, (*v)?[0]))).collect();
    if known.len() < LEAST_STATIONS {
        return values.to_vec();
    }
    let (first, last) = (known[0].0 as f64, known[known.len() - 1].0 as f64);
    let row = |k: usize| {
        let x = ((2.0 * k as f64 - first - last) / (last - first)).clamp(-1.0, 1.0);
        Vector3::new(1.0, x, x * x)
    };
    let mut weights = vec![1.0; known.len()];
    let mut terms = Vector3::zeros();
    let mut residuals = Vec::new();
    let mut scatter = 0.0;
    for _ in 0..ROUNDS {
        let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
        for (&(k, value), &weight) in known.iter().zip(&weights) {
            normal += weight * row(k) * row(k).transpose();
            right += weight * value * row(k);
        }
        let Some(factor) = normal.cholesky() else { return values.to_vec() };
        terms = factor.solve(&right);
        residuals = known.iter().map(|&(k, value)| value - row(k).dot(&terms)).collect::<Vec<f64>>();
        scatter = MEDIAN_TO_SIGMA * median(&mut residuals.iter().map(|r| r.abs()).collect::<Vec<f64>>());
        residuals.iter().zip(&mut weights).for_each(|(r, w)| *w = huber(*r, BEND * scatter.max(1e-9)));
    }
    let independent =
        independent(&residuals.iter().map(|r| r.clamp(-3.0 * scatter, 3.0 * scatter)).collect::<Vec<f64>>());
    let usual = median(&mut values.iter().flatten().map(|v| v[1]).collect::<Vec<f64>>());
    // What is left scatters less than what was fitted, by the terms that were.
    let u = scatter.max(usual) * (TERMS / (independent - TERMS).max(1.0)).sqrt();
    (0..values.len()).map(|k| Some([row(k).dot(&terms), u])).collect()
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
        let lean = |k: usize| 0.002 * ((k as f64 - 15.0) / 20.0).cos();
        let waved = |k: usize| lean(k) + 0.001 * (k as f64 * 1.7).sin() + if k == 9 { 0.2 } else { 0.0 };
        let values: Vec<Option<[f64; 2]>> = (0..30).map(|k| (k % 7 != 3).then(|| [waved(k), 0.0005])).collect();
        for (k, found) in along(&values).into_iter().enumerate() {
            let [slope, u] = found.unwrap();
            assert!((slope - lean(k)).abs() < 3.0 * u && u < 0.0008, "{k}: {slope} {u} {}", lean(k));
        }
        // Halves of a row that agree throughout count as two; signs by turns as every one.
        let halves: Vec<f64> = (0..40).map(|k| if k < 20 { 1.0 } else { -1.0 }).collect();
        assert!((1.0..3.0).contains(&independent(&halves)));
        assert!(independent(&[1.0, -1.0, 1.0, -1.0]) == 4.0);
        // Too few for that: each has its own.
        assert_eq!(along(&values[..4]), values[..4]);
    }
}
