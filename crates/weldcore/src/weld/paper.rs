//! The paper's own evaluation (its section 6), step by step, on the combined cloud in base.
//!
//! 1. centroid of the combined cloud, distance of every point from it;
//! 2. drop the weld by that distance, and split what is left in two;
//! 3. the modelled pipe as a cloud;
//! 4. ICP of the one part to the model;
//! 5. nearest neighbour of the other part's points in the model;
//! 6. histogram of the distances; of its bins those with at least 20 % of the highest count are kept, and their
//!    count-weighted mean is the misalignment.
//!
//! Where the paper leaves a choice, or its letter would not work, the choice is said at the step. The result is unsigned
//! and has neither an angle nor an uncertainty of its own: it is kept to compare with the paper; [`step`](super::step)
//! is the better.
//!
//! Sources: Filippov et al., Welded joints geometry testing by means of automated structured light scanning; D. Freedman and
//! P. Diaconis, Z. Wahrscheinlichkeitstheorie verw. Gebiete 57 (1981) 453 for the width of a bin.

use std::collections::BTreeSet;

use crate::clouds::distance::Target;
use crate::clouds::icp::{self, Metric, Options};
use crate::clouds::kdtree::KdTree;
use crate::error::{Error, Result, require_finite, require_positive};
use crate::ground::memory::require;
use crate::ground::robust::{MEDIAN_TO_SIGMA, median_between, quantile};
use crate::ground::threads;
use crate::ground::transform::Vec3;

/// The paper's rule: bins with fewer counts than this part of the highest are not "reliable".
const KEPT_PART: f64 = 0.20;
/// A wall's points lie within this many robust sigma of its median centroid distance; weld metal does not.
const WALL_SIGMAS: f64 = 3.0;
/// A wall of fewer points is none.
const LEAST_POINTS: usize = 100;
/// Points that take part: every k-th of the combined cloud (the paper's had 150,066), and of them those that ICP needs.
const POINTS: usize = 100_000;
const ICP_POINTS: usize = 10_000;
/// Spacing of the modelled pipe's points. Distances are counted along the model's normals: it does not enter them.
const MODEL_SPACING_MM: f64 = 1.0;
/// The model reaches over the scan by so many spacings, so that no point finds its nearest neighbour at its edge.
const MARGIN: i64 = 4;
/// At most so many of them, a whole girth of 1220 mm a metre long: shots placed further apart are not of one part.
const MODEL_POINTS: f64 = 4e6;
/// Rings along the axis in which the weld is sought, and the share of the points beyond which single ones do not count.
const RINGS: usize = 200;
const STRAYS: f64 = 0.001;
/// Bins at most.
const MOST_BINS: f64 = 2000.0;

/// The distances of the one wall from the pipe that fits the other.
#[derive(Debug, Clone, PartialEq)]
pub struct Histogram {
    /// Borders of the bins, one more than bins.
    pub edges_mm: Vec<f64>,
    /// Points in each.
    pub counts: Vec<i64>,
    /// Whether a bin counts.
    pub kept: Vec<bool>,
    /// The misalignment: count-weighted mean of the bins that count.
    pub step_mm: f64,
}

/// The pipe to whose surface everything is held: a point of its axis, its unit direction from the reference wall to the
/// other wall, its radius (the real one, where the arc shows it).
#[derive(Debug, Clone, Copy)]
pub struct Pipe {
    /// On the axis.
    pub origin_mm: Vec3,
    /// Unit.
    pub axis: Vec3,
    /// Outer.
    pub radius_mm: f64,
}

impl Pipe {
    fn axial(&self, p: &[f64; 3]) -> f64 {
        (Vec3::from(*p) - self.origin_mm).dot(&self.axis)
    }
}

