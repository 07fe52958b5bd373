//! A pipe of known size found in a shot, roughly: what the walls are then sought in.

use nalgebra::Matrix3;
use rayon::prelude::*;

use super::seam::{Course, Seam};
use crate::clouds::normals;
use crate::error::{Error, Result, require_count};
use crate::ground::robust::{MEDIAN_TO_SIGMA, TUKEY_SIGMAS, median, tukey};
use crate::ground::stop::polled;
use crate::ground::threads;
use crate::ground::transform::Vec3;

/// Normals that the coarse frame is found from: where half of the pixels hold nothing, one in thirty has its four neighbours. With
/// 6000 the axis leans enough to blur what lies beside a dent.
const COARSE_POINTS: f64 = 20_000.0;

/// Neighbours that a normal of a bare point is of.
const CLOUD_NEIGHBOURS: usize = 16;

/// What is known of the part before it is scanned, in the frame of the points.
#[derive(Debug, Clone, Copy)]
pub struct Nominal {
    /// How the seam runs, by the part's rated size.
    pub course: Course,
    /// Of the part.
    pub wall_thickness_mm: f64,
    /// From the reference wall to the other wall; without it the axis comes from the points, and points to the right of
    /// the image (or down, where it runs so).
    pub axis: Option<Vec3>,
    /// Towards angle 0; without it angle 0 faces the scanner.
    pub zero: Option<Vec3>,
}

/// The normal at pixel (row, column) from its neighbours `reach` away, towards the scanner; `None` at holes and edges.
fn normal(points: &[[f64; 3]], width: usize, row: usize, column: usize, reach: usize) -> Option<Vec3> {
    let at = |r: usize, c: usize| points.get(r * width + c).map(|p| Vec3::from(*p)).filter(|p| p.x.is_finite());
    let (up, left) = (row.checked_sub(reach)?, column.checked_sub(reach)?);
    let right = (column + reach < width).then_some(column + reach)?;
    let here = at(row, column)?;
    let n =
        (at(row, right)? - at(row, left)?).cross(&(at(row + reach, column)? - at(up, column)?)).try_normalize(0.0)?;
    Some(if n.dot(&here) > 0.0 { -n } else { n })
}

/// Points of a grid with their normals, over a twentieth of the radius at most: the surface must be nearly flat there, and
/// longer is less noisy.
fn of_grid(points: &[[f64; 3]], width: usize) -> Vec<(Vec3, Vec3)> {
    let height = points.len() / width;
    let stride = ((points.len() as f64 / COARSE_POINTS).sqrt() as usize).max(1);
    let reach = (width.min(height) / 100).clamp(1, 8);
    let rows: Vec<usize> = (0..height).step_by(stride).collect();
    let found: Vec<Vec<(Vec3, Vec3)>> = threads::install(|| {
        rows.par_iter()
            .inspect(polled)
            .map(|&r| {
                let pick = |c| Some((Vec3::from(points[r * width + c]), normal(points, width, r, c, reach)?));
                (0..width).step_by(stride).filter_map(pick).collect()
            })
            .collect()
    });
    found.into_iter().flatten().collect()
}

/// Points in any order with their normals, a sample of them.
fn of_cloud(points: &[[f64; 3]]) -> Result<Vec<(Vec3, Vec3)>> {
    let stride = points.len().div_ceil(COARSE_POINTS as usize).max(1);
    let sample: Vec<[f64; 3]> = points.iter().step_by(stride).filter(|p| p[0].is_finite()).copied().collect();
    require_count("part points", 100, sample.len())?;
    let normals = normals::of_cloud(&sample, CLOUD_NEIGHBOURS, [0.0; 3])?;
    let pairs = sample.iter().zip(normals).map(|(p, n)| (Vec3::from(*p), Vec3::from(n)));
    Ok(pairs.filter(|(_, n)| n.x.is_finite()).collect())
}

/// A cylinder of the nominal radius near the points, a grid or bare ones in one column or row: axis from the normals, place from a
/// vote of `p - R n`, both then refined with the points that agree. Degrees and millimetres suffice.
pub(super) fn coarse_frame(points: &[[f64; 3]], width: usize, nominal: &Nominal) -> Result<Seam> {
    let seen = if width == 1 || width == points.len() { of_cloud(points)? } else { of_grid(points, width) };
    require_count("part points with a normal", 100, seen.len())?;
    let axis = axis_from_normals(&seen, nominal)?;
    let middle = seen.iter().map(|(p, _)| p).sum::<Vec3>() / seen.len() as f64;
    let zero = nominal.zero.unwrap_or_else(|| {
        // Towards the scanner, which is at the origin of its own frame.
        let view = -middle;
        view - axis * axis.dot(&view)
    });
    let mut frame = Seam::new(middle, axis, zero, nominal.course)?;
    frame.origin_mm = vote_centre(&seen, &frame);
    refine_centre(&seen, &mut frame);
    Ok(frame)
}

