//! The distance of a point from the surface that a cloud shows around it: from the quadric through the patch.
//!
//! The patch is turned into its principal axes, and its height over the plane of the first two is described by a quadric,
//! by least squares, once more without what lies further off than three standard deviations. The distance is taken along
//! the quadric's normal below the point.
//!
//! Source: the osculating quadric of a height field; S. Petitjean, ACM Comput. Surv. 34 (2002) 211, section 3.
//!
//! # Errors
//! A patch that lies to one side of the point, or further off than it is wide, gives none: it would be extrapolated.
//! Points whose noise goes together count as fewer; see [`CORRELATED_POINTS`].

use nalgebra::{Matrix3, SMatrix, SVector};

use crate::error::{Error, Result, require_finite, require_positive};
use crate::ground::threads;
use crate::ground::transform::Vec3;

const TERMS: usize = 6;
/// Six coefficients, five times over.
const LEAST_POINTS: usize = 30;
/// Where the patch's points lie to one side of the point by more than this share of its radius, the surface ends there,
/// and the quadric would be extrapolated. A half disc is off by 0.42.
const MOST_ONE_SIDED: f64 = 0.3;
/// Points further off than this many standard deviations are left out.
const GATE: f64 = 3.0;
/// Points whose noise goes together, about: the decode of a pixel draws on the same projector column as its neighbours.
pub const CORRELATED_POINTS: f64 = 4.0;

/// A point held against the patch below it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Held {
    /// Of the point, positive on the side of the normal, mm.
    pub distance_mm: f64,
    /// Standard uncertainty of the quadric there, mm.
    pub standard_mm: f64,
    /// Of the patch, unit; to either side.
    pub normal: Vec3,
}

/// Holds points against a cloud.
///
/// `patches`: per point, the indices of the cloud's points within `radius_mm` of it. `None` where there are fewer than 30, where
/// they lie to one side, or further off than the radius.
///
/// # Errors
/// [`Error::NonFinite`], [`Error::OutOfRange`] for the radius or an index, [`Error::Shape`] unless there is a patch per point.
pub fn held_against(
    cloud: &[[f64; 3]],
    points: &[[f64; 3]],
    patches: &[&[u32]],
    radius_mm: f64,
) -> Result<Vec<Option<Held>>> {
    require_finite("points", points)?;
    require_positive("radius_mm", radius_mm)?;
    if patches.len() != points.len() {
        let (expected, got) = (format!("one per point, {}", points.len()), patches.len().to_string());
        return Err(Error::Shape { what: "patches", expected, got });
    }
    if let Some(index) = patches.iter().copied().flatten().find(|i| **i as usize >= cloud.len()) {
        let expected = format!("below the {} points of the cloud", cloud.len());
        return Err(Error::OutOfRange { what: "index", expected, value: index.to_string() });
    }
    let pairs: Vec<(&[f64; 3], &[u32])> = points.iter().zip(patches.iter().copied()).collect();
    Ok(threads::map_each(&pairs, |(point, patch)| {
        let around: Vec<Vec3> = patch.iter().map(|&i| Vec3::from(cloud[i as usize])).collect();
        held(&Vec3::from(**point), &around, radius_mm)
    }))
}

fn held(point: &Vec3, patch: &[Vec3], radius_mm: f64) -> Option<Held> {
    if patch.len() < LEAST_POINTS {
        return None;
    }
    let n = patch.len() as f64;
    let mean = patch.iter().sum::<Vec3>() / n;
    let spread = patch.iter().map(|p| (p - mean) * (p - mean).transpose()).sum::<Matrix3<f64>>();
    let eigen = spread.symmetric_eigen();
    let normal: Vec3 = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into();
    let aside: Vec3 = eigen.eigenvectors.column(eigen.eigenvalues.imax()).into();
    let along = normal.cross(&aside);
    // The point is the origin.
    let local: Vec<[f64; 3]> =
        patch.iter().map(|p| p - point).map(|d| [d.dot(&aside), d.dot(&along), d.dot(&normal)]).collect();
    let middle = mean - point;
    if middle.dot(&aside).hypot(middle.dot(&along)) > MOST_ONE_SIDED * radius_mm {
        return None;
    }
    let (quadric, variance) = quadric(&local)?;
    let [height, slope_u, slope_v] = [quadric[0], quadric[1], quadric[2]];
    if height.abs() > radius_mm {
        return None;
    }
    // It stands -height above the quadric, measured along the normal of the patch: hence the cosine of the slope.
    let distance_mm = -height / (1.0 + slope_u * slope_u + slope_v * slope_v).sqrt();
    Some(Held { distance_mm, standard_mm: (variance * CORRELATED_POINTS).sqrt(), normal })
}

