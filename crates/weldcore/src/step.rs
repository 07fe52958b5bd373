//! The step around the seam: how far the other wall stands out from the reference wall, with its uncertainty.
//!
//! # Model
//! The walls of every shot are averaged into cells. In cylinder coordinates about the reference wall's fitted axis the
//! radial deviation of a cell in shot k at angle θ and axial coordinate s (from the seam's centreline) is
//!
//! - on the reference wall: `ref_k(θ, s)`, a small correction of that shot's own cylinder (radius, place, direction);
//! - on the other wall: `ref_k(θ, s) + h(θ, s)`, with `h = ΔR + e(s)·n(θ) - (e(s)×n(θ))² / 2R` and `e(s) = e0 + e1 s`:
//!   the radial distance, to second order, of a cylinder whose radius differs by ΔR and whose axis is off by e(s).
//!
//! Each shot has a reference of its own, so a robot's pose error moves both walls of a shot alike and leaves h; the
//! parameters of h belong to the pipe and are common to all shots. What pipes have beyond that (ovality, dents) enters as
//! Legendre polynomials over each shot's arc; what the weld drew each wall in enters as the bending of a thin shell
//! ([`crate::sections`]), which belongs to no step. A group of terms is admitted only where the data ask for it (Schwarz's
//! criterion). The step at the seam is `h(θ, 0)`: both walls extrapolated to the seam.
//! Where a bin of the profile departs from the model significantly, the departure is added: a local step is not
//! smoothed away.
//!
//! # Weights and uncertainty
//! What is left after a fit is mostly the walls' own unevenness: 0.01 mm, correlated over centimetres, along the axis
//! further than around it (pipes are drawn and ground that way). Its covariance
//! `v(Δ) = nugget·[Δ = 0] + sill·φ(|Δ|)` is estimated from the residuals, with Wendland's φ on a support of its own in either
//! direction, and the walls are fitted by generalised least squares with it: no number of points makes two places that
//! belong to one wave count twice. The covariance of the parameters is that of the model that includes ΔR and tilt, whether
//! or not these were admitted. Added in quadrature: the change of the answer when the walls' strips beside the bead are left
//! out, the correlated unevenness itself (at the seam each wall may stand off its smooth run as far as it does
//! elsewhere), and what the caller knows of the angle.
//!
//! Sources: GUM (JCGM 100:2008) 5.1; G. Schwarz, Ann. Statist. 6 (1978) 461, eq. 3; P. Diggle and P. Ribeiro, Model-based
//! Geostatistics (2007), 5.2 for the covariance function of residuals; H. Wendland, Adv. Comput. Math. 4 (1995) 389, φ(3,1).

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::sections::shell_term;
use crate::segment::Label;
use crate::statistics::median;
use crate::stop::{poll, polled};
use crate::threads;

/// One shot, unrolled and labelled (see [`crate::segment`]).
#[derive(Debug, Clone, Copy)]
pub struct Shot<'a> {
    /// Angle about the axis, rad; NaN where there is no point.
    pub angle_rad: &'a [f32],
    /// From the seam's centreline, mm; the reference wall is negative.
    pub axial_mm: &'a [f32],
    /// Radial deviation from the reference wall's cylinder, mm.
    pub deviation_mm: &'a [f32],
    /// A [`Label`] per point.
    pub labels: &'a [u8],
    /// Radius of the reference wall.
    pub radius_mm: f64,
    /// Distance between the toes.
    pub bead_width_mm: f64,
    /// Of the nominal wall.
    pub thickness_mm: f64,
}

/// What the caller knows of further standard uncertainties (k = 1).
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Known {
    /// Of the angle about the axis (hand-eye, robot, zero mark), rad.
    pub angle_rad: f64,
}

/// One bin of the profile around the seam.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bin {
    /// Centre: an even degree.
    pub angle_deg: f64,
    /// Mean angle of what was seen of the bin.
    pub seen_at_deg: f64,
    /// Both walls extrapolated to the seam's centreline.
    pub step_mm: f64,
    /// Standard uncertainty and its parts (k = 1).
    pub standard_mm: f64,
    /// From noise, unevenness and extrapolation.
    pub fit_mm: f64,
    /// From the choice of the strip beside the bead.
    pub toe_mm: f64,
    /// From a departure of the bin from the model.
    pub local_mm: f64,
    /// From the angle.
    pub angle_mm: f64,
    /// From the walls' unevenness, which the seam itself need not share.
    pub unevenness_mm: f64,
}

/// The step of a weld.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// Mean of the other wall's radial deviation from the reference wall over its points.
    pub mean_mm: f64,
    /// Median of the same.
    pub median_mm: f64,
    /// Largest |step| of the profile.
    pub max_abs_mm: f64,
    /// Where.
    pub max_abs_at_deg: f64,
    /// Expanded uncertainty (k = 2) of `max_abs_mm`.
    pub expanded_mm: f64,
    /// The profile in order of angle.
    pub profile: Vec<Bin>,
    /// How much of the turn was seen on both walls.
    pub coverage_deg: f64,
    /// Difference of the radii, other minus reference, and its standard uncertainty.
    pub radius_difference_mm: (f64, f64),
    /// Offset of the other wall's axis at the seam (towards angle 0, towards 90°).
    pub axis_offset_mm: [f64; 2],
    /// Standard uncertainty of that offset along its own direction.
    pub axis_offset_standard_mm: f64,
    /// Angle between the walls' axes.
    pub tilt_rad: f64,
    /// Its standard uncertainty.
    pub tilt_standard_rad: f64,
    /// Legendre degree up to which the walls' shape was needed (2: cylinders suffice).
    pub shape_degree: usize,
    /// What the weld drew the reference wall and the other wall in, where the data show it; else 0.
    pub shrinkage_mm: [f64; 2],
    /// Rms of the cells about the model.
    pub residual_rms_mm: f64,
    /// Distance at which the residuals' correlation ends, around and along the axis.
    pub correlation_mm: [f64; 2],
    /// Effective number of independent cells.
    pub effective_cells: f64,
    /// Per shot: the deviation of every point from the corrected reference wall.
    pub deviation_mm: Vec<Vec<f32>>,
}

/// Width of the profile's bins, by contract.
const BIN_DEG: f64 = 2.0;
/// A bin counts as seen when each wall has this part of the points of a typical bin: edges of the view fill bins partly.
const SEEN_PART: f64 = 0.1;
/// Cells per wall and shot: enough to see the unevenness's correlation, few enough to handle their covariance whole.
const CELLS_PER_WALL: f64 = 700.0;
/// Every so many points tell where the middle of an arc is.
const MIDDLE_STRIDE: usize = 16;
/// Places around an arc at which the reference wall's correction is tabulated: it is smooth, and linear in between to
/// 1e-8 of its size.
const TABLE: usize = 4096;
/// A cell needs this part of the points of a typical cell.
const FULL_PART: f64 = 0.25;
/// Beyond this degree a polynomial over one shot's arc describes dents, which the departure of single bins does better.
const MAX_SHAPE_DEGREE: usize = 8;
/// Amplitude of a weld's shrinkage, one sigma; half a millimetre is the most.
const SHRINKAGE_MM: f64 = 0.25;
/// What walls depart from their model as a rule, before it is known of these.
const USUAL_UNEVENNESS_MM: f64 = 0.02;
/// A bin's departure from the model counts from this many sigma.
const DEPARTURE_SIGMAS: f64 = 3.0;

