//! The model of the walls: which terms it has, and its rows.

use nalgebra::DVector;

use super::cells::{Arc, Cell, LabelledShot};
use crate::ground::threads;
use crate::weld::sections::shell_term;

/// Places around an arc at which the reference wall's correction is tabulated: it is smooth, and linear in between to
/// 1e-8 of its size.
const TABLE: usize = 4096;

/// Which terms a model has.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Terms {
    pub(super) radius: bool,
    pub(super) tilt: bool,
    /// Highest Legendre degree of the walls' own shape; 2 means none.
    pub(super) shape: usize,
    /// What the weld drew each wall in, see [`crate::weld::sections`].
    pub(super) shell: bool,
}

impl Terms {
    /// With the terms that every pipe may have, needed or not.
    pub(super) fn widened(self) -> Self {
        Self { radius: true, tilt: true, ..self }
    }
}

pub(super) struct Model<'a> {
    pub(super) arcs: &'a [Arc],
    pub(super) terms: Terms,
    /// Axial unit, so that all columns have the same size.
    pub(super) scale_mm: f64,
    /// Of the nominal wall: the shell term's length comes from it.
    pub(super) thickness_mm: f64,
}

pub(super) const CYLINDER: usize = 5;

impl Model<'_> {
    fn shapes(&self) -> usize {
        self.terms.shape - 2
    }

    pub(super) fn step_columns(&self) -> usize {
        2 + usize::from(self.terms.radius) + 2 * usize::from(self.terms.tilt) + self.arcs.len() * self.shapes()
    }

    fn shells(&self) -> usize {
        if self.terms.shell { 2 } else { 0 }
    }

    /// The columns of the walls' shrinkage.
    pub(super) fn shell_columns(&self) -> std::ops::Range<usize> {
        let first = self.arcs.len() * (CYLINDER + self.shapes());
        first..first + self.shells()
    }

    pub(super) fn columns(&self) -> usize {
        self.arcs.len() * (CYLINDER + self.shapes()) + self.shells() + self.step_columns()
    }

    /// The columns that are not zero in the rows of a shot.
    pub(super) fn columns_of_shot(&self, shot: usize) -> Vec<usize> {
        let width = CYLINDER + self.shapes();
        let common = self.arcs.len() * width;
        let shapes = self.columns() - (self.arcs.len() - shot) * self.shapes();
        let mut own: Vec<usize> = (shot * width..(shot + 1) * width).collect();
        own.extend(common..self.columns() - self.arcs.len() * self.shapes());
        own.extend(shapes..shapes + self.shapes());
        own
    }

    /// The columns of a plainer model among those of this one, which has all terms.
    pub(super) fn columns_with(&self, terms: Terms) -> Vec<usize> {
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
    pub(super) fn step_row(&self, shot: Option<usize>, angle: f64, axial: f64, row: &mut [f64]) {
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

    pub(super) fn row(&self, cell: &Cell) -> Vec<f64> {
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
pub(super) fn bow(turn: f64, half: f64) -> f64 {
    ((turn / 2.0).sin() / (half / 2.0).sin().max(1e-9)).powi(2)
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

/// `(e × n)² / 2R`: how far a cylinder that is off its axis falls short of `e·n`.
pub(super) fn second_order(model: &Model, parameters: &DVector<f64>, angle: f64, axial: f64) -> f64 {
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

/// Every point's deviation from the corrected reference wall.
pub(super) fn corrected(model: &Model, parameters: &DVector<f64>, shot: usize, points: &LabelledShot) -> Vec<f32> {
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
