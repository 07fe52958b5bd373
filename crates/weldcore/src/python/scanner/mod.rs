//! Camera and projector as Python sees them.

pub(crate) mod lens;
mod sphere_caps;
pub(crate) mod triangulate;

use pyo3::prelude::*;

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    lens::register(m)?;
    sphere_caps::register(m)?;
    triangulate::register(m)
}
