//! The tree itself: how it is built, and how a search goes through it.

use rayon::prelude::*;

use super::boxes::{Aside, BoxTree, Item, Visit, WIDTH, at_most, order};
use super::leaf::Leaf;
use super::sought::{FAR, Nearby, NearestTwo, ROUNDING, Sought, squared_distance};
use crate::error::{Error, Result, require_count, require_finite};
use crate::ground::memory::require;
use crate::ground::stop::polled;
use crate::ground::threads;

/// Coordinates beyond this would overflow when squared.
pub const LARGEST_COORDINATE: f64 = 1e150;
/// Not a place.
const NOWHERE: u32 = u32::MAX;

/// A k-d tree over a cloud. It keeps its own copy of the points.
#[derive(Clone)]
pub struct KdTree {
    pub(super) len: usize,
    leaves: Vec<Leaf>,
    /// Which point each place of a leaf holds.
    indices: Vec<[u32; WIDTH]>,
    pub(super) boxes: BoxTree,
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

    /// The point in a place of the tree's own order, and its index.
    #[inline(always)]
    pub(crate) fn in_place(&self, place: u32) -> ([f64; 3], u32) {
        let (leaf, i) = (place as usize / WIDTH, place as usize % WIDTH);
        (self.leaves[leaf].0.map(|row| row[i]), self.indices[leaf][i])
    }

    /// Brings `step` up to date: its nearest point to `q`; the squared distance is returned. A query that has moved by less
    /// than half of the lead of its nearest point over the second nearest needs no search, and does not touch the tree.
    #[inline(always)]
    pub(crate) fn follow(&self, q: &[f64; 3], step: &mut Followed, aside: &mut Aside) -> f64 {
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
        *step = Followed { at: *q, lead, point, index, place: found.place };
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
    pub(super) fn search(&self, q: &[f64; 3], aside: &mut Aside, found: &mut impl Sought) {
        self.boxes.search(q, aside, &mut Leaves { tree: self, q, found });
    }

    #[inline(always)]
    pub(super) fn offer_leaf(&self, leaf: usize, q: &[f64; 3], found: &mut impl Sought) {
        let distances = self.leaves[leaf].squared_distances(q);
        let mut near = at_most(&distances, found.bound());
        while near != 0 {
            let place = near.trailing_zeros() as usize & (WIDTH - 1);
            near &= near - 1;
            found.offer(distances[place], self.indices[leaf][place], (leaf * WIDTH + place) as u32);
        }
    }
}

impl std::fmt::Debug for KdTree {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "KdTree({} points)", self.len)
    }
}

/// What is known of a query that moves a little at a time.
#[derive(Clone, Copy)]
pub(crate) struct Followed {
    /// Where it was when it was last searched.
    pub(super) at: [f64; 3],
    /// How much nearer its nearest point was than the second nearest, mm.
    pub(super) lead: f64,
    /// Its nearest point.
    pub(crate) point: [f64; 3],
    pub(crate) index: u32,
    pub(super) place: u32,
}

impl Followed {
    /// Of a query that was never searched.
    pub(crate) const NEW: Self = Self { at: [0.0; 3], lead: 0.0, point: [0.0; 3], index: u32::MAX, place: NOWHERE };
}

/// Looks for points in the leaves.
struct Leaves<'a, F> {
    tree: &'a KdTree,
    q: &'a [f64; 3],
    found: &'a mut F,
}

impl<F: Sought> Visit for Leaves<'_, F> {
    #[inline(always)]
    fn bound(&self) -> f64 {
        self.found.bound()
    }

    #[inline(always)]
    fn visit(&mut self, leaf: usize) {
        self.tree.offer_leaf(leaf, self.q, self.found);
    }
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
