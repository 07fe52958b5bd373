//! A scanned part into reference wall, other wall and bead, without seeds.
//!
//! The shot is unrolled into the seam's frame: along, across, height. [`crate::weld::sections`] finds cap, toes and undisturbed
//! walls in it, station by station; every point gets a fate by them. The reference wall's surface is then fitted to its undisturbed points, with the weld's shrinkage taken out, and all is counted from it.

use rayon::prelude::*;

use super::coarse::{Nominal, coarse_frame};
use super::label::{Fate, Label};
use super::seam::{Seam, Unrolled};
use crate::error::{Error, Result, require_positive};
use crate::ground::robust::median;
use crate::ground::stop::polled;
use crate::ground::threads::{self, CHUNK};
use crate::ground::transform::Vec3;
use crate::weld::sections::{self, Sections, ShellTable, Station, TOLERANCE_MM};

/// A segmented shot.
#[derive(Debug, Clone)]
pub struct Segmentation {
    /// The seam, on the surface of the reference wall.
    pub seam: Seam,
    /// A [`Label`] per point.
    pub labels: Vec<u8>,
    /// The points in the frame of `seam`.
    pub unrolled: Unrolled,
    /// Noise of one point across the wall (robust, 1 sigma).
    pub noise_mm: f64,
    /// Mean distance between the toes.
    pub bead_width_mm: f64,
    /// Whether the course's size was fitted; otherwise too little was seen for it and it is the nominal one.
    pub course_fitted: bool,
    /// A [`Fate`] per point.
    pub fates: Vec<u8>,
    /// Of the nominal wall.
    pub thickness_mm: f64,
    /// The cross-sections along the seam.
    pub sections: Sections,
}

impl Segmentation {
    /// Some of the points again, in the frame that they came in: x, y and z of each. The shot keeps them in single precision.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for a place beyond the last.
    pub fn points(&self, indices: &[usize]) -> Result<Vec<f64>> {
        let (u, seam) = (&self.unrolled, &self.seam);
        let mut flat = Vec::with_capacity(3 * indices.len());
        for &i in indices {
            let Some((at, (across, height))) = u.at.get(i).zip(u.across_mm.get(i).zip(u.height_mm.get(i))) else {
                let expected = format!("0 to {}", u.at.len().saturating_sub(1));
                return Err(Error::OutOfRange { what: "index of a point", expected, value: i.to_string() });
            };
            let p = seam.above(f64::from(*at), f64::from(*across), f64::from(*height));
            flat.extend_from_slice(p.as_slice());
        }
        Ok(flat)
    }
}

/// Points further from the pipe than this many wall thicknesses are something else: neither a step nor the
/// reinforcement of a weld comes near.
const GATE_THICKNESSES: f64 = 2.0;
/// The strip on which the cap's flank throws light of its own (it pulls the phase by micrometres), in heights of the cap:
/// on two sessions with such light the step moves by 0.003 mm at one height, and no more from 1.7 on.
const STRIP_HEIGHTS: f64 = 1.7;
/// Points so many stations beyond the outermost ones, in the corners of a view, are held against those.
const CORNER_STATIONS: f64 = 4.0;
/// Segments one shot. `points` is a pixel grid `width` wide, row-major, NaN where there is no point; in one column or row
/// they are a cloud, in any order.
///
/// # Errors
/// [`Error::Shape`], [`Error::OutOfRange`] on bad arguments; [`Error::TooFew`] where there is next to nothing;
/// [`Error::NotFound`] with the reason where no weld, or only one wall, is in view.
pub fn segment(points: &[[f64; 3]], width: usize, nominal: &Nominal) -> Result<Segmentation> {
    require_positive("wall thickness", nominal.wall_thickness_mm)?;
    if width == 0 || !points.len().is_multiple_of(width) {
        let (expected, got) = (format!("rows of {width} pixels"), format!("{} pixels", points.len()));
        return Err(Error::Shape { what: "points", expected, got });
    }
    crate::ground::memory::require(points.len(), 80);
    let coarse = coarse_frame(points, width, nominal)?;
    let unrolled = Unrolled::of(points, &coarse);
    let thickness = nominal.wall_thickness_mm;
    let mut sections = sections::examine(&unrolled, coarse.course, thickness, GATE_THICKNESSES * thickness)?;
    let (fates, labels) = sort_points(&sections, &unrolled, thickness);
    let wall = undrawn(points, &labels, &unrolled, &sections, &coarse, thickness);
    let (seam, course_fitted) = coarse.refined(&wall, nominal.course)?;
    let seam = Seam { origin_mm: seam.origin_mm + seam.across * centreline(&sections, &coarse, &seam), ..seam };
    reframe(&mut sections, &coarse, &seam);
    Ok(Segmentation {
        seam,
        labels,
        fates,
        unrolled: Unrolled::of(points, &seam),
        noise_mm: sections.noise_mm,
        bead_width_mm: sections.cap_width_mm,
        course_fitted,
        thickness_mm: thickness,
        sections,
    })
}

