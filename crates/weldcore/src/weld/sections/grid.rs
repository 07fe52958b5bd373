//! The unrolled view as cells: stations along the seam by bins across it, each with the median of its points.

use rayon::prelude::*;

use crate::error::{Error, Result, require_count};
use crate::ground::robust::{MEDIAN_TO_SIGMA, median, median_between};
use crate::ground::stop::polled;
use crate::ground::threads::{self, CHUNK};
use crate::weld::seam::{Course, Unrolled};

/// Bins across the seam, in point spacings, and their least and largest width: a toe is placed to about a bin.
const BIN_SPACINGS: f64 = 0.8;
const BIN_MM: [f64; 2] = [0.2, 0.8];
/// A coarse cloud gets wider bins, so that a cell holds so many points.
const POINTS_PER_CELL: f64 = 3.0;
/// A median of fewer points is a point.
const LEAST_POINTS: usize = 2;
/// Cells with so many points tell the noise.
const NOISE_POINTS: usize = 6;
/// The outermost points belong to the outermost stations.
const OUTERMOST: f64 = 0.5;
/// Of about so many.
const NOISE_CELLS: usize = 2000;
/// Of every so many points one tells how far the view reaches.
const RANGE_STRIDE: usize = 16;

/// Where a point lies in the grid.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Place {
    /// Along the seam from the middle of the view, mm.
    pub along: f64,
    /// Across the seam, mm.
    pub across: f64,
    /// Height over the frame's surface, mm.
    pub height: f64,
}

/// Stations by bins with medians.
#[derive(Debug, Clone)]
pub(crate) struct Grid {
    /// The middle of the view, in the seam's parameter.
    pub middle: f64,
    pub course: Course,
    pub start_along: f64,
    pub station_mm: f64,
    pub stations: usize,
    pub start_across: f64,
    pub bin_mm: f64,
    pub bins: usize,
    /// Median height per cell, station by station; NaN with fewer than two points.
    pub heights: Vec<f64>,
    /// Noise of one point across the wall, one sigma.
    pub noise_mm: f64,
    /// Noise of a cell's median.
    pub cell_sigma_mm: f64,
}

impl Grid {
    /// Cells of all points where the part is; `near_mm` tells which points are the part's when the extent of
    /// the view is sought (a cell takes points of any height: a deep dent is one of the part's places too).
    pub fn of(unrolled: &Unrolled, course: Course, near_mm: f64) -> Result<Self> {
        let near = |i: usize| f64::from(unrolled.height_mm[i].abs()) < near_mm;
        let n = unrolled.height_mm.len();
        let count = unrolled.height_mm.iter().filter(|d| f64::from(d.abs()) < near_mm).count();
        require_count("part points near the nominal pipe", 1000, count)?;
        let some = || (0..n).step_by(RANGE_STRIDE).filter(|&i| near(i));
        let mut grid = Self {
            middle: course.middle(some().map(|i| unrolled.at[i])),
            course,
            start_along: 0.0,
            station_mm: 1.0,
            stations: 1,
            start_across: 0.0,
            bin_mm: 1.0,
            bins: 1,
            heights: Vec::new(),
            noise_mm: 0.0,
            cell_sigma_mm: 0.0,
        };
        let places = some().map(|i| grid.place(unrolled, i));
        let (along, across): (Vec<f64>, Vec<f64>) = places.map(|p| (p.along, p.across)).unzip();
        let (along, across) = (inner_range(along), inner_range(across));
        let spacing = ((along.1 - along.0) * (across.1 - across.0) / count as f64).sqrt();
        if !(spacing.is_finite() && spacing > 0.0) {
            return Err(Error::Degenerate { what: "part", reason: "its points span no surface".into() });
        }
        grid.stations = (((along.1 - along.0) / course.station_mm()).round() as usize).clamp(1, 4096);
        grid.station_mm = (along.1 - along.0) / grid.stations as f64;
        grid.start_along = along.0;
        let filled = POINTS_PER_CELL * spacing * spacing / grid.station_mm;
        let bin = (BIN_SPACINGS * spacing).clamp(BIN_MM[0], BIN_MM[1]).max(filled);
        grid.bins = (((across.1 - across.0) / bin).round() as usize).clamp(16, 8192);
        grid.bin_mm = (across.1 - across.0) / grid.bins as f64;
        grid.start_across = across.0;
        grid.take_medians(unrolled);
        Ok(grid)
    }

    #[inline]
    pub fn place(&self, unrolled: &Unrolled, i: usize) -> Place {
        Place {
            along: self.course.along_mm(self.course.apart(f64::from(unrolled.at[i]), self.middle)),
            across: f64::from(unrolled.across_mm[i]),
            height: f64::from(unrolled.height_mm[i]),
        }
    }

    /// Tells the station of a place along the seam; what lies up to so many stations beyond the outermost ones belongs to those.
    pub fn stations_within(&self, beyond: f64) -> impl Fn(f64) -> Option<usize> + use<> {
        let (over, last) = (1.0 / self.station_mm, self.stations as i32 - 1);
        let (start, end) = (self.start_along, f64::from(last + 1) + beyond);
        move |along| {
            let k = (along - start) * over;
            (k > -beyond && k < end).then(|| (k.max(0.0) as i32).min(last) as usize)
        }
    }

    /// Middle of a station, in the seam's parameter.
    pub fn at(&self, station: usize) -> f64 {
        self.middle + self.course.difference(self.start_along + (station as f64 + 0.5) * self.station_mm)
    }

