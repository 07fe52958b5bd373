//! The seam's frame: along the seam, across it, and height over the reference wall. What stands behind it (sections, step,
//! fates, the cloud) knows neither pipes nor degrees.
//!
//! A place along a seam is kept as `at`, in the seam's own parameter: the angle of a circle, rad. [`Course`] turns it into mm,
//! into bins, and into the number that people read. Where [`Course`] is asked, another kind of seam answers for itself; a straight
//! one, whose parameter is mm and whose radius is infinite, is one more variant here.

use std::f64::consts::{PI, TAU};

use multiversion::multiversion;
use nalgebra::Matrix3;
use rayon::prelude::*;

use crate::error::{Error, Result, require_count, require_positive};
use crate::ground::branchless::atan2;
use crate::ground::stop::polled;
use crate::ground::threads::{self, CHUNK};
use crate::ground::transform::Vec3;
use crate::surfaces::{PointNoise, cylinder};

/// Width of a bin along a closed seam, by contract.
const BIN_DEG: f64 = 2.0;
const TURN_DEG: f64 = 360.0;
const TURN_BINS: usize = 180;
/// Length of a station along the seam: short enough that a dent of two degrees on a large pipe fills one, long enough
/// for several points a bin.
const STATION_MM: f64 = 4.0;
/// The same on a pipe of less than 50 mm radius, whose arcs are short.
const SMALL_STATION_MM: f64 = 2.5;
const SMALL_RADIUS_MM: f64 = 50.0;
/// How far the real diameter of a pipe may be from its nominal one, relative (the usual delivery tolerance is 1 %). A
/// radius that the arc does not determine better than this is taken as nominal.
const DIAMETER_TOLERANCE: f64 = 0.01;
/// A radius this far from the nominal one, relative, is another pipe's: ovality bends a pipe locally by a few per cent.
const OTHER_PIPE: f64 = 0.2;
/// Points that the surface of the reference wall is fitted to.
const FIT_POINTS: usize = 10_000;

/// How a seam runs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Course {
    /// Around a pipe: closed. Its parameter is the angle, rad.
    Circle {
        /// Of the reference wall's surface.
        radius_mm: f64,
    },
}

impl Course {
    /// The course of a seam around a pipe of this radius.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for a radius that is none.
    pub fn of_radius(radius_mm: f64) -> Result<Self> {
        require_positive("pipe radius", radius_mm)?;
        Ok(Self::Circle { radius_mm })
    }

    /// Radius of the reference wall's surface.
    #[inline]
    pub fn radius_mm(self) -> f64 {
        let Self::Circle { radius_mm } = self;
        radius_mm
    }

    /// The mean of the courses that several shots have of one seam.
    pub fn mean(courses: impl ExactSizeIterator<Item = Self>) -> Self {
        let count = courses.len() as f64;
        Self::Circle { radius_mm: courses.map(Self::radius_mm).sum::<f64>() / count }
    }

    /// Length along the seam of a difference of two places.
    #[inline]
    pub fn along_mm(self, difference: f64) -> f64 {
        difference * self.radius_mm()
    }

    /// The difference of two places that is so long.
    #[inline]
    pub fn difference(self, along_mm: f64) -> f64 {
        along_mm / self.radius_mm()
    }

    /// From one place to another the short way: `to - from` without whole turns.
    #[inline]
    pub fn apart(self, to: f64, from: f64) -> f64 {
        let turn = to - from;
        // Mostly it is the short way already, and rounding is a call.
        if turn.abs() < PI { turn } else { turn - (turn / TAU).round() * TAU }
    }

    /// The middle of places, of whatever precision.
    pub fn middle<T: nalgebra::RealField + Copy + Into<f64>>(self, places: impl Iterator<Item = T>) -> f64 {
        let (mut c, mut s) = (0.0, 0.0);
        for at in places {
            let (sin, cos) = at.sin_cos();
            (c, s) = (c + cos.into(), s + sin.into());
        }
        f64::atan2(s, c)
    }

    /// What people read at a place: degrees in [0, 360) from the zero mark of a closed seam.
    pub fn reading(self, at: f64) -> f64 {
        self.told(at.to_degrees())
    }

