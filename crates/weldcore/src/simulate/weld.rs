//! A butt weld in its own frame: z along the pipe from the reference wall (z < 0) to the other wall, the seam at z = 0,
//! angles from x about z. Plates are a pipe of infinite radius: their surface is x = 0, x outward, y along the seam.

use std::f64::consts::TAU;

use crate::Vec3;
use crate::error::{Error, Result, require_positive};

use super::shapes::{Hit, Ray, entry, whole_waves};

/// Parts of a weld, added to its label.
const REFERENCE: u8 = 0;
const OTHER: u8 = 1;
const BEAD: u8 = 2;

/// A Newton step on a surface below this, mm, ends the search: a hundredth of a nanometre.
const CONVERGED_MM: f64 = 1e-8;
/// Samples of a ray on its way through the bead's hull: a tenth of a usual bead's height apart at normal view.
const BEAD_SAMPLES: usize = 24;

/// One wall: a cylinder, or a plane where the radius is infinite, whose axis may be off and askew.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wall {
    /// Outside radius, mm.
    pub radius_mm: f64,
    /// Where its axis crosses the plane of the seam, x and y, mm. A plate is moved by x.
    pub offset_mm: [f64; 2],
    /// Slope of its axis, dx/dz and dy/dz, rad.
    pub tilt_rad: [f64; 2],
    /// Amplitude of the second harmonic of its radius, mm.
    pub ovality_mm: f64,
    /// Where the radius is largest, rad.
    pub ovality_at_rad: f64,
    /// Amplitude of its waviness, mm.
    pub waviness_mm: f64,
}

/// The bead: a parabolic cap with ripples between its toes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bead {
    /// Toe to toe, mm; 0 for no bead.
    pub width_mm: f64,
    /// Height of the cap over the walls, mm.
    pub height_mm: f64,
    /// Amplitude of the ripples, mm.
    pub ripple_mm: f64,
    /// Distance of the ripples, mm.
    pub pitch_mm: f64,
    /// How far each toe wanders to and fro, mm.
    pub wander_mm: f64,
}

/// Two walls and a bead.
#[derive(Debug, Clone, PartialEq)]
pub struct Weld {
    reference: Placed,
    other: Placed,
    /// The reference and the other wall without their waviness: what the truth refers to.
    smooth: [Placed; 2],
    bead: Bead,
    half_length_mm: f64,
    /// How far above the reference wall anything of the weld can stand near the seam.
    top_mm: f64,
}

/// A wall with its frame: e1, e2 across the axis, d along it; for a plate e1 is the normal.
#[derive(Debug, Clone, PartialEq)]
struct Placed {
    wall: Wall,
    flat: bool,
    origin: Vec3,
    e1: Vec3,
    e2: Vec3,
    axis: Vec3,
    /// Angular or spatial frequency along the seam, frequency along the axis, and start of three waves.
    waves: [[f64; 3]; 3],
}

impl Placed {
    fn new(wall: Wall) -> Self {
        let flat = wall.radius_mm.is_infinite();
        let axis = Vec3::new(wall.tilt_rad[0].tan(), wall.tilt_rad[1].tan(), 1.0).normalize();
        let e1 = (Vec3::x() - axis * axis.x).normalize();
        let e2 = axis.cross(&e1);
        let around = |wavelength: f64| {
            if flat { TAU / wavelength } else { whole_waves(wall.radius_mm, wavelength) }
        };
        let waves =
            [[around(71.0), TAU / 113.0, 0.3], [-around(43.0), TAU / 61.0, 1.7], [around(97.0), TAU / 37.0, 4.1]];
        Self { wall, flat, origin: Vec3::new(wall.offset_mm[0], wall.offset_mm[1], 0.0), e1, e2, axis, waves }
    }

    /// Deviation from the cylinder or plane and its derivatives along the seam's coordinate and the axis.
    fn form(&self, along: f64, a: f64) -> [f64; 3] {
        let w = &self.wall;
        let (sin, cos) = (2.0 * (along - w.ovality_at_rad)).sin_cos();
        let mut form = [w.ovality_mm * cos, -2.0 * w.ovality_mm * sin, 0.0];
        if w.waviness_mm > 0.0 {
            for [n, k, start] in self.waves {
                let (sin, cos) = (n * along + k * a + start).sin_cos();
                let amplitude = w.waviness_mm / 3.0;
                form[0] += amplitude * sin;
                form[1] += amplitude * n * cos;
                form[2] += amplitude * k * cos;
            }
        }
        form
    }

    fn plain(&self) -> bool {
        self.wall.ovality_mm == 0.0 && self.wall.waviness_mm == 0.0
    }

