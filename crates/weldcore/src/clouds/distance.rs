//! Signed distance to clouds, meshes and analytic surfaces.
//!
//! The sign: positive outside of a sphere or cylinder, in front of a mesh's faces, and on the side of a plane's or a
//! cloud's normals.

use multiversion::multiversion;
use rayon::prelude::*;

use crate::clouds::kdtree::{self, KdTree};
use crate::clouds::mesh::Mesh;
use crate::error::{Error, Result, require_finite};
use crate::ground::memory::require;
use crate::ground::stop::polled;
use crate::ground::threads;
use crate::surfaces::Surface;

/// Points handed to a thread at a time.
const CHUNK: usize = 4096;

/// What points are held against.
#[derive(Debug, Clone, Copy)]
pub enum Target<'a> {
    /// A cloud, and the unit normals of its points where there are any.
    Cloud(&'a KdTree, Option<&'a [[f64; 3]]>),
    /// A mesh.
    Mesh(&'a Mesh),
    /// An analytic surface.
    Surface(Surface),
}

/// The distance of each point from the target, mm; without `signed` its absolute value.
///
/// To a cloud it is the distance to the nearest point, with the sign of the side of that point's normal on which the
/// query lies. To a mesh it is as in [`Mesh::feet`]. To an analytic surface it is exact.
///
/// # Errors
/// [`Error::NonFinite`], [`Error::OutOfRange`] for coordinates too large to be squared, [`Error::Shape`] for normals
/// that are not those of the cloud, [`Error::Degenerate`] for signs from a cloud without normals or a mesh without sides.
pub fn distance(points: &[[f64; 3]], target: &Target, signed: bool) -> Result<Vec<f64>> {
    match target {
        Target::Cloud(tree, normals) => to_cloud(points, tree, *normals, signed),
        Target::Mesh(mesh) => mesh.distance(points, signed),
        Target::Surface(surface) => {
            require_finite("points", points)?;
            require(points.len(), 8);
            let mut distance = vec![0.0; points.len()];
            threads::install(|| {
                (points.par_chunks(CHUNK), distance.par_chunks_mut(CHUNK))
                    .into_par_iter()
                    .inspect(polled)
                    .for_each(|(points, distance)| to_surface(surface, signed, points, distance));
            });
            Ok(distance)
        }
    }
}

