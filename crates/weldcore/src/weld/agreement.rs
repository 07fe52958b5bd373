//! Part shots held against each other where they saw the same wall of the pipe.
//!
//! The pipe's surface is unrolled about its axis into cells of some millimetres, and each shot's points of the walls give
//! a cell their mean distance from the axis. Of two shots that saw the same cells the median over the cells of how far the
//! one's wall stands outside the other's is their difference, and 1.4826 median absolute deviations its scatter.
//!
//! [`wall_seen`] tells of one shot alone how far its wall holds the direction and the place of a cylinder that is fitted
//! to it: how far the arc reaches, how a turn about the line of sight twists it, and how uneven it is beyond what is the
//! same all along it (the pipe's form) or all around it (an end that the weld draws in).
//!
//! # Errors
//! What two shots share, an error of the hand-eye say, does not show. Neighbouring cells share the scanner's errors.

use std::collections::BTreeMap;

use crate::error::{Error, Result, require_finite};
use crate::ground::memory::require;
use crate::ground::robust::{MEDIAN_TO_SIGMA, median_between, quantile};
use crate::ground::threads;
use crate::ground::transform::Vec3;
use crate::weld::label::Label;
use crate::weld::seam::{Course, Seam};
use crate::weld::segment::Segmentation;

/// Cells in which the walls are compared: small against any pipe's radius, and of tens of points.
const CELL_MM: f64 = 4.0;
/// The fewest points of a cell, and cells of a pair.
const LEAST_POINTS: usize = 5;
const LEAST_CELLS: usize = 20;
/// Points of a shot that are looked at; more would change nothing.
const POINTS: usize = 150_000;
/// Points that tell the radius, which sets how many cells there are around.
const RADIUS_POINTS: usize = 1000;
/// Points of one shot's wall that tell its form.
const FORM_POINTS: usize = 20_000;
/// Unevenness is taken in a grid of so many cells around and along, each with as many points.
const GRID: usize = 10;
/// Share of the arc's points that its half reaches over.
const ARC_SHARE: f64 = 0.98;

/// The points of all shots in base, with what they belong to.
#[derive(Debug, Clone, Copy)]
pub struct WallCloud<'a> {
    /// Base, mm.
    pub points: &'a [[f64; 3]],
    /// A [`Label`] per point.
    pub labels: &'a [u8],
    /// Number of each point's shot.
    pub shots: &'a [u16],
}

/// What two shots that saw a wall together say differently of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Difference {
    /// Place of the one shot in the list.
    pub one: usize,
    /// And of the other, behind it.
    pub other: usize,
    /// Cells that both saw.
    pub cells: usize,
    /// The other's wall outside the one's, median over the cells.
    pub difference_mm: f64,
    /// Of single cells about it, robust, 1 sigma.
    pub scatter_mm: f64,
    /// Of the differences themselves.
    pub rms_mm: f64,
    /// Middle of the common cells.
    pub middle_mm: Vec3,
}

/// One shot's cells in their order: number along and across the seam, mean height, middle in base.
type Cells = Vec<((i64, i64), f64, Vec3)>;

/// Holds every two shots against each other.
///
/// `shots`: numbers of those to compare. One difference per pair that saw a wall together in 20 cells or more, in order of
/// the later shot, then of the earlier.
///
/// # Errors
/// [`Error::Shape`] for arrays of different lengths, [`Error::NonFinite`], [`Error::Degenerate`] for an axis without a
/// direction.
pub fn wall_differences(cloud: &WallCloud, shots: &[u16], origin_mm: Vec3, axis: Vec3) -> Result<Vec<Difference>> {
    let n = cloud.points.len();
    if [cloud.labels.len(), cloud.shots.len()] != [n; 2] {
        let got = format!("{} and {}", cloud.labels.len(), cloud.shots.len());
        return Err(Error::Shape { what: "labels and shots", expected: format!("{n} of each"), got });
    }
    require_finite("points", cloud.points)?;
    require_finite("origin_mm", &[origin_mm.into()])?;
    let what = "pipe axis";
    let axis = axis
        .try_normalize(0.0)
        .filter(|a| a.iter().all(|c| c.is_finite()))
        .ok_or_else(|| Error::Degenerate { what, reason: "it has no direction".into() })?;
    let seam = through_the_middle(cloud, origin_mm, axis)?;
    let seen: Vec<Cells> = walls_by_shot(cloud, shots).iter().map(|wall| cells(cloud.points, wall, &seam)).collect();
    let pairs: Vec<(usize, usize)> = (0..shots.len()).flat_map(|j| (0..j).map(move |i| (i, j))).collect();
    let found = threads::map_each(&pairs, |&(i, j)| difference(i, j, seen.get(i)?, seen.get(j)?));
    Ok(found.into_iter().flatten().collect())
}

