//! Whether the frames of a shot are what they are said to be.
//!
//! A stack says everything twice. N > 3 samples of a sinusoid leave a residual, and the sets count the same fringes: in
//! the chain of [`Plan`] a coarser signal foretells the phase of the finer one. Frames that were copied, exchanged or
//! displaced, a set that starts a step late and a foreign convention all break one of the two, each in its own way. So a
//! few pixels are read again under each of these *hypotheses*, and the one that makes residuals and sets agree is named.
//! Nothing is said where the stack agrees as it stands, nor where no hypothesis does much better.
//!
//! What honest stacks do is taken off first: harmonics of the projector are one function of the phase, the same in every
//! frame of a set; light that flickers scales a frame; the noise is known; dark, saturated and even pixels are left out.

use std::f64::consts::TAU;

use rayon::prelude::*;

use super::noise::sample_rows;
use super::response::{self, PhaseError, sine_series};
use super::wave::{Level, Wave, round64, turns};
use super::{FringeSet, Noise, Shot};
use crate::stop::polled;
use crate::threads;
use crate::unwrap::Plan;

/// Pixels in a run, and how many runs a row is looked at in: memory comes in lines of so many pixels.
const RUN: usize = 8;
const RUNS_PER_ROW: usize = 6;
/// Half the swing of a set's frames over the noise, from which a pixel speaks: its phase then has 0.07 rad at most.
const CLEAR: f32 = 10.0;
/// Noise of a decision on the fringe order, in fringes, up to which a pixel speaks of it.
const QUIET_MISS: f64 = 0.08;
/// Fewer pixels say nothing: the mean of as many random phases is below 0.25 in all but one of ten thousand.
const FEWEST: usize = 150;
/// Parts of a period in which the residual is averaged over frames: harmonics up to the sixth are told apart.
const PARTS: usize = 24;
/// A frame may be brighter or darker by this for the lamp's sake: flicker is a few per cent.
const FLICKER: f32 = 0.06;
/// The mean level over the amplitude, with some light from elsewhere.
const MEAN_TO_SWING: f64 = 1.25;
/// Edges, glints and light between walls spoil some pixels of any honest shot: the worst quarter is not heard.
const HEARD: f64 = 0.75;
/// Disorder up to which nothing is looked for: 1 - cos of 16 degrees of disagreement between sets, or a residual of
/// 4 % of the amplitude's power. One step of twelve is 30 degrees, one exchange among twelve 3.3 % beside what it does to
/// the sets; what is below moves no fringe.
const ORDERLY: f64 = 0.04;
/// A cause must leave at most this share of the disorder, and little in itself. A right one leaves noise alone; one that
/// happens to help leaves half or more.
const EXPLAINED: f64 = 0.3;
const LEFT: f64 = 2.0 * ORDERLY;
/// Causes that explain as well as each other within this: the simplest is named.
const AS_GOOD: f64 = 1.25;
/// Random phases miss by more than a quarter of a fringe in half of the pixels, and to all sides: an uncorrected gamma with
/// three steps misses by as much at most, and mostly to one side.
const RANDOM_MISS: f64 = 0.25;
const UNRELATED: f64 = 0.4;
const AGREEMENT: f64 = 0.35;
/// Displacements that are looked for, px, and from where on one is a jolt: a camera that trembles by 3 px all the while
/// moves its mean by less than 4.
const REACH: i64 = 12;
const JOLT_PX: i64 = 4;
/// Pixels that are read again for each displacement.
const JOLT_SAMPLE: usize = 240;
/// Work that the hypotheses may take: pixels times frames times hypotheses.
const EFFORT: usize = 60_000_000;

/// A contradiction between the frames of one exposure, and what would explain it.
#[derive(Debug, Clone, PartialEq)]
pub struct Disagreement {
    /// Which exposure.
    pub exposure: usize,
    /// The fringe set that is concerned; `None`: several.
    pub set: Option<usize>,
    /// The frames of the exposure that are concerned, from 0; all of a set, or of the stack, where no single ones are.
    pub frames: Vec<usize>,
    /// One line: the likely cause. Steps count from 0 in their set.
    pub text: String,
    /// Share of the clear pixels that contradict the frames as they are stated.
    pub share: f64,
    /// How many times better the cause fits than the statement.
    pub strength: f64,
}

/// Clear pixels of one exposure.
struct Sample {
    /// Per frame the level of every pixel.
    levels: Vec<Vec<f32>>,
    /// Variance of a level of each pixel.
    variance: Vec<f32>,
    /// Column and row of each pixel.
    places: Vec<(usize, usize)>,
    /// Half the swing in each set, by set, then pixel.
    swing: Vec<Vec<f32>>,
}

impl Sample {
    fn len(&self) -> usize {
        self.places.len()
    }

    /// Whether the set stands clear of the noise in the pixel.
    fn clear(&self, set: usize, i: usize) -> bool {
        self.swing[set][i] >= CLEAR * self.variance[i].sqrt()
    }

    /// The variance of the set's phase there, turns², by its swing.
    fn phase_variance(&self, set: usize, steps: usize, i: usize) -> f64 {
        let b = f64::from(self.swing[set][i]).max(1e-6);
        2.0 / steps as f64 * f64::from(self.variance[i]) / (b * b) / TAU.powi(2)
    }