/// The direction to which the normals are most square, started at the nominal one and reweighted, with its sign.
fn axis_from_normals(seen: &[(Vec3, Vec3)], nominal: &Nominal) -> Result<Vec3> {
    let prior = nominal.axis;
    let mut axis = prior.map(|a| a.normalize());
    let mut told = false;
    for _ in 0..6 {
        // Flanks of the bead and rubbish lean towards the axis: weight them down by what is usual.
        let scale = axis.map(|a| {
            let mut lean: Vec<f64> = seen.iter().map(|(_, n)| n.dot(&a).abs()).collect();
            3.0 * MEDIAN_TO_SIGMA * median(&mut lean).max(1e-3)
        });
        let (mut spread, mut weight) = (Matrix3::zeros(), 0.0);
        for (_, n) in seen {
            let w = match (axis, scale) {
                (Some(a), Some(s)) => tukey(n.dot(&a) / s),
                _ => 1.0,
            };
            spread += n * n.transpose() * w;
            weight += w;
        }
        let eigen = spread.symmetric_eigen();
        let mut order = [0, 1, 2];
        order.sort_by(|&i, &j| eigen.eigenvalues[i].total_cmp(&eigen.eigenvalues[j]));
        // On a short arc the normals hardly turn about the axis; then only what is known beforehand tells the axis.
        let [lean, turn] = [eigen.eigenvalues[order[0]], eigen.eigenvalues[order[1]]];
        // Nor do they where a wall so little curved would turn them less than they lean: what turns them is something else.
        let around = eigen.eigenvectors.column(order[1]).into_owned();
        let due = variance(seen.iter().map(|(p, _)| p.dot(&around))) / nominal.course.radius_mm().powi(2);
        told = turn > 4.0 * lean && (prior.is_none() || due * weight > 4.0 * lean);
        if !told && prior.is_some() {
            break;
        }
        axis = Some(eigen.eigenvectors.column(order[0]).into());
    }
    let Some(axis) = axis.filter(|_| told || prior.is_some()) else {
        let reason = "the arc in view is too short to show the pipe's axis; give part.axis_base".into();
        return Err(Error::Degenerate { what: "pipe axis", reason });
    };
    let sign = match prior {
        Some(p) => axis.dot(&p),
        None if axis.x.abs() >= axis.y.abs() => axis.x,
        None => axis.y,
    };
    Ok(if sign < 0.0 { -axis } else { axis })
}

fn variance(values: impl Iterator<Item = f64>) -> f64 {
    let (mut count, mut sum, mut square) = (0.0, 0.0, 0.0);
    for value in values {
        (count, sum, square) = (count + 1.0, sum + value, square + value * value);
    }
    (square / count - (sum / count).powi(2)).max(0.0)
}

/// Where most of `p - R n` meet across the axis: the fullest of cells of a twentieth of the radius, and its mean.
fn vote_centre(seen: &[(Vec3, Vec3)], frame: &Seam) -> Vec3 {
    let square = frame.square();
    let cell = frame.course.radius_mm() / 20.0;
    let place = |p: &Vec3, n: &Vec3| {
        let v = p - n * frame.course.radius_mm() - frame.origin_mm;
        (v.dot(&frame.zero), v.dot(&square))
    };
    let mut votes: std::collections::BTreeMap<(i64, i64), (usize, f64, f64)> = Default::default();
    for (p, n) in seen {
        let (x, y) = place(p, n);
        let entry = votes.entry(((x / cell).floor() as i64, (y / cell).floor() as i64)).or_default();
        *entry = (entry.0 + 1, entry.1 + x, entry.2 + y);
    }
    let Some((_, &(count, x, y))) = votes.iter().max_by_key(|(key, value)| (value.0, std::cmp::Reverse(**key))) else {
        return frame.origin_mm;
    };
    frame.origin_mm + (frame.zero * x + square * y) / count as f64
}

/// Moves the axis sideways to the least squares of the radial deviations, reweighted; in place.
fn refine_centre(seen: &[(Vec3, Vec3)], frame: &mut Seam) {
    let square = frame.square();
    let radius = frame.course.radius_mm();
    for _ in 0..10 {
        // Direction from the axis, and distance from the surface.
        let placed = |(p, _): &(Vec3, Vec3)| {
            let v = p - frame.origin_mm;
            let (x, y) = (v.dot(&frame.zero), v.dot(&square));
            let r = (x * x + y * y).sqrt();
            [x / r, y / r, r - radius]
        };
        let places: Vec<[f64; 3]> = seen.iter().map(placed).filter(|p| p[0].is_finite()).collect();
        let mut sizes: Vec<f64> = places.iter().map(|p| p[2].abs()).collect();
        let scale = TUKEY_SIGMAS * MEDIAN_TO_SIGMA * median(&mut sizes).max(1e-6);
        let (mut xx, mut xy, mut yy, mut bx, mut by) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for [c, s, d] in places {
            let w = tukey(d / scale);
            xx += w * c * c;
            xy += w * c * s;
            yy += w * s * s;
            bx += w * c * d;
            by += w * s * d;
        }
        let det = xx * yy - xy * xy;
        if det <= 1e-9 * xx.max(yy).powi(2) {
            return;
        }
        let (dx, dy) = ((yy * bx - xy * by) / det, (xx * by - xy * bx) / det);
        frame.origin_mm += frame.zero * dx + square * dy;
        if dx.hypot(dy) < 1e-6 * radius {
            return;
        }
    }
}
