//! Spheres of a known size, found in a raw cloud without any other hint.
//!
//! The cloud is cut into cells an eighth of the radius wide: tiles of a pixel grid, or voxels. Each cell has a normal
//! and votes for the centre at one radius along it, on either side. Where votes meet, a sphere of fixed radius is
//! fitted, first to the cells, then to the points. A place is refused unless it looks like a sphere of that size in
//! every respect: its surroundings lie on it, enough of the cap is seen, the noise leaves its shape visible, and the
//! radius, set free, comes out right within its own uncertainty.

mod cells;
mod votes;

use nalgebra::{Matrix3, Matrix4, Vector4};

use self::cells::{CelledCloud, Layout, Voxel, finite};
use self::votes::Votes;
use super::least_squares::PointNoise;
use super::sphere::{self, Sphere};
use crate::error::{Error, Result, require_finite, require_positive};
use crate::ground::robust::{MEDIAN_SIGMAS, median};
use crate::ground::transform::Vec3;

/// The cap that counts: half-angle about the line of sight. Beyond it light falls and is seen too obliquely; the same
/// 120° cone in which ASTM E3125 evaluates scanned spheres.
pub const CAP_RAD: f64 = 60.0 * std::f64::consts::PI / 180.0;
/// Points further from the sphere than this many standard deviations are not on it.
const GATE: f64 = 3.0;
/// Points within this part of the radius from the surface are its surroundings.
const ZONE: f64 = 0.2;
/// Least share of the surroundings that lies on the sphere. A cylinder of the same radius reaches 0.3.
const PURITY: f64 = 0.6;
/// Least solid angle seen, in parts of a hemisphere; the whole cap is 0.5. A cylinder of the same radius reaches 0.1.
const COVERAGE: f64 = 0.15;
/// Noise that leaves the shape visible: the cap is R/2 deep.
const NOISE: f64 = 0.03;
/// A scanner's scale may be off by this much beyond what the noise of the free radius allows.
const SCALE: f64 = 0.005;
/// Coverage factor of the free radius.
const SIGMAS: f64 = 4.0;
/// The size is told when the free radius is known to this part of it; a plane passes for a sphere otherwise.
const TELLING: f64 = 0.25;
/// Places looked at before the search gives up; votes of a cylinder of the same radius meet all along its axis.
const MAX_PLACES: usize = 256;
/// Voxels of votes followed uphill.
const MAX_PEAKS: usize = 4096;
/// Votes meet in a ball of this part of the radius, ...
const BALL: f64 = 0.2;
/// ... and must be this many times those that a plane leaves in one. A sphere of the least coverage leaves seven times.
const ABOVE_PLANE: f64 = 3.0;

/// What no scanner's calibration is free of: a two-hundredth of a pixel, in each direction, common to a whole sphere.
const SYSTEMATIC_PX: f64 = 0.005;

/// A sphere found in a cloud.
#[derive(Debug, Clone, PartialEq)]
pub struct FoundSphere {
    /// Its centre, and the radius that was given.
    pub sphere: Sphere,
    /// Covariance of the centre, mm²: from the residuals, enlarged where neighbouring residuals go together, and on a
    /// grid with a two-hundredth of a pixel for what the calibration of a scanner leaves.
    pub covariance: Matrix3<f64>,
    /// Root mean square of the inliers' distances from the sphere, mm.
    pub rms_mm: f64,
    /// Indices of the points on it, ascending.
    pub inliers: Vec<usize>,
    /// Solid angle seen, in parts of a hemisphere (0.5 is the whole 120° cap).
    pub coverage: f64,
    /// The radius that the same points have when it is set free, mm.
    pub free_radius_mm: f64,
    /// Standard uncertainty of the free radius, mm.
    pub free_radius_sigma_mm: f64,
}

