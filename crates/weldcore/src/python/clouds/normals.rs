//! Surface normals as Python sees them.

use numpy::ndarray::{Array2, Array3, Ix2, Ix3};
use numpy::{IntoPyArray, PyUntypedArrayMethods};
use pyo3::prelude::*;

use crate::clouds::normals;
use crate::error::Error;
use crate::python::call::{compute, raise};
use crate::python::convert::vector;
use crate::python::convert::{floats, points, whole};

/// Neighbours that fix a plane in a bare cloud, the point itself included.
pub(crate) const NEIGHBOURS: usize = 20;

/// Surface normals: square to the least-squares plane of each point's neighbours, towards the viewpoint.
///
/// A grid (H, W, 3) takes its neighbours from the pixels around, and leaves out those across a jump of depth (further
/// away than four times the pixels' common distance). A bare cloud (n, 3) takes the k nearest points.
///
/// Args:
///     points: (H, W, 3), mm, NaN where there is no point; or (n, 3), mm, finite.
///     viewpoint: (3,) mm: normals point to its side. None is the origin, where a scanner has its camera.
///     k: points that fix a plane in a bare cloud, the point itself included; 3 to n.
///     window: side of the square of pixels that fixes a plane in a grid: odd, 3 or more.
///
/// Returns:
///     float64 of the shape of the points: unit vectors; NaN where there is no point, or the neighbours fix no plane.
///
/// Raises:
///     InputError: a wrong shape, NaN or infinity in a bare cloud, k or window out of range.
///     GeometryError: fewer than k points in a bare cloud.
///
/// Example:
///     >>> import numpy as np
///     >>> from weldscan import estimate_normals
///     >>> x, y = np.meshgrid(np.arange(8.0), np.arange(6.0))
///     >>> grid = np.stack([x, y, np.full_like(x, 300.0)], -1)
///     >>> bool(np.allclose(estimate_normals(grid), [0, 0, -1]))
///     True
///     >>> bool(np.allclose(estimate_normals(grid.reshape(-1, 3)), [0, 0, -1]))
///     True
#[pyfunction]
#[pyo3(signature = (points, viewpoint=None, *, k=20, window=5))]
fn estimate_normals<'py>(
    py: Python<'py>,
    points: &Bound<'py, PyAny>,
    viewpoint: Option<&Bound<'py, PyAny>>,
    #[pyo3(from_py_with = whole)] k: usize,
    #[pyo3(from_py_with = whole)] window: usize,
) -> PyResult<Bound<'py, PyAny>> {
    let viewpoint = viewpoint.map_or(Ok([0.0; 3]), |v| vector("viewpoint", v))?;
    let wrong =
        |got: String| raise(py, &Error::Shape { what: "points", expected: "shape (H, W, 3) or (n, 3)".into(), got });
    let dimensions =
        py.import("numpy")?.call_method1("ndim", (points,)).and_then(|n| n.extract::<usize>()).unwrap_or(0);
    if dimensions == 3 {
        let array = floats::<Ix3>("points", points)?;
        let &[height, width, 3] = array.shape() else { return Err(wrong(format!("shape {:?}", array.shape()))) };
        let grid = array.as_slice()?.as_chunks::<3>().0;
        let normals = compute(py, || match width {
            0 => Ok(Vec::new()),
            _ => normals::of_grid(grid, width, window, viewpoint),
        })?;
        let normals = Array3::from_shape_vec((height, width, 3), normals.into_flattened());
        return Ok(normals.map_err(|e| wrong(e.to_string()))?.into_pyarray(py).into_any());
    }
    let array = floats::<Ix2>("points", points)?;
    let cloud = self::points("points", &array)?;
    let normals = compute(py, || normals::of_cloud(cloud, k, viewpoint))?;
    let normals = Array2::from_shape_vec((cloud.len(), 3), normals.into_flattened());
    Ok(normals.map_err(|e| wrong(e.to_string()))?.into_pyarray(py).into_any())
}

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(estimate_normals, m)?)
}
