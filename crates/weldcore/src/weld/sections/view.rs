//! The profiles of a view, and the weld found in them: raised, hollow or flush, and its course.

use rayon::prelude::*;

use super::cap::{self, Candidate, WeldLine, widest_cap_mm};
use super::grid::Grid;
use super::profile::Profile;
use super::station::{Kind, Station};
use super::walls::{ShellTable, TOLERANCE_MM};
use crate::error::{Error, Result};
use crate::ground::robust::median;
use crate::ground::threads;

/// Caps are sought up to this many times the widest that may be: one that is too wide must be found as such.
const SEARCH_WIDTHS: f64 = 1.6;
/// A hollow cap or a flush one is looked for where fewer stations than this show a raised one.
const RAISED_PART: f64 = 0.6;
/// A flush weld shows in at least this part of the stations, by a jump of so many times the scatter beside it.
const FLUSH_PART: f64 = 0.5;
const FLUSH_STRENGTH: f64 = 5.0;
/// The edge of a view.
const EDGE_MM: f64 = 2.0;
/// A wall is read beside the weld where at least this much of it is in view, or as much as the cap is wide.
const LEAST_WALL_MM: f64 = 15.0;
/// Width of the gap that a flush weld is taken for.
pub(super) const FLUSH_GAP_MM: f64 = 1.0;

/// The profiles of a view.
pub(super) struct View<'a> {
    pub(super) grid: &'a Grid,
    /// Median of three stations: for finding. And its mirror image.
    pub(super) smooth: Vec<[Profile; 2]>,
    /// The station alone: for reading.
    pub(super) own: Vec<[Profile; 2]>,
    pub(super) thickness_mm: f64,
    pub(super) shell: ShellTable,
    pub(super) sigma: f64,
    pub(super) widest_mm: f64,
}

/// The weld's course.
pub(super) struct Found {
    pub(super) kind: Kind,
    pub(super) course: WeldLine,
    /// All candidates of each station.
    pub(super) candidates: Vec<Vec<Candidate>>,
    /// Part of the stations with a second jump as strong as a weld's; for a flush one.
    pub(super) second_line: f64,
}

impl<'a> View<'a> {
    pub(super) fn of(grid: &'a Grid, thickness_mm: f64) -> Self {
        let smoothed = grid.smoothed();
        let both = |heights: &[f64]| {
            let profile = Profile::new(grid.start_across, grid.bin_mm, heights.to_vec());
            let mirrored = profile.mirrored();
            [mirrored, profile]
        };
        let rows: Vec<usize> = (0..grid.stations).collect();
        let (smooth, own) = threads::install(|| {
            rows.par_iter().map(|&k| (both(&smoothed[k * grid.bins..(k + 1) * grid.bins]), both(grid.row(k)))).unzip()
        });
        let shell = ShellTable::new(grid.course.shell_mm(thickness_mm));
        Self {
            grid,
            smooth,
            own,
            thickness_mm,
            shell,
            sigma: grid.cell_sigma_mm,
            widest_mm: widest_cap_mm(thickness_mm),
        }
    }

    pub(super) fn along(&self, station: usize) -> f64 {
        self.grid.start_along + (station as f64 + 0.5) * self.grid.station_mm
    }

    pub(super) fn profile(&self, station: usize) -> &Profile {
        &self.smooth[station][1]
    }

    fn candidates(&self, sign: f64) -> Vec<Vec<Candidate>> {
        let search = SEARCH_WIDTHS * self.widest_mm;
        threads::install(|| self.smooth.par_iter().map(|p| cap::candidates(&p[1], search, self.sigma, sign)).collect())
    }

    /// Raised, hollow or flush, and its course.
    pub(super) fn weld(&self) -> Result<Found> {
        let along: Vec<f64> = (0..self.grid.stations).map(|k| self.along(k)).collect();
        // Of the stations that hold points at all.
        let filled = self.own.iter().filter(|p| 2.0 * p[1].count(0, p[1].len()) > 0.3 * p[1].len() as f64).count();
        let part = |course: &Option<WeldLine>| {
            course.as_ref().map_or(0.0, |c| c.chosen.iter().flatten().count() as f64 / filled.max(1) as f64)
        };
        let raised = self.candidates(1.0);
        let raised_course = cap::course(&raised, &along);
        let raised_part = part(&raised_course);
        if raised_part >= RAISED_PART
            && let Some(course) = raised_course
        {
            return Ok(Found { kind: Kind::Raised, course, candidates: raised, second_line: 0.0 });
        }
        let hollow = self.candidates(-1.0);
        let hollow_course = cap::course(&hollow, &along);
        if part(&hollow_course) > raised_part.max(RAISED_PART)
            && let Some(course) = hollow_course
            && course.width() <= self.widest_mm
        {
            return Ok(Found { kind: Kind::Hollow, course, candidates: hollow, second_line: 0.0 });
        }
        if raised_part >= 0.5 * RAISED_PART
            && let Some(course) = raised_course
        {
            // Weak, but there: the doubts will say where it is not.
            return Ok(Found { kind: Kind::Raised, course, candidates: raised, second_line: 0.0 });
        }
        self.flush(&along, filled)
    }

