//! How a wall's unevenness varies across the seam: the few shapes that a Matérn-5/2 process has over the rows of a wall.
//!
//! A process over the rows, the seam itself among them, is `φ(z)·x` with independent x of unit variance and
//! `φ(z) = sd K(z, rows) U Λ^-1/2` from the eigenvectors U and eigenvalues Λ of K(rows, rows): those above a share of the largest.
//! What the cut loses at the seam is known and never dropped, see [`Basis::lost`].
//!
//! Source: C. Williams and M. Seeger, Using the Nyström method to speed up kernel machines, NIPS 13 (2001), eq. 5 to 9.

use nalgebra::DMatrix;

/// Eigenvalues below this share of the largest are left out: 1e-4 would lose 4 % of the uncertainty of long waves.
const LEAST_SHARE: f64 = 1e-5;

/// Shapes across the seam.
#[derive(Debug, Clone)]
pub(super) struct Basis {
    rows_mm: Vec<f64>,
    rank: usize,
    /// Row by row, each of the rank: `sd U Λ^-1/2`.
    shapes: Vec<f64>,
    length_mm: f64,
    variance: f64,
}

impl Basis {
    /// Of waves of this standard deviation and length over the rows at these places.
    pub fn new(rows_mm: &[f64], sd_mm: f64, length_mm: f64) -> Self {
        let n = rows_mm.len();
        let kernel = DMatrix::from_fn(n, n, |i, j| matern(rows_mm[i] - rows_mm[j], length_mm));
        let eigen = kernel.symmetric_eigen();
        let largest = eigen.eigenvalues.max();
        let mut kept: Vec<usize> = (0..n).filter(|&k| eigen.eigenvalues[k] > LEAST_SHARE * largest).collect();
        kept.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
        let shape = |i: usize, k: &usize| sd_mm * eigen.eigenvectors[(i, *k)] / eigen.eigenvalues[*k].sqrt();
        let shapes = (0..n).flat_map(|i| kept.iter().map(move |k| shape(i, k))).collect();
        Self { rows_mm: rows_mm.to_vec(), rank: kept.len(), shapes, length_mm, variance: sd_mm * sd_mm }
    }

    /// How many shapes there are.
    pub fn rank(&self) -> usize {
        self.rank
    }

    /// Their values at a place across.
    pub fn at(&self, across_mm: f64, out: &mut [f64]) {
        out.fill(0.0);
        for (row, shapes) in self.rows_mm.iter().zip(self.shapes.chunks_exact(self.rank.max(1))) {
            let k = matern(across_mm - row, self.length_mm);
            out.iter_mut().zip(shapes).for_each(|(slot, shape)| *slot += k * shape);
        }
    }

    /// The variance at a place that the shapes kept do not hold.
    pub fn lost(&self, across_mm: f64) -> f64 {
        let mut shapes = vec![0.0; self.rank()];
        self.at(across_mm, &mut shapes);
        (self.variance - shapes.iter().map(|v| v * v).sum::<f64>()).max(0.0)
    }
}

/// The Matérn-5/2 correlation.
pub(super) fn matern(distance_mm: f64, length_mm: f64) -> f64 {
    let a = 5_f64.sqrt() * distance_mm.abs() / length_mm;
    (1.0 + a + a * a / 3.0) * (-a).exp()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shapes_hold_the_covariance_between_rows() {
        let rows: Vec<f64> = (0..14).map(|k| 5.0 * f64::from(k)).collect();
        for length in [4.0, 20.0, 80.0, 400.0] {
            let basis = Basis::new(&rows, 0.02, length);
            let (mut a, mut b) = (vec![0.0; basis.rank()], vec![0.0; basis.rank()]);
            for (z, y) in [(0.0, 0.0), (0.0, 10.0), (20.0, 55.0)] {
                basis.at(z, &mut a);
                basis.at(y, &mut b);
                let found: f64 = a.iter().zip(&b).map(|(p, q)| p * q).sum();
                let expected = 4e-4 * matern(z - y, length);
                assert!((found - expected).abs() < 2e-4 * 4e-4, "{length}: {found} is not {expected}");
            }
            assert!(basis.lost(0.0) < 1e-3 * 4e-4 && basis.rank() < 15);
        }
        // Between rows, short waves are mostly lost; and that is said.
        assert!(Basis::new(&rows, 1.0, 4.0).lost(2.5) > 0.1);
    }
}
