//! Spatial unwrapping: reliable pixels first.
//!
//! Herráez, Burton, Lalor and Gdeisat, "Fast two-dimensional phase-unwrapping algorithm based on sorting by reliability
//! following a noncontinuous path", Applied Optics 41 (2002) 7437. Neighbours are joined in the order of their
//! reliability, and each joint fixes the whole turns between two groups. That is Kruskal's algorithm: the answer is a
//! minimum spanning forest, which may be found in any way. Here it is found tile by tile. Within a tile (that stays in
//! the cache, and tiles run in parallel) a joint is final if no cheaper one leaves either of the two groups, over the
//! tile's border included; the few others wait, with the joints between tiles, for a second round over the whole image.

use std::f64::consts::TAU;

use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::ground::branchless::{round, round64};
use crate::ground::memory::require;
use crate::ground::stop::{poll, polled};
use crate::ground::threads::{self, CHUNK};

/// Side of a tile, pixels.
const SIDE: usize = 64;

/// No phase is larger, rad: beyond, nothing is left of the fraction of a turn.
const LARGEST: f64 = 1e9;

/// A joint between two neighbours: cost (as an integer that orders like it) above, the joint's number below, so that
/// equal costs go by position. The number is twice the pixel's, plus one for the neighbour below instead of on the right.
type Joint = u64;

fn joint(cost: f32, pixel: usize, down: bool) -> Joint {
    let bits = cost.to_bits();
    // Floats order like their bits, but for the sign.
    let ordered = if bits >> 31 == 1 { !bits } else { bits | 1 << 31 };
    (u64::from(ordered) << 32) | (2 * pixel as u64 + u64::from(down))
}

/// Groups of pixels with whole turns between them. Each entry holds the parent and the turns to it.
struct Groups {
    parent: Vec<u32>,
    turns: Vec<i32>,
}

impl Groups {
    fn new(n: usize) -> Self {
        Self { parent: (0..n as u32).collect(), turns: vec![0; n] }
    }

    /// The group of `i`, and the turns to add to `i` to be in line with it.
    #[inline(always)]
    fn find(&mut self, i: usize) -> (usize, i32) {
        let (mut at, mut sum) = (i, 0);
        loop {
            let up = self.parent[at] as usize;
            if up == at {
                return (at, sum);
            }
            // Halve the path on the way.
            let over = self.parent[up] as usize;
            if over != up {
                self.turns[at] += self.turns[up];
                self.parent[at] = over as u32;
            }
            sum += self.turns[at];
            at = self.parent[at] as usize;
        }
    }

    /// Makes `b`'s group, whose own turns then count `turns` to it, part of `a`'s. The lower number stays on top, so
    /// that a group's name is its first pixel.
    fn join(&mut self, a: usize, b: usize, turns: i32) {
        let (top, under, turns) = if a < b { (a, b, turns) } else { (b, a, -turns) };
        self.parent[under] = top as u32;
        self.turns[under] = turns;
    }
}

struct Image<'a> {
    width: usize,
    height: usize,
    /// In turns, within half a turn; NaN where there is nothing.
    phase: &'a [f32],
    /// What joining a pixel costs; the sum of two is the cost of a joint.
    cost: &'a [f32],
}

impl Image<'_> {
    fn joint_right(&self, at: usize) -> Option<Joint> {
        (at % self.width + 1 < self.width).then(|| self.joint(at, at + 1, false)).flatten()
    }

    fn joint_below(&self, at: usize) -> Option<Joint> {
        (at / self.width + 1 < self.height).then(|| self.joint(at, at + self.width, true)).flatten()
    }

    #[inline(always)]
    fn joint(&self, a: usize, b: usize, down: bool) -> Option<Joint> {
        let cost = self.cost[a] + self.cost[b];
        (!(self.phase[a] + self.phase[b]).is_nan()).then(|| joint(cost, a, down))
    }

    fn ends(&self, joint: Joint) -> (usize, usize) {
        let number = (joint & 0xffff_ffff) as usize;
        let (at, down) = (number / 2, number % 2);
        (at, if down == 1 { at + self.width } else { at + 1 })
    }

    /// The turns to add to `b` to be in line with `a`.
    fn turns(&self, a: usize, b: usize) -> i32 {
        round(self.phase[a] - self.phase[b]) as i32
    }
}

