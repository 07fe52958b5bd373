//! What a projector whose light is not proportional to its level does to the phase, seen in the images themselves.
//!
//! Harmonic p of the light is taken for the fundamental where p = mN ± 1. So the measured phase of N steps is
//! `φ' = φ + Σ a_m sin(m N φ)`: sines alone, for light is an even function of the phase. Surfaces are smooth over a few
//! pixels, the error is not: it repeats N times in a fringe. In the second difference over a lag of a part of its wave,
//! `φ(x - l) - 2 φ(x) + φ(x + l)`, the surface is nearly gone and whole fringes drop out; the a_m that make it smallest
//! are found by Gauss and Newton, robustly. Their covariance is that of whole rows, so that what neighbouring pixels
//! share is in it. What is applied is the same error as a series in the measured phase, `φ = φ' - Σ c_m sin(m N φ')`:
//! it needs more terms than the series in the true phase, but no solving in every pixel.

use std::f64::consts::TAU;

use multiversion::multiversion;
use nalgebra::{SMatrix, SVector};
use rayon::prelude::*;

use super::noise::CameraNoise;
use super::phase_error::{
    ErrorSource, NEGLIGIBLE, PhaseError, TERMS, check_steps, in_the_measured_phase, sin_cos_turns, sine_series,
};
use super::shot::{FringeSet, Shot, starts};
use super::wave::{Level, Sinusoid, TILE, Wave, demodulate};
use crate::error::{Error, Result, require_positive};
use crate::ground::branchless::{round, turns};
use crate::ground::robust::{MEDIAN_TO_SIGMA, TUKEY_SIGMAS, nth};
use crate::ground::stop::polled;
use crate::ground::threads;

/// Terms in the true phase that are fitted: with three steps and a gamma of 2.2 the sixth is 0.1 mrad.
const FITTED: usize = 6;
/// Rows that are looked at: 24 of a usual camera give the first term to 0.2 mrad.
const ROWS: usize = 24;
/// Parts of the error's wave, in turn from row to row: what one lag is blind to (half a wave: every other term), the others
/// see, also when they are rounded to whole pixels.
const LAGS: [f64; 3] = [0.3, 0.6, 0.85];
/// Pixels over which a surface counts as smooth. A set whose error has longer waves does not show it.
const LONGEST_WAVE: f64 = 40.0;
/// Of a row, so many pixels are looked at, more or less: what neighbours say is much the same.
const PER_ROW: usize = 160;
/// Fewer second differences say nothing.
const FEWEST: usize = 500;
/// Pairs of rows in which the slope of the phase is looked at.
const PROBES: usize = 8;
/// Reweighted solutions.
const ITERATIONS: usize = 10;
/// A tenth of what the coefficients are known to, rad.
const CONVERGED: f64 = 2e-5;
type Coefficients = SVector<f64, FITTED>;
type Square = SMatrix<f64, FITTED, FITTED>;

/// The rounding of a display's own levels makes errors of this size that repeat with the fringes: below it nothing is
/// said about the response. An even error of one level in 256 over an amplitude of half the range, as σ_φ of N steps.
fn display_rounding_rad(steps: usize) -> f64 {
    (2.0 / steps as f64).sqrt() * (1.0 / 12f64.sqrt() / 255.0) / 0.5
}

/// Looks for the error in the sets of a shot.
pub(super) fn seen_in_shot<T: Level>(
    shot: &Shot<'_, T>,
    sets: &[FringeSet],
    noise: &CameraNoise,
    saturation: f32,
    z: f64,
) -> Vec<PhaseError> {
    let starts = starts(sets);
    let look = |(set, &start): (&FringeSet, &usize)| {
        let wave = Wave::new(set.steps);
        let row = |y: usize| shot_row(shot, start, set.steps, &wave, noise, saturation, y);
        seen_in_rows(shot.width, shot.height, &row, set.steps, z, ROWS)
    };
    let found: Vec<Option<PhaseError>> =
        threads::install(|| sets.par_iter().inspect(polled).zip(&starts).map(look).collect());
    // A coarse set cannot show its error; the next finer one of as many steps that shows one speaks for it.
    let speaks = |set: &FringeSet| {
        let same = sets.iter().zip(&found).filter(|(s, _)| s.steps == set.steps && s.periods > set.periods);
        let seen = same.filter_map(|(s, f)| Some((s.periods, f.filter(PhaseError::is_some)?)));
        seen.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, f)| PhaseError { source: ErrorSource::FinerSet, ..f })
    };
    let each = sets.iter().zip(&found);
    each.map(|(set, own)| own.or_else(|| speaks(set)).unwrap_or(PhaseError::none(set.steps))).collect()
}

