//! Every source point's partner on the target.

use multiversion::multiversion;

use crate::clouds::kdtree::{Aside, Followed, KdTree};
use crate::clouds::mesh::Mesh;
use crate::ground::transform::{Transform, Vec3};
use crate::surfaces::Surface;

/// A moved source point's partner.
#[derive(Clone, Copy, Default)]
pub(super) struct Match {
    pub(super) point: Vec3,
    /// The target's normal there; zero for metric point.
    pub(super) normal: Vec3,
    /// Between the two, mm.
    pub(super) distance: f64,
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw", "x86_64+avx2"))]
pub(super) fn to_cloud(
    tree: &KdTree,
    normals: Option<&[[f64; 3]]>,
    pose: &Transform,
    source: &[[f64; 3]],
    steps: &mut [Followed],
    matches: &mut [Match],
) {
    plain_to_cloud(tree, normals, pose, source, steps, matches);
}

/// The body of [`to_cloud`], and its fallback.
#[inline(always)]
pub(super) fn plain_to_cloud(
    tree: &KdTree,
    normals: Option<&[[f64; 3]]>,
    pose: &Transform,
    source: &[[f64; 3]],
    steps: &mut [Followed],
    matches: &mut [Match],
) {
    let mut aside = Aside::new();
    for ((p, step), found) in source.iter().zip(steps).zip(matches) {
        let moved = pose.apply(&as_vector(p));
        found.distance = tree.follow(&[moved.x, moved.y, moved.z], step, &mut aside).sqrt();
        found.point = step.point.into();
        if let Some(normal) = normals.and_then(|n| n.get(step.index as usize)) {
            found.normal = as_vector(normal);
            if normal[0].is_nan() {
                found.distance = f64::INFINITY;
            }
        }
    }
}

pub(super) fn to_mesh(mesh: &Mesh, pose: &Transform, source: &[[f64; 3]], matches: &mut [Match]) {
    let moved: Vec<[f64; 3]> = source.iter().map(|p| pose.apply(&as_vector(p)).into()).collect();
    mesh.each_near(&moved, matches, |m, foot| {
        *m = Match { point: foot.point, normal: foot.normal, distance: foot.distance };
    });
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw", "x86_64+avx2"))]
pub(super) fn to_surface(surface: &Surface, pose: &Transform, source: &[[f64; 3]], matches: &mut [Match]) {
    plain_to_surface(surface, pose, source, matches);
}

/// The body of [`to_surface`], and its fallback.
#[inline(always)]
pub(super) fn plain_to_surface(surface: &Surface, pose: &Transform, source: &[[f64; 3]], matches: &mut [Match]) {
    for (p, found) in source.iter().zip(matches) {
        let foot = surface.foot(&pose.apply(&as_vector(p)));
        *found = Match { point: foot.point, normal: foot.normal, distance: foot.distance.abs() };
    }
}

#[inline(always)]
pub(super) fn as_vector(p: &[f64; 3]) -> Vec3 {
    Vec3::new(p[0], p[1], p[2])
}