/// What a tile found: its top left corner and size, each pixel's group (a pixel of the image) and turns to it, and the
/// joints that wait.
struct Tile {
    left: usize,
    top: usize,
    width: usize,
    height: usize,
    group: Vec<(u32, i32)>,
    waiting: Vec<Joint>,
}

fn join_tile(image: &Image<'_>, left: usize, top: usize) -> Tile {
    let (width, height) = (SIDE.min(image.width - left), SIDE.min(image.height - top));
    let n = width * height;
    let mut joints = Vec::with_capacity(2 * n);
    let mut waiting = Vec::with_capacity(4 * (width + height));
    // The cheapest joint that leaves the tile from each group.
    let mut leaving = vec![Joint::MAX; n];
    let mut leave = |local: usize, joint: Option<Joint>| {
        if let Some(joint) = joint {
            leaving[local] = leaving[local].min(joint);
        }
        joint
    };
    for y in 0..height {
        for x in 0..width {
            let (at, local) = ((top + y) * image.width + left + x, y * width + x);
            if x + 1 < width {
                joints.extend(image.joint_right(at));
            } else {
                waiting.extend(leave(local, image.joint_right(at)));
            }
            if y + 1 < height {
                joints.extend(image.joint_below(at));
            } else {
                waiting.extend(leave(local, image.joint_below(at)));
            }
            if x == 0 && left > 0 {
                leave(local, image.joint(at - 1, at, false));
            }
            if y == 0 && top > 0 {
                leave(local, image.joint(at - image.width, at, true));
            }
        }
    }
    joints.sort_unstable();
    let local = |at: usize| (at / image.width - top) * width + at % image.width - left;
    // `all` knows what any joint has joined, `sure` only what is final.
    let (mut all, mut sure) = (Groups::new(n), Groups::new(n));
    for joint in joints {
        let (at, other) = image.ends(joint);
        let (a, b) = (local(at), local(other));
        let ((ga, _), (gb, _)) = (all.find(a), all.find(b));
        if ga == gb {
            continue;
        }
        if joint < leaving[ga] || joint < leaving[gb] {
            let ((sa, ta), (sb, tb)) = (sure.find(a), sure.find(b));
            sure.join(sa, sb, ta + image.turns(at, other) - tb);
        } else {
            waiting.push(joint);
        }
        let cheapest = leaving[ga].min(leaving[gb]);
        all.join(ga, gb, 0);
        leaving[ga.min(gb)] = cheapest;
    }
    let place = |local: usize| ((top + local / width) * image.width + left + local % width) as u32;
    let group = (0..n).map(|i| sure.find(i)).map(|(g, turns)| (place(g), turns)).collect();
    Tile { left, top, width, height, group, waiting }
}

