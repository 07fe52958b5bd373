//! Any of the surfaces with a formula.

use super::cylinder::Cylinder;
use super::foot::Foot;
use super::plane::Plane;
use super::sphere::Sphere;
use crate::ground::transform::Vec3;

/// A surface with a formula: distances to it are exact.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Surface {
    /// A plane.
    Plane(Plane),
    /// A sphere.
    Sphere(Sphere),
    /// A cylinder without ends.
    Cylinder(Cylinder),
}

impl Surface {
    /// The nearest point of the surface.
    #[inline(always)]
    pub fn foot(&self, p: &Vec3) -> Foot {
        match self {
            Self::Plane(plane) => plane.foot(p),
            Self::Sphere(sphere) => sphere.foot(p),
            Self::Cylinder(cylinder) => cylinder.foot(p),
        }
    }
}