    /// Height above the wall's surface (across its axis) and its gradient.
    fn height(&self, p: &Vec3) -> (f64, Vec3) {
        let q = p - self.origin;
        let (x, y) = (q.dot(&self.e1), q.dot(&self.e2));
        if self.flat {
            if self.plain() {
                return (x, self.e1);
            }
            let [f, fs, fa] = self.form(y, q.dot(&self.axis));
            return (x - f, self.e1 - self.e2 * fs - self.axis * fa);
        }
        let rho = x.hypot(y);
        let outward = (self.e1 * x + self.e2 * y) / rho;
        if self.plain() {
            return (rho - self.wall.radius_mm, outward);
        }
        let around = (self.e2 * x - self.e1 * y) / rho;
        let [f, fs, fa] = self.form(y.atan2(x), q.dot(&self.axis));
        (rho - self.wall.radius_mm - f, outward - around * (fs / rho) - self.axis * fa)
    }

    /// The way in: the closed form for the cylinder or plane moved outward by `by`.
    fn ideal(&self, ray: &Ray, by: f64) -> Option<f64> {
        let q = ray.origin - self.origin;
        let (x, dx) = (q.dot(&self.e1), ray.direction.dot(&self.e1));
        if self.flat {
            return (dx < 0.0).then(|| (by - x) / dx);
        }
        let (y, dy) = (q.dot(&self.e2), ray.direction.dot(&self.e2));
        let r = self.wall.radius_mm + by;
        entry(dx * dx + dy * dy, x * dx + y * dy, x * x + y * y - r * r)
    }

    /// The way out through the cylinder or plane moved outward by `by`; infinite where the ray does not leave.
    fn leave(&self, ray: &Ray, by: f64) -> f64 {
        let (x, dx) = ((ray.origin - self.origin).dot(&self.e1), ray.direction.dot(&self.e1));
        if self.flat {
            return if dx > 0.0 { (by - x) / dx } else { f64::INFINITY };
        }
        // The way in of the ray that comes back.
        let back = Ray { origin: ray.origin, direction: -ray.direction };
        self.ideal(&back, by).map_or(f64::INFINITY, |t| -t)
    }

    /// Where the ray meets the wall: the closed form, then Newton on what the form adds to it.
    fn meet(&self, ray: &Ray) -> Option<f64> {
        let mut t = self.ideal(ray, 0.0)?;
        if !self.plain() {
            let speed = ray.direction.norm();
            for _ in 0..12 {
                let (height, gradient) = self.height(&ray.at(t));
                let slope = gradient.dot(&ray.direction);
                if slope >= 0.0 {
                    return None;
                }
                let step = height / slope;
                t -= step;
                if step.abs() * speed < CONVERGED_MM {
                    return Some(t);
                }
            }
        }
        Some(t)
    }

    /// The wall without its waviness.
    fn smooth(&self) -> Self {
        Self { wall: Wall { waviness_mm: 0.0, ..self.wall }, ..self.clone() }
    }
}

impl Weld {
    /// A weld of two walls. The reference wall's axis is z: it has no offset and no tilt.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] naming the parameter; [`Error::Degenerate`] for a pipe welded to a plate.
    pub fn new(reference: Wall, other: Wall, bead: Bead, length_mm: f64) -> Result<Self> {
        let zero = [0.0; 2];
        if reference.offset_mm != zero || reference.tilt_rad != zero {
            let value = format!("{:?} and {:?}", reference.offset_mm, reference.tilt_rad);
            let what = "reference wall's offset_mm and tilt_rad";
            return Err(Error::OutOfRange { what, expected: "0: the weld's frame is its own".into(), value });
        }
        if reference.radius_mm.is_infinite() != other.radius_mm.is_infinite() {
            return Err(Error::Degenerate { what: "weld", reason: "one wall is a plate, the other a pipe".into() });
        }
        let step = if reference.radius_mm.is_infinite() { 0.0 } else { other.radius_mm - reference.radius_mm };
        let lean = bead.width_mm * (other.tilt_rad[0].abs() + other.tilt_rad[1].abs());
        let top_mm = bead.height_mm
            + bead.ripple_mm
            + reference.ovality_mm.abs()
            + reference.waviness_mm
            + other.ovality_mm.abs()
            + other.waviness_mm
            + other.offset_mm[0].hypot(other.offset_mm[1])
            + step.abs()
            + lean;
        let (reference, other) = (Placed::new(reference), Placed::new(other));
        let smooth = [reference.smooth(), other.smooth()];
        let weld = Self { reference, other, smooth, bead, half_length_mm: 0.5 * length_mm, top_mm };
        weld.check()?;
        Ok(weld)
    }

