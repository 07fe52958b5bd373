//! Least squares of orthogonal distances: what the fits of all surfaces have in common.
//!
//! Every fit minimises the weighted sum of squared orthogonal distances, `Σ wᵢ·dᵢ²`, by Levenberg-Marquardt from an
//! analytic start, in coordinates that are centred on the data and scaled by a power of two (which is exact). The
//! normal matrix only steers the steps; where they end is decided by the gradient, so that nothing of the precision is
//! lost to it.

use std::ops::{Add, Mul, Sub};

use nalgebra::{DMatrix, SMatrix, SVector};

use crate::error::{Error, Result, require_finite};
use crate::ground::threads;
use crate::ground::transform::Vec3;

/// A fitted surface and how well the points support it. `S` is [`Plane`](super::plane::Plane),
/// [`Sphere`](super::sphere::Sphere) or [`Cylinder`](super::cylinder::Cylinder).
#[derive(Debug, Clone, PartialEq)]
pub struct Fit<S> {
    /// The surface.
    pub surface: S,
    /// Root of the (weighted) mean squared orthogonal distance, mm.
    pub rms_mm: f64,
    /// Covariance of the parameters, in the order and the units that the surface documents; scaled by the residual
    /// variance `Σ w·d² / (n - p)`, or by the sigma given. NaN where neither is to be had (no redundancy).
    pub covariance: DMatrix<f64>,
    /// Steps until the last digits stood still.
    pub iterations: usize,
}

/// Relative weights of the points (1/σ², up to a factor) and what is known of their noise.
#[derive(Debug, Clone, Copy, Default)]
pub struct PointNoise<'a> {
    /// One weight per point, not negative; without it all are 1.
    pub weights: Option<&'a [f64]>,
    /// Standard deviation of a point of weight 1 along the normal, mm; without it the residuals tell.
    pub sigma_mm: Option<f64>,
}

impl PointNoise<'_> {
    pub(super) fn weight(&self, i: usize) -> f64 {
        self.weights.and_then(|w| w.get(i)).copied().unwrap_or(1.0)
    }

    /// The number of points that count, after the checks that all fits share.
    pub(super) fn check(&self, points: &[[f64; 3]], needed: usize) -> Result<usize> {
        require_finite("points", points)?;
        if let Some(sigma) = self.sigma_mm {
            crate::error::require_positive("sigma_mm", sigma)?;
        }
        let mut counted = points.len();
        if let Some(weights) = self.weights {
            if weights.len() != points.len() {
                let (expected, got) = (format!("{} values", points.len()), weights.len().to_string());
                return Err(Error::Shape { what: "weights", expected, got });
            }
            if let Some(w) = weights.iter().find(|w| !(w.is_finite() && **w >= 0.0)) {
                let expected = "finite and not negative".into();
                return Err(Error::OutOfRange { what: "weights", expected, value: w.to_string() });
            }
            counted = weights.iter().filter(|w| **w > 0.0).count();
        }
        crate::error::require_count("points", needed, counted)?;
        Ok(counted)
    }
}

/// Coordinates in which the fits work: `p = origin + scale·q`, with the scale a power of two.
#[derive(Debug, Clone, Copy)]
pub(super) struct Local {
    pub(super) origin: Vec3,
    pub(super) scale: f64,
    /// `1 / scale`, exact too.
    pub(super) inverse: f64,
}

impl Local {
    pub(super) fn new(origin: Vec3, scale: f64) -> Self {
        Self { origin, scale, inverse: 1.0 / scale }
    }

