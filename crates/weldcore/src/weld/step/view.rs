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
            let [at, across, height] = [u.at[*i], u.across_mm[*i], u.height_mm[*i]].map(f64::from);
            let p = shot.seam.above(at, across, height);
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
    pub own: Stretched,
    /// What is added to place along, place across and height in the shot's own frame: constant, and per mm across.
    table: Vec<[f64; 6]>,
    /// How far each wall reaches from the centreline: from, to.
    pub reach_mm: [[f64; 2]; 2],
}

/// A stretch of a shot's own seam, which tables are over.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Stretched {
    pub(crate) course: Course,
    pub(crate) middle: f64,
    pub(crate) half: f64,
}

impl Stretched {
    /// Where a place lies in a table: the entry before it, and how far it is on to the next; beyond the stretch (nothing of the weld
    /// is there) that of its end.
    #[inline]
    fn slot(&self, at: f64) -> (usize, f64) {
        let local = self.course.apart(at, self.middle) / self.half;
        let place = ((local + 1.0) / 2.0 * TABLE as f64).clamp(0.0, TABLE as f64 - 1e-9);
        // A point that is none has no place.
        let k = place as i32 as usize;
        (k, place - k as f64)
    }

    /// The place of an entry.
    fn place(&self, entry: usize) -> f64 {
        self.middle + self.half * (2.0 * entry as f64 / TABLE as f64 - 1.0)
    }
}

/// What a pass over a shot's points tells of its walls.
struct WallExtent {
    count: [usize; 2],
    half: f64,
    far: f64,
    reach_mm: [[f64; 2]; 2],
}

impl WallExtent {
    const NONE: Self = Self { count: [0; 2], half: 0.0, far: 1.0, reach_mm: [[f64::INFINITY, 0.0]; 2] };

    fn of(shot: &LabelledShot, middle: f64) -> Self {
        let (own, u) = (shot.seam.course, shot.unrolled);
        let parts = threads::map_ranges(shot.labels.len(), |range| {
            let mut part = Self::NONE;
            for i in range {
                let Some(k) = is_wall(shot.labels[i]).map(usize::from) else { continue };
                let across = f64::from(u.across_mm[i].abs());
                part.count[k] += 1;
                part.half = part.half.max(own.apart(f64::from(u.at[i]), middle).abs());
                part.reach_mm[k] = [part.reach_mm[k][0].min(across), part.reach_mm[k][1].max(across)];
            }
            part
        });
        let mut all = Self::NONE;
        for part in parts {
            all.half = all.half.max(part.half);
            for k in 0..2 {
                all.count[k] += part.count[k];
                let [from, to] = part.reach_mm[k];
                all.reach_mm[k] = [all.reach_mm[k][0].min(from), all.reach_mm[k][1].max(to)];
                all.far = all.far.max(to);
            }
        }
        all
    }
}

impl SeamView {
    /// # Errors
    /// [`Error::TooFew`] without both walls, [`Error::Degenerate`] where all points lie at one place.
    pub fn of(shot: &LabelledShot, common: &Seam) -> Result<Self> {
        let (own, u) = (shot.seam.course, shot.unrolled);
        // Any place about the middle will do to count from.
        let some = (0..shot.labels.len()).step_by(MIDDLE_STRIDE).filter(|i| is_wall(shot.labels[*i]).is_some());
        let own_middle = own.middle(some.map(|i| u.at[i]));
        let extent = WallExtent::of(shot, own_middle);
        let walls = [("points of the reference wall", extent.count[0]), ("points of the other wall", extent.count[1])];
        for (what, n) in walls {
            require_count(what, 100, n)?;
        }
        if extent.half <= 0.0 {
            return Err(Error::Degenerate { what: "step", reason: "all points lie at one angle".into() });
        }
        let placed = |at: f64, across: f64| {
            let Some(base_from_scanner) = &shot.base_from_scanner else { return [at, across, 0.0] };
            common.place(&base_from_scanner.apply(&shot.seam.point(at, across)).into())
        };
        let stretch = Stretched { course: own, middle: own_middle, half: extent.half };
        let far = extent.far;
        let entry = |k: usize| {
            let at = stretch.place(k);
            let ends = [-far, far].map(|across| {
                let [a, z, h] = placed(at, across);
                [own.apart(a, at), z - across, h]
            });
            let mean = |i: usize| (ends[0][i] + ends[1][i]) / 2.0;
            let slope = |i: usize| (ends[1][i] - ends[0][i]) / (2.0 * far);
            [mean(0), mean(1), mean(2), slope(0), slope(1), slope(2)]
        };
        let course = common.course;
        let table: Vec<[f64; 6]> = (0..=TABLE).map(entry).collect();
        let mut view =
            Self { course, middle: 0.0, half: 0.0, own: stretch, table, reach_mm: [[f64::INFINITY, 0.0]; 2] };
        view.middle = course.apart(view.moved(own_middle, 0.0, 0.0)[0], 0.0);
        // How far the walls reach about the common seam: by the corners of their stretch.
        for at in [0, TABLE / 2, TABLE].map(|k| stretch.place(k)) {
            for (k, sign) in [(0, -1.0), (1, 1.0)] {
                for (end, mm) in extent.reach_mm[k].into_iter().enumerate() {
                    let [along, across, _] = view.moved(at, sign * mm, 0.0);
                    view.half = view.half.max(course.apart(along, view.middle).abs());
                    let reach = &mut view.reach_mm[k][end];
                    *reach = if end == 0 { reach.min(across.abs()) } else { reach.max(across.abs()) };
                }
            }
        }
        Ok(view)
    }

