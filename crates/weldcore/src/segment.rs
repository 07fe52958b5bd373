//! A scanned part into reference wall, other wall and bead, without seeds.
//!
//! The shot is unrolled about the pipe: angle, axial coordinate, radial deviation. The unrolled view is cut into sectors,
//! each sector's axial profile (medians of narrow axial bins) is explained by two straight walls and what lies between
//! them. Where each wall ends minimises, for the wall from the edge of the view to a place `t`,
//!
//! `SSE of its straight line over [edge, t]  +  λ · (bins beyond t)`,
//!
//! that is: a bin belongs to the wall as long as it departs from the wall's line by less than √λ, which is the larger of one
//! point's noise and three times the unevenness of the walls themselves, both estimated from the profile. The line's tilt
//! and height are free in each sector, so that neither an inexact pipe model nor a tilted wall matters. A weld's toe
//! fades in: between the wall and the first bin that shows it lies a strip which looks like wall and is not. Its width
//! follows from the flank: a parabola that crosses √λ at a distance x from its foot crosses 4 √λ at 2 x.

use nalgebra::Matrix3;
use rayon::prelude::*;

use crate::Vec3;
use crate::error::{Error, Result, require_positive};
use crate::fit::{Noise, cylinder};
use crate::statistics::median;
use crate::threads;

/// What a point belongs to; the numbers are those of `weldscan.result.Label`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Label {
    /// No point, or nothing of the weld.
    None = 0,
    /// The wall that the step is counted from.
    ReferenceWall = 1,
    /// The wall behind the weld, along the axis.
    OtherWall = 2,
    /// The weld metal.
    Bead = 3,
}

/// A pipe's axis with the origins of angle and axial coordinate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PipeFrame {
    /// On the axis, at the seam's centreline.
    pub origin_mm: Vec3,
    /// Unit, from the reference wall to the other wall.
    pub axis: Vec3,
    /// Unit, at right angles to the axis: angle 0. Angles are right-handed about the axis.
    pub zero: Vec3,
    /// Of the reference wall.
    pub radius_mm: f64,
}

impl PipeFrame {
    /// A frame whose zero direction is the given one made square to the axis.
    ///
    /// # Errors
    /// [`Error::Degenerate`] where the zero mark lies along the axis.
    pub fn new(origin_mm: Vec3, axis: Vec3, zero: Vec3, radius_mm: f64) -> Result<Self> {
        let what = "pipe frame";
        let axis = axis
            .try_normalize(0.0)
            .ok_or_else(|| Error::Degenerate { what, reason: "the axis has no direction".into() })?;
        let zero = (zero - axis * axis.dot(&zero))
            .try_normalize(1e-6 * zero.norm())
            .ok_or_else(|| Error::Degenerate { what, reason: "the zero mark lies along the axis".into() })?;
        require_positive("pipe radius", radius_mm)?;
        Ok(Self { origin_mm, axis, zero, radius_mm })
    }

    /// Angle (rad, in [-π, π]), axial coordinate and radial deviation (mm) of a point.
    #[inline]
    pub fn unroll(&self, p: &[f64; 3]) -> [f64; 3] {
        let v = Vec3::from(*p) - self.origin_mm;
        let axial = v.dot(&self.axis);
        let (x, y) = (v.dot(&self.zero), v.dot(&self.axis.cross(&self.zero)));
        [y.atan2(x), axial, x.hypot(y) - self.radius_mm]
    }
}

/// A shot's points in a [`PipeFrame`], pixel by pixel; NaN where there is no point.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Unrolled {
    /// Angle about the axis, rad, in [-π, π].
    pub angle_rad: Vec<f32>,
    /// Along the axis, mm.
    pub axial_mm: Vec<f32>,
    /// Radial deviation from the reference wall's cylinder, mm.
    pub deviation_mm: Vec<f32>,
}

impl Unrolled {
    /// Unrolls every point.
    pub fn of(points: &[[f64; 3]], frame: &PipeFrame) -> Self {
        let square = frame.axis.cross(&frame.zero);
        let parts = threads::map_chunks(points, |_, chunk| {
            let mut part = Self::default();
            for p in chunk {
                let v = Vec3::from(*p) - frame.origin_mm;
                let (x, y) = (v.dot(&frame.zero), v.dot(&square));
                part.angle_rad.push((y as f32).atan2(x as f32));
                part.axial_mm.push(v.dot(&frame.axis) as f32);
                part.deviation_mm.push(((x * x + y * y).sqrt() - frame.radius_mm) as f32);
            }
            part
        });
        let gather = |pick: fn(&Self) -> &Vec<f32>| {
            let mut all = Vec::with_capacity(points.len());
            parts.iter().for_each(|p| all.extend_from_slice(pick(p)));
            all
        };
        Self {
            angle_rad: gather(|p| &p.angle_rad),
            axial_mm: gather(|p| &p.axial_mm),
            deviation_mm: gather(|p| &p.deviation_mm),
        }
    }
}

/// What is known of the part before it is scanned, in the frame of the points.
#[derive(Debug, Clone, Copy)]
pub struct Nominal {
    /// Outer radius of the pipe.
    pub radius_mm: f64,
    /// Of the pipe.
    pub wall_thickness_mm: f64,
    /// From the reference wall to the other wall; without it the axis comes from the points, and points to the right of
    /// the image (or down, where it runs so).
    pub axis: Option<Vec3>,
    /// Towards angle 0; without it angle 0 faces the scanner.
    pub zero: Option<Vec3>,
}