#[derive(Debug, Clone, Copy)]
struct Cell {
    shot: usize,
    other: bool,
    angle: f64,
    axial: f64,
    deviation: f64,
}

/// Which terms a model has.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Terms {
    radius: bool,
    tilt: bool,
    /// Highest Legendre degree of the walls' own shape; 2 means none.
    shape: usize,
    /// What the weld drew each wall in, see [`crate::sections`].
    shell: bool,
}

impl Terms {
    /// With the terms that every pipe may have, needed or not.
    fn widened(self) -> Self {
        Self { radius: true, tilt: true, ..self }
    }
}

/// The arc of one shot: angles are counted from its middle.
#[derive(Debug, Clone, Copy)]
struct Arc {
    middle: f64,
    half: f64,
    radius_mm: f64,
}

impl Arc {
    fn local(&self, angle: f64) -> f64 {
        let turn = angle - self.middle;
        turn - (turn / std::f64::consts::TAU).round() * std::f64::consts::TAU
    }
}

struct Model<'a> {
    arcs: &'a [Arc],
    terms: Terms,
    /// Axial unit, so that all columns have the same size.
    scale_mm: f64,
    /// Of the nominal wall: the shell term's length comes from it.
    thickness_mm: f64,
}

const CYLINDER: usize = 5;

impl Model<'_> {
    fn shapes(&self) -> usize {
        self.terms.shape - 2
    }

    fn step_columns(&self) -> usize {
        2 + usize::from(self.terms.radius) + 2 * usize::from(self.terms.tilt) + self.arcs.len() * self.shapes()
    }

    fn shells(&self) -> usize {
        if self.terms.shell { 2 } else { 0 }
    }

    /// The columns of the walls' shrinkage.
    fn shell_columns(&self) -> std::ops::Range<usize> {
        let first = self.arcs.len() * (CYLINDER + self.shapes());
        first..first + self.shells()
    }

    fn columns(&self) -> usize {
        self.arcs.len() * (CYLINDER + self.shapes()) + self.shells() + self.step_columns()
    }

    /// The columns that are not zero in the rows of a shot.
    fn columns_of_shot(&self, shot: usize) -> Vec<usize> {
        let width = CYLINDER + self.shapes();
        let common = self.arcs.len() * width;
        let shapes = self.columns() - (self.arcs.len() - shot) * self.shapes();
        let mut own: Vec<usize> = (shot * width..(shot + 1) * width).collect();
        own.extend(common..self.columns() - self.arcs.len() * self.shapes());
        own.extend(shapes..shapes + self.shapes());
        own
    }

    /// The columns of a plainer model among those of this one, which has all terms.
    fn columns_with(&self, terms: Terms) -> Vec<usize> {
        let (shots, width, kept) = (self.arcs.len(), CYLINDER + self.shapes(), terms.shape - 2);
        let mut columns: Vec<usize> = (0..shots).flat_map(|k| k * width..k * width + CYLINDER + kept).collect();
        let shells = shots * width;
        let step = shells + self.shells();
        columns.extend((shells..step).filter(|_| terms.shell));
        columns.extend(step..step + 2);
        columns.extend((step + 2..step + 3).filter(|_| terms.radius));
        columns.extend((step + 3..step + 5).filter(|_| terms.tilt));
        let shapes = step + 5;
        columns.extend((0..shots).flat_map(|k| shapes + k * self.shapes()..shapes + k * self.shapes() + kept));
        columns
    }

    /// The row of the reference wall's correction, into its columns of `row`.
    fn reference_row(&self, shot: usize, angle: f64, axial: f64, row: &mut [f64]) {
        let arc = &self.arcs[shot];
        let turn = arc.local(angle);
        let (sin, cos) = turn.sin_cos();
        let z = axial / self.scale_mm;
        let width = CYLINDER + self.shapes();
        let own = &mut row[shot * width..(shot + 1) * width];
        // 1, cos, sin span the same as these, which stay apart on a short arc.
        own[..CYLINDER].copy_from_slice(&[1.0, sin / arc.half.sin().max(1e-9), bow(turn, arc.half), z * cos, z * sin]);
        legendre(turn / arc.half, &mut own[CYLINDER..]);
    }

    /// The row of h, into its columns.
    fn step_row(&self, shot: Option<usize>, angle: f64, axial: f64, row: &mut [f64]) {
        let (sin, cos) = angle.sin_cos();
        let z = axial / self.scale_mm;
        let own = &mut row[self.arcs.len() * (CYLINDER + self.shapes()) + self.shells()..];
        own[..2].copy_from_slice(&[cos, sin]);
        let mut next = 2;
        if self.terms.radius {
            own[next] = 1.0;
            next += 1;
        }
        if self.terms.tilt {
            own[next..next + 2].copy_from_slice(&[z * cos, z * sin]);
            next += 2;
        }
        if let Some(shot) = shot {
            let (arc, shapes) = (&self.arcs[shot], self.shapes());
            let at = next + shot * shapes;
            legendre(arc.local(angle) / arc.half, &mut own[at..at + shapes]);
        }
    }

    fn row(&self, cell: &Cell) -> Vec<f64> {
        let mut row = vec![0.0; self.columns()];
        self.reference_row(cell.shot, cell.angle, cell.axial, &mut row);
        if self.terms.shell {
            let at = self.shell_columns().start + usize::from(cell.other);
            row[at] = shell_term(cell.axial, self.arcs[cell.shot].radius_mm, self.thickness_mm);
        }
        if cell.other {
            self.step_row(Some(cell.shot), cell.angle, cell.axial, &mut row);
        }
        row
    }
}

/// `1 - cos` of the turn, scaled to 1 at the arc's end.
fn bow(turn: f64, half: f64) -> f64 {
    ((turn / 2.0).sin() / (half / 2.0).sin().max(1e-9)).powi(2)
}

/// Legendre polynomials of degree 3, 4, ...
fn legendre(x: f64, out: &mut [f64]) {
    let (mut before, mut last) = (x, 1.5 * x * x - 0.5);
    for (k, slot) in out.iter_mut().enumerate() {
        let n = (k + 3) as f64;
        let next = ((2.0 * n - 1.0) * x * last - (n - 1.0) * before) / n;
        (before, last) = (last, next);
        *slot = next;
    }
}

/// A least-squares solution.
struct Solution {
    parameters: DVector<f64>,
    /// Covariance of the parameters.
    covariance: DMatrix<f64>,
    residuals: Vec<f64>,
}

