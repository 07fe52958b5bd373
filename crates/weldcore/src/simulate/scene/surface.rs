//! The surface of a scene: its height at any place, and the truth at its toes.

use std::f64::consts::{PI, TAU};

use super::description::{BOUND_SIGMA, Scene, SceneWall, SecondSeam, Spatter};
use super::field::{Curve, Field, Wander};
use crate::error::Result;
use crate::ground::random::mix;
use crate::ground::threads;

/// A cap keeps at least this share of its width where its toes wander towards each other.
const NARROWEST: f64 = 0.2;

/// What a place of the surface belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WeldPart {
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
type WallSide = usize;

/// A scene whose random parts are drawn: it can be asked for its surface.
#[derive(Debug, Clone)]
pub struct WeldSurface {
    pub(super) scene: Scene,
    fields: [Vec<Field>; 2],
    toes: [Curve; 2],
    crest: Curve,
    seam: Curve,
    /// Of the shell term, 1/mm.
    decay: f64,
    /// Drops by the degree that they reach into.
    drops: Vec<Vec<Spatter>>,
    pub(super) top_mm: f64,
    pub(super) bottom_mm: f64,
    /// How high that stands which rises more steeply than `cast::STEEPEST`, mm: the toes of an elliptic cap, drops.
    pub(super) steep_mm: f64,
    /// The toes lie between these, z, mm.
    toes_within: [f64; 2],
    /// Whether a wall's height depends on where its toe and the seam are.
    from_toe: [bool; 2],
}

impl WeldSurface {
    /// Draws the random parts.
    ///
    /// # Errors
    /// [`Error::OutOfRange`](crate::Error::OutOfRange) or [`Error::NonFinite`](crate::Error::NonFinite) naming the parameter.
    pub fn new(scene: Scene) -> Result<Self> {
        scene.check()?;
        let stream = |number: u64| mix(scene.seed ^ mix(number));
        let fields_of = |side: WallSide, wall: &SceneWall| {
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
    pub(super) fn steep_near(&self, z: f64) -> bool {
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
    fn wall(&self, side: WallSide, (angle, direction): (f64, [f64; 2]), z: f64, x: f64, from_middle: f64) -> f64 {
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
    fn second(&self, side: WallSide, middle: f64, z: f64) -> (f64, bool) {
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
    fn edge(&self, side: WallSide, at: (f64, [f64; 2]), toe: f64, middle: f64) -> f64 {
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
    pub fn height(&self, angle: f64, z: f64) -> (f64, WeldPart) {
        let (sin, cos) = angle.sin_cos();
        self.height_towards((angle, [cos, sin]), z)
    }

    /// [`Self::height`] with the unit vector of the angle.
    #[inline]
    pub(super) fn height_towards(&self, at: (f64, [f64; 2]), z: f64) -> (f64, WeldPart) {
        // Away from the seam many a wall need not know where its toe is.
        let [low, high] = self.toes_within;
        let (middle, toes) = match (z < low, z > high) {
            (true, _) if !self.from_toe[0] => (self.scene.seam_mm, self.toes_within),
            (_, true) if !self.from_toe[1] => (self.scene.seam_mm, self.toes_within),
            _ => self.toes(at.0),
        };
        let on_wall = |side: WallSide, x: f64, part: WeldPart| {
            let (more, on_second) = self.second(side, middle, z);
            let f = self.wall(side, at, z, x, (z - middle).abs()) + more;
            (f, if on_second { WeldPart::SecondCap } else { part })
        };
        let (mut f, mut part) = if z < toes[0] {
            on_wall(0, toes[0] - z, WeldPart::Reference)
        } else if z >= toes[1] {
            on_wall(1, z - toes[1], WeldPart::Other)
        } else {
            let u = (z - toes[0]) / (toes[1] - toes[0]);
            let chord = (1.0 - u) * self.edge(0, at, toes[0], middle) + u * self.edge(1, at, toes[1], middle);
            (chord + self.crown(at.0, toes, z), WeldPart::Cap)
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
                (f, part) = (f + most, WeldPart::Spatter);
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