    fn keep(&self, wanted: impl Fn(usize) -> bool) -> Self {
        let take = |v: &Vec<f32>| (0..self.len()).filter(|&i| wanted(i)).map(|i| v[i]).collect::<Vec<f32>>();
        Self {
            levels: self.levels.iter().map(take).collect(),
            variance: take(&self.variance),
            places: (0..self.len()).filter(|&i| wanted(i)).map(|i| self.places[i]).collect(),
            swing: self.swing.iter().map(take).collect(),
        }
    }
}

fn starts(sets: &[FringeSet]) -> Vec<usize> {
    sets.iter().scan(0, |at, s| Some(std::mem::replace(at, *at + s.steps))).collect()
}

/// Runs of pixels along the rows at which the noise was taken, which are in the cache.
fn sample<T: Level>(
    frames: &[&[T]],
    width: usize,
    height: usize,
    sets: &[FringeSet],
    noise: &Noise,
    top: f32,
) -> Sample {
    let mut places = Vec::new();
    let runs = RUNS_PER_ROW.min(width / RUN).max(1);
    for (number, row) in sample_rows(height).enumerate() {
        for run in 0..runs {
            // The runs of a row stand between those of the row before.
            let room = width.saturating_sub(RUN);
            let x = (room * run / runs + (number * 5 % 8) * room / (8 * runs)).min(room);
            places.extend((x..(x + RUN).min(width)).map(|x| (x, row)));
        }
    }
    let level = |frame: &&[T], (x, y): (usize, usize)| -> f32 { frame.get(y * width + x).map_or(0.0, |&v| v.into()) };
    let levels: Vec<Vec<f32>> = frames.iter().map(|f| places.iter().map(|&p| level(f, p)).collect()).collect();
    let n = places.len();
    let (mut swing, mut highest, mut mean) = (Vec::new(), vec![0.0f32; n], vec![0.0f32; n]);
    for (set, start) in sets.iter().zip(starts(sets)) {
        let (mut low, mut high) = (vec![f32::INFINITY; n], vec![0.0f32; n]);
        for frame in levels.get(start..start + set.steps).unwrap_or_default() {
            for i in 0..n {
                low[i] = low[i].min(frame[i]);
                high[i] = high[i].max(frame[i]);
                mean[i] += frame[i] / frames.len() as f32;
            }
        }
        for i in 0..n {
            highest[i] = highest[i].max(high[i]);
        }
        swing.push((0..n).map(|i| 0.5 * (high[i] - low[i])).collect::<Vec<f32>>());
    }
    let variance: Vec<f32> = mean.iter().map(|&m| (noise.sigma(f64::from(m)) as f32).powi(2)).collect();
    let all = Sample { levels, variance, places, swing };
    all.keep(|i| highest[i] < top && (0..sets.len()).any(|s| all.clear(s, i)))
}

/// Another reading of the frames.
#[derive(Clone)]
struct Reading {
    /// Which frame is read as which.
    order: Vec<usize>,
    /// Per set direction and what is taken off its phase, turns.
    turned: Vec<(f32, f32)>,
}

/// How well the frames agree under a reading: zero for a stack without fault.
struct Order {
    disorder: f64,
    /// The mean of exp(2πi miss) of each decision on a fringe order, that enough pixels speak of.
    agreement: Vec<Option<[f64; 2]>>,
    /// Of each pixel.
    cost: Vec<f32>,
    /// The mean residual of all sets, as a share of the fringes' power.
    residual: f64,
    /// Whether some set has nothing to do with the one before.
    unrelated: bool,
}

struct Court<'a> {
    sets: &'a [FringeSet],
    starts: Vec<usize>,
    waves: Vec<Wave>,
    plan: &'a Plan,
    /// Gains of each decision: the links, then the helpers.
    decisions: Vec<Vec<f64>>,
}

impl<'a> Court<'a> {
    fn new(sets: &'a [FringeSet], plan: &'a Plan) -> Self {
        let finest = sets.get(plan.finest).map_or(1.0, |s| s.periods);
        let helper = |&helper: &usize| -> Vec<f64> {
            let ratio = sets[helper].periods / finest;
            let gain = |s: usize| if s == plan.finest { ratio } else { -f64::from(u8::from(s == helper)) };
            (0..sets.len()).map(gain).collect()
        };
        let decisions = plan.links.iter().map(|l| l.gains.clone()).chain(plan.helpers.iter().map(helper)).collect();
        let waves = sets.iter().map(|s| Wave::new(s.steps)).collect();
        Self { sets, starts: starts(sets), waves, plan, decisions }
    }

    fn as_stated(&self) -> Reading {
        let frames = self.sets.iter().map(|s| s.steps).sum();
        Reading { order: (0..frames).collect(), turned: vec![(1.0, 0.0); self.sets.len()] }
    }

    fn frames_of(&self, set: usize) -> std::ops::Range<usize> {
        self.starts[set]..self.starts[set] + self.sets[set].steps
    }

    fn name(&self, set: usize) -> String {
        let periods = self.sets[set].periods;
        format!("the set of {periods} period{}", if periods == 1.0 { "" } else { "s" })
    }

