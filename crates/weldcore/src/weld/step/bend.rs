//! How a scanner's calibration may bend the space that a shot saw: so many modes of unit variance, common to all its shots.
//!
//! A mode is how far it moves points along the surface's normal, known at some of the shot's points; over the view it is smooth, a
//! polynomial of place along and across. As columns of the border the modes are solved for with everything else: straight walls
//! calibrate the scanner, and what is left of the modes is in the step's covariance.

use nalgebra::DMatrix;

use super::view::{LabelledShot, Modes, SeamView};
use crate::error::{Error, Result, require_count};

/// Of the polynomial: a lens' fifth-order distortion over a view.
const DEGREE: usize = 5;
const TERMS: usize = (DEGREE + 1) * (DEGREE + 2) / 2;

/// The modes of one shot, over its view.
#[derive(Debug, Clone)]
pub(super) struct Bend {
    middle: f64,
    half: f64,
    reach_mm: f64,
    /// A row of terms for each mode.
    coefficients: Vec<f64>,
}

impl Bend {
    /// # Errors
    /// [`Error::Shape`] where points and rows do not agree, [`Error::TooFew`] where the points do not tell a polynomial.
    pub fn of(shot: &LabelledShot, view: &SeamView) -> Result<Option<Self>> {
        let Some(Modes { points, deviation_mm, count }) = shot.modes else { return Ok(None) };
        let known = points.len();
        if deviation_mm.len() != known * count || points.iter().any(|&i| i >= shot.labels.len()) {
            let (expected, got) = (format!("{known} points of the shot, {count} modes each"), "others".into());
            return Err(Error::Shape { what: "calibration modes", expected, got });
        }
        require_count("points with calibration modes", 3 * TERMS, known)?;
        let mut bend = Self { middle: view.middle, half: view.half, reach_mm: 1.0, coefficients: Vec::new() };
        let places: Vec<[f64; 3]> = points.iter().map(|&i| view.placed(shot.unrolled, i)).collect();
        bend.reach_mm = places.iter().fold(1.0, |most, p| f64::max(most, p[1].abs()));
        let rows: Vec<[f64; TERMS]> =
            places.iter().map(|[at, across, _]| bend.terms(view.course.apart(*at, bend.middle), *across)).collect();
        let x = DMatrix::from_fn(known, TERMS, |i, j| rows[i][j]);
        let y = DMatrix::from_row_slice(known, count, deviation_mm);
        let degenerate =
            |_| Error::Degenerate { what: "step", reason: "calibration modes: their points lie badly".into() };
        let found = x.svd(true, true).solve(&y, 1e-9).map_err(degenerate)?;
        bend.coefficients = (0..count).flat_map(|m| (0..TERMS).map(|t| found[(t, m)]).collect::<Vec<f64>>()).collect();
        Ok(Some(bend))
    }

    pub fn count(&self) -> usize {
        self.coefficients.len() / TERMS
    }

    /// Where the polynomials are counted from.
    pub fn middle(&self) -> f64 {
        self.middle
    }

    /// Every mode at a place: along from the middle, in the seam's parameter, and across.
    pub fn at(&self, apart: f64, across_mm: f64, out: &mut [f64]) {
        let terms = self.terms(apart, across_mm);
        for (slot, row) in out.iter_mut().zip(self.coefficients.chunks_exact(TERMS)) {
            *slot = row.iter().zip(&terms).map(|(c, t)| c * t).sum();
        }
    }

    fn terms(&self, apart: f64, across_mm: f64) -> [f64; TERMS] {
        let (a, z) = (apart / self.half, across_mm / self.reach_mm);
        let (mut powers_a, mut powers_z) = ([1.0; DEGREE + 1], [1.0; DEGREE + 1]);
        for k in 1..=DEGREE {
            (powers_a[k], powers_z[k]) = (a * powers_a[k - 1], z * powers_z[k - 1]);
        }
        let mut out = [0.0; TERMS];
        let pairs = (0..=DEGREE).flat_map(|i| (0..=DEGREE - i).map(move |j| (i, j)));
        out.iter_mut().zip(pairs).for_each(|(slot, (i, j))| *slot = powers_a[i] * powers_z[j]);
        out
    }
}
