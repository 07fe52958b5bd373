//! How well the frames agree under a reading of them: by the residuals of each set, and by what the sets say of each other.

use crate::ground::branchless::{round64, turns};
use std::f64::consts::TAU;

use super::super::phase_error::{PhaseError, sine_series};
use super::super::shot::{FringeSet, starts};
use super::super::temporal::Plan;
use super::super::wave::Wave;
use super::clear_pixels::{ClearPixels, FEWEST};

/// Noise of a decision on the fringe order, in fringes, up to which a pixel speaks of it.
const QUIET_MISS: f64 = 0.08;
/// Parts of a period in which the residual is averaged over frames: harmonics up to the sixth are told apart.
const PARTS: usize = 24;
/// A frame may be brighter or darker by this for the lamp's sake: flicker is a few per cent.
pub(super) const FLICKER: f32 = 0.06;
/// Edges, glints and light between walls spoil some pixels of any honest shot: the worst quarter is not heard.
const HEARD: f64 = 0.75;
/// Disorder up to which nothing is looked for: 1 - cos of 16 degrees of disagreement between sets, or a residual of
/// 4 % of the amplitude's power. One step of twelve is 30 degrees, one exchange among twelve 3.3 % beside what it does to
/// the sets; what is below moves no fringe.
pub(super) const ORDERLY: f64 = 0.04;
/// Causes that explain as well as each other within this: the simplest is named.
pub(super) const AS_GOOD: f64 = 1.25;
/// Random phases miss by more than a quarter of a fringe in half of the pixels, and to all sides: an uncorrected gamma with
/// three steps misses by as much at most, and mostly to one side.
const RANDOM_MISS: f64 = 0.25;
const UNRELATED: f64 = 0.4;
const AGREEMENT: f64 = 0.35;

/// Another reading of the frames.
#[derive(Clone)]
pub(super) struct FrameReading {
    /// Which frame is read as which.
    pub(super) order: Vec<usize>,
    /// Per set direction and what is taken off its phase, turns.
    pub(super) turned: Vec<(f32, f32)>,
}

/// How well the frames agree under a reading: zero for a stack without fault.
pub(super) struct Agreement {
    pub(super) disorder: f64,
    /// The mean of exp(2πi miss) of each decision on a fringe order, that enough pixels speak of.
    pub(super) agreement: Vec<Option<[f64; 2]>>,
    /// Of each pixel.
    pub(super) cost: Vec<f32>,
    /// The mean residual of all sets, as a share of the fringes' power.
    pub(super) residual: f64,
    /// Whether some set has nothing to do with the one before.
    pub(super) unrelated: bool,
}

pub(super) struct Court<'a> {
    pub(super) sets: &'a [FringeSet],
    pub(super) starts: Vec<usize>,
    waves: Vec<Wave>,
    pub(super) plan: &'a Plan,
    /// Gains of each decision: the links, then the helpers.
    pub(super) decisions: Vec<Vec<f64>>,
}

impl<'a> Court<'a> {
    pub(super) fn new(sets: &'a [FringeSet], plan: &'a Plan) -> Self {
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

    pub(super) fn as_stated(&self) -> FrameReading {
        let frames = self.sets.iter().map(|s| s.steps).sum();
        FrameReading { order: (0..frames).collect(), turned: vec![(1.0, 0.0); self.sets.len()] }
    }

    pub(super) fn frames_of(&self, set: usize) -> std::ops::Range<usize> {
        self.starts[set]..self.starts[set] + self.sets[set].steps
    }

    pub(super) fn name(&self, set: usize) -> String {
        let periods = self.sets[set].periods;
        format!("the set of {periods} period{}", if periods == 1.0 { "" } else { "s" })
    }

    /// The better of what the sample says with and without the projector's error taken off: that was seen in these very
    /// frames, and is wrong where they are.
    pub(super) fn hear(&self, sample: &ClearPixels, reading: &FrameReading, errors: &[PhaseError]) -> Agreement {
        let plain = self.hear_once(sample, reading, &[]);
        if errors.iter().any(PhaseError::is_some) && plain.disorder > ORDERLY {
            let corrected = self.hear_once(sample, reading, errors);
            if corrected.disorder < plain.disorder {
                return corrected;
            }
        }
        plain
    }

    fn hear_once(&self, sample: &ClearPixels, reading: &FrameReading, errors: &[PhaseError]) -> Agreement {
        let n = sample.len();
        let mut out =
            Agreement { disorder: 0.0, agreement: Vec::new(), cost: vec![0.0; n], residual: 0.0, unrelated: false };
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
    pub(super) fn fit(&self, sample: &ClearPixels, s: usize, frames: &[&[f32]]) -> (Vec<f32>, Option<Vec<f32>>) {
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
