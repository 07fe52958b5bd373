//! The step along the seam: how far the other wall stands out from the reference wall, with its uncertainty.
//!
//! All shots are unrolled about one axis: their places in base, then one cylinder on the reference wall of all of them
//! (`view.rs`). The points of each wall are averaged into the cells of one grid (`cells.rs`). In the seam's frame the height of a
//! cell of shot k at a place θ along it and s across it (from its centreline) is
//!
//! - on the reference wall: `ref(θ) + shot_k(θ, s) + drawn(θ, s) + f(θ, s) + e`,
//! - on the other wall: `ref(θ) + h(θ, s) + shot_k(θ, s) + drawn'(θ, s) + f'(θ, s) + e`,
//!
//! with Fourier terms `ref` and `h`, what shot k is displaced by (which moves both walls alike), what the weld drew each wall in by,
//! what the scanner's calibration leaves open (`bend.rs`), all with priors (`terms.rs`); and each wall's own unevenness f, a Gaussian
//! process whose scales the cells themselves tell. Both walls are kriged to the seam (`weld/kriging`): the step is that of the surfaces there, waves and shrinkage
//! included, with one covariance for all bins. A shot's turn about the axis is solved for in a second pass, where the walls
//! found so far say what it changes.
//!
//! What the cap hides follows from the walls only as long as they run on to it; `guard.rs` tells where they do not.
//!
//! Sources: N. Cressie, Statistics for Spatial Data (1993), 3.4; GUM (JCGM 100:2008) 5.2.2; JCGM 101:2008, 7.

mod bend;
mod cells;
mod fit;
mod guard;
mod profile;
mod terms;
#[cfg(test)]
mod tests;
mod view;

pub use profile::ProfileBin;
#[cfg(feature = "python")]
pub(crate) use view::Stretched;
pub use view::{LabelledShot, Modes, OwnSurface};

use super::kriging::{Asked, Largest, Scales, largest};
use super::seam::Course;
use crate::error::{Error, Result, require_count};
use crate::ground::memory::require;
use bend::Bend;
use cells::{Columns, gather};
use fit::{SeamEquations, Solved};
use guard::Guard;
use profile::{mean_and_median, slopes};
use terms::Terms;
use view::{SeamView, common_seam};

/// What the caller knows of further standard uncertainties (k = 1).
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Known {
    /// Of the place along the seam (hand-eye, robot, zero mark), in its parameter.
    pub at: f64,
}

/// A Fourier term of the step around the seam: cosine and sine, their standard uncertainties, and their prior's.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepWave {
    /// How often it goes around.
    pub n: usize,
    /// Cosine and sine.
    pub amplitude_mm: [f64; 2],
    /// Their standard uncertainties.
    pub standard_mm: [f64; 2],
    /// Of each, before the scan.
    pub prior_mm: f64,
}

/// What a wall's unevenness is like.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FoundUnevenness {
    /// Standard deviation.
    pub sd_mm: f64,
    /// How far it reaches along and across the seam.
    pub reach_mm: [f64; 2],
    /// Variance of a cell over what the scatter of its points makes of it.
    pub noise: f64,
}

/// How large the largest |step| of some bins is.
#[derive(Debug, Clone, PartialEq)]
pub struct LargestStep {
    /// The bin, of those asked, whose largest value is likeliest: the one with the largest estimate.
    pub at: usize,
    /// Quantiles of the largest magnitude: 0, 1, ... 100 %.
    pub quantiles: Vec<f64>,
    /// The interval that holds it in 95 % of all cases.
    pub interval_mm: [f64; 2],
    /// So many standard uncertainties hold all bins at once in 95 % of all cases.
    pub band_factor: f64,
}

impl LargestStep {
    /// Its median, and the larger half of its interval.
    pub fn about_median(&self) -> (f64, f64) {
        let median = self.quantiles[50];
        let [low, high] = self.interval_mm;
        (median, (median - low).max(high - median))
    }
}

