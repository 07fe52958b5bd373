//! The stations read: toes, walls, transition, edges, cap.

use rayon::prelude::*;

use super::cap::Candidate;
use super::direction::Direction;
use super::foot::{self, FlankFoot};
use super::station::{Edge, Kind, Station, running_median};
use super::toes::Toe;
use super::view::{FLUSH_GAP_MM, Found, View};
use super::{direction, doubts, edges, toes, walls};
use crate::ground::robust::{MEDIAN_TO_SIGMA, median};
use crate::ground::threads;

/// A station is seen where this part of the usual bins near the weld holds points.
const SEEN_PART: f64 = 0.3;
/// Near the weld: so far beyond its toes.
const NEAR_MM: f64 = 8.0;
/// Gaps between the readings of a flush weld, in widest caps: nobody knows where its toes are.
const FLUSH_GAPS: [f64; 2] = [0.2, 0.4];
/// Toes wander by less than this between neighbours, and as a part of the width.
const WANDER_MM: f64 = 0.6;
const WANDER_WIDTHS: f64 = 0.06;
/// A toe that is hidden, a cap's flank of this length inside it and the first of the wall outside, over more than the flank
/// takes for itself: what is left of a cap 0.9 mm high runs out over so much at a toe angle of 150 degrees.
const HIDDEN_ABOUT_MM: [f64; 2] = [3.0, 1.5];
const HIDDEN_MM: f64 = 1.5;
/// Where an end that flares begins is known to this.
const FLARE_MM: f64 = 0.6;
/// Thicker walls are bevelled down to thinner ones by 15 degrees at most (PNAE G-7-009, GOST 16037: 12 to 15).
const STEEPEST_BEVEL: f64 = 0.27;
/// What is the wall's own is there in so many neighbours on either side too.
const NEIGHBOURS: usize = 2;
/// A median scatters by so much more than a mean.
const MEDIAN_EFFICIENCY: f64 = 1.25;

/// What the line right beside each toe runs off the reading, with its standard uncertainty; `None` where it is not seen.
type Bevels = [Option<[f64; 2]>; 2];

