//! Welds as they come: a height field `r(angle, z) = R + f` over a pipe, made of parts that real pipes have.
//!
//! Frame: z along the pipe from the reference wall to the other wall, the seam near z = 0, angles from x about z. Each
//! wall has its own radius, axis, ovality, random unevenness, weld shrinkage, machining (taper, counterbore), flare,
//! dents and coats; between the two toes stands a cap on the chord from one wall's edge to the other's. Nothing here is
//! taken from what the measuring side assumes of a weld. The truth is read off the same surface that the rays meet.

mod cast;
mod field;

pub use cast::{Cast, Seen, Status};
pub use field::{Unevenness, Wander};

use std::f64::consts::{PI, TAU};

use crate::error::{Error, Result, require_positive};
use crate::threads;

use super::mix;
use field::{Curve, Field};

/// A cap keeps at least this share of its width where its toes wander towards each other.
const NARROWEST: f64 = 0.2;
/// Standard deviations of a random part that bound the surface.
const BOUND_SIGMA: f64 = 6.0;

/// `amplitude cos(n (angle - at))` on a wall's radius.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Harmonic {
    /// Waves around the pipe.
    pub n: u32,
    /// Amplitude, mm.
    pub amplitude_mm: f64,
    /// Where it stands out most, rad.
    pub at_rad: f64,
}

/// Material machined off: `depth` at the toe, less by `slope` per mm away from it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Taper {
    /// At the toe, mm.
    pub depth_mm: f64,
    /// mm per mm.
    pub slope: f64,
}

/// A floor of constant depth from the toe outward, then a shoulder.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Counterbore {
    /// Depth of the floor, mm.
    pub depth_mm: f64,
    /// From the toe to the shoulder, mm.
    pub floor_mm: f64,
    /// Slope of the shoulder, mm per mm.
    pub slope: f64,
}

/// The end of a wall bent outward: `amplitude exp(-x/decay)` at the distance x from the toe.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Flare {
    /// At the toe, mm; below 0 it is bent inward.
    pub amplitude_mm: f64,
    /// Decay length, mm.
    pub decay_mm: f64,
}

/// A dent: `-depth shape(angle) exp(-x/decay)` at the distance x from the toe.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Dent {
    /// At its middle, at the toe, mm; below 0 it is a bulge.
    pub depth_mm: f64,
    /// Where its middle is, rad.
    pub at_rad: f64,
    /// Its full width at half depth, rad.
    pub width_rad: f64,
    /// Decay length along the pipe, mm; infinite: the whole wall.
    pub decay_mm: f64,
    /// A raised cosine (which ends) instead of a Gaussian.
    pub cosine: bool,
}

/// Something laid on the wall: a coat (to infinity) or a strip of tape.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Strip {
    /// Thickness, mm.
    pub thickness_mm: f64,
    /// Begins at this distance from the toe, mm.
    pub from_mm: f64,
    /// Ends there, mm; may be infinite.
    pub to_mm: f64,
    /// Over which its edges rise, mm.
    pub edge_mm: f64,
}

/// One wall.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Wall {
    /// Its radius less the nominal one, mm.
    pub radius_difference_mm: f64,
    /// Where its axis crosses the plane z = 0, mm.
    pub offset_mm: [f64; 2],
    /// Slope of its axis, dx/dz and dy/dz.
    pub tilt_rad: [f64; 2],
    /// Out of round.
    pub ovality: Vec<Harmonic>,
    /// Random unevenness, scale by scale.
    pub unevenness: Vec<Unevenness>,
    /// How far the weld drew the wall in at the seam, mm.
    pub shrinkage_mm: f64,
    /// Machined by a taper.
    pub taper: Option<Taper>,
    /// Machined by a counterbore.
    pub counterbore: Option<Counterbore>,
    /// Bent.
    pub flare: Option<Flare>,
    /// Dents, bulges, and arcs that stand off.
    pub dents: Vec<Dent>,
    /// Coats and tapes.
    pub strips: Vec<Strip>,
}

