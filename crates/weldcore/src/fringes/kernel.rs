//! The loops over tiles: exposures fused, sets unwrapped, every pixel judged.
//!
//! As in [`super::wave`] each loop is compiled for several instruction sets, and all of them give the same bits.

use crate::ground::branchless::{round, turns, turns_of, turns_quotient};
use std::f64::consts::TAU;
use std::mem::MaybeUninit;

use multiversion::multiversion;

use super::noise::CameraNoise;
use super::phase_error::{PhaseError, compensate};
use super::phase_map::Reason;
use super::shot::{FringeSet, Shot};
use super::temporal::Plan;
use super::wave::{Lane, Level, PixelFit, Sinusoid, TILE, Take, Wave, demodulate, each_pixel, tile_of};

/// The share of the modulation that harmonics may reach before a pixel has "no fit": a fifth more than a display of
/// gamma 2.2 left uncorrected makes, (gamma - 1)/(gamma + 2) = 0.286. A single bad frame that passes for a harmonic
/// moves the phase by less than 4/sqrt(N) of it, 0.7 rad or a ninth of a fringe with four steps.
const HARMONIC_LIMIT: f64 = 0.35;
/// The disagreement between frequencies that is left to smooth errors of the model, in fringes. The order is wrong
/// from half a fringe on; half of that is kept in reserve. An uncorrected gamma with three steps (0.19 rad) in a
/// hierarchy of ratio 8 needs all of it: 8 * 0.19 rad = 0.24 fringes.
const MODEL_ERROR_FRINGES: f32 = 0.25;

/// One fringe set of a tile, all exposures together.
#[doc(hidden)]
#[derive(Debug)]
pub struct Fused {
    re: Lane,
    im: Lane,
    /// 1/sigma_phi², summed over the exposures.
    weight: Lane,
    /// Why exposures were not usable, as a number.
    why: Lane,
    /// The largest single weight, and background and squared modulation of that exposure.
    best: Lane,
    background: Lane,
    modulation2: Lane,
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
}

/// The results of a tile: parts of the result's arrays, of one length of `TILE` at most.
pub(super) struct Results<'a> {
    pub(super) column: &'a mut [MaybeUninit<f64>],
    pub(super) sigma: &'a mut [MaybeUninit<f32>],
    pub(super) modulation: &'a mut [MaybeUninit<f32>],
    pub(super) background: &'a mut [MaybeUninit<f32>],
    pub(super) reason: &'a mut [MaybeUninit<u8>],
}

impl Work {
    pub(super) fn new(sets: usize) -> Self {
        let zero = [0.0; TILE];
        let fused = || Fused {
            re: zero,
            im: zero,
            weight: zero,
            why: zero,
            best: zero,
            background: zero,
            modulation2: zero,
            phase: zero,
            variance: zero,
        };
        Self { fit: Sinusoid::empty(), sets: (0..sets).map(|_| fused()).collect(), why: zero }
    }
}

/// What it takes to judge a sample of a set.
#[doc(hidden)]
#[derive(Debug)]
pub struct Judge {
    floor: f32,
    gain: f32,
    saturation: f32,
    /// Half the number of steps.
    half: f32,
    z: f32,
    /// On the residual: times the variance of a grey level, plus times the squared modulation.
    noise_limit: f32,
    harmonic_limit: f32,
}

impl Judge {
    /// Variance of a grey level in the sample, whether it is unsaturated, and whether it is a sinusoid.
    #[inline(always)]
    fn look(&self, s: &PixelFit, b2: f32) -> (f32, bool, bool) {
        let variance = self.floor + self.gain * s.background;
        let fits = s.rest <= self.noise_limit * variance + self.harmonic_limit * b2;
        (variance, s.top < self.saturation, fits)
    }

    /// The reason that a set without an answer has: nothing usable, by what was seen, or a modulation that does not
    /// stand z sigma above the noise.
    #[inline(always)]
    fn reason(&self, weight: f32, unfit: f32) -> f32 {
        let dark = if weight < self.z * self.z { Reason::Dark as u8 as f32 } else { 0.0 };
        if (weight <= 0.0) & (unfit > 0.0) { unfit } else { dark }
    }
}

