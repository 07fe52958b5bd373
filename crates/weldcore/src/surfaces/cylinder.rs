//! The cylinder of least orthogonal distance, free or with a known radius.

use nalgebra::{DMatrix, Matrix3, SMatrix, SVector};

use super::foot::{Foot, direction, finite};
use super::least_squares::{Fit, Local, Moments, NormalEquations, Number, PointNoise, SurfaceModel, minimise};
use super::plane::{complete, tilted, upright};
use crate::error::{Error, Result, require_positive};
use crate::ground::threads;
use crate::ground::transform::Vec3;

const WHAT: &str = "cylinder";

/// A cylinder without ends. The parameters of its covariance: point x, y, z (mm), axis x, y, z (1) and, where it was
/// fitted, the radius (mm). Its rank is 4 or 5: point and axis move across the axis alone.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cylinder {
    /// A point on the axis, mm; of a fit the one nearest to the (weighted) mean of the data.
    pub point_mm: Vec3,
    /// Unit vector along the axis; of a fit its largest component is positive.
    pub axis: Vec3,
    /// Radius, mm.
    pub radius_mm: f64,
}

impl Cylinder {
    /// A cylinder about the line through `point_mm` along `axis`, which may have any length but zero.
    ///
    /// # Errors
    /// [`Error::NonFinite`], [`Error::Degenerate`] for a zero axis, [`Error::OutOfRange`] for a radius that is not above
    /// zero.
    pub fn new(point_mm: [f64; 3], axis: [f64; 3], radius_mm: f64) -> Result<Self> {
        require_positive("radius_mm", radius_mm)?;
        let (point_mm, axis) = (finite("point_mm", point_mm)?, direction("axis", axis)?);
        Ok(Self { point_mm, axis, radius_mm })
    }

    /// The signed distance of a point, mm.
    #[inline(always)]
    pub fn distance(&self, p: &[f64; 3]) -> f64 {
        let (o, a) = (&self.point_mm, &self.axis);
        let (x, y, z) = (p[0] - o.x, p[1] - o.y, p[2] - o.z);
        let along = x * a.x + y * a.y + z * a.z;
        let (x, y, z) = (x - along * a.x, y - along * a.y, z - along * a.z);
        (x * x + y * y + z * z).sqrt() - self.radius_mm
    }

    /// The nearest point of the cylinder; from its axis, where a circle is equally near, one of that.
    #[inline(always)]
    pub fn foot(&self, p: &Vec3) -> Foot {
        let offset = p - self.point_mm;
        let along = self.axis * self.axis.dot(&offset);
        let arm = offset - along;
        let reach = arm.norm();
        let normal = if reach > 0.0 { arm / reach } else { across(&self.axis) };
        Foot { distance: reach - self.radius_mm, point: self.point_mm + along + normal * self.radius_mm, normal }
    }
}

/// Unknowns: shifts and tilts of the axis in two directions across it, and (P = 5) the radius.
#[derive(Clone)]
struct CylinderUnknowns {
    point: [f64; 3],
    /// Two directions across the axis, then the axis, as rows.
    axes: [[f64; 3]; 3],
    radius: f64,
}

impl CylinderUnknowns {
    fn new(point: Vec3, axes: Matrix3<f64>, radius: f64) -> Self {
        let axis = axes.row(2).transpose();
        // The foot of the data's mean: there shift and tilt disturb each other least.
        let foot = point - axis * point.dot(&axis);
        Self { point: foot.into(), axes: std::array::from_fn(|r| std::array::from_fn(|c| axes[(r, c)])), radius }
    }

    fn matrix(&self) -> Matrix3<f64> {
        Matrix3::from_fn(|r, c| self.axes[r][c])
    }

    /// Derivatives by the shifts and the tilts, and the distance.
    #[inline(always)]
    fn across<T: Number>(&self, q: &[T; 3]) -> ([T; 4], T) {
        let d: [T; 3] = std::array::from_fn(|k| q[k] - T::of(self.point[k]));
        let along = |a: usize| {
            let axis = &self.axes[a];
            T::of(axis[0]) * d[0] + T::of(axis[1]) * d[1] + T::of(axis[2]) * d[2]
        };
        let (x, y, t) = (along(0), along(1), along(2));
        let r = (x * x + y * y).sqrt();
        let s = r.pull();
        let (x, y) = (x * s, y * s);
        ([x, y, x * t, y * t], r - T::of(self.radius))
    }

