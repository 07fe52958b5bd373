//! One profile across the seam, with running sums: a line or a parabola over any stretch of it costs nothing.

/// Sums of 1, x, x², x³, x⁴, h, xh, x²h, h².
const SUMS: usize = 9;

/// Heights at equal distances, NaN where there is none.
#[derive(Debug, Clone)]
pub(crate) struct Profile {
    /// Where the first bin begins.
    pub start: f64,
    /// Width of a bin, mm.
    pub bin: f64,
    pub heights: Vec<f64>,
    sums: Vec<[f64; SUMS]>,
    /// x is counted from here in the sums, so that they do not cancel.
    middle: f64,
}

/// A straight line by least squares.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Line {
    pub count: f64,
    pub x: f64,
    pub h: f64,
    pub slope: f64,
    pub sxx: f64,
    pub sse: f64,
}

impl Line {
    pub fn at(&self, x: f64) -> f64 {
        self.h + self.slope * (x - self.x)
    }

    pub fn rms(&self) -> f64 {
        (self.sse / self.count).sqrt()
    }
}

/// A parabola by least squares: `c0 + c1 x + c2 x²`, x from the profile's middle.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Parabola {
    pub coefficients: [f64; 3],
    pub sse: f64,
    middle: f64,
}

impl Parabola {
    pub fn at(&self, x: f64) -> f64 {
        let [a, b, c] = self.coefficients;
        let x = x - self.middle;
        a + x * (b + x * c)
    }
}

impl Profile {
    pub fn new(start: f64, bin: f64, heights: Vec<f64>) -> Self {
        let mut profile =
            Self { start, bin, middle: start + 0.5 * bin * heights.len() as f64, sums: Vec::new(), heights };
        profile.sums = profile.running(|_| true);
        profile
    }

    /// The same seen from the other side: x becomes −x.
    pub fn mirrored(&self) -> Self {
        let end = self.start + self.bin * self.heights.len() as f64;
        Self::new(-end, self.bin, self.heights.iter().rev().copied().collect())
    }

    /// The profile without the bins that are not kept.
    pub fn keeping(&self, keep: impl Fn(usize) -> bool) -> Self {
        let heights = self.heights.iter().enumerate().map(|(i, &h)| if keep(i) { h } else { f64::NAN }).collect();
        Self::new(self.start, self.bin, heights)
    }

    fn running(&self, keep: impl Fn(usize) -> bool) -> Vec<[f64; SUMS]> {
        let mut sums = Vec::with_capacity(self.heights.len() + 1);
        let mut so_far = [0.0; SUMS];
        sums.push(so_far);
        for (i, &h) in self.heights.iter().enumerate() {
            if h.is_finite() && keep(i) {
                let x = self.x(i) - self.middle;
                let xx = x * x;
                for (s, v) in so_far.iter_mut().zip([1.0, x, xx, xx * x, xx * xx, h, x * h, xx * h, h * h]) {
                    *s += v;
                }
            }
            sums.push(so_far);
        }
        sums
    }

    pub fn len(&self) -> usize {
        self.heights.len()
    }

    /// Middle of a bin.
    pub fn x(&self, i: usize) -> f64 {
        self.start + (i as f64 + 0.5) * self.bin
    }

    /// Where a bin begins.
    pub fn edge(&self, i: usize) -> f64 {
        self.start + i as f64 * self.bin
    }

    /// The boundary between bins next to x, in [0, len].
    pub fn boundary(&self, x: f64) -> usize {
        ((x - self.start) / self.bin + 0.5).clamp(0.0, self.len() as f64) as usize
    }

    /// A length in whole bins.
    pub fn in_bins(&self, length: f64) -> usize {
        (length / self.bin + 0.5).max(1.0) as usize
    }

    fn sum(&self, from: usize, to: usize) -> [f64; SUMS] {
        std::array::from_fn(|k| self.sums[to][k] - self.sums[from][k])
    }

    pub fn count(&self, from: usize, to: usize) -> f64 {
        self.sums[to][0] - self.sums[from][0]
    }

    /// Mean place and mean height of bins [from, to).
    pub fn mean(&self, from: usize, to: usize) -> Option<(f64, f64)> {
        let n = self.count(from, to);
        (n > 0.0).then(|| {
            let sum = |k: usize| self.sums[to][k] - self.sums[from][k];
            (self.middle + sum(1) / n, sum(5) / n)
        })
    }

