//! Where a scanner is calibrated: the parts of both images in which its board was seen.
//!
//! A lens's distortion is a polynomial that was fitted where there were features; beyond their hull it is extrapolated, and
//! no covariance knows how far it can be trusted there.

use super::lens::Scanner;
use crate::error::{Error, Result};
use crate::ground::threads;
use crate::ground::transform::Vec3;

/// Why a pixel that was decoded has no point: it lies outside the calibrated region. Continues [`crate::fringes::Reason`].
pub const OUTSIDE_CALIBRATION: u8 = 5;

/// A convex polygon in an image.
#[derive(Debug, Clone, PartialEq)]
pub struct Hull {
    /// Of each side, (a, b, c): a x + b y <= c inside.
    sides: Vec<[f64; 3]>,
}

impl Hull {
    /// From its corners in order, in either direction, px.
    ///
    /// # Errors
    /// [`Error::Shape`] for fewer than three corners, [`Error::NonFinite`], [`Error::OutOfRange`] where they are not those
    /// of a convex polygon in order.
    pub fn new(what: &'static str, corners: &[[f64; 2]]) -> Result<Self> {
        if corners.len() < 3 {
            let got = format!("{} corners", corners.len());
            return Err(Error::Shape { what, expected: "three corners at least".into(), got });
        }
        if let Some(index) = corners.iter().position(|c| !(c[0].is_finite() && c[1].is_finite())) {
            return Err(Error::NonFinite { what, index });
        }
        let after = |i: usize| corners[(i + 1) % corners.len()];
        let area: f64 = (0..corners.len()).map(|i| corners[i][0] * after(i)[1] - after(i)[0] * corners[i][1]).sum();
        let side = |i: usize| {
            let ([x, y], [p, q]) = (corners[i], after(i));
            let (a, b) = if area > 0.0 { (q - y, x - p) } else { (y - q, p - x) };
            [a, b, a * x + b * y]
        };
        let hull = Self { sides: (0..corners.len()).map(side).collect() };
        // Corners lie on sides of their own: rounding must not put them outside.
        let reach = corners.iter().flatten().fold(1.0_f64, |m, v| m.max(v.abs()));
        let convex = corners.iter().all(|&[x, y]| hull.beyond(x, y) <= 1e-9 * reach * reach);
        if area == 0.0 || !convex {
            let expected = "the corners of a convex polygon, in order".into();
            return Err(Error::OutOfRange { what, expected, value: format!("{corners:?}") });
        }
        Ok(hull)
    }

    /// By how much the worst side is passed, in units of its length; negative inside.
    fn beyond(&self, x: f64, y: f64) -> f64 {
        self.sides.iter().map(|[a, b, c]| a * x + b * y - c).fold(f64::NEG_INFINITY, f64::max)
    }

    /// Whether a place of the image lies within.
    #[inline]
    pub fn contains(&self, x: f64, y: f64) -> bool {
        self.sides.iter().all(|[a, b, c]| a * x + b * y <= *c)
    }
}

/// Which points, on the camera's pixel grid, lie outside the camera's or the projector's hull; never those that are NaN.
///
/// # Errors
/// [`Error::Shape`] where the points are not those of one image of the camera.
pub fn outside(points_mm: &[[f64; 3]], scanner: &Scanner, camera: &Hull, projector: &Hull) -> Result<Vec<bool>> {
    let width = scanner.camera.width;
    if points_mm.len() != width * scanner.camera.height {
        let expected = format!("{width} x {} points, the camera's pixels", scanner.camera.height);
        return Err(Error::Shape { what: "points_mm", expected, got: points_mm.len().to_string() });
    }
    let projector_from_camera = scanner.camera_from_projector.inverse();
    let one = |i: usize| {
        let point = points_mm[i];
        if point[2].is_nan() {
            return false;
        }
        let lit = scanner.projector.project(&projector_from_camera.apply(&Vec3::from(point)));
        let seen = camera.contains((i % width) as f64, (i / width) as f64);
        !(seen && lit.is_some_and(|(x, y)| projector.contains(x, y)))
    };
    Ok(threads::map_ranges(points_mm.len(), |range| range.map(one).collect::<Vec<_>>()).concat())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scanner::lens::tests::example;

    const SQUARE: [[f64; 2]; 4] = [[10.0, 20.0], [30.0, 20.0], [30.0, 50.0], [10.0, 50.0]];

    #[test]
    fn a_hull_holds_its_corners_whatever_their_direction() {
        let mut back = SQUARE;
        back.reverse();
        for corners in [SQUARE, back] {
            let hull = Hull::new("hull", &corners).unwrap();
            assert!(corners.iter().all(|&[x, y]| hull.contains(x, y)) && hull.contains(20.0, 30.0));
            for [x, y] in [[9.9, 30.0], [30.1, 30.0], [20.0, 19.9], [20.0, 50.1]] {
                assert!(!hull.contains(x, y), "{x} {y}");
            }
        }
        let crossed = [SQUARE[0], SQUARE[2], SQUARE[1], SQUARE[3]];
        let dented = [[0.0, 0.0], [9.0, 0.0], [9.0, 9.0], [5.0, 2.0]];
        for corners in [&crossed[..], &dented, &SQUARE[..2], &[[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]]] {
            assert!(Hull::new("hull", corners).is_err(), "{corners:?}");
        }
        assert!(Hull::new("hull", &[[0.0, 0.0], [1.0, f64::NAN], [0.0, 1.0]]).is_err());
    }

    #[test]
    fn points_are_outside_by_either_image() {
        let scanner = example();
        let (w, h) = (scanner.camera.width, scanner.camera.height);
        let whole = |w: f64, h: f64| Hull::new("hull", &[[-9.0, -9.0], [w, -9.0], [w, h], [-9.0, h]]).unwrap();
        let mut points = vec![[f64::NAN; 3]; w * h];
        for v in (0..h).step_by(7) {
            for u in (0..w).step_by(5) {
                let (x, y) = scanner.camera.undistort(u as f64, v as f64).unwrap();
                points[v * w + u] = [x * 420.0, y * 420.0, 420.0];
            }
        }
        let seen = scanner.project_to_projector(&points);
        let all = whole(1e5, 1e5);
        let half = (w as f64 / 2.0).floor();
        let left = outside(&points, &scanner, &whole(half, 1e5), &all).unwrap();
        // A column of the projector that splits what it lights.
        let mut columns: Vec<f64> = seen.iter().map(|p| p[0]).filter(|c| c.is_finite()).collect();
        columns.sort_by(f64::total_cmp);
        let middle = columns[columns.len() / 2] + 1e-6;
        let lit = outside(&points, &scanner, &all, &whole(middle, 1e5)).unwrap();
        for i in 0..w * h {
            let known = points[i][2].is_finite();
            assert_eq!(left[i], known && ((i % w) as f64 > half || seen[i][0].is_nan()), "{i}");
            assert_eq!(lit[i], known && (seen[i][0] > middle || seen[i][0].is_nan()), "{i}");
        }
        assert!(outside(&points[1..], &scanner, &all, &all).is_err());
    }
}
