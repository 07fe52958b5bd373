//! Fringe orders that are unlike all around them.

use multiversion::multiversion;
use rayon::prelude::*;

use super::phase_map::{PhaseMap, Reason};
use crate::ground::stop::polled;
use crate::ground::threads;

/// Rows that a thread takes at a time.
const ROWS: usize = 32;

/// Rejects pixels with a fringe order of their own: at most two of the eight neighbours within half a fringe, and more
/// that are not. Surfaces, and their edges, leave three neighbours at least on a pixel's own side.
pub(super) fn reject_jumps(map: &mut PhaseMap, half_fringe_px: f64) {
    let (width, column) = (map.width, &map.column_px);
    let band_jumps = |band: usize| -> Vec<usize> {
        // Single precision tells half a fringe from less, and is half the bytes. A border of NaN on all sides: whoever
        // lies outside is neither near nor far.
        let narrow = |row: Option<usize>| -> Vec<f32> {
            let mut out = vec![f32::NAN; width + 2];
            let own = row.and_then(|r| column.get(r * width..(r + 1) * width)).unwrap_or_default();
            out.iter_mut().skip(1).zip(own).for_each(|(o, c)| *o = *c as f32);
            out
        };
        let first = band * ROWS;
        let last = (first + ROWS).min(map.height);
        let (mut above, mut here) = (narrow(first.checked_sub(1)), narrow(Some(first)));
        let mut jumps = vec![0u8; width];
        let mut found = Vec::new();
        for row in first..last {
            let below = narrow(Some(row + 1));
            if mark_jumps([&above, &here, &below], half_fringe_px as f32, &mut jumps) {
                found.extend((0..width).zip(&jumps).filter(|(_, jump)| **jump > 0).map(|(i, _)| row * width + i));
            }
            (above, here) = (here, below);
        }
        found
    };
    let bands = map.height.div_ceil(ROWS);
    let found: Vec<Vec<usize>> =
        threads::install(|| (0..bands).into_par_iter().inspect(polled).map(band_jumps).collect());
    for at in found.into_iter().flatten() {
        if let (Some(c), Some(s), Some(r)) =
            (map.column_px.get_mut(at), map.sigma_px.get_mut(at), map.reason.get_mut(at))
        {
            (*c, *s, *r) = (f64::NAN, f32::NAN, Reason::OrderInDoubt as u8);
        }
    }
}

/// Ones where there is a jump in the middle one of three rows; says whether there is any.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
fn mark_jumps(rows: [&[f32]; 3], reach: f32, jumps: &mut [u8]) -> bool {
    let width = jumps.len();
    let [Some(above), Some(here), Some(below)] = rows.map(|r| r.get(..width + 2)) else { return false };
    let mut any = 0;
    for i in 0..width {
        let own = here[i + 1];
        let around = [above[i], above[i + 1], above[i + 2], here[i], here[i + 2], below[i], below[i + 1], below[i + 2]];
        let (mut near, mut far) = (0, 0);
        for other in around {
            let d = (own - other).abs();
            near += i32::from(d < reach);
            far += i32::from(d >= reach);
        }
        let jump = i32::from(near <= 2) & i32::from(far > near);
        jumps[i] = jump as u8;
        any |= jump;
    }
    any > 0
}
