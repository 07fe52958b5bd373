//! The error of a measured phase as a series in it, and the series that known harmonics of the light make.
//!
//! Harmonic p of the light is taken for the fundamental where p = mN ± 1. So the measured phase of N steps is
//! `φ' = φ + Σ a_m sin(m N φ)`. What is applied is the same error as a series in the measured phase,
//! `φ = φ' - Σ c_m sin(m N φ')`: it needs more terms than the series in the true phase, but no solving in every pixel.

use crate::ground::branchless::round;
use std::f64::consts::TAU;

use multiversion::multiversion;

use super::wave::Lane;
use crate::error::{Error, Result};

/// Terms in the measured phase: with three steps and a gamma of 2.2 the sixteenth is 0.1 mrad.
pub const TERMS: usize = 16;
/// Terms below this, in rad, are left out of the kernel.
pub(super) const NEGLIGIBLE: f64 = 1e-6;
/// Points of a period over which series are turned into each other; those in between are right to 1e-9.
const POINTS: usize = 512;
/// Harmonics of a power law that are kept.
const HARMONICS: usize = 48;

/// Where a set's error is known from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ErrorSource {
    /// Nothing was seen above the noise.
    Nothing,
    /// The set's own phase.
    Phase,
    /// A finer set, for this one's waves are too long to be seen against the surface.
    FinerSet,
    /// The caller.
    Given,
}

impl ErrorSource {
    /// One word for it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Nothing => "nothing",
            Self::Phase => "phase",
            Self::FinerSet => "finer set",
            Self::Given => "given",
        }
    }
}

/// The error of a measured phase φ' of `steps` steps: `Σ sin_rad[m - 1] sin(m steps φ')`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PhaseError {
    /// Steps of the set.
    pub steps: usize,
    /// Coefficients, rad.
    pub sin_rad: [f64; TERMS],
    /// Their standard deviations; zero where they were given.
    pub standard_rad: [f64; TERMS],
    /// Where it is known from.
    pub source: ErrorSource,
}

impl PhaseError {
    /// No error.
    pub fn none(steps: usize) -> Self {
        Self { steps, sin_rad: [0.0; TERMS], standard_rad: [0.0; TERMS], source: ErrorSource::Nothing }
    }

    /// A known one.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for fewer than three steps, more than 16 coefficients, one that is not finite, and
    /// a series that no phase can have: two phases would be measured as one.
    pub fn given(steps: usize, sin_rad: &[f64]) -> Result<Self> {
        let wrong = |expected: String, value: String| Err(Error::OutOfRange { what: "phase_error", expected, value });
        check_steps(steps)?;
        if sin_rad.len() > TERMS {
            return wrong(format!("at most {TERMS} coefficients"), sin_rad.len().to_string());
        }
        if let Some(bad) = sin_rad.iter().find(|c| !c.is_finite()) {
            return wrong("finite".into(), bad.to_string());
        }
        let mut terms = [0.0; TERMS];
        terms.iter_mut().zip(sin_rad).for_each(|(t, c)| *t = *c);
        let given = Self { sin_rad: terms, source: ErrorSource::Given, ..Self::none(steps) };
        if !given.is_one_to_one() {
            return wrong("a series that keeps the order of phases".into(), format!("{sin_rad:?}"));
        }
        Ok(given)
    }

    /// Is there anything to take off?
    pub fn is_some(&self) -> bool {
        self.source != ErrorSource::Nothing
    }

    /// The largest error of a phase, rad.
    pub fn largest_rad(&self) -> f64 {
        let error = |theta: f64| (1..).zip(&self.sin_rad).map(|(m, c)| c * (f64::from(m) * theta).sin()).sum::<f64>();
        (0..128).map(|i| error(TAU * f64::from(i) / 128.0).abs()).fold(0.0, f64::max)
    }

    /// Does the true phase rise with the measured one everywhere?
    fn is_one_to_one(&self) -> bool {
        let slope = |theta: f64| {
            let terms = (1..).zip(&self.sin_rad);
            1.0 - terms.map(|(m, c)| f64::from(m) * self.steps as f64 * c * (f64::from(m) * theta).cos()).sum::<f64>()
        };
        (0..128).all(|i| slope(TAU * f64::from(i) / 128.0) > 0.0)
    }

