//! Exact nearest neighbours among points in space.
//!
//! The tree splits at medians along the widest side, and stores three binary splits as one node of eight children, so
//! that the boxes of a node, and the points of a leaf, are each measured with a handful of vector instructions. Leaves
//! and nodes lie in order and need no pointers: the children of node `i` are `8 i .. 8 i + 8` of the level below.
//!
//! **Exact** means: the answer is that of a plain loop computing `(x² + y²) + z²` of the differences in `f64`, bit for
//! bit, and of equally distant points the lowest index. Pruning is safe in floating point, because subtraction,
//! multiplication and addition round monotonically: no point of a box comes out nearer than its box.
//!
//! **Memory** beyond the caller's points: 28 bytes a point in leaves, 7 in boxes, 35 in all.

use multiversion::multiversion;
use rayon::prelude::*;

use crate::error::{Error, Result, require_count, require_finite};
use crate::memory::require;
use crate::stop::{poll, polled};
use crate::threads;

mod along;
mod boxes;

pub(crate) use along::{for_chunks, order_along};
pub(crate) use boxes::{Aside, BoxTree, Extent, Item, Visit, WIDTH, at_most, max, min, order};

/// Queries handed to a thread at a time.
const QUERIES: usize = 1024;
/// Coordinates beyond this would overflow when squared.
pub const LARGEST_COORDINATE: f64 = 1e150;
/// More neighbours than this take their time to be put in order.
const MANY: usize = 4096;
/// No neighbour yet: every real one is nearer.
const FAR: f64 = f64::MAX;
/// Not a place.
const NOWHERE: u32 = u32::MAX;
/// Some units in the last place, relative: far more than a distance is off by.
const ROUNDING: f64 = 64.0 * f64::EPSILON;

/// Eight points, coordinate by coordinate.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
struct Leaf([[f64; WIDTH]; 3]);

/// A k-d tree over a cloud. It keeps its own copy of the points.
#[derive(Clone)]
pub struct KdTree {
    len: usize,
    leaves: Vec<Leaf>,
    /// Which point each place of a leaf holds.
    indices: Vec<[u32; WIDTH]>,
    boxes: BoxTree,
}

impl KdTree {
    /// Builds the tree: `n log n` time on all threads, the same tree on any number of them.
    ///
    /// # Errors
    /// [`Error::TooFew`] for no points, [`Error::NonFinite`], and [`Error::OutOfRange`] for coordinates beyond
    /// [`LARGEST_COORDINATE`] or about 2³² points and more.
    pub fn new(points: &[[f64; 3]]) -> Result<Self> {
        let what = "points";
        require_count(what, 1, points.len())?;
        require_range(what, points)?;
        if u32::try_from(points.len() + WIDTH).is_err() {
            let expected = "fewer than 2^32 points".into();
            return Err(Error::OutOfRange { what, expected, value: points.len().to_string() });
        }
        require(points.len(), 80);
        Ok(threads::install(|| Self::build(points)))
    }

    fn build(points: &[[f64; 3]]) -> Self {
        let mut items: Vec<Item> = points.par_iter().enumerate().map(|(i, &at)| Item { at, index: i as u32 }).collect();
        order(&mut items);
        let blank = (Leaf([[f64::INFINITY; WIDTH]; 3]), [u32::MAX; WIDTH]);
        let (leaves, indices): (Vec<Leaf>, Vec<[u32; WIDTH]>) = items
            .par_chunks(WIDTH)
            .inspect(polled)
            .map(|chunk| {
                let (mut leaf, mut index) = blank;
                for (place, item) in chunk.iter().enumerate() {
                    for (axis, row) in leaf.0.iter_mut().enumerate() {
                        row[place] = item.at[axis];
                    }
                    index[place] = item.index;
                }
                (leaf, index)
            })
            .unzip();
        drop(items);
        let boxes = BoxTree::new(&leaves, Leaf::extent);
        Self { len: points.len(), leaves, indices, boxes }
    }