#[inline(always)]
fn unfit(clear: bool, fits: bool, before: f32) -> f32 {
    let unfit = if fits { before } else { Reason::NoFit as u8 as f32 };
    if clear { unfit } else { Reason::Saturated as u8 as f32 }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
fn fuse_alone_u8(frames: &[&[u8; TILE]], wave: &Wave, judge: &Judge, set: &mut Fused, why: &mut Lane) {
    plain_fuse_alone(frames, wave, judge, set, why);
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
fn fuse_alone_u16(frames: &[&[u16; TILE]], wave: &Wave, judge: &Judge, set: &mut Fused, why: &mut Lane) {
    plain_fuse_alone(frames, wave, judge, set, why);
}

/// A set of the only exposure: from grey levels to phase in one go. The body of both, and their fallback.
#[inline(always)]
fn plain_fuse_alone<T: Level>(frames: &[&[T; TILE]], wave: &Wave, judge: &Judge, set: &mut Fused, why: &mut Lane) {
    each_pixel(frames, wave, &mut Alone { judge, set, why });
}

struct Alone<'a> {
    judge: &'a Judge,
    set: &'a mut Fused,
    why: &'a mut Lane,
}

impl Take for Alone<'_> {
    #[inline(always)]
    fn take(&mut self, i: usize, s: PixelFit) {
        let Self { judge, set, why } = self;
        let b2 = s.re * s.re + s.im * s.im;
        let (variance, clear, fits) = judge.look(&s, b2);
        let power = judge.half * b2;
        let power = if power > 1e-12 { power } else { 1e-12 };
        // Three quotients by one division.
        let (above, below) = turns_quotient(s.im, s.re);
        let per_all = 1.0 / (variance * below * power);
        let ok = clear & fits;
        let weight = if ok { power * (below * power * per_all) } else { 0.0 };
        set.phase[i] = turns_of(above * (variance * power * per_all), s.im, s.re);
        set.weight[i] = weight;
        set.variance[i] = if ok { variance * (variance * below * per_all) } else { 1e30 };
        set.background[i] = s.background;
        set.modulation2[i] = b2;
        let here = judge.reason(weight, unfit(clear, fits, 0.0));
        why[i] = if why[i] > 0.0 { why[i] } else { here };
    }
}

/// Adds one of several exposures to a set. The last one turns the sum of the phasors into a phase.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
fn fuse(fit: &Sinusoid, judge: &Judge, first: bool, last: bool, set: &mut Fused, why: &mut Lane) {
    plain_fuse(fit, judge, first, last, set, why);
}

/// The body of [`fuse`], and its fallback: a loop for each place that an exposure may have.
#[inline(always)]
fn plain_fuse(fit: &Sinusoid, judge: &Judge, first: bool, last: bool, set: &mut Fused, why: &mut Lane) {
    match (first, last) {
        (true, _) => fuse_loop::<true, false>(fit, judge, set, why),
        (false, true) => fuse_loop::<false, true>(fit, judge, set, why),
        (false, false) => fuse_loop::<false, false>(fit, judge, set, why),
    }
}

#[inline(always)]
fn fuse_loop<const FIRST: bool, const LAST: bool>(fit: &Sinusoid, judge: &Judge, set: &mut Fused, why: &mut Lane) {
    for i in 0..TILE {
        let s = fit.at(i);
        let b2 = s.re * s.re + s.im * s.im;
        let b = b2.sqrt();
        let (variance, clear, fits) = judge.look(&s, b2);
        let gain = if clear & fits { b / variance } else { 0.0 };
        let weight = judge.half * b * gain;
        let [re, im, sum, best, before] =
            if FIRST { [0.0; 5] } else { [set.re[i], set.im[i], set.weight[i], set.best[i], set.why[i]] };
        let better = FIRST | (weight > best);
        let (re, im, sum) = (re + s.re * gain, im + s.im * gain, sum + weight);
        set.weight[i] = sum;
        set.background[i] = if better { s.background } else { set.background[i] };
        set.modulation2[i] = if better { b2 } else { set.modulation2[i] };
        // Kept in mind only in case nothing else is usable.
        let unfit = unfit(clear, fits, before);
        if LAST {
            set.phase[i] = turns(im, re);
            set.variance[i] = 1.0 / (sum + 1e-30);
            let here = judge.reason(sum, unfit);
            why[i] = if why[i] > 0.0 { why[i] } else { here };
        } else {
            (set.re[i], set.im[i], set.why[i]) = (re, im, unfit);
            set.best[i] = if better { weight } else { best };
        }
    }
}

/// A link of the plan in single precision.
struct ChainLink {
    weights: Vec<f32>,
    /// (set, gain²) of the decision's noise.
    gains2: Vec<(usize, f32)>,
    ratio: f32,
}

