//! One station along the seam, and what may be doubtful about it.

use super::walls::WallRun;
use crate::ground::robust::median;

/// How a station's weld shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Kind {
    /// Nothing of it is known.
    Unknown = 0,
    /// A raised cap.
    Raised = 1,
    /// A hollow one.
    Hollow = 2,
    /// A jump between two walls, without a cap.
    Flush = 3,
}

/// The edge step of one station.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Edge {
    /// Height of the other wall's surface over the reference wall's, each right beside its toe, read along the bisector of
    /// both walls' normals.
    pub step_mm: f64,
    /// Standard uncertainty: noise, choice of the stretch, direction of reading.
    pub standard_mm: f64,
    /// What the choice of the toes may hide, in full.
    pub hull_mm: f64,
    /// Part of it: what looks like the foot of the cap, or like an undercut, and may be the wall's own edge.
    pub foot_mm: f64,
}

impl Edge {
    /// Expanded (k = 2), and the hull in full.
    pub fn expanded_mm(&self) -> f64 {
        2.0 * self.standard_mm + self.hull_mm
    }
}

/// One station.
#[derive(Debug, Clone, PartialEq)]
pub struct Station {
    /// Its middle, in the seam's parameter.
    pub at: f64,
    /// Whether enough points lie near the weld.
    pub seen: bool,
    /// How its weld shows.
    pub kind: Kind,
    /// Whether the toes are the course's, for want of its own.
    pub by_course: bool,
    /// Both toes across the seam: reference side, other side.
    pub toes_mm: Option<[f64; 2]>,
    /// Standard uncertainty of each toe: a sixth of the range in which it may as well be, and what the toes of the view
    /// scatter along the seam.
    pub toes_standard_mm: [f64; 2],
    /// Height of the cap over the chord between the toes.
    pub height_mm: f64,
    /// The edge step, where both surfaces beside the toes are there.
    pub edge: Option<Edge>,
    /// How far the step of the surfaces is off that of the two neighbours at the same places, where it is more than noise: what
    /// else is read off them is spatter, or a toe that is taken elsewhere.
    pub local_step_mm: Option<f64>,
    /// From where outward each wall is undisturbed, across the seam.
    pub undisturbed_mm: [Option<f64>; 2],
    /// How far the surface between toe and undisturbed wall departs from the straight wall.
    pub departure_mm: [f64; 2],
    /// Both straight walls extrapolated to the middle between the toes.
    pub wall_step_mm: Option<f64>,
    pub(crate) walls: [Option<WallRun>; 2],
}

impl Station {
    /// The straight wall of a side (0 reference, 1 other) at a place across the seam.
    pub(super) fn straight_at(&self, side: usize, x: f64) -> Option<f64> {
        self.walls[side].map(|run| run.straight(if side == 0 { -x } else { x }))
    }

    /// Slope of a side's straight wall across the seam.
    pub(super) fn slope(&self, side: usize) -> Option<f64> {
        self.walls[side].map(|run| if side == 0 { -run.slope } else { run.slope })
    }
}

/// Why a weld's edges may not be what they seem: a code of `weldscan.result.CODES`, the place, and a line.
#[derive(Debug, Clone, PartialEq)]
pub struct Doubt {
    /// `cap`, `edges`, `transition`, `walls` or `points-without-wall`.
    pub code: &'static str,
    /// Where, in the seam's parameter.
    pub at: f64,
    /// What, with numbers.
    pub text: String,
}

/// Median of the values within `reach` stations of one, itself included; `None` with fewer than three.
pub(super) fn running_median(values: &[Option<f64>], at: usize, reach: usize) -> Option<f64> {
    let mut near: Vec<f64> =
        values[at.saturating_sub(reach)..(at + reach + 1).min(values.len())].iter().flatten().copied().collect();
    (near.len() >= 3).then(|| median(&mut near))
}
