//! Decoding twelve images of 1280 x 960, beside copying their bytes; unwrapping one phase image in space.

use std::f64::consts::TAU;
use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use weldcore::fringes::{DecodeOptions, FringeSet, Shot, decode_phase, decode_shot, unwrap_spatial};

#[cfg(not(feature = "python"))] // which brings it along
#[global_allocator]
static ALLOCATOR: weldcore::ground::allocator::Recycler = weldcore::ground::allocator::Recycler;

const WIDTH: usize = 1280;
const HEIGHT: usize = 960;
const SETS: [FringeSet; 3] = [FringeSet::new(1.0, 4), FringeSet::new(8.0, 4), FringeSet::new(64.0, 4)];

/// The column that lights a pixel: a slanted wall.
fn column(i: usize) -> f64 {
    10.0 + 0.97 * (i % WIDTH) as f64 + 0.005 * (i / WIDTH) as f64
}

fn images() -> Vec<Vec<u8>> {
    let mut noise = 1u32;
    let mut frames = Vec::new();
    for set in SETS {
        for k in 0..set.steps {
            let frame = (0..WIDTH * HEIGHT).map(|i| {
                noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                let wave = TAU * (set.periods * (column(i) + 0.5) / WIDTH as f64 - k as f64 / set.steps as f64);
                (120.0 + 90.0 * wave.cos() + f64::from(noise >> 8) / f64::from(1 << 24) * 3.0) as u8
            });
            frames.push(frame.collect());
        }
    }
    frames
}

fn decoding(c: &mut Criterion) {
    let frames = images();
    let slices: Vec<&[u8]> = frames.iter().map(Vec::as_slice).collect();
    let shot = Shot { exposures: vec![slices.clone()], width: WIDTH, height: HEIGHT };
    let decode = || decode_shot(&shot, &SETS, WIDTH, &DecodeOptions::default());
    let Ok(map) = decode() else { return };
    let right = |(i, c): (usize, &f64)| (c - column(i)).abs() < 0.5;
    assert!(map.column_px.iter().enumerate().filter(|x| right(*x)).count() > WIDTH * HEIGHT * 99 / 100);

    let mut copies = frames.clone();
    let mut group = c.benchmark_group("decode 12 images");
    group.bench_function("copy the bytes", |b| {
        b.iter(|| copies.iter_mut().zip(&frames).for_each(|(to, from)| to.copy_from_slice(black_box(from))));
    });
    group.bench_function("column, modulation, mask, sigma", |b| b.iter(|| black_box(decode())));
    group.bench_function("three wrapped phases in f64", |b| b.iter(|| black_box(decode_phase(&slices, &[4, 4, 4]))));
    group.finish();
}

fn unwrapping(c: &mut Criterion) {
    let truth = |i: usize| TAU * 64.0 * column(i) / WIDTH as f64;
    let wrapped: Vec<f64> = (0..WIDTH * HEIGHT).map(|i| truth(i) - TAU * (truth(i) / TAU).round()).collect();
    let unwrap = || unwrap_spatial(&wrapped, WIDTH, None, None);
    let Ok(found) = unwrap() else { return };
    assert!(found.iter().enumerate().all(|(i, f)| (f - truth(i) - (found[0] - truth(0))).abs() < 1e-6));
    c.bench_function("unwrap 1280 x 960 in space", |b| b.iter(|| black_box(unwrap())));
}

criterion_group!(benches, decoding, unwrapping);
criterion_main!(benches);
