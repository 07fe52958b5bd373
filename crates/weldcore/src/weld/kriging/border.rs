//! The unknowns that both walls and all shots share, with what the walls say of them; and the step that follows.
//!
//! Every unknown b is counted in units of its prior, so that its prior precision is 1. With what [`super::sweep`] leaves of the
//! walls (`information`, `right`, `square`, `log_det`) and M from a wall's columns to the border's
//!
//! ```text
//! S = I + Σ Mᵀ information M      v = Σ Mᵀ right      b = S⁻¹ v
//! -2 l = Σ log_det + log|S| + Σ square - vᵀ b
//! h = Σ value + (X0 - Σ slope M) b
//! C = Σ covariance + (X0 - Σ slope M) S⁻¹ (·)ᵀ
//! ```
//!
//! With wide priors l is the restricted likelihood.
//!
//! Source: D. Harville, J. Am. Stat. Assoc. 72 (1977) 320, 5.2 and 6; N. Cressie, Statistics for Spatial Data (1993), 3.4.5.

use nalgebra::{DMatrix, DVector};

use super::rows::{add_gram, cholesky, forward};
use super::sweep::Reduced;

/// Which of the border's unknowns each column of a wall is: the sum of one or several.
pub(crate) type BorderColumns = Vec<Vec<usize>>;

/// Both walls' equations for the border, solved.
#[derive(Debug, Clone)]
pub(crate) struct Border {
    size: usize,
    /// The lower factor of S.
    lower: Vec<f64>,
    /// The unknowns, in units of their prior.
    pub estimate: Vec<f64>,
    /// `-2 l`, but for a constant: what [`Scaled::cost`] finds by a shorter way.
    #[cfg_attr(not(test), expect(dead_code))]
    pub cost: f64,
}

/// Values at several places, with their covariance.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Answer {
    pub value: Vec<f64>,
    /// Row by row.
    pub covariance: Vec<f64>,
    /// The part of each variance that the walls' unevenness alone makes, the border given.
    pub of_unevenness: Vec<f64>,
}

impl Border {
    /// Joins walls; `None` where the numbers do not allow it.
    pub fn join(size: usize, walls: &[(&Reduced, &BorderColumns)]) -> Option<Self> {
        let mut lower = vec![0.0; size * size];
        let mut right = vec![0.0; size];
        (0..size).for_each(|k| lower[k * size + k] = 1.0);
        let mut cost = 0.0;
        for (wall, columns) in walls {
            for i in 0..wall.columns {
                for j in i..wall.columns {
                    let value = wall.information[i * wall.columns + j];
                    for &p in &columns[i] {
                        for &q in &columns[j] {
                            lower[p * size + q] += value;
                            if i != j {
                                lower[q * size + p] += value;
                            }
                        }
                    }
                }
                columns[i].iter().for_each(|&p| right[p] += wall.right[i]);
            }
            cost += wall.square + wall.log_det;
        }
        cost += cholesky(&mut lower, size)?;
        let mut estimate = right;
        forward(&lower, size, &mut estimate, 1);
        cost -= estimate.iter().map(|v| v * v).sum::<f64>();
        for i in (0..size).rev() {
            let rest: f64 = (i + 1..size).map(|k| lower[k * size + i] * estimate[k]).sum();
            estimate[i] = (estimate[i] - rest) / lower[i * size + i];
        }
        cost.is_finite().then_some(Self { size, lower, estimate, cost })
    }

    /// What was asked of the walls, with `rows` of the border (asked times unknowns) added.
    pub fn answer(&self, rows: &[f64], walls: &[(&Reduced, &BorderColumns)]) -> Answer {
        let asked = rows.len() / self.size;
        let mut left = rows.to_vec();
        let (mut value, mut covariance) = (vec![0.0; asked], vec![0.0; asked * asked]);
        for (wall, columns) in walls {
            for (k, slope) in wall.slope.chunks_exact(wall.columns).enumerate() {
                for (s, of) in slope.iter().zip(*columns) {
                    of.iter().for_each(|&p| left[k * self.size + p] -= s);
                }
                value[k] += wall.value[k];
            }
            covariance.iter_mut().zip(&wall.covariance).for_each(|(a, b)| *a += b);
        }
        for (v, row) in value.iter_mut().zip(left.chunks_exact(self.size)) {
            *v += row.iter().zip(&self.estimate).map(|(a, b)| a * b).sum::<f64>();
        }
        let of_unevenness = (0..asked).map(|k| covariance[k * asked + k]).collect();
        let more = self.spread(&left);
        for i in 0..asked {
            for j in 0..asked {
                covariance[i * asked + j] += more[i.min(j) * asked + i.max(j)];
            }
        }
        Answer { value, covariance, of_unevenness }
    }

