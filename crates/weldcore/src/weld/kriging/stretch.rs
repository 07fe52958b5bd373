//! A shot by itself, as the search for the walls' scales sees it: its own line, some of its rows, and of the border what its cells
//! tell.
//!
//! Over the few degrees that a shot sees, most combinations of the border's unknowns do not show: of 45, some 15 do. All have a
//! prior of 1, so that turning them into the eigenvectors of what the cells say changes nothing, and those of no information may
//! be left out: they add nothing to the likelihood of any scales.

use nalgebra::DMatrix;

use super::border::BorderColumns;
use super::wall::{Cell, KrigedWall, SeamLine, Width};

/// Information, in units of the prior's, below which the cells are silent.
const SILENT: f64 = 1e-3;

/// Of more rows than this some are left out, for the work grows with their cube: those kept stand further and further apart, from
/// the seam on, so that short waves show between the first ones and long waves between all.
const ROWS: usize = 9;

/// Both walls of one shot.
#[derive(Debug, Clone)]
pub(crate) struct Stretch {
    pub(super) line: SeamLine,
    pub(super) walls: [KrigedWall; 2],
}

impl Stretch {
    /// Of walls, on an open line, whose columns are sums of `size` unknowns.
    pub fn new(line: SeamLine, walls: [&KrigedWall; 2], columns: [&BorderColumns; 2], size: usize) -> Self {
        let thinned: [(Vec<f64>, Vec<bool>); 2] = walls.map(thinned);
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
        // BorderColumns that no cell lies in tell nothing: only every so many are kept.
        let used: Vec<usize> = walls.iter().flat_map(|w| w.cells().iter().map(|c| c.column)).collect();
        let (first, last) = used.iter().fold((usize::MAX, 0), |(low, high), c| (low.min(*c), high.max(*c)));
        let apart = used.iter().fold(0, |apart, c| common_divisor(apart, c - first)).max(1);
        let line = match used.len() {
            0 => line,
            _ => SeamLine { columns: (last - first) / apart + 1, spacing_mm: line.spacing_mm * apart as f64, ..line },
        };
        let width = Width { common: kept.len(), of_a_shot: 0, shots: 1 };
        let walls = std::array::from_fn(|k| {
            let (rows_mm, held) = &thinned[k];
            let mut of_held = whole[k].chunks_exact(size).zip(held).filter(|(_, held)| **held).map(|(row, _)| row);
            let turned = |_: &Cell, out: &mut [f64]| {
                let Some(row) = of_held.next() else { return };
                for (slot, c) in out.iter_mut().zip(&kept) {
                    *slot = row.iter().zip(eigen.eigenvectors.column(*c).iter()).map(|(a, b)| a * b).sum();
                }
            };
            let cells = walls[k].cells().iter().zip(held).filter(|(_, held)| **held);
            let cells = cells.map(|(cell, _)| Cell { column: (cell.column - first) / apart, ..*cell }).collect();
            KrigedWall::new(cells, width, rows_mm.clone(), turned)
        });
        Self { line, walls }
    }

    /// How many cells it has.
    pub fn count(&self) -> usize {
        self.walls.iter().map(KrigedWall::count).sum()
    }
}

fn common_divisor(a: usize, b: usize) -> usize {
    if b == 0 { a } else { common_divisor(b, a % b) }
}

/// A wall's rows of all unknowns, cell by cell.
fn whole_rows(wall: &KrigedWall, columns: &BorderColumns, size: usize) -> Vec<f64> {
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

/// The rows that carry a wall's unevenness, where there are cells, and whether each cell lies in one of them.
fn thinned(wall: &KrigedWall) -> (Vec<f64>, Vec<bool>) {
    let rows = wall.rows_mm();
    let nearest = |cell: &Cell| {
        let off = |k: &usize| (rows[*k] - cell.across_mm).abs();
        (0..rows.len()).min_by(|a, b| off(a).total_cmp(&off(b))).unwrap_or(0)
    };
    let row_of: Vec<usize> = wall.cells().iter().map(nearest).collect();
    let mut used = row_of.clone();
    used.sort_unstable();
    used.dedup();
    used.sort_by(|a, b| rows[*a].abs().total_cmp(&rows[*b].abs()));
    // 0, 1, 2, 4, 6, 9, 12, 16, ...
    let apart = |n: usize| if used.len() > ROWS { (n + 1) * (n + 1) / 4 } else { n };
    let mut kept: Vec<usize> = (0..).map(apart).map_while(|n| used.get(n)).copied().collect();
    kept.sort_unstable();
    let held = row_of.iter().map(|row| kept.binary_search(row).is_ok()).collect();
    (kept.iter().map(|k| rows[*k]).collect(), held)
}