    /// A reading without whole turns.
    pub fn told(self, reading: f64) -> f64 {
        reading.rem_euclid(TURN_DEG)
    }

    /// The same in the precision of a cloud's points.
    #[inline]
    pub fn reading_f32(self, at: f32) -> f32 {
        let angle = at.to_degrees();
        if angle < 0.0 { (angle + TURN_DEG as f32).min((TURN_DEG as f32).next_down()) } else { angle }
    }

    /// The place of a reading.
    pub fn at_reading(self, reading: f64) -> f64 {
        reading.to_radians()
    }

    /// From one reading to another the short way.
    pub fn readings_apart(self, to: f64, from: f64) -> f64 {
        self.told(to - from + TURN_DEG / 2.0) - TURN_DEG / 2.0
    }

    /// The difference of readings that is so long.
    pub fn reading_of_mm(self, along_mm: f64) -> f64 {
        self.difference(along_mm).to_degrees()
    }

    /// The difference of readings after which a closed seam comes back to where it began.
    pub fn turn(self) -> Option<f64> {
        Some(TURN_DEG)
    }

    /// The sign of the unit of readings, as it follows a number.
    pub fn unit(self) -> &'static str {
        "°"
    }

    /// What readings are, as the title of an axis.
    pub fn label(self) -> &'static str {
        "angle about the pipe's axis, from the zero mark"
    }

    /// How many bins the seam has. They are centred on multiples of their width.
    #[inline]
    pub fn bins(self) -> usize {
        TURN_BINS
    }

    /// Width of a bin, as a reading.
    pub fn bin_width(self) -> f64 {
        BIN_DEG
    }

    /// The bin of a place.
    #[inline]
    pub fn bin(self, at: f64) -> usize {
        ((at.to_degrees() / BIN_DEG + 0.5).floor() as i64).rem_euclid(TURN_BINS as i64) as usize
    }

    /// Where in its bin a place lies, from 0 to 1.
    #[inline]
    pub(super) fn in_bin(self, at: f64) -> f64 {
        (at.to_degrees() / BIN_DEG + 0.5).rem_euclid(1.0).min(1.0_f64.next_down())
    }

    /// Length of a bin along the seam.
    pub(super) fn bin_mm(self) -> f64 {
        self.along_mm(self.at_reading(BIN_DEG))
    }

    /// The bin so many beyond another; `None` beyond the end of a seam that has ends.
    pub fn beyond(self, bin: i64, count: i64) -> Option<usize> {
        Some((bin + count).rem_euclid(TURN_BINS as i64) as usize)
    }

    /// Which of equal cells along the seam, of about this length, a place lies in: a whole number of them around a closed one.
    pub fn cell(self, at: f64, cell_mm: f64) -> i64 {
        let around = (self.along_mm(TAU) / cell_mm).round_ties_even().max(8.0);
        ((at / TAU).rem_euclid(1.0) * around).floor() as i64
    }

    /// The middle of a bin, as a reading.
    pub fn bin_reading(self, bin: usize) -> f64 {
        BIN_DEG * bin as f64
    }

    /// The middle of a bin.
    #[inline]
    pub fn bin_middle(self, bin: usize) -> f64 {
        self.at_reading(self.bin_reading(bin))
    }

    /// Length of a station along the seam.
    pub fn station_mm(self) -> f64 {
        if self.radius_mm() < SMALL_RADIUS_MM { SMALL_STATION_MM } else { STATION_MM }
    }

    /// The length over which a wall of this thickness bends where a ring load draws it in; `None`: this seam is no ring.
    pub fn shell_mm(self, thickness_mm: f64) -> Option<f64> {
        Some((self.radius_mm() * thickness_mm).sqrt())
    }

    /// How the height of a wall at a place grows with its offset, per mm in each of two directions.
    #[inline]
    pub(in crate::weld) fn offset(self, at: f64) -> [f64; 2] {
        let (sin, cos) = at.sin_cos();
        [cos, sin]
    }

    /// How it grows with a difference of the walls' own curvature: of pipes, of their radii.
    pub(super) fn curvature(self, _at: f64) -> f64 {
        1.0
    }
}