    /// Steps and coefficients as the kernel takes them: turns of turns.
    pub(super) fn in_turns(&self) -> Option<(f32, Vec<f32>)> {
        let used = self.sin_rad.iter().rposition(|c| c.abs() > NEGLIGIBLE).map_or(0, |m| m + 1);
        let terms = self.sin_rad.iter().take(used).map(|c| (c / TAU) as f32).collect();
        (self.is_some() && used > 0).then_some((self.steps as f32, terms))
    }
}

/// sin and cos of 2πx to 4e-6, by Taylor's series at half the angle.
#[inline(always)]
pub(super) fn sin_cos_turns(x: f32) -> (f32, f32) {
    let h = std::f32::consts::PI * (x - round(x));
    let z = h * h;
    let s = 1.0 + z * (-1.0 / 6.0 + z * (1.0 / 120.0 + z * (-1.0 / 5040.0 + z * (1.0 / 362_880.0 - z / 39_916_800.0))));
    let c = 1.0 + z * (-0.5 + z * (1.0 / 24.0 + z * (-1.0 / 720.0 + z * (1.0 / 40_320.0 - z / 3_628_800.0))));
    let s = h * s;
    (2.0 * s * c, 1.0 - 2.0 * s * s)
}

/// Takes the error off the phases of a tile, in turns.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
pub(super) fn compensate(steps: f32, terms: &[f32], phase: &mut Lane) {
    for p in phase.iter_mut() {
        *p -= sine_series(steps, terms, *p);
    }
}

/// The series `Σ terms[m - 1] sin(2π m steps p)` by Clenshaw.
#[inline(always)]
pub(super) fn sine_series(steps: f32, terms: &[f32], p: f32) -> f32 {
    let (sin, cos) = sin_cos_turns(steps * p);
    let (mut one, mut two) = (0.0f32, 0.0f32);
    for c in terms.iter().rev() {
        (one, two) = (c + 2.0 * cos * one - two, one);
    }
    one * sin
}

/// The error that harmonics of the light make: `ratios[p - 2]` is the amplitude of harmonic p over the fundamental's.
///
/// # Errors
/// [`Error::OutOfRange`] for fewer than three steps, [`Error::NonFinite`], and [`Error::Degenerate`] where the
/// harmonics outweigh the fundamental.
pub fn error_of_harmonics(ratios: &[f64], steps: usize) -> Result<PhaseError> {
    if let Some(index) = ratios.iter().position(|r| !r.is_finite()) {
        return Err(Error::NonFinite { what: "harmonics", index });
    }
    check_steps(steps)?;
    // What is taken for the fundamental, over it: 1 + Σ r_{mN+1} e^{imθ} + r_{mN-1} e^{-imθ}, θ = Nφ.
    let aliases: Vec<(f64, f64)> = (2..)
        .zip(ratios)
        .filter_map(|(p, &r)| match p % steps {
            1 => Some((((p - 1) / steps) as f64, r)),
            rest if rest == steps - 1 => Some((-(p.div_ceil(steps) as f64), r)),
            _ => None,
        })
        .collect();
    // The phasor, and its derivative by θ.
    let phasor = |theta: f64| {
        aliases.iter().fold((1.0, 0.0, 0.0, 0.0), |(re, im, re1, im1), &(m, r)| {
            let (sin, cos) = (m * theta).sin_cos();
            (re + r * cos, im + r * sin, re1 - m * r * sin, im1 + m * r * cos)
        })
    };
    if (0..POINTS).any(|i| phasor(TAU * i as f64 / POINTS as f64).0 <= 0.0) {
        let reason = "they outweigh the fundamental".into();
        return Err(Error::Degenerate { what: "harmonics", reason });
    }
    let sin_rad = in_the_measured_phase(steps, |theta| {
        let (re, im, re1, im1) = phasor(theta);
        (im.atan2(re), (im1 * re - re1 * im) / (re * re + im * im))
    });
    PhaseError::given(steps, &sin_rad)
}

/// The coefficients of an error as a series in the measured phase, from the error (rad) and its slope over θ, N times the
/// true phase: `c_m = 1/π ∫ Δ sin(mθ') dθ' = 1/(mπ) ∫ cos(mθ') dΔ` with θ' = θ + NΔ.
pub(super) fn in_the_measured_phase(steps: usize, error: impl Fn(f64) -> (f64, f64)) -> [f64; TERMS] {
    let mut sums = [0.0; TERMS];
    for i in 0..POINTS {
        let theta = TAU * i as f64 / POINTS as f64;
        let (delta, slope) = error(theta);
        let cos = (theta + steps as f64 * delta).cos();
        let (mut c0, mut c1) = (1.0, cos);
        for (m, sum) in (1u8..).zip(&mut sums) {
            *sum += 2.0 / f64::from(m) * c1 * slope / POINTS as f64;
            (c0, c1) = (c1, 2.0 * cos * c1 - c0);
        }
    }
    sums
}