struct Chain {
    base: Vec<f32>,
    /// How far below zero the base may lie: half of what is missing to a whole period.
    base_margin: f32,
    steps: Vec<ChainLink>,
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
    // sigma is in radians, the miss in fringes; squares spare the root.
    let to_fringes2 = (z / TAU as f32).powi(2);
    let model2 = MODEL_ERROR_FRINGES.powi(2);
    for i in 0..TILE {
        let noise2 = to_fringes2 * variance[i];
        let dark = if noise2 >= 0.25 { Reason::Dark as u8 as f32 } else { 0.0 };
        let limit2 = if noise2 > model2 { noise2 } else { model2 };
        let doubt = if miss[i] * miss[i] > limit2 { Reason::OrderInDoubt as u8 as f32 } else { 0.0 };
        let here = if dark > 0.0 { dark } else { doubt };
        why[i] = if why[i] > 0.0 { why[i] } else { here };
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
fn unwrap(chain: &Chain, work: &mut Work, out: &mut Results) {
    plain_unwrap(chain, work, out);
}

/// The body of [`unwrap`], and its fallback.
#[inline(always)]
fn plain_unwrap(chain: &Chain, work: &mut Work, out: &mut Results) {
    let sets = &work.sets;
    // A plan has its finest set.
    let finest = &sets[chain.finest];
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
    let (mut correction, mut information, mut uncertainty) = ([0.0f32; TILE], finest.weight, finest.variance);
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
    if !chain.helpers.is_empty() {
        for i in 0..TILE {
            uncertainty[i] = 1.0 / (information[i] + 1e-30);
            correction[i] *= uncertainty[i];
        }
    }
    let spread = (chain.pixels / TAU) as f32;
    // Within the noise of the border the other border is as likely.
    let (low, high) = (-0.5f32, (chain.size - 0.5) as f32);
    let n = out.column.len().min(TILE);
    let (columns, sigmas, reasons) = (&mut out.column[..n], &mut out.sigma[..n], &mut out.reason[..n]);
    let (modulations, backgrounds) = (&mut out.modulation[..n], &mut out.background[..n]);
    for i in 0..n {
        let phase = f64::from(finest.phase[i]) + f64::from(correction[i]);
        let column = (f64::from(order[i]) + phase) * chain.pixels - 0.5;
        let wrap = if column < -0.5 { chain.size } else { 0.0 };
        let wrap = if column >= chain.size - 0.5 { -chain.size } else { wrap };
        let column = if chain.cyclic { column + wrap } else { column };
        let sigma = spread * uncertainty[i].sqrt();
        let margin = chain.z * sigma;
        let outside = ((column as f32) < low + margin) | (column as f32 > high - margin);
        let doubt = if outside { Reason::OrderInDoubt as u8 as f32 } else { 0.0 };
        let why = if work.why[i] > 0.0 { work.why[i] } else { doubt };
        columns[i] = MaybeUninit::new(if why > 0.0 { f64::NAN } else { column });
        sigmas[i] = MaybeUninit::new(if why > 0.0 { f32::NAN } else { sigma });
        // A small whole number in the lowest bits: a conversion would be made one by one.
        reasons[i] = MaybeUninit::new((why + 8_388_608.0).to_bits() as u8);
        modulations[i] = MaybeUninit::new(finest.modulation2[i].sqrt());
        backgrounds[i] = MaybeUninit::new(finest.background[i]);
    }
}

/// A grey level, as [`Level`], whose sets are fused from frames to phase in one go.
pub trait Fuse: Level {
    #[doc(hidden)]
    fn fuse_alone(frames: &[&[Self; TILE]], wave: &Wave, judge: &Judge, set: &mut Fused, why: &mut Lane);
}

impl Fuse for u8 {
    fn fuse_alone(frames: &[&[Self; TILE]], wave: &Wave, judge: &Judge, set: &mut Fused, why: &mut Lane) {
        fuse_alone_u8(frames, wave, judge, set, why);
    }
}

impl Fuse for u16 {
    fn fuse_alone(frames: &[&[Self; TILE]], wave: &Wave, judge: &Judge, set: &mut Fused, why: &mut Lane) {
        fuse_alone_u16(frames, wave, judge, set, why);
    }
}

pub(super) struct Decoder<'a, T> {
    shot: &'a Shot<'a, T>,
    /// First frame, number of steps, wave and limits of each set.
    sets: Vec<(usize, usize, Wave, Judge)>,
    /// The sets that do not keep to the usual convention, as they are.
    foreign: Vec<Option<FringeSet>>,
    /// What is taken off each set's phase: steps and series.
    errors: Vec<Option<(f32, Vec<f32>)>>,
    chain: Chain,
}

impl<'a, T: Fuse> Decoder<'a, T> {
    pub(super) fn new(
        shot: &'a Shot<'a, T>,
        sets: &[FringeSet],
        plan: &Plan,
        projector_size: usize,
        noise: CameraNoise,
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
                z,
                noise_limit,
                harmonic_limit: (n * HARMONIC_LIMIT.powi(2)) as f32,
            };
            (at, set.steps, Wave::new(set.steps), judge)
        });
        let judged = judged.collect();
        let narrow = |v: &[f64]| v.iter().map(|&x| x as f32).collect::<Vec<_>>();
        let finest = sets.get(plan.finest).map_or(1.0, |s| s.periods);
        let steps = plan.links.iter().map(|link| ChainLink {
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
        let foreign = sets.iter().map(|s| (!s.is_plain()).then_some(*s)).collect();
        Self { shot, sets: judged, foreign, errors: Vec::new(), chain }
    }

    /// Takes the projector's error off each set's phase.
    pub(super) fn compensating(mut self, errors: &[PhaseError]) -> Self {
        self.errors = errors.iter().map(PhaseError::in_turns).collect();
        self
    }

    /// Writes every pixel of the results, which begin at pixel `start`.
    pub(super) fn tile(&self, start: usize, work: &mut Work, mut out: Results) {
        let len = out.column.len();
        work.why = [0.0; TILE];
        for (i, (at, steps, wave, judge)) in self.sets.iter().enumerate() {
            let Some(set) = work.sets.get_mut(i) else { continue };
            let last = self.shot.exposures.len() - 1;
            for (e, frames) in self.shot.exposures.iter().enumerate() {
                let frames = frames.get(*at..at + steps).unwrap_or_default();
                if last == 0 {
                    tile_of(frames, start, len, |tiles| T::fuse_alone(tiles, wave, judge, set, &mut work.why));
                } else {
                    demodulate(frames, start, len, wave, &mut work.fit);
                    fuse(&work.fit, judge, e == 0, e == last, set, &mut work.why);
                }
            }
            if let Some(Some((steps, terms))) = self.errors.get(i) {
                compensate(*steps, terms, &mut set.phase);
            }
            if let Some(Some(stated)) = self.foreign.get(i) {
                set.phase.iter_mut().for_each(|p| *p = stated.phase_of_measured(*p));
            }
        }
        unwrap(&self.chain, work, &mut out);
    }
}