/// A seam in space, with the origins of its coordinates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Seam {
    /// Where all of them are counted from: of a circle its centre.
    pub origin_mm: Vec3,
    /// Unit, from the reference wall to the other wall.
    pub across: Vec3,
    /// Unit, at right angles to `across`: from the origin to where `at` is 0. Along runs right-handed about `across`.
    pub zero: Vec3,
    /// How it runs.
    pub course: Course,
}

impl Seam {
    /// A seam whose zero direction is the given one made square to `across`.
    ///
    /// # Errors
    /// [`Error::Degenerate`] where the zero mark lies along the axis.
    pub fn new(origin_mm: Vec3, across: Vec3, zero: Vec3, course: Course) -> Result<Self> {
        let what = "pipe frame";
        let across = across
            .try_normalize(0.0)
            .ok_or_else(|| Error::Degenerate { what, reason: "the axis has no direction".into() })?;
        let zero = (zero - across * across.dot(&zero))
            .try_normalize(1e-6 * zero.norm())
            .ok_or_else(|| Error::Degenerate { what, reason: "the zero mark lies along the axis".into() })?;
        Ok(Self { origin_mm, across, zero, course })
    }

    /// Completes `across` and `zero` to a right-handed frame.
    pub(super) fn square(&self) -> Vec3 {
        self.across.cross(&self.zero)
    }

    /// Away from the metal at a place: the direction of height.
    pub fn outward(&self, at: f64) -> Vec3 {
        let (sin, cos) = at.sin_cos();
        self.zero * cos + self.square() * sin
    }

    /// The point of the reference wall's surface at a place along and a distance across.
    pub fn point(&self, at: f64, across_mm: f64) -> Vec3 {
        self.above(at, across_mm, 0.0)
    }

    /// The point so high over it: what [`Seam::place`] undoes.
    pub fn above(&self, at: f64, across_mm: f64, height_mm: f64) -> Vec3 {
        self.origin_mm + self.across * across_mm + self.outward(at) * (self.course.radius_mm() + height_mm)
    }

    /// Place along (an angle in [-π, π]), distance across and height (mm) of a point.
    #[inline]
    pub fn place(&self, p: &[f64; 3]) -> [f64; 3] {
        let v = Vec3::from(*p) - self.origin_mm;
        let (x, y) = (v.dot(&self.zero), v.dot(&self.square()));
        [y.atan2(x), v.dot(&self.across), x.hypot(y) - self.course.radius_mm()]
    }

    /// Where a ray from the frame's origin of coordinates first meets the reference wall's surface.
    pub(super) fn meet(&self, ray: &Vec3) -> Option<Vec3> {
        let flat = |v: &Vec3| v - self.across * self.across.dot(v);
        let (d, o) = (flat(ray), flat(&self.origin_mm));
        let radius = self.course.radius_mm();
        let (a, b, c) = (d.norm_squared(), d.dot(&o), o.norm_squared() - radius * radius);
        let root = b * b - a * c;
        (a > 0.0 && root >= 0.0).then(|| (b - root.sqrt()) / a).filter(|t| *t > 0.0).map(|t| ray * t)
    }

    /// Of so many points of the reference wall every how-manieth its surface is fitted to.
    pub(super) fn fit_stride(count: usize) -> usize {
        count.div_ceil(FIT_POINTS).max(1)
    }