/// Generalised least squares: rows and deviations are whitened first.
fn solve(model: &Model, cells: &[Cell], whitener: &Whitener) -> Result<Solution> {
    let degenerate = |reason: &str| Error::Degenerate { what: "step", reason: reason.into() };
    let columns = model.columns();
    crate::error::require_count("cells of the walls", columns + 1, cells.len())?;
    let mut rows = DMatrix::zeros(cells.len(), columns);
    for (i, cell) in cells.iter().enumerate() {
        for (j, v) in model.row(cell).into_iter().enumerate() {
            rows[(i, j)] = v;
        }
    }
    let shells = model.shell_columns();
    let weight = whitener.unit_mm / SHRINKAGE_MM;
    let mut white = rows.clone();
    white.column_iter_mut().for_each(|mut c| whitener.apply(c.as_mut_slice()));
    // The prior: a weld draws a wall in by some tenths of a millimetre, and by nothing as a rule.
    white = white.insert_rows(cells.len(), shells.len(), 0.0);
    shells.clone().enumerate().for_each(|(k, column)| white[(cells.len() + k, column)] = weight);
    let qr = white.qr();
    let (q, r) = (qr.q(), qr.r());
    let size = r.amax();
    if (0..columns).any(|j| r[(j, j)].abs() <= 1e-10 * size) {
        return Err(degenerate("the arc that both walls were seen on is too short"));
    }
    let inverse = r
        .solve_upper_triangular(&DMatrix::identity(columns, columns))
        .ok_or_else(|| degenerate("the walls do not determine it"))?;
    let deviations = DVector::from_iterator(cells.len(), cells.iter().map(|c| c.deviation));
    // The second-order term of h depends on the answer: three rounds leave 1e-9 mm.
    let mut parameters = DVector::zeros(columns);
    let mut bent = deviations.clone();
    for _ in 0..3 {
        let mut white = bent.clone();
        whitener.apply(white.as_mut_slice());
        let white = white.insert_rows(cells.len(), shells.len(), 0.0);
        parameters = &inverse * (q.tr_mul(&white));
        for (i, cell) in cells.iter().enumerate() {
            bent[i] =
                deviations[i] + if cell.other { second_order(model, &parameters, cell.angle, cell.axial) } else { 0.0 };
        }
    }
    let residuals = &bent - &rows * &parameters;
    let mut white = residuals.clone();
    whitener.apply(white.as_mut_slice());
    let cost = white.norm_squared();
    if !cost.is_finite() {
        return Err(degenerate("the fit of the walls did not converge"));
    }
    let scale = cost / (cells.len() - columns) as f64;
    let covariance = &inverse * inverse.transpose() * scale;
    Ok(Solution { parameters, covariance, residuals: residuals.iter().copied().collect() })
}

/// `(e × n)² / 2R`: how far a cylinder that is off its axis falls short of `e·n`.
fn second_order(model: &Model, parameters: &DVector<f64>, angle: f64, axial: f64) -> f64 {
    let at = parameters.len() - model.step_columns();
    let p = &parameters.as_slice()[at..];
    let (sin, cos) = angle.sin_cos();
    let z = axial / model.scale_mm;
    let tilt_at = 2 + usize::from(model.terms.radius);
    let (tx, ty) = if model.terms.tilt { (p[tilt_at] * z, p[tilt_at + 1] * z) } else { (0.0, 0.0) };
    let across = -(p[0] + tx) * sin + (p[1] + ty) * cos;
    let radius = model.arcs.iter().map(|a| a.radius_mm).sum::<f64>() / model.arcs.len() as f64;
    across * across / (2.0 * radius)
}

/// The covariance of what a fit leaves: a nugget, and a part correlated over a support around and along the axis.
#[derive(Debug, Clone, Copy)]
struct Covariance {
    nugget: f64,
    sill: f64,
    /// Distance at which the correlation ends: around and along the axis.
    support_mm: [f64; 2],
}

/// Wendland's positive definite function of support 1, smooth at 0 as a Gaussian is.
fn wendland(r: f64) -> f64 {
    if r < 1.0 { (1.0 - r).powi(4) * (4.0 * r + 1.0) } else { 0.0 }
}

/// Lags of the empirical covariance, in cells.
const LAGS: usize = 16;

/// Distance of two cells of one shot around and along the axis.
fn apart_mm(arcs: &[Arc], a: &Cell, b: &Cell) -> [f64; 2] {
    let arc = &arcs[a.shot];
    [((arc.local(a.angle) - arc.local(b.angle)) * arc.radius_mm).abs(), (a.axial - b.axial).abs()]
}

/// Whether unevenness may be common to two cells: they are of one wall in one shot.
fn related(a: &Cell, b: &Cell) -> bool {
    a.shot == b.shot && a.other == b.other
}

impl Covariance {
    /// From the residuals: products of pairs, averaged by their lag around and along the axis.
    fn of(arcs: &[Arc], cells: &[Cell], residuals: &[f64], cell_mm: f64) -> Self {
        // A dent is not unevenness: it must not hide itself by raising what counts as usual.
        let mut sizes: Vec<f64> = residuals.iter().map(|r| r.abs()).collect();
        let limit = 3.0 * 1.4826 * median(&mut sizes);
        let r: Vec<f64> = residuals.iter().map(|v| v.clamp(-limit, limit)).collect();
        let variance = r.iter().map(|v| v * v).sum::<f64>() / r.len() as f64;
        let indices: Vec<usize> = (0..cells.len()).collect();
        let parts: Vec<[[(f64, f64, f64); LAGS]; 2]> = threads::install(|| {
            indices
                .par_chunks(64)
                .inspect(polled)
                .map(|chunk| {
                    let mut lags = [[(0.0, 0.0, 0.0); LAGS]; 2];
                    for &i in chunk {
                        for j in i + 1..cells.len() {
                            if !related(&cells[i], &cells[j]) {
                                break;
                            }
                            let d = apart_mm(arcs, &cells[i], &cells[j]);
                            for way in 0..2 {
                                let lag = (d[way] / cell_mm).round() as usize;
                                if lag > 0 && lag < LAGS && 2.0 * d[1 - way] < cell_mm {
                                    let slot: &mut (f64, f64, f64) = &mut lags[way][lag];
                                    *slot = (slot.0 + 1.0, slot.1 + d[way], slot.2 + r[i] * r[j]);
                                }
                            }
                        }
                    }
                    lags
                })
                .collect()
        });
        let mut lags = [[(0.0, 0.0, 0.0); LAGS]; 2];
        for (way, lag) in (0..2).flat_map(|w| (0..LAGS).map(move |l| (w, l))) {
            for part in &parts {
                let (a, b) = (&mut lags[way][lag], part[way][lag]);
                *a = (a.0 + b.0, a.1 + b.1, a.2 + b.2);
            }
        }
        let seen = |way: usize| -> Vec<(f64, f64)> {
            lags[way].iter().filter(|l| l.0 > 0.0).map(|l| (l.1 / l.0, l.2 / l.0)).collect()
        };
        let (around, along) = (seen(0), seen(1));
        // The sill from the way in which the correlation reaches further.
        let sill = [&around, &along].map(|lags| fitted_support(lags, cell_mm, None).1);
        let sill = sill[0].max(sill[1]).clamp(0.0, variance);
        let support_mm = [&around, &along].map(|lags| fitted_support(lags, cell_mm, Some(sill)).0);
        // A hundredth at least stays uncorrelated, which keeps the whitening stable.
        Self { nugget: (variance - sill).max(0.01 * variance).max(f64::MIN_POSITIVE), sill, support_mm }
    }

