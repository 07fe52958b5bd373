//! A butt weld in its own frame: z along the pipe from the reference wall (z < 0) to the other wall, the seam at z = 0,
//! angles from x about z. Plates are a pipe of infinite radius: their surface is x = 0, x outward, y along the seam.

use std::f64::consts::TAU;

use crate::error::{Error, Result, require_positive};
use crate::ground::random::mix;
use crate::ground::threads;
use crate::ground::transform::Vec3;

use super::ray::{Hit, Ray, entry};

/// Parts of a weld, added to its label.
const REFERENCE: u8 = 0;
const OTHER: u8 = 1;
const BEAD: u8 = 2;

/// The bead is found to a hundredth of a nanometre.
const CONVERGED_MM: f64 = 1e-8;
/// A Newton step on a wall below this is the last: the error left is its square times a curvature below 1/mm.
const LAST_STEP_MM: f64 = 1e-5;
/// Samples of a ray on its way through the bead's hull: a quarter of a millimetre apart on a usual bead.
const BEAD_SAMPLES: usize = 12;

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
    reference: PlacedWall,
    other: PlacedWall,
    /// The reference and the other wall without their waviness: what the truth refers to.
    smooth: [PlacedWall; 2],
    bead: Bead,
    half_length_mm: f64,
    /// How far above the reference wall anything of the weld can stand near the seam.
    top_mm: f64,
    /// How far a wall can stand from its cylinder or plane.
    form_mm: f64,
    /// Angular frequencies of the ripples and of the toes.
    ripples: f64,
    wander: [f64; 4],
}

/// A wall with its frame: e1, e2 across the axis, d along it; for a plate e1 is the normal.
#[derive(Debug, Clone, PartialEq)]
struct PlacedWall {
    wall: Wall,
    flat: bool,
    origin: Vec3,
    e1: Vec3,
    e2: Vec3,
    axis: Vec3,
    /// Angular or spatial frequency along the seam, frequency along the axis, and start of three waves.
    waves: [[f64; 3]; 3],
}

/// Angular frequency of what repeats every `wavelength_mm` along the seam: a whole number of times around a pipe.
fn frequency(radius_mm: f64, wavelength_mm: f64) -> f64 {
    let waves = TAU * radius_mm / wavelength_mm;
    if radius_mm.is_infinite() { TAU / wavelength_mm } else { waves.round().max(1.0) }
}

impl PlacedWall {
    fn new(wall: Wall) -> Self {
        let flat = wall.radius_mm.is_infinite();
        let axis = Vec3::new(wall.tilt_rad[0].tan(), wall.tilt_rad[1].tan(), 1.0).normalize();
        let e1 = (Vec3::x() - axis * axis.x).normalize();
        let e2 = axis.cross(&e1);
        let around = |wavelength: f64| frequency(wall.radius_mm, wavelength);
        let waves =
            [[around(71.0), TAU / 113.0, 0.3], [-around(43.0), TAU / 61.0, 1.7], [around(97.0), TAU / 37.0, 4.1]];
        Self { wall, flat, origin: Vec3::new(wall.offset_mm[0], wall.offset_mm[1], 0.0), e1, e2, axis, waves }
    }

