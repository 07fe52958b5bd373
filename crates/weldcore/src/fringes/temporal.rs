//! From wrapped to absolute phase.
//!
//! Temporal unwrapping takes fringe sets of several frequencies, in periods over the projector. A whole combination of
//! their phases, such as the beat of two sets, is a phase too, with the same combination of the frequencies. A signal
//! of at most one period is unambiguous; with it the fringe order of a finer one follows, and so on to the finest. One
//! step from a signal `a` to a finer `b`, whose frequencies have the ratio r, succeeds while
//! `z sigma |r a - b| < π`, where a and b are the coefficients of the signals and |.| their length: this is the rule
//! for hierarchical (sqrt(r² + 1)) and for heterodyne unwrapping (sqrt((r-1)² + r²)) alike. [`Plan`] finds the chain
//! whose weakest step is strongest.

use std::f64::consts::TAU;

use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::ground::branchless::round64;
use crate::ground::memory::require;
use crate::ground::stop::polled;
use crate::ground::threads::{self, CHUNK};

/// The least phase noise that is worth planning for, rad: 8-bit images at full modulation (B = 100, one grey level of
/// noise, four steps). A list of fringes that fails even then cannot be unwrapped.
const BEST_SIGMA_RAD: f64 = 0.007;
/// Frequencies that agree to this are the same.
const SAME: f64 = 1e-9;

/// A whole combination of the phases of the fringe sets.
#[derive(Debug, Clone, PartialEq)]
pub struct Signal {
    /// One coefficient per fringe set.
    pub weights: Vec<f64>,
    /// Periods over the projector, above zero.
    pub periods: f64,
}

/// One link of the chain.
#[derive(Debug, Clone, PartialEq)]
pub struct Link {
    /// The signal whose order is found.
    pub signal: Signal,
    /// Its frequency over that of the link before.
    pub ratio: f64,
    /// `ratio * before - signal` as a combination of the sets' phases: what the noise of the decision is made of.
    pub gains: Vec<f64>,
}

/// How a list of fringe sets is unwrapped.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// A signal of at most one period.
    pub base: Signal,
    /// From the base to the finest set. Empty where that is the base itself.
    pub links: Vec<Link>,
    /// The finest set.
    pub finest: usize,
    /// The other sets that are fine enough to add to the answer.
    pub helpers: Vec<usize>,
    /// The largest |r a - b|.
    pub gain: f64,
}

/// Sets of at least this share of the finest frequency are averaged with it. One below would add less than a fifth of
/// the finest's information, while an error in its phase (light between walls, gamma) counts more than twofold.
const HELPER_SHARE: f64 = 0.5;

impl Plan {
    /// Finds the chain for sets of these frequencies; `z` is the safety factor on the noise.
    ///
    /// # Errors
    /// [`Error::Shape`] without sets, [`Error::OutOfRange`] for a frequency that is not above zero and for a list that
    /// repeats within the projector's width, or that only noiseless images could unwrap. The message says what to add.
    pub fn new(periods: &[f64], z: f64) -> Result<Self> {
        if periods.is_empty() {
            return Err(Error::Shape { what: "fringes", expected: "at least one".into(), got: "none".into() });
        }
        if let Some(p) = periods.iter().find(|p| !(p.is_finite() && **p > 0.0)) {
            let expected = "finite and above 0".into();
            return Err(Error::OutOfRange { what: "fringe periods", expected, value: p.to_string() });
        }
        let top = periods.iter().copied().fold(0.0, f64::max);
        let finest = periods.iter().position(|&p| p == top).unwrap_or(0);
        let signals = signals(periods);
        let goal = signals.iter().position(|s| s.weights == unit(periods.len(), finest));
        let Some((chain, gain)) = goal.and_then(|goal| strongest(&signals, goal)) else {
            return Err(refuse(periods, "repeats within the projector's width"));
        };
        if z * gain * BEST_SIGMA_RAD > std::f64::consts::PI {
            return Err(refuse(periods, &format!("multiplies the noise by {gain:.0}")));
        }
        let mut links = Vec::new();
        for pair in chain.windows(2) {
            if let [a, b] = pair {
                let ratio = b.periods / a.periods;
                links.push(Link { signal: (*b).clone(), ratio, gains: gains(a, b) });
            }
        }
        let Some(base) = chain.first().map(|s| (*s).clone()) else {
            return Err(refuse(periods, "is empty"));
        };
        let helps = |&i: &usize| i != finest && periods.get(i).is_some_and(|&p| p >= HELPER_SHARE * top);
        Ok(Self { base, links, finest, helpers: (0..periods.len()).filter(helps).collect(), gain })
    }
}

fn refuse(periods: &[f64], why: &str) -> Error {
    let list = periods.iter().map(f64::to_string).collect::<Vec<_>>().join(", ");
    Error::OutOfRange {
        what: "fringe periods",
        expected:
            "a list that counts the fringes over the whole projector: add a set of 1 period (1, 8, 64), or choose \
                   sets whose beats come down to one period (59, 64, 70)"
                .into(),
        value: format!("{list}, which {why}"),
    }
}

