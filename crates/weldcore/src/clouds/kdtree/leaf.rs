//! Eight points, measured together.

use super::boxes::{Extent, WIDTH, max, min};

/// Eight points, coordinate by coordinate.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub(super) struct Leaf(pub(super) [[f64; WIDTH]; 3]);

impl Leaf {
    #[inline(always)]
    pub(super) fn squared_distances(&self, q: &[f64; 3]) -> [f64; WIDTH] {
        std::array::from_fn(|i| {
            let (x, y, z) = (self.0[0][i] - q[0], self.0[1][i] - q[1], self.0[2][i] - q[2]);
            (x * x + y * y) + z * z
        })
    }

    /// The box around the points, low and high corner; places without a point do not count.
    pub(super) fn extent(&self) -> Extent {
        let high = |row: [f64; WIDTH]| row.into_iter().filter(|&v| v != f64::INFINITY).fold(f64::NEG_INFINITY, max);
        (self.0.map(|row| row.into_iter().fold(f64::INFINITY, min)), self.0.map(high))
    }
}
