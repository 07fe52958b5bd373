//! Iterative closest point as Python sees it.

use numpy::ndarray::Array2;
use numpy::{IntoPyArray, PyArray1, PyArray2};
use pyo3::prelude::*;

use crate::clouds::distance::Target;
use crate::clouds::icp::{self, Metric, Options, Registration, RobustKernel, Weak, WeakKind};
use crate::clouds::normals;
use crate::error::Error;
use crate::python::call::raise;
use crate::python::clouds::distance::Given;
use crate::python::clouds::normals::NEIGHBOURS;
use crate::python::convert::{array, words};
use crate::python::convert::{float_matrix, points, transform, whole, whole_or_none};
use crate::python::ground::transform::rows;

/// A direction along which `register_icp` did not move the pose, because the pairs do not show it.
#[pyclass(frozen, module = "weldscan", name = "WeakDirection")]
#[derive(Clone)]
pub(crate) struct PyWeak(pub(crate) Weak);

#[pymethods]
impl PyWeak {
    /// "translation", "rotation" or "screw" (a rotation with a pitch).
    #[getter]
    fn kind(&self) -> &'static str {
        match self.0.kind {
            WeakKind::Translation => "translation",
            WeakKind::Rotation => "rotation",
            WeakKind::Screw => "screw",
        }
    }

    /// (3,) float64: unit direction, in the target's frame.
    #[getter]
    fn axis<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.0.axis)
    }

    /// (3,) float64: a point of the line of a rotation, mm, in the target's frame; None for a translation.
    #[getter]
    fn point_mm<'py>(&self, py: Python<'py>) -> Option<Bound<'py, PyArray1<f64>>> {
        self.0.point_mm.map(|p| array(py, &p))
    }

    /// By how much the residuals change when the points move by 1 mm along it, mm rms.
    #[getter]
    fn strength(&self) -> f64 {
        self.0.strength
    }

    /// (6,) float64: rotation vector (rad), translation (mm) about the origin of the target's frame, for 1 rad or 1 mm.
    #[getter]
    fn vector<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_slice(py, self.0.vector.as_slice())
    }

    fn __repr__(&self) -> String {
        let point = self.0.point_mm.map_or(String::new(), |p| format!(", point_mm={}", words(&p)));
        format!("WeakDirection({}, axis={}{point})", self.kind(), words(&self.0.axis))
    }
}

/// What `register_icp` found.
#[pyclass(frozen, module = "weldscan", name = "Registration")]
pub(crate) struct PyRegistration(pub(crate) Registration);

#[pymethods]
impl PyRegistration {
    /// (4, 4) float64: maps the source onto the target; det = +1.
    #[getter]
    fn target_from_source<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        rows(py, &self.0.target_from_source)
    }

    /// Whether the last round moved no point further than the tolerance.
    #[getter]
    fn converged(&self) -> bool {
        self.0.converged
    }

    /// Rounds in all.
    #[getter]
    fn iterations(&self) -> usize {
        self.0.iterations
    }

    /// Root mean square of the inliers' residuals of the metric, mm.
    #[getter]
    fn rms_mm(&self) -> f64 {
        self.0.rms_mm
    }

    /// (k,) uint32: the source points that counted, ascending.
    #[getter]
    fn inliers<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<u32>> {
        PyArray1::from_slice(py, &self.0.inliers)
    }

    /// (6, 6) float64, rad and mm: of a small motion after `target_from_source`, rotation vector then translation, about
    /// the origin of the target's frame; from the scatter of the residuals, taken as independent. The unobserved
    /// directions are left out: nothing is known of them.
    #[getter]
    fn covariance<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        Array2::from_shape_fn((6, 6), |(r, c)| self.0.covariance[(r, c)]).into_pyarray(py)
    }

    /// The directions along which the pose was not moved: a list of `WeakDirection`, translations first.
    #[getter]
    fn unobserved(&self) -> Vec<PyWeak> {
        self.0.unobserved.iter().cloned().map(PyWeak).collect()
    }

    fn __repr__(&self) -> String {
        let r = &self.0;
        let weak: Vec<String> = self.unobserved().iter().map(PyWeak::__repr__).collect();
        format!(
            "Registration(converged={}, iterations={}, rms_mm={:.6}, inliers={}, unobserved=[{}])",
            if r.converged { "True" } else { "False" },
            r.iterations,
            r.rms_mm,
            r.inliers.len(),
            weak.join(", ")
        )
    }
}