/// The step of a weld.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// Mean of the other wall's height over the reference wall, over its points.
    pub mean_mm: f64,
    /// Median of the same.
    pub median_mm: f64,
    /// Mean step at the seam over the profile's bins, and its standard uncertainty.
    pub seam_mean_mm: (f64, f64),
    /// Of all bins of the profile.
    pub largest: LargestStep,
    /// The profile in order along the seam.
    pub profile: Vec<ProfileBin>,
    /// Covariance of the profile's steps, row by row.
    pub covariance_mm2: Vec<f64>,
    /// From which departure on a bin's walls do not run on to the cap as they run further away.
    pub departure_limit: f64,
    /// How much of the seam was seen on both walls, as a difference of readings.
    pub coverage: f64,
    /// Difference of the walls' curvature (of pipes: of their radii), other minus reference, and its standard uncertainty.
    pub curvature_mm: (f64, f64),
    /// Offset of the other wall at the seam, in the two directions of its course.
    pub offset_mm: [f64; 2],
    /// Standard uncertainty of that offset along its own direction.
    pub offset_standard_mm: f64,
    /// Angle between the walls.
    pub tilt_rad: f64,
    /// Its standard uncertainty.
    pub tilt_standard_rad: f64,
    /// Further Fourier terms, n = 2 and up.
    pub waves: Vec<StepWave>,
    /// What the weld drew the reference wall and the other wall in by, each with its standard uncertainty.
    pub shrinkage_mm: [(f64, f64); 2],
    /// Of the reference wall and of the other wall.
    pub unevenness: [FoundUnevenness; 2],
    /// Rms of the walls' cells about the terms that have a name: what unevenness and noise leave.
    pub residual_rms_mm: f64,
    /// Cells of both walls.
    pub cells: usize,
    /// Per shot: the reference wall's surface.
    pub surfaces: Vec<OwnSurface>,
}

impl Step {
    /// The interval of the largest |step| about its median: the median, and the larger half.
    pub fn max_abs_mm(&self) -> (f64, f64) {
        self.largest.about_median()
    }

    /// How large the largest |step| of some of the profile's bins is; `None` of none.
    pub fn largest_of(&self, bins: &[usize]) -> Option<LargestStep> {
        let n = self.profile.len();
        let value: Vec<f64> = bins.iter().map(|&k| self.profile.get(k).map(|b| b.step_mm)).collect::<Option<_>>()?;
        let covariance: Vec<f64> =
            bins.iter().flat_map(|&i| bins.iter().map(move |&j| self.covariance_mm2[i * n + j])).collect();
        largest_step(&value, &covariance)
    }
}

fn largest_step(value: &[f64], covariance: &[f64]) -> Option<LargestStep> {
    let Largest { quantiles, upper, lower, band_factor } = largest(value, covariance)?;
    let at = (0..value.len()).max_by(|a, b| value[*a].abs().total_cmp(&value[*b].abs()))?;
    Some(LargestStep { at, quantiles, interval_mm: [lower, upper], band_factor })
}

/// The shots of a seam, and all that their walls say together.
struct Together {
    course: Course,
    views: Vec<SeamView>,
    equations: SeamEquations,
    /// Length of each wall's rows of cells, and how far it reaches.
    rows_mm: [f64; 2],
    reach_mm: [[f64; 2]; 2],
    /// Bins that were seen on both walls.
    bins: Vec<usize>,
    posed: bool,
}

impl Together {
    fn of(shots: &[LabelledShot]) -> Result<Self> {
        require_count("part shots with both walls", 1, shots.len())?;
        shots.iter().try_for_each(LabelledShot::check)?;
        require(shots.iter().map(|s| s.labels.len()).sum(), 4);
        let seam = common_seam(shots)?;
        let views = shots.iter().map(|s| SeamView::of(s, &seam)).collect::<Result<Vec<SeamView>>>()?;
        let columns = Columns::of(seam.course);
        let gathered = gather(shots, &views, &columns)?;
        let thickness_mm = shots.iter().map(|s| s.thickness_mm).sum::<f64>() / shots.len() as f64;
        let posed = shots.iter().all(|s| s.base_from_scanner.is_some());
        let bends =
            shots.iter().zip(&views).map(|(shot, view)| Bend::of(shot, view)).collect::<Result<Option<Vec<Bend>>>>()?;
        let bends = bends.unwrap_or_default();
        if bends.iter().any(|b| b.count() != bends[0].count()) {
            let (expected, got) = ("the same modes in every shot".into(), "different numbers".into());
            return Err(Error::Shape { what: "calibration modes", expected, got });
        }
        let terms = Terms::new(seam.course, thickness_mm, views.iter().map(|v| v.middle).collect(), posed, bends);
        let equations = SeamEquations::of(columns, &gathered, terms);
        let seen = (0..gathered.seen.len()).filter(|bin| gathered.seen[*bin]);
        let bins: Vec<usize> = seen.filter(|bin| equations.column_of_bin(*bin).is_some()).collect();
        if bins.is_empty() {
            return Err(Error::NotFound { what: "step", reason: "no angle at which both walls were seen".into() });
        }
        Ok(Self {
            course: seam.course,
            views,
            equations,
            rows_mm: gathered.walls.each_ref().map(|w| w.row_mm),
            reach_mm: gathered.walls.each_ref().map(|w| w.reach_mm),
            bins,
            posed,
        })
    }