/// Finds the spheres of radius `radius_mm` in a cloud.
///
/// `width` is that of a pixel grid (row by row, NaN where a pixel has no point); without it the cloud is bare and all
/// of it must be finite. With `count` the best `count` are returned, or an error that says why there are not so many.
/// The order is that of the number of inliers, most first.
///
/// # Errors
/// Bad values; [`Error::NotFound`] where fewer than `count` are there.
pub fn find(
    points: &[[f64; 3]],
    width: Option<usize>,
    radius_mm: f64,
    count: Option<usize>,
) -> Result<Vec<FoundSphere>> {
    require_positive("radius_mm", radius_mm)?;
    if count == Some(0) {
        return Err(Error::OutOfRange { what: "count", expected: "at least 1".into(), value: "0".into() });
    }
    crate::ground::memory::require(points.len(), 64);
    let cloud = match width {
        Some(width) => CelledCloud::of_grid(points, width, radius_mm)?,
        None => {
            require_finite("points", points)?;
            CelledCloud::of_bare(points, radius_mm)
        }
    };
    let (mut found, refused) = cloud.search(radius_mm);
    found.sort_by(|a, b| b.inliers.len().cmp(&a.inliers.len()).then(a.inliers.cmp(&b.inliers)));
    if let Some(count) = count {
        if found.len() < count {
            let mut reason = format!("{} of {count} spheres of radius {radius_mm} mm seen", found.len());
            for (place, why) in refused.iter().take(5) {
                reason += &format!("; at ({:.1}, {:.1}, {:.1}) {why}", place[0], place[1], place[2]);
            }
            return Err(Error::NotFound { what: "sphere", reason });
        }
        found.truncate(count);
    }
    Ok(found)
}
impl CelledCloud<'_> {
    fn search(&self, radius: f64) -> (Vec<FoundSphere>, Vec<(Vec3, String)>) {
        let votes = Votes::of(&self.cells, radius, BALL * radius);
        let (mut found, mut refused): (Vec<FoundSphere>, Vec<(Vec3, String)>) = (Vec::new(), Vec::new());
        let mut looked: Vec<Vec3> = Vec::new();
        let plane = std::f64::consts::PI * (BALL * radius / self.side).powi(2);
        let enough = (ABOVE_PLANE * plane).max(4.0);
        for peak in votes.peaks().into_iter().take(MAX_PEAKS) {
            crate::ground::stop::poll();
            if looked.len() >= MAX_PLACES {
                break;
            }
            let (place, support) = votes.settle(peak);
            if (support as f64) < enough {
                continue;
            }
            // Two spheres cannot share space; and a place that was refused is not worth another look close by.
            let taken = found.iter().any(|f| (f.sphere.center_mm - place).norm() < radius);
            if taken || looked.iter().any(|p| (p - place).norm() < 0.3 * radius) {
                continue;
            }
            looked.push(place);
            match self.examine(place, radius) {
                Ok(f) if found.iter().any(|g| (g.sphere.center_mm - f.sphere.center_mm).norm() < radius) => {}
                Ok(f) => found.push(f),
                Err(reason) => refused.push((place, reason)),
            }
        }
        refused.retain(|(p, _)| found.iter().all(|f| (f.sphere.center_mm - p).norm() > 1.5 * radius));
        (found, refused)
    }

    /// Fits a sphere near `place`, or says why there is none.
    fn examine(&self, place: Vec3, radius: f64) -> std::result::Result<FoundSphere, String> {
        let mut center = self.settle_on_cells(place, radius)?;
        let sight = self.line_of_sight(center, radius);
        let limit = CAP_RAD.cos();
        // All points that could be on it, with the cell they belong to.
        let mut near: Vec<(usize, usize)> = Vec::new();
        for (k, cell) in self.around(center) {
            if ((cell.mean - center).norm() - radius).abs() < 0.5 * radius {
                self.members(k, |i| {
                    if finite(&self.points[i]) {
                        near.push((i, k));
                    }
                });
            }
        }
        let mut sigma = 0.0;
        let mut zone: Vec<(usize, usize, f64)> = Vec::new();
        // Each round measures the noise, gates, fits; ten rounds settle or never will.
        for _ in 0..20 {
            crate::ground::stop::poll();
            zone.clear();
            for &(i, k) in &near {
                let d = Vec3::from(self.points[i]) - center;
                let r = d.norm();
                if (r - radius).abs() < ZONE * radius && sight.is_none_or(|v| d.dot(&v) >= limit * r) {
                    zone.push((i, k, r - radius));
                }
            }
            if zone.len() < 8 {
                return Err(format!("only {} points", zone.len()));
            }
            let mut sizes: Vec<f64> = zone.iter().map(|z| z.2.abs()).collect();
            sigma = median(&mut sizes) / MEDIAN_SIGMAS;
            let gate = self.gate(sigma, center);
            let on: Vec<[f64; 3]> = zone.iter().filter(|z| z.2.abs() <= gate).map(|z| self.points[z.0]).collect();
            let step = fixed_step(&on, center, radius).ok_or("the points do not determine a sphere")?;
            center += step;
            if step.norm() < 1e-9 * radius {
                break;
            }
            if (center - place).norm() > radius {
                return Err("the points lead away from it".into());
            }
        }
        if sigma > NOISE * radius {
            return Err(format!("its surroundings scatter by {sigma:.3} mm: not a sphere of radius {radius} mm"));
        }
        let gate = self.gate(sigma, center);
        let on: Vec<(usize, usize)> = zone.iter().filter(|z| z.2.abs() <= gate).map(|z| (z.0, z.1)).collect();
        self.judge(&on, zone.len(), center, radius, sight)
    }

    /// Fits once more without truncation, with the radius fixed and free, and decides.
    fn judge(
        &self,
        on: &[(usize, usize)],
        around: usize,
        center: Vec3,
        radius: f64,
        sight: Option<Vec3>,
    ) -> std::result::Result<FoundSphere, String> {
        let purity = on.len() as f64 / around as f64;
        if purity < PURITY {
            return Err(format!("only {:.0} % of the surroundings lie on a sphere", 100.0 * purity));
        }
        let points: Vec<[f64; 3]> = on.iter().map(|z| self.points[z.0]).collect();
        let start = Sphere { center_mm: center, radius_mm: radius };
        let fixed = sphere::refine(&points, start, false, PointNoise::default()).map_err(|e| e.to_string())?;
        let center = fixed.surface.center_mm;
        let axis = sight.unwrap_or_else(|| points.iter().map(|p| (Vec3::from(*p) - center).normalize()).sum());
        let coverage = coverage(&points, center, axis);
        if coverage < COVERAGE {
            return Err(format!("only {:.0} % of a hemisphere is seen", 100.0 * coverage));
        }
        let free = sphere::refine(&points, fixed.surface, true, PointNoise::default()).map_err(|e| e.to_string())?;
        let sigma_radius = (free.covariance[(3, 3)] * correlation(on, &points, &free.surface, 4)).sqrt();
        if SIGMAS * sigma_radius > TELLING * radius {
            return Err(format!("{} points do not tell its size", on.len()));
        }
        let miss = (free.surface.radius_mm - radius).abs();
        if miss > SIGMAS * sigma_radius + SCALE * radius {
            let seen = free.surface.radius_mm;
            return Err(format!(
                "a radius of {seen:.3} mm is seen, with a standard uncertainty of {sigma_radius:.3} mm"
            ));
        }
        let scale = correlation(on, &points, &fixed.surface, 3);
        let systematic = match self.layout {
            Layout::Grid { tile, .. } => (SYSTEMATIC_PX * self.side / tile as f64).powi(2),
            Layout::Bare { .. } => 0.0,
        };
        let mut inliers: Vec<usize> = on.iter().map(|z| z.0).collect();
        inliers.sort_unstable();
        Ok(FoundSphere {
            sphere: fixed.surface,
            covariance: Matrix3::from_fn(|a, b| fixed.covariance[(a, b)] * scale) + Matrix3::identity() * systematic,
            rms_mm: fixed.rms_mm,
            inliers,
            coverage,
            free_radius_mm: free.surface.radius_mm,
            free_radius_sigma_mm: sigma_radius,
        })
    }

    /// Three sigma, and never below the rounding of the coordinates.
    fn gate(&self, sigma: f64, center: Vec3) -> f64 {
        GATE * sigma + 16.0 * f64::EPSILON * center.amax()
    }

    /// The centre from the cells around the place whose normals agree.
    fn settle_on_cells(&self, place: Vec3, radius: f64) -> std::result::Result<Vec3, String> {
        let mut center = place;
        for _ in 0..8 {
            let on: Vec<[f64; 3]> = self.agreeing(center, radius).map(|c| c.mean.into()).collect();
            if on.len() < 4 {
                return Err("too few neighbouring normals meet".into());
            }
            let step = fixed_step(&on, center, radius).ok_or("the normals do not determine a centre")?;
            center += step;
            if (center - place).norm() > radius {
                return Err("the points lead away from it".into());
            }
            if step.norm() < 1e-3 * radius {
                break;
            }
        }
        // The same test as for the points, before they are looked at.
        let mut sizes: Vec<f64> = self
            .around(center)
            .map(|(_, c)| ((c.mean - center).norm() - radius).abs())
            .filter(|r| *r < ZONE * radius)
            .collect();
        if sizes.is_empty() || median(&mut sizes) > NOISE * radius {
            return Err(format!("its surroundings do not lie on a sphere of radius {radius} mm"));
        }
        Ok(center)
    }

    /// Cells near the sphere's surface whose normals point to or from its centre.
    fn agreeing(&self, center: Vec3, radius: f64) -> impl Iterator<Item = &Voxel> {
        const AGREE: f64 = 0.9; // cosine; 26°, more than the turn of the surface over a cell and its neighbours
        self.around(center).map(|(_, c)| c).filter(move |c| {
            let d = c.mean - center;
            let r = d.norm();
            (r - radius).abs() < 0.125 * radius && c.normal.dot(&d).abs() > AGREE * r
        })
    }

    /// Unit vector from the centre to the viewer. On a grid the pixel coordinates near the sphere are an affine
    /// function of the points, and do not change along it; a bare cloud is seen from its origin if all of its points
    /// can be.
    fn line_of_sight(&self, center: Vec3, radius: f64) -> Option<Vec3> {
        match self.layout {
            Layout::Grid { .. } => {
                let (mut matrix, mut right) = (Matrix4::zeros(), [Vector4::zeros(); 2]);
                let mut outward = Vec3::zeros();
                for cell in self.agreeing(center, radius) {
                    let q = (cell.mean - center) / radius;
                    let row = Vector4::new(q[0], q[1], q[2], 1.0);
                    matrix += row * row.transpose();
                    right.iter_mut().zip(cell.pixel).for_each(|(sum, pixel)| *sum += row * pixel);
                    outward += q;
                }
                let decomposed = matrix.lu();
                let column = decomposed.solve(&right[0])?;
                let row = decomposed.solve(&right[1])?;
                let sight = column.xyz().cross(&row.xyz()).try_normalize(0.0)?;
                Some(if sight.dot(&outward) < 0.0 { -sight } else { sight })
            }
            Layout::Bare { .. } => {
                let (mut seen, mut all) = (0.0, 0.0);
                for cell in self.agreeing(center, radius) {
                    all += cell.points as f64;
                    if (cell.mean - center).dot(&cell.mean) < 0.0 {
                        seen += cell.points as f64;
                    }
                }
                // A few cells on the limb may fall on the wrong side of it.
                if seen < 0.95 * all { None } else { (-center).try_normalize(radius) }
            }
        }
    }
}