    /// How many points are in the tree.
    pub fn len(&self) -> usize {
        self.len
    }

    /// The points, as they were given.
    pub fn points(&self) -> Vec<[f64; 3]> {
        require(self.len, 24);
        let mut points = vec![[0.0; 3]; self.len];
        for place in 0..self.places() as u32 {
            let (point, index) = self.in_place(place);
            if let Some(to) = points.get_mut(index as usize) {
                *to = point;
            }
        }
        points
    }

    /// Whether the tree holds no point; it always holds one.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// What the tree takes, in bytes.
    pub fn bytes(&self) -> usize {
        size_of_val(&*self.leaves) + size_of_val(&*self.indices) + self.boxes.bytes()
    }

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

    /// The point in a place of the tree's own order, and its index.
    #[inline(always)]
    pub(crate) fn in_place(&self, place: u32) -> ([f64; 3], u32) {
        let (leaf, i) = (place as usize / WIDTH, place as usize % WIDTH);
        (self.leaves[leaf].0.map(|row| row[i]), self.indices[leaf][i])
    }

    /// Brings `step` up to date: its nearest point to `q`; the squared distance is returned. A query that has moved by less
    /// than half of the lead of its nearest point over the second nearest needs no search, and does not touch the tree.
    #[inline(always)]
    pub(crate) fn follow(&self, q: &[f64; 3], step: &mut Step, aside: &mut Aside) -> f64 {
        let mut found = NearestTwo { squared: FAR, second: FAR, index: u32::MAX, place: 0 };
        if step.place == NOWHERE {
            self.offer_leaf(self.boxes.dive(q), q, &mut found);
        } else {
            let squared = squared_distance(&step.point, q);
            if 2.0 * squared_distance(&step.at, q).sqrt() < step.lead {
                return squared;
            }
            found.offer(squared, step.index, step.place);
        }
        self.search(q, aside, &mut found);
        let (first, second) = (found.squared.sqrt(), found.second.sqrt());
        // Less what rounding could make of the distances compared.
        let lead = second - first - ROUNDING * second;
        let (point, index) = self.in_place(found.place);
        *step = Step { at: *q, lead, point, index, place: found.place };
        found.squared
    }

    /// How many places the tree has: its points, and blanks in the last leaf with an index beyond the points.
    pub(crate) fn places(&self) -> usize {
        self.leaves.len() * WIDTH
    }

    /// The places of the points nearest to `q`, in no order; of equally distant points those of the lowest index.
    /// Starts from what `nearby` knows of the last query: the points that were near that are not far from this one.
    #[inline(always)]
    pub(crate) fn nearby(&self, q: &[f64; 3], aside: &mut Aside, nearby: &mut Nearby) {
        nearby.start(q);
        self.search(q, aside, nearby);
        nearby.finish(q);
    }

    /// Offers every point that may be nearer than `found.bound()`.
    #[inline(always)]
    fn search(&self, q: &[f64; 3], aside: &mut Aside, found: &mut impl Found) {
        self.boxes.search(q, aside, &mut Leaves { tree: self, q, found });
    }

    #[inline(always)]
    fn offer_leaf(&self, leaf: usize, q: &[f64; 3], found: &mut impl Found) {
        let distances = self.leaves[leaf].squared_distances(q);
        let mut near = at_most(&distances, found.bound());
        while near != 0 {
            let place = near.trailing_zeros() as usize & (WIDTH - 1);
            near &= near - 1;
            found.offer(distances[place], self.indices[leaf][place], (leaf * WIDTH + place) as u32);
        }
    }
}

