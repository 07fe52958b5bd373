//! The walls of all shots, averaged into the cells of one grid around the common seam.

use rayon::prelude::*;

use super::view::{LabelledShot, SeamView, is_wall};
use crate::error::{Error, Result, require_count};
use crate::ground::robust::median;
use crate::ground::stop::polled;
use crate::ground::threads;
use crate::weld::kriging::{Cell, SeamLine};
use crate::weld::seam::Course;

/// Length of a cell along and across the seam, about: fine enough for waves of 8 mm.
const CELL_MM: f64 = 5.0;
/// A wall of a small pipe is short: at least so many rows of cells.
const LEAST_ROWS: f64 = 8.0;
/// At most so many: they carry the wall's unevenness across the seam.
const MOST_ROWS: f64 = 16.0;
/// Cells of small pipes are not shorter than this along the seam.
const LEAST_CELL_MM: f64 = 2.0;
/// How many columns may share a cell; they divide a turn's bins, and leave the cell's middle on a column.
const SHARED: [usize; 5] = [1, 3, 5, 9, 15];
/// A cell needs this part of the points of a typical cell.
const FULL_PART: f64 = 0.25;
/// The scatter of a cell's points is not taken to be less: no scanner is as good.
const LEAST_SCATTER_MM: f64 = 1e-4;
/// So many differences tell the scatter; with fewer it is taken to be usual, and the cells tell by how much that is wrong.
const TELLING: f64 = 30.0;
const USUAL_SCATTER_MM: f64 = 0.03;
/// Fewer cells are no wall.
const LEAST_CELLS: usize = 8;
/// Two walls whose arc leaves out so much of a closed seam are an open one.
const OPEN_GAP: f64 = 1.0 / 6.0;

/// The columns along a seam: bins of the profile are centred on some of them.
#[derive(Debug, Clone, Copy)]
pub(super) struct Columns {
    pub course: Course,
    /// Around the whole seam.
    pub around: usize,
    /// Columns of a bin.
    pub of_a_bin: usize,
    /// Columns that share a cell.
    pub of_a_cell: usize,
}

impl Columns {
    pub fn of(course: Course) -> Self {
        let bin_mm = course.along_mm(course.at_reading(course.bin_width()));
        let of_a_bin = ((bin_mm / CELL_MM).round() as usize).max(1);
        let spacing = bin_mm / of_a_bin as f64;
        let [.., last] = SHARED;
        let of_a_cell = SHARED.into_iter().find(|n| *n as f64 * spacing >= LEAST_CELL_MM).unwrap_or(last);
        Self { course, around: course.bins() * of_a_bin, of_a_bin, of_a_cell }
    }

    /// In the seam's parameter.
    pub fn spacing(&self) -> f64 {
        self.course.at_reading(self.course.bin_width()) / self.of_a_bin as f64
    }

    /// The column in the middle of the cell that a place lies in, counted around the seam.
    fn cell(&self, at: f64) -> usize {
        let cell = (at / (self.spacing() * self.of_a_cell as f64)).round() as i64;
        (cell * self.of_a_cell as i64).rem_euclid(self.around as i64) as usize
    }

    /// The middle of a column.
    pub fn middle(&self, column: usize) -> f64 {
        column as f64 * self.spacing()
    }

    pub fn of_bin(&self, bin: usize) -> usize {
        bin * self.of_a_bin
    }
}

/// CellSums over a cell's points, about its middle: number, place along (in the seam's parameter) and across, height, and their products.
type CellSums = [f64; 10];

fn add(sums: &mut CellSums, a: f64, z: f64, h: f64) {
    for (slot, v) in sums.iter_mut().zip([1.0, a, z, h, a * a, a * z, z * z, a * h, z * h, h * h]) {
        *slot += v;
    }
}

/// What is left of the heights after a plane, squared and summed, and how many differences that is of.
fn scatter(s: &CellSums) -> (f64, f64) {
    let n = s[0];
    let about = |product: f64, i: usize, j: usize| product - s[i] * s[j] / n;
    let (aa, az, zz) = (about(s[4], 1, 1), about(s[5], 1, 2), about(s[6], 2, 2));
    let (ah, zh, hh) = (about(s[7], 1, 3), about(s[8], 2, 3), about(s[9], 3, 3));
    let det = aa * zz - az * az;
    if n < 6.0 || det <= 1e-9 * aa * zz {
        return (0.0, 0.0);
    }
    let explained = (ah * ah * zz - 2.0 * ah * zh * az + zh * zh * aa) / det;
    ((hh - explained).max(0.0), n - 3.0)
}

