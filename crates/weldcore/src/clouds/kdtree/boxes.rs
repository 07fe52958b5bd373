//! A tree of bounding boxes without pointers, eight children a node: what the trees of points and of triangles share.

use rayon::prelude::*;

use crate::ground::stop::poll;

/// Children of a node: one AVX-512 vector, two of AVX2.
pub(crate) const WIDTH: usize = 8;
/// Ranges below this are ordered without handing half of them to another thread.
const SERIAL: usize = 16 * 1024;
/// Levels that 2³² children need, each with at most `WIDTH - 1` put aside.
const DEEPEST: usize = 11 * (WIDTH - 1) + 1;

/// The low and the high corner of a box.
pub(crate) type Extent = ([f64; 3], [f64; 3]);

/// The bounding boxes of eight children; a child that does not exist is infinitely far.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
struct Boxes {
    low: [[f64; WIDTH]; 3],
    high: [[f64; WIDTH]; 3],
}

/// The boxes around a row of children, around eight of those, and so on up to one root.
#[derive(Clone)]
pub(crate) struct BoxTree {
    /// All levels one after the other, from the parents of the children up to the root.
    boxes: Vec<Boxes>,
    /// Where each level starts in `boxes`.
    levels: Vec<usize>,
}

/// What goes through the children in a search.
pub(crate) trait Visit {
    /// Children further than this (squared) are of no interest; those exactly as far may be.
    fn bound(&self) -> f64;
    /// Looks at a child.
    fn visit(&mut self, child: usize);
}

/// Boxes put aside during a search: squared distance, level, node.
pub(crate) struct Aside([(f64, u32, u32); DEEPEST]);

impl Aside {
    pub(crate) fn new() -> Self {
        Self([(0.0, 0, 0); DEEPEST])
    }
}

impl BoxTree {
    /// Over at least one child, in the order of [`order`].
    pub(crate) fn new<T: Sync>(children: &[T], extent: impl Fn(&T) -> Extent + Sync) -> Self {
        let mut boxes: Vec<Boxes> =
            children.par_chunks(WIDTH).map(|eight| Boxes::around(eight.iter().map(&extent))).collect();
        let (mut levels, mut start) = (vec![0], 0);
        while boxes.len() - start > 1 {
            let below = boxes.get(start..).unwrap_or_default();
            let above: Vec<Boxes> = below.chunks(WIDTH).map(|e| Boxes::around(e.iter().map(Boxes::extent))).collect();
            start = boxes.len();
            levels.push(start);
            boxes.extend(above);
        }
        boxes.shrink_to_fit();
        Self { boxes, levels }
    }

    pub(crate) fn bytes(&self) -> usize {
        size_of_val(&*self.boxes)
    }

    /// Visits every child whose box is within `visit.bound()` of `q`, near ones first.
    #[inline(always)]
    pub(crate) fn search(&self, q: &[f64; 3], aside: &mut Aside, visit: &mut impl Visit) {
        let mut depth = 0;
        let (mut level, mut node) = (self.levels.len() - 1, 0);
        loop {
            let near = self.boxes[self.levels[level] + node].squared_distances(q);
            let (first, least) = least(&near);
            if least <= visit.bound() {
                if level == 0 {
                    visit.visit(node * WIDTH + first);
                }
                let mut others = at_most(&near, visit.bound()) & !(1 << first);
                while others != 0 {
                    let child = others.trailing_zeros() as usize & (WIDTH - 1);
                    others &= others - 1;
                    if level > 0 {
                        aside.0[depth] = (near[child], (level - 1) as u32, (node * WIDTH + child) as u32);
                        depth += 1;
                    } else if near[child] <= visit.bound() {
                        visit.visit(node * WIDTH + child);
                    }
                }
                if level > 0 {
                    (level, node) = (level - 1, node * WIDTH + first);
                    continue;
                }
            }
            loop {
                if depth == 0 {
                    return;
                }
                depth -= 1;
                let (distance, l, n) = aside.0[depth];
                if distance <= visit.bound() {
                    (level, node) = (l as usize, n as usize);
                    break;
                }
            }
        }
    }

