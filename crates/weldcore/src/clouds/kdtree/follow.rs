//! Queries that move a little from call to call.

use multiversion::multiversion;
use rayon::prelude::*;

use super::along::order_along;
use super::boxes::Aside;
use super::queries::QUERIES;
use super::tree::{Followed, KdTree, require_range};
use crate::error::Result;
use crate::ground::memory::require;
use crate::ground::stop::polled;
use crate::ground::threads;

/// Nearest neighbours of queries that move a little from call to call, as the points of an iteration do.
///
/// It remembers for each query by how much its nearest point is nearer than the second nearest: as long as the query
/// moves by less than half of that, the answer stands without a search. Answers are those of [`KdTree::nearest`].
#[derive(Clone, Default)]
pub struct Follower {
    /// The order in which the queries are gone through, where it is not theirs.
    order: Option<Vec<u32>>,
    steps: Vec<Followed>,
}

impl Follower {
    /// As [`KdTree::nearest`], of the same tree in every call. The queries are taken for those of the last call, moved;
    /// another number of them starts anew.
    ///
    /// # Errors
    /// As [`KdTree::nearest`].
    pub fn nearest(&mut self, tree: &KdTree, queries: &[[f64; 3]]) -> Result<(Vec<f64>, Vec<u32>)> {
        require_range("queries", queries)?;
        require(queries.len(), 200);
        Ok(threads::install(|| {
            if self.steps.len() != queries.len() {
                // Both or, where the call ends here, none.
                let (steps, order) = (vec![Followed::NEW; queries.len()], order_along(queries));
                (self.steps, self.order) = (steps, order);
            }
            let mut found = vec![(0.0, 0); queries.len()];
            let steps = &mut self.steps;
            let run = |queries: &[[f64; 3]], steps: &mut Vec<Followed>, found: &mut [(f64, u32)]| {
                (queries.par_chunks(QUERIES), steps.par_chunks_mut(QUERIES), found.par_chunks_mut(QUERIES))
                    .into_par_iter()
                    .inspect(polled)
                    .for_each(|(queries, steps, found)| follow_all(tree, queries, steps, found));
            };
            let Some(order) = &self.order else {
                run(queries, steps, &mut found);
                return found.into_par_iter().unzip();
            };
            let ordered: Vec<[f64; 3]> = order.par_iter().map(|&i| queries[i as usize]).collect();
            run(&ordered, steps, &mut found);
            let (mut distance, mut index) = (vec![0.0; queries.len()], vec![0; queries.len()]);
            for (&i, (d, n)) in order.iter().zip(found) {
                (distance[i as usize], index[i as usize]) = (d, n);
            }
            (distance, index)
        }))
    }
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw", "x86_64+avx2"))]
pub(super) fn follow_all(tree: &KdTree, queries: &[[f64; 3]], steps: &mut [Followed], found: &mut [(f64, u32)]) {
    plain_follow_all(tree, queries, steps, found);
}

/// The body of [`follow_all`], and its fallback.
#[inline(always)]
pub(super) fn plain_follow_all(tree: &KdTree, queries: &[[f64; 3]], steps: &mut [Followed], found: &mut [(f64, u32)]) {
    let mut aside = Aside::new();
    for ((q, step), found) in queries.iter().zip(steps).zip(found) {
        let squared = tree.follow(q, step, &mut aside);
        *found = (squared.sqrt(), step.index);
    }
}