    pub(super) fn check(&self) -> Result<()> {
        require_positive("weld length_mm", self.half_length_mm)?;
        let refuse =
            |what, expected: &str, value: String| Err(Error::OutOfRange { what, expected: expected.into(), value });
        for placed in [&self.reference, &self.other] {
            let w = &placed.wall;
            if w.radius_mm.is_nan() || w.radius_mm <= 0.0 {
                return refuse("wall radius_mm", "above 0 (infinite for a plate)", w.radius_mm.to_string());
            }
            let rest = [w.offset_mm[0], w.offset_mm[1], w.ovality_mm, w.ovality_at_rad, w.waviness_mm];
            if let Some(index) = rest.iter().position(|v| !v.is_finite()) {
                return Err(Error::NonFinite { what: "wall (offset x, y, ovality, its angle, waviness)", index });
            }
            if !w.tilt_rad.iter().all(|t| t.abs() < 0.5) {
                return refuse("wall tilt_rad", "below 0.5", format!("{:?}", w.tilt_rad));
            }
            // Far enough from a self-intersecting wall for Newton to converge.
            if w.ovality_mm.abs() > 0.1 * w.radius_mm || !(0.0..=1.0).contains(&w.waviness_mm) {
                let value = format!("{} and {}", w.ovality_mm, w.waviness_mm);
                return refuse("wall ovality_mm and waviness_mm", "at most a tenth of the radius and 1 mm", value);
            }
            if placed.flat && w.ovality_mm != 0.0 {
                return refuse("plate ovality_mm", "0", w.ovality_mm.to_string());
            }
        }
        let b = &self.bead;
        for (what, v) in [
            ("bead width_mm", b.width_mm),
            ("bead height_mm", b.height_mm),
            ("bead ripple_mm", b.ripple_mm),
            ("bead wander_mm", b.wander_mm),
        ] {
            if !(v.is_finite() && v >= 0.0) {
                return refuse(what, "finite and 0 or above", v.to_string());
            }
        }
        require_positive("bead pitch_mm", b.pitch_mm)
    }

    /// Angle about the axis, rad (plates: place along the seam, mm), of a point in the weld's frame.
    #[inline]
    pub fn along(&self, p: &Vec3) -> f64 {
        if self.reference.flat { p.y } else { p.y.atan2(p.x) }
    }

    /// Angular frequency of something that repeats every `wavelength_mm` along the seam.
    fn frequency(&self, wavelength_mm: f64) -> f64 {
        if self.reference.flat {
            TAU / wavelength_mm
        } else {
            whole_waves(self.reference.wall.radius_mm, wavelength_mm)
        }
    }

    /// Where the toes are at this place along the seam, z, mm.
    fn toes(&self, along: f64) -> (f64, f64) {
        let Bead { width_mm, wander_mm, .. } = self.bead;
        let half = 0.5 * width_mm;
        if wander_mm == 0.0 {
            return (-half, half);
        }
        let wave = |slow: f64, fast: f64, start: f64| {
            let (a, b) = (self.frequency(slow) * along + start, self.frequency(fast) * along - start);
            (wander_mm * (0.6 * a.sin() + 0.4 * b.sin())).min(half)
        };
        (-half + wave(31.0, 11.0, 0.5), half + wave(27.0, 9.0, 2.5))
    }

    /// Height above the bead's surface; at the toes it is the height above the walls.
    fn above_bead(&self, p: &Vec3) -> f64 {
        let along = self.along(p);
        let (low, high) = self.toes(along);
        let across = ((p.z - low) / (high - low)).clamp(0.0, 1.0);
        let blend = across * across * (3.0 - 2.0 * across);
        let cap = 4.0 * across * (1.0 - across);
        // Ripples are crescents: the pool freezes first at the toes.
        let bow = 0.35 * self.bead.width_mm / self.bead.pitch_mm * TAU * (1.0 - cap);
        let ripple = (self.frequency(self.bead.pitch_mm) * along + bow).cos();
        (1.0 - blend) * self.reference.height(p).0 + blend * self.other.height(p).0
            - cap * (self.bead.height_mm + self.bead.ripple_mm * ripple)
    }

    fn bead_normal(&self, p: &Vec3) -> Vec3 {
        // Central differences: the surface has no detail as fine as that.
        let h = 1e-4;
        let slope = |e: Vec3| self.above_bead(&(p + e * h)) - self.above_bead(&(p - e * h));
        Vec3::new(slope(Vec3::x()), slope(Vec3::y()), slope(Vec3::z())).normalize()
    }

