//! Against a plain loop, and against kiddo.

use super::follow::*;
use super::queries::*;
use super::sought::*;
use super::tree::*;
use crate::error::Error;
use crate::ground::threads;
use proptest::prelude::*;

/// The oracle: a plain loop.
fn sorted(points: &[[f64; 3]], q: &[f64; 3]) -> Vec<(f64, u32)> {
    let mut all: Vec<(f64, u32)> = points
        .iter()
        .enumerate()
        .map(|(i, p)| {
            let d: [f64; 3] = std::array::from_fn(|k| p[k] - q[k]);
            ((d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt(), i as u32)
        })
        .collect();
    all.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    all
}

fn agrees(points: &[[f64; 3]], queries: &[[f64; 3]], k: usize, r: f64) {
    let tree = KdTree::new(points).unwrap();
    let k = k.clamp(1, points.len());
    let (d1, i1) = tree.nearest(queries).unwrap();
    let (dk, ik) = tree.knn(queries, k).unwrap();
    let within = tree.radius(queries, r).unwrap();
    for (n, q) in queries.iter().enumerate() {
        let all = sorted(points, q);
        assert_eq!((d1[n], i1[n]), all[0]);
        let got: Vec<_> = dk[n * k..][..k].iter().copied().zip(ik[n * k..][..k].iter().copied()).collect();
        assert_eq!(got, all[..k]);
        let got: Vec<_> = within[n].distance_mm.iter().copied().zip(within[n].index.iter().copied()).collect();
        let expected: Vec<_> = all.into_iter().filter(|x| x.0 <= r).collect();
        assert_eq!(got, expected);
    }
}

fn random(n: usize, seed: u64, size: f64, offset: f64) -> Vec<[f64; 3]> {
    let mut state = seed;
    let mut next = || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 11) as f64 / (1u64 << 53) as f64 * size + offset
    };
    (0..n).map(|_| [next(), next(), next()]).collect()
}

#[test]
fn random_clouds_of_any_size_near_and_far_from_the_origin() {
    for n in [1, 2, 7, 8, 9, 63, 64, 65, 513, 4097] {
        for offset in [0.0, 1e6] {
            agrees(&random(n, 1, 100.0, offset), &random(50, 2, 120.0, offset - 10.0), 11, 9.0);
        }
    }
}

#[test]
fn vectors_and_the_plain_fallback_give_the_same_bits() {
    let points = random(5000, 3, 100.0, -50.0);
    let queries = random(400, 4, 130.0, -65.0);
    let tree = KdTree::new(&points).unwrap();
    let n = queries.len();
    let none = Nearest { squared: FAR, index: u32::MAX };
    let (mut fast, mut plain) = (vec![none; n], vec![none; n]);
    nearest_of(&tree, &queries, &mut fast);
    plain_nearest_of(&tree, &queries, &mut plain);
    for (a, b) in fast.iter().zip(&plain) {
        assert_eq!((a.squared.to_bits(), a.index), (b.squared.to_bits(), b.index));
    }
    let normals = random(5000, 5, 2.0, -1.0);
    let (mut fast, mut plain) = (vec![0.0; n], vec![0.0; n]);
    signed_of(&tree, &normals, &queries, &mut fast);
    plain_signed_of(&tree, &normals, &queries, &mut plain);
    assert!(fast == plain && fast.iter().any(|&d| d < 0.0));
    let (mut fast, mut plain) = (vec![(0.0, 0); n], vec![(0.0, 0); n]);
    let (mut fast_steps, mut plain_steps) = (vec![Followed::NEW; n], vec![Followed::NEW; n]);
    for shift in [0.0, 1e-3, 2.0] {
        let moved: Vec<[f64; 3]> = queries.iter().map(|q| q.map(|c| c + shift)).collect();
        follow_all(&tree, &moved, &mut fast_steps, &mut fast);
        plain_follow_all(&tree, &moved, &mut plain_steps, &mut plain);
        assert_eq!(fast, plain);
    }
    let (mut fast, mut plain) = ((vec![0.0; 7 * n], vec![0; 7 * n]), (vec![0.0; 7 * n], vec![0; 7 * n]));
    nearest_k_of(&tree, &queries, 7, &mut fast.0, &mut fast.1);
    plain_nearest_k_of(&tree, &queries, 7, &mut plain.0, &mut plain.1);
    assert_eq!(fast, plain);
    let lists = |found: Vec<Within>| found.into_iter().map(|w| (w.distance_mm, w.index)).collect::<Vec<_>>();
    let (fast, plain) = (within_of(&tree, &queries, 6.0), plain_within_of(&tree, &queries, 6.0));
    assert_eq!(lists(fast), lists(plain));
}