    /// The better of what the sample says with and without the projector's error taken off: that was seen in these very
    /// frames, and is wrong where they are.
    fn hear(&self, sample: &Sample, reading: &Reading, errors: &[PhaseError]) -> Order {
        let plain = self.hear_once(sample, reading, &[]);
        if errors.iter().any(PhaseError::is_some) && plain.disorder > ORDERLY {
            let corrected = self.hear_once(sample, reading, errors);
            if corrected.disorder < plain.disorder {
                return corrected;
            }
        }
        plain
    }

    fn hear_once(&self, sample: &Sample, reading: &Reading, errors: &[PhaseError]) -> Order {
        let n = sample.len();
        let mut out =
            Order { disorder: 0.0, agreement: Vec::new(), cost: vec![0.0; n], residual: 0.0, unrelated: false };
        let mut phases: Vec<Vec<f32>> = Vec::new();
        for (s, set) in self.sets.iter().enumerate() {
            let frames: Vec<&[f32]> =
                self.frames_of(s).map(|slot| sample.levels[reading.order[slot]].as_slice()).collect();
            let (mut phase, rest) = self.fit(sample, s, &frames);
            if let Some(rest) = rest {
                let heard: Vec<usize> = (0..n).filter(|&i| sample.clear(s, i)).collect();
                if heard.len() >= FEWEST {
                    heard.iter().for_each(|&i| out.cost[i] += rest[i]);
                    out.residual += heard.iter().map(|&i| f64::from(rest[i])).sum::<f64>() / heard.len() as f64;
                }
            }
            let terms = errors.get(s).and_then(PhaseError::in_turns);
            let (sign, off) = reading.turned[s];
            for p in &mut phase {
                let error = terms.as_ref().map_or(0.0, |(steps, terms)| sine_series(*steps, terms, *p));
                *p = sign * set.phase_of_measured(*p - error) - off;
            }
            phases.push(phase);
        }
        let misses = self.misses(&phases, n);
        for (gains, misses) in self.decisions.iter().zip(misses) {
            let used: Vec<(usize, f64)> = gains.iter().copied().enumerate().filter(|(_, g)| *g != 0.0).collect();
            // Of the miss, by noise; turns².
            let variance = |i: usize| -> f64 {
                used.iter().map(|&(s, g)| g * g * sample.phase_variance(s, self.sets[s].steps, i)).sum()
            };
            let quiet = |i: usize| {
                let variance = variance(i);
                let clear = used.iter().all(|&(s, _)| sample.clear(s, i));
                (clear && variance < QUIET_MISS * QUIET_MISS).then_some((i, variance))
            };
            let heard: Vec<(usize, f64)> = (0..n).filter_map(quiet).collect();
            if heard.len() < FEWEST {
                out.agreement.push(None);
                continue;
            }
            let mut sum = [0.0f64; 2];
            let mut random = 0;
            for &(i, variance) in &heard {
                let (sin, cos) = (TAU * misses[i]).sin_cos();
                sum = [sum[0] + cos, sum[1] + sin];
                random += usize::from(misses[i].abs() > RANDOM_MISS);
                // Noise alone makes the mean of the cosine smaller by this factor.
                out.cost[i] += ((-0.5 * TAU * TAU * variance).exp() - cos) as f32;
            }
            let mean = sum.map(|v| v / heard.len() as f64);
            out.unrelated |= random as f64 > UNRELATED * heard.len() as f64 && mean[0].hypot(mean[1]) < AGREEMENT;
            out.agreement.push(Some(mean));
        }
        let mut costs = out.cost.clone();
        costs.sort_unstable_by(f32::total_cmp);
        costs.truncate(((HEARD * n as f64) as usize).max(1));
        out.disorder = (costs.iter().map(|&c| f64::from(c)).sum::<f64>() / costs.len() as f64).max(0.0);
        out
    }

