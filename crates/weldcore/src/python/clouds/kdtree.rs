//! The k-d tree as Python sees it.

use std::sync::{Mutex, TryLockError};

use numpy::ndarray::Array2;
use numpy::{IntoPyArray, PyArray1, PyArray2};
use pyo3::prelude::*;

use crate::clouds::kdtree::{Follower, KdTree};
use crate::error::Error;
use crate::python::call::{compute, raise};
use crate::python::convert::{float_matrix, points, whole};

type Pair<'py, A> = (Bound<'py, A>, Bound<'py, PyArray1<u32>>);
type Lists<'py> = (Vec<Bound<'py, PyArray1<f64>>>, Vec<Bound<'py, PyArray1<u32>>>);

/// A k-d tree: exact nearest neighbours among points in space.
///
/// Exact means the answer of a plain loop in float64, bit for bit; of equally distant points the lowest index comes
/// first. The tree keeps a copy of the points, 35 bytes a point in all.
///
/// Args:
///     points: (n, 3), mm, n >= 1, any frame.
///
/// Raises:
///     InputError: a wrong shape; NaN, infinity or a coordinate beyond 1e150.
///     GeometryError: no point.
///
/// Example:
///     >>> from weldscan import KdTree
///     >>> tree = KdTree([[0, 0, 0], [3, 0, 0], [0, 4, 0]])
///     >>> distance, index = tree.nearest([[2, 0, 0], [0, 3, 0]])
///     >>> distance.tolist(), index.tolist()
///     ([1.0, 1.0], [1, 2])
#[pyclass(frozen, module = "weldscan", name = "KdTree")]
pub(crate) struct PyKdTree {
    pub(crate) tree: KdTree,
}

#[pymethods]
impl PyKdTree {
    #[new]
    #[pyo3(signature = (points))]
    fn new(points: &Bound<'_, PyAny>) -> PyResult<Self> {
        let py = points.py();
        let array = float_matrix("points", points)?;
        let points = self::points("points", &array)?;
        Ok(Self { tree: compute(py, || KdTree::new(points))? })
    }

    /// The nearest point to each query.
    ///
    /// Args:
    ///     queries: (m, 3), mm, in the frame of the points.
    ///
    /// Returns:
    ///     distance: (m,) float64, mm.
    ///     index: (m,) uint32, into the points; the lowest of equally distant ones.
    ///
    /// Raises:
    ///     InputError: a wrong shape; NaN, infinity or a coordinate beyond 1e150.
    ///
    /// Example:
    ///     >>> from weldscan import KdTree
    ///     >>> KdTree([[0, 0, 0], [2, 0, 0]]).nearest([[1, 0, 0]])
    ///     (array([1.]), array([0], dtype=uint32))
    fn nearest<'py>(&self, py: Python<'py>, queries: &Bound<'py, PyAny>) -> PyResult<Pair<'py, PyArray1<f64>>> {
        let array = float_matrix("queries", queries)?;
        let queries = points("queries", &array)?;
        let (distance, index) = compute(py, || self.tree.nearest(queries))?;
        Ok((distance.into_pyarray(py), index.into_pyarray(py)))
    }

