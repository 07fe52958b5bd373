//! Triangulating 1.23 million pixels with both lenses.

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use weldcore::Vec3;
use weldcore::ground::transform::Transform;
use weldcore::scanner::triangulate::triangulate;
use weldcore::scanner::{Axis, Lens, Scanner};

#[cfg(not(feature = "python"))] // which brings it along
#[global_allocator]
static ALLOCATOR: weldcore::ground::allocator::Recycler = weldcore::ground::allocator::Recycler;

fn scanner() -> weldcore::Result<Scanner> {
    let camera = Lens::new(1280, 960, [2650.0, 2648.0], [647.5, 474.5], [-0.09, 0.12, 4e-4, -3e-4, 0.0])?;
    let projector = Lens::new(1280, 800, [2150.0; 2], [639.5, 399.5], [0.03, -0.02, 0.0, 0.0, 0.0])?;
    let (sin, cos) = 0.343f64.sin_cos();
    let pose = Transform::from_rows(&[
        [cos, 0.0, sin, -150.0],
        [0.0, 1.0, 0.0, 5.0],
        [-sin, 0.0, cos, 0.0],
        [0.0, 0.0, 0.0, 1.0],
    ])?;
    Scanner::new(camera, projector, pose)
}

fn triangulating(c: &mut Criterion) {
    let Ok(scanner) = scanner() else { return };
    let rays = scanner.camera_rays();
    let pose = scanner.camera_from_projector.inverse();
    let truth: Vec<Vec3> = rays
        .x
        .iter()
        .zip(&rays.y)
        .enumerate()
        .map(|(i, (x, y))| Vec3::new(*x, *y, 1.0) * (400.0 + (i % 97) as f64 / 10.0))
        .collect();
    let column: Vec<f64> =
        truth.iter().map(|p| scanner.projector.project(&pose.apply(p)).map_or(f64::NAN, |(u, _)| u)).collect();
    let sigma = vec![0.05f32; column.len()];
    let run = || triangulate(&column, &scanner, Some(&sigma), Axis::X);
    let Ok(cloud) = run() else { return };
    let close = cloud.points_mm.iter().zip(&truth).filter(|(p, t)| (Vec3::from(**p) - **t).norm() < 1e-7);
    assert!(close.count() > column.len() / 2);
    c.bench_function("triangulate 1280 x 960", |b| b.iter(|| black_box(run())));
}

criterion_group!(benches, triangulating);
criterion_main!(benches);
