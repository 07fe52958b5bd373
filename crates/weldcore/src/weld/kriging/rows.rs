//! Small dense matrices, row by row: the four operations that an elimination by blocks lives on.
//!
//! All of them add multiples of rows to a row, which the compiler turns into vector instructions; nothing is shared between
//! threads, so that the order of every sum is fixed.

use multiversion::multiversion;

/// Rows that are taken together: each load of the sum serves so many products.
const TOGETHER: usize = 8;

/// `out += Σ coefficients[k] · rows[k]`, rows being `stride` long and read from `from` on.
#[inline(always)]
fn add_rows(out: &mut [f64], rows: &[f64], stride: usize, from: usize, coefficients: impl Fn(usize) -> f64) {
    let count = rows.len() / stride;
    let length = out.len();
    let row = |k: usize| &rows[k * stride + from..k * stride + from + length];
    let mut k = 0;
    while k + TOGETHER <= count {
        let a: [f64; TOGETHER] = std::array::from_fn(|i| coefficients(k + i));
        let r: [&[f64]; TOGETHER] = std::array::from_fn(|i| row(k + i));
        for j in 0..length {
            let first = (a[0] * r[0][j] + a[1] * r[1][j]) + (a[2] * r[2][j] + a[3] * r[3][j]);
            let second = (a[4] * r[4][j] + a[5] * r[5][j]) + (a[6] * r[6][j] + a[7] * r[7][j]);
            out[j] += first + second;
        }
        k += TOGETHER;
    }
    while k < count {
        let (a, r) = (coefficients(k), row(k));
        for j in 0..length {
            out[j] += a * r[j];
        }
        k += 1;
    }
}

/// The upper triangle of `gram += ZᵀZ`; `z` has rows of `columns`.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
pub(super) fn add_gram(gram: &mut [f64], z: &[f64], columns: usize) {
    for (i, out) in gram.chunks_exact_mut(columns).enumerate() {
        add_rows(&mut out[i..], z, columns, i, |k| z[k * columns + i]);
    }
}

/// `out -= WᵀZ`; W has rows of `width`, Z and `out` of `columns`.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
pub(super) fn subtract_product(out: &mut [f64], w: &[f64], width: usize, z: &[f64], columns: usize) {
    for (i, out) in out.chunks_exact_mut(columns).enumerate() {
        add_rows(out, z, columns, 0, |k| -w[k * width + i]);
    }
}

/// The lower triangle of `out -= WᵀW`; both have rows of `width`.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
pub(super) fn subtract_gram(out: &mut [f64], w: &[f64], width: usize) {
    for (i, out) in out.chunks_exact_mut(width).enumerate() {
        add_rows(&mut out[..=i], w, width, 0, |k| -w[k * width + i]);
    }
}

/// `L⁻¹ R` in place; L is the lower factor, `size` square, R has rows of `columns`.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
pub(super) fn forward(lower: &[f64], size: usize, right: &mut [f64], columns: usize) {
    for i in 0..size {
        let (done, rest) = right.split_at_mut(i * columns);
        let factors = &lower[i * size..(i + 1) * size];
        let out = &mut rest[..columns];
        add_rows(out, done, columns, 0, |k| -factors[k]);
        let over = 1.0 / factors[i];
        out.iter_mut().for_each(|v| *v *= over);
    }
}

/// A cell's part in a block's equations: `own += w a aᵀ` (lower triangle, `size` wide, a's place being `first`), and `right += w a x`
/// for the parts of x that are not zero, each with where it begins, and for the cell's height.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
#[allow(clippy::too_many_arguments)]
pub(super) fn add_cell(
    own: &mut [f64],
    (size, first): (usize, usize),
    right: &mut [f64],
    columns: usize,
    row: &[f64],
    weight: f64,
    parts: &[(usize, &[f64]); 2],
    (height_at, height): (usize, f64),
) {
    for (a, value) in row.iter().enumerate() {
        let scaled = weight * value;
        let out = &mut own[(first + a) * size + first..][..=a];
        out.iter_mut().zip(row).for_each(|(o, v)| *o += scaled * v);
        let out = &mut right[(first + a) * columns..][..columns];
        for (at, part) in parts {
            out[*at..].iter_mut().zip(*part).for_each(|(o, v)| *o += scaled * v);
        }
        out[height_at] += scaled * height;
    }
}