    /// Place along and across, and height, about the common seam of what lies there in the shot's own frame.
    #[inline]
    pub fn moved(&self, at: f64, across: f64, height: f64) -> [f64; 3] {
        let (k, part) = self.own.slot(at);
        let (a, b) = (&self.table[k], &self.table[k + 1]);
        let e: [f64; 6] = std::array::from_fn(|c| a[c] + part * (b[c] - a[c]));
        [at + e[0] + e[3] * across, across + e[1] + e[4] * across, height + e[2] + e[5] * across]
    }

    /// A point's place along and across, and its height, about the common seam.
    pub fn placed(&self, unrolled: &Unrolled, i: usize) -> [f64; 3] {
        let [at, across, height] = [unrolled.at[i], unrolled.across_mm[i], unrolled.height_mm[i]].map(f64::from);
        self.moved(at, across, height)
    }

    /// A surface that is given about the common seam, place along and across, as the shot's own frame has it.
    pub fn surface(&self, surface: impl Fn(f64, f64) -> f64) -> OwnSurface {
        let entry = |k: usize| {
            let [at, across, height, _, _, lean] = self.table[k];
            let here = self.own.place(k) + at;
            let [low, high] = [-1.0, 1.0].map(|z| surface(here, across + z));
            [height - (low + high) / 2.0, lean - (high - low) / 2.0]
        };
        OwnSurface { stretch: self.own, table: (0..=TABLE).map(entry).collect() }
    }
}

/// The reference wall's surface, of all shots together, in one shot's own frame.
#[derive(Debug, Clone, PartialEq)]
pub struct OwnSurface {
    pub(crate) stretch: Stretched,
    /// What is added to a height: constant, and per mm across.
    pub(crate) table: Vec<[f64; 2]>,
}

impl OwnSurface {
    /// The wall of the shot's own frame, so far inside.
    #[cfg(test)]
    pub(crate) fn flat(course: Course, inside_mm: f64) -> Self {
        Self { stretch: Stretched { course, middle: 0.0, half: 1.0 }, table: vec![[inside_mm, 0.0]; TABLE + 1] }
    }

    /// How far a point stands off it; NaN where there is none.
    #[inline]
    pub fn deviation(&self, unrolled: &Unrolled, i: usize) -> f32 {
        let (k, part) = self.stretch.slot(f64::from(unrolled.at[i]));
        let blend = |c: usize| self.table[k][c] + part * (self.table[k + 1][c] - self.table[k][c]);
        (f64::from(unrolled.height_mm[i]) + blend(0) + f64::from(unrolled.across_mm[i]) * blend(1)) as f32
    }

    /// The same of every point.
    pub fn deviations(&self, unrolled: &Unrolled) -> Vec<f32> {
        let of = |range: std::ops::Range<usize>| range.map(|i| self.deviation(unrolled, i)).collect::<Vec<f32>>();
        threads::map_ranges(unrolled.at.len(), of).concat()
    }
}
