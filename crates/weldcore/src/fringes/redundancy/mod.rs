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

pub(super) mod disagreement;

mod border;
mod causes;
mod clear_pixels;
mod copies;
mod court;
mod jolt;

use rayon::prelude::*;

pub(super) use border::run_over;

use super::noise::CameraNoise;
use super::phase_error::PhaseError;
use super::response;
use super::shot::{FringeSet, Shot};
use super::temporal::Plan;
use super::wave::Level;
use crate::ground::stop::polled;
use crate::ground::threads;
use causes::{Cause, causes, origins};
use clear_pixels::{ClearPixels, FEWEST, clear_pixels};
use copies::copies;
use court::{AS_GOOD, Court, ORDERLY};
use disagreement::Disagreement;
use jolt::jolt;

/// A cause must leave at most this share of the disorder, and little in itself. A right one leaves noise alone; one that
/// happens to help leaves half or more.
const EXPLAINED: f64 = 0.3;
const LEFT: f64 = 2.0 * ORDERLY;
/// Work that the hypotheses may take: pixels times frames times hypotheses.
const EFFORT: usize = 60_000_000;

/// Whether the finest phase falls from left to right; `false` too where it does neither.
fn falls(court: &Court<'_>, sample: &ClearPixels) -> bool {
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

/// What the frames of a shot say about themselves; nothing where they agree, or too few pixels speak.
pub(in crate::fringes) fn disagreements<T: Level>(
    shot: &Shot<'_, T>,
    sets: &[FringeSet],
    plan: &Plan,
    noise: &CameraNoise,
    saturation: f32,
    errors: &[PhaseError],
    z: f64,
) -> Vec<Disagreement> {
    let court = Court::new(sets, plan);
    let mut out = Vec::new();
    for (exposure, frames) in shot.exposures.iter().enumerate() {
        let sample = clear_pixels(frames, shot.width, shot.height, sets, noise, saturation);
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
    sample: &ClearPixels,
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

#[cfg(test)]
mod tests {
    use super::super::decode::tests::{SETS, images};
    use super::super::decode::{DecodeOptions, decode_shot};
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
}