    /// The step at the middles of bins. Several shots turn about the axis: by what the walls found in a first pass are like.
    fn at_seam(&self, scales: &[Scales; 2]) -> Result<Solved> {
        let solve = |equations: &SeamEquations, bins: &[usize]| {
            let column = |bin: &usize| equations.column_of_bin(*bin).unwrap_or(0);
            let ask = |factor: f64| -> Vec<Asked> {
                bins.iter().map(|bin| Asked { column: column(bin), across_mm: 0.0, factor }).collect()
            };
            let mut rows = vec![0.0; bins.len() * equations.terms.count()];
            for (row, bin) in rows.chunks_exact_mut(equations.terms.count()).zip(bins) {
                equations.terms.step_row(equations.columns.course.bin_middle(*bin), row);
            }
            equations.solve(scales, [&ask(-1.0), &ask(1.0)], &rows)
        };
        if !self.posed || self.equations.terms.shots() < 2 {
            return solve(&self.equations, &self.bins);
        }
        let first = solve(&self.equations, &[])?;
        let turning = self.equations.terms.turning(&first.border.estimate);
        solve(&self.equations.with(turning), &self.bins)
    }

    /// The step, and what is uncertain of it.
    fn solved(&self, scales: &[Scales; 2], known: &Known) -> Result<(Solved, Uncertain)> {
        let solved = self.at_seam(scales)?;
        let found = Uncertain::of(&solved, &self.bins, &self.views, &self.course, known)?;
        Ok((solved, found))
    }
}

/// The step of one shot by itself, in its own frame: the reading of each bin, step and standard uncertainty. What its walls are like
/// comes from all shots.
///
/// # Errors
/// As [`measure`].
pub fn alone(shot: &LabelledShot, known: &Known, like: &[FoundUnevenness; 2]) -> Result<Vec<[f64; 3]>> {
    let together = Together::of(&[LabelledShot { base_from_scanner: None, modes: None, ..*shot }])?;
    let scales = like.map(|u| {
        let [along_mm, across_mm] = u.reach_mm;
        Scales { sd_mm: u.sd_mm, along_mm, across_mm, noise: u.noise }
    });
    let (solved, found) = together.solved(&scales, known)?;
    let n = together.bins.len();
    let bin = |(k, bin): (usize, &usize)| {
        let standard = found.covariance_mm2[k * n + k].sqrt();
        [together.course.bin_reading(*bin), solved.answer.value[k], standard]
    };
    Ok(together.bins.iter().enumerate().map(bin).collect())
}