/// Looks for the error in one wrapped phase (row-major, rad; NaN where there is none) of `steps` steps, in `rows` rows
/// spread over the image. `None` where its waves are too long, or too little of them is in view, to see any.
///
/// # Errors
/// [`Error::Shape`] where the phase does not have that size, [`Error::OutOfRange`] for fewer than three steps or too many, or z ≤ 0.
pub fn seen_in_phase(phase_rad: &[f64], width: usize, steps: usize, z: f64, rows: usize) -> Result<Option<PhaseError>> {
    require_positive("z", z)?;
    check_steps(steps)?;
    if width == 0 || phase_rad.is_empty() || !phase_rad.len().is_multiple_of(width) {
        let got = format!("{} values, {width} in a row", phase_rad.len());
        return Err(Error::Shape { what: "phase_rad", expected: "an image (H, W)".into(), got });
    }
    let row = |y: usize| {
        let row = phase_rad.get(y * width..(y + 1) * width).unwrap_or_default();
        row.iter().map(|p| if p.is_finite() { (p / TAU) as f32 } else { f32::NAN }).collect()
    };
    Ok(seen_in_rows(width, phase_rad.len() / width, &row, steps, z, rows.max(ROWS)))
}

/// The phase along a row of a shot, turns; NaN where the fringes do not stand clear of the noise in any exposure.
fn shot_row<T: Level>(
    shot: &Shot<'_, T>,
    at: usize,
    steps: usize,
    wave: &Wave,
    noise: &CameraNoise,
    saturation: f32,
    y: usize,
) -> Vec<f32> {
    let mut row = vec![f32::NAN; shot.width];
    let mut fit = Sinusoid::empty();
    for (tile, out) in row.chunks_mut(TILE).enumerate() {
        let (mut re, mut im) = ([0.0f32; TILE], [0.0f32; TILE]);
        for frames in &shot.exposures {
            let frames = frames.get(at..at + steps).unwrap_or_default();
            demodulate(frames, y * shot.width + tile * TILE, out.len(), wave, &mut fit);
            for i in 0..TILE {
                let b2 = fit.re[i] * fit.re[i] + fit.im[i] * fit.im[i];
                let level = noise.floor() as f32 + noise.gain as f32 * fit.background[i];
                if fit.top[i] < saturation && b2 > 100.0 * level {
                    re[i] += fit.re[i];
                    im[i] += fit.im[i];
                }
            }
        }
        for (out, (&re, &im)) in out.iter_mut().zip(re.iter().zip(&im)) {
            *out = if re == 0.0 && im == 0.0 { f32::NAN } else { turns(im, re) };
        }
    }
    row
}

fn wrap(x: f32) -> f32 {
    x - round(x)
}

fn median(values: &mut [f32]) -> Option<f32> {
    nth(values, values.len() / 2)
}

/// Three phases of a row or column, a lag apart, turns.
type Three = [f32; 3];

/// The second difference of the true phase, and how it changes with the coefficients.
#[inline(always)]
fn second_difference(three: &Three, error: &Trial) -> (f32, [f32; FITTED]) {
    let (mut phases, mut slopes) = ([0.0f32; 3], [0.0f32; FITTED]);
    for ((phase, measured), weight) in phases.iter_mut().zip(three).zip([1.0, -2.0, 1.0]) {
        *phase = measured - sine_series(error.steps, &error.measured, *measured);
        let (sin, cos) = sin_cos_turns(error.steps * *phase);
        let (mut sines, mut slope) = ([0.0f32; FITTED], 1.0f32);
        let (mut s0, mut s1, mut c0, mut c1) = (0.0f32, sin, 1.0f32, cos);
        for ((m, out), a) in (1u8..).zip(&mut sines).zip(&error.fitted) {
            *out = s1;
            // The coefficients are in turns, the angle in radians of N turns.
            slope += std::f32::consts::TAU * f32::from(m) * error.steps * a * c1;
            (s0, s1) = (s1, 2.0 * cos * s1 - s0);
            (c0, c1) = (c1, 2.0 * cos * c1 - c0);
        }
        for (out, s) in slopes.iter_mut().zip(&sines) {
            *out -= weight * s / slope;
        }
    }
    let [a, b, c] = phases;
    (wrap(wrap(a - b) - wrap(b - c)), slopes)
}

