//! Fits and the search for spheres, by size. Each result is checked before it is timed.
#![allow(clippy::expect_used, missing_docs)] // A bench whose result is wrong is to stop.

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use weldcore::Vec3;
use weldcore::surfaces::{PointNoise, cylinder, find_spheres, plane, robust, sphere};

/// Uniform in (-1, 1) from a counter.
fn uniform(i: usize) -> f64 {
    let mut z = (i as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    2.0 * ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64 - 1.0
}

const CENTER: Vec3 = Vec3::new(100.0, -50.0, 400.0);

/// A ball of radius 25 with noise of some 0.05 mm; every `stray`th point is anywhere near.
fn ball(n: usize, stray: usize) -> Vec<[f64; 3]> {
    let point = |i: usize| {
        let box_ = Vec3::new(uniform(5 * i), uniform(5 * i + 1), uniform(5 * i + 2));
        if stray > 0 && i % 5 < stray {
            return (CENTER + box_ * 40.0).into();
        }
        (CENTER + box_.normalize() * (25.0 + 0.05 * (uniform(5 * i + 3) + uniform(5 * i + 4)))).into()
    };
    (0..n).map(point).collect()
}

/// A wall of a pipe of 630 mm, 85° of it.
fn pipe(n: usize) -> Vec<[f64; 3]> {
    let point = |i: usize| {
        let (t, r) = (0.75 * uniform(3 * i), 315.0 + 0.05 * uniform(3 * i + 2));
        [r * t.cos(), 60.0 * uniform(3 * i + 1), r * t.sin()]
    };
    (0..n).map(point).collect()
}

/// What a camera of 1280x960 sees of three balls before a plate.
fn view() -> Vec<[f64; 3]> {
    let balls = [Vec3::new(-20.0, -15.0, 412.0), Vec3::new(25.0, -12.0, 405.0), Vec3::new(2.0, 20.0, 410.0)];
    let point = |i: usize| {
        let ray = Vec3::new(((i % 1280) as f64 - 639.5) / 2650.0, ((i / 1280) as f64 - 479.5) / 2650.0, 1.0);
        let mut depth = 430.0 / (1.0 + 0.3 * ray.x);
        for c in balls {
            let (a, b) = (ray.norm_squared(), ray.dot(&c));
            let root = b * b - a * (c.norm_squared() - 100.0);
            if root > 0.0 {
                depth = (b - root.sqrt()) / a;
            }
        }
        (ray * (depth + 0.05 * uniform(i))).into()
    };
    (0..1280 * 960).map(point).collect()
}

fn sizes(c: &mut Criterion) {
    let mut group = c.benchmark_group("fit");
    group.sample_size(10);
    for n in [10_000, 100_000, 1_000_000] {
        group.throughput(Throughput::Elements(n as u64));
        let (ball, pipe) = (ball(n, 0), pipe(n));
        let found = sphere::fit(&ball, None, PointNoise::default()).expect("a ball");
        assert!((found.surface.center_mm - CENTER).norm() < 0.01);
        group.bench_function(BenchmarkId::new("sphere", n), |b| {
            b.iter(|| sphere::fit(&ball, None, PointNoise::default()));
        });
        group.bench_function(BenchmarkId::new("sphere, radius known", n), |b| {
            b.iter(|| sphere::fit(&ball, Some(25.0), PointNoise::default()));
        });
        group.bench_function(BenchmarkId::new("plane", n), |b| b.iter(|| plane::fit(&pipe, PointNoise::default())));
        let found = cylinder::fit(&pipe, None, PointNoise::default()).expect("a pipe");
        assert!((found.surface.radius_mm - 315.0).abs() < 0.05);
        group.bench_function(BenchmarkId::new("cylinder", n), |b| {
            b.iter(|| cylinder::fit(&pipe, None, PointNoise::default()));
        });
        group.bench_function(BenchmarkId::new("cylinder, from a start", n), |b| {
            b.iter(|| cylinder::refine(&pipe, found.surface, true, PointNoise::default()));
        });
    }
    group.finish();
}

fn among_outliers(c: &mut Criterion) {
    let mut group = c.benchmark_group("fit, 40 % outliers");
    group.sample_size(10);
    for n in [10_000, 100_000, 1_000_000] {
        let points = ball(n, 2);
        let (found, _) = robust::sphere(&points, None, None, 0).expect("a ball");
        assert!((found.surface.center_mm - CENTER).norm() < 0.01);
        group.throughput(Throughput::Elements(n as u64));
        group.bench_function(BenchmarkId::new("sphere", n), |b| b.iter(|| robust::sphere(&points, None, None, 0)));
    }
    group.finish();
}

fn three_spheres(c: &mut Criterion) {
    let points = view();
    assert_eq!(find_spheres::find(&points, Some(1280), 10.0, None).expect("three balls").len(), 3);
    let mut group = c.benchmark_group("find spheres");
    group.sample_size(20);
    group.bench_function("grid of 1280x960", |b| b.iter(|| find_spheres::find(&points, Some(1280), 10.0, Some(3))));
    group.finish();
}

criterion_group!(benches, sizes, among_outliers, three_spheres);
criterion_main!(benches);
