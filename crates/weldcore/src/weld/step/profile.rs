//! The profile along the seam, and what is said over all points.

use super::view::{LabelledShot, OwnSurface, is_wall};
use crate::ground::robust::median;
use crate::ground::threads;

/// One bin of the profile along the seam.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProfileBin {
    /// Its middle, as a reading (`Course::reading`).
    pub along: f64,
    /// Both walls as they are at the seam's centreline.
    pub step_mm: f64,
    /// Standard uncertainty and its parts (k = 1).
    pub standard_mm: f64,
    /// From the terms that both walls and all shots share: noise, extrapolation, how the shots join.
    pub fit_mm: f64,
    /// From the walls' unevenness, as far as their cells do not tell it at the seam.
    pub unevenness_mm: f64,
    /// From what is not known of the place along the seam.
    pub place_mm: f64,
    /// Half width of the band that holds all bins at once in 95 % of all cases.
    pub band_mm: f64,
    /// How far the step right beside the cap departs from what the walls further away predict, in standard uncertainties; NaN where
    /// that was not seen.
    pub departure: f64,
}

/// So many points tell mean and median to a thousandth of their scatter.
const TELLING: usize = 2_000_000;

/// Over the other wall's points of all shots, or every so-manieth of them.
pub(super) fn mean_and_median(shots: &[LabelledShot], surfaces: &[OwnSurface]) -> (f64, f64) {
    let points: usize = shots.iter().map(|s| s.labels.len()).sum();
    let stride = points.div_ceil(TELLING).max(1);
    let of_shot = |(shot, surface): (&LabelledShot, &OwnSurface)| {
        threads::map_ranges(shot.labels.len() / stride, |range| {
            let other = range.map(|k| k * stride).filter(|&i| is_wall(shot.labels[i]) == Some(true));
            other.map(|i| surface.deviation(shot.unrolled, i)).collect::<Vec<f32>>()
        })
        .concat()
    };
    let mut all: Vec<f32> = shots.iter().zip(surfaces).flat_map(of_shot).collect();
    if all.is_empty() {
        return (f64::NAN, f64::NAN);
    }
    let mean = all.iter().map(|d| f64::from(*d)).sum::<f64>() / all.len() as f64;
    (mean, f64::from(median(&mut all)))
}

/// The slope of a profile at each of its bins, per unit of the places: across its neighbours, where these are seen.
pub(super) fn slopes(bins: &[usize], around: usize, bin_width: f64, step_mm: &[f64]) -> Vec<f64> {
    let find = |bin: usize| bins.binary_search(&(bin % around)).ok();
    let slope = |(k, &bin): (usize, &usize)| {
        let before = find(bin + around - 1);
        let after = find(bin + 1);
        let (low, high) = (before.unwrap_or(k), after.unwrap_or(k));
        let apart = f64::from(u8::from(before.is_some()) + u8::from(after.is_some())) * bin_width;
        if apart > 0.0 { (step_mm[high] - step_mm[low]) / apart } else { 0.0 }
    };
    bins.iter().enumerate().map(slope).collect()
}
