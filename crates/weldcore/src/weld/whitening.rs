//! Columns of a linear model over points of one wall, divided by the root of the wall's covariance.
//!
//! The covariance is that of the walls' unevenness: `wendland` of the distance over the supports
//! around and along the wall, and a nugget of what neighbours do not share; here in units of the unevenness' variance.
//! Least squares of the whitened columns are generalised least squares of the plain ones.
//!
//! Source: K.-R. Koch, Parameter Estimation (1999), 3.2; the Cholesky factor is of all points, some hundred.

use nalgebra::DMatrix;

use crate::error::{Error, Result, require_positive};
use crate::ground::memory::require;

/// Wendland's positive definite function of support 1, smooth at 0 as a Gaussian is: H. Wendland, Adv. Comput. Math. 4 (1995)
/// 389, φ(3,1).
fn wendland(r: f64) -> f64 {
    if r < 1.0 { (1.0 - r).powi(4) * (4.0 * r + 1.0) } else { 0.0 }
}

/// `L⁻¹ columns`, where `L Lᵀ` is the covariance of the points.
///
/// `places_mm`: each point's place around and along the wall. `support_mm`: where the correlation ends, around and along.
/// `columns`: row by row, as many rows as points; what is not finite in them stays so.
///
/// # Errors
/// [`Error::Shape`] where `columns` are not whole rows; [`Error::NonFinite`]; [`Error::OutOfRange`] for a support or nugget
/// that is not above zero.
pub fn whitened(places_mm: &[[f64; 2]], support_mm: [f64; 2], nugget: f64, columns: &[f64]) -> Result<Vec<f64>> {
    let n = places_mm.len();
    require_positive("support_mm", support_mm[0])?;
    require_positive("support_mm", support_mm[1])?;
    require_positive("nugget", nugget)?;
    if let Some(index) = places_mm.iter().flatten().position(|v| !v.is_finite()) {
        return Err(Error::NonFinite { what: "places_mm", index: index / 2 });
    }
    let wide = columns.len() / n.max(1);
    if wide * n != columns.len() {
        let (expected, got) = (format!("rows of {n} points"), format!("{} numbers", columns.len()));
        return Err(Error::Shape { what: "columns", expected, got });
    }
    require(n * n, 16);
    let between = |i: usize, j: usize| {
        let apart: [f64; 2] = std::array::from_fn(|way| (places_mm[i][way] - places_mm[j][way]) / support_mm[way]);
        wendland(apart[0].hypot(apart[1])) + if i == j { nugget } else { 0.0 }
    };
    let root = DMatrix::from_fn(n, n, between).cholesky().ok_or_else(|| Error::Degenerate {
        what: "covariance of a wall",
        reason: "the nugget is below its rounding".into(),
    })?;
    let mut white = DMatrix::from_row_slice(n, wide, columns);
    root.l_dirty().solve_lower_triangular_mut(&mut white);
    Ok(white.transpose().as_slice().to_vec())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whitened_columns_have_the_inverse_covariance_as_their_product() {
        let places: Vec<[f64; 2]> = (0..40).map(|k| [f64::from(k % 8) * 3.0, f64::from(k / 8) * 5.0]).collect();
        let (support, nugget) = ([10.0, 25.0], 0.1);
        let columns: Vec<f64> = (0..80).map(|k| f64::from(k * k % 17)).collect();
        let white = whitened(&places, support, nugget, &columns).unwrap();
        let covariance = DMatrix::from_fn(40, 40, |i, j| {
            let r = ((places[i][0] - places[j][0]) / 10.0).hypot((places[i][1] - places[j][1]) / 25.0);
            let near = (1.0 - r).max(0.0);
            near.powi(4) * (4.0 * r + 1.0) + if i == j { nugget } else { 0.0 }
        });
        let plain = DMatrix::from_row_slice(40, 2, &columns);
        let expected = plain.transpose() * covariance.try_inverse().unwrap() * &plain;
        let white = DMatrix::from_row_slice(40, 2, &white);
        assert!((white.transpose() * &white - &expected).amax() < 1e-9 * expected.amax());
        assert!((&white - &plain).amax() > 1.0);
    }

    #[test]
    fn what_is_no_wall_is_refused() {
        assert!(whitened(&[[0.0; 2]; 2], [1.0; 2], 0.1, &[1.0; 3]).is_err());
        assert!(whitened(&[[0.0; 2]], [0.0, 1.0], 0.1, &[1.0]).is_err());
        assert!(whitened(&[[0.0; 2]], [1.0; 2], 0.0, &[1.0]).is_err());
        assert!(whitened(&[[f64::NAN, 0.0]], [1.0; 2], 0.1, &[1.0]).is_err());
        assert!(whitened(&[], [1.0; 2], 0.1, &[]).unwrap().is_empty());
    }
}