/// The cap: `height (1 - |v|^n)^m` over the chord between the walls' edges, v from -1 to 1 with 0 at the crown.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cap {
    /// Toe to toe, mm.
    pub width_mm: f64,
    /// At the crown, mm; 0: ground flush; below 0: concave or underfilled.
    pub height_mm: f64,
    /// n: 2 for a parabola, above for a flat crown.
    pub power: f64,
    /// m: 0.5 for an ellipse, 1 for a parabola, 2 for toes that blend in.
    pub blend: f64,
    /// Where the crown is, 0 to 1 from the reference wall's toe to the other's.
    pub crown: f64,
    /// Depth of a valley along the crown, as a share of the height: two humps.
    pub valley: f64,
    /// Amplitude of the ripples, mm.
    pub ripple_mm: f64,
    /// Their distance, mm.
    pub pitch_mm: f64,
    /// Each toe by itself.
    pub toes: Wander,
    /// The height, by itself.
    pub crest: Wander,
    /// Depth of the undercut inside the reference wall's toe and inside the other's, mm.
    pub undercut_mm: [f64; 2],
    /// Its width, mm.
    pub undercut_width_mm: f64,
}

/// A second weld, with a ring between it and the first.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SecondSeam {
    /// From the middle of the first cap to the middle of the second, mm; below 0 it is in the reference wall.
    pub distance_mm: f64,
    /// Width of its cap, mm.
    pub width_mm: f64,
    /// Height of its cap, mm.
    pub height_mm: f64,
    /// How far the ring stands out from the wall beyond it, mm.
    pub ring_mm: f64,
}

/// A drop of spatter: a ball whose middle lies 0.3 radii below the surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spatter {
    /// Where it is, rad.
    pub at_rad: f64,
    /// Where it is, mm.
    pub z_mm: f64,
    /// Radius, mm.
    pub radius_mm: f64,
}

/// All of a weld.
#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// Nominal outside radius, mm.
    pub radius_mm: f64,
    /// Wall thickness, mm: it sets how far shrinkage reaches.
    pub thickness_mm: f64,
    /// The pipes end at this distance from z = 0, mm.
    pub half_length_mm: f64,
    /// z below the seam.
    pub reference: Wall,
    /// z above the seam.
    pub other: Wall,
    /// Between them.
    pub cap: Cap,
    /// Where the seam's middle is, z, mm.
    pub seam_mm: f64,
    /// How the seam wanders along the pipe.
    pub seam_wander: Wander,
    /// A second weld in view.
    pub second: Option<SecondSeam>,
    /// Drops on walls and cap.
    pub spatter: Vec<Spatter>,
    /// Start of the random numbers.
    pub seed: u64,
}

/// What a place of the surface belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// The reference wall up to its toe.
    Reference = 1,
    /// The other wall up to its toe.
    Other = 2,
    /// Between the toes.
    Cap = 3,
    /// The cap of the second weld.
    SecondCap = 4,
    /// A drop of spatter.
    Spatter = 5,
}

/// The truth at one angle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Edges {
    /// z of the reference wall's and of the other wall's toe, mm.
    pub toes_mm: [f64; 2],
    /// Height of the reference wall's and of the other wall's surface there over the nominal radius, mm. Spatter is left
    /// out.
    pub heights_mm: [f64; 2],
    /// The cap's largest height over the chord, ripples left out, mm.
    pub cap_mm: f64,
    /// Step at the second weld, away from the first minus towards it, mm; 0 without one.
    pub second_step_mm: f64,
}

impl Edges {
    /// Other wall minus reference wall, along the radius, mm.
    #[inline]
    pub fn step_mm(&self) -> f64 {
        self.heights_mm[1] - self.heights_mm[0]
    }
}

/// The reference wall is side 0, the other wall side 1.
type Side = usize;

/// A scene whose random parts are drawn: it can be asked for its surface.
#[derive(Debug, Clone)]
pub struct Surface {
    scene: Scene,
    fields: [Vec<Field>; 2],
    toes: [Curve; 2],
    crest: Curve,
    seam: Curve,
    /// Of the shell term, 1/mm.
    decay: f64,
    /// Drops by the degree that they reach into.
    drops: Vec<Vec<Spatter>>,
    top_mm: f64,
    bottom_mm: f64,
    /// How high that stands which rises more steeply than `cast::STEEPEST`, mm: the toes of an elliptic cap, drops.
    steep_mm: f64,
    /// The toes lie between these, z, mm.
    toes_within: [f64; 2],
    /// Whether a wall's height depends on where its toe and the seam are.
    from_toe: [bool; 2],
}

