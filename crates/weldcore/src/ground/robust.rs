//! Robust statistics, and the weights and widths of robust estimates.
//!
//! Sources: P. J. Huber, Robust Statistics (1981), 4.4 and 5; J. W. Tukey's biweight after Holland and Welsch, Commun. Stat. A 6
//! (1977) 813, where the widths of 95 % efficiency are from.

/// The median of absolute deviations of normal noise, times this, is its standard deviation.
pub(crate) const MEDIAN_TO_SIGMA: f64 = 1.4826;
/// The median of absolute deviations of normal noise, in standard deviations.
pub(crate) const MEDIAN_SIGMAS: f64 = 0.6745;
/// Huber's width in standard deviations that keeps 95 % efficiency on normal noise.
pub(crate) const HUBER_SIGMAS: f64 = 1.345;
/// The same of Tukey's biweight.
pub(crate) const TUKEY_SIGMAS: f64 = 4.685;

/// Huber's weight of a residual: 1 up to the width, then less, so that its influence grows no further.
#[inline(always)]
pub(crate) fn huber(residual: f64, width: f64) -> f64 {
    let size = residual.abs();
    if size > width { width / size } else { 1.0 }
}

/// Tukey's biweight of a residual in units of the width: smoothly down to nothing from 1 on.
#[inline(always)]
pub(crate) fn tukey(u: f64) -> f64 {
    if u.abs() < 1.0 { (1.0 - u * u).powi(2) } else { 0.0 }
}

/// The value that `n` others lie below, the last one where there are fewer. Reorders.
pub(crate) fn nth<T: Copy + Into<f64>>(values: &mut [T], n: usize) -> Option<T> {
    let n = n.min(values.len().checked_sub(1)?);
    Some(*values.select_nth_unstable_by(n, |a, b| (*a).into().total_cmp(&(*b).into())).1)
}

/// The median, the upper of the middle two of an even number; 0 of nothing. Reorders.
pub(crate) fn median<T: Copy + Default + Into<f64>>(values: &mut [T]) -> T {
    nth(values, values.len() / 2).unwrap_or_default()
}

/// The median, of an even number the mean of the middle two; NaN of nothing. Reorders.
pub(crate) fn median_between<T: Copy + Into<f64>>(values: &mut [T]) -> f64 {
    let n = values.len();
    let Some(high) = nth(values, n / 2) else { return f64::NAN };
    if n % 2 == 1 {
        return high.into();
    }
    let low = values.iter().take(n / 2).map(|v| (*v).into()).fold(f64::NEG_INFINITY, f64::max);
    0.5 * (low + high.into())
}

/// The value with a share of the others below it, straight between the two next to it; NaN of nothing. Reorders.
pub(crate) fn quantile(values: &mut [f64], share: f64) -> f64 {
    let at = (values.len().saturating_sub(1)) as f64 * share;
    let below = at as usize;
    let Some(low) = nth(values, below) else { return f64::NAN };
    let next = values.iter().skip(below + 1).copied().fold(f64::INFINITY, f64::min);
    if next.is_finite() { low + (next - low) * (at - below as f64) } else { low }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ground::random::{mix, normals};

    #[test]
    fn half_of_them_lie_below() {
        assert_eq!(median(&mut [3.0, 1.0, 2.0]), 2.0);
        assert_eq!(median(&mut [4.0, 1.0, 2.0, 3.0]), 3.0);
        assert_eq!(median(&mut [7.0_f32]), 7.0);
        assert_eq!(median::<f64>(&mut []), 0.0);
        assert_eq!(median_between(&mut [4.0, 1.0, 2.0, 3.0]), 2.5);
        assert_eq!(median_between(&mut [4.0_f32, 1.0, 2.5]), 2.5);
        assert!(median_between::<f64>(&mut []).is_nan());
    }

    #[test]
    fn a_quantile_lies_straight_between_its_neighbours() {
        let mut values = [5.0, 1.0, 3.0, 2.0, 4.0];
        assert_eq!([0.0, 0.25, 0.3, 0.5, 1.0].map(|share| quantile(&mut values, share)), [1.0, 2.0, 2.2, 3.0, 5.0]);
        assert!(quantile(&mut [], 0.5).is_nan());
    }

    #[test]
    fn the_widths_are_those_of_normal_noise() {
        let noise: Vec<f64> = (0..200_000).map(|k| f64::from(normals().draw(mix(k)))).collect();
        let mut sizes: Vec<f64> = noise.iter().map(|v| v.abs()).collect();
        // A median of so many is known to 0.3 %.
        let middle = median(&mut sizes);
        assert!((middle - MEDIAN_SIGMAS).abs() < 0.005 && (middle * MEDIAN_TO_SIGMA - 1.0).abs() < 0.007);
        // The efficiency of an M-estimate is (mean of psi')² / mean of psi².
        let efficiency = |psi: &dyn Fn(f64) -> f64| {
            let h = 1e-4;
            let slope = noise.iter().map(|&r| (psi(r + h) - psi(r - h)) / (2.0 * h)).sum::<f64>() / noise.len() as f64;
            slope * slope / (noise.iter().map(|&r| psi(r).powi(2)).sum::<f64>() / noise.len() as f64)
        };
        for psi in [&(|r: f64| r * huber(r, HUBER_SIGMAS)) as &dyn Fn(f64) -> f64, &|r| r * tukey(r / TUKEY_SIGMAS)] {
            assert!((efficiency(psi) - 0.95).abs() < 0.01);
        }
    }
}
