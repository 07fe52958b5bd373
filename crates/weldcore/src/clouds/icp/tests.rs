//! Registrations whose answer is known.

use nalgebra::{Matrix6, Rotation3};

use super::equations::*;
use super::pairs::*;
use super::registration::with;
use super::*;
use crate::clouds::kdtree::{Followed, KdTree};
use crate::ground::threads;
use crate::ground::transform::{Transform, Vec3};
use crate::surfaces::{Cylinder, Plane, Sphere, Surface};

const RADIUS: f64 = 110.0;

fn pose(turn: [f64; 3], shift: [f64; 3]) -> Transform {
    Transform { rotation: *Rotation3::new(Vec3::from(turn)).matrix(), translation: shift.into() }
}

fn moved(points: &[[f64; 3]], t: &Transform) -> Vec<[f64; 3]> {
    points.iter().map(|&p| t.apply(&p.into()).into()).collect()
}

/// A quarter of a pipe along z.
fn pipe(n: u32) -> Vec<[f64; 3]> {
    let side = 0..n;
    side.clone()
        .flat_map(|i| {
            side.clone().map(move |j| {
                let angle = f64::from(i) / f64::from(n) * 1.6;
                [RADIUS * angle.cos(), RADIUS * angle.sin(), f64::from(j) / f64::from(n) * 200.0]
            })
        })
        .collect()
}

/// A surface without a symmetry, with its normals.
fn relief(n: u32) -> (Vec<[f64; 3]>, Vec<[f64; 3]>) {
    let mut points = Vec::new();
    let mut normals = Vec::new();
    for i in 0..n {
        for j in 0..n {
            let (x, y) = (f64::from(i) * 60.0 / f64::from(n), f64::from(j) * 60.0 / f64::from(n));
            points.push([x, y, 6.0 * (x / 9.0).sin() + 5.0 * (y / 7.0).cos()]);
            let slope = Vec3::new(-6.0 / 9.0 * (x / 9.0).cos(), 5.0 / 7.0 * (y / 7.0).sin(), 1.0);
            normals.push(slope.normalize().into());
        }
    }
    (points, normals)
}

#[test]
fn on_a_cylinder_the_two_free_directions_are_named_and_do_not_drift() {
    let surface = Target::Surface(Surface::Cylinder(Cylinder::new([0.0; 3], [0.0, 0.0, 2.0], RADIUS).unwrap()));
    let start = pose([0.05, -0.07, 0.0], [3.0, -4.0, 0.0]);
    let source = moved(&pipe(60), &start.inverse());
    let options = Options { metric: Metric::Plane, ..Options::default() };
    let found = register(&source, &surface, &options).unwrap();
    assert!(found.converged && found.iterations < 12 && found.rms_mm < 1e-9, "{found:?}");
    assert_eq!(found.inliers.len(), source.len());
    let kinds: Vec<WeakKind> = found.unobserved.iter().map(|w| w.kind).collect();
    assert_eq!(kinds, [WeakKind::Translation, WeakKind::Rotation]);
    assert!(found.unobserved.iter().all(|w| (w.axis.z.abs() - 1.0).abs() < 1e-9 && w.strength < 1e-9));
    assert!(found.unobserved[1].point_mm.unwrap().xy().norm() < 1e-6);
    // Along the axis nothing moves but by products of the 5 degrees and 5 mm; about it only by what goes with
    // undoing the 5 mm in the shortest way, at a distance of some 100 mm.
    let centroid = source.iter().map(|p| Vec3::from(*p)).sum::<Vec3>() / source.len() as f64;
    assert!((found.target_from_source.apply(&centroid) - centroid).z.abs() < 0.5);
    let turn = Rotation3::from_matrix_unchecked(found.target_from_source.rotation).scaled_axis();
    assert!(turn.z.abs() < 0.05 && turn.xy().norm() > 0.08, "{turn}");
    // A hundred rounds more change nothing.
    let again = Options { start: found.target_from_source, tolerance_mm: 0.0, ..options };
    let again = register(&source, &surface, &again).unwrap();
    assert!((again.target_from_source.translation - found.target_from_source.translation).amax() < 1e-9);
    assert!((again.target_from_source.rotation - found.target_from_source.rotation).amax() < 1e-11);
}

