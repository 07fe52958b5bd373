//! The rounds of a registration: pair, weigh, move.

use nalgebra::{Matrix3, Matrix6, Rotation3, Vector6};
use rayon::prelude::*;

use super::equations::{Equations, Setting, accumulate};
use super::options::{Metric, Options, RobustKernel};
use super::pairs::{Match, as_vector, to_cloud, to_mesh, to_surface};
use super::registration::{Registration, name};
use crate::clouds::distance::Target;
use crate::clouds::kdtree::{Followed, order_along};
use crate::error::{Error, Result};
use crate::ground::memory::require;
use crate::ground::robust::{HUBER_SIGMAS, MEDIAN_TO_SIGMA, TUKEY_SIGMAS, median, nth};
use crate::ground::stop::polled;
use crate::ground::threads;
use crate::ground::transform::{Transform, Vec3};

/// Points handed to a thread at a time; partial sums are added in their order.
const CHUNK: usize = 2048;
/// The fewest pairs that a round goes on with.
pub(super) const FEWEST: usize = 3;

/// The rounds on one choice of points.
pub(super) struct Rounds<'a> {
    target: &'a Target<'a>,
    options: &'a Options,
    source: Vec<[f64; 3]>,
    /// Which of the caller's points they are.
    chosen: Vec<u32>,
    /// Their centroid, and their rms and largest distance from it.
    centroid: Vec3,
    size: f64,
    reach: f64,
    steps: Vec<Followed>,
    matches: Vec<Match>,
    /// Pairs that count: up to this distance; how a residual counts then.
    limit: f64,
    kernel: RobustKernel,
}

impl<'a> Rounds<'a> {
    pub(super) fn new(all: &[[f64; 3]], wanted: usize, target: &'a Target<'a>, options: &'a Options) -> Self {
        require(wanted.min(all.len()), 280);
        let mut chosen = spread(all.len(), wanted);
        let mut source: Vec<[f64; 3]> = chosen.iter().filter_map(|&i| all.get(i as usize).copied()).collect();
        if let Some(order) = threads::install(|| order_along(&source)) {
            source = order.iter().filter_map(|&i| source.get(i as usize).copied()).collect();
            chosen = order.iter().filter_map(|&i| chosen.get(i as usize).copied()).collect();
        }
        let n = source.len() as f64;
        let start = source.first().map_or(Vec3::zeros(), |p| Vec3::from(*p));
        let offsets = |from: Vec3| source.iter().map(move |p| Vec3::from(*p) - from);
        let centroid = start + offsets(start).sum::<Vec3>() / n;
        let (squares, reach) = offsets(centroid)
            .map(|v| v.norm_squared())
            .fold((0.0, 0.0), |(sum, most), square| (sum + square, f64::max(most, square)));
        // All points equal: no rotation is seen, whatever the scale.
        let size = if squares > 0.0 { (squares / n).sqrt() } else { 1.0 };
        Self {
            target,
            options,
            centroid,
            size,
            reach: reach.sqrt(),
            steps: vec![Followed::NEW; source.len()],
            matches: vec![Match::default(); source.len()],
            source,
            chosen,
            limit: options.max_distance_mm,
            kernel: options.kernel,
        }
    }

    /// Rounds until the pose rests: the pose, how many, and whether it rests.
    pub(super) fn run(&mut self, mut pose: Transform, most: usize) -> Result<(Transform, usize, bool)> {
        for round in 1..=most {
            self.pair(&pose)?;
            let (step, moved_mm) = self.equations(&pose)?.step(self.options.weak, self.size, self.reach)?;
            let center = pose.apply(&self.centroid);
            pose = about(&step, &center) * pose;
            pose.rotation = nearest_rotation(&pose.rotation);
            if moved_mm <= self.options.tolerance_mm {
                return Ok((pose, round, true));
            }
        }
        Ok((pose, most, false))
    }

    /// Finds every point's partner, and which pairs count.
    fn pair(&mut self, pose: &Transform) -> Result<()> {
        let (target, metric) = (self.target, self.options.metric);
        threads::install(|| {
            (self.source.par_chunks(CHUNK), self.steps.par_chunks_mut(CHUNK), self.matches.par_chunks_mut(CHUNK))
                .into_par_iter()
                .inspect(polled)
                .for_each(|(source, steps, matches)| match target {
                    Target::Cloud(tree, normals) => {
                        let normals = normals.filter(|_| metric == Metric::Plane);
                        to_cloud(tree, normals, pose, source, steps, matches);
                    }
                    Target::Mesh(mesh) => to_mesh(mesh, pose, source, matches),
                    Target::Surface(surface) => to_surface(surface, pose, source, matches),
                });
        });
        // A partner without a normal is infinitely far.
        self.limit = self.options.max_distance_mm.min(f64::MAX);
        let near = self.matches.iter().filter(|m| m.distance <= self.limit).count();
        if self.options.trim > 0.0 && near >= FEWEST {
            let keep = ((near as f64 * (1.0 - self.options.trim)).ceil() as usize).max(FEWEST);
            let mut distances: Vec<f64> = self.counting().map(|(_, m)| m.distance).collect();
            self.limit = nth(&mut distances, keep - 1).unwrap_or(0.0);
        }
        let got = self.counting().count();
        if got < FEWEST {
            let reason = format!("{got} source points have a partner within {} mm", self.options.max_distance_mm);
            return Err(Error::NotFound { what: "pairs", reason });
        }
        let width = |deviations: f64| {
            let mut residuals: Vec<f64> = self.counting().map(|(p, m)| self.residual(&pose.apply(&p), m)).collect();
            Some(median(&mut residuals) * MEDIAN_TO_SIGMA * deviations)
        };
        self.kernel = match self.options.kernel {
            RobustKernel::Huber(None) => RobustKernel::Huber(width(HUBER_SIGMAS)),
            RobustKernel::Tukey(None) => RobustKernel::Tukey(width(TUKEY_SIGMAS)),
            given => given,
        };
        Ok(())
    }

