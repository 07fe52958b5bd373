//! The weld: its walls and cap, the step around the seam, and what became of every pixel.

pub mod agreement;
mod coarse;
mod kriging;
mod label;
pub mod paper;
pub mod place;
mod seam;
pub mod seam_fates;
pub mod sections;
pub mod segment;
pub mod step;
pub mod whitening;

pub use coarse::Nominal;
pub use label::{Fate, Label};
pub use seam::{Course, Seam, Unrolled};
