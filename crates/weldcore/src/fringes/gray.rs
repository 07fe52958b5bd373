//! Gray code, alone and as the fringe order of a wrapped phase.

use std::f64::consts::{FRAC_PI_2, TAU};

use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::ground::memory::require;
use crate::ground::robust::{MEDIAN_TO_SIGMA, median};
use crate::ground::stop::polled;
use crate::ground::threads::{self, CHUNK};

/// What the bit images are compared with.
#[derive(Debug, Clone, Copy)]
pub enum GrayImages<'a, T> {
    /// One image all white and one all black: the threshold is their mean.
    WhiteBlack(&'a [T], &'a [T]),
    /// For each bit the inverse image.
    Inverse(&'a [&'a [T]]),
}

/// Safety factor on the noise, as [`crate::fringes::DecodeOptions`] has it.
const Z: f64 = 5.0;
/// Standard deviation of rounding to whole grey levels: 1/sqrt(12).
const ROUNDING: f64 = 0.288_675;
/// Pixels that the noise is taken from: they give it to half a per cent.
const SAMPLES: usize = 1 << 15;

/// The contrast below which noise could turn a bit: five standard deviations of the difference that decides it. The noise
/// is seen in what should be zero in every pixel: between white and black, how far a bit's level is from the nearer of
/// them (light that other stripes throw there counts as noise); between inverse images, how the sums of two bits' images
/// differ. One bit and its inverse show no noise: one grey level is assumed.
fn least_contrast<T: Copy + Into<f64>>(bits: &[&[T]], against: &GrayImages<'_, T>) -> f64 {
    let n = bits.first().map_or(0, |b| b.len());
    let stride = n.div_ceil(SAMPLES).max(1);
    let at = |image: &[T], i: usize| -> f64 { image.get(i).map_or(f64::NAN, |v| (*v).into()) };
    let whole = (0..n).step_by(stride).all(|i| bits.iter().all(|b| at(b, i).fract() == 0.0));
    // Of a single level.
    let floor = if whole { ROUNDING } else { 0.0 };
    match against {
        GrayImages::WhiteBlack(white, black) => {
            let swing = |i: &usize| at(white, *i) - at(black, *i);
            let lit: Vec<usize> = (0..n).step_by(stride).filter(|i| swing(i) > 0.0).collect();
            let middle = finite_median(lit.iter().map(swing).collect());
            let bright = lit.iter().filter(|i| swing(i) >= middle);
            let misses = bright.flat_map(|&i| {
                let (white, black) = (at(white, i), at(black, i));
                bits.iter().map(move |b| (at(b, i) - white).abs().min((at(b, i) - black).abs()))
            });
            // A miss is of two levels; twice the level less white and black, of six.
            Z * 3f64.sqrt() * (MEDIAN_TO_SIGMA * finite_median(misses.collect())).max(floor * 2f64.sqrt())
        }
        GrayImages::Inverse(inverse) => {
            let sums = |i: usize| bits.iter().zip(*inverse).map(move |(a, b)| at(a, i) + at(b, i));
            let differ = |i: usize| sums(i).zip(sums(i).skip(1)).map(|(a, b)| (a - b).abs());
            let differences: Vec<f64> = (0..n).step_by(stride).flat_map(differ).collect();
            let level =
                if bits.len() < 2 { 1.0 } else { (MEDIAN_TO_SIGMA * finite_median(differences) / 2.0).max(floor) };
            Z * 2f64.sqrt() * level
        }
    }
}

/// The median of the finite ones; 0 of none.
fn finite_median(mut values: Vec<f64>) -> f64 {
    values.retain(|v| v.is_finite());
    median(&mut values)
}

