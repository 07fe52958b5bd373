//! The part shots joined into one cloud in base.

use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::ground::memory::require;
use crate::ground::stop::polled;
use crate::ground::threads::{self, CHUNK};
use crate::ground::transform::Transform;
use crate::weld::seam::{Course, Unrolled};

/// One segmented shot with its place.
#[derive(Debug, Clone, Copy)]
pub struct Scan<'a> {
    /// Points in the scanner's frame.
    pub points: &'a [[f64; 3]],
    /// Where the scanner stood.
    pub base_from_scanner: Transform,
    /// The same points in the seam's frame.
    pub unrolled: &'a Unrolled,
    /// How the seam runs.
    pub course: Course,
    /// A label per point.
    pub labels: &'a [u8],
    /// Deviation per point from the corrected reference wall; points without one (NaN) are left out.
    pub deviation_mm: &'a [f32],
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
    /// Deviation per point.
    pub deviation_mm: Vec<f32>,
    /// Along the seam per point, as a reading ([`Course::reading`]).
    pub along: Vec<f32>,
    /// Across the seam per point.
    pub across_mm: Vec<f32>,
    /// Shot per point.
    pub shot: Vec<u16>,
}

/// Cuts `n` items off the front.
fn take<'a, T>(rest: &mut &'a mut [T], n: usize) -> &'a mut [T] {
    let (head, tail) = std::mem::take(rest).split_at_mut(n);
    *rest = tail;
    head
}

/// Joins the shots.
///
/// # Errors
/// [`Error::Shape`] where a shot's arrays differ in length.
pub fn place(scans: &[Scan]) -> Result<Placed> {
    for s in scans {
        let n = s.points.len();
        let u = s.unrolled;
        let lengths = [s.labels.len(), s.deviation_mm.len(), u.at.len(), u.across_mm.len()];
        if lengths != [n; 4] {
            return Err(Error::Shape { what: "scan", expected: format!("{n} of each"), got: format!("{lengths:?}") });
        }
    }
    require(scans.iter().map(|s| s.points.len()).sum(), 40);
    let chunks: Vec<(&Scan, usize)> =
        scans.iter().flat_map(|s| (0..s.points.len()).step_by(CHUNK).map(move |start| (s, start))).collect();
    let indices = |s: &Scan, start: usize| start..(start + CHUNK).min(s.points.len());
    let kept = |s: &Scan, i: usize| s.deviation_mm[i].is_finite();
    threads::install(|| {
        let counts: Vec<usize> = chunks
            .par_iter()
            .inspect(polled)
            .map(|&(s, start)| indices(s, start).filter(|&i| kept(s, i)).count())
            .collect();
        let total = counts.iter().sum();
        let mut out = Placed {
            points: vec![0.0; 3 * total],
            labels: vec![0; total],
            deviation_mm: vec![0.0; total],
            along: vec![0.0; total],
            across_mm: vec![0.0; total],
            shot: vec![0; total],
        };
        let (mut points, mut labels, mut deviations) =
            (out.points.as_mut_slice(), out.labels.as_mut_slice(), out.deviation_mm.as_mut_slice());
        let (mut along, mut across, mut shots) =
            (out.along.as_mut_slice(), out.across_mm.as_mut_slice(), out.shot.as_mut_slice());
        let slots: Vec<_> = counts
            .iter()
            .map(|&n| {
                let first = (take(&mut points, 3 * n), take(&mut labels, n), take(&mut deviations, n));
                (first, (take(&mut along, n), take(&mut across, n), take(&mut shots, n)))
            })
            .collect();
        chunks.par_iter().inspect(polled).zip(slots).for_each(
            |(&(s, start), ((points, labels, deviations), (along, across, shots)))| {
                for (slot, i) in indices(s, start).filter(|&i| kept(s, i)).enumerate() {
                    let p = s.base_from_scanner.apply(&s.points[i].into());
                    points[3 * slot..3 * slot + 3].copy_from_slice(p.as_slice());
                    labels[slot] = s.labels[i];
                    deviations[slot] = s.deviation_mm[i];
                    along[slot] = s.course.reading_f32(s.unrolled.at[i]);
                    across[slot] = s.unrolled.across_mm[i];
                    shots[slot] = s.shot;
                }
            },
        );
        Ok(out)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ground::transform::Vec3;

    #[test]
    fn points_without_a_deviation_are_left_out_and_the_rest_is_moved() {
        let n = 2 * CHUNK + 5;
        let points: Vec<[f64; 3]> = (0..n).map(|i| [i as f64, 0.0, 1.0]).collect();
        let deviation_mm: Vec<f32> = (0..n).map(|i| if i % 3 == 0 { f32::NAN } else { i as f32 }).collect();
        let unrolled = Unrolled { at: vec![-0.5; n], across_mm: vec![2.0; n], height_mm: vec![0.0; n] };
        let labels = vec![1; n];
        let base_from_scanner = Transform { translation: Vec3::new(0.0, 10.0, 0.0), ..Transform::identity() };
        let scan = |shot| Scan {
            points: &points,
            base_from_scanner,
            unrolled: &unrolled,
            course: Course::of_radius(100.0).unwrap(),
            labels: &labels,
            deviation_mm: &deviation_mm,
            shot,
        };
        let placed = place(&[scan(0), scan(7)]).unwrap();
        let each: Vec<usize> = (0..n).filter(|i| i % 3 != 0).collect();
        assert_eq!(placed.labels.len(), 2 * each.len());
        for (k, &i) in each.iter().chain(&each).enumerate() {
            assert_eq!(placed.points[3 * k..3 * k + 3], [i as f64, 10.0, 1.0]);
            assert_eq!(placed.deviation_mm[k], i as f32);
            assert_eq!(placed.shot[k], if k < each.len() { 0 } else { 7 });
        }
        assert!((placed.along[0] - (360.0 - 0.5_f32.to_degrees())).abs() < 1e-4);
        assert!(place(&[Scan { labels: &[], ..scan(0) }]).is_err());
    }
}
