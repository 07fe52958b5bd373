//! Fringe images to the projector column that lights each pixel.
//!
//! Step k of N projects `0.5 + 0.5 cos(2π(periods (u + 0.5)/width) - 2πk/N)` into column u, and the camera sees
//! `I_k = A + B cos(phi - 2πk/N)` with `phi = atan2(ΣI sin, ΣI cos)` and `sigma_phi = sqrt(2/N) sigma_I / B`.
//! [`decode_shot`] does all of it for one axis of one shot: noise model from the data, N-step phases of every set and
//! exposure, exposures fused, temporal unwrapping by [`Plan`], and a reason for every pixel without
//! an answer.

use multiversion::multiversion;
use rayon::prelude::*;

use super::jumps::reject_jumps;
use super::kernel::{Decoder, Fuse, Results, Work};
use super::noise::{self, CameraNoise};
use super::phase_error::PhaseError;
use super::phase_map::{PhaseMap, REASONS};
use super::redundancy;
use super::response;
use super::saturation;
use super::shot::{FringeSet, Shot};
use super::temporal::Plan;
use super::wave::{Level, Sinusoid, TILE, Wave, demodulate};
use crate::error::{Error, Result, require_positive};
use crate::ground::memory::{filled, require, room};
use crate::ground::stop::polled;
use crate::ground::threads::{self, CHUNK};

/// What is done about the projector's response, see [`PhaseError`].
#[derive(Debug, Clone, Default, PartialEq)]
pub enum Compensation {
    /// Nothing.
    #[default]
    Off,
    /// The error that the shot's own phases show is taken off, where they show one above the noise.
    Auto,
    /// A known error per set.
    Given(Vec<PhaseError>),
}

/// Settings of [`decode_shot`]. The defaults follow from noise and geometry.
#[derive(Debug, Clone, PartialEq)]
pub struct DecodeOptions {
    /// The level at which the camera saturates; `None`: see [`saturation`](saturation::saturation).
    pub saturation: Option<f64>,
    /// The safety factor z on sigma. At 5 noise alone decides one fringe order in two million wrongly.
    pub z: f64,
    /// The projector's response.
    pub compensation: Compensation,
}

impl Default for DecodeOptions {
    fn default() -> Self {
        Self { saturation: None, z: 5.0, compensation: Compensation::Off }
    }
}

/// Decodes the fringe images of one axis of one shot. `projector_size` is the projector's extent along that axis, px.
///
/// # Errors
/// [`Error::Shape`] where the frames do not fit the fringes or each other, [`Error::OutOfRange`] for fewer than three
/// steps, a frequency or setting out of its range, and for a list of fringes that cannot be unwrapped.
pub fn decode_shot<T: Fuse>(
    shot: &Shot<'_, T>,
    sets: &[FringeSet],
    projector_size: usize,
    options: &DecodeOptions,
) -> Result<PhaseMap> {
    validate(shot, sets, projector_size, options)?;
    let plan = Plan::new(&sets.iter().map(|s| s.periods).collect::<Vec<_>>(), options.z)?;
    let seen = options.saturation.is_none().then(|| saturation::saturation(shot, None));
    let saturation = options.saturation.or(seen.map(|s| s.level)).unwrap_or(f64::INFINITY);
    let noise = noise::estimate(shot, sets, saturation as f32);
    let phase_error = match &options.compensation {
        Compensation::Off => sets.iter().map(|s| PhaseError::none(s.steps)).collect(),
        Compensation::Auto => response::seen_in_shot(shot, sets, &noise, saturation as f32, options.z),
        Compensation::Given(errors) => errors.clone(),
    };
    let disagreements =
        redundancy::disagreements(shot, sets, &plan, &noise, saturation as f32, &phase_error, options.z);
    let decoder = Decoder::new(shot, sets, &plan, projector_size, noise, saturation as f32, options.z as f32)
        .compensating(&phase_error);

    let n = shot.width * shot.height;
    require(n, 40);
    let (mut column, mut sigma, mut reason) = (room::<f64>(n), room::<f32>(n), room::<u8>(n));
    let (mut modulation, mut background) = (room::<f32>(n), room::<f32>(n));
    threads::install(|| {
        let floats = sigma.par_chunks_mut(CHUNK).zip(modulation.par_chunks_mut(CHUNK));
        let floats = floats.zip(background.par_chunks_mut(CHUNK));
        let columns = column.par_chunks_mut(CHUNK).zip(reason.par_chunks_mut(CHUNK));
        columns.zip(floats).inspect(polled).enumerate().for_each(
            |(chunk, ((column, reason), ((sigma, modulation), background)))| {
                let mut work = Work::new(sets.len());
                let tiles = column.chunks_mut(TILE).zip(reason.chunks_mut(TILE));
                let floats = sigma.chunks_mut(TILE).zip(modulation.chunks_mut(TILE)).zip(background.chunks_mut(TILE));
                for (tile, ((column, reason), ((sigma, modulation), background))) in tiles.zip(floats).enumerate() {
                    let results = Results { column, sigma, modulation, background, reason };
                    decoder.tile(chunk * CHUNK + tile * TILE, &mut work, results);
                }
            },
        );
    });
    // SAFETY: the chunks cover the images, and their tiles, of at most `TILE` pixels, the chunks; a tile writes them all.
    let (column_px, sigma_px, reason) = unsafe { (filled(column), filled(sigma), filled(reason)) };
    // SAFETY: as above.
    let (modulation, background) = unsafe { (filled(modulation), filled(background)) };
    let mut map = PhaseMap {
        width: shot.width,
        height: shot.height,
        column_px,
        sigma_px,
        modulation,
        background,
        reason,
        counts: [0; REASONS],
        noise,
        saturation,
        clipped_below_full_scale: seen.is_some_and(|s| s.below_full_scale),
        harmonics: harmonics(shot, sets, &noise, saturation as f32),
        phase_error,
        plan: plan.clone(),
        disagreements,
    };
    if !plan.links.is_empty() {
        let finest = sets.get(plan.finest).map_or(1.0, |s| s.periods);
        reject_jumps(&mut map, 0.5 * projector_size as f64 / finest);
    }
    map.counts = count_reasons(&map.reason);
    if map.disagreements.is_empty() {
        let (columns, size) = (&map.column_px, projector_size as f64);
        map.disagreements.extend(redundancy::run_over(columns, map.width, map.height, sets, &map.plan, size));
    }
    Ok(map)
}

