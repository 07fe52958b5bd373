//! The unknowns that walls and shots share, and their priors: what pipes, welds and robots are, before any scan.
//!
//! | unknown | of | prior, one sigma |
//! |---|---|---|
//! | difference of the radii, n = 0 of the step | other wall | 0.5 % of the diameter, 1 mm at least: the tolerance of diameters (EN 10216) |
//! | offset of the axes, n = 1 | other wall | a wall's thickness, 3 mm at least: fit-up |
//! | lean of the axes | other wall | 0.02 rad: wide, the walls tell it |
//! | n = 2 to 12 of the step, and of the reference wall | | (D/200 or 1 mm) (2/n)²: twice an out of roundness of 1 %, which is an amplitude of D/400 |
//! | what the weld drew a wall in by, n = 0; n = 1, 2 | each wall | 0.2 mm; 0.05 mm |
//! | radius, place and lean of a shot | both walls | one shot, or no poses: 5 mm, 20 mrad; several: 0.1 mm, 0.5 mm, 2 mrad, a robot's |
//! | turn of a shot about the axis | both walls | 0.5 mm of place |
//! | modes of the scanner's calibration | both walls | 1, as its covariance has them ([`super::bend`]) |
//!
//! All are linear: what an offset does in second order has the shape of n = 0 and 2. A wall's column is the sum of unknowns
//! that it has no way to tell apart ([`Terms::columns`]).

use super::bend::Bend;
use crate::weld::kriging::{self, Cell, Width};
use crate::weld::seam::Course;
use crate::weld::sections::shell_term;

/// The highest Fourier term.
const MOST_WAVES: usize = 12;
/// Terms n = 2, 3, ..., a cosine and a sine of each.
const ROUND: usize = 2 * (MOST_WAVES - 1);
const SHELL: usize = 5;
/// Of a shot: radius, place (2), lean (2); and its turn, where that is solved for.
const OF_A_SHOT: usize = 5;

// Where each group of unknowns begins.
const RADIUS: usize = 0;
const OFFSET: usize = 1;
const LEAN: usize = 3;
const STEP_ROUND: usize = 5;
const REFERENCE_ROUND: usize = STEP_ROUND + ROUND;
const SHELLS: usize = REFERENCE_ROUND + ROUND;
const MODES: usize = SHELLS + 2 * SHELL;

const LEAST_RADIUS_MM: f64 = 1.0;
const LEAST_OFFSET_MM: f64 = 3.0;
const LEAN_RAD: f64 = 0.02;
const LEAST_ROUND_MM: f64 = 1.0;
const DRAWN_MM: [f64; SHELL] = [0.2, 0.05, 0.05, 0.05, 0.05];
const TURN_MM: f64 = 0.5;

/// What a shot is displaced by, one sigma: radius, place, lean (rad).
const FREE: [f64; 3] = [5.0, 5.0, 0.02];
const POSED: [f64; 3] = [0.1, 0.5, 0.002];

/// The unknowns of a seam, with the scale of each.
#[derive(Debug, Clone)]
pub(super) struct Terms {
    course: Course,
    thickness_mm: f64,
    /// Middles of the shots' stretches.
    middles: Vec<f64>,
    shot_sigma: [f64; 3],
    radius_sigma_mm: f64,
    offset_sigma_mm: f64,
    round_sigma_mm: f64,
    /// Fourier terms of the reference wall and of the step so far, n = 1 to 12: what a turn of a shot changes. Without them a shot
    /// does not turn.
    turned: Option<[Vec<[f64; 2]>; 2]>,
    /// What the scanner's calibration leaves open: of every shot, or of none.
    bends: Vec<Bend>,
}

/// A Fourier series' slope.
fn slope(series: &[[f64; 2]], at: f64) -> f64 {
    let term = |(n, c): (usize, &[f64; 2])| {
        let (sin, cos) = ((n + 1) as f64 * at).sin_cos();
        (n + 1) as f64 * (c[1] * cos - c[0] * sin)
    };
    series.iter().enumerate().map(term).sum()
}

impl Terms {
    /// Of shots whose stretches have these middles; `posed` where their places are known.
    pub fn new(course: Course, thickness_mm: f64, middles: Vec<f64>, posed: bool, bends: Vec<Bend>) -> Self {
        let diameter = 2.0 * course.radius_mm();
        Self {
            course,
            thickness_mm,
            shot_sigma: if posed && middles.len() > 1 { POSED } else { FREE },
            middles,
            radius_sigma_mm: LEAST_RADIUS_MM.max(diameter / 200.0),
            offset_sigma_mm: LEAST_OFFSET_MM.max(thickness_mm),
            round_sigma_mm: LEAST_ROUND_MM.max(diameter / 200.0),
            turned: None,
            bends,
        }
    }

