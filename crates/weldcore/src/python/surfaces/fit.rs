//! `weldscan.fit_plane`, `fit_sphere`, `fit_cylinder` and their results.

use numpy::{Ix1, PyArray1, PyArray2, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::prelude::*;

use crate::error::Error;
use crate::ground::transform::Vec3;
use crate::python::call::{compute, raise};
use crate::python::convert::{self, array, float_matrix, floats, points as as_points, whole};
use crate::python::surfaces::find_spheres::PyFoundSphere;
use crate::python::surfaces::shapes::PySphere;
use crate::surfaces::{Fit, PointNoise, cylinder, plane, robust, sphere};

/// What the three results have in common.
pub(crate) struct Common {
    pub(crate) rms_mm: f64,
    pub(crate) covariance: Vec<Vec<f64>>,
    pub(crate) iterations: usize,
    pub(crate) inliers: Option<Vec<usize>>,
}

impl Common {
    fn of<S>(fit: &Fit<S>, inliers: Option<Vec<usize>>) -> Self {
        let rows = fit.covariance.row_iter().map(|r| r.iter().copied().collect()).collect();
        Self { rms_mm: fit.rms_mm, covariance: rows, iterations: fit.iterations, inliers }
    }

    fn inliers<'py>(&self, py: Python<'py>) -> Option<Bound<'py, PyArray1<i64>>> {
        self.inliers.as_ref().map(|list| PyArray1::from_iter(py, list.iter().map(|&i| i as i64)))
    }

    /// The end of a result's repr.
    fn describe(&self) -> String {
        let inliers = self.inliers.as_ref().map_or(String::new(), |list| format!(", {} inliers", list.len()));
        format!("rms_mm={:.6}, iterations={}{inliers})", self.rms_mm, self.iterations)
    }
}

fn triple(v: &Vec3) -> String {
    format!("({:.6}, {:.6}, {:.6})", v[0], v[1], v[2])
}

macro_rules! result_class {
    ($(#[$doc:meta])* $name:ident, $surface:ty, $covariance:literal, { $($getters:tt)* }) => {
        $(#[$doc])*
        #[pyclass(frozen, module = "weldscan")]
        pub(crate) struct $name {
            pub(crate) surface: $surface,
            pub(crate) common: Common,
        }

        impl $name {
            fn of(fit: &Fit<$surface>, inliers: Option<Vec<usize>>) -> Self {
                Self { surface: fit.surface, common: Common::of(fit, inliers) }
            }
        }

        #[pymethods]
        impl $name {
            /// Root mean square of the orthogonal distances, mm.
            #[getter]
            fn rms_mm(&self) -> f64 {
                self.common.rms_mm
            }

            #[doc = $covariance]
            #[getter]
            fn covariance<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
                Ok(PyArray2::from_vec2(py, &self.common.covariance)?)
            }

            /// Steps of the minimisation.
            #[getter]
            fn iterations(&self) -> usize {
                self.common.iterations
            }

            /// Indices of the points that were fitted, ascending, int64; None unless `robust` was asked for.
            #[getter]
            fn inliers<'py>(&self, py: Python<'py>) -> Option<Bound<'py, PyArray1<i64>>> {
                self.common.inliers(py)
            }

            $($getters)*
        }
    };
}

result_class!(
    /// A plane fitted by `fit_plane`.
    PlaneFit,
    plane::Plane,
    "Covariance of point x, y, z (mm) and normal x, y, z (1), (6, 6) float64, rank 3.",
    {
        /// The point of the plane at the mean of the data, (3,) float64, mm.
        #[getter]
        fn point_mm<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
            array(py, &self.surface.point_mm)
        }

        /// Unit normal, (3,) float64; its largest component is positive.
        #[getter]
        fn normal<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
            array(py, &self.surface.normal)
        }

        fn __repr__(&self) -> String {
            let s = &self.surface;
            let (point, normal) = (triple(&s.point_mm), triple(&s.normal));
            format!("PlaneFit(point_mm={point}, normal={normal}, {}", self.common.describe())
        }
    }
);

result_class!(
    /// A sphere fitted by `fit_sphere`.
    SphereFit,
    sphere::Sphere,
    "Covariance of centre x, y, z and, where it was free, the radius, (3, 3) or (4, 4) float64, mm².",
    {
        /// Centre, (3,) float64, mm.
        #[getter]
        fn center_mm<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
            array(py, &self.surface.center_mm)
        }

        /// Radius, mm.
        #[getter]
        fn radius_mm(&self) -> f64 {
            self.surface.radius_mm
        }

        fn __repr__(&self) -> String {
            let s = &self.surface;
            let center = triple(&s.center_mm);
            format!("SphereFit(center_mm={center}, radius_mm={:.6}, {}", s.radius_mm, self.common.describe())
        }
    }
);