/// The seam whose surface runs through the middle of the points: it sets how many cells there are along it.
fn through_the_middle(cloud: &WallCloud, origin: Vec3, axis: Vec3) -> Result<Seam> {
    let thinned = cloud.points.iter().step_by((cloud.points.len() / RADIUS_POINTS).max(1));
    let from_axis = |p: &[f64; 3]| {
        let v = Vec3::from(*p) - origin;
        (v - axis * v.dot(&axis)).norm()
    };
    let mut radii: Vec<f64> = thinned.map(from_axis).collect();
    let zero = axis.cross(&if axis.z.abs() < 0.9 { Vec3::z() } else { Vec3::x() });
    Seam::new(origin, axis, zero, Course::of_radius(median_between(&mut radii))?)
}

/// Indices of the walls' points of each shot, thinned.
fn walls_by_shot(cloud: &WallCloud, shots: &[u16]) -> Vec<Vec<usize>> {
    require(cloud.points.len(), 16);
    let mut place: BTreeMap<u16, usize> = BTreeMap::new();
    shots.iter().enumerate().for_each(|(k, number)| {
        place.entry(*number).or_insert(k);
    });
    let parts = threads::map_ranges(cloud.points.len(), |range| {
        let mut part = vec![Vec::new(); shots.len()];
        for i in range {
            let wall = [Label::ReferenceWall as u8, Label::OtherWall as u8].contains(&cloud.labels[i]);
            if let Some(&k) = place.get(&cloud.shots[i]).filter(|_| wall) {
                part[k].push(i);
            }
        }
        part
    });
    let all = |k: usize| -> Vec<usize> { parts.iter().flat_map(|part| part[k].iter().copied()).collect() };
    let thinned = |wall: Vec<usize>| wall.iter().copied().step_by((wall.len() / POINTS).max(1)).collect();
    shots.iter().map(|number| place.get(number).map_or(Vec::new(), |&k| thinned(all(k)))).collect()
}

fn cells(points: &[[f64; 3]], wall: &[usize], seam: &Seam) -> Cells {
    let parts = threads::map_chunks(wall, |_, chunk| {
        let mut sums: BTreeMap<(i64, i64), (usize, f64, Vec3)> = BTreeMap::new();
        for &i in chunk {
            let [at, across, height] = seam.place(&points[i]);
            let cell = (seam.course.cell(at, CELL_MM), (across / CELL_MM).floor() as i64);
            let sum = sums.entry(cell).or_default();
            *sum = (sum.0 + 1, sum.1 + height, sum.2 + Vec3::from(points[i]) - seam.origin_mm);
        }
        sums
    });
    let mut sums: BTreeMap<(i64, i64), (usize, f64, Vec3)> = BTreeMap::new();
    for (cell, more) in parts.into_iter().flatten() {
        let sum = sums.entry(cell).or_default();
        *sum = (sum.0 + more.0, sum.1 + more.1, sum.2 + more.2);
    }
    let full = sums.into_iter().filter(|(_, sum)| sum.0 >= LEAST_POINTS);
    full.map(|(cell, (n, height, v))| (cell, height / n as f64, seam.origin_mm + v / n as f64)).collect()
}

fn difference(one: usize, other: usize, a: &Cells, b: &Cells) -> Option<Difference> {
    let seen: BTreeMap<(i64, i64), (f64, Vec3)> =
        a.iter().map(|&(cell, height, middle)| (cell, (height, middle))).collect();
    let common = || b.iter().filter_map(|(cell, height, _)| seen.get(cell).map(|(h, middle)| (height - h, middle)));
    let mut off: Vec<f64> = common().map(|c| c.0).collect();
    let cells = off.len();
    if cells < LEAST_CELLS {
        return None;
    }
    let middle_mm = common().map(|c| c.1).sum::<Vec3>() / cells as f64;
    let rms_mm = (off.iter().map(|d| d * d).sum::<f64>() / cells as f64).sqrt();
    let difference_mm = median_between(&mut off);
    off.iter_mut().for_each(|d| *d = (*d - difference_mm).abs());
    let scatter_mm = MEDIAN_TO_SIGMA * median_between(&mut off);
    Some(Difference { one, other, cells, difference_mm, scatter_mm, rms_mm, middle_mm })
}

