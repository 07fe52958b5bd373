//! Rigid transforms `a_from_b`.

use nalgebra::{Matrix3, Matrix4};

use crate::Vec3;
use crate::error::{Error, Result};

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
}
