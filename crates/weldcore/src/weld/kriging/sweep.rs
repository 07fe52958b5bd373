//! One wall eliminated from the equations, column by column: what is left speaks of the border alone.
//!
//! Unknowns of a wall are the states of its unevenness, [`super::chain`] along the seam for each of the shapes of
//! [`super::basis`] across it. With A the rows of the cells, X their rows of the border and H what is asked, the precision
//! `J + AᵀWA` is block tridiagonal, and one forward Cholesky pass with the right-hand sides `[AᵀWX | AᵀWy | Hᵀ]` gives all that
//! is needed: the products of the solved right-hand sides are the Schur complements. Nothing is substituted back.
//!
//! Source: H. Rue and L. Held, Gaussian Markov Random Fields (2005), 2.3 and 2.4.

use super::basis::Basis;
use super::chain::{ColumnChain, Two, correlation, transposed};
use super::rows::{add_cell, add_gram, cholesky, forward, subtract_gram, subtract_product};
use super::wall::{Asked, KrigedWall, Scales, SeamLine};
use crate::ground::stop::poll;

/// A wall without its unevenness: what its cells say of the border, and of what was asked.
#[derive(Debug, Clone)]
pub(crate) struct Reduced {
    /// BorderColumns of the wall's border.
    pub columns: usize,
    /// Cells of the wall.
    pub cells: usize,
    /// Information of the border's unknowns without their prior, columns squared; the upper triangle counts.
    pub information: Vec<f64>,
    pub right: Vec<f64>,
    pub square: f64,
    /// Of the cells' covariance, given the border.
    pub log_det: f64,
    /// What was asked, given a border of 0; and by how much it falls for every unit of each of the border's unknowns.
    pub value: Vec<f64>,
    pub slope: Vec<f64>,
    /// Covariance of what was asked, given the border; asked squared.
    pub covariance: Vec<f64>,
}

