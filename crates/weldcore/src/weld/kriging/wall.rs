//! What is known of one wall: its cells, column by column along the seam, with their rows of the border.

use super::chain::{ColumnChain, Two};

/// The columns along the seam.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct SeamLine {
    pub columns: usize,
    pub spacing_mm: f64,
    /// Whether the last column is followed by the first; their number is even then.
    pub closed: bool,
}

impl SeamLine {
    /// What is eliminated together: a column; around a closed seam one from either end, which keeps every block beside the next.
    pub(super) fn blocks(&self) -> impl Iterator<Item = Vec<usize>> {
        let Self { columns, closed, .. } = *self;
        let count = if closed { columns / 2 } else { columns };
        (0..count).map(move |s| if closed { vec![s, columns - 1 - s] } else { vec![s] })
    }

    /// A column's own block of the chain's precision.
    pub(super) fn own(&self, chain: &ColumnChain, column: usize) -> Two {
        if self.closed {
            chain.inner
        } else if self.columns == 1 {
            [[1.0, 0.0], [0.0, 1.0]]
        } else if column == 0 {
            chain.first
        } else if column + 1 == self.columns {
            chain.last
        } else {
            chain.inner
        }
    }

    /// Distance between two columns, the short way.
    pub(crate) fn apart_mm(&self, one: usize, other: usize) -> f64 {
        let apart = one.abs_diff(other);
        let apart = if self.closed { apart.min(self.columns - apart) } else { apart };
        apart as f64 * self.spacing_mm
    }
}

/// The mean of some of a wall's points.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Cell {
    pub column: usize,
    /// Along the seam from the middle of its column.
    pub along_mm: f64,
    /// Across the seam from its centreline.
    pub across_mm: f64,
    pub height_mm: f64,
    /// One over the variance of its height, as the scatter of its points has it.
    pub weight: f64,
    pub shot: usize,
}

/// The border's columns as one wall has them: those common to all shots, then so many for every shot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Width {
    pub common: usize,
    pub of_a_shot: usize,
    pub shots: usize,
}

impl Width {
    pub fn total(self) -> usize {
        self.common + self.of_a_shot * self.shots
    }

    /// Where a shot's own columns begin.
    pub fn of_shot(self, shot: usize) -> usize {
        self.common + self.of_a_shot * shot
    }
}

/// One wall: its cells in the order of their columns, and what of the sums over them does not depend on its unevenness.
#[derive(Debug, Clone)]
pub(crate) struct KrigedWall {
    pub(super) cells: Vec<Cell>,
    /// A row per cell: the common columns, then those of the cell's own shot. Every column in units of its prior.
    pub(super) rows: Vec<f64>,
    pub(super) width: Width,
    /// Across the seam: places that carry the unevenness, the seam among them.
    pub(super) rows_mm: Vec<f64>,
    /// `XᵀWX`, `XᵀWy`, `yᵀWy` and `Σ log w` of weights as the cells have them.
    pub(super) information: Vec<f64>,
    pub(super) right: Vec<f64>,
    pub(super) square: f64,
    pub(super) log_weights: f64,
}

impl KrigedWall {
    /// A wall of these cells; `row_of` writes a cell's row of the border.
    pub fn new(
        mut cells: Vec<Cell>,
        width: Width,
        rows_mm: Vec<f64>,
        mut row_of: impl FnMut(&Cell, &mut [f64]),
    ) -> Self {
        cells.sort_by_key(|c| c.column);
        let (n, total) = (width.common + width.of_a_shot, width.total());
        let mut rows = vec![0.0; cells.len() * n];
        let (mut information, mut right) = (vec![0.0; total * total], vec![0.0; total]);
        let (mut square, mut log_weights) = (0.0, 0.0);
        for (cell, row) in cells.iter().zip(rows.chunks_exact_mut(n.max(1))) {
            row_of(cell, row);
            let at = |k: usize| if k < width.common { k } else { width.of_shot(cell.shot) + k - width.common };
            for i in 0..n {
                let scaled = cell.weight * row[i];
                for j in i..n {
                    information[at(i) * total + at(j)] += scaled * row[j];
                }
                right[at(i)] += scaled * cell.height_mm;
            }
            square += cell.weight * cell.height_mm * cell.height_mm;
            log_weights += cell.weight.ln();
        }
        Self { cells, rows, width, rows_mm, information, right, square, log_weights }
    }

    pub fn count(&self) -> usize {
        self.cells.len()
    }

    pub fn cells(&self) -> &[Cell] {
        &self.cells
    }

    pub fn width(&self) -> Width {
        self.width
    }

    /// The border's rows, cell by cell: the common columns, then those of its shot.
    pub fn rows(&self) -> impl Iterator<Item = &[f64]> {
        self.rows.chunks_exact((self.width.common + self.width.of_a_shot).max(1))
    }

    pub fn rows_mm(&self) -> &[f64] {
        &self.rows_mm
    }
}

/// What a wall's unevenness and noise are like.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Scales {
    /// Standard deviation of the unevenness.
    pub sd_mm: f64,
    /// How far it reaches along and across the seam.
    pub along_mm: f64,
    pub across_mm: f64,
    /// Variance of a cell over what its points' scatter makes of it.
    pub noise: f64,
}

/// Unevenness that reaches less far along the seam is texture: a gauge's foot stands on several of its hills.
const TEXTURE_MM: f64 = 5.0;

impl Scales {
    /// Is the unevenness a texture? What the next cells have of it says nothing of the step then: all of it counts as uncertain.
    pub fn is_texture(&self) -> bool {
        self.along_mm < TEXTURE_MM
    }
}

/// What is asked of a wall: its height above the border's terms at a column, so far across, times a factor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Asked {
    pub column: usize,
    pub across_mm: f64,
    pub factor: f64,
}