/// The quadric's coefficients (1, u, v, u², uv, v²), and the variance of the first one.
fn quadric(local: &[[f64; 3]]) -> Option<(SVector<f64, TERMS>, f64)> {
    let terms = |[u, v, _]: &[f64; 3]| SVector::<f64, TERMS>::from([1.0, *u, *v, u * u, u * v, v * v]);
    let normal_of = |kept: &[bool]| {
        let mut normal = SMatrix::<f64, TERMS, TERMS>::zeros();
        let mut right = SVector::<f64, TERMS>::zeros();
        for (p, _) in local.iter().zip(kept).filter(|(_, kept)| **kept) {
            let row = terms(p);
            normal += row * row.transpose();
            right += row * p[2];
        }
        Some((normal.cholesky()?, right))
    };
    let mut kept = vec![true; local.len()];
    let mut found = None;
    for _ in 0..2 {
        let (normal, right) = normal_of(&kept)?;
        let solution = normal.solve(&right);
        let residual: Vec<f64> = local.iter().map(|p| p[2] - terms(p).dot(&solution)).collect();
        let count = kept.iter().filter(|kept| **kept).count();
        let squares: f64 = residual.iter().zip(&kept).filter(|(_, kept)| **kept).map(|(r, _)| r * r).sum();
        let sigma = (squares / (count - TERMS) as f64).sqrt();
        kept = residual.iter().map(|r| r.abs() <= GATE * sigma.max(1e-9)).collect();
        if kept.iter().filter(|kept| **kept).count() < LEAST_POINTS {
            return None;
        }
        found = Some((solution, sigma));
    }
    let (solution, sigma) = found?;
    let (normal, _) = normal_of(&kept)?;
    Some((solution, sigma * sigma * normal.inverse()[(0, 0)]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ground::random::{mix, normals};

    const RADIUS_MM: f64 = 1.5;
    const NOISE_MM: f64 = 0.01;

    /// A patch of a pipe of 60 mm about (0, 0, 60), seen from below, with noise; and a point that stands off it.
    fn patch(from_mm: f64) -> Vec<[f64; 3]> {
        let mut points = Vec::new();
        for (k, (i, j)) in (-20..=20).flat_map(|i| (-20..=20).map(move |j| (i, j))).enumerate() {
            let (x, y) = (f64::from(i) * 0.08, f64::from(j) * 0.08);
            let noise = NOISE_MM * f64::from(normals().draw(mix(k as u64)));
            if x.hypot(y) < RADIUS_MM && x >= from_mm {
                points.push([x, y, 60.0 - (60.0_f64.powi(2) - y * y).sqrt() + noise]);
            }
        }
        points
    }

    fn against(cloud: &[[f64; 3]], z: f64) -> Option<Held> {
        let all: Vec<u32> = (0..cloud.len() as u32).collect();
        held_against(cloud, &[[0.0, 0.0, z]], &[&all], RADIUS_MM).unwrap()[0]
    }

    #[test]
    fn a_point_stands_off_a_pipe_by_what_it_does() {
        for off in [0.0, 0.3, -0.2] {
            let found = against(&patch(-9.0), off).unwrap();
            let signed = found.distance_mm * found.normal.z.signum();
            assert!((signed - off).abs() < 4.0 * found.standard_mm, "{found:?}");
            assert!(found.standard_mm > NOISE_MM / 30.0 && found.standard_mm < NOISE_MM);
            assert!(found.normal.z.abs() > 0.999);
        }
    }

    #[test]
    fn a_stray_point_does_not_pull() {
        let mut cloud = patch(-9.0);
        let clean = against(&cloud, 0.0).unwrap().distance_mm.abs();
        cloud.push([0.1, 0.1, 0.5]);
        assert!((against(&cloud, 0.0).unwrap().distance_mm.abs() - clean).abs() < NOISE_MM / 20.0);
    }

    #[test]
    fn an_edge_a_gap_and_a_far_surface_give_no_distance() {
        assert!(against(&patch(0.0), 0.0).is_none());
        assert!(against(&patch(-9.0)[..29], 0.0).is_none());
        assert!(against(&patch(-9.0), 2.0).is_none());
        assert!(held_against(&[], &[[0.0; 3]], &[&[0]], 1.0).is_err());
        assert!(held_against(&[], &[[0.0; 3]], &[], 1.0).is_err());
        assert!(held_against(&[], &[[f64::NAN; 3]], &[&[]], 1.0).is_err());
    }
}