/// The misalignment as the paper computes it, of the points of a whole part in base.
///
/// # Errors
/// [`Error::NonFinite`], [`Error::OutOfRange`] for the radius, [`Error::NoAnswer`] where one of the parts has no points left or
/// the points reach too far, and what [`icp::register`] says where it finds nothing to hold on to.
pub fn misalignment(points: &[[f64; 3]], pipe: &Pipe) -> Result<Histogram> {
    require_finite("points_mm", points)?;
    require_finite("pipe axis", &[pipe.origin_mm.into(), pipe.axis.into()])?;
    require_positive("radius_mm", pipe.radius_mm)?;
    let points: Vec<[f64; 3]> = points.iter().copied().step_by((points.len() / POINTS).max(1)).collect();
    let axial: Vec<f64> = points.iter().map(|p| pipe.axial(p)).collect();
    let excess = centroid_excess(&points, &axial, pipe);
    let seam = seam_place(&axial, &excess);
    let [reference, other] = [-1.0, 1.0].map(|side| -> Result<Vec<[f64; 3]>> {
        let of_side = (0..points.len()).filter(|&i| side * (axial[i] - seam) > 0.0).collect();
        Ok(without_weld(of_side, &excess)?.iter().map(|&i| points[i]).collect())
    });
    let (reference, other) = (reference?, other?);
    let (model, normals) = modelled_pipe(&points, pipe)?;
    let source: Vec<[f64; 3]> = reference.iter().copied().step_by((reference.len() / ICP_POINTS).max(1)).collect();
    let tree = KdTree::new(&model)?;
    let options = Options { metric: Metric::Plane, ..Options::default() };
    let fit = icp::register(&source, &Target::Cloud(&tree, Some(&normals)), &options)?;
    let moved = threads::map_chunks(&other, |_, chunk| {
        chunk.iter().map(|p| fit.target_from_source.apply(&Vec3::from(*p)).into()).collect::<Vec<[f64; 3]>>()
    });
    let placed = moved.concat();
    let (_, nearest) = tree.nearest(&placed)?;
    let distance = |(p, k): (&[f64; 3], &u32)| {
        let (q, normal) = (Vec3::from(model[*k as usize]), Vec3::from(normals[*k as usize]));
        (Vec3::from(*p) - q).dot(&normal).abs()
    };
    Ok(histogram(&placed.iter().zip(&nearest).map(distance).collect::<Vec<f64>>()))
}

/// Steps 1, 2: how much further from the centroid each point is than the modelled pipe at its place, mm.
///
/// The bare distance from the centroid grows along and across a curved wall by centimetres, in which a weld 2 mm high
/// does not show; less what the model's own form has at the same place it does.
fn centroid_excess(points: &[[f64; 3]], axial: &[f64], pipe: &Pipe) -> Vec<f64> {
    let sums = threads::map_chunks(points, |_, chunk| chunk.iter().map(|p| Vec3::from(*p)).sum::<Vec3>());
    let centroid = sums.into_iter().sum::<Vec3>() / points.len() as f64;
    let parts = threads::map_chunks(points, |start, chunk| {
        let excess = |(k, p): (usize, &[f64; 3])| {
            let (p, on_axis) = (Vec3::from(*p), pipe.origin_mm + pipe.axis * axial[start + k]);
            let outward = p - on_axis;
            let modelled = on_axis + outward * (pipe.radius_mm / outward.norm());
            (p - centroid).norm() - (modelled - centroid).norm()
        };
        chunk.iter().enumerate().map(excess).collect::<Vec<f64>>()
    });
    parts.concat()
}