    fn meet_bead(&self, ray: &Ray, after: f64, until: f64) -> Option<f64> {
        if self.bead.width_mm == 0.0 {
            return None;
        }
        // The hull: a slab that holds the toes, under a surface that nothing of the bead reaches.
        let slab = 0.5 * self.bead.width_mm + self.bead.wander_mm;
        let (z, dz) = (ray.origin.z, ray.direction.z);
        let (mut start, mut end) = (after, until);
        if dz.abs() > 0.0 {
            let (a, b) = ((-slab * dz.signum() - z) / dz, (slab * dz.signum() - z) / dz);
            start = start.max(a);
            end = end.min(b);
        } else if z.abs() > slab {
            return None;
        }
        end = end.min(self.reference.leave(ray, self.top_mm));
        if start >= end {
            return None;
        }
        if self.reference.height(&ray.at(start)).0 > self.top_mm {
            start = start.max(self.reference.ideal(ray, self.top_mm)?);
            if start >= end {
                return None;
            }
        }
        if !end.is_finite() {
            return None;
        }
        let mut low = start;
        let mut above = self.above_bead(&ray.at(low));
        if above < 0.0 {
            return None;
        }
        for i in 1..=BEAD_SAMPLES {
            let high = start + (end - start) * i as f64 / BEAD_SAMPLES as f64;
            let below = self.above_bead(&ray.at(high));
            if below <= 0.0 {
                return Some(self.pin(ray, (low, above), (high, below)));
            }
            (low, above) = (high, below);
        }
        None
    }

    /// The root between a point above and a point below the bead: regula falsi (Illinois).
    fn pin(&self, ray: &Ray, (mut a, mut fa): (f64, f64), (mut b, mut fb): (f64, f64)) -> f64 {
        let speed = ray.direction.norm();
        let mut side = 0;
        for _ in 0..60 {
            if (b - a) * speed < CONVERGED_MM || fa <= fb {
                break;
            }
            let t = (fa * b - fb * a) / (fa - fb);
            let f = self.above_bead(&ray.at(t));
            if f.abs() < CONVERGED_MM {
                return t;
            }
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
        0.5 * (a + b)
    }

    /// The first hit beyond `after`.
    pub(super) fn hit(&self, ray: &Ray, after: f64) -> Option<Hit> {
        let mut best: Option<(f64, u8)> = None;
        let mut offer = |t: f64, part: u8| {
            if t > after && best.is_none_or(|(found, _)| t < found) {
                best = Some((t, part));
            }
        };
        let reference = self.reference.meet(ray);
        let other = self.other.meet(ray);
        for (found, part) in [(reference, REFERENCE), (other, OTHER)] {
            let Some(t) = found else { continue };
            let p = ray.at(t);
            if p.z.abs() > self.half_length_mm {
                continue;
            }
            let (low, high) =
                self.toes(if p.z.abs() > self.bead.width_mm + self.bead.wander_mm { 0.0 } else { self.along(&p) });
            if (part == REFERENCE && p.z < low) || (part == OTHER && p.z >= high) {
                offer(t, part);
            }
        }
        // A ray that misses both walls may still graze the bead.
        // The cap stands on both walls: below the two of them there is none left.
        let deep = reference.zip(other).map_or(f64::INFINITY, |(a, b)| a.max(b) + 1e-6);
        if let Some(t) = self.meet_bead(ray, after, best.map_or(deep, |(t, _)| t.min(deep))) {
            let p = ray.at(t);
            let (low, high) = self.toes(self.along(&p));
            if (low..=high).contains(&p.z) {
                best = Some((t, BEAD));
            }
        }
        let (t, part) = best?;
        let p = ray.at(t);
        let normal = match part {
            REFERENCE => self.reference.height(&p).1.normalize(),
            OTHER => self.other.height(&p).1.normalize(),
            _ => self.bead_normal(&p),
        };
        Some(Hit { t, normal, part })
    }

    /// How far a point in the weld's frame stands out from the reference wall, its waviness left out, mm.
    #[inline]
    pub fn above_reference(&self, p: &Vec3) -> f64 {
        self.smooth[0].height(p).0
    }

    /// The true step at the seam: other wall minus reference wall along the radius at `along` (rad about the axis;
    /// plates: mm along the seam), both extrapolated to z = 0, waviness left out, mm.
    pub fn step_at_seam(&self, along: f64) -> f64 {
        let [reference, other] = &self.smooth;
        let (base, outward) = if reference.flat {
            (Vec3::new(0.0, along, 0.0), Vec3::x())
        } else {
            (Vec3::zeros(), Vec3::new(along.cos(), along.sin(), 0.0))
        };
        let start = if reference.flat { 0.0 } else { reference.wall.radius_mm };
        let surface = |wall: &Placed| {
            let mut r = start;
            for _ in 0..30 {
                let (height, gradient) = wall.height(&(base + outward * r));
                r -= height / gradient.dot(&outward);
            }
            r
        };
        surface(other) - surface(reference)
    }

    /// Millimetres along and across the seam, for surface texture.
    pub(super) fn texture(&self, p: &Vec3) -> (f64, f64) {
        let scale = if self.reference.flat { 1.0 } else { self.reference.wall.radius_mm };
        (self.along(p) * scale, p.z)
    }
}