    fn counting(&self) -> impl Iterator<Item = (Vec3, &Match)> {
        let points = self.source.iter().map(as_vector);
        points.zip(&self.matches).filter(|(_, m)| m.distance <= self.limit)
    }

    /// What the metric makes of a pair, mm, unsigned.
    fn residual(&self, moved: &Vec3, m: &Match) -> f64 {
        match self.options.metric {
            Metric::Point => m.distance,
            Metric::Plane => m.normal.dot(&(moved - m.point)).abs(),
        }
    }

    /// The normal equations of the pairs that count, about the moved centroid, rotations scaled by the size.
    fn equations(&self, pose: &Transform) -> Result<Equations> {
        let setting = Setting {
            pose: *pose,
            center: pose.apply(&self.centroid),
            size: self.size,
            limit: self.limit,
            metric: self.options.metric,
            kernel: self.kernel,
        };
        let parts: Vec<Equations> = threads::install(|| {
            (self.source.par_chunks(CHUNK), self.matches.par_chunks(CHUNK))
                .into_par_iter()
                .inspect(polled)
                .map(|(source, matches)| accumulate(&setting, source, matches))
                .collect()
        });
        let mut all = Equations::default();
        parts.iter().for_each(|part| all.add(part));
        if all.count < FEWEST {
            let reason = "the kernel leaves fewer than three pairs".into();
            return Err(Error::NotFound { what: "pairs", reason });
        }
        Ok(all)
    }

    /// Adds to the answer what the pairs at the final pose say of it.
    pub(super) fn conclude(&mut self, mut answer: Registration) -> Result<Registration> {
        let pose = answer.target_from_source;
        self.pair(&pose)?;
        let equations = self.equations(&pose)?;
        answer.rms_mm = (equations.plain / equations.count as f64).sqrt();
        answer.inliers = (self.source.iter().map(as_vector).zip(&self.matches).zip(&self.chosen))
            .filter(|((_, m), _)| m.distance <= self.limit)
            .filter(|((p, m), _)| self.kernel.weight(self.residual(&pose.apply(p), m)) > 0.0)
            .map(|(_, &index)| index)
            .collect();
        answer.inliers.sort_unstable();
        let center = pose.apply(&self.centroid);
        let eigen = equations.eigen()?;
        // From scaled rotation and translation about the centroid to radians and millimetres about the origin.
        let mut plain = Matrix6::identity();
        plain.fixed_view_mut::<3, 3>(0, 0).fill_diagonal(1.0 / self.size);
        plain.fixed_view_mut::<3, 3>(3, 0).copy_from(&(center.cross_matrix() / self.size));
        let mut null = Vec::new();
        let mut covariance = Matrix6::zeros();
        for (value, vector) in eigen.eigenvalues.iter().zip(eigen.eigenvectors.column_iter()) {
            if *value > self.options.weak.powi(2) {
                covariance += vector * vector.transpose() / (value * equations.weight);
            } else {
                null.push((value.max(0.0), vector.into_owned()));
            }
        }
        let per_pair = if self.options.metric == Metric::Point { 3.0 } else { 1.0 };
        let freedom = per_pair * equations.weight - (6 - null.len()) as f64;
        let variance = if freedom > 0.0 { equations.squares / freedom } else { f64::INFINITY };
        let covariance = plain * covariance * plain.transpose();
        answer.covariance = covariance.map(|c| if c == 0.0 { 0.0 } else { c * variance });
        answer.unobserved = name(&null, &center, self.size);
        Ok(answer)
    }
}

/// `wanted` of `0..n`, one from each of as many equal runs, at places in them that follow no period of an image's rows.
fn spread(n: usize, wanted: usize) -> Vec<u32> {
    if wanted >= n {
        return (0..n as u32).collect();
    }
    let run = n as f64 / wanted as f64;
    let golden = (5f64.sqrt() - 1.0) / 2.0;
    (0..wanted).map(|i| ((i as f64 + (i as f64 * golden).fract()) * run) as u32).collect()
}

/// The motion of a rotation vector and a translation about a centre.
fn about(step: &Vector6<f64>, center: &Vec3) -> Transform {
    let turn: Vec3 = step.fixed_rows::<3>(0).into();
    let shift: Vec3 = step.fixed_rows::<3>(3).into();
    let rotation = *Rotation3::new(turn).matrix();
    Transform { rotation, translation: center + shift - rotation * center }
}

/// Undoes the rounding that products of rotations collect: one Newton step towards the orthonormal matrix.
fn nearest_rotation(r: &Matrix3<f64>) -> Matrix3<f64> {
    r * (Matrix3::identity() * 1.5 - r.transpose() * r * 0.5)
}
