//! The simulator as Python sees it.

mod attributes;
pub(crate) mod scene;
pub(crate) mod shot;

use pyo3::prelude::*;

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    shot::register(m)?;
    scene::register(m)
}