#[test]
fn lattices_duplicates_and_lines_go_to_the_lowest_index() {
    let lattice: Vec<[f64; 3]> =
        (0..1000).map(|i| [f64::from(i % 10), f64::from(i / 10 % 10), f64::from(i / 100)]).collect();
    let between: Vec<[f64; 3]> = lattice.iter().map(|p| p.map(|c| c + 0.5)).collect();
    agrees(&lattice, &between, 9, 1.0);
    agrees(&lattice, &lattice, 7, 1.0);
    agrees(&vec![[1.0, 2.0, 3.0]; 300], &[[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]], 300, 0.0);
    let line: Vec<[f64; 3]> = (0..500).map(|i| [f64::from(i % 250), 0.0, 0.0]).collect();
    agrees(&line, &between[..200], 5, 3.0);
}

#[test]
fn kiddo_finds_the_same_distances() {
    let points = random(20_000, 5, 50.0, 1000.0);
    let queries = random(2_000, 6, 50.0, 1000.0);
    let theirs = kiddo::ImmutableKdTree::<f64, 3>::new_from_slice(&points).unwrap();
    let (ours, _) = KdTree::new(&points).unwrap().nearest(&queries).unwrap();
    for (q, d) in queries.iter().zip(ours) {
        let their = theirs.query(q).nearest_one::<kiddo::SquaredEuclidean<f64>>().execute();
        assert!((their.distance.sqrt() - d).abs() <= 4.0 * f64::EPSILON * d);
    }
}

proptest! {
    #[test]
    fn coarse_coordinates_make_ties(
        points in prop::collection::vec(prop::array::uniform3(-4i32..4), 1..200),
        queries in prop::collection::vec(prop::array::uniform3(-5i32..5), 0..20),
        k in 1usize..12,
        r in 0u32..6,
    ) {
        let float = |v: Vec<[i32; 3]>| -> Vec<[f64; 3]> { v.into_iter().map(|p| p.map(f64::from)).collect() };
        agrees(&float(points), &float(queries), k, f64::from(r));
    }
}

#[test]
fn any_number_of_threads_gives_the_same_answer() {
    let (points, queries) = (random(100_000, 3, 10.0, 0.0), random(5_000, 4, 10.0, 0.0));
    let answers: Vec<_> = [1, 2, 8]
        .iter()
        .map(|&n| {
            threads::set_threads(Some(n)).unwrap();
            KdTree::new(&points).unwrap().knn(&queries, 5).unwrap()
        })
        .collect();
    threads::set_threads(None).unwrap();
    assert!(answers.windows(2).all(|w| w[0] == w[1]));
}

#[test]
fn followed_queries_get_the_answers_of_a_search() {
    let mut points = random(3_000, 7, 20.0, 0.0);
    points.extend_from_within(..500);
    let tree = KdTree::new(&points).unwrap();
    let (mut queries, shifts) = (random(2_000, 8, 20.0, 0.0), random(2_000, 9, 2.0, -1.0));
    let mut follower = Follower::default();
    for round in 0..12 {
        assert_eq!(follower.nearest(&tree, &queries).unwrap(), tree.nearest(&queries).unwrap());
        for (q, shift) in queries.iter_mut().zip(&shifts) {
            *q = std::array::from_fn(|k| q[k] + shift[k] * 0.5f64.powi(round));
        }
    }
}

#[test]
fn it_takes_at_most_40_bytes_a_point() {
    for n in [10_000, 100_000, 300_000] {
        assert!(KdTree::new(&random(n, 9, 1.0, 0.0)).unwrap().bytes() <= 40 * n);
    }
}

#[test]
fn what_has_no_answer_is_refused() {
    assert!(matches!(KdTree::new(&[]), Err(Error::TooFew { .. })));
    assert!(matches!(KdTree::new(&[[0.0, f64::NAN, 0.0]]), Err(Error::NonFinite { .. })));
    assert!(matches!(KdTree::new(&[[0.0, 1e200, 0.0]]), Err(Error::OutOfRange { .. })));
    let tree = KdTree::new(&[[0.0; 3]]).unwrap();
    assert!(matches!(tree.nearest(&[[f64::INFINITY, 0.0, 0.0]]), Err(Error::NonFinite { .. })));
    assert!(matches!(tree.knn(&[[0.0; 3]], 2), Err(Error::OutOfRange { .. })));
    assert!(matches!(tree.knn(&[[0.0; 3]], 0), Err(Error::OutOfRange { .. })));
    assert!(tree.radius(&[[0.0; 3]], -1.0).is_err() && tree.radius(&[[0.0; 3]], f64::NAN).is_err());
    assert_eq!(tree.radius(&[[1.0; 3]], f64::INFINITY).unwrap()[0].index, [0]);
    assert!(tree.nearest(&[]).unwrap().0.is_empty());
}
