//! Surface normals, from the pixel grid and from a bare cloud.

use std::mem::MaybeUninit;

use multiversion::multiversion;
use rayon::prelude::*;

use crate::clouds::kdtree::{Aside, KdTree, Nearby};
use crate::error::{Error, Result, require_count};
use crate::ground::memory::{filled, require, room};
use crate::ground::robust::median;
use crate::ground::stop::{poll, polled};
use crate::ground::threads;

/// Rows of the grid handed to a thread at a time.
const ROWS: usize = 32;
/// Pixels of a row treated side by side, so that their sums stay in the nearest cache.
const SIDE_BY_SIDE: usize = 32;
/// Neighbours this many times further apart than pixels commonly are lie across a jump: a surface seen so obliquely
/// (beyond 75°) that its own pixels were that far apart is not measured.
const JUMP: f64 = 4.0;
/// Places of a tree handed to a thread at a time.
const PLACES: usize = 1024;
/// Below this share of the spread along a line, the spread across it is rounding.
const ROUNDING: f64 = 1e-12;

/// The normals of a grid of points, `width` to a row, where neighbours in the grid are neighbours on the surface.
///
/// The two tangents are the slopes of the least-squares planes of the points over row and column in a window of
/// `window` by `window` pixels; the normal is square to both, and points to the side of `viewpoint`. Points of the
/// window that lie across a jump of depth do not count. NaN where there is no point, or its neighbours fix no plane.
///
/// # Errors
/// [`Error::Shape`] where the points are not whole rows, [`Error::OutOfRange`] for a window that is even or below 3,
/// [`Error::NonFinite`] for the viewpoint.
pub fn of_grid(points: &[[f64; 3]], width: usize, window: usize, viewpoint: [f64; 3]) -> Result<Vec<[f64; 3]>> {
    require_viewpoint(viewpoint)?;
    if width == 0 || !points.len().is_multiple_of(width) {
        let (expected, got) = (format!("rows of {width}"), format!("{} points", points.len()));
        return Err(Error::Shape { what: "points", expected, got });
    }
    if window < 3 || window.is_multiple_of(2) || window > 1 << 10 {
        let expected = "odd, from 3 to 1023".into();
        return Err(Error::OutOfRange { what: "window", expected, value: window.to_string() });
    }
    let mut normals = room::<[f64; 3]>(points.len());
    let jump = JUMP * common_distance(points, width);
    threads::install(|| {
        normals.par_chunks_mut(ROWS * width).inspect(polled).enumerate().for_each(|(strip, normals)| {
            of_strip(&PixelGrid { points, width, reach: window / 2, jump, viewpoint }, strip * ROWS, normals);
        });
    });
    // SAFETY: the strips cover the points, and `of_strip` writes every normal of its own.
    Ok(unsafe { filled(normals) })
}

/// The median distance of neighbours in a row, over every third pair; 0 where there are none.
fn common_distance(points: &[[f64; 3]], width: usize) -> f64 {
    let squared = |pair: &[[f64; 3]]| match pair {
        [a, b] => (0..3).map(|k| (a[k] - b[k]).powi(2)).sum(),
        _ => f64::NAN,
    };
    let distances =
        |row: &[[f64; 3]]| -> Vec<f64> { row.windows(2).step_by(3).map(squared).filter(|d| d.is_finite()).collect() };
    let rows: Vec<Vec<f64>> =
        threads::install(|| points.par_chunks(width).step_by(3).inspect(polled).map(distances).collect());
    let mut all: Vec<f64> = rows.into_iter().flatten().collect();
    median(&mut all).sqrt()
}

struct PixelGrid<'a> {
    points: &'a [[f64; 3]],
    width: usize,
    reach: usize,
    jump: f64,
    viewpoint: [f64; 3],
}

/// A coordinate of pixels that lie side by side.
type Lanes = [f64; SIDE_BY_SIDE];
/// Sums for each of them over a row of its window: of 1, j, jj, p, j p.
type RowSums = [Lanes; 9];
/// And over the whole window: of 1, i, j, ii, ij, jj, p, i p, j p.
type Sums = [Lanes; 15];

