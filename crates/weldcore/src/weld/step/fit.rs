//! Both walls of all shots in one set of equations: what their unevenness is like, and what they say of the step.

use super::cells::{Columns, Gathered, line_of};
use super::terms::Terms;
use crate::error::{Error, Result};
use crate::ground::threads;
use crate::weld::kriging::{
    Answer, Asked, Border, BorderColumns, Cell, KrigedWall, Prior, Reduced, Scales, SeamLine, Stretch, fit, fit_near,
    sweep,
};

/// So many shots, that share as little of the seam as may be, tell what the walls are like: the others see the same waves.
const SHOTS_FOR_SCALES: usize = 4;
/// Rows between the seam and a wall's first cell carry nothing; this many at most are kept there.
const ROWS_TO_SEAM: usize = 1;

/// The equations of a seam: columns, border, walls.
pub(super) struct SeamEquations {
    pub columns: Columns,
    pub line: SeamLine,
    /// The column around the seam that the line begins with.
    start: usize,
    pub terms: Terms,
    pub walls: [KrigedWall; 2],
    border: [BorderColumns; 2],
    priors: [Prior; 2],
}

/// The equations solved, with what was asked.
pub(super) struct Solved {
    pub border: Border,
    pub answer: Answer,
    /// Whose unknowns these are.
    pub terms: Terms,
    /// What they leave of every cell's height.
    pub residuals: Vec<f64>,
}

impl SeamEquations {
    pub fn of(columns: Columns, gathered: &Gathered, terms: Terms) -> Self {
        let (line, start) = line_of(&columns, &gathered.walls);
        let border = [false, true].map(|other| terms.columns(other));
        let cell_along = line.spacing_mm * columns.of_a_cell as f64;
        let along_mm = line.columns as f64 * line.spacing_mm;
        let priors = std::array::from_fn(|k| {
            let wall = &gathered.walls[k];
            Prior::of_walls([cell_along, wall.row_mm], [along_mm, wall.reach_mm[1] - wall.reach_mm[0]])
        });
        let mut made = Self { columns, line, start, terms, walls: [empty(), empty()], border, priors };
        made.walls = std::array::from_fn(|k| made.wall(k == 1, &gathered.walls[k].cells, rows_of(gathered, k)));
        made
    }

    fn wall(&self, other: bool, cells: &[Cell], rows_mm: Vec<f64>) -> KrigedWall {
        let columns = &self.columns;
        let moved = cells.iter().filter_map(|c| {
            let column = (c.column + columns.around - self.start) % columns.around;
            (column < self.line.columns).then_some(Cell { column, ..*c })
        });
        KrigedWall::new(moved.collect(), self.terms.width(other), rows_mm, |cell, out| {
            self.terms.row(other, cell, self.at(cell), out);
        })
    }

    /// The place of a cell along the seam.
    pub fn at(&self, cell: &Cell) -> f64 {
        self.columns.middle(self.start + cell.column) + self.columns.course.difference(cell.along_mm)
    }

    /// The column of a bin on this line.
    pub fn column_of_bin(&self, bin: usize) -> Option<usize> {
        let column = (self.columns.of_bin(bin) + self.columns.around - self.start) % self.columns.around;
        (column < self.line.columns).then_some(column)
    }

    /// The same with other terms of the same unknowns.
    pub fn with(&self, terms: Terms) -> Self {
        let border = [false, true].map(|other| terms.columns(other));
        let mut made = Self { terms, border, walls: [empty(), empty()], ..*self };
        made.walls = std::array::from_fn(|k| self.rebuilt(&made.terms, k == 1, |_| true));
        made
    }

    /// The same with some of the cells.
    pub fn only(&self, keep: impl Fn(bool, &Cell) -> bool) -> Self {
        let walls = std::array::from_fn(|k| self.rebuilt(&self.terms, k == 1, |cell| keep(k == 1, cell)));
        Self { walls, terms: self.terms.clone(), border: self.border.clone(), ..*self }
    }

    fn rebuilt(&self, terms: &Terms, other: bool, keep: impl Fn(&Cell) -> bool) -> KrigedWall {
        let old = &self.walls[usize::from(other)];
        let cells = old.cells().iter().filter(|c| keep(c)).copied().collect();
        KrigedWall::new(cells, terms.width(other), old.rows_mm().to_vec(), |cell, out| {
            terms.row(other, cell, self.at(cell), out);
        })
    }

    /// What the walls are like: begun at `near`, or with each wall alone as the shot with the most cells has it.
    pub fn scales(&self, near: Option<[Scales; 2]>) -> Result<[Scales; 2]> {
        let mut shots: Vec<Stretch> = self.telling().into_iter().map(|shot| self.of_a_shot(shot).stretch()).collect();
        shots.sort_by_key(|s| std::cmp::Reverse(s.count()));
        let priors = [&self.priors[0], &self.priors[1]];
        let found = match near {
            Some(near) => fit_near(&shots, priors, near),
            None => fit(&shots, priors),
        };
        found.ok_or_else(|| degenerate("the walls do not determine it"))
    }

    fn stretch(&self) -> Stretch {
        Stretch::new(self.line, self.walls.each_ref(), self.border.each_ref(), self.terms.count())
    }

