//! The surface right beside a toe, as a gauge reads it: the value at the toe of the longest stretch that still tells the
//! same as all shorter ones (Lepski, Theory Probab. Appl. 35 (1991) 454). Right-hand toes: the inside lies at smaller x.

use nalgebra::{DMatrix, DVector};

use super::profile::Profile;
use crate::ground::robust::{MEDIAN_TO_SIGMA, huber, median};

/// The first strip beside a toe is rounded by the toe itself and by the size of a pixel. On it, and as far again as a part
/// of the cap's height, the cap's flank throws light that pulls the phase by some hundredths of a millimetre.
const CLEAR_MM: f64 = 0.35;
const CLEAR_HEIGHTS: f64 = 0.4;
const CLEAR_MOST_MM: f64 = 1.35;
/// Stretches that are tried, mm: straight ones and curved ones.
const STRAIGHT_MM: [f64; 5] = [2.0, 3.0, 5.0, 8.0, 12.0];
const CURVED_MM: [f64; 4] = [3.5, 6.0, 10.0, 16.0];
/// The first strip beside a toe is held against what was read further out; light of the flank moves it by this much.
const STRIP_MM: f64 = 1.0;
pub(super) const FLANK_LIGHT_MM: f64 = 0.06;
/// A bevel that ends within the strip that is not read shows in the line of so much, drawn on to the toe; of three bins at
/// least.
const BEVEL_MM: f64 = 0.6;
const BEVEL_BINS: f64 = 3.0;
/// A toe may lie so much too far out.
const INSIDE_MM: f64 = 1.0;
/// A stretch counts where its far end is seen at least up to this part.
const SEEN_PART: f64 = 0.7;
/// The slope beside a toe is that of a line of this length: a shorter one shows the noise.
const SLOPE_MM: f64 = 3.5;
/// What the choice of the stretch costs, as a part of the spread of those that are as good.
const CHOICE: f64 = 0.35;
/// Below this nothing is known better: the projector's response and the camera's pixels.
const FLOOR_MM: f64 = 0.006;
/// Huber's bend, in scales of the residual, and rounds of reweighting.
const HUBER: f64 = 2.0;
const ROUNDS: usize = 3;

/// What a gauge would read beside a toe.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Reading {
    /// Height of the surface at the toe.
    pub height: f64,
    /// Its standard uncertainty: noise, and the choice of the stretch.
    pub u: f64,
    /// Slope of the surface beside the toe.
    pub slope: f64,
    /// How far the first millimetre beside the toe is off what was read: a bare strip before a tape, or a flare.
    pub strip: f64,
    /// How far the line of the first strip runs off what was read, drawn on to the toe, or how far metal inside the toe
    /// lies below it, with its standard uncertainty: a bevel shorter than the strip that is not read.
    pub bevel: Option<[f64; 2]>,
}

/// Reads the surface to the right of `toe`, beside a cap of this height; `None` where too little of it is there.
pub(super) fn read(profile: &Profile, toe: f64, cap_height: f64, sigma: f64) -> Option<Reading> {
    let clear = (CLEAR_MM + CLEAR_HEIGHTS * cap_height.abs()).min(CLEAR_MOST_MM);
    let mut found: Vec<(f64, StretchFit)> = Vec::new();
    let kinds = STRAIGHT_MM.iter().map(|&l| (l, 1)).chain(CURVED_MM.iter().map(|&l| (l, 2)));
    for (length, degree) in kinds {
        if let Some(fit) = stretch(profile, toe, [clear, length], degree, sigma) {
            found.push((length, fit));
        }
    }
    // From the noisiest to the least noisy: the last that agrees with all before it. By what the noise alone does to each: one
    // that runs over a kink scatters too, and would be among the first.
    found.sort_by(|a, b| b.1.leverage.total_cmp(&a.1.leverage).then(a.0.total_cmp(&b.0)));
    let agrees =
        |i: usize| found[..i].iter().all(|(_, f)| (f.value - found[i].1.value).abs() <= 2.0 * f.variance.sqrt());
    let chosen = (0..found.len()).rev().find(|&i| agrees(i))?;
    let best = &found[chosen].1;
    let as_good = found[..=chosen].iter().filter(|(_, f)| f.variance <= 4.0 * best.variance).map(|(_, f)| f.value);
    let (low, high) = as_good.fold((f64::INFINITY, f64::NEG_INFINITY), |r, v| (r.0.min(v), r.1.max(v)));
    let u = (best.variance + (CHOICE * (high - low)).powi(2) + FLOOR_MM * FLOOR_MM).sqrt();
    let slope = stretch(profile, toe, [clear, SLOPE_MM], 1, sigma).map_or(best.slope, |f| f.slope);
    let (from, to) = (profile.boundary(toe + CLEAR_MM), profile.boundary(toe + CLEAR_MM + STRIP_MM));
    let strip = profile.mean(from, to).map_or(0.0, |(x, h)| (h - best.value - best.slope * (x - toe)).abs());
    let seen = FLANK_LIGHT_MM + 3.0 * sigma / profile.count(from, to).max(1.0).sqrt();
    let strip = if strip > seen { strip } else { 0.0 };
    // Where bins are empty, the line is of the next ones.
    let [least, most] = [BEVEL_MM.max(BEVEL_BINS * profile.bin), STRIP_MM.max((BEVEL_BINS + 1.0) * profile.bin)];
    let mut ends = profile.boundary(toe + CLEAR_MM + least)..=profile.boundary(toe + CLEAR_MM + most);
    let bevel = ends.find_map(|to| profile.line(from, to)).map(|line| {
        let se = sigma * (1.0 / line.count + (toe - line.x).powi(2) / line.sxx).sqrt();
        let at_toe = line.at(toe) - best.value;
        // Metal of a cap is no lower than the wall: where it is, the toe was taken too far out, over a bevel.
        let sign = if cap_height < 0.0 { -1.0 } else { 1.0 };
        let (first, last) = (profile.boundary(toe - INSIDE_MM), profile.boundary(toe));
        let below = (first..last.saturating_sub(1)).filter_map(|i| profile.mean(i, i + 2));
        let dip = below.map(|(x, h)| sign * (h - best.value - best.slope * (x - toe))).fold(0.0, f64::min) * sign;
        if dip.abs() > at_toe.abs() { [dip, sigma] } else { [at_toe, se] }
    });
    Some(Reading { height: best.value, u, slope, strip, bevel })
}

