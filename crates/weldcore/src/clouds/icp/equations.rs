//! The normal equations of the pairs, and the motion that they ask for.

use multiversion::multiversion;
use nalgebra::{Matrix6, SymmetricEigen, Vector6};

use super::options::{Metric, RobustKernel};
use super::pairs::{Match, as_vector};
use crate::error::{Error, Result};
use crate::ground::transform::{Transform, Vec3};

/// What [`accumulate`] needs beside the pairs.
pub(super) struct Setting {
    pub(super) pose: Transform,
    pub(super) center: Vec3,
    pub(super) size: f64,
    pub(super) limit: f64,
    pub(super) metric: Metric,
    pub(super) kernel: RobustKernel,
}

/// `Σ w j jᵀ` and `Σ w j r` of the rows `j` of the Jacobian and residuals `r`.
#[derive(Clone, Copy, Default)]
pub(super) struct Equations {
    /// Six rows of: six columns of `Σ w j jᵀ`, then `Σ w j r`, then nothing, to fill a vector register.
    pub(super) sums: [[f64; 8]; 6],
    pub(super) weight: f64,
    /// `Σ w r²`
    pub(super) squares: f64,
    /// `Σ r²`
    pub(super) plain: f64,
    pub(super) count: usize,
}

impl Equations {
    pub(super) fn add(&mut self, other: &Self) {
        for (a, b) in self.sums.iter_mut().flatten().zip(other.sums.iter().flatten()) {
            *a += b;
        }
        self.weight += other.weight;
        self.squares += other.squares;
        self.plain += other.plain;
        self.count += other.count;
    }

    #[inline(always)]
    fn add_row(&mut self, weight: f64, arm: &Vec3, normal: &Vec3, residual: f64) {
        let turn = arm.cross(normal);
        let row = [turn.x, turn.y, turn.z, normal.x, normal.y, normal.z, residual, 0.0];
        for (sums, factor) in self.sums.iter_mut().zip(row) {
            for (sum, value) in sums.iter_mut().zip(row) {
                *sum += weight * factor * value;
            }
        }
    }

    /// Of the mean of `j jᵀ`: the eigenvalues are squares of (mm of residual per mm of motion).
    pub(super) fn eigen(&self) -> Result<SymmetricEigen<f64, nalgebra::U6>> {
        let mean = Matrix6::from_fn(|r, c| self.sums[r][c]) / self.weight;
        let degenerate = || Error::Degenerate { what: "registration", reason: "the sums overflow".into() };
        if !mean.iter().all(|v| v.is_finite()) {
            return Err(degenerate());
        }
        SymmetricEigen::try_new(mean, f64::EPSILON, 1000).ok_or_else(degenerate)
    }

    /// The motion about the centroid, rotation vector and translation, that minimises the linearised sum along every
    /// observed direction, and how far it moves the points at most, mm.
    pub(super) fn step(&self, weak: f64, size: f64, reach: f64) -> Result<(Vector6<f64>, f64)> {
        let gradient = Vector6::from_fn(|r, _| self.sums[r][6]) / self.weight;
        let eigen = self.eigen()?;
        let mut step = Vector6::zeros();
        for (value, vector) in eigen.eigenvalues.iter().zip(eigen.eigenvectors.column_iter()) {
            if *value > weak * weak {
                step -= vector * (vector.dot(&gradient) / value);
            }
        }
        let mut rotation = step.fixed_rows_mut::<3>(0);
        rotation /= size;
        let moved_mm = step.fixed_rows::<3>(0).norm() * reach + step.fixed_rows::<3>(3).norm();
        if !moved_mm.is_finite() {
            return Err(Error::Degenerate { what: "registration", reason: "the step overflows".into() });
        }
        Ok((step, moved_mm))
    }
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw", "x86_64+avx2"))]
pub(super) fn accumulate(setting: &Setting, source: &[[f64; 3]], matches: &[Match]) -> Equations {
    plain_accumulate(setting, source, matches)
}

/// The body of [`accumulate`], and its fallback.
#[inline(always)]
pub(super) fn plain_accumulate(setting: &Setting, source: &[[f64; 3]], matches: &[Match]) -> Equations {
    let mut all = Equations::default();
    for (p, m) in source.iter().zip(matches) {
        if m.distance > setting.limit {
            continue;
        }
        let moved = setting.pose.apply(&as_vector(p));
        let (offset, arm) = (moved - m.point, (moved - setting.center) / setting.size);
        let residual = match setting.metric {
            Metric::Point => m.distance,
            Metric::Plane => m.normal.dot(&offset),
        };
        let weight = setting.kernel.weight(residual.abs());
        if weight <= 0.0 {
            continue;
        }
        match setting.metric {
            Metric::Point => {
                all.add_row(weight, &arm, &Vec3::x(), offset.x);
                all.add_row(weight, &arm, &Vec3::y(), offset.y);
                all.add_row(weight, &arm, &Vec3::z(), offset.z);
            }
            Metric::Plane => all.add_row(weight, &arm, &m.normal, residual),
        }
        all.weight += weight;
        all.squares += weight * residual * residual;
        all.plain += residual * residual;
        all.count += 1;
    }
    all
}
