//! What decoding finds, pixel by pixel, and why a pixel has no answer.

use super::noise::CameraNoise;
use super::phase_error::PhaseError;
use super::redundancy::disagreement::Disagreement;
use super::temporal::Plan;

/// Why a pixel has no answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Reason {
    /// It has one.
    Ok = 0,
    /// Its modulation does not stand above the noise by what the unwrapping needs.
    Dark = 1,
    /// Some set is saturated in every exposure.
    Saturated = 2,
    /// The frequencies disagree on the fringe order, or the neighbours do.
    OrderInDoubt = 3,
    /// Its samples are no sinusoid.
    NoFit = 4,
}

/// How many reasons there are.
pub const REASONS: usize = 5;

/// What decoding found.
#[derive(Debug, Clone)]
pub struct PhaseMap {
    /// Columns of the camera's image.
    pub width: usize,
    /// Rows of the camera's image.
    pub height: usize,
    /// The projector's column (row for horizontal fringes), pixel centres at whole numbers; NaN where rejected.
    pub column_px: Vec<f64>,
    /// Its standard deviation by noise; NaN where rejected.
    pub sigma_px: Vec<f32>,
    /// Amplitude of the finest fringes in the exposure that counts most, grey levels.
    pub modulation: Vec<f32>,
    /// Mean level of the same.
    pub background: Vec<f32>,
    /// A [`Reason`] per pixel.
    pub reason: Vec<u8>,
    /// How many pixels have each reason.
    pub counts: [usize; REASONS],
    /// The camera's noise.
    pub noise: CameraNoise,
    /// The level from which a pixel counts as saturated.
    pub saturation: f64,
    /// Whether the images show that the camera clips below the full scale of its numbers.
    pub clipped_below_full_scale: bool,
    /// Per set the rms of the higher harmonics over the first's amplitude; `None` with three steps, which show none.
    pub harmonics: Vec<Option<f64>>,
    /// Per set the error that was taken off its phase, for the projector's response.
    pub phase_error: Vec<PhaseError>,
    /// How the sets were unwrapped.
    pub plan: Plan,
    /// Where the frames contradict each other, and the likely cause; empty for a stack that agrees with itself.
    pub disagreements: Vec<Disagreement>,
}
