//! What became of every pixel of a part shot, bin by bin along the seam: none is forgotten.
//!
//! A pixel with a point has the fate that [`crate::weld::segment`] gave it. A pixel without one lies where its ray meets the
//! surface of the reference wall, and its fate is the reason that decoding gave.

use super::label::Fate;
use super::segment::Segmentation;
use crate::error::{Error, Result};
use crate::fringes::Reason;
use crate::ground::threads;
use crate::ground::transform::Vec3;
use crate::scanner::Lens;
use crate::scanner::calibrated_region::OUTSIDE_CALIBRATION;

/// The fates, in the order of `weldscan.result.FATES`: wall, transition, cap, gated, off line, dark, saturated, order in
/// doubt, two paths, outside the calibration, hidden, other.
pub const FATES: usize = 12;
/// Which of them a pixel with a point has.
const IS_POINT: [bool; FATES] = [true, true, true, true, true, false, false, false, false, false, false, true];
/// Pixels this near to the weld count as its own: the surfaces beside the toes are read from them.
const NEAR_MM: f64 = 8.0;

/// Pixels by bin and fate.
#[derive(Debug, Clone, PartialEq)]
pub struct SeamFates {
    /// All pixels of the view.
    pub all: Vec<[u32; FATES]>,
    /// Those on the weld and within 8 mm of its toes.
    pub near: Vec<[u32; FATES]>,
    /// The same without their fates, in cells of half a station along the seam, a whole number of them to a bin: pixels, and
    /// those of them that have a point. A dark stretch may be shorter than a bin.
    pub cells: Vec<[u32; 2]>,
}

fn of_fate(fate: u8) -> Option<usize> {
    match fate {
        f if f == Fate::Wall as u8 => Some(0),
        f if f == Fate::Transition as u8 => Some(1),
        f if f == Fate::Cap as u8 => Some(2),
        f if f == Fate::Gated as u8 => Some(3),
        f if f == Fate::OffLine as u8 => Some(4),
        f if f == Fate::Other as u8 => Some(11),
        _ => None,
    }
}

fn of_reason(reason: u8) -> usize {
    match reason {
        r if r == Reason::Saturated as u8 => 6,
        // Samples that are no sinusoid have no fringe order either.
        r if r == Reason::OrderInDoubt as u8 || r == Reason::NoFit as u8 => 7,
        OUTSIDE_CALIBRATION => 9,
        _ => 5,
    }
}

/// Counts the pixels of a segmented shot; `reasons` as decoding gave them, or [`OUTSIDE_CALIBRATION`], `camera` with the shot's width and height.
///
/// # Errors
/// [`Error::Shape`] where the arrays are not those of one image of the camera.
pub fn seam_fates(shot: &Segmentation, reasons: &[u8], camera: &Lens) -> Result<SeamFates> {
    let n = camera.width * camera.height;
    if [shot.fates.len(), reasons.len()] != [n, n] {
        let got = format!("{} points and {} reasons", shot.fates.len(), reasons.len());
        return Err(Error::Shape { what: "shot", expected: format!("{n} pixels of the camera"), got });
    }
    let seam = &shot.seam;
    let bins = seam.course.bins();
    let toes = shot.sections.stations.iter().filter_map(|s| s.toes_mm);
    let half = toes.map(|t| 0.5 * (t[1] - t[0])).fold(0.0, f64::max) + NEAR_MM;
    // How far the view reaches across: beyond it no ray is the seam's.
    let reach = |i: usize| f64::from(shot.unrolled.across_mm[i]);
    let walls = (0..n).step_by(7).filter(|&i| shot.fates[i] == Fate::Wall as u8);
    let (low, high) = walls.map(reach).fold((f64::INFINITY, f64::NEG_INFINITY), |r, z| (r.0.min(z), r.1.max(z)));
    let cells_per_bin = (seam.course.bin_mm() / (0.5 * shot.sections.station_mm)).round().max(1.0);
    let cell =
        |at: f64| seam.course.bin(at) * cells_per_bin as usize + (seam.course.in_bin(at) * cells_per_bin) as usize;
    let one = |i: usize| -> Option<(f64, usize, f64)> {
        if let Some(fate) = of_fate(shot.fates[i]) {
            return Some((f64::from(shot.unrolled.at[i]), fate, reach(i)));
        }
        let (x, y) = camera.undistort((i % camera.width) as f64, (i / camera.width) as f64)?;
        let foot = seam.meet(&Vec3::new(x, y, 1.0))?;
        let [at, across, _] = seam.place(&foot.into());
        (across > low && across < high).then(|| (at, of_reason(reasons[i]), across))
    };
    let empty = || SeamFates {
        all: vec![[0; FATES]; bins],
        near: vec![[0; FATES]; bins],
        cells: vec![[0; 2]; bins * cells_per_bin as usize],
    };
    let parts = threads::map_ranges(n, |range| {
        let mut part = empty();
        for (at, fate, across) in range.filter_map(one) {
            let bin = seam.course.bin(at);
            part.all[bin][fate] += 1;
            if across.abs() < half {
                part.near[bin][fate] += 1;
                let [pixels, points] = &mut part.cells[cell(at)];
                *pixels += 1;
                *points += u32::from(IS_POINT[fate]);
            }
        }
        part
    });
    let mut found = empty();
    for part in parts {
        add(&mut found.all, &part.all);
        add(&mut found.near, &part.near);
        add(&mut found.cells, &part.cells);
    }
    Ok(found)
}