    /// The k nearest points to each query, nearest first, equally distant ones by index.
    ///
    /// Args:
    ///     queries: (m, 3), mm, in the frame of the points.
    ///     k: how many, from 1 to the number of points.
    ///
    /// Returns:
    ///     distance: (m, k) float64, mm, ascending in each row.
    ///     index: (m, k) uint32, into the points.
    ///
    /// Raises:
    ///     InputError: as for `nearest`; k below 1 or above the number of points.
    ///
    /// Example:
    ///     >>> from weldscan import KdTree
    ///     >>> distance, index = KdTree([[0, 0, 0], [2, 0, 0], [5, 0, 0]]).knn([[4, 0, 0]], 2)
    ///     >>> distance.tolist(), index.tolist()
    ///     ([[1.0, 2.0]], [[2, 1]])
    #[allow(clippy::type_complexity)]
    fn knn<'py>(
        &self,
        py: Python<'py>,
        queries: &Bound<'py, PyAny>,
        #[pyo3(from_py_with = whole)] k: usize,
    ) -> PyResult<(Bound<'py, PyArray2<f64>>, Bound<'py, PyArray2<u32>>)> {
        let array = float_matrix("queries", queries)?;
        let queries = points("queries", &array)?;
        let (distance, index) = compute(py, || self.tree.knn(queries, k))?;
        let shape = (queries.len(), k);
        let wrong = |e: numpy::ndarray::ShapeError| {
            raise(py, &Error::Shape { what: "k", expected: format!("{shape:?}"), got: e.to_string() })
        };
        let distance = Array2::from_shape_vec(shape, distance).map_err(wrong)?;
        let index = Array2::from_shape_vec(shape, index).map_err(wrong)?;
        Ok((distance.into_pyarray(py), index.into_pyarray(py)))
    }

    /// All points within r of each query, the border included, nearest first, equally distant ones by index.
    ///
    /// Args:
    ///     queries: (m, 3), mm, in the frame of the points.
    ///     r: mm, 0 or more; infinity gives all points.
    ///
    /// Returns:
    ///     distance: a list of m float64 arrays, mm, ascending.
    ///     index: a list of m uint32 arrays, into the points; empty where no point is near.
    ///
    /// Raises:
    ///     InputError: as for `nearest`; a negative or NaN r.
    ///
    /// Example:
    ///     >>> from weldscan import KdTree
    ///     >>> distance, index = KdTree([[0, 0, 0], [2, 0, 0], [5, 0, 0]]).radius([[0, 0, 0], [9, 0, 0]], 2.0)
    ///     >>> [i.tolist() for i in index]
    ///     [[0, 1], []]
    fn radius<'py>(&self, py: Python<'py>, queries: &Bound<'py, PyAny>, r: f64) -> PyResult<Lists<'py>> {
        let array = float_matrix("queries", queries)?;
        let queries = points("queries", &array)?;
        let within = compute(py, || self.tree.radius(queries, r))?;
        Ok(within.into_iter().map(|w| (w.distance_mm.into_pyarray(py), w.index.into_pyarray(py))).unzip())
    }

    fn __len__(&self) -> usize {
        self.tree.len()
    }

    fn __repr__(&self) -> String {
        format!("{:?}", self.tree)
    }
}

/// Nearest neighbours of queries that move a little from call to call, as the points of an iteration do.
///
/// It remembers by how much the nearest point of each query is nearer than the second nearest: as long as a query has
/// moved by less than half of that, the answer stands without a search. Answers are those of `KdTree.nearest`.
///
/// Args:
///     tree: a `KdTree`.
///
/// Example:
///     >>> import numpy as np
///     >>> from weldscan import Follower, KdTree
///     >>> follower = Follower(KdTree([[0, 0, 0], [2, 0, 0]]))
///     >>> for x in (0.0, 0.1, 1.9):
///     ...     distance, index = follower.nearest([[x, 0, 0]])
///     >>> index.tolist()
///     [1]
#[pyclass(frozen, module = "weldscan", name = "Follower")]
pub(crate) struct PyFollower {
    pub(crate) tree: Py<PyKdTree>,
    pub(crate) follower: Mutex<Follower>,
}

#[pymethods]
impl PyFollower {
    #[new]
    fn new(tree: Py<PyKdTree>) -> Self {
        Self { tree, follower: Mutex::default() }
    }

    /// The nearest point to each query, as `KdTree.nearest`. The queries are taken for those of the last call, moved;
    /// another number of them starts anew.
    ///
    /// Args:
    ///     queries: (m, 3), mm, in the frame of the points.
    ///
    /// Returns:
    ///     distance: (m,) float64, mm.
    ///     index: (m,) uint32, into the points; the lowest of equally distant ones.
    ///
    /// Raises:
    ///     InputError: a wrong shape; NaN, infinity or a coordinate beyond 1e150.
    ///
    /// Example:
    ///     >>> from weldscan import Follower, KdTree
    ///     >>> Follower(KdTree([[0, 0, 0], [2, 0, 0]])).nearest([[1.5, 0, 0]])
    ///     (array([0.5]), array([1], dtype=uint32))
    fn nearest<'py>(&self, py: Python<'py>, queries: &Bound<'py, PyAny>) -> PyResult<Pair<'py, PyArray1<f64>>> {
        let array = float_matrix("queries", queries)?;
        let queries = points("queries", &array)?;
        let tree = &self.tree.get().tree;
        let (distance, index) = compute(py, || {
            match self.follower.try_lock() {
                Ok(mut follower) => follower.nearest(tree, queries),
                // What a call that failed left behind is as good as any start.
                Err(TryLockError::Poisoned(left)) => left.into_inner().nearest(tree, queries),
                // Another thread, perhaps one that a fork has cut off, is not waited for.
                Err(TryLockError::WouldBlock) => tree.nearest(queries),
            }
        })?;
        Ok((distance.into_pyarray(py), index.into_pyarray(py)))
    }

    fn __repr__(&self) -> String {
        format!("Follower({:?})", self.tree.get().tree)
    }
}

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyKdTree>()?;
    m.add_class::<PyFollower>()
}
