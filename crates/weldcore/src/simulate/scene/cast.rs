//! Rays of a scanner on a weld's surface.

use std::f64::consts::PI;

use rayon::prelude::*;

use super::super::ray::Ray;
use super::surface::{WeldPart, WeldSurface};
use crate::ground::memory::require;
use crate::ground::stop::polled;
use crate::ground::threads;
use crate::ground::transform::{Transform, Vec3};
use crate::scanner::Scanner;

/// The march along a ray takes slopes up to this for granted; steeper ones (the toes of an elliptic cap, drops) may lose
/// a corner that hides a part of them.
pub(super) const STEEPEST: f64 = 1.2;
/// A march's shortest step, mm.
const SHORTEST_MM: f64 = 0.05;
/// Shortest step of a shadow ray, mm.
const SHADOW_MM: f64 = 0.1;
/// A shadow ray starts this far along its way, mm.
const LIFT_MM: f64 = 0.02;
/// Steps of a march, at most.
const STEPS: usize = 400;
/// The hit is found to this, mm.
const CONVERGED_MM: f64 = 1e-8;
/// Cosine of light or view below which a surface shows no fringes: 75 degrees.
pub const GRAZING: f64 = 0.259;
/// For the slopes at the hit, mm.
const DIFFERENCE_MM: f64 = 0.003;
/// Rows that one task casts.
const BAND: usize = 8;

/// Whether a pixel can hold a point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Status {
    /// Lit and in view.
    Lit = 0,
    /// Light or view graze the surface.
    Grazing = 1,
    /// Something stands between the projector and the point.
    Shaded = 2,
    /// The projector's image does not reach there.
    Outside = 3,
    /// The ray meets no pipe.
    Nothing = 4,
}

/// What one ray found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Seen {
    /// Depth in the camera's frame, mm.
    pub depth_mm: f64,
    /// The projector pixel that lights the point.
    pub column_px: f64,
    /// Its row.
    pub row_px: f64,
    /// Angle about the pipe, rad.
    pub angle_rad: f64,
    /// Place along the pipe, mm.
    pub z_mm: f64,
    /// Cosine between the surface's normal and the light.
    pub light: f32,
    /// Cosine between the surface's normal and the bisector of light and view: a mirror has 1.
    pub gloss: f32,
    /// What was met; 0 for nothing.
    pub part: u8,
    /// Whether the pixel can hold a point.
    pub status: Status,
}

const NOTHING: Seen = Seen {
    depth_mm: f64::NAN,
    column_px: f64::NAN,
    row_px: f64::NAN,
    angle_rad: f64::NAN,
    z_mm: f64::NAN,
    light: 0.0,
    gloss: 0.0,
    part: 0,
    status: Status::Nothing,
};

/// What every pixel found, row-major.
pub type Cast = Vec<Seen>;

/// A place on a ray: how high it is above the surface, and where.
#[derive(Clone, Copy)]
struct RayPlace {
    above: f64,
    /// Height of the surface over the nominal radius.
    height: f64,
    angle: f64,
    z: f64,
    /// Cosine and sine of the angle.
    outward: [f64; 2],
    part: WeldPart,
}

impl WeldSurface {
    #[inline]
    fn place(&self, p: &Vec3) -> RayPlace {
        let rho = (p.x * p.x + p.y * p.y).sqrt();
        let (angle, outward) = (p.y.atan2(p.x), [p.x / rho, p.y / rho]);
        let (height, part) = self.height_towards((angle, outward), p.z);
        RayPlace { above: rho - self.scene.radius_mm - height, height, angle, z: p.z, outward, part }
    }

    /// The first place where a ray from outside meets the surface.
    fn meet(&self, ray: &Ray) -> Option<(f64, RayPlace)> {
        let (start, other_side) = ray.through(self.scene.radius_mm + self.top_mm)?;
        if start <= 0.0 {
            return None;
        }
        let end = match ray.through(self.scene.radius_mm - self.bottom_mm) {
            Some((inside, _)) => inside + SHORTEST_MM,
            None => 0.5 * (start + other_side),
        };
        let mut near = (start, self.place(&ray.at(start)));
        for _ in 0..STEPS {
            let (t, place) = near;
            if t >= end {
                return None;
            }
            let down = -(ray.direction.x * place.outward[0] + ray.direction.y * place.outward[1]);
            let aside = (1.0 - down * down).max(0.0).sqrt();
            // No slope up to the steepest can be met before that.
            let step = (place.above / (down + STEEPEST * aside).max(0.1)).max(SHORTEST_MM);
            // Close to the surface the step that a flat surface asks for, and a little beyond.
            let step = if place.above < 0.1 { step.max(1.1 * place.above / down.max(0.2)) } else { step };
            let far = (t + step, self.place(&ray.at(t + step)));
            if far.1.above <= 0.0 {
                return Some(self.pin(ray, near, far));
            }
            near = far;
        }
        None
    }

