//! Clouds and meshes as Python sees them.

pub(crate) mod distance;
pub(crate) mod icp;
pub(crate) mod kdtree;
pub(crate) mod normals;
mod quadric;

use pyo3::prelude::*;

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    distance::register(m)?;
    icp::register(m)?;
    kdtree::register(m)?;
    normals::register(m)?;
    quadric::register(m)
}