    /// Centred on the weighted mean, extents about 1. Refuses points that are all equal.
    pub(super) fn of(what: &'static str, points: &[[f64; 3]], noise: &PointNoise) -> Result<Self> {
        let first = points.first().copied().unwrap_or_default();
        let sums = |origin: [f64; 3]| {
            let parts = threads::map_chunks(points, |start, chunk| {
                let mut sum = [0.0; 5];
                for (i, p) in chunk.iter().enumerate() {
                    let w = noise.weight(start + i);
                    for k in 0..3 {
                        let d = p[k] - origin[k];
                        sum[k] += w * d;
                        sum[3] += w * d * d;
                    }
                    sum[4] += w;
                }
                sum
            });
            parts.iter().fold([0.0; 5], |a, b| std::array::from_fn(|k| a[k] + b[k]))
        };
        let s = sums(first);
        let origin: [f64; 3] = std::array::from_fn(|k| first[k] + s[k] / s[4]);
        let s = sums(origin);
        let extent = (s[3] / s[4]).sqrt();
        let size = origin.iter().fold(0.0, |m: f64, v| m.max(v.abs()));
        if !(extent.is_finite() && origin.iter().all(|v| v.is_finite())) {
            return Err(Error::Degenerate { what, reason: "the coordinates are too large".into() });
        }
        if extent <= 4.0 * f64::EPSILON * size || extent < f64::MIN_POSITIVE.sqrt() {
            return Err(Error::Degenerate { what, reason: "all points are equal".into() });
        }
        Ok(Self::new(origin.into(), extent.log2().round().exp2()))
    }

    #[inline(always)]
    pub(super) fn to_local(self, p: &[f64; 3]) -> [f64; 3] {
        std::array::from_fn(|k| (p[k] - self.origin[k]) * self.inverse)
    }

    pub(super) fn to_world(self, q: &Vec3) -> Vec3 {
        self.origin + q * self.scale
    }
}

/// The weighted sums of one Gauss-Newton step in `P` unknowns.
pub(super) struct NormalEquations<const P: usize> {
    /// `Σ w·jᵀj`.
    pub(super) matrix: SMatrix<f64, P, P>,
    /// `Σ w·j·d`.
    pub(super) gradient: SVector<f64, P>,
    /// `Σ w·d²`.
    pub(super) cost: f64,
    /// `Σ w`.
    pub(super) weight: f64,
    /// Where the points are few: an upper triangle R with `RᵀR = matrix`, and z with `Rᵀz = -gradient`, both computed
    /// without squaring, so that no digits are lost to a poor condition.
    pub(super) root: Option<(SMatrix<f64, P, P>, SVector<f64, P>)>,
}

/// A surface in the making: how a step in its `P` unknowns changes it and its distance to a point.
pub(super) trait SurfaceModel<const P: usize>: Clone + Sync {
    /// Derivative of the distance of the point `q` by the unknowns, and the distance.
    fn row<T: Number>(&self, q: &[T; 3]) -> ([T; P], T);
    /// The surface after a step.
    fn moved(&self, step: &SVector<f64, P>) -> Self;
}

/// A number, or eight of them that go through the processor's lanes together.
pub(super) trait Number: Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> {
    fn of(value: f64) -> Self;
    fn sqrt(self) -> Self;
    /// `-1 / self`, and 0 for 0: a point in the centre has no direction and pulls nowhere.
    fn pull(self) -> Self;
}

impl Number for f64 {
    #[inline(always)]
    fn of(value: f64) -> Self {
        value
    }

    #[inline(always)]
    fn sqrt(self) -> Self {
        self.sqrt()
    }

    #[inline(always)]
    fn pull(self) -> Self {
        if self > 0.0 { -1.0 / self } else { 0.0 }
    }
}

const LANES: usize = 8;

#[derive(Clone, Copy)]
struct Eight([f64; LANES]);

macro_rules! lanewise {
    ($($operation:ident $name:ident $symbol:tt),*) => {$(
        impl $operation for Eight {
            type Output = Self;

            #[inline(always)]
            fn $name(mut self, other: Self) -> Self {
                for l in 0..LANES {
                    self.0[l] $symbol other.0[l];
                }
                self
            }
        }
    )*};
}

