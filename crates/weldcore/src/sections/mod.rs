//! Cross-sections of a weld, station by station along the seam: its cap, both toes, the surfaces right beside them, and the
//! undisturbed walls further out.
//!
//! 1. The unrolled view becomes cells (`grid`): stations of 4 mm by bins of 0.2 to 0.8 mm, each with its median.
//! 2. The cap is found as a cap (`cap`): raised (or hollow), one-humped, between smooth surfaces; or flush, as a jump. All
//!    stations together give the seam's course.
//! 3. Each toe is where two free parabolas meet at best, with the range that is as plausible (`toes`).
//! 4. The surface right beside each toe is read as a gauge reads it (`edges`): the **edge step**.
//! 5. The undisturbed walls are grown inward from the edges of the view (`walls`), with what a weld draws them in.
//!
//! What lies between a toe and its undisturbed wall is a *transition*: a taper, a counterbore, a flare, a dent, the edge of a
//! coat. Nothing is left out because it is inconvenient: heights are not gated, and what fits none of these is a doubt.

mod cap;
mod doubts;
mod edges;
mod grid;
mod profile;
mod toes;
mod walls;

use rayon::prelude::*;

pub use cap::widest_cap_mm;
pub(crate) use grid::Grid;
pub(crate) use walls::{TOLERANCE_MM, WallRun, shell_term};

use crate::error::{Error, Result};
use crate::segment::{PipeFrame, Unrolled};
use crate::statistics::median;
use crate::threads;
use cap::{Candidate, Course};
use profile::Profile;
use toes::Toe;

/// Caps are sought up to this many times the widest that may be: one that is too wide must be found as such.
const SEARCH_WIDTHS: f64 = 1.6;
/// A hollow cap or a flush one is looked for where fewer stations than this show a raised one.
const RAISED_PART: f64 = 0.6;
/// A flush weld shows in at least this part of the stations, by a jump of so many times the scatter beside it.
const FLUSH_PART: f64 = 0.5;
const FLUSH_STRENGTH: f64 = 5.0;
/// A station is seen where this part of the usual bins near the weld holds points.
const SEEN_PART: f64 = 0.3;
/// The edge of a view.
const EDGE_MM: f64 = 2.0;
/// Near the weld: so far beyond its toes.
const NEAR_MM: f64 = 8.0;
/// A wall is read beside the weld where at least this much of it is in view, or as much as the cap is wide.
const LEAST_WALL_MM: f64 = 15.0;
/// Gaps between the readings of a flush weld, in widest caps: nobody knows where its toes are.
const FLUSH_GAPS: [f64; 2] = [0.2, 0.4];
const FLUSH_GAP_MM: f64 = 1.0;
/// Toes wander by less than this between neighbours, and as a part of the width.
const WANDER_MM: f64 = 0.6;
const WANDER_WIDTHS: f64 = 0.06;

/// How a station's weld shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Kind {
    /// Nothing of it is known.
    Unknown = 0,
    /// A raised cap.
    Raised = 1,
    /// A hollow one.
    Hollow = 2,
    /// A jump between two walls, without a cap.
    Flush = 3,
}

/// The edge step of one station.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Edge {
    /// Height of the other wall's surface over the reference wall's, each right beside its toe, read along the bisector of
    /// both walls' normals.
    pub step_mm: f64,
    /// Standard uncertainty: noise, choice of the stretch, direction of reading.
    pub standard_mm: f64,
    /// What the choice of the toes may hide, in full.
    pub hull_mm: f64,
    /// Part of it: what looks like the foot of the cap, or like an undercut, and may be the wall's own edge.
    pub foot_mm: f64,
}

impl Edge {
    /// Expanded (k = 2), and the hull in full.
    pub fn expanded_mm(&self) -> f64 {
        2.0 * self.standard_mm + self.hull_mm
    }
}

/// One station.
#[derive(Debug, Clone, PartialEq)]
pub struct Station {
    /// Its middle.
    pub angle_rad: f64,
    /// Whether enough points lie near the weld.
    pub seen: bool,
    /// How its weld shows.
    pub kind: Kind,
    /// Whether the toes are the course's, for want of its own.
    pub by_course: bool,
    /// Both toes across the seam: reference side, other side.
    pub toes_mm: Option<[f64; 2]>,
    /// Height of the cap over the chord between the toes.
    pub height_mm: f64,
    /// The edge step, where both surfaces beside the toes are there.
    pub edge: Option<Edge>,
    /// From where outward each wall is undisturbed, across the seam.
    pub undisturbed_mm: [Option<f64>; 2],
    /// How far the surface between toe and undisturbed wall departs from the straight wall.
    pub departure_mm: [f64; 2],
    /// Both straight walls extrapolated to the middle between the toes.
    pub wall_step_mm: Option<f64>,
    pub(crate) walls: [Option<WallRun>; 2],
}