impl Surface {
    /// Draws the random parts.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] or [`Error::NonFinite`] naming the parameter.
    pub fn new(scene: Scene) -> Result<Self> {
        scene.check()?;
        let stream = |number: u64| mix(scene.seed ^ mix(number));
        let fields_of = |side: Side, wall: &Wall| {
            let seed = |scale: usize| stream(16 + 2 * scale as u64 + side as u64);
            let field = |(scale, of)| Field::new(scene.radius_mm, scene.half_length_mm, of, seed(scale));
            wall.unevenness.iter().enumerate().map(field).collect::<Result<Vec<_>>>()
        };
        let fields = [fields_of(0, &scene.reference)?, fields_of(1, &scene.other)?];
        let curve = |of: &Wander, number: u64| Curve::new(scene.radius_mm, of, stream(number));
        let mut drops = vec![Vec::new(); if scene.spatter.is_empty() { 0 } else { 360 }];
        for drop in &scene.spatter {
            let reach = (drop.radius_mm / scene.radius_mm).to_degrees();
            let at = drop.at_rad.to_degrees();
            let first = (at - reach).floor() as i64;
            for degree in first..=first.saturating_add(359).min((at + reach).floor() as i64) {
                if let Some(bin) = drops.get_mut(degree.rem_euclid(360) as usize) {
                    bin.push(*drop);
                }
            }
        }
        let (top_mm, bottom_mm) = scene.bounds();
        let crest = scene.cap.height_mm.abs() + scene.cap.ripple_mm + BOUND_SIGMA * scene.cap.crest.sd_mm;
        let drop = scene.spatter.iter().map(|d| 0.7 * d.radius_mm).fold(0.0, f64::max);
        let steep_mm = drop.max(if scene.cap.blend < 1.0 { crest } else { 0.0 });
        let reach = 0.5 * scene.cap.width_mm + BOUND_SIGMA * (scene.cap.toes.sd_mm + scene.seam_wander.sd_mm);
        let from_toe = [&scene.reference, &scene.other].map(|w| {
            let machined = w.taper.is_some() || w.counterbore.is_some() || w.flare.is_some();
            machined || w.shrinkage_mm != 0.0 || !w.dents.is_empty() || !w.strips.is_empty() || scene.second.is_some()
        });
        Ok(Self {
            toes: [curve(&scene.cap.toes, 1), curve(&scene.cap.toes, 2)],
            crest: curve(&scene.cap.crest, 3),
            seam: curve(&scene.seam_wander, 4),
            decay: 1.285 / (scene.radius_mm * scene.thickness_mm).sqrt(),
            fields,
            drops,
            top_mm,
            bottom_mm,
            steep_mm,
            toes_within: [scene.seam_mm - reach, scene.seam_mm + reach],
            from_toe,
            scene,
        })
    }

    /// The parameters.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// Whether something steep can stand between a lamp and a place of this z.
    #[inline]
    fn steep_near(&self, z: f64) -> bool {
        // Light comes in at 15 degrees over the surface at least: four times the height.
        let [low, high] = self.toes_within.map(|toe| toe - self.scene.seam_mm);
        let reach = low.abs().max(high) + 4.0 * self.steep_mm;
        !self.scene.spatter.is_empty() || (self.steep_mm > 0.0 && (z - self.scene.seam_mm).abs() < reach)
    }

    /// The middle of the seam and z of both toes at an angle.
    fn toes(&self, angle: f64) -> (f64, [f64; 2]) {
        let middle = self.scene.seam_mm + self.seam.at(angle);
        let half = 0.5 * self.scene.cap.width_mm;
        let least = NARROWEST * half;
        let reference = (half - self.toes[0].at(angle)).max(least);
        let other = (half + self.toes[1].at(angle)).max(least);
        (middle, [middle - reference, middle + other])
    }

