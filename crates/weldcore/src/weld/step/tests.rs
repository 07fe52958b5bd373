//! The step of welds whose closed form is known.

use super::*;
use crate::ground::threads;
use crate::weld::label::Label;
use crate::weld::seam::Course;
use crate::weld::segment::tests::{COLUMNS, EXAMPLE, Example, MIDDLE_RAD, normal_random};
use crate::weld::segment::{Segmentation, segment};

/// Three sigma of 0.04 mm of noise over 110,000 points, extrapolated to the end of a short arc in the model with all
/// its terms.
const STEP_TOLERANCE_MM: f64 = 0.006;

fn shot(s: &Segmentation) -> LabelledShot<'_> {
    LabelledShot {
        unrolled: &s.unrolled,
        labels: &s.labels,
        seam: s.seam,
        thickness_mm: s.thickness_mm,
        modes: None,
        base_from_scanner: None,
    }
}

fn measured(examples: &[Example]) -> (Vec<Segmentation>, Step) {
    let segmented: Vec<Segmentation> =
        examples.iter().map(|e| segment(&e.points(), COLUMNS, &e.nominal()).unwrap()).collect();
    let shots: Vec<LabelledShot> = segmented.iter().map(shot).collect();
    let step = measure(&shots, &Known::default()).unwrap();
    (segmented, step)
}

fn largest_error(step: &Step, e: &Example) -> f64 {
    let error = |b: &ProfileBin| (b.step_mm - e.step_mm(b.along.to_radians(), 0.0)).abs();
    step.profile.iter().map(error).fold(0.0, f64::max)
}

#[test]
fn the_step_is_that_of_the_closed_form() {
    for e in [
        EXAMPLE,
        Example { offset_mm: [-0.3, -0.9], seed: 2, ..EXAMPLE },
        Example { tilt: [0.002, -0.001], radius_difference_mm: 0.4, seed: 3, ..EXAMPLE },
        Example { radius_mm: 54.0, half_arc_rad: 0.8, offset_mm: [1.0, -0.7], bead_width_mm: 6.0, ..EXAMPLE },
        Example { radius_mm: 610.0, half_arc_rad: 0.12, bead_width_mm: 20.0, ..EXAMPLE },
    ] {
        let (_, step) = measured(&[e]);
        assert!(largest_error(&step, &e) < STEP_TOLERANCE_MM, "R {}: {} mm", e.radius_mm, largest_error(&step, &e));
        for bin in &step.profile {
            let error = bin.step_mm - e.step_mm(bin.along.to_radians(), 0.0);
            assert!(error.abs() < 4.0 * bin.standard_mm, "{error} mm at {}", bin.along);
        }
        let arc_deg = 2.0 * e.half_arc_rad.to_degrees();
        assert!((step.coverage - arc_deg).abs() <= 2.0 * e.frame().course.bin_width(), "{} deg", step.coverage);
    }
}

#[test]
fn the_sign_follows_the_wall_that_stands_out() {
    let out = Example { offset_mm: [0.5 * MIDDLE_RAD.cos(), 0.5 * MIDDLE_RAD.sin()], ..EXAMPLE };
    let inward = Example { offset_mm: out.offset_mm.map(|v| -v), ..EXAMPLE };
    assert!((measured(&[out]).1.mean_mm - 0.495).abs() < 0.01);
    assert!((measured(&[inward]).1.mean_mm + 0.495).abs() < 0.01);
}

#[test]
fn a_dent_beside_the_seam_is_not_smoothed_away() {
    let e = EXAMPLE;
    let mut s = segment(&e.points(), COLUMNS, &e.nominal()).unwrap();
    // Six degrees of the other wall stand 0.5 mm higher.
    for i in 0..s.labels.len() {
        let turn = f64::from(s.unrolled.at[i]) - MIDDLE_RAD;
        if s.unrolled.across_mm[i] > 0.0 && (0.05..0.155).contains(&turn) {
            s.unrolled.height_mm[i] += 0.5;
        }
    }
    let step = measure(&[shot(&s)], &Known::default()).unwrap();
    let true_at = |b: &ProfileBin| {
        let turn = Course::of_radius(e.radius_mm).unwrap().apart(b.along.to_radians(), MIDDLE_RAD);
        e.step_mm(b.along.to_radians(), 0.0) + if (0.05..0.155).contains(&turn) { 0.5 } else { 0.0 }
    };
    let top = step.profile.iter().map(|b| true_at(b).abs()).fold(0.0, f64::max);
    let (most, u) = step.max_abs_mm();
    assert!((most - top).abs() < u.max(0.02), "{most} ± {u} of {top} mm");
}