    /// The phase of a set, turns, and with more than three steps what harmonics, flicker and noise leave of the residual's
    /// power, over that of the fringes.
    fn fit(&self, sample: &Sample, s: usize, frames: &[&[f32]]) -> (Vec<f32>, Option<Vec<f32>>) {
        let (n, steps, wave) = (sample.len(), frames.len(), &self.waves[s]);
        let (mut re, mut im, mut mean) = (vec![0.0f32; n], vec![0.0f32; n], vec![0.0f32; n]);
        let (cos, sin): (Vec<f32>, Vec<f32>) =
            wave.cos.iter().zip(&wave.sin).map(|(c, s)| (*c as f32, *s as f32)).unzip();
        let (twice, once) = (2.0 / steps as f32, 1.0 / steps as f32);
        for (frame, (cos, sin)) in frames.iter().zip(cos.iter().zip(&sin)) {
            for i in 0..n {
                re[i] += twice * frame[i] * cos;
                im[i] += twice * frame[i] * sin;
                mean[i] += once * frame[i];
            }
        }
        let phase: Vec<f32> = re.iter().zip(&im).map(|(re, im)| turns(*im, *re)).collect();
        if steps == 3 {
            return (phase, None);
        }
        // A pixel whose frames are exchanged may show no fringes: what it is measured by never falls below the noise.
        let scale: Vec<f32> =
            (0..n).map(|i| 1.0 / (re[i] * re[i] + im[i] * im[i]).max(4.0 * sample.variance[i]).sqrt()).collect();
        let (mut sums, mut counts) = ([0.0f32; PARTS], [0u32; PARTS]);
        let part = |i: usize, k: usize| {
            let psi = phase[i] - k as f32 * once;
            (((psi - psi.floor()) * PARTS as f32) as usize).min(PARTS - 1)
        };
        let mut rest: Vec<Vec<f32>> = Vec::with_capacity(steps);
        for (k, frame) in frames.iter().enumerate() {
            let fit = |i: usize| mean[i] + re[i] * cos[k] + im[i] * sin[k];
            let (mut product, mut square) = (0.0f32, 1e-12f32);
            for i in 0..n {
                product += (frame[i] - fit(i)) * fit(i);
                square += fit(i) * fit(i);
            }
            let flicker = (product / square).clamp(-FLICKER, FLICKER);
            let miss: Vec<f32> = (0..n).map(|i| (frame[i] - (1.0 + flicker) * fit(i)) * scale[i]).collect();
            for i in 0..n {
                let at = part(i, k);
                sums[at] += miss[i].clamp(-1.0, 1.0);
                counts[at] += 1;
            }
            rest.push(miss);
        }
        let shape: [f32; PARTS] = std::array::from_fn(|p| if counts[p] > 0 { sums[p] / counts[p] as f32 } else { 0.0 });
        let mut power = vec![0.0f32; n];
        for (k, miss) in rest.iter().enumerate() {
            for i in 0..n {
                power[i] += (miss[i] - shape[part(i, k)]).powi(2);
            }
        }
        let freedom = (steps - 3) as f32;
        let over = |i: usize| twice * (power[i].min(steps as f32) - freedom * sample.variance[i] * scale[i] * scale[i]);
        (phase, Some((0..n).map(over).collect()))
    }

    /// By how much each decision misses, fringes, by decision, then pixel.
    fn misses(&self, phases: &[Vec<f32>], n: usize) -> Vec<Vec<f64>> {
        let margin = 0.5 * (1.0 - self.plan.base.periods).max(0.0);
        let combine = |weights: &[f64], i: usize| -> f64 {
            weights.iter().zip(phases).filter(|(w, _)| **w != 0.0).map(|(w, p)| w * f64::from(p[i])).sum()
        };
        let mut out = vec![vec![0.0; n]; self.decisions.len()];
        let finest = self.sets.get(self.plan.finest).map_or(1.0, |s| s.periods);
        for i in 0..n {
            let base = combine(&self.plan.base.weights, i);
            let mut absolute = base - round64(base + margin - 0.5);
            let mut decision = out.iter_mut();
            for (link, miss) in self.plan.links.iter().zip(&mut decision) {
                let (signal, expected) = (combine(&link.signal.weights, i), absolute * link.ratio);
                absolute = signal + round64(expected - signal);
                miss[i] = expected - absolute;
            }
            for (&helper, miss) in self.plan.helpers.iter().zip(&mut decision) {
                let expected = absolute * self.sets[helper].periods / finest - f64::from(phases[helper][i]);
                miss[i] = expected - round64(expected);
            }
        }
        out
    }
}

/// A possible cause: another reading, what it concerns, and its name. The simpler come first.
struct Cause {
    reading: Reading,
    set: Option<usize>,
    frames: Vec<usize>,
    text: String,
}

/// By how many steps of a set it begins late or early, the shorter way round.
fn late(by: usize, steps: usize) -> String {
    let early = 2 * by > steps;
    let by = if early { steps - by } else { by };
    format!("{by} step{} {}", if by == 1 { "" } else { "s" }, if early { "early" } else { "late" })
}

/// Two frames exchanged, a set rolled, two sets exchanged, the stack rolled, a set that runs the other way.
fn causes(court: &Court<'_>) -> Vec<Cause> {
    let stated = court.as_stated();
    let frames = stated.order.len();
    let of = |frame: usize| (0..court.sets.len()).find(|&s| court.frames_of(s).contains(&frame)).unwrap_or(0);
    let mut out = Vec::new();
    for (s, set) in court.sets.iter().enumerate() {
        for step in 1..set.steps {
            let mut reading = stated.clone();
            reading.order[court.frames_of(s)].rotate_left(step);
            let text = format!("{} is rolled: it begins {}", court.name(s), late(set.steps - step, set.steps));
            out.push(Cause { reading, set: Some(s), frames: court.frames_of(s).collect(), text });
        }
    }
    for b in 1..frames {
        for a in 0..b {
            let (s, t) = (of(a), of(b));
            let (i, k) = (a - court.starts[s], b - court.starts[t]);
            let text = if s == t {
                format!("steps {i} and {k} of {} are exchanged", court.name(s))
            } else {
                format!("step {i} of {} and step {k} of {} are exchanged", court.name(s), court.name(t))
            };
            let mut reading = stated.clone();
            reading.order.swap(a, b);
            out.push(Cause { reading, set: (s == t).then_some(s), frames: vec![a, b], text });
        }
    }
    for t in 1..court.sets.len() {
        for s in (0..t).filter(|&s| court.sets[s].steps == court.sets[t].steps) {
            let mut reading = stated.clone();
            for (a, b) in court.frames_of(s).zip(court.frames_of(t)) {
                reading.order.swap(a, b);
            }
            let frames = court.frames_of(s).chain(court.frames_of(t)).collect();
            let text = format!("{} and {} are exchanged", court.name(s), court.name(t));
            out.push(Cause { reading, set: None, frames, text });
        }
    }
    for by in [1, 2] {
        for (turn, when) in [(by, "early"), (frames - by, "late")] {
            let mut reading = stated.clone();
            reading.order.rotate_left(turn);
            let text =
                format!("the whole stack is rolled: it begins {by} frame{} {when}", if by == 1 { "" } else { "s" });
            out.push(Cause { reading, set: None, frames: (0..frames).collect(), text });
        }
    }
    for (s, set) in court.sets.iter().enumerate() {
        for step in 0..set.steps {
            let mut reading = stated.clone();
            reading.turned[s] = (-1.0, step as f32 / set.steps as f32);
            let text = format!("the steps of {} run the other way: its direction = -1", court.name(s));
            out.push(Cause { reading, set: Some(s), frames: court.frames_of(s).collect(), text });
        }
    }
    out
}

