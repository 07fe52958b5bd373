//! Surfaces and distances to them as Python sees them.

use numpy::ndarray::{Ix1, Ix2};
use numpy::{IntoPyArray, PyArray1, PyArrayMethods, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::prelude::*;

use super::kdtree::PyKdTree;
use super::{compute, float_matrix, floats, points, raise, unmasked};
use crate::Vec3;
use crate::distance::{self, Cylinder, Plane, Sphere, Surface, Target};
use crate::error::{Error, Result};
use crate::kdtree::KdTree;
use crate::mesh::Mesh;

/// Three numbers.
pub(crate) fn vector(what: &'static str, given: &Bound<'_, PyAny>) -> PyResult<[f64; 3]> {
    let array = floats::<Ix1>(what, given)?;
    let numbers = array.as_slice()?;
    numbers.try_into().map_err(|_| {
        let got = format!("{} numbers", numbers.len());
        raise(given.py(), &Error::Shape { what, expected: "3 numbers".into(), got })
    })
}

pub(crate) fn array<'py>(py: Python<'py>, v: &Vec3) -> Bound<'py, PyArray1<f64>> {
    PyArray1::from_slice(py, v.as_slice())
}

pub(crate) fn words(v: &Vec3) -> String {
    format!("[{}, {}, {}]", v.x, v.y, v.z)
}

/// A plane, as a target of `distance` and `register_icp`: exact.
///
/// Args:
///     point_mm: (3,) a point on it.
///     normal: (3,) of any length but zero; distances are positive on its side.
///
/// Raises:
///     InputError: a wrong shape, NaN or infinity.
///     GeometryError: a normal of length zero.
///
/// Example:
///     >>> from weldscan import Plane
///     >>> Plane([0, 0, 5], [0, 0, 2]).normal
///     array([0., 0., 1.])
#[pyclass(frozen, module = "weldscan", name = "Plane")]
pub(crate) struct PyPlane(pub(crate) Plane);

#[pymethods]
impl PyPlane {
    #[new]
    fn new(point_mm: &Bound<'_, PyAny>, normal: &Bound<'_, PyAny>) -> PyResult<Self> {
        let plane = Plane::new(vector("point_mm", point_mm)?, vector("normal", normal)?);
        Ok(Self(plane.map_err(|e| raise(point_mm.py(), &e))?))
    }

    /// (3,) float64: a point on it, mm.
    #[getter]
    fn point_mm<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.0.point())
    }

    /// (3,) float64: unit normal.
    #[getter]
    fn normal<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.0.normal())
    }

    fn __repr__(&self) -> String {
        format!("Plane(point_mm={}, normal={})", words(&self.0.point()), words(&self.0.normal()))
    }
}

/// A sphere, as a target of `distance` and `register_icp`: exact.
///
/// Args:
///     center_mm: (3,)
///     radius_mm: above 0.
///
/// Raises:
///     InputError: a wrong shape, NaN or infinity, a radius that is not above 0.
///
/// Example:
///     >>> from weldscan import Sphere
///     >>> Sphere([0, 0, 0], 15).radius_mm
///     15.0
#[pyclass(frozen, module = "weldscan", name = "Sphere")]
pub(crate) struct PySphere(pub(crate) Sphere);

#[pymethods]
impl PySphere {
    #[new]
    fn new(center_mm: &Bound<'_, PyAny>, radius_mm: f64) -> PyResult<Self> {
        let sphere = Sphere::new(vector("center_mm", center_mm)?, radius_mm);
        Ok(Self(sphere.map_err(|e| raise(center_mm.py(), &e))?))
    }

    /// (3,) float64: centre, mm.
    #[getter]
    fn center_mm<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.0.center())
    }

    /// Radius, mm.
    #[getter]
    fn radius_mm(&self) -> f64 {
        self.0.radius()
    }

    fn __repr__(&self) -> String {
        format!("Sphere(center_mm={}, radius_mm={})", words(&self.0.center()), self.0.radius())
    }
}

/// A cylinder without ends, as a target of `distance` and `register_icp`: exact.
///
/// Args:
///     point_mm: (3,) a point on the axis.
///     axis: (3,) along the axis, of any length but zero.
///     radius_mm: above 0.
///
/// Raises:
///     InputError: a wrong shape, NaN or infinity, a radius that is not above 0.
///     GeometryError: an axis of length zero.
///
/// Example:
///     >>> from weldscan import Cylinder
///     >>> Cylinder([0, 0, 0], [0, 0, 2], 315)
///     Cylinder(point_mm=[0, 0, 0], axis=[0, 0, 1], radius_mm=315)
#[pyclass(frozen, module = "weldscan", name = "Cylinder")]
pub(crate) struct PyCylinder(pub(crate) Cylinder);

