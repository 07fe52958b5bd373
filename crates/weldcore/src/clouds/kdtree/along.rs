//! Queries in an order in which neighbours follow each other: a search then finds in the cache what the last one used.

use rayon::prelude::*;

use super::boxes::{max, min};
use crate::ground::robust::median;
use crate::ground::stop::polled;

/// Fewer queries than this are not worth ordering.
const FEW: usize = 8 * 1024;
/// Queries that follow each other at more than this many times their spacing are in no useful order. A row of an image is
/// at 1, a shuffled cloud at hundreds.
const SCATTERED: f64 = 16.0;
/// Every so many pairs are looked at to tell.
const PAIRS: usize = 61;
/// Cells along a side of the cloud: of three sides 30 bits.
const CELLS: f64 = 1024.0;

/// The order along a space-filling curve (Morton's) of points that are in none; None where they are in a good one.
pub(crate) fn order_along(points: &[[f64; 3]]) -> Option<Vec<u32>> {
    if points.len() < FEW {
        return None;
    }
    let extents = points.par_chunks(FEW).map(|chunk| {
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for p in chunk {
            for k in 0..3 {
                (low[k], high[k]) = (min(low[k], p[k]), max(high[k], p[k]));
            }
        }
        (low, high)
    });
    let nothing = || ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    let join = |a: ([f64; 3], [f64; 3]), b: ([f64; 3], [f64; 3])| {
        (std::array::from_fn(|k| min(a.0[k], b.0[k])), std::array::from_fn(|k| max(a.1[k], b.1[k])))
    };
    let (low, high) = extents.reduce(nothing, join);
    let size: f64 = (0..3).map(|k| high[k] - low[k]).fold(0.0, max);
    let mut steps: Vec<f64> = points
        .windows(2)
        .step_by(PAIRS)
        .map(|pair| (0..3).map(|k| (pair[1][k] - pair[0][k]).abs()).fold(0.0, max))
        .collect();
    let step = median(&mut steps);
    // The spacing of as many points on a square surface. Also false where there is no size at all, or no finite one.
    let spacing = size / (points.len() as f64).sqrt();
    if !(step > SCATTERED * spacing && spacing > 0.0 && size.is_finite()) {
        return None;
    }
    let cell = |p: &[f64; 3]| (0..3).fold(0, |code, k| code | spread_bits((p[k] - low[k]) / size * (CELLS - 1.0)) << k);
    let mut keys: Vec<u64> = points.par_iter().enumerate().map(|(i, p)| cell(p) << 32 | i as u64).collect();
    keys.par_sort_unstable();
    Some(keys.into_par_iter().map(|key| key as u32).collect())
}

/// The ten bits of a number below 1024, three places apart.
fn spread_bits(value: f64) -> u64 {
    let mut v = (value as u64) & 0x3ff;
    v = (v | v << 16) & 0x0300_00ff;
    v = (v | v << 8) & 0x0300_f00f;
    v = (v | v << 4) & 0x030c_30c3;
    (v | v << 2) & 0x0924_9249
}

/// `job` on chunks of queries and their answers, in a good order; the answers come in the order of the queries.
pub(crate) fn for_chunks<T: Send + Sync + Copy>(
    queries: &[[f64; 3]],
    answers: &mut [T],
    chunk: usize,
    job: impl Fn(&[[f64; 3]], &mut [T]) + Sync,
) {
    let run = |queries: &[[f64; 3]], answers: &mut [T]| {
        (queries.par_chunks(chunk), answers.par_chunks_mut(chunk))
            .into_par_iter()
            .inspect(polled)
            .for_each(|(queries, answers)| job(queries, answers));
    };
    let Some(order) = order_along(queries) else { return run(queries, answers) };
    let ordered: Vec<[f64; 3]> = order.par_iter().map(|&i| queries[i as usize]).collect();
    let mut found = answers.to_vec();
    run(&ordered, &mut found);
    for (&i, value) in order.iter().zip(found) {
        answers[i as usize] = value;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_are_spread_three_apart() {
        for v in 0..1024u64 {
            let expected = (0..10).fold(0, |code, bit| code | (v >> bit & 1) << (3 * bit));
            assert_eq!(spread_bits(v as f64), expected);
        }
    }

    #[test]
    fn a_shuffled_cloud_is_ordered_and_an_image_is_not() {
        let image: Vec<[f64; 3]> = (0..20_000).map(|i| [f64::from(i % 200), f64::from(i / 200), 5.0]).collect();
        assert!(order_along(&image).is_none());
        assert!(order_along(&vec![[1.0; 3]; 20_000]).is_none());
        // 7919 is prime to 20,000: every point once, far from the last.
        let shuffled: Vec<[f64; 3]> = (0..20_000).map(|i| image[i * 7919 % 20_000]).collect();
        let mut order = order_along(&shuffled).unwrap();
        let step = |a: u32, b: u32| (shuffled[a as usize][0] - shuffled[b as usize][0]).abs();
        let mean = order.windows(2).map(|w| step(w[0], w[1])).sum::<f64>() / 20_000.0;
        assert!(mean < 3.0, "{mean}");
        order.sort_unstable();
        assert!(order.into_iter().eq(0..20_000));
        let mut answers = vec![0.0; 20_000];
        for_chunks(&shuffled, &mut answers, 100, |q, a| a.iter_mut().zip(q).for_each(|(a, q)| *a = q[0]));
        assert!(answers.iter().zip(&shuffled).all(|(a, q)| *a == q[0]));
    }
}