impl Station {
    /// The wall of a side (0 reference, 1 other) at a place across the seam, with its shrinkage.
    pub(crate) fn wall_at(&self, side: usize, x: f64) -> Option<f64> {
        self.walls[side].map(|run| run.at(if side == 0 { -x } else { x }))
    }

    fn straight_at(&self, side: usize, x: f64) -> Option<f64> {
        self.walls[side].map(|run| run.straight(if side == 0 { -x } else { x }))
    }

    /// Slope of a side's straight wall along the axis.
    fn slope(&self, side: usize) -> Option<f64> {
        self.walls[side].map(|run| if side == 0 { -run.slope } else { run.slope })
    }
}

/// Why a weld's edges may not be what they seem: a code of `weldscan.result.CODES`, the place, and a line.
#[derive(Debug, Clone, PartialEq)]
pub struct Doubt {
    /// `cap`, `edges`, `transition`, `walls` or `points-without-wall`.
    pub code: &'static str,
    /// Where.
    pub angle_rad: f64,
    /// What, with numbers.
    pub text: String,
}

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

/// Examines an unrolled view of a pipe with walls of `thickness_mm`; `near_mm` is how far from the nominal pipe points are its
/// own beyond doubt.
///
/// # Errors
/// [`Error::TooFew`] and [`Error::Degenerate`] where there is next to nothing; [`Error::NotFound`] where no weld, or only one
/// wall, is in view.
pub fn examine(unrolled: &Unrolled, frame: &PipeFrame, thickness_mm: f64, near_mm: f64) -> Result<Sections> {
    let grid = Grid::of(unrolled, frame, near_mm)?;
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

/// The profiles of a view.
struct View<'a> {
    grid: &'a Grid,
    /// Median of three stations: for finding. And its mirror image.
    smooth: Vec<[Profile; 2]>,
    /// The station alone: for reading.
    own: Vec<[Profile; 2]>,
    thickness_mm: f64,
    sigma: f64,
    widest_mm: f64,
}

/// The weld's course.
struct Found {
    kind: Kind,
    course: Course,
    /// All candidates of each station.
    candidates: Vec<Vec<Candidate>>,
    /// Part of the stations with a second jump as strong as a weld's; for a flush one.
    second_line: f64,
}

impl<'a> View<'a> {
    fn of(grid: &'a Grid, thickness_mm: f64) -> Self {
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
        Self { grid, smooth, own, thickness_mm, sigma: grid.cell_sigma_mm, widest_mm: widest_cap_mm(thickness_mm) }
    }

    fn along(&self, station: usize) -> f64 {
        self.grid.start_along + (station as f64 + 0.5) * self.grid.station_mm
    }

    fn profile(&self, station: usize) -> &Profile {
        &self.smooth[station][1]
    }

    fn candidates(&self, sign: f64) -> Vec<Vec<Candidate>> {
        let search = SEARCH_WIDTHS * self.widest_mm;
        threads::install(|| self.smooth.par_iter().map(|p| cap::candidates(&p[1], search, self.sigma, sign)).collect())
    }

