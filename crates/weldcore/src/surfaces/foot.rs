//! Where a point meets a surface, and the checks of what a surface is described by.

use crate::error::{Error, Result};
use crate::ground::transform::Vec3;

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

/// The vector, if it is one.
pub(super) fn finite(what: &'static str, v: [f64; 3]) -> Result<Vec3> {
    match v.iter().position(|c| !c.is_finite()) {
        Some(index) => Err(Error::NonFinite { what, index }),
        None => Ok(v.into()),
    }
}

/// The unit vector of a direction of any length but zero.
pub(super) fn direction(what: &'static str, v: [f64; 3]) -> Result<Vec3> {
    let v = finite(what, v)?;
    let largest = v.amax();
    if largest == 0.0 {
        return Err(Error::Degenerate { what, reason: "has no direction: its length is zero".into() });
    }
    // Scaled first: squares of tiny or huge components would under- or overflow.
    Ok((v / largest).normalize())
}
