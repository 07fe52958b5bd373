//! Fringe images to the projector column that lights each pixel.
//!
//! [`decode_shot`] does all of it for one axis of one shot; [`decode_phase`] is the N-step phase alone, and
//! [`unwrap_temporal`], [`unwrap_spatial`] and [`absolute_from_gray`] make wrapped phases absolute.

// Several tiles run in step through the kernels: there an index is plainer than a tower of zips.
#![allow(clippy::needless_range_loop)]

mod decode;
mod gray;
mod jumps;
mod kernel;
mod noise;
mod phase_error;
mod phase_map;
mod quality;
mod redundancy;
mod response;
mod saturation;
mod shot;
mod spatial;
mod temporal;
mod wave;
mod wrapped;

pub use decode::{Compensation, DecodeOptions, decode_shot};
pub use gray::{GrayImages, absolute_from_gray, decode_gray};
pub use kernel::Fuse;
pub use noise::{CameraNoise, NoiseSource};
pub use phase_error::{ErrorSource, PhaseError, TERMS, error_of_harmonics, harmonics_of_gamma};
pub use phase_map::{PhaseMap, REASONS, Reason};
pub use quality::{Quality, quality};
pub use redundancy::disagreement::Disagreement;
pub use response::seen_in_phase;
pub use saturation::{Saturation, saturation};
pub use shot::{FringeSet, Shot};
pub use spatial::unwrap_spatial;
pub use temporal::{Link, Plan, Signal, unwrap_temporal};
pub use wave::Level;
pub use wrapped::{WrappedPhase, decode_phase};
