//! What a point belongs to, and what became of it.

/// What a point belongs to; the numbers are those of `weldscan.result.Label`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Label {
    /// No point, or nothing of the weld.
    None = 0,
    /// The wall that the step is counted from.
    ReferenceWall = 1,
    /// The wall behind the weld, along the axis.
    OtherWall = 2,
    /// The weld metal.
    Bead = 3,
    /// Between a toe and an undisturbed wall, off the latter.
    Transition = 4,
}

/// What became of a point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Fate {
    /// There is none.
    None = 0,
    /// It lies on an undisturbed wall.
    Wall = 1,
    /// Between a toe and the undisturbed wall, off the latter.
    Transition = 2,
    /// Between the toes.
    Cap = 3,
    /// Further from the wall than two thicknesses.
    Gated = 4,
    /// Beside an undisturbed wall, off its line.
    OffLine = 5,
    /// Where no wall was recognised.
    Other = 6,
}
