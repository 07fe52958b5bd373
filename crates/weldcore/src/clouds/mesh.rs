//! Triangle meshes, and the only file that knows parry.
//!
//! parry merges vertices, finds which triangles share an edge, makes the angle-weighted normals of edges and vertices,
//! and projects a point on a triangle. The search for the triangle is ours: the tree of boxes that the k-d tree uses.
//!
//! The sign of a distance is that of the side of the nearest face, edge or vertex. Source: Bærentzen & Aanæs, Signed
//! distance computation using the angle weighted pseudonormal, IEEE TVCG 11 (2005) 243.

use multiversion::multiversion;
use parry3d_f64::math::Vector;
use parry3d_f64::query::PointQueryWithLocation;
use parry3d_f64::shape::{TriMesh, TriMeshFlags, Triangle, TrianglePointLocation};
use rayon::prelude::*;

use crate::clouds::kdtree::{Aside, BoxTree, Extent, Item, Visit, WIDTH, at_most, for_chunks, max, min, order};
use crate::error::{Error, Result, require_count, require_finite};
use crate::ground::memory::require;
use crate::ground::stop::{poll, polled};
use crate::ground::threads;
use crate::ground::transform::Vec3;
use crate::surfaces::Foot;

/// Coordinates beyond this would overflow in the products of a projection.
pub const LARGEST_COORDINATE: f64 = 1e60;

/// Points handed to a thread at a time.
const CHUNK: usize = 1024;

/// A surface of triangles.
#[derive(Clone)]
pub struct Mesh {
    boxes: BoxTree,
    /// The faces eight by eight, coordinate by coordinate, to find the nearest.
    leaves: Vec<TriangleLeaf>,
    /// In the tree's order.
    faces: Vec<Face>,
    vertices: usize,
    flat: usize,
    open_edges: usize,
    /// Why there is no inside and outside, where there is none.
    unoriented: Option<String>,
}

/// A triangle with all that a signed distance needs.
#[derive(Clone)]
struct Face {
    triangle: Triangle,
    /// Unit normal.
    normal: Vector,
    /// Sums of the normals around the edges ab, bc, ca and the corners a, b, c; zero on the rim of an open mesh.
    edges: [Vector; 3],
    corners: [Vector; 3],
}

impl Mesh {
    /// A mesh of vertices and triangles of their indices, counter-clockwise seen from outside.
    ///
    /// Vertices at the same place are taken for one. Triangles without an area do not count.
    ///
    /// # Errors
    /// [`Error::TooFew`] without vertices or triangles, [`Error::NonFinite`], [`Error::OutOfRange`] for coordinates
    /// beyond [`LARGEST_COORDINATE`] or an index without a vertex, [`Error::Degenerate`] where no triangle has an area.
    pub fn new(vertices: &[[f64; 3]], triangles: &[[u32; 3]]) -> Result<Self> {
        require_count("vertices", 3, vertices.len())?;
        require_count("triangles", 1, triangles.len())?;
        require_range("vertices", vertices)?;
        let what = "triangles";
        if let Some(wrong) = triangles.iter().flatten().find(|&&i| i as usize >= vertices.len()) {
            let expected = format!("indices below the {} vertices", vertices.len());
            return Err(Error::OutOfRange { what, expected, value: wrong.to_string() });
        }
        let no_area = || Error::Degenerate { what: "mesh", reason: "no triangle has an area".into() };
        let at = |i: u32| Vector::from_array(vertices[i as usize]);
        if !triangles.iter().any(|t| Triangle::new(at(t[0]), at(t[1]), at(t[2])).normal().is_some()) {
            return Err(no_area());
        }
        require(vertices.len() + triangles.len(), 800);
        let points = vertices.iter().map(|&v| Vector::from_array(v)).collect();
        let given = triangles.to_vec();
        let (mesh, unoriented) = threads::left_to_itself(move || {
            let mut mesh = TriMesh::new(points, given).ok()?;
            // One after the other: merging first, so that the others see the merged vertices.
            let _ = mesh.set_flags(TriMeshFlags::DELETE_DEGENERATE_TRIANGLES | TriMeshFlags::MERGE_DUPLICATE_VERTICES);
            let topology = mesh.set_flags(mesh.flags() | TriMeshFlags::HALF_EDGE_TOPOLOGY | TriMeshFlags::ORIENTED);
            Some((mesh, topology.err().map(|_| "two triangles run along an edge in the same direction".to_string())))
        })
        .ok_or_else(no_area)?;
        Self::from_parry(&mesh, vertices.len(), triangles.len(), unoriented).ok_or_else(no_area)
    }