fn unit(n: usize, at: usize) -> Vec<f64> {
    (0..n).map(|i| if i == at { 1.0 } else { 0.0 }).collect()
}

fn gains(a: &Signal, b: &Signal) -> Vec<f64> {
    let ratio = b.periods / a.periods;
    a.weights.iter().zip(&b.weights).map(|(a, b)| ratio * a - b).collect()
}

/// The combinations that are worth a look: the sets, their beats, the beats of beats, and for short lists all others
/// of a length up to sqrt(6).
fn signals(periods: &[f64]) -> Vec<Signal> {
    let n = periods.len();
    let mut candidates: Vec<Vec<f64>> = (0..n).map(|i| unit(n, i)).collect();
    if n <= 4 {
        for code in 0..5usize.pow(n as u32) {
            let weights: Vec<f64> = (0..n).map(|i| (code / 5usize.pow(i as u32) % 5) as f64 - 2.0).collect();
            if weights.iter().map(|w| w * w).sum::<f64>() <= 6.0 {
                candidates.push(weights);
            }
        }
    } else {
        let minus = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a - b).collect::<Vec<_>>();
        let mut order: Vec<usize> = (0..n).collect();
        order.sort_by(|&a, &b| periods.get(a).partial_cmp(&periods.get(b)).unwrap_or(std::cmp::Ordering::Equal));
        let sets: Vec<Vec<f64>> = order.iter().map(|&i| unit(n, i)).collect();
        let beats: Vec<Vec<f64>> = sets.windows(2).map(|w| minus(&w[1], &w[0])).collect();
        let beats_of_beats: Vec<Vec<f64>> = beats.windows(2).map(|w| minus(&w[1], &w[0])).collect();
        for (i, a) in sets.iter().enumerate() {
            candidates.extend(sets.iter().take(i).map(|b| minus(a, b)));
        }
        candidates.extend(beats_of_beats);
    }
    let mut found: Vec<Signal> = Vec::new();
    for mut weights in candidates {
        let mut sum: f64 = weights.iter().zip(periods).map(|(w, p)| w * p).sum();
        if sum < 0.0 {
            (weights, sum) = (weights.iter().map(|w| -w).collect(), -sum);
        }
        if sum > SAME && !found.iter().any(|s| s.weights == weights) {
            found.push(Signal { weights, periods: sum });
        }
    }
    found.sort_by(|a, b| a.periods.total_cmp(&b.periods));
    found
}

/// The chain from a signal of at most one period up to the goal whose largest |r a - b| is smallest; among equals the
/// one with fewest links. Signals come sorted by frequency, and links only lead upwards.
fn strongest(signals: &[Signal], goal: usize) -> Option<(Vec<&Signal>, f64)> {
    let mut best: Vec<Option<(f64, usize, Option<usize>)>> = vec![None; signals.len()];
    for (at, to) in signals.iter().enumerate().take(goal + 1) {
        let mut here = (to.periods <= 1.0 + SAME).then_some((0.0, 0, None));
        for (before, from) in signals.iter().enumerate().take(at) {
            let Some((cost, links, _)) = best.get(before).copied().flatten() else { continue };
            if from.periods > to.periods * (1.0 - SAME) {
                continue;
            }
            let gain = gains(from, to).iter().map(|g| g * g).sum::<f64>().sqrt();
            let (cost, links) = (f64::max(cost, gain), links + 1);
            if here.is_none_or(|(c, l, _)| cost < c - SAME || (cost < c + SAME && links < l)) {
                here = Some((cost, links, Some(before)));
            }
        }
        if let Some(slot) = best.get_mut(at) {
            *slot = here;
        }
    }
    let gain = best.get(goal).copied().flatten()?.0;
    let mut chain = Vec::new();
    let mut at = Some(goal);
    while let Some(i) = at {
        chain.push(signals.get(i)?);
        at = best.get(i).copied().flatten()?.2;
    }
    chain.reverse();
    Some((chain, gain))
}