/// One Gauss-Newton step of the centre of a sphere of fixed radius.
fn fixed_step(points: &[[f64; 3]], center: Vec3, radius: f64) -> Option<Vec3> {
    let (mut matrix, mut right) = (Matrix3::zeros(), Vec3::zeros());
    for p in points {
        let d = Vec3::from(*p) - center;
        let r = d.norm();
        if r > 0.0 {
            let n = d / r;
            matrix += n * n.transpose();
            right += n * (r - radius);
        }
    }
    // In a plane or on a line there is a direction without information.
    if matrix.determinant() <= 1e-12 * matrix.trace().powi(3) {
        return None;
    }
    matrix.cholesky().map(|c| c.solve(&right))
}

/// By how much the variance of a cell's mean residual exceeds that of independent residuals; at least 1.
fn correlation(on: &[(usize, usize)], points: &[[f64; 3]], sphere: &Sphere, unknowns: usize) -> f64 {
    let (mut squares, mut total) = (0.0, 0.0);
    let (mut cells, mut at) = (0_usize, usize::MAX);
    let (mut sum, mut n) = (0.0, 0.0);
    for (&(_, cell), p) in on.iter().zip(points) {
        let residual = (Vec3::from(*p) - sphere.center_mm).norm() - sphere.radius_mm;
        total += residual * residual;
        // The points come cell by cell.
        if cell != at {
            if n > 0.0 {
                squares += sum * sum / n;
            }
            (sum, n, at) = (0.0, 0.0, cell);
            cells += 1;
        }
        sum += residual;
        n += 1.0;
    }
    squares += if n > 0.0 { sum * sum / n } else { 0.0 };
    let variance = total / (on.len().saturating_sub(unknowns)).max(1) as f64;
    let between = squares / cells.saturating_sub(unknowns).max(1) as f64;
    if variance > 0.0 { (between / variance).max(1.0) } else { 1.0 }
}