#[inline(always)]
fn side_by_side(planes: [&Vec<f64>; 3], from: usize) -> Option<[&Lanes; 3]> {
    let [x, y, z] = planes.map(|plane| plane.get(from..).and_then(|p| p.first_chunk()));
    Some([x?, y?, z?])
}

#[inline(always)]
fn add_pixels(sums: &mut RowSums, [cx, cy, cz]: [&Lanes; 3], [px, py, pz]: [&Lanes; 3], j: f64, jump: f64) {
    let [n, nj, njj, sx, sy, sz, jx, jy, jz] = sums;
    for k in 0..SIDE_BY_SIDE {
        // Relative to the pixel's own point: no cancellation far from the origin.
        let (x, y, z) = (px[k] - cx[k], py[k] - cy[k], pz[k] - cz[k]);
        // False for NaN.
        let counts = x * x + y * y + z * z <= jump;
        let of = |v: f64| if counts { v } else { 0.0 };
        let (x, y, z) = (of(x), of(y), of(z));
        n[k] += of(1.0);
        nj[k] += of(j);
        njj[k] += of(j * j);
        sx[k] += x;
        sy[k] += y;
        sz[k] += z;
        jx[k] += j * x;
        jy[k] += j * y;
        jz[k] += j * z;
    }
}

#[inline(always)]
fn add_row(sums: &mut Sums, of_row: &RowSums, i: f64) {
    let [n, nj, njj, sx, sy, sz, jx, jy, jz] = of_row;
    // Each sum of the window is one of the row times a power of i.
    let parts: [(&Lanes, f64); 15] = [
        (n, 1.0),
        (n, i),
        (nj, 1.0),
        (n, i * i),
        (nj, i),
        (njj, 1.0),
        (sx, 1.0),
        (sy, 1.0),
        (sz, 1.0),
        (sx, i),
        (sy, i),
        (sz, i),
        (jx, 1.0),
        (jy, 1.0),
        (jz, 1.0),
    ];
    for (sum, (part, factor)) in sums.iter_mut().zip(parts) {
        for (s, p) in sum.iter_mut().zip(part) {
            *s += factor * p;
        }
    }
}

/// What the windows around a line of pixels take from one row, where no neighbours in it lie across a jump: the sums over
/// the window's width of p and of j p.
struct WindowLine {
    /// No jump along the row, nor down to the next one.
    even: [bool; 2],
    sums: [[Lanes; 2]; 3],
}

/// Neighbours that are closer than this, squared, each to each, leave no pixel of a window across a jump: the way to it
/// is |i| + |j| steps, at most the root of two times the distance over which `jump` is counted.
fn even_step(jump: f64) -> f64 {
    0.5 * jump * jump
}

/// Whether all neighbours of two rows of points, at the same place in each, are closer than that.
#[inline(always)]
fn is_even(here: [&[f64]; 3], there: [&[f64]; 3], limit: f64) -> bool {
    let [hx, hy, hz] = here;
    let [tx, ty, tz] = there;
    let mut jumps = 0u64;
    for ((hx, hy, hz), (tx, ty, tz)) in hx
        .iter()
        .zip(hy)
        .zip(hz)
        .map(|((x, y), z)| (x, y, z))
        .zip(tx.iter().zip(ty).zip(tz).map(|((x, y), z)| (x, y, z)))
    {
        let (x, y, z) = (hx - tx, hy - ty, hz - tz);
        // False for NaN.
        let even = x * x + y * y + z * z <= limit;
        jumps |= u64::from(!even);
    }
    jumps == 0
}