/// Eliminates a wall; `None` where the numbers do not allow it.
pub(crate) fn sweep(line: &SeamLine, wall: &KrigedWall, scales: &Scales, asked: &[Asked]) -> Option<Reduced> {
    if wall.rows_mm.is_empty() {
        return None;
    }
    let chain = ColumnChain::new(scales.along_mm, line.spacing_mm);
    let basis = Basis::new(&wall.rows_mm, scales.sd_mm, scales.across_mm);
    let (rank, border, over) = (basis.rank(), wall.width.total(), 1.0 / scales.noise);
    let columns = border + 1 + asked.len();
    let held = wall.width.common + wall.width.of_a_shot;
    let starts: Vec<usize> = (0..=line.columns).map(|c| wall.cells.partition_point(|cell| cell.column < c)).collect();
    let mut asked_in: Vec<Vec<usize>> = vec![Vec::new(); line.columns];
    let texture = scales.is_texture();
    if !texture {
        asked.iter().enumerate().for_each(|(k, a)| asked_in[a.column].push(k));
    }

    let mut gram = vec![0.0; columns * columns];
    let mut before: Option<Carried> = None;
    let mut live = Live { slot: vec![usize::MAX; columns], peak: vec![0.0; columns], listed: Vec::new() };
    let mut shapes = vec![0.0; rank];
    let mut row = vec![0.0; 2 * rank];
    let mut log_det = -log_det_of_chain(line, &chain)? * rank as f64;
    for block in line.blocks() {
        poll();
        let size = 2 * rank * block.len();
        let cells_of = |column: usize| starts[column]..starts[column + 1];
        let shots = block.iter().flat_map(|c| wall.cells[cells_of(*c)].iter().map(|cell| cell.shot));
        let of_shots = shots.flat_map(|k| wall.width.of_shot(k)..wall.width.of_shot(k + 1));
        let of_asked = block.iter().flat_map(|c| asked_in[*c].iter().map(|k| border + 1 + k));
        let carried = before.as_ref().map_or(&[][..], |b| &b.listed);
        live.list(
            (0..wall.width.common).chain([border]).chain(of_shots).chain(of_asked).chain(carried.iter().copied()),
        );
        let wide = live.listed.len();
        let mut own = vec![0.0; size * size];
        let mut right = vec![0.0; size * wide];
        for (k, &column) in block.iter().enumerate() {
            let first = 2 * rank * k;
            spread(&mut own, size, first, first, rank, &line.own(&chain, column));
            for i in cells_of(column) {
                let cell = &wall.cells[i];
                basis.at(cell.across_mm, &mut shapes);
                let slope = chain.rate * cell.along_mm;
                for m in 0..rank {
                    (row[m], row[rank + m]) = (shapes[m], slope * shapes[m]);
                }
                let (common, mine) = wall.rows[i * held..(i + 1) * held].split_at(wall.width.common);
                let parts = [(0, common), (live.slot[wall.width.of_shot(cell.shot).min(border)], mine)];
                let height = (live.slot[border], cell.height_mm);
                add_cell(&mut own, (size, first), &mut right, wide, &row, cell.weight * over, &parts, height);
            }
            for &a in &asked_in[column] {
                basis.at(asked[a].across_mm, &mut shapes);
                for m in 0..rank {
                    right[(first + m) * wide + live.slot[border + 1 + a]] += asked[a].factor * shapes[m];
                }
            }
        }
        couple_within(&mut own, &block, rank, &chain);
        if let Some(before) = &before {
            subtract_gram(&mut own, &before.links, size);
            subtract_product(&mut right, &before.links, size, &live.laid_out(before, size), wide);
        }
        log_det += cholesky(&mut own, size)?;
        let mut links = couple_to_next(line, rank, &chain);
        forward(&own, size, &mut links, size);
        forward(&own, size, &mut right, wide);
        live.add_to(&mut gram, columns, &right);
        before = Some(live.carried(links, &right, wall.width.common, border));
    }

    let at = |i: usize, j: usize| gram[i.min(j) * columns + i.max(j)];
    let mut information = vec![0.0; border * border];
    for i in 0..border {
        for j in i..border {
            information[i * border + j] = over * wall.information[i * border + j] - at(i, j);
        }
    }
    let mut covariance = vec![0.0; asked.len() * asked.len()];
    for (i, a) in asked.iter().enumerate() {
        let lost = basis.lost(a.across_mm);
        for (j, b) in asked.iter().enumerate() {
            let rest = if a.across_mm == b.across_mm {
                (if texture { scales.sd_mm.powi(2) } else { lost })
                    * a.factor
                    * b.factor
                    * correlation(line.apart_mm(a.column, b.column), scales.along_mm)
            } else {
                0.0
            };
            covariance[i * asked.len() + j] = at(border + 1 + i, border + 1 + j) + rest;
        }
    }
    Some(Reduced {
        columns: border,
        cells: wall.count(),
        information,
        right: (0..border).map(|i| over * wall.right[i] - at(i, border)).collect(),
        square: over * wall.square - at(border, border),
        log_det: log_det - wall.log_weights + wall.count() as f64 * scales.noise.ln(),
        value: (0..asked.len()).map(|k| at(border + 1 + k, border)).collect(),
        slope: (0..asked.len()).flat_map(|k| (0..border).map(move |j| at(border + 1 + k, j))).collect(),
        covariance,
    })
}

/// A column of the right-hand side that has fallen to this share of its largest is over: what is known of a place is soon nothing
/// to places further on, which makes the work grow with the columns that live at once, not with all of them.
const OVER: f64 = 1e-8;

/// What a block hands on: its links to the next one, and its solved right-hand sides with the columns that they are of.
struct Carried {
    links: Vec<f64>,
    right: Vec<f64>,
    listed: Vec<usize>,
}

/// The columns of the right-hand sides that are not zero in a block.
struct Live {
    /// Where each column stands among them.
    slot: Vec<usize>,
    /// The largest that each has been.
    peak: Vec<f64>,
    /// In rising order.
    listed: Vec<usize>,
}

impl Live {
    fn list(&mut self, columns: impl Iterator<Item = usize>) {
        self.listed.drain(..).for_each(|c| self.slot[c] = usize::MAX);
        for c in columns {
            if self.slot[c] == usize::MAX {
                self.slot[c] = 0;
                self.listed.push(c);
            }
        }
        self.listed.sort_unstable();
        self.listed.iter().enumerate().for_each(|(k, c)| self.slot[*c] = k);
    }

