//! The camera's noise, from the fringe images themselves.
//!
//! The variance of a grey level is `read² + 1/12 + gain · level`: electronics, rounding, photons. To see it, one needs
//! a number that is zero but for noise at every pixel, whatever the surface, the projector's gamma and the light that
//! walls throw on each other. With two or more fringe sets that is the difference of their backgrounds: the mean over
//! the steps of a set does not depend on its frequency. With one set of four or more steps it is the part of its
//! samples at the highest harmonic that the steps can tell. One set of three steps leaves nothing over: then the
//! background itself must do, and the surface's texture counts as noise (an upper bound).
//!
//! What is left of smooth model errors goes away in the difference between neighbours, taken across or along the image,
//! whichever is quieter: along a fringe the phase hardly changes. Everything else that such a difference may hold
//! (edges, glints, movement, light that flickers between walls) only adds to it. So the variance is taken from small
//! runs of pixels, the quiet tenth of the runs speaks for its band of grey levels, corrected by the quantile of chi²,
//! and a line is fitted to the bands.

use rayon::prelude::*;

use super::shot::{FringeSet, Shot, starts};
use super::wave::{Level, Wave};
use crate::ground::stop::polled;
use crate::ground::threads;

/// Variance of rounding to whole grey levels.
pub(crate) const ROUNDING: f64 = 1.0 / 12.0;
/// Pairs of neighbouring rows that are looked at, spread over the image: some 30,000 pixels of a usual camera, which
/// give the standard deviation in each band to a few per cent.
const ROW_PAIRS: usize = 24;
/// Bands of grey level.
const BANDS: usize = 16;
/// Differences in a run.
const RUN: usize = 16;
/// A band with fewer runs says nothing.
const FEWEST: usize = 20;
/// The quantile of the runs' variances that speaks for them, and where chi² over its 16 degrees of freedom has it.
const QUIET: f64 = 0.1;
const QUIET_CHI2: f64 = 0.582_0;
/// A band that misses the line by this share of its variance counts half: bands that few surfaces fill may hold little
/// but edges.
const BAND_MISS: f64 = 0.5;

/// What the noise was estimated from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NoiseSource {
    /// The differences between the backgrounds of the fringe sets.
    Backgrounds,
    /// The residuals of the one fringe set.
    Residuals,
    /// The neighbour differences of the background, texture included: an upper bound.
    Texture,
    /// Too few usable pixels: one grey level was assumed.
    Assumed,
}

impl NoiseSource {
    /// One word for it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Backgrounds => "backgrounds",
            Self::Residuals => "residuals",
            Self::Texture => "texture",
            Self::Assumed => "assumed",
        }
    }
}

/// Variance of a grey level: `read_variance + 1/12 + gain * level`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraNoise {
    /// Of the electronics, grey levels squared.
    pub read_variance: f64,
    /// Grey levels per detected photon, more or less.
    pub gain: f64,
    /// What it was estimated from.
    pub source: NoiseSource,
}

impl CameraNoise {
    /// The standard deviation of a grey level of this brightness.
    pub fn sigma(&self, level: f64) -> f64 {
        (self.floor() + self.gain * level.max(0.0)).sqrt()
    }

    pub(crate) fn floor(&self) -> f64 {
        self.read_variance + ROUNDING
    }
}

/// A combination of the frames of an exposure that is zero but for noise: frames and weights, whose squares add to one.
struct Contrast {
    weights: Vec<(usize, f32)>,
}

impl Contrast {
    fn new(weights: impl Iterator<Item = (usize, f32)> + Clone) -> Self {
        let power: f32 = weights.clone().map(|(_, w)| w * w).sum();
        Self { weights: weights.map(|(k, w)| (k, w / power.sqrt())).collect() }
    }
}

fn contrasts(sets: &[FringeSet]) -> (Vec<Contrast>, NoiseSource) {
    let starts = starts(sets);
    let mean = |at: usize, steps: usize, sign: f32| (at..at + steps).map(move |k| (k, sign / steps as f32));
    let ranges: Vec<(usize, usize)> = starts.iter().copied().zip(sets.iter().map(|s| s.steps)).collect();
    if let [(_, steps)] = ranges.as_slice() {
        let steps = *steps;
        if steps == 3 {
            return (vec![Contrast::new(mean(0, 3, 1.0))], NoiseSource::Texture);
        }
        let wave = Wave::new(steps);
        let highest = |k: usize| wave.cos.get(k * (steps / 2) % steps).map_or(0.0, |&c| c as f32);
        return (vec![Contrast::new((0..steps).map(|k| (k, highest(k))))], NoiseSource::Residuals);
    }
    let pairs = ranges.windows(2).filter_map(|w| match w {
        &[(a, n), (b, m)] => Some(Contrast::new(mean(a, n, 1.0).chain(mean(b, m, -1.0)))),
        _ => None,
    });
    (pairs.collect(), NoiseSource::Backgrounds)
}

