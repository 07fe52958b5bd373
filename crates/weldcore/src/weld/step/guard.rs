//! Whether the walls run on to the cap as they run further away.
//!
//! A dent or a flare beside the cap raises what counts as usual unevenness, and hides by that: kriging then shrinks what the
//! cap covers. So the walls are fitted without what lies nearest to the cap, with scales of their own, and what is nearest is
//! predicted from that, bin by bin. Where it is not met, what the cap hides cannot be told from the walls.

use super::fit::SeamEquations;
use crate::error::Result;
use crate::weld::kriging::{Asked, Cell, Scales};

/// What is left out beside the cap; of a short wall this part.
const LEFT_OUT_MM: f64 = 20.0;
const LEFT_OUT_PART: f64 = 0.4;
/// Cells that are predicted: within this of the wall's nearest ones, in rows.
const NEAREST_ROWS: f64 = 1.5;
/// Departures are counted in the band of all bins; a wall that runs on stays within this much of it.
const BAND: f64 = 1.3;
/// The band of one bin alone, and of very many.
const BAND_FACTORS: [f64; 2] = [2.8, 3.6];

/// What was found of the walls beside the cap.
pub(super) struct Guard {
    /// Per bin: the departure of the step beside the cap from what the walls further away predict, over its standard uncertainty.
    pub departures: Vec<Option<f64>>,
    /// What the walls are like further away.
    pub scales: [Scales; 2],
}

impl Guard {
    /// The departure from which on a wall does not run on, for bins whose band has this factor.
    pub fn limit(band_factor: f64) -> f64 {
        BAND * band_factor.clamp(BAND_FACTORS[0], BAND_FACTORS[1])
    }

    /// Of walls that nothing can be said of.
    pub fn none(bins: usize, scales: [Scales; 2]) -> Self {
        Self { departures: vec![None; bins], scales }
    }

    pub fn of(
        equations: &SeamEquations,
        near: [Scales; 2],
        rows_mm: [f64; 2],
        reach_mm: [[f64; 2]; 2],
    ) -> Result<Self> {
        let limits: [f64; 2] = std::array::from_fn(|k| {
            let [from, to] = reach_mm[k];
            from + LEFT_OUT_MM.min(LEFT_OUT_PART * (to - from))
        });
        let far = equations.only(|other, cell| cell.across_mm.abs() > limits[usize::from(other)]);
        let scales = far.scales(Some(near))?;
        // The nearest cells, and what is predicted in their places: other wall less reference wall where both have one.
        let nearest: [Vec<Option<Cell>>; 2] = std::array::from_fn(|k| {
            let mut found: Vec<Option<Cell>> = vec![None; equations.line.columns];
            let most = reach_mm[k][0] + NEAREST_ROWS * rows_mm[k];
            for cell in equations.walls[k].cells().iter().filter(|c| c.across_mm.abs() < most) {
                let slot = &mut found[cell.column];
                // Of several shots, the cell with the most points.
                if slot.is_none_or(|c| c.weight < cell.weight) {
                    *slot = Some(*cell);
                }
            }
            found
        });
        // One pair a bin: the one with the most points.
        let mut pairs: Vec<Option<(Cell, Cell)>> = vec![None; equations.columns.course.bins()];
        for (reference, other) in nearest[0].iter().zip(&nearest[1]).filter_map(|(a, b)| Some(((*a)?, (*b)?))) {
            let slot = &mut pairs[equations.columns.course.bin(equations.at(&other))];
            let less = |(a, b): &(Cell, Cell)| a.weight.min(b.weight) < reference.weight.min(other.weight);
            if slot.as_ref().is_none_or(less) {
                *slot = Some((reference, other));
            }
        }
        let pairs: Vec<(Cell, Cell)> = pairs.into_iter().flatten().collect();
        let mut departures = vec![None; equations.columns.course.bins()];
        if pairs.is_empty() {
            return Ok(Self { departures, scales });
        }
        let ask = |cell: &Cell, factor: f64| Asked { column: cell.column, across_mm: cell.across_mm, factor };
        let asked = [
            pairs.iter().map(|p| ask(&p.0, -1.0)).collect::<Vec<Asked>>(),
            pairs.iter().map(|p| ask(&p.1, 1.0)).collect::<Vec<Asked>>(),
        ];
        let mut rows = Vec::with_capacity(pairs.len() * equations.terms.count());
        for (reference, other) in &pairs {
            let minus = equations.terms.whole_row(false, reference, equations.at(reference));
            let plus = equations.terms.whole_row(true, other, equations.at(other));
            rows.extend(plus.iter().zip(minus).map(|(p, m)| p - m));
        }
        let predicted = far.solve(&scales, [&asked[0], &asked[1]], &rows)?.answer;
        for (k, (reference, other)) in pairs.iter().enumerate() {
            let noise = scales[0].noise / reference.weight + scales[1].noise / other.weight;
            let sigma = (predicted.covariance[k * pairs.len() + k] + noise).sqrt();
            let z = (other.height_mm - reference.height_mm - predicted.value[k]) / sigma;
            departures[equations.columns.course.bin(equations.at(other))] = Some(z);
        }
        Ok(Self { departures, scales })
    }
}