/// What one shot's reference wall shows of a cylinder.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WallSeen {
    /// Angle in the middle of the arc.
    pub middle_rad: f64,
    /// Half the arc that was seen.
    pub half_arc_rad: f64,
    /// Standard deviation of `across * sin(angle)`, the only form that a turn across the line of sight has.
    pub twist_mm: f64,
    /// Unevenness beyond what is the same all along the wall or all around it, rms.
    pub waves_mm: f64,
}

/// Looks at a shot's reference wall; `None` where it has none.
pub fn wall_seen(shot: &Segmentation) -> Option<WallSeen> {
    let labels = shot.labels.iter().enumerate();
    let wall: Vec<usize> = labels.filter(|(_, l)| **l == Label::ReferenceWall as u8).map(|(i, _)| i).collect();
    let thinned: Vec<usize> = wall.iter().copied().step_by((wall.len() / FORM_POINTS).max(1)).collect();
    let gather = |from: &[f32]| -> Vec<f64> { thinned.iter().map(|&i| f64::from(from[i])).collect() };
    let unrolled = &shot.unrolled;
    form(shot.seam.course, &gather(&unrolled.at), &gather(&unrolled.across_mm), &gather(&unrolled.height_mm))
}

fn mean(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let n = values.len() as f64;
    values.sum::<f64>() / n
}

fn form(course: Course, at: &[f64], across_mm: &[f64], height_mm: &[f64]) -> Option<WallSeen> {
    if at.is_empty() {
        return None;
    }
    let middle_rad = course.middle(at.iter().copied());
    let off: Vec<f64> = at.iter().map(|a| course.apart(*a, middle_rad)).collect();
    let across_middle = mean(across_mm.iter().copied());
    let twists: Vec<f64> = across_mm.iter().zip(&off).map(|(a, o)| (a - across_middle) * o.sin()).collect();
    let twist = mean(twists.iter().copied());
    let twist_mm = mean(twists.iter().map(|t| (t - twist).powi(2))).sqrt();
    let half_arc_rad = quantile(&mut off.iter().map(|o| o.abs()).collect::<Vec<_>>(), ARC_SHARE);
    Some(WallSeen { middle_rad, half_arc_rad, twist_mm, waves_mm: waves(&off, across_mm, height_mm) })
}

/// Of each value the number of its part, of parts with as many values each.
fn parts_of(values: &[f64]) -> impl Fn(f64) -> usize + use<> {
    let mut sorted = values.to_vec();
    let edges: Vec<f64> = (1..GRID).map(|k| quantile(&mut sorted, k as f64 / GRID as f64)).collect();
    move |value| edges.partition_point(|edge| *edge < value)
}