/// Where along the axis the weld is: the ring whose median excess departs most from the two walls' own.
fn seam_place(axial: &[f64], excess: &[f64]) -> f64 {
    let mut sorted = axial.to_vec();
    let (low, high) = (quantile(&mut sorted, STRAYS), quantile(&mut sorted, 1.0 - STRAYS));
    let mut rings: Vec<Vec<f64>> = vec![Vec::new(); RINGS];
    for (a, e) in axial.iter().zip(excess) {
        let ring = ((a - low) / (high - low) * RINGS as f64) as usize;
        rings[ring.min(RINGS - 1)].push(*e);
    }
    let medians: Vec<f64> = rings.iter_mut().map(|ring| median_between(ring)).collect();
    let usual = median_between(&mut medians.iter().copied().filter(|m| m.is_finite()).collect::<Vec<f64>>());
    let mut most = (0, -1.0);
    for (ring, m) in medians.iter().enumerate() {
        if (m - usual).abs() > most.1 {
            most = (ring, (m - usual).abs());
        }
    }
    low + (most.0 as f64 + 0.5) / RINGS as f64 * (high - low)
}

/// Step 2, of one side of the seam: what stands out of the wall, weld metal, is dropped.
fn without_weld(mut part: Vec<usize>, excess: &[f64]) -> Result<Vec<usize>> {
    for _ in 0..2 {
        if part.len() < LEAST_POINTS {
            let reason = "hardly a point is left of one wall when the weld is dropped".into();
            return Err(Error::NoAnswer { reason });
        }
        let middle = median_between(&mut part.iter().map(|&i| excess[i]).collect::<Vec<f64>>());
        let off = |i: usize| (excess[i] - middle).abs();
        let spread = MEDIAN_TO_SIGMA * median_between(&mut part.iter().map(|&i| off(i)).collect::<Vec<f64>>());
        part.retain(|&i| off(i) <= WALL_SIGMAS * spread);
    }
    Ok(part)
}

/// Points and their unit normals.
type Oriented = (Vec<[f64; 3]>, Vec<[f64; 3]>);

/// Step 3: the pipe's surface as a cloud with outward normals, over the arcs and the length that were scanned.
fn modelled_pipe(points: &[[f64; 3]], pipe: &Pipe) -> Result<Oriented> {
    let across = pipe.axis.cross(&Vec3::ith(pipe.axis.abs().imin(), 1.0)).normalize();
    let square = pipe.axis.cross(&across);
    let step = MODEL_SPACING_MM / pipe.radius_mm;
    let parts = threads::map_chunks(points, |_, chunk| {
        let mut part = (f64::INFINITY, f64::NEG_INFINITY, BTreeSet::new());
        for p in chunk {
            let v = Vec3::from(*p) - pipe.origin_mm;
            let axial = v.dot(&pipe.axis);
            part.0 = axial.min(part.0);
            part.1 = axial.max(part.1);
            part.2.insert((v.dot(&square).atan2(v.dot(&across)) / step).floor() as i64);
        }
        part
    });
    let low = parts.iter().map(|p| p.0).fold(f64::INFINITY, f64::min);
    let high = parts.iter().map(|p| p.1).fold(f64::NEG_INFINITY, f64::max);
    let with_margin = |turn: &i64| -> [i64; 2 * MARGIN as usize + 1] {
        std::array::from_fn(|k| turn.saturating_add(k as i64 - MARGIN))
    };
    let turns: BTreeSet<i64> = parts.iter().flat_map(|p| &p.2).flat_map(with_margin).collect();
    let length = (high - low) / MODEL_SPACING_MM + 2.0 * MARGIN as f64;
    let size = length * turns.len() as f64;
    if size.is_nan() || size > MODEL_POINTS {
        let reach = if high - low < 1e4 { format!("{:.0}", high - low) } else { format!("{:.3e}", high - low) };
        let reason = format!("the points reach over {reach} mm of the pipe: no modelled pipe is so long");
        return Err(Error::NoAnswer { reason });
    }
    let outward: Vec<Vec3> = turns
        .iter()
        .map(|&turn| {
            let (sin, cos) = (turn as f64 * step).sin_cos();
            across * cos + square * sin
        })
        .collect();
    require(length as usize * outward.len(), 48);
    let mut model = (Vec::new(), Vec::new());
    for row in 0..length.ceil() as usize {
        let axial = low + (row as f64 - MARGIN as f64) * MODEL_SPACING_MM;
        for normal in &outward {
            model.0.push((pipe.origin_mm + pipe.axis * axial + normal * pipe.radius_mm).into());
            model.1.push((*normal).into());
        }
    }
    Ok(model)
}