    /// The line through bins [from, to); `None` with fewer than three.
    pub fn line(&self, from: usize, to: usize) -> Option<Line> {
        let sum = |k: usize| self.sums[to][k] - self.sums[from][k];
        let n = sum(0);
        if n < 3.0 {
            return None;
        }
        let (x, h) = (sum(1) / n, sum(5) / n);
        let sxx = sum(2) - n * x * x;
        if sxx <= 0.0 {
            return None;
        }
        let sxh = sum(6) - n * x * h;
        let shh = sum(8) - n * h * h;
        let slope = sxh / sxx;
        Some(Line { count: n, x: self.middle + x, h, slope, sxx, sse: (shh - slope * sxh).max(0.0) })
    }

    /// The parabola through bins [from, to); `None` with fewer than three.
    pub fn parabola(&self, from: usize, to: usize) -> Option<Parabola> {
        let s = self.sum(from, to);
        let n = s[0];
        if n < 3.0 {
            return None;
        }
        // About the stretch's own middle, in units of its half length, else the normal equations lose their digits.
        let (m, u) = (s[1] / n, (0.5 * self.bin * (to - from) as f64).max(self.bin));
        let central = {
            let s2 = s[2] - 2.0 * m * s[1] + n * m * m;
            let s3 = s[3] - 3.0 * m * s[2] + 3.0 * m * m * s[1] - n * m.powi(3);
            let s4 = s[4] - 4.0 * m * s[3] + 6.0 * m * m * s[2] - 4.0 * m.powi(3) * s[1] + n * m.powi(4);
            [n, 0.0, s2 / (u * u), s3 / u.powi(3), s4 / u.powi(4)]
        };
        let b0 = s[5];
        let b1 = (s[6] - m * s[5]) / u;
        let b2 = (s[7] - 2.0 * m * s[6] + m * m * s[5]) / (u * u);
        let [p0, p1, p2, p3, p4] = central;
        let a = nalgebra::Matrix3::new(p0, p1, p2, p1, p2, p3, p2, p3, p4);
        let b = nalgebra::Vector3::new(b0, b1, b2);
        let c = a.cholesky()?.solve(&b);
        let sse = (s[8] - c.dot(&b)).max(0.0);
        // Back to powers of x from the profile's middle.
        let (c1, c2) = (c[1] / u, c[2] / (u * u));
        let coefficients = [c[0] - c1 * m + c2 * m * m, c1 - 2.0 * c2 * m, c2];
        Some(Parabola { coefficients, sse, middle: self.middle })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_and_parabolas_are_those_of_plain_least_squares() {
        let heights: Vec<f64> = (0..60)
            .map(|i| if i % 7 == 3 { f64::NAN } else { 0.3 + 0.02 * f64::from(i) - 0.001 * f64::from(i * i % 17) })
            .collect();
        let profile = Profile::new(-12.0, 0.4, heights.clone());
        for (from, to) in [(0, 60), (5, 19), (30, 36)] {
            let kept: Vec<(f64, f64)> =
                (from..to).filter(|&i| heights[i].is_finite()).map(|i| (profile.x(i), heights[i])).collect();
            for degree in [1, 2] {
                let a = nalgebra::DMatrix::from_fn(kept.len(), degree + 1, |r, c| kept[r].0.powi(c as i32));
                let b = nalgebra::DVector::from_iterator(kept.len(), kept.iter().map(|p| p.1));
                let c = a.clone().svd(true, true).solve(&b, 1e-14).unwrap();
                let sse = (&a * &c - &b).norm_squared();
                let plain = |x: f64| (0..=degree).map(|k| c[k] * x.powi(k as i32)).sum::<f64>();
                let (at, found) = if degree == 1 {
                    let line = profile.line(from, to).unwrap();
                    (line.at(-3.0), line.sse)
                } else {
                    let parabola = profile.parabola(from, to).unwrap();
                    (parabola.at(-3.0), parabola.sse)
                };
                assert!((at - plain(-3.0)).abs() < 1e-8 && (found - sse).abs() < 1e-9, "{degree} {at} {found} {sse}");
            }
        }
    }

    #[test]
    fn a_mirrored_profile_reads_the_same_backwards() {
        let profile = Profile::new(1.0, 0.5, vec![1.0, 2.0, f64::NAN, 5.0]);
        let mirrored = profile.mirrored();
        assert_eq!(mirrored.x(0), -profile.x(3));
        assert_eq!(mirrored.heights[0], 5.0);
        assert_eq!(profile.mean(0, 2), Some((1.5, 1.5)));
    }
}
