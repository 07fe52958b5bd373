//! Points held against the surface that a cloud shows, for Python (see `weldscan.verification.validation`).

use numpy::{IntoPyArray, PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1};
use pyo3::prelude::*;

use crate::clouds::quadric::{self, Held};
use crate::python::call::compute;
use crate::python::convert::{float_matrix, points as as_points};

/// Distances, their uncertainties, normals.
type HeldArrays<'py> = (Bound<'py, PyArray1<f64>>, Bound<'py, PyArray1<f64>>, Bound<'py, PyArray2<f64>>);

/// Holds points against the quadrics through the patches of a cloud around them.
///
/// cloud: (m, 3), mm. points: (n, 3), mm, same frame. patches: per point the indices of the cloud's points within radius_mm of
/// it, (k,) uint32, as `KdTree.radius` gives them. Returns the points' signed distances (n,) in mm, the quadrics' standard
/// uncertainties there (n,) in mm, and the patches' normals (n, 3), towards which distances are positive; NaN where there are
/// fewer than 30 points, or they lie to one side or further off than the radius. Raises InputError for a wrong shape, NaN, or an
/// index beyond the cloud. Source: `crates/weldcore/src/clouds/quadric.rs`.
#[pyfunction]
fn quadric_distances<'py>(
    py: Python<'py>,
    cloud: &Bound<'py, PyAny>,
    points: &Bound<'py, PyAny>,
    patches: Vec<PyReadonlyArray1<'py, u32>>,
    radius_mm: f64,
) -> PyResult<HeldArrays<'py>> {
    let (cloud, points) = (float_matrix("cloud", cloud)?, float_matrix("points", points)?);
    let (cloud, points) = (as_points("cloud", &cloud)?, as_points("points", &points)?);
    let patches = patches.iter().map(|p| Ok(p.as_slice()?)).collect::<PyResult<Vec<&[u32]>>>()?;
    let found = compute(py, || quadric::held_against(cloud, points, &patches, radius_mm))?;
    let column = |pick: fn(&Held) -> f64| -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_iter(py, found.iter().map(|held| held.as_ref().map_or(f64::NAN, pick)))
    };
    let normals: Vec<f64> =
        found.iter().flat_map(|held| held.map_or([f64::NAN; 3], |held| held.normal.into())).collect();
    let normals = normals.into_pyarray(py).reshape([found.len(), 3])?;
    Ok((column(|held| held.distance_mm), column(|held| held.standard_mm), normals))
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(quadric_distances, m)?)
}