    /// z of the second weld's toes, the one nearer to the first weld first.
    fn second_toes(&self, second: &SecondSeam, middle: f64) -> [f64; 2] {
        let half = 0.5 * second.width_mm * second.distance_mm.signum();
        [middle + second.distance_mm - half, middle + second.distance_mm + half]
    }

    /// Height of a wall over the nominal radius; `direction` is the unit vector of the angle, `x` the distance from the
    /// wall's toe, `from_middle` that from the middle of the seam.
    fn wall(&self, side: Side, (angle, direction): (f64, [f64; 2]), z: f64, x: f64, from_middle: f64) -> f64 {
        let wall = if side == 0 { &self.scene.reference } else { &self.scene.other };
        let mut f = wall.radius_difference_mm;
        if wall.offset_mm != [0.0; 2] || wall.tilt_rad != [0.0; 2] {
            let [ex, ey] = [0, 1].map(|i: usize| wall.offset_mm[i] + wall.tilt_rad[i] * z);
            let (along, aside) = (ex * direction[0] + ey * direction[1], ey * direction[0] - ex * direction[1]);
            let radius = self.scene.radius_mm + wall.radius_difference_mm;
            // The circle of that radius about the axis, along the ray from the frame's origin.
            f += along - aside * aside / (radius + (radius * radius - aside * aside).sqrt());
        }
        for h in &wall.ovality {
            f += h.amplitude_mm * (f64::from(h.n) * (angle - h.at_rad)).cos();
        }
        for field in &self.fields[side] {
            f += field.at(angle, z);
        }
        if wall.shrinkage_mm != 0.0 {
            let s = self.decay * from_middle.max(0.0);
            f -= wall.shrinkage_mm * (-s).exp() * (s.cos() + s.sin());
        }
        if let Some(t) = &wall.taper {
            f -= t.depth_mm.signum() * (t.depth_mm.abs() - t.slope * x).max(0.0);
        }
        if let Some(c) = &wall.counterbore {
            f -= c.depth_mm.signum() * (c.depth_mm.abs() - c.slope * (x - c.floor_mm).max(0.0)).max(0.0);
        }
        if let Some(flare) = &wall.flare {
            f += flare.amplitude_mm * (-x / flare.decay_mm).exp();
        }
        for dent in &wall.dents {
            let away = (angle - dent.at_rad + PI).rem_euclid(TAU) - PI;
            let shape = dent.shape(away);
            if shape > 0.0 {
                f -= dent.depth_mm * shape * (-x / dent.decay_mm).exp();
            }
        }
        for strip in &wall.strips {
            let edge = |past: f64| (past / strip.edge_mm + 0.5).clamp(0.0, 1.0);
            f += strip.thickness_mm * edge(x - strip.from_mm).min(edge(strip.to_mm - x));
        }
        f
    }

    /// What the second weld adds to the wall that it is in: the ring, and the chord and crown of its cap.
    fn second(&self, side: Side, middle: f64, z: f64) -> (f64, bool) {
        let Some(second) = &self.scene.second else { return (0.0, false) };
        if (second.distance_mm > 0.0) != (side == 1) {
            return (0.0, false);
        }
        let [near, far] = self.second_toes(second, middle);
        let u = (z - near) / (far - near);
        if u <= 0.0 {
            return (second.ring_mm, false);
        }
        if u >= 1.0 {
            return (0.0, false);
        }
        (second.ring_mm * (1.0 - u) + second.height_mm * 4.0 * u * (1.0 - u), true)
    }

    /// A wall's height at its toe.
    fn edge(&self, side: Side, at: (f64, [f64; 2]), toe: f64, middle: f64) -> f64 {
        self.wall(side, at, toe, 0.0, (toe - middle).abs()) + self.second(side, middle, toe).0
    }

