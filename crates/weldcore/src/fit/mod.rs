//! Plane, sphere and cylinder by orthogonal distance, with covariance; robust starts; spheres found in a cloud.
//!
//! Every fit minimises the weighted sum of squared orthogonal distances, `Σ wᵢ·dᵢ²`, by Levenberg-Marquardt from an
//! analytic start, in coordinates that are centred on the data and scaled by a power of two (which is exact). The normal
//! matrix only steers the steps; where they end is decided by the gradient, so that nothing of the precision is lost to it.

pub mod cylinder;
pub mod plane;
pub mod robust;
pub mod sphere;
pub mod spheres;

use nalgebra::{DMatrix, SMatrix, SVector};

use crate::Vec3;
use crate::error::{Error, Result, require_finite};
use crate::threads;

/// A fitted surface and how well the points support it. `S` is [`plane::Plane`], [`sphere::Sphere`] or
/// [`cylinder::Cylinder`].
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
pub struct Noise<'a> {
    /// One weight per point, not negative; without it all are 1.
    pub weights: Option<&'a [f64]>,
    /// Standard deviation of a point of weight 1 along the normal, mm; without it the residuals tell.
    pub sigma_mm: Option<f64>,
}

impl Noise<'_> {
    fn weight(&self, i: usize) -> f64 {
        self.weights.and_then(|w| w.get(i)).copied().unwrap_or(1.0)
    }

    /// The number of points that count, after the checks that all fits share.
    fn check(&self, points: &[[f64; 3]], needed: usize) -> Result<usize> {
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
struct Local {
    origin: Vec3,
    scale: f64,
}

impl Local {
    /// Centred on the weighted mean, extents about 1. Refuses points that are all equal.
    fn of(what: &'static str, points: &[[f64; 3]], noise: &Noise) -> Result<Self> {
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
        Ok(Self { origin: origin.into(), scale: extent.log2().round().exp2() })
    }

    #[inline]
    fn to_local(self, p: &[f64; 3]) -> [f64; 3] {
        std::array::from_fn(|k| (p[k] - self.origin[k]) / self.scale)
    }

    fn to_world(self, q: &Vec3) -> Vec3 {
        self.origin + q * self.scale
    }
}

/// What is left of the data's digits, in local units: a spread below this is rounding.
fn rounding(local: Local) -> f64 {
    4.0 * f64::EPSILON * (1.0 + local.origin.amax() / local.scale)
}

/// The weighted sums of one Gauss-Newton step in `P` unknowns.
struct Normal<const P: usize> {
    /// `Σ w·jᵀj`.
    matrix: SMatrix<f64, P, P>,
    /// `Σ w·j·d`.
    gradient: SVector<f64, P>,
    /// `Σ w·d²`.
    cost: f64,
    /// `Σ w`.
    weight: f64,
}

/// A surface in the making: how a step in its `P` unknowns changes it and its distance to a point.
trait Model<const P: usize>: Clone + Sync {
    /// Derivative of the distance of the point `q` by the unknowns, and the distance.
    fn row(&self, q: &[f64; 3]) -> ([f64; P], f64);
    /// The surface after a step.
    fn moved(&self, step: &SVector<f64, P>) -> Self;
}

impl<const P: usize> Normal<P> {
    fn of<M: Model<P>>(model: &M, points: &[[f64; 3]], local: Local, noise: &Noise) -> Self {
        let parts = threads::map_chunks(points, |start, chunk| {
            let (mut matrix, mut gradient) = ([[0.0; P]; P], [0.0; P]);
            let (mut cost, mut weight) = (0.0, 0.0);
            for (i, p) in chunk.iter().enumerate() {
                let w = noise.weight(start + i);
                let (j, d) = model.row(&local.to_local(p));
                for a in 0..P {
                    let wj = w * j[a];
                    gradient[a] += wj * d;
                    for b in a..P {
                        matrix[a][b] += wj * j[b];
                    }
                }
                cost += w * d * d;
                weight += w;
            }
            (matrix, gradient, cost, weight)
        });
        let mut sum = Self { matrix: SMatrix::zeros(), gradient: SVector::zeros(), cost: 0.0, weight: 0.0 };
        for (matrix, gradient, cost, weight) in parts {
            sum.matrix += SMatrix::from_fn(|a, b| matrix[a.min(b)][a.max(b)]);
            sum.gradient += SVector::from(gradient);
            sum.cost += cost;
            sum.weight += weight;
        }
        sum
    }

    /// `-(N + damping·diag N)⁻¹ g` by Cholesky with the diagonal scaled to 1; `None` where N is not positive.
    fn step(&self, damping: f64) -> Option<SVector<f64, P>> {
        let d = SVector::<f64, P>::from_fn(|a, _| self.matrix[(a, a)].sqrt());
        if d.iter().any(|v| !(v.is_finite() && *v > 0.0)) {
            return None;
        }
        let mut l = SMatrix::<f64, P, P>::from_fn(|a, b| self.matrix[(a, b)] / (d[a] * d[b]));
        for a in 0..P {
            l[(a, a)] += damping;
        }
        for a in 0..P {
            for b in 0..=a {
                let sum: f64 = (0..b).map(|k| l[(a, k)] * l[(b, k)]).sum();
                let rest = l[(a, b)] - sum;
                if a == b {
                    if rest <= 16.0 * f64::EPSILON {
                        return None;
                    }
                    l[(a, a)] = rest.sqrt();
                } else {
                    l[(a, b)] = rest / l[(b, b)];
                }
            }
        }
        let mut x = SVector::<f64, P>::from_fn(|a, _| -self.gradient[a] / d[a]);
        for a in 0..P {
            let sum: f64 = (0..a).map(|k| l[(a, k)] * x[k]).sum();
            x[a] = (x[a] - sum) / l[(a, a)];
        }
        for a in (0..P).rev() {
            let sum: f64 = (a + 1..P).map(|k| l[(k, a)] * x[k]).sum();
            x[a] = (x[a] - sum) / l[(a, a)];
        }
        Some(SVector::from_fn(|a, _| x[a] / d[a]))
    }

    /// `N⁻¹`; NaN where it does not exist.
    fn inverse(&self) -> SMatrix<f64, P, P> {
        let mut inverse = SMatrix::<f64, P, P>::from_element(f64::NAN);
        let mut unit = Self { matrix: self.matrix, gradient: SVector::zeros(), cost: 0.0, weight: 0.0 };
        for a in 0..P {
            unit.gradient = SVector::from_fn(|b, _| if a == b { -1.0 } else { 0.0 });
            match unit.step(0.0) {
                Some(column) => inverse.set_column(a, &column),
                None => return SMatrix::from_element(f64::NAN),
            }
        }
        (inverse + inverse.transpose()) / 2.0
    }

    /// Variance of a point of weight 1, in local units: given, or from the residuals of `counted` points.
    fn variance(&self, counted: usize, noise: &Noise, local: Local) -> f64 {
        match noise.sigma_mm {
            Some(sigma) => (sigma / local.scale).powi(2),
            None if counted > P => self.cost / (counted - P) as f64,
            None => f64::NAN,
        }
    }

    fn rms(&self) -> f64 {
        (self.cost / self.weight).sqrt()
    }
}

/// More steps than any solvable fit has been seen to take.
const MAX_STEPS: usize = 300;

/// Steps below this, in parts of the data's extent, are not judged by the cost any more.
const NEAR: f64 = 1e-9;

/// Levenberg-Marquardt from `start` until the step is lost in rounding. Returns the surface, its sums, the steps taken.
fn minimise<const P: usize, M: Model<P>>(
    what: &'static str,
    start: M,
    points: &[[f64; 3]],
    local: Local,
    noise: &Noise,
) -> Result<(M, Normal<P>, usize)> {
    let fail = |reason: &str| Err(Error::Degenerate { what, reason: reason.into() });
    let mut model = start;
    let mut normal = Normal::of(&model, points, local, noise);
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
        let next = Normal::of(&moved, points, local, noise);
        if damping == 0.0 && size < NEAR {
            // The cost is level to its rounding here; the gradient still has digits, until the steps stop shrinking.
            if !next.cost.is_finite() || size > 0.5 * last {
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
struct Moments {
    mean: Vec3,
    /// Variances along the axes, ascending.
    variances: Vec3,
    /// Unit axes as columns, in the order of the variances.
    axes: nalgebra::Matrix3<f64>,
}

impl Moments {
    fn of(points: &[[f64; 3]], local: Local, noise: &Noise) -> Self {
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
        Self { mean, variances, axes }
    }
}

/// Eigenvalues of a symmetric matrix in ascending order, and its eigenvectors as the columns of a right-handed frame.
fn principal(matrix: &nalgebra::Matrix3<f64>) -> (Vec3, nalgebra::Matrix3<f64>) {
    let eigen = matrix.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    let values = Vec3::from_fn(|i, _| eigen.eigenvalues[order[i]]);
    let [a, b] = [0, 1].map(|i| Vec3::from(eigen.eigenvectors.column(order[i])));
    (values, nalgebra::Matrix3::from_columns(&[a, b, a.cross(&b)]))
}
