//! The scanner: a camera and a projector, each a pinhole with a lens, and where the one stands from the other.
//!
//! Both devices follow OpenCV's model: a direction `(x, y, 1)` is distorted to
//! `x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2 x²)`, `y'` alike, and imaged at
//! `u = fx x' + cx`, `v = fy y' + cy`; the centre of the first pixel is (0, 0). A projector is a camera that is used
//! backwards. The scanner's frame is its camera's.

use std::sync::{Arc, Mutex};

use rayon::prelude::*;

use crate::error::{Error, Result, require_positive};
use crate::ground::memory::require;
use crate::ground::stop::polled;
use crate::ground::threads;
use crate::ground::transform::Transform;
use crate::ground::transform::Vec3;

/// Newton on the lens stops at a residual below this, in normalised coordinates (3e-9 px at f = 3000).
const CONVERGED: f64 = 1e-12;
/// Newton doubles the digits each time: a lens that needs more than this folds.
const MAX_ITERATIONS: usize = 30;
/// Images larger than this on a side are a mistake in the file.
const MAX_SIDE: usize = 1 << 16;

/// A pinhole with a lens, camera or projector.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lens {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Focal length along a row, px.
    pub fx: f64,
    /// Focal length along a column, px.
    pub fy: f64,
    /// Principal point, px.
    pub cx: f64,
    /// Principal point, px.
    pub cy: f64,
    /// k1, k2, p1, p2, k3 as in OpenCV.
    pub dist: [f64; 5],
}

impl Lens {
    /// A lens from its image size, focal lengths, principal point and distortion k1 k2 p1 p2 k3.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for an empty or absurd size or a focal length that is not above zero,
    /// [`Error::NonFinite`] for the rest.
    pub fn new(width: usize, height: usize, focal: [f64; 2], centre: [f64; 2], dist: [f64; 5]) -> Result<Self> {
        for (what, side) in [("lens width", width), ("lens height", height)] {
            if !(1..=MAX_SIDE).contains(&side) {
                let expected = format!("1 to {MAX_SIDE} px");
                return Err(Error::OutOfRange { what, expected, value: side.to_string() });
            }
        }
        require_positive("focal length fx", focal[0])?;
        require_positive("focal length fy", focal[1])?;
        if let Some(index) = centre.iter().chain(&dist).position(|v| !v.is_finite()) {
            return Err(Error::NonFinite { what: "lens (cx, cy, k1, k2, p1, p2, k3)", index });
        }
        Ok(Self { width, height, fx: focal[0], fy: focal[1], cx: centre[0], cy: centre[1], dist })
    }

    /// Where the lens sends the normalised direction (x, y, 1), in normalised coordinates.
    #[inline]
    pub fn distort(&self, x: f64, y: f64) -> (f64, f64) {
        let [k1, k2, p1, p2, k3] = self.dist;
        let (xx, xy, yy) = (x * x, x * y, y * y);
        let r2 = xx + yy;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        (x * radial + 2.0 * p1 * xy + p2 * (r2 + 2.0 * xx), y * radial + p1 * (r2 + 2.0 * yy) + 2.0 * p2 * xy)
    }