/// The cells of one wall.
#[derive(Debug, Clone, Default)]
pub(super) struct WallCells {
    pub cells: Vec<Cell>,
    /// Length of a row across the seam, and the extent of the wall, as distances from the centreline.
    pub row_mm: f64,
    pub reach_mm: [f64; 2],
}

/// The cells of both walls, in columns counted around the seam, and which bins were seen on both walls.
pub(super) struct Gathered {
    pub walls: [WallCells; 2],
    pub seen: Vec<bool>,
}

/// Points that one thread gathers by itself.
const GATHERED: usize = 16 * threads::CHUNK;
/// A bin counts as seen when each wall has this part of the points of a typical bin: edges of the view fill bins partly.
const SEEN_PART: f64 = 0.1;

pub(super) fn gather(shots: &[LabelledShot], views: &[SeamView], columns: &Columns) -> Result<Gathered> {
    // The rows are common to all shots.
    let mut reach = [[f64::INFINITY, 0.0_f64]; 2];
    for view in views {
        for (all, one) in reach.iter_mut().zip(view.reach_mm) {
            *all = [all[0].min(one[0]), all[1].max(one[1])];
        }
    }
    let rows_mm = reach.map(|[from, to]| CELL_MM.min((to - from) / LEAST_ROWS).max((to - from) / MOST_ROWS));
    if !rows_mm.iter().all(|mm| mm.is_finite() && *mm > 0.0) {
        return Err(Error::Degenerate { what: "step", reason: "the walls have no extent".into() });
    }
    let mut walls: [WallCells; 2] =
        std::array::from_fn(|k| WallCells { cells: Vec::new(), row_mm: rows_mm[k], reach_mm: reach[k] });
    let mut seen = vec![false; columns.course.bins()];
    for (index, (shot, view)) in shots.iter().zip(views).enumerate() {
        let found = of_shot(shot, view, columns, rows_mm, reach);
        for (bin, counts) in found.bins.iter().enumerate() {
            let full = |k: usize| counts[k] >= 1.0 && counts[k] >= SEEN_PART * found.typical[k];
            seen[bin] |= full(0) && full(1);
        }
        for (k, wall) in walls.iter_mut().enumerate() {
            wall.cells.extend(found.cells[k].iter().map(|c| Cell { shot: index, ..*c }));
        }
    }
    for wall in &walls {
        require_count("cells of a wall", LEAST_CELLS, wall.cells.len())?;
    }
    Ok(Gathered { walls, seen })
}

struct OfShot {
    cells: [Vec<Cell>; 2],
    /// Points of each wall by bin.
    bins: Vec<[f64; 2]>,
    typical: [f64; 2],
}

