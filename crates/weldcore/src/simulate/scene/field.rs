//! Random surfaces and curves around a pipe: white noise on nodes, smoothed to a Gaussian covariance, between the nodes a
//! cubic B-spline. Each is smooth, closes around the pipe, and is the same on any number of threads.

use std::f64::consts::TAU;

use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::ground::memory::require;
use crate::ground::random::{mix, normals};
use crate::ground::stop::polled;
use crate::ground::threads;

/// Nodes per correlation length: the spline then follows the field to a thousandth of its sd.
const NODES_PER_LENGTH: f64 = 5.0;
/// Nodes around a pipe, at least: a spline needs four.
const FEWEST: usize = 8;
/// The kernel ends at so many of its own sigmas.
const REACH: f64 = 4.0;
/// Larger grids are a mistake (a correlation length in metres), and would take the memory.
const MOST_NODES: usize = 1 << 23;

/// Unevenness of a wall: a Gaussian process with the covariance `sd² exp(-½ (da/around)² - ½ (dz/along)²)`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Unevenness {
    /// Standard deviation, mm.
    pub sd_mm: f64,
    /// Correlation length around the pipe, mm.
    pub around_mm: f64,
    /// Correlation length along the pipe, mm.
    pub along_mm: f64,
}

/// Something that varies around the pipe: a Gaussian process of one dimension.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wander {
    /// Standard deviation, mm.
    pub sd_mm: f64,
    /// Correlation length around the pipe, mm.
    pub length_mm: f64,
}

/// Weights of white noise for one direction, normalised so that the spline has unit variance.
#[derive(Debug, Clone)]
struct Smoothing {
    taps: Vec<f64>,
    reach: usize,
}

impl Smoothing {
    /// `length` is the correlation length in node distances.
    fn new(length: f64) -> Self {
        // White noise under a Gaussian of variance L²/2 has the covariance exp(-½ (d/L)²); the cubic spline itself
        // smooths by a third of a node distance squared.
        let sigma = (0.5 * length * length - 1.0 / 3.0).max(1e-6).sqrt();
        let reach = (REACH * sigma).ceil() as usize;
        let gauss = |k: f64| (-0.5 * (k / sigma).powi(2)).exp();
        let taps: Vec<f64> = (0..=2 * reach).map(|k| gauss(k as f64 - reach as f64)).collect();
        Self { taps, reach }
    }

    /// Divides by the standard deviation of the spline through noise that repeats after `period` nodes (0: never).
    fn normalised(mut self, period: usize) -> Self {
        let size = if period == 0 { self.taps.len() + 2 } else { period };
        let mut seen = vec![0.0; size];
        for (k, tap) in self.taps.iter().enumerate() {
            for (j, share) in [1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0].into_iter().enumerate() {
                if let Some(sum) = seen.get_mut((k + j) % size) {
                    *sum += share * tap;
                }
            }
        }
        let sd = seen.iter().map(|v| v * v).sum::<f64>().sqrt();
        self.taps.iter_mut().for_each(|t| *t /= sd);
        self
    }

    fn closed(&self, noise: &[f64]) -> Vec<f64> {
        let count = noise.len();
        let start = |i: usize| i + count * self.reach.div_ceil(count) - self.reach;
        let at = |i: usize| noise.get(i % count).copied().unwrap_or(0.0);
        (0..count).map(|i| self.taps.iter().enumerate().map(|(k, tap)| tap * at(start(i) + k)).sum()).collect()
    }
}

/// The four weights of a cubic B-spline at the place `u` between its two middle nodes.
#[inline]
fn spline(u: f64) -> [f64; 4] {
    let (v, u2) = (1.0 - u, u * u);
    let (u3, v2) = (u2 * u, v * v);
    [v2 * v / 6.0, (3.0 * u3 - 6.0 * u2 + 4.0) / 6.0, (3.0 * v2 * v - 6.0 * v2 + 4.0) / 6.0, u3 / 6.0]
}

/// Draw `number` of the stream `seed`.
fn noise(seed: u64, number: usize) -> f64 {
    f64::from(normals().draw(mix(seed ^ mix(number as u64))))
}

/// An angle of -π to 2π, as they come, from 0 to 2π: cheaper than a remainder.
#[inline]
fn turn(angle: f64) -> f64 {
    match angle {
        a if (0.0..TAU).contains(&a) => a,
        a if (-TAU..0.0).contains(&a) => a + TAU,
        a => a.rem_euclid(TAU),
    }
}