#[pymethods]
impl PyCylinder {
    #[new]
    fn new(point_mm: &Bound<'_, PyAny>, axis: &Bound<'_, PyAny>, radius_mm: f64) -> PyResult<Self> {
        let cylinder = Cylinder::new(vector("point_mm", point_mm)?, vector("axis", axis)?, radius_mm);
        Ok(Self(cylinder.map_err(|e| raise(point_mm.py(), &e))?))
    }

    /// (3,) float64: a point on the axis, mm.
    #[getter]
    fn point_mm<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.0.point())
    }

    /// (3,) float64: unit direction of the axis.
    #[getter]
    fn axis<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        array(py, &self.0.axis())
    }

    /// Radius, mm.
    #[getter]
    fn radius_mm(&self) -> f64 {
        self.0.radius()
    }

    fn __repr__(&self) -> String {
        let (point, axis) = (words(&self.0.point()), words(&self.0.axis()));
        format!("Cylinder(point_mm={point}, axis={axis}, radius_mm={})", self.0.radius())
    }
}

/// A triangle mesh, as a target of `distance` and `register_icp`.
///
/// Vertices at the same place are taken for one, so that a soup of triangles (STL) will do. Triangles without an area do
/// not count. Counter-clockwise triangles face the viewer: distances are positive in front of them.
///
/// Args:
///     vertices: (n, 3), mm.
///     triangles: (m, 3) integers, indices into the vertices.
///
/// Raises:
///     InputError: a wrong shape or type, NaN or infinity, coordinates beyond 1e60, an index without a vertex.
///     GeometryError: no triangle, or none with an area.
///
/// Example:
///     >>> from weldscan import Mesh
///     >>> Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
///     Mesh(4 vertices, 4 triangles, closed)
#[pyclass(frozen, module = "weldscan", name = "Mesh")]
pub(crate) struct PyMesh {
    pub(crate) mesh: Mesh,
    /// Vertices and triangles as they came: what it is pickled as.
    pub(super) given: (Vec<[f64; 3]>, Vec<[u32; 3]>),
}

#[pymethods]
impl PyMesh {
    #[new]
    fn new(vertices: &Bound<'_, PyAny>, triangles: &Bound<'_, PyAny>) -> PyResult<Self> {
        let py = vertices.py();
        let vertices = float_matrix("vertices", vertices)?;
        let vertices = points("vertices", &vertices)?;
        let triangles = indices("triangles", triangles)?;
        let mesh = compute(py, || Mesh::new(vertices, &triangles))?;
        Ok(Self { mesh, given: (vertices.to_vec(), triangles) })
    }

    /// How many triangles count: those with an area.
    #[getter]
    fn triangles(&self) -> usize {
        self.mesh.triangles()
    }

    /// Whether it has an inside: every edge belongs to two triangles that face the same way.
    #[getter]
    fn closed(&self) -> bool {
        self.mesh.closed()
    }

    fn __repr__(&self) -> String {
        format!("{:?}", self.mesh)
    }
}

/// An (m, 3) array of integers that are 0 or more.
fn indices(what: &'static str, given: &Bound<'_, PyAny>) -> PyResult<Vec<[u32; 3]>> {
    let py = given.py();
    let wrong = |got: String| raise(py, &Error::Shape { what, expected: "integers of shape (m, 3)".into(), got });
    unmasked(what, given)?;
    let array = py.import("numpy")?.call_method1("asarray", (given,)).map_err(|_| wrong("another object".into()))?;
    let dtype = array.getattr("dtype")?;
    let shape: Vec<usize> = array.getattr("shape")?.extract()?;
    let empty = shape.first() == Some(&0);
    if !"iu".contains(&dtype.getattr("kind")?.extract::<String>()?) && !empty {
        return Err(wrong(format!("dtype {dtype}")));
    }
    let array = array.call_method1("astype", ("int64",))?;
    let Ok(array) = array.cast_into::<numpy::PyArray<i64, Ix2>>() else {
        return Err(wrong(format!("shape {shape:?}")));
    };
    if array.shape()[1] != 3 {
        return Err(wrong(format!("shape {shape:?}")));
    }
    let view = array.readonly();
    let index = |&i: &i64| {
        u32::try_from(i)
            .map_err(|_| raise(py, &Error::OutOfRange { what, expected: "0 or more".into(), value: i.to_string() }))
    };
    let rows = view.as_array();
    rows.rows().into_iter().map(|r| Ok([index(&r[0])?, index(&r[1])?, index(&r[2])?])).collect()
}

/// Whatever a cloud can be held against.
pub(crate) enum Given<'py> {
    Tree(Py<PyKdTree>),
    Points(PyReadonlyArray2<'py, f64>),
    Mesh(Py<PyMesh>),
    Surface(Surface),
}