type PhaseRow<'a> = &'a (dyn Fn(usize) -> Vec<f32> + Sync);

/// Whether the phase runs down the image, and the wave of its error in pixels; `None` if that is too long.
fn error_wave(width: usize, height: usize, row: PhaseRow<'_>, steps: usize) -> Option<(bool, f64)> {
    let pairs = PROBES.min(height / 2);
    let (mut across, mut along) = (Vec::new(), Vec::new());
    for i in 0..pairs {
        let y = i * (height - 2) / pairs.saturating_sub(1).max(1);
        let (upper, lower) = (row(y), row(y + 1));
        across.extend(upper.iter().zip(upper.iter().skip(1)).map(|(a, b)| wrap(a - b).abs()).filter(|s| !s.is_nan()));
        along.extend(upper.iter().zip(&lower).map(|(a, b)| wrap(a - b).abs()).filter(|s| !s.is_nan()));
    }
    let (across, along) = (median(&mut across)?, median(&mut along)?);
    let down = along > across;
    let wave = 1.0 / (steps as f64 * f64::from(across.max(along)));
    let reach = if down { height } else { width };
    (wave <= LONGEST_WAVE && (reach as f64) > 4.0 * wave + 8.0).then_some((down, wave))
}

fn samples(width: usize, height: usize, row: PhaseRow<'_>, steps: usize, rows: usize) -> Option<Vec<Vec<Three>>> {
    let (down, wave) = error_wave(width, height, row, steps)?;
    let lags = LAGS.map(|part| (part * wave).round().max(1.0) as usize);
    let margin = if down { lags.iter().copied().max()? } else { 0 };
    let reach = height.checked_sub(2 * margin + 1)?;
    let count = rows.min(reach + 1);
    let look = |(i, &lag): (usize, &usize), stride: usize| -> Vec<Three> {
        let y = margin + i * reach / count.saturating_sub(1).max(1);
        let here = row(y);
        let (before, middle, after) = if down {
            (&row(y - lag)[..], &here[..], &row(y + lag)[..])
        } else {
            (&here[..], here.get(lag..).unwrap_or_default(), here.get(2 * lag..).unwrap_or_default())
        };
        let three = before.iter().zip(middle).zip(after).skip(y % stride).step_by(stride);
        let three = three.map(|((&a, &b), &c)| [a, b, c]);
        three.filter(|t| t.iter().all(|p| p.is_finite())).collect()
    };
    let taken = |stride: usize| -> Vec<Vec<Three>> {
        lags.iter().cycle().take(count).enumerate().map(|at| look(at, stride)).collect()
    };
    let total = |found: &[Vec<Three>]| found.iter().map(Vec::len).sum::<usize>();
    let mut found = taken((width / PER_ROW).max(1));
    // Little of the image shows fringes (three spheres, say): then all of it counts.
    if width > PER_ROW && total(&found) < count * PER_ROW / 2 {
        found = taken(1);
    }
    (total(&found) >= FEWEST).then_some(found)
}

/// An error under trial: coefficients in turns, in the true phase and in the measured one.
struct Trial {
    steps: f32,
    fitted: [f32; FITTED],
    measured: Vec<f32>,
}

