//! Fringe images to the projector column that lights each pixel.
//!
//! Step k of N projects `0.5 + 0.5 cos(2π(periods (u + 0.5)/width) - 2πk/N)` into column u, and the camera sees
//! `I_k = A + B cos(phi - 2πk/N)` with `phi = atan2(ΣI sin, ΣI cos)` and `sigma_phi = sqrt(2/N) sigma_I / B`.
//! [`decode_shot`] does all of it for one axis of one shot: noise model from the data, N-step phases of every set and
//! exposure, exposures fused, temporal unwrapping by [`crate::unwrap::Plan`], and a reason for every pixel without
//! an answer.

// Several tiles run in step through the kernels: there an index is plainer than a tower of zips.
#![allow(clippy::needless_range_loop)]

mod noise;
mod wave;
mod wrapped;

use std::f64::consts::TAU;

use multiversion::multiversion;
use rayon::prelude::*;

pub use noise::{Noise, NoiseSource};
pub use wave::Level;
pub(crate) use wave::{round, round64};
pub use wrapped::{WrappedPhase, decode_phase};

use crate::error::{Error, Result, require_positive};
use crate::memory::zeros;
use crate::threads::{self, CHUNK};
use crate::unwrap::Plan;
use wave::{Lane, Sinusoid, TILE, Wave, turns};

/// N steps of one frequency.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FringeSet {
    /// Periods over the projector's width (height for horizontal fringes).
    pub periods: f64,
    /// Number of steps, 3 or more.
    pub steps: usize,
}

/// The images of one shot, all of the same size, row-major.
#[derive(Debug, Clone)]
pub struct Shot<'a, T> {
    /// Per exposure the frames in the order of the fringe sets, then of the steps.
    pub exposures: Vec<Vec<&'a [T]>>,
    /// Columns of the camera's image.
    pub width: usize,
    /// Rows of the camera's image.
    pub height: usize,
}

/// Settings of [`decode_shot`]. The defaults follow from noise and geometry.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DecodeOptions {
    /// The level at which the camera saturates; `None`: see [`saturation_level`].
    pub saturation: Option<f64>,
    /// The safety factor z on sigma. At 5 noise alone decides one fringe order in two million wrongly.
    pub z: f64,
}

impl Default for DecodeOptions {
    fn default() -> Self {
        Self { saturation: None, z: 5.0 }
    }
}

/// Why a pixel has no answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Reason {
    /// It has one.
    Ok = 0,
    /// Its modulation does not stand above the noise by what the unwrapping needs.
    Dark = 1,
    /// Some set is saturated in every exposure.
    Saturated = 2,
    /// The frequencies disagree on the fringe order, or the neighbours do.
    OrderInDoubt = 3,
    /// Its samples are no sinusoid.
    NoFit = 4,
}

/// How many reasons there are.
pub const REASONS: usize = 5;

/// The share of the modulation that harmonics may reach before a pixel has "no fit": a fifth more than a display of
/// gamma 2.2 left uncorrected makes, (gamma - 1)/(gamma + 2) = 0.286. A single bad frame that passes for a harmonic
/// moves the phase by less than 4/sqrt(N) of it, 0.7 rad or a ninth of a fringe with four steps.
const HARMONIC_LIMIT: f64 = 0.35;
/// The disagreement between frequencies that is left to smooth errors of the model, in fringes. The order is wrong
/// from half a fringe on; half of that is kept in reserve. An uncorrected gamma with three steps (0.19 rad) in a
/// hierarchy of ratio 8 needs all of it: 8 * 0.19 rad = 0.24 fringes.
const MODEL_ERROR_FRINGES: f32 = 0.25;