#[cfg(test)]
mod tests {
    use super::super::decode::tests::{SETS, images};
    use super::super::noise::NoiseSource;
    use super::super::wave;
    use super::*;

    /// Bits of column, sigma, modulation and background, and the reasons.
    type Bits = (Vec<u64>, [Vec<u32>; 3], Vec<u8>);

    fn results(job: impl FnOnce(Results)) -> Bits {
        let (mut column, mut reason) = ([MaybeUninit::new(0f64); TILE], [MaybeUninit::new(0u8); TILE]);
        let mut floats = [[MaybeUninit::new(0f32); TILE]; 3];
        let [sigma, modulation, background] = &mut floats;
        job(Results { column: &mut column, sigma, modulation, background, reason: &mut reason });
        // SAFETY: all were initialised above.
        let bits = |lane: [MaybeUninit<f32>; TILE]| lane.map(|v| unsafe { v.assume_init() }.to_bits()).to_vec();
        // SAFETY: as above.
        let column = column.map(|v| unsafe { v.assume_init() }.to_bits()).to_vec();
        // SAFETY: as above.
        (column, floats.map(bits), reason.map(|v| unsafe { v.assume_init() }).to_vec())
    }

    #[test]
    fn vectors_and_the_plain_fallback_give_the_same_bits() {
        let frames = images(2 * TILE, 1);
        let frames: Vec<&[u8]> = frames.iter().map(Vec::as_slice).collect();
        for exposures in [vec![frames.clone()], vec![frames.clone(), frames.clone()]] {
            compare_with_plain(&Shot { exposures, width: 2 * TILE, height: 1 });
        }
    }

    fn compare_with_plain(shot: &Shot<'_, u8>) {
        let plan = Plan::new(&SETS.map(|s| s.periods), 5.0).unwrap();
        let model = CameraNoise { read_variance: 0.5, gain: 0.01, source: NoiseSource::Assumed };
        let decoder = Decoder::new(shot, &SETS, &plan, 912, model, 255.0, 5.0);
        for start in [0, TILE] {
            let mut work = Work::new(SETS.len());
            let fast = results(|out| decoder.tile(start, &mut work, out));

            let mut plain = Work::new(SETS.len());
            for (i, (at, steps, wave, judge)) in decoder.sets.iter().enumerate() {
                for (e, frames) in shot.exposures.iter().enumerate() {
                    let tiles: Vec<&[u8; TILE]> =
                        frames[*at..at + steps].iter().map(|f| f[start..start + TILE].try_into().unwrap()).collect();
                    if shot.exposures.len() == 1 {
                        plain_fuse_alone(&tiles, wave, judge, &mut plain.sets[i], &mut plain.why);
                    } else {
                        wave::demodulate_tile(&tiles, wave, &mut plain.fit);
                        plain_fuse(&plain.fit, judge, e == 0, e == 1, &mut plain.sets[i], &mut plain.why);
                    }
                }
            }
            let plain = results(|mut out| plain_unwrap(&decoder.chain, &mut plain, &mut out));
            assert_eq!(fast, plain);
            assert!(start == 0 || fast.2.contains(&0));
        }
    }
}
