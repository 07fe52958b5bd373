//! Frames that were copied, or a pattern that was shown twice.

use super::clear_pixels::ClearPixels;
use super::court::{Court, FLICKER};
use super::disagreement::Disagreement;

/// Frames that show the same. Exactly, for a file that was copied; but for noise and the lamp, for a pattern that was
/// shown twice.
pub(super) fn copies(court: &Court<'_>, sample: &ClearPixels, exposure: usize, everywhere: bool) -> Vec<Disagreement> {
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
