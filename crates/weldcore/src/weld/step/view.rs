//! The shots of one seam in one frame: a common axis and zero mark, and where each shot's points lie about them.

use crate::error::{Error, Result, require_count, require_positive};
use crate::ground::threads;
use crate::ground::transform::{Transform, Vec3};
use crate::weld::label::Label;
use crate::weld::seam::{Course, Seam, Unrolled};

/// Every so many points tell where the middle of a stretch is.
const MIDDLE_STRIDE: usize = 16;
/// Points of the reference wall, of all shots, that the common axis is fitted to.
const AXIS_POINTS: usize = 8000;
/// Intervals of a shot's table along its stretch: what it holds is smooth, and straight in between to 1e-7 of its size.
const TABLE: usize = 1024;

/// What is known of a shot's modes: points, by their number in it, and a row of all modes for each, mm.
#[derive(Debug, Clone, Copy)]
pub struct Modes<'a> {
    /// Numbers of points of the shot.
    pub points: &'a [usize],
    /// Of each, a row of all modes.
    pub deviation_mm: &'a [f64],
    /// How many modes there are.
    pub count: usize,
}

/// One shot, unrolled and labelled (see [`crate::weld::segment`]).
#[derive(Debug, Clone, Copy)]
pub struct LabelledShot<'a> {
    /// The points in the seam's frame, across from its centreline.
    pub unrolled: &'a Unrolled,
    /// A [`Label`] per point.
    pub labels: &'a [u8],
    /// The frame of `unrolled`.
    pub seam: Seam,
    /// Of the nominal wall.
    pub thickness_mm: f64,
    /// Where the scanner stood; `None` of all shots: their seams' frames are taken for one.
    pub base_from_scanner: Option<Transform>,
    /// What the scanner's calibration leaves open: of all shots, or of none.
    pub modes: Option<Modes<'a>>,
}

pub(super) fn is_wall(label: u8) -> Option<bool> {
    match label {
        l if l == Label::ReferenceWall as u8 => Some(false),
        l if l == Label::OtherWall as u8 => Some(true),
        _ => None,
    }
}

impl LabelledShot<'_> {
    pub(super) fn check(&self) -> Result<()> {
        let n = self.labels.len();
        if [self.unrolled.at.len(), self.unrolled.across_mm.len(), self.unrolled.height_mm.len()] != [n; 3] {
            let (expected, got) = ("arrays of one length".into(), "different lengths".into());
            return Err(Error::Shape { what: "shot", expected, got });
        }
        require_positive("thickness_mm", self.thickness_mm)
    }

    fn walls(&self) -> impl Iterator<Item = (usize, bool)> {
        self.labels.iter().enumerate().filter_map(|(i, l)| is_wall(*l).map(|other| (i, other)))
    }
}

/// The seam that all shots are counted about: of one shot its own; of several the mean of theirs in base, with the surface that
/// fits the reference wall of all of them.
pub(super) fn common_seam(shots: &[LabelledShot]) -> Result<Seam> {
    let (first, rest) =
        shots.split_first().ok_or(Error::TooFew { what: "part shots with both walls", needed: 1, got: 0 })?;
    let Some(placed) = first.base_from_scanner else {
        return Ok(Seam { course: Course::mean(shots.iter().map(|s| s.seam.course)), ..first.seam });
    };
    let own = in_base(&first.seam, &placed)?;
    if rest.is_empty() {
        return Ok(own);
    }
    let seams = shots.iter().filter_map(|s| in_base(&s.seam, &s.base_from_scanner?).ok()).collect::<Vec<Seam>>();
    let mean = |pick: fn(&Seam) -> Vec3| seams.iter().map(pick).sum::<Vec3>() / seams.len() as f64;
    let course = Course::mean(seams.iter().map(|s| s.course));
    let start = Seam::new(mean(|s| s.origin_mm), mean(|s| s.across), mean(|s| s.zero), course)?;
    let each = AXIS_POINTS / shots.len();
    let mut wall: Vec<[f64; 3]> = Vec::with_capacity(AXIS_POINTS);
    for shot in shots {
        let Some(base_from_scanner) = shot.base_from_scanner else { continue };
        let mine: Vec<usize> = shot.walls().filter(|(_, other)| !other).map(|(i, _)| i).collect();
        for i in mine.iter().step_by(mine.len().div_ceil(each.max(1)).max(1)) {
            let u = shot.unrolled;
            let (at, height) = (f64::from(u.at[*i]), f64::from(u.height_mm[*i]));
            let p = shot.seam.point(at, f64::from(u.across_mm[*i])) + shot.seam.outward(at) * height;
            wall.push(base_from_scanner.apply(&p).into());
        }
    }
    let (fitted, _) = start.refined(&wall, course)?;
    // Across is counted from the weld: from where the shots have it, on average.
    let across = seams.iter().map(|s| fitted.across.dot(&(s.origin_mm - fitted.origin_mm))).sum::<f64>();
    Ok(Seam { origin_mm: fitted.origin_mm + fitted.across * (across / seams.len() as f64), ..fitted })
}