/// The line that starts at `from` in the planes; the windows reach `reach` pixels to both sides of its lanes.
#[inline(always)]
fn line(planes: &[Vec<f64>; 3], from: usize, stride: usize, reach: usize, limit: f64) -> WindowLine {
    let width = SIDE_BY_SIDE + 2 * reach;
    let part = |at: usize, n: usize| -> [&[f64]; 3] {
        let [x, y, z] = planes;
        [x, y, z].map(|plane| plane.get(at..at + n).unwrap_or_default())
    };
    let along = is_even(part(from, width - 1), part(from + 1, width - 1), limit);
    let down = part(from + stride, width);
    let mut line = WindowLine {
        even: [along, !down[0].is_empty() && is_even(part(from, width), down, limit)],
        sums: [[[0.0; SIDE_BY_SIDE]; 2]; 3],
    };
    if along {
        for (plane, [sum, tilt]) in planes.iter().zip(&mut line.sums) {
            for shift in 0..=2 * reach {
                let j = shift as f64 - reach as f64;
                let Some(lanes) = plane.get(from + shift..).and_then(|p| p.first_chunk::<SIDE_BY_SIDE>()) else {
                    continue;
                };
                for k in 0..SIDE_BY_SIDE {
                    sum[k] += lanes[k];
                    tilt[k] += j * lanes[k];
                }
            }
        }
    }
    line
}

/// Twice the tangents of the windows around a line of pixels, down and along, up to a factor above zero.
type Tangents = [[Lanes; 3]; 2];

/// Where every pixel of the windows counts: sums of sums.
#[inline(always)]
fn even_tangents(lines: &[WindowLine]) -> Tangents {
    let mut tangents = [[[0.0; SIDE_BY_SIDE]; 3]; 2];
    let [down, along] = &mut tangents;
    let reach = lines.len() / 2;
    for (i, line) in lines.iter().enumerate() {
        let i = i as f64 - reach as f64;
        for ([sum, tilt], (u, v)) in line.sums.iter().zip(down.iter_mut().zip(along.iter_mut())) {
            for k in 0..SIDE_BY_SIDE {
                u[k] += i * sum[k];
                v[k] += tilt[k];
            }
        }
    }
    tangents
}

