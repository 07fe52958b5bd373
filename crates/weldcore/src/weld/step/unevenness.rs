//! The walls' own unevenness: its covariance, and least squares that know of it.

use rayon::prelude::*;

use super::cells::{Cell, Stretch};
use crate::ground::robust::{MEDIAN_TO_SIGMA, median};
use crate::ground::stop::{poll, polled};
use crate::ground::threads;

/// What walls depart from their model as a rule, before it is known of these.
const USUAL_UNEVENNESS_MM: f64 = 0.02;

/// The covariance of what a fit leaves: a nugget, and a part correlated over a support along and across the seam.
#[derive(Debug, Clone, Copy)]
pub(super) struct Covariance {
    pub(super) nugget: f64,
    pub(super) sill: f64,
    /// Distance at which the correlation ends: along and across the seam.
    pub(super) support_mm: [f64; 2],
}

/// Wendland's positive definite function of support 1, smooth at 0 as a Gaussian is.
pub(crate) fn wendland(r: f64) -> f64 {
    if r < 1.0 { (1.0 - r).powi(4) * (4.0 * r + 1.0) } else { 0.0 }
}

/// Lags of the empirical covariance, in cells.
pub(super) const LAGS: usize = 16;

/// Distance of two cells of one shot along and across the seam.
pub(super) fn apart_mm(stretches: &[Stretch], a: &Cell, b: &Cell) -> [f64; 2] {
    let stretch = &stretches[a.shot];
    [stretch.course.along_mm(stretch.local(a.at) - stretch.local(b.at)).abs(), (a.across - b.across).abs()]
}

/// Whether unevenness may be common to two cells: they are of one wall in one shot.
pub(super) fn related(a: &Cell, b: &Cell) -> bool {
    a.shot == b.shot && a.other == b.other
}

impl Covariance {
    /// From the residuals: products of pairs, averaged by their lag along and across the seam.
    pub(super) fn of(stretches: &[Stretch], cells: &[Cell], residuals: &[f64], cell_mm: f64) -> Self {
        // A dent is not unevenness: it must not hide itself by raising what counts as usual.
        let mut sizes: Vec<f64> = residuals.iter().map(|r| r.abs()).collect();
        let limit = 3.0 * MEDIAN_TO_SIGMA * median(&mut sizes);
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
                            let d = apart_mm(stretches, &cells[i], &cells[j]);
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
        let (along, across) = (seen(0), seen(1));
        // The sill from the way in which the correlation reaches further.
        let sill = [&along, &across].map(|lags| fitted_support(lags, cell_mm, None).1);
        let sill = sill[0].max(sill[1]).clamp(0.0, variance);
        let support_mm = [&along, &across].map(|lags| fitted_support(lags, cell_mm, Some(sill)).0);
        // A hundredth at least stays uncorrelated, which keeps the whitening stable.
        Self { nugget: (variance - sill).max(0.01 * variance).max(f64::MIN_POSITIVE), sill, support_mm }
    }

    /// Between two cells.
    fn between(&self, stretches: &[Stretch], a: &Cell, b: &Cell) -> f64 {
        if !related(a, b) {
            return 0.0;
        }
        let d = apart_mm(stretches, a, b);
        self.sill * wendland((d[0] / self.support_mm[0]).hypot(d[1] / self.support_mm[1]))
    }

    /// Variance of a weighted sum of cells.
    pub(super) fn variance_of(&self, stretches: &[Stretch], terms: &[(Cell, f64)]) -> f64 {
        let row = |(a, w): &(Cell, f64)| {
            let pairs: f64 = terms.iter().map(|(b, v)| v * self.between(stretches, a, b)).sum();
            w * (pairs + w * self.nugget)
        };
        terms.iter().map(row).sum::<f64>().max(0.0)
    }
}

/// The support, and the sill where it is not given, that fit an empirical covariance best; (one cell, 0) for none.
pub(super) fn fitted_support(lags: &[(f64, f64)], cell_mm: f64, sill: Option<f64>) -> (f64, f64) {
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
/// correlated, and in their order along the seam that leaves a narrow band.
pub(super) struct Whitener {
    pub(super) rows: Vec<(usize, Vec<f64>)>,
    /// What a whitened residual of usual size is: 1 where the covariance is known, else a length.
    pub(super) unit_mm: f64,
}

impl Whitener {
    pub(super) fn identity(cells: usize) -> Self {
        Self { rows: (0..cells).map(|i| (i, vec![1.0])).collect(), unit_mm: USUAL_UNEVENNESS_MM }
    }

    pub(super) fn of(stretches: &[Stretch], cells: &[Cell], covariance: &Covariance) -> Self {
        let mut rows: Vec<(usize, Vec<f64>)> = Vec::with_capacity(cells.len());
        for (i, cell) in cells.iter().enumerate() {
            poll();
            let wall = cells[..i].iter().rev().take_while(|c| related(cell, c)).count();
            let near = |j: &usize| apart_mm(stretches, cell, &cells[*j])[0] < covariance.support_mm[0];
            let first = (i - wall..i).find(near).unwrap_or(i);
            let mut row: Vec<f64> = (first..i).map(|j| covariance.between(stretches, cell, &cells[j])).collect();
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
    pub(super) fn apply(&self, x: &mut [f64]) {
        self.apply_from(0, x);
    }

    /// The same for the cells from `start` on; a shot's depend on none before it.
    pub(super) fn apply_from(&self, start: usize, x: &mut [f64]) {
        for i in 0..x.len() {
            let (first, row) = &self.rows[start + i];
            let last = row.len() - 1;
            let sum: f64 = row[..last].iter().zip(&x[first - start..i]).map(|(a, b)| a * b).sum();
            x[i] = (x[i] - sum) / row[last];
        }
    }

    /// How many independent cells tell as much of a wall's height as the correlated ones do, given their variance.
    pub(super) fn effective_count(&self, variance: f64) -> f64 {
        let mut ones = vec![1.0; self.rows.len()];
        self.apply(&mut ones);
        variance * ones.iter().map(|v| v * v).sum::<f64>()
    }
}
