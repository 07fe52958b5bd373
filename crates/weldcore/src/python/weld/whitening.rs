//! Whitened columns for Python (see `weldscan.measure.calibration_margin`).

use numpy::{IntoPyArray, PyArray2, PyArrayMethods, PyUntypedArrayMethods};
use pyo3::prelude::*;

use crate::error::Error;
use crate::python::call::{compute, raise};
use crate::python::convert::float_matrix;
use crate::weld::whitening;

/// Divides columns over points of one wall by the root of the wall's covariance.
///
/// places_mm: (n, 2), around and along the wall. columns: (n, k). support_mm: where the correlation ends, around and along.
/// nugget: variance that neighbours do not share, in units of the other's. Returns (n, k) float64. Raises InputError for arrays
/// that do not belong together or hold NaN, and for numbers that are not above zero. Source:
/// `crates/weldcore/src/weld/whitening.rs`.
#[pyfunction]
fn whitened<'py>(
    py: Python<'py>,
    places_mm: &Bound<'py, PyAny>,
    columns: &Bound<'py, PyAny>,
    support_mm: (f64, f64),
    nugget: f64,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let (places, columns) = (float_matrix("places_mm", places_mm)?, float_matrix("columns", columns)?);
    let (n, wide) = (places.shape()[0], columns.shape()[1]);
    if places.shape()[1] != 2 || columns.shape()[0] != n {
        let (expected, got) = ("(n, 2) and (n, k)".into(), format!("{:?} and {:?}", places.shape(), columns.shape()));
        return Err(raise(py, &Error::Shape { what: "places_mm and columns", expected, got }));
    }
    let (places, values) = (places.as_slice()?.as_chunks::<2>().0, columns.as_slice()?);
    let found = compute(py, || whitening::whitened(places, support_mm.into(), nugget, values))?;
    found.into_pyarray(py).reshape([n, wide])
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(whitened, m)?)
}