/// Measures the step on all shots together.
///
/// # Errors
/// [`Error::Shape`] where a shot's arrays differ in length, [`Error::TooFew`] without both walls in each shot,
/// [`Error::Degenerate`] where the walls do not determine it, [`Error::NotFound`] where no bin was seen on both walls.
pub fn measure(shots: &[LabelledShot], known: &Known) -> Result<Step> {
    let together = Together::of(shots)?;
    let Together { course, views, equations, bins, .. } = &together;
    let near = equations.scales(None)?;
    // Walls too short to leave anything out are not told apart.
    let guard = Guard::of(equations, near, together.rows_mm, together.reach_mm)
        .unwrap_or_else(|_| Guard::none(course.bins(), near));
    let (mut scales, (mut solved, mut found)) = (near, together.solved(&near, known)?);
    let departure_limit = Guard::limit(found.largest.band_factor);
    if guard.departures.iter().flatten().any(|z| z.abs() > departure_limit) {
        // What lies beside the cap must not say what is usual.
        scales = guard.scales;
        (solved, found) = together.solved(&scales, known)?;
    }
    let Solved { border, answer, terms, residuals } = &solved;
    let Uncertain { covariance_mm2, place_mm, largest } = found;

    let n = bins.len();
    let mut profile = Vec::with_capacity(n);
    for (k, &bin) in bins.iter().enumerate() {
        let (variance, of_place) = (covariance_mm2[k * n + k], place_mm[k].powi(2));
        let standard_mm = variance.sqrt();
        profile.push(ProfileBin {
            along: course.bin_reading(bin),
            step_mm: answer.value[k],
            standard_mm,
            fit_mm: (variance - of_place - answer.of_unevenness[k]).max(0.0).sqrt(),
            unevenness_mm: answer.of_unevenness[k].max(0.0).sqrt(),
            place_mm: place_mm[k],
            band_mm: largest.band_factor * standard_mm,
            departure: guard.departures[bin].unwrap_or(f64::NAN),
        });
    }
    let estimate = &border.estimate;
    let of_shot =
        |(k, view): (usize, &SeamView)| view.surface(|at, across| terms.reference_height(estimate, k, at, across));
    let surfaces: Vec<OwnSurface> = views.iter().enumerate().map(of_shot).collect();
    let (mean_mm, median_mm) = mean_and_median(shots, &surfaces);
    let told = |row: &[f64]| {
        let value: f64 = row.iter().zip(estimate).map(|(a, b)| a * b).sum();
        (value, border.spread(row)[0].sqrt())
    };
    let pair = |rows: [Vec<f64>; 2]| {
        let value = rows.each_ref().map(|r| told(r).0);
        // Of a vector's length: its covariance along its own direction.
        let length = value[0].hypot(value[1]);
        let towards = if length > 0.0 { value.map(|v| v / length) } else { [1.0, 0.0] };
        let along: Vec<f64> = rows[0].iter().zip(&rows[1]).map(|(a, b)| towards[0] * a + towards[1] * b).collect();
        (value, told(&along).1)
    };
    let ((offset_mm, offset_standard_mm), (lean, tilt_standard_rad)) =
        (pair(terms.offset_rows()), pair(terms.lean_rows()));
    let waves = terms.round_rows().map(|(n, rows, prior_mm)| {
        let [c, s] = rows.map(|r| told(&r));
        StepWave { n, amplitude_mm: [c.0, s.0], standard_mm: [c.1, s.1], prior_mm }
    });
    let mean_variance = covariance_mm2.iter().sum::<f64>() / (n * n) as f64;
    Ok(Step {
        mean_mm,
        median_mm,
        seam_mean_mm: (answer.value.iter().sum::<f64>() / n as f64, mean_variance.max(0.0).sqrt()),
        largest,
        coverage: course.bin_width() * n as f64,
        curvature_mm: told(&terms.radius_row()),
        offset_mm,
        offset_standard_mm,
        tilt_rad: lean[0].hypot(lean[1]).atan(),
        tilt_standard_rad,
        waves: waves.collect(),
        shrinkage_mm: terms.drawn_rows().map(|row| told(&row)),
        unevenness: scales.map(|s| FoundUnevenness {
            sd_mm: s.sd_mm,
            reach_mm: [s.along_mm, s.across_mm],
            noise: s.noise,
        }),
        residual_rms_mm: (residuals.iter().map(|r| r * r).sum::<f64>() / residuals.len() as f64).sqrt(),
        cells: residuals.len(),
        covariance_mm2,
        departure_limit,
        profile,
        surfaces,
    })
}

/// What is uncertain of the profile.
struct Uncertain {
    covariance_mm2: Vec<f64>,
    /// Of each bin, what is not known of its place along the seam makes of it.
    place_mm: Vec<f64>,
    largest: LargestStep,
}

impl Uncertain {
    /// Adds to the walls' covariance what a shift along the seam does: of all bins together by what the caller knows, of a shot's
    /// bins by what that shot's place leaves open.
    fn of(solved: &Solved, bins: &[usize], views: &[SeamView], course: &Course, known: &Known) -> Result<Self> {
        let (n, value) = (bins.len(), &solved.answer.value);
        let slopes = slopes(bins, course.bins(), course.at_reading(course.bin_width()), value);
        let apart = |bin: usize, view: &SeamView| course.apart(course.bin_middle(bin), view.middle).abs();
        let nearest = |bin: &usize| {
            let by_place = |a: &usize, b: &usize| apart(*bin, &views[*a]).total_cmp(&apart(*bin, &views[*b]));
            (0..views.len()).min_by(by_place).unwrap_or(0)
        };
        let shots: Vec<usize> = bins.iter().map(nearest).collect();
        let aside: Vec<f64> = (bins.iter().zip(&shots))
            .map(|(bin, shot)| {
                let row = solved.terms.aside_row(*shot, course.bin_middle(*bin));
                course.difference(solved.border.spread(&row)[0].sqrt())
            })
            .collect();
        let mut covariance_mm2 = solved.answer.covariance.clone();
        for i in 0..n {
            for j in 0..n {
                let shared = if shots[i] == shots[j] { aside[i] * aside[j] } else { 0.0 };
                covariance_mm2[i * n + j] += slopes[i] * slopes[j] * (known.at * known.at + shared);
            }
        }
        let place_mm = (0..n).map(|k| slopes[k].abs() * known.at.hypot(aside[k])).collect();
        let largest = largest_step(value, &covariance_mm2)
            .ok_or_else(|| Error::Degenerate { what: "step", reason: "its uncertainty is none".into() })?;
        Ok(Self { covariance_mm2, place_mm, largest })
    }
}