#[test]
fn both_metrics_bring_a_cloud_back_onto_itself() {
    let (target, normals) = relief(120);
    let tree = KdTree::new(&target).unwrap();
    let truth = pose([0.01, -0.02, 0.015], [0.4, -0.3, 0.2]);
    let source = moved(&target, &truth.inverse());
    for metric in [Metric::Point, Metric::Plane] {
        let options = Options { metric, ..Options::default() };
        let found = register(&source, &Target::Cloud(&tree, Some(&normals)), &options).unwrap();
        assert!(found.converged, "{} rounds", found.iterations);
        assert!((found.target_from_source.rotation - truth.rotation).amax() < 1e-9);
        assert!((found.target_from_source.translation - truth.translation).amax() < 1e-7);
        assert!((found.target_from_source.rotation.determinant() - 1.0).abs() < 1e-14);
        assert!(found.unobserved.is_empty() && found.rms_mm < 1e-7);
    }
}

#[test]
fn the_covariance_is_the_scatter_of_repeated_registrations() {
    let (target, normals) = relief(40);
    let tree = KdTree::new(&target).unwrap();
    let sigma = 0.001;
    let mut state = 1u64;
    let mut noise = || {
        let uniform = |s: &mut u64| {
            *s = s.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (*s >> 11) as f64 / (1u64 << 53) as f64 - 0.5
        };
        (0..12).map(|_| uniform(&mut state)).sum::<f64>() * sigma
    };
    let options = Options { metric: Metric::Plane, ..Options::default() };
    let (mut scatter, mut stated) = (Matrix6::zeros(), Matrix6::zeros());
    let repeats = 400;
    for _ in 0..repeats {
        let source: Vec<[f64; 3]> = target.iter().map(|p| [p[0] + noise(), p[1] + noise(), p[2] + noise()]).collect();
        let found = register(&source, &Target::Cloud(&tree, Some(&normals)), &options).unwrap();
        let turn = Rotation3::from_matrix_unchecked(found.target_from_source.rotation).scaled_axis();
        let error = with(&turn, &found.target_from_source.translation);
        scatter += error * error.transpose() / f64::from(repeats);
        stated += found.covariance / f64::from(repeats);
    }
    for i in 0..6 {
        // 400 repeats know a variance to 7 %.
        let ratio = scatter[(i, i)] / stated[(i, i)];
        assert!((0.75..1.3).contains(&ratio), "direction {i}: {ratio}");
    }
}

#[test]
fn outliers_do_not_pull_a_trimmed_or_robust_fit() {
    let (target, normals) = relief(80);
    let tree = KdTree::new(&target).unwrap();
    let truth = pose([0.004, -0.003, 0.005], [0.1, -0.2, 0.1]);
    let mut source = moved(&target, &truth.inverse());
    for p in source.iter_mut().step_by(9) {
        p[2] += 3.0;
    }
    let cloud = Target::Cloud(&tree, Some(&normals));
    let error = |options: Options| {
        let found = register(&source, &cloud, &Options { metric: Metric::Plane, ..options }).unwrap();
        (found.target_from_source.translation - truth.translation).amax()
    };
    assert!(error(Options::default()) > 0.05);
    assert!(error(Options { trim: 0.15, ..Options::default() }) < 1e-6);
    assert!(error(Options { max_distance_mm: 1.0, ..Options::default() }) < 1e-6);
    assert!(error(Options { kernel: RobustKernel::Tukey(None), ..Options::default() }) < 1e-6);
    assert!(error(Options { kernel: RobustKernel::Tukey(Some(0.5)), ..Options::default() }) < 1e-6);
    assert!(error(Options { kernel: RobustKernel::Huber(Some(0.01)), ..Options::default() }) < 0.01);
}

#[test]
fn vectors_and_the_plain_fallback_give_the_same_bits() {
    let (target, normals) = relief(60);
    let tree = KdTree::new(&target).unwrap();
    let (pose, n) = (pose([0.002, 0.001, -0.001], [0.3, 0.2, -0.1]), target.len());
    let (mut fast, mut plain) = (vec![Match::default(); n], vec![Match::default(); n]);
    let (mut fast_steps, mut plain_steps) = (vec![Followed::NEW; n], vec![Followed::NEW; n]);
    to_cloud(&tree, Some(&normals), &pose, &target, &mut fast_steps, &mut fast);
    plain_to_cloud(&tree, Some(&normals), &pose, &target, &mut plain_steps, &mut plain);
    let numbers = |m: &[Match]| m.iter().map(|m| (m.point, m.normal, m.distance.to_bits())).collect::<Vec<_>>();
    assert_eq!(numbers(&fast), numbers(&plain));
    for metric in [Metric::Point, Metric::Plane] {
        for kernel in [RobustKernel::None, RobustKernel::Huber(Some(0.1)), RobustKernel::Tukey(Some(0.3))] {
            let center = Vec3::new(30.0, 30.0, 0.0);
            let setting = Setting { pose, center, size: 25.0, limit: 0.5, metric, kernel };
            let (a, b) = (accumulate(&setting, &target, &fast), plain_accumulate(&setting, &target, &fast));
            assert!(a.sums == b.sums && a.squares == b.squares && a.plain == b.plain && a.count == b.count);
            assert!(a.count > 0 || matches!(kernel, RobustKernel::Tukey(_)));
        }
    }
    let surface = Surface::Cylinder(Cylinder::new([0.0; 3], [0.0, 1.0, 2.0], 20.0).unwrap());
    to_surface(&surface, &pose, &target, &mut fast);
    plain_to_surface(&surface, &pose, &target, &mut plain);
    assert_eq!(numbers(&fast), numbers(&plain));
}

