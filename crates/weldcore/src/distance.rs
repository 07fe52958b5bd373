//! Signed distance to clouds, meshes and analytic surfaces.
//!
//! The sign: positive outside of a sphere or cylinder, and on the side of a plane's or a cloud's normals.

use crate::Vec3;
use crate::error::{Error, Result, require_positive};

/// All points `p` with `normal · (p - point) = 0`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plane {
    point: Vec3,
    normal: Vec3,
}

/// All points at a distance from the centre.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sphere {
    center: Vec3,
    radius: f64,
}

/// All points at a distance from the axis: a cylinder without ends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cylinder {
    point: Vec3,
    axis: Vec3,
    radius: f64,
}

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

/// Where a point meets a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Foot {
    /// Signed distance of the point, mm.
    pub distance: f64,
    /// The nearest point of the surface, mm.
    pub point: Vec3,
    /// The unit normal there.
    pub normal: Vec3,
}

impl Plane {
    /// A plane through `point_mm` with a normal of any length but zero; distances are positive on its side.
    ///
    /// # Errors
    /// [`Error::NonFinite`], [`Error::Degenerate`] for a zero normal.
    pub fn new(point_mm: [f64; 3], normal: [f64; 3]) -> Result<Self> {
        Ok(Self { point: finite("point_mm", point_mm)?, normal: direction("normal", normal)? })
    }

    /// A point on it, mm.
    pub fn point(&self) -> Vec3 {
        self.point
    }

    /// Unit normal.
    pub fn normal(&self) -> Vec3 {
        self.normal
    }

    /// The nearest point of the plane.
    #[inline(always)]
    pub fn foot(&self, p: &Vec3) -> Foot {
        let distance = self.normal.dot(&(p - self.point));
        Foot { distance, point: p - self.normal * distance, normal: self.normal }
    }
}

impl Sphere {
    /// A sphere.
    ///
    /// # Errors
    /// [`Error::NonFinite`], [`Error::OutOfRange`] for a radius that is not above zero.
    pub fn new(center_mm: [f64; 3], radius_mm: f64) -> Result<Self> {
        require_positive("radius_mm", radius_mm)?;
        Ok(Self { center: finite("center_mm", center_mm)?, radius: radius_mm })
    }

    /// Centre, mm.
    pub fn center(&self) -> Vec3 {
        self.center
    }

    /// Radius, mm.
    pub fn radius(&self) -> f64 {
        self.radius
    }

    /// The nearest point of the sphere; from its centre, where all are equally near, the one in direction x.
    #[inline(always)]
    pub fn foot(&self, p: &Vec3) -> Foot {
        let arm = p - self.center;
        let reach = arm.norm();
        let normal = if reach > 0.0 { arm / reach } else { Vec3::x() };
        Foot { distance: reach - self.radius, point: self.center + normal * self.radius, normal }
    }
}

impl Cylinder {
    /// A cylinder about the line through `point_mm` along `axis`, which may have any length but zero.
    ///
    /// # Errors
    /// [`Error::NonFinite`], [`Error::Degenerate`] for a zero axis, [`Error::OutOfRange`] for a radius that is not above
    /// zero.
    pub fn new(point_mm: [f64; 3], axis: [f64; 3], radius_mm: f64) -> Result<Self> {
        require_positive("radius_mm", radius_mm)?;
        let (point, axis) = (finite("point_mm", point_mm)?, direction("axis", axis)?);
        Ok(Self { point, axis, radius: radius_mm })
    }

    /// A point on the axis, mm.
    pub fn point(&self) -> Vec3 {
        self.point
    }

    /// Unit direction of the axis.
    pub fn axis(&self) -> Vec3 {
        self.axis
    }

    /// Radius, mm.
    pub fn radius(&self) -> f64 {
        self.radius
    }

    /// The nearest point of the cylinder; from its axis, where a circle is equally near, one of that.
    #[inline(always)]
    pub fn foot(&self, p: &Vec3) -> Foot {
        let offset = p - self.point;
        let along = self.axis * self.axis.dot(&offset);
        let arm = offset - along;
        let reach = arm.norm();
        let normal = if reach > 0.0 { arm / reach } else { across(&self.axis) };
        Foot { distance: reach - self.radius, point: self.point + along + normal * self.radius, normal }
    }
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

/// A unit vector square to `axis`.
fn across(axis: &Vec3) -> Vec3 {
    axis.cross(&Vec3::ith(axis.iamin(), 1.0)).normalize()
}

fn finite(what: &'static str, v: [f64; 3]) -> Result<Vec3> {
    match v.iter().position(|c| !c.is_finite()) {
        Some(index) => Err(Error::NonFinite { what, index }),
        None => Ok(v.into()),
    }
}

fn direction(what: &'static str, v: [f64; 3]) -> Result<Vec3> {
    let v = finite(what, v)?;
    let largest = v.amax();
    if largest == 0.0 {
        return Err(Error::Degenerate { what, reason: "has no direction: its length is zero".into() });
    }
    // Scaled first: squares of tiny or huge components would under- or overflow.
    Ok((v / largest).normalize())
}
