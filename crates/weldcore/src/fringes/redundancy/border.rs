//! Columns that run on over the projector's border: what the sets cannot tell each other.

use super::super::noise::sample_rows;
use super::super::shot::{FringeSet, starts};
use super::super::temporal::Plan;
use super::disagreement::{Disagreement, late};

/// Columns that run on over the projector's border: pixels so far apart are neighbours, and light has no other end.
const NEIGHBOURS: usize = 8;
const WHOLE: f64 = 0.9;
/// Pairs of such pixels. An honest view that ends at the border has none, but for a flip by noise.
const FEWEST_PAIRS: usize = 40;

/// What the sets cannot tell each other: the coarsest one rolled by steps that are whole fringes of the next, or all
/// sets off by an angle of that kind. Then the columns jump from one border of the projector to the other in the middle of a
/// surface. `columns` is the result, row-major.
pub(in crate::fringes) fn run_over(
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
