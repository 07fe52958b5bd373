//! Images as they come from Python, and as they go there.

use numpy::ndarray::IxDyn;
use numpy::{PyArray1, PyArray2, PyArrayDyn, PyArrayMethods, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::prelude::*;

use crate::error::Error;
use crate::python::call::raise;
use crate::python::convert::{float_matrix, unmasked};

/// Hands a vector to numpy as an image, without a copy.
pub(crate) fn image<T: numpy::Element>(
    py: Python<'_>,
    values: Vec<T>,
    height: usize,
    width: usize,
) -> PyResult<Py<PyArray2<T>>> {
    Ok(PyArray1::from_vec(py, values).reshape([height, width])?.unbind())
}

pub(crate) fn shaped<T: numpy::Element>(
    py: Python<'_>,
    values: Vec<T>,
    shape: &[usize],
) -> PyResult<Py<PyArrayDyn<T>>> {
    Ok(PyArray1::from_vec(py, values).reshape(IxDyn(shape))?.unbind())
}

/// A frame as an array of `T`, or `None` where it is of another type.
pub(crate) fn frame<'py, T: numpy::Element>(given: &Bound<'py, PyAny>) -> PyResult<Option<PyReadonlyArray2<'py, T>>> {
    unmasked("an image", given)?;
    let Ok(array) = given.cast::<PyArray2<T>>() else { return Ok(None) };
    if array.is_c_contiguous() {
        return Ok(Some(array.readonly()));
    }
    let copy = given.py().import("numpy")?.call_method1("ascontiguousarray", (array,))?;
    Ok(Some(copy.cast_into::<PyArray2<T>>()?.readonly()))
}

/// Images as the core takes them: a list of (H, W) arrays or a stack (N, H, W), of one type, levels as they are.
pub(crate) enum Images<'py> {
    U8(Vec<PyReadonlyArray2<'py, u8>>),
    U16(Vec<PyReadonlyArray2<'py, u16>>),
    F64(Vec<PyReadonlyArray2<'py, f64>>),
}

/// The images of an argument, and their shape.
pub(crate) fn images<'py>(what: &'static str, given: &Bound<'py, PyAny>) -> PyResult<(Images<'py>, [usize; 2])> {
    let py = given.py();
    unmasked(what, given)?;
    let wrong = |expected: &str, got: String| raise(py, &Error::Shape { what, expected: expected.into(), got });
    let Ok(items) = given.try_iter() else {
        return Err(wrong("a stack (N, H, W) or a list of (H, W) images", given.get_type().to_string()));
    };
    let frames: Vec<Bound<'py, PyAny>> = items.collect::<PyResult<_>>()?;
    let mut shape = None;
    for f in &frames {
        let here: Option<[usize; 2]> = f.getattr("shape").ok().and_then(|s| s.extract().ok());
        let here = match here {
            Some(here) => here,
            // A nested list is an image, too.
            None => {
                let array = float_matrix(what, f)?;
                [array.shape()[0], array.shape()[1]]
            }
        };
        if *shape.get_or_insert(here) != here {
            return Err(wrong("images of one size", format!("{shape:?} and {here:?}")));
        }
    }
    fn all<'py, T: numpy::Element>(frames: &[Bound<'py, PyAny>]) -> PyResult<Option<Vec<PyReadonlyArray2<'py, T>>>> {
        frames.iter().map(frame::<T>).collect()
    }
    let shape = shape.ok_or_else(|| wrong("images", "none".into()))?;
    let images = if let Some(frames) = all::<u8>(&frames)? {
        Images::U8(frames)
    } else if let Some(frames) = all::<u16>(&frames)? {
        Images::U16(frames)
    } else {
        Images::F64(frames.iter().map(|f| float_matrix(what, f)).collect::<PyResult<_>>()?)
    };
    Ok((images, shape))
}

pub(crate) fn slices<'a, T: numpy::Element>(arrays: &'a [PyReadonlyArray2<'_, T>]) -> PyResult<Vec<&'a [T]>> {
    arrays.iter().map(|a| Ok(a.as_slice()?)).collect()
}
