//! Meshes, and distances to clouds, meshes and surfaces as Python sees them.

use numpy::ndarray::Ix2;
use numpy::{IntoPyArray, PyArray1, PyArrayMethods, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::prelude::*;

use crate::clouds::distance::{self, Target};
use crate::clouds::kdtree::KdTree;
use crate::clouds::mesh::Mesh;
use crate::error::{Error, Result};
use crate::python::call::{compute, raise};
use crate::python::clouds::kdtree::PyKdTree;
use crate::python::convert::{float_matrix, floats, points, unmasked};
use crate::python::surfaces::surface_of;
use crate::surfaces::Surface;

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
    pub(crate) given: (Vec<[f64; 3]>, Vec<[u32; 3]>),
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
        } else if let Some(surface) = surface_of(target) {
            Self::Surface(surface)
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
///     target: (m, 3) points, a `KdTree` of them, a `Mesh`, a `Plane`, a `Sphere`, a `Cylinder`, or a fit
///         of one of these.
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

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyMesh>()?;
    m.add_function(wrap_pyfunction!(py_distance, m)?)
}