/// A shot whose points somebody else has labelled, about a seam that is roughly known: the reference wall's surface is fitted, the
/// seam's centreline is taken as given, and nothing is examined.
///
/// # Errors
/// [`Error::Shape`] unless there is a label for every point; as [`segment`] where the wall does not determine its surface.
pub fn labelled(points: &[[f64; 3]], labels: &[u8], near: &Seam, thickness_mm: f64) -> Result<Segmentation> {
    require_positive("wall thickness", thickness_mm)?;
    if labels.len() != points.len() {
        let (expected, got) = (format!("{} labels, one per point", points.len()), format!("{} labels", labels.len()));
        return Err(Error::Shape { what: "labels", expected, got });
    }
    let of_reference = points.iter().zip(labels).filter(|(_, l)| **l == Label::ReferenceWall as u8);
    let wall: Vec<[f64; 3]> = of_reference.map(|(p, _)| *p).collect();
    let (seam, course_fitted) = near.refined(&wall, near.course)?;
    let unrolled = Unrolled::of(points, &seam);
    let sections = Sections::unexamined(&unrolled, seam.course, GATE_THICKNESSES * thickness_mm)?;
    let fate = |label: &u8| match *label {
        l if l == Label::ReferenceWall as u8 || l == Label::OtherWall as u8 => Fate::Wall as u8,
        l if l == Label::Bead as u8 => Fate::Cap as u8,
        l if l == Label::Transition as u8 => Fate::Transition as u8,
        _ => Fate::None as u8,
    };
    Ok(Segmentation {
        seam,
        labels: labels.to_vec(),
        fates: labels.iter().map(fate).collect(),
        unrolled,
        noise_mm: sections.noise_mm,
        bead_width_mm: sections.cap_width_mm,
        course_fitted,
        thickness_mm,
        sections,
    })
}

/// What became of every point, from the sections: its [`Fate`] and its [`Label`].
fn sort_points(sections: &Sections, unrolled: &Unrolled, thickness_mm: f64) -> (Vec<u8>, Vec<u8>) {
    let grid = &sections.grid;
    let shell = ShellTable::new(grid.course.shell_mm(thickness_mm));
    let own: Vec<Option<Bed>> = (0..sections.stations.len()).map(|k| Bed::of(sections, k)).collect();
    // What little a station without a weld of its own holds is held against its neighbour's.
    let near = |k: usize| (0..=4).flat_map(move |d: usize| [k.wrapping_sub(d), k + d]);
    let beds: Vec<Option<Bed>> = (0..own.len()).map(|k| near(k).find_map(|j| *own.get(j)?)).collect();
    let tolerance = TOLERANCE_MM.max(5.0 * sections.noise_mm) + 4.0 * sections.noise_mm;
    let gate = GATE_THICKNESSES * thickness_mm;
    let station = grid.stations_within(CORNER_STATIONS);
    let sort = |i: usize| -> (Fate, Label) {
        let p = grid.place(unrolled, i);
        if !p.height.is_finite() {
            return (Fate::None, Label::None);
        }
        // Beyond the stations there is nothing of the seam.
        let Some(k) = station(p.along) else { return (Fate::Other, Label::None) };
        let Some(bed) = &beds[k] else {
            return (if p.height.abs() > gate { Fate::Gated } else { Fate::Other }, Label::None);
        };
        let side = usize::from(p.across > bed.middle);
        let (mine, x) = (&bed.sides[side], if side == 0 { -p.across } else { p.across });
        let out = x - mine.toe;
        let off = p.height - mine.height - mine.slope * x - mine.shrinkage * shell.at(x - mine.centre);
        if out <= 0.0 {
            let fate = if off.abs() > gate + bed.height { Fate::Gated } else { Fate::Cap };
            return (fate, Label::Bead);
        }
        if off.abs() > gate {
            return (Fate::Gated, Label::None);
        }
        let Some(begin) = mine.undisturbed else { return (Fate::Other, Label::None) };
        let fits = off.abs() <= tolerance;
        let fate = match (out, fits) {
            (_, true) => Fate::Wall,
            (out, _) if out > mine.end + grid.bin_mm => Fate::Other,
            (out, false) if out < begin => Fate::Transition,
            _ => Fate::OffLine,
        };
        let label = match (fate, out < STRIP_HEIGHTS * bed.height) {
            (Fate::Wall, true) => Label::Bead,
            (Fate::Wall, false) if out >= begin - grid.bin_mm => [Label::ReferenceWall, Label::OtherWall][side],
            (Fate::Transition, _) => Label::Transition,
            _ => Label::None,
        };
        (fate, label)
    };
    let (mut fates, mut labels) = (vec![0; unrolled.at.len()], vec![0; unrolled.at.len()]);
    threads::install(|| {
        let chunks = fates.par_chunks_mut(CHUNK).zip(labels.par_chunks_mut(CHUNK)).inspect(polled);
        chunks.enumerate().for_each(|(k, (fates, labels))| {
            for (i, (fate, label)) in fates.iter_mut().zip(labels).enumerate() {
                let sorted = sort(k * CHUNK + i);
                (*fate, *label) = (sorted.0 as u8, sorted.1 as u8);
            }
        });
    });
    (fates, labels)
}

