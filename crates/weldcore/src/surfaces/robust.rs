//! Fits among outliers: random minimal samples judged by a truncated cost (MSAC), reweighting from the best of them,
//! and a last fit, untruncated, on the points within three standard deviations.
//!
//! The noise is taken from the data, so no threshold is asked for. Random numbers are functions of a seed and a
//! counter: the same seed gives the same bits on any number of threads.
//!
//! Sources: Torr and Zisserman, MLESAC, CVIU 78 (2000), for MSAC; Rousseeuw, Least median of squares regression, JASA
//! 79 (1984), for the scale; Holland and Welsch (1977) for reweighting, with Tukey's biweight.

use super::cylinder::{self, Cylinder};
use super::least_squares::{Fit, PointNoise};
use super::plane::{self, Plane};
use super::sphere::{self, Sphere};
use crate::error::{Error, Result, require_count, require_finite, require_positive};
use crate::ground::memory::require;
use crate::ground::random::Counter;
use crate::ground::robust::{MEDIAN_SIGMAS, TUKEY_SIGMAS, median, nth, tukey};
use crate::ground::threads;
use crate::ground::transform::Vec3;

/// A robust fit: the fit on the inliers, and their indices, ascending.
pub type Robust<S> = (Fit<S>, Vec<usize>);

/// Points that judge a sample; with them the share of inliers is known to 2 %.
const JUDGES: usize = 512;
/// Samples: among 60 % outliers, one of 256 has four inliers with a probability of 0.998.
const SAMPLES: u64 = 512;
/// The scale comes from this quantile of the residuals: with a third, up to 60 % may be outliers.
const QUANTILE: f64 = 1.0 / 3.0;
/// Normal quantile: the third smallest |residual| of undisturbed data is 0.4307 sigma.
const QUANTILE_SIGMAS: f64 = 0.4307;
/// Points further from the surface than this many sigma are outliers.
const GATE: f64 = 3.0;
/// Rounds of reweighting; the scale settles in about five.
const ROUNDS: usize = 30;

/// A plane among outliers. See the module.
///
/// # Errors
/// As [`plane::fit`]; [`Error::NotFound`] where no plane stands out.
pub fn plane(points: &[[f64; 3]], sigma_mm: Option<f64>, seed: u64) -> Result<Robust<Plane>> {
    check("plane", points, 3, sigma_mm)?;
    let judges = judges(points, seed);
    let starts = sampled::<3, _>(points, seed, |sample| plane::through(&sample));
    let start = best("plane", &judges, starts, Plane::distance, sigma_mm)?;
    let refine = |on: &[[f64; 3]], _: &Plane, noise: PointNoise| plane::fit(on, noise);
    reweighted(points, start, 3, Plane::distance, refine, sigma_mm)
}

/// A sphere among outliers, its radius free or known. See the module.
///
/// # Errors
/// As [`sphere::fit`]; [`Error::NotFound`] where no sphere stands out.
pub fn sphere(points: &[[f64; 3]], radius_mm: Option<f64>, sigma_mm: Option<f64>, seed: u64) -> Result<Robust<Sphere>> {
    check("sphere", points, 4, sigma_mm)?;
    if let Some(radius) = radius_mm {
        require_positive("radius_mm", radius)?;
    }
    let judges = judges(points, seed);
    let starts = sampled::<4, _>(points, seed, |sample| match radius_mm {
        None => sphere::through_four(&sample),
        Some(radius) => sphere::through_three(&sample, radius),
    });
    let start = best("sphere", &judges, starts, Sphere::distance, sigma_mm)?;
    let refine =
        |on: &[[f64; 3]], near: &Sphere, noise: PointNoise| sphere::refine(on, *near, radius_mm.is_none(), noise);
    reweighted(points, start, 4, Sphere::distance, refine, sigma_mm)
}

