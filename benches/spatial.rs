//! Trees, neighbours, normals, registration and distances on a million points.
#![allow(missing_docs, clippy::expect_used)] // criterion's macros; a bench may fail

use std::hint::black_box;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use weldcore::clouds::distance::{Target, distance};
use weldcore::clouds::icp::{Metric, Options, register};
use weldcore::clouds::kdtree::{Follower, KdTree};
use weldcore::clouds::mesh::Mesh;
use weldcore::clouds::normals;
use weldcore::ground::transform::Transform;
use weldcore::surfaces::{Cylinder, Surface};

const RADIUS: f64 = 315.0;

fn random(seed: u64) -> impl FnMut() -> f64 {
    let mut state = seed;
    move || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 11) as f64 / (1u64 << 53) as f64
    }
}

/// Points on a part of a pipe, shuffled; a million of them are 0.2 mm apart.
fn pipe(n: usize, radius: f64, seed: u64) -> Vec<[f64; 3]> {
    let mut next = random(seed);
    (0..n).map(|_| (next(), next() * 150.0)).map(|(a, z)| [radius * a.cos(), radius * a.sin(), z]).collect()
}

/// The same as an image.
fn grid(width: usize, height: usize) -> Vec<[f64; 3]> {
    let at = |i: usize, n: usize| i as f64 / n as f64;
    (0..width * height)
        .map(|i| (at(i % width, width), at(i / width, height) * 150.0))
        .map(|(a, z)| [RADIUS * a.cos(), RADIUS * a.sin(), z])
        .collect()
}

fn tube(around: u32, along: u32) -> Mesh {
    let vertices: Vec<[f64; 3]> = (0..around)
        .flat_map(|i| {
            (0..=along).map(move |j| (f64::from(i) / f64::from(around) * std::f64::consts::TAU, f64::from(j)))
        })
        .map(|(a, z)| [RADIUS * a.cos(), RADIUS * a.sin(), z * 1.5])
        .collect();
    let id = |i: u32, j: u32| (i % around) * (along + 1) + j;
    let triangles: Vec<[u32; 3]> = (0..around)
        .flat_map(|i| (0..along).map(move |j| (i, j)))
        .flat_map(|(i, j)| [[id(i, j), id(i + 1, j), id(i, j + 1)], [id(i + 1, j), id(i + 1, j + 1), id(i, j + 1)]])
        .collect();
    Mesh::new(&vertices, &triangles).expect("a tube is a mesh")
}

fn trees(c: &mut Criterion) {
    let mut group = c.benchmark_group("kdtree");
    group.sample_size(10);
    for n in [10_000, 100_000, 1_000_000, 10_000_000] {
        let points = pipe(n, RADIUS, 1);
        group.throughput(Throughput::Elements(n as u64));
        group.bench_function(format!("build {n}"), |b| b.iter(|| KdTree::new(black_box(&points))));
        let tree = KdTree::new(&points).expect("finite points");
        assert!(tree.bytes() <= 40 * n);
        let queries = pipe(n / 2, RADIUS + 1.0, 2);
        let (distances, _) = tree.nearest(&queries).expect("finite queries");
        assert!(distances.iter().all(|d| (1.0..5.0).contains(d)), "1 mm off a dense cloud");
        group.throughput(Throughput::Elements(queries.len() as u64));
        group.bench_function(format!("nearest {n}"), |b| b.iter(|| tree.nearest(black_box(&queries))));
    }
    let tree = KdTree::new(&pipe(1_000_000, RADIUS, 1)).expect("finite points");
    let (mut queries, mut follower) = (pipe(500_000, RADIUS, 2), Follower::default());
    group.bench_function("follow 1000000, 1 um a round", |b| {
        b.iter(|| {
            queries.iter_mut().for_each(|q| q[2] += 0.001);
            follower.nearest(&tree, &queries)
        });
    });
    let few = &queries[..100_000];
    group.bench_function("knn 20 of 1000000", |b| b.iter(|| tree.knn(black_box(few), 20)));
    group.finish();
}

fn surfaces(c: &mut Criterion) {
    let mut group = c.benchmark_group("surface");
    group.sample_size(10);
    let image = grid(1250, 800);
    let inwards = normals::of_grid(&image, 1250, 5, [0.0; 3]).expect("a grid");
    assert!(inwards.iter().zip(&image).all(|(n, p)| (n[0] * p[0] + n[1] * p[1]) / RADIUS < -0.999));
    group.throughput(Throughput::Elements(image.len() as u64));
    group.bench_function("normals of a grid", |b| b.iter(|| normals::of_grid(black_box(&image), 1250, 5, [0.0; 3])));
    let cloud = pipe(1_000_000, RADIUS, 1);
    group.bench_function("normals of a cloud", |b| b.iter(|| normals::of_cloud(black_box(&cloud), 20, [0.0; 3])));
    let queries = pipe(500_000, RADIUS + 0.5, 3);
    group.throughput(Throughput::Elements(queries.len() as u64));
    let mesh = tube(760, 96);
    let cylinder = Surface::Cylinder(Cylinder::new([0.0; 3], [0.0, 0.0, 1.0], RADIUS).expect("a cylinder"));
    for (name, target) in [("mesh", Target::Mesh(&mesh)), ("cylinder", Target::Surface(cylinder))] {
        let found = distance(&queries, &target, true).expect("finite queries");
        assert!(found.iter().all(|d| (d - 0.5).abs() < 0.01), "half a millimetre outside");
        group.bench_function(format!("distance to a {name}"), |b| {
            b.iter(|| distance(black_box(&queries), &target, true))
        });
    }
    group.finish();
}

fn registration(c: &mut Criterion) {
    let mut group = c.benchmark_group("icp");
    group.sample_size(10);
    let (target, normals): (Vec<_>, Vec<_>) = relief(1_000_000, 1).into_iter().unzip();
    let tree = KdTree::new(&target).expect("finite points");
    let shift = [0.3, -0.2, 0.4];
    let source: Vec<[f64; 3]> =
        relief(500_000, 2).iter().map(|(p, _)| [p[0] - shift[0], p[1] - shift[1], p[2] - shift[2]]).collect();
    let cloud = Target::Cloud(&tree, Some(&normals));
    let options = Options { metric: Metric::Plane, start: Transform::identity(), ..Options::default() };
    let found = register(&source, &cloud, &options).expect("a registration");
    assert!(found.converged && (0..3).all(|k| (found.target_from_source.translation[k] - shift[k]).abs() < 1e-3));
    group.bench_function("plane 500000 to 1000000", |b| b.iter(|| register(black_box(&source), &cloud, &options)));
    group.finish();
}

/// A surface without a symmetry, with its normals.
fn relief(n: usize, seed: u64) -> Vec<([f64; 3], [f64; 3])> {
    let mut next = random(seed);
    (0..n)
        .map(|_| {
            let (x, y) = (next() * 200.0, next() * 200.0);
            let slope = [-6.0 / 19.0 * (x / 19.0).cos(), 5.0 / 27.0 * (y / 27.0).sin(), 1.0];
            let length = slope.iter().map(|v| v * v).sum::<f64>().sqrt();
            ([x, y, 6.0 * (x / 19.0).sin() + 5.0 * (y / 27.0).cos()], slope.map(|v| v / length))
        })
        .collect()
}

criterion_group!(benches, trees, surfaces, registration);
criterion_main!(benches);
