//! What the walls' unevenness and noise are like: the scales that make the cells most likely.
//!
//! `-2 l` of [`super::border`] and what is known of walls beforehand ([`Prior`]) are made least over the logarithms of a wall's four
//! scales, shot by shot: of each wall of one shot alone, then of each wall beside the other one, for what waves on one wall alone
//! may be a bow of the shot. What shots share of the border tells next to nothing of the scales, so each has its own
//! ([`super::stretch`]), and the work grows with the shots.
//! The search is a simplex: the cost jumps a little where the number of shapes across changes, and no derivative sees that.
//!
//! Source: J. Nelder and R. Mead, Comput. J. 7 (1965) 308; the restricted likelihood as in [`super::border`].

use super::border::Scaled;
use super::stretch::Stretch;
use super::sweep::{Reduced, sweep};
use super::wall::Scales;
use crate::ground::threads;

/// What is known of a wall's scales beforehand: the logarithm of each is normal, within bounds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Prior {
    /// Median, standard deviation of the logarithm, least, most: of sd, lengths along and across (mm), and noise.
    pub of: [[f64; 4]; 4],
    /// The least product of both lengths.
    pub least_mm2: f64,
}

/// Waves shorter than this part of a cell one way are the cell's own; and what is short both ways is noise: unevenness covers so
/// many cells.
const LEAST_CELLS: f64 = 0.5;
const LEAST_AREA: f64 = 1.5;

/// Of the median lengths, where a second start is: so short waves and long ones may both be likely, with a ridge between.
const SHORTER: f64 = 0.3;
/// What it costs to be beyond a bound by a factor e.
const STEEP: f64 = 100.0;

impl Prior {
    /// Of walls in cells of this size along and across, seen over these lengths.
    pub fn of_walls(cell_mm: [f64; 2], seen_mm: [f64; 2]) -> Self {
        let bounds = |k: usize, most: f64| [LEAST_CELLS * cell_mm[k], most.min(4.0 * seen_mm[k]).max(3.0 * cell_mm[k])];
        let ([a, b], [c, d]) = (bounds(0, 400.0), bounds(1, 600.0));
        Self {
            of: [[0.01, 1.5, 2e-4, 0.5], [25.0, 0.9, a, b], [50.0, 0.9, c, d], [1.65, 1.2, 0.2, 30.0]],
            least_mm2: LEAST_AREA * cell_mm[0] * cell_mm[1],
        }
    }

    /// Where to begin: the medians, and waves shorter each way.
    fn starts(&self) -> [Scales; 4] {
        [[1.0, 1.0], [SHORTER, 1.0], [1.0, SHORTER], [SHORTER, SHORTER]].map(|parts| {
            let part = [1.0, parts[0], parts[1], 1.0];
            let [sd_mm, along_mm, across_mm, noise] = std::array::from_fn(|k| {
                let [median, _, least, most] = self.of[k];
                (part[k] * median).clamp(least, most)
            });
            Scales { sd_mm, along_mm, across_mm, noise }
        })
    }

    /// The scales of logarithms, and what they cost; beyond the bounds the nearest ones at a price that grows.
    fn read(&self, logs: &[f64; 4]) -> (Scales, f64) {
        let mut cost = 0.0;
        let [sd_mm, along_mm, across_mm, noise] = std::array::from_fn(|k| {
            let [median, sigma, least, most] = self.of[k];
            let held = logs[k].clamp(least.ln(), most.ln());
            cost += ((held - median.ln()) / sigma).powi(2) + STEEP * (logs[k] - held).powi(2);
            held.exp()
        });
        cost += STEEP * (self.least_mm2 / (along_mm * across_mm)).ln().max(0.0).powi(2);
        (Scales { sd_mm, along_mm, across_mm, noise }, cost)
    }
}

/// A search ends where the corners of the simplex cost the same to this, or after so many sweeps: of a first one, that only shows
/// where to begin; and of one that ends within a third of what one standard deviation costs.
const ABOUT: (f64, usize) = (1.0, 30);
const CLOSELY: (f64, usize) = (0.3, 40);
/// First steps of the logarithms of sd and lengths, and of a search that begins near its end.
const STEPS: [f64; 3] = [0.8, 0.5, 0.5];
const SHORT: f64 = 0.6;
/// Steps of the golden section that finds the noise: to a hundredth of its logarithm.
const SECTIONS: usize = 14;

