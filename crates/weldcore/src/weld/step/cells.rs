//! The walls of a shot, averaged into cells.

use rayon::prelude::*;

use crate::error::{Error, Result, require_count};
use crate::ground::robust::median;
use crate::ground::stop::polled;
use crate::ground::threads;
use crate::weld::label::Label;
use crate::weld::seam::{Course, Unrolled};

/// Cells per wall and shot: enough to see the unevenness's correlation, few enough to handle their covariance whole.
const CELLS_PER_WALL: f64 = 700.0;
/// Every so many points tell where the middle of a stretch is.
const MIDDLE_STRIDE: usize = 16;
/// A cell needs this part of the points of a typical cell.
const FULL_PART: f64 = 0.25;

/// One shot, unrolled and labelled (see [`crate::weld::segment`]).
#[derive(Debug, Clone, Copy)]
pub struct LabelledShot<'a> {
    /// The points in the seam's frame, across from its centreline.
    pub unrolled: &'a Unrolled,
    /// A [`Label`] per point.
    pub labels: &'a [u8],
    /// How the seam runs.
    pub course: Course,
    /// Distance between the toes.
    pub bead_width_mm: f64,
    /// Of the nominal wall.
    pub thickness_mm: f64,
}

#[derive(Debug, Clone, Copy)]
pub(super) struct Cell {
    pub(super) shot: usize,
    pub(super) other: bool,
    pub(super) at: f64,
    pub(super) across: f64,
    pub(super) height: f64,
}

/// The stretch of the seam that one shot saw: places are counted from its middle.
#[derive(Debug, Clone, Copy)]
pub(super) struct Stretch {
    pub(super) middle: f64,
    pub(super) half: f64,
    pub(super) course: Course,
}

impl Stretch {
    pub(super) fn local(&self, at: f64) -> f64 {
        self.course.apart(at, self.middle)
    }
}

/// Sums of a wall's points over a grid of cells.
pub(super) struct WallGrid {
    pub(super) cells: Vec<Cell>,
    pub(super) cell_mm: f64,
}

pub(super) fn is_wall(label: u8) -> Option<bool> {
    match label {
        l if l == Label::ReferenceWall as u8 => Some(false),
        l if l == Label::OtherWall as u8 => Some(true),
        _ => None,
    }
}

/// The stretch of a shot's walls, from the middle of what was seen of them.
pub(super) fn stretch_of(shot: &LabelledShot) -> Result<Stretch> {
    let mut count = [0_usize; 2];
    shot.labels.iter().filter_map(|l| is_wall(*l)).for_each(|other| count[usize::from(other)] += 1);
    for (what, n) in [("points of the reference wall", count[0]), ("points of the other wall", count[1])] {
        require_count(what, 100, n)?;
    }
    let walls = || shot.unrolled.at.iter().zip(shot.labels).enumerate().filter(|(_, (_, l))| is_wall(**l).is_some());
    // Any place about the middle will do to count from.
    let some = walls().filter(|(i, _)| i % MIDDLE_STRIDE == 0).map(|(_, (at, _))| *at);
    let mut stretch = Stretch { middle: shot.course.middle(some), half: 0.0, course: shot.course };
    for (_, (at, _)) in walls() {
        stretch.half = stretch.half.max(stretch.local(f64::from(*at)).abs());
    }
    if stretch.half <= 0.0 {
        return Err(Error::Degenerate { what: "step", reason: "all points lie at one angle".into() });
    }
    Ok(stretch)
}

pub(super) fn grid_of(index: usize, shot: &LabelledShot, stretch: &Stretch) -> Result<WallGrid> {
    let mut low = [f64::INFINITY; 2];
    let mut high = [f64::NEG_INFINITY; 2];
    for (z, l) in shot.unrolled.across_mm.iter().zip(shot.labels) {
        if let Some(other) = is_wall(*l) {
            let k = usize::from(other);
            low[k] = low[k].min(f64::from(*z));
            high[k] = high[k].max(f64::from(*z));
        }
    }
    let length_mm = stretch.course.along_mm(2.0 * stretch.half);
    let area = length_mm * (high[0] - low[0]).max(high[1] - low[1]);
    let cell_mm = (area / CELLS_PER_WALL).sqrt();
    if !(cell_mm.is_finite() && cell_mm > 0.0) {
        return Err(Error::Degenerate { what: "step", reason: "the walls have no extent".into() });
    }
    let columns = (length_mm / cell_mm) as usize + 1;
    let rows: [usize; 2] = std::array::from_fn(|k| ((high[k] - low[k]) / cell_mm) as usize + 1);
    let total = columns * (rows[0] + rows[1]);
    // Along, across, height, count; one partial grid per large chunk, added in order.
    let indices: Vec<usize> = (0..shot.labels.len()).collect();
    let parts: Vec<Vec<[f64; 4]>> = threads::install(|| {
        indices
            .par_chunks(8 * threads::CHUNK)
            .inspect(polled)
            .map(|chunk| {
                let mut sums = vec![[0.0; 4]; total];
                for &i in chunk {
                    let Some(other) = is_wall(shot.labels[i]) else { continue };
                    let k = usize::from(other);
                    let (a, z) = (stretch.local(f64::from(shot.unrolled.at[i])), f64::from(shot.unrolled.across_mm[i]));
                    let column = ((stretch.course.along_mm(a + stretch.half) / cell_mm) as usize).min(columns - 1);
                    let row = (((z - low[k]) / cell_mm) as usize).min(rows[k] - 1);
                    let slot = &mut sums[columns * (k * rows[0] + row) + column];
                    let d = f64::from(shot.unrolled.height_mm[i]);
                    *slot = [slot[0] + a, slot[1] + z, slot[2] + d, slot[3] + 1.0];
                }
                sums
            })
            .collect()
    });
    let mut sums = vec![[0.0; 4]; total];
    for part in parts {
        for (a, b) in sums.iter_mut().zip(part) {
            *a = std::array::from_fn(|k| a[k] + b[k]);
        }
    }
    let mut counts: Vec<f64> = sums.iter().map(|s| s[3]).filter(|n| *n > 0.0).collect();
    let full = FULL_PART * median(&mut counts);
    let cell = |(k, s): (usize, &[f64; 4])| {
        (s[3] > 0.0 && s[3] >= full).then(|| Cell {
            shot: index,
            other: k >= columns * rows[0],
            at: stretch.middle + s[0] / s[3],
            across: s[1] / s[3],
            height: s[2] / s[3],
        })
    };
    // Wall by wall, and along the seam: neighbours in the list are neighbours on the wall, see `Whitener`.
    let place = |k: usize, c: usize, r: usize| columns * (k * rows[0] + r) + c;
    let turned = (0..2).flat_map(|k| (0..columns).flat_map(move |c| (0..rows[k]).map(move |r| place(k, c, r))));
    Ok(WallGrid { cells: turned.filter_map(|i| cell((i, &sums[i]))).collect(), cell_mm })
}