/// The points are gathered as the shot's own frame has them, column by column from its first one on; then cells are placed.
fn of_shot(shot: &LabelledShot, view: &SeamView, columns: &Columns, rows_mm: [f64; 2], reach: [[f64; 2]; 2]) -> OfShot {
    let course = columns.course;
    let own = view.own;
    let of_a_cell = columns.of_a_cell;
    // Of the shot's own columns the one in the middle of its stretch lies in the middle of a cell.
    let cells_aside = (own.half / (columns.spacing() * of_a_cell as f64)).ceil() as usize + 1;
    let along = 2 * cells_aside + 1;
    let rows: [usize; 2] = std::array::from_fn(|k| ((reach[k][1] - reach[k][0]) / rows_mm[k]).ceil() as usize + 1);
    let (over_spacing, over_row) = (1.0 / columns.spacing(), rows_mm.map(|mm| 1.0 / mm));
    let middle_column = (along * of_a_cell / 2) as f64;
    let cell_middle = |cell: usize| {
        let column = (cell * of_a_cell + of_a_cell / 2) as f64;
        own.middle + (column - middle_column) * columns.spacing()
    };
    let first_row = [0, along * rows[0]];
    let parts: Vec<(Vec<CellSums>, Vec<[f64; 2]>)> = threads::install(|| {
        (0..shot.labels.len().div_ceil(GATHERED))
            .into_par_iter()
            .inspect(polled)
            .map(|part| {
                let mut sums = vec![[0.0; 10]; along * (rows[0] + rows[1])];
                let mut counts = vec![[0.0; 2]; along * of_a_cell];
                for i in part * GATHERED..((part + 1) * GATHERED).min(shot.labels.len()) {
                    let Some(k) = is_wall(shot.labels[i]).map(usize::from) else { continue };
                    let u = shot.unrolled;
                    let [across, height] = [u.across_mm[i], u.height_mm[i]].map(f64::from);
                    let apart = own.course.apart(f64::from(u.at[i]), own.middle);
                    let column = ((apart * over_spacing + middle_column + 0.5) as i32 as usize).min(counts.len() - 1);
                    counts[column][k] += 1.0;
                    let cell = column / of_a_cell;
                    let row = ((across.abs() - reach[k][0]) * over_row[k]).max(0.0) as i32 as usize;
                    let slot = first_row[k] + cell * rows[k] + row.min(rows[k] - 1);
                    let off = apart - ((cell * of_a_cell + of_a_cell / 2) as f64 - middle_column) * columns.spacing();
                    add(&mut sums[slot], off, across, height);
                }
                (sums, counts)
            })
            .collect()
    });
    let (mut sums, mut counts) = (vec![[0.0; 10]; along * (rows[0] + rows[1])], vec![[0.0; 2]; along * of_a_cell]);
    for (part, more) in parts {
        sums.iter_mut().zip(part).for_each(|(a, b)| a.iter_mut().zip(b).for_each(|(x, y)| *x += y));
        counts.iter_mut().zip(more).for_each(|(a, b)| a.iter_mut().zip(b).for_each(|(x, y)| *x += y));
    }
    let cells = std::array::from_fn(|k| {
        let mine = &sums[first_row[k]..][..along * rows[k]];
        let mut numbers: Vec<f64> = mine.iter().map(|s| s[0]).filter(|n| *n > 0.0).collect();
        let full = FULL_PART * median(&mut numbers);
        let (square, free) = mine.iter().map(scatter).fold((0.0, 0.0), |a, b| (a.0 + b.0, a.1 + b.1));
        let scatter = if free >= TELLING { (square / free).sqrt() } else { USUAL_SCATTER_MM };
        let variance = scatter.max(LEAST_SCATTER_MM).powi(2);
        let cell = |(place, s): (usize, &CellSums)| {
            (s[0] > 0.0 && s[0] >= full).then(|| {
                let at = cell_middle(place / rows[k]) + s[1] / s[0];
                let [at, across_mm, height_mm] = view.moved(at, s[2] / s[0], s[3] / s[0]);
                let column = columns.cell(at);
                let along_mm = course.along_mm(course.apart(at, columns.middle(column)));
                Cell { column, along_mm, across_mm, height_mm, weight: s[0] / variance, shot: 0 }
            })
        };
        mine.iter().enumerate().filter_map(cell).collect()
    });
    let mut bins = vec![[0.0; 2]; course.bins()];
    for (column, seen) in counts.iter().enumerate() {
        let at = own.middle + (column as f64 - middle_column) * columns.spacing();
        let bin = &mut bins[course.bin(view.moved(at, 0.0, 0.0)[0])];
        *bin = [bin[0] + seen[0], bin[1] + seen[1]];
    }
    let typical = std::array::from_fn(|k| {
        let mut numbers: Vec<f64> = bins.iter().map(|c| c[k]).filter(|n| *n > 0.0).collect();
        median(&mut numbers)
    });
    OfShot { cells, bins, typical }
}

/// The columns that all cells lie in: around the whole seam, or from the end of the longest gap on where that is long. Returns
/// where they begin, too.
pub(super) fn line_of(columns: &Columns, walls: &[WallCells; 2]) -> (SeamLine, usize) {
    let spacing_mm = columns.course.along_mm(columns.spacing());
    let mut used: Vec<usize> = walls.iter().flat_map(|w| w.cells.iter().map(|c| c.column)).collect();
    used.sort_unstable();
    used.dedup();
    let (Some(&low), Some(&high)) = (used.first(), used.last()) else {
        return (SeamLine { columns: 1, spacing_mm, closed: false }, 0);
    };
    let (mut longest, mut start, mut end) = (low + columns.around - high, low, high);
    for pair in used.windows(2) {
        if pair[1] - pair[0] > longest {
            (longest, start, end) = (pair[1] - pair[0], pair[1], pair[0] + columns.around);
        }
    }
    if (longest as f64) < OPEN_GAP * columns.around as f64 {
        return (SeamLine { columns: columns.around, spacing_mm, closed: true }, 0);
    }
    // Bins reach a cell's half beyond its middle.
    let margin = columns.of_a_bin.max(columns.of_a_cell);
    (
        SeamLine { columns: end - start + 1 + 2 * margin, spacing_mm, closed: false },
        (start + columns.around - margin) % columns.around,
    )
}