/// Nearest neighbours of queries that move a little from call to call, as the points of an iteration do.
///
/// It remembers for each query by how much its nearest point is nearer than the second nearest: as long as the query
/// moves by less than half of that, the answer stands without a search. Answers are those of [`KdTree::nearest`].
#[derive(Clone, Default)]
pub struct Follower {
    /// The order in which the queries are gone through, where it is not theirs.
    order: Option<Vec<u32>>,
    steps: Vec<Step>,
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
                let (steps, order) = (vec![Step::NEW; queries.len()], order_along(queries));
                (self.steps, self.order) = (steps, order);
            }
            let mut found = vec![(0.0, 0); queries.len()];
            let steps = &mut self.steps;
            let run = |queries: &[[f64; 3]], steps: &mut Vec<Step>, found: &mut [(f64, u32)]| {
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

impl std::fmt::Debug for KdTree {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "KdTree({} points)", self.len)
    }
}

/// The points within a radius of a query, nearest first.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Within {
    /// Distances, mm, ascending.
    pub distance_mm: Vec<f64>,
    /// Indices of the points.
    pub index: Vec<u32>,
}

/// What a search looks for.
trait Found {
    /// Points further than this (squared) are of no interest; points exactly as far may be.
    fn bound(&self) -> f64;
    fn offer(&mut self, squared: f64, index: u32, place: u32);
}

/// Looks for points in the leaves.
struct Leaves<'a, F> {
    tree: &'a KdTree,
    q: &'a [f64; 3],
    found: &'a mut F,
}

impl<F: Found> Visit for Leaves<'_, F> {
    #[inline(always)]
    fn bound(&self) -> f64 {
        self.found.bound()
    }

    #[inline(always)]
    fn visit(&mut self, leaf: usize) {
        self.tree.offer_leaf(leaf, self.q, self.found);
    }
}

/// The nearest.
#[derive(Clone, Copy)]
struct Nearest {
    squared: f64,
    index: u32,
}

impl Found for Nearest {
    #[inline(always)]
    fn bound(&self) -> f64 {
        self.squared
    }

    #[inline(always)]
    fn offer(&mut self, squared: f64, index: u32, _: u32) {
        if squared < self.squared || (squared == self.squared && index < self.index) {
            (self.squared, self.index) = (squared, index);
        }
    }
}

/// The nearest, and how far the second nearest is.
struct NearestTwo {
    squared: f64,
    second: f64,
    index: u32,
    place: u32,
}

impl Found for NearestTwo {
    #[inline(always)]
    fn bound(&self) -> f64 {
        self.second
    }

    #[inline(always)]
    fn offer(&mut self, squared: f64, index: u32, place: u32) {
        if place == self.place && self.index != u32::MAX {
            return;
        }
        if squared < self.squared || (squared == self.squared && index < self.index) {
            self.second = self.squared;
            (self.squared, self.index, self.place) = (squared, index, place);
        } else if squared < self.second {
            self.second = squared;
        }
    }
}

/// The `k` nearest in no order: candidates are collected, and thinned out when there are many.
pub(crate) struct Nearby {
    k: usize,
    bound: f64,
    /// Squared distance, index, place.
    candidates: Vec<(f64, u32, u32)>,
    places: Vec<u32>,
    /// The last query and the distance of its `k`-th neighbour.
    last: Option<([f64; 3], f64)>,
}

impl Nearby {
    pub(crate) fn new(k: usize) -> Self {
        Self { k, bound: FAR, candidates: Vec::new(), places: Vec::new(), last: None }
    }

    /// What the last search found.
    pub(crate) fn places(&self) -> &[u32] {
        &self.places
    }

    fn start(&mut self, q: &[f64; 3]) {
        self.candidates.clear();
        // The last query's k points are no further from this one than the way between the two and then their distance.
        self.bound = self.last.map_or(FAR, |(p, reach)| {
            let far = (squared_distance(&p, q).sqrt() + reach) * (1.0 + ROUNDING);
            min(far * far, FAR)
        });
    }

