//! Many queries at once.

use multiversion::multiversion;
use rayon::prelude::*;

use super::along::for_chunks;
use super::boxes::Aside;
use super::sought::{FAR, Nearest, NearestK, WithinRadius};
use super::tree::{Followed, KdTree, require_range};
use crate::error::{Error, Result};
use crate::ground::memory::require;
use crate::ground::stop::poll;
use crate::ground::threads;

/// Queries handed to a thread at a time.
pub(super) const QUERIES: usize = 1024;

/// The points within a radius of a query, nearest first.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Within {
    /// Distances, mm, ascending.
    pub distance_mm: Vec<f64>,
    /// Indices of the points.
    pub index: Vec<u32>,
}

impl KdTree {
    /// The nearest point to each query: distances, mm, and indices; of equally distant points the lowest index.
    ///
    /// # Errors
    /// [`Error::NonFinite`] and [`Error::OutOfRange`] as in [`KdTree::new`].
    pub fn nearest(&self, queries: &[[f64; 3]]) -> Result<(Vec<f64>, Vec<u32>)> {
        require_range("queries", queries)?;
        require(queries.len(), 96);
        let mut found = vec![Nearest { squared: FAR, index: u32::MAX }; queries.len()];
        Ok(threads::install(|| {
            for_chunks(queries, &mut found, QUERIES, |queries, found| nearest_of(self, queries, found));
            found.par_iter().map(|f| (f.squared.sqrt(), f.index)).unzip()
        }))
    }

    /// The distance of the nearest point to each query, mm, negative where the query is behind that point's normal.
    pub(crate) fn signed(&self, queries: &[[f64; 3]], normals: &[[f64; 3]]) -> Result<Vec<f64>> {
        require_range("points", queries)?;
        require(queries.len(), 72);
        let mut distance = vec![0.0; queries.len()];
        threads::install(|| for_chunks(queries, &mut distance, QUERIES, |q, d| signed_of(self, normals, q, d)));
        Ok(distance)
    }

    /// The `k` nearest points to each query, nearest first, equally distant ones by index: distances, mm, and indices,
    /// `k` after `k`.
    ///
    /// # Errors
    /// As [`KdTree::nearest`], and [`Error::OutOfRange`] unless `1 <= k <= len`.
    pub fn knn(&self, queries: &[[f64; 3]], k: usize) -> Result<(Vec<f64>, Vec<u32>)> {
        require_range("queries", queries)?;
        if !(1..=self.len).contains(&k) {
            let expected = format!("from 1 to the {} points of the tree", self.len);
            return Err(Error::OutOfRange { what: "k", expected, value: k.to_string() });
        }
        let wanted = queries.len().checked_mul(k).filter(|&n| n <= isize::MAX as usize / 16);
        let Some(wanted) = wanted else {
            let expected = "small enough for its answer to fit into memory".into();
            return Err(Error::OutOfRange { what: "k", expected, value: k.to_string() });
        };
        require(wanted, 12);
        let (mut distance, mut index) = (vec![0.0; wanted], vec![0; wanted]);
        threads::install(|| {
            let chunks = (distance.par_chunks_mut(QUERIES * k), index.par_chunks_mut(QUERIES * k));
            (queries.par_chunks(QUERIES), chunks.0, chunks.1)
                .into_par_iter()
                .for_each(|(queries, distance, index)| nearest_k_of(self, queries, k, distance, index));
        });
        Ok((distance, index))
    }

