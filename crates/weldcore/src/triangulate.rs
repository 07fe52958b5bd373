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

use crate::error::{Error, Result};
use crate::memory::{fill, filled, require, room};
use crate::scanner::{Lens, Rays, Scanner};
use crate::stop::polled;
use crate::threads::{self, CHUNK};

/// Pixels that the kernel takes at a time.
const TILE: usize = 128;
/// Where the last step of Newton starts from a larger miss than this (normalised coordinates), the ray does not meet the
/// column. What is left after it is of the order of the square.
const CLOSE: f64 = 1e-7;

/// Which way the fringes run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Axis {
    /// Along x: the phase gives the projector's column.
    X,
    /// Along y: the phase gives the projector's row.
    Y,
}

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
struct View<T> {
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

impl View<f64> {
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

    fn narrow(&self) -> View<f32> {
        View {
            rotation: self.rotation.map(|row| row.map(|v| v as f32)),
            translation: self.translation.map(|v| v as f32),
            k: self.k.map(|v| v as f32),
            p: self.p.map(|v| v as f32),
        }
    }
}

impl<T: Real> View<T> {
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
        let View { translation: t, k, p, .. } = self;
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
    view: View<f64>,
    narrow: View<f32>,
    focal: [f64; 2],
    centre: [f64; 2],
    size: [f64; 2],
}

impl Problem {
    fn new(scanner: &Scanner, axis: Axis) -> Self {
        let Lens { width, height, fx, fy, cx, cy, .. } = scanner.projector;
        let swap = |a: f64, b: f64| if axis == Axis::X { [a, b] } else { [b, a] };
        let view = View::new(scanner, axis);
        Self {
            narrow: view.narrow(),
            view,
            focal: swap(fx, fy),
            centre: swap(cx, cy),
            size: swap(width as f64, height as f64),
        }
    }
}

struct Tile {
    x: [f64; TILE],
    y: [f64; TILE],
    column: [f64; TILE],
    z: [f64; TILE],
    /// dz/dcolumn along the ray, mm per px.
    per_px: [f32; TILE],
}

impl Tile {
    fn empty() -> Self {
        let nan = [f64::NAN; TILE];
        Self { x: nan, y: nan, column: nan, z: nan, per_px: [f32::NAN; TILE] }
    }
}

/// Depth along each ray, and how fast it changes with the column.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
fn solve(problem: &Problem, tile: &mut Tile) {
    plain_solve(problem, tile);
}

/// The body of [`solve`], and its fallback.
#[inline(always)]
fn plain_solve(problem: &Problem, tile: &mut Tile) {
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
fn place(tile: &Tile, points: &mut [MaybeUninit<[f64; 3]>]) {
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
    let mut tile = Tile::empty();
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

/// The paper's geometry (Fig. 1): camera and projector at the same distance from a reference plane that is parallel to
/// the line between them, and fringes of constant pitch on that plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReferenceGeometry {
    /// From the camera to the projector, mm; positive where the phase grows in that direction.
    pub baseline_mm: f64,
    /// Both devices' distance from the plane, mm.
    pub distance_mm: f64,
    /// Pitch of the fringes on the plane, mm.
    pub period_mm: f64,
}

/// 1/height = a + b/dphi, per pixel, with dphi = reference phase - phase (the paper's Eq. 1).
#[derive(Debug, Clone)]
pub struct ReferencePlane {
    /// 1/mm. In the paper's geometry 1/distance.
    pub a: Vec<f64>,
    /// rad/mm. In the paper's geometry 2π baseline/(distance period).
    pub b: Vec<f64>,
    /// Root mean square error of the calibration heights, mm.
    pub rms_mm: Vec<f32>,
}

fn same_size(what: &'static str, expected: usize, got: usize) -> Result<()> {
    if expected == got {
        Ok(())
    } else {
        Err(Error::Shape { what, expected: format!("{expected} pixels"), got: got.to_string() })
    }
}

/// Height over the reference plane, towards the scanner, mm: dphi = phi_A - phi_C (the paper's Eq. 1) is the distance
/// CA = dphi period/2π on the plane, and the similar triangles PID ~ CAD (Fig. 1) give
/// height = distance CA/(baseline + CA).
///
/// # Errors
/// [`Error::Shape`] for phases of different sizes, [`Error::OutOfRange`] for a geometry that is none.
pub fn height_from_reference(phase: &[f64], reference: &[f64], geometry: &ReferenceGeometry) -> Result<Vec<f64>> {
    same_size("reference_phase", phase.len(), reference.len())?;
    crate::error::require_positive("distance_mm", geometry.distance_mm)?;
    crate::error::require_positive("period_mm", geometry.period_mm)?;
    crate::error::require_positive("baseline_mm (its size)", geometry.baseline_mm.abs())?;
    let height = |(phase, reference): (&f64, &f64)| {
        let along = (reference - phase) * geometry.period_mm / std::f64::consts::TAU;
        geometry.distance_mm * along / (geometry.baseline_mm + along)
    };
    require(phase.len(), 8);
    Ok(phase.iter().zip(reference).map(height).collect())
}

/// Height over the reference plane by a calibration of every pixel, mm: 1/(a + b/dphi); zero where dphi is zero.
///
/// # Errors
/// [`Error::Shape`] for arrays of different sizes.
pub fn height_from_calibration(phase: &[f64], reference: &[f64], plane: &ReferencePlane) -> Result<Vec<f64>> {
    same_size("reference_phase", phase.len(), reference.len())?;
    same_size("calibration", phase.len(), plane.a.len().min(plane.b.len()))?;
    let coefficients = plane.a.iter().zip(&plane.b);
    let height = |((phase, reference), (a, b)): ((&f64, &f64), (&f64, &f64))| {
        let along = reference - phase;
        along / (a * along + b)
    };
    require(phase.len(), 8);
    Ok(phase.iter().zip(reference).zip(coefficients).map(height).collect())
}

/// Fits 1/height = a + b/dphi to planes at known heights over the reference, in every pixel. Minimised is the error in
/// height (to first order): the sum of (height² (a + b/dphi) - height)². Two planes determine a pixel; planes that are
/// NaN there are left out, and with fewer than two it stays NaN.
///
/// # Errors
/// [`Error::TooFew`] below two planes, [`Error::Shape`] for arrays of different sizes, [`Error::OutOfRange`] for a height
/// that is zero or not finite, [`Error::Degenerate`] where all heights are equal.
pub fn calibrate_reference_plane(reference: &[f64], phases: &[&[f64]], heights_mm: &[f64]) -> Result<ReferencePlane> {
    crate::error::require_count("planes", 2, phases.len())?;
    same_size("heights_mm", phases.len(), heights_mm.len())?;
    for phase in phases {
        same_size("phases", reference.len(), phase.len())?;
    }
    if let Some(h) = heights_mm.iter().find(|h| !h.is_finite() || **h == 0.0) {
        let expected = "finite and not 0 (the reference itself is height 0)".into();
        return Err(Error::OutOfRange { what: "heights_mm", expected, value: h.to_string() });
    }
    if heights_mm.iter().all(|h| Some(h) == heights_mm.first()) {
        let reason = "all planes are at one height: two unknowns need two heights".into();
        return Err(Error::Degenerate { what: "calibrate_reference_plane", reason });
    }
    let fit = |i: usize| -> (f64, f64, f32) {
        let rows = || {
            phases.iter().zip(heights_mm).filter_map(move |(phase, &h)| {
                let along = reference.get(i)? - phase.get(i)?;
                (along.is_finite() && along != 0.0).then_some((h * h, h * h / along, h))
            })
        };
        // Two columns, made orthogonal: no squares of a bad condition.
        let dot = |f: &dyn Fn((f64, f64, f64)) -> f64| rows().map(f).sum::<f64>();
        let (pp, pq) = (dot(&|(p, _, _)| p * p), dot(&|(p, q, _)| p * q));
        let share = pq / pp;
        let rest = |p: f64, q: f64| q - share * p;
        let qq = dot(&|(p, q, _)| rest(p, q) * rest(p, q));
        let b = dot(&|(p, q, h)| rest(p, q) * h) / qq;
        let a = dot(&|(p, q, h)| p * (h - b * q)) / pp;
        let n = rows().count();
        if n < 2 || !(a.is_finite() && b.is_finite()) {
            return (f64::NAN, f64::NAN, f32::NAN);
        }
        let square = dot(&|(p, q, h)| (p * a + q * b - h).powi(2));
        (a, b, (square / n as f64).sqrt() as f32)
    };
    require(reference.len(), 72);
    let fits: Vec<_> = threads::install(|| (0..reference.len()).into_par_iter().with_min_len(CHUNK).map(fit).collect());
    let mut plane = ReferencePlane { a: Vec::new(), b: Vec::new(), rms_mm: Vec::new() };
    for (a, b, rms) in fits {
        plane.a.push(a);
        plane.b.push(b);
        plane.rms_mm.push(rms);
    }
    Ok(plane)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Vec3;
    use crate::scanner::tests::example;

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

    /// The paper's Fig. 1 by intersecting lines: where the projector's ray to D meets the plane, and the camera's.
    fn seen(x: f64, height: f64, g: &ReferenceGeometry) -> (f64, f64) {
        let scale = g.distance_mm / (g.distance_mm - height);
        let (a, c) = (x * scale, g.baseline_mm + (x - g.baseline_mm) * scale);
        let phase = |x: f64| std::f64::consts::TAU * x / g.period_mm;
        (phase(a), phase(c))
    }

    #[test]
    fn similar_triangles_and_their_calibration_give_the_height() {
        for baseline_mm in [150.0, -150.0] {
            let geometry = ReferenceGeometry { baseline_mm, distance_mm: 500.0, period_mm: 4.0 };
            let heights = [-40.0, -3.0, 0.4, 12.0, 90.0];
            let (reference, phase): (Vec<f64>, Vec<f64>) =
                heights.iter().enumerate().map(|(i, h)| seen(30.0 * i as f64 - 50.0, *h, &geometry)).unzip();
            let found = height_from_reference(&phase, &reference, &geometry).unwrap();
            assert!(found.iter().zip(heights).all(|(f, h)| (f - h).abs() < 1e-9), "{found:?}");

            // One pixel, three planes: x on the plane is 20 whatever the height.
            let look = |h: f64| seen(20.0 * (1.0 - h / 500.0), h, &geometry);
            let planes: Vec<[f64; 1]> = [10.0, 25.0, 60.0].iter().map(|h| [look(*h).1]).collect();
            let planes: Vec<&[f64]> = planes.iter().map(|p| p.as_slice()).collect();
            let plane = calibrate_reference_plane(&[look(0.0).0], &planes, &[10.0, 25.0, 60.0]).unwrap();
            assert!((plane.a[0] - 1.0 / 500.0).abs() < 1e-12 && plane.rms_mm[0] < 1e-9);
            let h = height_from_calibration(&[look(33.0).1], &[look(33.0).0], &plane).unwrap();
            assert!((h[0] - 33.0).abs() < 1e-9);
        }
    }

    #[test]
    fn bad_calibrations_are_refused() {
        let p: &[f64] = &[1.0];
        assert!(calibrate_reference_plane(&[0.0], &[p], &[1.0]).is_err());
        assert!(calibrate_reference_plane(&[0.0], &[p, p], &[1.0, 1.0]).is_err());
        assert!(calibrate_reference_plane(&[0.0], &[p, p], &[1.0, 0.0]).is_err());
        assert!(calibrate_reference_plane(&[0.0], &[p, &[]], &[1.0, 2.0]).is_err());
        assert!(calibrate_reference_plane(&[f64::NAN], &[p, p], &[1.0, 2.0]).unwrap().a[0].is_nan());
        let g = ReferenceGeometry { baseline_mm: 0.0, distance_mm: 1.0, period_mm: 1.0 };
        assert!(height_from_reference(p, p, &g).is_err());
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
        let tile = || Tile { x: of(&rays.x), y: of(&rays.y), column: of(&column), ..Tile::empty() };
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
        crate::threads::set_threads(Some(1)).unwrap();
        let one = bits(run());
        crate::threads::set_threads(Some(3)).unwrap();
        assert_eq!(one, bits(run()));
        crate::threads::set_threads(None).unwrap();
    }
}