impl View<'_> {
    /// A toe of a station: side 0 is the reference wall's.
    fn toe(&self, station: usize, candidate: &Candidate, side: usize, band: Option<[f64; 2]>) -> Option<Toe> {
        let profile = &self.smooth[station][side];
        if side == 1 {
            return toes::toe(profile, candidate.from, candidate.to, self.sigma, band);
        }
        let n = profile.len();
        let band = band.map(|[low, high]| [-high, -low]);
        let toe = toes::toe(profile, n - candidate.to, n - candidate.from, self.sigma, band)?;
        Some(Toe { at: -toe.at, from: -toe.to, to: -toe.from, ..toe })
    }

    pub(super) fn stations(&self, found: &Found) -> Vec<Station> {
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
                            return Some(Toe { at, from: at, to: at, undercut_mm: 0.0 });
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
        let (mut stations, mut toes): (Vec<Station>, Vec<[Toe; 2]>) =
            threads::install(|| (0..count).into_par_iter().map(|k| self.station(k, found, toes[k], usual)).unzip());
        if found.kind == Kind::Raised {
            for (k, moved) in self.flares(found, &stations, &toes).into_iter().enumerate() {
                if let Some(moved) = moved {
                    (stations[k], toes[k]) = self.station(k, found, moved.map(Some), usual);
                }
            }
        }
        for (side, scatter) in [0, 1].map(|side| (side, toe_scatter(&stations, side))) {
            stations.iter_mut().for_each(|s| s.toes_standard_mm[side] = s.toes_standard_mm[side].hypot(scatter));
        }
        let local: Vec<Option<f64>> =
            threads::install(|| (0..count).into_par_iter().map(|k| self.local_step(&stations, k)).collect());
        stations.iter_mut().zip(local).for_each(|(station, local)| station.local_step_mm = local);
        let directions = direction::directions(&stations, self.grid.course);
        let read: Vec<Option<(Edge, Bevels)>> = threads::install(|| {
            let read = |k: usize| {
                let station = &stations[k];
                if station.toes_mm.is_some() { self.edge(k, found, station, &toes[k], directions[k]?) } else { None }
            };
            (0..count).into_par_iter().map(read).collect()
        });
        let bevels: Vec<Bevels> = read.iter().map(|read| read.map_or([None; 2], |(_, bevels)| bevels)).collect();
        stations.iter_mut().zip(read).for_each(|(station, read)| station.edge = read.map(|(edge, _)| edge));
        let hidden = if found.kind == Kind::Flush { 0.0 } else { self.hidden(&stations) };
        // A ripple of the cap has a foot and a groove too; an end that flares has it in all neighbours.
        let feet: Vec<Option<f64>> = stations.iter().map(|s| s.edge.map(|e| e.foot_mm)).collect();
        for (k, station) in stations.iter_mut().enumerate() {
            if let Some(edge) = &mut station.edge {
                let near = k.saturating_sub(NEIGHBOURS)..(k + NEIGHBOURS + 1).min(feet.len());
                let mut feet: Vec<f64> = feet[near.clone()].iter().flatten().copied().collect();
                let foot = if feet.len() == 2 { feet[0].min(feet[1]) } else { median(&mut feet) };
                edge.foot_mm = foot + hidden + bevel(&bevels[near.clone()], 0) + bevel(&bevels[near], 1);
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
                if (own - usual).abs() > band {
                    // Where a hole is in its place, it is known from its neighbours alone.
                    let by_neighbours = Toe { at: usual, from: usual - band, to: usual + band, undercut_mm: 0.0 };
                    let again = self.toe(k, c, side, Some([usual - band, usual + band])).unwrap_or(by_neighbours);
                    // What the free search found stays plausible.
                    let first = toes[k][side].map_or([own, own], |t| [t.from, t.to]);
                    let kept = (first[0] - usual).abs().max((first[1] - usual).abs()) <= 2.0 * band;
                    let (from, to) =
                        if kept { (again.from.min(first[0]), again.to.max(first[1])) } else { (again.from, again.to) };
                    toes[k][side] = Some(Toe { from, to, ..again });
                }
            }
        }
    }

    /// All of a station but its edge step, and its toes.
    fn station(&self, k: usize, found: &Found, toes: [Option<Toe>; 2], usual: [f64; 2]) -> (Station, [Toe; 2]) {
        let middle = found.course.at(self.along(k));
        let by_course = toes.iter().any(Option::is_none);
        let toes: [Toe; 2] = std::array::from_fn(|side| {
            let at = middle + usual[side];
            toes[side].unwrap_or(Toe { at, from: at - WANDER_MM, to: at + WANDER_MM, undercut_mm: 0.0 })
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
            at: self.grid.at(k),
            seen,
            kind: found.kind,
            by_course,
            toes_mm: None,
            toes_standard_mm: if found.kind == Kind::Flush {
                [FLUSH_GAPS[1] * self.widest_mm / toes::PLAUSIBLE_SIGMAS; 2]
            } else {
                toes.map(|toe| (toe.to - toe.from) / (2.0 * toes::PLAUSIBLE_SIGMAS))
            },
            height_mm: 0.0,
            edge: None,
            local_step_mm: None,
            undisturbed_mm: [None; 2],
            departure_mm: [0.0; 2],
            wall_step_mm: None,
            walls: [None; 2],
        };
        if !seen {
            return (station, toes);
        }
        let centre = 0.5 * (toes[0].at + toes[1].at);
        station.toes_mm = Some([toes[0].at, toes[1].at]);
        for (side, toe) in toes.iter().enumerate() {
            let sign = if side == 0 { -1.0 } else { 1.0 };
            let profile = &self.smooth[k][side];
            station.walls[side] = walls::grow(profile, sign * toe.at, sign * centre, &self.shell, self.sigma);
            station.undisturbed_mm[side] = station.walls[side].map(|run| sign * run.from);
        }
        if let (Some(a), Some(b)) = (station.straight_at(0, centre), station.straight_at(1, centre)) {
            station.wall_step_mm = Some(b - a);
        }
        for side in 0..2 {
            station.departure_mm[side] = self.departure(k, &station, &toes, side);
        }
        station.height_mm = if found.kind == Kind::Flush { 0.0 } else { self.cap_height(k, [toes[0].at, toes[1].at]) };
        (station, toes)
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

    /// The edge step of a station, and what is bevelled right beside its toes.
    fn edge(
        &self,
        k: usize,
        found: &Found,
        station: &Station,
        toes: &[Toe; 2],
        direction: Direction,
    ) -> Option<(Edge, Bevels)> {
        let slope = direction.slope;
        let read = |places: [f64; 2]| -> Option<(Edge, Bevels)> {
            let a = edges::read(&self.own[k][0], -places[0], station.height_mm, self.sigma)?;
            let b = edges::read(&self.own[k][1], places[1], station.height_mm, self.sigma)?;
            let width = places[1] - places[0];
            let leaning = [(-a.slope - slope).abs(), (b.slope - slope).abs()];
            let doubt = |side: usize| (toes[side].to - toes[side].at).max(toes[side].at - toes[side].from);
            let flush = found.kind == Kind::Flush;
            let (hull, foot) = if flush {
                (0.0, 0.0)
            } else {
                let foot = self.foot(k, found, toes, [a.height, b.height])
                    + self.groove(k, found, station)
                    + a.strip
                    + b.strip;
                (leaning[0] * doubt(0) + leaning[1] * doubt(1), foot)
            };
            let edge = Edge {
                step_mm: b.height - a.height - slope * width,
                standard_mm: [a.u, b.u, direction.slope_u * width]
                    .into_iter()
                    .chain((0..2).map(|side| if flush { 0.0 } else { leaning[side] * station.toes_standard_mm[side] }))
                    .fold(0.0, f64::hypot),
                hull_mm: hull + direction.spread * width,
                foot_mm: foot,
            };
            let bevel = |side: usize, read: Option<[f64; 2]>| match read {
                _ if flush => None,
                Some([off, _]) if off.abs() < toes[side].undercut_mm => Some([toes[side].undercut_mm, self.sigma]),
                read => read,
            };
            Some((edge, [bevel(0, a.bevel), bevel(1, b.bevel)]))
        };
        let middle = 0.5 * (toes[0].at + toes[1].at);
        if found.kind == Kind::Flush {
            // Nobody knows where the toes of a ground weld were: the step is one of those that are read over several gaps.
            let gaps = std::iter::once(0.5 * FLUSH_GAP_MM)
                .chain(FLUSH_GAPS.iter().map(|g| 0.5 * FLUSH_GAP_MM + g * self.widest_mm));
            let all: Vec<(Edge, Bevels)> = gaps.filter_map(|half| read([middle - half, middle + half])).collect();
            let most = |e: &Edge| e.step_mm.abs() + e.expanded_mm();
            let (mut edge, bevels) = *all.iter().max_by(|a, b| most(&a.0).total_cmp(&most(&b.0)))?;
            let furthest = edge.step_mm.abs();
            let low = all.iter().map(|(e, _)| e.step_mm - e.expanded_mm()).fold(f64::INFINITY, f64::min);
            let high = all.iter().map(|(e, _)| e.step_mm + e.expanded_mm()).fold(f64::NEG_INFINITY, f64::max);
            edge.step_mm = 0.5 * (low + high);
            edge.hull_mm = (0.5 * (high - low) - 2.0 * edge.standard_mm).max(0.0);
            // Nor which of the surfaces in its reach are the edges: the furthest apart of them may be.
            let apart = self.spread(k, middle, slope) - furthest;
            edge.hull_mm += if apart > walls::TOLERANCE_MM + 3.0 * self.sigma { apart } else { 0.0 };
            return Some((edge, bevels));
        }
        read([toes[0].at, toes[1].at])
    }

    /// How far the surface rises and falls where a flush weld may be, over a line of this slope, in blocks of a millimetre.
    fn spread(&self, k: usize, middle: f64, slope: f64) -> f64 {
        let (profile, reach) = (self.profile(k), 0.5 * FLUSH_GAP_MM + FLUSH_GAPS[1] * self.widest_mm);
        let (from, to) = (profile.boundary(middle - reach), profile.boundary(middle + reach));
        let block = profile.in_bins(1.0);
        let means = (from..to).step_by(block).filter_map(|at| profile.mean(at, (at + block).min(to)));
        let heights = means.map(|(x, h)| h - slope * (x - middle));
        let (low, high) = heights.fold((f64::INFINITY, f64::NEG_INFINITY), |r, h| (r.0.min(h), r.1.max(h)));
        (high - low).max(0.0)
    }

    /// Height of a cap over the chord between its toes; negative for a hollow one.
    fn cap_height(&self, k: usize, toes: [f64; 2]) -> f64 {
        let profile = &self.smooth[k][1];
        let (from, to) = (profile.boundary(toes[0]), profile.boundary(toes[1]));
        let over = doubts::over_chord(profile, from, to).unwrap_or_default();
        over.into_iter().fold(0.0, |most: f64, h| if h.abs() > most.abs() { h } else { most })
    }

    /// What a bevel could do where this view hides a toe behind its cap, both sides: nothing says whether metal or wall
    /// runs there. Bevels are turned, so that one is seen where half of the stations see it.
    fn hidden(&self, stations: &[Station]) -> f64 {
        let longest = |k: usize, station: &Station, side: usize| {
            let toe = station.toes_mm?[side];
            let (profile, toe) = (&self.smooth[k][side], if side == 0 { -toe } else { toe });
            let about = profile.boundary(toe - HIDDEN_ABOUT_MM[0])..profile.boundary(toe + HIDDEN_ABOUT_MM[1]);
            let empty = profile.heights[about].chunk_by(|a, b| a.is_nan() == b.is_nan()).filter(|run| run[0].is_nan());
            Some(profile.bin * empty.map(<[f64]>::len).max().unwrap_or(0) as f64)
        };
        let usual = |side: usize| {
            let mut all: Vec<f64> = stations.iter().enumerate().filter_map(|(k, s)| longest(k, s, side)).collect();
            if all.is_empty() { 0.0 } else { median(&mut all) }
        };
        (0..2).map(|side| STEEPEST_BEVEL * (usual(side) - HIDDEN_MM).max(0.0)).sum()
    }

    /// Where a flank flattens outward, metal that looks like the foot of the cap may be the wall's own edge (an end that
    /// flares within a few millimetres has no kink at its toe): its height over the surface beside the toe, both sides.
    fn foot(&self, k: usize, found: &Found, toes: &[Toe; 2], beside: [f64; 2]) -> f64 {
        (0..2)
            .filter_map(|side| self.foot_of(k, found, toes, side).map(|foot| (foot.height - beside[side]).abs()))
            .sum()
    }

    fn foot_of(&self, k: usize, found: &Found, toes: &[Toe; 2], side: usize) -> Option<FlankFoot> {
        let sign = if found.kind == Kind::Hollow { -1.0 } else { 1.0 };
        let [toe, far] = if side == 0 { [-toes[0].at, -toes[1].at] } else { [toes[1].at, toes[0].at] };
        foot::foot(&self.smooth[k][side], toe, far, sign, self.sigma)
    }

    /// Toes that were found in the tail of an end that flares, put to where it begins: where most neighbours tell the same.
    fn flares(&self, found: &Found, stations: &[Station], toes: &[[Toe; 2]]) -> Vec<Option<[Toe; 2]>> {
        let ends: Vec<[Option<f64>; 2]> = (0..stations.len())
            .map(|k| {
                [0, 1].map(|side| {
                    let (wall, foot) = (stations[k].walls[side]?, self.foot_of(k, found, &toes[k], side)?);
                    let crown = self.crown(k, toes[k].map(|toe| toe.at));
                    foot::flare(&self.smooth[k][side], foot, if side == 0 { -crown } else { crown }, &wall)
                })
            })
            .collect();
        (0..stations.len())
            .map(|k| {
                let near = k.saturating_sub(NEIGHBOURS)..(k + NEIGHBOURS + 1).min(ends.len());
                let moved = [0, 1].map(|side| {
                    let mut all: Vec<f64> = ends[near.clone()].iter().filter_map(|e| e[side]).collect();
                    if all.len() <= near.len() / 2 { None } else { Some(ends[k][side].unwrap_or(median(&mut all))) }
                });
                moved.iter().any(Option::is_some).then(|| {
                    [0, 1].map(|side| {
                        let sign = if side == 0 { -1.0 } else { 1.0 };
                        let about = |x: f64| Toe {
                            at: sign * x,
                            from: sign * x - FLARE_MM,
                            to: sign * x + FLARE_MM,
                            undercut_mm: 0.0,
                        };
                        moved[side].map_or(toes[k][side], about)
                    })
                })
            })
            .collect()
    }

    /// Where a cap is highest.
    fn crown(&self, k: usize, toes: [f64; 2]) -> f64 {
        let profile = &self.smooth[k][1];
        let (from, to) = (profile.boundary(toes[0]), profile.boundary(toes[1]));
        let highest = (from..to).filter(|&i| profile.heights[i].is_finite());
        highest
            .max_by(|&a, &b| profile.heights[a].total_cmp(&profile.heights[b]))
            .map_or(0.5 * (toes[0] + toes[1]), |i| profile.x(i))
    }
}

/// How far a side's toes scatter, one sigma: by stations that share no points, as each is found in the median of three.
fn toe_scatter(stations: &[Station], side: usize) -> f64 {
    let toe = |s: &Station| s.toes_mm.map(|toes| toes[side]);
    let mut apart: Vec<f64> =
        stations.iter().zip(stations.iter().skip(3)).filter_map(|(a, b)| Some((toe(a)? - toe(b)?).abs())).collect();
    if apart.is_empty() { 0.0 } else { MEDIAN_TO_SIGMA * median(&mut apart) / std::f64::consts::SQRT_2 }
}

/// What a bevel shorter than the strip that is not read changes at a toe: the median of neighbours, where it is more than
/// noise and the flank's light.
fn bevel(near: &[Bevels], side: usize) -> f64 {
    let lines: Vec<[f64; 2]> = near.iter().filter_map(|b| b[side]).collect();
    if lines.len() <= NEIGHBOURS {
        return 0.0;
    }
    let off = median(&mut lines.iter().map(|l| l[0]).collect::<Vec<_>>()).abs();
    let noise = median(&mut lines.iter().map(|l| l[1]).collect::<Vec<_>>());
    let seen = edges::FLANK_LIGHT_MM + 3.0 * MEDIAN_EFFICIENCY * noise / (lines.len() as f64).sqrt();
    if off > seen { off } else { 0.0 }
}