    /// The seam whose surface fits the reference wall's points best by orthogonal distance, begun at this one, with what they
    /// allow: a free radius where it is determined to better than a pipe's delivery tolerance, else the nominal one; where
    /// they are too flat even for that, as a plane is laid on them. And whether the radius was free.
    ///
    /// # Errors
    /// [`Error::TooFew`] without points; [`Error::Degenerate`] where they are another part's.
    pub(super) fn refined(&self, wall: &[[f64; 3]], nominal: Course) -> Result<(Self, bool)> {
        require_count("points of the reference wall", 100, wall.len())?;
        let sample: Vec<[f64; 3]> = wall.iter().step_by(Self::fit_stride(wall.len())).copied().collect();
        let told = nominal.radius_mm();
        let start =
            cylinder::Cylinder { point_mm: self.origin_mm, axis: self.across, radius_mm: self.course.radius_mm() };
        let fixed = match cylinder::refine(&sample, start, false, PointNoise::default()) {
            Ok(fit) => fit.surface,
            Err(Error::Degenerate { .. }) => return Ok((self.laid_on(&sample)?, false)),
            Err(error) => return Err(error),
        };
        let free = cylinder::refine(&sample, fixed, true, PointNoise::default()).ok().filter(|fit| {
            let last = fit.covariance.nrows() - 1;
            let sigma = fit.covariance[(last, last)].sqrt();
            // The residuals of a wall are correlated: their number counts for far less than it says, see `step`.
            let doubt = sigma * (sample.len() as f64 / 100.0).sqrt();
            doubt < DIAMETER_TOLERANCE * told
        });
        if let Some(fit) = &free
            && (fit.surface.radius_mm / told - 1.0).abs() > OTHER_PIPE
        {
            let seen = fit.surface.radius_mm;
            let reason =
                format!("the reference wall's radius is {seen:.1} mm, not {told:.1} mm as the part's description says");
            return Err(Error::Degenerate { what: "pipe", reason });
        }
        let (surface, fitted) = free.map_or((fixed, false), |fit| (fit.surface, true));
        let across = if surface.axis.dot(&self.across) < 0.0 { -surface.axis } else { surface.axis };
        // The point of the axis next to the origin so far.
        let origin = surface.point_mm + across * across.dot(&(self.origin_mm - surface.point_mm));
        Ok((Self::new(origin, across, self.zero, Course::of_radius(surface.radius_mm)?)?, fitted))
    }
}

impl Seam {
    /// This seam with its surface laid on points as a plane is: raised, leaned across, and rolled along.
    fn laid_on(&self, wall: &[[f64; 3]]) -> Result<Self> {
        let placed: Vec<[f64; 3]> = wall.iter().map(|p| self.place(p)).collect();
        let middle = self.course.middle(placed.iter().map(|p| p[0]));
        let (mut normal, mut right) = (Matrix3::zeros(), Vec3::zeros());
        for [at, across, height] in placed {
            let row = Vec3::new(1.0, across, self.course.apart(at, middle));
            normal += row * row.transpose();
            right += row * height;
        }
        let Some(factor) = normal.cholesky() else {
            let reason = "its points lie on a line".into();
            return Err(Error::Degenerate { what: "reference wall", reason });
        };
        let [raised, leaned, rolled]: [f64; 3] = factor.solve(&right).into();
        let outward = self.outward(middle);
        // What rises along the seam is a surface whose middle lies that much further along.
        let origin = self.origin_mm + outward * raised + self.across.cross(&outward) * rolled;
        Self::new(origin, self.across + outward * leaned, self.zero, self.course)
    }
}

/// A shot's points in a [`Seam`]'s frame, pixel by pixel; NaN where there is no point.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Unrolled {
    /// Along the seam, in its parameter: an angle in [-π, π].
    pub at: Vec<f32>,
    /// Across the seam, mm; the reference wall is negative.
    pub across_mm: Vec<f32>,
    /// Over the reference wall's surface, mm.
    pub height_mm: Vec<f32>,
}

impl Unrolled {
    /// Places every point.
    pub fn of(points: &[[f64; 3]], seam: &Seam) -> Self {
        let n = points.len();
        let mut all = Self { at: vec![0.0; n], across_mm: vec![0.0; n], height_mm: vec![0.0; n] };
        threads::install(|| {
            let (at, across) = (all.at.par_chunks_mut(CHUNK), all.across_mm.par_chunks_mut(CHUNK));
            let slots = at.zip(across).zip(all.height_mm.par_chunks_mut(CHUNK));
            points.par_chunks(CHUNK).inspect(polled).zip(slots).for_each(|(points, ((at, across), height))| {
                unroll(points, seam, at, across, height);
            });
        });
        all
    }
}