    /// The derivative of [`Self::distort`]: (dx'/dx, dx'/dy, dy'/dy). It is symmetric: dy'/dx = dx'/dy.
    #[inline]
    pub fn distort_jacobian(&self, x: f64, y: f64) -> (f64, f64, f64) {
        let [k1, k2, p1, p2, k3] = self.dist;
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3));
        (
            radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
            x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y,
            radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
        )
    }

    /// The pixel of a point in the device's own frame; `None` behind the device, and so far off the axis that the
    /// distortion polynomial folds back. The pixel may lie outside the image.
    #[inline]
    pub fn project(&self, p: &Vec3) -> Option<(f64, f64)> {
        if p.z.is_nan() || p.z <= 0.0 {
            return None;
        }
        let (x, y) = (p.x / p.z, p.y / p.z);
        let (a, b, d) = self.distort_jacobian(x, y);
        let (xd, yd) = self.distort(x, y);
        (a * d - b * b > 0.0 && a + d > 0.0).then_some((self.fx * xd + self.cx, self.fy * yd + self.cy))
    }

    /// The normalised direction (x, y, 1) that is imaged at pixel (u, v): Newton to 1e-12; `None` where the lens has
    /// no such direction.
    #[inline]
    pub fn undistort(&self, u: f64, v: f64) -> Option<(f64, f64)> {
        let (xd, yd) = ((u - self.cx) / self.fx, (v - self.cy) / self.fy);
        let (mut x, mut y) = (xd, yd);
        for _ in 0..MAX_ITERATIONS {
            let (fx, fy) = self.distort(x, y);
            let (ex, ey) = (fx - xd, fy - yd);
            let (a, b, d) = self.distort_jacobian(x, y);
            let det = a * d - b * b;
            // Beyond the fold the polynomial runs backwards: no direction there is real.
            if !(det > 0.0 && a + d > 0.0) {
                return None;
            }
            x -= (d * ex - b * ey) / det;
            y -= (a * ey - b * ex) / det;
            if ex.abs().max(ey.abs()) < CONVERGED {
                return Some((x, y));
            }
        }
        None
    }

    /// [`Self::project`] of many points; NaN where there is no pixel.
    pub fn project_all(&self, points: &[[f64; 3]]) -> Vec<[f64; 2]> {
        pairs(points, |p| self.project(&Vec3::from(*p)))
    }

    /// [`Self::undistort`] of many pixels; NaN where there is no direction.
    pub fn undistort_all(&self, pixels: &[[f64; 2]]) -> Vec<[f64; 2]> {
        pairs(pixels, |&[u, v]| self.undistort(u, v))
    }

    /// Whether pixel (u, v) lies in the image, borders of the outer pixels included.
    #[inline]
    pub fn contains(&self, u: f64, v: f64) -> bool {
        u >= -0.5 && v >= -0.5 && u <= self.width as f64 - 0.5 && v <= self.height as f64 - 0.5
    }
}

fn pairs<T: Sync>(items: &[T], of: impl Fn(&T) -> Option<(f64, f64)> + Sync) -> Vec<[f64; 2]> {
    let pair = |item: &T| of(item).map_or([f64::NAN; 2], |(a, b)| [a, b]);
    require(items.len(), 40);
    threads::map_chunks(items, |_, chunk| chunk.iter().map(pair).collect::<Vec<_>>()).concat()
}

/// The direction of every pixel of a camera: x and y of (x, y, 1), row-major; NaN where the lens has none.
#[derive(Debug, PartialEq)]
pub struct Rays {
    /// x of each pixel.
    pub x: Vec<f64>,
    /// y of each pixel.
    pub y: Vec<f64>,
}

impl Rays {
    fn of(lens: &Lens) -> Self {
        require(lens.width * lens.height, 40);
        let row = |v: usize| -> (Vec<f64>, Vec<f64>) {
            let direction = |u: usize| lens.undistort(u as f64, v as f64).unwrap_or((f64::NAN, f64::NAN));
            (0..lens.width).map(direction).unzip()
        };
        let rows: Vec<_> = threads::install(|| (0..lens.height).into_par_iter().inspect(polled).map(row).collect());
        let (x, y): (Vec<_>, Vec<_>) = rows.into_iter().unzip();
        Self { x: x.concat(), y: y.concat() }
    }
}

/// Which way the fringes run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Axis {
    /// Along x: the phase gives the projector's column.
    X,
    /// Along y: the phase gives the projector's row.
    Y,
}

/// A camera and a projector. Points are in the camera's frame.
#[derive(Debug)]
pub struct Scanner {
    /// The camera.
    pub camera: Lens,
    /// The projector, a camera used backwards.
    pub projector: Lens,
    /// Maps projector coordinates to camera coordinates.
    pub camera_from_projector: Transform,
    rays: Mutex<Option<(Lens, Arc<Rays>)>>,
}

