//! The sphere of least orthogonal distance, free or with a known radius; and the paper's sphere through four points.

use nalgebra::{DMatrix, Matrix4, SVector, Vector4};

use super::{Fit, Local, Model, Moments, Noise, Normal, minimise, rounding};
use crate::Vec3;
use crate::error::{Error, Result, require_finite, require_positive};

const WHAT: &str = "sphere";

/// A sphere. The parameters of its covariance: centre x, y, z and, where it was fitted, the radius; mm².
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sphere {
    /// Centre, mm.
    pub center_mm: Vec3,
    /// Radius, mm.
    pub radius_mm: f64,
}

impl Sphere {
    /// Signed distance of a point from the surface, positive outside, mm.
    pub fn distance(&self, p: &[f64; 3]) -> f64 {
        (Vec3::from(*p) - self.center_mm).norm() - self.radius_mm
    }
}

/// Centre and radius unknown (P = 4), or the centre alone (P = 3).
#[derive(Clone)]
struct Unknown {
    center: [f64; 3],
    radius: f64,
}

#[inline]
fn direction(center: &[f64; 3], q: &[f64; 3]) -> ([f64; 3], f64) {
    let d: [f64; 3] = std::array::from_fn(|k| q[k] - center[k]);
    let r = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
    // A point in the centre has no direction; it pulls nowhere.
    let s = if r > 0.0 { -1.0 / r } else { 0.0 };
    (d.map(|v| v * s), r)
}

impl Model<4> for Unknown {
    #[inline]
    fn row(&self, q: &[f64; 3]) -> ([f64; 4], f64) {
        let (n, r) = direction(&self.center, q);
        ([n[0], n[1], n[2], -1.0], r - self.radius)
    }

    fn moved(&self, step: &SVector<f64, 4>) -> Self {
        Self { center: std::array::from_fn(|k| self.center[k] + step[k]), radius: self.radius + step[3] }
    }
}

impl Model<3> for Unknown {
    #[inline]
    fn row(&self, q: &[f64; 3]) -> ([f64; 3], f64) {
        let (n, r) = direction(&self.center, q);
        (n, r - self.radius)
    }

    fn moved(&self, step: &SVector<f64, 3>) -> Self {
        Self { center: std::array::from_fn(|k| self.center[k] + step[k]), radius: self.radius }
    }
}

/// Minimises `Σ w·(|p - c| - R)²` over the centre and, unless `radius_mm` is given, the radius.
///
/// At least 4 points (3 with a given radius). With a given radius and points that do not tell the side (a flat patch),
/// the side of the less squared distance is taken.
///
/// # Errors
/// Not finite, too few, a radius or weights out of range; [`Error::Degenerate`] for points that are all equal, collinear
/// or coplanar (free radius), or too flat for their noise.
pub fn fit(points: &[[f64; 3]], radius_mm: Option<f64>, noise: Noise) -> Result<Fit<Sphere>> {
    let counted = noise.check(points, if radius_mm.is_some() { 3 } else { 4 })?;
    if let Some(radius) = radius_mm {
        require_positive("radius_mm", radius)?;
    }
    let local = Local::of(WHAT, points, &noise)?;
    let start = start(points, radius_mm.map(|r| r / local.scale), local, &noise)?;
    fit_in(start, points, counted, radius_mm, local, noise)
}

/// The same from a start that is near already: no search, any finite centre will do.
///
/// # Errors
/// As [`fit`].
pub fn refine(points: &[[f64; 3]], start: Sphere, free_radius: bool, noise: Noise) -> Result<Fit<Sphere>> {
    let counted = noise.check(points, if free_radius { 4 } else { 3 })?;
    require_positive("radius_mm", start.radius_mm)?;
    let local = Local::of(WHAT, points, &noise)?;
    let center: [f64; 3] = ((start.center_mm - local.origin) / local.scale).into();
    let unknown = Unknown { center, radius: start.radius_mm / local.scale };
    let radius_mm = if free_radius { None } else { Some(start.radius_mm) };
    fit_in(unknown, points, counted, radius_mm, local, noise)
}

fn fit_in(
    start: Unknown,
    points: &[[f64; 3]],
    counted: usize,
    radius_mm: Option<f64>,
    local: Local,
    noise: Noise,
) -> Result<Fit<Sphere>> {
    let (found, rms, covariance, iterations) = if radius_mm.is_some() {
        let (found, normal, iterations): (_, Normal<3>, _) = minimise(WHAT, start, points, local, &noise)?;
        let covariance = normal.inverse() * normal.variance(counted, &noise, local);
        (found, normal.rms(), DMatrix::from_fn(3, 3, |a, b| covariance[(a, b)]), iterations)
    } else {
        let (found, normal, iterations): (_, Normal<4>, _) = minimise(WHAT, start, points, local, &noise)?;
        let covariance = normal.inverse() * normal.variance(counted, &noise, local);
        (found, normal.rms(), DMatrix::from_fn(4, 4, |a, b| covariance[(a, b)]), iterations)
    };
    // A plane is a sphere without end: past this the sagitta of the data is below their rounding.
    if !(found.radius > 0.0 && found.radius < 1e7) {
        return Err(Error::Degenerate { what: WHAT, reason: "the points lie in a plane".into() });
    }
    Ok(Fit {
        surface: Sphere {
            center_mm: local.to_world(&found.center.into()),
            radius_mm: radius_mm.unwrap_or(found.radius * local.scale),
        },
        rms_mm: rms * local.scale,
        covariance: covariance * (local.scale * local.scale),
        iterations,
    })
}

