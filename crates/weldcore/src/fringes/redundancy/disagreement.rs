//! What is said of frames that contradict each other.

/// A contradiction between the frames of one exposure, and what would explain it.
#[derive(Debug, Clone, PartialEq)]
pub struct Disagreement {
    /// Which exposure.
    pub exposure: usize,
    /// The fringe set that is concerned; `None`: several.
    pub set: Option<usize>,
    /// The frames of the exposure that are concerned, from 0; all of a set, or of the stack, where no single ones are.
    pub frames: Vec<usize>,
    /// One line: the likely cause. Steps count from 0 in their set.
    pub text: String,
    /// Share of the clear pixels that contradict the frames as they are stated.
    pub share: f64,
    /// How many times better the cause fits than the statement.
    pub strength: f64,
}

/// By how many steps of a set it begins late or early, the shorter way round.
pub(super) fn late(by: usize, steps: usize) -> String {
    let early = 2 * by > steps;
    let by = if early { steps - by } else { by };
    format!("{by} step{} {}", if by == 1 { "" } else { "s" }, if early { "early" } else { "late" })
}
