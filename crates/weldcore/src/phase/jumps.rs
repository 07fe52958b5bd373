//! Fringe orders that are unlike all around them.

use multiversion::multiversion;
use rayon::prelude::*;

use super::{PhaseMap, Reason};
use crate::threads;

/// Rejects pixels with a fringe order of their own: at most two of the eight neighbours within half a fringe, and more
/// that are not. Surfaces, and their edges, leave three neighbours at least on a pixel's own side.
pub(super) fn reject_jumps(map: &mut PhaseMap, half_fringe_px: f64) {
    let (width, column) = (map.width, &map.column_px);
    let row_jumps = |row: usize| -> Vec<usize> {
        let around = [row.checked_sub(1), Some(row), Some(row + 1)];
        let rows: Vec<&[f64]> =
            around.iter().flatten().filter_map(|r| column.get(r * width..(r + 1) * width)).collect();
        let Some(own) = column.get(row * width..(row + 1) * width) else { return Vec::new() };
        let (mut near, mut far) = (vec![0u8; width], vec![0u8; width]);
        count_neighbours(own, &rows, half_fringe_px, &mut near, &mut far);
        if !mark_jumps(&mut near, &far) {
            return Vec::new();
        }
        near.iter().enumerate().filter(|(_, jump)| **jump > 0).map(|(i, _)| row * width + i).collect()
    };
    let found: Vec<Vec<usize>> = threads::install(|| (0..map.height).into_par_iter().map(row_jumps).collect());
    for at in found.into_iter().flatten() {
        if let (Some(c), Some(s), Some(r)) =
            (map.column_px.get_mut(at), map.sigma_px.get_mut(at), map.reason.get_mut(at))
        {
            (*c, *s, *r) = (f64::NAN, f32::NAN, Reason::OrderInDoubt as u8);
        }
    }
}

/// Turns the counts in `near` into ones where there is a jump; says whether there is any.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
fn mark_jumps(near: &mut [u8], far: &[u8]) -> bool {
    let mut any = 0;
    for (near, &far) in near.iter_mut().zip(far) {
        // The pixel itself is among the near ones.
        let jump = u8::from(*near >= 1) & u8::from(*near <= 3) & u8::from(far + 1 > *near);
        *near = jump;
        any |= jump;
    }
    any > 0
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
fn count_neighbours(own: &[f64], rows: &[&[f64]], reach: f64, near: &mut [u8], far: &mut [u8]) {
    for row in rows {
        for shift in 0..3usize {
            // Neighbour i + shift - 1 of pixel i.
            let skip = usize::from(shift == 0);
            let other = row.get(shift.saturating_sub(1)..).unwrap_or_default();
            let (near, far) = (near.iter_mut().skip(skip), far.iter_mut().skip(skip));
            for (((&a, &b), near), far) in own.iter().skip(skip).zip(other).zip(near).zip(far) {
                let d = (a - b).abs();
                *near += u8::from(d < reach);
                *far += u8::from(d >= reach);
            }
        }
    }
}