/// A segmented shot.
#[derive(Debug, Clone)]
pub struct Segmentation {
    /// The reference wall's cylinder with its origins.
    pub frame: PipeFrame,
    /// A [`Label`] per point.
    pub labels: Vec<u8>,
    /// The points in `frame`.
    pub unrolled: Unrolled,
    /// Noise of one point across the wall (robust, 1 sigma).
    pub noise_mm: f64,
    /// Mean distance between the toes.
    pub bead_width_mm: f64,
    /// Whether the radius was fitted; otherwise the arc was too short for it and it is the nominal one.
    pub radius_fitted: bool,
}

/// Points further from the pipe than this many wall thicknesses are something else: neither a step nor the
/// reinforcement of a weld comes near.
const GATE_THICKNESSES: f64 = 2.0;
/// Points per sector that let each axial bin have a sharp median.
const POINTS_PER_SECTOR: usize = 10_000;
/// At most this many sectors: the seam's run is smooth.
const MAX_SECTORS: usize = 32;
/// Axial bins are this many point spacings wide.
const BIN_SPACINGS: f64 = 4.0;
/// A wall point lies within this many sigma of its wall (5 sigma: one in two million by chance).
const WALL_SIGMAS: f64 = 5.0;
/// Medians of bins with fewer points are not used.
const MIN_POINTS_PER_BIN: usize = 8;
/// How far the real diameter of a pipe may be from its nominal one, relative (the usual delivery tolerance is 1 %). A
/// radius that the arc does not determine better than this is taken as nominal.
const DIAMETER_TOLERANCE: f64 = 0.01;
/// A radius this far from the nominal one, relative, is another pipe's: ovality bends a pipe locally by a few per cent.
const OTHER_PIPE: f64 = 0.2;
/// Normals that the coarse frame is found from.
const COARSE_POINTS: f64 = 20_000.0;
/// Of every so many points one tells how far the view reaches.
const RANGE_STRIDE: usize = 16;
/// Points that the cylinder of the reference wall is fitted to.
const FIT_POINTS: usize = 40_000;

const WELD: &str = "weld";

