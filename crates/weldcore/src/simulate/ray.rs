//! Rays, and where they enter what they meet.

use crate::ground::transform::{Transform, Vec3};

/// A half line `origin + t * direction`, t > 0. The direction need not be a unit vector.
#[derive(Debug, Clone, Copy)]
pub struct Ray {
    /// Where it starts.
    pub origin: Vec3,
    /// Where it goes.
    pub direction: Vec3,
}

impl Ray {
    /// The point at `t`.
    #[inline]
    pub fn at(&self, t: f64) -> Vec3 {
        self.origin + self.direction * t
    }

    /// The same ray seen from another frame.
    #[inline]
    pub fn seen_from(&self, other_from_this: &Transform) -> Self {
        Self { origin: other_from_this.apply(&self.origin), direction: other_from_this.rotation * self.direction }
    }

    /// Where it goes into and out of the cylinder of that radius about z.
    #[inline]
    pub fn through(&self, radius: f64) -> Option<(f64, f64)> {
        let (o, d) = (&self.origin, &self.direction);
        let (a, b) = (d.x * d.x + d.y * d.y, o.x * d.x + o.y * d.y);
        let disc = b * b - a * (o.x * o.x + o.y * o.y - radius * radius);
        (disc > 0.0 && a > 0.0).then(|| ((-b - disc.sqrt()) / a, (-b + disc.sqrt()) / a))
    }
}

/// The first point of a shape on a ray.
#[derive(Debug, Clone, Copy)]
pub struct Hit {
    /// Ray parameter.
    pub t: f64,
    /// Outward unit normal, in the shape's frame.
    pub normal: Vec3,
    /// Added to the body's label: which part of the shape.
    pub part: u8,
}

/// The smaller root of `a t² + 2 b t + c = 0`, where there is one: the way into a convex body.
#[inline]
pub(super) fn entry(a: f64, b: f64, c: f64) -> Option<f64> {
    let disc = b * b - a * c;
    if !(disc >= 0.0 && a > 0.0) {
        return None;
    }
    // Of the two forms the one without cancellation.
    let root = disc.sqrt();
    Some(if b < 0.0 { c / (root - b) } else { (-b - root) / a })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn entry_is_the_smaller_root(first in -100.0..100.0f64, gap in 0.0..100.0f64, a in 0.1..10.0f64) {
            // a (t - first)(t - second) = a t² + 2 b t + c
            let second = first + gap;
            let (b, c) = (-0.5 * a * (first + second), a * first * second);
            if let Some(t) = entry(a, b, c) {
                prop_assert!((t - first).abs() < 1e-5 * (1.0 + gap));
            } else {
                prop_assert!(gap < 1e-4);
            }
        }
    }
}