fn in_base(seam: &Seam, base_from_scanner: &Transform) -> Result<Seam> {
    let turn = |v: &Vec3| base_from_scanner.apply(v) - base_from_scanner.apply(&Vec3::zeros());
    Seam::new(base_from_scanner.apply(&seam.origin_mm), turn(&seam.across), turn(&seam.zero), seam.course)
}

/// One shot about the common seam.
#[derive(Debug, Clone)]
pub(super) struct SeamView {
    pub course: Course,
    /// The stretch of the seam that was seen of the walls, about the common seam.
    pub middle: f64,
    pub half: f64,
    /// The same in the shot's own frame, which the table is over.
    own_middle: f64,
    own_half: f64,
    /// What is added to place along, place across and height in the shot's own frame: constant, and per mm across.
    table: Vec<[f64; 6]>,
    /// How far each wall reaches from the centreline: from, to.
    pub reach_mm: [[f64; 2]; 2],
}

impl SeamView {
    /// # Errors
    /// [`Error::TooFew`] without both walls, [`Error::Degenerate`] where all points lie at one place.
    pub fn of(shot: &LabelledShot, common: &Seam) -> Result<Self> {
        let (own, u) = (shot.seam.course, shot.unrolled);
        // Any place about the middle will do to count from.
        let some = (0..shot.labels.len()).step_by(MIDDLE_STRIDE).filter(|i| is_wall(shot.labels[*i]).is_some());
        let own_middle = own.middle(some.map(|i| u.at[i]));
        let walls =
            |range: std::ops::Range<usize>| range.filter_map(|i| Some((i, usize::from(is_wall(shot.labels[i])?))));
        let (mut count, mut own_half, mut far) = ([0_usize; 2], 0.0_f64, 1.0_f64);
        for (more, half, reach) in threads::map_ranges(shot.labels.len(), |range| {
            let (mut count, mut half, mut far) = ([0_usize; 2], 0.0_f64, 1.0_f64);
            for (i, k) in walls(range) {
                count[k] += 1;
                half = half.max(own.apart(f64::from(u.at[i]), own_middle).abs());
                far = far.max(f64::from(u.across_mm[i].abs()));
            }
            (count, half, far)
        }) {
            count = [count[0] + more[0], count[1] + more[1]];
            (own_half, far) = (own_half.max(half), far.max(reach));
        }
        for (what, n) in [("points of the reference wall", count[0]), ("points of the other wall", count[1])] {
            require_count(what, 100, n)?;
        }
        if own_half <= 0.0 {
            return Err(Error::Degenerate { what: "step", reason: "all points lie at one angle".into() });
        }
        let placed = |at: f64, across: f64| {
            let Some(base_from_scanner) = &shot.base_from_scanner else { return [at, across, 0.0] };
            common.place(&base_from_scanner.apply(&shot.seam.point(at, across)).into())
        };
        let entry = |k: usize| {
            let at = own_middle + own_half * (2.0 * k as f64 / TABLE as f64 - 1.0);
            let ends = [-far, far].map(|across| {
                let [a, z, h] = placed(at, across);
                [own.apart(a, at), z - across, h]
            });
            let mean = |i: usize| (ends[0][i] + ends[1][i]) / 2.0;
            let slope = |i: usize| (ends[1][i] - ends[0][i]) / (2.0 * far);
            [mean(0), mean(1), mean(2), slope(0), slope(1), slope(2)]
        };
        let course = common.course;
        let mut view = Self {
            course,
            middle: own_middle,
            half: own_half,
            own_middle,
            own_half,
            table: (0..=TABLE).map(entry).collect(),
            reach_mm: [[f64::INFINITY, 0.0]; 2],
        };
        view.middle = course.apart(own_middle + view.entry(own_middle)[0], 0.0);
        let parts = threads::map_ranges(shot.labels.len(), |range| {
            let (mut half, mut reach) = (0.0_f64, [[f64::INFINITY, 0.0]; 2]);
            for (i, k) in walls(range) {
                let [at, across, _] = view.placed(u, i);
                half = half.max(course.apart(at, view.middle).abs());
                reach[k] = [reach[k][0].min(across.abs()), reach[k][1].max(across.abs())];
            }
            (half, reach)
        });
        view.half = parts.iter().map(|p| p.0).fold(0.0, f64::max);
        view.reach_mm = std::array::from_fn(|k| {
            let all = parts.iter().map(|p| p.1[k]);
            all.fold([f64::INFINITY, 0.0], |a, b| [a[0].min(b[0]), f64::max(a[1], b[1])])
        });
        Ok(view)
    }

