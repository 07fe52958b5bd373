//! Fitting a sinusoid to N samples of it, tile by tile.
//!
//! The loops run over tiles of [`TILE`] pixels held in plain arrays, so that the compiler makes vectors of them; each
//! is compiled for AVX-512, AVX2 and the baseline, and the best is chosen at run time. None fuses a product with a
//! sum: every version gives the same bits.

use std::f64::consts::TAU;

use multiversion::multiversion;

/// Pixels that a kernel takes at a time: all of its arrays stay in the first-level cache.
pub(crate) const TILE: usize = 256;

/// One number per pixel of a tile.
pub type Lane = [f32; TILE];

/// A grey level as cameras deliver it.
pub trait Level: Copy + Send + Sync + Default + Into<f32> + Into<f64> + Into<u32> + 'static {
    /// The largest value that the type holds.
    const FULL: u32;
    #[doc(hidden)]
    fn demodulate(frames: &[&[Self; TILE]], wave: &Wave, out: &mut Sinusoid);
}

impl Level for u8 {
    const FULL: u32 = 255;
    fn demodulate(frames: &[&[Self; TILE]], wave: &Wave, out: &mut Sinusoid) {
        demodulate_u8(frames, wave, out);
    }
}

impl Level for u16 {
    const FULL: u32 = 65_535;
    fn demodulate(frames: &[&[Self; TILE]], wave: &Wave, out: &mut Sinusoid) {
        demodulate_u16(frames, wave, out);
    }
}

/// cos and sin of delta_k = 2πk/N.
#[doc(hidden)]
#[derive(Debug, Clone)]
pub struct Wave {
    pub cos: Vec<f64>,
    pub sin: Vec<f64>,
    cos32: Vec<f32>,
    sin32: Vec<f32>,
}

impl Wave {
    pub(crate) fn new(steps: usize) -> Self {
        let exact = |v: f64| if v.abs() < 1e-15 { 0.0 } else { v };
        let delta = |k: usize| TAU * k as f64 / steps as f64;
        let cos: Vec<f64> = (0..steps).map(|k| exact(delta(k).cos())).collect();
        let sin: Vec<f64> = (0..steps).map(|k| exact(delta(k).sin())).collect();
        let narrow = |v: &[f64]| v.iter().map(|&x| x as f32).collect();
        Self { cos32: narrow(&cos), sin32: narrow(&sin), cos, sin }
    }
}

/// What N samples of a sinusoid say of a tile: `I_k = background + modulation cos(phi - delta_k)`.
#[doc(hidden)]
#[derive(Debug)]
pub struct Sinusoid {
    /// (2/N) ΣI cos = modulation cos(phi).
    pub re: Lane,
    /// (2/N) ΣI sin = modulation sin(phi).
    pub im: Lane,
    /// Mean level.
    pub background: Lane,
    /// Sum of the squared residuals.
    pub rest: Lane,
    /// The highest level.
    pub top: Lane,
}

/// The same of one pixel.
pub(crate) struct PixelFit {
    pub re: f32,
    pub im: f32,
    pub background: f32,
    pub rest: f32,
    pub top: f32,
}

/// What is done with the sinusoid of each pixel. A trait, for closures cannot be told to be inlined, and outside of the
/// caller's loop they would not become vectors.
pub(crate) trait Take {
    fn take(&mut self, i: usize, sample: PixelFit);
}

impl Take for Sinusoid {
    #[inline(always)]
    fn take(&mut self, i: usize, s: PixelFit) {
        (self.re[i], self.im[i], self.background[i]) = (s.re, s.im, s.background);
        (self.rest[i], self.top[i]) = (s.rest, s.top);
    }
}

impl Sinusoid {
    pub(crate) fn empty() -> Self {
        let zero = [0.0; TILE];
        Self { re: zero, im: zero, background: zero, rest: zero, top: zero }
    }