/// Segments one shot. `points` is a pixel grid `width` wide, row-major, NaN where there is no point.
///
/// # Errors
/// [`Error::Shape`], [`Error::OutOfRange`] on bad arguments; [`Error::TooFew`] where there is next to nothing;
/// [`Error::NotFound`] with the reason where no weld, or only one wall, is in view.
pub fn segment(points: &[[f64; 3]], width: usize, nominal: &Nominal) -> Result<Segmentation> {
    require_positive("pipe radius", nominal.radius_mm)?;
    require_positive("wall thickness", nominal.wall_thickness_mm)?;
    if width == 0 || !points.len().is_multiple_of(width) {
        let (expected, got) = (format!("rows of {width} pixels"), format!("{} pixels", points.len()));
        return Err(Error::Shape { what: "points", expected, got });
    }
    let coarse = coarse_frame(points, width, nominal)?;
    let coarse_view = View::of(points, &coarse, nominal)?;
    let walls = find_walls(&coarse_view)?;
    let labels = walls.labels(&coarse_view);
    let (frame, radius_fitted) = reference_frame(points, &labels, &coarse, nominal)?;
    let centreline = walls.centreline(&coarse_view, &coarse, &frame);
    let frame = PipeFrame { origin_mm: frame.origin_mm + frame.axis * centreline, ..frame };
    Ok(Segmentation {
        frame,
        labels,
        unrolled: Unrolled::of(points, &frame),
        noise_mm: walls.noise_mm,
        bead_width_mm: walls.bead_width_mm,
        radius_fitted,
    })
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

/// A cylinder of the nominal radius near the points: axis from the normals, place from a vote of `p - R n`, both then
/// refined with the points that agree. Degrees and millimetres suffice, see [`find_walls`].
fn coarse_frame(points: &[[f64; 3]], width: usize, nominal: &Nominal) -> Result<PipeFrame> {
    // Normals over a twentieth of the radius, at most: the surface must be nearly flat there, and longer is less noisy.
    let height = points.len() / width;
    let stride = ((points.len() as f64 / COARSE_POINTS).sqrt() as usize).max(1);
    let reach = (width.min(height) / 100).clamp(1, 8);
    let rows: Vec<usize> = (0..height).step_by(stride).collect();
    let found: Vec<Vec<(Vec3, Vec3)>> = threads::install(|| {
        rows.par_iter()
            .map(|&r| {
                let pick = |c| Some((Vec3::from(points[r * width + c]), normal(points, width, r, c, reach)?));
                (0..width).step_by(stride).filter_map(pick).collect()
            })
            .collect()
    });
    let seen: Vec<(Vec3, Vec3)> = found.into_iter().flatten().collect();
    crate::error::require_count("part points with a normal", 100, seen.len())?;
    let axis = axis_from_normals(&seen, nominal.axis)?;
    let middle = seen.iter().map(|(p, _)| p).sum::<Vec3>() / seen.len() as f64;
    let zero = nominal.zero.unwrap_or_else(|| {
        // Towards the scanner, which is at the origin of its own frame.
        let view = -middle;
        view - axis * axis.dot(&view)
    });
    let radius = nominal.radius_mm;
    let mut frame = PipeFrame::new(middle, axis, zero, radius)?;
    frame.origin_mm = vote_centre(&seen, &frame);
    refine_centre(&seen, &mut frame);
    Ok(frame)
}

/// The direction to which the normals are most square, started at `prior` and reweighted, with its sign.
fn axis_from_normals(seen: &[(Vec3, Vec3)], prior: Option<Vec3>) -> Result<Vec3> {
    let mut axis = prior.map(|a| a.normalize());
    let mut told = false;
    for _ in 0..6 {
        // Flanks of the bead and rubbish lean towards the axis: weight them down by what is usual.
        let scale = axis.map(|a| {
            let mut lean: Vec<f64> = seen.iter().map(|(_, n)| n.dot(&a).abs()).collect();
            3.0 * 1.4826 * median(&mut lean).max(1e-3)
        });
        let mut spread = Matrix3::zeros();
        for (_, n) in seen {
            let w = match (axis, scale) {
                (Some(a), Some(s)) => tukey(n.dot(&a) / s),
                _ => 1.0,
            };
            spread += n * n.transpose() * w;
        }
        let eigen = spread.symmetric_eigen();
        let mut order = [0, 1, 2];
        order.sort_by(|&i, &j| eigen.eigenvalues[i].total_cmp(&eigen.eigenvalues[j]));
        // On a short arc the normals hardly turn about the axis; then only what is known beforehand tells the axis.
        told = eigen.eigenvalues[order[1]] > 4.0 * eigen.eigenvalues[order[0]];
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

/// Where most of `p - R n` meet across the axis: the fullest of cells of a twentieth of the radius, and its mean.
fn vote_centre(seen: &[(Vec3, Vec3)], frame: &PipeFrame) -> Vec3 {
    let square = frame.axis.cross(&frame.zero);
    let cell = frame.radius_mm / 20.0;
    let place = |p: &Vec3, n: &Vec3| {
        let v = p - n * frame.radius_mm - frame.origin_mm;
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
fn refine_centre(seen: &[(Vec3, Vec3)], frame: &mut PipeFrame) {
    let square = frame.axis.cross(&frame.zero);
    for _ in 0..10 {
        let deviation = |p: &Vec3| frame.unroll(&(*p).into());
        let mut sizes: Vec<f64> = seen.iter().map(|(p, _)| deviation(p)[2].abs()).collect();
        let scale = 4.685 * 1.4826 * median(&mut sizes).max(1e-6);
        let (mut xx, mut xy, mut yy, mut bx, mut by) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for (p, _) in seen {
            let [angle, _, d] = deviation(p);
            let w = tukey(d / scale);
            let (s, c) = angle.sin_cos();
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
        if dx.hypot(dy) < 1e-6 * frame.radius_mm {
            return;
        }
    }
}

/// Tukey's biweight, zero beyond 1.
fn tukey(u: f64) -> f64 {
    if u.abs() < 1.0 { (1.0 - u * u).powi(2) } else { 0.0 }
}

/// The unrolled shot cut into sectors and axial bins.
struct View {
    unrolled: Unrolled,
    /// Index of the sector of each point, or `usize::MAX`.
    middle_rad: f64,
    start_rad: f64,
    sector_rad: f64,
    sectors: usize,
    start_mm: f64,
    bin_mm: f64,
    bins: usize,
    gate_mm: f64,
    /// Median deviation of each bin, NaN with too few points, sector by sector.
    medians: Vec<f64>,
    /// Noise of one point (median over the bins of 1.4826 MAD).
    noise_mm: f64,
}

impl View {
    fn of(points: &[[f64; 3]], frame: &PipeFrame, nominal: &Nominal) -> Result<Self> {
        let unrolled = Unrolled::of(points, frame);
        let gate_mm = GATE_THICKNESSES * nominal.wall_thickness_mm;
        // The camera sees less than half a turn: angles from the middle of the view do not wrap.
        let near = |d: &f32| f64::from(d.abs()) < gate_mm;
        let unrolled_count = unrolled.angle_rad.len();
        let count = unrolled.deviation_mm.iter().filter(|d| near(d)).count();
        let (mut c, mut s) = (0.0, 0.0);
        for i in (0..unrolled_count).step_by(RANGE_STRIDE).filter(|&i| near(&unrolled.deviation_mm[i])) {
            let (sin, cos) = unrolled.angle_rad[i].sin_cos();
            (c, s) = (c + f64::from(cos), s + f64::from(sin));
        }
        crate::error::require_count("part points near the nominal pipe", 1000, count)?;
        let middle_rad = s.atan2(c);
        let mut view = Self {
            unrolled,
            middle_rad,
            start_rad: 0.0,
            sector_rad: 1.0,
            sectors: (count / POINTS_PER_SECTOR).clamp(1, MAX_SECTORS),
            start_mm: 0.0,
            bin_mm: 1.0,
            bins: 1,
            gate_mm,
            medians: Vec::new(),
            noise_mm: 0.0,
        };
        let (a, z): (Vec<f64>, Vec<f64>) =
            (0..unrolled_count).step_by(RANGE_STRIDE).filter_map(|i| view.place(i)).map(|(a, z, _)| (a, z)).unzip();
        let (a, z) = (inner_range(a), inner_range(z));
        let spacing = ((a.1 - a.0) * frame.radius_mm * (z.1 - z.0) / count as f64).sqrt();
        if !(spacing.is_finite() && spacing > 0.0) {
            return Err(Error::Degenerate { what: "part", reason: "its points span no surface".into() });
        }
        view.start_rad = a.0;
        view.sector_rad = (a.1 - a.0) / view.sectors as f64;
        view.start_mm = z.0;
        view.bins = (((z.1 - z.0) / (BIN_SPACINGS * spacing)) as usize).clamp(8, 4096);
        view.bin_mm = (z.1 - z.0) / view.bins as f64;
        view.take_medians();
        Ok(view)
    }

    /// A point near the pipe: angle from the middle of the view, axial coordinate, deviation.
    #[inline]
    fn place(&self, i: usize) -> Option<(f64, f64, f64)> {
        let d = f64::from(self.unrolled.deviation_mm[i]);
        (d.abs() < self.gate_mm).then(|| {
            let turn = f64::from(self.unrolled.angle_rad[i]) - self.middle_rad;
            let turn = turn - (turn / std::f64::consts::TAU).round() * std::f64::consts::TAU;
            (turn, f64::from(self.unrolled.axial_mm[i]), d)
        })
    }

    #[inline]
    fn sector(&self, angle: f64) -> Option<usize> {
        let k = (angle - self.start_rad) / self.sector_rad;
        // The outermost points belong to the outermost sectors.
        (k > -1.0 && k < self.sectors as f64 + 1.0).then(|| (k.max(0.0) as usize).min(self.sectors - 1))
    }

    #[inline]
    fn bin(&self, axial: f64) -> Option<usize> {
        let k = (axial - self.start_mm) / self.bin_mm;
        (k >= 0.0 && k < self.bins as f64).then_some(k as usize)
    }

    fn axial_of(&self, bin: f64) -> f64 {
        self.start_mm + bin * self.bin_mm
    }

    fn take_medians(&mut self) {
        let cells = self.sectors * self.bins;
        let cell_of =
            |i: usize| self.place(i).and_then(|(a, z, d)| Some((self.sector(a)? * self.bins + self.bin(z)?, d as f32)));
        let mut starts = vec![0_usize; cells + 1];
        let n = self.unrolled.angle_rad.len();
        let found: Vec<Vec<(u32, f32)>> =
            threads::map_ranges(n, |range| range.filter_map(|i| cell_of(i).map(|(k, d)| (k as u32, d))).collect());
        for (cell, _) in found.iter().flatten() {
            starts[*cell as usize + 1] += 1;
        }
        for k in 0..cells {
            starts[k + 1] += starts[k];
        }
        let mut sorted = vec![0.0_f32; starts[cells]];
        let mut next = starts.clone();
        for (cell, d) in found.iter().flatten() {
            sorted[next[*cell as usize]] = *d;
            next[*cell as usize] += 1;
        }
        let mut slices: Vec<&mut [f32]> = Vec::with_capacity(cells);
        let mut rest = sorted.as_mut_slice();
        for k in 0..cells {
            let (head, tail) = rest.split_at_mut(starts[k + 1] - starts[k]);
            slices.push(head);
            rest = tail;
        }
        let stats: Vec<(f64, f64)> = threads::install(|| {
            slices
                .into_par_iter()
                .map(|values| {
                    if values.len() < MIN_POINTS_PER_BIN {
                        return (f64::NAN, f64::NAN);
                    }
                    let middle = values.len() / 2;
                    let m = *values.select_nth_unstable_by(middle, f32::total_cmp).1;
                    values.iter_mut().for_each(|v| *v = (*v - m).abs());
                    let mad = *values.select_nth_unstable_by(middle, f32::total_cmp).1;
                    (f64::from(m), 1.4826 * f64::from(mad))
                })
                .collect()
        });
        let mut noises: Vec<f64> = stats.iter().map(|s| s.1).filter(|s| s.is_finite()).collect();
        self.noise_mm = median(&mut noises);
        self.medians = stats.into_iter().map(|s| s.0).collect();
    }
}

/// The range of values without its outermost thousandth on either side: stray points do not stretch the view.
fn inner_range(mut values: Vec<f64>) -> (f64, f64) {
    let cut = values.len() / 1000;
    let last = values.len() - 1 - cut;
    let low = *values.select_nth_unstable_by(cut, f64::total_cmp).1;
    let high = *values.select_nth_unstable_by(last, f64::total_cmp).1;
    (low, high)
}

/// A straight wall of one sector: deviation = height + slope · axial, from the edge of the view to its toe.
#[derive(Debug, Clone, Copy)]
struct Wall {
    height_mm: f64,
    slope: f64,
    /// First bin that is not wall, counted from the wall's edge of the view.
    end: usize,
    /// The same with the strip in which the weld fades in.
    toe: usize,
    /// Mean square of the wall's bins about its line.
    unevenness_mm2: f64,
}

/// Both walls in each sector (`None` where the sector shows no weld).
struct Walls {
    sectors: Vec<Option<(Wall, Wall)>>,
    noise_mm: f64,
    bead_width_mm: f64,
}

/// The wall at the start of a profile, see the module's head; `profile` is (axial, deviation) with NaN for no data.
fn wall_from_edge(profile: &[(f64, f64)], limit_mm: f64) -> Option<Wall> {
    // Sums of 1, z, d, zz, zd, dd about the first bin, so that the line over [0, t] costs nothing.
    let origin = profile.iter().find(|p| p.1.is_finite())?;
    let lambda = limit_mm * limit_mm;
    let mut sums = [0.0; 6];
    let mut best: Option<(f64, Wall)> = None;
    for (t, &(z, d)) in profile.iter().enumerate() {
        if d.is_finite() {
            let (z, d) = (z - origin.0, d - origin.1);
            for (s, v) in sums.iter_mut().zip([1.0, z, d, z * z, z * d, d * d]) {
                *s += v;
            }
        }
        let [n, sz, sd, szz, szd, sdd] = sums;
        let spread = n * szz - sz * sz;
        if n < 3.0 || spread <= 0.0 {
            continue;
        }
        let slope = (n * szd - sz * sd) / spread;
        let height = (sd - slope * sz) / n;
        let sse = (sdd - height * sd - slope * szd).max(0.0);
        let cost = sse - lambda * n;
        if best.as_ref().is_none_or(|(c, _)| cost < *c) {
            let height_mm = origin.1 + height - slope * origin.0;
            best = Some((cost, Wall { height_mm, slope, end: t + 1, toe: t + 1, unevenness_mm2: sse / n }));
        }
    }
    let (_, mut wall) = best?;
    let off = |&(z, d): &(f64, f64)| (d - wall.height_mm - wall.slope * z).abs();
    let beyond = profile.iter().skip(wall.end).position(|p| off(p) > 4.0 * limit_mm);
    wall.toe = wall.end.saturating_sub(beyond.unwrap_or(1).max(1));
    Some(wall)
}

fn find_walls(view: &View) -> Result<Walls> {
    let profile = |k: usize| -> Vec<(f64, f64)> {
        let medians = view.medians[k * view.bins..(k + 1) * view.bins].iter();
        medians.enumerate().map(|(b, &d)| (view.axial_of(b as f64 + 0.5), d)).collect()
    };
    let full = |p: &[(f64, f64)]| p.iter().filter(|b| b.1.is_finite()).count() * 2 > view.bins;
    let mut limit_mm = view.noise_mm;
    let mut pairs: Vec<Option<(Wall, Wall)>> = Vec::new();
    // Twice: the walls' own unevenness is known only once there are walls.
    for _ in 0..2 {
        pairs = (0..view.sectors)
            .map(|k| {
                let forward = profile(k);
                if !full(&forward) {
                    return None;
                }
                let backward: Vec<_> = forward.iter().rev().copied().collect();
                Some((wall_from_edge(&forward, limit_mm)?, wall_from_edge(&backward, limit_mm)?))
            })
            .collect();
        // The evener side tells: where only one wall is in view, the other side's line is no wall's.
        let typical = |pick: fn(&(Wall, Wall)) -> f64| {
            let mut squares: Vec<f64> = pairs.iter().flatten().map(pick).collect();
            median(&mut squares)
        };
        let evener = typical(|p| p.0.unevenness_mm2).min(typical(|p| p.1.unevenness_mm2));
        limit_mm = view.noise_mm.max(3.0 * evener.sqrt());
    }
    let seen = pairs.iter().flatten().count();
    if seen == 0 {
        return Err(Error::NotFound { what: WELD, reason: "no sector of the view is filled with points".into() });
    }
    for pair in &mut pairs {
        *pair = pair.and_then(|(a, b)| apart(a, b, view.bins));
    }
    let welded = pairs.iter().flatten().count();
    if 2 * welded < seen {
        let reason = format!(
            "{} of {seen} sectors are one straight wall within {limit_mm:.3} mm: no weld is in view",
            seen - welded
        );
        return Err(Error::NotFound { what: WELD, reason });
    }
    let length = |pick: fn(&(Wall, Wall)) -> usize| {
        let mut lengths: Vec<f64> = pairs.iter().flatten().map(|p| pick(p) as f64).collect();
        median(&mut lengths) * view.bin_mm
    };
    let (first, second) = (length(|p| p.0.toe), length(|p| p.1.toe));
    let bead_width_mm = view.bins as f64 * view.bin_mm - first - second;
    // A wall is extrapolated over half a bead: from less than a whole bead's width that is a guess. A strip narrower than
    // the wall is thick may be the crown of a bead of which half is in view.
    for (name, seen_mm) in [("reference wall", first), ("other wall", second)] {
        if seen_mm < bead_width_mm.max(view.gate_mm / GATE_THICKNESSES) {
            let reason = format!(
                "only {seen_mm:.1} mm of the {name} beside a weld {bead_width_mm:.1} mm wide: only one wall is in view"
            );
            return Err(Error::NotFound { what: WELD, reason });
        }
    }
    smooth_toes(&mut pairs);
    keep_clear_of_the_flank(view, &mut pairs);
    Ok(Walls { sectors: pairs, noise_mm: view.noise_mm, bead_width_mm })
}

/// Two walls that both claim a strip between them (a weld ground flush shows only its step) lose it; walls that claim most
/// of each other are one.
fn apart(mut a: Wall, mut b: Wall, bins: usize) -> Option<(Wall, Wall)> {
    let contested = (a.end + b.end).saturating_sub(bins);
    if 2 * contested > a.end.max(b.end) {
        return None;
    }
    a.toe = a.toe.min(a.end.saturating_sub(contested + 1));
    b.toe = b.toe.min(b.end.saturating_sub(contested + 1));
    Some((a, b))
}

/// Each toe becomes the median of its neighbourhood: the seam runs smoothly, and one sector that is misled by spatter, a
/// hole or a wave of the wall neither lets weld metal pass for wall nor loses a wall.
fn smooth_toes(pairs: &mut [Option<(Wall, Wall)>]) {
    let around = |k: usize, pick: fn(&(Wall, Wall)) -> usize| {
        let window = &pairs[k.saturating_sub(2)..(k + 3).min(pairs.len())];
        let mut toes: Vec<f64> = window.iter().flatten().map(|p| pick(p) as f64).collect();
        median(&mut toes) as usize
    };
    let limits: Vec<(usize, usize)> =
        (0..pairs.len()).map(|k| (around(k, |p| p.0.toe), around(k, |p| p.1.toe))).collect();
    for (pair, (first, second)) in pairs.iter_mut().zip(limits) {
        if let Some((a, b)) = pair {
            a.toe = first;
            b.toe = second;
        }
    }
}

/// Takes from each wall the strip on which the bead's flank throws light of its own (the fringes are mixed there, by some
/// micrometres): it reaches about as far as the bead is high.
fn keep_clear_of_the_flank(view: &View, pairs: &mut [Option<(Wall, Wall)>]) {
    for (k, pair) in pairs.iter_mut().enumerate() {
        let Some((a, b)) = pair else { continue };
        let wall = |bin: usize, w: &Wall| w.height_mm + w.slope * view.axial_of(bin as f64 + 0.5);
        let height = (a.toe..view.bins - b.toe)
            .map(|bin| {
                let d = view.medians[k * view.bins + bin];
                (d - wall(bin, a)).abs().min((d - wall(bin, b)).abs())
            })
            .filter(|h| h.is_finite())
            .fold(0.0, f64::max);
        let strip = (height / view.bin_mm).ceil() as usize;
        a.toe = a.toe.saturating_sub(strip);
        b.toe = b.toe.saturating_sub(strip);
    }
}

impl Walls {
    fn toes(&self, view: &View, sector: usize) -> Option<(f64, f64)> {
        let (a, b) = (*self.sectors.get(sector)?)?;
        Some((view.axial_of(a.toe as f64), view.axial_of((view.bins - b.toe) as f64)))
    }

    fn labels(&self, view: &View) -> Vec<u8> {
        let toes: Vec<Option<(f64, f64)>> = (0..view.sectors).map(|k| self.toes(view, k)).collect();
        let label = |i: usize| -> Option<Label> {
            let (a, z, d) = view.place(i)?;
            let k = view.sector(a)?;
            let ((first, second), (low, high)) = (self.sectors[k]?, toes[k]?);
            if z > low && z < high {
                return Some(Label::Bead);
            }
            let (wall, label) = if z <= low { (first, Label::ReferenceWall) } else { (second, Label::OtherWall) };
            let spread = (self.noise_mm.powi(2) + wall.unevenness_mm2).sqrt();
            ((d - wall.height_mm - wall.slope * z).abs() <= WALL_SIGMAS * spread).then_some(label)
        };
        threads::map_ranges(view.unrolled.angle_rad.len(), |range| {
            range.map(|i| label(i).unwrap_or(Label::None) as u8).collect::<Vec<u8>>()
        })
        .concat()
    }

    /// Axial coordinate in `frame` of the middle between the toes: mean over the sectors.
    fn centreline(&self, view: &View, coarse: &PipeFrame, frame: &PipeFrame) -> f64 {
        let square = coarse.axis.cross(&coarse.zero);
        let (mut sum, mut count) = (0.0, 0.0);
        for k in 0..view.sectors {
            if let Some((low, high)) = self.toes(view, k) {
                let angle = view.middle_rad + view.start_rad + (k as f64 + 0.5) * view.sector_rad;
                let p = coarse.origin_mm
                    + coarse.axis * (low + high) / 2.0
                    + (coarse.zero * angle.cos() + square * angle.sin()) * coarse.radius_mm;
                sum += frame.unroll(&p.into())[1];
                count += 1.0;
            }
        }
        sum / f64::max(count, 1.0)
    }
}

/// The reference wall's cylinder by orthogonal distance, with what its arc allows: a free radius where it is determined
/// to better than the pipe's delivery tolerance, else the nominal one.
fn reference_frame(
    points: &[[f64; 3]],
    labels: &[u8],
    coarse: &PipeFrame,
    nominal: &Nominal,
) -> Result<(PipeFrame, bool)> {
    let wall: Vec<[f64; 3]> =
        std::iter::zip(points, labels).filter(|(_, l)| **l == Label::ReferenceWall as u8).map(|(p, _)| *p).collect();
    crate::error::require_count("points of the reference wall", 100, wall.len())?;
    let sample: Vec<[f64; 3]> = wall.iter().step_by(wall.len().div_ceil(FIT_POINTS)).copied().collect();
    let start = cylinder::Cylinder { point_mm: coarse.origin_mm, axis: coarse.axis, radius_mm: coarse.radius_mm };
    let fixed = cylinder::refine(&sample, start, false, Noise::default())?.surface;
    let free = cylinder::refine(&sample, fixed, true, Noise::default()).ok().filter(|fit| {
        let last = fit.covariance.nrows() - 1;
        let sigma = fit.covariance[(last, last)].sqrt();
        // The residuals of a wall are correlated: their number counts for far less than it says, see `step`.
        let doubt = sigma * (sample.len() as f64 / 100.0).sqrt();
        doubt < DIAMETER_TOLERANCE * nominal.radius_mm
    });
    if let Some(fit) = &free
        && (fit.surface.radius_mm / nominal.radius_mm - 1.0).abs() > OTHER_PIPE
    {
        let (seen, told) = (fit.surface.radius_mm, nominal.radius_mm);
        let reason =
            format!("the reference wall's radius is {seen:.1} mm, not {told:.1} mm as the part's description says");
        return Err(Error::Degenerate { what: "pipe", reason });
    }
    let (surface, fitted) = free.map_or((fixed, false), |fit| (fit.surface, true));
    let axis = if surface.axis.dot(&coarse.axis) < 0.0 { -surface.axis } else { surface.axis };
    // The point of the axis next to the coarse origin.
    let origin = surface.point_mm + axis * axis.dot(&(coarse.origin_mm - surface.point_mm));
    Ok((PipeFrame::new(origin, axis, coarse.zero, surface.radius_mm)?, fitted))
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A pipe's weld as a scanner sees it from outside, made point by point from the closed form, not by the simulator.
    #[derive(Clone, Copy)]
    pub(crate) struct Example {
        pub radius_mm: f64,
        /// Offset of the other wall's axis.
        pub offset_mm: [f64; 2],
        pub radius_difference_mm: f64,
        pub tilt: [f64; 2],
        pub bead_width_mm: f64,
        pub bead_height_mm: f64,
        pub noise_mm: f64,
        pub half_arc_rad: f64,
        /// Extent along the axis of the reference wall's side and of the other wall's.
        pub reach_mm: [f64; 2],
        pub seed: u64,
    }

    pub(crate) const EXAMPLE: Example = Example {
        radius_mm: 315.0,
        offset_mm: [0.45, 0.1],
        radius_difference_mm: 0.0,
        tilt: [0.0, 0.0],
        bead_width_mm: 11.0,
        bead_height_mm: 1.8,
        noise_mm: 0.04,
        half_arc_rad: 0.25,
        reach_mm: [90.0, 100.0],
        seed: 1,
    };

    pub(crate) const COLUMNS: usize = 400;
    pub(crate) const ROWS: usize = 300;
    /// Towards the scanner: where the middle of the view lies about the axis.
    pub(crate) const MIDDLE_RAD: f64 = 2.0;

    fn uniform(state: &mut u64) -> f64 {
        *state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        ((*state >> 11) as f64 + 0.5) / (1_u64 << 53) as f64
    }

    pub(crate) fn normal_random(state: &mut u64) -> f64 {
        (-2.0 * uniform(state).ln()).sqrt() * (std::f64::consts::TAU * uniform(state)).cos()
    }

    impl Example {
        /// Radial step at an angle, by the exact radial distance of an eccentric circle.
        pub(crate) fn step_mm(&self, angle: f64, axial: f64) -> f64 {
            let e: Vec<f64> = (0..2).map(|k| self.offset_mm[k] + self.tilt[k] * axial).collect();
            let (along, across) = (e[0] * angle.cos() + e[1] * angle.sin(), e[1] * angle.cos() - e[0] * angle.sin());
            let radius = self.radius_mm + self.radius_difference_mm;
            along + (radius * radius - across * across).sqrt() - self.radius_mm
        }

        /// The axis runs along +x of the scanner, whose z looks at the pipe; angle 0 is `zero`.
        pub(crate) fn frame(&self) -> PipeFrame {
            let origin = Vec3::new(3.0, -2.0, 420.0 + self.radius_mm);
            let toward = Vec3::new(0.0, 0.0, -1.0);
            let axis = Vec3::x();
            // zero turned by MIDDLE_RAD about the axis is `toward`.
            let zero = toward * MIDDLE_RAD.cos() - axis.cross(&toward) * MIDDLE_RAD.sin();
            PipeFrame::new(origin, axis, zero, self.radius_mm).unwrap()
        }

        pub(crate) fn nominal(&self) -> Nominal {
            let frame = self.frame();
            Nominal {
                radius_mm: self.radius_mm,
                wall_thickness_mm: 6.0,
                axis: Some(frame.axis),
                zero: Some(frame.zero),
            }
        }

        pub(crate) fn points(&self) -> Vec<[f64; 3]> {
            let frame = self.frame();
            let square = frame.axis.cross(&frame.zero);
            let mut state = self.seed;
            let mut points = Vec::new();
            for r in 0..ROWS {
                for c in 0..COLUMNS {
                    let angle = MIDDLE_RAD + self.half_arc_rad * (2.0 * (r as f64 + 0.5) / ROWS as f64 - 1.0);
                    let part = (c as f64 + 0.5) / COLUMNS as f64;
                    let axial = -self.reach_mm[0] + part * (self.reach_mm[0] + self.reach_mm[1]);
                    let half = self.bead_width_mm / 2.0;
                    let mut height = if axial > 0.0 { self.step_mm(angle, axial) } else { 0.0 };
                    if axial.abs() < half {
                        let t = axial / half;
                        height =
                            self.step_mm(angle, axial) * (t + 1.0) / 2.0 + self.bead_height_mm * (1.0 - t * t).powi(2);
                    }
                    let radius = self.radius_mm + height + self.noise_mm * normal_random(&mut state);
                    let p = frame.origin_mm
                        + frame.axis * axial
                        + (frame.zero * angle.cos() + square * angle.sin()) * radius;
                    points.push(p.into());
                }
            }
            points
        }
    }

    fn share(labels: &[u8], wanted: Label, truth: impl Fn(f64) -> bool, e: &Example) -> f64 {
        let axial =
            |i: usize| -e.reach_mm[0] + ((i % COLUMNS) as f64 + 0.5) / COLUMNS as f64 * (e.reach_mm[0] + e.reach_mm[1]);
        let inside: Vec<usize> = (0..labels.len()).filter(|&i| truth(axial(i))).collect();
        inside.iter().filter(|&&i| labels[i] == wanted as u8).count() as f64 / inside.len() as f64
    }

    #[test]
    fn walls_and_bead_are_told_apart_on_pipes_of_any_size() {
        for (radius_mm, bead_width_mm, half_arc_rad) in [(54.0, 6.0, 0.8), (315.0, 11.0, 0.25), (610.0, 24.0, 0.12)] {
            let e = Example { radius_mm, bead_width_mm, half_arc_rad, ..EXAMPLE };
            let s = segment(&e.points(), COLUMNS, &e.nominal()).unwrap();
            // A bead's height (1.8 mm) and two bins beside the toes are left to the flank.
            let half = bead_width_mm / 2.0;
            let shares = [
                share(&s.labels, Label::ReferenceWall, |z| z < -half - 8.0, &e),
                share(&s.labels, Label::OtherWall, |z| z > half + 8.0, &e),
                share(&s.labels, Label::Bead, |z| z.abs() < half - 1.0, &e),
            ];
            assert!(shares.iter().all(|s| *s > 0.99), "R {radius_mm}: {shares:?}");
            assert!(share(&s.labels, Label::Bead, |z| z.abs() > half + 8.0, &e) < 0.01, "R {radius_mm}");
            assert!(s.frame.origin_mm.x - 3.0 < 0.5 && s.frame.axis.dot(&Vec3::x()) > 0.999_99, "R {radius_mm}");
        }
    }

    #[test]
    fn the_axis_need_not_be_known() {
        let e = EXAMPLE;
        let nominal = Nominal { axis: None, zero: None, ..e.nominal() };
        let s = segment(&e.points(), COLUMNS, &nominal).unwrap();
        assert!(s.frame.axis.dot(&Vec3::x()) > 0.999_99);
        // Angle 0 faces the scanner.
        assert!(s.frame.zero.dot(&Vec3::new(0.0, 0.0, -1.0)) > 0.999);
    }

    #[test]
    fn a_plain_pipe_shows_no_weld() {
        let e = Example { offset_mm: [0.0; 2], bead_height_mm: 0.0, ..EXAMPLE };
        let error = segment(&e.points(), COLUMNS, &e.nominal()).unwrap_err();
        assert!(error.to_string().contains("no weld is in view"), "{error}");
    }

    #[test]
    fn a_weld_at_the_edge_of_the_view_leaves_only_one_wall() {
        for reach_mm in [[150.0, 3.0], [150.0, 9.0], [9.0, 150.0], [1.0, 150.0]] {
            let e = Example { reach_mm, ..EXAMPLE };
            let error = segment(&e.points(), COLUMNS, &e.nominal()).map(|s| s.bead_width_mm).unwrap_err();
            assert!(error.to_string().contains("only one wall"), "{reach_mm:?}: {error}");
        }
    }

    #[test]
    fn a_weld_ground_flush_shows_by_its_step() {
        let e = Example { bead_height_mm: 0.0, bead_width_mm: 1.0, offset_mm: [-0.8, 0.0], ..EXAMPLE };
        let s = segment(&e.points(), COLUMNS, &e.nominal()).unwrap();
        assert!(share(&s.labels, Label::ReferenceWall, |z| z < -4.0, &e) > 0.98);
        assert!(share(&s.labels, Label::OtherWall, |z| z > 4.0, &e) > 0.98);
    }

    #[test]
    fn rubbish_is_refused_without_a_panic() {
        let nominal = EXAMPLE.nominal();
        assert!(segment(&[], 1, &nominal).is_err());
        assert!(segment(&[[f64::NAN; 3]; 10_000], 100, &nominal).is_err());
        assert!(segment(&[[1.0; 3]; 10_000], 100, &nominal).is_err());
        assert!(segment(&EXAMPLE.points(), 7, &nominal).is_err());
        assert!(segment(&EXAMPLE.points(), COLUMNS, &Nominal { radius_mm: -1.0, ..nominal }).is_err());
        let mut state = 3;
        let noise: Vec<[f64; 3]> =
            (0..40_000).map(|_| std::array::from_fn(|_| 400.0 * normal_random(&mut state))).collect();
        assert!(segment(&noise, 200, &nominal).is_err());
    }
}