result_class!(
    /// A cylinder fitted by `fit_cylinder`.
    CylinderFit,
    cylinder::Cylinder,
    "Covariance of point x, y, z (mm), axis x, y, z (1) and, where it was free, the radius (mm): (6, 6) or (7, 7) \
     float64, rank 4 or 5.",
    {
        /// The point of the axis nearest to the mean of the data, (3,) float64, mm.
        #[getter]
        fn point_mm<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
            array(py, &self.surface.point_mm)
        }

        /// Unit vector along the axis, (3,) float64; its largest component is positive.
        #[getter]
        fn axis<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
            array(py, &self.surface.axis)
        }

        /// Radius, mm.
        #[getter]
        fn radius_mm(&self) -> f64 {
            self.surface.radius_mm
        }

        fn __repr__(&self) -> String {
            let s = &self.surface;
            let (point, axis, rest) = (triple(&s.point_mm), triple(&s.axis), self.common.describe());
            format!("CylinderFit(point_mm={point}, axis={axis}, radius_mm={:.6}, {rest}", s.radius_mm)
        }
    }
);

/// The sphere of an object: a sphere, a fit of one, one that was found.
pub(crate) fn sphere_of(object: &Bound<'_, PyAny>) -> Option<sphere::Sphere> {
    if let Ok(sphere) = object.cast::<PySphere>() {
        Some(sphere.get().0)
    } else if let Ok(fit) = object.cast::<SphereFit>() {
        Some(fit.get().surface)
    } else {
        object.cast::<PyFoundSphere>().ok().map(|found| found.get().0.sphere)
    }
}

/// Weights as an optional array.
fn weights_of<'py>(
    points: &PyReadonlyArray2<'_, f64>,
    weights: Option<&Bound<'py, PyAny>>,
    robust: bool,
) -> PyResult<Option<numpy::PyReadonlyArray1<'py, f64>>> {
    match weights {
        Some(weights) if robust => {
            let (expected, value) = ("None together with robust=True".into(), "an array".into());
            Err(raise(weights.py(), &Error::OutOfRange { what: "weights", expected, value }))
        }
        Some(weights) => {
            let array = floats::<Ix1>("weights", weights)?;
            if array.len() == points.shape()[0] {
                return Ok(Some(array));
            }
            let got = format!("shape {:?}", array.shape());
            Err(raise(weights.py(), &Error::Shape { what: "weights", expected: "one per point".into(), got }))
        }
        None => Ok(None),
    }
}

/// Fits a plane by least squares of the orthogonal distances: minimises `sum(w * ((p - point) . normal)**2)`.
///
/// Args:
///     points: (n, 3) float64, n >= 3, mm, any frame.
///     weights: (n,) float64, relative weights 1/sigma**2; None: all equal. Not together with `robust`.
///     sigma_mm: standard deviation of a point (of weight 1) along the normal; None: the residuals tell it.
///     robust: outliers may be present (up to 60 %): MSAC start, reweighting, and a last fit without truncation on the
///         points within three standard deviations.
///     seed: of the random samples; the same seed gives the same result.
///
/// Returns:
///     PlaneFit with `point_mm` (the mean of the data), `normal` (unit, its largest component positive), `rms_mm`,
///     `covariance` (point in mm, normal), `iterations`, `inliers`.
///
/// Raises:
///     InputError: wrong shape, NaN or infinity, weights or sigma out of range.
///     GeometryError: fewer than 3 points; points that are equal or collinear.
///
/// Source: Shakarji, Least-squares fitting algorithms of the NIST algorithm testing system, J. Res. NIST 103 (1998).
///
/// Example:
///     >>> import weldscan
///     >>> plane = weldscan.fit_plane([[0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]])
///     >>> plane.normal.tolist(), plane.point_mm.tolist()
///     ([0.0, 0.0, 1.0], [0.5, 0.5, 1.0])
#[pyfunction]
#[pyo3(signature = (points, *, weights=None, sigma_mm=None, robust=false, seed=0))]
fn fit_plane(
    py: Python<'_>,
    points: &Bound<'_, PyAny>,
    weights: Option<&Bound<'_, PyAny>>,
    sigma_mm: Option<f64>,
    robust: bool,
    #[pyo3(from_py_with = whole)] seed: usize,
) -> PyResult<PlaneFit> {
    let array = float_matrix("points", points)?;
    let weights = weights_of(&array, weights, robust)?;
    let (list, weights) = (as_points("points", &array)?, weights.as_ref().map(|w| w.as_slice()).transpose()?);
    if robust {
        let (fit, inliers) = compute(py, || robust::plane(list, sigma_mm, seed as u64))?;
        return Ok(PlaneFit::of(&fit, Some(inliers)));
    }
    Ok(PlaneFit::of(&compute(py, || plane::fit(list, PointNoise { weights, sigma_mm }))?, None))
}