/// What decoding found.
#[derive(Debug, Clone)]
pub struct PhaseMap {
    /// Columns of the camera's image.
    pub width: usize,
    /// Rows of the camera's image.
    pub height: usize,
    /// The projector's column (row for horizontal fringes), pixel centres at whole numbers; NaN where rejected.
    pub column_px: Vec<f64>,
    /// Its standard deviation by noise; NaN where rejected.
    pub sigma_px: Vec<f32>,
    /// Amplitude of the finest fringes in the exposure that counts most, grey levels.
    pub modulation: Vec<f32>,
    /// Mean level of the same.
    pub background: Vec<f32>,
    /// A [`Reason`] per pixel.
    pub reason: Vec<u8>,
    /// How many pixels have each reason.
    pub counts: [usize; REASONS],
    /// The camera's noise.
    pub noise: Noise,
    /// The level from which a pixel counts as saturated.
    pub saturation: f64,
    /// Per set the rms of the higher harmonics over the first's amplitude; `None` with three steps, which show none.
    pub harmonics: Vec<Option<f64>>,
    /// How the sets were unwrapped.
    pub plan: Plan,
}

/// Where the camera saturates, by its data. 8-bit images: 255. 16-bit images often hold fewer bits: the full scale of the
/// narrowest of 8, 10, 12, 14 and 16 bits that holds the largest value, after a shift by the low bits that are zero in
/// every pixel. Should this guess a narrower scale than the camera's, then at most pixels of exactly the largest value
/// seen are lost.
pub fn saturation_level<T: Level>(shot: &Shot<'_, T>) -> f64 {
    if T::FULL == 255 {
        return 255.0;
    }
    let frames: Vec<&[T]> = shot.exposures.iter().flatten().copied().collect();
    let scan = |frame: &&[T]| {
        frame.iter().fold((0u32, 0u32), |(top, bits), &v| {
            let v: u32 = v.into();
            (top.max(v), bits | v)
        })
    };
    let seen: Vec<(u32, u32)> = threads::install(|| frames.par_iter().map(scan).collect());
    let (top, bits) = seen.iter().fold((0, 0), |(top, bits), s| (top.max(s.0), bits | s.1));
    let shift = if bits == 0 { 0 } else { bits.trailing_zeros() };
    let full = [8, 10, 12, 14, 16].map(|b| (1u32 << b) - 1);
    let scale = full.into_iter().find(|&f| f >= top >> shift).unwrap_or(T::FULL);
    f64::from((scale << shift).min(T::FULL))
}