    fn shifted(&self, step: &[f64]) -> Self {
        let axes = self.matrix();
        let at = |k: usize| step.get(k).copied().unwrap_or(0.0);
        let point = Vec3::from(self.point) + (axes.row(0) * at(0) + axes.row(1) * at(1)).transpose();
        let axis = tilted(&axes, at(2), at(3));
        Self::new(point, complete(&axes.row(0).transpose(), &axis), self.radius + at(4))
    }
}

impl SurfaceModel<5> for CylinderUnknowns {
    #[inline(always)]
    fn row<T: Number>(&self, q: &[T; 3]) -> ([T; 5], T) {
        let (j, d) = self.across(q);
        ([j[0], j[1], j[2], j[3], T::of(-1.0)], d)
    }

    fn moved(&self, step: &SVector<f64, 5>) -> Self {
        self.shifted(step.as_slice())
    }
}

impl SurfaceModel<4> for CylinderUnknowns {
    #[inline(always)]
    fn row<T: Number>(&self, q: &[T; 3]) -> ([T; 4], T) {
        self.across(q)
    }

    fn moved(&self, step: &SVector<f64, 4>) -> Self {
        self.shifted(step.as_slice())
    }
}

/// Minimises `Σ w·d²`, d the distance from the cylinder, over the axis and, unless `radius_mm` is given, the radius.
///
/// The start is searched for: directions all over the hemisphere, a circle in the projection along each, the best of
/// them refined on a sample of the points. At least 5 points (4 with a given radius).
///
/// # Errors
/// Not finite, too few, a radius or weights out of range; [`Error::Degenerate`] for points that are all equal,
/// collinear or coplanar, or too flat for their noise.
pub fn fit(points: &[[f64; 3]], radius_mm: Option<f64>, noise: PointNoise) -> Result<Fit<Cylinder>> {
    let counted = noise.check(points, if radius_mm.is_some() { 4 } else { 5 })?;
    if let Some(radius) = radius_mm {
        require_positive("radius_mm", radius)?;
    }
    let local = Local::of(WHAT, points, &noise)?;
    let moments = Moments::of(points, local, &noise);
    if moments.collinear {
        return Err(Error::Degenerate { what: WHAT, reason: "the points lie on a line".into() });
    }
    if moments.coplanar {
        return Err(Error::Degenerate { what: WHAT, reason: "the points lie in a plane".into() });
    }
    let radius = radius_mm.map(|r| r / local.scale);
    let mut last = Error::Degenerate { what: WHAT, reason: "no direction gives a circle".into() };
    for start in starts(points, radius, local, &noise, &moments) {
        match fit_in(start, points, counted, radius_mm, local, noise) {
            Ok(found) => return Ok(found),
            Err(error) => last = error,
        }
    }
    Err(last)
}

/// The same from a start that is near already.
///
/// # Errors
/// As [`fit`]; also an axis that is not a direction.
pub fn refine(points: &[[f64; 3]], start: Cylinder, free_radius: bool, noise: PointNoise) -> Result<Fit<Cylinder>> {
    let counted = noise.check(points, if free_radius { 5 } else { 4 })?;
    require_positive("radius_mm", start.radius_mm)?;
    let local = Local::of(WHAT, points, &noise)?;
    let Some(axis) = start.axis.try_normalize(1e-150).filter(|a| a.iter().all(|v| v.is_finite())) else {
        let (expected, value) = ("a direction".into(), format!("{:?}", start.axis.as_slice()));
        return Err(Error::OutOfRange { what: "axis", expected, value });
    };
    let point = (start.point_mm - local.origin) / local.scale;
    let unknown = CylinderUnknowns::new(point, any_frame(&axis), start.radius_mm / local.scale);
    let radius_mm = if free_radius { None } else { Some(start.radius_mm) };
    fit_in(unknown, points, counted, radius_mm, local, noise)
}

