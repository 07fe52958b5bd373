//! Which pixels look at spheres, for Python (see `weldscan.verification.standards`).

use numpy::{IntoPyArray, PyArray1, PyArray2, PyArrayMethods};
use pyo3::prelude::*;

use super::lens::PyLens;
use crate::python::call::compute;
use crate::python::convert::{float_matrix, points};
use crate::scanner::sphere_caps::{SphereCap, sphere_caps as caps};

type CapOf<'py> = (Bound<'py, PyArray1<i64>>, Bound<'py, PyArray2<f64>>, usize);

/// Per sphere, the pixels whose rays meet its 120 degree cap before any other sphere, and where they meet it.
///
/// lens: the camera's. centres_mm: (n, 3), the camera's frame. radius_mm: of all of them. Returns for each: flat pixel indices,
/// ascending, (k,) int64; unit vectors from the centre to the surface, (k, 3); and how many pixels the cap has, those beyond the
/// image's edge and behind other spheres with it. Raises InputError for a wrong shape, NaN, or a radius that is not above zero.
/// Source: `crates/weldcore/src/scanner/sphere_caps.rs`.
#[pyfunction]
fn sphere_caps<'py>(
    py: Python<'py>,
    lens: PyRef<'py, PyLens>,
    centres_mm: &Bound<'py, PyAny>,
    radius_mm: f64,
) -> PyResult<Vec<CapOf<'py>>> {
    let array = float_matrix("centres_mm", centres_mm)?;
    let (centres, camera) = (points("centres_mm", &array)?, &lens.lens);
    let found = compute(py, || caps(camera, centres, radius_mm))?;
    let hand_over = |cap: SphereCap| {
        let n = cap.pixels.len();
        let pixels = PyArray1::from_iter(py, cap.pixels.into_iter().map(|k| k as i64));
        Ok((pixels, cap.outward.into_flattened().into_pyarray(py).reshape([n, 3])?, cap.whole))
    };
    found.into_iter().map(hand_over).collect()
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(sphere_caps, m)?)
}
