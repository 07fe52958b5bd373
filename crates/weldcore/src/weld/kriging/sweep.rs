//! One wall eliminated from the equations, column by column: what is left speaks of the border alone.
//!
//! Unknowns of a wall are the states of its unevenness, [`super::chain`] along the seam for each of the shapes of
//! [`super::basis`] across it. With A the rows of the cells, X their rows of the border and H what is asked, the precision
//! `J + AᵀWA` is block tridiagonal, and one forward Cholesky pass with the right-hand sides `[AᵀWX | AᵀWy | Hᵀ]` gives all that
//! is needed: the products of the solved right-hand sides are the Schur complements. Nothing is substituted back.
//!
//! Source: H. Rue and L. Held, Gaussian Markov Random Fields (2005), 2.3 and 2.4.

use super::basis::Basis;
use super::chain::{Chain, Two, correlation, transposed};
use super::rows::{add_gram, cholesky, forward, subtract_product};
use super::wall::{Asked, Line, Scales, Wall};
use crate::ground::stop::poll;

/// A wall without its unevenness: what its cells say of the border, and of what was asked.
#[derive(Debug, Clone)]
pub(crate) struct Reduced {
    /// Columns of the wall's border.
    pub columns: usize,
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
pub(crate) fn sweep(line: &Line, wall: &Wall, scales: &Scales, asked: &[Asked]) -> Option<Reduced> {
    let chain = Chain::new(scales.along_mm, line.spacing_mm);
    let basis = Basis::new(&wall.rows_mm, scales.sd_mm, scales.across_mm);
    let (rank, border, over) = (basis.rank(), wall.width.total(), 1.0 / scales.noise);
    let columns = border + 1 + asked.len();
    let held = wall.width.common + wall.width.of_a_shot;
    let starts: Vec<usize> = (0..=line.columns).map(|c| wall.cells.partition_point(|cell| cell.column < c)).collect();
    let mut asked_in: Vec<Vec<usize>> = vec![Vec::new(); line.columns];
    asked.iter().enumerate().for_each(|(k, a)| asked_in[a.column].push(k));

    let mut gram = vec![0.0; columns * columns];
    let mut before: Option<(Vec<f64>, Vec<f64>)> = None;
    let mut shapes = vec![0.0; rank];
    let mut row = vec![0.0; 2 * rank];
    let mut log_det = -log_det_of_chain(line, &chain)? * rank as f64;
    for block in line.blocks() {
        poll();
        let size = 2 * rank * block.len();
        let mut own = vec![0.0; size * size];
        let mut right = vec![0.0; size * columns];
        for (k, &column) in block.iter().enumerate() {
            let first = 2 * rank * k;
            spread(&mut own, size, first, first, rank, &line.own(&chain, column));
            for (i, cell) in wall.cells[starts[column]..starts[column + 1]].iter().enumerate() {
                basis.at(cell.across_mm, &mut shapes);
                let slope = chain.rate * cell.along_mm;
                for m in 0..rank {
                    (row[m], row[rank + m]) = (shapes[m], slope * shapes[m]);
                }
                let weight = cell.weight * over;
                let at = (starts[column] + i) * held;
                let (common, mine) = wall.rows[at..at + held].split_at(wall.width.common);
                let mine_at = wall.width.of_shot(cell.shot);
                for (a, value) in row.iter().enumerate() {
                    let scaled = weight * value;
                    let out = &mut own[(first + a) * size + first..][..=a];
                    out.iter_mut().zip(&row).for_each(|(o, v)| *o += scaled * v);
                    let out = &mut right[(first + a) * columns..][..columns];
                    out.iter_mut().zip(common).for_each(|(o, v)| *o += scaled * v);
                    out[mine_at..].iter_mut().zip(mine).for_each(|(o, v)| *o += scaled * v);
                    out[border] += scaled * cell.height_mm;
                }
            }
            for &a in &asked_in[column] {
                basis.at(asked[a].across_mm, &mut shapes);
                for m in 0..rank {
                    right[(first + m) * columns + border + 1 + a] += asked[a].factor * shapes[m];
                }
            }
        }
        couple_within(&mut own, &block, rank, &chain);
        if let Some((carry, carried)) = &before {
            subtract_product(&mut own, carry, size, carry, size);
            subtract_product(&mut right, carry, size, carried, columns);
        }
        log_det += cholesky(&mut own, size)?;
        let mut carry = couple_to_next(line, rank, &chain);
        forward(&own, size, &mut carry, size);
        forward(&own, size, &mut right, columns);
        add_gram(&mut gram, &right, columns);
        before = Some((carry, right));
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
                lost * a.factor * b.factor * correlation(line.apart_mm(a.column, b.column), scales.along_mm)
            } else {
                0.0
            };
            covariance[i * asked.len() + j] = at(border + 1 + i, border + 1 + j) + rest;
        }
    }
    Some(Reduced {
        columns: border,
        information,
        right: (0..border).map(|i| over * wall.right[i] - at(i, border)).collect(),
        square: over * wall.square - at(border, border),
        log_det: log_det - wall.log_weights + wall.count() as f64 * scales.noise.ln(),
        value: (0..asked.len()).map(|k| at(border + 1 + k, border)).collect(),
        slope: (0..asked.len()).flat_map(|k| (0..border).map(move |j| at(border + 1 + k, j))).collect(),
        covariance,
    })
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
fn couple_within(own: &mut [f64], block: &[usize], rank: usize, chain: &Chain) {
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
fn couple_to_next(line: &Line, rank: usize, chain: &Chain) -> Vec<f64> {
    let size = if line.closed { 4 * rank } else { 2 * rank };
    let mut links = vec![0.0; size * size];
    spread(&mut links, size, 0, 0, rank, &transposed(&chain.link));
    if line.closed {
        spread(&mut links, size, 2 * rank, 2 * rank, rank, &chain.link);
    }
    links
}

/// The logarithm of the determinant of a chain's precision, eliminated as the wall is.
fn log_det_of_chain(line: &Line, chain: &Chain) -> Option<f64> {
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
            subtract_product(&mut own, carry, size, carry, size);
        }
        log_det += cholesky(&mut own, size)?;
        let mut next = couple_to_next(line, 1, chain);
        forward(&own, size, &mut next, size);
        carry = Some(next);
    }
    Some(log_det)
}
