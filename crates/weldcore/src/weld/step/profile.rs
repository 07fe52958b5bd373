//! The profile along the seam: its bins, and how single ones depart from the model.

use super::cells::{Cell, LabelledShot, Stretch, is_wall};
use super::unevenness::Covariance;
use crate::ground::robust::median;
use crate::ground::threads;
use crate::weld::seam::Course;

/// A bin counts as seen when each wall has this part of the points of a typical bin: edges of the view fill bins partly.
const SEEN_PART: f64 = 0.1;
/// A bin's departure from the model counts from this many sigma.
const DEPARTURE_SIGMAS: f64 = 3.0;

/// One bin of the profile along the seam.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProfileBin {
    /// Its middle, as a reading ([`Course::reading`]).
    pub along: f64,
    /// Mean place of what was seen of the bin, as a reading.
    pub seen_along: f64,
    /// Both walls extrapolated to the seam's centreline.
    pub step_mm: f64,
    /// Standard uncertainty and its parts (k = 1).
    pub standard_mm: f64,
    /// From noise, unevenness and extrapolation.
    pub fit_mm: f64,
    /// From the choice of the strip beside the bead.
    pub toe_mm: f64,
    /// From a departure of the bin from the model.
    pub local_mm: f64,
    /// From what is not known of the place along the seam.
    pub place_mm: f64,
    /// From the walls' unevenness, which the seam itself need not share.
    pub unevenness_mm: f64,
}

/// Over the other wall's points of all shots.
pub(super) fn mean_and_median(shots: &[LabelledShot], deviations: &[Vec<f32>]) -> (f64, f64) {
    let other = |k: usize| {
        let labelled = shots[k].labels.iter().zip(&deviations[k]);
        labelled.filter(|(l, _)| is_wall(**l) == Some(true)).map(|(_, d)| *d)
    };
    let mut all: Vec<f32> = (0..shots.len()).flat_map(other).collect();
    if all.is_empty() {
        return (f64::NAN, f64::NAN);
    }
    let mean = all.iter().map(|d| f64::from(*d)).sum::<f64>() / all.len() as f64;
    (mean, f64::from(median(&mut all)))
}

/// A bin of the profile that both walls of a shot were seen in.
pub(super) struct SeenBin {
    pub(super) index: usize,
    pub(super) shot: usize,
    /// Mean place of what was seen.
    pub(super) at: f64,
}

/// In order along the seam; where several shots saw a bin, the one that saw most of it.
pub(super) fn seen_bins(course: Course, shots: &[LabelledShot]) -> Vec<SeenBin> {
    let bins = course.bins();
    let mut best: Vec<Option<(f64, SeenBin)>> = (0..bins).map(|_| None).collect();
    for (k, shot) in shots.iter().enumerate() {
        let parts = threads::map_ranges(shot.labels.len(), |range| {
            let mut sums = vec![[(0.0, 0.0); 2]; bins];
            for (a, l) in shot.unrolled.at[range.clone()].iter().zip(&shot.labels[range]) {
                if let Some(other) = is_wall(*l) {
                    let index = course.bin(f64::from(*a));
                    let off = course.apart(f64::from(*a), course.bin_middle(index));
                    let slot: &mut (f64, f64) = &mut sums[index][usize::from(other)];
                    *slot = (slot.0 + 1.0, slot.1 + off);
                }
            }
            sums
        });
        let mut sums = vec![[(0.0, 0.0); 2]; bins];
        for part in parts {
            for (slot, more) in sums.iter_mut().flatten().zip(part.iter().flatten()) {
                *slot = (slot.0 + more.0, slot.1 + more.1);
            }
        }
        let typical: [f64; 2] = std::array::from_fn(|w| {
            let mut counts: Vec<f64> = sums.iter().map(|s| s[w].0).filter(|n| *n > 0.0).collect();
            median(&mut counts)
        });
        for (index, walls) in sums.iter().enumerate() {
            if (0..2).any(|w| walls[w].0 < 1.0 || walls[w].0 < SEEN_PART * typical[w]) {
                continue;
            }
            let fullness = walls[0].0.min(walls[1].0);
            let off = (walls[0].1 / walls[0].0 + walls[1].1 / walls[1].0) / 2.0;
            let at = course.bin_middle(index) + off;
            if best[index].as_ref().is_none_or(|(n, _)| fullness > *n) {
                best[index] = Some((fullness, SeenBin { index, shot: k, at }));
            }
        }
    }
    best.into_iter().flatten().map(|(_, seen)| seen).collect()
}

/// How single bins depart from the smooth model.
pub(super) struct Departures<'a> {
    pub(super) course: Course,
    pub(super) stretches: &'a [Stretch],
    pub(super) cells: &'a [Cell],
    pub(super) residuals: &'a [f64],
    pub(super) covariance: &'a Covariance,
}

impl Departures<'_> {
    /// The departure of a bin's walls from the model, other minus reference, as far as it is significant, and its
    /// standard uncertainty. Between "within the noise" (0) and "far beyond it" (all of it) the passage is smooth.
    pub(super) fn of(&self, shot: usize, index: usize) -> (f64, f64) {
        let mine: Vec<usize> = (0..self.cells.len())
            .filter(|&i| self.cells[i].shot == shot && self.course.bin(self.cells[i].at) == index)
            .collect();
        let count = |other: bool| mine.iter().filter(|&&i| self.cells[i].other == other).count() as f64;
        let (reference, other) = (count(false), count(true));
        if reference == 0.0 || other == 0.0 {
            return (0.0, 0.0);
        }
        let weight = |c: &Cell| if c.other { 1.0 / other } else { -1.0 / reference };
        let terms: Vec<(Cell, f64)> = mine.iter().map(|&i| (self.cells[i], weight(&self.cells[i]))).collect();
        let departure: f64 = mine.iter().zip(&terms).map(|(&i, (_, w))| w * self.residuals[i]).sum();
        let sigma = self.covariance.variance_of(self.stretches, &terms).sqrt();
        let excess = 1.0 - (DEPARTURE_SIGMAS * sigma / departure).powi(2);
        if excess.is_finite() && excess > 0.0 { (excess * departure, sigma) } else { (0.0, 0.0) }
    }
}
