//! The model of the walls: which terms it has, and its rows.

use nalgebra::DVector;

use super::cells::{Cell, LabelledShot, Stretch};
use crate::ground::threads;
use crate::weld::seam::Course;
use crate::weld::sections::shell_term;

/// Places along a stretch at which the reference wall's correction is tabulated: it is smooth, and linear in between to
/// 1e-8 of its size.
const TABLE: usize = 4096;

/// Which terms a model has.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Terms {
    /// A difference of the walls' own curvature along the seam: of their radii.
    pub(super) curvature: bool,
    pub(super) tilt: bool,
    /// Highest Legendre degree of the walls' own shape; 2 means none.
    pub(super) shape: usize,
    /// What the weld drew each wall in, see [`crate::weld::sections`].
    pub(super) shell: bool,
}

impl Terms {
    /// With the terms that every part may have, needed or not.
    pub(super) fn widened(self) -> Self {
        Self { curvature: true, tilt: true, ..self }
    }
}

pub(super) struct Model<'a> {
    /// How the seam runs: the mean of the shots'.
    pub(super) course: Course,
    pub(super) stretches: &'a [Stretch],
    pub(super) terms: Terms,
    /// Unit across the seam, so that all columns have the same size.
    pub(super) scale_mm: f64,
    /// Of the nominal wall: the shell term's length comes from it.
    pub(super) thickness_mm: f64,
}

/// Columns of a wall's own surface: its size, place and direction.
pub(super) const SURFACE: usize = 5;

impl Model<'_> {
    fn shapes(&self) -> usize {
        self.terms.shape - 2
    }

    pub(super) fn step_columns(&self) -> usize {
        2 + usize::from(self.terms.curvature) + 2 * usize::from(self.terms.tilt) + self.stretches.len() * self.shapes()
    }

    fn shells(&self) -> usize {
        if self.terms.shell { 2 } else { 0 }
    }

    /// The columns of the walls' shrinkage.
    pub(super) fn shell_columns(&self) -> std::ops::Range<usize> {
        let first = self.stretches.len() * (SURFACE + self.shapes());
        first..first + self.shells()
    }

    pub(super) fn columns(&self) -> usize {
        self.stretches.len() * (SURFACE + self.shapes()) + self.shells() + self.step_columns()
    }

    /// The columns that are not zero in the rows of a shot.
    pub(super) fn columns_of_shot(&self, shot: usize) -> Vec<usize> {
        let width = SURFACE + self.shapes();
        let common = self.stretches.len() * width;
        let shapes = self.columns() - (self.stretches.len() - shot) * self.shapes();
        let mut own: Vec<usize> = (shot * width..(shot + 1) * width).collect();
        own.extend(common..self.columns() - self.stretches.len() * self.shapes());
        own.extend(shapes..shapes + self.shapes());
        own
    }

    /// The columns of a plainer model among those of this one, which has all terms.
    pub(super) fn columns_with(&self, terms: Terms) -> Vec<usize> {
        let (shots, width, kept) = (self.stretches.len(), SURFACE + self.shapes(), terms.shape - 2);
        let mut columns: Vec<usize> = (0..shots).flat_map(|k| k * width..k * width + SURFACE + kept).collect();
        let shells = shots * width;
        let step = shells + self.shells();
        columns.extend((shells..step).filter(|_| terms.shell));
        columns.extend(step..step + 2);
        columns.extend((step + 2..step + 3).filter(|_| terms.curvature));
        columns.extend((step + 3..step + 5).filter(|_| terms.tilt));
        let shapes = step + 5;
        columns.extend((0..shots).flat_map(|k| shapes + k * self.shapes()..shapes + k * self.shapes() + kept));
        columns
    }

    /// The row of the reference wall's correction, into its columns of `row`.
    fn reference_row(&self, shot: usize, at: f64, across_mm: f64, row: &mut [f64]) {
        let stretch = &self.stretches[shot];
        let local = stretch.local(at);
        let [a, b] = stretch.course.offset(local);
        let [one, lean, bow] = stretch.course.stretch_columns(local, stretch.half);
        let z = across_mm / self.scale_mm;
        let width = SURFACE + self.shapes();
        let own = &mut row[shot * width..(shot + 1) * width];
        own[..SURFACE].copy_from_slice(&[one, lean, bow, z * a, z * b]);
        legendre(local / stretch.half, &mut own[SURFACE..]);
    }

    /// The row of h, into its columns.
    pub(super) fn step_row(&self, shot: Option<usize>, at: f64, across_mm: f64, row: &mut [f64]) {
        let [a, b] = self.course.offset(at);
        let z = across_mm / self.scale_mm;
        let own = &mut row[self.stretches.len() * (SURFACE + self.shapes()) + self.shells()..];
        own[..2].copy_from_slice(&[a, b]);
        let mut next = 2;
        if self.terms.curvature {
            own[next] = self.course.curvature(at);
            next += 1;
        }
        if self.terms.tilt {
            own[next..next + 2].copy_from_slice(&[z * a, z * b]);
            next += 2;
        }
        if let Some(shot) = shot {
            let (stretch, shapes) = (&self.stretches[shot], self.shapes());
            let first = next + shot * shapes;
            legendre(stretch.local(at) / stretch.half, &mut own[first..first + shapes]);
        }
    }

    pub(super) fn row(&self, cell: &Cell) -> Vec<f64> {
        let mut row = vec![0.0; self.columns()];
        self.reference_row(cell.shot, cell.at, cell.across, &mut row);
        if self.terms.shell {
            let at = self.shell_columns().start + usize::from(cell.other);
            row[at] = shell_term(cell.across, self.stretches[cell.shot].course.shell_mm(self.thickness_mm));
        }
        if cell.other {
            self.step_row(Some(cell.shot), cell.at, cell.across, &mut row);
        }
        row
    }
}

