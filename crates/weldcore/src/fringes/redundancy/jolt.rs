//! A camera that was pushed between two frames.

use rayon::prelude::*;

use super::super::phase_error::PhaseError;
use super::super::wave::Level;
use super::clear_pixels::{ClearPixels, FEWEST};
use super::court::{AS_GOOD, Court, ORDERLY};
use crate::ground::stop::polled;
use crate::ground::threads;

/// Displacements that are looked for, px, and from where on one is a jolt: a camera that trembles by 3 px all the while
/// moves its mean by less than 4.
const REACH: i64 = 12;
const JOLT_PX: i64 = 4;
/// Pixels that are read again for each displacement.
const JOLT_SAMPLE: usize = 240;

/// From a frame on, all are displaced by whole pixels: the displacement that makes them agree.
pub(super) fn jolt<T: Level>(
    court: &Court<'_>,
    frames: &[&[T]],
    (width, height): (usize, usize),
    sample: &ClearPixels,
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
                let sample = ClearPixels { levels: levels.collect(), ..few.keep(|_| true) };
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
