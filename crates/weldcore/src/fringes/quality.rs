//! Whether a shot's images are good enough to be measured, before anything is decoded.
//!
//! A pixel can be used where one exposure has it unsaturated in all of its frames and modulated in those of the finest
//! fringes: `2/N |sum I_k exp(2 pi i k / N)|` over full scale, the amplitude of the fringes, is not below a least one.

use std::f32::consts::TAU;
use std::ops::Range;

use super::saturation::saturation;
use super::shot::Shot;
use super::wave::Level;
use crate::error::{Error, Result};
use crate::ground::robust::median_between;
use crate::ground::threads;

/// What share of the image can be measured, and what spoils the rest.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Quality {
    /// Unsaturated and modulated in at least one exposure.
    pub usable: f64,
    /// Saturated in every exposure.
    pub saturated: f64,
    /// Neither: too little modulation.
    pub dark: f64,
    /// Of the usable pixels, in parts of full scale; 0 where there is none.
    pub median_modulation: f64,
}

/// Judges a shot by the frames of its finest fringes; `full_scale` is that of the camera's numbers, where it is known.
///
/// # Errors
/// [`Error::Shape`] for frames of another size or `finest` beyond them, [`Error::TooFew`] for less than three of them or no pixel.
pub fn quality<T: Level>(
    shot: &Shot<'_, T>,
    finest: Range<usize>,
    least_modulation: f64,
    full_scale: Option<u32>,
) -> Result<Quality> {
    let pixels = shot.width * shot.height;
    crate::error::require_count("frames of the finest fringes", 3, finest.len())?;
    crate::error::require_count("pixels", 1, pixels)?;
    for frames in &shot.exposures {
        if frames.len() < finest.end || frames.iter().any(|frame| frame.len() != pixels) {
            let (expected, got) =
                (format!("{} frames of {pixels} pixels at least", finest.end), frames.len().to_string());
            return Err(Error::Shape { what: "exposures", expected, got });
        }
    }
    let levels: Vec<(u32, f32)> = shot
        .exposures
        .iter()
        .map(|frames| {
            let alone = Shot { exposures: vec![frames.clone()], width: shot.width, height: shot.height };
            let found = saturation(&alone, full_scale);
            (found.level as u32, 2.0 / (finest.len() as f32 * found.full_scale as f32))
        })
        .collect();
    let turns: Vec<(f32, f32)> = (0..finest.len()).map(|k| (TAU * k as f32 / finest.len() as f32).sin_cos()).collect();
    // Per pixel its best modulation, NaN where no exposure has it unsaturated.
    let parts = threads::map_ranges(pixels, |range| {
        let mut best = vec![f32::NAN; range.len()];
        let (mut sine, mut cosine) = (vec![0.0_f32; range.len()], vec![0.0_f32; range.len()]);
        let mut highest = vec![0_u32; range.len()];
        for (frames, (level, scale)) in shot.exposures.iter().zip(&levels) {
            [&mut sine, &mut cosine].into_iter().for_each(|sums| sums.fill(0.0));
            highest.fill(0);
            for frame in frames {
                for (top, v) in highest.iter_mut().zip(&frame[range.clone()]) {
                    *top = (*top).max((*v).into());
                }
            }
            for (frame, (sin, cos)) in frames[finest.clone()].iter().zip(&turns) {
                for ((s, c), v) in sine.iter_mut().zip(&mut cosine).zip(&frame[range.clone()]) {
                    let v = Into::<u32>::into(*v) as f32;
                    *s += sin * v;
                    *c += cos * v;
                }
            }
            for (k, best) in best.iter_mut().enumerate() {
                if highest[k] < *level {
                    // `max` takes the number where the other is NaN.
                    *best = best.max(sine[k].hypot(cosine[k]) * scale);
                }
            }
        }
        best
    });
    let best = parts.concat();
    let unsaturated = best.iter().filter(|m| !m.is_nan()).count();
    let mut usable: Vec<f32> = best.into_iter().filter(|m| f64::from(*m) >= least_modulation).collect();
    let share = |count: usize| count as f64 / pixels as f64;
    Ok(Quality {
        usable: share(usable.len()),
        saturated: share(pixels - unsaturated),
        dark: share(unsaturated - usable.len()),
        median_modulation: if usable.is_empty() { 0.0 } else { median_between(&mut usable) },
    })
}

