//! Plane, sphere and cylinder: one type each with distance, foot, fit by orthogonal distance and covariance.
//!
//! | module | what is in it |
//! |---|---|
//! | [`plane`], [`sphere`], [`cylinder`] | the surface, `fit` and, from a start that is near, `refine` |
//! | [`least_squares`] | [`Fit`]: a surface with its covariance; [`PointNoise`]: weights and sigma; the minimisation itself |
//! | [`robust`] | the same fits among outliers |
//! | [`find_spheres`] | spheres of a known size in a raw cloud |

pub mod cylinder;
pub mod find_spheres;
mod foot;
pub mod least_squares;
pub mod plane;
pub mod robust;
pub mod sphere;
mod surface;

pub use cylinder::Cylinder;
pub use foot::Foot;
pub use least_squares::{Fit, PointNoise};
pub use plane::Plane;
pub use sphere::Sphere;
pub use surface::Surface;

#[cfg(test)]
mod tests;
