//! What the walls' unevenness and noise are like: the scales that make the cells most likely.
//!
//! `-2 l` of [`super::border`] and what is known of walls beforehand ([`Prior`]) are made least over the logarithms of a wall's four
//! scales, shot by shot: of each wall of one shot alone, then of each wall beside the other one, for what waves on one wall alone
//! may be a bow of the shot. What shots share of the border tells next to nothing of the scales, so each has its own
//! ([`super::stretch`]), and the work grows with the shots.
//! The search is a simplex: the cost jumps a little where the number of shapes across changes, and no derivative sees that.
//!
//! Source: J. Nelder and R. Mead, Comput. J. 7 (1965) 308; the restricted likelihood as in [`super::border`].

use super::border::{Border, Columns};
use super::stretch::Stretch;
use super::sweep::{Reduced, sweep};
use super::wall::Scales;
use crate::ground::threads;

/// What is known of a wall's scales beforehand: the logarithm of each is normal, within bounds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Prior {
    /// Median, standard deviation of the logarithm, least, most: of sd, lengths along and across (mm), and noise.
    pub of: [[f64; 4]; 4],
}

/// Waves shorter than this part of a cell are the cell's own.
const LEAST_CELLS: f64 = 0.5;

impl Prior {
    /// Of walls in cells of this size along and across, seen over these lengths.
    pub fn of_walls(cell_mm: [f64; 2], seen_mm: [f64; 2]) -> Self {
        let bounds = |k: usize, most: f64| [LEAST_CELLS * cell_mm[k], most.min(4.0 * seen_mm[k]).max(3.0 * cell_mm[k])];
        let ([a, b], [c, d]) = (bounds(0, 400.0), bounds(1, 600.0));
        Self { of: [[0.01, 1.5, 2e-4, 0.5], [25.0, 0.9, a, b], [50.0, 0.9, c, d], [1.65, 1.2, 0.2, 200.0]] }
    }

    fn start(&self) -> [f64; 4] {
        self.of.map(|[median, _, least, most]| median.clamp(least, most).ln())
    }

    /// The scales of logarithms, and what they cost; beyond the bounds the nearest ones at a price that grows.
    fn read(&self, logs: &[f64; 4]) -> (Scales, f64) {
        let mut cost = 0.0;
        let [sd_mm, along_mm, across_mm, noise] = std::array::from_fn(|k| {
            let [median, sigma, least, most] = self.of[k];
            let held = logs[k].clamp(least.ln(), most.ln());
            cost += ((held - median.ln()) / sigma).powi(2) + 100.0 * (logs[k] - held).powi(2);
            held.exp()
        });
        (Scales { sd_mm, along_mm, across_mm, noise }, cost)
    }
}

/// A search ends where the corners of the simplex cost the same to this, or after so many sweeps: of a first one, that only shows
/// where to begin; and of one that ends within a third of what one standard deviation costs.
const ABOUT: (f64, usize) = (2.0, 60);
const CLOSELY: (f64, usize) = (0.3, 60);
/// First steps of the logarithms, and of a search that begins near its end.
const STEPS: [f64; 4] = [0.8, 0.5, 0.5, 0.4];
const SHORT: f64 = 0.4;

/// The scales of both walls from some shots: begun at `near`, or with each wall of the first of them alone; then each beside the
/// other one as it was begun with. `None` where the cells do not tell.
pub(crate) fn fit(shots: &[Stretch], priors: [&Prior; 2], near: Option<[Scales; 2]>) -> Option<[Scales; 2]> {
    let one = |shot: &Stretch, k: usize, scales: &Scales| sweep(&shot.line, &shot.walls[k], scales, &[]);
    let join = |shot: &Stretch, walls: &[(&Reduced, &Columns)]| Some(Border::join(shot.columns.len(), walls)?.cost);
    let both = |job: &(dyn Fn(usize) -> Option<Scales> + Sync)| -> Option<[Scales; 2]> {
        let (first, second) = threads::install(|| rayon::join(|| job(0), || job(1)));
        Some([first?, second?])
    };
    let near = match near {
        Some(near) => near,
        None => both(&|k| {
            let shot = shots.first()?;
            let cost = |logs: &[f64; 4]| {
                let (scales, price) = priors[k].read(logs);
                Some(join(shot, &[(&one(shot, k, &scales)?, &shot.columns)])? + price)
            };
            search(priors[k].start(), STEPS, ABOUT, &cost).map(|logs| priors[k].read(&logs).0)
        })?,
    };
    let begun: Vec<[Reduced; 2]> =
        shots.iter().map(|shot| Some([one(shot, 0, &near[0])?, one(shot, 1, &near[1])?])).collect::<Option<_>>()?;
    both(&|k| {
        let cost = |logs: &[f64; 4]| {
            let (scales, price) = priors[k].read(logs);
            let mut sum = price;
            for (shot, begun) in shots.iter().zip(&begun) {
                let mine = one(shot, k, &scales)?;
                sum += join(shot, &[(&mine, &shot.columns), (&begun[1 - k], &shot.columns)])?;
            }
            Some(sum)
        };
        let Scales { sd_mm, along_mm, across_mm, noise } = near[k];
        let start = [sd_mm, along_mm, across_mm, noise].map(f64::ln);
        search(start, STEPS.map(|s| SHORT * s), CLOSELY, &cost).map(|logs| priors[k].read(&logs).0)
    })
}

