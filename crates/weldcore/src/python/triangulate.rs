//! Triangulation as Python sees it.

use numpy::{PyArray1, PyArray2, PyArray3, PyArrayMethods, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::prelude::*;

use super::phase::image;
use super::scanner::PyScanner;
use super::{compute, float_matrix, raise};
use crate::error::Error;
use crate::triangulate::{Axis, triangulate as core};

/// Points on the camera's pixel grid, scanner frame.
#[pyclass(frozen, get_all, module = "weldscan", name = "Cloud")]
pub(crate) struct PyCloud {
    /// (H, W, 3) float64, mm, scanner frame; NaN where there is no point.
    points_mm: Py<PyArray3<f64>>,
    /// (H, W) float32, mm: standard deviation along the camera's ray, NaN where there is no point; None if no sigma_px
    /// was given.
    sigma_mm: Option<Py<PyArray2<f32>>>,
}

#[pymethods]
impl PyCloud {
    fn __repr__(&self, py: Python<'_>) -> String {
        let points = self.points_mm.bind(py).readonly();
        let n = points.as_array().iter().skip(2).step_by(3).filter(|z| z.is_finite()).count();
        let shape = points.shape();
        format!("Cloud({n} points on a grid of {} x {})", shape[1], shape[0])
    }
}

/// The point on each camera ray that the projector lights with this column, exactly with both lenses.
///
/// Newton on the depth along each ray against the distorted projector column, to 1e-11. Pixels without a column have no
/// point, nor have those whose point would lie behind either device or outside the projector's image.
///
/// Args:
///     column: (H, W), projector columns (rows for axis "y"), px; NaN for none. The camera's size.
///     scanner: `Scanner`. The camera's rays are computed once and kept in it.
///     sigma_px: (H, W), standard deviation of `column`; then `sigma_mm` along the ray follows by the derivative.
///     axis: "x" if `column` holds columns, "y" if it holds rows.
///
/// Returns:
///     Cloud: `points_mm` (H, W, 3) float64, scanner frame, NaN where none; `sigma_mm` (H, W) float32 or None.
///
/// Raises:
///     InputError: arrays that do not have the camera's size; another axis.
///
/// Example:
///     >>> import numpy as np
///     >>> from weldscan import Lens, Scanner, triangulate
///     >>> lens = Lens(64, 48, [[500, 0, 32], [0, 500, 24], [0, 0, 1]], [0, 0, 0, 0])
///     >>> pose = np.eye(4)
///     >>> pose[0, 3] = 10.0
///     >>> u = np.arange(64.0)[None, :].repeat(48, axis=0)
///     >>> cloud = triangulate(u - 12.5, Scanner(lens, lens, pose))
///     >>> float(np.nanmedian(cloud.points_mm[..., 2]))
///     400.0
#[pyfunction]
#[pyo3(signature = (column, scanner, sigma_px=None, axis="x"))]
fn triangulate(
    column: &Bound<'_, PyAny>,
    scanner: &Bound<'_, PyScanner>,
    sigma_px: Option<&Bound<'_, PyAny>>,
    axis: &str,
) -> PyResult<PyCloud> {
    let py = column.py();
    let axis = match axis {
        "x" => Axis::X,
        "y" => Axis::Y,
        other => {
            let value = format!("{other:?}");
            return Err(raise(py, &Error::OutOfRange { what: "axis", expected: "\"x\" or \"y\"".into(), value }));
        }
    };
    let column = float_matrix("column", column)?;
    let scanner = &scanner.get().scanner;
    let (h, w) = (scanner.camera.height, scanner.camera.width);
    let same_size = |what, shape: &[usize]| {
        let expected = format!("the camera's shape ({h}, {w})");
        if shape == [h, w] {
            Ok(())
        } else {
            Err(raise(py, &Error::Shape { what, expected, got: format!("{shape:?}") }))
        }
    };
    same_size("column", column.shape())?;
    let sigma: Option<PyReadonlyArray2<'_, f32>> = match sigma_px {
        Some(given) => {
            let array = py.import("numpy")?.call_method1("ascontiguousarray", (given, "float32"));
            let array = array.ok().and_then(|a| a.cast_into::<PyArray2<f32>>().ok()).ok_or_else(|| {
                let got = given.get_type().to_string();
                raise(py, &Error::Shape { what: "sigma_px", expected: "an (H, W) array of numbers".into(), got })
            })?;
            same_size("sigma_px", array.shape())?;
            Some(array.readonly())
        }
        None => None,
    };
    let (column, sigma) = (column.as_slice()?, sigma.as_ref().map(|s| s.as_slice()).transpose()?);
    let cloud = compute(py, || core(column, scanner, sigma, axis))?;
    let points = PyArray1::from_vec(py, cloud.points_mm.into_flattened()).reshape([h, w, 3])?.unbind();
    let sigma_mm = sigma.map(|_| image(py, cloud.sigma_mm, h, w)).transpose()?;
    Ok(PyCloud { points_mm: points, sigma_mm })
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyCloud>()?;
    m.add_function(wrap_pyfunction!(triangulate, m)?)
}
