//! The paper's model: heights over a reference plane, by similar triangles or by a calibration of every pixel.

use rayon::prelude::*;

use crate::error::{Error, Result, require_count, require_positive};
use crate::ground::memory::require;
use crate::ground::threads::{self, CHUNK};

/// The paper's geometry (Fig. 1): camera and projector at the same distance from a reference plane that is parallel to
/// the line between them, and fringes of constant pitch on that plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReferenceGeometry {
    /// From the camera to the projector, mm; positive where the phase grows in that direction.
    pub baseline_mm: f64,
    /// Both devices' distance from the plane, mm.
    pub distance_mm: f64,
    /// Pitch of the fringes on the plane, mm.
    pub period_mm: f64,
}

/// 1/height = a + b/dphi, per pixel, with dphi = reference phase - phase (the paper's Eq. 1).
#[derive(Debug, Clone)]
pub struct ReferencePlane {
    /// 1/mm. In the paper's geometry 1/distance.
    pub a: Vec<f64>,
    /// rad/mm. In the paper's geometry 2π baseline/(distance period).
    pub b: Vec<f64>,
    /// Root mean square error of the calibration heights, mm.
    pub rms_mm: Vec<f32>,
}

fn same_size(what: &'static str, expected: usize, got: usize) -> Result<()> {
    if expected == got {
        Ok(())
    } else {
        Err(Error::Shape { what, expected: format!("{expected} pixels"), got: got.to_string() })
    }
}

/// Height over the reference plane, towards the scanner, mm: dphi = phi_A - phi_C (the paper's Eq. 1) is the distance
/// CA = dphi period/2π on the plane, and the similar triangles PID ~ CAD (Fig. 1) give
/// height = distance CA/(baseline + CA).
///
/// # Errors
/// [`Error::Shape`] for phases of different sizes, [`Error::OutOfRange`] for a geometry that is none.
pub fn height_from_reference(phase: &[f64], reference: &[f64], geometry: &ReferenceGeometry) -> Result<Vec<f64>> {
    same_size("reference_phase", phase.len(), reference.len())?;
    require_positive("distance_mm", geometry.distance_mm)?;
    require_positive("period_mm", geometry.period_mm)?;
    require_positive("baseline_mm (its size)", geometry.baseline_mm.abs())?;
    let height = |(phase, reference): (&f64, &f64)| {
        let along = (reference - phase) * geometry.period_mm / std::f64::consts::TAU;
        geometry.distance_mm * along / (geometry.baseline_mm + along)
    };
    require(phase.len(), 8);
    Ok(phase.iter().zip(reference).map(height).collect())
}

/// Height over the reference plane by a calibration of every pixel, mm: 1/(a + b/dphi); zero where dphi is zero.
///
/// # Errors
/// [`Error::Shape`] for arrays of different sizes.
pub fn height_from_calibration(phase: &[f64], reference: &[f64], plane: &ReferencePlane) -> Result<Vec<f64>> {
    same_size("reference_phase", phase.len(), reference.len())?;
    same_size("calibration", phase.len(), plane.a.len().min(plane.b.len()))?;
    let coefficients = plane.a.iter().zip(&plane.b);
    let height = |((phase, reference), (a, b)): ((&f64, &f64), (&f64, &f64))| {
        let along = reference - phase;
        along / (a * along + b)
    };
    require(phase.len(), 8);
    Ok(phase.iter().zip(reference).zip(coefficients).map(height).collect())
}