/// Variances of runs of neighbour differences, by grey level.
#[derive(Default)]
struct Bands {
    /// Level and mean square of each run.
    runs: [Vec<(f64, f64)>; BANDS],
    /// The run that is being filled: count, sum of levels, sum of squares.
    open: (usize, f64, f64),
}

impl Bands {
    fn add(&mut self, level: f32, difference: f32, top: f32) {
        let (count, levels, squares) = &mut self.open;
        *count += 1;
        *levels += f64::from(level);
        *squares += f64::from(difference).powi(2);
        if *count == RUN {
            let (level, square) = (*levels / RUN as f64, *squares / RUN as f64);
            let band = ((level / f64::from(top) * BANDS as f64) as usize).min(BANDS - 1);
            if let Some(runs) = self.runs.get_mut(band) {
                runs.push((level, square));
            }
            self.open = (0, 0.0, 0.0);
        }
    }

    fn append(&mut self, other: Self) {
        for (mine, theirs) in self.runs.iter_mut().zip(other.runs) {
            mine.extend(theirs);
        }
    }

    /// A run holds neighbours only: it ends where the pixels do.
    fn end_run(&mut self) {
        self.open = (0, 0.0, 0.0);
    }

    /// (level, variance, count) of each band; of all together where no band has enough.
    fn variances(self) -> Vec<(f64, f64, f64)> {
        let (full, sparse): (Vec<_>, Vec<_>) = self.runs.into_iter().partition(|runs| runs.len() >= FEWEST);
        if full.is_empty() {
            let all = sparse.concat();
            return if all.is_empty() { Vec::new() } else { vec![quiet(all)] };
        }
        full.into_iter().map(quiet).collect()
    }
}

/// (level, variance, count) of the quiet tenth of the runs, of which there is one at least.
fn quiet(mut runs: Vec<(f64, f64)>) -> (f64, f64, f64) {
    let n = runs.len() as f64;
    let level = runs.iter().map(|r| r.0).sum::<f64>() / n;
    let variance = runs.select_nth_unstable_by((QUIET * n) as usize, |a, b| a.1.total_cmp(&b.1)).1.1;
    (level, variance / QUIET_CHI2, n)
}

/// The line through the bands: variance = floor + gain · level, floor at least that of rounding, gain at least zero.
fn fit_line(bands: &[(f64, f64, f64)]) -> Option<(f64, f64)> {
    let count: f64 = bands.iter().map(|b| b.2).sum();
    let mean = bands.iter().map(|b| b.1 * b.2).sum::<f64>() / count;
    if !mean.is_finite() {
        return None;
    }
    let (mut floor, mut gain) = (mean, 0.0);
    for _ in 0..10 {
        let (mut sw, mut sx, mut sy, mut sxx, mut sxy) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for &(x, y, n) in bands {
            // The variance of a variance v that was estimated from n samples is 2 v²/n.
            let expected = (floor + gain * x).max(ROUNDING);
            let w = n / expected.powi(2) / (1.0 + ((y / expected - 1.0) / BAND_MISS).powi(2));
            (sw, sx, sy, sxx, sxy) = (sw + w, sx + w * x, sy + w * y, sxx + w * x * x, sxy + w * x * y);
        }
        let det = sw * sxx - sx * sx;
        if det > 1e-9 * sw * sxx {
            (floor, gain) = ((sxx * sy - sx * sxy) / det, (sw * sxy - sx * sy) / det);
        } else {
            (floor, gain) = (sy / sw, 0.0);
        }
        if floor < ROUNDING {
            (floor, gain) = (ROUNDING, (sxy - ROUNDING * sx) / sxx);
        }
        if gain.is_nan() || gain < 0.0 {
            (floor, gain) = ((sy / sw).max(ROUNDING), 0.0);
        }
    }
    (floor.is_finite() && gain.is_finite()).then_some((floor, gain))
}

