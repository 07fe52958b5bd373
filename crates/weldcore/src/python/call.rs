//! Calling the core: detached from the interpreter, ended by Ctrl-C, its errors turned into exceptions.

use std::cell::Cell;

use pyo3::exceptions::{PyKeyboardInterrupt, PyMemoryError};
use pyo3::prelude::*;

use crate::error::{Error, Result};
use crate::ground::stop::{Stopped, attended};

/// Turns a core error into the exception of the same kind from `weldscan.errors`.
pub(crate) fn raise(py: Python<'_>, error: &Error) -> PyErr {
    let class = match error {
        Error::Shape { .. } | Error::NonFinite { .. } | Error::OutOfRange { .. } | Error::Image { .. } => "InputError",
        Error::TooFew { .. } | Error::Degenerate { .. } | Error::NoAnswer { .. } | Error::NotFound { .. } => {
            "GeometryError"
        }
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
pub(crate) fn compute<T: Send>(py: Python<'_>, job: impl FnOnce() -> Result<T> + Send) -> PyResult<T> {
    crate::ground::threads::threads().map_err(|e| raise(py, &e))?;
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