/// Solid angle that the points cover, in parts of a hemisphere: occupied bins of equal area about `axis`.
fn coverage(points: &[[f64; 3]], center: Vec3, axis: Vec3) -> f64 {
    let axis = axis.try_normalize(1e-12).unwrap_or_else(Vec3::z);
    let across = axis.cross(&if axis.x.abs() < 0.7 { Vec3::x() } else { Vec3::y() }).normalize();
    let third = axis.cross(&across);
    // Some eight points a bin on average, so that an empty bin is a gap and no chance.
    let rings = (((points.len() as f64) / 8.0 / 2.0).sqrt() as usize).clamp(3, 16);
    let sectors = 2 * rings;
    let mut seen = vec![false; 2 * rings * sectors];
    for p in points {
        let d = Vec3::from(*p) - center;
        let height = (d.dot(&axis) / d.norm()).clamp(-1.0, 1.0);
        let angle = d.dot(&third).atan2(d.dot(&across)) / std::f64::consts::TAU + 0.5;
        let ring = (((1.0 - height) * rings as f64) as usize).min(2 * rings - 1);
        let sector = ((angle * sectors as f64) as usize).min(sectors - 1);
        seen[ring * sectors + sector] = true;
    }
    seen.iter().filter(|s| **s).count() as f64 / (rings * sectors) as f64
}
#[cfg(test)]
mod tests {
    use super::*;
    use crate::ground::threads;

