//! The step along the seam: how far the other wall stands out from the reference wall, with its uncertainty.
//!
//! # Model
//! The walls of every shot are averaged into cells. In the seam's frame the height of a cell in shot k at a place θ along it
//! and s across it (from its centreline) is
//!
//! - on the reference wall: `ref_k(θ, s)`, a small correction of that shot's own surface (size, place, direction);
//! - on the other wall: `ref_k(θ, s) + h(θ, s)`. What two walls can do to each other is the seam's to say
//!   ([`Course`]); around a pipe it is `h = ΔR + e(s)·n(θ) - (e(s)×n(θ))² / 2R` with `e(s) = e0 + e1 s`: the radial
//!   distance, to second order, of a cylinder whose radius differs by ΔR and whose axis is off by e(s).
//!
//! Each shot has a reference of its own, so a robot's pose error moves both walls of a shot alike and leaves h; the
//! parameters of h belong to the part and are common to all shots. What parts have beyond that (ovality, dents) enters as
//! Legendre polynomials over each shot's stretch; what the weld drew each wall in enters as the bending of a thin shell
//! ([`crate::weld::sections`]), which belongs to no step. A group of terms is admitted only where the data ask for it (Schwarz's
//! criterion). The step at the seam is `h(θ, 0)`: both walls extrapolated to the seam.
//! Where a bin of the profile departs from the model significantly, the departure is added: a local step is not
//! smoothed away.
//!
//! # Weights and uncertainty
//! What is left after a fit is mostly the walls' own unevenness: 0.01 mm, correlated over centimetres, across the seam
//! further than along it (pipes are drawn and ground that way). Its covariance
//! `v(Δ) = nugget·[Δ = 0] + sill·φ(|Δ|)` is estimated from the residuals, with Wendland's φ on a support of its own in either
//! direction, and the walls are fitted by generalised least squares with it: no number of points makes two places that
//! belong to one wave count twice. The covariance of the parameters is that of the model that includes ΔR and tilt, whether
//! or not these were admitted. Added in quadrature: the change of the answer when the walls' strips beside the bead are left
//! out, the correlated unevenness itself (at the seam each wall may stand off its smooth run as far as it does
//! elsewhere), and what the caller knows of the place.
//!
//! Sources: GUM (JCGM 100:2008) 5.1; G. Schwarz, Ann. Statist. 6 (1978) 461, eq. 3; P. Diggle and P. Ribeiro, Model-based
//! Geostatistics (2007), 5.2 for the covariance function of residuals; H. Wendland, Adv. Comput. Math. 4 (1995) 389, φ(3,1).

mod cells;
mod model;
mod profile;
mod solve;
mod unevenness;

use nalgebra::DVector;

pub use cells::LabelledShot;
pub use profile::ProfileBin;

use crate::error::{Error, Result, require_count, require_positive};
use crate::ground::memory::require;
use crate::weld::seam::Course;
use cells::{Cell, Stretch, WallGrid, grid_of, stretch_of};
use model::{Model, Terms, corrected, second_order};
use profile::{Departures, mean_and_median, seen_bins};
use solve::{choose, solve};
pub(crate) use unevenness::wendland;
use unevenness::{Covariance, Whitener};

/// What the caller knows of further standard uncertainties (k = 1).
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Known {
    /// Of the place along the seam (hand-eye, robot, zero mark), in its parameter.
    pub at: f64,
}

