//! The sphere of least orthogonal distance, free or with a known radius; and the paper's sphere through four points.

use nalgebra::{DMatrix, Matrix4, SVector, Vector4};

use super::foot::{Foot, finite};
use super::least_squares::{Fit, Local, Moments, NormalEquations, Number, PointNoise, SurfaceModel, minimise};
use crate::error::{Error, Result, require_finite, require_positive};
use crate::ground::transform::Vec3;

const WHAT: &str = "sphere";

/// All points at a distance from the centre. The parameters of its covariance: centre x, y, z and, where it was fitted, the radius; mm².
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sphere {
    /// Centre, mm.
    pub center_mm: Vec3,
    /// Radius, mm.
    pub radius_mm: f64,
}

impl Sphere {
    /// A sphere.
    ///
    /// # Errors
    /// [`Error::NonFinite`], [`Error::OutOfRange`] for a radius that is not above zero.
    pub fn new(center_mm: [f64; 3], radius_mm: f64) -> Result<Self> {
        require_positive("radius_mm", radius_mm)?;
        Ok(Self { center_mm: finite("center_mm", center_mm)?, radius_mm })
    }

    /// The signed distance of a point, mm.
    #[inline(always)]
    pub fn distance(&self, p: &[f64; 3]) -> f64 {
        let (x, y, z) = (p[0] - self.center_mm.x, p[1] - self.center_mm.y, p[2] - self.center_mm.z);
        (x * x + y * y + z * z).sqrt() - self.radius_mm
    }

    /// The nearest point of the sphere; from its centre, where all are equally near, the one in direction x.
    #[inline(always)]
    pub fn foot(&self, p: &Vec3) -> Foot {
        let arm = p - self.center_mm;
        let reach = arm.norm();
        let normal = if reach > 0.0 { arm / reach } else { Vec3::x() };
        Foot { distance: reach - self.radius_mm, point: self.center_mm + normal * self.radius_mm, normal }
    }
}

/// Centre and radius unknown (P = 4), or the centre alone (P = 3).
#[derive(Clone)]
pub(super) struct SphereUnknowns {
    pub(super) center: [f64; 3],
    pub(super) radius: f64,
}

/// Derivative of the distance by the centre, and the distance.
#[inline(always)]
fn pulled<T: Number>(unknown: &SphereUnknowns, q: &[T; 3]) -> ([T; 3], T) {
    let d: [T; 3] = std::array::from_fn(|k| q[k] - T::of(unknown.center[k]));
    let r = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
    let s = r.pull();
    (d.map(|v| v * s), r - T::of(unknown.radius))
}

impl SurfaceModel<4> for SphereUnknowns {
    #[inline(always)]
    fn row<T: Number>(&self, q: &[T; 3]) -> ([T; 4], T) {
        let (n, d) = pulled(self, q);
        ([n[0], n[1], n[2], T::of(-1.0)], d)
    }

    fn moved(&self, step: &SVector<f64, 4>) -> Self {
        Self { center: std::array::from_fn(|k| self.center[k] + step[k]), radius: self.radius + step[3] }
    }
}

