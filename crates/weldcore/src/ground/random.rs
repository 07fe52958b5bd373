//! Random numbers that are functions of a seed and a place: the same bits in any order, on any number of threads.

use std::f64::consts::TAU;

use super::threads::Lasting;

/// Random numbers by counting: SplitMix64 of seed and counter (Steele, Lea, Flood, OOPSLA 2014).
#[derive(Debug, Clone, Copy)]
pub struct Counter {
    seed: u64,
}

impl Counter {
    /// Numbers of this seed.
    pub fn new(seed: u64) -> Self {
        Self { seed: mix(seed ^ 0x5851_F42D_4C95_7F2D) }
    }

    /// The number at a place, uniform below `limit` (0 for a limit of 0).
    pub fn below(&self, place: u64, limit: usize) -> usize {
        let bits = mix(self.seed.wrapping_add(place.wrapping_mul(0x9E37_79B9_7F4A_7C15)));
        ((u128::from(bits) * limit as u128) >> 64) as usize
    }
}

/// A hash of 64 bits in which every bit of the input matters (the finaliser of SplitMix64, Steele et al. 2014).
#[inline]
pub(crate) fn mix(counter: u64) -> u64 {
    let mut z = counter.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// The normal distribution in 65536 equally likely values: its quantiles, scaled to unit variance.
pub(crate) struct Normals(Vec<f32>);

impl Normals {
    const HALF: usize = 1 << 15;

    fn tabulate() -> Self {
        // dx/dp = 1/density(x) from p = 1/2 up, by Runge-Kutta with four steps from value to value.
        let slope = |x: f64| (0.5 * x * x).exp() * TAU.sqrt();
        let (mut x, h) = (0.0f64, 1.0 / (8.0 * Self::HALF as f64));
        let mut half = Vec::with_capacity(Self::HALF);
        for step in 0..4 * Self::HALF - 1 {
            if step % 4 == 2 {
                half.push(x);
            }
            let a = slope(x);
            let b = slope(x + 0.5 * h * a);
            let c = slope(x + 0.5 * h * b);
            let d = slope(x + h * c);
            x += h * (a + 2.0 * b + 2.0 * c + d) / 6.0;
        }
        let rms = (half.iter().map(|x| x * x).sum::<f64>() / half.len() as f64).sqrt();
        Self(half.iter().map(|x| -x / rms).chain(half.iter().map(|x| x / rms)).map(|x| x as f32).collect())
    }

    #[inline]
    pub(crate) fn draw(&self, random: u64) -> f32 {
        self.0.get((random >> 48) as usize).copied().unwrap_or(0.0)
    }
}

/// The table, made once.
pub(crate) fn normals() -> &'static Normals {
    static TABLE: Lasting<Normals> = Lasting::new();
    TABLE.get(Normals::tabulate)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normals_have_the_moments_and_quantiles_of_the_normal_distribution() {
        let values: Vec<f64> = normals().0.iter().map(|&x| f64::from(x)).collect();
        let moment = |k: i32| values.iter().map(|x| x.powi(k)).sum::<f64>() / values.len() as f64;
        assert!(moment(1).abs() < 1e-6 && (moment(2) - 1.0).abs() < 1e-6 && moment(3).abs() < 1e-5);
        // The tails end at 4.3 sigma: the fourth moment is a little below 3.
        assert!((moment(4) - 3.0).abs() < 0.01);
        for (share, quantile) in [(0.841_344_746, 1.0), (0.977_249_868, 2.0), (0.998_650_102, 3.0)] {
            let below = values.iter().filter(|&&x| x < quantile).count() as f64 / values.len() as f64;
            assert!((below - share).abs() < 5e-5, "{quantile}: {below}");
        }
    }

    #[test]
    fn hashed_bits_are_balanced_and_neighbours_are_unrelated() {
        let draws: Vec<f64> = (0..200_000u64).map(|i| f64::from(normals().draw(mix(i)))).collect();
        let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
        let next: Vec<f64> = draws.windows(2).map(|w| w[0] * w[1]).collect();
        let square: Vec<f64> = draws.iter().map(|x| x * x).collect();
        // Five standard errors of 200,000 draws.
        let limit = 5.0 / (draws.len() as f64).sqrt();
        assert!(mean(&draws).abs() < limit && mean(&next).abs() < limit);
        assert!((mean(&square) - 1.0).abs() < limit * 2f64.sqrt());
    }
}
