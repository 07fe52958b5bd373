//! From the projector's column to points.
//!
//! A camera pixel is a ray `z (x, y, 1)`; a projector column is a surface, a plane but for the projector's lens. In the
//! projector's frame the ray at `s = 1/z` is seen in the direction `((q + s t) / (q_z + s t_z))`, with q the rotated
//! ray and t the camera's place: one unknown, found by Newton on the distorted column, exactly with both lenses. The
//! start is the plane without the lens. Each step doubles the digits, so the first two are taken in single precision,
//! at twice the speed, and the last two in double.

// Several arrays run in step through the kernel: there an index is plainer than a tower of zips.
#![allow(clippy::needless_range_loop)]

use std::mem::MaybeUninit;
use std::ops::{Add, Div, Mul, Sub};

use multiversion::multiversion;
use rayon::prelude::*;

use super::lens::{Axis, Lens, Rays, Scanner};
use crate::error::{Error, Result};
use crate::ground::memory::{fill, filled, require, room};
use crate::ground::stop::polled;
use crate::ground::threads::{self, CHUNK};

/// Pixels that the kernel takes at a time.
const TILE: usize = 128;
/// Where the last step of Newton starts from a larger miss than this (normalised coordinates), the ray does not meet the
/// column. What is left after it is of the order of the square.
const CLOSE: f64 = 1e-7;

/// Points on the camera's pixel grid.
#[derive(Debug, Clone)]
pub struct Cloud {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Scanner frame, mm; NaN where there is none.
    pub points_mm: Vec<[f64; 3]>,
    /// Standard deviation along the camera's ray; NaN where there is no point. Empty if none was asked for.
    pub sigma_mm: Vec<f32>,
}

/// Single or double precision.
trait Real: Copy + From<f32> + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self> {}
impl Real for f32 {}
impl Real for f64 {}

/// The projector, turned so that the measured coordinate is the first.
struct Projection<T> {
    /// Rows of projector_from_camera's rotation, measured coordinate first, then the other, then z; and its translation.
    rotation: [[T; 3]; 3],
    translation: [T; 3],
    k: [T; 3],
    /// Tangential terms: p[0] belongs to the measured coordinate.
    p: [T; 2],
}

/// What the projector sees of a camera ray at s = 1/z.
struct Look<T> {
    /// Measured coordinate less its aim, normalised and distorted; and its derivative by s.
    miss: T,
    slope: T,
    /// The other coordinate.
    across: T,
    /// Its distance from the projector, times s.
    depth: T,
}

impl<T: Real> Look<T> {
    #[inline(always)]
    fn step(&self) -> T {
        self.miss / self.slope
    }
}

impl Projection<f64> {
    fn new(scanner: &Scanner, axis: Axis) -> Self {
        let pose = scanner.camera_from_projector.inverse();
        let row = |r: usize| [pose.rotation[(r, 0)], pose.rotation[(r, 1)], pose.rotation[(r, 2)]];
        let Lens { dist: [k1, k2, p1, p2, k3], .. } = scanner.projector;
        let t = pose.translation;
        let (first, second, p) = match axis {
            Axis::X => (0, 1, [p2, p1]),
            Axis::Y => (1, 0, [p1, p2]),
        };
        Self {
            rotation: [row(first), row(second), row(2)],
            translation: [t[first], t[second], t[2]],
            k: [k1, k2, k3],
            p,
        }
    }

    fn narrow(&self) -> Projection<f32> {
        Projection {
            rotation: self.rotation.map(|row| row.map(|v| v as f32)),
            translation: self.translation.map(|v| v as f32),
            k: self.k.map(|v| v as f32),
            p: self.p.map(|v| v as f32),
        }
    }
}

impl<T: Real> Projection<T> {
    #[inline(always)]
    fn turn(&self, x: T, y: T) -> [T; 3] {
        let [a, b, c] = self.rotation;
        [a[0] * x + a[1] * y + a[2], b[0] * x + b[1] * y + b[2], c[0] * x + c[1] * y + c[2]]
    }

    /// s where the turned ray meets the plane of the column, the lens left out.
    #[inline(always)]
    fn plane(&self, q: &[T; 3], aim: T) -> T {
        (aim * q[2] - q[0]) / (self.translation[0] - aim * self.translation[2])
    }