    /// Height of the cap over the chord, ripples in it, at `z` between the toes.
    fn crown(&self, angle: f64, toes: [f64; 2], z: f64) -> f64 {
        let cap = &self.scene.cap;
        let mut under = 0.0;
        let mut rim = [0.0; 2];
        for (side, inside) in [z - toes[0], toes[1] - z].into_iter().enumerate() {
            if cap.undercut_mm[side] != 0.0 {
                rim[side] = cap.undercut_width_mm.min(0.3 * (toes[1] - toes[0]));
                if inside < rim[side] {
                    under -= cap.undercut_mm[side] * (PI * inside / rim[side]).sin().powi(2);
                }
            }
        }
        // The cap rises inside the undercuts.
        let u = (z - toes[0] - rim[0]) / (toes[1] - toes[0] - rim[0] - rim[1]);
        if !(0.0..=1.0).contains(&u) {
            return under;
        }
        let v = if u < cap.crown { (u - cap.crown) / cap.crown } else { (u - cap.crown) / (1.0 - cap.crown) };
        let mut profile = (1.0 - v.abs().powf(cap.power)).max(0.0).powf(cap.blend);
        if cap.valley != 0.0 {
            profile *= 1.0 - cap.valley * (-(v / 0.35).powi(2)).exp();
        }
        let mut height = cap.height_mm + self.crest.at(angle);
        if cap.ripple_mm != 0.0 {
            // Ripples are crescents: the pool freezes first at the toes.
            let bow = 0.35 * cap.width_mm * v * v;
            height += cap.ripple_mm * (TAU * (angle * self.scene.radius_mm + bow) / cap.pitch_mm).cos();
        }
        under + height * profile
    }

    /// Height over the nominal radius, and what stands there.
    pub fn height(&self, angle: f64, z: f64) -> (f64, Part) {
        let (sin, cos) = angle.sin_cos();
        self.height_towards((angle, [cos, sin]), z)
    }

    /// [`Self::height`] with the unit vector of the angle.
    #[inline]
    fn height_towards(&self, at: (f64, [f64; 2]), z: f64) -> (f64, Part) {
        // Away from the seam many a wall need not know where its toe is.
        let [low, high] = self.toes_within;
        let (middle, toes) = match (z < low, z > high) {
            (true, _) if !self.from_toe[0] => (self.scene.seam_mm, self.toes_within),
            (_, true) if !self.from_toe[1] => (self.scene.seam_mm, self.toes_within),
            _ => self.toes(at.0),
        };
        let on_wall = |side: Side, x: f64, part: Part| {
            let (more, on_second) = self.second(side, middle, z);
            let f = self.wall(side, at, z, x, (z - middle).abs()) + more;
            (f, if on_second { Part::SecondCap } else { part })
        };
        let (mut f, mut part) = if z < toes[0] {
            on_wall(0, toes[0] - z, Part::Reference)
        } else if z >= toes[1] {
            on_wall(1, z - toes[1], Part::Other)
        } else {
            let u = (z - toes[0]) / (toes[1] - toes[0]);
            let chord = (1.0 - u) * self.edge(0, at, toes[0], middle) + u * self.edge(1, at, toes[1], middle);
            (chord + self.crown(at.0, toes, z), Part::Cap)
        };
        if !self.drops.is_empty() {
            let degree = at.0.to_degrees().rem_euclid(360.0) as usize;
            let mut most = 0.0f64;
            for drop in self.drops.get(degree).into_iter().flatten() {
                let around = ((at.0 - drop.at_rad + PI).rem_euclid(TAU) - PI) * self.scene.radius_mm;
                let away = around * around + (z - drop.z_mm).powi(2);
                most = most.max((drop.radius_mm * drop.radius_mm - away).max(0.0).sqrt() - 0.3 * drop.radius_mm);
            }
            if most > 0.0 {
                (f, part) = (f + most, Part::Spatter);
            }
        }
        (f, part)
    }

    /// The truth at an angle.
    pub fn edges(&self, angle: f64) -> Edges {
        let (sin, cos) = angle.sin_cos();
        let at = (angle, [cos, sin]);
        let (middle, toes) = self.toes(angle);
        let heights_mm = [0, 1].map(|side: usize| self.edge(side, at, toes[side], middle));
        let crest = |i: u32| {
            let z = toes[0] + (toes[1] - toes[0]) * f64::from(i) / 64.0;
            self.crown(angle, toes, z)
        };
        let tallest = (0..=64).map(crest).fold(0.0, |best: f64, c| if c.abs() > best.abs() { c } else { best });
        let second_step_mm = self.scene.second.as_ref().map_or(0.0, |second| {
            let side = usize::from(second.distance_mm > 0.0);
            let [near, far] = self.second_toes(second, middle);
            let height = |z: f64| self.wall(side, at, z, (z - toes[side]).abs(), (z - middle).abs());
            height(far) - height(near) - second.ring_mm
        });
        Edges { toes_mm: toes, heights_mm, cap_mm: tallest, second_step_mm }
    }

