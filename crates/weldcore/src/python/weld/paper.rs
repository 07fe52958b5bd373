//! The paper's chain for Python (see `weldscan.measure.paper_method`).

use numpy::{IntoPyArray, PyArray1};
use pyo3::prelude::*;

use crate::ground::transform::Vec3;
use crate::python::call::compute;
use crate::python::convert::{float_matrix, points, vector};
use crate::weld::paper::{self, Pipe};

/// Edges, counts, which bins count, and their mean.
type HistogramArrays<'py> = (Bound<'py, PyArray1<f64>>, Bound<'py, PyArray1<i64>>, Bound<'py, PyArray1<bool>>, f64);

/// Measures the misalignment of two walls as the paper does.
///
/// points_mm: (n, 3) float64, all points of the part in base. axis_point_mm, axis: (3,), the pipe's axis, unit, from the
/// reference wall to the other wall. radius_mm: of the modelled pipe. Returns the histogram of the other wall's distances: edges
/// (n + 1,) float64 in mm, counts (n,) int64, whether each bin counts (n,) bool, and the count-weighted mean of those in mm.
/// Raises InputError for NaN or a wrong shape, GeometryError where a wall has no points left or ICP nothing to hold on to.
/// Source: `crates/weldcore/src/weld/paper.rs`.
#[pyfunction]
fn misalignment<'py>(
    py: Python<'py>,
    points_mm: &Bound<'py, PyAny>,
    axis_point_mm: &Bound<'py, PyAny>,
    axis: &Bound<'py, PyAny>,
    radius_mm: f64,
) -> PyResult<HistogramArrays<'py>> {
    let given = float_matrix("points_mm", points_mm)?;
    let points = points("points_mm", &given)?;
    let origin_mm = Vec3::from(vector("axis_point_mm", axis_point_mm)?);
    let pipe = Pipe { origin_mm, axis: Vec3::from(vector("axis", axis)?), radius_mm };
    let found = compute(py, || paper::misalignment(points, &pipe))?;
    let arrays = (found.edges_mm.into_pyarray(py), found.counts.into_pyarray(py), found.kept.into_pyarray(py));
    Ok((arrays.0, arrays.1, arrays.2, found.step_mm))
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(misalignment, m)?)
}