    #[inline(always)]
    fn look(&self, q: &[T; 3], aim: T, s: T) -> Look<T> {
        let Projection { translation: t, k, p, .. } = self;
        let (one, two, three, six) = (T::from(1.0), T::from(2.0), T::from(3.0), T::from(6.0));
        let depth = q[2] + t[2] * s;
        let inverse = one / depth;
        let a = (q[0] + t[0] * s) * inverse;
        let b = (q[1] + t[1] * s) * inverse;
        // The lens, as in `Lens::distort`, and its slope along the ray.
        let (aa, ab, bb) = (a * a, a * b, b * b);
        let r2 = aa + bb;
        let radial = one + r2 * (k[0] + r2 * (k[1] + r2 * k[2]));
        let bend = two * (k[0] + r2 * (two * k[1] + r2 * three * k[2]));
        let along_a = radial + aa * bend + two * p[1] * b + six * p[0] * a;
        let along_b = ab * bend + two * p[1] * a + two * p[0] * b;
        Look {
            miss: a * radial + two * p[1] * ab + p[0] * (r2 + two * aa) - aim,
            slope: (along_a * (t[0] - a * t[2]) + along_b * (t[1] - b * t[2])) * inverse,
            across: b * radial + p[1] * (r2 + two * bb) + two * p[0] * ab,
            depth,
        }
    }
}

/// The numbers of a tile's problem; of each pair the first belongs to the measured coordinate.
struct Problem {
    view: Projection<f64>,
    narrow: Projection<f32>,
    focal: [f64; 2],
    centre: [f64; 2],
    size: [f64; 2],
}

impl Problem {
    fn new(scanner: &Scanner, axis: Axis) -> Self {
        let Lens { width, height, fx, fy, cx, cy, .. } = scanner.projector;
        let swap = |a: f64, b: f64| if axis == Axis::X { [a, b] } else { [b, a] };
        let view = Projection::new(scanner, axis);
        Self {
            narrow: view.narrow(),
            view,
            focal: swap(fx, fy),
            centre: swap(cx, cy),
            size: swap(width as f64, height as f64),
        }
    }
}

struct RayTile {
    x: [f64; TILE],
    y: [f64; TILE],
    column: [f64; TILE],
    z: [f64; TILE],
    /// dz/dcolumn along the ray, mm per px.
    per_px: [f32; TILE],
}

impl RayTile {
    fn empty() -> Self {
        let nan = [f64::NAN; TILE];
        Self { x: nan, y: nan, column: nan, z: nan, per_px: [f32::NAN; TILE] }
    }
}

/// Depth along each ray, and how fast it changes with the column.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
fn solve(problem: &Problem, tile: &mut RayTile) {
    plain_solve(problem, tile);
}

/// The body of [`solve`], and its fallback.
#[inline(always)]
fn plain_solve(problem: &Problem, tile: &mut RayTile) {
    let Problem { view, narrow, focal, centre, size } = problem;
    let per_focal = 1.0 / focal[0];
    // Loops of one precision each: the compiler makes vectors of their full width. Newton's steps are written out, for
    // it makes vectors of a loop only where that holds no other.
    let (mut x, mut y, mut aims, mut start) = ([0f32; TILE], [0f32; TILE], [0f32; TILE], [0f32; TILE]);
    for i in 0..TILE {
        (x[i], y[i]) = (tile.x[i] as f32, tile.y[i] as f32);
        aims[i] = ((tile.column[i] - centre[0]) * per_focal) as f32;
    }
    for i in 0..TILE {
        let (q, aim) = (narrow.turn(x[i], y[i]), aims[i]);
        let mut s = narrow.plane(&q, aim);
        s -= narrow.look(&q, aim, s).step();
        s -= narrow.look(&q, aim, s).step();
        start[i] = s;
    }
    for i in 0..TILE {
        let q = view.turn(tile.x[i], tile.y[i]);
        let column = tile.column[i];
        let aim = (column - centre[0]) * per_focal;
        let mut s = f64::from(start[i]);
        s -= view.look(&q, aim, s).step();
        let look = view.look(&q, aim, s);
        s -= look.step();
        let other = focal[1] * look.across + centre[1];
        let good = (look.miss.abs() < CLOSE)
            & (s > 0.0)
            & (look.depth > 0.0)
            & (column >= -0.5)
            & (column <= size[0] - 0.5)
            & (other >= -0.5)
            & (other <= size[1] - 0.5);
        let z = 1.0 / s;
        tile.z[i] = if good { z } else { f64::NAN };
        // dz/dcolumn = -z² / (focal dmiss/ds); the rest is the length of (x, y, 1).
        tile.per_px[i] = (z * z / (focal[0] * look.slope)) as f32;
    }
    for i in 0..TILE {
        let length = (x[i] * x[i] + y[i] * y[i] + 1.0).sqrt();
        tile.per_px[i] = tile.per_px[i].abs() * length;
    }
}

