//! The level at which the camera saturates, by its data.
//!
//! A camera clips at the full scale of its bits, or below it: video levels end at 235, a full well at 3900 of 4095. What
//! is brighter is piled up at one level, with the noise of whatever comes after. The histogram of honest fringes ends
//! otherwise: at most the crests of one even surface stand together at its upper end, where a sinusoid spends √w of its time in
//! the last w levels, three times as much as in as many levels of the next. A pile-up holds as much as all that lies above
//! it would: overshoot times density.

use rayon::prelude::*;

use super::noise::sample_rows;
use super::shot::Shot;
use super::wave::Level;
use crate::ground::stop::polled;
use crate::ground::threads;

/// Every so many of the rows at which the noise is taken.
const EVERY: usize = 4;
/// Full scale is cut into so many bins, 8 bits into their levels.
const BINS: u32 = 1024;
/// A pile-up may be this wide, bins: noise of two levels of 8 bits behind the clipping.
const WIDEST: usize = 16;
/// What is piled up in w bins, in bins of what lies below: the crests of an even surface reach 3 w, rounding adds to it.
const CRESTS: f64 = 4.0;
/// And the overshoot from which clipped fringes are bent: 6 of 255 levels are 3 % of a full swing.
const OVERSHOOT: f64 = 6.0;
/// Fewer values in the pile-up are a few glints.
const FEWEST: u32 = 50;
/// The bins below a pile-up must be filled: a few sharp levels, as of images without noise, say nothing.
const BELOW: usize = 12;
const FILLED: usize = 9;
/// A value counts where another frame differs by this share of full scale: a lamp in view has one level, too.
const CHANGE: u32 = 32;

/// Where the camera saturates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Saturation {
    /// The level from which a pixel counts as saturated.
    pub level: f64,
    /// Full scale of the camera's numbers.
    pub full_scale: f64,
    /// Whether the camera clips below that.
    pub below_full_scale: bool,
}

/// Where the camera saturates, by its data: the full scale of its numbers, or below it where values are piled up. 8-bit
/// images have 255. 16-bit images often hold fewer bits: the full scale of the narrowest of 8, 10, 12, 14 and 16 bits that
/// holds the largest value, after a shift by the low bits that are zero in every pixel. Should this guess a narrower scale
/// than the camera's, then at most pixels of exactly the largest value seen are lost. `full_scale` is that of the camera's
/// numbers where it is known; nothing is guessed then.
pub fn saturation<T: Level>(shot: &Shot<'_, T>, full_scale: Option<u32>) -> Saturation {
    let frames: Vec<&[T]> = shot.exposures.iter().flatten().copied().collect();
    let (guessed, bits) = scale_of(&frames);
    let full = full_scale.map_or(guessed, |full| full.clamp(1, T::FULL));
    let per_bin = (full / BINS + 1).next_power_of_two();
    let rows: Vec<usize> = sample_rows(shot.height).step_by(EVERY).collect();
    let counts = histogram(&frames, &rows, shot.width, per_bin, full);
    // Low bits that are never set, as of 6 bits in a byte: their levels are one.
    let used = counts.iter().zip(0u32..).filter(|(n, _)| **n > 0).fold(bits / per_bin, |all, (_, bin)| all | bin);
    let unit = if used == 0 { 1 } else { 1u32 << used.trailing_zeros() };
    let merged: Vec<u32> = counts.chunks(unit as usize).map(|c| c.iter().sum()).collect();
    let bin = unit * per_bin;
    match pile_up(&merged) {
        Some(low) if ((low as u32 + 1) * bin) <= full => {
            Saturation { level: f64::from(low as u32 * bin), full_scale: f64::from(full), below_full_scale: true }
        }
        Some(low) if T::FULL == 255 => {
            Saturation { level: f64::from(low as u32 * bin), full_scale: f64::from(full), below_full_scale: false }
        }
        _ => Saturation { level: f64::from(full), full_scale: f64::from(full), below_full_scale: false },
    }
}

/// The largest value of 8, 10, 12, 14 or 16 bits, after a shift by the low bits that are zero in every pixel; and the bits
/// that are set in any (for 8 bits none, which the histogram shows).
fn scale_of<T: Level>(frames: &[&[T]]) -> (u32, u32) {
    if T::FULL == 255 {
        return (255, 0);
    }
    let scan = |frame: &&[T]| {
        frame.iter().fold((0u32, 0u32), |(top, bits), &v| {
            let v: u32 = v.into();
            (top.max(v), bits | v)
        })
    };
    let seen: Vec<(u32, u32)> = threads::install(|| frames.par_iter().inspect(polled).map(scan).collect());
    let (top, bits) = seen.iter().fold((0, 0), |(top, bits), s| (top.max(s.0), bits | s.1));
    let shift = if bits == 0 { 0 } else { bits.trailing_zeros() };
    let full = [8, 10, 12, 14, 16].map(|b| (1u32 << b) - 1);
    let scale = full.into_iter().find(|&f| f >= top >> shift).unwrap_or(T::FULL);
    ((scale << shift).min(T::FULL), bits)
}