fn fit_in(
    start: CylinderUnknowns,
    points: &[[f64; 3]],
    counted: usize,
    radius_mm: Option<f64>,
    local: Local,
    noise: PointNoise,
) -> Result<Fit<Cylinder>> {
    // Rows of the Jacobian: point, axis, radius by shifts, tilts, radius; the local scale belongs to lengths.
    let jacobian = |found: &CylinderUnknowns| {
        let [u, v] = [found.axes[0], found.axes[1]].map(Vec3::from);
        let mut j = SMatrix::<f64, 7, 5>::zeros();
        j.fixed_view_mut::<3, 1>(0, 0).copy_from(&(u * local.scale));
        j.fixed_view_mut::<3, 1>(0, 1).copy_from(&(v * local.scale));
        j.fixed_view_mut::<3, 1>(3, 2).copy_from(&u);
        j.fixed_view_mut::<3, 1>(3, 3).copy_from(&v);
        j[(6, 4)] = local.scale;
        j
    };
    let (found, rms, covariance, iterations) = if radius_mm.is_some() {
        let (found, normal, iterations): (_, NormalEquations<4>, _) = minimise(WHAT, start, points, local, &noise)?;
        let unknowns = normal.inverse() * normal.variance(counted, &noise, local);
        let j = jacobian(&found).fixed_view::<6, 4>(0, 0).into_owned();
        let covariance = j * unknowns * j.transpose();
        (found, normal.rms(), DMatrix::from_fn(6, 6, |a, b| covariance[(a, b)]), iterations)
    } else {
        let (found, normal, iterations): (_, NormalEquations<5>, _) = minimise(WHAT, start, points, local, &noise)?;
        let unknowns = normal.inverse() * normal.variance(counted, &noise, local);
        let j = jacobian(&found);
        let covariance = j * unknowns * j.transpose();
        (found, normal.rms(), DMatrix::from_fn(7, 7, |a, b| covariance[(a, b)]), iterations)
    };
    if !(found.radius > 0.0 && found.radius < 1e7) {
        return Err(Error::Degenerate { what: WHAT, reason: "the points lie in a plane".into() });
    }
    Ok(Fit {
        surface: Cylinder {
            point_mm: local.to_world(&found.point.into()),
            axis: upright(Vec3::from(found.axes[2])),
            radius_mm: radius_mm.unwrap_or(found.radius * local.scale),
        },
        rms_mm: rms * local.scale,
        covariance,
        iterations,
    })
}

/// A unit vector square to `axis`.
fn across(axis: &Vec3) -> Vec3 {
    axis.cross(&Vec3::ith(axis.iamin(), 1.0)).normalize()
}

/// A frame with the given third row.
fn any_frame(axis: &Vec3) -> Matrix3<f64> {
    complete(&if axis.x.abs() < 0.7 { Vec3::x() } else { Vec3::y() }, axis)
}

/// Directions over a hemisphere, evenly (a Fibonacci spiral).
pub(super) fn directions(count: usize) -> impl Iterator<Item = Vec3> {
    let golden = std::f64::consts::PI * (3.0 - 5.0_f64.sqrt());
    (0..count).map(move |i| {
        let z = 1.0 - (i as f64 + 0.5) / count as f64;
        let (r, angle) = ((1.0 - z * z).sqrt(), golden * i as f64);
        Vec3::new(r * angle.cos(), r * angle.sin(), z)
    })
}

/// Directions tried: 5° apart, well inside the valley around the true one.
const DIRECTIONS: usize = 800;
/// Points that judge a direction.
const JUDGES: usize = 300;
/// Points on which the best directions are refined.
const SAMPLE: usize = 3000;
/// Directions refined.
const REFINED: usize = 16;

/// Starts, best first: already minimised on a sample of the points.
fn starts(
    points: &[[f64; 3]],
    radius: Option<f64>,
    local: Local,
    noise: &PointNoise,
    moments: &Moments,
) -> Vec<CylinderUnknowns> {
    let pick = |most: usize| -> Vec<[f64; 3]> {
        let counted: Vec<usize> = (0..points.len()).filter(|&i| noise.weight(i) > 0.0).collect();
        let step = counted.len().div_ceil(most).max(1);
        counted.iter().step_by(step).filter_map(|&i| points.get(i)).map(|p| local.to_local(p)).collect()
    };
    let (judges, sample) = (pick(JUDGES), pick(SAMPLE));
    // A slender cloud has a valley as narrow as itself: the same directions again as its whitened points see them.
    let spread = moments.variances.map(|v| v.max(1e-8 * moments.variances[2]).sqrt());
    let stretched = |d: Vec3| (moments.axes * spread.component_mul(&d)).normalize();
    let whitened = |d: &Vec3| moments.axes.tr_mul(d).component_div(&spread).normalize();
    let tried: Vec<Vec3> = (moments.axes.column_iter().map(Into::into))
        .chain(directions(DIRECTIONS))
        .chain(directions(DIRECTIONS).map(stretched))
        .collect();
    let judged = threads::map_each(&tried, |axis| circle(&judges, any_frame(axis), radius));
    let mut order: Vec<(f64, CylinderUnknowns)> = judged.into_iter().flatten().collect();
    order.sort_by(|a, b| a.0.total_cmp(&b.0));
    // Neighbours of a good direction lead to the same valley.
    let mut kept: Vec<CylinderUnknowns> = Vec::new();
    for (_, candidate) in order {
        let axis = Vec3::from(candidate.axes[2]);
        let alike = |k: &CylinderUnknowns| {
            let other = Vec3::from(k.axes[2]);
            other.dot(&axis).abs() > 0.97 && whitened(&other).dot(&whitened(&axis)).abs() > 0.97
        };
        if kept.len() < REFINED && !kept.iter().any(alike) {
            kept.push(candidate);
        }
    }
    let unit = Local::new(Vec3::zeros(), 1.0);
    let refined = threads::map_each(&kept, |start| {
        let all = PointNoise::default();
        if radius.is_some() {
            minimise::<4, _>(WHAT, start.clone(), &sample, unit, &all).map(|(m, n, _)| (n.cost, m))
        } else {
            minimise::<5, _>(WHAT, start.clone(), &sample, unit, &all).map(|(m, n, _)| (n.cost, m))
        }
    });
    let mut good: Vec<(f64, CylinderUnknowns)> =
        refined.into_iter().flatten().filter(|(_, m)| m.radius > 0.0 && m.radius < 1e7).collect();
    good.sort_by(|a, b| a.0.total_cmp(&b.0));
    good.into_iter().map(|g| g.1).chain(kept).collect()
}