/// The code of each pixel from its bit images, most significant first; -1 where a bit cannot be told because the
/// difference that decides is not above `contrast` grey levels (`None`: five standard deviations of the noise, which is
/// taken from the images).
///
/// # Errors
/// [`Error::Shape`] where images are missing or of different sizes, [`Error::OutOfRange`] for more than 31 bits or a
/// contrast below zero.
pub fn decode_gray<T: Copy + Into<f64> + Sync>(
    bits: &[&[T]],
    against: GrayImages<'_, T>,
    contrast: Option<f64>,
) -> Result<Vec<i32>> {
    let n = bits.first().map_or(0, |b| b.len());
    if !(1..=31).contains(&bits.len()) {
        let (expected, value) = ("1 to 31 bits".into(), bits.len().to_string());
        return Err(Error::OutOfRange { what: "images", expected, value });
    }
    if let Some(value) = contrast.filter(|c| !(c.is_finite() && *c >= 0.0)) {
        return Err(Error::OutOfRange { what: "contrast", expected: "0 or more".into(), value: value.to_string() });
    }
    let others: Vec<&[T]> = match against {
        GrayImages::WhiteBlack(white, black) => vec![white, black],
        GrayImages::Inverse(inverse) => inverse.to_vec(),
    };
    let enough = matches!(against, GrayImages::WhiteBlack(..)) || others.len() == bits.len();
    if !enough || bits.iter().chain(&others).any(|b| b.len() != n) {
        let expected = format!("images of one size, {n} pixels, and as many inverses as bits");
        return Err(Error::Shape { what: "images", expected, got: "others".into() });
    }
    let contrast = contrast.unwrap_or_else(|| least_contrast(bits, &against));
    let at = |image: Option<&&[T]>, i: usize| -> f64 {
        image.and_then(|image| image.get(i)).map_or(f64::NAN, |v| (*v).into())
    };
    let code = |i: usize| -> i32 {
        let (white, black) = (at(others.first(), i), at(others.get(1), i));
        let mut binary = 0;
        for (k, bit) in bits.iter().enumerate() {
            let level = at(Some(bit), i);
            // Twice the distance from the threshold, and what must exceed the contrast.
            let (above, swing) = match against {
                GrayImages::WhiteBlack(..) => (2.0 * level - white - black, white - black),
                GrayImages::Inverse(_) => {
                    let d = level - at(others.get(k), i);
                    (d, d.abs())
                }
            };
            if swing.is_nan() || level.is_nan() || swing <= contrast {
                return -1;
            }
            // Gray to binary: each bit is the exclusive or with the one before.
            binary = (binary << 1) | ((binary & 1) ^ i32::from(above > 0.0));
        }
        binary
    };
    require(n, 4);
    let mut out = vec![0; n];
    threads::install(|| {
        out.par_chunks_mut(CHUNK).inspect(polled).enumerate().for_each(|(chunk, values)| {
            values.iter_mut().enumerate().for_each(|(i, v)| *v = code(chunk * CHUNK + i));
        });
    });
    Ok(out)
}