impl Clone for Scanner {
    fn clone(&self) -> Self {
        Self {
            rays: Mutex::new(self.kept_rays()),
            ..Self::bare(self.camera, self.projector, self.camera_from_projector)
        }
    }
}

impl Scanner {
    fn bare(camera: Lens, projector: Lens, camera_from_projector: Transform) -> Self {
        Self { camera, projector, camera_from_projector, rays: Mutex::new(None) }
    }

    /// A scanner from its parts.
    ///
    /// # Errors
    /// [`Error::Degenerate`] where camera and projector stand in the same place: nothing can be triangulated then.
    pub fn new(camera: Lens, projector: Lens, camera_from_projector: Transform) -> Result<Self> {
        if camera_from_projector.translation.norm() <= 0.0 {
            let reason = "camera and projector stand in the same place".into();
            return Err(Error::Degenerate { what: "scanner", reason });
        }
        Ok(Self::bare(camera, projector, camera_from_projector))
    }

    /// The projector pixels that light points of the camera's frame; NaN where there is none.
    pub fn project_to_projector(&self, points: &[[f64; 3]]) -> Vec<[f64; 2]> {
        let projector_from_camera = self.camera_from_projector.inverse();
        pairs(points, |p| self.projector.project(&projector_from_camera.apply(&Vec3::from(*p))))
    }

    /// The direction of every camera pixel; computed once and kept, for a scan asks for it with every shot.
    pub fn camera_rays(&self) -> Arc<Rays> {
        match self.kept_rays() {
            Some((lens, rays)) if lens == self.camera => rays,
            _ => {
                let rays = Arc::new(Rays::of(&self.camera));
                if let Ok(mut kept) = self.rays.try_lock() {
                    *kept = Some((self.camera, rays.clone()));
                }
                rays
            }
        }
    }