/// The lower Cholesky factor of a symmetric matrix of which the lower triangle is given, in its place (the upper triangle becomes
/// its transpose), and the logarithm of its determinant; `None` where it is not positive definite.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
pub(super) fn cholesky(matrix: &mut [f64], size: usize) -> Option<f64> {
    for i in 0..size {
        for j in 0..i {
            matrix[j * size + i] = matrix[i * size + j];
        }
    }
    // Row by row of the upper factor: each is what is left of its own after multiples of those above.
    let mut log_det = 0.0;
    for i in 0..size {
        let (done, rest) = matrix.split_at_mut(i * size);
        let out = &mut rest[i..size];
        add_rows(out, done, size, i, |k| -done[k * size + i]);
        let pivot = out[0];
        if !(pivot > 0.0 && pivot.is_finite()) {
            return None;
        }
        log_det += pivot.ln();
        let over = 1.0 / pivot.sqrt();
        out.iter_mut().for_each(|v| *v *= over);
    }
    for i in 0..size {
        for j in 0..i {
            matrix[i * size + j] = matrix[j * size + i];
        }
    }
    Some(log_det)
}

#[cfg(test)]
mod tests {
    use nalgebra::DMatrix;

    use super::*;

    fn matrix(rows: usize, columns: usize, seed: u64) -> Vec<f64> {
        let place =
            |k: u64| (crate::ground::random::mix(seed.wrapping_add(k)) >> 11) as f64 / (1_u64 << 53) as f64 - 0.5;
        (0..rows * columns).map(|k| place(k as u64)).collect()
    }

    #[test]
    fn they_are_what_a_matrix_library_says() {
        let (rows, width, columns) = (13, 7, 21);
        let (z, w) = (matrix(rows, columns, 1), matrix(rows, width, 2));
        let (zm, wm) = (DMatrix::from_row_slice(rows, columns, &z), DMatrix::from_row_slice(rows, width, &w));
        let mut gram = vec![0.0; columns * columns];
        add_gram(&mut gram, &z, columns);
        let expected = zm.tr_mul(&zm);
        for i in 0..columns {
            for j in i..columns {
                assert!((gram[i * columns + j] - expected[(i, j)]).abs() < 1e-14);
            }
        }
        let mut out = vec![0.0; width * columns];
        subtract_product(&mut out, &w, width, &z, columns);
        assert!((DMatrix::from_row_slice(width, columns, &out) + wm.tr_mul(&zm)).amax() < 1e-14);

        let mut square = vec![0.0; width * width];
        subtract_gram(&mut square, &w, width);
        let expected = wm.tr_mul(&wm);
        assert!((0..width).all(|i| (0..=i).all(|j| (square[i * width + j] + expected[(i, j)]).abs() < 1e-14)));

        let positive = zm.tr_mul(&zm) + DMatrix::identity(columns, columns);
        let mut lower: Vec<f64> = positive.transpose().as_slice().to_vec();
        let log_det = cholesky(&mut lower, columns).unwrap();
        assert!((log_det - positive.determinant().ln()).abs() < 1e-10);
        let right = matrix(columns, 5, 3);
        let mut solved = right.clone();
        forward(&lower, columns, &mut solved, 5);
        let factor = positive.cholesky().unwrap().l();
        let expected = factor.solve_lower_triangular(&DMatrix::from_row_slice(columns, 5, &right)).unwrap();
        assert!((DMatrix::from_row_slice(columns, 5, &solved) - expected).amax() < 1e-12);
        assert!(cholesky(&mut [1.0, 2.0, 2.0, 1.0], 2).is_none());
    }
}