    /// What was handed on, in the order of the columns of this block.
    fn laid_out(&self, before: &Carried, rows: usize) -> Vec<f64> {
        let (from, to) = (before.listed.len(), self.listed.len());
        let mut out = vec![0.0; rows * to];
        for (line, given) in out.chunks_exact_mut(to).zip(before.right.chunks_exact(from)) {
            before.listed.iter().zip(given).for_each(|(c, v)| line[self.slot[*c]] = *v);
        }
        out
    }

    fn add_to(&self, gram: &mut [f64], columns: usize, right: &[f64]) {
        let wide = self.listed.len();
        let mut own = vec![0.0; wide * wide];
        add_gram(&mut own, right, wide);
        for (i, &p) in self.listed.iter().enumerate() {
            let line = &mut gram[p * columns..(p + 1) * columns];
            self.listed[i..].iter().zip(&own[i * wide + i..]).for_each(|(q, v)| line[*q] += v);
        }
    }

    /// Hands on what is not over; the common columns never are.
    fn carried(&mut self, links: Vec<f64>, right: &[f64], common: usize, height: usize) -> Carried {
        let wide = self.listed.len();
        let mut size = vec![0.0; wide];
        for line in right.chunks_exact(wide) {
            size.iter_mut().zip(line).for_each(|(s, v)| *s += v * v);
        }
        for (c, s) in self.listed.iter().zip(&size) {
            self.peak[*c] = self.peak[*c].max(*s);
        }
        let lives = |k: &usize| {
            let c = self.listed[*k];
            c < common || c == height || size[*k] > OVER * OVER * self.peak[c]
        };
        let kept: Vec<usize> = (0..wide).filter(lives).collect();
        let listed = kept.iter().map(|k| self.listed[*k]).collect();
        let right = right.chunks_exact(wide).flat_map(|line| kept.iter().map(|k| line[*k])).collect();
        Carried { links, right, listed }
    }
}

/// Adds a 2x2 matrix to the blocks of a column's states: the same for every shape.
fn spread(matrix: &mut [f64], stride: usize, row: usize, column: usize, rank: usize, two: &Two) {
    for (i, line) in two.iter().enumerate() {
        for (j, value) in line.iter().enumerate() {
            for m in 0..rank {
                matrix[(row + i * rank + m) * stride + column + j * rank + m] += value;
            }
        }
    }
}

/// The links between the two columns of a block, which are neighbours at either end of the fold: the last fold's second column
/// follows its first, the first fold's first column follows its second.
fn couple_within(own: &mut [f64], block: &[usize], rank: usize, chain: &ColumnChain) {
    let &[one, other] = block else { return };
    let size = 4 * rank;
    if other == one + 1 {
        spread(own, size, 2 * rank, 0, rank, &chain.link);
    }
    if one == 0 {
        spread(own, size, 2 * rank, 0, rank, &transposed(&chain.link));
    }
}

/// The links from a block to the next one: from its rows to that one's columns.
fn couple_to_next(line: &SeamLine, rank: usize, chain: &ColumnChain) -> Vec<f64> {
    let size = if line.closed { 4 * rank } else { 2 * rank };
    let mut links = vec![0.0; size * size];
    spread(&mut links, size, 0, 0, rank, &transposed(&chain.link));
    if line.closed {
        spread(&mut links, size, 2 * rank, 2 * rank, rank, &chain.link);
    }
    links
}

/// The logarithm of the determinant of a chain's precision, eliminated as the wall is.
fn log_det_of_chain(line: &SeamLine, chain: &ColumnChain) -> Option<f64> {
    let mut log_det = 0.0;
    let mut carry: Option<Vec<f64>> = None;
    for block in line.blocks() {
        let size = 2 * block.len();
        let mut own = vec![0.0; size * size];
        for (k, &column) in block.iter().enumerate() {
            spread(&mut own, size, 2 * k, 2 * k, 1, &line.own(chain, column));
        }
        couple_within(&mut own, &block, 1, chain);
        if let Some(carry) = &carry {
            subtract_gram(&mut own, carry, size);
        }
        log_det += cholesky(&mut own, size)?;
        let mut next = couple_to_next(line, 1, chain);
        forward(&own, size, &mut next, size);
        carry = Some(next);
    }
    Some(log_det)
}