#[test]
fn the_interval_covers_the_error_of_correlated_walls() {
    // Waves of 0.01 mm over 8 mm on each wall, drawn anew 40 times; the true step is that of the waves' walls at the seam.
    let (mut inside, mut total, mut square) = (0, 0, 0.0);
    for seed in 0..40_u64 {
        let e = Example { noise_mm: 0.02, seed: seed + 10, ..EXAMPLE };
        let mut s = segment(&e.points(), COLUMNS, &e.nominal()).unwrap();
        let mut state = seed + 1;
        let mut waves = || -> Vec<[f64; 3]> {
            (0..60)
                .map(|_| {
                    let k = std::array::from_fn::<f64, 2, _>(|_| normal_random(&mut state) / 8.0);
                    [k[0], k[1], std::f64::consts::TAU * normal_random(&mut state)]
                })
                .collect()
        };
        let walls = [waves(), waves()];
        let height = |other: bool, x: f64, z: f64| -> f64 {
            let sum: f64 = walls[usize::from(other)].iter().map(|w| (w[0] * x + w[1] * z + w[2]).cos()).sum();
            0.01 * sum * (2.0 / 60.0_f64).sqrt()
        };
        for i in 0..s.labels.len() {
            let (x, z) = (f64::from(s.unrolled.at[i]) * e.radius_mm, f64::from(s.unrolled.across_mm[i]));
            s.unrolled.height_mm[i] += height(z > 0.0, x, z) as f32;
        }
        let step = measure(&[shot(&s)], &Known::default()).unwrap();
        for bin in step.profile.iter().step_by(3) {
            let at = bin.along.to_radians();
            let turned = Course::of_radius(e.radius_mm).unwrap().apart(at, 0.0) * e.radius_mm;
            let truth = e.step_mm(at, 0.0) + height(true, turned, 0.0) - height(false, turned, 0.0);
            let error = (bin.step_mm - truth) / bin.standard_mm;
            inside += usize::from(error.abs() <= 2.0);
            square += error * error;
            total += 1;
        }
    }
    let (share, sd) = (inside as f64 / f64::from(total), (square / f64::from(total)).sqrt());
    assert!(share > 0.92 && (0.8..1.15).contains(&sd), "{share} of the errors lie in their intervals, sd {sd}");
}

#[test]
fn shots_join_in_one_profile_and_each_keeps_its_reference() {
    let (_, alone) = measured(&[EXAMPLE]);
    let (_, twice) = measured(&[EXAMPLE, Example { seed: 7, ..EXAMPLE }]);
    assert_eq!(alone.profile.len(), twice.profile.len());
    assert!(largest_error(&twice, &EXAMPLE) < STEP_TOLERANCE_MM);
    assert_eq!(twice.surfaces.len(), 2);
}

#[test]
fn the_same_bits_on_any_number_of_threads() {
    let mut seen = Vec::new();
    for n in [1, 2, 8] {
        threads::set_threads(Some(n)).unwrap();
        let (_, step) = measured(&[EXAMPLE]);
        seen.push((
            step.mean_mm.to_bits(),
            step.largest,
            step.profile.iter().map(|b| b.step_mm.to_bits()).collect::<Vec<u64>>(),
        ));
    }
    threads::set_threads(None).unwrap();
    assert!(seen.windows(2).all(|w| w[0] == w[1]));
}

#[test]
fn one_wall_or_none_is_refused() {
    let e = EXAMPLE;
    let mut s = segment(&e.points(), COLUMNS, &e.nominal()).unwrap();
    assert!(matches!(measure(&[], &Known::default()), Err(Error::TooFew { .. })));
    s.labels.iter_mut().filter(|l| **l == Label::OtherWall as u8).for_each(|l| *l = 0);
    assert!(matches!(measure(&[shot(&s)], &Known::default()), Err(Error::TooFew { .. })));
}
