//! What stands in a simulated scene: analytic shapes, each in its own frame, and their first intersection with a ray.

use crate::error::{Error, Result, require_positive};
use crate::ground::transform::{Transform, Vec3};

use super::ray::{Hit, Ray, entry};
use super::weld::Weld;

/// A shape in its own frame, mm.
#[derive(Debug, Clone, PartialEq)]
pub enum Shape {
    /// A ball about the origin.
    Sphere {
        /// Radius.
        radius_mm: f64,
    },
    /// A box about the origin, with a chessboard on its +z face where `squares` is above zero.
    Block {
        /// Edge lengths.
        size_mm: [f64; 3],
        /// Squares of the chessboard along x and y (inner corners plus one).
        squares: [u32; 2],
        /// Edge of a square.
        square_mm: f64,
    },
    /// The side of a cylinder about z, from z = 0 to its length.
    Stem {
        /// Radius.
        radius_mm: f64,
        /// Length.
        length_mm: f64,
    },
    /// Two walls and the bead between them, about z.
    Weld(Box<Weld>),
}

/// How a surface answers to light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Finish {
    /// Lambert reflectance, 0 to 1.
    pub albedo: f64,
    /// Height of the specular lobe, relative to a white Lambert surface lit squarely.
    pub specular: f64,
    /// Blinn-Phong exponent of the lobe: larger is narrower.
    pub shininess: f64,
    /// Relative amplitude of the brush marks in the albedo.
    pub brushed: f64,
}

/// A shape at its place in the scene.
#[derive(Debug, Clone, PartialEq)]
pub struct Body {
    /// The shape.
    pub shape: Shape,
    /// Its place.
    pub scene_from_body: Transform,
    /// Its surface.
    pub surface: Finish,
    /// Its label in the truth; a weld's parts are label (reference wall), label + 1 (other wall), label + 2 (bead).
    pub label: u8,
}

impl Body {
    /// Checks every number.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] naming the parameter.
    pub fn check(&self) -> Result<()> {
        match &self.shape {
            Shape::Sphere { radius_mm } => require_positive("sphere radius_mm", *radius_mm)?,
            Shape::Block { size_mm, squares, square_mm } => {
                size_mm.iter().try_for_each(|&s| require_positive("block size_mm", s))?;
                if squares[0] > 0 {
                    require_positive("block square_mm", *square_mm)?;
                }
            }
            Shape::Stem { radius_mm, length_mm } => {
                require_positive("stem radius_mm", *radius_mm)?;
                require_positive("stem length_mm", *length_mm)?;
            }
            Shape::Weld(weld) => weld.check()?,
        }
        let s = &self.surface;
        let fraction = |what, value: f64| {
            let refused = || Error::OutOfRange { what, expected: "0 to 1".into(), value: value.to_string() };
            if (0.0..=1.0).contains(&value) { Ok(()) } else { Err(refused()) }
        };
        fraction("surface albedo", s.albedo)?;
        fraction("surface brushed", s.brushed)?;
        require_positive("surface shininess", s.shininess)?;
        if !(s.specular.is_finite() && s.specular >= 0.0) {
            let value = s.specular.to_string();
            return Err(Error::OutOfRange { what: "surface specular", expected: "0 or above".into(), value });
        }
        Ok(())
    }

    /// Radius of a ball about the body's origin that holds it; infinite where there is no use in asking.
    pub(super) fn bound_mm(&self) -> f64 {
        match &self.shape {
            Shape::Sphere { radius_mm } => *radius_mm,
            Shape::Block { size_mm, .. } => 0.5 * Vec3::from(*size_mm).norm(),
            Shape::Stem { radius_mm, length_mm } => radius_mm.hypot(*length_mm),
            Shape::Weld(_) => f64::INFINITY,
        }
    }

    /// The first hit beyond `after`, of a ray in the body's frame.
    #[inline]
    pub(super) fn hit(&self, ray: &Ray, after: f64) -> Option<Hit> {
        match &self.shape {
            Shape::Sphere { radius_mm } => sphere(ray, *radius_mm, after),
            Shape::Block { size_mm, .. } => block(ray, size_mm, after),
            Shape::Stem { radius_mm, length_mm } => stem(ray, *radius_mm, *length_mm, after),
            Shape::Weld(weld) => weld.hit(ray, after),
        }
    }

    /// Albedo at a point of the surface, in the body's frame.
    pub(super) fn albedo(&self, p: &Vec3) -> f64 {
        let Finish { albedo, brushed, .. } = self.surface;
        match &self.shape {
            Shape::Block { size_mm, squares, square_mm } if squares[0] > 0 && p.z > 0.5 * size_mm[2] - 1e-6 => {
                let i = (p.x / square_mm + 0.5 * f64::from(squares[0])).floor();
                let j = (p.y / square_mm + 0.5 * f64::from(squares[1])).floor();
                let outside = i < 0.0 || j < 0.0 || i >= f64::from(squares[0]) || j >= f64::from(squares[1]);
                // The first square is black; black paint returns a twelfth of the light.
                if !outside && (i + j) as i64 % 2 == 0 { albedo / 12.0 } else { albedo }
            }
            Shape::Weld(weld) if brushed > 0.0 => {
                // Marks of a brush that went around the pipe: long along the seam, short across it.
                let place = (weld.along(p), p.z);
                let (coarse, fine) = (weld.texture(place, 60.0, 4.0), weld.texture(place, 17.0, 0.7));
                albedo * (1.0 + brushed * (0.7 * coarse + 0.3 * fine))
            }
            _ => albedo,
        }
    }
}

fn sphere(ray: &Ray, radius: f64, after: f64) -> Option<Hit> {
    let (o, d) = (&ray.origin, &ray.direction);
    let t = entry(d.norm_squared(), o.dot(d), o.norm_squared() - radius * radius)?;
    (t > after).then(|| Hit { t, normal: ray.at(t) / radius, part: 0 })
}

fn block(ray: &Ray, size: &[f64; 3], after: f64) -> Option<Hit> {
    let (mut near, mut far) = (f64::NEG_INFINITY, f64::INFINITY);
    let mut normal = Vec3::zeros();
    for axis in 0..3 {
        let (o, d, half) = (ray.origin[axis], ray.direction[axis], 0.5 * size[axis]);
        if d == 0.0 {
            if o.abs() > half {
                return None;
            }
            continue;
        }
        let (t_in, t_out) = ((-half * d.signum() - o) / d, (half * d.signum() - o) / d);
        if t_in > near {
            near = t_in;
            normal = Vec3::zeros();
            normal[axis] = -d.signum();
        }
        far = far.min(t_out);
    }
    (near <= far && near > after).then_some(Hit { t: near, normal, part: 0 })
}

fn stem(ray: &Ray, radius: f64, length: f64, after: f64) -> Option<Hit> {
    let (o, d) = (&ray.origin, &ray.direction);
    let t = entry(d.x * d.x + d.y * d.y, o.x * d.x + o.y * d.y, o.x * o.x + o.y * o.y - radius * radius)?;
    let p = ray.at(t);
    (t > after && (0.0..=length).contains(&p.z)).then(|| Hit { t, normal: Vec3::new(p.x, p.y, 0.0) / radius, part: 0 })
}