    fn from_parry(mesh: &TriMesh, vertices: usize, triangles: usize, unoriented: Option<String>) -> Option<Self> {
        let normals = mesh.pseudo_normals()?;
        let half_edges = mesh.topology().map_or(&[][..], |t| &t.half_edges);
        // The rim: half-edges without a twin, and the vertices at their ends.
        let on_rim: Vec<bool> = half_edges.iter().map(|e| e.twin == u32::MAX).collect();
        let mut at_rim = vec![false; mesh.vertices().len()];
        for (t, corners) in mesh.indices().iter().enumerate() {
            for k in 0..3 {
                if on_rim.get(3 * t + k).is_some_and(|&rim| rim) {
                    for v in [corners[k], corners[(k + 1) % 3]] {
                        *at_rim.get_mut(v as usize)? = true;
                    }
                }
            }
        }
        let mut faces = Vec::with_capacity(mesh.indices().len());
        for (t, corners) in mesh.indices().iter().enumerate() {
            poll();
            let triangle = mesh.triangle(t as u32);
            let Some(normal) = triangle.normal() else { continue };
            let edge = |k: usize| {
                let rim = on_rim.get(3 * t + k).is_some_and(|&rim| rim);
                if rim { Vector::ZERO } else { normals.edges_pseudo_normal.get(t).map_or(normal, |e| e[k]) }
            };
            let corner = |k: usize| {
                let v = corners[k] as usize;
                let rim = at_rim.get(v).is_some_and(|&rim| rim);
                if rim { Vector::ZERO } else { normals.vertices_pseudo_normal.get(v).copied().unwrap_or(normal) }
            };
            let (edges, corners) = ([0, 1, 2].map(edge), [0, 1, 2].map(corner));
            faces.push(Face { triangle, normal, edges, corners });
        }
        if faces.is_empty() {
            return None;
        }
        let flat = triangles - faces.len();
        let open_edges = on_rim.iter().filter(|&&rim| rim).count();
        let (boxes, leaves, faces) = threads::install(|| {
            let mut items: Vec<Item> = (faces.iter().enumerate())
                .map(|(i, f)| Item { at: f.triangle.center().to_array(), index: i as u32 })
                .collect();
            order(&mut items);
            let faces: Vec<Face> = items.iter().map(|i| faces[i.index as usize].clone()).collect();
            let leaves: Vec<TriangleLeaf> = faces.par_chunks(WIDTH).inspect(polled).map(TriangleLeaf::new).collect();
            let eights: Vec<&[Face]> = faces.chunks(WIDTH).collect();
            (BoxTree::new(&eights, |eight| around(eight)), leaves, faces)
        });
        Some(Self { boxes, leaves, faces, vertices, flat, open_edges, unoriented })
    }

    /// How many vertices were given.
    pub fn vertices(&self) -> usize {
        self.vertices
    }

    /// How many triangles count: those with an area.
    pub fn triangles(&self) -> usize {
        self.faces.len()
    }

    /// How many triangles have no area, and so do not count.
    pub fn flat(&self) -> usize {
        self.flat
    }

    /// Whether the mesh has an inside: every edge belongs to two triangles that run along it in opposite directions.
    pub fn closed(&self) -> bool {
        self.unoriented.is_none() && self.open_edges == 0
    }

    /// Fails where neighbouring triangles face opposite ways, or more than two meet at an edge: there are no sides.
    ///
    /// # Errors
    /// [`Error::Degenerate`].
    pub fn require_sides(&self) -> Result<()> {
        match &self.unoriented {
            Some(reason) => {
                let reason = format!("{reason}: it has no sides, so that distances have no sign");
                Err(Error::Degenerate { what: "mesh", reason })
            }
            None => Ok(()),
        }
    }

