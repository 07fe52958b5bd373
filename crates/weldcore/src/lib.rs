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
//!   size, partial sums are added in chunk order, ties go to the lowest index (see [`threads`](ground::threads)).
//! - **Errors**: one enum, [`Error`]. Nothing here panics on any input; a call may be ended by unwinding (see [`stop`](ground::stop)).
//!
//! # Rooms
//! Each may use those above it; `tests/rooms.rs` sees to that, and that no two files need each other.
//!
//! | module | what is in it |
//! |---|---|
//! | [`ground`] | [`threads`](ground::threads) whose number changes no bit, [`stop`](ground::stop)ping a long call, [`memory`](ground::memory), [`image`](ground::image)s, [`transform`](ground::transform)s, [`robust`](ground::robust) statistics |
//! | [`fringes`] | fringe images to wrapped and absolute phase: [`decode_shot`](fringes::decode_shot), [`decode_phase`](fringes::decode_phase), [`unwrap_temporal`](fringes::unwrap_temporal), [`unwrap_spatial`](fringes::unwrap_spatial), [`decode_gray`](fringes::decode_gray), the [`quality`](fringes::quality()) of captures |
//! | [`surfaces`] | [`plane`](surfaces::plane), [`sphere`](surfaces::sphere), [`cylinder`](surfaces::cylinder): distance, foot, fit by orthogonal distance with covariance, [`robust`](surfaces::robust) fits; [`find_spheres`](surfaces::find_spheres) in a cloud |
//! | [`scanner`] | camera and projector with their [`lens`](scanner::lens)es; phase to points ([`triangulate`](scanner::triangulate)); the pixels of [`sphere_caps`](scanner::sphere_caps); the [`reference_plane`](scanner::reference_plane) model of the paper |
//! | [`clouds`] | exact nearest neighbours ([`kdtree`](clouds::kdtree)), [`normals`](clouds::normals), triangle [`mesh`](clouds::mesh)es, signed [`distance`](clouds::distance), [`quadric`](clouds::quadric)s through patches, iterative closest point ([`icp`](clouds::icp)) |
//! | [`weld`] | [`segment`](weld::segment): walls and cap of a shot; [`sections`](weld::sections): toes and doubts, station by station; [`step`](weld::step) around the seam and its uncertainty; [`place`](weld::place): the shots of a part in base; [`agreement`](weld::agreement) of shots; [`paper`](weld::paper): the paper's own method; [`seam_fates`](weld::seam_fates): what became of every pixel |
//! | [`simulate`] | ray-cast fringe images of analytic scenes and welds, with the truth |

pub mod clouds;
pub mod error;
pub mod fringes;
pub mod ground;
pub mod scanner;
pub mod simulate;
pub mod surfaces;
pub mod weld;

#[cfg(feature = "python")]
mod python;

pub use error::{Error, Result};
pub use ground::transform::Vec3;
