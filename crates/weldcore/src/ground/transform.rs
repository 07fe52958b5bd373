//! Rigid transforms `a_from_b`.

use nalgebra::{Matrix3, Matrix4, Quaternion, SymmetricEigen, UnitQuaternion};

use crate::error::{Error, Result, require_count, require_finite};

/// A point or a direction, in the frame that the context names.
pub type Vec3 = nalgebra::Vector3<f64>;

/// How far a given rotation may be from orthonormal (largest element of `RᵀR - I`): rounding of a matrix that
/// was written with six decimals.
pub const ROTATION_TOLERANCE: f64 = 1e-5;

/// A rotation and a translation: `p_a = rotation * p_b + translation`. The rotation is proper (det = +1).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Transform {
    /// Rotation matrix.
    pub rotation: Matrix3<f64>,
    /// Translation, mm.
    pub translation: Vec3,
}

impl Transform {
    /// The identity.
    pub fn identity() -> Self {
        Self { rotation: Matrix3::identity(), translation: Vec3::zeros() }
    }

    /// Reads a homogeneous 4x4 matrix, row by row.
    ///
    /// # Errors
    /// [`Error::NonFinite`], or [`Error::OutOfRange`] where the last row is not `0 0 0 1` or the rotation is not
    /// orthonormal within [`ROTATION_TOLERANCE`] or mirrors.
    pub fn from_rows(rows: &[[f64; 4]; 4]) -> Result<Self> {
        let what = "rigid transform";
        if let Some(index) = rows.iter().flatten().position(|v| !v.is_finite()) {
            return Err(Error::NonFinite { what, index });
        }
        let refuse = |expected: &str, value: String| Err(Error::OutOfRange { what, expected: expected.into(), value });
        if rows[3] != [0.0, 0.0, 0.0, 1.0] {
            return refuse("a matrix whose last row is 0 0 0 1", format!("{:?}", rows[3]));
        }
        let m = Matrix4::from_fn(|r, c| rows[r][c]);
        let rotation: Matrix3<f64> = m.fixed_view::<3, 3>(0, 0).into();
        let miss = (rotation.transpose() * rotation - Matrix3::identity()).amax();
        if miss > ROTATION_TOLERANCE {
            return refuse("orthonormal in its 3x3 part", format!("an error of {miss:.1e}"));
        }
        if rotation.determinant() < 0.0 {
            return refuse("a rotation", "a reflection (det = -1)".into());
        }
        Ok(Self { rotation, translation: Vec3::new(m[(0, 3)], m[(1, 3)], m[(2, 3)]) })
    }

    /// The homogeneous 4x4 matrix, row by row.
    pub fn to_rows(&self) -> [[f64; 4]; 4] {
        let (r, t) = (&self.rotation, &self.translation);
        let mut rows = [[0.0; 4]; 4];
        for i in 0..3 {
            rows[i] = [r[(i, 0)], r[(i, 1)], r[(i, 2)], t[i]];
        }
        rows[3][3] = 1.0;
        rows
    }

    /// `b_from_a`.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.transpose();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// Maps a point.
    #[inline]
    pub fn apply(&self, p: &Vec3) -> Vec3 {
        self.rotation * p + self.translation
    }
}

impl std::ops::Mul for Transform {
    type Output = Self;

    /// `a_from_b * b_from_c = a_from_c`.
    fn mul(self, other: Self) -> Self {
        Self { rotation: self.rotation * other.rotation, translation: self.apply(&other.translation) }
    }
}

/// Below this share of the spread, the moments that fix the rotation are rounding.
const ROUNDING: f64 = 1e-12;