/// Fits a sphere by least squares of the orthogonal distances: minimises `sum(w * (|p - center| - radius)**2)`.
///
/// Args:
///     points: (n, 3) float64, n >= 4 (3 with a given radius), mm, any frame.
///     radius_mm: the radius where it is known (a calibrated ball seen as a cap); None: it is fitted.
///     near: a sphere, or a fit of one, to begin at; None: at the algebraic sphere, which points far off lead astray.
///     weights: (n,) float64, relative weights 1/sigma**2; None: all equal. Not together with `robust`.
///     sigma_mm: standard deviation of a point (of weight 1) along the normal; None: the residuals tell it.
///     robust: outliers may be present (up to 60 %): MSAC start, reweighting, and a last fit without truncation on the
///         points within three standard deviations.
///     seed: of the random samples; the same seed gives the same result.
///
/// Returns:
///     SphereFit with `center_mm`, `radius_mm`, `rms_mm`, `covariance` (centre and, where it was fitted, radius; mm²;
///     NaN without redundancy), `iterations`, `inliers`.
///
/// Raises:
///     InputError: wrong shape, NaN or infinity, radius, weights or sigma out of range.
///     GeometryError: too few points; points that are equal, collinear, coplanar (free radius) or too flat.
///
/// Source: Shakarji, Least-squares fitting algorithms of the NIST algorithm testing system, J. Res. NIST 103 (1998).
///
/// Example:
///     >>> import weldscan
///     >>> ball = weldscan.fit_sphere([[2, 0, 0], [-2, 0, 0], [0, 2, 0], [0, -2, 0], [0, 0, 2]])
///     >>> round(ball.radius_mm, 9)
///     2.0
#[pyfunction]
#[pyo3(signature = (points, radius_mm=None, *, near=None, weights=None, sigma_mm=None, robust=false, seed=0))]
#[allow(clippy::too_many_arguments)] // Python's keywords.
fn fit_sphere(
    py: Python<'_>,
    points: &Bound<'_, PyAny>,
    radius_mm: Option<f64>,
    near: Option<&Bound<'_, PyAny>>,
    weights: Option<&Bound<'_, PyAny>>,
    sigma_mm: Option<f64>,
    robust: bool,
    #[pyo3(from_py_with = whole)] seed: usize,
) -> PyResult<SphereFit> {
    let array = float_matrix("points", points)?;
    let weights = weights_of(&array, weights, robust)?;
    let (list, weights) = (as_points("points", &array)?, weights.as_ref().map(|w| w.as_slice()).transpose()?);
    if let Some(near) = near {
        let wrong =
            |got: String| raise(py, &Error::Shape { what: "near", expected: "a sphere, without robust".into(), got });
        let Some(mut start) = sphere_of(near).filter(|_| !robust) else {
            return Err(wrong(near.get_type().name()?.to_string()));
        };
        start.radius_mm = radius_mm.unwrap_or(start.radius_mm);
        let noise = PointNoise { weights, sigma_mm };
        return Ok(SphereFit::of(&compute(py, || sphere::refine(list, start, radius_mm.is_none(), noise))?, None));
    }
    if robust {
        let (fit, inliers) = compute(py, || robust::sphere(list, radius_mm, sigma_mm, seed as u64))?;
        return Ok(SphereFit::of(&fit, Some(inliers)));
    }
    Ok(SphereFit::of(&compute(py, || sphere::fit(list, radius_mm, PointNoise { weights, sigma_mm }))?, None))
}