    /// Between two cells.
    fn between(&self, arcs: &[Arc], a: &Cell, b: &Cell) -> f64 {
        if !related(a, b) {
            return 0.0;
        }
        let d = apart_mm(arcs, a, b);
        self.sill * wendland((d[0] / self.support_mm[0]).hypot(d[1] / self.support_mm[1]))
    }

    /// Variance of a weighted sum of cells.
    fn variance_of(&self, arcs: &[Arc], terms: &[(Cell, f64)]) -> f64 {
        let row = |(a, w): &(Cell, f64)| {
            let pairs: f64 = terms.iter().map(|(b, v)| v * self.between(arcs, a, b)).sum();
            w * (pairs + w * self.nugget)
        };
        terms.iter().map(row).sum::<f64>().max(0.0)
    }
}

/// The support, and the sill where it is not given, that fit an empirical covariance best; (one cell, 0) for none.
fn fitted_support(lags: &[(f64, f64)], cell_mm: f64, sill: Option<f64>) -> (f64, f64) {
    let mut best = (f64::INFINITY, cell_mm, 0.0);
    // From a cell to the largest lag, in steps of an eighth of an octave.
    for k in 0..=8 * LAGS.ilog2() {
        let support = cell_mm * 2_f64.powf(f64::from(k) / 8.0);
        let shape: Vec<f64> = lags.iter().map(|l| wendland(l.0 / support)).collect();
        let (fit, power) = lags.iter().zip(&shape).fold((0.0, 0.0), |(a, b), (l, s)| (a + l.1 * s, b + s * s));
        let height = sill.unwrap_or(if power > 0.0 { (fit / power).max(0.0) } else { 0.0 });
        let miss: f64 = lags.iter().zip(&shape).map(|(l, s)| (l.1 - height * s).powi(2)).sum();
        if miss < best.0 {
            best = (miss, support, height);
        }
    }
    (best.1, best.2)
}

/// Cholesky factor of the cells' covariance, row by row from the first column that is not zero: cells far apart are not
/// correlated, and in their order around the axis that leaves a narrow band.
struct Whitener {
    rows: Vec<(usize, Vec<f64>)>,
    /// What a whitened residual of usual size is: 1 where the covariance is known, else a length.
    unit_mm: f64,
}

impl Whitener {
    fn identity(cells: usize) -> Self {
        Self { rows: (0..cells).map(|i| (i, vec![1.0])).collect(), unit_mm: USUAL_UNEVENNESS_MM }
    }

    fn of(arcs: &[Arc], cells: &[Cell], covariance: &Covariance) -> Self {
        let mut rows: Vec<(usize, Vec<f64>)> = Vec::with_capacity(cells.len());
        for (i, cell) in cells.iter().enumerate() {
            poll();
            let wall = cells[..i].iter().rev().take_while(|c| related(cell, c)).count();
            let near = |j: &usize| apart_mm(arcs, cell, &cells[*j])[0] < covariance.support_mm[0];
            let first = (i - wall..i).find(near).unwrap_or(i);
            let mut row: Vec<f64> = (first..i).map(|j| covariance.between(arcs, cell, &cells[j])).collect();
            for j in first..i {
                let (start, other) = &rows[j];
                let from = first.max(*start);
                let sum: f64 =
                    row[from - first..j - first].iter().zip(&other[from - start..]).map(|(a, b)| a * b).sum();
                row[j - first] = (row[j - first] - sum) / other[j - start];
            }
            // The nugget is never eaten up: the correlated part is positive definite by itself.
            let rest = covariance.sill + covariance.nugget - row.iter().map(|v| v * v).sum::<f64>();
            row.push(rest.max(0.5 * covariance.nugget).sqrt());
            rows.push((first, row));
        }
        Self { rows, unit_mm: 1.0 }
    }

    /// `L⁻¹ x`, in place.
    fn apply(&self, x: &mut [f64]) {
        self.apply_from(0, x);
    }

    /// The same for the cells from `start` on; a shot's depend on none before it.
    fn apply_from(&self, start: usize, x: &mut [f64]) {
        for i in 0..x.len() {
            let (first, row) = &self.rows[start + i];
            let last = row.len() - 1;
            let sum: f64 = row[..last].iter().zip(&x[first - start..i]).map(|(a, b)| a * b).sum();
            x[i] = (x[i] - sum) / row[last];
        }
    }

    /// How many independent cells tell as much of a wall's height as the correlated ones do, given their variance.
    fn effective_count(&self, variance: f64) -> f64 {
        let mut ones = vec![1.0; self.rows.len()];
        self.apply(&mut ones);
        variance * ones.iter().map(|v| v * v).sum::<f64>()
    }
}

/// Sums of a wall's points over a grid of cells.
struct Grid {
    cells: Vec<Cell>,
    cell_mm: f64,
}

fn is_wall(label: u8) -> Option<bool> {
    match label {
        l if l == Label::ReferenceWall as u8 => Some(false),
        l if l == Label::OtherWall as u8 => Some(true),
        _ => None,
    }
}

/// The arc of a shot's walls, from the middle of what was seen of them.
fn arc_of(shot: &Shot) -> Result<Arc> {
    let (mut c, mut s, mut count) = (0.0, 0.0, [0_usize; 2]);
    for (i, (a, l)) in shot.angle_rad.iter().zip(shot.labels).enumerate() {
        if let Some(other) = is_wall(*l) {
            // Any angle about the middle will do to count from.
            if i % MIDDLE_STRIDE == 0 {
                let (sin, cos) = a.sin_cos();
                (c, s) = (c + f64::from(cos), s + f64::from(sin));
            }
            count[usize::from(other)] += 1;
        }
    }
    for (what, n) in [("points of the reference wall", count[0]), ("points of the other wall", count[1])] {
        crate::error::require_count(what, 100, n)?;
    }
    let mut arc = Arc { middle: f64::atan2(s, c), half: 0.0, radius_mm: shot.radius_mm };
    for (a, l) in shot.angle_rad.iter().zip(shot.labels) {
        if is_wall(*l).is_some() {
            arc.half = arc.half.max(arc.local(f64::from(*a)).abs());
        }
    }
    if arc.half <= 0.0 {
        return Err(Error::Degenerate { what: "step", reason: "all points lie at one angle".into() });
    }
    Ok(arc)
}