/// The scales of both walls from some shots: with each wall of the first of them alone, then each beside the other one. `None` where
/// the cells do not tell.
pub(crate) fn fit(shots: &[Stretch], priors: [&Prior; 2]) -> Option<[Scales; 2]> {
    let first = [(shots.first()?, None)];
    let alone = both(&|k| likeliest(&first, k, priors[k], &priors[k].starts(), STEPS, ABOUT))?;
    fit_near(shots, priors, fit_near(shots, priors, alone)?)
}

/// The scales of both walls, each beside the other one as it is near.
pub(crate) fn fit_near(shots: &[Stretch], priors: [&Prior; 2], near: [Scales; 2]) -> Option<[Scales; 2]> {
    let swept = |shot: &Stretch, k: usize| sweep(&shot.line, &shot.walls[k], &near[k], &[]);
    both(&|k| {
        let beside = shots.iter().map(|shot| Some((shot, Some(swept(shot, 1 - k)?)))).collect::<Option<Vec<_>>>()?;
        likeliest(&beside, k, priors[k], &[near[k]], STEPS.map(|s| SHORT * s), CLOSELY)
    })
}

/// A job for each wall, on a thread of its own.
fn both(job: &(dyn Fn(usize) -> Option<Scales> + Sync)) -> Option<[Scales; 2]> {
    let (first, second) = threads::install(|| rayon::join(|| job(0), || job(1)));
    Some([first?, second?])
}

/// The likeliest scales of wall k, from shots with what the other wall says of each, or without.
///
/// Sd and noise that grow together leave the walls' sweep as it is, but for a factor: so the noise is found for every ratio of
/// the two, and the simplex has three corners to move, not four.
fn likeliest(
    shots: &[(&Stretch, Option<Reduced>)],
    k: usize,
    prior: &Prior,
    starts: &[Scales],
    steps: [f64; 3],
    effort: (f64, usize),
) -> Option<Scales> {
    let best_noise = |logs: &[f64; 3]| -> Option<(f64, [f64; 4])> {
        let (scales, price) = prior.read(&[logs[0], logs[1], logs[2], 0.0]);
        // The bounds of sd hold with its noise, below; here it is over the noise's root.
        let scales = Scales { sd_mm: logs[0].exp(), noise: 1.0, ..scales };
        if !(price.is_finite() && scales.sd_mm.is_finite()) {
            return None;
        }
        let swept = shots.iter().map(|(shot, _)| sweep(&shot.line, &shot.walls[k], &scales, &[]));
        let swept = swept.collect::<Option<Vec<Reduced>>>()?;
        let mut joined: Vec<Scaled> =
            shots.iter().zip(&swept).map(|((_, beside), mine)| Scaled::new(mine, beside.as_ref())).collect();
        let mut cost = |log_noise: f64| {
            let logs = [logs[0] + 0.5 * log_noise, logs[1], logs[2], log_noise];
            let mut sum = prior.read(&logs).1;
            for scaled in &mut joined {
                sum += scaled.cost(log_noise)?;
            }
            Some((sum, logs))
        };
        let [_, _, _, [_, _, least, most]] = prior.of;
        golden([least.ln(), most.ln()], &mut cost)
    };
    let worth = |logs: &[f64; 3]| Some(best_noise(logs)?.0);
    let logs = |s: &Scales| [(s.sd_mm / s.noise.sqrt()).ln(), s.along_mm.ln(), s.across_mm.ln()];
    let starts = starts.iter().filter_map(|s| Some((logs(s), if starts.len() > 1 { worth(&logs(s))? } else { 0.0 })));
    let (start, _) = starts.min_by(|a, b| a.1.total_cmp(&b.1))?;
    let found = search(start, steps, effort, &worth)?;
    Some(prior.read(&best_noise(&found)?.1).0)
}

