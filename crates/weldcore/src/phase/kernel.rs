//! The loops over tiles: exposures fused, sets unwrapped, every pixel judged.
//!
//! As in [`super::wave`] each loop is compiled for several instruction sets, and all of them give the same bits.

use std::f64::consts::TAU;

use multiversion::multiversion;

use super::response::{self, PhaseError};
use super::wave::{Lane, Level, Sinusoid, TILE, Wave, round, turns};
use super::{FringeSet, Noise, Reason, Shot};
use crate::unwrap::Plan;

/// The share of the modulation that harmonics may reach before a pixel has "no fit": a fifth more than a display of
/// gamma 2.2 left uncorrected makes, (gamma - 1)/(gamma + 2) = 0.286. A single bad frame that passes for a harmonic
/// moves the phase by less than 4/sqrt(N) of it, 0.7 rad or a ninth of a fringe with four steps.
const HARMONIC_LIMIT: f64 = 0.35;
/// The disagreement between frequencies that is left to smooth errors of the model, in fringes. The order is wrong
/// from half a fringe on; half of that is kept in reserve. An uncorrected gamma with three steps (0.19 rad) in a
/// hierarchy of ratio 8 needs all of it: 8 * 0.19 rad = 0.24 fringes.
const MODEL_ERROR_FRINGES: f32 = 0.25;

/// Fits the sinusoid to `len <= TILE` pixels from `start` on; the rest of the tile is padded.
pub(super) fn demodulate<T: Level>(frames: &[&[T]], start: usize, len: usize, wave: &Wave, out: &mut Sinusoid) {
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
pub(super) struct Work {
    fit: Sinusoid,
    sets: Vec<Fused>,
    /// Reason so far, as a number, so that the loops stay vectors.
    why: Lane,
    pub(super) column: [f64; TILE],
    pub(super) sigma: Lane,
    pub(super) modulation: Lane,
    pub(super) background: Lane,
    pub(super) reason: [u8; TILE],
}

impl Work {
    pub(super) fn new(sets: usize) -> Self {
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

pub(super) struct Decoder<'a, T> {
    shot: &'a Shot<'a, T>,
    /// First frame, number of steps, wave and limits of each set.
    sets: Vec<(usize, usize, Wave, Judge)>,
    /// What is taken off each set's phase: steps and series.
    errors: Vec<Option<(f32, Vec<f32>)>>,
    chain: Chain,
}

impl<'a, T: Level> Decoder<'a, T> {
    pub(super) fn new(
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
        Self { shot, sets: judged, errors: Vec::new(), chain }
    }

    /// Takes the projector's error off each set's phase.
    pub(super) fn compensating(mut self, errors: &[PhaseError]) -> Self {
        self.errors = errors.iter().map(PhaseError::in_turns).collect();
        self
    }

    pub(super) fn tile(&self, start: usize, len: usize, work: &mut Work) {
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
            if let Some(Some((steps, terms))) = self.errors.get(i) {
                response::compensate(*steps, terms, &mut set.phase);
            }
        }
        unwrap(&self.chain, work);
    }
}

#[cfg(test)]
mod tests {
    use super::super::NoiseSource;
    use super::super::tests::{SETS, images};
    use super::super::wave;
    use super::*;

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
            assert!(start == 0 || fast.reason.contains(&0));
        }
    }
}