/// The harmonics of light = level^gamma, over the fundamental, from the second on.
pub fn harmonics_of_gamma(gamma: f64) -> Vec<f64> {
    let mut ratio = 1.0;
    let next = |p: usize| {
        ratio *= (gamma - p as f64 + 1.0) / (gamma + p as f64);
        ratio
    };
    (2..=HARMONICS).map(next).collect()
}

/// More steps than 10,000 no camera takes, and their sines are none in single precision.
pub(super) fn check_steps(steps: usize) -> Result<()> {
    if (3..=10_000).contains(&steps) {
        return Ok(());
    }
    Err(Error::OutOfRange { what: "steps", expected: "3 to 10000".into(), value: steps.to_string() })
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::wave::TILE;
    use super::*;
    use proptest::prelude::*;

    /// The phase that N steps of light = (0.5 + 0.5 cos)^gamma are measured as.
    pub(in crate::fringes) fn measured(phi: f64, gamma: f64, steps: usize) -> f64 {
        let (mut re, mut im) = (0.0, 0.0);
        for k in 0..steps {
            let delta = TAU * k as f64 / steps as f64;
            let light = (0.5 + 0.5 * (phi - delta).cos()).powf(gamma);
            re += light * delta.cos();
            im += light * delta.sin();
        }
        im.atan2(re)
    }

    fn rms_left(error: &PhaseError, gamma: f64) -> (f64, f64) {
        let (mut before, mut after) = (0.0, 0.0);
        for i in 0..1000 {
            let phi = TAU * (f64::from(i) + 0.5) / 1000.0 - std::f64::consts::PI;
            let found = measured(phi, gamma, error.steps);
            let off = |x: f64| (x - phi + 3.0 * std::f64::consts::PI).rem_euclid(TAU) - std::f64::consts::PI;
            let mut lane = [(found / TAU) as f32; TILE];
            if let Some((steps, terms)) = error.in_turns() {
                compensate(steps, &terms, &mut lane);
            }
            before += off(found).powi(2) / 1000.0;
            after += off(f64::from(lane[0]) * TAU).powi(2) / 1000.0;
        }
        (before.sqrt(), after.sqrt())
    }

    #[test]
    fn the_error_of_a_power_law_is_taken_off() {
        for (gamma, steps, left) in [(1.35, 3, 1e-4), (2.2, 3, 1e-3), (0.6, 3, 1e-3), (1.35, 4, 1e-4), (2.2, 5, 2e-4)] {
            let error = error_of_harmonics(&harmonics_of_gamma(gamma), steps).unwrap();
            let (before, after) = rms_left(&error, gamma);
            assert!(after < left && before > 10.0 * after, "gamma {gamma}, {steps} steps: {before} -> {after}");
        }
        assert!(error_of_harmonics(&harmonics_of_gamma(1.0), 3).unwrap().sin_rad.iter().all(|c| c.abs() < 1e-12));
        assert!(error_of_harmonics(&[f64::NAN], 3).is_err());
        assert!(error_of_harmonics(&[3.0], 3).is_err());
        assert!(error_of_harmonics(&[0.1], 2).is_err());
    }

    #[test]
    fn one_to_one_or_refused() {
        assert!(PhaseError::given(3, &[0.2, 0.02]).is_ok());
        assert!(PhaseError::given(3, &[0.5]).is_err());
        assert!(PhaseError::given(3, &[f64::NAN]).is_err());
        assert!(PhaseError::given(2, &[0.1]).is_err());
        assert!(PhaseError::given(3, &[0.0; TERMS + 1]).is_err());
    }

    proptest! {
        #[test]
        fn sine_and_cosine_are_those_of_the_standard_library(x in -20.0..20.0f32) {
            let (sin, cos) = sin_cos_turns(x);
            let (s, c) = (f64::from(x) * TAU).sin_cos();
            prop_assert!((f64::from(sin) - s).abs() < 1e-5 && (f64::from(cos) - c).abs() < 1e-5);
        }
    }
}
