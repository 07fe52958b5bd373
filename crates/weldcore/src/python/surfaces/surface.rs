//! Whatever has a surface with a formula: a surface, a fit of one, a sphere that was found.

use pyo3::prelude::*;

use super::fit::{CylinderFit, PlaneFit, sphere_of};
use super::shapes::{PyCylinder, PyPlane};
use crate::surfaces::Surface;

/// The surface of an object; `None` where it is none of these.
pub(crate) fn surface_of(object: &Bound<'_, PyAny>) -> Option<Surface> {
    if let Ok(plane) = object.cast::<PyPlane>() {
        Some(Surface::Plane(plane.get().0))
    } else if let Ok(cylinder) = object.cast::<PyCylinder>() {
        Some(Surface::Cylinder(cylinder.get().0))
    } else if let Ok(fit) = object.cast::<PlaneFit>() {
        Some(Surface::Plane(fit.get().surface))
    } else if let Ok(fit) = object.cast::<CylinderFit>() {
        Some(Surface::Cylinder(fit.get().surface))
    } else {
        sphere_of(object).map(Surface::Sphere)
    }
}