    /// The nearest point of the mesh to each of some points, with the face's normal there. Distances are positive in
    /// front of the nearest face, edge or vertex, and NaN where the nearest point is on the rim of an open mesh, which has
    /// no sides; without `signed` they are positive everywhere.
    ///
    /// # Errors
    /// [`Error::NonFinite`], [`Error::OutOfRange`] as in [`Mesh::new`]; with `signed` those of [`Mesh::require_sides`].
    pub fn feet(&self, points: &[[f64; 3]], signed: bool) -> Result<Vec<Foot>> {
        require(points.len(), size_of::<Foot>());
        let mut feet = vec![Foot { distance: 0.0, point: Vec3::zeros(), normal: Vec3::zeros() }; points.len()];
        self.each_foot(points, signed, &mut feet, |to, foot| *to = foot)?;
        Ok(feet)
    }

    /// The distances of [`Mesh::feet`] alone.
    ///
    /// # Errors
    /// As [`Mesh::feet`].
    pub fn distance(&self, points: &[[f64; 3]], signed: bool) -> Result<Vec<f64>> {
        let mut distance = vec![0.0; points.len()];
        self.each_foot(points, signed, &mut distance, |to, foot| *to = foot.distance)?;
        Ok(distance)
    }

    /// Unsigned feet of finite points, on this thread.
    pub(crate) fn each_near<T>(&self, points: &[[f64; 3]], out: &mut [T], put: impl Fn(&mut T, Foot) + Sync) {
        feet_of(self, points, false, out, &put);
    }

    fn each_foot<T: Send + Sync + Copy>(
        &self,
        points: &[[f64; 3]],
        signed: bool,
        out: &mut [T],
        put: impl Fn(&mut T, Foot) + Sync,
    ) -> Result<()> {
        require_range("points", points)?;
        require(points.len(), 48 + 2 * size_of::<T>());
        if signed {
            self.require_sides()?;
        }
        threads::install(|| for_chunks(points, out, CHUNK, |points, out| feet_of(self, points, signed, out, &put)));
        Ok(())
    }
}

impl std::fmt::Debug for Mesh {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Mesh({} vertices, {} triangles", self.vertices, self.faces.len())?;
        if self.flat > 0 {
            write!(f, " and {} without area", self.flat)?;
        }
        match (&self.unoriented, self.open_edges) {
            (Some(_), _) => write!(f, ", not oriented)"),
            (None, 0) => write!(f, ", closed)"),
            (None, n) => write!(f, ", open along {n} edges)"),
        }
    }
}

impl Face {
    fn extent(&self) -> Extent {
        let Triangle { a, b, c } = self.triangle;
        let corner = |pick: fn(f64, f64) -> f64| {
            let of = |k: usize| pick(pick(a[k], b[k]), c[k]);
            [of(0), of(1), of(2)]
        };
        (corner(min), corner(max))
    }

    /// The direction that tells the sides apart at a place of the triangle.
    fn side(&self, location: TrianglePointLocation) -> Vector {
        match location {
            TrianglePointLocation::OnVertex(i) => self.corners[i as usize % 3],
            TrianglePointLocation::OnEdge(i, _) => self.edges[i as usize % 3],
            TrianglePointLocation::OnFace(..) | TrianglePointLocation::OnSolid => self.normal,
        }
    }
}

/// The box around some faces.
fn around(faces: &[Face]) -> Extent {
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for (l, h) in faces.iter().map(Face::extent) {
        for k in 0..3 {
            (low[k], high[k]) = (min(low[k], l[k]), max(high[k], h[k]));
        }
    }
    (low, high)
}

/// Eight faces: corners a, b, c, unit normal, and one over the squared lengths of ab, bc, ca.
#[derive(Clone)]
#[repr(C, align(64))]
struct TriangleLeaf([[f64; WIDTH]; 15]);

impl TriangleLeaf {
    fn new(faces: &[Face]) -> Self {
        let mut rows = [[f64::NAN; WIDTH]; 15];
        for (place, face) in faces.iter().enumerate() {
            let Triangle { a, b, c } = face.triangle;
            for (row, value) in [a, b, c, face.normal].iter().flat_map(|v| v.to_array()).enumerate() {
                rows[row][place] = value;
            }
            for (row, side) in [b - a, c - b, a - c].iter().enumerate() {
                rows[12 + row][place] = 1.0 / side.length_squared();
            }
        }
        Self(rows)
    }