#[test]
fn symmetric_targets_leave_their_own_motions_free() {
    let (points, _) = relief(30);
    for (surface, kinds) in [
        (
            Surface::Plane(Plane::new([0.0; 3], [0.0, 0.0, 1.0]).unwrap()),
            vec![WeakKind::Translation, WeakKind::Translation, WeakKind::Rotation],
        ),
        (Surface::Sphere(Sphere::new([30.0, 30.0, -90.0], 95.0).unwrap()), vec![WeakKind::Rotation; 3]),
    ] {
        let options = Options { metric: Metric::Plane, ..Options::default() };
        let found = register(&points, &Target::Surface(surface), &options).unwrap();
        assert_eq!(found.unobserved.iter().map(|w| w.kind).collect::<Vec<_>>(), kinds);
        if let Surface::Sphere(sphere) = surface {
            for w in &found.unobserved {
                let offset = sphere.center_mm - w.point_mm.unwrap();
                assert!((offset - w.axis * w.axis.dot(&offset)).norm() < 1e-6);
            }
        }
    }
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    let (target, normals) = relief(220);
    let tree = KdTree::new(&target).unwrap();
    let source = moved(&target, &pose([0.01, 0.0, 0.0], [0.1, 0.1, 0.1]));
    let options = Options { metric: Metric::Plane, trim: 0.1, ..Options::default() };
    let answers: Vec<_> = [1, 2, 8]
        .iter()
        .map(|&n| {
            threads::set_threads(Some(n)).unwrap();
            register(&source, &Target::Cloud(&tree, Some(&normals)), &options).unwrap()
        })
        .collect();
    threads::set_threads(None).unwrap();
    assert!(answers.windows(2).all(|w| w[0] == w[1]));
}

#[test]
fn what_has_no_answer_is_refused() {
    let (target, normals) = relief(10);
    let tree = KdTree::new(&target).unwrap();
    let cloud = Target::Cloud(&tree, None);
    let with = |options: Options| register(&target, &cloud, &options);
    let base = Options::default();
    assert!(matches!(with(Options { metric: Metric::Plane, ..base }), Err(Error::Degenerate { .. })));
    for bad in [
        Options { trim: 1.0, ..base },
        Options { trim: f64::NAN, ..base },
        Options { max_distance_mm: 0.0, ..base },
        Options { max_iterations: 0, ..base },
        Options { tolerance_mm: -1.0, ..base },
        Options { kernel: RobustKernel::Tukey(Some(0.0)), ..base },
        Options { max_points: Some(2), ..base },
        Options { weak: f64::NAN, ..base },
    ] {
        assert!(matches!(with(bad), Err(Error::OutOfRange { .. })), "{bad:?}");
    }
    assert!(matches!(register(&target[..2], &cloud, &base), Err(Error::TooFew { .. })));
    assert!(matches!(register(&[[f64::NAN; 3]; 9], &cloud, &base), Err(Error::NonFinite { .. })));
    let far = vec![[1e6; 3]; 9];
    assert!(matches!(register(&far, &cloud, &Options { max_distance_mm: 1.0, ..base }), Err(Error::NotFound { .. })));
    let short = Target::Cloud(&tree, Some(&normals[1..]));
    assert!(matches!(register(&target, &short, &base), Err(Error::Shape { .. })));
    // All points in one place, and points beyond what can be squared: an answer or an error.
    let _ = register(&[[1.0; 3]; 5], &cloud, &base).unwrap();
    let _ = register(&[[1e300; 3], [-1e300; 3], [0.0; 3]], &cloud, &base);
}
