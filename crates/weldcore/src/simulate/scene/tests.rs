//! The surface and the rays against closed forms.

use std::f64::consts::TAU;

use super::description::*;
use super::surface::*;
use super::*;
use crate::error::Error;
use crate::ground::transform::{Transform, Vec3};
use crate::scanner::{Lens, Scanner};

const STILL: Wander = Wander { sd_mm: 0.0, length_mm: 20.0 };

fn cap(width_mm: f64, height_mm: f64) -> Cap {
    Cap {
        width_mm,
        height_mm,
        power: 2.0,
        blend: 1.0,
        crown: 0.5,
        valley: 0.0,
        ripple_mm: 0.0,
        pitch_mm: 3.0,
        toes: STILL,
        crest: STILL,
        undercut_mm: [0.0; 2],
        undercut_width_mm: 1.0,
    }
}

fn scene(radius_mm: f64) -> Scene {
    Scene {
        radius_mm,
        thickness_mm: 6.0,
        half_length_mm: 120.0,
        reference: SceneWall::default(),
        other: SceneWall::default(),
        cap: cap(11.0, 1.7),
        seam_mm: 0.0,
        seam_wander: STILL,
        second: None,
        spatter: Vec::new(),
        seed: 7,
    }
}

fn surface(change: impl FnOnce(&mut Scene)) -> WeldSurface {
    let mut scene = scene(315.0);
    change(&mut scene);
    WeldSurface::new(scene).unwrap()
}

fn uneven(sd_mm: f64) -> Vec<Unevenness> {
    vec![Unevenness { sd_mm, around_mm: 15.0, along_mm: 25.0 }]
}

/// As the scanners of the demo: camera above the pipe at angle 0, image x along z, projector aside.
fn scanner() -> (Scanner, Transform) {
    let camera = Lens::new(160, 120, [326.0; 2], [79.7, 59.2], [0.0; 5]).unwrap();
    let projector = Lens::new(1280, 800, [2080.0; 2], [641.0, 402.5], [0.0; 5]).unwrap();
    let (sin, cos) = 20f64.to_radians().sin_cos();
    let toed = Transform::from_rows(&[
        [cos, 0.0, sin, -144.0],
        [0.0, 1.0, 0.0, 4.0],
        [-sin, 0.0, cos, 25.0],
        [0.0, 0.0, 0.0, 1.0],
    ]);
    // Camera's x along the pipe, its z towards the axis.
    let pose = Transform::from_rows(&[
        [0.0, 0.0, -1.0, 745.0],
        [0.0, 1.0, 0.0, 0.0],
        [1.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, 1.0],
    ]);
    (Scanner::new(camera, projector, toed.unwrap()).unwrap(), pose.unwrap())
}

#[test]
fn the_step_of_two_round_pipes_is_that_of_their_circles() {
    let (difference, offset, tilt) = (0.3, [0.4, -0.2], [0.002, -0.001]);
    let surface = surface(|s| {
        s.other.radius_difference_mm = difference;
        (s.other.offset_mm, s.other.tilt_rad) = (offset, tilt);
    });
    for i in 0..72 {
        let angle = TAU * f64::from(i) / 72.0;
        let edges = surface.edges(angle);
        assert_eq!(edges.toes_mm, [-5.5, 5.5]);
        let r = 315.0 + edges.heights_mm[1];
        // The point at the toe lies on the other circle.
        let centre = [0, 1].map(|k: usize| offset[k] + tilt[k] * 5.5);
        let away = (r * angle.cos() - centre[0]).hypot(r * angle.sin() - centre[1]);
        assert!((away - 315.3).abs() < 1e-9);
        assert!(edges.heights_mm[0].abs() < 1e-12);
    }
}

