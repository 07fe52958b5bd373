//! Generalised least squares of the walls, and the choice of the terms that the data ask for.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::cells::Cell;
use super::model::{Model, Terms, second_order};
use super::unevenness::Whitener;
use crate::error::{Error, Result, require_count};
use crate::ground::threads;

/// Beyond this degree a polynomial over one shot's arc describes dents, which the departure of single bins does better.
const MAX_SHAPE_DEGREE: usize = 8;
/// Amplitude of a weld's shrinkage, one sigma; half a millimetre is the most.
const SHRINKAGE_MM: f64 = 0.25;

/// A least-squares solution.
pub(super) struct Solution {
    pub(super) parameters: DVector<f64>,
    /// Covariance of the parameters.
    pub(super) covariance: DMatrix<f64>,
    pub(super) residuals: Vec<f64>,
}

/// Generalised least squares: rows and heights are whitened first.
pub(super) fn solve(model: &Model, cells: &[Cell], whitener: &Whitener) -> Result<Solution> {
    let degenerate = |reason: &str| Error::Degenerate { what: "step", reason: reason.into() };
    let columns = model.columns();
    require_count("cells of the walls", columns + 1, cells.len())?;
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
    let heights = DVector::from_iterator(cells.len(), cells.iter().map(|c| c.height));
    // The second-order term of h depends on the answer: three rounds leave 1e-9 mm.
    let mut parameters = DVector::zeros(columns);
    let mut bent = heights.clone();
    for _ in 0..3 {
        let mut white = bent.clone();
        whitener.apply(white.as_mut_slice());
        let white = white.insert_rows(cells.len(), shells.len(), 0.0);
        parameters = &inverse * (q.tr_mul(&white));
        for (i, cell) in cells.iter().enumerate() {
            bent[i] =
                heights[i] + if cell.other { second_order(model, &parameters, cell.at, cell.across) } else { 0.0 };
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

/// Adds groups of terms to the plain offset as long as Schwarz's criterion falls.
pub(super) fn choose<'a>(model: &impl Fn(Terms) -> Model<'a>, cells: &[Cell], whitener: &Whitener) -> Result<Terms> {
    let count = cells.len() as f64;
    let mut terms = Terms { curvature: false, tilt: false, shape: 2, shell: false };
    let full = model(Terms { curvature: true, tilt: true, shape: MAX_SHAPE_DEGREE, shell: true });
    let normal = Normal::of(&full, cells, whitener, &solve(&model(terms), cells, whitener)?.residuals);
    let criterion = |terms: Terms| -> Option<f64> {
        let columns = full.columns_with(terms);
        let cost = normal.cost(&columns)?;
        Some(count * (cost / count).max(f64::MIN_POSITIVE).ln() + columns.len() as f64 * count.ln())
    };
    let mut best = criterion(terms).unwrap_or(f64::INFINITY);
    loop {
        let mut candidates =
            vec![Terms { curvature: true, ..terms }, Terms { tilt: true, ..terms }, Terms { shell: true, ..terms }];
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
        let starts: Vec<usize> = (0..=model.stretches.len()).map(|k| cells.partition_point(|c| c.shot < k)).collect();
        let shots: Vec<usize> = (0..model.stretches.len()).collect();
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
