//! Reading images.

use numpy::PyArray;
use numpy::ndarray::Array2;
use pyo3::prelude::*;

use crate::ground::image::{self, Pixels};
use crate::python::call::{compute, raise_as};
use crate::python::convert::Whole;

/// The pixels of a grey PNG of 8 or 16 bits, read strictly: what is truncated, damaged or in colour is refused.
///
/// Args:
///     data: bytes of the file.
///     size: (columns, rows) that the image must have; None for any.
///
/// Returns:
///     (rows, columns) uint8 or uint16.
///
/// Raises:
///     InputError: says what the file is and what it should be.
///
/// Example:
///     >>> import cv2, numpy as np
///     >>> data = cv2.imencode(".png", np.array([[1, 2, 3]], np.uint8))[1].tobytes()
///     >>> from weldscan import decode_png
///     >>> decode_png(data)
///     array([[1, 2, 3]], dtype=uint8)
///     >>> decode_png(data[:-9])
///     Traceback (most recent call last):
///     weldscan.errors.InputError: is truncated: the PNG breaks off after ... bytes
#[pyfunction]
#[pyo3(signature = (data, size=None))]
fn decode_png<'py>(py: Python<'py>, data: &[u8], size: Option<[Whole; 2]>) -> PyResult<Bound<'py, PyAny>> {
    let image = compute(py, || image::decode_png(data, size.map(|side| side.map(|w| w.0))))?;
    let shape = (image.height, image.width);
    let misfit = |e: numpy::ndarray::ShapeError| raise_as(py, "InputError", e.to_string());
    Ok(match image.pixels {
        Pixels::U8(v) => PyArray::from_owned_array(py, Array2::from_shape_vec(shape, v).map_err(misfit)?).into_any(),
        Pixels::U16(v) => PyArray::from_owned_array(py, Array2::from_shape_vec(shape, v).map_err(misfit)?).into_any(),
    })
}

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(decode_png, m)?)
}