    /// By cases without branches: the distance from the plane where the foot is inside, else from the nearest edge.
    #[inline(always)]
    fn squared_distances(&self, q: &[f64; 3]) -> [f64; WIDTH] {
        let mut squared = [0.0; WIDTH];
        for (i, squared) in squared.iter_mut().enumerate() {
            let v = |row: usize| [self.0[row][i], self.0[row + 1][i], self.0[row + 2][i]];
            let (a, b, c, n) = (v(0), v(3), v(6), v(9));
            let (pa, pb, pc) = (minus(q, &a), minus(q, &b), minus(q, &c));
            let (ab, bc, ca) = (minus(&b, &a), minus(&c, &b), minus(&a, &c));
            let edge = |side: &[f64; 3], p: &[f64; 3], inverse: f64| {
                let t = min(max(dot(side, p) * inverse, 0.0), 1.0);
                let off = [p[0] - side[0] * t, p[1] - side[1] * t, p[2] - side[2] * t];
                dot(&off, &off)
            };
            let inside = |side: &[f64; 3], p: &[f64; 3]| dot(&cross(&n, side), p) >= 0.0;
            let height = dot(&n, &pa);
            let edges =
                min(edge(&ab, &pa, self.0[12][i]), min(edge(&bc, &pb, self.0[13][i]), edge(&ca, &pc, self.0[14][i])));
            *squared = if inside(&ab, &pa) & inside(&bc, &pb) & inside(&ca, &pc) { height * height } else { edges };
        }
        squared
    }
}

