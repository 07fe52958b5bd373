//! A few pixels of an exposure that stand clear of the noise: what is read again under each hypothesis.

use std::f64::consts::TAU;

use super::super::noise::{CameraNoise, sample_rows};
use super::super::shot::{FringeSet, starts};
use super::super::wave::Level;

/// Pixels in a run, and how many runs a row is looked at in: memory comes in lines of so many pixels.
const RUN: usize = 8;
const RUNS_PER_ROW: usize = 6;
/// Half the swing of a set's frames over the noise, from which a pixel speaks: its phase then has 0.07 rad at most.
const CLEAR: f32 = 10.0;
/// Fewer pixels say nothing: the mean of as many random phases is below 0.25 in all but one of ten thousand.
pub(super) const FEWEST: usize = 150;

/// Clear pixels of one exposure.
pub(super) struct ClearPixels {
    /// Per frame the level of every pixel.
    pub(super) levels: Vec<Vec<f32>>,
    /// Variance of a level of each pixel.
    pub(super) variance: Vec<f32>,
    /// Column and row of each pixel.
    pub(super) places: Vec<(usize, usize)>,
    /// Half the swing in each set, by set, then pixel.
    pub(super) swing: Vec<Vec<f32>>,
}

impl ClearPixels {
    pub(super) fn len(&self) -> usize {
        self.places.len()
    }

    /// Whether the set stands clear of the noise in the pixel.
    pub(super) fn clear(&self, set: usize, i: usize) -> bool {
        self.swing[set][i] >= CLEAR * self.variance[i].sqrt()
    }

    /// The variance of the set's phase there, turns², by its swing.
    pub(super) fn phase_variance(&self, set: usize, steps: usize, i: usize) -> f64 {
        let b = f64::from(self.swing[set][i]).max(1e-6);
        2.0 / steps as f64 * f64::from(self.variance[i]) / (b * b) / TAU.powi(2)
    }

    pub(super) fn keep(&self, wanted: impl Fn(usize) -> bool) -> Self {
        let take = |v: &Vec<f32>| (0..self.len()).filter(|&i| wanted(i)).map(|i| v[i]).collect::<Vec<f32>>();
        Self {
            levels: self.levels.iter().map(take).collect(),
            variance: take(&self.variance),
            places: (0..self.len()).filter(|&i| wanted(i)).map(|i| self.places[i]).collect(),
            swing: self.swing.iter().map(take).collect(),
        }
    }
}

/// Runs of pixels along the rows at which the noise was taken, which are in the cache.
pub(super) fn clear_pixels<T: Level>(
    frames: &[&[T]],
    width: usize,
    height: usize,
    sets: &[FringeSet],
    noise: &CameraNoise,
    top: f32,
) -> ClearPixels {
    let mut places = Vec::new();
    let runs = RUNS_PER_ROW.min(width / RUN).max(1);
    for (number, row) in sample_rows(height).enumerate() {
        for run in 0..runs {
            // The runs of a row stand between those of the row before.
            let room = width.saturating_sub(RUN);
            let x = (room * run / runs + (number * 5 % 8) * room / (8 * runs)).min(room);
            places.extend((x..(x + RUN).min(width)).map(|x| (x, row)));
        }
    }
    let level = |frame: &&[T], (x, y): (usize, usize)| -> f32 { frame.get(y * width + x).map_or(0.0, |&v| v.into()) };
    let levels: Vec<Vec<f32>> = frames.iter().map(|f| places.iter().map(|&p| level(f, p)).collect()).collect();
    let n = places.len();
    let (mut swing, mut highest, mut mean) = (Vec::new(), vec![0.0f32; n], vec![0.0f32; n]);
    for (set, start) in sets.iter().zip(starts(sets)) {
        let (mut low, mut high) = (vec![f32::INFINITY; n], vec![0.0f32; n]);
        for frame in levels.get(start..start + set.steps).unwrap_or_default() {
            for i in 0..n {
                low[i] = low[i].min(frame[i]);
                high[i] = high[i].max(frame[i]);
                mean[i] += frame[i] / frames.len() as f32;
            }
        }
        for i in 0..n {
            highest[i] = highest[i].max(high[i]);
        }
        swing.push((0..n).map(|i| 0.5 * (high[i] - low[i])).collect::<Vec<f32>>());
    }
    let variance: Vec<f32> = mean.iter().map(|&m| (noise.sigma(f64::from(m)) as f32).powi(2)).collect();
    let all = ClearPixels { levels, variance, places, swing };
    all.keep(|i| highest[i] < top && (0..sets.len()).any(|s| all.clear(s, i)))
}