#[cfg(test)]
mod tests {
    use std::slice::from_ref;

    use super::*;

    /// Four steps after two other frames; the left half at most as bright as `left`, the right half as `right`, evenly down to
    /// 60 % of it; modulated by half.
    fn frames(left: f32, right: f32) -> Vec<Vec<u8>> {
        let pixel = |k: usize, step: usize| {
            let phase = TAU * step as f32 / 4.0 + k as f32;
            let bright = if k % 40 < 20 { left } else { right };
            let bright = bright * (0.6 + 0.02 * (k % 20) as f32);
            (bright * (1.0 + 0.5 * phase.cos())).round().clamp(0.0, 255.0) as u8
        };
        (0..6).map(|f| (0..40 * 30).map(|k| if f < 2 { 10 } else { pixel(k, f - 2) }).collect()).collect()
    }

    fn judged(exposures: &[Vec<Vec<u8>>], least: f64) -> Quality {
        let exposures = exposures.iter().map(|frames| frames.iter().map(Vec::as_slice).collect()).collect();
        quality(&Shot { exposures, width: 40, height: 30 }, 2..6, least, None).unwrap()
    }

    #[test]
    fn the_shares_are_those_of_what_was_shown() {
        let found = judged(&[frames(160.0, 10.0)], 0.1);
        assert_eq!((found.usable, found.saturated, found.dark), (0.5, 0.0, 0.5));
        // Between the two middle pixels of twenty; the levels are whole.
        assert!((found.median_modulation - 0.79 * 80.0 / 255.0).abs() < 0.5 / 255.0);
        let found = judged(&[frames(250.0, 160.0)], 0.1);
        assert!(found.saturated > 0.2 && found.saturated < 0.5 && (found.usable + found.saturated - 1.0).abs() < 1e-12);
    }

    #[test]
    fn each_pixel_counts_by_its_best_exposure() {
        let (long, short) = (frames(900.0, 160.0), frames(160.0, 10.0));
        assert_eq!(judged(from_ref(&long), 0.1).usable, 0.5);
        assert_eq!(judged(from_ref(&short), 0.1).usable, 0.5);
        assert_eq!(judged(&[short, long], 0.1).usable, 1.0);
    }

    #[test]
    fn what_is_dark_for_the_camera_is_dark() {
        let wide = |frames: Vec<Vec<u8>>| -> Vec<Vec<u16>> {
            frames.into_iter().map(|frame| frame.into_iter().map(u16::from).collect()).collect()
        };
        let frames = wide(frames(160.0, 160.0));
        let exposures = vec![frames.iter().map(Vec::as_slice).collect()];
        let shot = Shot { exposures, width: 40, height: 30 };
        assert_eq!(quality(&shot, 2..6, 0.1, None).unwrap().usable, 1.0);
        let found = quality(&shot, 2..6, 0.1, Some(4095)).unwrap();
        assert_eq!((found.usable, found.dark), (0.0, 1.0));
    }

    #[test]
    fn what_is_no_shot_is_refused() {
        let frame = vec![1_u8; 12];
        let shot = Shot { exposures: vec![vec![frame.as_slice(); 4]], width: 4, height: 3 };
        assert!(quality(&shot, 2..5, 0.1, None).is_err() && quality(&shot, 0..2, 0.1, None).is_err());
        assert!(quality(&Shot { width: 5, ..shot.clone() }, 0..4, 0.1, None).is_err());
        assert_eq!(quality(&Shot { exposures: vec![], ..shot }, 0..4, 0.1, None).unwrap().saturated, 1.0);
    }
}
