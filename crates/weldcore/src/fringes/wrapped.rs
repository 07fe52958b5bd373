//! The wrapped phase of one or more fringe sets, in full double precision.

use multiversion::multiversion;
use rayon::prelude::*;

use super::wave::{TILE, Wave};
use crate::error::{Error, Result};
use crate::ground::branchless::atan2;
use crate::ground::memory::require;
use crate::ground::stop::polled;
use crate::ground::threads::{self, CHUNK};

/// What [`decode_phase`] found; everything set after set, each row-major.
#[derive(Debug, Clone)]
pub struct WrappedPhase {
    /// In (-π, π].
    pub phase_rad: Vec<f64>,
    /// Amplitude, grey levels.
    pub modulation: Vec<f32>,
    /// Mean level.
    pub background: Vec<f32>,
    /// Root of the summed squared residuals over N - 3, grey levels; zero for three steps.
    pub residual: Vec<f32>,
}

struct Kernel<'a> {
    wave: &'a Wave,
    re: [f64; TILE],
    im: [f64; TILE],
    sum: [f64; TILE],
    rest: [f64; TILE],
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
fn gather(level: &[f64; TILE], cos: f64, sin: f64, k: &mut Kernel<'_>) {
    for i in 0..TILE {
        k.re[i] += level[i] * cos;
        k.im[i] += level[i] * sin;
        k.sum[i] += level[i];
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
fn residual(level: &[f64; TILE], cos: f64, sin: f64, scale: f64, k: &mut Kernel<'_>) {
    for i in 0..TILE {
        let miss = level[i] - scale * (0.5 * k.sum[i] + k.re[i] * cos + k.im[i] * sin);
        k.rest[i] += miss * miss;
    }
}

/// Leaves the phase in `re`, the modulation in `im`.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
fn finish(scale: f64, k: &mut Kernel<'_>) {
    plain_finish(scale, k);
}

/// The body of [`finish`], and its fallback.
#[inline(always)]
fn plain_finish(scale: f64, k: &mut Kernel<'_>) {
    for i in 0..TILE {
        let (re, im) = (k.re[i], k.im[i]);
        k.re[i] = atan2(im, re);
        k.im[i] = scale * (re * re + im * im).sqrt();
    }
}

/// The wrapped phase of each set of N steps: `phi = atan2(ΣI sin delta_k, ΣI cos delta_k)` with delta_k = 2πk/N, which is
/// the least-squares sinusoid `A + B cos(phi - delta_k)`. A level that is not finite makes its pixel NaN.
///
/// # Errors
/// [`Error::Shape`] where the images do not fit the steps or each other, [`Error::OutOfRange`] for fewer than 3 steps.
pub fn decode_phase<T: Copy + Into<f64> + Sync>(images: &[&[T]], steps: &[usize]) -> Result<WrappedPhase> {
    let needed: usize = steps.iter().sum();
    if let Some(n) = steps.iter().find(|&&n| n < 3) {
        return Err(Error::OutOfRange { what: "steps", expected: "3 or more".into(), value: n.to_string() });
    }
    if needed == 0 || images.len() != needed {
        let expected = format!("as many images as steps, {needed}, and one set at least");
        return Err(Error::Shape { what: "images", expected, got: images.len().to_string() });
    }
    let n = images.first().map_or(0, |i| i.len());
    if let Some(other) = images.iter().find(|i| i.len() != n) {
        let expected = format!("images of one size, {n} pixels");
        return Err(Error::Shape { what: "images", expected, got: format!("{} pixels", other.len()) });
    }
    let size = n * steps.len();
    require(size, 20);
    let mut out = WrappedPhase {
        phase_rad: vec![0.0; size],
        modulation: vec![0.0; size],
        background: vec![0.0; size],
        residual: vec![0.0; size],
    };
    let mut first = 0;
    for (set, &steps) in steps.iter().enumerate() {
        let images = images.get(first..first + steps).unwrap_or_default();
        first += steps;
        let range = set * n..(set + 1) * n;
        let (Some(phase), Some(modulation), Some(background), Some(rest)) = (
            out.phase_rad.get_mut(range.clone()),
            out.modulation.get_mut(range.clone()),
            out.background.get_mut(range.clone()),
            out.residual.get_mut(range),
        ) else {
            continue;
        };
        let wave = Wave::new(steps);
        threads::install(|| {
            let chunks = phase.par_chunks_mut(CHUNK).zip(modulation.par_chunks_mut(CHUNK));
            let chunks = chunks.zip(background.par_chunks_mut(CHUNK).zip(rest.par_chunks_mut(CHUNK)));
            chunks.inspect(polled).enumerate().for_each(|(i, ((phase, modulation), (background, rest)))| {
                let tiles = phase.chunks_mut(TILE).zip(modulation.chunks_mut(TILE));
                let tiles = tiles.zip(background.chunks_mut(TILE).zip(rest.chunks_mut(TILE)));
                for (j, ((phase, modulation), (background, rest))) in tiles.enumerate() {
                    let k = tile(images, i * CHUNK + j * TILE, &wave);
                    phase.iter_mut().zip(&k.re).for_each(|(o, v)| *o = *v);
                    modulation.iter_mut().zip(&k.im).for_each(|(o, v)| *o = *v as f32);
                    background.iter_mut().zip(&k.sum).for_each(|(o, v)| *o = (v / steps as f64) as f32);
                    let freedom = (steps - 3).max(1) as f64;
                    rest.iter_mut().zip(&k.rest).for_each(|(o, v)| *o = (v / freedom).sqrt() as f32);
                }
            });
        });
    }
    Ok(out)
}

fn tile<'a, T: Copy + Into<f64>>(images: &[&[T]], start: usize, wave: &'a Wave) -> Kernel<'a> {
    let zero = [0.0; TILE];
    let mut k = Kernel { wave, re: zero, im: zero, sum: zero, rest: zero };
    let mut level = [0.0; TILE];
    let scale = 2.0 / images.len() as f64;
    let load = |image: &[T], level: &mut [f64; TILE]| {
        let end = image.len().min(start + TILE);
        level.iter_mut().zip(image.get(start..end).unwrap_or_default()).for_each(|(l, v)| *l = (*v).into());
    };
    for ((image, &cos), &sin) in images.iter().zip(&wave.cos).zip(&wave.sin) {
        load(image, &mut level);
        gather(&level, cos, sin, &mut k);
    }
    if images.len() > 3 {
        for ((image, &cos), &sin) in images.iter().zip(&k.wave.cos).zip(&k.wave.sin) {
            load(image, &mut level);
            residual(&level, cos, sin, scale, &mut k);
        }
    }
    finish(scale, &mut k);
    k
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::f64::consts::TAU;

    proptest! {
        #[test]
        fn the_sinusoid_comes_back(phi in -3.1..3.1f64, b in 1.0..100.0f64, steps in 3..16usize, n in 1..600usize) {
            let images: Vec<Vec<f64>> =
                (0..steps).map(|k| vec![120.0 + b * (phi - TAU * k as f64 / steps as f64).cos(); n]).collect();
            let images: Vec<&[f64]> = images.iter().map(Vec::as_slice).collect();
            let found = decode_phase(&images, &[steps]).unwrap();
            prop_assert!(found.phase_rad.iter().all(|p| (p - phi).abs() < 1e-12 * 120.0 / b));
            prop_assert!(found.modulation.iter().all(|m| (f64::from(*m) - b).abs() < 1e-5 * b));
            prop_assert!(found.background.iter().all(|m| (f64::from(*m) - 120.0).abs() < 1e-4));
            prop_assert!(found.residual.iter().all(|r| *r < 1e-6));
        }
    }

    #[test]
    fn a_bad_frame_shows_in_the_residual() {
        let mut images = vec![vec![100u8; 10]; 5];
        images[2][3] = 150;
        let images: Vec<&[u8]> = images.iter().map(Vec::as_slice).collect();
        let found = decode_phase(&images, &[5]).unwrap();
        // 50 levels in one of five samples leave 50 sqrt((5 - 3)/5) in all, over sqrt(5 - 3).
        assert!((found.residual[3] - 50.0 / 5f32.sqrt()).abs() < 1e-4);
        assert!(found.residual[4] < 1e-4);
        assert!(decode_phase(&images, &[2, 3]).is_err());
        assert!(decode_phase(&images, &[4]).is_err());
        assert!(decode_phase::<u8>(&[], &[]).is_err());
    }
}