    fn flush(&self, along: &[f64], filled: usize) -> Result<Found> {
        let jumps: Vec<Vec<cap::Jump>> =
            threads::install(|| self.smooth.par_iter().map(|p| cap::jumps(&p[1], self.sigma)).collect());
        let as_candidates: Vec<Vec<Candidate>> = jumps
            .iter()
            .map(|station| {
                let strong = station.iter().filter(|j| j.strength >= FLUSH_STRENGTH);
                strong
                    .map(|j| {
                        let half = 0.5 * FLUSH_GAP_MM;
                        let profile = &self.smooth[0][1];
                        Candidate {
                            from: profile.boundary(j.at - half),
                            to: profile.boundary(j.at + half),
                            toes: [j.at - half, j.at + half],
                            height: 0.0,
                            score: j.strength,
                        }
                    })
                    .collect()
            })
            .collect();
        let course = cap::course(&as_candidates, along);
        let seen = course.as_ref().map_or(0, |c| c.chosen.iter().flatten().count());
        match course {
            Some(course) if seen as f64 >= FLUSH_PART * filled.max(1) as f64 => {
                let second = jumps.iter().filter(|j| j.get(1).is_some_and(|j| j.strength > 12.0)).count();
                let second_line = second as f64 / filled.max(1) as f64;
                Ok(Found { kind: Kind::Flush, course, candidates: as_candidates, second_line })
            }
            _ if self.ends_in_metal() => {
                let reason = "something stands up at the edge of the view: only one wall is in view".into();
                Err(Error::NotFound { what: "weld", reason })
            }
            _ => {
                let reason = format!(
                    "{} of {filled} stations of {:.1} mm show neither a cap nor an edge: no weld is in view",
                    filled.saturating_sub(seen),
                    self.grid.station_mm
                );
                Err(Error::NotFound { what: "weld", reason })
            }
        }
    }

    /// Whether the view ends on a weld: most stations leave the line of their middle at one end.
    fn ends_in_metal(&self) -> bool {
        let leaves = |p: &Profile| {
            let n = p.len();
            let (strip, middle) = (p.in_bins(EDGE_MM), p.line(n / 4, n - n / 4));
            let off = |from: usize, to: usize| {
                p.mean(from, to)
                    .zip(middle)
                    .is_some_and(|((x, h), line)| (h - line.at(x)).abs() > 2.0 * TOLERANCE_MM + 4.0 * self.sigma)
            };
            off(0, strip.min(n)) || off(n.saturating_sub(strip), n)
        };
        2 * self.smooth.iter().filter(|p| leaves(&p[1])).count() > self.smooth.len()
    }

    /// # Errors
    /// [`Error::NotFound`] where hardly anything of a wall is in view beside the weld.
    pub(super) fn only_one_wall(&self, stations: &[Station]) -> Result<()> {
        for (side, name) in [(0, "reference wall"), (1, "other wall")] {
            let end = if side == 0 { self.grid.start_across } else { self.profile(0).edge(self.grid.bins) };
            let mut sides: Vec<f64> = stations.iter().filter_map(|s| Some((end - s.toes_mm?[side]).abs())).collect();
            let mut widths: Vec<f64> = stations.iter().filter_map(|s| s.toes_mm.map(|t| t[1] - t[0])).collect();
            if sides.is_empty() {
                let reason = "no station shows the surfaces on both sides of the weld: only one wall is in view".into();
                return Err(Error::NotFound { what: "weld", reason });
            }
            let (seen_mm, width) = (median(&mut sides), median(&mut widths));
            if seen_mm < width.min(LEAST_WALL_MM) {
                let reason = format!(
                    "only {seen_mm:.1} mm of the {name} beside a weld {width:.1} mm wide: only one wall is in view"
                );
                return Err(Error::NotFound { what: "weld", reason });
            }
        }
        Ok(())
    }
}