/// Legendre polynomials of degree 3, 4, ...
pub(super) fn legendre(x: f64, out: &mut [f64]) {
    let (mut before, mut last) = (x, 1.5 * x * x - 0.5);
    for (k, slot) in out.iter_mut().enumerate() {
        let n = (k + 3) as f64;
        let next = ((2.0 * n - 1.0) * x * last - (n - 1.0) * before) / n;
        (before, last) = (last, next);
        *slot = next;
    }
}

/// How far the step falls short of what is linear in the offset.
pub(super) fn second_order(model: &Model, parameters: &DVector<f64>, at: f64, across_mm: f64) -> f64 {
    let p = &parameters.as_slice()[parameters.len() - model.step_columns()..];
    let z = across_mm / model.scale_mm;
    let tilt_at = 2 + usize::from(model.terms.curvature);
    let (tx, ty) = if model.terms.tilt { (p[tilt_at] * z, p[tilt_at + 1] * z) } else { (0.0, 0.0) };
    model.course.second_order([p[0] + tx, p[1] + ty], at)
}

/// Every point's deviation from the corrected reference wall.
pub(super) fn corrected(model: &Model, parameters: &DVector<f64>, shot: usize, points: &LabelledShot) -> Vec<f32> {
    let width = SURFACE + model.shapes();
    let own = &parameters.as_slice()[shot * width..(shot + 1) * width];
    let stretch = &model.stretches[shot];
    // The correction is f(along) + across · g(along).
    let table: Vec<[f64; 2]> = (0..=TABLE)
        .map(|k| {
            let at = stretch.middle + stretch.half * (2.0 * k as f64 / TABLE as f64 - 1.0);
            let correction = |across_mm: f64| {
                let mut row = vec![0.0; model.columns()];
                model.reference_row(shot, at, across_mm, &mut row);
                row[shot * width..(shot + 1) * width].iter().zip(own).map(|(a, b)| a * b).sum::<f64>()
            };
            [correction(0.0), correction(1.0) - correction(0.0)]
        })
        .collect();
    threads::map_ranges(points.labels.len(), |range| {
        let one = |i: usize| {
            let place = (stretch.local(f64::from(points.unrolled.at[i])) / stretch.half + 1.0) / 2.0 * TABLE as f64;
            // Beyond the walls' stretch (nothing of the weld is there) the correction is that of its end.
            let place = place.clamp(0.0, TABLE as f64 - 1e-9);
            let (k, part) = (place as usize, place.fract());
            let blend = |c: usize| table[k][c] + part * (table[k + 1][c] - table[k][c]);
            (f64::from(points.unrolled.height_mm[i]) - blend(0) - f64::from(points.unrolled.across_mm[i]) * blend(1))
                as f32
        };
        range.map(one).collect::<Vec<f32>>()
    })
    .concat()
}