/// The absolute phase of the finest set, rad, in [0, 2π periods), from the wrapped phases of several. NaN where any is
/// NaN. Every order is the nearest; [`crate::fringes::decode_shot`] is the one that knows the noise and says when not to
/// trust it.
///
/// # Errors
/// Those of [`Plan::new`], and [`Error::Shape`] where the phases are not of one size, one per frequency.
pub fn unwrap_temporal(wrapped: &[&[f64]], periods: &[f64], z: f64) -> Result<Vec<f64>> {
    let plan = Plan::new(periods, z)?;
    let n = wrapped.first().map_or(0, |w| w.len());
    if wrapped.len() != periods.len() || wrapped.iter().any(|w| w.len() != n) {
        let expected = format!("{} phases of one size, one per frequency", periods.len());
        return Err(Error::Shape { what: "wrapped", expected, got: wrapped.len().to_string() });
    }
    let finest = periods.get(plan.finest).copied().unwrap_or(1.0);
    let whole = |p: &f64| (p - p.round()).abs() < SAME;
    let cyclic = plan.base.periods == 1.0 && periods.iter().all(whole);
    let margin = 0.5 * (1.0 - plan.base.periods).max(0.0);
    let combine = |signal: &Signal, i: usize| -> f64 {
        let terms = signal.weights.iter().zip(wrapped).filter(|(w, _)| **w != 0.0);
        terms.map(|(w, phase)| w * phase.get(i).copied().unwrap_or(f64::NAN)).sum::<f64>() / TAU
    };
    let absolute = |i: usize| -> f64 {
        let base = combine(&plan.base, i);
        let mut turns = base - round64(base + margin - 0.5);
        for link in &plan.links {
            let signal = combine(&link.signal, i);
            turns = signal + round64(turns * link.ratio - signal);
        }
        // The finest set's own phase is kept to the last bit; only whole turns are added.
        let own = wrapped.get(plan.finest).and_then(|w| w.get(i)).copied().unwrap_or(f64::NAN);
        let mut order = round64(turns - own / TAU);
        if cyclic {
            let at = order + own / TAU;
            order += if at < 0.0 { finest } else { 0.0 };
            order -= if at >= finest { finest } else { 0.0 };
        }
        own + TAU * order
    };
    require(n, 8);
    let mut out = vec![0.0; n];
    threads::install(|| {
        out.par_chunks_mut(CHUNK).inspect(polled).enumerate().for_each(|(chunk, values): (usize, &mut [f64])| {
            values.iter_mut().enumerate().for_each(|(i, v)| *v = absolute(chunk * CHUNK + i));
        });
    });
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn any_plan_gives_back_the_phase(x in 0.0..1.0f64, which in 0..5usize) {
            let lists: [&[f64]; 5] =
                [&[1.0, 8.0, 64.0], &[64.0, 1.0], &[59.0, 64.0, 70.0], &[15.0, 16.0], &[0.8, 5.5, 31.0]];
            let periods = lists[which];
            let wrapped: Vec<[f64; 1]> = periods.iter().map(|p| [TAU * (p * x - (p * x).round())]).collect();
            let wrapped: Vec<&[f64]> = wrapped.iter().map(|w| w.as_slice()).collect();
            let finest = periods.iter().copied().fold(0.0, f64::max);
            let found = unwrap_temporal(&wrapped, periods, 5.0).unwrap()[0];
            prop_assert!((found - TAU * finest * x).abs() < 1e-9);
        }
    }

    fn chain(periods: &[f64]) -> Vec<f64> {
        let plan = Plan::new(periods, 5.0).unwrap();
        std::iter::once(plan.base.periods).chain(plan.links.iter().map(|l| l.signal.periods)).collect()
    }

    #[test]
    fn hierarchies_climb_set_by_set_in_any_order() {
        assert_eq!(chain(&[1.0, 8.0, 64.0]), [1.0, 8.0, 64.0]);
        assert_eq!(chain(&[64.0, 1.0, 8.0]), [1.0, 8.0, 64.0]);
        assert_eq!(chain(&[1.0]), [1.0]);
        assert_eq!(chain(&[16.0, 1.0]), [1.0, 16.0]);
        assert_eq!(Plan::new(&[1.0, 8.0, 64.0], 5.0).unwrap().gain, 65f64.sqrt());
        assert_eq!(Plan::new(&[64.0, 1.0, 8.0], 5.0).unwrap().finest, 0);
    }

    #[test]
    fn beats_of_beats_come_down_to_one_period() {
        let plan = Plan::new(&[59.0, 64.0, 70.0], 5.0).unwrap();
        assert_eq!(plan.base.periods, 1.0);
        // METHOD's rule for 1 -> 6 -> 70 by hand: |(6, -11, 5)| and |(0, -11.67, 10.67)|.
        assert!(plan.gain <= (11.667f64.powi(2) + 10.667f64.powi(2)).sqrt() + 1e-3);
        assert_eq!(plan.helpers, [0, 1]);
        assert_eq!(Plan::new(&[15.0, 16.0], 5.0).unwrap().base.periods, 1.0);
    }

    #[test]
    fn lists_that_repeat_are_refused_with_the_remedy() {
        for list in [&[64.0][..], &[8.0, 64.0], &[59.0, 64.0], &[10.0, 20.0, 30.0]] {
            let message = Plan::new(list, 5.0).unwrap_err().to_string();
            assert!(message.contains("add a set of 1 period"), "{message}");
        }
        assert!(Plan::new(&[1.0, 400.0], 5.0).unwrap_err().to_string().contains("multiplies the noise"));
        assert!(Plan::new(&[], 5.0).is_err());
        assert!(Plan::new(&[1.0, f64::NAN], 5.0).is_err());
        assert!(Plan::new(&[0.0, 1.0], 5.0).is_err());
    }

    #[test]
    fn long_lists_are_planned_quickly() {
        assert_eq!(chain(&[1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0]).last(), Some(&64.0));
        assert_eq!(Plan::new(&[40.0, 44.0, 49.0, 55.0, 62.0], 5.0).unwrap().base.periods, 1.0);
    }
}