    /// Raised, hollow or flush, and its course.
    fn weld(&self) -> Result<Found> {
        let along: Vec<f64> = (0..self.grid.stations).map(|k| self.along(k)).collect();
        // Of the stations that hold points at all.
        let filled = self.own.iter().filter(|p| 2.0 * p[1].count(0, p[1].len()) > 0.3 * p[1].len() as f64).count();
        let part = |course: &Option<Course>| {
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

    /// A toe of a station: side 0 is the reference wall's.
    fn toe(&self, station: usize, candidate: &Candidate, side: usize, band: Option<[f64; 2]>) -> Option<Toe> {
        let profile = &self.smooth[station][side];
        if side == 1 {
            return toes::toe(profile, candidate.from, candidate.to, self.sigma, band);
        }
        let n = profile.len();
        let band = band.map(|[low, high]| [-high, -low]);
        let toe = toes::toe(profile, n - candidate.to, n - candidate.from, self.sigma, band)?;
        Some(Toe { at: -toe.at, from: -toe.to, to: -toe.from })
    }

    fn stations(&self, found: &Found) -> Vec<Station> {
        let count = self.grid.stations;
        let chosen = &found.course.chosen;
        let mut toes: Vec<[Option<Toe>; 2]> = threads::install(|| {
            (0..count)
                .into_par_iter()
                .map(|k| {
                    std::array::from_fn(|side| {
                        let c = chosen[k].as_ref()?;
                        if found.kind == Kind::Flush {
                            let at = c.toes[side];
                            return Some(Toe { at, from: at, to: at });
                        }
                        self.toe(k, c, side, None)
                    })
                })
                .collect()
        });
        if found.kind != Kind::Flush {
            self.second_look(found, &mut toes);
        }
        // The middle and the usual width, for stations that have none of their own.
        let usual: [f64; 2] = std::array::from_fn(|side| {
            let mut off: Vec<f64> =
                (0..count).filter_map(|k| Some(toes[k][side]?.at - found.course.at(self.along(k)))).collect();
            if off.is_empty() { 0.0 } else { median(&mut off) }
        });
        let mut stations: Vec<Station> =
            threads::install(|| (0..count).into_par_iter().map(|k| self.station(k, found, toes[k], usual)).collect());
        // A ripple of the cap has a foot and a groove too; an end that flares has it in all neighbours.
        let feet: Vec<Option<f64>> = stations.iter().map(|s| s.edge.map(|e| e.foot_mm)).collect();
        for (k, station) in stations.iter_mut().enumerate() {
            if let Some(edge) = &mut station.edge {
                let mut near: Vec<f64> =
                    feet[k.saturating_sub(2)..(k + 3).min(feet.len())].iter().flatten().copied().collect();
                edge.foot_mm = if near.len() == 2 { near[0].min(near[1]) } else { median(&mut near) };
                edge.hull_mm += edge.foot_mm;
            }
        }
        stations
    }

    /// Toes off the running median of their neighbours are sought again near it.
    fn second_look(&self, found: &Found, toes: &mut [[Option<Toe>; 2]]) {
        let width = found.course.width();
        let band = WANDER_MM.max(WANDER_WIDTHS * width);
        for side in 0..2 {
            let at: Vec<Option<f64>> = toes.iter().map(|t| t[side].map(|t| t.at)).collect();
            for k in 0..toes.len() {
                let (Some(own), Some(c)) = (at[k], found.course.chosen[k].as_ref()) else { continue };
                let Some(usual) = running_median(&at, k, 4) else { continue };
                if (own - usual).abs() > band
                    && let Some(again) = self.toe(k, c, side, Some([usual - band, usual + band]))
                {
                    // What the free search found stays plausible.
                    let first = toes[k][side].map_or([own, own], |t| [t.from, t.to]);
                    let kept = (first[0] - usual).abs().max((first[1] - usual).abs()) <= 2.0 * band;
                    let (from, to) =
                        if kept { (again.from.min(first[0]), again.to.max(first[1])) } else { (again.from, again.to) };
                    toes[k][side] = Some(Toe { at: again.at, from, to });
                }
            }
        }
    }

    fn station(&self, k: usize, found: &Found, toes: [Option<Toe>; 2], usual: [f64; 2]) -> Station {
        let middle = found.course.at(self.along(k));
        let by_course = toes.iter().any(Option::is_none);
        let toes: [Toe; 2] = std::array::from_fn(|side| {
            let at = middle + usual[side];
            toes[side].unwrap_or(Toe { at, from: at - WANDER_MM, to: at + WANDER_MM })
        });
        let own = &self.own[k];
        let seen = {
            let near = |side: usize| {
                let at = if side == 0 { -toes[0].at } else { toes[1].at };
                let (from, to) = (own[side].boundary(at), own[side].boundary(at + NEAR_MM));
                (to - from).min(own[side].in_bins(NEAR_MM)) > 0
                    && own[side].count(from, to) >= SEEN_PART * own[side].in_bins(NEAR_MM) as f64
            };
            near(0) && near(1)
        };
        let mut station = Station {
            angle_rad: self.grid.angle_rad(k),
            seen,
            kind: found.kind,
            by_course,
            toes_mm: None,
            height_mm: 0.0,
            edge: None,
            undisturbed_mm: [None; 2],
            departure_mm: [0.0; 2],
            wall_step_mm: None,
            walls: [None; 2],
        };
        if !seen {
            return station;
        }
        let shell = [self.grid.radius_mm, self.thickness_mm];
        let centre = 0.5 * (toes[0].at + toes[1].at);
        station.toes_mm = Some([toes[0].at, toes[1].at]);
        for (side, toe) in toes.iter().enumerate() {
            let sign = if side == 0 { -1.0 } else { 1.0 };
            let profile = &self.smooth[k][side];
            station.walls[side] = walls::grow(profile, sign * toe.at, sign * centre, shell, self.sigma);
            station.undisturbed_mm[side] = station.walls[side].map(|run| sign * run.from);
        }
        if let (Some(a), Some(b)) = (station.straight_at(0, centre), station.straight_at(1, centre)) {
            station.wall_step_mm = Some(b - a);
        }
        for side in 0..2 {
            station.departure_mm[side] = self.departure(k, &station, &toes, side);
        }
        let (edge, height) = self.edge(k, found, &station, &toes);
        station.edge = edge;
        station.height_mm = height;
        station
    }

    /// Largest departure of the transition from the straight wall, over blocks of bins. What may as well be the cap's
    /// flank is no transition: the edges' hull bears it.
    fn departure(&self, k: usize, station: &Station, toes: &[Toe; 2], side: usize) -> f64 {
        let Some(run) = station.walls[side] else { return 0.0 };
        let profile = &self.smooth[k][side];
        let [at, last] = if side == 0 { [-toes[0].at, -toes[0].from] } else { [toes[1].at, toes[1].to] };
        let (from, to) = (profile.boundary(last.max(at + 1.0)), profile.boundary(run.from));
        let block = profile.in_bins(1.0);
        (from..to)
            .step_by(block)
            .filter_map(|at| profile.mean(at, (at + block).min(to)))
            .map(|(x, h)| (h - run.straight(x)).abs())
            .fold(0.0, f64::max)
    }

    /// The edge step of a station, and the height of its cap.
    fn edge(&self, k: usize, found: &Found, station: &Station, toes: &[Toe; 2]) -> (Option<Edge>, f64) {
        let slopes = [station.slope(0), station.slope(1)];
        // Along the bisector of both walls; where one is unknown, along the other.
        let (slope, slope_u) = match slopes {
            [Some(a), Some(b)] => {
                let u = station.walls.iter().flatten().map(|r| r.slope_u).fold(0.0, f64::hypot) / 2.0;
                (0.5 * (a + b), u)
            }
            [Some(a), None] | [None, Some(a)] => {
                (a, station.walls.iter().flatten().map(|r| r.slope_u).fold(0.0, f64::max))
            }
            [None, None] => return (None, 0.0),
        };
        let height = if found.kind == Kind::Flush { 0.0 } else { self.cap_height(k, [toes[0].at, toes[1].at]) };
        let read = |places: [f64; 2]| -> Option<Edge> {
            let a = edges::read(&self.own[k][0], -places[0], height, self.sigma)?;
            let b = edges::read(&self.own[k][1], places[1], height, self.sigma)?;
            let width = places[1] - places[0];
            let leaning = [(-a.slope - slope).abs(), (b.slope - slope).abs()];
            let doubt = |side: usize| (toes[side].to - toes[side].at).max(toes[side].at - toes[side].from);
            let (hull, foot) = if found.kind == Kind::Flush {
                (0.0, 0.0)
            } else {
                let foot = self.foot(k, found, toes, [a.height, b.height])
                    + self.groove(k, found, station)
                    + a.strip
                    + b.strip;
                (leaning[0] * doubt(0) + leaning[1] * doubt(1), foot)
            };
            Some(Edge {
                step_mm: b.height - a.height - slope * width,
                standard_mm: (a.u * a.u + b.u * b.u + (slope_u * width).powi(2)).sqrt(),
                hull_mm: hull,
                foot_mm: foot,
            })
        };
        let middle = 0.5 * (toes[0].at + toes[1].at);
        if found.kind == Kind::Flush {
            // Nobody knows where the toes of a ground weld were: the reading that is furthest from zero counts.
            let gaps = std::iter::once(0.5 * FLUSH_GAP_MM)
                .chain(FLUSH_GAPS.iter().map(|g| 0.5 * FLUSH_GAP_MM + g * self.widest_mm));
            let all: Vec<Edge> = gaps.filter_map(|half| read([middle - half, middle + half])).collect();
            let most = all
                .iter()
                .max_by(|a, b| (a.step_mm.abs() + a.expanded_mm()).total_cmp(&(b.step_mm.abs() + b.expanded_mm())));
            return (most.copied(), 0.0);
        }
        (read([toes[0].at, toes[1].at]), height)
    }

    /// Height of a cap over the chord between its toes; negative for a hollow one.
    fn cap_height(&self, k: usize, toes: [f64; 2]) -> f64 {
        let profile = &self.smooth[k][1];
        let (from, to) = (profile.boundary(toes[0]), profile.boundary(toes[1]));
        let over = doubts::over_chord(profile, from, to).unwrap_or_default();
        over.into_iter().fold(0.0, |most: f64, h| if h.abs() > most.abs() { h } else { most })
    }

    /// Where a flank flattens outward, metal that looks like the foot of the cap may be the wall's own edge (an end that
    /// flares within a few millimetres has no kink at its toe): its height over the surface beside the toe, both sides.
    fn foot(&self, k: usize, found: &Found, toes: &[Toe; 2], beside: [f64; 2]) -> f64 {
        let sign = if found.kind == Kind::Hollow { -1.0 } else { 1.0 };
        (0..2)
            .map(|side| {
                let profile = &self.smooth[k][side];
                let toe = if side == 0 { -toes[0].at } else { toes[1].at };
                let far = if side == 0 { -toes[1].at } else { toes[0].at };
                foot(profile, toe, far, beside[side], sign, self.sigma)
            })
            .sum()
    }

    /// # Errors
    /// [`Error::NotFound`] where hardly anything of a wall is in view beside the weld.
    fn only_one_wall(&self, stations: &[Station]) -> Result<()> {
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

/// The flank's slope is that of windows of a millimetre.
const FLANK_WINDOW_MM: f64 = 1.0;
const ROUNDED_MM: f64 = 0.35;
/// A cap is steepest at its toe, but for its ripples. Where the last millimetre has less than this part of the steepest
/// slope, it may be something else than the cap.
const FOOT_SLOPE: f64 = 0.5;
/// A flank that hides behind its cap shows no foot: at least this part of it must be seen.
const FLANK_PART: f64 = 0.7;

fn foot(profile: &Profile, toe: f64, far: f64, beside: f64, sign: f64, sigma: f64) -> f64 {
    // The last strip is rounded by the toe itself and by the size of a pixel.
    let (from, to) = (profile.boundary(0.5 * (toe + far)), profile.boundary(toe - ROUNDED_MM));
    let window = profile.in_bins(FLANK_WINDOW_MM).max(3);
    if to < from + 2 * window {
        return 0.0;
    }
    let steep: Vec<(f64, f64, f64)> = (from..=to - window)
        .filter_map(|i| {
            profile
                .line(i, i + window)
                .map(|l| (0.5 * (profile.edge(i) + profile.edge(i + window)), -sign * l.slope, sigma / l.sxx.sqrt()))
        })
        .collect();
    let Some(&(_, last, se)) = steep.last() else { return 0.0 };
    let most = steep.iter().map(|s| s.1).fold(0.0, f64::max);
    let Some(&(x, _, _)) = steep.iter().rev().find(|s| s.1 >= 0.9 * most) else { return 0.0 };
    if last >= FOOT_SLOPE * most - 2.0 * se || toe - ROUNDED_MM - x <= FLANK_WINDOW_MM {
        return 0.0;
    }
    let at = profile.boundary(x);
    if profile.count(at, to) < FLANK_PART * (to - at) as f64 {
        return 0.0;
    }
    profile.mean(at.saturating_sub(1), (at + 1).min(profile.len())).map_or(0.0, |(_, h)| (h - beside).abs())
}

/// Median of the values within `reach` stations of one, itself included; `None` with fewer than three.
fn running_median(values: &[Option<f64>], at: usize, reach: usize) -> Option<f64> {
    let mut near: Vec<f64> =
        values[at.saturating_sub(reach)..(at + reach + 1).min(values.len())].iter().flatten().copied().collect();
    (near.len() >= 3).then(|| median(&mut near))
}
