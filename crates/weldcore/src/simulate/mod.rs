//! Fringe images of analytic scenes by ray casting, and the truth that belongs to them.
//!
//! Each camera pixel's ray (lens undone) is cut with the bodies of the scene in closed form, except for what has none
//! (ovality, waviness, the bead: Newton and regula falsi to a hundredth of a nanometre). From the hit a second ray goes to the
//! projector: blocked, turned away or outside the projector's image, it is in shadow; else the projector's lens gives
//! the exact place (column, row) whose light falls there. All frames of a shot are shaded from this one pass.
//!
//! What a frame shows: the pattern `(0.5 + 0.5 cos(2π (periods (u + 0.5)/width - i/steps)))^gamma`, softened by the
//! projector's square pixels and its blur, on a Lambert surface with a Blinn-Phong lobe, falling off with the square of
//! the distance; plus room light; times the exposure; plus shot and read noise, clipped and quantised. Pixels on an
//! edge average four rays. There is no light from body to body.
//!
//! Random numbers are a hash of seed, frame and pixel: the same bits in any order and on any number of threads.

mod photometry;
mod ray;
mod render;
pub mod scene;
mod shapes;
mod shot;
mod view;
mod weld;

pub use photometry::Photometry;
pub use ray::{Hit, Ray};
pub use render::{Fringes, simulate};
pub use shapes::{Body, Finish, Shape};
pub use shot::{Frames, Sample, SimulatedShot};
pub use weld::{Bead, Wall, Weld};