fn grid_of(index: usize, shot: &Shot, arc: &Arc) -> Result<Grid> {
    let mut low = [f64::INFINITY; 2];
    let mut high = [f64::NEG_INFINITY; 2];
    for (z, l) in shot.axial_mm.iter().zip(shot.labels) {
        if let Some(other) = is_wall(*l) {
            let k = usize::from(other);
            low[k] = low[k].min(f64::from(*z));
            high[k] = high[k].max(f64::from(*z));
        }
    }
    let area = 2.0 * arc.half * arc.radius_mm * (high[0] - low[0]).max(high[1] - low[1]);
    let cell_mm = (area / CELLS_PER_WALL).sqrt();
    if !(cell_mm.is_finite() && cell_mm > 0.0) {
        return Err(Error::Degenerate { what: "step", reason: "the walls have no extent".into() });
    }
    let columns = (2.0 * arc.half * arc.radius_mm / cell_mm) as usize + 1;
    let rows: [usize; 2] = std::array::from_fn(|k| ((high[k] - low[k]) / cell_mm) as usize + 1);
    let total = columns * (rows[0] + rows[1]);
    // Angle, axial, deviation, count; one partial grid per large chunk, added in order.
    let indices: Vec<usize> = (0..shot.labels.len()).collect();
    let parts: Vec<Vec<[f64; 4]>> = threads::install(|| {
        indices
            .par_chunks(8 * threads::CHUNK)
            .inspect(polled)
            .map(|chunk| {
                let mut sums = vec![[0.0; 4]; total];
                for &i in chunk {
                    let Some(other) = is_wall(shot.labels[i]) else { continue };
                    let k = usize::from(other);
                    let (a, z) = (arc.local(f64::from(shot.angle_rad[i])), f64::from(shot.axial_mm[i]));
                    let column = (((a + arc.half) * arc.radius_mm / cell_mm) as usize).min(columns - 1);
                    let row = (((z - low[k]) / cell_mm) as usize).min(rows[k] - 1);
                    let slot = &mut sums[columns * (k * rows[0] + row) + column];
                    let d = f64::from(shot.deviation_mm[i]);
                    *slot = [slot[0] + a, slot[1] + z, slot[2] + d, slot[3] + 1.0];
                }
                sums
            })
            .collect()
    });
    let mut sums = vec![[0.0; 4]; total];
    for part in parts {
        for (a, b) in sums.iter_mut().zip(part) {
            *a = std::array::from_fn(|k| a[k] + b[k]);
        }
    }
    let mut counts: Vec<f64> = sums.iter().map(|s| s[3]).filter(|n| *n > 0.0).collect();
    let full = FULL_PART * median(&mut counts);
    let cell = |(k, s): (usize, &[f64; 4])| {
        (s[3] > 0.0 && s[3] >= full).then(|| Cell {
            shot: index,
            other: k >= columns * rows[0],
            angle: arc.middle + s[0] / s[3],
            axial: s[1] / s[3],
            deviation: s[2] / s[3],
        })
    };
    // Wall by wall, and around the axis: neighbours in the list are neighbours on the wall, see `Whitener`.
    let place = |k: usize, c: usize, r: usize| columns * (k * rows[0] + r) + c;
    let turned = (0..2).flat_map(|k| (0..columns).flat_map(move |c| (0..rows[k]).map(move |r| place(k, c, r))));
    Ok(Grid { cells: turned.filter_map(|i| cell((i, &sums[i]))).collect(), cell_mm })
}

/// Measures the step on all shots together.
///
/// # Errors
/// [`Error::Shape`] where a shot's arrays differ in length, [`Error::TooFew`] without both walls in each shot,
/// [`Error::Degenerate`] where the walls do not determine it.
pub fn measure(shots: &[Shot], known: &Known) -> Result<Step> {
    crate::error::require_count("part shots with both walls", 1, shots.len())?;
    for shot in shots {
        let n = shot.labels.len();
        if [shot.angle_rad.len(), shot.axial_mm.len(), shot.deviation_mm.len()] != [n; 3] {
            let (expected, got) = ("arrays of one length".into(), "different lengths".into());
            return Err(Error::Shape { what: "shot", expected, got });
        }
        crate::error::require_positive("radius_mm", shot.radius_mm)?;
        crate::error::require_positive("thickness_mm", shot.thickness_mm)?;
    }
    crate::memory::require(shots.iter().map(|s| s.labels.len()).sum(), 24);
    let arcs = shots.iter().map(arc_of).collect::<Result<Vec<Arc>>>()?;
    let grids = (0..shots.len()).map(|k| grid_of(k, &shots[k], &arcs[k])).collect::<Result<Vec<Grid>>>()?;
    let cell_mm = grids.iter().map(|g| g.cell_mm).fold(0.0, f64::max);
    let cells: Vec<Cell> = grids.into_iter().flat_map(|g| g.cells).collect();
    let scale_mm = cells.iter().map(|c| c.axial.abs()).fold(0.0, f64::max);
    let thickness_mm = shots.iter().map(|s| s.thickness_mm).sum::<f64>() / shots.len() as f64;
    let model = |terms: Terms| Model { arcs: &arcs, terms, scale_mm, thickness_mm };

    // Plain least squares first, to see what the walls' unevenness is like.
    let plain = Whitener::identity(cells.len());
    let rough = solve(&model(choose(&model, &cells, &plain)?.widened()), &cells, &plain)?;
    let covariance = Covariance::of(&arcs, &cells, &rough.residuals, cell_mm);
    let whitener = Whitener::of(&arcs, &cells, &covariance);
    let terms = choose(&model, &cells, &whitener)?;
    let chosen = solve(&model(terms), &cells, &whitener)?;
    let wide_terms = terms.widened();
    let wide = solve(&model(wide_terms), &cells, &whitener)?;

    // Without the strip beside the bead: half a bead's width.
    let bead_mm = shots.iter().map(|s| s.bead_width_mm).fold(0.0, f64::max);
    let nearest =
        |other: bool| cells.iter().filter(|c| c.other == other).map(|c| c.axial.abs()).fold(f64::INFINITY, f64::min);
    let limits = [nearest(false) + bead_mm / 2.0, nearest(true) + bead_mm / 2.0];
    let far: Vec<Cell> = cells.iter().filter(|c| c.axial.abs() > limits[usize::from(c.other)]).copied().collect();
    let without_strip = solve(&model(terms), &far, &Whitener::of(&arcs, &far, &covariance)).ok();

    let deviation_mm: Vec<Vec<f32>> =
        (0..shots.len()).map(|k| corrected(&model(terms), &chosen.parameters, k, &shots[k])).collect();
    let (mean_mm, median_mm) = mean_and_median(shots, &deviation_mm);

    // Each wall ends at the seam as uneven as it is elsewhere.
    let unevenness_mm = (2.0 * covariance.sill).sqrt();
    let departures = Departures { arcs: &arcs, cells: &cells, residuals: &chosen.residuals, covariance: &covariance };
    let step_at = |terms: Terms, parameters: &DVector<f64>, shot: usize, angle: f64| {
        let m = model(terms);
        let mut row = vec![0.0; m.columns()];
        m.step_row(Some(shot), angle, 0.0, &mut row);
        DVector::from_vec(row).dot(parameters) - second_order(&m, parameters, angle, 0.0)
    };
    let mut profile = Vec::new();
    for seen in seen_bins(shots) {
        let (angle, shot) = (seen.angle_rad, seen.shot);
        let smooth = step_at(terms, &chosen.parameters, shot, angle);
        let mut row = vec![0.0; model(wide_terms).columns()];
        model(wide_terms).step_row(Some(shot), angle, 0.0, &mut row);
        let row = DVector::from_vec(row);
        let fit_mm = row.dot(&(&wide.covariance * &row)).max(0.0).sqrt();
        let toe_mm = without_strip
            .as_ref()
            .map_or(smooth.abs(), |s| (step_at(terms, &s.parameters, shot, angle) - smooth).abs() / 3f64.sqrt());
        let (local, local_mm) = departures.of(shot, seen.index);
        let slope = (step_at(terms, &chosen.parameters, shot, angle + 1e-4)
            - step_at(terms, &chosen.parameters, shot, angle - 1e-4))
            / 2e-4;
        let angle_mm = slope.abs() * known.angle_rad;
        let parts = [fit_mm, toe_mm, local_mm, angle_mm, unevenness_mm];
        profile.push(Bin {
            angle_deg: BIN_DEG * seen.index as f64,
            seen_at_deg: angle.to_degrees().rem_euclid(360.0),
            step_mm: smooth + local,
            standard_mm: parts.iter().map(|p| p * p).sum::<f64>().sqrt(),
            fit_mm,
            toe_mm,
            local_mm,
            angle_mm,
            unevenness_mm,
        });
    }
    let Some(largest) = profile.iter().max_by(|a, b| a.step_mm.abs().total_cmp(&b.step_mm.abs())) else {
        return Err(Error::NotFound { what: "step", reason: "no angle at which both walls were seen".into() });
    };
    let at = wide.parameters.len() - model(wide_terms).step_columns();
    let p = &wide.parameters.as_slice()[at..];
    // Of a vector's length: its covariance along its own direction.
    let along = |k: usize| {
        let v = nalgebra::Vector2::new(p[k], p[k + 1]);
        let u = v.try_normalize(0.0).unwrap_or(nalgebra::Vector2::x());
        let c = wide.covariance.fixed_view::<2, 2>(at + k, at + k);
        u.dot(&(c * u)).max(0.0).sqrt()
    };
    Ok(Step {
        mean_mm,
        median_mm,
        max_abs_mm: largest.step_mm.abs(),
        max_abs_at_deg: largest.angle_deg,
        expanded_mm: 2.0 * largest.standard_mm,
        coverage_deg: BIN_DEG * profile.len() as f64,
        radius_difference_mm: (p[2], wide.covariance[(at + 2, at + 2)].max(0.0).sqrt()),
        axis_offset_mm: [p[0], p[1]],
        axis_offset_standard_mm: along(0),
        tilt_standard_rad: along(3) / scale_mm,
        tilt_rad: (p[3].hypot(p[4]) / scale_mm).atan(),
        shape_degree: terms.shape,
        shrinkage_mm: {
            let mut drawn = model(terms).shell_columns().map(|k| chosen.parameters[k]);
            std::array::from_fn(|_| drawn.next().unwrap_or(0.0))
        },
        residual_rms_mm: (chosen.residuals.iter().map(|r| r * r).sum::<f64>() / cells.len() as f64).sqrt(),
        correlation_mm: covariance.support_mm,
        effective_cells: whitener.effective_count(covariance.nugget + covariance.sill),
        profile,
        deviation_mm,
    })
}