/// Fits a cylinder by least squares of the orthogonal distances: minimises `sum(w * (dist(p, axis) - radius)**2)`.
///
/// Args:
///     points: (n, 3) float64, n >= 5 (4 with a given radius), mm, any frame.
///     radius_mm: the radius where it is known (a pipe seen as a short arc); None: it is fitted.
///     weights: (n,) float64, relative weights 1/sigma**2; None: all equal. Not together with `robust`.
///     sigma_mm: standard deviation of a point (of weight 1) along the normal; None: the residuals tell it.
///     robust: outliers may be present (up to 60 %): MSAC start over directions of the whole hemisphere, reweighting,
///     and
///         a last fit without truncation on the points within three standard deviations.
///     seed: of the random samples; the same seed gives the same result.
///
/// Returns:
///     CylinderFit with `point_mm` (of the axis, nearest to the mean of the data), `axis` (unit, its largest component
///     positive), `radius_mm`, `rms_mm`, `covariance` (point in mm, axis, and radius in mm where it was fitted; NaN
///     without redundancy), `iterations`, `inliers`.
///
/// Raises:
///     InputError: wrong shape, NaN or infinity, radius, weights or sigma out of range.
///     GeometryError: too few points; points that are equal, collinear, coplanar or too flat.
///
/// Source: Shakarji, Least-squares fitting algorithms of the NIST algorithm testing system, J. Res. NIST 103 (1998).
///
/// Example:
///     >>> import numpy as np, weldscan
///     >>> angle, z = np.linspace(0, 2, 60), np.tile([0.0, 5.0, 9.0], 20)
///     >>> pipe = weldscan.fit_cylinder(np.c_[3 * np.cos(angle), 3 * np.sin(angle), z])
///     >>> round(pipe.radius_mm, 9), np.abs(pipe.axis).round(9).tolist()
///     (3.0, [0.0, 0.0, 1.0])
#[pyfunction]
#[pyo3(signature = (points, radius_mm=None, *, weights=None, sigma_mm=None, robust=false, seed=0))]
fn fit_cylinder(
    py: Python<'_>,
    points: &Bound<'_, PyAny>,
    radius_mm: Option<f64>,
    weights: Option<&Bound<'_, PyAny>>,
    sigma_mm: Option<f64>,
    robust: bool,
    #[pyo3(from_py_with = whole)] seed: usize,
) -> PyResult<CylinderFit> {
    let array = float_matrix("points", points)?;
    let weights = weights_of(&array, weights, robust)?;
    let (list, weights) = (as_points("points", &array)?, weights.as_ref().map(|w| w.as_slice()).transpose()?);
    if robust {
        let (fit, inliers) = compute(py, || robust::cylinder(list, radius_mm, sigma_mm, seed as u64))?;
        return Ok(CylinderFit::of(&fit, Some(inliers)));
    }
    Ok(CylinderFit::of(&compute(py, || cylinder::fit(list, radius_mm, PointNoise { weights, sigma_mm }))?, None))
}

/// Returns the centre (3,) and the radius of the sphere through four points, in closed form.
///
/// Solves `C1 x + C2 y + C3 z + C4 = -(x² + y² + z²)` for the four points; centre `-(C1, C2, C3) / 2`, radius
/// `sqrt(C1² + C2² + C3² - 4 C4) / 2`.
///
/// Args:
///     points: (4, 3) float64, mm, any frame.
///
/// Returns:
///     centre (3,) float64 and radius, mm.
///
/// Raises:
///     InputError: not four points, NaN or infinity.
///     GeometryError: the points lie in a plane.
///
/// Source: Filippov et al., Welded joints geometry testing by means of automated structured light scanning, Eqs. 2-7,
/// with a column of ones in (2), the negative right side in (3) and the radius as above.
///
/// Example:
///     >>> import weldscan
///     >>> centre, radius = weldscan.sphere_through_points([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 1]])
///     >>> bool(abs(centre).max() < 1e-12), round(radius, 9)
///     (True, 1.0)
#[pyfunction]
fn sphere_through_points<'py>(
    py: Python<'py>,
    points: &Bound<'_, PyAny>,
) -> PyResult<(Bound<'py, PyArray1<f64>>, f64)> {
    let array = float_matrix("points", points)?;
    let list = as_points("points", &array)?;
    let found = compute(py, || sphere::through_points(list))?;
    Ok((convert::array(py, &found.center_mm), found.radius_mm))
}

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PlaneFit>()?;
    m.add_class::<SphereFit>()?;
    m.add_class::<CylinderFit>()?;
    m.add_function(wrap_pyfunction!(fit_plane, m)?)?;
    m.add_function(wrap_pyfunction!(fit_sphere, m)?)?;
    m.add_function(wrap_pyfunction!(fit_cylinder, m)?)?;
    m.add_function(wrap_pyfunction!(sphere_through_points, m)?)
}
