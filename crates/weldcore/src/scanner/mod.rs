//! Camera and projector: their lenses, and the points that they see together.

pub mod calibrated_region;
pub mod lens;
pub mod reference_plane;
pub mod sphere_caps;
pub mod triangulate;

pub use lens::{Axis, Lens, Rays, Scanner};
