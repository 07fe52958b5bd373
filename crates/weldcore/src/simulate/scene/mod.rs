//! Welds as they come: a height field `r(angle, z) = R + f` over a pipe, made of parts that real pipes have.
//!
//! Frame: z along the pipe from the reference wall to the other wall, the seam near z = 0, angles from x about z. Each
//! wall has its own radius, axis, ovality, random unevenness, weld shrinkage, machining (taper, counterbore), flare,
//! dents and coats; between the two toes stands a cap on the chord from one wall's edge to the other's. Nothing here is
//! taken from what the measuring side assumes of a weld. The truth is read off the same surface that the rays meet.

mod cast;
mod description;
mod field;
mod surface;

pub use cast::{Cast, GRAZING, Seen, Status};
pub use description::{Cap, Counterbore, Dent, Flare, Harmonic, Scene, SceneWall, SecondSeam, Spatter, Strip, Taper};
pub use field::{Unevenness, Wander};
pub use surface::{Edges, WeldPart, WeldSurface};

#[cfg(test)]
mod tests;
