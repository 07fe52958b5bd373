//! `weldscan.find_spheres`.

use numpy::{IxDyn, PyArray1, PyArray2, PyUntypedArrayMethods};
use pyo3::prelude::*;

use crate::error::Error;
use crate::python::call::{compute, raise};
use crate::python::convert::{array, floats, whole_or_none};
use crate::surfaces::find_spheres::{FoundSphere, find};

/// A sphere found by `find_spheres`.
#[pyclass(frozen, module = "weldscan", name = "FoundSphere")]
pub(crate) struct PyFoundSphere(pub(crate) FoundSphere);

#[pymethods]
impl PyFoundSphere {
    /// Centre, (3,) float64, mm.
    #[getter]
    fn center_mm<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.0.sphere.center_mm)
    }

    /// The radius that was given, mm.
    #[getter]
    fn radius_mm(&self) -> f64 {
        self.0.sphere.radius_mm
    }

    /// Covariance of the centre, (3, 3) float64, mm².
    #[getter]
    fn covariance<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let rows: Vec<Vec<f64>> = (0..3).map(|r| (0..3).map(|c| self.0.covariance[(r, c)]).collect()).collect();
        Ok(PyArray2::from_vec2(py, &rows)?)
    }

    /// Root mean square of the inliers' distances, mm.
    #[getter]
    fn rms_mm(&self) -> f64 {
        self.0.rms_mm
    }

    /// Flat indices of the points on the sphere, ascending, int64.
    #[getter]
    fn inliers<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<i64>> {
        PyArray1::from_iter(py, self.0.inliers.iter().map(|&i| i as i64))
    }

    /// Solid angle seen, in parts of a hemisphere; 0.5 is the whole 120° cap.
    #[getter]
    fn coverage(&self) -> f64 {
        self.0.coverage
    }

    /// The radius of the same points when it is set free, mm.
    #[getter]
    fn free_radius_mm(&self) -> f64 {
        self.0.free_radius_mm
    }

    /// Standard uncertainty of the free radius, mm.
    #[getter]
    fn free_radius_sigma_mm(&self) -> f64 {
        self.0.free_radius_sigma_mm
    }

    fn __repr__(&self) -> String {
        let s = &self.0;
        let c = s.sphere.center_mm;
        format!(
            "FoundSphere(center_mm=({:.4}, {:.4}, {:.4}), radius_mm={}, rms_mm={:.4}, {} inliers, coverage={:.2})",
            c[0],
            c[1],
            c[2],
            s.sphere.radius_mm,
            s.rms_mm,
            s.inliers.len(),
            s.coverage
        )
    }
}

/// Finds the spheres of a known radius in a raw cloud, with no hint but that radius.
///
/// Normals vote for centres; where votes meet, a sphere of fixed radius is fitted by orthogonal distance to the points
/// within three standard deviations (the noise is taken from the data) and within 60° of the line of sight (the cone of
/// ASTM E3125: beyond it light is seen too obliquely). What is not a sphere of that size is refused: planes, cylinders,
/// edges, spheres whose radius, set free, misses the given one by more than four of its standard uncertainties and 0.5
/// %.
///
/// Args:
///     points: (H, W, 3) float64, the pixel grid of a scanner (rows down, columns right), NaN where a pixel has no
///     point;
///         or (n, 3), a bare cloud without NaN. mm, any frame; a bare cloud whose origin is the scanner's is trimmed to
///         the cone about the line of sight, any other is not.
///     radius_mm: radius of the spheres, mm.
///     count: how many there must be; the best are returned. None: all, perhaps none.
///
/// Returns:
///     list of FoundSphere, the one with the most inliers first.
///
/// Raises:
///     InputError: wrong shape, infinite (in a bare cloud also NaN) coordinates, radius or count out of range.
///     GeometryError: fewer than `count` are there; says why other places were refused.
///
/// Example:
///     >>> import numpy as np, weldscan
///     >>> rng = np.random.default_rng(1)
///     >>> d = rng.normal(size=(5000, 3))
///     >>> ball = [0, 0, 400] + 10 * d / np.linalg.norm(d, axis=1, keepdims=True)
///     >>> plate = np.c_[rng.uniform(-40, 40, (5000, 2)), np.full(5000, 415.0)]
///     >>> [sphere] = weldscan.find_spheres(np.vstack([ball, plate]), 10)
///     >>> bool(np.allclose(sphere.center_mm, [0, 0, 400]))
///     True
#[pyfunction]
#[pyo3(signature = (points, radius_mm, count=None))]
fn find_spheres(
    py: Python<'_>,
    points: &Bound<'_, PyAny>,
    radius_mm: f64,
    #[pyo3(from_py_with = whole_or_none)] count: Option<usize>,
) -> PyResult<Vec<PyFoundSphere>> {
    let array = floats::<IxDyn>("points", points)?;
    let width = match *array.shape() {
        [_, 3] => None,
        [_, width, 3] => Some(width),
        ref shape => {
            let (expected, got) = ("(n, 3) or (H, W, 3)".into(), format!("shape {shape:?}"));
            return Err(raise(py, &Error::Shape { what: "points", expected, got }));
        }
    };
    let flat = array.as_slice()?.as_chunks::<3>().0;
    let found = compute(py, || find(flat, width, radius_mm, count))?;
    Ok(found.into_iter().map(PyFoundSphere).collect())
}

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyFoundSphere>()?;
    m.add_function(wrap_pyfunction!(find_spheres, m)?)
}