/// All sets start elsewhere, by one angle or by one step each: what a decision misses says by how much, but for whole
/// turns.
fn origins(court: &Court<'_>, stated: &Order, falls: bool) -> Vec<Cause> {
    let frames = court.as_stated().order.len();
    let mut out = Vec::new();
    let mut add = |off: &dyn Fn(&FringeSet) -> f64, text: String| {
        let turned = court.sets.iter().map(|s| (1.0, off(s) as f32)).collect();
        let reading = Reading { turned, ..court.as_stated() };
        out.push(Cause { reading, set: None, frames: (0..frames).collect(), text });
    };
    let (mut origins, mut weights) = (Vec::new(), Vec::new());
    for (gains, agreement) in court.decisions.iter().zip(&stated.agreement) {
        weights.push(gains.iter().sum::<f64>());
        let (Some(&gain), &Some([re, im])) = (weights.last(), agreement) else { continue };
        if gain.abs() < 0.5 || !origins.is_empty() {
            continue;
        }
        // The lamp's flicker turns a phase by ε A/B √(2/N), the same in all pixels of a brightness.
        let lamp: f64 = gains.iter().zip(court.sets).map(|(g, s)| g * g * 2.0 / s.steps as f64).sum();
        let miss = im.atan2(re) / TAU;
        if TAU * miss.abs() < f64::from(FLICKER) * MEAN_TO_SWING * lamp.sqrt() {
            continue;
        }
        let whole = gain.abs().ceil() as i64;
        origins.extend((-whole..=whole).map(|k| (miss + k as f64) / gain).filter(|o| o.abs() <= 0.5 + 1e-9));
    }
    // A person chooses an angle that is a whole part of the circle; among equals the smallest.
    let odd = |o: f64| (24.0 * o - (24.0 * o).round()).abs() > 0.12;
    origins.sort_by(|a, b| (odd(*a), a.abs()).partial_cmp(&(odd(*b), b.abs())).unwrap_or(std::cmp::Ordering::Equal));
    for o in origins {
        let before = court.sets.first().map_or((1.0, 0.0), |s| (s.direction, s.origin_rad));
        let one = court.sets.iter().all(|s| (s.direction, s.origin_rad) == before);
        let added = o * TAU;
        let text = match (falls, one) {
            (true, true) => format!(
                "the steps run the other way and start elsewhere: fringes[].direction = {}, origin_rad = {:.3}",
                -before.0,
                principal(-(before.1 + added))
            ),
            (false, true) => {
                format!(
                    "all sets start elsewhere, {:.0} degrees on: fringes[].origin_rad = {:.3}",
                    added.to_degrees(),
                    principal(before.1 + added)
                )
            }
            _ => format!("all sets start elsewhere, {:.0} degrees on: fringes[].origin_rad", added.to_degrees()),
        };
        add(&|_| o, text);
    }
    for step in [1.0, -1.0] {
        let text = if falls {
            "the frames of every set are in reverse order: fringes[].direction = -1, or turn the order round"
        } else {
            "every set begins one step elsewhere"
        };
        add(&|s| step / s.steps as f64, text.into());
    }
    out
}

/// An angle in (-π, π].
fn principal(angle_rad: f64) -> f64 {
    let turns = angle_rad / TAU;
    let inside = turns - turns.round();
    TAU * if inside <= -0.5 + 1e-9 { inside + 1.0 } else { inside }
}

