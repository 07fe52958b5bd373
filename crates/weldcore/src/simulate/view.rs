//! What the rays of one shot's pixels find in a scene.

use rayon::prelude::*;

use super::photometry::Photometry;
use super::ray::{Hit, Ray};
use super::shapes::{Body, Shape};
use super::shot::{NOTHING, Sample};
use crate::ground::stop::polled;
use crate::ground::threads;
use crate::ground::transform::{Transform, Vec3};
use crate::scanner::Scanner;

/// Rows that one task casts.
pub(super) const BAND: usize = 8;
/// A shadow ray starts this far above the surface, mm, so that rounding does not let a surface shade itself.
const LIFT_MM: f64 = 1e-3;
/// Neighbours whose depths differ by more than this share of the depth lie on different surfaces.
const EDGE: f64 = 0.004;

/// The scene as one shot sees it.
pub(super) struct ShotView<'a> {
    scanner: &'a Scanner,
    projector_from_camera: Transform,
    photometry: &'a Photometry,
    bodies: Vec<PlacedBody<'a>>,
}

struct PlacedBody<'a> {
    body: &'a Body,
    body_from_camera: Transform,
    /// The body's origin in the camera's frame.
    centre: Vec3,
    bound_squared: f64,
}

impl PlacedBody<'_> {
    /// Whether a ray (camera's frame) comes near enough to be worth the closed form.
    #[inline]
    fn near(&self, ray: &Ray) -> bool {
        let to = self.centre - ray.origin;
        let along = to.dot(&ray.direction);
        to.norm_squared() - along * along / ray.direction.norm_squared() <= self.bound_squared
    }
}

impl<'a> ShotView<'a> {
    pub(super) fn new(
        scanner: &'a Scanner,
        scene_from_camera: &Transform,
        bodies: &'a [Body],
        photometry: &'a Photometry,
    ) -> Self {
        let place = |body: &'a Body| {
            let body_from_camera = body.scene_from_body.inverse() * *scene_from_camera;
            let bound = body.bound_mm() + 1e-6;
            let centre = body_from_camera.inverse().translation;
            PlacedBody { body, body_from_camera, centre, bound_squared: bound * bound }
        };
        Self {
            scanner,
            projector_from_camera: scanner.camera_from_projector.inverse(),
            photometry,
            bodies: bodies.iter().map(place).collect(),
        }
    }

    fn first_hit(&self, ray: &Ray) -> Option<(&PlacedBody<'a>, Hit)> {
        let mut best: Option<(&PlacedBody<'a>, Hit)> = None;
        for placed in self.bodies.iter().filter(|b| b.near(ray)) {
            if let Some(hit) = placed.body.hit(&ray.seen_from(&placed.body_from_camera), 0.0)
                && best.as_ref().is_none_or(|(_, found)| hit.t < found.t)
            {
                best = Some((placed, hit));
            }
        }
        best
    }

    fn shadowed(&self, from: Vec3, to: Vec3) -> bool {
        let ray = Ray { origin: from, direction: to - from };
        self.bodies
            .iter()
            .filter(|b| b.near(&ray))
            .any(|placed| placed.body.hit(&ray.seen_from(&placed.body_from_camera), 0.0).is_some_and(|hit| hit.t < 1.0))
    }

    /// What the ray along (x, y, 1) finds.
    pub(super) fn sample(&self, x: f64, y: f64) -> Sample {
        let ray = Ray { origin: Vec3::zeros(), direction: Vec3::new(x, y, 1.0) };
        // A pixel beyond the lens's fold has no direction.
        let Some((placed, hit)) = (x.is_finite() && y.is_finite()).then(|| self.first_hit(&ray)).flatten() else {
            return NOTHING;
        };
        let body = placed.body;
        let p = ray.at(hit.t);
        let in_body = placed.body_from_camera.apply(&p);
        let normal = placed.body_from_camera.rotation.transpose() * hit.normal;
        let albedo = body.albedo(&in_body);
        let mut sample = Sample {
            depth_mm: p.z,
            ambient: (self.photometry.ambient * albedo) as f32,
            label: body.label.saturating_add(hit.part),
            ..NOTHING
        };
        let lamp = self.scanner.camera_from_projector.translation;
        let to_lamp = lamp - p;
        let facing = normal.dot(&to_lamp) / to_lamp.norm();
        if facing <= 0.0 {
            return sample;
        }
        let projector = &self.scanner.projector;
        let Some((column, row)) = projector.project(&self.projector_from_camera.apply(&p)) else { return sample };
        if !projector.contains(column, row) || self.shadowed(p + normal * LIFT_MM, lamp) {
            return sample;
        }
        (sample.column_px, sample.row_px) = (column, row);
        let halfway = (to_lamp.normalize() - p.normalize()).normalize();
        let gloss = body.surface.specular * normal.dot(&halfway).max(0.0).powf(body.surface.shininess);
        let falloff = self.photometry.distance_mm.powi(2) / to_lamp.norm_squared();
        sample.direct = (self.photometry.lamp * falloff * (albedo * facing + gloss)) as f32;
        if let Shape::Weld(weld) = &body.shape
            && hit.part < 2
        {
            sample.along = weld.along(&in_body);
            if hit.part == 1 {
                sample.deviation_mm = weld.step_at(&in_body);
            }
        }
        sample
    }
}

/// The four rays of each pixel on an edge, in the order of the pixels.
pub(super) fn antialias(scanner: &Scanner, view: &ShotView<'_>, samples: &[Sample]) -> Vec<(usize, [Sample; 4])> {
    let camera = &scanner.camera;
    let differ = |a: &Sample, b: &Sample| {
        let lit = a.column_px.is_nan() != b.column_px.is_nan();
        lit || a.label != b.label || (a.depth_mm - b.depth_mm).abs() > EDGE * a.depth_mm
    };
    let row = |v: usize| {
        let at = |u: usize, v: usize| samples.get(v * camera.width + u);
        let is_edge = move |u: &usize| {
            let Some(here) = at(*u, v) else { return false };
            let beside = [(u.wrapping_sub(1), v), (u + 1, v), (*u, v.wrapping_sub(1)), (*u, v + 1)];
            let inside = beside.into_iter().filter(|&(u, v)| u < camera.width && v < camera.height);
            inside.filter_map(|(u, v)| at(u, v)).any(|there| differ(here, there))
        };
        (0..camera.width).filter(is_edge).map(move |u| {
            let rays = [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)];
            let cast =
                |(du, dv)| camera.undistort(u as f64 + du, v as f64 + dv).map_or(NOTHING, |(x, y)| view.sample(x, y));
            (v * camera.width + u, rays.map(cast))
        })
    };
    threads::install(|| {
        (0..camera.height).into_par_iter().with_min_len(BAND).inspect(polled).flat_map_iter(row).collect()
    })
}