fn waves(angle: &[f64], along: &[f64], deviation: &[f64]) -> f64 {
    let (around, lengthwise) = (parts_of(angle), parts_of(along));
    let mut grid = [[(0_usize, 0.0); GRID]; GRID];
    for ((a, z), d) in angle.iter().zip(along).zip(deviation) {
        let cell = &mut grid[around(*a)][lengthwise(*z)];
        *cell = (cell.0 + 1, cell.1 + d);
    }
    let mut heights = grid.map(|row| row.map(|(n, sum)| (n >= LEAST_POINTS).then(|| sum / n as f64)));
    let middle = |line: [Option<f64>; GRID]| {
        let there = line.iter().flatten();
        there.clone().sum::<f64>() / there.count().max(1) as f64
    };
    // First what is the same all around, then what is the same all along.
    let columns: [f64; GRID] = std::array::from_fn(|k| middle(heights.map(|row| row[k])));
    heights = heights.map(|row| std::array::from_fn(|k| row[k].map(|h| h - columns[k])));
    heights = heights.map(|row| row.map(|h| h.map(|h| h - middle(row))));
    let left: Vec<f64> = heights.iter().flatten().flatten().map(|h| h * h).collect();
    if left.is_empty() { 0.0 } else { mean(left.into_iter()).sqrt() }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use super::*;

    /// Two walls of a pipe along x as two shots saw them, the second's further out by `off_mm`.
    fn pipe(off_mm: f64) -> (Vec<[f64; 3]>, Vec<u8>, Vec<u16>) {
        let (mut points, mut labels, mut shots) = (Vec::new(), Vec::new(), Vec::new());
        for shot in 0..2_u16 {
            for k in 0..200 {
                for j in 0..200 {
                    let (angle, x) = (f64::from(k) * 0.003, f64::from(j) * 0.5 - 50.0);
                    let radius = 150.0 + if shot == 1 { off_mm } else { 0.0 };
                    points.push([x + 7.0, radius * angle.cos() - 3.0, radius * angle.sin() + 2.0]);
                    labels.push(if x.abs() < 5.0 { Label::Bead as u8 } else { 1 + u8::from(x > 0.0) });
                    shots.push(3 * shot);
                }
            }
        }
        (points, labels, shots)
    }

    fn compare(off_mm: f64, numbers: &[u16]) -> Vec<Difference> {
        let (points, labels, shots) = pipe(off_mm);
        let cloud = WallCloud { points: &points, labels: &labels, shots: &shots };
        wall_differences(&cloud, numbers, Vec3::new(-20.0, -3.0, 2.0), Vec3::new(2.0, 0.0, 0.0)).unwrap()
    }

    #[test]
    fn a_wall_that_stands_out_is_found_by_how_much() {
        for off_mm in [0.0, 0.3, -0.2] {
            let found = compare(off_mm, &[0, 3]);
            let [pair] = found.as_slice() else { panic!("{found:?}") };
            // Cells hold the same points of both shots but for those on their borders.
            assert!((pair.difference_mm - off_mm).abs() < 1e-9 && (pair.rms_mm - off_mm.abs()).abs() < 1e-3);
            assert!(pair.scatter_mm < 1e-9 && pair.cells > 300 && (pair.one, pair.other) == (0, 1));
            assert!((pair.middle_mm.x - 7.0).abs() < 3.0);
        }
        assert!((compare(0.3, &[3, 0])[0].difference_mm + 0.3).abs() < 1e-9);
        assert!(compare(0.3, &[0, 1]).is_empty());
    }

    #[test]
    fn the_bits_do_not_hang_on_the_number_of_threads() {
        let mut seen = Vec::new();
        for n in [1, 2, 8] {
            threads::set_threads(Some(n)).unwrap();
            seen.push(compare(0.123, &[0, 3]));
        }
        threads::set_threads(None).unwrap();
        assert!(seen.windows(2).all(|w| w[0] == w[1]));
    }

    #[test]
    fn waves_are_what_is_neither_the_pipes_form_nor_a_drawn_in_end() {
        let mut wall = (Vec::new(), Vec::new(), Vec::new());
        let amplitude = 0.1;
        for k in 0..200 {
            for j in 0..100 {
                let (angle, along) = (f64::from(k) / 200.0 * 0.8 + 2.9, f64::from(j) / 100.0 * 80.0 + 10.0);
                wall.0.push(if angle > TAU / 2.0 { angle - TAU } else { angle });
                wall.1.push(along);
                wall.2.push((3.0 * angle).cos() + (-along / 20.0).exp());
            }
        }
        let course = Course::of_radius(150.0).unwrap();
        let plain = form(course, &wall.0, &wall.1, &wall.2).unwrap();
        assert!(plain.waves_mm < 1e-6 && (plain.half_arc_rad - 0.98 * 0.4).abs() < 0.01);
        assert!((plain.middle_rad - (3.3 - TAU)).abs() < 0.01);
        let sign = |v: f64| if v.rem_euclid(2.0) < 1.0 { amplitude } else { -amplitude };
        for ((d, a), z) in wall.2.iter_mut().zip(&wall.0).zip(&wall.1) {
            *d += sign((a.rem_euclid(TAU) - 2.9) / 0.08) * sign((z - 10.0) / 8.0) / amplitude;
        }
        let waved = form(course, &wall.0, &wall.1, &wall.2).unwrap();
        assert!((waved.waves_mm / amplitude - 1.0).abs() < 0.1, "{waved:?}");
        assert!(form(course, &[], &[], &[]).is_none());
    }

    #[test]
    fn what_does_not_belong_together_is_refused() {
        let cloud = WallCloud { points: &[[0.0; 3]], labels: &[], shots: &[0] };
        assert!(matches!(wall_differences(&cloud, &[0], Vec3::zeros(), Vec3::x()), Err(Error::Shape { .. })));
        let cloud = WallCloud { labels: &[1], ..cloud };
        assert!(matches!(wall_differences(&cloud, &[0], Vec3::zeros(), Vec3::zeros()), Err(Error::Degenerate { .. })));
        let cloud = WallCloud { points: &[[f64::NAN; 3]], ..cloud };
        assert!(matches!(wall_differences(&cloud, &[0], Vec3::zeros(), Vec3::x()), Err(Error::NonFinite { .. })));
    }
}