    #[inline(always)]
    pub(crate) fn at(&self, i: usize) -> PixelFit {
        PixelFit {
            re: self.re[i],
            im: self.im[i],
            background: self.background[i],
            rest: self.rest[i],
            top: self.top[i],
        }
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
fn demodulate_u8(frames: &[&[u8; TILE]], wave: &Wave, out: &mut Sinusoid) {
    demodulate_tile(frames, wave, out);
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
fn demodulate_u16(frames: &[&[u16; TILE]], wave: &Wave, out: &mut Sinusoid) {
    demodulate_tile(frames, wave, out);
}

#[inline(always)]
pub(super) fn demodulate_tile<T: Level>(frames: &[&[T; TILE]], wave: &Wave, out: &mut Sinusoid) {
    each_pixel(frames, wave, out);
}

/// Hands `take` the tile of `len <= TILE` pixels from `start` on; what is missing to a whole one is padded.
pub(super) fn tile_of<T: Level>(frames: &[&[T]], start: usize, len: usize, take: impl FnOnce(&[&[T; TILE]])) {
    let whole: Option<Vec<&[T; TILE]>> =
        frames.iter().map(|f| f.get(start..start + TILE).filter(|_| len == TILE)?.try_into().ok()).collect();
    if let Some(tiles) = whole {
        return take(&tiles);
    }
    let mut padded = vec![[T::default(); TILE]; frames.len()];
    for (tile, frame) in padded.iter_mut().zip(frames) {
        let pixels = frame.get(start..start + len).unwrap_or_default();
        tile.iter_mut().zip(pixels).for_each(|(t, p)| *t = *p);
    }
    take(&padded.iter().collect::<Vec<_>>());
}

/// Fits the sinusoid to `len <= TILE` pixels from `start` on.
pub(super) fn demodulate<T: Level>(frames: &[&[T]], start: usize, len: usize, wave: &Wave, out: &mut Sinusoid) {
    tile_of(frames, start, len, |tiles| T::demodulate(tiles, wave, out));
}

/// Hands the sinusoid of every pixel to `to`. The usual numbers of steps keep all samples of a pixel in registers; the
/// rest go frame by frame.
#[inline(always)]
pub(crate) fn each_pixel<T: Level>(frames: &[&[T; TILE]], wave: &Wave, to: &mut impl Take) {
    match frames.len() {
        3 => each_fixed::<T, 3>(frames, wave, to),
        4 => each_of_four(frames, to),
        5 => each_fixed::<T, 5>(frames, wave, to),
        6 => each_fixed::<T, 6>(frames, wave, to),
        8 => each_fixed::<T, 8>(frames, wave, to),
        _ => {
            let mut fit = Sinusoid::empty();
            demodulate_any(frames, wave, &mut fit);
            for i in 0..TILE {
                to.take(i, fit.at(i));
            }
        }
    }
}

#[inline(always)]
fn each_fixed<T: Level, const N: usize>(frames: &[&[T; TILE]], wave: &Wave, to: &mut impl Take) {
    let (Ok(frames), Ok(cos), Ok(sin)) = (
        <&[&[T; TILE]; N]>::try_from(frames),
        <&[f32; N]>::try_from(wave.cos32.as_slice()),
        <&[f32; N]>::try_from(wave.sin32.as_slice()),
    ) else {
        return;
    };
    let (half, mean) = (2.0 / N as f32, 1.0 / N as f32);
    for i in 0..TILE {
        let (mut re, mut im, mut sum, mut top) = (0.0f32, 0.0f32, 0.0f32, 0.0f32);
        for k in 0..N {
            let v: f32 = frames[k][i].into();
            re += v * cos[k];
            im += v * sin[k];
            sum += v;
            top = if v > top { v } else { top };
        }
        let (re, im, background) = (re * half, im * half, sum * mean);
        let mut rest = 0.0f32;
        if N > 3 {
            for k in 0..N {
                let v: f32 = frames[k][i].into();
                let miss = v - background - (re * cos[k] + im * sin[k]);
                rest += miss * miss;
            }
        }
        to.take(i, PixelFit { re, im, background, rest, top });
    }
}

/// Four steps: cos and sin are 0 and ±1, and the residual is what alternates.
#[inline(always)]
fn each_of_four<T: Level>(frames: &[&[T; TILE]], to: &mut impl Take) {
    let &[a, b, c, d] = frames else { return };
    for i in 0..TILE {
        let (a, b, c, d): (f32, f32, f32, f32) = (a[i].into(), b[i].into(), c[i].into(), d[i].into());
        let higher = |x: f32, y: f32| if x > y { x } else { y };
        let alternating = (a + c) - (b + d);
        let sample = PixelFit {
            re: 0.5 * (a - c),
            im: 0.5 * (b - d),
            background: 0.25 * ((a + c) + (b + d)),
            rest: 0.25 * (alternating * alternating),
            top: higher(higher(a, b), higher(c, d)),
        };
        to.take(i, sample);
    }
}

#[inline(always)]
fn demodulate_any<T: Level>(frames: &[&[T; TILE]], wave: &Wave, out: &mut Sinusoid) {
    let n = frames.len() as f32;
    *out = Sinusoid::empty();
    for ((frame, &cos), &sin) in frames.iter().zip(&wave.cos32).zip(&wave.sin32) {
        for i in 0..TILE {
            let v: f32 = frame[i].into();
            out.re[i] += v * cos;
            out.im[i] += v * sin;
            out.background[i] += v;
            out.top[i] = if v > out.top[i] { v } else { out.top[i] };
        }
    }
    for i in 0..TILE {
        out.re[i] *= 2.0 / n;
        out.im[i] *= 2.0 / n;
        out.background[i] /= n;
    }
    for ((frame, &cos), &sin) in frames.iter().zip(&wave.cos32).zip(&wave.sin32) {
        for i in 0..TILE {
            let v: f32 = frame[i].into();
            let miss = v - out.background[i] - (out.re[i] * cos + out.im[i] * sin);
            out.rest[i] += miss * miss;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn any_number_of_steps_gives_back_the_sinusoid() {
        for steps in 3..14 {
            let wave = Wave::new(steps);
            let level = |i: usize, k: usize| {
                let (cos, sin) = (wave.cos[k], wave.sin[k]);
                let phi = i as f64 / 40.0 - 3.0;
                (30_000.0 + 20_000.0 * (phi.cos() * cos + phi.sin() * sin)).round() as u16
            };
            let frames: Vec<[u16; TILE]> = (0..steps).map(|k| std::array::from_fn(|i| level(i, k))).collect();
            let mut out = Sinusoid::empty();
            u16::demodulate(&frames.iter().collect::<Vec<_>>(), &wave, &mut out);
            for i in 0..TILE {
                let phi = i as f64 / 40.0 - 3.0;
                assert!((f64::from(out.re[i]) - 20_000.0 * phi.cos()).abs() < 0.6);
                assert!((f64::from(out.im[i]) - 20_000.0 * phi.sin()).abs() < 0.6);
                assert!((f64::from(out.background[i]) - 30_000.0).abs() < 0.6);
                assert!(out.rest[i] < 0.3 * steps as f32);
                assert_eq!(f64::from(out.top[i]), f64::from((0..steps).map(|k| level(i, k)).max().unwrap()));
            }
        }
    }
}