/// [`Seam::place`] of many points.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2"))]
fn unroll(points: &[[f64; 3]], seam: &Seam, at: &mut [f32], across_mm: &mut [f32], height_mm: &mut [f32]) {
    let [ox, oy, oz]: [f64; 3] = seam.origin_mm.into();
    let [[zx, zy, zz], [sx, sy, sz], [ax, ay, az]]: [[f64; 3]; 3] =
        [seam.zero.into(), seam.square().into(), seam.across.into()];
    let radius = seam.course.radius_mm();
    for (((p, at), across), height) in points.iter().zip(at).zip(across_mm).zip(height_mm) {
        let (vx, vy, vz) = (p[0] - ox, p[1] - oy, p[2] - oz);
        let (x, y) = (vx * zx + vy * zy + vz * zz, vx * sx + vy * sy + vz * sz);
        *at = atan2(y, x) as f32;
        *across = (vx * ax + vy * ay + vz * az) as f32;
        *height = ((x * x + y * y).sqrt() - radius) as f32;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn around(radius_mm: f64) -> Course {
        Course::of_radius(radius_mm).unwrap()
    }

    #[test]
    fn a_place_is_where_its_point_is() {
        let seam =
            Seam::new(Vec3::new(3.0, -2.0, 400.0), Vec3::new(0.9, 0.1, 0.0), Vec3::new(0.3, 0.0, -1.0), around(54.0))
                .unwrap();
        for at in [-3.0, -0.4, 0.0, 1.2, 3.1] {
            let p = seam.point(at, 7.5) + seam.outward(at) * 0.25;
            let found = seam.place(&p.into());
            assert!([at, 7.5, 0.25].iter().zip(found).all(|(a, b)| (a - b).abs() < 1e-12), "{at}: {found:?}");
            let kept = Unrolled::of(&[p.into()], &seam);
            assert!((f64::from(kept.at[0]) - at).abs() < 1e-6 && (kept.height_mm[0] - 0.25).abs() < 1e-6);
        }
    }

    #[test]
    fn a_turn_of_a_closed_seam_is_nothing() {
        let course = around(200.0);
        assert!((course.apart(3.1, -3.1) - (6.2 - TAU)).abs() < 1e-12);
        assert!((course.middle([3.0_f32, -3.0].into_iter()).abs() - std::f64::consts::PI).abs() < 1e-6);
        assert_eq!(course.bin(-0.001), 0);
        assert_eq!(course.bin(-0.04), course.bins() - 1);
        assert_eq!(course.beyond(course.bins() as i64 - 1, 2), Some(1));
        assert!((course.readings_apart(1.0, 359.0) - 2.0).abs() < 1e-12);
        assert!((0..course.bins()).all(|k| course.bin(course.bin_middle(k)) == k));
        assert!((course.reading(-0.5) - (360.0 - 0.5_f64.to_degrees())).abs() < 1e-12);
        assert!(course.reading_f32(-1e-9) < 360.0);
        assert!((course.along_mm(course.difference(12.5)) - 12.5).abs() < 1e-12);
    }

    #[test]
    fn a_ray_meets_the_near_side_of_a_cylinder() {
        let meet = |x: f64| {
            let seam = Seam::new(Vec3::new(x, 0.0, 100.0), Vec3::y(), Vec3::z(), around(5.0)).unwrap();
            seam.meet(&Vec3::z())
        };
        assert!((meet(3.0).unwrap() - Vec3::new(0.0, 0.0, 96.0)).norm() < 1e-12);
        assert!(meet(6.0).is_none());
    }

    #[test]
    fn a_wall_too_flat_for_a_cylinder_is_laid_on_as_a_plane() {
        let seam = Seam::new(Vec3::new(0.0, 0.0, 1e5 + 400.0), Vec3::x(), -Vec3::z(), around(1e5)).unwrap();
        // A plane, raised, leaned and rolled against it by known amounts.
        let height = |x: f64, y: f64| 0.7 + 0.01 * x - 0.02 * y;
        let points: Vec<[f64; 3]> = (0..900)
            .map(|i| (f64::from(i % 30) - 40.0, f64::from(i / 30) - 15.0))
            .map(|(x, y)| [x, y, 400.0 - height(x, y)])
            .collect();
        let (found, fitted) = seam.refined(&points, around(1e5)).unwrap();
        assert!(!fitted);
        for p in &points {
            let [_, _, height] = found.place(p);
            // The pipe's own curvature over 15 mm is 0.001 mm, and tangents stand for angles.
            assert!(height.abs() < 0.01, "{height} at {p:?}");
        }
    }

    #[test]
    fn a_radius_that_is_none_is_refused() {
        assert!([-1.0, 0.0, f64::NAN].iter().all(|r| Course::of_radius(*r).is_err()));
    }
}