    /// What is kept. A lock that another thread holds, perhaps one that a fork has cut off, is not waited for.
    fn kept_rays(&self) -> Option<(Lens, Arc<Rays>)> {
        self.rays.try_lock().ok()?.clone()
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use nalgebra::Rotation3;
    use proptest::prelude::*;

    /// A scanner as they are built: strong lenses, a projector with pixels that are not square, a slanted baseline.
    pub(crate) fn example() -> Scanner {
        let camera = Lens::new(320, 240, [776.0, 777.0], [158.0, 122.0], [-0.21, 0.35, -0.0007, 0.0005, 0.02]).unwrap();
        let projector = Lens::new(912, 1140, [1640.0, 3280.0], [455.5, 610.0], [-0.05, 0.04, 6e-4, -2e-4, 0.0]);
        let pose = Transform {
            rotation: *Rotation3::from_euler_angles(0.03, -0.36, 0.02).matrix(),
            translation: Vec3::new(165.0, -12.0, 8.0),
        };
        Scanner::new(camera, projector.unwrap(), pose).unwrap()
    }

    #[test]
    fn a_pinhole_projects_by_similar_triangles() {
        let lens = Lens::new(640, 480, [500.0, 400.0], [320.0, 240.0], [0.0; 5]).unwrap();
        assert_eq!(lens.project(&Vec3::new(1.0, -2.0, 10.0)), Some((370.0, 160.0)));
        assert_eq!(lens.project(&Vec3::new(1.0, -2.0, -10.0)), None);
        assert_eq!(lens.project(&Vec3::new(1.0, -2.0, 0.0)), None);
    }

    #[test]
    fn distortion_is_opencvs() {
        // Written out term by term from OpenCV's documentation; the Python tests compare with cv2 itself.
        let lens = Lens::new(10, 10, [1.0; 2], [0.0; 2], [0.1, -0.2, 0.01, 0.02, 0.3]).unwrap();
        let (x, y) = lens.distort(0.3, -0.2);
        let r2: f64 = 0.13;
        let radial = 1.0 + 0.1 * r2 - 0.2 * r2.powi(2) + 0.3 * r2.powi(3);
        assert!((x - (0.3 * radial + 2.0 * 0.01 * -0.06 + 0.02 * (r2 + 0.18))).abs() < 1e-15);
        assert!((y - (-0.2 * radial + 0.01 * (r2 + 0.08) + 2.0 * 0.02 * -0.06)).abs() < 1e-15);
    }

    #[test]
    fn the_jacobian_is_the_difference_quotient() {
        let lens = example().camera;
        let (x, y, h) = (0.15, -0.12, 1e-6);
        let (a, b, d) = lens.distort_jacobian(x, y);
        let along_x = (lens.distort(x + h, y), lens.distort(x - h, y));
        let along_y = (lens.distort(x, y + h), lens.distort(x, y - h));
        assert!((a - (along_x.0.0 - along_x.1.0) / (2.0 * h)).abs() < 1e-9);
        assert!((b - (along_x.0.1 - along_x.1.1) / (2.0 * h)).abs() < 1e-9);
        assert!((b - (along_y.0.0 - along_y.1.0) / (2.0 * h)).abs() < 1e-9);
        assert!((d - (along_y.0.1 - along_y.1.1) / (2.0 * h)).abs() < 1e-9);
    }

    proptest! {
        #[test]
        fn undistort_undoes_project(u in -20.0..340.0, v in -20.0..260.0) {
            let lens = example().camera;
            let (x, y) = lens.undistort(u, v).unwrap();
            let (u2, v2) = lens.project(&Vec3::new(3.0 * x, 3.0 * y, 3.0)).unwrap();
            prop_assert!((u - u2).abs() < 1e-9 && (v - v2).abs() < 1e-9);
        }

        #[test]
        fn no_input_panics(f in prop::num::f64::ANY, k in prop::num::f64::ANY, u in prop::num::f64::ANY) {
            if let Ok(lens) = Lens::new(10, 10, [f, 1.0], [k, 0.0], [k, u, f, k, u]) {
                let _ = lens.undistort(u, k);
                let _ = lens.project(&Vec3::new(u, k, f));
            }
        }
    }

    #[test]
    fn a_fold_has_no_direction() {
        // r (1 - r²) never exceeds 0.385: nothing is imaged beyond.
        let lens = Lens::new(100, 100, [100.0; 2], [50.0; 2], [-1.0, 0.0, 0.0, 0.0, 0.0]).unwrap();
        assert!(lens.undistort(50.0 + 38.0, 50.0).is_some());
        assert!(lens.undistort(50.0 + 39.0, 50.0).is_none());
        assert!(lens.project(&Vec3::new(0.7, 0.0, 1.0)).is_none());
    }

    #[test]
    fn rays_are_kept_and_follow_the_camera() {
        let mut scanner = example();
        let rays = scanner.camera_rays();
        assert!(Arc::ptr_eq(&rays, &scanner.camera_rays()));
        assert!(Arc::ptr_eq(&rays, &scanner.clone().camera_rays()));
        let at = 100 * 320 + 17;
        assert_eq!(scanner.camera.undistort(17.0, 100.0), Some((rays.x[at], rays.y[at])));
        scanner.camera.fx += 1.0;
        assert_ne!(*scanner.camera_rays(), *rays);
    }

    #[test]
    fn impossible_lenses_are_refused() {
        assert!(matches!(Lens::new(0, 5, [1.0; 2], [0.0; 2], [0.0; 5]), Err(Error::OutOfRange { .. })));
        assert!(matches!(Lens::new(5, 5, [-1.0, 1.0], [0.0; 2], [0.0; 5]), Err(Error::OutOfRange { .. })));
        assert!(matches!(Lens::new(5, 5, [1.0; 2], [f64::NAN, 0.0], [0.0; 5]), Err(Error::NonFinite { .. })));
        let s = example();
        let same_place = Transform { translation: Vec3::zeros(), ..s.camera_from_projector };
        assert!(matches!(Scanner::new(s.camera, s.projector, same_place), Err(Error::Degenerate { .. })));
    }
}