/// The least cost by a simplex of five corners; `None` where the cost has no value at the start.
fn search(
    start: [f64; 4],
    steps: [f64; 4],
    (close, most): (f64, usize),
    cost: &impl Fn(&[f64; 4]) -> Option<f64>,
) -> Option<[f64; 4]> {
    let worth = |logs: &[f64; 4]| cost(logs).unwrap_or(f64::INFINITY);
    let mut corners: Vec<([f64; 4], f64)> = vec![(start, cost(&start)?)];
    for k in 0..4 {
        let mut corner = start;
        corner[k] += steps[k];
        corners.push((corner, worth(&corner)));
    }
    let mut sweeps = corners.len();
    while sweeps < most {
        corners.sort_by(|a, b| a.1.total_cmp(&b.1));
        if corners[4].1 - corners[0].1 < close {
            break;
        }
        let middle: [f64; 4] = std::array::from_fn(|k| corners[..4].iter().map(|c| c.0[k]).sum::<f64>() / 4.0);
        let away = |far: f64| -> [f64; 4] { std::array::from_fn(|k| middle[k] + far * (middle[k] - corners[4].0[k])) };
        let try_at = |logs: [f64; 4]| (logs, worth(&logs));
        let mirrored = try_at(away(1.0));
        sweeps += 1;
        if mirrored.1 < corners[0].1 {
            let further = try_at(away(2.0));
            sweeps += 1;
            corners[4] = if further.1 < mirrored.1 { further } else { mirrored };
        } else if mirrored.1 < corners[3].1 {
            corners[4] = mirrored;
        } else {
            let nearer = try_at(away(if mirrored.1 < corners[4].1 { 0.5 } else { -0.5 }));
            sweeps += 1;
            if nearer.1 < corners[4].1.min(mirrored.1) {
                corners[4] = nearer;
            } else {
                let best = corners[0].0;
                for corner in &mut corners[1..] {
                    *corner = try_at(std::array::from_fn(|k| 0.5 * (best[k] + corner.0[k])));
                }
                sweeps += 4;
            }
        }
    }
    corners.into_iter().min_by(|a, b| a.1.total_cmp(&b.1)).map(|c| c.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_search_finds_the_bottom_of_a_narrow_valley() {
        let cost = |x: &[f64; 4]| {
            Some(50.0 * (x[0] + 0.5 * x[1] - 1.0).powi(2) + x[1] * x[1] + (x[2] - 2.0).powi(2) + 5.0 * x[3] * x[3])
        };
        let found = search([0.0, 1.0, 0.0, 1.0], STEPS, (0.3, 100), &cost).unwrap();
        // Nearer than one standard deviation.
        assert!(cost(&found).unwrap() < 1.0, "{found:?}");
        assert!(search([0.0; 4], STEPS, CLOSELY, &|_| None).is_none());
    }

    #[test]
    fn scales_stay_within_their_bounds() {
        let prior = Prior::of_walls([5.0, 5.0], [60.0, 40.0]);
        let (scales, price) = prior.read(&[0.0, 20.0, 0.0, 20.0]);
        assert!((scales.sd_mm - 0.5).abs() < 1e-9 && (scales.noise - 200.0).abs() < 1e-9);
        assert!((scales.along_mm - 240.0).abs() < 1e-9 && (scales.across_mm - 2.5).abs() < 1e-9 && price > 1e4);
    }
}
