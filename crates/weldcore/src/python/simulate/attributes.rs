//! Objects that are read by attribute.

use pyo3::exceptions::{PyAttributeError, PyOverflowError, PyTypeError, PyValueError};
use pyo3::prelude::*;

use crate::python::call::raise_as;

/// An object that lacks an attribute, or has one of the wrong type, is a wrong input.
pub(crate) fn wrong_object(py: Python<'_>, what: &str, error: PyErr) -> PyErr {
    let wrong = error.is_instance_of::<PyAttributeError>(py)
        || error.is_instance_of::<PyTypeError>(py)
        || error.is_instance_of::<PyOverflowError>(py)
        || error.is_instance_of::<PyValueError>(py);
    if wrong { raise_as(py, "InputError", format!("{what}: {}", error.value(py))) } else { error }
}
