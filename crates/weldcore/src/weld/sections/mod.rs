//! Cross-sections of a weld, station by station along the seam: its cap, both toes, the surfaces right beside them, and the
//! undisturbed walls further out.
//!
//! 1. The unrolled view becomes cells (`grid`): stations of 4 mm by bins of 0.2 to 0.8 mm, each with its median.
//! 2. The cap is found as a cap (`cap`): raised (or hollow), one-humped, between smooth surfaces; or flush, as a jump. All
//!    stations together give the seam's course.
//! 3. Each toe is where two free parabolas meet at best, with the range that is as plausible (`toes`).
//! 4. The surface right beside each toe is read as a gauge reads it (`edges`), along the bisector of both walls (`direction`):
//!    the **edge step**.
//! 5. The undisturbed walls are grown inward from the edges of the view (`walls`), with what a weld draws them in.
//!
//! What lies between a toe and its undisturbed wall is a *transition*: a taper, a counterbore, a flare, a dent, the edge of a
//! coat. Nothing is left out because it is inconvenient: heights are not gated, and what fits none of these is a doubt.

mod cap;
mod direction;
mod doubts;
mod edges;
mod foot;
mod grid;
mod local;
mod profile;
mod read;
mod station;
mod toes;
mod view;
mod walls;

pub use cap::widest_cap_mm;
pub(crate) use grid::Grid;
pub use station::{Doubt, Edge, Kind, Station};
#[cfg(feature = "python")]
pub(crate) use walls::WallRun;
pub(crate) use walls::{ShellTable, TOLERANCE_MM, shell_term};

use super::seam::{Course, Unrolled};
use crate::error::{Error, Result};
use crate::ground::robust::median;
use view::View;

/// All stations of a view.
#[derive(Debug, Clone)]
pub struct Sections {
    pub(crate) grid: Grid,
    /// In order along the seam.
    pub stations: Vec<Station>,
    /// Length of a station along the seam.
    pub station_mm: f64,
    /// What makes the weld doubtful.
    pub doubts: Vec<Doubt>,
    /// Median distance of the toes.
    pub cap_width_mm: f64,
    /// Median height of the cap.
    pub cap_height_mm: f64,
    /// Noise of one point across the wall, one sigma.
    pub noise_mm: f64,
}

impl Sections {
    /// Of a view that is not examined: no stations.
    pub(super) fn unexamined(unrolled: &Unrolled, course: Course, near_mm: f64) -> Result<Self> {
        let grid = Grid::of(unrolled, course, near_mm)?;
        let (station_mm, noise_mm) = (grid.station_mm, grid.noise_mm);
        let (stations, doubts) = (Vec::new(), Vec::new());
        Ok(Self { grid, stations, station_mm, doubts, cap_width_mm: f64::NAN, cap_height_mm: f64::NAN, noise_mm })
    }
}

/// Examines an unrolled view of a seam between walls of `thickness_mm`; `near_mm` is how far from the nominal part points are its
/// own beyond doubt.
///
/// # Errors
/// [`Error::TooFew`] and [`Error::Degenerate`] where there is next to nothing; [`Error::NotFound`] where no weld, or only one
/// wall, is in view.
pub fn examine(unrolled: &Unrolled, course: Course, thickness_mm: f64, near_mm: f64) -> Result<Sections> {
    let grid = Grid::of(unrolled, course, near_mm)?;
    let view = View::of(&grid, thickness_mm);
    let found = view.weld()?;
    let stations = view.stations(&found);
    view.only_one_wall(&stations)?;
    let doubts = view.doubts(&found, &stations);
    let mut widths: Vec<f64> = stations.iter().filter_map(|s| s.toes_mm.map(|t| t[1] - t[0])).collect();
    let mut heights: Vec<f64> = stations.iter().filter(|s| s.toes_mm.is_some()).map(|s| s.height_mm).collect();
    if widths.is_empty() {
        return Err(Error::NotFound { what: "weld", reason: "no station shows both toes".into() });
    }
    Ok(Sections {
        stations,
        station_mm: grid.station_mm,
        doubts,
        cap_width_mm: median(&mut widths),
        cap_height_mm: median(&mut heights),
        noise_mm: grid.noise_mm,
        grid,
    })
}