#[test]
fn machined_flared_and_dented_edges_are_as_deep_as_they_were_made() {
    let at = |change: &dyn Fn(&mut SceneWall)| surface(|s| change(&mut s.other));
    let taper = at(&|w| w.taper = Some(Taper { depth_mm: 1.6, slope: 0.1 }));
    assert!((taper.edges(1.0).step_mm() + 1.6).abs() < 1e-12);
    assert!((taper.height(1.0, 5.5 + 6.0).0 + 1.0).abs() < 1e-12 && taper.height(1.0, 22.0).0 == 0.0);
    let bore = at(&|w| w.counterbore = Some(Counterbore { depth_mm: 1.6, floor_mm: 10.0, slope: 0.5 }));
    assert!((bore.edges(1.0).step_mm() + 1.6).abs() < 1e-12);
    assert!((bore.height(1.0, 15.4).0 + 1.6).abs() < 1e-12 && (bore.height(1.0, 17.5).0 + 0.6).abs() < 1e-12);
    let flare = at(&|w| w.flare = Some(Flare { amplitude_mm: 1.5, decay_mm: 4.0 }));
    assert!((flare.edges(1.0).step_mm() - 1.5).abs() < 1e-12);
    assert!((flare.height(1.0, 9.5).0 - 1.5 / 1f64.exp()).abs() < 1e-12);
    for cosine in [false, true] {
        let width_rad = 0.1;
        let dent = at(&|w| w.dents = vec![Dent { depth_mm: 1.4, at_rad: 6.25, width_rad, decay_mm: 15.0, cosine }]);
        assert!((dent.edges(6.25).step_mm() + 1.4).abs() < 1e-12);
        // Half as deep at half the width, on the far side of 0 as well.
        assert!((dent.edges(6.30).step_mm() + 0.7).abs() < 1e-9);
        assert!((dent.edges(6.30 - TAU).step_mm() + 0.7).abs() < 1e-9);
        assert!(dent.edges(3.0).step_mm().abs() < 1e-9);
        assert!((dent.height(6.25, 20.5).0 + 1.4 / 1f64.exp()).abs() < 1e-9);
    }
}

#[test]
fn shrinkage_is_the_shell_term() {
    let surface = surface(|s| s.reference.shrinkage_mm = 0.25);
    let b = 1.285 / (315.0f64 * 6.0).sqrt();
    for z in [-5.5, -20.0, -60.0] {
        let s: f64 = -b * z;
        assert!((surface.height(0.3, z).0 + 0.25 * (-s).exp() * (s.cos() + s.sin())).abs() < 1e-12);
    }
    assert_eq!(surface.height(0.3, 30.0).0, 0.0);
}

#[test]
fn a_coat_begins_where_it_is_said_and_a_tape_ends() {
    let surface = surface(|s| {
        s.reference.strips = vec![Strip { thickness_mm: 1.4, from_mm: 15.0, to_mm: f64::INFINITY, edge_mm: 0.5 }];
        s.other.strips = vec![Strip { thickness_mm: 0.4, from_mm: 2.0, to_mm: 22.0, edge_mm: 0.5 }];
    });
    let height = |z: f64| surface.height(0.0, z).0;
    assert_eq!([height(-20.0), height(-20.5), height(-21.0), height(-100.0)], [0.0, 0.7, 1.4, 1.4]);
    assert_eq!([height(7.0), height(8.0), height(27.0), height(28.5)], [0.0, 0.4, 0.4, 0.0]);
    assert_eq!(surface.edges(0.0).step_mm(), 0.0);
}

#[test]
fn a_ring_between_two_welds_has_its_own_height() {
    for sign in [1.0, -1.0] {
        let surface = surface(|s| {
            s.second = Some(SecondSeam { distance_mm: sign * 30.0, width_mm: 10.0, height_mm: 1.5, ring_mm: 1.6 });
        });
        let edges = surface.edges(2.0);
        assert!((edges.step_mm() - sign * 1.6).abs() < 1e-12);
        assert!((edges.second_step_mm + 1.6).abs() < 1e-12);
        assert_eq!(
            surface.height(2.0, sign * 15.0),
            (1.6, if sign > 0.0 { WeldPart::Other } else { WeldPart::Reference })
        );
        let (top, part) = surface.height(2.0, sign * 30.0);
        assert!((top - 0.8 - 1.5).abs() < 1e-12 && part == WeldPart::SecondCap);
        assert_eq!(surface.height(2.0, sign * 36.0).0, 0.0);
    }
}