lanewise!(Add add +=, Sub sub -=, Mul mul *=);

impl Number for Eight {
    #[inline(always)]
    fn of(value: f64) -> Self {
        Self([value; LANES])
    }

    #[inline(always)]
    fn sqrt(mut self) -> Self {
        for l in 0..LANES {
            self.0[l] = self.0[l].sqrt();
        }
        self
    }

    #[inline(always)]
    fn pull(mut self) -> Self {
        for l in 0..LANES {
            self.0[l] = self.0[l].pull();
        }
        self
    }
}

/// Up to so many points the step is solved without forming squares, which costs more and loses nothing.
const FEW: usize = 2000;

/// A loop over at most five unknowns, written out: the compiler would rather vectorise it than what is inside.
macro_rules! unrolled {
    ($name:ident below $end:ident => $body:block) => {
        unrolled!(@ $name, $end, $body, 0, 1, 2, 3, 4)
    };
    (@ $name:ident, $end:ident, $body:block, $($value:literal),*) => {
        $({
            let $name = $value;
            if $name < $end $body
        })*
    };
}

/// The sums over a chunk: lanes are added up separately and at the end in order, whatever the width of the processor's
/// registers, so that the bits are the same on all of them.
#[multiversion::multiversion(targets("x86_64+avx512f", "x86_64+avx2"))]
fn accumulate<const P: usize, M: SurfaceModel<P>>(
    model: &M,
    points: &[[f64; 3]],
    weights: Option<&[f64]>,
    local: Local,
) -> NormalEquations<P> {
    plain_accumulate(model, points, weights, local)
}

/// The body of [`accumulate`], and its fallback.
#[inline(always)]
fn plain_accumulate<const P: usize, M: SurfaceModel<P>>(
    model: &M,
    points: &[[f64; 3]],
    weights: Option<&[f64]>,
    local: Local,
) -> NormalEquations<P> {
    let zero = Eight([0.0; LANES]);
    let (mut matrix, mut gradient) = ([[zero; P]; P], [zero; P]);
    let (mut cost, mut weight) = (zero, zero);
    for (number, block) in points.chunks(LANES).enumerate() {
        // The last block is filled up with copies of weight 0.
        let fill = block.first().copied().unwrap_or_default();
        let mut q = [Eight([0.0; LANES]); 3];
        for l in 0..LANES {
            let local = local.to_local(block.get(l).unwrap_or(&fill));
            (q[0].0[l], q[1].0[l], q[2].0[l]) = (local[0], local[1], local[2]);
        }
        let mut w = Eight([0.0; LANES]);
        match weights {
            None => w.0.iter_mut().take(block.len()).for_each(|w| *w = 1.0),
            Some(all) => w.0.iter_mut().zip(all.iter().skip(number * LANES)).for_each(|(w, given)| *w = *given),
        }
        let (j, d) = model.row(&q);
        unrolled!(a below P => {
            let wj = w * j[a];
            gradient[a] = gradient[a] + wj * d;
            unrolled!(b below P => {
                if b >= a {
                    matrix[a][b] = matrix[a][b] + wj * j[b];
                }
            });
        });
        cost = cost + w * d * d;
        weight = weight + w;
    }
    let sum = |lanes: &Eight| lanes.0.iter().sum::<f64>();
    NormalEquations {
        matrix: SMatrix::from_fn(|a, b| sum(&matrix[a.min(b)][a.max(b)])),
        gradient: SVector::from_fn(|a, _| sum(&gradient[a])),
        cost: sum(&cost),
        weight: sum(&weight),
        root: None,
    }
}

