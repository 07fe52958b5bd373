//! What a scene is described by, and the checks of every number.

use std::f64::consts::{PI, TAU};

use super::field::{Unevenness, Wander};
use crate::error::{Error, Result, require_positive};

/// Standard deviations of a random part that bound the surface.
pub(super) const BOUND_SIGMA: f64 = 6.0;

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
pub struct SceneWall {
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
    pub reference: SceneWall,
    /// z above the seam.
    pub other: SceneWall,
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

impl Dent {
    /// 1 at the middle, 0.5 at half the width.
    #[inline]
    pub(super) fn shape(&self, away: f64) -> f64 {
        let ratio = away / self.width_rad;
        if self.cosine {
            if ratio.abs() < 1.0 { 0.5 + 0.5 * (PI * ratio).cos() } else { 0.0 }
        } else {
            (-4.0 * std::f64::consts::LN_2 * ratio * ratio).exp()
        }
    }
}

impl SceneWall {
    /// How far it can stand out and in, away from the nominal radius, mm.
    pub(super) fn bounds(&self, half_length_mm: f64) -> (f64, f64) {
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
    pub(super) fn bounds(&self) -> (f64, f64) {
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

    pub(super) fn check(&self) -> Result<()> {
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
