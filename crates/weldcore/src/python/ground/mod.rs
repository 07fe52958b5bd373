//! Threads, images and transforms as Python sees them.

pub(crate) mod image;
pub(crate) mod threads;
pub(crate) mod transform;

use pyo3::prelude::*;

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    image::register(m)?;
    threads::register(m)?;
    transform::register(m)
}