/// Coope's linear sphere `2 c·q + (R² - c²) = q²`; with a known radius also its two mirror places on the normal of the
/// best plane, whichever leaves the least squares.
fn start(points: &[[f64; 3]], radius: Option<f64>, local: Local, noise: &Noise) -> Result<Unknown> {
    let moments = Moments::of(points, local, noise);
    // Any sphere through the points of a line turns about it.
    if moments.variances[1] <= rounding(local).powi(2) {
        return Err(Error::Degenerate { what: WHAT, reason: "the points lie on a line".into() });
    }
    let flat = moments.variances[0] <= rounding(local).powi(2);
    let mut candidates = Vec::new();
    if !flat {
        let linear = Linear { axes: moments.axes, mean: moments.mean };
        let normal: Normal<4> = Normal::of(&linear, points, local, noise);
        if let Some(x) = normal.step(0.0) {
            // In principal axes about the mean, so that a short cap costs no digits.
            let center = Vec3::new(x[0], x[1], x[2]) / 2.0;
            let found = (x[3] + center.norm_squared()).max(0.0).sqrt();
            let center = moments.mean + moments.axes * center;
            candidates.push(Unknown { center: center.into(), radius: radius.unwrap_or(found) });
        }
    }
    if let Some(radius) = radius {
        // The mean squared distance from the axis of a cap tells how deep its plane lies.
        let depth = (radius * radius - moments.variances[1] - moments.variances[2]).max(0.0).sqrt();
        for side in [-1.0, 1.0] {
            let center = moments.mean + moments.axes.column(0) * (side * depth);
            candidates.push(Unknown { center: center.into(), radius });
        }
    }
    let cost = |c: &Unknown| Normal::<3>::of(c, points, local, noise).cost;
    if candidates.len() > 1 {
        let costs: Vec<f64> = candidates.iter().map(cost).collect();
        let best = (0..costs.len()).min_by(|&a, &b| costs[a].total_cmp(&costs[b])).unwrap_or(0);
        candidates.swap(0, best);
    }
    let reason = || "the points lie in a plane".into();
    candidates.into_iter().next().ok_or_else(|| Error::Degenerate { what: WHAT, reason: reason() })
}

/// The rows of the linear start: `(q', 1)·x - |q'|²` with q' in principal axes.
#[derive(Clone)]
struct Linear {
    axes: nalgebra::Matrix3<f64>,
    mean: Vec3,
}

impl Model<4> for Linear {
    #[inline]
    fn row(&self, q: &[f64; 3]) -> ([f64; 4], f64) {
        let v = self.axes.tr_mul(&(Vec3::from(*q) - self.mean));
        ([v[0], v[1], v[2], 1.0], -v.norm_squared())
    }

    fn moved(&self, _: &SVector<f64, 4>) -> Self {
        self.clone()
    }
}

/// The sphere through four points, in closed form: `C1 x + C2 y + C3 z + C4 = -(x² + y² + z²)` solved for C, centre
/// `-C/2`, radius `√(C1² + C2² + C3² - 4 C4) / 2`.
///
/// Source: the paper, Eqs. 2-7, with its errata: the matrix has a column of ones, and the right side is negative.
///
/// # Errors
/// Not four points, not finite, or [`Error::Degenerate`] where they lie in a plane.
pub fn through_points(points: &[[f64; 3]]) -> Result<Sphere> {
    if points.len() != 4 {
        let got = format!("{} points", points.len());
        return Err(Error::Shape { what: "points", expected: "exactly 4 points".into(), got });
    }
    require_finite("points", points)?;
    let local = Local::of(WHAT, points, &Noise::default())?;
    let q: Vec<Vec3> = points.iter().map(|p| local.to_local(p).into()).collect();
    let matrix = Matrix4::from_fn(|r, c| if c < 3 { q[r][c] } else { 1.0 });
    let right = Vector4::from_fn(|r, _| -q[r].norm_squared());
    let flat = || Error::Degenerate { what: WHAT, reason: "the four points lie in a plane".into() };
    // Six times the volume of the tetrahedron, whose edges are about 1 here: below this it is rounding.
    let rounding = f64::EPSILON * (1.0 + local.origin.amax() / local.scale);
    if matrix.determinant().abs() < 64.0 * rounding {
        return Err(flat());
    }
    let c = matrix.lu().solve(&right).filter(|c| c.iter().all(|v| v.is_finite())).ok_or_else(flat)?;
    let center = -c.xyz() / 2.0;
    let radius = (c.xyz().norm_squared() - 4.0 * c[3]).max(0.0).sqrt() / 2.0;
    Ok(Sphere { center_mm: local.to_world(&center), radius_mm: radius * local.scale })
}
