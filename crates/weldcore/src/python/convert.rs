//! Python's objects as the core takes them, and points the other way.

use numpy::ndarray::Ix1;
use numpy::{
    PyArray, PyArray1, PyArrayMethods, PyReadonlyArray, PyReadonlyArray2, PyUntypedArray, PyUntypedArrayMethods,
};
use pyo3::exceptions::{PyMemoryError, PyOverflowError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyFloat, PyList, PyTuple};

use super::call::{raise, raise_as};
use crate::error::Error;
use crate::ground::transform::{Transform, Vec3};

/// Refuses what is, or holds, a numpy array with masked values: without its mask, what it hides would count.
pub(crate) fn unmasked(what: &str, given: &Bound<'_, PyAny>) -> PyResult<()> {
    let py = given.py();
    if given.is_exact_instance_of::<PyUntypedArray>() || given.is_exact_instance_of::<PyFloat>() {
        return Ok(());
    }
    if let Ok(list) = given.cast_exact::<PyList>() {
        return list.iter().try_for_each(|item| unmasked(what, &item));
    }
    if let Ok(tuple) = given.cast_exact::<PyTuple>() {
        return tuple.iter().try_for_each(|item| unmasked(what, &item));
    }
    if !given.is_instance_of::<PyUntypedArray>() {
        return Ok(());
    }
    let ma = py.import("numpy.ma")?;
    let hidden = || -> PyResult<usize> { ma.call_method1("getmaskarray", (given,))?.call_method0("sum")?.extract() };
    match hidden()? {
        0 => Ok(()),
        n => {
            let remedy = "leave them out, or fill them: `.filled(...)`";
            Err(raise_as(py, "InputError", format!("{what}: {n} of its values are masked; {remedy}")))
        }
    }
}

/// [`unmasked`], of a list of numbers.
pub(crate) fn numbers(what: &'static str, given: &Bound<'_, PyAny>) -> PyResult<Vec<f64>> {
    parts(what, "a list of numbers", given)
}

/// Whatever numpy takes for an array of real numbers, as a C-contiguous float64 array of `D` dimensions; an array that
/// is one already is not copied.
pub(crate) fn floats<'py, D: numpy::ndarray::Dimension>(
    what: &'static str,
    given: &Bound<'py, PyAny>,
) -> PyResult<PyReadonlyArray<'py, f64, D>> {
    let py = given.py();
    unmasked(what, given)?;
    if let Ok(array) = given.cast::<PyArray<f64, D>>()
        && array.is_c_contiguous()
    {
        return Ok(array.readonly());
    }
    let wrong = |got: String| {
        let dimensions = D::NDIM.map_or(String::new(), |n| format!(" of {n} dimensions"));
        raise(py, &Error::Shape { what, expected: format!("an array of real numbers{dimensions}"), got })
    };
    let array = py.import("numpy")?.call_method1("asarray", (given,)).map_err(|e| {
        match e.is_instance_of::<PyMemoryError>(py) {
            true => e,
            false => wrong(given.get_type().name().map_or("another object".into(), |n| n.to_string())),
        }
    })?;
    let dtype = array.getattr("dtype")?;
    if !"biuf".contains(&dtype.getattr("kind")?.extract::<String>()?) {
        return Err(wrong(format!("dtype {dtype}")));
    }
    let options = PyDict::new(py);
    options.set_item("dtype", "float64")?;
    let array = py.import("numpy")?.call_method("ascontiguousarray", (array,), Some(&options))?;
    let shape: Vec<usize> = array.getattr("shape")?.extract()?;
    Ok(array.cast_into::<PyArray<f64, D>>().map_err(|_| wrong(format!("shape {shape:?}")))?.readonly())
}

/// [`floats`] for a matrix.
pub(crate) fn float_matrix<'py>(what: &'static str, given: &Bound<'py, PyAny>) -> PyResult<PyReadonlyArray2<'py, f64>> {
    floats(what, given)
}

/// A C-contiguous `(n, 3)` float64 array as a slice of points, without a copy.
pub(crate) fn points<'a>(what: &'static str, array: &'a PyReadonlyArray2<'_, f64>) -> PyResult<&'a [[f64; 3]]> {
    let py = array.py();
    let wrong = |got: String| {
        raise(py, &Error::Shape { what, expected: "a C-contiguous float64 array of shape (n, 3)".into(), got })
    };
    if array.shape()[1] != 3 {
        return Err(wrong(format!("shape {:?}", array.shape())));
    }
    let flat = array.as_slice().map_err(|_| wrong("strided".into()))?;
    Ok(flat.as_chunks::<3>().0)
}

/// A whole number of Python's, of any size and sign. One beyond the range of usize becomes its nearest: the checks of the
/// range refuse that by name, and a negative number is as wrong as none.
pub(crate) struct Whole(pub usize);

impl<'a, 'py> FromPyObject<'a, 'py> for Whole {
    type Error = PyErr;

    fn extract(given: Borrowed<'a, 'py, PyAny>) -> PyResult<Self> {
        match given.extract() {
            Ok(number) => Ok(Self(number)),
            Err(error) if error.is_instance_of::<PyOverflowError>(given.py()) => {
                Ok(Self(if given.lt(0)? { 0 } else { usize::MAX }))
            }
            Err(error) => Err(error),
        }
    }
}

/// [`Whole`] for an argument.
pub(crate) fn whole(given: &Bound<'_, PyAny>) -> PyResult<usize> {
    Ok(given.extract::<Whole>()?.0)
}

/// [`Whole`] for an argument that may be None.
pub(crate) fn whole_or_none(given: &Bound<'_, PyAny>) -> PyResult<Option<usize>> {
    Ok(given.extract::<Option<Whole>>()?.map(|w| w.0))
}

/// An argument of several parts as a `T`; what is none is named, with what it should be.
pub(crate) fn parts<'py, T>(what: &'static str, expected: &str, given: &Bound<'py, PyAny>) -> PyResult<T>
where
    T: for<'a> FromPyObject<'a, 'py, Error = PyErr>,
{
    let py = given.py();
    unmasked(what, given)?;
    given.extract().map_err(|e: PyErr| {
        raise(py, &Error::Shape { what, expected: expected.into(), got: format!("another: {}", e.value(py)) })
    })
}

/// A 4x4 array as a rigid transform.
pub(crate) fn transform(what: &'static str, array: &PyReadonlyArray2<'_, f64>) -> PyResult<Transform> {
    let py = array.py();
    if array.shape() != [4, 4] {
        let got = format!("shape {:?}", array.shape());
        return Err(raise(py, &Error::Shape { what, expected: "shape (4, 4)".into(), got }));
    }
    let view = array.as_array();
    let rows = std::array::from_fn(|r| std::array::from_fn(|c| view[[r, c]]));
    Transform::from_rows(&rows).map_err(|e| raise(py, &e))
}

/// Three numbers.
pub(crate) fn vector(what: &'static str, given: &Bound<'_, PyAny>) -> PyResult<[f64; 3]> {
    let array = floats::<Ix1>(what, given)?;
    let numbers = array.as_slice()?;
    numbers.try_into().map_err(|_| {
        let got = format!("{} numbers", numbers.len());
        raise(given.py(), &Error::Shape { what, expected: "3 numbers".into(), got })
    })
}

/// A vector as an array.
pub(crate) fn array<'py>(py: Python<'py>, v: &Vec3) -> Bound<'py, PyArray1<f64>> {
    PyArray1::from_slice(py, v.as_slice())
}

/// A vector as text.
pub(crate) fn words(v: &Vec3) -> String {
    format!("[{}, {}, {}]", v.x, v.y, v.z)
}
