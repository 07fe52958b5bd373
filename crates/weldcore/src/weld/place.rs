//! The part shots joined into one cloud in base.
//!
//! Of many shots most see the same surface: on request one point is kept of every cell of the unrolled part, that of the first shot
//! that saw it.

use rayon::prelude::*;

use crate::error::{Error, Result, require_positive};
use crate::ground::memory::require;
use crate::ground::stop::{poll, polled};
use crate::ground::threads::{self, CHUNK};
use crate::ground::transform::Transform;
use crate::weld::label::Label;
use crate::weld::seam::{Seam, Unrolled};
use crate::weld::step::OwnSurface;

/// Of cells across the seam: what lies further away belongs to the outermost ones.
const FURTHEST_MM: f64 = 1000.0;
/// The cell of what is no point.
const NOWHERE: u32 = u32::MAX;
/// Labels there are.
const LABELS: usize = Label::Transition as usize + 1;

/// One segmented shot with its place.
#[derive(Debug, Clone, Copy)]
pub struct Scan<'a> {
    /// Where the scanner stood.
    pub base_from_scanner: Transform,
    /// The points in the seam's frame; NaN where there is none.
    pub unrolled: &'a Unrolled,
    /// That frame.
    pub seam: Seam,
    /// A [`Label`] per point.
    pub labels: &'a [u8],
    /// The reference wall that deviations are counted from.
    pub surface: &'a OwnSurface,
    /// Number of the shot.
    pub shot: u16,
}

/// The cloud of all shots, one array per property, in order of the shots and of their pixels.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Placed {
    /// Points in base.
    pub points: Vec<f64>,
    /// Label per point.
    pub labels: Vec<u8>,
    /// Deviation per point from the reference wall.
    pub deviation_mm: Vec<f32>,
    /// Along the seam per point, as a reading ([`crate::weld::Course::reading`]).
    pub along: Vec<f32>,
    /// Across the seam per point.
    pub across_mm: Vec<f32>,
    /// Shot per point.
    pub shot: Vec<u16>,
    /// Of all points of the shots, kept or not, how many have each label.
    pub counts: [usize; LABELS],
}

/// Cuts `n` items off the front.
fn take<'a, T>(rest: &mut &'a mut [T], n: usize) -> &'a mut [T] {
    let (head, tail) = std::mem::take(rest).split_at_mut(n);
    *rest = tail;
    head
}

/// Which cells of the unrolled part hold a point.
struct TakenCells {
    cell_mm: f64,
    from_mm: f64,
    across: usize,
    /// How many there are.
    count: usize,
    taken: Vec<u64>,
}

impl TakenCells {
    fn of(scans: &[Scan], cell_mm: f64) -> Result<Self> {
        require_positive("cell_mm", cell_mm)?;
        let mut range = [0.0_f64; 2];
        for s in scans {
            let parts = threads::map_chunks(&s.unrolled.across_mm, |_, chunk| {
                chunk.iter().fold([0.0_f32; 2], |[low, high], x| [low.min(*x), high.max(*x)])
            });
            for [low, high] in parts {
                range = [range[0].min(f64::from(low)), range[1].max(f64::from(high))];
            }
        }
        let [from_mm, to_mm] = range.map(|mm| mm.clamp(-FURTHEST_MM, FURTHEST_MM));
        let around_mm = scans.iter().map(|s| s.seam.course.along_mm(std::f64::consts::TAU)).fold(0.0, f64::max);
        let (along, across) = ((around_mm / cell_mm).floor() + 2.0, ((to_mm - from_mm) / cell_mm).floor() + 1.0);
        let count = along * across;
        if count.is_nan() || count >= f64::from(NOWHERE) {
            let expected = "so large that four thousand million cover the part".into();
            return Err(Error::OutOfRange { what: "cell_mm", expected, value: cell_mm.to_string() });
        }
        let (across, count) = (across as usize, count as usize);
        require(count / 64 + 1, 8);
        Ok(Self { cell_mm, from_mm, across, count, taken: vec![0; count / 64 + 1] })
    }

    /// The cell of a place.
    #[inline]
    fn at(&self, along_mm: f64, across_mm: f64) -> u32 {
        let row = (along_mm / self.cell_mm) as u32 as usize;
        let column = ((across_mm - self.from_mm) / self.cell_mm).max(0.0) as u32 as usize;
        (row * self.across + column.min(self.across - 1)).min(self.count - 1) as u32
    }