/// The least of a function with one bottom between two places, with what it says there.
fn golden<T>([mut low, mut high]: [f64; 2], cost: &mut impl FnMut(f64) -> Option<(f64, T)>) -> Option<(f64, T)> {
    let part = (5_f64.sqrt() - 1.0) / 2.0;
    let mut at = [high - part * (high - low), low + part * (high - low)];
    let mut found = [cost(at[0])?, cost(at[1])?];
    for _ in 0..SECTIONS {
        if found[0].0 < found[1].0 {
            (high, at[1]) = (at[1], at[0]);
            at[0] = high - part * (high - low);
            found.swap(0, 1);
            found[0] = cost(at[0])?;
        } else {
            (low, at[0]) = (at[0], at[1]);
            at[1] = low + part * (high - low);
            found.swap(0, 1);
            found[1] = cost(at[1])?;
        }
    }
    let [first, second] = found;
    Some(if first.0 < second.0 { first } else { second })
}

/// The least cost by a simplex of four corners; `None` where the cost has no value at the start.
fn search(
    start: [f64; 3],
    steps: [f64; 3],
    (close, most): (f64, usize),
    cost: &impl Fn(&[f64; 3]) -> Option<f64>,
) -> Option<[f64; 3]> {
    let worth = |logs: &[f64; 3]| cost(logs).unwrap_or(f64::INFINITY);
    let mut corners: Vec<([f64; 3], f64)> = vec![(start, cost(&start)?)];
    for k in 0..3 {
        let mut corner = start;
        corner[k] += steps[k];
        corners.push((corner, worth(&corner)));
    }
    let mut sweeps = corners.len();
    while sweeps < most {
        corners.sort_by(|a, b| a.1.total_cmp(&b.1));
        if corners[3].1 - corners[0].1 < close {
            break;
        }
        let middle: [f64; 3] = std::array::from_fn(|k| corners[..3].iter().map(|c| c.0[k]).sum::<f64>() / 3.0);
        let away = |far: f64| -> [f64; 3] { std::array::from_fn(|k| middle[k] + far * (middle[k] - corners[3].0[k])) };
        let try_at = |logs: [f64; 3]| (logs, worth(&logs));
        let mirrored = try_at(away(1.0));
        sweeps += 1;
        if mirrored.1 < corners[0].1 {
            let further = try_at(away(2.0));
            sweeps += 1;
            corners[3] = if further.1 < mirrored.1 { further } else { mirrored };
        } else if mirrored.1 < corners[2].1 {
            corners[3] = mirrored;
        } else {
            let nearer = try_at(away(if mirrored.1 < corners[3].1 { 0.5 } else { -0.5 }));
            sweeps += 1;
            if nearer.1 < corners[3].1.min(mirrored.1) {
                corners[3] = nearer;
            } else {
                let best = corners[0].0;
                for corner in &mut corners[1..] {
                    *corner = try_at(std::array::from_fn(|k| 0.5 * (best[k] + corner.0[k])));
                }
                sweeps += 3;
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
        let cost = |x: &[f64; 3]| Some(50.0 * (x[0] + 0.5 * x[1] - 1.0).powi(2) + x[1] * x[1] + (x[2] - 2.0).powi(2));
        let found = search([0.0, 1.0, 0.0], STEPS, (0.3, 100), &cost).unwrap();
        // Nearer than one standard deviation.
        assert!(cost(&found).unwrap() < 1.0, "{found:?}");
        assert!(search([0.0; 3], STEPS, CLOSELY, &|_| None).is_none());
    }

    #[test]
    fn a_golden_section_ends_at_the_bottom() {
        for bottom in [-1.5, 0.3, 5.0] {
            let (_, at) = golden([-1.6, 5.3], &mut |x: f64| Some(((x - bottom).powi(2), x))).unwrap();
            assert!((at - bottom).abs() < 0.01, "{at} is not {bottom}");
        }
    }

    #[test]
    fn scales_stay_within_their_bounds() {
        let prior = Prior::of_walls([5.0, 5.0], [60.0, 40.0]);
        let (scales, price) = prior.read(&[0.0, 20.0, 0.0, 20.0]);
        assert!((scales.sd_mm - 0.5).abs() < 1e-9 && (scales.noise - 30.0).abs() < 1e-9);
        assert!((scales.along_mm - 240.0).abs() < 1e-9 && (scales.across_mm - 2.5).abs() < 1e-9 && price > 1e4);
    }
}
