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

use multiversion::multiversion;
use nalgebra::{Matrix3, Matrix6, Rotation3, SymmetricEigen, Vector6};
use rayon::prelude::*;

use crate::Vec3;
use crate::distance::{Surface, Target};
use crate::error::{Error, Result, require_count, require_finite, require_positive};
use crate::kdtree::{Aside, KdTree, Step, order_along};
use crate::memory::require;
use crate::mesh::Mesh;
use crate::stop::polled;
use crate::threads;
use crate::transform::Transform;

/// Points handed to a thread at a time; partial sums are added in their order.
const CHUNK: usize = 2048;
/// Points of the first rounds, which only have to come near.
const COARSE: usize = 16 * 1024;
/// The fewest pairs that a round goes on with.
const FEWEST: usize = 3;
/// A weak direction is called a translation, or a rotation without pitch, where the rest of it moves the points by
/// less than this share. It names the direction; it does not change the pose.
const NAMED: f64 = 0.05;
/// How far the length of a normal may be from 1: rounding of single precision, or of four decimals.
const UNIT: f64 = 1e-3;
/// The median absolute deviation of normal noise, times this, is its standard deviation.
const MAD: f64 = 1.4826;
/// Kernel widths in standard deviations at which robust estimates keep 95 % efficiency on normal noise.
const HUBER: f64 = 1.345;
const TUKEY: f64 = 4.685;

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
pub enum Kernel {
    /// Squared.
    None,
    /// Squared up to the width, then linear.
    Huber(Option<f64>),
    /// Smoothly down to no influence beyond the width.
    Tukey(Option<f64>),
}

/// The options of [`register`].
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
    pub kernel: Kernel,
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
            kernel: Kernel::None,
            max_iterations: 100,
            tolerance_mm: 1e-7,
            // A hundredth: normals from scanned clouds are no better than half a degree.
            weak: 0.01,
            max_points: None,
        }
    }
}

/// What [`register`] found.
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
pub enum Kind {
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
    pub kind: Kind,
    /// Unit direction.
    pub axis: Vec3,
    /// A point of the line of a rotation, mm: the one nearest to the cloud's centroid.
    pub point_mm: Option<Vec3>,
    /// By how much the residuals change when the points move by 1 mm along it, mm rms.
    pub strength: f64,
    /// Rotation vector (rad), translation (mm) about the origin of the target's frame, for 1 rad or 1 mm.
    pub vector: Vector6<f64>,
}

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
    if let Kernel::Huber(Some(width)) | Kernel::Tukey(Some(width)) = options.kernel {
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

/// A moved source point's partner.
#[derive(Clone, Copy, Default)]
struct Match {
    point: Vec3,
    /// The target's normal there; zero for metric point.
    normal: Vec3,
    /// Between the two, mm.
    distance: f64,
}

/// The rounds on one choice of points.
struct Rounds<'a> {
    target: &'a Target<'a>,
    options: &'a Options,
    source: Vec<[f64; 3]>,
    /// Which of the caller's points they are.
    chosen: Vec<u32>,
    /// Their centroid, and their rms and largest distance from it.
    centroid: Vec3,
    size: f64,
    reach: f64,
    steps: Vec<Step>,
    matches: Vec<Match>,
    /// Pairs that count: up to this distance; how a residual counts then.
    limit: f64,
    kernel: Kernel,
}