    fn thin(&mut self) {
        let by_distance = |a: &(f64, u32, u32), b: &(f64, u32, u32)| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1));
        if self.candidates.len() >= self.k {
            self.candidates.select_nth_unstable_by(self.k - 1, by_distance);
            self.candidates.truncate(self.k);
            self.bound = self.candidates[self.k - 1].0;
        }
    }

    fn finish(&mut self, q: &[f64; 3]) {
        self.thin();
        self.places.clear();
        self.places.extend(self.candidates.iter().map(|c| c.2));
        self.last = Some((*q, self.bound.sqrt()));
    }
}

impl Found for Nearby {
    #[inline(always)]
    fn bound(&self) -> f64 {
        self.bound
    }

    #[inline(always)]
    fn offer(&mut self, squared: f64, index: u32, place: u32) {
        if squared <= self.bound {
            self.candidates.push((squared, index, place));
            if self.candidates.len() >= 2 * self.k + WIDTH {
                self.thin();
            }
        }
    }
}

/// What is known of a query that moves a little at a time.
#[derive(Clone, Copy)]
pub(crate) struct Step {
    /// Where it was when it was last searched.
    at: [f64; 3],
    /// How much nearer its nearest point was than the second nearest, mm.
    lead: f64,
    /// Its nearest point.
    pub(crate) point: [f64; 3],
    pub(crate) index: u32,
    place: u32,
}

impl Step {
    /// Of a query that was never searched.
    pub(crate) const NEW: Self = Self { at: [0.0; 3], lead: 0.0, point: [0.0; 3], index: u32::MAX, place: NOWHERE };
}

/// The `k` nearest, ascending.
struct NearestK<'a> {
    squared: &'a mut [f64],
    index: &'a mut [u32],
}

impl Found for NearestK<'_> {
    #[inline(always)]
    fn bound(&self) -> f64 {
        self.squared[self.squared.len() - 1]
    }

    #[inline(always)]
    fn offer(&mut self, squared: f64, index: u32, _: u32) {
        let mut at = self.squared.len();
        if at > MANY {
            poll();
        }
        while at > 0
            && (squared < self.squared[at - 1] || (squared == self.squared[at - 1] && index < self.index[at - 1]))
        {
            at -= 1;
            if at + 1 < self.squared.len() {
                self.squared[at + 1] = self.squared[at];
                self.index[at + 1] = self.index[at];
            }
        }
        if at < self.squared.len() {
            self.squared[at] = squared;
            self.index[at] = index;
        }
    }
}

/// All within a radius.
struct WithinRadius {
    bound: f64,
    r: f64,
    all: Vec<(f64, u32)>,
}

impl Found for WithinRadius {
    #[inline(always)]
    fn bound(&self) -> f64 {
        self.bound
    }