    /// Lets those groups of unknowns be 0 that so many observations do not ask for, by Schwarz's criterion, alone and together. The
    /// covariance stays: what they may be all the same is uncertain as before.
    ///
    /// Priors are wide, and waves of the walls look a little like every term; where a term is drawn on beyond the walls, one that is
    /// not there costs more than it is worth.
    pub fn make_plain(&mut self, groups: impl IntoIterator<Item = Vec<usize>>, observations: usize) {
        let mut all = vec![0.0; self.size * self.size];
        (0..self.size).for_each(|k| all[k * self.size + k] = 1.0);
        let covariance = self.spread(&all);
        let at = |i: usize, j: usize| covariance[i.min(j) * self.size + i.max(j)];
        // Where these are 0: how far they are from it together, `xᵀ C⁻¹ x`, and what that makes of all others.
        let with_zero = |zero: &[usize]| -> Option<(f64, DVector<f64>)> {
            let own = DMatrix::from_fn(zero.len(), zero.len(), |i, j| at(zero[i], zero[j]));
            let values = DVector::from_iterator(zero.len(), zero.iter().map(|k| self.estimate[*k]));
            let weights = own.cholesky()?.solve(&values);
            Some((values.dot(&weights), weights))
        };
        let price = |unknowns: usize| unknowns as f64 * (observations as f64).ln();
        let mut silent: Vec<(f64, Vec<usize>)> = groups
            .into_iter()
            .filter_map(|group| Some((with_zero(&group)?.0 - price(group.len()), group)))
            .filter(|(over, _)| *over < 0.0)
            .collect();
        silent.sort_by(|a, b| a.0.total_cmp(&b.0));
        while !silent.is_empty() {
            let zero: Vec<usize> = silent.iter().flat_map(|(_, group)| group.iter().copied()).collect();
            if let Some((off, weights)) = with_zero(&zero)
                && off < price(zero.len())
            {
                let moved = |k: usize| zero.iter().zip(&weights).map(|(z, w)| at(k, *z) * w).sum::<f64>();
                self.estimate = (0..self.size).map(|k| self.estimate[k] - moved(k)).collect();
                return;
            }
            silent.pop();
        }
    }

    /// Covariance of linear functions of the unknowns, one a row; the upper triangle.
    pub fn spread(&self, rows: &[f64]) -> Vec<f64> {
        let asked = rows.len() / self.size;
        if asked == 0 {
            return Vec::new();
        }
        let mut turned = vec![0.0; rows.len()];
        for (k, row) in rows.chunks_exact(self.size).enumerate() {
            row.iter().enumerate().for_each(|(p, v)| turned[p * asked + k] = *v);
        }
        forward(&self.lower, self.size, &mut turned, asked);
        let mut covariance = vec![0.0; asked * asked];
        add_gram(&mut covariance, &turned, asked);
        covariance
    }
}

/// A wall whose variances, of noise and unevenness, are all larger by a factor that is still to be found, beside another wall or none;
/// both have the border's unknowns for columns.
pub(super) struct Scaled<'a> {
    wall: &'a Reduced,
    beside: Option<&'a Reduced>,
    /// What the equations are built in.
    lower: Vec<f64>,
    right: Vec<f64>,
}

impl<'a> Scaled<'a> {
    pub fn new(wall: &'a Reduced, beside: Option<&'a Reduced>) -> Self {
        Self { wall, beside, lower: vec![0.0; wall.columns * wall.columns], right: vec![0.0; wall.columns] }
    }

    /// What [`Border::join`] says it costs, with this factor.
    pub fn cost(&mut self, log_factor: f64) -> Option<f64> {
        let (size, over) = (self.wall.columns, (-log_factor).exp());
        let mut cost = over * self.wall.square + self.wall.log_det + self.wall.cells as f64 * log_factor;
        for i in 0..size {
            for j in i..size {
                self.lower[j * size + i] = over * self.wall.information[i * size + j];
            }
            self.lower[i * size + i] += 1.0;
            self.right[i] = over * self.wall.right[i];
        }
        if let Some(beside) = self.beside {
            for i in 0..size {
                for j in i..size {
                    self.lower[j * size + i] += beside.information[i * size + j];
                }
                self.right[i] += beside.right[i];
            }
            cost += beside.square + beside.log_det;
        }
        cost += cholesky(&mut self.lower, size)?;
        forward(&self.lower, size, &mut self.right, 1);
        cost -= self.right.iter().map(|v| v * v).sum::<f64>();
        cost.is_finite().then_some(cost)
    }
}