fn count_reasons(reason: &[u8]) -> [usize; REASONS] {
    let counts = threads::map_chunks(reason, |_, chunk| count_chunk(chunk));
    counts.iter().fold([0; REASONS], |sum, c| std::array::from_fn(|r| sum[r] + c[r] as usize))
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
fn count_chunk(reason: &[u8]) -> [u32; REASONS] {
    let mut counts = [0; REASONS];
    for (r, count) in counts.iter_mut().enumerate() {
        // Bytes count bytes, as far as they can.
        for part in reason.chunks(128) {
            let mut few = 0u8;
            for &x in part {
                few += u8::from(x == r as u8);
            }
            *count += u32::from(few);
        }
    }
    counts
}

fn validate<T>(shot: &Shot<'_, T>, sets: &[FringeSet], projector_size: usize, options: &DecodeOptions) -> Result<()> {
    for (what, count) in [("fringes", sets.len()), ("exposures", shot.exposures.len())] {
        if count == 0 {
            return Err(Error::Shape { what, expected: "at least one".into(), got: "none".into() });
        }
    }
    require_positive("projector_size", projector_size as f64)?;
    require_positive("z", options.z)?;
    if let Some(level) = options.saturation {
        require_positive("saturation", level)?;
    }
    if let Some(set) = sets.iter().find(|s| s.steps < 3) {
        let (expected, value) = ("3 or more".into(), set.steps.to_string());
        return Err(Error::OutOfRange { what: "steps of a fringe set", expected, value });
    }
    if let Some(set) = sets.iter().find(|s| s.direction.abs() != 1.0) {
        let (expected, value) = ("1 or -1".into(), set.direction.to_string());
        return Err(Error::OutOfRange { what: "direction of a fringe set", expected, value });
    }
    if let Some(set) = sets.iter().find(|s| !s.origin_rad.is_finite() || s.origin_rad.abs() > std::f64::consts::TAU) {
        let (expected, value) = ("within one turn".into(), set.origin_rad.to_string());
        return Err(Error::OutOfRange { what: "origin_rad of a fringe set", expected, value });
    }
    if let Compensation::Given(errors) = &options.compensation
        && !errors.iter().map(|e| e.steps).eq(sets.iter().map(|s| s.steps))
    {
        let got = format!("{:?}", errors.iter().map(|e| e.steps).collect::<Vec<_>>());
        return Err(Error::Shape { what: "phase_error", expected: "one per fringe set, of its steps".into(), got });
    }
    let needed: usize = sets.iter().map(|s| s.steps).sum();
    for frames in &shot.exposures {
        if frames.len() != needed {
            let expected = format!("{needed} frames per exposure, the steps of all fringe sets");
            return Err(Error::Shape { what: "exposures", expected, got: frames.len().to_string() });
        }
        if let Some(frame) = frames.iter().find(|f| f.len() != shot.width * shot.height) {
            let expected = format!("frames of {} x {} pixels", shot.width, shot.height);
            return Err(Error::Shape { what: "exposures", expected, got: format!("{} pixels", frame.len()) });
        }
    }
    Ok(())
}

/// The rms of the harmonics over the amplitude, by set, over sample rows: what noise does not explain of the residual.
fn harmonics<T: Level>(
    shot: &Shot<'_, T>,
    sets: &[FringeSet],
    noise: &CameraNoise,
    saturation: f32,
) -> Vec<Option<f64>> {
    let Some(frames) = shot.exposures.first() else { return Vec::new() };
    let mut at = 0;
    let mut out = Vec::new();
    for set in sets {
        let frames = frames.get(at..at + set.steps).unwrap_or_default();
        at += set.steps;
        if set.steps == 3 {
            out.push(None);
            continue;
        }
        let (mut rest, mut power) = (0.0, 0.0);
        let (wave, mut fit) = (Wave::new(set.steps), Sinusoid::empty());
        // A quarter of them: thousands of pixels are plenty for a mean.
        for row in noise::sample_rows(shot.height).step_by(4) {
            let mut start = row * shot.width;
            while start < (row + 1) * shot.width {
                let len = TILE.min((row + 1) * shot.width - start);
                demodulate(frames, start, len, &wave, &mut fit);
                for i in 0..len {
                    let level = noise.floor() + noise.gain * f64::from(fit.background[i]);
                    let b2 = f64::from(fit.re[i]).powi(2) + f64::from(fit.im[i]).powi(2);
                    // Where the fringes do not stand clear of the noise there is no harmonic to see.
                    if fit.top[i] < saturation && b2 > 100.0 * level {
                        rest += f64::from(fit.rest[i]) - (set.steps - 3) as f64 * level;
                        power += 0.5 * set.steps as f64 * b2;
                    }
                }
                start += len;
            }
        }
        out.push((power > 0.0).then(|| (rest / power).max(0.0).sqrt()));
    }
    out
}

#[cfg(test)]
pub(super) mod tests {
    use std::f64::consts::TAU;

    use super::super::phase_map::Reason;
    use super::*;

    fn noise(seed: u64) -> impl FnMut() -> f64 {
        let mut state = seed;
        move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 53) as f64
        }
    }

    pub(in crate::fringes) const SETS: [FringeSet; 3] =
        [FringeSet::new(59.0, 4), FringeSet::new(64.0, 5), FringeSet::new(70.0, 12)];

    /// Images of a slanted wall with some noise, saturation and darkness in it.
    pub(in crate::fringes) fn images(width: usize, height: usize) -> Vec<Vec<u8>> {
        let mut random = noise(7);
        let mut frames = Vec::new();
        for set in SETS {
            for k in 0..set.steps {
                let frame = (0..width * height).map(|i| {
                    let x = (i % width) as f64 / width as f64;
                    let wave = TAU * (set.periods * (0.05 + 0.9 * x) - k as f64 / set.steps as f64);
                    (160.0 * x * (1.1 + wave.cos()) + 2.0 * random()) as u8
                });
                frames.push(frame.collect());
            }
        }
        frames
    }

    #[test]
    fn columns_come_back_on_any_number_of_threads() {
        let (width, height) = (700, 50);
        let frames = images(width, height);
        let shot = Shot { exposures: vec![frames.iter().map(Vec::as_slice).collect()], width, height };
        let run = || decode_shot(&shot, &SETS, 912, &DecodeOptions::default()).unwrap();
        crate::ground::threads::set_threads(Some(1)).unwrap();
        let one = run();
        crate::ground::threads::set_threads(Some(3)).unwrap();
        let three = run();
        crate::ground::threads::set_threads(None).unwrap();
        assert_eq!(
            one.column_px.iter().map(|c| c.to_bits()).collect::<Vec<_>>(),
            three.column_px.iter().map(|c| c.to_bits()).collect::<Vec<_>>()
        );
        assert_eq!(one.counts, three.counts);
        let mut seen = 0;
        for (i, column) in one.column_px.iter().enumerate().filter(|c| c.1.is_finite()) {
            let truth = 912.0 * (0.05 + 0.9 * (i % width) as f64 / width as f64) - 0.5;
            assert!((column - truth).abs() < 6.0 * f64::from(one.sigma_px[i]) + 0.02, "{column} {truth}");
            seen += 1;
        }
        assert!(seen > width * height / 3, "{:?}", one.counts);
    }

    #[test]
    fn neighbours_with_another_order_are_jumps() {
        let mut map = {
            let frames = images(64, 16);
            let shot = Shot { exposures: vec![frames.iter().map(Vec::as_slice).collect()], width: 64, height: 16 };
            decode_shot(&shot, &SETS, 912, &DecodeOptions::default()).unwrap()
        };
        map.column_px = (0..64 * 16).map(|i| (i % 64) as f64).collect();
        map.reason.fill(0);
        // One alone, a pair, and an edge that stays.
        for at in [5 * 64 + 10, 8 * 64 + 30, 8 * 64 + 31] {
            map.column_px[at] += 20.0;
        }
        for y in 0..16 {
            for x in 50..64 {
                map.column_px[y * 64 + x] += 40.0;
            }
        }
        reject_jumps(&mut map, 7.0);
        let rejected: Vec<usize> = (0..64 * 16).filter(|&i| map.reason[i] == Reason::OrderInDoubt as u8).collect();
        assert_eq!(rejected, [5 * 64 + 10, 8 * 64 + 30, 8 * 64 + 31]);
    }
}
