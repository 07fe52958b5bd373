//! The binding, and the only home of pyo3 and numpy. Each wrapper does four things and no arithmetic: it checks shape
//! and order, detaches from the interpreter and calls the core, maps the error, hands the result over without a copy.
//!
//! A room of the core has a file of the same name here with a `register` function.

use std::cell::Cell;

use numpy::{PyArray, PyArrayMethods, PyReadonlyArray, PyReadonlyArray2, PyUntypedArray, PyUntypedArrayMethods};
use pyo3::exceptions::{PyKeyboardInterrupt, PyMemoryError, PyOverflowError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyFloat, PyList, PyTuple};

mod distance;
mod fit;
mod icp;
mod image;
mod kdtree;
mod normals;
mod phase;
mod pickle;
mod response;
mod scanner;
mod segment;
mod simulate;
mod transform;
mod triangulate;

use crate::error::Error;
use crate::memory::Recycler;
use crate::stop::{Stopped, attended};
use crate::transform::Transform;

#[global_allocator]
static ALLOCATOR: Recycler = Recycler;

/// Turns a core error into the exception of the same kind from `weldscan.errors`.
pub(crate) fn raise(py: Python<'_>, error: &Error) -> PyErr {
    let class = match error {
        Error::Shape { .. } | Error::NonFinite { .. } | Error::OutOfRange { .. } | Error::Image { .. } => "InputError",
        Error::TooFew { .. } | Error::Degenerate { .. } | Error::NotFound { .. } => "GeometryError",
    };
    raise_as(py, class, error.to_string())
}

/// An exception of the named class of `weldscan.errors`.
pub(crate) fn raise_as(py: Python<'_>, class: &str, message: String) -> PyErr {
    match py.import("weldscan.errors").and_then(|m| m.getattr(class)).and_then(|c| c.call1((message,))) {
        Ok(value) => PyErr::from_value(value),
        Err(error) => error,
    }
}

/// Detaches from the interpreter, computes, and maps the error. On the thread that hears signals a long computation ends
/// where one is to end it (Ctrl-C).
pub(crate) fn compute<T: Send>(py: Python<'_>, job: impl FnOnce() -> crate::Result<T> + Send) -> PyResult<T> {
    crate::threads::threads().map_err(|e| raise(py, &e))?;
    let main = is_main_thread(py)?;
    let (done, raised) = py.detach(|| {
        let raised = Cell::new(None);
        let hears = || match Python::attach(|py| py.check_signals()) {
            Ok(()) => false,
            Err(error) => {
                raised.set(Some(error));
                true
            }
        };
        let done = attended(main.then_some(&hears as &dyn Fn() -> bool), job);
        (done, raised.into_inner())
    });
    match done {
        Ok(result) => result.map_err(|e| raise(py, &e)),
        Err(Stopped::OutOfMemory) => Err(PyMemoryError::new_err("not enough memory for this computation")),
        Err(Stopped::OnRequest) => Err(raised.unwrap_or_else(|| PyKeyboardInterrupt::new_err(()))),
    }
}

/// Whether this is the thread on which Python runs signal handlers. After a fork it may be another.
fn is_main_thread(py: Python<'_>) -> PyResult<bool> {
    thread_local! {
        static KNOWN: Cell<Option<(u32, bool)>> = const { Cell::new(None) };
    }
    let process = std::process::id();
    if let Some((of, main)) = KNOWN.get()
        && of == process
    {
        return Ok(main);
    }
    let threading = py.import("threading")?;
    let main = threading.call_method0("main_thread")?.getattr("ident")?.eq(threading.call_method0("get_ident")?)?;
    KNOWN.set(Some((process, main)));
    Ok(main)
}

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
    crate::threads::set_threads(threads).map_err(|e| raise(py, &e))
}

#[pymodule]
#[pyo3(name = "_weldcore")]
fn weldcore(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add("__version__", env!("CARGO_PKG_VERSION"))?;
    m.add_function(wrap_pyfunction!(set_threads, m)?)?;
    m.add_function(wrap_pyfunction!(refuse_masked, m)?)?;
    fit::register(m)?;
    scanner::register(m)?;
    phase::register(m)?;
    response::register(m)?;
    triangulate::register(m)?;
    segment::register(m)?;
    kdtree::register(m)?;
    transform::register(m)?;
    distance::register(m)?;
    icp::register(m)?;
    image::register(m)?;
    normals::register(m)?;
    simulate::register(m)?;
    pickle::register(m)
}
