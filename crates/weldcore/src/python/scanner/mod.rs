//! Camera and projector as Python sees them.

mod calibrated_region;
pub(crate) mod lens;
mod sphere_caps;
pub(crate) mod triangulate;

use pyo3::prelude::*;

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    calibrated_region::register(m)?;
    lens::register(m)?;
    sphere_caps::register(m)?;
    triangulate::register(m)
}
