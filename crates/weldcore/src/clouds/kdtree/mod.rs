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

mod along;
mod boxes;
mod follow;
mod leaf;
mod queries;
mod sought;
mod tree;

pub(crate) use along::{for_chunks, order_along};
pub(crate) use boxes::{Aside, BoxTree, Extent, Item, Visit, WIDTH, at_most, max, min, order};
pub use follow::Follower;
pub use queries::Within;
pub(crate) use sought::Nearby;
pub(crate) use tree::{Followed, require_range};
pub use tree::{KdTree, LARGEST_COORDINATE};

#[cfg(test)]
mod tests;