/// The step of a weld.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// Mean of the other wall's height over the reference wall, over its points.
    pub mean_mm: f64,
    /// Median of the same.
    pub median_mm: f64,
    /// Largest |step| of the profile.
    pub max_abs_mm: f64,
    /// Where, as a reading ([`Course::reading`]).
    pub max_abs_at: f64,
    /// Expanded uncertainty (k = 2) of `max_abs_mm`.
    pub expanded_mm: f64,
    /// The profile in order along the seam.
    pub profile: Vec<ProfileBin>,
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
    /// Legendre degree up to which the walls' shape was needed (2: their own surfaces suffice).
    pub shape_degree: usize,
    /// What the weld drew the reference wall and the other wall in, where the data show it; else 0.
    pub shrinkage_mm: [f64; 2],
    /// Rms of the cells about the model.
    pub residual_rms_mm: f64,
    /// Distance at which the residuals' correlation ends, along and across the seam.
    pub correlation_mm: [f64; 2],
    /// Effective number of independent cells.
    pub effective_cells: f64,
    /// Per shot: the deviation of every point from the corrected reference wall.
    pub deviation_mm: Vec<Vec<f32>>,
}

/// Measures the step on all shots together.
///
/// # Errors
/// [`Error::Shape`] where a shot's arrays differ in length, [`Error::TooFew`] without both walls in each shot,
/// [`Error::Degenerate`] where the walls do not determine it.
pub fn measure(shots: &[LabelledShot], known: &Known) -> Result<Step> {
    require_count("part shots with both walls", 1, shots.len())?;
    for shot in shots {
        let n = shot.labels.len();
        if [shot.unrolled.at.len(), shot.unrolled.across_mm.len(), shot.unrolled.height_mm.len()] != [n; 3] {
            let (expected, got) = ("arrays of one length".into(), "different lengths".into());
            return Err(Error::Shape { what: "shot", expected, got });
        }
        require_positive("thickness_mm", shot.thickness_mm)?;
    }
    require(shots.iter().map(|s| s.labels.len()).sum(), 24);
    let course = Course::mean(shots.iter().map(|s| s.course));
    let stretches = shots.iter().map(stretch_of).collect::<Result<Vec<Stretch>>>()?;
    let grids = (0..shots.len()).map(|k| grid_of(k, &shots[k], &stretches[k])).collect::<Result<Vec<WallGrid>>>()?;
    let cell_mm = grids.iter().map(|g| g.cell_mm).fold(0.0, f64::max);
    let cells: Vec<Cell> = grids.into_iter().flat_map(|g| g.cells).collect();
    let scale_mm = cells.iter().map(|c| c.across.abs()).fold(0.0, f64::max);
    let thickness_mm = shots.iter().map(|s| s.thickness_mm).sum::<f64>() / shots.len() as f64;
    let model = |terms: Terms| Model { course, stretches: &stretches, terms, scale_mm, thickness_mm };

    // Plain least squares first, to see what the walls' unevenness is like.
    let plain = Whitener::identity(cells.len());
    let rough = solve(&model(choose(&model, &cells, &plain)?.widened()), &cells, &plain)?;
    let covariance = Covariance::of(&stretches, &cells, &rough.residuals, cell_mm);
    let whitener = Whitener::of(&stretches, &cells, &covariance);
    let terms = choose(&model, &cells, &whitener)?;
    let chosen = solve(&model(terms), &cells, &whitener)?;
    let wide_terms = terms.widened();
    let wide = solve(&model(wide_terms), &cells, &whitener)?;

    // Without the strip beside the bead: half a bead's width.
    let bead_mm = shots.iter().map(|s| s.bead_width_mm).fold(0.0, f64::max);
    let nearest =
        |other: bool| cells.iter().filter(|c| c.other == other).map(|c| c.across.abs()).fold(f64::INFINITY, f64::min);
    let limits = [nearest(false) + bead_mm / 2.0, nearest(true) + bead_mm / 2.0];
    let far: Vec<Cell> = cells.iter().filter(|c| c.across.abs() > limits[usize::from(c.other)]).copied().collect();
    let without_strip = solve(&model(terms), &far, &Whitener::of(&stretches, &far, &covariance)).ok();

    let deviation_mm: Vec<Vec<f32>> =
        (0..shots.len()).map(|k| corrected(&model(terms), &chosen.parameters, k, &shots[k])).collect();
    let (mean_mm, median_mm) = mean_and_median(shots, &deviation_mm);

    // Each wall ends at the seam as uneven as it is elsewhere.
    let unevenness_mm = (2.0 * covariance.sill).sqrt();
    let departures = Departures {
        course,
        stretches: &stretches,
        cells: &cells,
        residuals: &chosen.residuals,
        covariance: &covariance,
    };
    let step_at = |terms: Terms, parameters: &DVector<f64>, shot: usize, at: f64| {
        let m = model(terms);
        let mut row = vec![0.0; m.columns()];
        m.step_row(Some(shot), at, 0.0, &mut row);
        DVector::from_vec(row).dot(parameters) - second_order(&m, parameters, at, 0.0)
    };
    let mut profile = Vec::new();
    for seen in seen_bins(course, shots) {
        let (at, shot) = (seen.at, seen.shot);
        let smooth = step_at(terms, &chosen.parameters, shot, at);
        let mut row = vec![0.0; model(wide_terms).columns()];
        model(wide_terms).step_row(Some(shot), at, 0.0, &mut row);
        let row = DVector::from_vec(row);
        let fit_mm = row.dot(&(&wide.covariance * &row)).max(0.0).sqrt();
        let toe_mm = without_strip
            .as_ref()
            .map_or(smooth.abs(), |s| (step_at(terms, &s.parameters, shot, at) - smooth).abs() / 3f64.sqrt());
        let (local, local_mm) = departures.of(shot, seen.index);
        let slope = (step_at(terms, &chosen.parameters, shot, at + 1e-4)
            - step_at(terms, &chosen.parameters, shot, at - 1e-4))
            / 2e-4;
        let place_mm = slope.abs() * known.at;
        let parts = [fit_mm, toe_mm, local_mm, place_mm, unevenness_mm];
        profile.push(ProfileBin {
            along: course.bin_reading(seen.index),
            seen_along: course.reading(at),
            step_mm: smooth + local,
            standard_mm: parts.iter().map(|p| p * p).sum::<f64>().sqrt(),
            fit_mm,
            toe_mm,
            local_mm,
            place_mm,
            unevenness_mm,
        });
    }
    let Some(largest) = profile.iter().max_by(|a, b| a.step_mm.abs().total_cmp(&b.step_mm.abs())) else {
        return Err(Error::NotFound { what: "step", reason: "no angle at which both walls were seen".into() });
    };
    let first = wide.parameters.len() - model(wide_terms).step_columns();
    let p = &wide.parameters.as_slice()[first..];
    // Of a vector's length: its covariance along its own direction.
    let along = |k: usize| {
        let v = nalgebra::Vector2::new(p[k], p[k + 1]);
        let u = v.try_normalize(0.0).unwrap_or(nalgebra::Vector2::x());
        let c = wide.covariance.fixed_view::<2, 2>(first + k, first + k);
        u.dot(&(c * u)).max(0.0).sqrt()
    };
    Ok(Step {
        mean_mm,
        median_mm,
        max_abs_mm: largest.step_mm.abs(),
        max_abs_at: largest.along,
        expanded_mm: 2.0 * largest.standard_mm,
        coverage: course.bin_width() * profile.len() as f64,
        curvature_mm: (p[2], wide.covariance[(first + 2, first + 2)].max(0.0).sqrt()),
        offset_mm: [p[0], p[1]],
        offset_standard_mm: along(0),
        tilt_standard_rad: along(3) / scale_mm,
        tilt_rad: (p[3].hypot(p[4]) / scale_mm).atan(),
        shape_degree: terms.shape,
        shrinkage_mm: {
            let mut drawn = model(terms).shell_columns().map(|k| chosen.parameters[k]);
            std::array::from_fn(|_| drawn.next().unwrap_or(0.0))
        },
        residual_rms_mm: (chosen.residuals.iter().map(|r| r * r).sum::<f64>() / cells.len() as f64).sqrt(),
        correlation_mm: covariance.support_mm,
        effective_cells: whitener.effective_count(covariance.nugget + covariance.sill),
        profile,
        deviation_mm,
    })
}

#[cfg(test)]
mod tests;