/// Step 6: the histogram, the 20 % rule and the weighted mean.
fn histogram(distances_mm: &[f64]) -> Histogram {
    let mut sorted = distances_mm.to_vec();
    let (low, high) = (quantile(&mut sorted, 0.25), quantile(&mut sorted, 0.75));
    let width = 2.0 * (high - low) / (distances_mm.len() as f64).cbrt();
    // Far outliers would ask for millions of bins; they end in none that is kept.
    let limit = (high + 20.0 * (high - low)).max(1e-12);
    let bins = ((high + 20.0 * (high - low)) / width.max(1e-12)).ceil().clamp(1.0, MOST_BINS) as usize;
    let mut edges_mm: Vec<f64> = (0..bins).map(|k| k as f64 * (limit / bins as f64)).collect();
    edges_mm.push(limit);
    let mut counts = vec![0_i64; bins];
    for d in distances_mm.iter().filter(|d| **d <= limit) {
        let behind = edges_mm.partition_point(|edge| edge <= d);
        counts[behind.clamp(1, bins) - 1] += 1;
    }
    let highest = counts.iter().copied().max().unwrap_or(0) as f64;
    let kept: Vec<bool> = counts.iter().map(|&n| n as f64 >= KEPT_PART * highest).collect();
    let (mut total, mut weight) = (0.0, 0.0);
    for (k, _) in kept.iter().enumerate().filter(|(_, kept)| **kept) {
        total += (edges_mm[k] + edges_mm[k + 1]) / 2.0 * counts[k] as f64;
        weight += counts[k] as f64;
    }
    let used = counts.iter().rposition(|&n| n > 0).map_or(0, |last| last + 1);
    edges_mm.truncate(used + 1);
    Histogram { step_mm: total / weight, kept: kept[..used].to_vec(), counts: counts[..used].to_vec(), edges_mm }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ground::random::Counter;

    /// The walls' step varies by 1 % of itself over the arc seen; the bins are a few hundredths wide.
    const TOLERANCE_MM: f64 = 0.01;

    fn pipe() -> Pipe {
        Pipe { origin_mm: Vec3::new(900.0, 40.0, 300.0), axis: Vec3::new(0.6, 0.0, 0.8), radius_mm: 315.0 }
    }

    /// Two walls with a bead of 12 mm between them: the other wall's radius is `step_mm` larger.
    fn weld(step_mm: f64) -> Vec<[f64; 3]> {
        let (random, pipe) = (Counter::new(3), pipe());
        let across = Vec3::new(0.8, 0.0, -0.6);
        let point = |k: u64| {
            let unit = |j| random.below(4 * k + j, 1_000_001) as f64 / 1e6;
            let (axial, angle, noise) = (100.0 * unit(0) - 50.0, 0.44 * unit(1) - 0.22, 0.04 * unit(2) - 0.02);
            let height = if axial > 0.0 { step_mm } else { 0.0 } + 1.8 * (1.0 - (axial / 6.0).powi(2)).max(0.0);
            let outward = across * angle.cos() + pipe.axis.cross(&across) * angle.sin();
            (pipe.origin_mm + pipe.axis * axial + outward * (pipe.radius_mm + height + noise)).into()
        };
        (0..60_000).map(point).collect()
    }

    #[test]
    fn the_step_of_two_walls_even_from_a_start_that_is_off() {
        for step_mm in [0.2, 1.5, -0.47] {
            let found = misalignment(&weld(step_mm), &pipe()).unwrap();
            assert!((found.step_mm - f64::abs(step_mm)).abs() < TOLERANCE_MM, "{}", found.step_mm);
            let off = Pipe { origin_mm: pipe().origin_mm + Vec3::new(0.2, -0.3, 0.1), ..pipe() };
            assert!((misalignment(&weld(step_mm), &off).unwrap().step_mm - f64::abs(step_mm)).abs() < TOLERANCE_MM);
        }
    }

    #[test]
    fn the_20_percent_rule_by_hand() {
        // Four even lumps of distances. The far one is a tenth as dense as the highest and must not be averaged in.
        let lumps = [(0.3, 0.4, 300), (0.4, 0.6, 2000), (0.6, 0.7, 300), (0.9, 1.0, 100)];
        let lump = |(low, high, n): (f64, f64, usize)| (0..n).map(move |k| low + (high - low) * k as f64 / n as f64);
        let distances: Vec<f64> = lumps.into_iter().flat_map(lump).collect();
        let found = histogram(&distances);
        assert_eq!(found.counts.iter().sum::<i64>(), 2700);
        let highest = *found.counts.iter().max().unwrap() as f64;
        let width = found.edges_mm[1];
        for (k, kept) in found.kept.iter().enumerate() {
            assert_eq!(*kept, found.counts[k] as f64 >= 0.2 * highest);
            let centre = (found.edges_mm[k] + found.edges_mm[k + 1]) / 2.0;
            assert!(!kept || centre <= 0.7 + width);
            assert!(*kept || !(centre > 0.4 && centre < 0.6));
        }
        // Symmetric about 0.5 without the far lump; with it the mean would be 0.517.
        assert!((found.step_mm - 0.5).abs() < 0.003);
        assert!((histogram(&[0.3; 1000]).step_mm - 0.3).abs() < 0.15);
    }

    #[test]
    fn the_modelled_pipe_covers_the_scan() {
        let (cloud, pipe) = (weld(0.47), pipe());
        let (model, normals) = modelled_pipe(&cloud, &pipe).unwrap();
        let mut reach = (0.0_f64, 0.0_f64);
        for (p, n) in model.iter().zip(&normals) {
            let v = Vec3::from(*p) - pipe.origin_mm;
            let from_axis = v - pipe.axis * v.dot(&pipe.axis);
            assert!((from_axis.norm() - pipe.radius_mm).abs() < 1e-9);
            assert!((from_axis / pipe.radius_mm - Vec3::from(*n)).norm() < 1e-12);
            reach = (reach.0.min(pipe.axial(p)), reach.1.max(pipe.axial(p)));
        }
        assert!(reach.0 < -50.0 - 2.0 * MODEL_SPACING_MM && reach.1 > 50.0 + 2.0 * MODEL_SPACING_MM);
        let (distance, _) = KdTree::new(&model).unwrap().nearest(&cloud).unwrap();
        // Half a cell's diagonal, and the bead on its wall with its noise.
        let most = (MODEL_SPACING_MM / 2f64.sqrt()).hypot(0.47 + 1.8 + 0.02);
        assert!(distance.iter().all(|d| *d < most));
    }

    #[test]
    fn what_gives_no_answer_says_so() {
        let few: Vec<[f64; 3]> = weld(0.47).into_iter().step_by(400).collect();
        let error = misalignment(&few, &pipe()).unwrap_err();
        assert!(error.to_string().starts_with("hardly a point is left of one wall"), "{error}");
        let far: Vec<[f64; 3]> = [-1e7, 1e7].map(|x| (pipe().axis * x).into()).into();
        assert!(modelled_pipe(&far, &pipe()).unwrap_err().to_string().contains("reach over 2.000e7 mm of the pipe"));
        assert!(matches!(misalignment(&[[f64::NAN; 3]], &pipe()), Err(Error::NonFinite { .. })));
        assert!(misalignment(&few, &Pipe { radius_mm: 0.0, ..pipe() }).is_err());
        assert!(matches!(misalignment(&[], &pipe()), Err(Error::NoAnswer { .. })));
    }
}