/// The point on each camera ray that the projector lights with this column (row for [`Axis::Y`]). Pixels without a
/// column have no point, nor have those whose point would lie behind either device or outside the projector's image.
///
/// # Errors
/// [`Error::Shape`] where the arrays do not have the camera's size.
pub fn triangulate(column_px: &[f64], scanner: &Scanner, sigma_px: Option<&[f32]>, axis: Axis) -> Result<Cloud> {
    let Lens { width, height, .. } = scanner.camera;
    let n = width * height;
    let lengths = [("column", Some(column_px.len())), ("sigma_px", sigma_px.map(<[f32]>::len))];
    for (what, got) in lengths {
        if let Some(got) = got.filter(|&got| got != n) {
            let expected = format!("{n} pixels, the camera's {width} x {height}");
            return Err(Error::Shape { what, expected, got: got.to_string() });
        }
    }
    require(n, 28);
    let problem = Problem::new(scanner, axis);
    let rays = scanner.camera_rays();
    let mut points_mm = room::<[f64; 3]>(n);
    let mut sigma_mm = room::<f32>(sigma_px.map_or(0, <[f32]>::len));
    threads::install(|| match sigma_px {
        Some(sigma_px) => {
            let out = points_mm.par_chunks_mut(CHUNK).inspect(polled).zip(sigma_mm.par_chunks_mut(CHUNK)).enumerate();
            out.for_each(|(i, (p, s))| chunk(&problem, &rays, column_px, sigma_px, i * CHUNK, p, s));
        }
        None => {
            let out = points_mm.par_chunks_mut(CHUNK).inspect(polled).enumerate();
            out.for_each(|(i, p)| chunk(&problem, &rays, column_px, &[], i * CHUNK, p, &mut []));
        }
    });
    // SAFETY: the chunks cover the image, and `chunk` writes every place of its own.
    let (points_mm, sigma_mm) = unsafe { (filled(points_mm), filled(sigma_mm)) };
    Ok(Cloud { width, height, points_mm, sigma_mm })
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
fn place(tile: &RayTile, points: &mut [MaybeUninit<[f64; 3]>]) {
    for ((point, z), (x, y)) in points.iter_mut().zip(&tile.z).zip(tile.x.iter().zip(&tile.y)) {
        *point = MaybeUninit::new([x * z, y * z, *z]);
    }
}

/// Writes every point of a chunk, and every sigma where there are any.
fn chunk(
    problem: &Problem,
    rays: &Rays,
    column: &[f64],
    sigma_px: &[f32],
    start: usize,
    points: &mut [MaybeUninit<[f64; 3]>],
    sigma_mm: &mut [MaybeUninit<f32>],
) {
    let mut tile = RayTile::empty();
    for (i, points) in points.chunks_mut(TILE).enumerate() {
        let at = start + i * TILE;
        for (to, from) in [(&mut tile.x, &rays.x[..]), (&mut tile.y, &rays.y), (&mut tile.column, column)] {
            let from = from.get(at..at + points.len()).unwrap_or_default();
            to.iter_mut().zip(from).for_each(|(t, f)| *t = *f);
        }
        solve(problem, &mut tile);
        place(&tile, points);
        if let (Some(out), Some(sigma_px)) = (sigma_mm.chunks_mut(TILE).nth(i), sigma_px.get(at..)) {
            let mut sigma = [f32::NAN; TILE];
            for (((sigma, px), per_px), z) in sigma.iter_mut().zip(sigma_px).zip(&tile.per_px).zip(&tile.z) {
                *sigma = if z.is_nan() { f32::NAN } else { px * per_px };
            }
            fill(out, &sigma);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ground::transform::Vec3;
    use crate::scanner::lens::tests::example;

    /// A wavy wall that fills the view, as depth along the ray.
    fn depth(u: usize, v: usize) -> f64 {
        420.0 + 20.0 * (u as f64 / 40.0).sin() + 0.1 * v as f64
    }

    /// Columns (or rows) of the wall by projecting it.
    fn scene(scanner: &Scanner, axis: Axis) -> (Vec<f64>, Vec<Option<Vec3>>) {
        let rays = scanner.camera_rays();
        let pose = scanner.camera_from_projector.inverse();
        let point = |i: usize| {
            let p = Vec3::new(rays.x[i], rays.y[i], 1.0) * depth(i % 320, i / 320);
            let (u, v) = scanner.projector.project(&pose.apply(&p))?;
            scanner.projector.contains(u, v).then_some((if axis == Axis::X { u } else { v }, p))
        };
        (0..320 * 240).map(|i| point(i).map_or((f64::NAN, None), |(c, p)| (c, Some(p)))).unzip()
    }

    #[test]
    fn points_come_back_with_both_lenses() {
        // Fringes along y need a baseline along y, too.
        let mut scanner = example();
        scanner.camera_from_projector.translation.y = 90.0;
        for axis in [Axis::X, Axis::Y] {
            let (column, truth) = scene(&scanner, axis);
            let cloud = triangulate(&column, &scanner, None, axis).unwrap();
            let mut seen = 0;
            for (p, t) in cloud.points_mm.iter().zip(&truth) {
                if let Some(t) = t {
                    seen += 1;
                    assert!((Vec3::from(*p) - t).norm() < 1e-8, "{axis:?}: {p:?} {t:?}");
                } else {
                    assert!(p[2].is_nan());
                }
            }
            assert!(seen > 20_000, "{axis:?}: {seen}");
        }
    }

    #[test]
    fn sigma_is_the_difference_quotient() {
        let scanner = example();
        let (column, _) = scene(&scanner, Axis::X);
        let h = 1e-4;
        let moved: Vec<f64> = column.iter().map(|c| c + h).collect();
        let sigma = vec![0.05f32; column.len()];
        let a = triangulate(&column, &scanner, Some(&sigma), Axis::X).unwrap();
        let b = triangulate(&moved, &scanner, None, Axis::X).unwrap();
        let mut seen = 0;
        for ((p, q), s) in a.points_mm.iter().zip(&b.points_mm).zip(&a.sigma_mm) {
            let expected = 0.05 * (Vec3::from(*p) - Vec3::from(*q)).norm() / h;
            if expected.is_finite() {
                seen += 1;
                assert!((f64::from(*s) - expected).abs() < 1e-3 * expected, "{s} {expected}");
            }
        }
        assert!(seen > 20_000);
    }

    #[test]
    fn behind_or_beside_is_no_point() {
        let scanner = example();
        for column in [f64::NAN, f64::INFINITY, -1.0, 912.0, 1e300] {
            let cloud = triangulate(&vec![column; 320 * 240], &scanner, None, Axis::X).unwrap();
            assert!(cloud.points_mm.iter().all(|p| p[2].is_nan()), "{column}");
        }
        assert!(matches!(triangulate(&[1.0], &scanner, None, Axis::X), Err(Error::Shape { .. })));
    }

    #[test]
    fn vectors_and_the_plain_fallback_give_the_same_bits() {
        let scanner = example();
        let (column, _) = scene(&scanner, Axis::X);
        let (problem, rays) = (Problem::new(&scanner, Axis::X), scanner.camera_rays());
        let start = 100 * 320 + 64;
        let of = |v: &[f64]| -> [f64; TILE] { v[start..start + TILE].try_into().unwrap() };
        let tile = || RayTile { x: of(&rays.x), y: of(&rays.y), column: of(&column), ..RayTile::empty() };
        let (mut fast, mut plain) = (tile(), tile());
        solve(&problem, &mut fast);
        plain_solve(&problem, &mut plain);
        assert_eq!(fast.z.map(f64::to_bits), plain.z.map(f64::to_bits));
        assert_eq!(fast.per_px.map(f32::to_bits), plain.per_px.map(f32::to_bits));
        assert!(fast.z.iter().any(|z| z.is_finite()));
    }

    #[test]
    fn the_same_bits_on_any_number_of_threads() {
        let scanner = example();
        let (column, _) = scene(&scanner, Axis::X);
        let run = || triangulate(&column, &scanner, None, Axis::X).unwrap().points_mm;
        let bits = |points: Vec<[f64; 3]>| points.into_iter().flatten().map(f64::to_bits).collect::<Vec<_>>();
        crate::ground::threads::set_threads(Some(1)).unwrap();
        let one = bits(run());
        crate::ground::threads::set_threads(Some(3)).unwrap();
        assert_eq!(one, bits(run()));
        crate::ground::threads::set_threads(None).unwrap();
    }
}