/// Fits 1/height = a + b/dphi to planes at known heights over the reference, in every pixel. Minimised is the error in
/// height (to first order): the sum of (height² (a + b/dphi) - height)². Two planes determine a pixel; planes that are
/// NaN there are left out, and with fewer than two it stays NaN.
///
/// # Errors
/// [`Error::TooFew`] below two planes, [`Error::Shape`] for arrays of different sizes, [`Error::OutOfRange`] for a height
/// that is zero or not finite, [`Error::Degenerate`] where all heights are equal.
pub fn calibrate_reference_plane(reference: &[f64], phases: &[&[f64]], heights_mm: &[f64]) -> Result<ReferencePlane> {
    require_count("planes", 2, phases.len())?;
    same_size("heights_mm", phases.len(), heights_mm.len())?;
    for phase in phases {
        same_size("phases", reference.len(), phase.len())?;
    }
    if let Some(h) = heights_mm.iter().find(|h| !h.is_finite() || **h == 0.0) {
        let expected = "finite and not 0 (the reference itself is height 0)".into();
        return Err(Error::OutOfRange { what: "heights_mm", expected, value: h.to_string() });
    }
    if heights_mm.iter().all(|h| Some(h) == heights_mm.first()) {
        let reason = "all planes are at one height: two unknowns need two heights".into();
        return Err(Error::Degenerate { what: "calibrate_reference_plane", reason });
    }
    let fit = |i: usize| -> (f64, f64, f32) {
        let rows = || {
            phases.iter().zip(heights_mm).filter_map(move |(phase, &h)| {
                let along = reference.get(i)? - phase.get(i)?;
                (along.is_finite() && along != 0.0).then_some((h * h, h * h / along, h))
            })
        };
        // Two columns, made orthogonal: no squares of a bad condition.
        let dot = |f: &dyn Fn((f64, f64, f64)) -> f64| rows().map(f).sum::<f64>();
        let (pp, pq) = (dot(&|(p, _, _)| p * p), dot(&|(p, q, _)| p * q));
        let share = pq / pp;
        let rest = |p: f64, q: f64| q - share * p;
        let qq = dot(&|(p, q, _)| rest(p, q) * rest(p, q));
        let b = dot(&|(p, q, h)| rest(p, q) * h) / qq;
        let a = dot(&|(p, q, h)| p * (h - b * q)) / pp;
        let n = rows().count();
        if n < 2 || !(a.is_finite() && b.is_finite()) {
            return (f64::NAN, f64::NAN, f32::NAN);
        }
        let square = dot(&|(p, q, h)| (p * a + q * b - h).powi(2));
        (a, b, (square / n as f64).sqrt() as f32)
    };
    require(reference.len(), 72);
    let fits: Vec<_> = threads::install(|| (0..reference.len()).into_par_iter().with_min_len(CHUNK).map(fit).collect());
    let mut plane = ReferencePlane { a: Vec::new(), b: Vec::new(), rms_mm: Vec::new() };
    for (a, b, rms) in fits {
        plane.a.push(a);
        plane.b.push(b);
        plane.rms_mm.push(rms);
    }
    Ok(plane)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The paper's Fig. 1 by intersecting lines: where the projector's ray to D meets the plane, and the camera's.
    fn seen(x: f64, height: f64, g: &ReferenceGeometry) -> (f64, f64) {
        let scale = g.distance_mm / (g.distance_mm - height);
        let (a, c) = (x * scale, g.baseline_mm + (x - g.baseline_mm) * scale);
        let phase = |x: f64| std::f64::consts::TAU * x / g.period_mm;
        (phase(a), phase(c))
    }

    #[test]
    fn similar_triangles_and_their_calibration_give_the_height() {
        for baseline_mm in [150.0, -150.0] {
            let geometry = ReferenceGeometry { baseline_mm, distance_mm: 500.0, period_mm: 4.0 };
            let heights = [-40.0, -3.0, 0.4, 12.0, 90.0];
            let (reference, phase): (Vec<f64>, Vec<f64>) =
                heights.iter().enumerate().map(|(i, h)| seen(30.0 * i as f64 - 50.0, *h, &geometry)).unzip();
            let found = height_from_reference(&phase, &reference, &geometry).unwrap();
            assert!(found.iter().zip(heights).all(|(f, h)| (f - h).abs() < 1e-9), "{found:?}");

            // One pixel, three planes: x on the plane is 20 whatever the height.
            let look = |h: f64| seen(20.0 * (1.0 - h / 500.0), h, &geometry);
            let planes: Vec<[f64; 1]> = [10.0, 25.0, 60.0].iter().map(|h| [look(*h).1]).collect();
            let planes: Vec<&[f64]> = planes.iter().map(|p| p.as_slice()).collect();
            let plane = calibrate_reference_plane(&[look(0.0).0], &planes, &[10.0, 25.0, 60.0]).unwrap();
            assert!((plane.a[0] - 1.0 / 500.0).abs() < 1e-12 && plane.rms_mm[0] < 1e-9);
            let h = height_from_calibration(&[look(33.0).1], &[look(33.0).0], &plane).unwrap();
            assert!((h[0] - 33.0).abs() < 1e-9);
        }
    }

    #[test]
    fn bad_calibrations_are_refused() {
        let p: &[f64] = &[1.0];
        assert!(calibrate_reference_plane(&[0.0], &[p], &[1.0]).is_err());
        assert!(calibrate_reference_plane(&[0.0], &[p, p], &[1.0, 1.0]).is_err());
        assert!(calibrate_reference_plane(&[0.0], &[p, p], &[1.0, 0.0]).is_err());
        assert!(calibrate_reference_plane(&[0.0], &[p, &[]], &[1.0, 2.0]).is_err());
        assert!(calibrate_reference_plane(&[f64::NAN], &[p, p], &[1.0, 2.0]).unwrap().a[0].is_nan());
        let g = ReferenceGeometry { baseline_mm: 0.0, distance_mm: 1.0, period_mm: 1.0 };
        assert!(height_from_reference(p, p, &g).is_err());
    }
}