/// The rigid motion that brings a cloud onto a target by iterative closest point: least (weighted) squares of the
/// distances between paired points (metric "point") or from the target's tangent planes (metric "plane").
///
/// Each round pairs every source point, moved by the present pose, with the nearest point of the target, and moves the
/// pose by a Gauss-Newton step. Directions that the pairs do not show (about and along the axis of a cylinder) are not
/// moved but reported. With many points the first rounds run on an even choice of them, to come near; the last ones run
/// on all.
///
/// Args:
///     source: (n, 3), mm, n >= 3.
///     target: (m, 3) points, mm, a `KdTree` of them (saves building it), a `Mesh`, a `Plane`, `Sphere` or
///         `Cylinder`, or a fit of one of these.
///     metric: "point" or "plane". "plane" converges in a few rounds; "point" creeps along smooth surfaces.
///     normals: (m, 3) unit normals of the target's points, for a cloud with metric "plane"; points with NaN do not
///         count. None estimates them as `estimate_normals(target)` does.
///     start: (4, 4) target_from_source to start from; None is the identity.
///     max_distance_mm: pairs further apart do not count.
///     trim: share of the pairs, the ones furthest apart, that does not count, 0 to below 1.
///     kernel: None, "huber" or "tukey": how residuals count.
///     kernel_mm: the kernel's width; None takes it from the median residual of each round (1.345 and 4.685 sigma).
///     max_iterations: rounds at most, in all.
///     tolerance_mm: converged when a round moves no point further than this.
///     weak: a direction is unobserved when a motion of 1 mm along it changes the residuals by less than this, mm rms.
///     max_points: register with an even choice of this many points; everything in the answer, inliers and covariance
///         too, is then of these points alone.
///
/// Returns:
///     Registration: `target_from_source`, `converged`, `iterations`, `rms_mm`, `inliers`, `covariance`, `unobserved`.
///
/// Raises:
///     InputError: a wrong shape, NaN or infinity, an option out of range.
///     GeometryError: fewer than three points, or fewer than three pairs that count.
///
/// Source: Besl & McKay, A method for registration of 3-D shapes, PAMI 14 (1992) 239; Chen & Medioni, Object modelling
/// by registration of multiple range images, IVC 10 (1992) 145.
///
/// Example:
///     >>> import numpy as np
///     >>> from weldscan import Cylinder, register_icp
///     >>> angle, z = np.meshgrid(np.linspace(0, 1.5, 40), np.linspace(0, 100, 40))
///     >>> pipe = np.stack([50 * np.cos(angle), 50 * np.sin(angle), z], -1).reshape(-1, 3)
///     >>> found = register_icp(pipe + [0.5, -0.3, 0], Cylinder([0, 0, 0], [0, 0, 1], 50), "plane")
///     >>> [w.kind for w in found.unobserved]
///     ['translation', 'rotation']
///     >>> bool(found.rms_mm < 1e-9)
///     True
#[pyfunction]
#[pyo3(signature = (source, target, metric="point", *, normals=None, start=None, max_distance_mm=f64::INFINITY, trim=0.0,
    kernel=None, kernel_mm=None, max_iterations=100, tolerance_mm=1e-7, weak=0.01, max_points=None),
    text_signature = "(source, target, metric='point', *, normals=None, start=None, max_distance_mm=inf, trim=0.0, \
    kernel=None, kernel_mm=None, max_iterations=100, tolerance_mm=1e-07, weak=0.01, max_points=None)")]
#[allow(clippy::too_many_arguments)]
fn register_icp(
    py: Python<'_>,
    source: &Bound<'_, PyAny>,
    target: &Bound<'_, PyAny>,
    metric: &str,
    normals: Option<&Bound<'_, PyAny>>,
    start: Option<&Bound<'_, PyAny>>,
    max_distance_mm: f64,
    trim: f64,
    kernel: Option<&str>,
    kernel_mm: Option<f64>,
    #[pyo3(from_py_with = whole)] max_iterations: usize,
    tolerance_mm: f64,
    weak: f64,
    #[pyo3(from_py_with = whole_or_none)] max_points: Option<usize>,
) -> PyResult<PyRegistration> {
    let unknown = |what, expected: &str, value: &str| {
        raise(py, &Error::OutOfRange { what, expected: expected.into(), value: format!("'{value}'") })
    };
    let metric = match metric {
        "point" => Metric::Point,
        "plane" => Metric::Plane,
        other => return Err(unknown("metric", "'point' or 'plane'", other)),
    };
    let kernel = match kernel {
        None => RobustKernel::None,
        Some("huber") => RobustKernel::Huber(kernel_mm),
        Some("tukey") => RobustKernel::Tukey(kernel_mm),
        Some(other) => return Err(unknown("kernel", "None, 'huber' or 'tukey'", other)),
    };
    let defaults = Options::default();
    let start = match start {
        Some(given) => transform("start", &float_matrix("start", given)?)?,
        None => defaults.start,
    };
    let options =
        Options { metric, start, max_distance_mm, trim, kernel, max_iterations, tolerance_mm, weak, max_points };
    let source = float_matrix("source", source)?;
    let source = points("source", &source)?;
    let given = normals.map(|n| float_matrix("normals", n)).transpose()?;
    let given = given.as_ref().map(|n| points("normals", n)).transpose()?;
    let found = Given::new(target)?.compute(py, given, |target| match target {
        Target::Cloud(tree, None) if metric == Metric::Plane => {
            let estimated = normals::of_tree(tree, NEIGHBOURS.min(tree.len()), [0.0; 3])?;
            icp::register(source, &Target::Cloud(tree, Some(&estimated)), &options)
        }
        target => icp::register(source, target, &options),
    })?;
    Ok(PyRegistration(found))
}

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyWeak>()?;
    m.add_class::<PyRegistration>()?;
    m.add_function(wrap_pyfunction!(register_icp, m)?)
}