    /// Deviation from the cylinder or plane and its derivatives along the seam's coordinate and the axis.
    fn form(&self, along: f64, a: f64) -> [f64; 3] {
        let w = &self.wall;
        let mut form = [0.0; 3];
        if w.ovality_mm != 0.0 {
            let (sin, cos) = (2.0 * (along - w.ovality_at_rad)).sin_cos();
            form = [w.ovality_mm * cos, -2.0 * w.ovality_mm * sin, 0.0];
        }
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

    /// Where the ray meets the wall, and the gradient there: from the closed form, by Newton on what the form adds to it.
    fn meet(&self, ray: &Ray, mut t: f64) -> Option<(f64, Vec3)> {
        let speed = ray.direction.norm();
        let (mut height, mut gradient) = self.height(&ray.at(t));
        if !self.plain() {
            for _ in 0..12 {
                let slope = gradient.dot(&ray.direction);
                if slope >= 0.0 {
                    return None;
                }
                let step = height / slope;
                t -= step;
                if step.abs() * speed < LAST_STEP_MM {
                    break;
                }
                (height, gradient) = self.height(&ray.at(t));
            }
        }
        Some((t, gradient))
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
    /// [`Error::OutOfRange`] or [`Error::NonFinite`] naming the parameter.
    pub fn new(reference: Wall, other: Wall, bead: Bead, length_mm: f64) -> Result<Self> {
        let zero = [0.0; 2];
        if reference.offset_mm != zero || reference.tilt_rad != zero {
            let value = format!("{:?} and {:?}", reference.offset_mm, reference.tilt_rad);
            let what = "reference wall's offset_mm and tilt_rad";
            return Err(Error::OutOfRange { what, expected: "0: the weld's frame is its own".into(), value });
        }
        if reference.radius_mm.is_infinite() != other.radius_mm.is_infinite() {
            let value = format!("{} and {}", reference.radius_mm, other.radius_mm);
            return Err(Error::OutOfRange {
                what: "walls' radius_mm",
                expected: "two pipes or two plates".into(),
                value,
            });
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
        let form_mm = [reference, other].map(|w| w.ovality_mm.abs() + w.waviness_mm).into_iter().fold(0.0, f64::max);
        let frequency = |wavelength_mm: f64| frequency(reference.radius_mm, wavelength_mm);
        let (ripples, wander) = (frequency(bead.pitch_mm), [31.0, 11.0, 27.0, 9.0].map(frequency));
        let (reference, other) = (PlacedWall::new(reference), PlacedWall::new(other));
        let smooth = [reference.smooth(), other.smooth()];
        let weld =
            Self { reference, other, smooth, bead, half_length_mm: 0.5 * length_mm, top_mm, form_mm, ripples, wander };
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

    /// Where the toes are at this place along the seam, z, mm.
    fn toes(&self, along: f64) -> (f64, f64) {
        let Bead { width_mm, wander_mm, .. } = self.bead;
        let half = 0.5 * width_mm;
        if wander_mm == 0.0 {
            return (-half, half);
        }
        let [a, b, c, d] = self.wander;
        let wave = |slow: f64, fast: f64, start: f64| {
            let swing = 0.6 * (slow * along + start).sin() + 0.4 * (fast * along - start).sin();
            (wander_mm * swing).min(half)
        };
        (-half + wave(a, b, 0.5), half + wave(c, d, 2.5))
    }

    /// Height above the bead's surface; at the toes it is the height above the walls, but for their waviness.
    fn above_bead(&self, p: &Vec3) -> f64 {
        let along = self.along(p);
        let (low, high) = self.toes(along);
        let across = ((p.z - low) / (high - low)).clamp(0.0, 1.0);
        let blend = across * across * (3.0 - 2.0 * across);
        let cap = 4.0 * across * (1.0 - across);
        // Ripples are crescents: the pool freezes first at the toes.
        let bow = 0.35 * self.bead.width_mm / self.bead.pitch_mm * TAU * (1.0 - cap);
        let ripple = (self.ripples * along + bow).cos();
        let [reference, other] = &self.smooth;
        (1.0 - blend) * reference.height(p).0 + blend * other.height(p).0
            - cap * (self.bead.height_mm + self.bead.ripple_mm * ripple)
    }

    /// The toes lie within this distance of the seam.
    fn slab_mm(&self) -> f64 {
        0.5 * self.bead.width_mm + self.bead.wander_mm
    }

    fn bead_gradient(&self, p: &Vec3) -> Vec3 {
        // Central differences: the surface has no detail as fine as that.
        let h = 1e-4;
        let slope = |e: Vec3| self.above_bead(&(p + e * h)) - self.above_bead(&(p - e * h));
        Vec3::new(slope(Vec3::x()), slope(Vec3::y()), slope(Vec3::z()))
    }

    fn meet_bead(&self, ray: &Ray, after: f64, until: f64) -> Option<f64> {
        if self.bead.width_mm == 0.0 {
            return None;
        }
        // The hull: a slab that holds the toes, under a surface that nothing of the bead reaches.
        let slab = self.slab_mm();
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
        let mut best: Option<(f64, Vec3, u8)> = None;
        let slab = self.slab_mm();
        // Walls are searched only where their closed form says that it is worth it.
        let margin = 5.0 + 10.0 * self.form_mm;
        let speed = ray.direction.norm();
        let met = |wall: &PlacedWall, side: f64| {
            let t = wall.ideal(ray, 0.0)?;
            let beyond = side * ray.at(t).z > slab + margin;
            if beyond || (t - after) * speed < -margin { None } else { wall.meet(ray, t) }
        };
        let (reference, other) = (met(&self.reference, 1.0), met(&self.other, -1.0));
        for (found, part) in [(reference, REFERENCE), (other, OTHER)] {
            let Some((t, gradient)) = found else { continue };
            let p = ray.at(t);
            if t <= after || p.z.abs() > self.half_length_mm || best.is_some_and(|(first, ..)| first <= t) {
                continue;
            }
            // Far from the seam the toes need not be known.
            let (low, high) = if p.z.abs() > slab { (-slab, slab) } else { self.toes(self.along(&p)) };
            if (part == REFERENCE && p.z < low) || (part == OTHER && p.z >= high) {
                best = Some((t, gradient, part));
            }
        }
        // A ray that misses both walls may still graze the bead. The cap stands on both walls: below the two of them
        // there is none left.
        let deep = reference.zip(other).map_or(f64::INFINITY, |((a, _), (b, _))| a.max(b) + self.form_mm / speed);
        if let Some(t) = self.meet_bead(ray, after, best.map_or(deep, |(t, ..)| t.min(deep))) {
            let p = ray.at(t);
            let (low, high) = self.toes(self.along(&p));
            if (low..=high).contains(&p.z) {
                best = Some((t, self.bead_gradient(&p), BEAD));
            }
        }
        best.map(|(t, gradient, part)| Hit { t, normal: gradient.normalize(), part })
    }

    /// How far the other wall stands out from the reference wall at one of its points, the waviness of both left out,
    /// mm.
    #[inline]
    pub fn step_at(&self, p: &Vec3) -> f64 {
        // The point's height over its own smooth wall is that wall's waviness.
        self.smooth[0].height(p).0 - self.smooth[1].height(p).0
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
        let surface = |wall: &PlacedWall| {
            let mut r = start;
            for _ in 0..30 {
                let (height, gradient) = wall.height(&(base + outward * r));
                let before = r;
                r -= height / gradient.dot(&outward);
                if r == before {
                    break;
                }
            }
            r
        };
        surface(other) - surface(reference)
    }

    /// [`Self::step_at_seam`] at many places.
    pub fn steps_at_seam(&self, along: &[f64]) -> Vec<f64> {
        threads::map_chunks(along, |_, chunk| chunk.iter().map(|&a| self.step_at_seam(a)).collect::<Vec<_>>()).concat()
    }

    /// Noise of -1 to 1 on the surface, smooth over these lengths along and across the seam.
    pub(super) fn texture(&self, (along, across): (f64, f64), along_mm: f64, across_mm: f64) -> f64 {
        let turns = frequency(self.reference.wall.radius_mm, along_mm) / TAU;
        let period = if self.reference.flat { 1e9 } else { TAU * turns };
        smooth_noise(along * turns, across / across_mm, period.round())
    }

    /// Whether a point lies in the solid: below the surface that stands at its z.
    #[cfg(test)]
    pub(super) fn inside(&self, p: &Vec3) -> bool {
        let (low, high) = self.toes(self.along(p));
        let surface = match p.z {
            z if z < low => &self.reference,
            z if z >= high => &self.other,
            _ => return self.above_bead(p) <= 0.0,
        };
        p.z.abs() <= self.half_length_mm && surface.height(p).0 <= 0.0
    }
}

/// Noise of -1 to 1 that is smooth over a distance of one and repeats after `period` in x.
fn smooth_noise(x: f64, y: f64, period: f64) -> f64 {
    let (i, j) = (x.floor(), y.floor());
    let ease = |f: f64| f * f * (3.0 - 2.0 * f);
    let (u, v) = (ease(x - i), ease(y - j));
    let node = |di: f64, dj: f64| {
        let key = ((i + di).rem_euclid(period) as u64) << 32 ^ ((j + dj) as i64 as u64 & 0xffff_ffff);
        (mix(key) >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    };
    let (low, high) =
        (node(0.0, 0.0) * (1.0 - u) + node(1.0, 0.0) * u, node(0.0, 1.0) * (1.0 - u) + node(1.0, 1.0) * u);
    low * (1.0 - v) + high * v
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn wall(radius_mm: f64, offset_mm: [f64; 2]) -> Wall {
        Wall { radius_mm, offset_mm, tilt_rad: [0.0; 2], ovality_mm: 0.0, ovality_at_rad: 0.0, waviness_mm: 0.0 }
    }

    const BEAD: Bead = Bead { width_mm: 11.0, height_mm: 1.8, ripple_mm: 0.15, pitch_mm: 3.6, wander_mm: 0.25 };

    fn example() -> Weld {
        let reference = Wall { ovality_mm: 0.2, waviness_mm: 0.01, ..wall(315.0, [0.0; 2]) };
        let other = Wall { tilt_rad: [0.002, -0.001], waviness_mm: 0.01, ..wall(315.3, [0.4, -0.2]) };
        Weld::new(reference, other, BEAD, 300.0).unwrap()
    }

    #[test]
    fn the_step_at_the_seam_follows_from_the_sine_rule() {
        let (r, offset) = (315.0, [0.4, -0.2]);
        let weld = Weld::new(wall(r, [0.0; 2]), wall(r + 0.3, offset), BEAD, 300.0).unwrap();
        for i in 0..72 {
            let angle = TAU * f64::from(i) / 72.0;
            let along = offset[0] * angle.cos() + offset[1] * angle.sin();
            let across = offset[0] * angle.sin() - offset[1] * angle.cos();
            let radius = along + ((r + 0.3f64).powi(2) - across * across).sqrt();
            assert!((weld.step_at_seam(angle) - (radius - r)).abs() < 1e-10);
        }
    }

    #[test]
    fn a_weld_of_a_pipe_to_a_plate_and_a_moved_reference_wall_are_refused() {
        assert!(matches!(
            Weld::new(wall(f64::INFINITY, [0.0; 2]), wall(100.0, [0.0; 2]), BEAD, 300.0),
            Err(Error::OutOfRange { .. })
        ));
        assert!(Weld::new(wall(100.0, [0.1, 0.0]), wall(100.0, [0.0; 2]), BEAD, 300.0).is_err());
        for bad in [f64::NAN, -1.0, 0.0] {
            assert!(Weld::new(wall(bad, [0.0; 2]), wall(bad, [0.0; 2]), BEAD, 300.0).is_err());
            assert!(Weld::new(wall(100.0, [0.0; 2]), wall(100.0, [0.0; 2]), BEAD, bad).is_err());
        }
    }

    /// The first sign change of the weld's solid along a ray, by steps of 0.02 mm: slow, and blind to nothing larger.
    fn march(weld: &Weld, ray: &Ray, length_mm: f64) -> Option<f64> {
        let speed = ray.direction.norm();
        let steps = (length_mm / 0.02) as usize;
        (0..steps).map(|i| i as f64 * 0.02 / speed).find(|&t| weld.inside(&ray.at(t)))
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(300))]
        #[test]
        fn the_first_hit_on_a_weld_is_where_a_march_enters_it(
            angle in 0.0..TAU, z in -12.0..12.0f64, lean in -0.9..0.9f64, turn in -0.9..0.9f64,
        ) {
            let weld = example();
            let outward = Vec3::new(angle.cos(), angle.sin(), 0.0);
            let around = Vec3::new(-angle.sin(), angle.cos(), 0.0);
            let target = outward * 315.5 + Vec3::z() * z;
            let origin = target + (outward + around * turn + Vec3::z() * lean) * 20.0;
            let ray = Ray { origin, direction: (target - origin) * 0.7 };
            let found = weld.hit(&ray, 0.0).map(|h| h.t);
            let marched = march(&weld, &ray, 80.0);
            match (found, marched) {
                (None, None) => {}
                (Some(t), Some(m)) => {
                    // A step of the march, plus where it slips into the 10 micron gap that waviness leaves at a toe.
                    let apart = (t - m) * ray.direction.norm();
                    prop_assert!(apart.abs() < 0.1, "{t} {m} {apart}");
                }
                _ => prop_assert!(false, "{found:?} {marched:?}"),
            }
        }
    }
}