/// Frames that show the same. Exactly, for a file that was copied; but for noise and the lamp, for a pattern that was
/// shown twice.
fn copies(court: &Court<'_>, sample: &Sample, exposure: usize, everywhere: bool) -> Vec<Disagreement> {
    let n = sample.len();
    let variance = sample.variance.iter().sum::<f32>() / n as f32;
    let mut out: Vec<Disagreement> = Vec::new();
    for t in 0..court.sets.len() {
        for b in court.frames_of(t) {
            for (s, a) in (0..=t).flat_map(|s| court.frames_of(s).map(move |a| (s, a))).filter(|&(_, a)| a < b) {
                let (one, two) = (&sample.levels[a], &sample.levels[b]);
                let apart = one.iter().zip(two).any(|(x, y)| (x - y).abs() > 0.0);
                if apart && !(everywhere || b == a + 1) {
                    continue;
                }
                // What the stated steps should differ by.
                let power = |s: usize| sample.swing[s].iter().map(|b| b * b).sum::<f32>() / n as f32;
                let shift = (b - court.starts[t]) as f32 / court.sets[t].steps as f32
                    - (a - court.starts[s]) as f32 / court.sets[s].steps as f32;
                let expected = if s == t {
                    2.0 * (std::f32::consts::PI * shift).sin().powi(2) * power(s)
                } else {
                    0.5 * (power(s) + power(t))
                };
                let (xy, xx) =
                    one.iter().zip(two).fold((0.0f32, 1e-12f32), |(xy, xx), (x, y)| (xy + x * y, xx + x * x));
                let gain = (xy / xx).clamp(1.0 - 2.0 * FLICKER, 1.0 + 2.0 * FLICKER);
                let differ = one.iter().zip(two).map(|(x, y)| (y - gain * x).powi(2)).sum::<f32>() / n as f32;
                // Five variances: two of the frames, and room for one that was estimated low.
                if differ > 5.0 * variance || expected < 12.0 * differ.max(2.0 * variance) {
                    continue;
                }
                let what = if apart { "shows the same as" } else { "is a copy of" };
                let text = if s == t {
                    format!("step {} of {} {what} step {}", b - court.starts[t], court.name(t), a - court.starts[s])
                } else {
                    let (i, k) = (b - court.starts[t], a - court.starts[s]);
                    format!("step {i} of {} {what} step {k} of {}", court.name(t), court.name(s))
                };
                let share = 1.0;
                let strength = f64::from(expected / differ.max(2.0 * variance));
                let set = (s == t).then_some(t);
                out.push(Disagreement { exposure, set, frames: vec![a, b], text, share, strength });
                break;
            }
        }
    }
    out
}

/// Whether the finest phase falls from left to right; `false` too where it does neither.
fn falls(court: &Court<'_>, sample: &Sample) -> bool {
    let frames: Vec<&[f32]> = court.frames_of(court.plan.finest).map(|f| sample.levels[f].as_slice()).collect();
    let (phase, _) = court.fit(sample, court.plan.finest, &frames);
    let next = |i: &usize| {
        let ((x, y), (right, row)) = (sample.places[*i], sample.places[i + 1]);
        right == x + 1 && row == y
    };
    let sign = court.sets.get(court.plan.finest).map_or(1.0, |s| s.direction as f32);
    let slopes = (0..sample.len().saturating_sub(1)).filter(next).map(|i| sign * (phase[i + 1] - phase[i]));
    let slopes: Vec<f32> = slopes.map(|s| s - s.round()).filter(|s| s.abs() > 0.005).collect();
    slopes.len() > FEWEST / 2 && slopes.iter().filter(|s| **s < 0.0).count() * 10 > slopes.len() * 8
}

/// From a frame on, all are displaced by whole pixels: the displacement that makes them agree.
fn jolt<T: Level>(
    court: &Court<'_>,
    frames: &[&[T]],
    (width, height): (usize, usize),
    sample: &Sample,
    errors: &[PhaseError],
) -> Option<(usize, (i64, i64), f64)> {
    let reach = REACH as usize;
    let inside = |i: usize| {
        let (x, y) = sample.places[i];
        (reach..width.saturating_sub(reach)).contains(&x) && (reach..height.saturating_sub(reach)).contains(&y)
    };
    let stride = sample.len().div_ceil(JOLT_SAMPLE).max(1);
    let few = sample.keep(|i| i % stride == 0 && inside(i));
    if few.len() < FEWEST || frames.len() > 64 {
        return None;
    }
    let stated = court.as_stated();
    let moved = |(dx, dy): (i64, i64)| -> Vec<Vec<f32>> {
        let at = |&(x, y): &(usize, usize)| ((y as i64 + dy) * width as i64 + x as i64 + dx) as usize;
        let one = |f: &&[T]| few.places.iter().map(|p| f.get(at(p)).map_or(0.0, |&v| v.into())).collect();
        frames.iter().map(one).collect()
    };
    let search = |places: Vec<(i64, i64)>, from: std::ops::Range<usize>| {
        let one = |&(dx, dy): &(i64, i64)| {
            let shifted = moved((dx, dy));
            let each = from.clone().map(|j| {
                let levels = few.levels.iter().zip(&shifted).enumerate();
                let levels = levels.map(|(f, (still, moved))| if f < j { still.clone() } else { moved.clone() });
                let sample = Sample { levels: levels.collect(), ..few.keep(|_| true) };
                (j, (dx, dy), court.hear(&sample, &stated, errors).disorder)
            });
            each.min_by(|a, b| a.2.total_cmp(&b.2))
        };
        let found: Vec<_> = threads::install(|| places.par_iter().inspect(polled).map(one).collect());
        let found: Vec<_> = found.into_iter().flatten().collect();
        // Along the fringes nearly any displacement will do: the smallest that is as good.
        let best = found.iter().map(|f| f.2).fold(f64::INFINITY, f64::min);
        let good = found.into_iter().filter(|f| f.2 <= AS_GOOD * best + 0.25 * ORDERLY);
        good.min_by_key(|(_, (dx, dy), _)| dx * dx + dy * dy)
    };
    let grid = |cx: i64, cy: i64, reach: i64, step: usize| -> Vec<(i64, i64)> {
        let side = |c: i64| (c - reach..=c + reach).step_by(step).filter(|d| d.abs() <= REACH);
        side(cy).flat_map(|dy| side(cx).map(move |dx| (dx, dy))).collect()
    };
    let (j, (dx, dy), _) = search(grid(0, 0, REACH, 3), 1..frames.len())?;
    let (j, (dx, dy), left) = search(grid(dx, dy, 2, 1), j.saturating_sub(1).max(1)..(j + 2).min(frames.len()))?;
    (dx * dx + dy * dy >= JOLT_PX * JOLT_PX).then_some((j, (dx, dy), left))
}

