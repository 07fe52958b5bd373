//! What searches look for: the nearest point, the two nearest, the k nearest, all within a radius.

use super::boxes::{WIDTH, min};
use crate::ground::memory::require;
use crate::ground::stop::poll;

/// More neighbours than this take their time to be put in order.
const MANY: usize = 4096;
/// No neighbour yet: every real one is nearer.
pub(super) const FAR: f64 = f64::MAX;
/// Some units in the last place, relative: far more than a distance is off by.
pub(super) const ROUNDING: f64 = 64.0 * f64::EPSILON;

/// What a search looks for.
pub(super) trait Sought {
    /// Points further than this (squared) are of no interest; points exactly as far may be.
    fn bound(&self) -> f64;
    fn offer(&mut self, squared: f64, index: u32, place: u32);
}

/// The nearest.
#[derive(Clone, Copy)]
pub(super) struct Nearest {
    pub(super) squared: f64,
    pub(super) index: u32,
}

impl Sought for Nearest {
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
pub(super) struct NearestTwo {
    pub(super) squared: f64,
    pub(super) second: f64,
    pub(super) index: u32,
    pub(super) place: u32,
}

impl Sought for NearestTwo {
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
    pub(super) k: usize,
    pub(super) bound: f64,
    /// Squared distance, index, place.
    pub(super) candidates: Vec<(f64, u32, u32)>,
    pub(super) places: Vec<u32>,
    /// The last query and the distance of its `k`-th neighbour.
    pub(super) last: Option<([f64; 3], f64)>,
}

impl Nearby {
    pub(crate) fn new(k: usize) -> Self {
        Self { k, bound: FAR, candidates: Vec::new(), places: Vec::new(), last: None }
    }

    /// What the last search found.
    pub(crate) fn places(&self) -> &[u32] {
        &self.places
    }

    pub(super) fn start(&mut self, q: &[f64; 3]) {
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

    pub(super) fn finish(&mut self, q: &[f64; 3]) {
        self.thin();
        self.places.clear();
        self.places.extend(self.candidates.iter().map(|c| c.2));
        self.last = Some((*q, self.bound.sqrt()));
    }
}

impl Sought for Nearby {
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

/// The `k` nearest, ascending.
pub(super) struct NearestK<'a> {
    pub(super) squared: &'a mut [f64],
    pub(super) index: &'a mut [u32],
}

impl Sought for NearestK<'_> {
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
pub(super) struct WithinRadius {
    pub(super) bound: f64,
    pub(super) r: f64,
    pub(super) all: Vec<(f64, u32)>,
}

impl Sought for WithinRadius {
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

#[inline(always)]
pub(super) fn squared_distance(p: &[f64; 3], q: &[f64; 3]) -> f64 {
    let (x, y, z) = (p[0] - q[0], p[1] - q[1], p[2] - q[2]);
    (x * x + y * y) + z * z
}
