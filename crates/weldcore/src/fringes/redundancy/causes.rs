//! The hypotheses: what may have happened to the frames of a shot.

use std::f64::consts::TAU;

use super::super::shot::FringeSet;
use super::court::{Agreement, Court, FLICKER, FrameReading};
use super::disagreement::late;

/// The mean level over the amplitude, with some light from elsewhere.
const MEAN_TO_SWING: f64 = 1.25;

/// A possible cause: another reading, what it concerns, and its name. The simpler come first.
pub(super) struct Cause {
    pub(super) reading: FrameReading,
    pub(super) set: Option<usize>,
    pub(super) frames: Vec<usize>,
    pub(super) text: String,
}

/// Two frames exchanged, a set rolled, two sets exchanged, the stack rolled, a set that runs the other way.
pub(super) fn causes(court: &Court<'_>) -> Vec<Cause> {
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
pub(super) fn origins(court: &Court<'_>, stated: &Agreement, falls: bool) -> Vec<Cause> {
    let frames = court.as_stated().order.len();
    let mut out = Vec::new();
    let mut add = |off: &dyn Fn(&FringeSet) -> f64, text: String| {
        let turned = court.sets.iter().map(|s| (1.0, off(s) as f32)).collect();
        let reading = FrameReading { turned, ..court.as_stated() };
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shorter_way_round_is_said() {
        assert_eq!(late(1, 4), "1 step late");
        assert_eq!(late(2, 4), "2 steps late");
        assert_eq!(late(3, 4), "1 step early");
        assert!((principal(3.5 * std::f64::consts::PI) + 0.5 * std::f64::consts::PI).abs() < 1e-12);
    }
}