/// Triangular root of the normal matrix by Givens rotations of the rows themselves, and the right side with it.
fn triangle<const P: usize, M: SurfaceModel<P>>(
    model: &M,
    points: &[[f64; 3]],
    local: Local,
    noise: &PointNoise,
) -> (SMatrix<f64, P, P>, SVector<f64, P>) {
    let (mut root, mut right) = (SMatrix::<f64, P, P>::zeros(), SVector::<f64, P>::zeros());
    for (i, p) in points.iter().enumerate() {
        let w = noise.weight(i).sqrt();
        let (row, distance) = model.row(&local.to_local(p));
        let (mut row, mut rest) = (row.map(|v| w * v), -w * distance);
        for a in 0..P {
            let length = root[(a, a)].hypot(row[a]);
            if length == 0.0 {
                continue;
            }
            let (c, s) = (root[(a, a)] / length, row[a] / length);
            for b in a..P {
                (root[(a, b)], row[b]) = (c * root[(a, b)] + s * row[b], c * row[b] - s * root[(a, b)]);
            }
            (right[a], rest) = (c * right[a] + s * rest, c * rest - s * right[a]);
        }
    }
    (root, right)
}

impl<const P: usize> NormalEquations<P> {
    pub(super) fn of<M: SurfaceModel<P>>(model: &M, points: &[[f64; 3]], local: Local, noise: &PointNoise) -> Self {
        let chunk = |start: usize, chunk: &[[f64; 3]]| {
            accumulate(model, chunk, noise.weights.and_then(|w| w.get(start..start + chunk.len())), local)
        };
        // Few points are not worth a thread.
        if points.len() <= FEW {
            let mut sum = chunk(0, points);
            sum.root = Some(triangle(model, points, local, noise));
            return sum;
        }
        let mut sum = Self { matrix: SMatrix::zeros(), gradient: SVector::zeros(), cost: 0.0, weight: 0.0, root: None };
        for part in threads::map_chunks(points, chunk) {
            sum.matrix += part.matrix;
            sum.gradient += part.gradient;
            sum.cost += part.cost;
            sum.weight += part.weight;
        }
        sum
    }

    /// The undamped step from the triangular root; `None` where a column depends on the others.
    fn exact_step(root: &SMatrix<f64, P, P>, right: &SVector<f64, P>) -> Option<SVector<f64, P>> {
        let mut x = *right;
        for a in (0..P).rev() {
            let length = (0..=a).map(|k| root[(k, a)].powi(2)).sum::<f64>().sqrt();
            let diagonal = root[(a, a)];
            if diagonal.is_nan() || diagonal.abs() <= 64.0 * f64::EPSILON * length {
                return None;
            }
            let sum: f64 = (a + 1..P).map(|k| root[(a, k)] * x[k]).sum();
            x[a] = (x[a] - sum) / diagonal;
        }
        Some(x)
    }

    /// `-(N + damping·diag N)⁻¹ g` by Cholesky with the diagonal scaled to 1, or from the root; `None` where N is not
    /// positive.
    pub(super) fn step(&self, damping: f64) -> Option<SVector<f64, P>> {
        if let (Some((root, right)), true) = (&self.root, damping == 0.0) {
            return Self::exact_step(root, right);
        }
        let root = self.cholesky(damping)?;
        // RᵀR x = -g.
        let mut x = -self.gradient;
        for a in 0..P {
            let sum: f64 = (0..a).map(|k| root[(k, a)] * x[k]).sum();
            x[a] = (x[a] - sum) / root[(a, a)];
        }
        Self::exact_step(&root, &x)
    }

    /// The upper triangle R with `RᵀR = N + damping·diag N`; `None` where N is not positive beyond rounding.
    fn cholesky(&self, damping: f64) -> Option<SMatrix<f64, P, P>> {
        let d = SVector::<f64, P>::from_fn(|a, _| self.matrix[(a, a)].sqrt());
        if d.iter().any(|v| !(v.is_finite() && *v > 0.0)) {
            return None;
        }
        let mut root = SMatrix::<f64, P, P>::zeros();
        for a in 0..P {
            for b in a..P {
                let sum: f64 = (0..a).map(|k| root[(k, a)] * root[(k, b)]).sum();
                let full = self.matrix[(a, b)] / (d[a] * d[b]) + if a == b { damping } else { 0.0 };
                let rest = full - sum;
                if a == b && rest <= 16.0 * f64::EPSILON {
                    return None;
                }
                root[(a, b)] = if a == b { rest.sqrt() } else { rest / root[(a, a)] };
            }
        }
        Some(SMatrix::from_fn(|a, b| root[(a, b)] * d[b]))
    }