/// A cylinder among outliers, its radius free or known. The samples are circles in projections all over the hemisphere.
///
/// # Errors
/// As [`cylinder::fit`]; [`Error::NotFound`] where no cylinder stands out.
pub fn cylinder(
    points: &[[f64; 3]],
    radius_mm: Option<f64>,
    sigma_mm: Option<f64>,
    seed: u64,
) -> Result<Robust<Cylinder>> {
    check("cylinder", points, 6, sigma_mm)?;
    if let Some(radius) = radius_mm {
        require_positive("radius_mm", radius)?;
    }
    /// Directions 6° apart, and circles tried in each: among 60 % outliers one of 40 has three inliers.
    const DIRECTIONS: usize = 600;
    const CIRCLES: u64 = 40;
    /// Directions whose best circle is refined.
    const REFINED: usize = 10;
    let judges = judges(points, seed);
    let few: Vec<[f64; 3]> = judges.iter().step_by(3).copied().collect();
    let random = Counter::new(seed ^ 0xC1);
    let tried: Vec<(u64, Vec3)> = (0..).zip(cylinder::directions(DIRECTIONS)).collect();
    let circles = threads::map_each(&tried, |(number, axis)| {
        (0..CIRCLES)
            .filter_map(|k| {
                let at = |j: u64| few.get(random.below((number * CIRCLES + k) * 3 + j, few.len())).copied();
                let found = cylinder::through(&[at(0)?, at(1)?, at(2)?], axis, radius_mm)?;
                Some((quantile(&few, |p| found.distance(p), QUANTILE), found))
            })
            .min_by(|a, b| a.0.total_cmp(&b.0))
    });
    let mut circles: Vec<(f64, Cylinder)> = circles.into_iter().flatten().collect();
    circles.sort_by(|a, b| a.0.total_cmp(&b.0));
    circles.truncate(REFINED);
    let refine =
        |on: &[[f64; 3]], near: &Cylinder, noise: PointNoise| cylinder::refine(on, *near, radius_mm.is_none(), noise);
    // A direction that is some degrees off leaves a wide residual: narrow it on the judges before they are compared.
    let starts = threads::map_each(&circles, |(_, start)| {
        let (fit, _) = reweighted(&judges, *start, 5, Cylinder::distance, refine, sigma_mm).ok()?;
        Some(fit.surface)
    });
    let start = best("cylinder", &judges, starts.into_iter().flatten().collect(), Cylinder::distance, sigma_mm)?;
    reweighted(points, start, 5, Cylinder::distance, refine, sigma_mm)
}

fn check(what: &'static str, points: &[[f64; 3]], needed: usize, sigma_mm: Option<f64>) -> Result<()> {
    require_finite("points", points)?;
    require_count("points", needed, points.len())?;
    require(points.len(), 80);
    if let Some(sigma) = sigma_mm {
        require_positive("sigma_mm", sigma)?;
    }
    if points.iter().all(|p| Some(p) == points.first()) {
        return Err(Error::Degenerate { what, reason: "all points are equal".into() });
    }
    Ok(())
}

/// A random part of the points, or all of few.
fn judges(points: &[[f64; 3]], seed: u64) -> Vec<[f64; 3]> {
    if points.len() <= JUDGES {
        return points.to_vec();
    }
    let random = Counter::new(seed ^ 0xA5);
    // One from each of as many equal parts.
    let edge = |k: usize| k * points.len() / JUDGES;
    (0..JUDGES).filter_map(|k| points.get(edge(k) + random.below(k as u64, edge(k + 1) - edge(k)))).copied().collect()
}

/// Surfaces through random samples of `N` different points.
fn sampled<const N: usize, S: Send>(
    points: &[[f64; 3]],
    seed: u64,
    through: impl Fn([[f64; 3]; N]) -> Option<S> + Sync,
) -> Vec<S> {
    let random = Counter::new(seed);
    let numbers: Vec<u64> = (0..SAMPLES).collect();
    let found = threads::map_each(&numbers, |number| {
        let mut sample = [[0.0; 3]; N];
        for (j, p) in sample.iter_mut().enumerate() {
            *p = *points.get(random.below(number * N as u64 + j as u64, points.len()))?;
        }
        through(sample)
    });
    found.into_iter().flatten().collect()
}

/// A quantile of the points' absolute distances.
fn quantile(points: &[[f64; 3]], distance: impl Fn(&[f64; 3]) -> f64, share: f64) -> f64 {
    let mut sizes: Vec<f64> = points.iter().map(|p| distance(p).abs()).collect();
    let at = (sizes.len() as f64 * share) as usize;
    nth(&mut sizes, at).unwrap_or(f64::INFINITY)
}

