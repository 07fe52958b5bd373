//! The one error type of the core. Each message names the thing and, where there is one, the remedy.

/// What can go wrong in the core.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// An array has the wrong shape or two arrays do not belong together.
    #[error("{what}: expected {expected}, got {got}")]
    Shape {
        /// The argument.
        what: &'static str,
        /// What it should be.
        expected: String,
        /// What it is.
        got: String,
    },
    /// A value that must be finite is NaN or infinite.
    #[error("{what}: not finite at index {index}")]
    NonFinite {
        /// The argument.
        what: &'static str,
        /// Position of the first such value.
        index: usize,
    },
    /// A parameter is outside its range.
    #[error("{what}: must be {expected}, got {value}")]
    OutOfRange {
        /// The argument.
        what: &'static str,
        /// Its range.
        expected: String,
        /// Its value.
        value: String,
    },
    /// Fewer data than the question has unknowns.
    #[error("{what}: at least {needed} needed, got {got}")]
    TooFew {
        /// What there is too little of.
        what: &'static str,
        /// How many are needed.
        needed: usize,
        /// How many there are.
        got: usize,
    },
    /// The data do not determine the answer (collinear, coplanar, all equal ...).
    #[error("{what}: {reason}")]
    Degenerate {
        /// What was to be computed.
        what: &'static str,
        /// Why it cannot be.
        reason: String,
    },
    /// An image file is not what it should be.
    #[error("{reason}")]
    Image {
        /// What it is, and what it should be; the file's name goes before it.
        reason: String,
    },
    /// A method gives no answer on these data.
    #[error("{reason}")]
    NoAnswer {
        /// Why.
        reason: String,
    },
    /// What was looked for is not in the data.
    #[error("{what} not found: {reason}")]
    NotFound {
        /// What was looked for.
        what: &'static str,
        /// What was seen instead.
        reason: String,
    },
}

/// The result of a core function.
pub type Result<T> = std::result::Result<T, Error>;

/// Fails with [`Error::NonFinite`] at the first point with a NaN or infinite coordinate.
pub fn require_finite(what: &'static str, points: &[[f64; 3]]) -> Result<()> {
    match points.iter().position(|p| !p.iter().all(|c| c.is_finite())) {
        Some(index) => Err(Error::NonFinite { what, index }),
        None => Ok(()),
    }
}

/// Fails with [`Error::TooFew`] below `needed`.
pub fn require_count(what: &'static str, needed: usize, got: usize) -> Result<()> {
    if got < needed { Err(Error::TooFew { what, needed, got }) } else { Ok(()) }
}

/// Fails with [`Error::OutOfRange`] unless `value` is finite and above zero.
pub fn require_positive(what: &'static str, value: f64) -> Result<()> {
    if value.is_finite() && value > 0.0 {
        Ok(())
    } else {
        Err(Error::OutOfRange { what, expected: "finite and above 0".into(), value: value.to_string() })
    }
}