/// The noise model of a shot.
pub(crate) fn estimate<T: Level>(shot: &Shot<'_, T>, sets: &[FringeSet], saturation: f32) -> CameraNoise {
    let (contrasts, source) = contrasts(sets);
    let rows: Vec<usize> = sample_rows(shot.height).collect();
    let look = |row: &usize| {
        let (mut across, mut along) = (Bands::default(), Bands::default());
        for frames in &shot.exposures {
            for contrast in &contrasts {
                let pair = [*row, *row + 1].map(|r| Row::of(frames, contrast, r, shot.width));
                pair_differences(&pair, saturation, &mut across, &mut along);
            }
        }
        [across, along]
    };
    let found: Vec<[Bands; 2]> = threads::install(|| rows.par_iter().inspect(polled).map(look).collect());
    let (mut across, mut along) = (Bands::default(), Bands::default());
    for [a, b] in found {
        across.append(a);
        along.append(b);
    }
    let quieter = [across, along]
        .map(Bands::variances)
        .into_iter()
        .filter(|bands| !bands.is_empty())
        .min_by(|a, b| mean_variance(a).total_cmp(&mean_variance(b)));
    // A difference of two samples has twice the variance of one.
    let line = quieter.and_then(|bands| fit_line(&bands.iter().map(|&(x, v, n)| (x, 0.5 * v, n)).collect::<Vec<_>>()));
    match line {
        Some((floor, gain)) => CameraNoise { read_variance: (floor - ROUNDING).max(0.0), gain, source },
        None => CameraNoise { read_variance: 1.0 - ROUNDING, gain: 0.0, source: NoiseSource::Assumed },
    }
}

fn mean_variance(bands: &[(f64, f64, f64)]) -> f64 {
    let count: f64 = bands.iter().map(|b| b.2).sum();
    bands.iter().map(|b| b.1 * b.2).sum::<f64>() / count
}

/// The upper rows of the pairs that are looked at.
pub(crate) fn sample_rows(height: usize) -> impl Iterator<Item = usize> {
    let pairs = ROW_PAIRS.min(height / 2);
    (0..pairs).map(move |i| i * (height - 2) / pairs.max(2).saturating_sub(1)).filter(move |r| r + 1 < height)
}

/// The contrast along one row, with the mean and extreme levels of the frames that take part.
struct Row {
    value: Vec<f32>,
    mean: Vec<f32>,
    low: Vec<f32>,
    high: Vec<f32>,
}

impl Row {
    fn of<T: Level>(frames: &[&[T]], contrast: &Contrast, row: usize, width: usize) -> Self {
        let zero = vec![0.0f32; width];
        let mut out = Self { value: zero.clone(), mean: zero.clone(), low: vec![f32::INFINITY; width], high: zero };
        for &(k, weight) in &contrast.weights {
            let pixels = frames.get(k).and_then(|f| f.get(row * width..(row + 1) * width)).unwrap_or_default();
            let columns = out.value.iter_mut().zip(&mut out.mean).zip(out.low.iter_mut().zip(&mut out.high));
            for (&pixel, ((value, mean), (low, high))) in pixels.iter().zip(columns) {
                let v: f32 = pixel.into();
                *value += weight * v;
                *mean += v;
                *low = if v < *low { v } else { *low };
                *high = if v > *high { v } else { *high };
            }
        }
        let n = contrast.weights.len() as f32;
        out.mean.iter_mut().for_each(|m| *m /= n);
        out
    }

    /// Value and mean level of a pixel that clips neither at the bottom nor at the top.
    fn at(&self, i: usize, saturation: f32) -> Option<(f32, f32)> {
        let clear = *self.low.get(i)? > 0.0 && *self.high.get(i)? < saturation;
        clear.then_some((*self.value.get(i)?, *self.mean.get(i)?))
    }
}

fn pair_differences(pair: &[Row; 2], saturation: f32, across: &mut Bands, along: &mut Bands) {
    let [upper, lower] = pair;
    for i in 0..upper.value.len() {
        let Some((here, level)) = upper.at(i, saturation) else {
            across.end_run();
            along.end_run();
            continue;
        };
        if let Some((below, other)) = lower.at(i, saturation) {
            along.add(0.5 * (level + other), here - below, saturation);
        }
        // Every other pixel, so that no two differences share one.
        if i % 2 == 0
            && let Some((right, other)) = upper.at(i + 1, saturation)
        {
            across.add(0.5 * (level + other), here - right, saturation);
        }
    }
    across.end_run();
    along.end_run();
}
