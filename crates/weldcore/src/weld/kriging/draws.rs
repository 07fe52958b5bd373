//! The largest of many uncertain values, by draws from their joint distribution.
//!
//! The largest magnitude of a profile is not the magnitude at the place of its largest estimate: many places vie for it, and each
//! errs. Draws `h + L g` with `L Lᵀ = C` give its distribution, and the factor c by which all standard deviations have to be
//! taken so that all places at once lie inside. Random numbers are functions of draw and place: the same on any number of
//! threads.
//!
//! Where the band of all places holds 0 everywhere, the interval of the largest reaches down to 0: a quantile of magnitudes never
//! does. Elsewhere something stands out for certain, and both ends are quantiles.
//!
//! Source: JCGM 101:2008, 7; J. Hsu, Multiple Comparisons (1996), 1.3 for the factor c.

use rayon::prelude::*;

use super::rows::cholesky;
use crate::ground::random::{mix, normals};
use crate::ground::threads;

const DRAWS: usize = 4000;
/// Draws that are made together.
const TOGETHER: usize = 200;
/// Of the largest variance, added to each, so that places which are known together have a factor.
const JITTER: f64 = 1e-10;

/// The distribution of the largest magnitude.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Largest {
    /// Its quantiles: 0, 1, ... 100 %.
    pub quantiles: Vec<f64>,
    /// The 97.5 % quantile.
    pub upper: f64,
    /// The lower end of the interval that `upper` ends: the 2.5 % quantile, or 0 where 0 lies in the band of all places.
    pub lower: f64,
    /// c: so many standard deviations hold all places at once in 95 % of all cases.
    pub band_factor: f64,
}

/// The largest of values with this covariance (row by row); `None` without any, or where they have none.
pub(crate) fn largest(value: &[f64], covariance: &[f64]) -> Option<Largest> {
    let n = value.len();
    let most = (0..n).map(|k| covariance[k * n + k]).fold(0.0, f64::max);
    if n == 0 || !(most > 0.0 && most.is_finite()) {
        return None;
    }
    let sigma: Vec<f64> = (0..n).map(|k| covariance[k * n + k].sqrt().max(JITTER * most.sqrt())).collect();
    let mut lower = covariance.to_vec();
    (0..n).for_each(|k| lower[k * n + k] += JITTER * most);
    cholesky(&mut lower, n)?;
    let batches: Vec<usize> = (0..DRAWS / TOGETHER).collect();
    let drawn: Vec<Vec<(f64, f64)>> =
        threads::install(|| batches.par_iter().map(|batch| draw(batch * TOGETHER, value, &sigma, &lower)).collect());
    let (mut sorted, mut ratio): (Vec<f64>, Vec<f64>) = drawn.into_iter().flatten().unzip();
    sorted.sort_by(f64::total_cmp);
    ratio.sort_by(f64::total_cmp);
    let band_factor = quantile(&ratio, 0.95);
    let stands_out = value.iter().zip(&sigma).any(|(h, u)| h.abs() > band_factor * u);
    Some(Largest {
        quantiles: (0..=100).map(|p| quantile(&sorted, f64::from(p) / 100.0)).collect(),
        upper: quantile(&sorted, 0.975),
        lower: if stands_out { quantile(&sorted, 0.025) } else { 0.0 },
        band_factor,
    })
}

/// Draws from `first` on: the largest magnitude of each, and its largest error over sigma.
fn draw(first: usize, value: &[f64], sigma: &[f64], lower: &[f64]) -> Vec<(f64, f64)> {
    let n = value.len();
    let table = normals();
    // A row per place, a column per draw.
    let mut noise = vec![0.0; n * TOGETHER];
    for (place, row) in noise.chunks_exact_mut(TOGETHER).enumerate() {
        for (k, slot) in row.iter_mut().enumerate() {
            *slot = f64::from(table.draw(mix((((first + k) as u64) << 20) ^ place as u64)));
        }
    }
    let mut found = vec![(0.0_f64, 0.0_f64); TOGETHER];
    let mut error = vec![0.0; TOGETHER];
    for place in 0..n {
        error.fill(0.0);
        for (factor, row) in lower[place * n..=place * n + place].iter().zip(noise.chunks_exact(TOGETHER)) {
            error.iter_mut().zip(row).for_each(|(e, g)| *e += factor * g);
        }
        for (slot, e) in found.iter_mut().zip(&error) {
            *slot = (slot.0.max((value[place] + e).abs()), slot.1.max(e.abs() / sigma[place]));
        }
    }
    found
}

/// Of sorted values, straight between neighbours.
fn quantile(sorted: &[f64], share: f64) -> f64 {
    let at = share * (sorted.len() - 1) as f64;
    let low = at.floor() as usize;
    let high = (low + 1).min(sorted.len() - 1);
    sorted[low] + (at - low as f64) * (sorted[high] - sorted[low])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Five standard errors of the quantiles of 4000 draws.
    const TOLERANCE: f64 = 0.12;

    #[test]
    fn the_largest_of_independent_places_is_distributed_as_known() {
        let n = 40;
        let mut covariance = vec![0.0; n * n];
        (0..n).for_each(|k| covariance[k * n + k] = 0.25);
        let found = largest(&vec![0.0; n], &covariance).unwrap();
        // P(max |g| < c) = 0.95 where P(|g| < c) = 0.95^(1/40): c = 3.22.
        assert!((found.band_factor - 3.22).abs() < TOLERANCE, "{}", found.band_factor);
        assert!((found.quantiles[95] - 0.5 * found.band_factor).abs() < 1e-3 && found.lower == 0.0);
    }

    #[test]
    fn places_known_together_are_one() {
        let n = 30;
        let found = largest(&vec![1.0; n], &vec![0.01; n * n]).unwrap();
        assert!((found.band_factor - 1.96).abs() < TOLERANCE, "{}", found.band_factor);
        assert!((found.quantiles[50] - 1.0).abs() < 0.1 * TOLERANCE && (found.upper - 1.196).abs() < 0.1 * TOLERANCE);
        assert!((found.lower - 0.804).abs() < 0.1 * TOLERANCE);
    }

    #[test]
    fn nothing_has_no_largest() {
        assert!(largest(&[], &[]).is_none() && largest(&[1.0], &[0.0]).is_none());
    }
}
