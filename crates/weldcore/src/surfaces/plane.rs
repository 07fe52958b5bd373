//! The plane of least orthogonal distance.

use nalgebra::{DMatrix, Matrix3, SMatrix, SVector};

use super::foot::{Foot, direction, finite};
use super::least_squares::{Fit, Local, Moments, NormalEquations, Number, PointNoise, SurfaceModel, minimise};
use crate::error::{Error, Result};
use crate::ground::transform::Vec3;

const WHAT: &str = "plane";

/// All points `p` with `normal · (p - point_mm) = 0`. The parameters of its covariance: point x, y, z (mm), normal x, y, z (1). Its rank is 3: the point moves
/// along the normal alone, and the normal across itself.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plane {
    /// A point on it, mm; of a fit the one at the (weighted) mean of the data.
    pub point_mm: Vec3,
    /// Unit normal; of a fit its largest component is positive.
    pub normal: Vec3,
}

impl Plane {
    /// A plane through `point_mm` with a normal of any length but zero; distances are positive on its side.
    ///
    /// # Errors
    /// [`Error::NonFinite`], [`Error::Degenerate`] for a zero normal.
    pub fn new(point_mm: [f64; 3], normal: [f64; 3]) -> Result<Self> {
        Ok(Self { point_mm: finite("point_mm", point_mm)?, normal: direction("normal", normal)? })
    }

    /// The signed distance of a point, mm.
    #[inline(always)]
    pub fn distance(&self, p: &[f64; 3]) -> f64 {
        let (o, n) = (&self.point_mm, &self.normal);
        (p[0] - o.x) * n.x + (p[1] - o.y) * n.y + (p[2] - o.z) * n.z
    }

    /// The nearest point of the plane.
    #[inline(always)]
    pub fn foot(&self, p: &Vec3) -> Foot {
        let distance = self.normal.dot(&(p - self.point_mm));
        Foot { distance, point: p - self.normal * distance, normal: self.normal }
    }
}

/// Unknowns: shift along the normal, tilts towards the two axes.
#[derive(Clone)]
struct PlaneUnknowns {
    point: Vec3,
    /// Two directions in the plane, then the normal, as rows.
    axes: Matrix3<f64>,
}

impl SurfaceModel<3> for PlaneUnknowns {
    #[inline(always)]
    fn row<T: Number>(&self, q: &[T; 3]) -> ([T; 3], T) {
        let d: [T; 3] = std::array::from_fn(|k| q[k] - T::of(self.point[k]));
        let along = |a: usize| {
            let axis = self.axes.row(a);
            T::of(axis[0]) * d[0] + T::of(axis[1]) * d[1] + T::of(axis[2]) * d[2]
        };
        ([T::of(-1.0), along(0), along(1)], along(2))
    }

    fn moved(&self, step: &SVector<f64, 3>) -> Self {
        let normal = tilted(&self.axes, step[1], step[2]);
        let point = self.point + self.axes.row(2).transpose() * step[0];
        Self { point, axes: complete(&self.axes.row(0).transpose(), &normal) }
    }
}

/// The third of `axes` tilted by small amounts towards the first two, unit length.
pub(super) fn tilted(axes: &Matrix3<f64>, a: f64, b: f64) -> Vec3 {
    (axes.row(2) + axes.row(0) * a + axes.row(1) * b).transpose().normalize()
}

/// A right-handed frame as rows, the third being `axis` and the first near `first`.
pub(super) fn complete(first: &Vec3, axis: &Vec3) -> Matrix3<f64> {
    // Twice is enough: the second pass removes what rounding left of the axis.
    let u = (first - axis * first.dot(axis)).normalize();
    let u = (u - axis * u.dot(axis)).normalize();
    let v = axis.cross(&u);
    Matrix3::from_rows(&[u.transpose(), v.transpose(), axis.transpose()])
}

/// The direction with its largest component positive, and whether it was turned.
pub(super) fn upright(direction: Vec3) -> Vec3 {
    if direction[direction.iamax()] < 0.0 { -direction } else { direction }
}

/// Minimises `Σ w·((p - point)·normal)²` over the plane.
///
/// # Errors
/// Not finite, fewer than 3 points, weights out of range; [`Error::Degenerate`] where the points are equal or
/// collinear, or spread as far in a second direction as across the plane.
pub fn fit(points: &[[f64; 3]], noise: PointNoise) -> Result<Fit<Plane>> {
    let counted = noise.check(points, 3)?;
    let local = Local::of(WHAT, points, &noise)?;
    let moments = Moments::of(points, local, &noise);
    if moments.collinear {
        return Err(Error::Degenerate { what: WHAT, reason: "the points lie on a line".into() });
    }
    if moments.variances[1] - moments.variances[0] <= 1e-12 * moments.variances[1] {
        return Err(Error::Degenerate { what: WHAT, reason: "the points spread alike in two directions".into() });
    }
    let start = PlaneUnknowns { point: moments.mean, axes: frame(&moments) };
    let (found, normal, iterations): (_, NormalEquations<3>, _) = minimise(WHAT, start, points, local, &noise)?;
    let [u, v, w] = [0, 1, 2].map(|k| found.axes.row(k).transpose());
    // At the minimum the plane passes through the mean; the foot of the mean on it is the same to the last digits.
    let point = moments.mean - w * (moments.mean - found.point).dot(&w);
    let mut jacobian = SMatrix::<f64, 6, 3>::zeros();
    jacobian.fixed_view_mut::<3, 1>(0, 0).copy_from(&(w * local.scale));
    jacobian.fixed_view_mut::<3, 1>(3, 1).copy_from(&u);
    jacobian.fixed_view_mut::<3, 1>(3, 2).copy_from(&v);
    let unknowns = normal.inverse() * normal.variance(counted, &noise, local);
    let covariance = jacobian * unknowns * jacobian.transpose();
    Ok(Fit {
        surface: Plane { point_mm: local.to_world(&point), normal: upright(w) },
        rms_mm: normal.rms() * local.scale,
        covariance: DMatrix::from_fn(6, 6, |a, b| covariance[(a, b)]),
        iterations,
    })
}

/// Principal axes as rows, the one of least variance last: that is the normal of the best plane.
fn frame(moments: &Moments) -> Matrix3<f64> {
    complete(&moments.axes.column(2).into(), &moments.axes.column(0).into())
}

/// The plane through three points; `None` where they lie on a line.
pub(super) fn through(points: &[[f64; 3]]) -> Option<Plane> {
    let [a, b, c] = points else { return None };
    let [a, b, c] = [a, b, c].map(|p| Vec3::from(*p));
    let normal = (b - a).cross(&(c - a)).try_normalize(1e-12 * (b - a).norm() * (c - a).norm())?;
    Some(Plane { point_mm: a, normal: upright(normal) })
}