    /// [`Self::edges`] at many angles.
    pub fn edges_at(&self, angles: &[f64]) -> Vec<Edges> {
        threads::map_chunks(angles, |_, chunk| chunk.iter().map(|&a| self.edges(a)).collect::<Vec<_>>()).concat()
    }

    /// [`Self::height`] at many places (angle, z).
    pub fn heights_at(&self, places: &[[f64; 2]]) -> Vec<f64> {
        let height = |&[angle, z]: &[f64; 2]| self.height(angle, z).0;
        threads::map_chunks(places, |_, chunk| chunk.iter().map(height).collect::<Vec<_>>()).concat()
    }
}

impl Dent {
    /// 1 at the middle, 0.5 at half the width.
    #[inline]
    fn shape(&self, away: f64) -> f64 {
        let ratio = away / self.width_rad;
        if self.cosine {
            if ratio.abs() < 1.0 { 0.5 + 0.5 * (PI * ratio).cos() } else { 0.0 }
        } else {
            (-4.0 * std::f64::consts::LN_2 * ratio * ratio).exp()
        }
    }
}

impl Wall {
    /// How far it can stand out and in, away from the nominal radius, mm.
    fn bounds(&self, half_length_mm: f64) -> (f64, f64) {
        let tilt = self.tilt_rad[0].hypot(self.tilt_rad[1]) * half_length_mm;
        let random: f64 = self.unevenness.iter().map(|u| BOUND_SIGMA * u.sd_mm).sum();
        let round: f64 = self.ovality.iter().map(|h| h.amplitude_mm.abs()).sum();
        let mut out = self.offset_mm[0].hypot(self.offset_mm[1]) + tilt + random + round;
        let mut inward = out;
        let signed = [
            self.radius_difference_mm,
            -self.shrinkage_mm,
            self.taper.map_or(0.0, |t| -t.depth_mm),
            self.counterbore.map_or(0.0, |c| -c.depth_mm),
            self.flare.map_or(0.0, |f| f.amplitude_mm),
        ];
        let dents = self.dents.iter().map(|d| -d.depth_mm);
        for part in signed.into_iter().chain(dents).chain(self.strips.iter().map(|s| s.thickness_mm)) {
            if part > 0.0 { out += part } else { inward -= part }
        }
        // The shell term undershoots by e^-π of its height.
        (out + 0.05 * self.shrinkage_mm.abs(), inward + 0.05 * self.shrinkage_mm.abs())
    }
}

impl Scene {
    /// How far the surface can reach above and below the nominal radius, mm.
    fn bounds(&self) -> (f64, f64) {
        let walls = [&self.reference, &self.other].map(|w| w.bounds(self.half_length_mm));
        let crest = self.cap.height_mm.abs() + self.cap.ripple_mm.abs() + BOUND_SIGMA * self.cap.crest.sd_mm;
        let under = self.cap.undercut_mm[0].abs().max(self.cap.undercut_mm[1].abs());
        let second = self.second.map_or(0.0, |s| s.ring_mm.abs() + s.height_mm.abs());
        let drops = self.spatter.iter().map(|d| d.radius_mm).fold(0.0, f64::max);
        let top = walls[0].0.max(walls[1].0) + crest.max(second) + drops;
        let concave = if self.cap.height_mm < 0.0 { crest } else { self.cap.ripple_mm.abs() };
        let bottom = walls[0].1.max(walls[1].1) + under + concave.max(second);
        (top + 0.01, bottom + 0.01)
    }