/// Decodes the fringe images of one axis of one shot. `projector_size` is the projector's extent along that axis, px.
///
/// # Errors
/// [`Error::Shape`] where the frames do not fit the fringes or each other, [`Error::OutOfRange`] for fewer than three
/// steps, a frequency or setting out of its range, and for a list of fringes that cannot be unwrapped.
pub fn decode_shot<T: Level>(
    shot: &Shot<'_, T>,
    sets: &[FringeSet],
    projector_size: usize,
    options: &DecodeOptions,
) -> Result<PhaseMap> {
    validate(shot, sets, projector_size, options)?;
    let plan = Plan::new(&sets.iter().map(|s| s.periods).collect::<Vec<_>>(), options.z)?;
    let saturation = options.saturation.unwrap_or_else(|| saturation_level(shot));
    let noise = noise::estimate(shot, sets, saturation as f32);
    let decoder = Decoder::new(shot, sets, &plan, projector_size, noise, saturation as f32, options.z as f32);

    let n = shot.width * shot.height;
    let mut map = PhaseMap {
        width: shot.width,
        height: shot.height,
        column_px: zeros(n),
        sigma_px: zeros(n),
        modulation: zeros(n),
        background: zeros(n),
        reason: zeros(n),
        counts: [0; REASONS],
        noise,
        saturation,
        harmonics: harmonics(shot, sets, &noise, saturation as f32),
        plan: plan.clone(),
    };
    threads::install(|| {
        let floats = map.sigma_px.par_chunks_mut(CHUNK).zip(map.modulation.par_chunks_mut(CHUNK));
        let floats = floats.zip(map.background.par_chunks_mut(CHUNK));
        let columns = map.column_px.par_chunks_mut(CHUNK).zip(map.reason.par_chunks_mut(CHUNK));
        columns.zip(floats).enumerate().for_each(|(chunk, ((column, reason), ((sigma, modulation), background)))| {
            let mut work = Work::new(sets.len());
            let tiles = column.chunks_mut(TILE).zip(reason.chunks_mut(TILE));
            let floats = sigma.chunks_mut(TILE).zip(modulation.chunks_mut(TILE)).zip(background.chunks_mut(TILE));
            for (tile, ((column, reason), ((sigma, modulation), background))) in tiles.zip(floats).enumerate() {
                decoder.tile(chunk * CHUNK + tile * TILE, column.len(), &mut work);
                column.copy_from_slice(&work.column[..column.len()]);
                reason.copy_from_slice(&work.reason[..reason.len()]);
                sigma.copy_from_slice(&work.sigma[..sigma.len()]);
                modulation.copy_from_slice(&work.modulation[..modulation.len()]);
                background.copy_from_slice(&work.background[..background.len()]);
            }
        });
    });
    if !plan.links.is_empty() {
        let finest = sets.get(plan.finest).map_or(1.0, |s| s.periods);
        reject_jumps(&mut map, 0.5 * projector_size as f64 / finest);
    }
    map.counts = count_reasons(&map.reason);
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
fn harmonics<T: Level>(shot: &Shot<'_, T>, sets: &[FringeSet], noise: &Noise, saturation: f32) -> Vec<Option<f64>> {
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

/// Fits the sinusoid to `len <= TILE` pixels from `start` on; the rest of the tile is padded.
fn demodulate<T: Level>(frames: &[&[T]], start: usize, len: usize, wave: &Wave, out: &mut Sinusoid) {
    let whole: Option<Vec<&[T; TILE]>> =
        frames.iter().map(|f| f.get(start..start + TILE).filter(|_| len == TILE)?.try_into().ok()).collect();
    if let Some(tiles) = whole {
        return T::demodulate(&tiles, wave, out);
    }
    let mut padded = vec![[T::default(); TILE]; frames.len()];
    for (tile, frame) in padded.iter_mut().zip(frames) {
        let pixels = frame.get(start..start + len).unwrap_or_default();
        tile.iter_mut().zip(pixels).for_each(|(t, p)| *t = *p);
    }
    T::demodulate(&padded.iter().collect::<Vec<_>>(), wave, out);
}

/// One fringe set of a tile, all exposures together.
struct Fused {
    re: Lane,
    im: Lane,
    /// 1/sigma_phi², summed over the exposures.
    weight: Lane,
    /// The largest single weight, and background and modulation of that exposure.
    best: Lane,
    background: Lane,
    modulation: Lane,
    /// The phase in turns, and its variance.
    phase: Lane,
    variance: Lane,
}

/// What a thread works in.
struct Work {
    fit: Sinusoid,
    sets: Vec<Fused>,
    /// Reason so far, as a number, so that the loops stay vectors.
    why: Lane,
    column: [f64; TILE],
    sigma: Lane,
    modulation: Lane,
    background: Lane,
    reason: [u8; TILE],
}

impl Work {
    fn new(sets: usize) -> Self {
        let zero = [0.0; TILE];
        let fused = || Fused {
            re: zero,
            im: zero,
            weight: zero,
            best: zero,
            background: zero,
            modulation: zero,
            phase: zero,
            variance: zero,
        };
        Self {
            fit: Sinusoid::empty(),
            sets: (0..sets).map(|_| fused()).collect(),
            why: zero,
            column: [0.0; TILE],
            sigma: zero,
            modulation: zero,
            background: zero,
            reason: [0; TILE],
        }
    }
}

/// What it takes to judge a sample of a set.
struct Judge {
    floor: f32,
    gain: f32,
    saturation: f32,
    /// Half the number of steps.
    half: f32,
    /// On the residual: times the variance of a grey level, plus times the squared modulation.
    noise_limit: f32,
    harmonic_limit: f32,
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
fn fuse(fit: &Sinusoid, judge: &Judge, first: bool, why: &mut Lane, out: &mut Fused) {
    plain_fuse(fit, judge, first, why, out);
}

/// The body of [`fuse`], and its fallback.
#[inline(always)]
fn plain_fuse(fit: &Sinusoid, judge: &Judge, first: bool, why: &mut Lane, out: &mut Fused) {
    for i in 0..TILE {
        let (re, im, background) = (fit.re[i], fit.im[i], fit.background[i]);
        let b2 = re * re + im * im;
        let b = b2.sqrt();
        let variance = judge.floor + judge.gain * background;
        let clear = fit.top[i] < judge.saturation;
        let fits = fit.rest[i] <= judge.noise_limit * variance + judge.harmonic_limit * b2;
        let ok = clear & fits;
        let gain = if ok { b / variance } else { 0.0 };
        let weight = judge.half * b * gain;
        let before = if first {
            [0.0; 6]
        } else {
            [out.re[i], out.im[i], out.weight[i], out.best[i], out.background[i], out.modulation[i]]
        };
        let better = first | (weight > before[3]);
        out.re[i] = before[0] + re * gain;
        out.im[i] = before[1] + im * gain;
        out.weight[i] = before[2] + weight;
        out.best[i] = if better { weight } else { before[3] };
        out.background[i] = if better { background } else { before[4] };
        out.modulation[i] = if better { b } else { before[5] };
        // Remembered only where nothing else is usable: see `finish`.
        why[i] =
            if clear { if fits { why[i] } else { Reason::NoFit as u8 as f32 } } else { Reason::Saturated as u8 as f32 };
    }
}

/// Turns the summed phasors of a set into a phase, and keeps the reason where there is none.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
fn finish(z: f32, why_set: &Lane, set: &mut Fused, why: &mut Lane) {
    plain_finish(z, why_set, set, why);
}

/// The body of [`finish`], and its fallback.
#[inline(always)]
fn plain_finish(z: f32, why_set: &Lane, set: &mut Fused, why: &mut Lane) {
    let least = z * z;
    for i in 0..TILE {
        let weight = set.weight[i];
        set.phase[i] = turns(set.im[i], set.re[i]);
        set.variance[i] = 1.0 / (weight + 1e-30);
        // Nothing usable: saturated or no fit. Otherwise the modulation has to stand z sigma above the noise.
        let unusable = (weight <= 0.0) & (why_set[i] > 0.0);
        let dark = if weight < least { Reason::Dark as u8 as f32 } else { 0.0 };
        let here = if unusable { why_set[i] } else { dark };
        why[i] = if why[i] > 0.0 { why[i] } else { here };
    }
}

/// A link of the plan in single precision.
struct Step {
    weights: Vec<f32>,
    /// (set, gain²) of the decision's noise.
    gains2: Vec<(usize, f32)>,
    ratio: f32,
}

struct Chain {
    base: Vec<f32>,
    /// How far below zero the base may lie: half of what is missing to a whole period.
    base_margin: f32,
    steps: Vec<Step>,
    finest: usize,
    /// (set, ratio of its frequency to the finest's).
    helpers: Vec<(usize, f32)>,
    z: f32,
    /// Pixels per period of the finest set, and the projector's extent.
    pixels: f64,
    size: f64,
    /// The base repeats exactly over the projector: a base that noise has put at the wrong end is brought back.
    cyclic: bool,
}

#[inline(always)]
fn combine(weights: &[f32], sets: &[Fused], out: &mut Lane) {
    *out = [0.0; TILE];
    for (&w, set) in weights.iter().zip(sets) {
        if w != 0.0 {
            for i in 0..TILE {
                out[i] += w * set.phase[i];
            }
        }
    }
}

/// Judges one decision on a fringe order by its noise (in fringes) and by how well the frequencies agreed.
#[inline(always)]
fn judge_order(z: f32, variance: &Lane, miss: &Lane, why: &mut Lane) {
    // sigma is in radians, the miss in fringes.
    let to_fringes = z / (TAU as f32);
    for i in 0..TILE {
        let noise = to_fringes * variance[i].sqrt();
        let dark = if noise >= 0.5 { Reason::Dark as u8 as f32 } else { 0.0 };
        let limit = if noise > MODEL_ERROR_FRINGES { noise } else { MODEL_ERROR_FRINGES };
        let doubt = if miss[i].abs() > limit { Reason::OrderInDoubt as u8 as f32 } else { 0.0 };
        let here = if dark > 0.0 { dark } else { doubt };
        why[i] = if why[i] > 0.0 { why[i] } else { here };
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
fn unwrap(chain: &Chain, work: &mut Work) {
    plain_unwrap(chain, work);
}

/// The body of [`unwrap`], and its fallback.
#[inline(always)]
fn plain_unwrap(chain: &Chain, work: &mut Work) {
    let sets = &work.sets;
    let Some(finest) = sets.get(chain.finest) else { return };
    let (mut absolute, mut signal, mut variance, mut miss) = ([0.0; TILE], [0.0; TILE], [0.0; TILE], [0.0; TILE]);
    combine(&chain.base, sets, &mut absolute);
    for value in &mut absolute {
        // To [-margin, 1 - margin).
        let whole = round(*value + chain.base_margin - 0.5);
        *value -= whole;
    }
    // The order of the finest set's fringe, exact as a number.
    let mut order = [0.0; TILE];
    for i in 0..TILE {
        order[i] = round(absolute[i] - finest.phase[i]);
    }
    for step in &chain.steps {
        combine(&step.weights, sets, &mut signal);
        variance = [0.0; TILE];
        for &(set, gain2) in &step.gains2 {
            if let Some(set) = sets.get(set) {
                for i in 0..TILE {
                    variance[i] += gain2 * set.variance[i];
                }
            }
        }
        for i in 0..TILE {
            let expected = absolute[i] * step.ratio;
            let whole = round(expected - signal[i]);
            order[i] = whole;
            absolute[i] = signal[i] + whole;
            miss[i] = expected - absolute[i];
        }
        judge_order(chain.z, &variance, &miss, &mut work.why);
    }
    // The finest set, averaged with those that are nearly as fine, by information: weight times frequency squared.
    let (mut correction, mut information) = ([0.0f32; TILE], finest.weight);
    for &(set, ratio) in &chain.helpers {
        let Some(set) = sets.get(set) else { continue };
        let inverse = 1.0 / ratio;
        for i in 0..TILE {
            let expected = absolute[i] * ratio - set.phase[i];
            miss[i] = expected - round(expected);
            variance[i] = set.variance[i] + ratio * ratio * finest.variance[i];
            let weight = set.weight[i] * ratio * ratio;
            information[i] += weight;
            correction[i] -= weight * miss[i] * inverse;
        }
        judge_order(chain.z, &variance, &miss, &mut work.why);
    }
    let spread = chain.pixels / TAU;
    for i in 0..TILE {
        let phase = f64::from(finest.phase[i]) + f64::from(correction[i] / (information[i] + 1e-30));
        let column = (f64::from(order[i]) + phase) * chain.pixels - 0.5;
        let wrap = if column < -0.5 { chain.size } else { 0.0 };
        let wrap = if column >= chain.size - 0.5 { -chain.size } else { wrap };
        let column = if chain.cyclic { column + wrap } else { column };
        let sigma = spread / f64::from(information[i] + 1e-30).sqrt();
        // Within the noise of the border the other border is as likely.
        let margin = f64::from(chain.z) * sigma - 0.5;
        let outside = (column < margin) | (column > chain.size - 1.0 - margin);
        let doubt = if outside { Reason::OrderInDoubt as u8 as f32 } else { 0.0 };
        let why = if work.why[i] > 0.0 { work.why[i] } else { doubt };
        work.column[i] = if why > 0.0 { f64::NAN } else { column };
        work.sigma[i] = if why > 0.0 { f32::NAN } else { sigma as f32 };
        // A small whole number in the lowest bits: a conversion would be made one by one.
        work.reason[i] = (why + 8_388_608.0).to_bits() as u8;
    }
    work.modulation = finest.modulation;
    work.background = finest.background;
}

struct Decoder<'a, T> {
    shot: &'a Shot<'a, T>,
    /// First frame, number of steps, wave and limits of each set.
    sets: Vec<(usize, usize, Wave, Judge)>,
    chain: Chain,
}

impl<'a, T: Level> Decoder<'a, T> {
    fn new(
        shot: &'a Shot<'a, T>,
        sets: &[FringeSet],
        plan: &Plan,
        projector_size: usize,
        noise: Noise,
        saturation: f32,
        z: f32,
    ) -> Self {
        let mut start = 0;
        let judged = sets.iter().map(|set| {
            let at = start;
            start += set.steps;
            let n = set.steps as f64;
            // The root of chi² with f degrees of freedom exceeds sqrt(f) + z as rarely as a normal number exceeds z.
            let noise_limit = if set.steps > 3 { ((n - 3.0).sqrt() + f64::from(z)).powi(2) as f32 } else { f32::MAX };
            let judge = Judge {
                floor: noise.floor() as f32,
                gain: noise.gain as f32,
                saturation,
                half: 0.5 * n as f32,
                noise_limit,
                harmonic_limit: (n * HARMONIC_LIMIT.powi(2)) as f32,
            };
            (at, set.steps, Wave::new(set.steps), judge)
        });
        let judged = judged.collect();
        let narrow = |v: &[f64]| v.iter().map(|&x| x as f32).collect::<Vec<_>>();
        let finest = sets.get(plan.finest).map_or(1.0, |s| s.periods);
        let steps = plan.links.iter().map(|link| Step {
            weights: narrow(&link.signal.weights),
            gains2: link.gains.iter().enumerate().filter(|g| *g.1 != 0.0).map(|(i, g)| (i, (g * g) as f32)).collect(),
            ratio: link.ratio as f32,
        });
        let whole = |p: f64| (p - p.round()).abs() < 1e-9;
        let chain = Chain {
            base: narrow(&plan.base.weights),
            base_margin: 0.5 * (1.0 - plan.base.periods).max(0.0) as f32,
            steps: steps.collect(),
            finest: plan.finest,
            helpers: plan.helpers.iter().filter_map(|&i| Some((i, (sets.get(i)?.periods / finest) as f32))).collect(),
            z,
            pixels: projector_size as f64 / finest,
            size: projector_size as f64,
            cyclic: plan.base.periods == 1.0 && sets.iter().all(|s| whole(s.periods)),
        };
        Self { shot, sets: judged, chain }
    }

    fn tile(&self, start: usize, len: usize, work: &mut Work) {
        work.why = [0.0; TILE];
        for (i, (at, steps, wave, judge)) in self.sets.iter().enumerate() {
            let Some(set) = work.sets.get_mut(i) else { continue };
            let mut why_set = [0.0; TILE];
            for (e, frames) in self.shot.exposures.iter().enumerate() {
                let frames = frames.get(*at..at + steps).unwrap_or_default();
                demodulate(frames, start, len, wave, &mut work.fit);
                fuse(&work.fit, judge, e == 0, &mut why_set, set);
            }
            finish(self.chain.z, &why_set, set, &mut work.why);
        }
        unwrap(&self.chain, work);
    }
}

/// Rejects pixels with a fringe order of their own: at most two of the eight neighbours within half a fringe, and more
/// that are not. Surfaces, and their edges, leave three neighbours at least on a pixel's own side.
fn reject_jumps(map: &mut PhaseMap, half_fringe_px: f64) {
    let (width, column) = (map.width, &map.column_px);
    let row_jumps = |row: usize| -> Vec<usize> {
        let around = [row.checked_sub(1), Some(row), Some(row + 1)];
        let rows: Vec<&[f64]> =
            around.iter().flatten().filter_map(|r| column.get(r * width..(r + 1) * width)).collect();
        let Some(own) = column.get(row * width..(row + 1) * width) else { return Vec::new() };
        let (mut near, mut far) = (vec![0u8; width], vec![0u8; width]);
        count_neighbours(own, &rows, half_fringe_px, &mut near, &mut far);
        if !mark_jumps(&mut near, &far) {
            return Vec::new();
        }
        near.iter().enumerate().filter(|(_, jump)| **jump > 0).map(|(i, _)| row * width + i).collect()
    };
    let found: Vec<Vec<usize>> = threads::install(|| (0..map.height).into_par_iter().map(row_jumps).collect());
    for at in found.into_iter().flatten() {
        if let (Some(c), Some(s), Some(r)) =
            (map.column_px.get_mut(at), map.sigma_px.get_mut(at), map.reason.get_mut(at))
        {
            (*c, *s, *r) = (f64::NAN, f32::NAN, Reason::OrderInDoubt as u8);
        }
    }
}

/// Turns the counts in `near` into ones where there is a jump; says whether there is any.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
fn mark_jumps(near: &mut [u8], far: &[u8]) -> bool {
    let mut any = 0;
    for (near, &far) in near.iter_mut().zip(far) {
        // The pixel itself is among the near ones.
        let jump = u8::from(*near >= 1) & u8::from(*near <= 3) & u8::from(far + 1 > *near);
        *near = jump;
        any |= jump;
    }
    any > 0
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
fn count_neighbours(own: &[f64], rows: &[&[f64]], reach: f64, near: &mut [u8], far: &mut [u8]) {
    for row in rows {
        for shift in 0..3usize {
            // Neighbour i + shift - 1 of pixel i.
            let skip = usize::from(shift == 0);
            let other = row.get(shift.saturating_sub(1)..).unwrap_or_default();
            let (near, far) = (near.iter_mut().skip(skip), far.iter_mut().skip(skip));
            for (((&a, &b), near), far) in own.iter().skip(skip).zip(other).zip(near).zip(far) {
                let d = (a - b).abs();
                *near += u8::from(d < reach);
                *far += u8::from(d >= reach);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(seed: u64) -> impl FnMut() -> f64 {
        let mut state = seed;
        move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 53) as f64
        }
    }

    const SETS: [FringeSet; 3] = [
        FringeSet { periods: 59.0, steps: 4 },
        FringeSet { periods: 64.0, steps: 5 },
        FringeSet { periods: 70.0, steps: 12 },
    ];

    /// Images of a slanted wall with some noise, saturation and darkness in it.
    fn images(width: usize, height: usize) -> Vec<Vec<u8>> {
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

    fn bits(lane: &Lane) -> Vec<u32> {
        lane.iter().map(|v| v.to_bits()).collect()
    }

    #[test]
    fn vectors_and_the_plain_fallback_give_the_same_bits() {
        let frames = images(2 * TILE, 1);
        let frames: Vec<&[u8]> = frames.iter().map(Vec::as_slice).collect();
        let shot = Shot { exposures: vec![frames.clone(), frames], width: 2 * TILE, height: 1 };
        let plan = Plan::new(&SETS.map(|s| s.periods), 5.0).unwrap();
        let model = Noise { read_variance: 0.5, gain: 0.01, source: NoiseSource::Assumed };
        let decoder = Decoder::new(&shot, &SETS, &plan, 912, model, 255.0, 5.0);
        for start in [0, TILE] {
            let mut fast = Work::new(SETS.len());
            decoder.tile(start, TILE, &mut fast);

            let mut plain = Work::new(SETS.len());
            for (i, (at, steps, wave, judge)) in decoder.sets.iter().enumerate() {
                let mut why_set = [0.0; TILE];
                for (e, frames) in shot.exposures.iter().enumerate() {
                    let tiles: Vec<&[u8; TILE]> =
                        frames[*at..at + steps].iter().map(|f| f[start..start + TILE].try_into().unwrap()).collect();
                    wave::demodulate(&tiles, wave, &mut plain.fit);
                    plain_fuse(&plain.fit, judge, e == 0, &mut why_set, &mut plain.sets[i]);
                }
                plain_finish(5.0, &why_set, &mut plain.sets[i], &mut plain.why);
            }
            plain_unwrap(&decoder.chain, &mut plain);
            let columns = |w: &Work| w.column.map(f64::to_bits).to_vec();
            assert_eq!(columns(&fast), columns(&plain));
            assert_eq!(bits(&fast.sigma), bits(&plain.sigma));
            assert_eq!(bits(&fast.modulation), bits(&plain.modulation));
            assert_eq!(bits(&fast.background), bits(&plain.background));
            assert_eq!(fast.reason, plain.reason);
            assert!(start == 0 || fast.reason.iter().any(|r| *r == 0));
        }
    }

    #[test]
    fn columns_come_back_on_any_number_of_threads() {
        let (width, height) = (700, 50);
        let frames = images(width, height);
        let shot = Shot { exposures: vec![frames.iter().map(Vec::as_slice).collect()], width, height };
        let run = || decode_shot(&shot, &SETS, 912, &DecodeOptions::default()).unwrap();
        crate::threads::set_threads(Some(1)).unwrap();
        let one = run();
        crate::threads::set_threads(Some(3)).unwrap();
        let three = run();
        crate::threads::set_threads(None).unwrap();
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
