//! Plane, sphere and cylinder as Python sees them.

use numpy::PyArray1;
use pyo3::prelude::*;

use crate::python::call::raise;
use crate::python::convert::{array, vector, words};
use crate::surfaces::{Cylinder, Plane, Sphere};

/// A plane, as a target of `distance` and `register_icp`: exact.
///
/// Args:
///     point_mm: (3,) a point on it.
///     normal: (3,) of any length but zero; distances are positive on its side.
///
/// Raises:
///     InputError: a wrong shape, NaN or infinity.
///     GeometryError: a normal of length zero.
///
/// Example:
///     >>> from weldscan import Plane
///     >>> Plane([0, 0, 5], [0, 0, 2]).normal
///     array([0., 0., 1.])
#[pyclass(frozen, module = "weldscan", name = "Plane")]
pub(crate) struct PyPlane(pub(crate) Plane);

#[pymethods]
impl PyPlane {
    #[new]
    fn new(point_mm: &Bound<'_, PyAny>, normal: &Bound<'_, PyAny>) -> PyResult<Self> {
        let plane = Plane::new(vector("point_mm", point_mm)?, vector("normal", normal)?);
        Ok(Self(plane.map_err(|e| raise(point_mm.py(), &e))?))
    }

    /// (3,) float64: a point on it, mm.
    #[getter]
    fn point_mm<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.0.point_mm)
    }

    /// (3,) float64: unit normal.
    #[getter]
    fn normal<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.0.normal)
    }

    fn __repr__(&self) -> String {
        format!("Plane(point_mm={}, normal={})", words(&self.0.point_mm), words(&self.0.normal))
    }
}

/// A sphere, as a target of `distance` and `register_icp`: exact.
///
/// Args:
///     center_mm: (3,)
///     radius_mm: above 0.
///
/// Raises:
///     InputError: a wrong shape, NaN or infinity, a radius that is not above 0.
///
/// Example:
///     >>> from weldscan import Sphere
///     >>> Sphere([0, 0, 0], 15).radius_mm
///     15.0
#[pyclass(frozen, module = "weldscan", name = "Sphere")]
pub(crate) struct PySphere(pub(crate) Sphere);

#[pymethods]
impl PySphere {
    #[new]
    fn new(center_mm: &Bound<'_, PyAny>, radius_mm: f64) -> PyResult<Self> {
        let sphere = Sphere::new(vector("center_mm", center_mm)?, radius_mm);
        Ok(Self(sphere.map_err(|e| raise(center_mm.py(), &e))?))
    }

    /// (3,) float64: centre, mm.
    #[getter]
    fn center_mm<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.0.center_mm)
    }

    /// Radius, mm.
    #[getter]
    fn radius_mm(&self) -> f64 {
        self.0.radius_mm
    }

    fn __repr__(&self) -> String {
        format!("Sphere(center_mm={}, radius_mm={})", words(&self.0.center_mm), self.0.radius_mm)
    }
}

/// A cylinder without ends, as a target of `distance` and `register_icp`: exact.
///
/// Args:
///     point_mm: (3,) a point on the axis.
///     axis: (3,) along the axis, of any length but zero.
///     radius_mm: above 0.
///
/// Raises:
///     InputError: a wrong shape, NaN or infinity, a radius that is not above 0.
///     GeometryError: an axis of length zero.
///
/// Example:
///     >>> from weldscan import Cylinder
///     >>> Cylinder([0, 0, 0], [0, 0, 2], 315)
///     Cylinder(point_mm=[0, 0, 0], axis=[0, 0, 1], radius_mm=315)
#[pyclass(frozen, module = "weldscan", name = "Cylinder")]
pub(crate) struct PyCylinder(pub(crate) Cylinder);

#[pymethods]
impl PyCylinder {
    #[new]
    fn new(point_mm: &Bound<'_, PyAny>, axis: &Bound<'_, PyAny>, radius_mm: f64) -> PyResult<Self> {
        let cylinder = Cylinder::new(vector("point_mm", point_mm)?, vector("axis", axis)?, radius_mm);
        Ok(Self(cylinder.map_err(|e| raise(point_mm.py(), &e))?))
    }

    /// (3,) float64: a point on the axis, mm.
    #[getter]
    fn point_mm<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.0.point_mm)
    }

    /// (3,) float64: unit direction of the axis.
    #[getter]
    fn axis<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.0.axis)
    }

    /// Radius, mm.
    #[getter]
    fn radius_mm(&self) -> f64 {
        self.0.radius_mm
    }

    fn __repr__(&self) -> String {
        let (point, axis) = (words(&self.0.point_mm), words(&self.0.axis));
        format!("Cylinder(point_mm={point}, axis={axis}, radius_mm={})", self.0.radius_mm)
    }
}

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyPlane>()?;
    m.add_class::<PySphere>()?;
    m.add_class::<PyCylinder>()
}