fn add<const N: usize>(sum: &mut [[u32; N]], part: &[[u32; N]]) {
    sum.as_flattened_mut().iter_mut().zip(part.as_flattened()).for_each(|(s, p)| *s += p);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::weld::segment::segment;
    use crate::weld::segment::tests::{COLUMNS, EXAMPLE, ROWS};

    #[test]
    fn every_pixel_of_the_seam_is_counted_once() {
        let mut points = EXAMPLE.points();
        let mut reasons = vec![0_u8; points.len()];
        // A band across the whole view is dark, another saturated, a third outside the calibration.
        for row in 100..130 {
            for column in 0..COLUMNS {
                let i = row * COLUMNS + column;
                points[i] = [f64::NAN; 3];
                reasons[i] = [Reason::Dark as u8, Reason::Saturated as u8, OUTSIDE_CALIBRATION][row / 10 - 10];
            }
        }
        let shot = segment(&points, COLUMNS, &EXAMPLE.nominal()).unwrap();
        // A camera that sees the pipe as the points do: about 0.5 mm a pixel at 420 mm.
        let camera = Lens::new(COLUMNS, ROWS, [880.0, 880.0], [189.0, 149.5], [0.0; 5]).unwrap();
        let found = seam_fates(&shot, &reasons, &camera).unwrap();
        let total = |f: usize| found.all.iter().map(|b| b[f]).sum::<u32>();
        let valid = points.iter().filter(|p| p[0].is_finite()).count() as u32;
        assert_eq!([0, 1, 2, 3, 4, 11].map(total).iter().sum::<u32>(), valid);
        // The rays of nearly all lost pixels meet the pipe.
        for (fate, lost) in [(5, 10 * COLUMNS), (6, 10 * COLUMNS), (9, 10 * COLUMNS)] {
            assert!(f64::from(total(fate)) > 0.9 * lost as f64, "{fate} {} {lost}", total(fate));
        }
        assert!(total(0) > 8 * valid / 10 && total(2) > 0 && total(3) == 0);
        for k in 0..found.all.len() {
            assert!(std::iter::zip(found.near[k], found.all[k]).all(|(near, all)| near <= all));
        }
        // Cells tell the same as their bins, and which of them are dark.
        let per_bin = found.cells.len() / found.near.len();
        for (near, cells) in found.near.iter().zip(found.cells.chunks(per_bin)) {
            assert_eq!(near.iter().sum::<u32>(), cells.iter().map(|c| c[0]).sum::<u32>());
            let lost = (5..11).map(|f| near[f]).sum::<u32>();
            assert_eq!(lost, cells.iter().map(|c| c[0] - c[1]).sum::<u32>());
        }
        let dark = found.cells.iter().filter(|c| c[0] > 50 && 20 * c[1] < c[0]).count();
        // 20 rows of half a millimetre, in cells of two; where a dark pixel lies is known to about a row.
        assert!((2..=6).contains(&dark), "{dark}");
        assert!(seam_fates(&shot, &reasons[1..], &camera).is_err());
    }
}
