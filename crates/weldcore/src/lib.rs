//! The algorithms of weldscan: from fringe images to the step of a weld.
//!
//! # Conventions
//! - **Units**: millimetres, radians, pixels. A scalar's name ends in its unit (`radius_mm`, `sigma_px`).
//! - **Frames**: a transform is named `a_from_b` and maps coordinates in `b` to coordinates in `a`, so that
//!   `base_from_flange * flange_from_scanner` cancels by eye. The scanner's frame is its camera's, as OpenCV has it:
//!   x right, y down, z forward; the centre of the first pixel is (0, 0).
//! - **Clouds** are `&[[f64; 3]]`; a pixel without a point holds NaN. Images are row-major.
//! - **Precision**: geometry is `f64` and is centred before any solve; modulation, background and sigma are `f32`.
//! - **Determinism**: the same input gives the same bits on any number of threads. Work is cut into chunks of fixed
//!   size, partial sums are added in chunk order, ties go to the lowest index (see [`threads`]).
//! - **Errors**: one enum, [`Error`]. Nothing here panics on any input; a call may be ended by unwinding (see [`stop`]).
//!
//! # Rooms
//! | module | what is in it |
//! |---|---|
//! | [`phase`] | fringe images to wrapped phase, modulation, background, noise |
//! | [`unwrap`] | wrapped phase to absolute phase: temporal, Gray, spatial |
//! | [`scanner`] | camera and projector with their lenses |
//! | [`triangulate`] | phase to points; the reference-plane model of the paper |
//! | [`transform`] | rigid transforms and their closed-form fit |
//! | [`fit`] | plane, sphere, cylinder by orthogonal distance, with covariance; finding spheres in a cloud |
//! | [`kdtree`] | exact nearest neighbours |
//! | [`normals`] | surface normals from the pixel grid and from a bare cloud |
//! | [`icp`] | iterative closest point |
//! | [`distance`] | signed distance to clouds, meshes and analytic surfaces |
//! | [`mesh`] | triangle meshes |
//! | [`segment`] | reference wall, other wall and bead |
//! | [`seam_fates`] | what became of every pixel, bin by bin along the seam |
//! | [`sections`] | cap, toes, the surfaces beside them and the undisturbed walls, station by station |
//! | [`place`] | the shots of a part joined into one cloud in base |
//! | [`step`] | the step around the seam and its uncertainty |
//! | [`threads`] | the pools of threads, and loops whose bits do not depend on them |
//! | [`stop`] | ending a long call on request, or for want of memory |
//! | [`memory`] | large results without the cost of fresh memory |
//! | [`image`] | grey PNG files, read strictly |
//! | [`simulate`] | ray-cast fringe images of analytic scenes |

pub mod distance;
pub mod error;
pub mod fit;
pub mod icp;
pub mod image;
pub mod kdtree;
pub mod memory;
pub mod mesh;
pub mod normals;
pub mod phase;
pub mod place;
pub mod scanner;
pub mod seam_fates;
pub mod sections;
pub mod segment;
pub mod simulate;
mod statistics;
pub mod step;
pub mod stop;
pub mod threads;
pub mod transform;
pub mod triangulate;
pub mod unwrap;

#[cfg(feature = "python")]
mod python;

pub use error::{Error, Result};

/// A point or a direction, in the frame that the context names.
pub type Vec3 = nalgebra::Vector3<f64>;