/// What the frames of a shot say about themselves; nothing where they agree, or too few pixels speak.
pub(super) fn disagreements<T: Level>(
    shot: &Shot<'_, T>,
    sets: &[FringeSet],
    plan: &Plan,
    noise: &Noise,
    saturation: f32,
    errors: &[PhaseError],
    z: f64,
) -> Vec<Disagreement> {
    let court = Court::new(sets, plan);
    let mut out = Vec::new();
    for (exposure, frames) in shot.exposures.iter().enumerate() {
        let sample = sample(frames, shot.width, shot.height, sets, noise, saturation);
        if sample.len() < FEWEST {
            continue;
        }
        let found = copies(&court, &sample, exposure, false);
        if !found.is_empty() {
            out.extend(found);
            continue;
        }
        let stated = court.as_stated();
        if court.hear(&sample, &stated, errors).disorder <= ORDERLY {
            continue;
        }
        // From here on there is time: the stack is suspect.
        let seen = errors.iter().any(PhaseError::is_some);
        let own = if seen { errors.to_vec() } else { response::seen_in_shot(shot, sets, noise, saturation, z) };
        out.extend(explain(&court, shot, frames, exposure, &sample, &own));
    }
    out
}

fn explain<T: Level>(
    court: &Court<'_>,
    shot: &Shot<'_, T>,
    frames: &[&[T]],
    exposure: usize,
    sample: &Sample,
    errors: &[PhaseError],
) -> Vec<Disagreement> {
    let stated = court.hear(sample, &court.as_stated(), errors);
    if stated.disorder <= ORDERLY {
        return Vec::new();
    }
    let found = copies(court, sample, exposure, true);
    if !found.is_empty() {
        return found;
    }
    let mut causes = causes(court);
    let own = causes.len();
    causes.extend(origins(court, &stated, falls(court, sample)));
    let stride = (sample.len() * frames.len() * causes.len()).div_ceil(EFFORT).max(1);
    let few = sample.keep(|i| i % stride == 0);
    let share = stated.cost.iter().filter(|c| f64::from(**c) > 2.0 * ORDERLY).count() as f64 / sample.len() as f64;
    let explained = (EXPLAINED * stated.disorder).min(LEFT);
    let told = |set, frames, text, left: f64| {
        let strength = stated.disorder / left.max(0.1 * ORDERLY);
        vec![Disagreement { exposure, set, frames, text, share, strength }]
    };
    let mut found: Option<(f64, Cause)> = None;
    if few.len() >= FEWEST {
        let left: Vec<f64> = threads::install(|| {
            causes.par_iter().inspect(polled).map(|c| court.hear(&few, &c.reading, errors).disorder).collect()
        });
        let best = left.iter().copied().fold(f64::INFINITY, f64::min);
        let as_good = |l: f64| l <= AS_GOOD * best + 0.25 * ORDERLY;
        // What one set does alone, all may do together: two sets cannot tell.
        let common = left.iter().zip(&causes).skip(own).find(|(l, _)| as_good(**l)).map(|(_, c)| c.text.clone());
        let single = |at: usize| at < own;
        found =
            left.iter().copied().zip(causes).enumerate().find(|(_, (l, _))| as_good(*l)).map(|(at, (left, cause))| {
                let text = match common {
                    Some(common) if single(at) => format!("{}; or {common}", cause.text),
                    _ => cause.text,
                };
                (left, Cause { text, ..cause })
            });
        found = found.filter(|(left, _)| *left <= explained);
    }
    // A picture that is displaced by a quarter of a fringe looks like a step of four, where the surface is flat.
    let left = found.as_ref().map_or(explained, |(left, _)| left / AS_GOOD);
    if left > ORDERLY
        && let Some((j, (dx, dy), left)) =
            jolt(court, frames, (shot.width, shot.height), sample, errors).filter(|(_, _, l)| *l <= left)
    {
        let set = (0..court.sets.len()).find(|&s| court.frames_of(s).contains(&j)).unwrap_or(0);
        let text = format!(
            "a jolt: from step {} of {} on the picture is displaced by ({dx}, {dy}) px",
            j - court.starts[set],
            court.name(set)
        );
        return told(None, (j..frames.len()).collect(), text, left);
    }
    if let Some((left, cause)) = found {
        return told(cause.set, cause.frames, cause.text, left);
    }
    // Each set a good one by itself, which three steps do not show: a picture that trembles spoils all of them.
    if court.sets.iter().all(|s| s.steps > 3) && stated.unrelated && stated.residual < ORDERLY {
        let text = "the sets have nothing to do with each other: frames of another order, periods or scene".into();
        return told(None, (0..frames.len()).collect(), text, stated.disorder);
    }
    Vec::new()
}