    /// Uniform in [0, 1) from a counter.
    fn uniform(i: usize) -> f64 {
        let mut z = (i as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15).wrapping_add(0x1234_5678);
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }

    fn normal(i: usize) -> f64 {
        (-2.0 * (1.0 - uniform(2 * i)).ln()).sqrt() * (std::f64::consts::TAU * uniform(2 * i + 1)).cos()
    }

    const WIDTH: usize = 320;
    const NOISE_MM: f64 = 0.03;

    /// A pinhole camera's view of spheres (centre, radius), a cylinder along y (x, z, radius) and a plate.
    fn grid(spheres: &[([f64; 3], f64)], cylinder: Option<(f64, f64, f64)>) -> Vec<[f64; 3]> {
        let mut points = Vec::new();
        for row in 0..240 {
            for column in 0..WIDTH {
                let ray = Vec3::new((column as f64 - 159.5) / 1300.0, (row as f64 - 119.5) / 1300.0, 1.0);
                let mut nearest = if column < 12 { f64::NAN } else { (430.0 + 0.2 * ray.y) / (1.0 + 0.3 * ray.x) };
                let mut hit = |a: f64, b: f64, c: f64| {
                    let root = (b * b - a * c).sqrt();
                    if root.is_finite() {
                        nearest = nearest.min((b - root) / a);
                    }
                };
                for &(c, r) in spheres {
                    let c = Vec3::from(c);
                    hit(ray.norm_squared(), ray.dot(&c), c.norm_squared() - r * r);
                }
                if let Some((x, z, r)) = cylinder {
                    hit(ray.x * ray.x + 1.0, ray.x * x + z, x * x + z * z - r * r);
                }
                let depth = nearest + NOISE_MM * normal(row * WIDTH + column);
                points.push((ray * depth).into());
            }
        }
        points
    }

    const BALLS: [([f64; 3], f64); 3] =
        [([-20.0, -15.0, 412.0], 10.0), ([25.0, -12.0, 405.0], 10.0), ([2.0, 20.0, 410.0], 10.0)];

    /// Six standard deviations of a centre from some 2,500 points of the given noise, with a two-hundredth of a pixel.
    const CENTRE_TOLERANCE_MM: f64 = 6.0 * 0.003;