/// The absolute phase, rad, from a wrapped phase and a code with one bit more than it takes to number the fringes
/// (complementary Gray code): that last bit changes at half periods, so that near a period's end the order comes from a
/// code that does not change there. Phase zero is where a period and its code begin. NaN where code or phase is missing.
///
/// # Errors
/// [`Error::Shape`] where the two are of different sizes.
pub fn absolute_from_gray(code: &[i32], wrapped: &[f64]) -> Result<Vec<f64>> {
    if code.len() != wrapped.len() {
        let (expected, got) = (format!("{} pixels, as the code has", code.len()), wrapped.len().to_string());
        return Err(Error::Shape { what: "wrapped", expected, got });
    }
    let absolute = |(&code, &wrapped): (&i32, &f64)| -> f64 {
        if code < 0 {
            return f64::NAN;
        }
        let phase = wrapped - TAU * (wrapped / TAU).floor();
        let (coarse, shifted) = (code >> 1, (code + 1) >> 1);
        let order = if phase < FRAC_PI_2 {
            shifted
        } else if phase < 3.0 * FRAC_PI_2 {
            coarse
        } else {
            shifted - 1
        };
        phase + TAU * f64::from(order)
    };
    require(code.len(), 8);
    Ok(code.iter().zip(wrapped).map(absolute).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const BITS: u32 = 6;

    fn images(x: f64) -> Vec<[u8; 1]> {
        let cell = (x * f64::from(1u32 << BITS)) as u32;
        let gray = cell ^ (cell >> 1);
        (0..BITS).rev().map(|b| [if gray >> b & 1 == 1 { 200 } else { 40 }]).collect()
    }

    proptest! {
        #[test]
        fn orders_are_right_even_where_the_code_slips(x in 0.01..0.99f64, slip in -0.2..0.2f64) {
            // The code is read up to a fifth of a fringe beside the phase; 32 fringes.
            let fringes = 32.0;
            let bits = images((x + slip / fringes).clamp(0.0, 0.999_999));
            let bits: Vec<&[u8]> = bits.iter().map(|b| b.as_slice()).collect();
            let code = decode_gray(&bits, GrayImages::WhiteBlack(&[200], &[40]), None).unwrap();
            let phase = TAU * fringes * x;
            let wrapped = phase - TAU * (phase / TAU).round();
            prop_assert!((absolute_from_gray(&code, &[wrapped]).unwrap()[0] - phase).abs() < 1e-9);
        }
    }

    #[test]
    fn the_least_contrast_is_five_standard_deviations_of_the_decision() {
        let (n, sigma) = (20_000, 2.0);
        let mut state = 7u64;
        let mut noise = move || {
            let uniform = |s: &mut u64| {
                *s = s.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                (*s >> 11) as f64 / (1u64 << 53) as f64 - 0.5
            };
            (0..12).map(|_| uniform(&mut state)).sum::<f64>() * sigma
        };
        let mut image = |level: f64| (0..n).map(|_| level + noise()).collect::<Vec<f64>>();
        let (white, black) = (image(180.0), image(40.0));
        let bits = [image(180.0), image(40.0), image(180.0)];
        let inverse = [image(40.0), image(180.0), image(40.0)];
        let bits: Vec<&[f64]> = bits.iter().map(|b| b.as_slice()).collect();
        let inverse: Vec<&[f64]> = inverse.iter().map(|b| b.as_slice()).collect();
        // Of 30,000 absolute values the median is right to one per cent.
        let near = |found: f64, expected: f64| assert!((found / expected - 1.0).abs() < 0.05, "{found} {expected}");
        near(least_contrast(&bits, &GrayImages::WhiteBlack(&white, &black)), 5.0 * 6f64.sqrt() * sigma);
        near(least_contrast(&bits, &GrayImages::Inverse(&inverse)), 5.0 * 2f64.sqrt() * sigma);
        let one = least_contrast(&bits[..1], &GrayImages::Inverse(&inverse[..1]));
        near(one, 5.0 * 2f64.sqrt());
        assert!(least_contrast::<u8>(&[&[], &[]], &GrayImages::WhiteBlack(&[], &[])) > 0.0);
    }

    #[test]
    fn codes_and_dark_pixels() {
        let bits: Vec<[u8; 3]> = vec![[200, 40, 90], [200, 200, 90]];
        let bits: Vec<&[u8]> = bits.iter().map(|b| b.as_slice()).collect();
        let inverse: Vec<[u8; 3]> = vec![[40, 200, 90], [40, 40, 90]];
        let inverse: Vec<&[u8]> = inverse.iter().map(|b| b.as_slice()).collect();
        // Gray 11 is 2, Gray 01 is 1.
        assert_eq!(decode_gray(&bits, GrayImages::Inverse(&inverse), Some(10.0)).unwrap(), [2, 1, -1]);
        let (white, black) = ([200, 200, 95], [40, 40, 90]);
        assert_eq!(decode_gray(&bits, GrayImages::WhiteBlack(&white, &black), Some(10.0)).unwrap(), [2, 1, -1]);
        assert!(decode_gray(&bits, GrayImages::Inverse(&inverse[..1]), None).is_err());
        assert!(decode_gray::<u8>(&[], GrayImages::Inverse(&[]), None).is_err());
        assert!(absolute_from_gray(&[1], &[]).is_err());
    }
}