    fn check(&self) -> Result<()> {
        require_positive("scene radius_mm", self.radius_mm)?;
        require_positive("scene thickness_mm", self.thickness_mm)?;
        require_positive("scene half_length_mm", self.half_length_mm)?;
        let refuse =
            |what, expected: &str, value: String| Err(Error::OutOfRange { what, expected: expected.into(), value });
        if self.half_length_mm > 1e4 {
            return refuse("scene half_length_mm", "at most 10000", self.half_length_mm.to_string());
        }
        let c = &self.cap;
        require_positive("cap width_mm", c.width_mm)?;
        require_positive("cap power", c.power)?;
        require_positive("cap blend", c.blend)?;
        require_positive("cap pitch_mm", c.pitch_mm)?;
        require_positive("cap undercut_width_mm", c.undercut_width_mm)?;
        if !(c.crown > 0.0 && c.crown < 1.0) {
            return refuse("cap crown", "above 0 and below 1", c.crown.to_string());
        }
        let mut numbers = vec![c.height_mm, c.valley, c.ripple_mm, self.seam_mm];
        numbers.extend(c.undercut_mm);
        for wander in [c.toes, c.crest, self.seam_wander] {
            require_positive("wander length_mm", wander.length_mm)?;
            if nodes_too_many(self.radius_mm, wander.length_mm) {
                return refuse("wander length_mm", "a ten-thousandth of the girth", wander.length_mm.to_string());
            }
            numbers.push(wander.sd_mm);
        }
        for wall in [&self.reference, &self.other] {
            numbers.extend([wall.radius_difference_mm, wall.shrinkage_mm]);
            numbers.extend(wall.offset_mm);
            numbers.extend(wall.tilt_rad);
            for h in &wall.ovality {
                numbers.extend([h.amplitude_mm, h.at_rad]);
            }
            for u in &wall.unevenness {
                numbers.push(u.sd_mm);
                require_positive("unevenness around_mm", u.around_mm)?;
                require_positive("unevenness along_mm", u.along_mm)?;
            }
            if let Some(t) = &wall.taper {
                numbers.push(t.depth_mm);
                require_positive("taper slope", t.slope)?;
            }
            if let Some(b) = &wall.counterbore {
                numbers.extend([b.depth_mm, b.floor_mm]);
                require_positive("counterbore slope", b.slope)?;
            }
            if let Some(f) = &wall.flare {
                numbers.push(f.amplitude_mm);
                require_positive("flare decay_mm", f.decay_mm)?;
            }
            for d in &wall.dents {
                numbers.extend([d.depth_mm, d.at_rad]);
                require_positive("dent width_rad", d.width_rad)?;
                if d.decay_mm.is_nan() || d.decay_mm <= 0.0 {
                    return refuse("dent decay_mm", "above 0 (infinite for the whole wall)", d.decay_mm.to_string());
                }
            }
            for s in &wall.strips {
                numbers.extend([s.thickness_mm, s.from_mm]);
                require_positive("strip edge_mm", s.edge_mm)?;
                if s.to_mm.is_nan() {
                    return refuse("strip to_mm", "a number (infinite for a coat)", s.to_mm.to_string());
                }
            }
        }
        if let Some(s) = &self.second {
            numbers.extend([s.height_mm, s.ring_mm]);
            require_positive("second seam width_mm", s.width_mm)?;
            let least = 0.5 * (s.width_mm + c.width_mm);
            if s.distance_mm.is_nan() || s.distance_mm.abs() <= least {
                return refuse("second seam distance_mm", "beyond the first cap", s.distance_mm.to_string());
            }
        }
        for d in &self.spatter {
            numbers.extend([d.at_rad, d.z_mm]);
            require_positive("spatter radius_mm", d.radius_mm)?;
        }
        if let Some(index) = numbers.iter().position(|v| !v.is_finite()) {
            return Err(Error::NonFinite { what: "scene's numbers", index });
        }
        // Beyond that the surface would cut into itself, and the circle about a moved axis would not hold the origin.
        let (top, bottom) = self.bounds();
        if !(top < self.radius_mm && bottom < 0.8 * self.radius_mm) {
            let value = format!("{top} above and {bottom} below");
            return refuse("scene's heights, mm", "less than the radius above and 0.8 of it below", value);
        }
        Ok(())
    }
}

/// A curve with more nodes than that is a mistake.
fn nodes_too_many(radius_mm: f64, length_mm: f64) -> bool {
    TAU * radius_mm / length_mm > 1e4
}

#[cfg(test)]
mod tests;