fn to_cloud(points: &[[f64; 3]], tree: &KdTree, normals: Option<&[[f64; 3]]>, signed: bool) -> Result<Vec<f64>> {
    let normals = match normals.filter(|_| signed) {
        None if signed => {
            let reason = "the sign needs the normals of the target's points".into();
            return Err(Error::Degenerate { what: "signed distance to a cloud", reason });
        }
        Some(n) if n.len() != tree.len() => {
            let (expected, got) = (format!("{} as in target", tree.len()), n.len().to_string());
            return Err(Error::Shape { what: "normals", expected, got });
        }
        Some(n) => n,
        None => {
            kdtree::require_range("points", points)?;
            return Ok(tree.nearest(points)?.0);
        }
    };
    tree.signed(points, normals)
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw", "x86_64+avx2"))]
fn to_surface(surface: &Surface, signed: bool, points: &[[f64; 3]], distance: &mut [f64]) {
    plain_to_surface(surface, signed, points, distance);
}

/// The body of [`to_surface`], and its fallback.
#[inline(always)]
fn plain_to_surface(surface: &Surface, signed: bool, points: &[[f64; 3]], distance: &mut [f64]) {
    // The match is outside of the loops, so that each of them is one formula for the vector unit.
    match surface {
        Surface::Plane(s) => each(points, distance, signed, |p| s.distance(p)),
        Surface::Sphere(s) => each(points, distance, signed, |p| s.distance(p)),
        Surface::Cylinder(s) => each(points, distance, signed, |p| s.distance(p)),
    }
}

#[inline(always)]
fn each(points: &[[f64; 3]], distance: &mut [f64], signed: bool, formula: impl Fn(&[f64; 3]) -> f64) {
    for (p, d) in points.iter().zip(distance.iter_mut()) {
        *d = formula(p);
    }
    if !signed {
        for d in distance {
            *d = d.abs();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clouds::mesh::tests::tube;
    use crate::ground::transform::Vec3;
    use crate::surfaces::{Cylinder, Plane, Sphere};

    fn queries() -> Vec<[f64; 3]> {
        let mut state = 1u64;
        let mut next = || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            ((state >> 11) as f64 / (1u64 << 53) as f64 - 0.5) * 40.0
        };
        (0..5000).map(|_| [next(), next(), next()]).collect()
    }

    /// Rounding of coordinates of some 10 mm.
    const ROUNDED: f64 = 1e-13;

    #[test]
    fn analytic_distances_are_those_of_their_feet() {
        let surfaces = [
            Surface::Plane(Plane::new([1.0, 2.0, 3.0], [1.0, -2.0, 0.5]).unwrap()),
            Surface::Sphere(Sphere::new([1.0, 2.0, 3.0], 7.0).unwrap()),
            Surface::Cylinder(Cylinder::new([1.0, 2.0, 3.0], [0.0, 3.0, 4.0], 7.0).unwrap()),
        ];
        for surface in surfaces {
            let signed = distance(&queries(), &Target::Surface(surface), true).unwrap();
            let plain = distance(&queries(), &Target::Surface(surface), false).unwrap();
            assert!(signed.iter().any(|&d| d < -1.0) && signed.iter().any(|&d| d > 1.0));
            for ((q, d), positive) in queries().iter().zip(signed).zip(plain) {
                let foot = surface.foot(&Vec3::from(*q));
                assert!((foot.distance - d).abs() < ROUNDED && positive == d.abs());
                // The foot lies on the surface, straight below the point.
                assert!(surface.foot(&foot.point).distance.abs() < ROUNDED);
                assert!((foot.point + foot.normal * foot.distance - Vec3::from(*q)).norm() < ROUNDED);
            }
        }
    }

    #[test]
    fn vectors_and_the_plain_fallback_give_the_same_bits() {
        for surface in [
            Surface::Plane(Plane::new([1.0, 2.0, 3.0], [1.0, -2.0, 0.5]).unwrap()),
            Surface::Sphere(Sphere::new([1.0, 2.0, 3.0], 7.0).unwrap()),
            Surface::Cylinder(Cylinder::new([1.0, 2.0, 3.0], [0.0, 3.0, 4.0], 7.0).unwrap()),
        ] {
            for signed in [true, false] {
                let (mut fast, mut plain) = (vec![0.0; 5000], vec![0.0; 5000]);
                to_surface(&surface, signed, &queries(), &mut fast);
                plain_to_surface(&surface, signed, &queries(), &mut plain);
                assert_eq!(fast, plain);
            }
        }
    }

    #[test]
    fn an_axis_and_a_centre_have_a_distance_too() {
        let sphere = Sphere::new([1.0, 0.0, 0.0], 2.0).unwrap();
        let cylinder = Cylinder::new([0.0; 3], [0.0, 0.0, 1e-200], 2.0).unwrap();
        assert_eq!(sphere.foot(&Vec3::new(1.0, 0.0, 0.0)).distance, -2.0);
        let foot = cylinder.foot(&Vec3::new(0.0, 0.0, 5.0));
        assert!(foot.distance == -2.0 && (foot.normal.norm() - 1.0).abs() < 1e-15 && foot.point.z == 5.0);
    }

    #[test]
    fn a_cloud_with_normals_has_sides() {
        let (vertices, triangles) = tube(400, 10.0, 30.0);
        let wall: Vec<[f64; 3]> = vertices[2..].iter().step_by(2).map(|v| [v[0], v[1], 0.0]).collect();
        let normals: Vec<[f64; 3]> = wall.iter().map(|v| [v[0] / 10.0, v[1] / 10.0, 0.0]).collect();
        let tree = KdTree::new(&wall).unwrap();
        let around: Vec<[f64; 3]> = queries().iter().map(|q| [q[0], q[1], 0.0]).collect();
        let signed = distance(&around, &Target::Cloud(&tree, Some(&normals)), true).unwrap();
        let plain = distance(&around, &Target::Cloud(&tree, None), false).unwrap();
        for ((q, d), positive) in around.iter().zip(signed).zip(plain) {
            let exact = q[0].hypot(q[1]) - 10.0;
            // The nearest point is up to 0.08 mm away along the circle.
            assert!(positive == d.abs() && (positive - exact.abs()) < 0.08 && positive >= exact.abs() - ROUNDED);
            assert!(exact.abs() < 1e-3 || d.signum() == exact.signum());
        }
        assert!(distance(&around, &Target::Cloud(&tree, None), true).is_err());
        assert!(distance(&around, &Target::Cloud(&tree, Some(&normals[1..])), true).is_err());
        let mesh = Mesh::new(&vertices, &triangles).unwrap();
        let to_mesh = distance(&[[0.0, 0.0, 15.0], [12.0, 0.0, 15.0]], &Target::Mesh(&mesh), true).unwrap();
        assert!((to_mesh[0] + 10.0).abs() < 0.001 && (to_mesh[1] - 2.0).abs() < 0.001);
    }

    #[test]
    fn what_has_no_distance_is_refused() {
        let plane = Target::Surface(Surface::Plane(Plane::new([0.0; 3], [1.0, 0.0, 0.0]).unwrap()));
        assert!(matches!(distance(&[[f64::NAN; 3]], &plane, true), Err(Error::NonFinite { .. })));
        assert!(distance(&[], &plane, true).unwrap().is_empty());
        assert!(matches!(Plane::new([0.0; 3], [0.0; 3]), Err(Error::Degenerate { .. })));
        assert!(matches!(Sphere::new([0.0; 3], -1.0), Err(Error::OutOfRange { .. })));
        assert!(matches!(Cylinder::new([0.0; 3], [f64::NAN; 3], 1.0), Err(Error::NonFinite { .. })));
    }
}
