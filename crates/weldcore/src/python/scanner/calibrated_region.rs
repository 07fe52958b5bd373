//! Where a scanner is calibrated, for Python (see `weldscan.measure.session_points`).

use numpy::{IntoPyArray, PyArray2, PyArrayMethods, PyReadonlyArray3, PyUntypedArrayMethods};
use pyo3::prelude::*;

use super::lens::PyScanner;
use crate::error::{Error, Result};
use crate::python::call::{compute, raise};
use crate::python::convert::float_matrix;
use crate::scanner::calibrated_region::{Hull, outside};

/// Which points lie outside the hull of the camera's or of the projector's calibrated pixels.
///
/// points_mm: (H, W, 3) float64, contiguous, scanner frame, on the camera's pixel grid. scanner: Scanner. camera_px, projector_px:
/// corners of convex polygons in order, (n, 2), px. Returns (H, W) bool; False where there is no point. Raises InputError for a
/// wrong shape, or corners of no convex polygon. Source: `crates/weldcore/src/scanner/calibrated_region.rs`.
#[pyfunction]
fn outside_calibration<'py>(
    py: Python<'py>,
    points_mm: PyReadonlyArray3<'py, f64>,
    scanner: PyRef<'py, PyScanner>,
    camera_px: &Bound<'py, PyAny>,
    projector_px: &Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyArray2<bool>>> {
    let shape = points_mm.shape().to_vec();
    let strided =
        |_| raise(py, &Error::Shape { what: "points_mm", expected: "contiguous".into(), got: "strided".into() });
    let points = points_mm.as_slice().map_err(strided)?.as_chunks::<3>().0;
    if shape[2] != 3 {
        let got = format!("shape {shape:?}");
        return Err(raise(py, &Error::Shape { what: "points_mm", expected: "shape (H, W, 3)".into(), got }));
    }
    let hull = |what: &'static str, given: &Bound<'py, PyAny>| -> PyResult<Result<Hull>> {
        let corners = float_matrix(what, given)?;
        if corners.shape()[1] != 2 {
            let got = format!("shape {:?}", corners.shape());
            return Err(raise(py, &Error::Shape { what, expected: "shape (n, 2)".into(), got }));
        }
        Ok(Hull::new(what, corners.as_slice()?.as_chunks::<2>().0))
    };
    let (camera, projector) = (hull("camera_px", camera_px)?, hull("projector_px", projector_px)?);
    let scanner = &scanner.scanner;
    let found = compute(py, || outside(points, scanner, &camera?, &projector?))?;
    found.into_pyarray(py).reshape([shape[0], shape[1]])
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(outside_calibration, m)?)
}