/// Normal equations of a row, `matrix · step = right`.
struct RowEquations {
    matrix: Square,
    right: Coefficients,
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
fn misses(samples: &[Three], error: &Trial) -> Vec<(f32, [f32; FITTED])> {
    samples.iter().map(|three| second_difference(three, error)).collect()
}

fn normal(misses: &[(f32, [f32; FITTED])], scale: f32) -> RowEquations {
    let (mut matrix, mut right) = ([[0.0f64; FITTED]; FITTED], [0.0f64; FITTED]);
    for (miss, slopes) in misses {
        let u = miss / scale;
        let near = (1.0 - u * u).max(0.0);
        let (w, miss) = (f64::from(near * near), f64::from(*miss));
        let slopes = slopes.map(f64::from);
        for ((row, right), s) in matrix.iter_mut().zip(&mut right).zip(&slopes) {
            let ws = w * s;
            *right -= ws * miss;
            row.iter_mut().zip(&slopes).for_each(|(m, t)| *m += ws * t);
        }
    }
    RowEquations { matrix: Square::from_row_iterator(matrix.into_iter().flatten()), right: Coefficients::from(right) }
}

/// The error by the true phase, rad: the fit under way.
struct ErrorFit {
    rows: Vec<Vec<Three>>,
    steps: usize,
    a_rad: Coefficients,
    scale: f32,
}

impl ErrorFit {
    /// The error and its slope where N times the true phase is theta.
    fn error(a_rad: &Coefficients, theta: f64) -> (f64, f64) {
        let (sin, cos) = theta.sin_cos();
        let (mut s0, mut s1, mut c0, mut c1) = (0.0, sin, 1.0, cos);
        let (mut error, mut slope) = (0.0, 0.0);
        for (m, a) in (1u8..).zip(a_rad.iter()) {
            error += a * s1;
            slope += a * f64::from(m) * c1;
            (s0, s1) = (s1, 2.0 * cos * s1 - s0);
            (c0, c1) = (c1, 2.0 * cos * c1 - c0);
        }
        (error, slope)
    }

    fn series(&self, a_rad: &Coefficients) -> [f64; TERMS] {
        in_the_measured_phase(self.steps, |theta| Self::error(a_rad, theta))
    }

    /// Does the measured phase rise with the true one everywhere?
    fn is_one_to_one(&self, a_rad: &Coefficients) -> bool {
        (0..128).all(|i| 1.0 + self.steps as f64 * Self::error(a_rad, TAU * f64::from(i) / 128.0).1 > 0.05)
    }

    /// The normal equations of each row, with the scale of the misses anew where it is asked for.
    fn normals(&mut self, anew: bool) -> Option<Vec<RowEquations>> {
        let narrow = |c: f64| (c / TAU) as f32;
        let series = if self.a_rad == Coefficients::zeros() { [0.0; TERMS] } else { self.series(&self.a_rad) };
        let used = series.iter().rposition(|c| c.abs() > NEGLIGIBLE).map_or(0, |m| m + 1);
        let measured = series.iter().take(used).map(|&c| narrow(c)).collect();
        let fitted = std::array::from_fn(|m| narrow(self.a_rad.get(m).copied().unwrap_or(0.0)));
        let known = Trial { steps: self.steps as f32, fitted, measured };
        let rows: Vec<_> = self.rows.iter().map(|r| misses(r, &known)).collect();
        if anew {
            let mut sizes: Vec<f32> = rows.iter().flatten().map(|(miss, _)| miss.abs()).collect();
            self.scale = (TUKEY_SIGMAS * MEDIAN_TO_SIGMA) as f32 * median(&mut sizes)?.max(1e-6);
        }
        Some(rows.iter().map(|r| normal(r, self.scale)).collect())
    }

    /// One step of Gauss and Newton, with weights anew, no longer than keeps phases apart; returns its largest part, rad,
    /// and `None` where the coefficients are not determined.
    fn improve(&mut self) -> Option<f64> {
        let (mut matrix, mut right) = (Square::zeros(), Coefficients::zeros());
        for row in self.normals(true)? {
            matrix += row.matrix;
            right += row.right;
        }
        let mut step = TAU * matrix.cholesky()?.solve(&right);
        for _ in 0..8 {
            if self.is_one_to_one(&(self.a_rad + step)) {
                self.a_rad += step;
                return Some(step.amax());
            }
            step *= 0.5;
        }
        None
    }

