//! Tests that concern the fits of all surfaces.

use nalgebra::{SMatrix, SVector};
use proptest::prelude::*;

use super::least_squares::{Local, NormalEquations, PointNoise, SurfaceModel};
use super::sphere::{Sphere, SphereUnknowns};
use super::{cylinder, find_spheres, plane, robust, sphere};
use crate::ground::transform::Vec3;

/// A cap of a sphere, with a wave of the given size on it.
pub(super) fn cap(n: usize, center: [f64; 3], radius: f64, half_angle: f64, wave: f64) -> Vec<[f64; 3]> {
    let golden = std::f64::consts::PI * (3.0 - 5.0_f64.sqrt());
    let point = |i: usize| {
        let z = 1.0 - (1.0 - half_angle.cos()) * (i as f64 + 0.5) / n as f64;
        let (s, a) = ((1.0 - z * z).sqrt(), golden * i as f64);
        let r = radius + wave * (2.7 * i as f64).sin();
        [center[0] + r * s * a.cos(), center[1] + r * s * a.sin(), center[2] + r * z]
    };
    (0..n).map(point).collect()
}

/// Sum of squared distances, plainly.
fn cost(points: &[[f64; 3]], sphere: &Sphere) -> f64 {
    points.iter().map(|p| sphere.distance(p).powi(2)).sum()
}

proptest! {
    #[test]
    fn no_sphere_nearby_has_a_lower_cost(
        n in 4_usize..3000, half_angle in 0.3_f64..3.0, log_radius in -3.0_f64..4.0, far in -1e3_f64..1e3,
        known in any::<bool>(), step in prop::array::uniform4(-1.0_f64..1.0),
    ) {
        let radius = 10_f64.powf(log_radius);
        let center = [far * radius, radius, -radius];
        let points = cap(n, center, radius, half_angle, 1e-4 * radius);
        let fit = sphere::fit(&points, known.then_some(radius), PointNoise::default()).unwrap();
        let least = cost(&points, &fit.surface);
        prop_assert!((fit.rms_mm - (least / n as f64).sqrt()).abs() < 1e-9 * radius);
        let mut other = fit.surface;
        other.center_mm += Vec3::new(step[0], step[1], step[2]) * (1e-4 * radius);
        other.radius_mm += if known { 0.0 } else { 1e-4 * radius * step[3] };
        // The plain sum is rounded at the size of the coordinates.
        let rounding = 1e-15 * (1.0 + far.abs()) * radius * 1e-4 * radius * n as f64;
        prop_assert!(cost(&points, &other) >= least - rounding);
    }

    #[test]
    fn lanes_give_what_a_plain_loop_gives(n in 0_usize..40, x in -2.0_f64..2.0, r in 0.1_f64..3.0) {
        let local = Local::new(Vec3::zeros(), 1.0);
        let points = cap(n, [x, 0.3, -0.2], r, 2.0, 0.1);
        let weights: Vec<f64> = (0..n).map(|i| 0.5 + (i % 3) as f64).collect();
        let noise = PointNoise { weights: Some(&weights), sigma_mm: None };
        let model = SphereUnknowns { center: [0.1, 0.2, 0.3], radius: 1.2 };
        let sums: NormalEquations<4> = NormalEquations::of(&model, &points, local, &noise);
        let mut matrix = SMatrix::<f64, 4, 4>::zeros();
        let (mut gradient, mut cost) = (SVector::<f64, 4>::zeros(), 0.0);
        for (p, w) in points.iter().zip(&weights) {
            let (j, d): ([f64; 4], f64) = SurfaceModel::<4>::row(&model, p);
            let j = SVector::from(j);
            matrix += j * j.transpose() * *w;
            gradient += j * (*w * d);
            cost += w * d * d;
        }
        let size = 1e-13 * (1.0 + n as f64) * 10.0;
        prop_assert!((sums.matrix - matrix).amax() < size && (sums.gradient - gradient).amax() < size);
        prop_assert!((sums.cost - cost).abs() < size);
        // The triangle is a root of the same matrix.
        if let Some((root, right)) = sums.root {
            prop_assert!((root.transpose() * root - matrix).amax() < size);
            prop_assert!((root.transpose() * right + gradient).amax() < size);
        }
    }

    #[test]
    fn nothing_panics(
        points in prop::collection::vec(prop::array::uniform3(any::<f64>()), 0..9), r in any::<f64>(),
    ) {
        let _ = plane::fit(&points, PointNoise::default());
        for radius in [None, Some(r)] {
            let _ = sphere::fit(&points, radius, PointNoise::default());
            let _ = cylinder::fit(&points, radius, PointNoise::default());
            let _ = robust::sphere(&points, radius, None, 0);
            let _ = robust::cylinder(&points, radius, None, 0);
        }
        let _ = robust::plane(&points, Some(r), 1);
        let _ = sphere::through_points(&points);
        for width in [None, Some(2)] {
            let _ = find_spheres::find(&points, width, r, None);
        }
    }
}

#[test]
fn a_tilted_arc_is_fitted_without_a_hint() {
    let axis = Vec3::new(0.3, -0.5, 0.8).normalize();
    let frame = plane::complete(&Vec3::x(), &axis);
    let points: Vec<[f64; 3]> = (0..5000)
        .map(|i| {
            let (t, z) = (1.2 * (f64::from(i) * 0.618).fract(), 80.0 * (f64::from(i) * 0.414).fract());
            let p = frame.transpose() * Vec3::new(315.0 * t.cos(), 315.0 * t.sin(), z);
            (p + Vec3::new(900.0, -20.0, 400.0)).into()
        })
        .collect();
    for radius in [None, Some(315.0)] {
        let fit = cylinder::fit(&points, radius, PointNoise::default()).unwrap();
        // Exact points: what is left is the rounding of coordinates of 1000 mm over the arc's sagitta.
        assert!(fit.surface.axis.cross(&axis).norm() < 1e-12);
        assert!((fit.surface.radius_mm - 315.0).abs() < 1e-9 && fit.rms_mm < 1e-11);
        let (robust, inliers) = robust::cylinder(&points, radius, Some(0.01), 0).unwrap();
        assert!(inliers.len() == points.len() && robust.surface.axis.cross(&axis).norm() < 1e-12);
    }
}
