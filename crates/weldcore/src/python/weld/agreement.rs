//! Shots held against each other for Python (see `weldscan.measure.shot_agreement`).

use numpy::{PyArray1, PyReadonlyArray1};
use pyo3::prelude::*;

use crate::error::Error;
use crate::ground::transform::Vec3;
use crate::python::call::{compute, raise};
use crate::python::convert::{array, float_matrix, points, vector};
use crate::weld::agreement::{self, WallCloud};

/// A pair of `wall_differences`: places of both shots, cells, difference, scatter, rms, middle.
type WallPair<'py> = (usize, usize, usize, f64, f64, f64, Bound<'py, PyArray1<f64>>);

/// Holds the walls of every two shots of a placed cloud against each other, cell by cell of the unrolled pipe.
///
/// points_mm: (n, 3) float64, base. labels: (n,) uint8, `weldscan.result.Label`. shots: (n,) uint16, each point's shot.
/// numbers: the shots to compare. origin_mm, axis: (3,), the pipe's axis in base. Returns a list of (place of the one shot in
/// `numbers`, place of the other behind it, common cells, median of how far the other's wall stands further out (mm), scatter
/// of the cells about it (mm, robust, 1 sigma), rms (mm), (3,) middle of the cells in base); none of pairs with fewer than 20
/// common cells. Raises InputError for arrays that do not belong together or hold NaN, GeometryError for an axis without a
/// direction. Source: `crates/weldcore/src/weld/agreement.rs`.
#[pyfunction]
fn wall_differences<'py>(
    py: Python<'py>,
    points_mm: &Bound<'py, PyAny>,
    labels: PyReadonlyArray1<'py, u8>,
    shots: PyReadonlyArray1<'py, u16>,
    numbers: Vec<u16>,
    origin_mm: &Bound<'py, PyAny>,
    axis: &Bound<'py, PyAny>,
) -> PyResult<Vec<WallPair<'py>>> {
    let given = float_matrix("points_mm", points_mm)?;
    let strided = |what| raise(py, &Error::Shape { what, expected: "contiguous".into(), got: "strided".into() });
    let cloud = WallCloud {
        points: points("points_mm", &given)?,
        labels: labels.as_slice().map_err(|_| strided("labels"))?,
        shots: shots.as_slice().map_err(|_| strided("shots"))?,
    };
    let (origin, axis) = (Vec3::from(vector("origin_mm", origin_mm)?), Vec3::from(vector("axis", axis)?));
    let found = compute(py, || agreement::wall_differences(&cloud, &numbers, origin, axis))?;
    let pair = |d: agreement::Difference| {
        (d.one, d.other, d.cells, d.difference_mm, d.scatter_mm, d.rms_mm, array(py, &d.middle_mm))
    };
    Ok(found.into_iter().map(pair).collect())
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(wall_differences, m)?)
}
