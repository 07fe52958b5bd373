//! A shot by itself, as the search for the walls' scales sees it: its own line, and of the border what its cells tell.
//!
//! Over the few degrees that a shot sees, most combinations of the border's unknowns do not show: of 45, some 15 do. All have a
//! prior of 1, so that turning them into the eigenvectors of what the cells say changes nothing, and those of no information may
//! be left out: they add nothing to the likelihood of any scales.

use nalgebra::DMatrix;

use super::border::Columns;
use super::wall::{Cell, Line, Wall, Width};

/// Information, in units of the prior's, below which the cells are silent.
const SILENT: f64 = 1e-3;

/// Both walls of one shot.
#[derive(Debug, Clone)]
pub(crate) struct Stretch {
    pub(super) line: Line,
    pub(super) walls: [Wall; 2],
    /// Of both walls: unknown for unknown.
    pub(super) columns: Columns,
}

impl Stretch {
    /// Of walls whose columns are sums of `size` unknowns.
    pub fn new(line: Line, walls: [&Wall; 2], columns: [&Columns; 2], size: usize) -> Self {
        let whole: [Vec<f64>; 2] = std::array::from_fn(|k| whole_rows(walls[k], columns[k], size));
        let mut told = DMatrix::<f64>::zeros(size, size);
        for (wall, rows) in walls.iter().zip(&whole) {
            for (cell, row) in wall.cells().iter().zip(rows.chunks_exact(size)) {
                for i in 0..size {
                    let scaled = cell.weight * row[i];
                    (i..size).for_each(|j| told[(j, i)] += scaled * row[j]);
                }
            }
        }
        told.fill_upper_triangle_with_lower_triangle();
        let eigen = told.symmetric_eigen();
        let mut kept: Vec<usize> = (0..size).filter(|k| eigen.eigenvalues[*k] > SILENT).collect();
        kept.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
        let width = Width { common: kept.len(), of_a_shot: 0, shots: 1 };
        let walls = std::array::from_fn(|k| {
            let next = std::cell::Cell::new(0);
            let turned = |_: &Cell, out: &mut [f64]| {
                let row = &whole[k][next.get() * size..][..size];
                next.set(next.get() + 1);
                for (slot, c) in out.iter_mut().zip(&kept) {
                    *slot = row.iter().zip(eigen.eigenvectors.column(*c).iter()).map(|(a, b)| a * b).sum();
                }
            };
            Wall::new(walls[k].cells().to_vec(), width, carrying_rows(walls[k]), turned)
        });
        Self { line, walls, columns: (0..kept.len()).map(|k| vec![k]).collect() }
    }

    /// How many cells it has.
    pub fn count(&self) -> usize {
        self.walls.iter().map(Wall::count).sum()
    }
}

/// A wall's rows of all unknowns, cell by cell.
fn whole_rows(wall: &Wall, columns: &Columns, size: usize) -> Vec<f64> {
    let width = wall.width();
    let mut whole = vec![0.0; wall.count() * size];
    for ((cell, own), row) in wall.cells().iter().zip(wall.rows()).zip(whole.chunks_exact_mut(size.max(1))) {
        for (k, value) in own.iter().enumerate() {
            let column = if k < width.common { k } else { width.of_shot(cell.shot) + k - width.common };
            columns[column].iter().for_each(|&p| row[p] += value);
        }
    }
    whole
}

/// The rows that lie where there are cells: nothing is asked elsewhere.
fn carrying_rows(wall: &Wall) -> Vec<f64> {
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for cell in wall.cells() {
        (low, high) = (low.min(cell.across_mm), high.max(cell.across_mm));
    }
    let mut rows: Vec<f64> = wall.rows_mm().to_vec();
    rows.sort_by(f64::total_cmp);
    let apart = rows.windows(2).map(|w| w[1] - w[0]).fold(0.0, f64::max);
    rows.retain(|r| (low - apart..=high + apart).contains(r));
    rows
}