    /// `N⁻¹`; NaN where it does not exist.
    pub(super) fn inverse(&self) -> SMatrix<f64, P, P> {
        let none = SMatrix::from_element(f64::NAN);
        let Some(root) = self.root.map(|r| r.0).or_else(|| self.cholesky(0.0)) else { return none };
        // The inverse of the triangle column by column; N⁻¹ is its square.
        let mut inverse = SMatrix::<f64, P, P>::zeros();
        for a in 0..P {
            match Self::exact_step(&root, &SVector::from_fn(|b, _| if a == b { 1.0 } else { 0.0 })) {
                Some(column) => inverse.set_column(a, &column),
                None => return none,
            }
        }
        inverse * inverse.transpose()
    }

    /// Variance of a point of weight 1, in local units: given, or from the residuals of `counted` points.
    pub(super) fn variance(&self, counted: usize, noise: &PointNoise, local: Local) -> f64 {
        match noise.sigma_mm {
            Some(sigma) => (sigma / local.scale).powi(2),
            None if counted > P => self.cost / (counted - P) as f64,
            None => f64::NAN,
        }
    }

    pub(super) fn rms(&self) -> f64 {
        (self.cost / self.weight).sqrt()
    }
}

/// More steps than any solvable fit has been seen to take.
const MAX_STEPS: usize = 300;

/// Steps below this, in parts of the data's extent, are not judged by the cost any more.
const NEAR: f64 = 1e-9;

/// Levenberg-Marquardt from `start` until the step is lost in rounding. Returns the surface, its sums, the steps taken.
pub(super) fn minimise<const P: usize, M: SurfaceModel<P>>(
    what: &'static str,
    start: M,
    points: &[[f64; 3]],
    local: Local,
    noise: &PointNoise,
) -> Result<(M, NormalEquations<P>, usize)> {
    let fail = |reason: &str| Err(Error::Degenerate { what, reason: reason.into() });
    let mut model = start;
    let mut normal = NormalEquations::of(&model, points, local, noise);
    if !normal.cost.is_finite() {
        return fail("the coordinates are too large");
    }
    let mut damping: f64 = 0.0;
    let mut last = f64::INFINITY;
    for iteration in 1..=MAX_STEPS {
        let Some(step) = normal.step(damping) else {
            if damping > 1e8 {
                return fail("the points do not determine it");
            }
            damping = (damping * 10.0).max(1e-9);
            continue;
        };
        // The step as the distances see it, in local units.
        let size = (step.dot(&(normal.matrix * step)).max(0.0) / normal.weight).sqrt();
        let moved = model.moved(&step);
        let next = NormalEquations::of(&moved, points, local, noise);
        if damping == 0.0 && size < NEAR {
            // The cost is level to its rounding here; the gradient still has digits, until the steps stop shrinking.
            if !next.cost.is_finite() || size == 0.0 || size > 0.5 * last {
                return Ok((model, normal, iteration));
            }
            (model, normal, last) = (moved, next, size);
            continue;
        }
        last = f64::INFINITY;
        // Each distance is rounded by about an epsilon of the data's extent, 1; so much is the cost in doubt.
        let doubt = f64::EPSILON * (normal.cost + (normal.cost * normal.weight).sqrt() + f64::EPSILON * normal.weight);
        if next.cost.is_finite() && next.cost <= normal.cost + 4.0 * doubt {
            (model, normal) = (moved, next);
            damping = if damping < 1e-8 || size < NEAR { 0.0 } else { damping / 10.0 };
        } else {
            damping = (damping * 10.0).max(1e-6);
            if damping > 1e12 {
                return if normal.step(0.0).is_some() {
                    Ok((model, normal, iteration))
                } else {
                    fail("the points do not determine it")
                };
            }
        }
    }
    fail("the fit does not converge: too flat for its noise")
}