    /// A first guess without looking back: the child that is reached by nearest boxes.
    #[inline(always)]
    pub(crate) fn dive(&self, q: &[f64; 3]) -> usize {
        let mut node = 0;
        for &start in self.levels.iter().rev() {
            let (first, _) = least(&self.boxes[start + node].squared_distances(q));
            node = node * WIDTH + first;
        }
        node
    }
}

impl Boxes {
    fn around(children: impl Iterator<Item = ([f64; 3], [f64; 3])>) -> Self {
        let mut boxes = Self { low: [[f64::INFINITY; WIDTH]; 3], high: [[f64::NEG_INFINITY; WIDTH]; 3] };
        for (i, (low, high)) in children.enumerate() {
            for axis in 0..3 {
                boxes.low[axis][i] = low[axis];
                boxes.high[axis][i] = high[axis];
            }
        }
        boxes
    }

    #[inline(always)]
    fn squared_distances(&self, q: &[f64; 3]) -> [f64; WIDTH] {
        std::array::from_fn(|i| {
            let outside = |axis: usize| max(max(self.low[axis][i] - q[axis], q[axis] - self.high[axis][i]), 0.0);
            let (x, y, z) = (outside(0), outside(1), outside(2));
            (x * x + y * y) + z * z
        })
    }

    fn extent(&self) -> ([f64; 3], [f64; 3]) {
        (
            self.low.map(|row| row.into_iter().fold(f64::INFINITY, min)),
            self.high.map(|row| row.into_iter().fold(f64::NEG_INFINITY, max)),
        )
    }
}

/// Something on its way into a tree.
#[derive(Clone, Copy)]
pub(crate) struct Item {
    pub(crate) at: [f64; 3],
    pub(crate) index: u32,
}

/// Orders by median splits along the widest side, so that each run of 8, of 64, of 512 ... from the start is compact.
pub(crate) fn order(items: &mut [Item]) {
    let mut reach = WIDTH;
    while reach * WIDTH < items.len() {
        reach *= WIDTH;
    }
    split(items, reach);
}

fn split(items: &mut [Item], mut reach: usize) {
    if items.len() <= WIDTH {
        return;
    }
    while items.len() <= reach {
        reach /= WIDTH;
    }
    let middle = items.len().div_ceil(reach) / 2 * reach;
    match widest(items) {
        0 => select::<0>(items, middle),
        1 => select::<1>(items, middle),
        _ => select::<2>(items, middle),
    }
    let (low, high) = items.split_at_mut(middle);
    if low.len() > SERIAL {
        poll();
        rayon::join(|| split(low, reach), || split(high, reach));
    } else {
        split(low, reach);
        split(high, reach);
    }
}

fn select<const AXIS: usize>(items: &mut [Item], middle: usize) {
    items.select_nth_unstable_by(middle, |a, b| a.at[AXIS].total_cmp(&b.at[AXIS]));
}

fn widest(items: &[Item]) -> usize {
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for item in items {
        for axis in 0..3 {
            low[axis] = min(low[axis], item.at[axis]);
            high[axis] = max(high[axis], item.at[axis]);
        }
    }
    let side = [high[0] - low[0], high[1] - low[1], high[2] - low[2]];
    if side[0] >= side[1] && side[0] >= side[2] {
        0
    } else if side[1] >= side[2] {
        1
    } else {
        2
    }
}

// One vector instruction each, unlike `f64::min` and `max`, which have rules about NaN.
#[inline(always)]
pub(crate) fn min(a: f64, b: f64) -> f64 {
    if a < b { a } else { b }
}

#[inline(always)]
pub(crate) fn max(a: f64, b: f64) -> f64 {
    if a > b { a } else { b }
}

/// The lowest of eight and its place.
#[inline(always)]
fn least(values: &[f64; WIDTH]) -> (usize, f64) {
    let mut least = values[0];
    for &v in values {
        least = min(v, least);
    }
    (at_most(values, least).trailing_zeros() as usize & (WIDTH - 1), least)
}

/// A bit for each of the eight that is not above `bound`.
#[inline(always)]
pub(crate) fn at_most(values: &[f64; WIDTH], bound: f64) -> u32 {
    let mut bits = 0;
    for (i, &v) in values.iter().enumerate() {
        bits |= u32::from(v <= bound) << i;
    }
    bits
}