    /// With what a shot's turn does, from an estimate of the unknowns.
    pub fn turning(&self, estimate: &[f64]) -> Self {
        let mut series = [vec![[0.0; 2]; MOST_WAVES], vec![[0.0; 2]; MOST_WAVES]];
        series[1][0] = [0, 1].map(|k| self.offset_sigma_mm * estimate[OFFSET + k]);
        for n in 2..=MOST_WAVES {
            for (series, first) in series.iter_mut().zip([REFERENCE_ROUND, STEP_ROUND]) {
                series[n - 1] = [0, 1].map(|k| self.round_scale(n) * estimate[first + 2 * (n - 2) + k]);
            }
        }
        Self { turned: Some(series), ..self.clone() }
    }

    fn round_scale(&self, n: usize) -> f64 {
        self.round_sigma_mm * (2.0 / n as f64).powi(2)
    }

    pub fn shots(&self) -> usize {
        self.middles.len()
    }

    /// Of one of the shots alone.
    pub fn of_shot(&self, shot: usize) -> Self {
        let bends = self.bends.get(shot).cloned().into_iter().collect();
        Self { middles: vec![self.middles[shot]], bends, ..self.clone() }
    }

    fn of_a_shot(&self) -> usize {
        OF_A_SHOT + usize::from(self.turned.is_some())
    }

    /// How many modes the scanner's calibration has.
    fn modes(&self) -> usize {
        self.bends.first().map_or(0, Bend::count)
    }

    /// Where the unknowns of a shot begin.
    fn shot_at(&self, shot: usize) -> usize {
        MODES + self.modes() + self.of_a_shot() * shot
    }

    /// How many unknowns there are.
    pub fn count(&self) -> usize {
        self.shot_at(self.middles.len())
    }

    /// Of the reference wall (`other` false) and of the other one.
    pub fn width(&self, other: bool) -> Width {
        let common = self.modes() + if other { STEP_ROUND + ROUND + SHELL } else { ROUND + SHELL };
        Width { common, of_a_shot: self.of_a_shot(), shots: self.middles.len() }
    }

    /// Which unknowns each column of a wall is the sum of.
    pub fn columns(&self, other: bool) -> kriging::BorderColumns {
        let mut columns: kriging::BorderColumns = Vec::new();
        if other {
            columns.extend((0..STEP_ROUND).map(|k| vec![k]));
            columns.extend((0..ROUND).map(|k| vec![STEP_ROUND + k, REFERENCE_ROUND + k]));
        } else {
            columns.extend((0..ROUND).map(|k| vec![REFERENCE_ROUND + k]));
        }
        let shell = SHELLS + SHELL * usize::from(other);
        columns.extend((shell..shell + SHELL).map(|k| vec![k]));
        columns.extend((MODES..self.count()).map(|k| vec![k]));
        columns
    }

    fn round(&self, at: f64, out: &mut [f64]) {
        for (k, pair) in out.chunks_exact_mut(2).enumerate() {
            let (sin, cos) = ((k + 2) as f64 * at).sin_cos();
            let scale = self.round_scale(k + 2);
            (pair[0], pair[1]) = (scale * cos, scale * sin);
        }
    }

    fn shell(&self, at: f64, across_mm: f64, out: &mut [f64]) {
        let drawn = shell_term(across_mm, self.course.shell_mm(self.thickness_mm));
        let ((s1, c1), (s2, c2)) = (at.sin_cos(), (2.0 * at).sin_cos());
        for (slot, (shape, sigma)) in out.iter_mut().zip([1.0, c1, s1, c2, s2].into_iter().zip(DRAWN_MM)) {
            *slot = drawn * shape * sigma;
        }
    }

    /// The row of a cell at a place.
    pub fn row(&self, other: bool, cell: &Cell, at: f64, out: &mut [f64]) {
        let z = cell.across_mm;
        let mut next = 0;
        if other {
            self.step(at, z, out);
            next = STEP_ROUND;
        }
        self.round(at, &mut out[next..next + ROUND]);
        self.shell(at, z, &mut out[next + ROUND..next + ROUND + SHELL]);
        let (modes, shot) = out[next + ROUND + SHELL..].split_at_mut(self.modes());
        if let Some(bend) = self.bends.get(cell.shot) {
            bend.at(self.course.apart(at, bend.middle()), z, modes);
        }
        self.shot(other, cell.shot, at, z, shot);
    }

    /// n = 0 and 1 of the step, and its lean.
    fn step(&self, at: f64, across_mm: f64, out: &mut [f64]) {
        let [a, b] = self.course.offset(at);
        out[RADIUS] = self.radius_sigma_mm * self.course.curvature(at);
        (out[OFFSET], out[OFFSET + 1]) = (self.offset_sigma_mm * a, self.offset_sigma_mm * b);
        (out[LEAN], out[LEAN + 1]) = (LEAN_RAD * across_mm * a, LEAN_RAD * across_mm * b);
    }

