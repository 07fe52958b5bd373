//! The pieces against sums and formulas plainer than they are; whole images are checked from Python with OpenCV.

use proptest::prelude::*;

use super::*;

fn wall(radius_mm: f64, offset_mm: [f64; 2]) -> Wall {
    Wall { radius_mm, offset_mm, tilt_rad: [0.0; 2], ovality_mm: 0.0, ovality_at_rad: 0.0, waviness_mm: 0.0 }
}

const BEAD: Bead = Bead { width_mm: 11.0, height_mm: 1.8, ripple_mm: 0.15, pitch_mm: 3.6, wander_mm: 0.25 };

fn example() -> Weld {
    let reference = Wall { ovality_mm: 0.2, waviness_mm: 0.01, ..wall(315.0, [0.0; 2]) };
    let other = Wall { tilt_rad: [0.002, -0.001], waviness_mm: 0.01, ..wall(315.3, [0.4, -0.2]) };
    Weld::new(reference, other, BEAD, 300.0).unwrap()
}

#[test]
fn a_cosine_series_is_its_sum() {
    let a: Vec<f32> = (0..9).map(|i| 1.0 / (1.0 + i as f32)).collect();
    for i in 0..50 {
        let angle = 0.13 * i as f32;
        let sum: f32 = a.iter().enumerate().map(|(p, a)| a * (p as f32 * angle).cos()).sum();
        // f32 rounding, grown by the recurrence.
        assert!((cosine_series(&a, angle.cos()) - sum).abs() < 2e-5);
        let two = a[0] + a[1] * angle.cos();
        assert!((cosine_series(&a[..2], angle.cos()) - two).abs() < 1e-6);
    }
}

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

#[test]
fn the_step_at_the_seam_follows_from_the_sine_rule() {
    let (r, offset) = (315.0, [0.4, -0.2]);
    let weld = Weld::new(wall(r, [0.0; 2]), wall(r + 0.3, offset), BEAD, 300.0).unwrap();
    for i in 0..72 {
        let angle = TAU * f64::from(i) / 72.0;
        let along = offset[0] * angle.cos() + offset[1] * angle.sin();
        let across = offset[0] * angle.sin() - offset[1] * angle.cos();
        let radius = along + ((r + 0.3f64).powi(2) - across * across).sqrt();
        assert!((weld.step_at_seam(angle) - (radius - r)).abs() < 1e-10);
    }
}

#[test]
fn a_weld_of_a_pipe_to_a_plate_and_a_moved_reference_wall_are_refused() {
    assert!(matches!(
        Weld::new(wall(f64::INFINITY, [0.0; 2]), wall(100.0, [0.0; 2]), BEAD, 300.0),
        Err(Error::OutOfRange { .. })
    ));
    assert!(Weld::new(wall(100.0, [0.1, 0.0]), wall(100.0, [0.0; 2]), BEAD, 300.0).is_err());
    for bad in [f64::NAN, -1.0, 0.0] {
        assert!(Weld::new(wall(bad, [0.0; 2]), wall(bad, [0.0; 2]), BEAD, 300.0).is_err());
        assert!(Weld::new(wall(100.0, [0.0; 2]), wall(100.0, [0.0; 2]), BEAD, bad).is_err());
    }
}

/// The first sign change of the weld's solid along a ray, by steps of 0.02 mm: slow, and blind to nothing larger.
fn march(weld: &Weld, ray: &Ray, length_mm: f64) -> Option<f64> {
    let speed = ray.direction.norm();
    let steps = (length_mm / 0.02) as usize;
    (0..steps).map(|i| i as f64 * 0.02 / speed).find(|&t| weld.inside(&ray.at(t)))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]
    #[test]
    fn the_first_hit_on_a_weld_is_where_a_march_enters_it(
        angle in 0.0..TAU, z in -12.0..12.0f64, lean in -0.9..0.9f64, turn in -0.9..0.9f64,
    ) {
        let weld = example();
        let outward = Vec3::new(angle.cos(), angle.sin(), 0.0);
        let around = Vec3::new(-angle.sin(), angle.cos(), 0.0);
        let target = outward * 315.5 + Vec3::z() * z;
        let origin = target + (outward + around * turn + Vec3::z() * lean) * 20.0;
        let ray = Ray { origin, direction: (target - origin) * 0.7 };
        let found = weld.hit(&ray, 0.0).map(|h| h.t);
        let marched = march(&weld, &ray, 80.0);
        match (found, marched) {
            (None, None) => {}
            (Some(t), Some(m)) => {
                // A step of the march, plus where it slips into the 10 micron gap that waviness leaves at a toe.
                let apart = (t - m) * ray.direction.norm();
                prop_assert!(apart.abs() < 0.1, "{t} {m} {apart}");
            }
            _ => prop_assert!(false, "{found:?} {marched:?}"),
        }
    }

    #[test]
    fn entry_is_the_smaller_root(first in -100.0..100.0f64, gap in 0.0..100.0f64, a in 0.1..10.0f64) {
        // a (t - first)(t - second) = a t² + 2 b t + c
        let second = first + gap;
        let (b, c) = (-0.5 * a * (first + second), a * first * second);
        if let Some(t) = shapes::entry(a, b, c) {
            prop_assert!((t - first).abs() < 1e-5 * (1.0 + gap));
        } else {
            prop_assert!(gap < 1e-4);
        }
    }
}

#[test]
fn the_light_of_a_pattern_is_its_blurred_power() {
    let scanner = crate::scanner::tests::example();
    let samples = [];
    for (gamma, blur_px, periods) in [(1.0, 0.6, 64.0), (1.35, 0.5, 100.0), (2.2, 0.0, 8.0), (0.7, 1.0, 200.0)] {
        let photometry = Photometry {
            lamp: 1.0,
            distance_mm: 420.0,
            ambient: 0.0,
            black: 0.0,
            gamma,
            blur_px,
            full_well_e: 1e4,
            read_noise_e: 10.0,
            bits: 8,
            seed: 0,
        };
        let set = FringeSet { axis: Axis::X, periods, steps: 4, direction: 1.0, origin_rad: 0.0 };
        let shader = Shader {
            scanner: &scanner,
            fringes: &[set],
            exposures: &[1.0],
            photometry: &photometry,
            samples: &samples,
            edges: &[],
        };
        let light = shader.light(&set);
        let pattern = |u: f64| (0.5 + 0.5 * (TAU * periods * u / 912.0).cos()).powf(gamma);
        for i in 0..40 {
            let u = 0.37 * f64::from(i);
            // The mean over one pixel and a Gaussian cut at six sigma, by midpoints.
            let (mut sum, mut weight) = (0.0, 0.0);
            for a in 0..60 {
                let du = (f64::from(a) + 0.5) / 60.0 - 0.5;
                for b in -60..=60 {
                    let sigmas = f64::from(b) / 10.0;
                    let w = (-0.5 * sigmas * sigmas).exp();
                    sum += w * pattern(u + du + sigmas * blur_px);
                    weight += w;
                }
            }
            let x = (TAU * periods * u / 912.0).cos() as f32;
            let miss = f64::from(cosine_series(&light, x)) - sum / weight;
            // Harmonics beyond the last one kept, and f32.
            assert!(miss.abs() < 1e-4, "gamma {gamma}: {miss}");
        }
    }
}