/// The surface of least truncated cost, at three times the scale of the one of least quantile. The first of equals.
fn best<S: Copy + Send + Sync>(
    what: &'static str,
    judges: &[[f64; 3]],
    candidates: Vec<S>,
    distance: impl Fn(&S, &[f64; 3]) -> f64 + Sync,
    sigma_mm: Option<f64>,
) -> Result<S> {
    let scale = match sigma_mm {
        Some(sigma) => sigma,
        None => {
            let scales = threads::map_each(&candidates, |s| quantile(judges, |p| distance(s, p), QUANTILE));
            scales.into_iter().fold(f64::INFINITY, f64::min) / QUANTILE_SIGMAS
        }
    };
    // Exact data have no scale; any positive one will do then.
    let gate = (GATE * scale).powi(2).max(f64::MIN_POSITIVE);
    let costs = threads::map_each(&candidates, |s| {
        let cost: f64 = judges.iter().map(|p| distance(s, p).powi(2).min(gate)).sum();
        if cost.is_finite() { cost } else { f64::INFINITY }
    });
    let first = costs.iter().enumerate().min_by(|a, b| a.1.total_cmp(b.1)).map(|(i, _)| i);
    first
        .and_then(|i| candidates.get(i))
        .copied()
        .ok_or_else(|| Error::NotFound { what, reason: "no sample of the points determines one".into() })
}

/// Reweights until the inliers stand still, then fits them without weights or truncation.
fn reweighted<S: Copy + Sync>(
    points: &[[f64; 3]],
    start: S,
    needed: usize,
    distance: impl Fn(&S, &[f64; 3]) -> f64 + Sync,
    refine: impl Fn(&[[f64; 3]], &S, PointNoise) -> Result<Fit<S>>,
    sigma_mm: Option<f64>,
) -> Result<Robust<S>> {
    // A spread below the rounding of the coordinates is none.
    let rounding = 16.0 * f64::EPSILON * points.iter().flatten().fold(0.0, |m: f64, v| m.max(v.abs()));
    let residuals = |s: &S| -> Vec<f64> {
        threads::map_chunks(points, |_, chunk| chunk.iter().map(|p| distance(s, p)).collect::<Vec<_>>()).concat()
    };
    let within = |residuals: &[f64], gate: f64| -> Vec<usize> {
        (0..points.len()).filter(|&i| residuals.get(i).is_some_and(|r| r.abs() <= gate)).collect()
    };
    let gather =
        |indices: &[usize]| -> Vec<[f64; 3]> { indices.iter().filter_map(|&i| points.get(i)).copied().collect() };
    let mut surface = start;
    let mut current = residuals(&surface);
    let mut sigma = sigma_mm.unwrap_or_else(|| quantile(points, |p| distance(&surface, p), QUANTILE) / QUANTILE_SIGMAS);
    let mut inliers: Vec<usize> = Vec::new();
    let mut iterations = 0;
    for _ in 0..ROUNDS {
        if sigma_mm.is_none() {
            // Within three sigma of the last round: strays cannot hold it up.
            let mut sizes: Vec<f64> =
                current.iter().map(|r| r.abs()).filter(|r| *r <= GATE * sigma + rounding).collect();
            if !sizes.is_empty() {
                sigma = median(&mut sizes) / MEDIAN_SIGMAS;
            }
        }
        let width = TUKEY_SIGMAS * sigma + rounding;
        let used = within(&current, width);
        let weights: Vec<f64> =
            used.iter().filter_map(|&i| current.get(i)).map(|r| tukey(r / width).max(f64::MIN_POSITIVE)).collect();
        require_count("points near one surface", needed, used.len())?;
        let fit = refine(&gather(&used), &surface, PointNoise { weights: Some(&weights), sigma_mm: None })?;
        surface = fit.surface;
        iterations += fit.iterations;
        current = residuals(&surface);
        let next = within(&current, GATE * sigma + rounding);
        // A point in a thousand that still comes or goes moves nothing by a part of its uncertainty that matters.
        let settled = next.len().abs_diff(inliers.len()) <= inliers.len() / 1000;
        inliers = next;
        if settled {
            break;
        }
    }
    require_count("points near one surface", needed, inliers.len())?;
    let mut fit = refine(&gather(&inliers), &surface, PointNoise { weights: None, sigma_mm })?;
    fit.iterations += iterations;
    Ok((fit, inliers))
}