    /// Takes a cell; false where it was taken before.
    #[inline]
    fn take(&mut self, cell: u32) -> bool {
        let (word, bit) = (&mut self.taken[cell as usize / 64], 1_u64 << (cell % 64));
        let free = *word & bit == 0;
        *word |= bit;
        free
    }
}

/// Which points of each shot are kept, and how many have each label.
fn kept(scans: &[Scan], cell_mm: Option<f64>) -> Result<(Vec<Vec<u32>>, [usize; LABELS])> {
    let mut cells = cell_mm.map(|mm| TakenCells::of(scans, mm)).transpose()?;
    let mut counts = [0; LABELS];
    let mut all = Vec::with_capacity(scans.len());
    for s in scans {
        let (u, course) = (s.unrolled, s.seam.course);
        // Where each point lies, all threads together; who comes first is for one to say.
        let parts = threads::map_ranges(u.at.len(), |range| {
            let mut counts = [0; LABELS];
            let cell = |i: usize| {
                if !(u.height_mm[i].is_finite() && u.at[i].is_finite()) {
                    return NOWHERE;
                }
                counts[usize::from(s.labels[i]).min(LABELS - 1)] += 1;
                let along_mm = course.along_mm(f64::from(u.at[i]) + std::f64::consts::PI);
                cells.as_ref().map_or(0, |cells| cells.at(along_mm, f64::from(u.across_mm[i])))
            };
            let places: Vec<u32> = range.map(cell).collect();
            (places, counts)
        });
        let mut mine: Vec<u32> = Vec::new();
        for (start, (places, more)) in parts.iter().enumerate() {
            poll();
            counts.iter_mut().zip(more).for_each(|(all, n)| *all += n);
            let free =
                |(_, cell): &(usize, &u32)| **cell != NOWHERE && cells.as_mut().is_none_or(|cells| cells.take(**cell));
            mine.extend(places.iter().enumerate().filter(free).map(|(i, _)| (start * CHUNK + i) as u32));
        }
        all.push(mine);
    }
    Ok((all, counts))
}