/// How many nodes stand around the pipe for a correlation length.
fn nodes_around(radius_mm: f64, length_mm: f64) -> usize {
    ((TAU * radius_mm * NODES_PER_LENGTH / length_mm).ceil() as usize).max(FEWEST)
}

/// A random surface over angle and place along the pipe.
#[derive(Debug, Clone)]
pub(super) struct Field {
    around: usize,
    along: usize,
    per_rad: f64,
    per_mm: f64,
    half_length_mm: f64,
    nodes: Vec<f64>,
}

impl Field {
    /// # Errors
    /// [`Error::OutOfRange`] where the correlation lengths are so short that the grid would take the memory.
    pub(super) fn new(radius_mm: f64, half_length_mm: f64, of: &Unevenness, seed: u64) -> Result<Self> {
        let around = nodes_around(radius_mm, of.around_mm);
        let per_mm = NODES_PER_LENGTH / of.along_mm;
        let along = (2.0 * half_length_mm * per_mm).ceil() as usize + 4;
        if around.saturating_mul(along) > MOST_NODES {
            let value = format!("{} and {} mm", of.around_mm, of.along_mm);
            let expected = format!("long enough for {MOST_NODES} nodes");
            return Err(Error::OutOfRange { what: "unevenness around_mm and along_mm", expected, value });
        }
        require(around * (along + 64), 40);
        let per_rad = around as f64 / TAU;
        let ring = Smoothing::new(of.around_mm * per_rad / radius_mm).normalised(around);
        let line = Smoothing::new(of.along_mm * per_mm).normalised(0);
        // Rows beyond both ends feed the kernel.
        let row = |i: usize| -> Vec<f64> {
            ring.closed(&(0..around).map(|j| noise(seed, i * around + j)).collect::<Vec<_>>())
        };
        let rows: Vec<Vec<f64>> =
            threads::install(|| (0..along + 2 * line.reach).into_par_iter().inspect(polled).map(row).collect());
        let smooth = |i: usize| -> Vec<f64> {
            let mut sum = vec![0.0; around];
            for (tap, row) in line.taps.iter().zip(rows.iter().skip(i)) {
                sum.iter_mut().zip(row).for_each(|(s, v)| *s += of.sd_mm * tap * v);
            }
            sum
        };
        let nodes: Vec<Vec<f64>> =
            threads::install(|| (0..along).into_par_iter().inspect(polled).map(smooth).collect());
        Ok(Self { around, along, per_rad, per_mm, half_length_mm, nodes: nodes.concat() })
    }

    #[inline]
    pub(super) fn at(&self, angle: f64, z: f64) -> f64 {
        let x = turn(angle) * self.per_rad;
        let y = ((z + self.half_length_mm) * self.per_mm).clamp(0.0, (self.along - 4) as f64);
        let (i, j) = (x as usize, (y as usize).min(self.along - 4));
        let (across, down) = (spline(x - i as f64), spline(y - j as f64));
        let mut sum = 0.0;
        for (k, w) in down.iter().enumerate() {
            let start = (j + k) * self.around;
            let row = match self.nodes.get(start + i..start + i + 4) {
                Some(&[a, b, c, d]) if i + 4 <= self.around => [a, b, c, d],
                _ => [0, 1, 2, 3].map(|m| self.nodes.get(start + (i + m) % self.around).copied().unwrap_or(0.0)),
            };
            sum += w * (across[0] * row[0] + across[1] * row[1] + across[2] * row[2] + across[3] * row[3]);
        }
        sum
    }
}

/// A random curve around the pipe.
#[derive(Debug, Clone)]
pub(super) struct Curve {
    per_rad: f64,
    nodes: Vec<f64>,
}

impl Curve {
    pub(super) fn new(radius_mm: f64, of: &Wander, seed: u64) -> Self {
        if of.sd_mm == 0.0 {
            return Self { per_rad: 0.0, nodes: Vec::new() };
        }
        let count = nodes_around(radius_mm, of.length_mm);
        let per_rad = count as f64 / TAU;
        let kernel = Smoothing::new(of.length_mm * per_rad / radius_mm).normalised(count);
        let nodes = kernel.closed(&(0..count).map(|j| of.sd_mm * noise(seed, j)).collect::<Vec<_>>());
        Self { per_rad, nodes }
    }

