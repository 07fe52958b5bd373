//! What is minimised, and how a residual counts.

use crate::ground::robust::{huber, tukey};
use crate::ground::transform::Transform;

/// What is minimised.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Metric {
    /// Distances between paired points.
    Point,
    /// Distances from the target's tangent planes.
    Plane,
}

/// How a residual counts. The width is in mm; without one it follows from the median residual of each round.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum RobustKernel {
    /// Squared.
    None,
    /// Squared up to the width, then linear.
    Huber(Option<f64>),
    /// Smoothly down to no influence beyond the width.
    Tukey(Option<f64>),
}

/// The options of [`register`](super::register).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Options {
    /// What is minimised.
    pub metric: Metric,
    /// `target_from_source` to start from.
    pub start: Transform,
    /// Pairs further apart do not count, mm.
    pub max_distance_mm: f64,
    /// Share of the pairs, the ones furthest apart, that does not count.
    pub trim: f64,
    /// How a residual counts.
    pub kernel: RobustKernel,
    /// Rounds at most, in all.
    pub max_iterations: usize,
    /// Converged when a round moves no point further than this, mm.
    pub tolerance_mm: f64,
    /// A direction is unobserved when a motion of 1 mm along it changes the residuals by less than this, mm rms.
    pub weak: f64,
    /// Register with an even choice of this many points only.
    pub max_points: Option<usize>,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            metric: Metric::Point,
            start: Transform::identity(),
            max_distance_mm: f64::INFINITY,
            trim: 0.0,
            kernel: RobustKernel::None,
            max_iterations: 100,
            tolerance_mm: 1e-7,
            // A hundredth: normals from scanned clouds are no better than half a degree.
            weak: 0.01,
            max_points: None,
        }
    }
}

impl RobustKernel {
    /// The weight of a residual in the iteratively reweighted least squares.
    #[inline(always)]
    pub(super) fn weight(self, residual: f64) -> f64 {
        match self {
            Self::Huber(Some(width)) if width > 0.0 => huber(residual, width),
            Self::Tukey(Some(width)) if width > 0.0 => tukey(residual / width),
            _ => 1.0,
        }
    }
}