    #[inline(always)]
    fn offer(&mut self, squared: f64, index: u32, _: u32) {
        let distance = squared.sqrt();
        if distance <= self.r {
            if self.all.len() == self.all.capacity() {
                poll();
                require(2 * self.all.len(), size_of::<(f64, u32)>());
            }
            self.all.push((distance, index));
        }
    }
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw", "x86_64+avx2"))]
fn nearest_of(tree: &KdTree, queries: &[[f64; 3]], found: &mut [Nearest]) {
    plain_nearest_of(tree, queries, found);
}

/// The body of [`nearest_of`], and its fallback.
#[inline(always)]
fn plain_nearest_of(tree: &KdTree, queries: &[[f64; 3]], found: &mut [Nearest]) {
    let mut aside = Aside::new();
    for (q, found) in queries.iter().zip(found) {
        tree.offer_leaf(tree.boxes.dive(q), q, found);
        tree.search(q, &mut aside, found);
    }
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw", "x86_64+avx2"))]
fn signed_of(tree: &KdTree, normals: &[[f64; 3]], queries: &[[f64; 3]], distance: &mut [f64]) {
    plain_signed_of(tree, normals, queries, distance);
}

/// The body of [`signed_of`], and its fallback.
#[inline(always)]
fn plain_signed_of(tree: &KdTree, normals: &[[f64; 3]], queries: &[[f64; 3]], distance: &mut [f64]) {
    let mut aside = Aside::new();
    for (q, distance) in queries.iter().zip(distance) {
        let mut step = Step::NEW;
        let squared = tree.follow(q, &mut step, &mut aside);
        let (p, normal) = (step.point, normals.get(step.index as usize));
        let ahead = normal.map_or(0.0, |n| (0..3).map(|k| n[k] * (q[k] - p[k])).sum::<f64>());
        *distance = if ahead < 0.0 { -squared.sqrt() } else { squared.sqrt() };
    }
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw", "x86_64+avx2"))]
fn follow_all(tree: &KdTree, queries: &[[f64; 3]], steps: &mut [Step], found: &mut [(f64, u32)]) {
    plain_follow_all(tree, queries, steps, found);
}

/// The body of [`follow_all`], and its fallback.
#[inline(always)]
fn plain_follow_all(tree: &KdTree, queries: &[[f64; 3]], steps: &mut [Step], found: &mut [(f64, u32)]) {
    let mut aside = Aside::new();
    for ((q, step), found) in queries.iter().zip(steps).zip(found) {
        let squared = tree.follow(q, step, &mut aside);
        *found = (squared.sqrt(), step.index);
    }
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw", "x86_64+avx2"))]
fn nearest_k_of(tree: &KdTree, queries: &[[f64; 3]], k: usize, distance: &mut [f64], index: &mut [u32]) {
    plain_nearest_k_of(tree, queries, k, distance, index);
}

/// The body of [`nearest_k_of`], and its fallback.
#[inline(always)]
fn plain_nearest_k_of(tree: &KdTree, queries: &[[f64; 3]], k: usize, distance: &mut [f64], index: &mut [u32]) {
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
fn within_of(tree: &KdTree, queries: &[[f64; 3]], r: f64) -> Vec<Within> {
    plain_within_of(tree, queries, r)
}

/// The body of [`within_of`], and its fallback.
#[inline(always)]
fn plain_within_of(tree: &KdTree, queries: &[[f64; 3]], r: f64) -> Vec<Within> {
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

/// Fails where a coordinate is not finite, or too large to be squared.
pub(crate) fn require_range(what: &'static str, points: &[[f64; 3]]) -> Result<()> {
    if points.iter().flatten().all(|c| c.abs() <= LARGEST_COORDINATE) {
        return Ok(());
    }
    require_finite(what, points)?;
    let expected = format!("within ±{LARGEST_COORDINATE:e} in every coordinate");
    Err(Error::OutOfRange { what, expected, value: "a larger one".into() })
}

#[inline(always)]
fn squared_distance(p: &[f64; 3], q: &[f64; 3]) -> f64 {
    let (x, y, z) = (p[0] - q[0], p[1] - q[1], p[2] - q[2]);
    (x * x + y * y) + z * z
}

impl Leaf {
    #[inline(always)]
    fn squared_distances(&self, q: &[f64; 3]) -> [f64; WIDTH] {
        std::array::from_fn(|i| {
            let (x, y, z) = (self.0[0][i] - q[0], self.0[1][i] - q[1], self.0[2][i] - q[2]);
            (x * x + y * y) + z * z
        })
    }

    /// The box around the points, low and high corner; places without a point do not count.
    fn extent(&self) -> Extent {
        let high = |row: [f64; WIDTH]| row.into_iter().filter(|&v| v != f64::INFINITY).fold(f64::NEG_INFINITY, max);
        (self.0.map(|row| row.into_iter().fold(f64::INFINITY, min)), self.0.map(high))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
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
        let (mut fast_steps, mut plain_steps) = (vec![Step::NEW; n], vec![Step::NEW; n]);
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
}
