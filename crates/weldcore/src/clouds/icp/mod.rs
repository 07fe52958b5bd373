//! Iterative closest point: the rigid motion that brings a cloud onto a target.
//!
//! Each round pairs every source point, moved by the present pose, with the nearest point of the target, and moves the
//! pose by the Gauss-Newton step of the weighted sum of squares of
//! - `p - q` (metric point: Besl & McKay, A method for registration of 3-D shapes, PAMI 14 (1992) 239), or
//! - `n · (p - q)` (metric plane: Chen & Medioni, Object modelling by registration of multiple range images, IVC 10
//!   (1992) 145).
//!
//! There is one pose; moved points are made from it anew in every round. Rotations are scaled by the cloud's size, so
//! that all six directions are in millimetres, and each eigenvalue of the normal matrix is tested: along a direction
//! in which the residuals hardly change (about and along the axis of a cylinder, say) the pose is not moved, and the
//! direction is reported.

mod equations;
mod options;
mod pairs;
mod registration;
mod rounds;

use nalgebra::Matrix6;

pub use options::{Metric, Options, RobustKernel};
pub use registration::{Registration, Weak, WeakKind};

use crate::clouds::distance::Target;
use crate::error::{Error, Result, require_count, require_finite, require_positive};
use pairs::as_vector;
use rounds::{FEWEST, Rounds};

/// Points of the first rounds, which only have to come near.
const COARSE: usize = 16 * 1024;
/// How far the length of a normal may be from 1: rounding of single precision, or of four decimals.
const UNIT: f64 = 1e-3;

/// Brings `source` onto `target`.
///
/// Where there are many points the first rounds run on an even choice of them, to come near; the last ones run on all, or
/// on `max_points`. With `max_points` everything in the answer, inliers and covariance too, is of the chosen points.
///
/// # Errors
/// [`Error::TooFew`] below three points, [`Error::NonFinite`], [`Error::OutOfRange`] for an option,
/// [`Error::Shape`] for normals that are not those of the cloud, [`Error::Degenerate`] for the metric plane to a cloud
/// without normals, [`Error::NotFound`] where fewer than three pairs count.
pub fn register(source: &[[f64; 3]], target: &Target, options: &Options) -> Result<Registration> {
    check(source, target, options)?;
    let wanted = options.max_points.unwrap_or(usize::MAX).min(source.len());
    let mut pose = options.start;
    let mut iterations = 0;
    if wanted > 2 * COARSE {
        let mut coarse = Rounds::new(source, COARSE, target, options);
        (pose, iterations, _) = coarse.run(pose, options.max_iterations / 2)?;
    }
    let mut rounds = Rounds::new(source, wanted, target, options);
    let (target_from_source, more, converged) = rounds.run(pose, options.max_iterations - iterations)?;
    iterations += more;
    rounds.conclude(Registration {
        target_from_source,
        converged,
        iterations,
        rms_mm: 0.0,
        inliers: Vec::new(),
        covariance: Matrix6::zeros(),
        unobserved: Vec::new(),
    })
}

fn check(source: &[[f64; 3]], target: &Target, options: &Options) -> Result<()> {
    require_count("source", FEWEST, source.len())?;
    require_finite("source", source)?;
    let refuse = |what, expected: &str, value: f64| {
        Err(Error::OutOfRange { what, expected: expected.into(), value: value.to_string() })
    };
    if options.max_distance_mm.is_nan() || options.max_distance_mm <= 0.0 {
        return refuse("max_distance_mm", "above 0", options.max_distance_mm);
    }
    if !(0.0..1.0).contains(&options.trim) {
        return refuse("trim", "from 0 to below 1", options.trim);
    }
    if !(0.0..1.0).contains(&options.weak) {
        return refuse("weak", "from 0 to below 1", options.weak);
    }
    if !(options.tolerance_mm >= 0.0 && options.tolerance_mm.is_finite()) {
        return refuse("tolerance_mm", "0 or more, and finite", options.tolerance_mm);
    }
    if options.max_iterations == 0 {
        return refuse("max_iterations", "at least 1", 0.0);
    }
    if let Some(n) = options.max_points.filter(|&n| n < FEWEST) {
        return refuse("max_points", "at least 3", n as f64);
    }
    if let RobustKernel::Huber(Some(width)) | RobustKernel::Tukey(Some(width)) = options.kernel {
        require_positive("kernel_mm", width)?;
    }
    if let Target::Cloud(tree, normals) = target {
        match normals {
            Some(n) if n.len() != tree.len() => {
                let (expected, got) = (format!("{} as in target", tree.len()), n.len().to_string());
                return Err(Error::Shape { what: "normals", expected, got });
            }
            Some(n) => {
                // NaN is a point without a normal; any other length but 1 would scale the residuals.
                let length = |n: &[f64; 3]| as_vector(n).norm();
                if let Some(n) = n.iter().find(|n| (length(n) - 1.0).abs() > UNIT) {
                    return refuse("normals", "unit vectors, or NaN", length(n));
                }
            }
            None if options.metric == Metric::Plane => {
                let reason = "metric plane needs the normals of the target's points".into();
                return Err(Error::Degenerate { what: "registration", reason });
            }
            None => {}
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