/// Columns that run on over the projector's border: pixels so far apart are neighbours, and light has no other end.
const NEIGHBOURS: usize = 8;
const WHOLE: f64 = 0.9;
/// Pairs of such pixels. An honest view that ends at the border has none, but for a flip by noise.
const FEWEST_PAIRS: usize = 40;

/// What the sets cannot tell each other: the coarsest one rolled by steps that are whole fringes of the next, or all
/// sets off by an angle of that kind. Then the columns jump from one border of the projector to the other in the middle of a
/// surface. `columns` is the result, row-major.
pub(super) fn run_over(
    columns: &[f64],
    width: usize,
    height: usize,
    sets: &[FringeSet],
    plan: &Plan,
    size: f64,
) -> Option<Disagreement> {
    let line = |y: usize| columns.get(y * width..(y + 1) * width).unwrap_or_default();
    let far = |(a, b): (&f64, &f64)| usize::from((a - b).abs() > WHOLE * size);
    let found: usize = sample_rows(height)
        .map(|row| {
            let (here, below) = (line(row), line(row + NEIGHBOURS));
            let across = here.iter().zip(here.iter().skip(NEIGHBOURS)).map(far).sum::<usize>();
            across + here.iter().zip(below).map(far).sum::<usize>()
        })
        .sum();
    if found < FEWEST_PAIRS {
        return None;
    }
    let mut pairs: Vec<[f64; 2]> = Vec::new();
    for row in sample_rows(height) {
        let (here, below) = (line(row), line(row + NEIGHBOURS));
        let both = here.iter().zip(here.iter().skip(NEIGHBOURS)).chain(here.iter().zip(below));
        pairs.extend(both.map(|(a, b)| [*a, *b]).filter(|[a, b]| (a - b).is_finite()));
    }
    let jumps = |off: f64| {
        let at = |c: f64| (c + 0.5 + off).rem_euclid(size);
        pairs.iter().filter(|[a, b]| (at(*a) - at(*b)).abs() > WHOLE * size).count()
    };
    let starts = starts(sets);
    let base = plan.base.weights.iter().position(|w| *w != 0.0).filter(|_| plan.base.periods == 1.0);
    let base = base.filter(|_| plan.base.weights.iter().filter(|w| **w != 0.0).count() == 1);
    let end = "the columns run on over the projector's border in the middle of a surface";
    let frames = sets.iter().map(|s| s.steps).sum();
    let (text, set, frames) = match base.and_then(|b| Some((b, *sets.get(b)?, *starts.get(b)?))) {
        Some((b, set, start)) => {
            let shift = |k: usize| set.direction * k as f64 / set.steps as f64 * size;
            let fits: Vec<usize> = (1..set.steps).filter(|&k| jumps(shift(k)) == 0).collect();
            let text = match fits.as_slice() {
                &[k] => format!("the set of 1 period is rolled: it begins {}", late(k, set.steps)),
                _ => "the set of 1 period is rolled, or all sets start elsewhere (fringes[].origin_rad)".into(),
            };
            (text, Some(b), (start..start + set.steps).collect())
        }
        None => {
            ("all sets start elsewhere (fringes[].origin_rad), or a set is rolled".into(), None, (0..frames).collect())
        }
    };
    let (share, strength) = (found as f64 / pairs.len() as f64, found as f64 / FEWEST_PAIRS as f64);
    Some(Disagreement { exposure: 0, set, frames, text: format!("{end}: {text}"), share, strength })
}

#[cfg(test)]
mod tests {
    use super::super::tests::{SETS, images};
    use super::super::{DecodeOptions, decode_shot};
    use super::*;

    fn said(frames: &[Vec<u8>]) -> Vec<Disagreement> {
        let shot = Shot { exposures: vec![frames.iter().map(Vec::as_slice).collect()], width: 700, height: 50 };
        decode_shot(&shot, &SETS, 912, &DecodeOptions::default()).unwrap().disagreements
    }

    #[test]
    fn faults_are_named_and_nothing_else() {
        let honest = images(700, 50);
        assert_eq!(said(&honest), []);
        let mut frames = honest.clone();
        frames[2] = frames[1].clone();
        assert_eq!(said(&frames)[0].text, "step 2 of the set of 59 periods is a copy of step 1");
        let mut frames = honest.clone();
        frames.swap(10, 15);
        assert_eq!(said(&frames)[0].text, "steps 1 and 6 of the set of 70 periods are exchanged");
        let mut frames = honest.clone();
        frames[4..9].rotate_left(1);
        let found = &said(&frames)[0];
        assert_eq!(found.text, "the set of 64 periods is rolled: it begins 1 step late");
        assert_eq!((found.set, found.frames.clone()), (Some(1), (4..9).collect()));
        assert!(found.share > 0.9 && found.strength > 10.0);
    }

    #[test]
    fn the_shorter_way_round_is_said() {
        assert_eq!(late(1, 4), "1 step late");
        assert_eq!(late(2, 4), "2 steps late");
        assert_eq!(late(3, 4), "1 step early");
        assert!((principal(3.5 * std::f64::consts::PI) + 0.5 * std::f64::consts::PI).abs() < 1e-12);
    }
}