#[test]
fn the_surface_has_no_jumps() {
    let surface = surface(|s| {
        s.reference.unevenness = uneven(0.03);
        s.other.unevenness = uneven(0.03);
        s.other.taper = Some(Taper { depth_mm: 1.0, slope: 0.25 });
        s.reference.strips = vec![Strip { thickness_mm: 1.0, from_mm: 15.0, to_mm: 40.0, edge_mm: 0.5 }];
        s.cap = Cap { ripple_mm: 0.1, crown: 0.4, valley: 0.4, undercut_mm: [0.3, 0.2], ..s.cap };
        s.cap.toes.sd_mm = 0.3;
        s.cap.crest.sd_mm = 0.1;
        s.seam_wander.sd_mm = 0.5;
        s.second = Some(SecondSeam { distance_mm: 40.0, width_mm: 10.0, height_mm: 1.5, ring_mm: 0.5 });
        s.spatter = vec![Spatter { at_rad: 0.001, z_mm: 20.0, radius_mm: 0.8 }];
    });
    // The steepest place is the rim of the drop: its slope there is 3.2, the square root of that of a ball's edge.
    let step = 1e-4;
    for angle in [0.0, 0.001, 0.4] {
        let mut before = surface.height(angle, -60.0).0;
        for i in 1..1_200_000 {
            let here = surface.height(angle, -60.0 + step * f64::from(i)).0;
            assert!((here - before).abs() < 4.0 * step, "{angle} {i}");
            before = here;
        }
    }
}

#[test]
fn walls_are_uneven_independently() {
    let surface = surface(|s| {
        s.reference.unevenness = uneven(0.02);
        s.other.unevenness = uneven(0.02);
        s.cap.width_mm = 0.5;
    });
    let edges = surface.edges_at(&(0..264).map(|i| f64::from(i) / 42.0).collect::<Vec<_>>());
    let mean = |of: &dyn Fn(&Edges) -> f64| edges.iter().map(of).sum::<f64>() / edges.len() as f64;
    // Half a correlation length apart: some 70 independent values.
    let (a, b) = (mean(&|e| e.heights_mm[0].powi(2)).sqrt(), mean(&|e| e.heights_mm[1].powi(2)).sqrt());
    assert!((a / 0.02 - 1.0).abs() < 0.35 && (b / 0.02 - 1.0).abs() < 0.35, "{a} {b}");
    assert!(mean(&|e| e.heights_mm[0] * e.heights_mm[1]).abs() < 0.4 * a * b);
    // The step at the toes is that of the drawn surfaces.
    let edge = surface.edges(1.0);
    let beside = surface.height(1.0, edge.toes_mm[1] + 1e-9).0 - surface.height(1.0, edge.toes_mm[0] - 1e-9).0;
    assert!((beside - edge.step_mm()).abs() < 1e-9 && edge.step_mm() != 0.0);
}

#[test]
fn rays_meet_a_bare_cylinder_where_the_formula_says() {
    let surface = surface(|s| s.cap = cap(0.5, 0.0));
    let (scanner, pose) = scanner();
    let seen = surface.cast(&scanner, &pose);
    let rays = scanner.camera_rays();
    for (i, s) in seen.iter().enumerate() {
        let (o, d) = (pose.translation, pose.rotation * Vec3::new(rays.x[i], rays.y[i], 1.0));
        let (a, b) = (d.x * d.x + d.y * d.y, o.x * d.x + o.y * d.y);
        let disc = b * b - a * (o.x * o.x + o.y * o.y - 315.0 * 315.0);
        let t = (-b - disc.sqrt()) / a;
        assert!((s.depth_mm - t).abs() < 1e-6, "{i}: {} {t}", s.depth_mm);
        let p = o + d * t;
        assert!((s.z_mm - p.z).abs() < 1e-6);
        let lamp = pose.apply(&scanner.camera_from_projector.translation);
        let normal = Vec3::new(p.x, p.y, 0.0) / 315.0;
        assert!((f64::from(s.light) - normal.dot(&(lamp - p).normalize())).abs() < 1e-5);
    }
    assert!(seen.iter().all(|s| (s.status == Status::Lit) == s.column_px.is_finite()));
    assert!(seen.iter().filter(|s| s.status == Status::Lit).count() > seen.len() * 9 / 10);
}