    fn shot(&self, other: bool, shot: usize, at: f64, across_mm: f64, out: &mut [f64]) {
        let [radius, place, lean] = self.shot_sigma;
        let [a, b] = self.course.offset(self.course.apart(at, self.middles[shot]));
        out[0] = radius;
        (out[1], out[2]) = (place * a, place * b);
        (out[3], out[4]) = (lean * across_mm * a, lean * across_mm * b);
        if let Some([reference, step]) = &self.turned {
            let more = if other { slope(step, at) } else { 0.0 };
            out[OF_A_SHOT] = self.course.difference(TURN_MM) * (slope(reference, at) + more);
        }
    }

    /// The row of the step at the seam: other wall less reference wall.
    pub fn step_row(&self, at: f64, out: &mut [f64]) {
        out.fill(0.0);
        self.step(at, 0.0, out);
        self.round(at, &mut out[STEP_ROUND..REFERENCE_ROUND]);
        self.shell(at, 0.0, &mut out[SHELLS + SHELL..MODES]);
        let mut drawn = [0.0; SHELL];
        self.shell(at, 0.0, &mut drawn);
        out[SHELLS..SHELLS + SHELL].iter_mut().zip(drawn).for_each(|(o, d)| *o = -d);
    }

    /// What a cell's wall has of the unknowns, as a row of them all.
    pub fn whole_row(&self, other: bool, cell: &Cell, at: f64) -> Vec<f64> {
        let width = self.width(other);
        let mut own = vec![0.0; width.common + width.of_a_shot];
        self.row(other, cell, at, &mut own);
        let mut row = vec![0.0; self.count()];
        for (k, of) in self.columns(other).iter().enumerate() {
            let value = if k < width.common {
                own[k]
            } else if (width.of_shot(cell.shot)..width.of_shot(cell.shot + 1)).contains(&k) {
                own[width.common + k - width.of_shot(cell.shot)]
            } else {
                0.0
            };
            of.iter().for_each(|&p| row[p] += value);
        }
        row
    }

    /// The reference wall's height at a place as one shot sees it, what the weld drew it in by left out.
    pub fn reference_height(&self, estimate: &[f64], shot: usize, at: f64, across_mm: f64) -> f64 {
        let mut round = [0.0; ROUND];
        self.round(at, &mut round);
        let mut own = [0.0; OF_A_SHOT + 1];
        self.shot(false, shot, at, across_mm, &mut own);
        let common = round.iter().zip(&estimate[REFERENCE_ROUND..]).map(|(a, b)| a * b).sum::<f64>();
        let first = self.shot_at(shot);
        common + own[..self.of_a_shot()].iter().zip(&estimate[first..]).map(|(a, b)| a * b).sum::<f64>()
    }

    /// A row that picks one unknown in its own unit.
    fn pick(&self, at: usize, scale: f64) -> Vec<f64> {
        let mut row = vec![0.0; self.count()];
        row[at] = scale;
        row
    }

    pub fn radius_row(&self) -> Vec<f64> {
        self.pick(RADIUS, self.radius_sigma_mm)
    }

    pub fn offset_rows(&self) -> [Vec<f64>; 2] {
        [0, 1].map(|k| self.pick(OFFSET + k, self.offset_sigma_mm))
    }

    pub fn lean_rows(&self) -> [Vec<f64>; 2] {
        [0, 1].map(|k| self.pick(LEAN + k, LEAN_RAD))
    }

    /// Groups of unknowns that may well be none: what the weld drew each wall in by, the lean of the axes, each Fourier term of the
    /// step from n = 2 on.
    pub fn optional(&self) -> impl Iterator<Item = Vec<usize>> {
        let round = (STEP_ROUND..REFERENCE_ROUND).step_by(2).map(|k| k..k + 2);
        [SHELLS..SHELLS + SHELL, SHELLS + SHELL..MODES, LEAN..STEP_ROUND]
            .into_iter()
            .chain(round)
            .map(Iterator::collect)
    }

    /// What each wall was drawn in by, all around.
    pub fn drawn_rows(&self) -> [Vec<f64>; 2] {
        [0, 1].map(|k| self.pick(SHELLS + SHELL * k, DRAWN_MM[0]))
    }

    /// Cosine and sine of the step's term n, from 2 on, and their prior.
    pub fn round_rows(&self) -> impl Iterator<Item = (usize, [Vec<f64>; 2], f64)> {
        (2..=MOST_WAVES).map(|n| {
            let rows = [0, 1].map(|k| self.pick(STEP_ROUND + 2 * (n - 2) + k, self.round_scale(n)));
            (n, rows, self.round_scale(n))
        })
    }

    /// How far a shot is aside along the seam at a place, which turns it about the true axis.
    pub fn aside_row(&self, shot: usize, at: f64) -> Vec<f64> {
        let [_, place, _] = self.shot_sigma;
        let [a, b] = self.course.offset(self.course.apart(at, self.middles[shot]));
        let mut row = vec![0.0; self.count()];
        let first = self.shot_at(shot);
        (row[first + 1], row[first + 2]) = (-place * b, place * a);
        row
    }
}