    /// Heights of one station.
    pub fn row(&self, station: usize) -> &[f64] {
        &self.heights[station * self.bins..(station + 1) * self.bins]
    }

    /// The median of each station and its neighbours: what is sought in it is longer than a station.
    pub fn smoothed(&self) -> Vec<f64> {
        let one = |k: usize| -> Vec<f64> {
            let rows: Vec<&[f64]> =
                (k.saturating_sub(1)..(k + 2).min(self.stations)).map(|other| self.row(other)).collect();
            (0..self.bins)
                .map(|j| {
                    let mut values: Vec<f64> = rows.iter().map(|r| r[j]).filter(|h| h.is_finite()).collect();
                    if values.is_empty() { f64::NAN } else { median(&mut values) }
                })
                .collect()
        };
        threads::install(|| (0..self.stations).into_par_iter().flat_map_iter(one).collect())
    }

    fn take_medians(&mut self, unrolled: &Unrolled) {
        let cells = self.stations * self.bins;
        let station = self.stations_within(OUTERMOST);
        let (over, bins) = (1.0 / self.bin_mm, self.bins as f64);
        let cell_of = |i: usize| {
            let p = self.place(unrolled, i);
            let k = (p.across - self.start_across) * over;
            (p.height.is_finite() && k >= 0.0 && k < bins).then_some(())?;
            Some(station(p.along)? * self.bins + k as i32 as usize)
        };
        // Points of no cell are those of one more.
        let mut cell: Vec<u32> = vec![0; unrolled.at.len()];
        threads::install(|| {
            cell.par_chunks_mut(CHUNK).inspect(polled).enumerate().for_each(|(k, part)| {
                part.iter_mut().enumerate().for_each(|(i, slot)| {
                    *slot = cell_of(k * CHUNK + i).unwrap_or(cells) as u32;
                });
            });
        });
        let mut starts = vec![0_usize; cells + 2];
        cell.iter().for_each(|cell| starts[*cell as usize + 1] += 1);
        (0..=cells).for_each(|k| starts[k + 1] += starts[k]);
        let mut sorted = vec![0.0_f32; cell.len()];
        let mut next = starts.clone();
        for (cell, height) in cell.iter().zip(&unrolled.height_mm) {
            let slot = &mut next[*cell as usize];
            sorted[*slot] = *height;
            *slot += 1;
        }
        let mut slices: Vec<&mut [f32]> = Vec::with_capacity(cells);
        let mut rest = sorted.as_mut_slice();
        for k in 0..cells {
            let (head, tail) = rest.split_at_mut(starts[k + 1] - starts[k]);
            slices.push(head);
            rest = tail;
        }
        // So many cells tell the noise as well as all do.
        let telling = (cells / NOISE_CELLS).max(1);
        let stats: Vec<(f64, f64, usize)> = threads::install(|| {
            let each = slices.into_par_iter().enumerate().with_min_len(64);
            each.map(|(k, values)| cell_statistics(values, k % telling == 0)).collect()
        });
        let mut noises: Vec<f64> = stats.iter().map(|s| s.1).filter(|s| s.is_finite()).collect();
        let mut counts: Vec<f64> = stats.iter().filter(|s| s.0.is_finite()).map(|s| s.2 as f64).collect();
        self.heights = stats.iter().map(|s| s.0).collect();
        self.noise_mm = if noises.len() >= 20 { median(&mut noises) } else { self.noise_between_cells() };
        // The median of n normal values scatters by 1.25 / sqrt(n) sigma.
        self.cell_sigma_mm = 1.25 * self.noise_mm / median(&mut counts).max(1.0).sqrt();
    }

    /// Where cells hold too few points: second differences of neighbouring medians, which a smooth surface leaves at zero.
    fn noise_between_cells(&self) -> f64 {
        let mut bends: Vec<f64> = (0..self.stations)
            .flat_map(|k| self.row(k).windows(3).map(|w| (w[0] - 2.0 * w[1] + w[2]).abs()))
            .filter(|b| b.is_finite())
            .collect();
        if bends.is_empty() { 0.0 } else { MEDIAN_TO_SIGMA * median(&mut bends) / 6f64.sqrt() }
    }
}

/// Median, noise of one point (NaN with too few, and where it is not asked for), and count.
fn cell_statistics(values: &mut [f32], with_noise: bool) -> (f64, f64, usize) {
    let n = values.len();
    if n < LEAST_POINTS {
        return (f64::NAN, f64::NAN, n);
    }
    let m = median_between(values);
    if n < NOISE_POINTS || !with_noise {
        return (m, f64::NAN, n);
    }
    values.iter_mut().for_each(|v| *v = (*v - m as f32).abs());
    // Of few values the MAD is too small by about this factor (Croux and Rousseeuw, COMPSTAT 1992, 411).
    (m, MEDIAN_TO_SIGMA * median_between(values) * n as f64 / (n as f64 - 0.8), n)
}

/// The range of values without its outermost thousandth on either side: stray points do not stretch the view.
fn inner_range(mut values: Vec<f64>) -> (f64, f64) {
    let cut = values.len() / 1000;
    let last = values.len() - 1 - cut;
    let low = *values.select_nth_unstable_by(cut, f64::total_cmp).1;
    let high = *values.select_nth_unstable_by(last, f64::total_cmp).1;
    (low, high)
}