    /// One shot on a line of its own.
    fn of_a_shot(&self, shot: usize) -> Self {
        let around = self.columns.around;
        let walls = self.walls.each_ref().map(|w| {
            let mine = w.cells().iter().filter(|c| c.shot == shot);
            let cells = mine.map(|c| Cell { column: (c.column + self.start) % around, shot: 0, ..*c }).collect();
            super::cells::WallCells { cells, ..Default::default() }
        });
        let (line, start) = line_of(&self.columns, &walls);
        let terms = self.terms.of_shot(shot);
        let border = [false, true].map(|other| terms.columns(other));
        let mut made = Self { line, start, terms, border, walls: [empty(), empty()], ..*self };
        made.walls = std::array::from_fn(|k| made.wall(k == 1, &walls[k].cells, self.walls[k].rows_mm().to_vec()));
        made
    }

    /// The shots that tell what the walls are like: one after the other that with the most columns not seen so far.
    fn telling(&self) -> Vec<usize> {
        let shots = self.terms.shots();
        let mut seen = vec![vec![false; self.line.columns]; shots];
        for cell in self.walls.iter().flat_map(KrigedWall::cells) {
            seen[cell.shot][cell.column] = true;
        }
        let mut covered = vec![false; self.line.columns];
        let mut chosen: Vec<usize> = Vec::new();
        while chosen.len() < shots.min(SHOTS_FOR_SCALES) {
            let fresh = |k: &usize| seen[*k].iter().zip(&covered).filter(|(s, c)| **s && !**c).count();
            let left = (0..shots).filter(|k| !chosen.contains(k));
            let Some(next) = left.max_by_key(|k| (fresh(k), std::cmp::Reverse(*k))) else { break };
            covered.iter_mut().zip(&seen[next]).for_each(|(c, s)| *c |= s);
            chosen.push(next);
        }
        chosen
    }

    /// What the unknowns leave of every cell's height.
    fn residuals(&self, estimate: &[f64]) -> Vec<f64> {
        let of_wall = |k: usize| {
            let wall = &self.walls[k];
            let left = move |(cell, own): (&Cell, &[f64])| {
                let first = wall.width().of_shot(cell.shot);
                let term = |(c, value): (usize, &f64)| {
                    let column = if c < wall.width().common { c } else { first + c - wall.width().common };
                    value * self.border[k][column].iter().map(|&p| estimate[p]).sum::<f64>()
                };
                cell.height_mm - own.iter().enumerate().map(term).sum::<f64>()
            };
            wall.cells().iter().zip(wall.rows()).map(left).collect::<Vec<f64>>()
        };
        [of_wall(0), of_wall(1)].concat()
    }

    fn swept(&self, scales: &[Scales; 2], asked: [&[Asked]; 2]) -> Result<[Reduced; 2]> {
        let one = |k: usize| sweep(&self.line, &self.walls[k], &scales[k], asked[k]);
        let (first, second) = threads::install(|| rayon::join(|| one(0), || one(1)));
        match (first, second) {
            (Some(first), Some(second)) => Ok([first, second]),
            _ => Err(degenerate("the walls' equations have no solution")),
        }
    }

    /// What is asked of each wall, and of the border (a row per question).
    pub fn solve(&self, scales: &[Scales; 2], asked: [&[Asked]; 2], rows: &[f64]) -> Result<Solved> {
        let reduced = self.swept(scales, asked)?;
        let walls = [(&reduced[0], &self.border[0]), (&reduced[1], &self.border[1])];
        let mut border =
            Border::join(self.terms.count(), &walls).ok_or_else(|| degenerate("its terms have no solution"))?;
        border.make_plain(self.terms.optional(), self.walls.iter().map(KrigedWall::count).sum());
        let answer = border.answer(rows, &walls);
        if answer.value.iter().chain(&answer.covariance).any(|v| !v.is_finite()) {
            return Err(degenerate("the fit of the walls did not converge"));
        }
        let residuals = self.residuals(&border.estimate);
        Ok(Solved { border, answer, terms: self.terms.clone(), residuals })
    }
}

fn degenerate(reason: &str) -> Error {
    Error::Degenerate { what: "step", reason: reason.into() }
}

fn empty() -> KrigedWall {
    KrigedWall::new(
        Vec::new(),
        crate::weld::kriging::Width { common: 0, of_a_shot: 0, shots: 0 },
        Vec::new(),
        |_, _| {},
    )
}

/// The rows that carry a wall's unevenness: those of its cells, one towards the seam, and the seam.
fn rows_of(gathered: &Gathered, wall: usize) -> Vec<f64> {
    let sign = if wall == 0 { -1.0 } else { 1.0 };
    let (row, [from, to]) = (gathered.walls[wall].row_mm, gathered.walls[wall].reach_mm);
    let mut rows = vec![0.0];
    if from > ROWS_TO_SEAM as f64 * row {
        rows.push(sign * 0.5 * from);
    }
    let count = ((to - from) / row).round() as usize;
    rows.extend((0..count.max(1)).map(|k| sign * (from + (k as f64 + 0.5) * row)));
    rows
}