impl<'a> Rounds<'a> {
    fn new(all: &[[f64; 3]], wanted: usize, target: &'a Target<'a>, options: &'a Options) -> Self {
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
            steps: vec![Step::NEW; source.len()],
            matches: vec![Match::default(); source.len()],
            source,
            chosen,
            limit: options.max_distance_mm,
            kernel: options.kernel,
        }
    }

    /// Rounds until the pose rests: the pose, how many, and whether it rests.
    fn run(&mut self, mut pose: Transform, most: usize) -> Result<(Transform, usize, bool)> {
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
            self.limit = nth(self.counting().map(|(_, m)| m.distance).collect(), keep - 1);
        }
        let got = self.counting().count();
        if got < FEWEST {
            let reason = format!("{got} source points have a partner within {} mm", self.options.max_distance_mm);
            return Err(Error::NotFound { what: "pairs", reason });
        }
        let width = |deviations: f64| {
            let residuals: Vec<f64> = self.counting().map(|(p, m)| self.residual(&pose.apply(&p), m)).collect();
            let middle = residuals.len() / 2;
            Some(nth(residuals, middle) * MAD * deviations)
        };
        self.kernel = match self.options.kernel {
            Kernel::Huber(None) => Kernel::Huber(width(HUBER)),
            Kernel::Tukey(None) => Kernel::Tukey(width(TUKEY)),
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
    fn conclude(&mut self, mut answer: Registration) -> Result<Registration> {
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

/// What [`accumulate`] needs beside the pairs.
struct Setting {
    pose: Transform,
    center: Vec3,
    size: f64,
    limit: f64,
    metric: Metric,
    kernel: Kernel,
}

/// `Σ w j jᵀ` and `Σ w j r` of the rows `j` of the Jacobian and residuals `r`.
#[derive(Clone, Copy, Default)]
struct Equations {
    /// Six rows of: six columns of `Σ w j jᵀ`, then `Σ w j r`, then nothing, to fill a vector register.
    sums: [[f64; 8]; 6],
    weight: f64,
    /// `Σ w r²`
    squares: f64,
    /// `Σ r²`
    plain: f64,
    count: usize,
}

impl Equations {
    fn add(&mut self, other: &Self) {
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
    fn eigen(&self) -> Result<SymmetricEigen<f64, nalgebra::U6>> {
        let mean = Matrix6::from_fn(|r, c| self.sums[r][c]) / self.weight;
        let degenerate = || Error::Degenerate { what: "registration", reason: "the sums overflow".into() };
        if !mean.iter().all(|v| v.is_finite()) {
            return Err(degenerate());
        }
        SymmetricEigen::try_new(mean, f64::EPSILON, 1000).ok_or_else(degenerate)
    }

    /// The motion about the centroid, rotation vector and translation, that minimises the linearised sum along every
    /// observed direction, and how far it moves the points at most, mm.
    fn step(&self, weak: f64, size: f64, reach: f64) -> Result<(Vector6<f64>, f64)> {
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

impl Kernel {
    /// The weight of a residual in the iteratively reweighted least squares.
    #[inline(always)]
    fn weight(self, residual: f64) -> f64 {
        match self {
            Self::Huber(Some(width)) if residual > width && width > 0.0 => width / residual,
            Self::Tukey(Some(width)) if width > 0.0 => {
                let share = residual / width;
                if share < 1.0 { (1.0 - share * share).powi(2) } else { 0.0 }
            }
            _ => 1.0,
        }
    }
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw", "x86_64+avx2"))]
fn to_cloud(
    tree: &KdTree,
    normals: Option<&[[f64; 3]]>,
    pose: &Transform,
    source: &[[f64; 3]],
    steps: &mut [Step],
    matches: &mut [Match],
) {
    plain_to_cloud(tree, normals, pose, source, steps, matches);
}

/// The body of [`to_cloud`], and its fallback.
#[inline(always)]
fn plain_to_cloud(
    tree: &KdTree,
    normals: Option<&[[f64; 3]]>,
    pose: &Transform,
    source: &[[f64; 3]],
    steps: &mut [Step],
    matches: &mut [Match],
) {
    let mut aside = Aside::new();
    for ((p, step), found) in source.iter().zip(steps).zip(matches) {
        let moved = pose.apply(&as_vector(p));
        found.distance = tree.follow(&[moved.x, moved.y, moved.z], step, &mut aside).sqrt();
        found.point = step.point.into();
        if let Some(normal) = normals.and_then(|n| n.get(step.index as usize)) {
            found.normal = as_vector(normal);
            if normal[0].is_nan() {
                found.distance = f64::INFINITY;
            }
        }
    }
}

fn to_mesh(mesh: &Mesh, pose: &Transform, source: &[[f64; 3]], matches: &mut [Match]) {
    let moved: Vec<[f64; 3]> = source.iter().map(|p| pose.apply(&as_vector(p)).into()).collect();
    mesh.each_near(&moved, matches, |m, foot| {
        *m = Match { point: foot.point, normal: foot.normal, distance: foot.distance };
    });
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw", "x86_64+avx2"))]
fn to_surface(surface: &Surface, pose: &Transform, source: &[[f64; 3]], matches: &mut [Match]) {
    plain_to_surface(surface, pose, source, matches);
}

/// The body of [`to_surface`], and its fallback.
#[inline(always)]
fn plain_to_surface(surface: &Surface, pose: &Transform, source: &[[f64; 3]], matches: &mut [Match]) {
    for (p, found) in source.iter().zip(matches) {
        let foot = surface.foot(&pose.apply(&as_vector(p)));
        *found = Match { point: foot.point, normal: foot.normal, distance: foot.distance.abs() };
    }
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw", "x86_64+avx2"))]
fn accumulate(setting: &Setting, source: &[[f64; 3]], matches: &[Match]) -> Equations {
    plain_accumulate(setting, source, matches)
}

/// The body of [`accumulate`], and its fallback.
#[inline(always)]
fn plain_accumulate(setting: &Setting, source: &[[f64; 3]], matches: &[Match]) -> Equations {
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

#[inline(always)]
fn as_vector(p: &[f64; 3]) -> Vec3 {
    Vec3::new(p[0], p[1], p[2])
}

/// The `n`-th smallest of some distances.
fn nth(mut values: Vec<f64>, n: usize) -> f64 {
    let n = n.min(values.len().saturating_sub(1));
    if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(n, f64::total_cmp).1 }
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

/// Takes weak directions (scaled about the centre) apart into translations, rotations and screws.
fn name(null: &[(f64, Vector6<f64>)], center: &Vec3, size: f64) -> Vec<Weak> {
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
            weak.push(Weak { kind: Kind::Translation, axis, point_mm: None, strength: value.sqrt(), vector });
            continue;
        }
        for translation in weak.iter().filter(|w| w.kind == Kind::Translation) {
            shift -= translation.axis * translation.axis.dot(&shift);
        }
        let axis = turn.normalize();
        let point = center + turn.cross(&shift) / turn.norm_squared();
        let pitch = turn.dot(&shift) / turn.norm_squared();
        let kind = if pitch.abs() < NAMED * size { Kind::Rotation } else { Kind::Screw };
        let vector = with(&axis, &(point.cross(&axis) + axis * if kind == Kind::Screw { pitch } else { 0.0 }));
        weak.push(Weak { kind, axis, point_mm: Some(point), strength: value.sqrt(), vector });
    }
    weak
}

fn with(turn: &Vec3, shift: &Vec3) -> Vector6<f64> {
    Vector6::new(turn.x, turn.y, turn.z, shift.x, shift.y, shift.z)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::distance::{Cylinder, Plane, Sphere};

    const RADIUS: f64 = 110.0;

    fn pose(turn: [f64; 3], shift: [f64; 3]) -> Transform {
        Transform { rotation: *Rotation3::new(Vec3::from(turn)).matrix(), translation: shift.into() }
    }

    fn moved(points: &[[f64; 3]], t: &Transform) -> Vec<[f64; 3]> {
        points.iter().map(|&p| t.apply(&p.into()).into()).collect()
    }

    /// A quarter of a pipe along z.
    fn pipe(n: u32) -> Vec<[f64; 3]> {
        let side = 0..n;
        side.clone()
            .flat_map(|i| {
                side.clone().map(move |j| {
                    let angle = f64::from(i) / f64::from(n) * 1.6;
                    [RADIUS * angle.cos(), RADIUS * angle.sin(), f64::from(j) / f64::from(n) * 200.0]
                })
            })
            .collect()
    }

    /// A surface without a symmetry, with its normals.
    fn relief(n: u32) -> (Vec<[f64; 3]>, Vec<[f64; 3]>) {
        let mut points = Vec::new();
        let mut normals = Vec::new();
        for i in 0..n {
            for j in 0..n {
                let (x, y) = (f64::from(i) * 60.0 / f64::from(n), f64::from(j) * 60.0 / f64::from(n));
                points.push([x, y, 6.0 * (x / 9.0).sin() + 5.0 * (y / 7.0).cos()]);
                let slope = Vec3::new(-6.0 / 9.0 * (x / 9.0).cos(), 5.0 / 7.0 * (y / 7.0).sin(), 1.0);
                normals.push(slope.normalize().into());
            }
        }
        (points, normals)
    }

    #[test]
    fn on_a_cylinder_the_two_free_directions_are_named_and_do_not_drift() {
        let surface = Target::Surface(Surface::Cylinder(Cylinder::new([0.0; 3], [0.0, 0.0, 2.0], RADIUS).unwrap()));
        let start = pose([0.05, -0.07, 0.0], [3.0, -4.0, 0.0]);
        let source = moved(&pipe(60), &start.inverse());
        let options = Options { metric: Metric::Plane, ..Options::default() };
        let found = register(&source, &surface, &options).unwrap();
        assert!(found.converged && found.iterations < 12 && found.rms_mm < 1e-9, "{found:?}");
        assert_eq!(found.inliers.len(), source.len());
        let kinds: Vec<Kind> = found.unobserved.iter().map(|w| w.kind).collect();
        assert_eq!(kinds, [Kind::Translation, Kind::Rotation]);
        assert!(found.unobserved.iter().all(|w| (w.axis.z.abs() - 1.0).abs() < 1e-9 && w.strength < 1e-9));
        assert!(found.unobserved[1].point_mm.unwrap().xy().norm() < 1e-6);
        // Along the axis nothing moves but by products of the 5 degrees and 5 mm; about it only by what goes with
        // undoing the 5 mm in the shortest way, at a distance of some 100 mm.
        let centroid = source.iter().map(|p| Vec3::from(*p)).sum::<Vec3>() / source.len() as f64;
        assert!((found.target_from_source.apply(&centroid) - centroid).z.abs() < 0.5);
        let turn = Rotation3::from_matrix_unchecked(found.target_from_source.rotation).scaled_axis();
        assert!(turn.z.abs() < 0.05 && turn.xy().norm() > 0.08, "{turn}");
        // A hundred rounds more change nothing.
        let again = Options { start: found.target_from_source, tolerance_mm: 0.0, ..options };
        let again = register(&source, &surface, &again).unwrap();
        assert!((again.target_from_source.translation - found.target_from_source.translation).amax() < 1e-9);
        assert!((again.target_from_source.rotation - found.target_from_source.rotation).amax() < 1e-11);
    }

    #[test]
    fn both_metrics_bring_a_cloud_back_onto_itself() {
        let (target, normals) = relief(120);
        let tree = KdTree::new(&target).unwrap();
        let truth = pose([0.01, -0.02, 0.015], [0.4, -0.3, 0.2]);
        let source = moved(&target, &truth.inverse());
        for metric in [Metric::Point, Metric::Plane] {
            let options = Options { metric, ..Options::default() };
            let found = register(&source, &Target::Cloud(&tree, Some(&normals)), &options).unwrap();
            assert!(found.converged, "{} rounds", found.iterations);
            assert!((found.target_from_source.rotation - truth.rotation).amax() < 1e-9);
            assert!((found.target_from_source.translation - truth.translation).amax() < 1e-7);
            assert!((found.target_from_source.rotation.determinant() - 1.0).abs() < 1e-14);
            assert!(found.unobserved.is_empty() && found.rms_mm < 1e-7);
        }
    }

    #[test]
    fn the_covariance_is_the_scatter_of_repeated_registrations() {
        let (target, normals) = relief(40);
        let tree = KdTree::new(&target).unwrap();
        let sigma = 0.001;
        let mut state = 1u64;
        let mut noise = || {
            let uniform = |s: &mut u64| {
                *s = s.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                (*s >> 11) as f64 / (1u64 << 53) as f64 - 0.5
            };
            (0..12).map(|_| uniform(&mut state)).sum::<f64>() * sigma
        };
        let options = Options { metric: Metric::Plane, ..Options::default() };
        let (mut scatter, mut stated) = (Matrix6::zeros(), Matrix6::zeros());
        let repeats = 400;
        for _ in 0..repeats {
            let source: Vec<[f64; 3]> =
                target.iter().map(|p| [p[0] + noise(), p[1] + noise(), p[2] + noise()]).collect();
            let found = register(&source, &Target::Cloud(&tree, Some(&normals)), &options).unwrap();
            let turn = Rotation3::from_matrix_unchecked(found.target_from_source.rotation).scaled_axis();
            let error = with(&turn, &found.target_from_source.translation);
            scatter += error * error.transpose() / f64::from(repeats);
            stated += found.covariance / f64::from(repeats);
        }
        for i in 0..6 {
            // 400 repeats know a variance to 7 %.
            let ratio = scatter[(i, i)] / stated[(i, i)];
            assert!((0.75..1.3).contains(&ratio), "direction {i}: {ratio}");
        }
    }

    #[test]
    fn outliers_do_not_pull_a_trimmed_or_robust_fit() {
        let (target, normals) = relief(80);
        let tree = KdTree::new(&target).unwrap();
        let truth = pose([0.004, -0.003, 0.005], [0.1, -0.2, 0.1]);
        let mut source = moved(&target, &truth.inverse());
        for p in source.iter_mut().step_by(9) {
            p[2] += 3.0;
        }
        let cloud = Target::Cloud(&tree, Some(&normals));
        let error = |options: Options| {
            let found = register(&source, &cloud, &Options { metric: Metric::Plane, ..options }).unwrap();
            (found.target_from_source.translation - truth.translation).amax()
        };
        assert!(error(Options::default()) > 0.05);
        assert!(error(Options { trim: 0.15, ..Options::default() }) < 1e-6);
        assert!(error(Options { max_distance_mm: 1.0, ..Options::default() }) < 1e-6);
        assert!(error(Options { kernel: Kernel::Tukey(None), ..Options::default() }) < 1e-6);
        assert!(error(Options { kernel: Kernel::Tukey(Some(0.5)), ..Options::default() }) < 1e-6);
        assert!(error(Options { kernel: Kernel::Huber(Some(0.01)), ..Options::default() }) < 0.01);
    }

    #[test]
    fn vectors_and_the_plain_fallback_give_the_same_bits() {
        let (target, normals) = relief(60);
        let tree = KdTree::new(&target).unwrap();
        let (pose, n) = (pose([0.002, 0.001, -0.001], [0.3, 0.2, -0.1]), target.len());
        let (mut fast, mut plain) = (vec![Match::default(); n], vec![Match::default(); n]);
        let (mut fast_steps, mut plain_steps) = (vec![Step::NEW; n], vec![Step::NEW; n]);
        to_cloud(&tree, Some(&normals), &pose, &target, &mut fast_steps, &mut fast);
        plain_to_cloud(&tree, Some(&normals), &pose, &target, &mut plain_steps, &mut plain);
        let numbers = |m: &[Match]| m.iter().map(|m| (m.point, m.normal, m.distance.to_bits())).collect::<Vec<_>>();
        assert_eq!(numbers(&fast), numbers(&plain));
        for metric in [Metric::Point, Metric::Plane] {
            for kernel in [Kernel::None, Kernel::Huber(Some(0.1)), Kernel::Tukey(Some(0.3))] {
                let center = Vec3::new(30.0, 30.0, 0.0);
                let setting = Setting { pose, center, size: 25.0, limit: 0.5, metric, kernel };
                let (a, b) = (accumulate(&setting, &target, &fast), plain_accumulate(&setting, &target, &fast));
                assert!(a.sums == b.sums && a.squares == b.squares && a.plain == b.plain && a.count == b.count);
                assert!(a.count > 0 || matches!(kernel, Kernel::Tukey(_)));
            }
        }
        let surface = Surface::Cylinder(Cylinder::new([0.0; 3], [0.0, 1.0, 2.0], 20.0).unwrap());
        to_surface(&surface, &pose, &target, &mut fast);
        plain_to_surface(&surface, &pose, &target, &mut plain);
        assert_eq!(numbers(&fast), numbers(&plain));
    }

    #[test]
    fn symmetric_targets_leave_their_own_motions_free() {
        let (points, _) = relief(30);
        for (surface, kinds) in [
            (
                Surface::Plane(Plane::new([0.0; 3], [0.0, 0.0, 1.0]).unwrap()),
                vec![Kind::Translation, Kind::Translation, Kind::Rotation],
            ),
            (Surface::Sphere(Sphere::new([30.0, 30.0, -90.0], 95.0).unwrap()), vec![Kind::Rotation; 3]),
        ] {
            let options = Options { metric: Metric::Plane, ..Options::default() };
            let found = register(&points, &Target::Surface(surface), &options).unwrap();
            assert_eq!(found.unobserved.iter().map(|w| w.kind).collect::<Vec<_>>(), kinds);
            if let Surface::Sphere(sphere) = surface {
                for w in &found.unobserved {
                    let offset = sphere.center() - w.point_mm.unwrap();
                    assert!((offset - w.axis * w.axis.dot(&offset)).norm() < 1e-6);
                }
            }
        }
    }

    #[test]
    fn any_number_of_threads_gives_the_same_bits() {
        let (target, normals) = relief(220);
        let tree = KdTree::new(&target).unwrap();
        let source = moved(&target, &pose([0.01, 0.0, 0.0], [0.1, 0.1, 0.1]));
        let options = Options { metric: Metric::Plane, trim: 0.1, ..Options::default() };
        let answers: Vec<_> = [1, 2, 8]
            .iter()
            .map(|&n| {
                threads::set_threads(Some(n)).unwrap();
                register(&source, &Target::Cloud(&tree, Some(&normals)), &options).unwrap()
            })
            .collect();
        threads::set_threads(None).unwrap();
        assert!(answers.windows(2).all(|w| w[0] == w[1]));
    }

    #[test]
    fn what_has_no_answer_is_refused() {
        let (target, normals) = relief(10);
        let tree = KdTree::new(&target).unwrap();
        let cloud = Target::Cloud(&tree, None);
        let with = |options: Options| register(&target, &cloud, &options);
        let base = Options::default();
        assert!(matches!(with(Options { metric: Metric::Plane, ..base }), Err(Error::Degenerate { .. })));
        for bad in [
            Options { trim: 1.0, ..base },
            Options { trim: f64::NAN, ..base },
            Options { max_distance_mm: 0.0, ..base },
            Options { max_iterations: 0, ..base },
            Options { tolerance_mm: -1.0, ..base },
            Options { kernel: Kernel::Tukey(Some(0.0)), ..base },
            Options { max_points: Some(2), ..base },
            Options { weak: f64::NAN, ..base },
        ] {
            assert!(matches!(with(bad), Err(Error::OutOfRange { .. })), "{bad:?}");
        }
        assert!(matches!(register(&target[..2], &cloud, &base), Err(Error::TooFew { .. })));
        assert!(matches!(register(&[[f64::NAN; 3]; 9], &cloud, &base), Err(Error::NonFinite { .. })));
        let far = vec![[1e6; 3]; 9];
        assert!(matches!(
            register(&far, &cloud, &Options { max_distance_mm: 1.0, ..base }),
            Err(Error::NotFound { .. })
        ));
        let short = Target::Cloud(&tree, Some(&normals[1..]));
        assert!(matches!(register(&target, &short, &base), Err(Error::Shape { .. })));
        // All points in one place, and points beyond what can be squared: an answer or an error.
        let _ = register(&[[1.0; 3]; 5], &cloud, &base).unwrap();
        let _ = register(&[[1e300; 3], [-1e300; 3], [0.0; 3]], &cloud, &base);
    }
}