/// How often each level is seen along the rows, where another frame of the stack differs.
fn histogram<T: Level>(frames: &[&[T]], rows: &[usize], width: usize, per_bin: u32, full: u32) -> Vec<u32> {
    let (half, shift) = ((frames.len() / 2).max(1), per_bin.trailing_zeros());
    let bins = (full >> shift) as usize + 1;
    let count = |(k, frame): (usize, &&[T])| {
        let mut counts = vec![0u32; bins];
        let other = frames.get((k + half) % frames.len()).copied().unwrap_or_default();
        for row in rows {
            let range = row * width..(row + 1) * width;
            let pairs = frame.get(range.clone()).unwrap_or_default().iter().zip(other.get(range).unwrap_or_default());
            for (&v, &w) in pairs {
                let (v, w): (u32, u32) = (v.into(), w.into());
                if let Some(count) = counts.get_mut((v >> shift) as usize) {
                    *count += u32::from(v.abs_diff(w) > full / CHANGE);
                }
            }
        }
        counts
    };
    let add = |mut a: Vec<u32>, b: Vec<u32>| {
        a.iter_mut().zip(&b).for_each(|(a, b)| *a += b);
        a
    };
    threads::install(|| frames.par_iter().inspect(polled).enumerate().map(count).reduce(|| vec![0u32; bins], add))
}

/// The lowest bin of a pile-up at the upper end of a histogram.
fn pile_up(counts: &[u32]) -> Option<usize> {
    let end = counts.iter().rposition(|n| *n > 0)? + 1;
    // The last few values are noise or glints.
    let mut above = 0;
    let top = (0..end).rev().find(|&b| {
        above += counts.get(b).copied().unwrap_or(0);
        above >= FEWEST / 2
    })? + 1;
    let sum = |range: std::ops::Range<usize>| counts.get(range).unwrap_or_default().iter().sum::<u32>();
    let density = |w: usize| top.checked_sub(4 * w).map(|low| f64::from(sum(low..top - w)) / (3 * w) as f64);
    for w in 1..=WIDEST {
        let below = counts.get(top.checked_sub(w + BELOW)?..top - w)?;
        let (mass, under) = (sum(top - w..end), density(w)?);
        if mass < FEWEST
            || below.iter().filter(|n| **n > 0).count() < FILLED
            || f64::from(mass) < under * (CRESTS * w as f64 + OVERSHOOT)
        {
            continue;
        }
        // Noise spreads a pile-up to both sides: it ends where no more is seen than farther below.
        let far = density(2 * w + 2).unwrap_or(under);
        let usual = 2.0 * far + 3.0 * far.sqrt();
        let ends = |b: &usize| counts.get(*b).is_none_or(|n| f64::from(*n) <= usual);
        let low = (0..top - w).rev().take(2 * WIDEST).find(ends).map_or(top - w, |b| b + 1);
        return Some(low);
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A histogram of crests: a sinusoid of that amplitude about that mean.
    fn crests(mean: f64, amplitude: f64) -> Vec<u32> {
        let mut counts = vec![0; 256];
        for i in 0..200_000 {
            let level = mean + amplitude * (f64::from(i) * 0.618_034 * std::f64::consts::TAU).cos();
            if let Some(count) = counts.get_mut(level.round().min(255.0) as usize) {
                *count += 1;
            }
        }
        counts
    }

    #[test]
    fn crests_are_no_pile_up_wherever_they_end() {
        for amplitude in [10.0, 35.3, 60.0, 90.0, 100.2] {
            for mean in [100.0, 120.25, 134.5, 140.9] {
                assert_eq!(pile_up(&crests(mean, amplitude)), None, "{mean} {amplitude}");
            }
        }
    }

    #[test]
    fn what_is_cut_off_is_piled_up() {
        for overshoot in [20, 60, 120] {
            let mut counts = crests(120.0, 115.0);
            let cut = 235 - overshoot;
            let over: u32 = counts.drain(cut..).sum();
            counts.push(over);
            assert_eq!(pile_up(&counts), Some(cut));
        }
    }
}