/// Where pixels are missing, or lie across a jump: NaN where the rest fixes no plane.
#[inline(always)]
fn torn_tangents(s: &Sums) -> Tangents {
    let mut tangents = [[[0.0; SIDE_BY_SIDE]; 3]; 2];
    for k in 0..SIDE_BY_SIDE {
        // What is left of the sums when row and column are taken from their means.
        let per_n = 1.0 / s[0][k];
        let [ii, ij, jj] = [(3, 1, 1), (4, 1, 2), (5, 2, 2)].map(|(m, a, b)| s[m][k] - s[a][k] * s[b][k] * per_n);
        // The tangents are the inverse of [[ii, ij], [ij, jj]] times these: their cross product is theirs times a
        // number above zero. A window of whole steps has no determinant between 0 and 1/n.
        let fixed = (ii * jj - ij * ij) * s[0][k] > 0.5;
        for a in 0..3 {
            let [u, v] = [(1, 9), (2, 12)].map(|(m, p)| s[p + a][k] - s[m][k] * s[6 + a][k] * per_n);
            tangents[0][a][k] = if fixed { u } else { f64::NAN };
            tangents[1][a][k] = if fixed { v } else { f64::NAN };
        }
    }
    tangents
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw", "x86_64+avx2"))]
fn of_strip(grid: &PixelGrid, first: usize, normals: &mut [MaybeUninit<[f64; 3]>]) {
    plain_of_strip(grid, first, normals);
}

/// The body of [`of_strip`], and its fallback.
#[inline(always)]
fn plain_of_strip(grid: &PixelGrid, first: usize, normals: &mut [MaybeUninit<[f64; 3]>]) {
    let (width, reach) = (grid.width, grid.reach);
    let rows = normals.len() / width;
    let (top, height) = (first.saturating_sub(reach), grid.points.len() / width);
    let bottom = (first + rows + reach).min(height);
    // Coordinate by coordinate, relative to a point of the strip: no cancellation far from the origin. With a margin of
    // NaN at both ends of the rows.
    let stride = width + 2 * reach + SIDE_BY_SIDE;
    let inside = grid.points.get(top * width..bottom * width).unwrap_or_default();
    let origin = inside.iter().find(|p| p.iter().all(|c| c.is_finite())).copied().unwrap_or_default();
    let mut planes = [0; 3].map(|_| vec![f64::NAN; stride * (bottom - top)]);
    for (r, from) in inside.chunks(width).enumerate() {
        let [xs, ys, zs] = &mut planes;
        let at = r * stride + reach;
        let [Some(xs), Some(ys), Some(zs)] = [xs, ys, zs].map(|plane| plane.get_mut(at..at + width)) else { continue };
        for (p, (x, (y, z))) in from.iter().zip(xs.iter_mut().zip(ys.iter_mut().zip(zs))) {
            (*x, *y, *z) = (p[0] - origin[0], p[1] - origin[1], p[2] - origin[2]);
        }
    }
    let eye = [0, 1, 2].map(|a| grid.viewpoint[a] - origin[a]);
    let limit = even_step(grid.jump);
    let mut lines: Vec<WindowLine> = Vec::new();
    for block in 0..width.div_ceil(SIDE_BY_SIDE) {
        let left = block * SIDE_BY_SIDE;
        let lanes = SIDE_BY_SIDE.min(width - left);
        lines.clear();
        for r in 0..bottom - top {
            lines.push(line(&planes, r * stride + left, stride, reach, limit));
        }
        for r in 0..rows {
            let row = first + r;
            let here = (row - top) * stride + left;
            let [xs, ys, zs] = &planes;
            let Some(centre) = side_by_side([xs, ys, zs], here + reach) else { continue };
            let window = (row + reach < height)
                .then(|| lines.get((row - top).checked_sub(reach)?..=row - top + reach))
                .flatten()
                .filter(|window| window.iter().all(|l| l.even[0]))
                .filter(|window| window.iter().take(2 * reach).all(|l| l.even[1]));
            let [u, v] = match window {
                Some(window) => even_tangents(window),
                None => {
                    let mut sums: Sums = [[0.0; SIDE_BY_SIDE]; 15];
                    for near in row.saturating_sub(reach).max(top)..(row + reach + 1).min(bottom) {
                        let i = near as f64 - row as f64;
                        let mut of_row: RowSums = [[0.0; SIDE_BY_SIDE]; 9];
                        for shift in 0..=2 * reach {
                            let j = shift as f64 - reach as f64;
                            let there = side_by_side([xs, ys, zs], (near - top) * stride + left + shift);
                            let Some(there) = there else { continue };
                            add_pixels(&mut of_row, centre, there, j, (grid.jump * grid.jump) * (i * i + j * j));
                        }
                        add_row(&mut sums, &of_row, i);
                    }
                    torn_tangents(&sums)
                }
            };
            let mut found = [[0.0; SIDE_BY_SIDE]; 3];
            for k in 0..SIDE_BY_SIDE {
                let of = |t: &[Lanes; 3]| [t[0][k], t[1][k], t[2][k]];
                let to_eye = [eye[0] - centre[0][k], eye[1] - centre[1][k], eye[2] - centre[2][k]];
                let normal = towards(&cross(&of(&u), &of(&v)), &to_eye);
                (found[0][k], found[1][k], found[2][k]) = (normal[0], normal[1], normal[2]);
            }
            let normals = normals.get_mut(r * width + left..r * width + left + lanes).unwrap_or_default();
            for (k, normal) in normals.iter_mut().enumerate() {
                *normal = MaybeUninit::new([found[0][k], found[1][k], found[2][k]]);
            }
        }
    }
}

/// The normals of a bare cloud: square to the least-squares plane of each point's `k` nearest points, itself included,
/// on the side of `viewpoint`. NaN where these lie on a line or all in one place.
///
/// # Errors
/// Those of [`KdTree::new`], [`Error::OutOfRange`] for `k` below 3, [`Error::TooFew`] below `k` points,
/// [`Error::NonFinite`] for the viewpoint.
pub fn of_cloud(points: &[[f64; 3]], k: usize, viewpoint: [f64; 3]) -> Result<Vec<[f64; 3]>> {
    of_tree(&KdTree::new(points)?, k, viewpoint)
}

/// [`of_cloud`] for the points of a tree.
///
/// # Errors
/// As [`of_cloud`].
pub fn of_tree(tree: &KdTree, k: usize, viewpoint: [f64; 3]) -> Result<Vec<[f64; 3]>> {
    require_viewpoint(viewpoint)?;
    if k < 3 {
        return Err(Error::OutOfRange { what: "k", expected: "at least 3".into(), value: k.to_string() });
    }
    require_count("points", k, tree.len())?;
    require(tree.len(), 100);
    let places: Vec<usize> = (0..tree.places()).step_by(PLACES).collect();
    let parts: Vec<Vec<(u32, [f64; 3])>> = threads::install(|| {
        places
            .par_iter()
            .inspect(polled)
            .map(|&first| of_places(tree, first, (first + PLACES).min(tree.places()), k, viewpoint))
            .collect()
    });
    let mut normals = vec![[f64::NAN; 3]; tree.len()];
    for (index, normal) in parts.into_iter().flatten() {
        if let Some(to) = normals.get_mut(index as usize) {
            *to = normal;
        }
    }
    Ok(normals)
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw", "x86_64+avx2"))]
fn of_places(tree: &KdTree, first: usize, last: usize, k: usize, viewpoint: [f64; 3]) -> Vec<(u32, [f64; 3])> {
    let mut aside = Aside::new();
    let mut nearby = Nearby::new(k);
    let mut normals = Vec::with_capacity(last - first);
    for place in first..last {
        let (p, index) = tree.in_place(place as u32);
        if index as usize >= tree.len() {
            continue;
        }
        poll();
        tree.nearby(&p, &mut aside, &mut nearby);
        // Relative to the point itself: no cancellation far from the origin.
        let (mut sum, mut squares) = ([0.0; 3], [0.0; 6]);
        for &place in nearby.places() {
            let (q, _) = tree.in_place(place);
            let d = [q[0] - p[0], q[1] - p[1], q[2] - p[2]];
            for a in 0..3 {
                sum[a] += d[a];
                squares[a] += d[a] * d[a];
                squares[3 + a] += d[a] * d[(a + 1) % 3];
            }
        }
        let n = nearby.places().len() as f64;
        let [xx, yy, zz] = [0, 1, 2].map(|a| squares[a] - sum[a] * sum[a] / n);
        let [xy, yz, zx] = [0, 1, 2].map(|a| squares[3 + a] - sum[a] * sum[(a + 1) % 3] / n);
        let to_eye = [viewpoint[0] - p[0], viewpoint[1] - p[1], viewpoint[2] - p[2]];
        let normal = least_direction([[xx, xy, zx], [xy, yy, yz], [zx, yz, zz]]);
        normals.push((index, normal.map_or([f64::NAN; 3], |n| towards(&n, &to_eye))));
    }
    normals
}

/// The direction of the least eigenvalue of a symmetric matrix with no eigenvalue below zero, by Jacobi's rotations;
/// None where the two lowest are both nothing beside the largest.
#[inline(always)]
fn least_direction(mut m: [[f64; 3]; 3]) -> Option<[f64; 3]> {
    let scale = m[0][0] + m[1][1] + m[2][2];
    if !(scale.is_finite() && scale > 0.0) {
        return None;
    }
    m.iter_mut().flatten().for_each(|v| *v /= scale);
    let mut vectors = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    for _ in 0..12 {
        if m[0][1].abs() + m[1][2].abs() + m[0][2].abs() < f64::EPSILON * 0.01 {
            break;
        }
        for (p, q, r) in [(0, 1, 2), (0, 2, 1), (1, 2, 0)] {
            if m[p][q] == 0.0 {
                continue;
            }
            let theta = (m[q][q] - m[p][p]) / (2.0 * m[p][q]);
            let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
            let c = 1.0 / (t * t + 1.0).sqrt();
            let s = t * c;
            let (mpq, mrp, mrq) = (m[p][q], m[r][p], m[r][q]);
            m[p][p] -= t * mpq;
            m[q][q] += t * mpq;
            (m[p][q], m[q][p]) = (0.0, 0.0);
            (m[r][p], m[r][q]) = (c * mrp - s * mrq, s * mrp + c * mrq);
            (m[p][r], m[q][r]) = (m[r][p], m[r][q]);
            for v in &mut vectors {
                (v[p], v[q]) = (c * v[p] - s * v[q], s * v[p] + c * v[q]);
            }
        }
    }
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| m[a][a].total_cmp(&m[b][b]));
    let least = order[0];
    (m[order[1]][order[1]] > ROUNDING).then_some([vectors[0][least], vectors[1][least], vectors[2][least]])
}

#[inline(always)]
fn cross(a: &[f64; 3], b: &[f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// A unit vector along `v`, turned to the side of `eye`; NaN where `v` has no direction.
#[inline(always)]
fn towards(v: &[f64; 3], eye: &[f64; 3]) -> [f64; 3] {
    let length = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
    let side = v[0] * eye[0] + v[1] * eye[1] + v[2] * eye[2];
    let factor = if length > 0.0 { if side < 0.0 { -1.0 / length } else { 1.0 / length } } else { f64::NAN };
    [v[0] * factor, v[1] * factor, v[2] * factor]
}

fn require_viewpoint(viewpoint: [f64; 3]) -> Result<()> {
    match viewpoint.iter().position(|c| !c.is_finite()) {
        Some(index) => Err(Error::NonFinite { what: "viewpoint", index }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ground::transform::Vec3;

    fn noise(seed: u64) -> impl FnMut() -> f64 {
        let mut state = seed;
        move || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 11) as f64 / (1u64 << 53) as f64 - 0.5
        }
    }

    /// A ball of 50 mm at 300 mm, seen along rays 0.1 mm apart at that distance, and its true normals.
    fn ball(width: usize, height: usize) -> (Vec<[f64; 3]>, Vec<[f64; 3]>) {
        let mut points = Vec::new();
        let mut normals = Vec::new();
        for i in 0..height {
            for j in 0..width {
                let (x, y) = ((j as f64 - width as f64 / 2.0) * 0.1, (i as f64 - height as f64 / 2.0) * 0.1);
                let z = (2500.0 - x * x - y * y).sqrt();
                points.push([x, y, 300.0 - z]);
                normals.push([x / 50.0, y / 50.0, -z / 50.0]);
            }
        }
        (points, normals)
    }

    fn worst(found: &[[f64; 3]], truth: &[[f64; 3]]) -> f64 {
        let angle = |(a, b): (&[f64; 3], &[f64; 3])| (Vec3::from(*a) - Vec3::from(*b)).norm();
        found.iter().zip(truth).map(angle).fold(0.0, |w, a| if a.is_nan() { f64::NAN } else { f64::max(w, a) })
    }

    #[test]
    fn both_find_the_normals_of_a_ball() {
        let (points, truth) = ball(131, 90);
        let grid = of_grid(&points, 131, 5, [0.0; 3]).unwrap();
        let cloud = of_cloud(&points, 20, [0.0; 3]).unwrap();
        // Inside, symmetric neighbours cancel the curvature; at the rim of the view they lie on one side.
        assert!(worst(&grid, &truth) < 0.2 / 50.0 && worst(&cloud, &truth) < 0.4 / 50.0);
        let inside = 65 * 131 / 2;
        assert!(worst(&grid[inside..=inside], &truth[inside..=inside]) < 1e-4);
    }

    #[test]
    fn a_plane_is_exact_far_away_and_seen_from_either_side() {
        let truth = Vec3::new(0.3, -0.5, -1.0).normalize();
        let points: Vec<[f64; 3]> = (0..2000)
            .map(|i| {
                let (x, y) = (f64::from(i % 50), f64::from(i / 50));
                [1e6 + x, 1e6 + y, 1e6 + 0.3 * x - 0.5 * y]
            })
            .collect();
        for (side, viewpoint) in [(1.0, [1e6, 1e6, 0.0]), (-1.0, [1e6, 1e6, 2e6])] {
            let expected = vec![<[f64; 3]>::from(truth * side); 2000];
            // Coordinates of 1e6 mm are rounded to 1e-10 mm.
            assert!(worst(&of_grid(&points, 50, 3, viewpoint).unwrap(), &expected) < 1e-9);
            assert!(worst(&of_cloud(&points, 9, viewpoint).unwrap(), &expected) < 1e-9);
        }
    }

    #[test]
    fn missing_points_and_jumps_of_depth_do_not_count() {
        let mut noise = noise(1);
        let (width, height) = (60, 40);
        let mut points: Vec<[f64; 3]> = (0..width * height)
            .map(|i| {
                let (x, y) = ((i % width) as f64 * 0.1, (i / width) as f64 * 0.1);
                // A step of 5 mm between two level plates.
                [x, y, if i % width < 30 { 300.0 } else { 305.0 }]
            })
            .collect();
        for p in &mut points {
            if noise() > 0.2 {
                *p = [f64::NAN; 3];
            }
        }
        points[7 * width + 7] = [0.7, 0.7, 300.0];
        let normals = of_grid(&points, width, 5, [0.0; 3]).unwrap();
        let mut found = 0;
        for (p, n) in points.iter().zip(&normals) {
            assert!(!p[0].is_nan() || n[0].is_nan());
            if !n[0].is_nan() {
                found += 1;
                assert!((Vec3::from(*n) - Vec3::new(0.0, 0.0, -1.0)).norm() < 1e-12, "{p:?} {n:?}");
            }
        }
        assert!(found > 1200, "{found}");
    }

    #[test]
    fn noise_averages_out() {
        let (mut points, truth) = ball(100, 100);
        let mut noise = noise(3);
        points.iter_mut().for_each(|p| p[2] += 0.01 * noise());
        let rms = |found: Vec<[f64; 3]>| {
            let squares: f64 =
                found.iter().zip(&truth).map(|(a, b)| (Vec3::from(*a) - Vec3::from(*b)).norm_squared()).sum();
            (squares / 1e4).sqrt()
        };
        // A slope over 5 x 5 pixels of 0.1 mm: sigma / (0.1 sqrt(50)), in two directions; more at the rim of the view.
        let expected = 0.01 / 12f64.sqrt() / (0.1 * 50f64.sqrt()) * 2f64.sqrt();
        assert!((0.9..1.3).contains(&(rms(of_grid(&points, 100, 5, [0.0; 3]).unwrap()) / expected)));
        assert!((0.9..1.6).contains(&(rms(of_cloud(&points, 25, [0.0; 3]).unwrap()) / expected)));
    }

    #[test]
    fn any_number_of_threads_gives_the_same_bits() {
        let (points, _) = ball(200, 150);
        let answers: Vec<_> = [1, 2, 8]
            .iter()
            .map(|&n| {
                threads::set_threads(Some(n)).unwrap();
                (of_grid(&points, 200, 5, [0.0; 3]).unwrap(), of_cloud(&points, 12, [0.0; 3]).unwrap())
            })
            .collect();
        threads::set_threads(None).unwrap();
        assert!(answers.windows(2).all(|w| w[0] == w[1]));
    }

    #[test]
    fn lines_have_no_normal_and_bad_input_is_refused() {
        let line: Vec<[f64; 3]> = (0..40).map(|i| [f64::from(i), 2.0 * f64::from(i), 0.0]).collect();
        assert!(of_cloud(&line, 5, [0.0; 3]).unwrap().iter().flatten().all(|v| v.is_nan()));
        assert!(of_cloud(&[[1.0; 3]; 9], 5, [0.0; 3]).unwrap().iter().flatten().all(|v| v.is_nan()));
        assert!(of_grid(&line, 40, 3, [0.0; 3]).unwrap().iter().flatten().all(|v| v.is_nan()));
        assert!(of_grid(&[], 4, 3, [0.0; 3]).unwrap().is_empty());
        assert!(matches!(of_grid(&line, 7, 3, [0.0; 3]), Err(Error::Shape { .. })));
        assert!(matches!(of_grid(&line, 8, 4, [0.0; 3]), Err(Error::OutOfRange { .. })));
        assert!(matches!(of_grid(&line, 8, 3, [f64::NAN; 3]), Err(Error::NonFinite { .. })));
        assert!(matches!(of_cloud(&line, 2, [0.0; 3]), Err(Error::OutOfRange { .. })));
        assert!(matches!(of_cloud(&line, 41, [0.0; 3]), Err(Error::TooFew { .. })));
        assert!(matches!(of_cloud(&[[f64::NAN; 3]; 9], 3, [0.0; 3]), Err(Error::NonFinite { .. })));
    }
}
