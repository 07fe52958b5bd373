//! Decoding and unwrapping as Python sees them.

pub(crate) mod decode;
pub(crate) mod images;
mod quality;
pub(crate) mod response;
mod unwrap;
pub(crate) mod wrapped;

use pyo3::prelude::*;

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    decode::register(m)?;
    wrapped::register(m)?;
    quality::register(m)?;
    response::register(m)?;
    unwrap::register(m)
}
