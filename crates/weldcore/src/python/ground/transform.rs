//! The closed-form rigid registration as Python sees it.

use numpy::PyArray2;
use pyo3::prelude::*;

use crate::ground::transform::{Transform, register_rigid};
use crate::python::call::compute;
use crate::python::convert::{float_matrix, floats, points};

/// A transform as a (4, 4) array.
pub(crate) fn rows<'py>(py: Python<'py>, transform: &Transform) -> Bound<'py, PyArray2<f64>> {
    PyArray2::from_owned_array(py, numpy::ndarray::arr2(&transform.to_rows()))
}

/// What `register_rigid` found: `target_from_source`, a (4, 4) rigid transform with det = +1, and `rms_mm`, the weighted
/// rms distance that remains.
#[pyclass(frozen, module = "weldscan", name = "RigidFit")]
pub(crate) struct PyRigidFit {
    pub(crate) fit: Transform,
    /// The weighted rms of the distances that remain, mm.
    #[pyo3(get)]
    pub(crate) rms_mm: f64,
}

#[pymethods]
impl PyRigidFit {
    /// (4, 4) float64: maps the source onto the target.
    #[getter]
    fn target_from_source<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        rows(py, &self.fit)
    }

    fn __repr__(&self) -> String {
        format!("RigidFit(rms_mm={:.6}, target_from_source={:?})", self.rms_mm, self.fit.to_rows())
    }
}

/// The rigid motion with the least weighted sum of squared distances between paired points, in closed form.
///
/// Args:
///     source: (n, 3), mm, n >= 3.
///     target: (n, 3), mm: the partner of each source point, in the target's frame.
///     weights: (n,), 0 or more, of any common scale; None counts all the same.
///
/// Returns:
///     RigidFit: `target_from_source`, (4, 4), det = +1 even where a reflection would fit better; `rms_mm`.
///
/// Raises:
///     InputError: shapes that do not belong together, NaN or infinity, a negative weight.
///     GeometryError: fewer than three points of a weight above zero; collinear points, or any that leave the rotation
///         open.
///
/// Source: Horn, Closed-form solution of absolute orientation using unit quaternions, JOSA A 4 (1987) 629.
///
/// Example:
///     >>> import numpy as np
///     >>> from weldscan import register_rigid
///     >>> source = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
///     >>> fit = register_rigid(source, source + [1, 2, 3])
///     >>> fit.target_from_source[:3, 3].round(12).tolist()
///     [1.0, 2.0, 3.0]
#[pyfunction]
#[pyo3(name = "register_rigid", signature = (source, target, weights=None))]
fn py_register_rigid(
    py: Python<'_>,
    source: &Bound<'_, PyAny>,
    target: &Bound<'_, PyAny>,
    weights: Option<&Bound<'_, PyAny>>,
) -> PyResult<PyRigidFit> {
    let (source, target) = (float_matrix("source", source)?, float_matrix("target", target)?);
    let (source, target) = (points("source", &source)?, points("target", &target)?);
    let weights = weights.map(|w| floats::<numpy::ndarray::Ix1>("weights", w)).transpose()?;
    let weights = weights.as_ref().map(|w| w.as_slice()).transpose()?;
    let (fit, rms_mm) = compute(py, || register_rigid(source, target, weights))?;
    Ok(PyRigidFit { fit, rms_mm })
}

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyRigidFit>()?;
    m.add_function(wrap_pyfunction!(py_register_rigid, m)?)
}
