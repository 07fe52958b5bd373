//! A pipe's coordinates: angle, place along the axis, height over its cylinder.

use crate::error::{Error, Result, require_positive};
use crate::ground::threads;
use crate::ground::transform::Vec3;

/// A pipe's axis with the origins of angle and axial coordinate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PipeFrame {
    /// On the axis, at the seam's centreline.
    pub origin_mm: Vec3,
    /// Unit, from the reference wall to the other wall.
    pub axis: Vec3,
    /// Unit, at right angles to the axis: angle 0. Angles are right-handed about the axis.
    pub zero: Vec3,
    /// Of the reference wall.
    pub radius_mm: f64,
}

impl PipeFrame {
    /// A frame whose zero direction is the given one made square to the axis.
    ///
    /// # Errors
    /// [`Error::Degenerate`] where the zero mark lies along the axis.
    pub fn new(origin_mm: Vec3, axis: Vec3, zero: Vec3, radius_mm: f64) -> Result<Self> {
        let what = "pipe frame";
        let axis = axis
            .try_normalize(0.0)
            .ok_or_else(|| Error::Degenerate { what, reason: "the axis has no direction".into() })?;
        let zero = (zero - axis * axis.dot(&zero))
            .try_normalize(1e-6 * zero.norm())
            .ok_or_else(|| Error::Degenerate { what, reason: "the zero mark lies along the axis".into() })?;
        require_positive("pipe radius", radius_mm)?;
        Ok(Self { origin_mm, axis, zero, radius_mm })
    }

    /// The point of the cylinder at an angle and an axial coordinate.
    pub fn point(&self, angle_rad: f64, axial_mm: f64) -> Vec3 {
        let (sin, cos) = angle_rad.sin_cos();
        let out = self.zero * cos + self.axis.cross(&self.zero) * sin;
        self.origin_mm + self.axis * axial_mm + out * self.radius_mm
    }

    /// Angle (rad, in [-π, π]), axial coordinate and radial deviation (mm) of a point.
    #[inline]
    pub fn unroll(&self, p: &[f64; 3]) -> [f64; 3] {
        let v = Vec3::from(*p) - self.origin_mm;
        let axial = v.dot(&self.axis);
        let (x, y) = (v.dot(&self.zero), v.dot(&self.axis.cross(&self.zero)));
        [y.atan2(x), axial, x.hypot(y) - self.radius_mm]
    }
}

/// A shot's points in a [`PipeFrame`], pixel by pixel; NaN where there is no point.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Unrolled {
    /// Angle about the axis, rad, in [-π, π].
    pub angle_rad: Vec<f32>,
    /// Along the axis, mm.
    pub axial_mm: Vec<f32>,
    /// Radial deviation from the reference wall's cylinder, mm.
    pub deviation_mm: Vec<f32>,
}

impl Unrolled {
    /// Unrolls every point.
    pub fn of(points: &[[f64; 3]], frame: &PipeFrame) -> Self {
        let square = frame.axis.cross(&frame.zero);
        let parts = threads::map_chunks(points, |_, chunk| {
            let mut part = Self::default();
            for p in chunk {
                let v = Vec3::from(*p) - frame.origin_mm;
                let (x, y) = (v.dot(&frame.zero), v.dot(&square));
                part.angle_rad.push((y as f32).atan2(x as f32));
                part.axial_mm.push(v.dot(&frame.axis) as f32);
                part.deviation_mm.push(((x * x + y * y).sqrt() - frame.radius_mm) as f32);
            }
            part
        });
        let gather = |pick: fn(&Self) -> &Vec<f32>| {
            let mut all = Vec::with_capacity(points.len());
            parts.iter().for_each(|p| all.extend_from_slice(pick(p)));
            all
        };
        Self {
            angle_rad: gather(|p| &p.angle_rad),
            axial_mm: gather(|p| &p.axial_mm),
            deviation_mm: gather(|p| &p.deviation_mm),
        }
    }
}