#[inline(always)]
fn minus(a: &[f64; 3], b: &[f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

#[inline(always)]
fn dot(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
fn cross(a: &[f64; 3], b: &[f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// The nearest face so far.
struct NearestFace<'a> {
    leaves: &'a [TriangleLeaf],
    q: [f64; 3],
    squared: f64,
    face: usize,
}

impl Visit for NearestFace<'_> {
    #[inline(always)]
    fn bound(&self) -> f64 {
        self.squared
    }

    #[inline(always)]
    fn visit(&mut self, leaf: usize) {
        let distances = self.leaves[leaf].squared_distances(&self.q);
        let mut near = at_most(&distances, self.squared);
        while near != 0 {
            let place = near.trailing_zeros() as usize & (WIDTH - 1);
            near &= near - 1;
            if distances[place] < self.squared {
                (self.squared, self.face) = (distances[place], leaf * WIDTH + place);
            }
        }
    }
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw", "x86_64+avx2"))]
fn feet_of<T>(mesh: &Mesh, points: &[[f64; 3]], signed: bool, out: &mut [T], put: &(impl Fn(&mut T, Foot) + Sync)) {
    plain_feet_of(mesh, points, signed, out, put);
}

/// The body of [`feet_of`], and its fallback.
#[inline(always)]
fn plain_feet_of<T>(
    mesh: &Mesh,
    points: &[[f64; 3]],
    signed: bool,
    out: &mut [T],
    put: &(impl Fn(&mut T, Foot) + Sync),
) {
    let mut aside = Aside::new();
    for (p, out) in points.iter().zip(out) {
        poll();
        let mut found = NearestFace { leaves: &mesh.leaves, q: *p, squared: f64::MAX, face: 0 };
        found.visit(mesh.boxes.dive(p));
        mesh.boxes.search(p, &mut aside, &mut found);
        let face = &mesh.faces[found.face];
        let q = Vector::from_array(*p);
        let (projection, location) = face.triangle.project_local_point_and_get_location(q, false);
        let offset = q - projection.point;
        let distance = offset.length();
        let side = if signed { face.side(location) } else { Vector::ZERO };
        let distance = match offset.dot(side) {
            _ if !signed || distance == 0.0 => distance,
            _ if side == Vector::ZERO => f64::NAN,
            behind if behind < 0.0 => -distance,
            _ => distance,
        };
        put(out, Foot { distance, point: vec3(projection.point), normal: vec3(face.normal) });
    }
}

fn vec3(v: Vector) -> Vec3 {
    Vec3::new(v.x, v.y, v.z)
}

fn require_range(what: &'static str, points: &[[f64; 3]]) -> Result<()> {
    if points.iter().flatten().all(|c| c.abs() <= LARGEST_COORDINATE) {
        return Ok(());
    }
    require_finite(what, points)?;
    let expected = format!("within ±{LARGEST_COORDINATE:e} in every coordinate");
    Err(Error::OutOfRange { what, expected, value: "a larger one".into() })
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A tube around z with caps: `n` facets around, radius and height in mm.
    pub(crate) fn tube(n: u32, radius: f64, height: f64) -> (Vec<[f64; 3]>, Vec<[u32; 3]>) {
        let mut vertices = vec![[0.0, 0.0, 0.0], [0.0, 0.0, height]];
        let mut triangles = Vec::new();
        for i in 0..n {
            let angle = f64::from(i) / f64::from(n) * std::f64::consts::TAU;
            let (x, y) = (radius * angle.cos(), radius * angle.sin());
            vertices.extend([[x, y, 0.0], [x, y, height]]);
            let (a, b) = (2 + 2 * i, 2 + 2 * ((i + 1) % n));
            triangles.extend([[a, b, a + 1], [b, b + 1, a + 1], [0, b, a], [1, a + 1, b + 1]]);
        }
        (vertices, triangles)
    }

    fn random(n: usize, seed: u64, size: f64) -> Vec<[f64; 3]> {
        let mut state = seed;
        let mut next = || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            ((state >> 11) as f64 / (1u64 << 53) as f64 - 0.5) * size
        };
        (0..n).map(|_| [next(), next(), next()]).collect()
    }

    /// The oracle: the nearest of all points of a triangle, tried on a fine grid of barycentric coordinates.
    fn tried(triangle: &[[f64; 3]; 3], q: &[f64; 3]) -> f64 {
        let [a, b, c] = triangle.map(Vec3::from);
        let n = 60;
        let mut least = f64::MAX;
        for i in 0..=n {
            for j in 0..=n - i {
                let (u, v) = (f64::from(i) / f64::from(n), f64::from(j) / f64::from(n));
                least = least.min((a + (b - a) * u + (c - a) * v - Vec3::from(*q)).norm());
            }
        }
        least
    }

    #[test]
    fn distances_are_those_of_trying_all_triangles() {
        let vertices = random(30, 1, 20.0);
        let triangles: Vec<[u32; 3]> = (0..28).map(|i| [i, i + 1, i + 2]).collect();
        let mesh = Mesh::new(&vertices, &triangles).unwrap();
        let queries = random(60, 2, 30.0);
        for (foot, q) in mesh.feet(&queries, false).unwrap().iter().zip(&queries) {
            let all = triangles.iter().map(|t| tried(&t.map(|i| vertices[i as usize]), q));
            let expected = all.fold(f64::MAX, f64::min);
            // The grid is up to 0.5 mm coarse, and never too near.
            assert!(
                foot.distance <= expected + 1e-9 && expected < foot.distance + 0.35,
                "{} {expected}",
                foot.distance
            );
            assert!(((foot.point - Vec3::from(*q)).norm() - foot.distance).abs() < 1e-12);
        }
    }

    #[test]
    fn vectors_and_the_plain_fallback_give_the_same_bits() {
        let (vertices, triangles) = tube(64, 10.0, 30.0);
        let mesh = Mesh::new(&vertices, &triangles).unwrap();
        let queries = random(2000, 3, 60.0);
        let put = |out: &mut Foot, foot: Foot| *out = foot;
        let none = Foot { distance: 0.0, point: Vec3::zeros(), normal: Vec3::zeros() };
        let (mut fast, mut plain) = (vec![none; 2000], vec![none; 2000]);
        feet_of(&mesh, &queries, true, &mut fast, &put);
        plain_feet_of(&mesh, &queries, true, &mut plain, &put);
        assert!(fast == plain && fast.iter().any(|f| f.distance < 0.0) && fast.iter().any(|f| f.distance > 0.0));
    }

    #[test]
    fn a_closed_tube_has_an_inside() {
        let (vertices, triangles) = tube(64, 10.0, 30.0);
        let mesh = Mesh::new(&vertices, &triangles).unwrap();
        assert!(mesh.closed() && mesh.flat() == 0);
        let queries: Vec<[f64; 3]> = random(4000, 3, 40.0).iter().map(|p| [p[0], p[1], p[2] + 15.0]).collect();
        // Facets lie within the sagitta of the circle.
        let sagitta = 10.0 * (1.0 - (std::f64::consts::PI / 64.0).cos());
        for (foot, q) in mesh.feet(&queries, true).unwrap().iter().zip(&queries) {
            let (radial, axial) = (q[0].hypot(q[1]) - 10.0, (q[2] - 15.0).abs() - 15.0);
            let outside = radial.max(0.0).hypot(axial.max(0.0));
            let expected = if outside > 0.0 { outside } else { radial.max(axial) };
            assert!((foot.distance - expected).abs() <= sagitta + 1e-12, "{q:?}: {} {expected}", foot.distance);
        }
    }

    #[test]
    fn signs_are_right_at_sharp_edges_and_corners() {
        // A thin wedge: beyond its edge the nearest point belongs to both faces, which disagree on the side.
        let vertices = [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [10.0, 1.0, 0.5], [10.0, -1.0, 0.5]];
        let triangles = [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]];
        let mesh = Mesh::new(&vertices, &triangles).unwrap();
        let queries: Vec<[f64; 3]> =
            random(500, 5, 2.0).iter().map(|p| [-p[0].abs() - 1e-6, p[1] * 0.5, p[2]]).collect();
        let inside_out: Vec<[u32; 3]> = triangles.iter().map(|t| [t[0], t[2], t[1]]).collect();
        let inside_out = Mesh::new(&vertices, &inside_out).unwrap();
        let outwards = mesh.feet(&[[5.0, 0.0, 0.5]], true).unwrap()[0].distance < 0.0;
        let (mesh, other) = if outwards { (mesh, inside_out) } else { (inside_out, mesh) };
        assert!(mesh.feet(&queries, true).unwrap().iter().all(|f| f.distance > 0.0));
        assert!(other.feet(&queries, true).unwrap().iter().all(|f| f.distance < 0.0));
    }

    #[test]
    fn an_open_mesh_has_sides_but_not_at_its_rim() {
        let mesh = Mesh::new(&[[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 4.0, 0.0]], &[[0, 1, 2]]).unwrap();
        let feet = mesh.feet(&[[1.0, 1.0, 2.0], [1.0, 1.0, -2.0], [-1.0, 1.0, 0.5]], true).unwrap();
        assert_eq!((feet[0].distance, feet[1].distance), (2.0, -2.0));
        assert!(feet[2].distance.is_nan() && !mesh.closed());
        assert!(mesh.feet(&[[-1.0, 1.0, 0.0]], false).unwrap()[0].distance == 1.0);
    }

    #[test]
    fn a_soup_of_triangles_is_joined_and_flat_ones_are_left_out() {
        let (vertices, triangles) = tube(24, 5.0, 5.0);
        let soup: Vec<[f64; 3]> = triangles.iter().flatten().map(|&i| vertices[i as usize]).collect();
        let mut loose: Vec<[u32; 3]> = (0..triangles.len() as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
        loose.push([0, 0, 1]);
        let mesh = Mesh::new(&soup, &loose).unwrap();
        assert!(mesh.closed() && mesh.flat() == 1, "{mesh:?}");
        let turned: Vec<[u32; 3]> =
            triangles.iter().enumerate().map(|(i, t)| if i == 7 { [t[1], t[0], t[2]] } else { *t }).collect();
        let mesh = Mesh::new(&vertices, &turned).unwrap();
        assert!(matches!(mesh.feet(&[[0.0; 3]], true), Err(Error::Degenerate { .. })));
        assert!(mesh.feet(&[[0.0; 3]], false).is_ok());
    }

    #[test]
    fn what_is_no_mesh_is_refused() {
        let v = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]];
        assert!(matches!(Mesh::new(&v, &[]), Err(Error::TooFew { .. })));
        assert!(matches!(Mesh::new(&[], &[[0, 1, 2]]), Err(Error::TooFew { .. })));
        assert!(matches!(Mesh::new(&v, &[[0, 1, 3]]), Err(Error::OutOfRange { .. })));
        assert!(matches!(Mesh::new(&v, &[[0, 1, 2]]), Err(Error::Degenerate { .. })));
        assert!(matches!(Mesh::new(&[[f64::NAN; 3]; 3], &[[0, 1, 2]]), Err(Error::NonFinite { .. })));
        assert!(matches!(Mesh::new(&[[1e90; 3]; 3], &[[0, 1, 2]]), Err(Error::OutOfRange { .. })));
    }
}