impl<'py> Given<'py> {
    pub(crate) fn new(target: &Bound<'py, PyAny>) -> PyResult<Self> {
        Ok(if let Ok(tree) = target.cast::<PyKdTree>() {
            Self::Tree(tree.clone().unbind())
        } else if let Ok(mesh) = target.cast::<PyMesh>() {
            Self::Mesh(mesh.clone().unbind())
        } else if let Ok(plane) = target.cast::<PyPlane>() {
            Self::Surface(Surface::Plane(plane.get().0))
        } else if let Ok(sphere) = target.cast::<PySphere>() {
            Self::Surface(Surface::Sphere(sphere.get().0))
        } else if let Ok(cylinder) = target.cast::<PyCylinder>() {
            Self::Surface(Surface::Cylinder(cylinder.get().0))
        } else {
            Self::Points(floats::<Ix2>("target", target)?)
        })
    }

    /// Detaches from the interpreter and computes with the target.
    pub(crate) fn compute<T: Send>(
        &self,
        py: Python<'py>,
        normals: Option<&[[f64; 3]]>,
        job: impl FnOnce(&Target) -> Result<T> + Send,
    ) -> PyResult<T> {
        match self {
            Self::Tree(tree) => {
                let tree = &tree.get().tree;
                compute(py, || job(&Target::Cloud(tree, normals)))
            }
            Self::Points(array) => {
                let target = points("target", array)?;
                compute(py, || job(&Target::Cloud(&tree_of(target)?, normals)))
            }
            Self::Mesh(mesh) => {
                let mesh = &mesh.get().mesh;
                compute(py, || job(&Target::Mesh(mesh)))
            }
            Self::Surface(surface) => compute(py, || job(&Target::Surface(*surface))),
        }
    }
}

/// The tree of the target: errors name it.
fn tree_of(target: &[[f64; 3]]) -> Result<KdTree> {
    let what = "target";
    KdTree::new(target).map_err(|error| match error {
        Error::TooFew { needed, got, .. } => Error::TooFew { what, needed, got },
        Error::NonFinite { index, .. } => Error::NonFinite { what, index },
        Error::OutOfRange { expected, value, .. } => Error::OutOfRange { what, expected, value },
        other => other,
    })
}

/// The distance of each point from the target, mm.
///
/// To a cloud: the distance to the nearest point; signed by the side of that point's normal on which the query lies.
/// To a mesh: the distance to the nearest place of a triangle; signed by the side of the nearest face, edge or vertex
/// (angle-weighted normals); NaN where the nearest place is on the rim of an open mesh, which has no sides there.
/// To a plane, sphere or cylinder: exact; positive on the side of the normal, or outside.
///
/// Args:
///     points: (n, 3), mm, in the target's frame.
///     target: (m, 3) points, a `KdTree` of them, a `Mesh`, a `Plane`, a `Sphere` or a `Cylinder`.
///     signed: False gives distances of 0 and more.
///     normals: (m, 3) unit normals of the target's points, needed for a signed distance to a cloud.
///
/// Returns:
///     (n,) float64, mm.
///
/// Raises:
///     InputError: a wrong shape, NaN or infinity.
///     GeometryError: signs from a cloud without normals, or from a mesh whose triangles do not face one way.
///
/// Source: Baerentzen & Aanaes, Signed distance computation using the angle weighted pseudonormal, IEEE TVCG 11 (2005)
/// 243.
///
/// Example:
///     >>> from weldscan import Cylinder, distance
///     >>> distance([[12, 0, 5], [0, 9, 5]], Cylinder([0, 0, 0], [0, 0, 1], 10))
///     array([ 2., -1.])
#[pyfunction]
#[pyo3(name = "distance", signature = (points, target, signed=true, *, normals=None))]
fn py_distance<'py>(
    py: Python<'py>,
    points: &Bound<'py, PyAny>,
    target: &Bound<'py, PyAny>,
    signed: bool,
    normals: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyArray1<f64>>> {
    let array = float_matrix("points", points)?;
    let points = self::points("points", &array)?;
    let normals = normals.map(|n| float_matrix("normals", n)).transpose()?;
    let normals = normals.as_ref().map(|n| self::points("normals", n)).transpose()?;
    let found = Given::new(target)?.compute(py, normals, |target| distance::distance(points, target, signed))?;
    Ok(found.into_pyarray(py))
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyPlane>()?;
    m.add_class::<PySphere>()?;
    m.add_class::<PyCylinder>()?;
    m.add_class::<PyMesh>()?;
    m.add_function(wrap_pyfunction!(py_distance, m)?)
}