/// The rigid motion with the least weighted sum of squared distances between paired points:
/// `target_from_source` and the weighted rms of what remains, mm. Without weights all count the same.
///
/// Closed form; the rotation is the best proper one (det = +1) even where a reflection would fit better.
/// Source: Horn, Closed-form solution of absolute orientation using unit quaternions, JOSA A 4 (1987) 629.
///
/// # Errors
/// [`Error::Shape`] where the lengths differ, [`Error::NonFinite`], [`Error::OutOfRange`] for a negative weight,
/// [`Error::TooFew`] below three points of a weight above zero, [`Error::Degenerate`] where they are collinear.
pub fn register_rigid(source: &[[f64; 3]], target: &[[f64; 3]], weights: Option<&[f64]>) -> Result<(Transform, f64)> {
    let same_length = |what, got: usize| match got == source.len() {
        true => Ok(()),
        false => Err(Error::Shape { what, expected: format!("{} as in source", source.len()), got: got.to_string() }),
    };
    same_length("target", target.len())?;
    require_finite("source", source)?;
    require_finite("target", target)?;
    if let Some(w) = weights {
        same_length("weights", w.len())?;
        if let Some(index) = w.iter().position(|w| !w.is_finite()) {
            return Err(Error::NonFinite { what: "weights", index });
        }
        if let Some(w) = w.iter().find(|&&w| w < 0.0) {
            return Err(Error::OutOfRange { what: "weights", expected: "at least 0".into(), value: w.to_string() });
        }
    }
    // Only the ratio of weights matters: the largest becomes 1, so that no sum over- or underflows.
    let heaviest = weights.map_or(1.0, |w| w.iter().copied().fold(0.0, f64::max));
    let pairs = || {
        (source.iter().zip(target).enumerate())
            .map(|(i, (s, t))| (weights.map_or(1.0, |w| w[i] / heaviest), Vec3::from(*s), Vec3::from(*t)))
            .filter(|&(w, _, _)| w > 0.0)
    };
    require_count("paired points", 3, pairs().count())?;
    let mut moments = PairMoments::default();
    let first = pairs().next().map_or((Vec3::zeros(), Vec3::zeros()), |(_, s, t)| (s, t));
    pairs().for_each(|(w, s, t)| moments.add(w, &(s - first.0), &(t - first.1)));
    let (near_source, near_target) = (moments.source / moments.weight, moments.target / moments.weight);
    let mut centred = PairMoments::default();
    pairs().for_each(|(w, s, t)| centred.add(w, &(s - first.0 - near_source), &(t - first.1 - near_target)));
    let rotation = centred.rotation().ok_or_else(|| Error::Degenerate {
        what: "rigid registration",
        reason: "the points are collinear, all equal, or symmetric beyond a unique rotation".into(),
    })?;
    let translation = (first.1 + near_target) - rotation * (first.0 + near_source);
    let fit = Transform { rotation, translation };
    let offset = |s: Vec3, t: Vec3| rotation * (s - first.0 - near_source) - (t - first.1 - near_target);
    let squares: f64 = pairs().map(|(w, s, t)| w * offset(s, t).norm_squared()).sum();
    if !fit.to_rows().iter().flatten().all(|v| v.is_finite()) || !squares.is_finite() {
        let value = "larger ones".into();
        return Err(Error::OutOfRange { what: "points", expected: "coordinates below 1e150".into(), value });
    }
    Ok((fit, (squares / centred.weight).sqrt()))
}

/// Sums over weighted pairs of points: what the closed form needs to know of them.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct PairMoments {
    pub(crate) weight: f64,
    pub(crate) source: Vec3,
    pub(crate) target: Vec3,
    /// `Σ w source targetᵀ`
    cross: Matrix3<f64>,
    /// `Σ w |source| |target|`: what the entries of `cross` are compared with.
    spread: f64,
}

impl PairMoments {
    pub(crate) fn add(&mut self, w: f64, source: &Vec3, target: &Vec3) {
        self.weight += w;
        self.source += w * source;
        self.target += w * target;
        self.cross += w * source * target.transpose();
        self.spread += w * source.norm() * target.norm();
    }