/// Adds groups of terms to the plain offset as long as Schwarz's criterion falls.
fn choose<'a>(model: &impl Fn(Terms) -> Model<'a>, cells: &[Cell], whitener: &Whitener) -> Result<Terms> {
    let count = cells.len() as f64;
    let mut terms = Terms { radius: false, tilt: false, shape: 2, shell: false };
    let full = model(Terms { radius: true, tilt: true, shape: MAX_SHAPE_DEGREE, shell: true });
    let normal = Normal::of(&full, cells, whitener, &solve(&model(terms), cells, whitener)?.residuals);
    let criterion = |terms: Terms| -> Option<f64> {
        let columns = full.columns_with(terms);
        let cost = normal.cost(&columns)?;
        Some(count * (cost / count).max(f64::MIN_POSITIVE).ln() + columns.len() as f64 * count.ln())
    };
    let mut best = criterion(terms).unwrap_or(f64::INFINITY);
    loop {
        let mut candidates =
            vec![Terms { radius: true, ..terms }, Terms { tilt: true, ..terms }, Terms { shell: true, ..terms }];
        // Ovality is even: a step of one degree alone may not pay.
        candidates
            .extend((terms.shape + 1..=(terms.shape + 2).min(MAX_SHAPE_DEGREE)).map(|shape| Terms { shape, ..terms }));
        let tried = candidates.into_iter().filter(|t| *t != terms).filter_map(|t| Some((criterion(t)?, t)));
        match tried.min_by(|a, b| a.0.total_cmp(&b.0)) {
            Some((value, next)) if value < best => (best, terms) = (value, next),
            _ => return Ok(terms),
        }
    }
}

/// The normal equations of the fullest model for what the plainest one leaves: every model between them is a part of them,
/// and costs next to nothing. The plainest one's residuals are small, so that no digits cancel.
struct Normal {
    matrix: DMatrix<f64>,
    right: DVector<f64>,
    square: f64,
}

/// A shot's part: its columns, their products, their products with what is left, and its square.
type Part = (Vec<usize>, DMatrix<f64>, DVector<f64>, f64);

impl Normal {
    fn of(model: &Model, cells: &[Cell], whitener: &Whitener, residuals: &[f64]) -> Self {
        let starts: Vec<usize> = (0..=model.arcs.len()).map(|k| cells.partition_point(|c| c.shot < k)).collect();
        let shots: Vec<usize> = (0..model.arcs.len()).collect();
        // The columns of another shot are zero in a shot's rows, and whitening stays within a shot.
        let parts: Vec<Part> = threads::install(|| {
            shots
                .par_iter()
                .map(|&k| {
                    let (start, own) = (starts[k], model.columns_of_shot(k));
                    let mut white = DMatrix::zeros(starts[k + 1] - start, own.len());
                    let mut left = DVector::from_column_slice(&residuals[start..starts[k + 1]]);
                    for (i, cell) in cells[start..starts[k + 1]].iter().enumerate() {
                        let row = model.row(cell);
                        own.iter().enumerate().for_each(|(j, &column)| white[(i, j)] = row[column]);
                    }
                    white.column_iter_mut().for_each(|mut c| whitener.apply_from(start, c.as_mut_slice()));
                    whitener.apply_from(start, left.as_mut_slice());
                    let square = left.norm_squared();
                    (own, white.tr_mul(&white), white.tr_mul(&left), square)
                })
                .collect()
        });
        let n = model.columns();
        let mut all = Self { matrix: DMatrix::zeros(n, n), right: DVector::zeros(n), square: 0.0 };
        model.shell_columns().for_each(|k| all.matrix[(k, k)] = (whitener.unit_mm / SHRINKAGE_MM).powi(2));
        for (own, matrix, right, square) in parts {
            all.square += square;
            for (i, &a) in own.iter().enumerate() {
                all.right[a] += right[i];
                own.iter().enumerate().for_each(|(j, &b)| all.matrix[(a, b)] += matrix[(i, j)]);
            }
        }
        all
    }

    /// What is left when these columns are fitted; `None` where they do not stand apart.
    fn cost(&self, columns: &[usize]) -> Option<f64> {
        let matrix = DMatrix::from_fn(columns.len(), columns.len(), |i, j| self.matrix[(columns[i], columns[j])]);
        let right = DVector::from_fn(columns.len(), |i, _| self.right[columns[i]]);
        let solution = matrix.cholesky()?.solve(&right);
        Some((self.square - right.dot(&solution)).max(0.0)).filter(|c| c.is_finite())
    }
}