    #[test]
    fn the_spheres_of_a_plate_are_found_and_another_size_and_a_pin_are_not() {
        let mut scene = BALLS.to_vec();
        scene.push(([-30.0, 22.0, 411.0], 11.0));
        let points = grid(&scene, None);
        let found = find(&points, Some(WIDTH), 10.0, None).unwrap();
        assert_eq!(found.len(), 3);
        for (center, _) in BALLS {
            let f = found.iter().find(|f| (f.sphere.center_mm - Vec3::from(center)).norm() < 1.0).unwrap();
            let miss = f.sphere.center_mm - Vec3::from(center);
            assert!(miss.amax() < CENTRE_TOLERANCE_MM, "{miss}");
            let squared = miss.dot(&f.covariance.try_inverse().unwrap().mul(miss));
            // The 1e-5 quantile of chi² with 3 degrees of freedom.
            assert!(squared < 25.9, "{squared}");
            assert!(f.coverage > 0.4);
        }
        let error = find(&points, Some(WIDTH), 10.0, Some(4)).unwrap_err().to_string();
        assert!(error.contains("3 of 4") && error.contains("a radius of 1"), "{error}");
        assert_eq!(find(&points, Some(WIDTH), 11.0, None).unwrap().len(), 1);

        let pin = grid(&[], Some((3.0, 410.0, 10.0)));
        assert_eq!(find(&pin, Some(WIDTH), 10.0, None).unwrap(), []);
        assert_eq!(find(&grid(&[], None), Some(WIDTH), 10.0, None).unwrap(), []);
    }

    #[test]
    fn the_bits_do_not_depend_on_the_threads() {
        let points = grid(&BALLS, None);
        let run = |n, width| {
            threads::set_threads(Some(n)).unwrap();
            let keep: Vec<_> = points.iter().copied().filter(|p| width == Some(WIDTH) || finite(p)).collect();
            find(&keep, width, 10.0, Some(3)).unwrap()
        };
        for width in [Some(WIDTH), None] {
            let one = run(1, width);
            assert!(one == run(2, width) && one == run(8, width));
        }
        threads::set_threads(None).unwrap();
    }

    #[test]
    fn a_bare_cloud_of_whole_spheres_keeps_all_of_their_points() {
        let n = 8_000;
        let mut points: Vec<[f64; 3]> = Vec::new();
        for (k, center) in [[0.0, 0.0, 300.0], [20.5, 0.0, 300.0]].into_iter().enumerate() {
            for i in 0..n {
                let d = Vec3::from_fn(|a, _| normal(3 * (i + k * n) + a)).normalize();
                points.push((Vec3::from(center) + d * (10.0 + 0.02 * normal(100_000 + i))).into());
            }
        }
        for i in 0..4_000 {
            points.push(std::array::from_fn(|a| 60.0 * (uniform(7 * i + a) - 0.5) + if a == 2 { 300.0 } else { 0.0 }));
        }
        let found = find(&points, None, 10.0, Some(2)).unwrap();
        for f in found {
            assert!(f.sphere.center_mm.y.abs() < 0.002 && f.inliers.len() > 7_900 && f.coverage > 1.9);
        }
    }

    #[test]
    fn bad_input_is_refused() {
        assert!(matches!(find(&[], None, 0.0, None), Err(Error::OutOfRange { .. })));
        assert!(matches!(find(&[], None, 1.0, Some(0)), Err(Error::OutOfRange { .. })));
        assert!(matches!(find(&[[0.0; 3]; 5], Some(2), 1.0, None), Err(Error::Shape { .. })));
        assert!(matches!(find(&[[f64::NAN; 3]; 5], None, 1.0, None), Err(Error::NonFinite { .. })));
        assert!(matches!(find(&[[f64::INFINITY; 3]; 4], Some(2), 1.0, None), Err(Error::NonFinite { .. })));
        for width in [None, Some(2)] {
            assert!(matches!(find(&[[1.0; 3]; 4], width, 1.0, Some(1)), Err(Error::NotFound { .. })));
            assert_eq!(find(&[], width, 1.0, None).unwrap(), []);
            assert_eq!(find(&[[1e300, -1e300, 0.0]; 4], width, 1e-300, None).unwrap(), []);
        }
    }

    use std::ops::Mul;
}
