//! Which pixels look at a sphere: the rays that meet the part of it that is seen and lit squarely enough.
//!
//! The cap is the cone of 60° about the line of sight, as `find_spheres` has it and ASTM E3125 evaluates scanned spheres:
//! beyond it light falls and is seen too obliquely. A pixel belongs to the sphere that its ray meets first.

use super::lens::Lens;
use crate::error::{Result, require_finite, require_positive};
use crate::ground::threads;
use crate::ground::transform::Vec3;

/// Cosine of the cone's half angle.
pub const CAP_COS: f64 = 0.5;
/// The outline is a little wider than `f R / z`; a lens stretches it by less than the rest.
const OUTLINE: f64 = 1.5;

/// The pixels of one cap.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SphereCap {
    /// Those inside the image and not behind another sphere, ascending (`row * width + column`).
    pub pixels: Vec<usize>,
    /// Per pixel, the unit vector from the centre to where the ray meets the sphere.
    pub outward: Vec<[f64; 3]>,
    /// How many the cap has, those beyond the image's edge and behind other spheres with it.
    pub whole: usize,
}

/// The caps of spheres of one radius, in the camera's frame.
///
/// # Errors
/// [`Error::NonFinite`](crate::Error::NonFinite), [`Error::OutOfRange`](crate::Error::OutOfRange) for the radius.
pub fn sphere_caps(camera: &Lens, centres_mm: &[[f64; 3]], radius_mm: f64) -> Result<Vec<SphereCap>> {
    require_finite("centres_mm", centres_mm)?;
    require_positive("radius_mm", radius_mm)?;
    let centres: Vec<Vec3> = centres_mm.iter().map(|c| Vec3::from(*c)).collect();
    Ok((0..centres.len()).map(|k| cap(camera, &centres, k, radius_mm)).collect())
}

fn cap(camera: &Lens, centres: &[Vec3], which: usize, radius: f64) -> SphereCap {
    let centre = centres[which];
    let Some((u, v)) = camera.project(&centre) else { return SphereCap::default() };
    let reach = OUTLINE * radius * camera.fx / centre.z.max(radius);
    let span = |middle: f64| (middle - reach).floor() as i64..(middle + reach).ceil() as i64 + 1;
    let (columns, sight) = (span(u), -centre / centre.norm());
    let rows: Vec<i64> = span(v).collect();
    let parts = threads::map_each(&rows, |&row| {
        let mut part = SphereCap::default();
        for column in columns.clone() {
            let Some((x, y)) = camera.undistort(column as f64, row as f64) else { continue };
            let ray = Vec3::new(x, y, 1.0).normalize();
            let met = first_hit(&ray, &centre, radius).map(|depth| (depth, (ray * depth - centre) / radius));
            let Some((depth, outward)) = met.filter(|(_, outward)| outward.dot(&sight) >= CAP_COS) else { continue };
            part.whole += 1;
            let before = |(k, other): (usize, &Vec3)| {
                k != which && first_hit(&ray, other, radius).is_some_and(|nearer| nearer <= depth)
            };
            let inside = (0..camera.width as i64).contains(&column) && (0..camera.height as i64).contains(&row);
            if inside && !centres.iter().enumerate().any(before) {
                part.pixels.push(row as usize * camera.width + column as usize);
                part.outward.push(outward.into());
            }
        }
        part
    });
    let mut all = SphereCap::default();
    for part in parts {
        all.pixels.extend(part.pixels);
        all.outward.extend(part.outward);
        all.whole += part.whole;
    }
    all
}

/// Depth at which a unit ray from the origin enters a sphere before it.
fn first_hit(ray: &Vec3, centre: &Vec3, radius: f64) -> Option<f64> {
    let along = ray.dot(centre);
    let square = along * along - centre.norm_squared() + radius * radius;
    (square > 0.0).then(|| along - square.sqrt()).filter(|depth| *depth > 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cap_is_what_is_seen_of_a_sphere_before_others_and_inside_the_image() {
        let camera = Lens::new(640, 480, [1300.0, 1300.0], [320.0, 240.0], [-0.1, 0.1, 0.0, 0.0, 0.0]).unwrap();
        let edge = (-0.5 - camera.cx) / camera.fx * 400.0;
        let centres = [[0.0, 0.0, 400.0], [10.0, 0.0, 460.0], [edge, 0.0, 400.0], [0.0, 0.0, -400.0]];
        let found = sphere_caps(&camera, &centres, 10.0).unwrap();
        let [whole, hidden, cut, behind] = found.as_slice() else { panic!() };
        assert!(whole.pixels.len() == whole.whole && whole.pixels.is_sorted());
        // Orthographic area of the cap: pi (R sin 60)², in pixels of z / f; seen in perspective a little more.
        let area = std::f64::consts::PI * (8.66 * camera.fx / 400.0_f64).powi(2);
        assert!((whole.whole as f64 / area - 1.0).abs() < 0.05);
        for n in &whole.outward {
            assert!((Vec3::from(*n).norm() - 1.0).abs() < 1e-12 && n[2] <= -0.49);
        }
        let part = |cap: &SphereCap| cap.pixels.len() as f64 / cap.whole as f64;
        assert!((0.3..0.7).contains(&part(hidden)) && (0.4..0.6).contains(&part(cut)));
        assert!(!hidden.pixels.iter().any(|k| whole.pixels.contains(k)));
        assert_eq!(*behind, SphereCap::default());
        assert!(sphere_caps(&camera, &[[f64::NAN; 3]], 10.0).is_err() && sphere_caps(&camera, &[], 0.0).is_err());
    }
}