/// Every point's deviation from the corrected reference wall.
fn corrected(model: &Model, parameters: &DVector<f64>, shot: usize, points: &Shot) -> Vec<f32> {
    let width = CYLINDER + model.shapes();
    let own = &parameters.as_slice()[shot * width..(shot + 1) * width];
    let arc = &model.arcs[shot];
    // The correction is f(angle) + axial · g(angle).
    let table: Vec<[f64; 2]> = (0..=TABLE)
        .map(|k| {
            let angle = arc.middle + arc.half * (2.0 * k as f64 / TABLE as f64 - 1.0);
            let at = |axial: f64| {
                let mut row = vec![0.0; model.columns()];
                model.reference_row(shot, angle, axial, &mut row);
                row[shot * width..(shot + 1) * width].iter().zip(own).map(|(a, b)| a * b).sum::<f64>()
            };
            [at(0.0), at(1.0) - at(0.0)]
        })
        .collect();
    threads::map_ranges(points.labels.len(), |range| {
        let one = |i: usize| {
            let place = (arc.local(f64::from(points.angle_rad[i])) / arc.half + 1.0) / 2.0 * TABLE as f64;
            // Beyond the walls' arc (nothing of the weld is there) the correction is that of its end.
            let place = place.clamp(0.0, TABLE as f64 - 1e-9);
            let (k, part) = (place as usize, place.fract());
            let blend = |c: usize| table[k][c] + part * (table[k + 1][c] - table[k][c]);
            (f64::from(points.deviation_mm[i]) - blend(0) - f64::from(points.axial_mm[i]) * blend(1)) as f32
        };
        range.map(one).collect::<Vec<f32>>()
    })
    .concat()
}

/// Over the other wall's points of all shots.
fn mean_and_median(shots: &[Shot], deviations: &[Vec<f32>]) -> (f64, f64) {
    let other = |k: usize| {
        let labelled = shots[k].labels.iter().zip(&deviations[k]);
        labelled.filter(|(l, _)| is_wall(**l) == Some(true)).map(|(_, d)| *d)
    };
    let mut all: Vec<f32> = (0..shots.len()).flat_map(other).collect();
    if all.is_empty() {
        return (f64::NAN, f64::NAN);
    }
    let mean = all.iter().map(|d| f64::from(*d)).sum::<f64>() / all.len() as f64;
    let middle = all.len() / 2;
    (mean, f64::from(*all.select_nth_unstable_by(middle, f32::total_cmp).1))
}

/// A bin of the profile that both walls of a shot were seen in.
struct Seen {
    index: i64,
    shot: usize,
    /// Mean angle of what was seen.
    angle_rad: f64,
}

fn bin_of(angle_rad: f64) -> i64 {
    let turn = (360.0 / BIN_DEG) as i64;
    ((angle_rad.to_degrees() / BIN_DEG).round() as i64).rem_euclid(turn)
}

/// In order of angle; where several shots saw a bin, the one that saw most of it.
fn seen_bins(shots: &[Shot]) -> Vec<Seen> {
    let turn = (360.0 / BIN_DEG) as usize;
    let mut best: Vec<Option<(f64, Seen)>> = (0..turn).map(|_| None).collect();
    for (k, shot) in shots.iter().enumerate() {
        let parts = threads::map_ranges(shot.labels.len(), |range| {
            let mut sums = vec![[(0.0, 0.0); 2]; turn];
            for (a, l) in shot.angle_rad[range.clone()].iter().zip(&shot.labels[range]) {
                if let Some(other) = is_wall(*l) {
                    let index = bin_of(f64::from(*a));
                    let off = f64::from(*a) - (BIN_DEG * index as f64).to_radians();
                    let off = off - (off / std::f64::consts::TAU).round() * std::f64::consts::TAU;
                    let slot: &mut (f64, f64) = &mut sums[index as usize][usize::from(other)];
                    *slot = (slot.0 + 1.0, slot.1 + off);
                }
            }
            sums
        });
        let mut sums = vec![[(0.0, 0.0); 2]; turn];
        for part in parts {
            for (slot, more) in sums.iter_mut().flatten().zip(part.iter().flatten()) {
                *slot = (slot.0 + more.0, slot.1 + more.1);
            }
        }
        let typical: [f64; 2] = std::array::from_fn(|w| {
            let mut counts: Vec<f64> = sums.iter().map(|s| s[w].0).filter(|n| *n > 0.0).collect();
            median(&mut counts)
        });
        for (index, walls) in sums.iter().enumerate() {
            if (0..2).any(|w| walls[w].0 < 1.0 || walls[w].0 < SEEN_PART * typical[w]) {
                continue;
            }
            let fullness = walls[0].0.min(walls[1].0);
            let off = (walls[0].1 / walls[0].0 + walls[1].1 / walls[1].0) / 2.0;
            let angle_rad = (BIN_DEG * index as f64).to_radians() + off;
            if best[index].as_ref().is_none_or(|(n, _)| fullness > *n) {
                best[index] = Some((fullness, Seen { index: index as i64, shot: k, angle_rad }));
            }
        }
    }
    best.into_iter().flatten().map(|(_, seen)| seen).collect()
}

/// How single bins depart from the smooth model.
struct Departures<'a> {
    arcs: &'a [Arc],
    cells: &'a [Cell],
    residuals: &'a [f64],
    covariance: &'a Covariance,
}