    /// The table at a place in the shot's own frame; beyond the walls' stretch (nothing of the weld is there) that of its end.
    #[inline]
    fn entry(&self, own: f64) -> [f64; 6] {
        let local = self.course.apart(own, self.own_middle) / self.own_half;
        let place = ((local + 1.0) / 2.0 * TABLE as f64).clamp(0.0, TABLE as f64 - 1e-9);
        let (k, part) = (place as usize, place.fract());
        let (a, b) = (&self.table[k], &self.table[k + 1]);
        std::array::from_fn(|c| a[c] + part * (b[c] - a[c]))
    }

    /// A point's place along and across, and its height, about the common seam.
    #[inline]
    pub fn placed(&self, unrolled: &Unrolled, i: usize) -> [f64; 3] {
        let (at, across) = (f64::from(unrolled.at[i]), f64::from(unrolled.across_mm[i]));
        let e = self.entry(at);
        let height = f64::from(unrolled.height_mm[i]);
        [at + e[0] + e[3] * across, across + e[1] + e[4] * across, height + e[2] + e[5] * across]
    }

    /// Every point's height over a surface that is given about the common seam, place along and across.
    pub fn over(&self, shot: &LabelledShot, surface: impl Fn(f64, f64) -> f64) -> Vec<f32> {
        let table: Vec<[f64; 2]> = (0..=TABLE)
            .map(|k| {
                let own = self.own_middle + self.own_half * (2.0 * k as f64 / TABLE as f64 - 1.0);
                let [at, across, height, _, _, lean] = self.table[k];
                let here = own + at;
                let [low, high] = [-1.0, 1.0].map(|z| surface(here, across + z));
                [height - (low + high) / 2.0, lean - (high - low) / 2.0]
            })
            .collect();
        let unrolled = shot.unrolled;
        threads::map_ranges(shot.labels.len(), |range| {
            let one = |i: usize| {
                let local = self.course.apart(f64::from(unrolled.at[i]), self.own_middle) / self.own_half;
                let place = ((local + 1.0) / 2.0 * TABLE as f64).clamp(0.0, TABLE as f64 - 1e-9);
                // A point that is none has no place.
                let (k, part) = (place as usize, place.fract());
                let blend = |c: usize| table[k][c] + part * (table[k + 1][c] - table[k][c]);
                (f64::from(unrolled.height_mm[i]) + blend(0) + f64::from(unrolled.across_mm[i]) * blend(1)) as f32
            };
            range.map(one).collect::<Vec<f32>>()
        })
        .concat()
    }
}