/// Joins the shots; with `cell_mm` one point of every cell of this size of the unrolled part, else all of them.
///
/// # Errors
/// [`Error::Shape`] where a shot's arrays differ in length, [`Error::OutOfRange`] for a size that is none.
pub fn place(scans: &[Scan], cell_mm: Option<f64>) -> Result<Placed> {
    for s in scans {
        let n = s.labels.len();
        let u = s.unrolled;
        let lengths = [u.height_mm.len(), u.at.len(), u.across_mm.len()];
        if lengths != [n; 3] || u32::try_from(n).is_err() {
            return Err(Error::Shape { what: "scan", expected: format!("{n} of each"), got: format!("{lengths:?}") });
        }
    }
    let (kept, counts) = kept(scans, cell_mm)?;
    let total = kept.iter().map(Vec::len).sum();
    require(total, 40);
    let mut out = Placed {
        points: vec![0.0; 3 * total],
        labels: vec![0; total],
        deviation_mm: vec![0.0; total],
        along: vec![0.0; total],
        across_mm: vec![0.0; total],
        shot: vec![0; total],
        counts,
    };
    let (mut points, mut labels, mut deviations) =
        (out.points.as_mut_slice(), out.labels.as_mut_slice(), out.deviation_mm.as_mut_slice());
    let (mut along, mut across, mut shots) =
        (out.along.as_mut_slice(), out.across_mm.as_mut_slice(), out.shot.as_mut_slice());
    let mut chunks = Vec::new();
    for (s, mine) in scans.iter().zip(&kept) {
        for part in mine.chunks(CHUNK) {
            let n = part.len();
            let first = (take(&mut points, 3 * n), take(&mut labels, n), take(&mut deviations, n));
            chunks.push((s, part, first, (take(&mut along, n), take(&mut across, n), take(&mut shots, n))));
        }
    }
    threads::install(|| {
        chunks.into_par_iter().inspect(polled).for_each(
            |(s, part, (points, labels, deviations), (along, across, shots))| {
                for (slot, &i) in part.iter().enumerate() {
                    let (i, u) = (i as usize, s.unrolled);
                    let [at, across_mm, height] = [u.at[i], u.across_mm[i], u.height_mm[i]].map(f64::from);
                    let p = s.base_from_scanner.apply(&s.seam.above(at, across_mm, height));
                    points[3 * slot..3 * slot + 3].copy_from_slice(p.as_slice());
                    labels[slot] = s.labels[i];
                    deviations[slot] = s.surface.deviation(u, i);
                    along[slot] = s.seam.course.reading_f32(u.at[i]);
                    across[slot] = u.across_mm[i];
                    shots[slot] = s.shot;
                }
            },
        );
    });
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ground::transform::Vec3;
    use crate::weld::Course;

    /// A patch of 60 by 40 mm of a pipe, a point every 0.1 mm, every third without one.
    fn patch() -> (Seam, Unrolled, Vec<u8>) {
        let seam = Seam::new(Vec3::new(3.0, -2.0, 400.0), Vec3::x(), -Vec3::z(), Course::of_radius(100.0).unwrap());
        let mut u = Unrolled::default();
        for k in 0..400 {
            for j in 0..600 {
                u.at.push(k as f32 * 0.001 - 0.2);
                u.across_mm.push(j as f32 * 0.1 - 30.0);
                u.height_mm.push(if (k + j) % 3 == 0 { f32::NAN } else { 0.01 * j as f32 });
            }
        }
        let labels = u.across_mm.iter().map(|x| 1 + u8::from(*x > 0.0)).collect();
        (seam.unwrap(), u, labels)
    }

    #[test]
    fn every_point_is_where_its_shot_and_the_robot_say() {
        let (seam, unrolled, labels) = patch();
        let surface = OwnSurface::flat(seam.course, 0.25);
        let base_from_scanner = Transform { translation: Vec3::new(0.0, 10.0, 0.0), ..Transform::identity() };
        let scan =
            |shot| Scan { base_from_scanner, unrolled: &unrolled, seam, labels: &labels, surface: &surface, shot };
        let placed = place(&[scan(0), scan(7)], None).unwrap();
        let each: Vec<usize> = (0..labels.len()).filter(|&i| unrolled.height_mm[i].is_finite()).collect();
        assert_eq!(placed.labels.len(), 2 * each.len());
        assert_eq!(placed.counts.iter().sum::<usize>(), 2 * each.len());
        for (k, &i) in each.iter().chain(&each).enumerate() {
            let p = Vec3::new(placed.points[3 * k], placed.points[3 * k + 1] - 10.0, placed.points[3 * k + 2]);
            let [at, across, height] = seam.place(&p.into());
            assert!(
                (at - f64::from(unrolled.at[i])).abs() < 1e-9
                    && (height - f64::from(unrolled.height_mm[i])).abs() < 1e-9
            );
            assert!((across - f64::from(unrolled.across_mm[i])).abs() < 1e-9);
            assert!((placed.deviation_mm[k] - unrolled.height_mm[i] - 0.25).abs() < 1e-6);
            assert_eq!((placed.labels[k], placed.shot[k]), (labels[i], if k < each.len() { 0 } else { 7 }));
        }
        assert!(place(&[Scan { labels: &[], ..scan(0) }], None).is_err());
        assert!(place(&[scan(0)], Some(0.0)).is_err());
    }

    #[test]
    fn a_cell_holds_one_point_whoever_saw_it() {
        let (seam, unrolled, labels) = patch();
        let surface = OwnSurface::flat(seam.course, 0.0);
        let base_from_scanner = Transform::identity();
        let scan =
            |shot| Scan { base_from_scanner, unrolled: &unrolled, seam, labels: &labels, surface: &surface, shot };
        let all = place(&[scan(0), scan(1)], None).unwrap();
        let placed = place(&[scan(0), scan(1)], Some(0.5)).unwrap();
        // The patch is 40 by 60 mm, and its borders fill cells partly.
        let full = 40.0 * 60.0 / 0.25;
        assert!((placed.labels.len() as f64 / full - 1.0).abs() < 0.05, "{}", placed.labels.len());
        assert!(placed.shot.iter().all(|s| *s == 0) && placed.counts == all.counts);
        let mut seen = std::collections::BTreeSet::new();
        for (along, across) in placed.along.iter().zip(&placed.across_mm) {
            let along_mm = seam.course.along_mm(f64::from(*along).to_radians());
            assert!(seen.insert(((along_mm / 0.25) as i64, ((across + 30.0) / 0.25) as i64)));
        }
    }
}