    /// What stands z standard deviations above zero.
    fn judged(&mut self, z: f64) -> Option<PhaseError> {
        let (mut matrix, mut scatter) = (Square::zeros(), Square::zeros());
        for row in self.normals(false)? {
            matrix += row.matrix;
            scatter += row.right * row.right.transpose();
        }
        let inverse = matrix.cholesky()?.inverse();
        let covariance = TAU * TAU * inverse * scatter * inverse;
        let standard: Vec<f64> = covariance.diagonal().iter().map(|v| v.max(0.0).sqrt()).collect();
        let mut found = PhaseError::none(self.steps);
        let clear = |(a, s): (&f64, &f64)| a.abs() > z * s;
        let large = |(a, s): (&f64, &f64)| a.abs() > (z * s).max(display_rounding_rad(self.steps));
        let seen = self.a_rad.iter().zip(&standard).any(large);
        // To first order the terms in the measured phase are those in the true one.
        found.standard_rad.iter_mut().zip(&standard).for_each(|(f, s)| *f = *s);
        if seen {
            let last = self.a_rad.iter().zip(&standard).rposition(clear).map_or(0, |m| m + 1);
            let mut clear_terms = self.a_rad;
            clear_terms.iter_mut().skip(last).for_each(|a| *a = 0.0);
            found.sin_rad = self.series(&clear_terms);
            found.source = ErrorSource::Phase;
        }
        Some(found)
    }
}

fn seen_in_rows(
    width: usize,
    height: usize,
    row: PhaseRow<'_>,
    steps: usize,
    z: f64,
    rows: usize,
) -> Option<PhaseError> {
    if height < 2 || width < 2 {
        return None;
    }
    let rows = samples(width, height, row, steps, rows)?;
    let mut fit = ErrorFit { rows, steps, a_rad: Coefficients::zeros(), scale: 0.0 };
    fit.improve()?;
    // A first, linear step shows whether there may be something: most of the time there is not.
    let first = fit.judged(2.0)?;
    for _ in 1..ITERATIONS {
        if !first.is_some() || fit.improve()? < CONVERGED {
            break;
        }
    }
    fit.judged(z)
}

#[cfg(test)]
mod tests {
    use super::super::phase_error::tests::measured;
    use super::super::phase_error::{error_of_harmonics, harmonics_of_gamma};
    use super::*;

    /// A curved surface under fringes, with noise.
    fn wall(gamma: f64, steps: usize, noise: f64, down: bool) -> Vec<f64> {
        let mut state = 1u64;
        let mut random = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 53) as f64 - 0.5
        };
        let at = |x: f64, y: f64| 0.3 * x + 1e-4 * x * x + 0.02 * y;
        let pixel = |i: usize| {
            let (x, y) = ((i % 400) as f64, (i / 400) as f64);
            measured(if down { at(y, x) } else { at(x, y) }, gamma, steps)
        };
        (0..400 * 300).map(|i| pixel(i) + noise * 12f64.sqrt() * random()).collect()
    }

    #[test]
    fn the_error_is_seen_in_the_phase_itself() {
        for (gamma, steps, down) in [(1.35, 3, false), (1.35, 3, true), (2.2, 3, false), (0.7, 3, true), (1.5, 4, true)]
        {
            let phase = wall(gamma, steps, 0.01, down);
            let seen = seen_in_phase(&phase, 400, steps, 5.0, 24).unwrap().unwrap();
            let known = error_of_harmonics(&harmonics_of_gamma(gamma), steps).unwrap();
            assert_eq!(seen.source, ErrorSource::Phase);
            for (c, k) in seen.sin_rad.iter().zip(&known.sin_rad) {
                assert!((c - k).abs() < 3e-3, "{seen:?} {known:?}");
            }
        }
    }

    #[test]
    fn nothing_is_seen_where_there_is_nothing() {
        let seen = seen_in_phase(&wall(1.0, 3, 0.01, false), 400, 3, 5.0, 24).unwrap().unwrap();
        assert_eq!(seen.source, ErrorSource::Nothing);
        assert_eq!(seen.sin_rad, [0.0; TERMS]);
        assert!(seen.standard_rad[0] > 0.0);
        // A flat phase, noise alone, and nothing at all.
        assert_eq!(seen_in_phase(&[0.3; 400 * 300], 400, 3, 5.0, 24).unwrap(), None);
        assert_eq!(seen_in_phase(&[f64::NAN; 400 * 300], 400, 3, 5.0, 24).unwrap(), None);
        let noise: Vec<f64> = wall(1.0, 3, 50.0, false);
        assert!(seen_in_phase(&noise, 400, 3, 5.0, 24).unwrap().is_none_or(|e| !e.is_some()));
        assert!(seen_in_phase(&[0.0; 10], 3, 3, 5.0, 24).is_err());
        assert!(seen_in_phase(&[0.0; 9], 3, 2, 5.0, 24).is_err());
        assert!(seen_in_phase(&[], 0, 3, 5.0, 24).is_err());
    }
}