struct StretchFit {
    value: f64,
    slope: f64,
    /// Of the value, with the scatter of what was fitted.
    variance: f64,
    /// The same with a scatter of one.
    leverage: f64,
}

fn stretch(profile: &Profile, toe: f64, [clear, length]: [f64; 2], degree: usize, sigma: f64) -> Option<StretchFit> {
    let from = profile.boundary(toe + clear);
    let to = profile.boundary(toe + clear + length);
    let points: Vec<(f64, f64)> = (from..to)
        .filter(|&i| profile.heights[i].is_finite())
        .map(|i| ((profile.x(i) - toe) / length, profile.heights[i]))
        .collect();
    if points.len() < degree + 2 || points.last()?.0 < SEEN_PART {
        return None;
    }
    let rows = DMatrix::from_fn(points.len(), degree + 1, |r, c| points[r].0.powi(c as i32));
    let heights = DVector::from_iterator(points.len(), points.iter().map(|p| p.1));
    let mut weights = DVector::from_element(points.len(), 1.0);
    let mut fit = None;
    for _ in 0..ROUNDS {
        let weighted = DMatrix::from_fn(points.len(), degree + 1, |r, c| weights[r] * rows[(r, c)]);
        let normal = rows.transpose() * &weighted;
        let inverse = normal.cholesky()?.inverse();
        let c = &inverse * (weighted.transpose() * &heights);
        let residuals = &heights - &rows * &c;
        let mut sizes: Vec<f64> = residuals.iter().map(|r| r.abs()).collect();
        let scale = (MEDIAN_TO_SIGMA * median(&mut sizes)).max(sigma).max(1e-9);
        residuals.iter().zip(weights.iter_mut()).for_each(|(r, w)| *w = huber(*r, HUBER * scale));
        let leverage = inverse[(0, 0)];
        fit = Some(StretchFit { value: c[0], slope: c[1] / length, variance: scale * scale * leverage, leverage });
    }
    fit
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A cap inside x = 0 and a wall outside that is bevelled down to 0.225 mm at the toe, over 0.9 mm.
    fn bevelled(slope: f64) -> Profile {
        let height = |x: f64| if x < 0.0 { -0.9 * slope - 0.9 * x } else { -slope * (0.9 - x).max(0.0) };
        Profile::new(-3.0, 0.2, (0..120).map(|i| height(-2.9 + 0.2 * f64::from(i))).collect())
    }

    #[test]
    fn a_bevel_within_the_unread_strip_is_seen() {
        let read = |slope: f64, toe: f64| read(&bevelled(slope), toe, 1.0, 0.003).unwrap();
        let reading = read(0.25, 0.0);
        assert!(reading.height.abs() < 0.03, "the wall as it is read: {reading:?}");
        let [off, se] = reading.bevel.unwrap();
        assert!((off + 0.225).abs() < 0.05 && se < 0.02, "{reading:?}");
        // The toe taken at the bevel's middle, and nearly at its outer end.
        for toe in [0.4, 0.8] {
            let [off, _] = read(0.25, toe).bevel.unwrap();
            assert!((-0.225..-0.1).contains(&off), "{toe}: {off}");
        }
        let [off, _] = read(0.0, 0.0).bevel.unwrap();
        assert!(off.abs() < 1e-9, "{off}");
    }
}