#[test]
fn points_lie_on_the_surface_and_nothing_stands_before_them() {
    let surface = surface(|s| {
        s.reference.unevenness = uneven(0.03);
        s.other.unevenness = uneven(0.03);
        s.cap = Cap { blend: 0.5, height_mm: 3.0, ripple_mm: 0.15, ..s.cap };
        s.other.dents = vec![Dent { depth_mm: 8.0, at_rad: 0.05, width_rad: 0.05, decay_mm: 20.0, cosine: true }];
    });
    let (scanner, pose) = scanner();
    // Leaning along the pipe by 45 degrees, the light by 65.
    let (sin, cos) = (-45f64).to_radians().sin_cos();
    let turn = [
        [cos, 0.0, -sin, 315.0 * (1.0 - cos)],
        [0.0, 1.0, 0.0, 0.0],
        [sin, 0.0, cos, -315.0 * sin],
        [0.0, 0.0, 0.0, 1.0],
    ];
    let pose = Transform::from_rows(&turn).unwrap() * pose;
    let seen = surface.cast(&scanner, &pose);
    let rays = scanner.camera_rays();
    let mut parts = [0; 6];
    for (i, s) in seen.iter().enumerate().filter(|(_, s)| s.status != Status::Nothing) {
        let p = pose.apply(&(Vec3::new(rays.x[i], rays.y[i], 1.0) * s.depth_mm));
        let above = |p: &Vec3| p.x.hypot(p.y) - 315.0 - surface.height(p.y.atan2(p.x), p.z).0;
        assert!(above(&p).abs() < 1e-6);
        let back = (pose.translation - p).normalize();
        // A corner thinner than half a tenth may be missed where the toe is vertical.
        let hidden = (1..200).map(|k| above(&(p + back * (0.05 * f64::from(k))))).fold(0.0, f64::min);
        assert!(hidden > -0.05, "{i}: {hidden}");
        parts[usize::from(s.part)] += 1;
    }
    assert!(parts[1] > 1000 && parts[2] > 1000 && parts[3] > 200);
    // Light that grazes the cap is held up by it.
    assert!(seen.iter().any(|s| s.status == Status::Shaded));
}

#[test]
fn a_cast_has_the_same_bits_on_any_number_of_threads() {
    let build = || surface(|s| s.other.unevenness = uneven(0.03));
    let (scanner, pose) = scanner();
    let mut seen = Vec::new();
    for n in [1, 2, 5] {
        crate::ground::threads::set_threads(Some(n)).unwrap();
        let bits = build().cast(&scanner, &pose);
        seen.push(bits.iter().map(|s| (s.depth_mm.to_bits(), s.column_px.to_bits())).collect::<Vec<_>>());
    }
    crate::ground::threads::set_threads(None).unwrap();
    assert!(seen.windows(2).all(|w| w[0] == w[1]));
}

#[test]
fn scenes_that_cannot_be_are_refused() {
    let refused = |change: &dyn Fn(&mut Scene)| {
        let mut scene = scene(315.0);
        change(&mut scene);
        WeldSurface::new(scene).unwrap_err()
    };
    assert!(matches!(refused(&|s| s.radius_mm = 0.0), Error::OutOfRange { what: "scene radius_mm", .. }));
    assert!(matches!(refused(&|s| s.cap.crown = 1.0), Error::OutOfRange { what: "cap crown", .. }));
    assert!(matches!(refused(&|s| s.other.shrinkage_mm = f64::NAN), Error::NonFinite { .. }));
    assert!(matches!(refused(&|s| s.other.offset_mm[0] = 400.0), Error::OutOfRange { .. }));
    let near = SecondSeam { distance_mm: 5.0, width_mm: 10.0, height_mm: 1.5, ring_mm: 0.5 };
    assert!(matches!(refused(&|s| s.second = Some(near)), Error::OutOfRange { what: "second seam distance_mm", .. }));
}