/// What the points of one station are held against.
#[derive(Debug, Clone, Copy)]
struct Bed {
    /// Between the toes.
    middle: f64,
    /// Of the cap.
    height: f64,
    /// The reference wall's and the other wall's.
    sides: [BedSide; 2],
}

/// One side of it; x is counted across the seam, outward.
#[derive(Debug, Clone, Copy)]
struct BedSide {
    toe: f64,
    /// From where the wall is undisturbed, outward of its toe: the median of five stations, so that one that a wave or a drop of
    /// spatter stopped loses no wall.
    undisturbed: Option<f64>,
    /// How far out of the toe it was looked at.
    end: f64,
    /// The wall: height at x = 0, slope, shrinkage about its centre; without a wall all are 0.
    height: f64,
    slope: f64,
    shrinkage: f64,
    centre: f64,
}

impl Bed {
    fn of(sections: &Sections, k: usize) -> Option<Self> {
        let stations = &sections.stations;
        let own = &stations[k];
        let toes = own.toes_mm?;
        let near = &stations[k.saturating_sub(2)..(k + 3).min(stations.len())];
        let outward = |s: &Station, side: usize| {
            let (toes, from) = (s.toes_mm?, s.undisturbed_mm[side]?);
            Some(if side == 0 { toes[0] - from } else { from - toes[1] })
        };
        let sides = std::array::from_fn(|side| {
            let undisturbed = own.undisturbed_mm[side].map(|_| {
                let mut all: Vec<f64> = near.iter().filter_map(|s| outward(s, side)).collect();
                median(&mut all)
            });
            let toe = if side == 0 { -toes[0] } else { toes[1] };
            let (end, height, slope, shrinkage, centre) = own.walls[side].map_or_else(Default::default, |run| {
                (run.to - toe, run.straight(0.0), run.slope, run.shrinkage, run.centre)
            });
            BedSide { toe, undisturbed, end, height, slope, shrinkage, centre }
        });
        Some(Self { middle: 0.5 * (toes[0] + toes[1]), height: own.height_mm.abs(), sides })
    }
}

/// Where the middle between the toes lies across `seam`: mean over the stations.
fn centreline(sections: &Sections, coarse: &Seam, seam: &Seam) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for station in &sections.stations {
        if let Some([low, high]) = station.toes_mm {
            sum += seam.place(&coarse.point(station.at, 0.5 * (low + high)).into())[1];
            count += 1.0;
        }
    }
    sum / f64::max(count, 1.0)
}

/// The stations in another frame.
fn reframe(sections: &mut Sections, coarse: &Seam, seam: &Seam) {
    for station in &mut sections.stations {
        let at = station.at;
        let across = |x: f64| seam.place(&coarse.point(at, x).into())[1];
        station.toes_mm = station.toes_mm.map(|toes| toes.map(across));
        station.undisturbed_mm = station.undisturbed_mm.map(|from| from.map(across));
        station.at = seam.place(&coarse.point(at, 0.0).into())[0];
    }
    for doubt in &mut sections.doubts {
        doubt.at = seam.place(&coarse.point(doubt.at, 0.0).into())[0];
    }
}

