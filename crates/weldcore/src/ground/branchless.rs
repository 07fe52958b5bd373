//! Arithmetic without branches or calls, so that loops over it become vector instructions on every machine.

/// atan2(y, x) / 2π to 3e-8; 0 at the origin. Branch-free: the smaller of |x| and |y| over the larger, shifted by 45°
/// where that lies beyond tan 22.5°, then an odd polynomial through Chebyshev points.
#[inline(always)]
pub(crate) fn turns(y: f32, x: f32) -> f32 {
    let (above, below) = turns_quotient(y, x);
    turns_of(above / below, y, x)
}

/// The quotient that [`turns_of`] wants, not yet divided; the divisor is 1e-6 at least.
#[inline(always)]
pub(crate) fn turns_quotient(y: f32, x: f32) -> (f32, f32) {
    let (ax, ay) = (x.abs(), y.abs());
    let (large, small) = if ax > ay { (ax, ay) } else { (ay, ax) };
    let far = small > 0.414_213_57 * large;
    let above = if far { small - large } else { small };
    let below = if far { small + large } else { large };
    (above, if below > 1e-6 { below } else { 1e-6 })
}

#[inline(always)]
pub(crate) fn turns_of(q: f32, y: f32, x: f32) -> f32 {
    let (ax, ay) = (x.abs(), y.abs());
    let (large, small) = if ax > ay { (ax, ay) } else { (ay, ax) };
    let far = small > 0.414_213_57 * large;
    let z = q * q;
    let p = 3.178_972_8e-2 + z * (-2.204_043_7e-2 + z * 1.269_426_5e-2);
    let p = q * (0.159_154_94 + z * (-5.305_077_6e-2 + z * p));
    let p = if far { p + 0.125 } else { p };
    let p = if ay > ax { 0.25 - p } else { p };
    let p = if x.is_sign_negative() { 0.5 - p } else { p };
    p.copysign(y)
}

/// atan2(y, x) to 4e-16, as [`turns`].
#[inline(always)]
pub(crate) fn atan2(y: f64, x: f64) -> f64 {
    const TERMS: [f64; 11] = [
        1.0,
        -0.333_333_333_333_284_35,
        0.199_999_999_988_544_29,
        -0.142_857_141_809_171_9,
        0.111_111_061_779_333_73,
        -0.090_907_730_142_858_7,
        0.076_899_526_223_186_42,
        -0.066_402_261_887_265_36,
        0.056_883_080_900_218_03,
        -0.043_479_319_371_411_9,
        0.021_133_886_187_624_962,
    ];
    let (ax, ay) = (x.abs(), y.abs());
    let (large, small) = if ax > ay { (ax, ay) } else { (ay, ax) };
    let far = small > 0.414_213_562_373_095_03 * large;
    let above = if far { small - large } else { small };
    let below = if far { small + large } else { large };
    let q = above / (if below > 0.0 { below } else { 1.0 });
    let z = q * q;
    let mut p = 0.0;
    for term in TERMS.iter().rev() {
        p = p * z + term;
    }
    let p = q * p;
    let p = if far { p + std::f64::consts::FRAC_PI_4 } else { p };
    let p = if ay > ax { std::f64::consts::FRAC_PI_2 - p } else { p };
    let p = if x.is_sign_negative() { std::f64::consts::PI - p } else { p };
    p.copysign(y)
}

/// The nearest whole number, for |x| < 2²². Written as a sum, for the baseline has no instruction to round with.
#[inline(always)]
pub(crate) fn round(x: f32) -> f32 {
    const SHIFT: f32 = 12_582_912.0;
    (x + SHIFT) - SHIFT
}

/// The nearest whole number, for |x| < 2⁵¹.
#[inline(always)]
pub(crate) fn round64(x: f64) -> f64 {
    const SHIFT: f64 = 6_755_399_441_055_744.0;
    (x + SHIFT) - SHIFT
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn arctangents_are_those_of_the_standard_library(x in -300.0..300.0f64, y in -300.0..300.0f64) {
            prop_assert!((atan2(y, x) - y.atan2(x)).abs() < 9e-16);
            let exact = y.atan2(x) / TAU;
            prop_assert!((f64::from(turns(y as f32, x as f32)) - exact).abs() < 5e-8 + 1e-7 / (x.abs() + y.abs()));
        }

        #[test]
        fn rounding_is_to_the_nearest(x in -1000.0..1000.0f32) {
            prop_assert_eq!(round(x), x.round_ties_even());
            prop_assert_eq!(round64(f64::from(x)), f64::from(x).round_ties_even());
        }
    }

    #[test]
    fn axes_and_origin() {
        for (y, x, t) in [(0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.25), (0.0, -1.0, 0.5), (-1.0, 0.0, -0.25)] {
            assert_eq!(turns(y, x), t);
            assert!((atan2(f64::from(y), f64::from(x)) - f64::from(t) * TAU).abs() < 4e-16);
        }
    }
}