/// Unwraps a phase image in space. NaN (and anything beyond 1e9 rad), and pixels outside `mask` (true where a pixel counts), stay out and are NaN in
/// the answer. Each connected region keeps the value of its first pixel. `quality` replaces the reliability: pixels of
/// high quality are joined first; without it the cost of a pixel is the sum of its squared second differences along rows,
/// columns and diagonals, where a difference that is not to be had counts as the worst.
///
/// # Errors
/// [`Error::Shape`] where the arrays have not width x height pixels, [`Error::OutOfRange`] beyond 2³¹ pixels, and
/// [`Error::NonFinite`] for a quality that is not a number where there is a phase.
pub fn unwrap_spatial(
    wrapped: &[f64],
    width: usize,
    mask: Option<&[bool]>,
    quality: Option<&[f64]>,
) -> Result<Vec<f64>> {
    let n = wrapped.len();
    let height = n.checked_div(width).unwrap_or(0);
    for (what, got) in
        [("wrapped", n), ("mask", mask.map_or(n, <[_]>::len)), ("quality", quality.map_or(n, <[_]>::len))]
    {
        if got != width * height || got != n {
            let expected = format!("whole rows of {width} pixels, the same for all arrays");
            return Err(Error::Shape { what, expected, got: format!("{got} pixels") });
        }
    }
    if n >= 1 << 31 {
        return Err(Error::OutOfRange { what: "wrapped", expected: "below 2^31 pixels".into(), value: n.to_string() });
    }
    if n == 0 {
        return Ok(Vec::new());
    }
    require(n, 120);
    let whole = |v: f64| round64(v / TAU);
    let turns = |i: usize| -> f32 {
        let value = wrapped.get(i).copied().unwrap_or(f64::NAN);
        let counts = mask.is_none_or(|m| m.get(i).copied().unwrap_or(false)) && value.abs() < LARGEST;
        if counts { (value / TAU - whole(value)) as f32 } else { f32::NAN }
    };
    let phase: Vec<f32> = threads::install(|| (0..n).into_par_iter().with_min_len(1 << 14).map(turns).collect());
    let cost: Vec<f32> = match quality {
        Some(quality) => {
            if let Some(index) = quality.iter().zip(&phase).position(|(q, p)| !q.is_finite() && !p.is_nan()) {
                return Err(Error::NonFinite { what: "quality", index });
            }
            quality.iter().map(|q| -*q as f32).collect()
        }
        None => roughness(&phase, width),
    };
    let image = Image { width, height, phase: &phase, cost: &cost };

    let corners: Vec<(usize, usize)> =
        (0..height).step_by(SIDE).flat_map(|top| (0..width).step_by(SIDE).map(move |left| (left, top))).collect();
    let tiles: Vec<Tile> = threads::install(|| {
        corners.into_par_iter().inspect(polled).map(|(left, top)| join_tile(&image, left, top)).collect()
    });

    // Second round: the groups of all tiles, and the joints that wait.
    let mut group = vec![(0u32, 0i32); n];
    let mut waiting = Vec::new();
    for tile in &tiles {
        poll();
        for (y, row) in tile.group.chunks(tile.width).enumerate().take(tile.height) {
            let start = (tile.top + y) * width + tile.left;
            group[start..start + tile.width].copy_from_slice(row);
        }
        waiting.extend_from_slice(&tile.waiting);
    }
    waiting.sort_unstable();
    let mut groups = Groups::new(n);
    for (number, joint) in waiting.into_iter().enumerate() {
        if number.is_multiple_of(CHUNK) {
            poll();
        }
        let (a, b) = image.ends(joint);
        let ((la, ta), (lb, tb)) = (group[a], group[b]);
        let ((ga, ua), (gb, ub)) = (groups.find(la as usize), groups.find(lb as usize));
        if ga != gb {
            groups.join(ga, gb, ta + ua + image.turns(a, b) - tb - ub);
        }
    }
    // Flatten, then every pixel needs one look only.
    let top: Vec<(u32, i32)> = (0..n)
        .map(|i| if group[i].0 as usize == i { groups.find(i) } else { (0, 0) })
        .map(|(g, t)| (g as u32, t))
        .collect();
    let answer = |i: usize| -> f64 {
        if phase[i].is_nan() {
            return f64::NAN;
        }
        let (local, turns) = group[i];
        let (first, more) = top[local as usize];
        // The first pixel of a region keeps its value: its own whole turns go to all.
        let kept = whole(wrapped[first as usize]) - whole(wrapped[i]);
        wrapped[i] + TAU * (f64::from(turns + more) + kept)
    };
    let mut out = vec![0.0; n];
    threads::install(|| {
        out.par_chunks_mut(CHUNK).inspect(polled).enumerate().for_each(|(chunk, values): (usize, &mut [f64])| {
            values.iter_mut().enumerate().for_each(|(i, v)| *v = answer(chunk * CHUNK + i));
        });
    });
    Ok(out)
}