/// Points of the reference wall with the weld's shrinkage taken out, so that they lie on its surface: as many as its fit takes.
fn undrawn(
    points: &[[f64; 3]],
    labels: &[u8],
    unrolled: &Unrolled,
    sections: &Sections,
    coarse: &Seam,
    thickness_mm: f64,
) -> Vec<[f64; 3]> {
    // One amplitude: that of a single station is known too badly.
    let mut all: Vec<f64> = sections.stations.iter().filter_map(|s| s.walls[0].map(|run| run.shrinkage)).collect();
    let drawn = if all.is_empty() { 0.0 } else { median(&mut all) };
    let mut middles: Vec<f64> =
        sections.stations.iter().filter_map(|s| s.toes_mm.map(|t| 0.5 * (t[0] + t[1]))).collect();
    let middle = if middles.is_empty() { 0.0 } else { median(&mut middles) };
    let shell = ShellTable::new(coarse.course.shell_mm(thickness_mm));
    let of_wall = || (0..points.len()).filter(|&i| labels[i] == Label::ReferenceWall as u8);
    of_wall()
        .step_by(Seam::fit_stride(of_wall().count()))
        .map(|i| {
            let z = f64::from(unrolled.across_mm[i]) - middle;
            let lift = -drawn * shell.at(z);
            (Vec3::from(points[i]) + coarse.outward(f64::from(unrolled.at[i])) * lift).into()
        })
        .collect()
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::weld::seam::Course;

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
        pub(crate) fn frame(&self) -> Seam {
            let origin = Vec3::new(3.0, -2.0, 420.0 + self.radius_mm);
            let toward = Vec3::new(0.0, 0.0, -1.0);
            let axis = Vec3::x();
            // zero turned by MIDDLE_RAD about the axis is `toward`.
            let zero = toward * MIDDLE_RAD.cos() - axis.cross(&toward) * MIDDLE_RAD.sin();
            Seam::new(origin, axis, zero, Course::of_radius(self.radius_mm).unwrap()).unwrap()
        }

        pub(crate) fn nominal(&self) -> Nominal {
            let frame = self.frame();
            Nominal { course: frame.course, wall_thickness_mm: 6.0, axis: Some(frame.across), zero: Some(frame.zero) }
        }

        pub(crate) fn points(&self) -> Vec<[f64; 3]> {
            let frame = self.frame();
            let square = frame.square();
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
                        + frame.across * axial
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
            assert!(s.seam.origin_mm.x - 3.0 < 0.5 && s.seam.across.dot(&Vec3::x()) > 0.999_99, "R {radius_mm}");
        }
    }

    #[test]
    fn the_axis_need_not_be_known() {
        let e = EXAMPLE;
        let nominal = Nominal { axis: None, zero: None, ..e.nominal() };
        let s = segment(&e.points(), COLUMNS, &nominal).unwrap();
        assert!(s.seam.across.dot(&Vec3::x()) > 0.999_99);
        // Angle 0 faces the scanner.
        assert!(s.seam.zero.dot(&Vec3::new(0.0, 0.0, -1.0)) > 0.999);
    }

    #[test]
    fn bare_points_in_any_order_read_the_same() {
        for (radius_mm, half_arc_rad) in [(54.0, 0.8), (315.0, 0.25)] {
            let e = Example { radius_mm, half_arc_rad, ..EXAMPLE };
            let grid = segment(&e.points(), COLUMNS, &e.nominal()).unwrap();
            let seen: Vec<[f64; 3]> = e.points().into_iter().filter(|p| p[0].is_finite()).collect();
            // In steps that share no factor with their number, every point comes once.
            let n = seen.len();
            let step = (n / 3..).find(|s| (2..=*s).all(|f| !(s.is_multiple_of(f) && n.is_multiple_of(f)))).unwrap();
            let cloud: Vec<[f64; 3]> = (0..n).map(|i| seen[i * step % n]).collect();
            let bare = segment(&cloud, 1, &e.nominal()).unwrap();
            let count = |s: &Segmentation, l: Label| s.labels.iter().filter(|x| **x == l as u8).count() as f64;
            for label in [Label::ReferenceWall, Label::OtherWall, Label::Bead] {
                let (a, b) = (count(&grid, label), count(&bare, label));
                assert!((a - b).abs() < 0.01 * a, "R {radius_mm} {label:?}: {a} {b}");
            }
            let middle = |s: &Segmentation| s.sections.stations[s.sections.stations.len() / 2].edge.unwrap().step_mm;
            assert!((middle(&grid) - middle(&bare)).abs() < 0.02, "R {radius_mm}");
        }
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
        assert!(segment(&EXAMPLE.points(), COLUMNS, &Nominal { wall_thickness_mm: -1.0, ..nominal }).is_err());
        let mut state = 3;
        let noise: Vec<[f64; 3]> =
            (0..40_000).map(|_| std::array::from_fn(|_| 400.0 * normal_random(&mut state))).collect();
        assert!(segment(&noise, 200, &nominal).is_err());
    }
}
