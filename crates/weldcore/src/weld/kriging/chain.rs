//! A Matérn-3/2 process along the seam, column by column, as a Markov chain of two states.
//!
//! The covariance `(1 + k|d|) exp(-k|d|)`, k = √3/length, is that of the state (x, x'/k), which goes from one column to the
//! next, `a = k·spacing` further, by `Φ = e⁻ᵃ [[1+a, a], [-a, 1-a]]` and fresh noise of covariance `Q = I - ΦΦᵀ`. The precision of
//! a whole chain is block tridiagonal: elimination along it costs as much as there are columns, however long the waves.
//!
//! Source: J. Hartikainen and S. Särkkä, Kalman filtering and smoothing solutions to temporal Gaussian process regression models,
//! MLSP 2010, eq. 9 to 12.

/// A 2x2 matrix.
pub(super) type Two = [[f64; 2]; 2];

/// The blocks of a chain's precision.
#[derive(Debug, Clone, Copy)]
pub(super) struct ColumnChain {
    /// Of a column between two others.
    pub inner: Two,
    /// Of the first and the last column of an open chain.
    pub first: Two,
    pub last: Two,
    /// Between a column and the one before it: `-Q⁻¹ Φ`.
    pub link: Two,
    /// `k`: the second state is the derivative over this, per mm.
    pub rate: f64,
}

impl ColumnChain {
    /// The chain of waves of this length between columns this far apart.
    pub fn new(length_mm: f64, spacing_mm: f64) -> Self {
        let rate = 3_f64.sqrt() / length_mm;
        let a = rate * spacing_mm;
        let decay = (-a).exp();
        let phi = [[decay * (1.0 + a), decay * a], [-decay * a, decay * (1.0 - a)]];
        // Σ (2a)^k / k! from k = 3 on: the difference from one would lose its digits for long waves.
        let mut term = (2.0 * a).powi(3) / 6.0;
        let mut tail = 0.0;
        for k in 4..60 {
            tail += term;
            term *= 2.0 * a / f64::from(k);
            if term < 1e-18 * tail {
                break;
            }
        }
        let square = decay * decay;
        let (xx, xv, vv) = (square * tail, 2.0 * a * a * square, square * (tail + 4.0 * a));
        let over = 1.0 / (xx * vv - xv * xv);
        let fresh = [[vv * over, -xv * over], [-xv * over, xx * over]];
        let link = product(&fresh, &phi).map(|row| row.map(|v| -v));
        let back = product(&transposed(&phi), &link).map(|row| row.map(|v| -v));
        let add = |a: &Two, b: &Two| [[a[0][0] + b[0][0], a[0][1] + b[0][1]], [a[1][0] + b[1][0], a[1][1] + b[1][1]]];
        let one = [[1.0, 0.0], [0.0, 1.0]];
        Self { inner: add(&fresh, &back), first: add(&one, &back), last: fresh, link, rate }
    }
}

/// How a Matérn-3/2 process of this length correlates at a distance.
pub(super) fn correlation(distance_mm: f64, length_mm: f64) -> f64 {
    let a = 3_f64.sqrt() * distance_mm.abs() / length_mm;
    (1.0 + a) * (-a).exp()
}

fn product(a: &Two, b: &Two) -> Two {
    std::array::from_fn(|i| std::array::from_fn(|j| a[i][0] * b[0][j] + a[i][1] * b[1][j]))
}

pub(super) fn transposed(a: &Two) -> Two {
    [[a[0][0], a[1][0]], [a[0][1], a[1][1]]]
}

#[cfg(test)]
mod tests {
    use nalgebra::DMatrix;

    use super::*;

    #[test]
    fn an_open_chain_has_the_covariance_of_the_process() {
        for (length, spacing) in [(5.0, 5.0), (25.0, 4.0), (400.0, 5.0), (600.0, 0.5)] {
            let chain = ColumnChain::new(length, spacing);
            let n = 12;
            let mut precision = DMatrix::<f64>::zeros(2 * n, 2 * n);
            for c in 0..n {
                let own = if c == 0 {
                    chain.first
                } else if c == n - 1 {
                    chain.last
                } else {
                    chain.inner
                };
                for i in 0..2 {
                    for j in 0..2 {
                        precision[(2 * c + i, 2 * c + j)] = own[i][j];
                        if c > 0 {
                            precision[(2 * c + i, 2 * c - 2 + j)] = chain.link[i][j];
                            precision[(2 * c - 2 + j, 2 * c + i)] = chain.link[i][j];
                        }
                    }
                }
            }
            let covariance = precision.cholesky().unwrap().inverse();
            for i in 0..n {
                for j in 0..n {
                    let expected = correlation((i as f64 - j as f64) * spacing, length);
                    let found = covariance[(2 * i, 2 * j)];
                    assert!((found - expected).abs() < 1e-6, "{length} {spacing}: {found} is not {expected}");
                }
            }
        }
    }
}