/// The algebraic circle of the points seen along the third axis, and the squared distances it leaves.
fn circle(points: &[[f64; 3]], axes: Matrix3<f64>, radius: Option<f64>) -> Option<(f64, CylinderUnknowns)> {
    let flat = || points.iter().map(|q| axes * Vec3::from(*q)).map(|v| (v[0], v[1]));
    let (mut matrix, mut right) = (Matrix3::zeros(), Vec3::zeros());
    for (x, y) in flat() {
        let row = Vec3::new(x, y, 1.0);
        matrix += row * row.transpose();
        right += row * (x * x + y * y);
    }
    let c = matrix.cholesky()?.solve(&right);
    let (cx, cy) = (c[0] / 2.0, c[1] / 2.0);
    let free = (c[2] + cx * cx + cy * cy).max(0.0).sqrt();
    // A known radius moves the centre along the line to the middle of the arc.
    let n = points.len() as f64;
    let (mx, my) = flat().fold((0.0, 0.0), |m, (x, y)| (m.0 + x / n, m.1 + y / n));
    let (tx, ty) = (cx - mx, cy - my);
    let reach = tx.hypot(ty);
    let shift = radius.map_or(0.0, |r| if reach > 0.1 * free { (r - free) / reach } else { 0.0 });
    let (cx, cy, r) = (cx + tx * shift, cy + ty * shift, radius.unwrap_or(free));
    let cost: f64 = flat().map(|(x, y)| ((x - cx).hypot(y - cy) - r).powi(2)).sum();
    let point = axes.transpose() * Vec3::new(cx, cy, 0.0);
    cost.is_finite().then(|| (cost, CylinderUnknowns::new(point, axes, r)))
}

/// The cylinder along `axis` whose circle goes through three points; with a known radius, the circle of that radius
/// through the first two on the side of the third. `None` where there is none.
pub(super) fn through(points: &[[f64; 3]; 3], axis: &Vec3, radius: Option<f64>) -> Option<Cylinder> {
    let axes = any_frame(axis);
    let [a, b, c] = points.map(|p| axes * Vec3::from(p)).map(|v| (v[0], v[1]));
    let (bx, by, cx, cy) = (b.0 - a.0, b.1 - a.1, c.0 - a.0, c.1 - a.1);
    let cross = 2.0 * (bx * cy - by * cx);
    let (b2, c2) = (bx * bx + by * by, cx * cx + cy * cy);
    let (mut x, mut y) = ((cy * b2 - by * c2) / cross, (bx * c2 - cx * b2) / cross);
    let mut r = x.hypot(y);
    if let Some(known) = radius {
        // From the middle of the chord towards the circumcentre, as far as the radius asks.
        let height = (known * known - b2 / 4.0).sqrt() / b2.sqrt();
        let side = if (x - bx / 2.0) * -by + (y - by / 2.0) * bx < 0.0 { -1.0 } else { 1.0 };
        (x, y, r) = (bx / 2.0 - side * height * by, by / 2.0 + side * height * bx, known);
    }
    let point = axes.transpose() * Vec3::new(a.0 + x, a.1 + y, 0.0);
    let there = r > 0.0 && point.iter().chain([&r]).all(|v| v.is_finite());
    there.then_some(Cylinder { point_mm: point, axis: *axis, radius_mm: r })
}