/// Weighted mean and covariance of points, and the principal axes, least variance first.
pub(super) struct Moments {
    pub(super) mean: Vec3,
    /// Variances along the axes, ascending.
    pub(super) variances: Vec3,
    /// Unit axes as columns, in the order of the variances.
    pub(super) axes: nalgebra::Matrix3<f64>,
    pub(super) collinear: bool,
    pub(super) coplanar: bool,
}

impl Moments {
    pub(super) fn of(points: &[[f64; 3]], local: Local, noise: &PointNoise) -> Self {
        let parts = threads::map_chunks(points, |start, chunk| {
            let mut s = [0.0; 10];
            for (i, p) in chunk.iter().enumerate() {
                let (w, [x, y, z]) = (noise.weight(start + i), local.to_local(p));
                let terms = [w, w * x, w * y, w * z, w * x * x, w * x * y, w * x * z, w * y * y, w * y * z, w * z * z];
                s.iter_mut().zip(terms).for_each(|(a, b)| *a += b);
            }
            s
        });
        let s = parts.iter().fold([0.0; 10], |a, b| std::array::from_fn(|k| a[k] + b[k]));
        let mean = Vec3::new(s[1], s[2], s[3]) / s[0];
        let second = nalgebra::Matrix3::new(s[4], s[5], s[6], s[5], s[7], s[8], s[6], s[8], s[9]) / s[0];
        let (variances, axes) = principal(&(second - mean * mean.transpose()));
        // Below this a spread is rounding: of the coordinates, or of the largest variance.
        let digits = 4.0 * f64::EPSILON * (1.0 + local.origin.amax() * local.inverse);
        let rounding = digits * digits + 16.0 * f64::EPSILON * variances[2];
        Self { mean, variances, axes, collinear: variances[1] <= rounding, coplanar: variances[0] <= rounding }
    }
}

/// Eigenvalues of a symmetric matrix in ascending order, and its eigenvectors as the columns of a right-handed frame.
pub(super) fn principal(matrix: &nalgebra::Matrix3<f64>) -> (Vec3, nalgebra::Matrix3<f64>) {
    let eigen = matrix.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    let values = Vec3::from_fn(|i, _| eigen.eigenvalues[order[i]]);
    let [a, b] = [0, 1].map(|i| Vec3::from(eigen.eigenvectors.column(order[i])));
    (values, nalgebra::Matrix3::from_columns(&[a, b, a.cross(&b)]))
}

#[cfg(test)]
mod tests {
    use super::super::sphere::SphereUnknowns;
    use super::super::tests::cap;
    use super::*;

    #[test]
    fn vectors_and_the_plain_fallback_give_the_same_bits() {
        let points = cap(1003, [0.1, 0.2, 0.3], 1.1, 2.0, 0.1);
        let weights: Vec<f64> = (0..1003).map(|i| 0.5 + (i % 3) as f64).collect();
        let model = SphereUnknowns { center: [0.1, 0.2, 0.3], radius: 1.2 };
        for weights in [None, Some(weights.as_slice())] {
            let local = Local::new(Vec3::zeros(), 1.0);
            let fast: NormalEquations<4> = accumulate(&model, &points, weights, local);
            let plain: NormalEquations<4> = plain_accumulate(&model, &points, weights, local);
            assert!(fast.matrix == plain.matrix && fast.gradient == plain.gradient);
            assert!(fast.cost == plain.cost && fast.weight == plain.weight && fast.cost > 0.0);
        }
    }
}