    /// The root between a place above and a place below the surface: regula falsi (Illinois).
    fn pin(&self, ray: &Ray, (mut a, above): (f64, RayPlace), (mut b, below): (f64, RayPlace)) -> (f64, RayPlace) {
        let (mut fa, mut fb) = (above.above, below.above);
        let mut best = (b, below);
        let mut side = 0;
        for _ in 0..80 {
            if b - a < CONVERGED_MM || fa <= fb || best.1.above.abs() < CONVERGED_MM {
                break;
            }
            let t = ((fa * b - fb * a) / (fa - fb)).clamp(a, b);
            best = (t, self.place(&ray.at(t)));
            let f = best.1.above;
            if f > 0.0 {
                (a, fa) = (t, f);
                fb *= if side == 1 { 0.5 } else { 1.0 };
                side = 1;
            } else {
                (b, fb) = (t, f);
                fa *= if side == -1 { 0.5 } else { 1.0 };
                side = -1;
            }
        }
        best
    }

    /// The outward normal at a place of the surface.
    fn normal(&self, place: &RayPlace) -> Vec3 {
        let turn = DIFFERENCE_MM / (self.scene.radius_mm + place.height);
        let around = (self.height(place.angle + turn, place.z).0 - place.height) / DIFFERENCE_MM;
        let beside = self.height_towards((place.angle, place.outward), place.z + DIFFERENCE_MM).0;
        let along = (beside - place.height) / DIFFERENCE_MM;
        let [c, s] = place.outward;
        Vec3::new(c + around * s, s - around * c, -along).normalize()
    }

    /// Whether something of the weld stands between a point of the surface and the lamp.
    fn shaded(&self, p: &Vec3, place: &RayPlace, to_lamp: &Vec3) -> bool {
        let ray = Ray { origin: *p, direction: *to_lamp };
        let up = ray.direction.x * place.outward[0] + ray.direction.y * place.outward[1];
        let aside = (1.0 - up * up).max(0.0).sqrt();
        // A ray that climbs faster than the surface can is free, but for what is steeper, where that can reach.
        let climbs = up > STEEPEST * aside;
        if climbs && !self.steep_near(place.z) {
            return false;
        }
        let Some((_, leave)) = ray.through(self.scene.radius_mm + self.top_mm) else { return false };
        let mut t = LIFT_MM;
        for _ in 0..STEPS {
            if t >= leave {
                return false;
            }
            let above = self.place(&ray.at(t)).above;
            if above < 0.0 {
                return true;
            }
            if climbs && above > self.steep_mm {
                return false;
            }
            let closing = STEEPEST * aside - up;
            t += if closing > 0.0 { (above / closing).max(SHADOW_MM) } else { SHADOW_MM };
        }
        false
    }

    fn see(&self, ray: &Ray, depth_of: f64, lamp: &Vec3, pixel_of: impl Fn(&Vec3) -> Option<(f64, f64)>) -> Seen {
        let Some((t, place)) = self.meet(ray) else { return NOTHING };
        if place.z.abs() > self.scene.half_length_mm {
            return NOTHING;
        }
        let p = ray.at(t);
        let to_lamp = (lamp - p).normalize();
        let normal = self.normal(&place);
        let (light, view) = (normal.dot(&to_lamp), -normal.dot(&ray.direction));
        let halfway = (to_lamp - ray.direction).normalize();
        let pixel = pixel_of(&p);
        let status = match pixel {
            None => Status::Outside,
            Some(_) if light < GRAZING || view < GRAZING => Status::Grazing,
            Some(_) if self.shaded(&p, &place, &to_lamp) => Status::Shaded,
            Some(_) => Status::Lit,
        };
        let (column_px, row_px) = pixel.unwrap_or((f64::NAN, f64::NAN));
        Seen {
            depth_mm: t * depth_of,
            column_px,
            row_px,
            angle_rad: place.angle.rem_euclid(2.0 * PI),
            z_mm: place.z,
            light: light as f32,
            gloss: normal.dot(&halfway) as f32,
            part: place.part as u8,
            status,
        }
    }

    /// What every pixel of a scanner sees; `weld_from_scanner` is where it stands.
    pub fn cast(&self, scanner: &Scanner, weld_from_scanner: &Transform) -> Cast {
        require(scanner.camera.width * scanner.camera.height, 3 * size_of::<Seen>());
        let rays = scanner.camera_rays();
        let (width, height) = (scanner.camera.width, scanner.camera.height);
        let projector_from_weld = (*weld_from_scanner * scanner.camera_from_projector).inverse();
        let lamp = weld_from_scanner.apply(&scanner.camera_from_projector.translation);
        let pixel_of = |p: &Vec3| {
            let pixel = scanner.projector.project(&projector_from_weld.apply(p))?;
            scanner.projector.contains(pixel.0, pixel.1).then_some(pixel)
        };
        let row = |v: usize| {
            let pixels = v * width..(v + 1) * width;
            let directions =
                rays.x.get(pixels.clone()).into_iter().flatten().zip(rays.y.get(pixels).into_iter().flatten());
            let see = |(&x, &y): (&f64, &f64)| {
                if !(x.is_finite() && y.is_finite()) {
                    return NOTHING;
                }
                let direction = Vec3::new(x, y, 1.0);
                let length = direction.norm();
                let direction = weld_from_scanner.rotation * direction / length;
                let ray = Ray { origin: weld_from_scanner.translation, direction };
                self.see(&ray, 1.0 / length, &lamp, pixel_of)
            };
            directions.map(see).collect::<Vec<_>>()
        };
        threads::install(|| (0..height).into_par_iter().with_min_len(BAND).inspect(polled).flat_map_iter(row).collect())
    }
}