impl SurfaceModel<3> for SphereUnknowns {
    #[inline(always)]
    fn row<T: Number>(&self, q: &[T; 3]) -> ([T; 3], T) {
        pulled(self, q)
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
/// Not finite, too few, a radius or weights out of range; [`Error::Degenerate`] for points that are all equal,
/// collinear or coplanar (free radius), or too flat for their noise.
pub fn fit(points: &[[f64; 3]], radius_mm: Option<f64>, noise: PointNoise) -> Result<Fit<Sphere>> {
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
pub fn refine(points: &[[f64; 3]], start: Sphere, free_radius: bool, noise: PointNoise) -> Result<Fit<Sphere>> {
    let counted = noise.check(points, if free_radius { 4 } else { 3 })?;
    require_positive("radius_mm", start.radius_mm)?;
    let local = Local::of(WHAT, points, &noise)?;
    let center: [f64; 3] = ((start.center_mm - local.origin) / local.scale).into();
    let unknown = SphereUnknowns { center, radius: start.radius_mm / local.scale };
    let radius_mm = if free_radius { None } else { Some(start.radius_mm) };
    fit_in(unknown, points, counted, radius_mm, local, noise)
}

fn fit_in(
    start: SphereUnknowns,
    points: &[[f64; 3]],
    counted: usize,
    radius_mm: Option<f64>,
    local: Local,
    noise: PointNoise,
) -> Result<Fit<Sphere>> {
    let (found, rms, covariance, iterations) = if radius_mm.is_some() {
        let (found, normal, iterations): (_, NormalEquations<3>, _) = minimise(WHAT, start, points, local, &noise)?;
        let covariance = normal.inverse() * normal.variance(counted, &noise, local);
        (found, normal.rms(), DMatrix::from_fn(3, 3, |a, b| covariance[(a, b)]), iterations)
    } else {
        let (found, normal, iterations): (_, NormalEquations<4>, _) = minimise(WHAT, start, points, local, &noise)?;
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
fn start(points: &[[f64; 3]], radius: Option<f64>, local: Local, noise: &PointNoise) -> Result<SphereUnknowns> {
    let moments = Moments::of(points, local, noise);
    // Any sphere through the points of a line turns about it.
    if moments.collinear {
        return Err(Error::Degenerate { what: WHAT, reason: "the points lie on a line".into() });
    }
    let mut candidates = Vec::new();
    if !moments.coplanar {
        let linear = Linear { axes: moments.axes, mean: moments.mean };
        let normal: NormalEquations<4> = NormalEquations::of(&linear, points, local, noise);
        if let Some(x) = normal.step(0.0) {
            // In principal axes about the mean, so that a short cap costs no digits.
            let center = Vec3::new(x[0], x[1], x[2]) / 2.0;
            let found = (x[3] + center.norm_squared()).max(0.0).sqrt();
            let center = moments.mean + moments.axes * center;
            candidates.push(SphereUnknowns { center: center.into(), radius: radius.unwrap_or(found) });
        }
    }
    if let Some(radius) = radius {
        // The mean squared distance from the axis of a cap tells how deep its plane lies.
        let depth = (radius * radius - moments.variances[1] - moments.variances[2]).max(0.0).sqrt();
        for side in [-1.0, 1.0] {
            let center = moments.mean + moments.axes.column(0) * (side * depth);
            candidates.push(SphereUnknowns { center: center.into(), radius });
        }
    }
    let cost = |c: &SphereUnknowns| NormalEquations::<3>::of(c, points, local, noise).cost;
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

impl SurfaceModel<4> for Linear {
    #[inline(always)]
    fn row<T: Number>(&self, q: &[T; 3]) -> ([T; 4], T) {
        let d: [T; 3] = std::array::from_fn(|k| q[k] - T::of(self.mean[k]));
        let along = |a: usize| {
            let axis = self.axes.column(a);
            T::of(axis[0]) * d[0] + T::of(axis[1]) * d[1] + T::of(axis[2]) * d[2]
        };
        let v = [along(0), along(1), along(2)];
        ([v[0], v[1], v[2], T::of(1.0)], T::of(-1.0) * (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]))
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
    let local = Local::of(WHAT, points, &PointNoise::default())?;
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

/// The sphere of a known radius through the first three points, on the side of the fourth. `None` where there is none.
pub(super) fn through_three(points: &[[f64; 3]; 4], radius: f64) -> Option<Sphere> {
    let [a, b, c, d] = points.map(Vec3::from);
    let (ab, ac) = (b - a, c - a);
    let normal = ab.cross(&ac);
    let squared = normal.norm_squared();
    // Circumcentre of the triangle, from a; then up or down the normal.
    let foot = (ac * ab.norm_squared() - ab * ac.norm_squared()).cross(&normal) / (2.0 * squared);
    let height = (radius * radius - foot.norm_squared()).sqrt() / squared.sqrt();
    let at = |side: f64| Sphere { center_mm: a + foot + normal * (side * height), radius_mm: radius };
    let (up, down, d) = (at(1.0), at(-1.0), d.into());
    let near = if down.distance(&d).abs() < up.distance(&d).abs() { down } else { up };
    near.center_mm.iter().all(|v| v.is_finite()).then_some(near)
}

/// The sphere through four points, without the care of [`through_points`]. `None` where there is none.
pub(super) fn through_four(points: &[[f64; 3]; 4]) -> Option<Sphere> {
    let [a, b, c, d] = points.map(Vec3::from);
    let (b, c, d) = (b - a, c - a, d - a);
    let volume = b.dot(&c.cross(&d));
    let center = (c.cross(&d) * b.norm_squared() + d.cross(&b) * c.norm_squared() + b.cross(&c) * d.norm_squared())
        / (2.0 * volume);
    center.iter().all(|v| v.is_finite()).then(|| Sphere { center_mm: a + center, radius_mm: center.norm() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_ways_through_four_points_agree() {
        let center = Vec3::new(3.0, -4.0, 5.0);
        let points = [[1.0, 0.2, 0.1], [-0.3, 1.0, 0.4], [0.2, -0.5, -1.0], [-0.6, -0.8, 0.7]]
            .map(|d| (center + Vec3::from(d).normalize() * 2.5).into());
        let careful = through_points(&points).unwrap();
        let quick = through_four(&points).unwrap();
        let known = through_three(&points, 2.5).unwrap();
        let fitted = fit(&points, None, PointNoise::default()).unwrap().surface;
        for sphere in [careful, quick, known, fitted] {
            assert!((sphere.center_mm - center).norm() < 1e-13 && (sphere.radius_mm - 2.5).abs() < 1e-13);
        }
        assert!(through_three(&points, 1.0).is_none());
        let flat = [[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [1.0, 1.0, 1.0]];
        assert!(matches!(through_points(&flat), Err(Error::Degenerate { .. })) && through_four(&flat).is_none());
    }
}
