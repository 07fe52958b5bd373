//! What one station shows and its neighbours do not: a misalignment as short as a station, or merely a drop of spatter.

use super::station::Station;
use super::view::View;
use super::walls::TOLERANCE_MM;
use crate::ground::robust::median;

/// Surfaces are compared from so far beside the toes on, which wander,
const CLEAR_MM: f64 = 1.0;
/// over so much of them: metal that only lies on the wall is no wider than this, most of it; nothing that lies on a wall
/// makes a hollow.
const LOWERED_MM: f64 = 3.5;
const RAISED_MM: f64 = 7.0;
/// Of which this part must be seen.
const SEEN_PART: f64 = 0.5;
/// Standard deviations of the median difference below which it is noise: one of 10,000 stations.
const NOISE: f64 = 4.0;
/// A median scatters by so much more than a mean.
const MEDIAN_EFFICIENCY: f64 = 1.25;

impl View<'_> {
    /// How far the step between the surfaces beside the weld is off that of the two neighbours, read at the same places: 0
    /// where it is no more than noise or unevenness; `None` where they do not show it.
    pub(super) fn local_step(&self, stations: &[Station], k: usize) -> Option<f64> {
        let three: [[f64; 2]; 3] = if k == 0 || k + 1 >= stations.len() {
            return None;
        } else {
            let [before, own, after] = [k - 1, k, k + 1].map(|i| stations[i].toes_mm);
            [before?, own?, after?]
        };
        let sides = [0, 1].map(|side| {
            let outward = |t: &[f64; 2]| if side == 0 { -t[0] } else { t[1] };
            let toe = three.iter().map(outward).fold(f64::NEG_INFINITY, f64::max);
            let lowered = self.beside(k, side, toe, LOWERED_MM)?;
            if lowered < 0.0 { Some(lowered) } else { self.beside(k, side, toe, RAISED_MM) }
        });
        match sides {
            [None, None] => None,
            [reference, other] => Some(other.unwrap_or(0.0) - reference.unwrap_or(0.0)),
        }
    }

    /// How far a station's surface lies beyond those of both neighbours over a stretch beside the toe: the median difference
    /// to the nearer one.
    fn beside(&self, k: usize, side: usize, toe: f64, length: f64) -> Option<f64> {
        let own = &self.own[k][side];
        let (from, to) = (own.boundary(toe + CLEAR_MM), own.boundary(toe + CLEAR_MM + length));
        let off = |neighbour: usize| {
            let heights = &self.own[neighbour][side].heights;
            let mut off: Vec<f64> = (from..to).map(|i| own.heights[i] - heights[i]).filter(|d| d.is_finite()).collect();
            if off.is_empty() || (off.len() as f64) < SEEN_PART * own.in_bins(length) as f64 {
                return None;
            }
            let noise = MEDIAN_EFFICIENCY * self.sigma * (2.0 / off.len() as f64).sqrt();
            let off = median(&mut off);
            Some(if off.abs() > TOLERANCE_MM.max(NOISE * noise) { off } else { 0.0 })
        };
        let (before, after) = (off(k - 1)?, off(k + 1)?);
        Some(if before * after <= 0.0 { 0.0 } else { before.signum() * before.abs().min(after.abs()) })
    }
}