    /// All points within `r_mm` of each query, the border included, nearest first, equally distant ones by index.
    ///
    /// # Errors
    /// As [`KdTree::nearest`], and [`Error::OutOfRange`] where `r_mm` is negative or NaN.
    pub fn radius(&self, queries: &[[f64; 3]], r_mm: f64) -> Result<Vec<Within>> {
        require_range("queries", queries)?;
        if r_mm.is_nan() || r_mm < 0.0 {
            return Err(Error::OutOfRange { what: "r", expected: "at least 0".into(), value: r_mm.to_string() });
        }
        require(queries.len(), 2 * size_of::<Within>());
        let chunks: Vec<Vec<Within>> =
            threads::install(|| queries.par_chunks(QUERIES).map(|queries| within_of(self, queries, r_mm)).collect());
        Ok(chunks.into_iter().flatten().collect())
    }
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw", "x86_64+avx2"))]
pub(super) fn nearest_of(tree: &KdTree, queries: &[[f64; 3]], found: &mut [Nearest]) {
    plain_nearest_of(tree, queries, found);
}

/// The body of [`nearest_of`], and its fallback.
#[inline(always)]
pub(super) fn plain_nearest_of(tree: &KdTree, queries: &[[f64; 3]], found: &mut [Nearest]) {
    let mut aside = Aside::new();
    for (q, found) in queries.iter().zip(found) {
        tree.offer_leaf(tree.boxes.dive(q), q, found);
        tree.search(q, &mut aside, found);
    }
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw", "x86_64+avx2"))]
pub(super) fn signed_of(tree: &KdTree, normals: &[[f64; 3]], queries: &[[f64; 3]], distance: &mut [f64]) {
    plain_signed_of(tree, normals, queries, distance);
}

/// The body of [`signed_of`], and its fallback.
#[inline(always)]
pub(super) fn plain_signed_of(tree: &KdTree, normals: &[[f64; 3]], queries: &[[f64; 3]], distance: &mut [f64]) {
    let mut aside = Aside::new();
    for (q, distance) in queries.iter().zip(distance) {
        let mut step = Followed::NEW;
        let squared = tree.follow(q, &mut step, &mut aside);
        let (p, normal) = (step.point, normals.get(step.index as usize));
        let ahead = normal.map_or(0.0, |n| (0..3).map(|k| n[k] * (q[k] - p[k])).sum::<f64>());
        *distance = if ahead < 0.0 { -squared.sqrt() } else { squared.sqrt() };
    }
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw", "x86_64+avx2"))]
pub(super) fn nearest_k_of(tree: &KdTree, queries: &[[f64; 3]], k: usize, distance: &mut [f64], index: &mut [u32]) {
    plain_nearest_k_of(tree, queries, k, distance, index);
}

/// The body of [`nearest_k_of`], and its fallback.
#[inline(always)]
pub(super) fn plain_nearest_k_of(
    tree: &KdTree,
    queries: &[[f64; 3]],
    k: usize,
    distance: &mut [f64],
    index: &mut [u32],
) {
    let mut aside = Aside::new();
    for ((q, distance), index) in queries.iter().zip(distance.chunks_mut(k)).zip(index.chunks_mut(k)) {
        poll();
        distance.fill(FAR);
        index.fill(u32::MAX);
        tree.search(q, &mut aside, &mut NearestK { squared: distance, index });
        for d in distance {
            *d = d.sqrt();
        }
    }
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw", "x86_64+avx2"))]
pub(super) fn within_of(tree: &KdTree, queries: &[[f64; 3]], r: f64) -> Vec<Within> {
    plain_within_of(tree, queries, r)
}

/// The body of [`within_of`], and its fallback.
#[inline(always)]
pub(super) fn plain_within_of(tree: &KdTree, queries: &[[f64; 3]], r: f64) -> Vec<Within> {
    let mut aside = Aside::new();
    // Wide enough for the rounding of the square and of the root that decides.
    let bound = (r * r * (1.0 + 4.0 * f64::EPSILON)).clamp(f64::MIN_POSITIVE, FAR);
    let mut found = WithinRadius { bound, r, all: Vec::new() };
    let mut answers = Vec::with_capacity(queries.len());
    for q in queries {
        poll();
        tree.search(q, &mut aside, &mut found);
        found.all.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        require(found.all.len(), 12);
        let (distance_mm, index) = found.all.drain(..).unzip();
        answers.push(Within { distance_mm, index });
    }
    answers
}