    /// The rotation about the origin of both that turns source closest to target; None where several do.
    pub(crate) fn rotation(&self) -> Option<Matrix3<f64>> {
        let s = self.cross / self.spread;
        let (a, b, c) = (s[(1, 2)] - s[(2, 1)], s[(2, 0)] - s[(0, 2)], s[(0, 1)] - s[(1, 0)]);
        let (xy, xz, yz) = (s[(0, 1)] + s[(1, 0)], s[(0, 2)] + s[(2, 0)], s[(1, 2)] + s[(2, 1)]);
        let (x, y, z) = (s[(0, 0)], s[(1, 1)], s[(2, 2)]);
        #[rustfmt::skip]
        let n = Matrix4::new(
            x + y + z, a,         b,          c,
            a,         x - y - z, xy,         xz,
            b,         xy,        -x + y - z, yz,
            c,         xz,        yz,         -x - y + z,
        );
        if !n.iter().all(|v| v.is_finite()) {
            return None;
        }
        let eigen = SymmetricEigen::try_new(n, f64::EPSILON, 1000)?;
        let best = eigen.eigenvalues.imax();
        let second = (0..4).filter(|&i| i != best).map(|i| eigen.eigenvalues[i]).fold(f64::NEG_INFINITY, f64::max);
        if eigen.eigenvalues[best] - second <= ROUNDING {
            return None;
        }
        let q = eigen.eigenvectors.column(best);
        let turn = UnitQuaternion::from_quaternion(Quaternion::new(q[0], q[1], q[2], q[3]));
        Some(*turn.to_rotation_matrix().matrix())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Rotation3;

    fn example() -> Transform {
        Transform {
            rotation: *Rotation3::from_euler_angles(0.3, -0.7, 1.9).matrix(),
            translation: Vec3::new(10.0, -20.0, 30.0),
        }
    }

    #[test]
    fn the_inverse_undoes_the_transform() {
        let t = example();
        let p = Vec3::new(1.0, 2.0, 3.0);
        assert!((t.inverse().apply(&t.apply(&p)) - p).norm() < 1e-13);
        assert!(((t * t.inverse()).apply(&p) - p).norm() < 1e-13);
    }

    #[test]
    fn rows_survive_a_round_trip_and_a_mirror_is_refused() {
        let mut rows = example().to_rows();
        assert_eq!(Transform::from_rows(&rows).unwrap().to_rows(), rows);
        for r in rows.iter_mut().take(3) {
            r[0] = -r[0];
        }
        assert!(matches!(Transform::from_rows(&rows), Err(Error::OutOfRange { .. })));
    }

    fn corners() -> Vec<[f64; 3]> {
        vec![[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [0.0, 50.0, 0.0], [0.0, 0.0, 20.0], [30.0, -7.0, 3.0]]
    }

    fn moved(points: &[[f64; 3]], t: &Transform) -> Vec<[f64; 3]> {
        points.iter().map(|&p| t.apply(&p.into()).into()).collect()
    }

    /// Rounding of coordinates of some 100 mm.
    const ROUNDED: f64 = 1e-12;

    #[test]
    fn a_known_motion_is_found_to_rounding_also_from_three_points() {
        for n in [3, 5] {
            let source = &corners()[..n];
            let (found, rms) = register_rigid(source, &moved(source, &example()), None).unwrap();
            assert!((found.rotation - example().rotation).amax() < 1e-14);
            assert!((found.translation - example().translation).amax() < ROUNDED);
            assert!(rms < ROUNDED && (found.rotation.determinant() - 1.0).abs() < 1e-14);
        }
    }

    #[test]
    fn no_small_motion_fits_noisy_pairs_better() {
        let source = corners();
        let mut target = moved(&source, &example());
        for (i, p) in target.iter_mut().enumerate() {
            p[i % 3] += 0.1 * (i as f64 - 2.0);
        }
        let weights = [1.0, 2.0, 0.5, 0.0, 3.0];
        let cost = |t: &Transform| -> f64 {
            let pairs = source.iter().zip(&target).zip(weights);
            pairs.map(|((s, q), w)| w * (t.apply(&(*s).into()) - Vec3::from(*q)).norm_squared()).sum()
        };
        let (found, rms) = register_rigid(&source, &target, Some(&weights)).unwrap();
        assert!((rms - (cost(&found) / 6.5).sqrt()).abs() < ROUNDED && rms > 0.01);
        for axis in 0..6 {
            for step in [-1e-4, 1e-4] {
                let mut w = [0.0; 6];
                w[axis] = step;
                let nudge = Transform {
                    rotation: *Rotation3::from_scaled_axis(Vec3::new(w[0], w[1], w[2])).matrix(),
                    translation: Vec3::new(w[3], w[4], w[5]),
                };
                assert!(cost(&(nudge * found)) > cost(&found));
            }
        }
    }

    #[test]
    fn a_mirror_image_gets_the_best_rotation_all_the_same() {
        let source = corners();
        let mirrored: Vec<[f64; 3]> = source.iter().map(|p| [-p[0], p[1], p[2]]).collect();
        let (found, rms) = register_rigid(&source, &mirrored, None).unwrap();
        assert!((found.rotation.determinant() - 1.0).abs() < 1e-14 && rms > 1.0);
    }

    #[test]
    fn far_from_the_origin_the_answer_is_as_good_as_the_coordinates() {
        let far: Vec<[f64; 3]> = corners().iter().map(|p| p.map(|c| c + 1e6)).collect();
        let (found, rms) = register_rigid(&far, &moved(&far, &example()), None).unwrap();
        // Coordinates of 1e6 mm are rounded to 1e-10 mm.
        assert!((found.rotation - example().rotation).amax() < 1e-11 && rms < 1e-9);
    }

    #[test]
    fn what_does_not_fix_the_motion_is_refused() {
        let line: Vec<[f64; 3]> = (0..9).map(|i| [f64::from(i), 2.0 * f64::from(i), 1.0]).collect();
        assert!(matches!(register_rigid(&line, &line, None), Err(Error::Degenerate { .. })));
        assert!(matches!(register_rigid(&[[1.0; 3]; 4], &[[2.0; 3]; 4], None), Err(Error::Degenerate { .. })));
        let c = corners();
        assert!(matches!(register_rigid(&c, &c[1..], None), Err(Error::Shape { .. })));
        assert!(matches!(register_rigid(&c[..2], &c[..2], None), Err(Error::TooFew { .. })));
        assert!(matches!(register_rigid(&c, &c, Some(&[0.0; 5])), Err(Error::TooFew { .. })));
        assert!(matches!(register_rigid(&c, &c, Some(&[-1.0; 5])), Err(Error::OutOfRange { .. })));
        assert!(matches!(register_rigid(&[[f64::NAN; 3]; 3], &[[0.0; 3]; 3], None), Err(Error::NonFinite { .. })));
        assert!(register_rigid(&[[1e200, 0.0, 0.0], [0.0, 1e200, 0.0], [0.0; 3]], &c[..3], None).is_err());
    }
}
