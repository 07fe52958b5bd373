//! What a registration found, and the names of the directions that it did not see.

use nalgebra::{Matrix6, SymmetricEigen, Vector6};

use crate::ground::transform::{Transform, Vec3};

/// A weak direction is called a translation, or a rotation without pitch, where the rest of it moves the points by
/// less than this share. It names the direction; it does not change the pose.
const NAMED: f64 = 0.05;

/// What [`register`](super::register) found.
#[derive(Debug, Clone, PartialEq)]
pub struct Registration {
    /// The pose.
    pub target_from_source: Transform,
    /// Whether the last round moved no point further than the tolerance.
    pub converged: bool,
    /// Rounds in all.
    pub iterations: usize,
    /// Root mean square of the inliers' residuals of the metric, mm.
    pub rms_mm: f64,
    /// The source points that counted, ascending.
    pub inliers: Vec<u32>,
    /// Of a small motion after `target_from_source`: rotation vector (rad), translation (mm), about the origin of the
    /// target's frame, from the scatter of the residuals, taken as independent. Nothing for unobserved directions.
    pub covariance: Matrix6<f64>,
    /// The directions along which the pose was not moved, because the pairs do not show them.
    pub unobserved: Vec<Weak>,
}

/// What kind of motion a weak direction is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WeakKind {
    /// Along `axis`.
    Translation,
    /// About the line through `point` along `axis`.
    Rotation,
    /// About and along that line.
    Screw,
}

/// A direction in which the pose is not determined, in the target's frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Weak {
    /// What it is.
    pub kind: WeakKind,
    /// Unit direction.
    pub axis: Vec3,
    /// A point of the line of a rotation, mm: the one nearest to the cloud's centroid.
    pub point_mm: Option<Vec3>,
    /// By how much the residuals change when the points move by 1 mm along it, mm rms.
    pub strength: f64,
    /// Rotation vector (rad), translation (mm) about the origin of the target's frame, for 1 rad or 1 mm.
    pub vector: Vector6<f64>,
}

/// Takes weak directions (scaled about the centre) apart into translations, rotations and screws.
pub(super) fn name(null: &[(f64, Vector6<f64>)], center: &Vec3, size: f64) -> Vec<Weak> {
    if null.is_empty() {
        return Vec::new();
    }
    // Combinations of them ordered by how much they turn.
    let turning = Matrix6::from_fn(|a, b| match (null.get(a), null.get(b)) {
        (Some(a), Some(b)) => a.1.fixed_rows::<3>(0).dot(&b.1.fixed_rows::<3>(0)),
        // More than any real one, to come last.
        _ => f64::from(u8::from(a == b)) * 2.0,
    });
    let eigen = SymmetricEigen::new(turning);
    let mut order: Vec<usize> = (0..6).collect();
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    let mut weak: Vec<Weak> = Vec::new();
    for &i in order.iter().take(null.len()) {
        let (mut direction, mut value) = (Vector6::zeros(), 0.0);
        for (factor, (lambda, vector)) in eigen.eigenvectors.column(i).iter().zip(null) {
            direction += vector * *factor;
            value += lambda * factor * factor;
        }
        let turn: Vec3 = direction.fixed_rows::<3>(0) / size;
        let mut shift: Vec3 = direction.fixed_rows::<3>(3).into();
        if turn.norm() * size < NAMED {
            let axis = shift.normalize();
            let vector = with(&Vec3::zeros(), &axis);
            weak.push(Weak { kind: WeakKind::Translation, axis, point_mm: None, strength: value.sqrt(), vector });
            continue;
        }
        for translation in weak.iter().filter(|w| w.kind == WeakKind::Translation) {
            shift -= translation.axis * translation.axis.dot(&shift);
        }
        let axis = turn.normalize();
        let point = center + turn.cross(&shift) / turn.norm_squared();
        let pitch = turn.dot(&shift) / turn.norm_squared();
        let kind = if pitch.abs() < NAMED * size { WeakKind::Rotation } else { WeakKind::Screw };
        let vector = with(&axis, &(point.cross(&axis) + axis * if kind == WeakKind::Screw { pitch } else { 0.0 }));
        weak.push(Weak { kind, axis, point_mm: Some(point), strength: value.sqrt(), vector });
    }
    weak
}

pub(super) fn with(turn: &Vec3, shift: &Vec3) -> Vector6<f64> {
    Vector6::new(turn.x, turn.y, turn.z, shift.x, shift.y, shift.z)
}