    #[inline]
    pub(super) fn at(&self, angle: f64) -> f64 {
        if self.nodes.is_empty() {
            return 0.0;
        }
        let x = turn(angle) * self.per_rad;
        let i = x as usize;
        let weights = spline(x - i as f64);
        let at = |m: usize| self.nodes.get((i + m) % self.nodes.len()).copied().unwrap_or(0.0);
        (0..4).map(|m| weights.get(m).copied().unwrap_or(0.0) * at(m)).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn variance(values: &[f64]) -> f64 {
        values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64
    }

    #[test]
    fn a_field_has_its_sd_and_its_correlation_lengths() {
        let of = Unevenness { sd_mm: 0.02, around_mm: 6.0, along_mm: 15.0 };
        let fields: Vec<Field> = (0..6).map(|s| Field::new(200.0, 150.0, &of, s).unwrap()).collect();
        let places: Vec<(f64, f64)> =
            (0..400).flat_map(|i| (0..20).map(move |j| (0.0157 * f64::from(i), 14.0 * f64::from(j) - 140.0))).collect();
        let at = |da: f64, dz: f64| -> Vec<f64> {
            fields.iter().flat_map(|f| places.iter().map(move |&(a, z)| f.at(a + da / 200.0, z + dz))).collect()
        };
        let here = at(0.0, 0.0);
        let all = variance(&here);
        // Some 200 x 20 x 6 / 10 independent values: 3 % is more than four standard errors.
        assert!((all / 0.0004 - 1.0).abs() < 0.06, "{all}");
        for (da, dz, expected) in
            [(6.0, 0.0, -0.5f64), (0.0, 15.0, -0.5), (3.0, 0.0, -0.125), (9.0, 0.0, -1.125), (6.0, 15.0, -1.0)]
        {
            let there = at(da, dz);
            let product = here.iter().zip(&there).map(|(a, b)| a * b).sum::<f64>() / here.len() as f64;
            assert!((product / all - expected.exp()).abs() < 0.06, "{da} {dz}: {}", product / all);
        }
    }

    #[test]
    fn a_field_closes_and_is_smooth() {
        let of = Unevenness { sd_mm: 0.02, around_mm: 40.0, along_mm: 40.0 };
        let field = Field::new(12.5, 60.0, &of, 3).unwrap();
        assert!((field.at(-1e-9, 3.0) - field.at(TAU - 1e-9, 3.0)).abs() < 1e-12);
        let mut worst = 0.0f64;
        for i in 0..20_000 {
            let (a, z) = (f64::from(i) * 3.3e-4, f64::from(i) * 0.006 - 60.0);
            worst = worst.max((field.at(a + 1e-6, z + 1e-6) - field.at(a, z)).abs());
        }
        assert!(worst < 1e-8, "{worst}");
    }

    #[test]
    fn two_seeds_are_independent() {
        let of = Unevenness { sd_mm: 1.0, around_mm: 5.0, along_mm: 5.0 };
        let (a, b) = (Field::new(100.0, 100.0, &of, 1).unwrap(), Field::new(100.0, 100.0, &of, 2).unwrap());
        let product = |i: u32| {
            let place = (f64::from(i % 100) * 0.0628, f64::from(i / 100) * 5.0 - 95.0);
            a.at(place.0, place.1) * b.at(place.0, place.1)
        };
        let mean = (0..3900).map(product).sum::<f64>() / 3900.0;
        // Neighbours at 1.0 to 1.3 correlation lengths are tied by half: 1000 values count.
        assert!(mean.abs() < 4.0 / 1000f64.sqrt(), "{mean}");
    }

    #[test]
    fn a_curve_has_its_sd() {
        let of = Wander { sd_mm: 0.3, length_mm: 20.0 };
        let values: Vec<f64> = (0..50u64)
            .flat_map(|s| {
                let curve = Curve::new(100.0, &of, s);
                (0..30).map(move |i| curve.at(f64::from(i) * 0.21)).collect::<Vec<_>>()
            })
            .collect();
        assert!((variance(&values).sqrt() / 0.3 - 1.0).abs() < 0.1);
    }

    #[test]
    fn a_grid_that_would_take_the_memory_is_refused() {
        let of = Unevenness { sd_mm: 1.0, around_mm: 1e-3, along_mm: 1e-3 };
        assert!(matches!(Field::new(600.0, 300.0, &of, 0), Err(Error::OutOfRange { .. })));
    }
}