impl Departures<'_> {
    /// The departure of a bin's walls from the model, other minus reference, as far as it is significant, and its
    /// standard uncertainty. Between "within the noise" (0) and "far beyond it" (all of it) the passage is smooth.
    fn of(&self, shot: usize, index: i64) -> (f64, f64) {
        let mine: Vec<usize> = (0..self.cells.len())
            .filter(|&i| self.cells[i].shot == shot && bin_of(self.cells[i].angle) == index)
            .collect();
        let count = |other: bool| mine.iter().filter(|&&i| self.cells[i].other == other).count() as f64;
        let (reference, other) = (count(false), count(true));
        if reference == 0.0 || other == 0.0 {
            return (0.0, 0.0);
        }
        let weight = |c: &Cell| if c.other { 1.0 / other } else { -1.0 / reference };
        let terms: Vec<(Cell, f64)> = mine.iter().map(|&i| (self.cells[i], weight(&self.cells[i]))).collect();
        let departure: f64 = mine.iter().zip(&terms).map(|(&i, (_, w))| w * self.residuals[i]).sum();
        let sigma = self.covariance.variance_of(self.arcs, &terms).sqrt();
        let excess = 1.0 - (DEPARTURE_SIGMAS * sigma / departure).powi(2);
        if excess.is_finite() && excess > 0.0 { (excess * departure, sigma) } else { (0.0, 0.0) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::segment::tests::{COLUMNS, EXAMPLE, Example, MIDDLE_RAD};
    use crate::segment::{Segmentation, segment};

    /// Three sigma of 0.04 mm of noise over 110,000 points, extrapolated to the end of a short arc in the model with all
    /// its terms.
    const STEP_TOLERANCE_MM: f64 = 0.006;

    fn shot(s: &Segmentation) -> Shot<'_> {
        Shot {
            angle_rad: &s.unrolled.angle_rad,
            axial_mm: &s.unrolled.axial_mm,
            deviation_mm: &s.unrolled.deviation_mm,
            labels: &s.labels,
            radius_mm: s.frame.radius_mm,
            bead_width_mm: s.bead_width_mm,
            thickness_mm: s.thickness_mm,
        }
    }

    fn measured(examples: &[Example]) -> (Vec<Segmentation>, Step) {
        let segmented: Vec<Segmentation> =
            examples.iter().map(|e| segment(&e.points(), COLUMNS, &e.nominal()).unwrap()).collect();
        let shots: Vec<Shot> = segmented.iter().map(shot).collect();
        let step = measure(&shots, &Known::default()).unwrap();
        (segmented, step)
    }

    fn largest_error(step: &Step, e: &Example) -> f64 {
        let error = |b: &Bin| (b.step_mm - e.step_mm(b.seen_at_deg.to_radians(), 0.0)).abs();
        step.profile.iter().map(error).fold(0.0, f64::max)
    }

    #[test]
    fn the_step_is_that_of_the_closed_form() {
        for e in [
            EXAMPLE,
            Example { offset_mm: [-0.3, -0.9], seed: 2, ..EXAMPLE },
            Example { tilt: [0.002, -0.001], radius_difference_mm: 0.4, seed: 3, ..EXAMPLE },
            Example { radius_mm: 54.0, half_arc_rad: 0.8, offset_mm: [1.0, -0.7], bead_width_mm: 6.0, ..EXAMPLE },
            Example { radius_mm: 610.0, half_arc_rad: 0.12, bead_width_mm: 20.0, ..EXAMPLE },
        ] {
            let (_, step) = measured(&[e]);
            assert!(largest_error(&step, &e) < STEP_TOLERANCE_MM, "R {}: {} mm", e.radius_mm, largest_error(&step, &e));
            for bin in &step.profile {
                let error = bin.step_mm - e.step_mm(bin.seen_at_deg.to_radians(), 0.0);
                assert!(error.abs() < 4.0 * bin.standard_mm, "{error} mm at {}", bin.angle_deg);
            }
            let arc_deg = 2.0 * e.half_arc_rad.to_degrees();
            assert!((step.coverage_deg - arc_deg).abs() <= 2.0 * BIN_DEG, "{} deg", step.coverage_deg);
        }
    }

    #[test]
    fn the_sign_follows_the_wall_that_stands_out() {
        let out = Example { offset_mm: [0.5 * MIDDLE_RAD.cos(), 0.5 * MIDDLE_RAD.sin()], ..EXAMPLE };
        let inward = Example { offset_mm: out.offset_mm.map(|v| -v), ..EXAMPLE };
        assert!((measured(&[out]).1.mean_mm - 0.495).abs() < 0.01);
        assert!((measured(&[inward]).1.mean_mm + 0.495).abs() < 0.01);
    }

    #[test]
    fn a_dent_beside_the_seam_is_not_smoothed_away() {
        let e = EXAMPLE;
        let mut s = segment(&e.points(), COLUMNS, &e.nominal()).unwrap();
        // Six degrees of the other wall stand 0.5 mm higher.
        for i in 0..s.labels.len() {
            let turn = f64::from(s.unrolled.angle_rad[i]) - MIDDLE_RAD;
            if s.unrolled.axial_mm[i] > 0.0 && (0.05..0.155).contains(&turn) {
                s.unrolled.deviation_mm[i] += 0.5;
            }
        }
        let step = measure(&[shot(&s)], &Known::default()).unwrap();
        let top = e.step_mm(MIDDLE_RAD + 0.1, 0.0) + 0.5;
        assert!((step.max_abs_mm - top.abs()).abs() < 0.15, "{} of {top} mm", step.max_abs_mm);
    }

    #[test]
    fn the_interval_covers_the_error_of_correlated_walls() {
        // Unevenness of 0.01 mm over 8 mm, drawn anew 40 times: the stated parts of noise and extrapolation must cover.
        let mut inside = 0;
        let mut total = 0;
        for seed in 0..40_u64 {
            let e = Example { noise_mm: 0.02, seed: seed + 10, ..EXAMPLE };
            let mut s = segment(&e.points(), COLUMNS, &e.nominal()).unwrap();
            let mut state = seed + 1;
            let waves: Vec<[f64; 3]> = (0..60)
                .map(|_| {
                    let k =
                        std::array::from_fn::<f64, 2, _>(|_| crate::segment::tests::normal_random(&mut state) / 8.0);
                    [k[0], k[1], std::f64::consts::TAU * crate::segment::tests::normal_random(&mut state)]
                })
                .collect();
            for i in 0..s.labels.len() {
                let (x, z) = (f64::from(s.unrolled.angle_rad[i]) * e.radius_mm, f64::from(s.unrolled.axial_mm[i]));
                let wave: f64 = waves.iter().map(|w| (w[0] * x + w[1] * z + w[2]).cos()).sum();
                s.unrolled.deviation_mm[i] += (0.01 * wave * (2.0 / 60.0_f64).sqrt()) as f32;
            }
            let step = measure(&[shot(&s)], &Known::default()).unwrap();
            assert!(step.correlation_mm.iter().all(|l| (5.0..60.0).contains(l)), "{:?} mm", step.correlation_mm);
            for bin in step.profile.iter().step_by(5) {
                let error = bin.step_mm - e.step_mm(bin.seen_at_deg.to_radians(), 0.0);
                inside += usize::from(error.abs() <= 2.0 * bin.fit_mm.hypot(bin.toe_mm).hypot(bin.local_mm));
                total += 1;
            }
        }
        let share = inside as f64 / f64::from(total);
        assert!(share > 0.88, "{share} of the errors lie in their intervals");
    }

    #[test]
    fn shots_join_in_one_profile_and_each_keeps_its_reference() {
        let (_, alone) = measured(&[EXAMPLE]);
        let (_, twice) = measured(&[EXAMPLE, Example { seed: 7, ..EXAMPLE }]);
        assert_eq!(alone.profile.len(), twice.profile.len());
        assert!(largest_error(&twice, &EXAMPLE) < STEP_TOLERANCE_MM);
        assert_eq!(twice.deviation_mm.len(), 2);
    }

    #[test]
    fn the_same_bits_on_any_number_of_threads() {
        let mut seen = Vec::new();
        for n in [1, 2, 8] {
            threads::set_threads(Some(n)).unwrap();
            let (_, step) = measured(&[EXAMPLE]);
            seen.push((step.mean_mm.to_bits(), step.expanded_mm.to_bits(), step.profile));
        }
        threads::set_threads(None).unwrap();
        assert!(seen.windows(2).all(|w| w[0] == w[1]));
    }

    #[test]
    fn one_wall_or_none_is_refused() {
        let e = EXAMPLE;
        let mut s = segment(&e.points(), COLUMNS, &e.nominal()).unwrap();
        assert!(matches!(measure(&[], &Known::default()), Err(Error::TooFew { .. })));
        s.labels.iter_mut().filter(|l| **l == Label::OtherWall as u8).for_each(|l| *l = 0);
        assert!(matches!(measure(&[shot(&s)], &Known::default()), Err(Error::TooFew { .. })));
    }
}
