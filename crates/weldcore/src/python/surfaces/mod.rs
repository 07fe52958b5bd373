//! Surfaces, their fits and the search for spheres as Python sees them.

pub(crate) mod find_spheres;
pub(crate) mod fit;
pub(crate) mod shapes;
mod surface;

use pyo3::prelude::*;

pub(crate) use surface::surface_of;

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    shapes::register(m)?;
    fit::register(m)?;
    find_spheres::register(m)
}