/// The sum of the squared second differences, in turns squared, along row, column and both diagonals.
fn roughness(phase: &[f32], width: usize) -> Vec<f32> {
    let height = phase.len() / width;
    let row = |y: usize| -> Vec<f32> {
        let nothing = vec![f32::NAN; width];
        let line = |y: Option<usize>| y.and_then(|y| phase.get(y * width..(y + 1) * width)).unwrap_or(&nothing);
        let (above, here, below) = (line(y.checked_sub(1)), line(Some(y)), line(Some(y + 1)));
        let mut out = vec![4.0 * WORST; width];
        bend(above, here, below, &mut out);
        out
    };
    let rows: Vec<Vec<f32>> = threads::install(|| (0..height).into_par_iter().inspect(polled).map(row).collect());
    rows.concat()
}

/// A second difference of wrapped differences is at most one turn.
const WORST: f32 = 1.0;

#[multiversion::multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
fn bend(above: &[f32], here: &[f32], below: &[f32], out: &mut [f32]) {
    plain_bend(above, here, below, out);
}

/// The body of [`bend`], and its fallback.
#[inline(always)]
fn plain_bend(above: &[f32], here: &[f32], below: &[f32], out: &mut [f32]) {
    let wrap = |d: f32| d - round(d);
    let width = out.len().min(here.len()).min(above.len()).min(below.len());
    let (above, here, below, out) = (&above[..width], &here[..width], &below[..width], &mut out[..width]);
    let square = |before: f32, at: f32, after: f32| {
        let second = wrap(before - at) - wrap(at - after);
        let square = second * second;
        if square.is_nan() { WORST } else { square }
    };
    for x in 0..width {
        // At the sides only the column is to be had.
        out[x] = 3.0 * WORST + square(above[x], here[x], below[x]);
    }
    if width < 3 {
        return;
    }
    let inner = width - 2;
    let (a, h, b) = (&above[..inner], &here[..inner], &below[..inner]);
    let (a1, h1, b1) = (&above[1..1 + inner], &here[1..1 + inner], &below[1..1 + inner]);
    let (a2, h2, b2) = (&above[2..2 + inner], &here[2..2 + inner], &below[2..2 + inner]);
    let out = &mut out[1..1 + inner];
    for x in 0..inner {
        let row = square(h[x], h1[x], h2[x]);
        let column = square(a1[x], h1[x], b1[x]);
        out[x] = row + column + square(a[x], h1[x], b2[x]) + square(a2[x], h1[x], b[x]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn wrap(v: f64) -> f64 {
        v - TAU * (v / TAU).round()
    }

    /// Kruskal over the whole image at once, as the paper has it.
    fn plain(wrapped: &[f64], width: usize, mask: Option<&[bool]>, quality: Option<&[f64]>) -> Vec<f64> {
        let n = wrapped.len();
        let counts = |i: usize| mask.is_none_or(|m| m[i]) && wrapped[i].abs() < LARGEST;
        let phase: Vec<f32> = (0..n)
            .map(|i| if counts(i) { (wrapped[i] / TAU - round64(wrapped[i] / TAU)) as f32 } else { f32::NAN })
            .collect();
        let cost = quality.map_or_else(|| roughness(&phase, width), |q| q.iter().map(|q| -*q as f32).collect());
        let image = Image { width, height: n / width, phase: &phase, cost: &cost };
        let mut joints: Vec<Joint> =
            (0..n).flat_map(|i| [image.joint_right(i), image.joint_below(i)]).flatten().collect();
        joints.sort_unstable();
        let mut group: Vec<usize> = (0..n).collect();
        let mut turns = vec![0i32; n];
        for joint in joints {
            let (a, b) = image.ends(joint);
            if group[a] != group[b] {
                let shift = turns[a] + image.turns(a, b) - turns[b];
                let (from, to) = (group[b], group[a]);
                for i in 0..n {
                    if group[i] == from {
                        (group[i], turns[i]) = (to, turns[i] + shift);
                    }
                }
            }
        }
        let first = |g: usize| (0..n).find(|&i| group[i] == g).unwrap();
        (0..n)
            .map(|i| {
                if phase[i].is_nan() {
                    return f64::NAN;
                }
                let f = first(group[i]);
                let whole = |i: usize| round64(wrapped[i] / TAU);
                wrapped[i] + TAU * (f64::from(turns[i] - turns[f]) + whole(f) - whole(i))
            })
            .collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn tiles_make_no_difference(
            seed in any::<u64>(), width in 1..150usize, height in 1..100usize, noise in 0.0..8.0f64, given in any::<bool>(),
        ) {
            let mut state = seed;
            let mut random = || {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                (state >> 11) as f64 / (1u64 << 53) as f64
            };
            let n = width * height;
            let wrapped: Vec<f64> = (0..n)
                .map(|i| wrap(0.3 * (i % width) as f64 + 0.002 * (i / width).pow(2) as f64 + noise * (random() - 0.5)))
                .map(|v| if (v * 1e4) as i64 % 17 == 0 { f64::NAN } else { v })
                .collect();
            let mask: Vec<bool> = (0..n).map(|_| random() < 0.9).collect();
            let quality: Vec<f64> = (0..n).map(|_| (random() * 50.0).round()).collect();
            let quality = given.then_some(quality.as_slice());
            let expected = plain(&wrapped, width, Some(&mask), quality);
            let found = unwrap_spatial(&wrapped, width, Some(&mask), quality).unwrap();
            for (f, e) in found.iter().zip(&expected) {
                prop_assert!((f - e).abs() < 1e-9 || (f.is_nan() && e.is_nan()), "{} {}", f, e);
            }
        }
    }

    #[test]
    fn vectors_and_the_plain_fallback_give_the_same_bits() {
        let row = |s: f32| (0..203).map(|i| ((i as f32 + s) * 0.37).sin() * 0.5).collect::<Vec<f32>>();
        let (above, mut here, below) = (row(0.1), row(0.2), row(0.3));
        here[50] = f32::NAN;
        let (mut fast, mut plain) = (vec![0.0; 203], vec![0.0; 203]);
        bend(&above, &here, &below, &mut fast);
        plain_bend(&above, &here, &below, &mut plain);
        assert!(fast == plain && fast.iter().any(|&v| v > 0.0 && v < WORST));
    }

    #[test]
    fn a_smooth_surface_comes_back() {
        let (width, height) = (300, 200);
        let truth: Vec<f64> = (0..width * height)
            .map(|i| {
                let (x, y) = ((i % width) as f64 / 30.0 - 5.0, (i / width) as f64 / 20.0 - 5.0);
                30.0 * (-0.1 * (x * x + y * y)).exp() + x
            })
            .collect();
        let wrapped: Vec<f64> = truth.iter().map(|v| wrap(*v)).collect();
        let found = unwrap_spatial(&wrapped, width, None, None).unwrap();
        let shift = found[0] - truth[0];
        assert!(found.iter().zip(&truth).all(|(f, t)| (f - t - shift).abs() < 1e-9));
        assert_eq!(found[0], wrapped[0]);
    }

    #[test]
    fn regions_stand_alone_and_wrong_sizes_are_refused() {
        let nan = f64::NAN;
        let found = unwrap_spatial(&[3.0, -3.0, nan, 9.0, 9.5], 5, None, None).unwrap();
        assert!((found[1] - (TAU - 3.0)).abs() < 1e-12);
        assert!(found[2].is_nan());
        assert_eq!(&found[3..], [9.0, 9.5]);
        assert!(unwrap_spatial(&[1.0; 5], 2, None, None).is_err());
        assert!(unwrap_spatial(&[1.0; 4], 2, Some(&[true]), None).is_err());
        assert!(unwrap_spatial(&[1.0; 4], 2, None, Some(&[nan; 4])).is_err());
        assert!(unwrap_spatial(&[], 0, None, None).unwrap().is_empty());
        assert!(unwrap_spatial(&[1.0], 0, None, None).is_err());
    }
}
