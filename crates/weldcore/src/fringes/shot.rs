//! The frames of a shot, and the fringes that they show.

/// N steps of one frequency: step k projects `0.5 + 0.5 cos(2π(periods (u + 0.5)/width) - direction 2πk/N + origin_rad)`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FringeSet {
    /// Periods over the projector's width (height for horizontal fringes).
    pub periods: f64,
    /// Number of steps, 3 or more.
    pub steps: usize,
    /// 1, or -1 where the fringes move the other way from step to step.
    pub direction: f64,
    /// What the pattern's phase at the projector's border is more than zero in the first step.
    pub origin_rad: f64,
}

impl FringeSet {
    /// Steps that run the usual way, from phase zero.
    pub const fn new(periods: f64, steps: usize) -> Self {
        Self { periods, steps, direction: 1.0, origin_rad: 0.0 }
    }

    /// Does it keep to the usual convention?
    pub(crate) fn is_plain(&self) -> bool {
        self.direction > 0.0 && self.origin_rad == 0.0
    }

    /// The phase that counts fringes from the border, from the measured one `A + B cos(phi - 2πk/N)`, both in turns.
    #[inline(always)]
    pub(crate) fn phase_of_measured(&self, turns: f32) -> f32 {
        self.direction as f32 * turns - (self.origin_rad / std::f64::consts::TAU) as f32
    }
}

/// The images of one shot, all of the same size, row-major.
#[derive(Debug, Clone)]
pub struct Shot<'a, T> {
    /// Per exposure the frames in the order of the fringe sets, then of the steps.
    pub exposures: Vec<Vec<&'a [T]>>,
    /// Columns of the camera's image.
    pub width: usize,
    /// Rows of the camera's image.
    pub height: usize,
}

/// Where the frames of each set begin in an exposure.
pub(super) fn starts(sets: &[FringeSet]) -> Vec<usize> {
    sets.iter().scan(0, |at, s| Some(std::mem::replace(at, *at + s.steps))).collect()
}
