//! Threads and masked arrays.

use pyo3::prelude::*;

use crate::python::call::raise;
use crate::python::convert::{unmasked, whole_or_none};

/// Sets how many threads the core uses in this process.
///
/// Args:
///     threads: 1 to 1024; None returns to the default: `WELDSCAN_THREADS`, else `RAYON_NUM_THREADS`, else the number of
///         cores this process may use.
///
/// Raises:
///     InputError: out of range, or the default is (`WELDSCAN_THREADS=0`).
///
/// Example:
///     >>> from weldscan import set_threads
///     >>> set_threads(2)
///     >>> set_threads()
#[pyfunction]
#[pyo3(signature = (threads=None))]
fn set_threads(py: Python<'_>, #[pyo3(from_py_with = whole_or_none)] threads: Option<usize>) -> PyResult<()> {
    crate::ground::threads::set_threads(threads).map_err(|e| raise(py, &e))
}

/// Refuses an array, or lists of arrays, with masked values: without its mask, what it hides would count.
///
/// Args:
///     what: the argument's name, for the message.
///     given: what is to be looked at; what is no array passes.
///
/// Raises:
///     InputError: says how many values are masked.
#[pyfunction]
fn refuse_masked(what: &str, given: &Bound<'_, PyAny>) -> PyResult<()> {
    unmasked(what, given)
}

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(set_threads, m)?)?;
    m.add_function(wrap_pyfunction!(refuse_masked, m)?)
}
