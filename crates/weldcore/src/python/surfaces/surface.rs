//! Whatever has a surface with a formula: a surface, a fit of one, a sphere that was found.

use pyo3::prelude::*;

use super::find_spheres::PyFoundSphere;
use super::fit::{CylinderFit, PlaneFit, SphereFit};
use super::shapes::{PyCylinder, PyPlane, PySphere};
use crate::surfaces::Surface;

/// The surface of an object; `None` where it is none of these.
pub(crate) fn surface_of(object: &Bound<'_, PyAny>) -> Option<Surface> {
    if let Ok(plane) = object.cast::<PyPlane>() {
        Some(Surface::Plane(plane.get().0))
    } else if let Ok(sphere) = object.cast::<PySphere>() {
        Some(Surface::Sphere(sphere.get().0))
    } else if let Ok(cylinder) = object.cast::<PyCylinder>() {
        Some(Surface::Cylinder(cylinder.get().0))
    } else if let Ok(fit) = object.cast::<PlaneFit>() {
        Some(Surface::Plane(fit.get().surface))
    } else if let Ok(fit) = object.cast::<SphereFit>() {
        Some(Surface::Sphere(fit.get().surface))
    } else if let Ok(fit) = object.cast::<CylinderFit>() {
        Some(Surface::Cylinder(fit.get().surface))
    } else {
        object.cast::<PyFoundSphere>().ok().map(|found| Surface::Sphere(found.get().0.sphere))
    }
}
