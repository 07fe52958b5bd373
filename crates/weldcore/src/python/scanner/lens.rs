//! Camera, projector and scanner as Python sees them.

use numpy::{IntoPyArray, IxDyn, PyArray2, PyArrayMethods, PyUntypedArrayMethods};
use pyo3::prelude::*;

use crate::error::Error;
use crate::python::call::{compute, raise};
use crate::python::convert::{float_matrix, floats, transform, whole};
use crate::scanner::{Lens, Scanner};

/// A camera or projector: a pinhole with a lens, as OpenCV models it.
///
/// Args:
///     width, height: the image, px.
///     K: (3, 3) `[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]`, px; the centre of the first pixel is (0, 0). No skew.
///     dist: k1, k2, p1, p2 and, if there is a fifth, k3; (n,), or (1, n) or (n, 1), as OpenCV has them.
///
/// Raises:
///     InputError: a wrong shape, a value that is not finite, a focal length that is not above zero, a skew.
///
/// Example:
///     >>> from weldscan import Lens
///     >>> lens = Lens(640, 480, [[500, 0, 320], [0, 500, 240], [0, 0, 1]], [0, 0, 0, 0])
///     >>> lens.project([[0.1, 0.2, 1.0]])
///     array([[370., 340.]])
#[pyclass(frozen, module = "weldscan", name = "Lens")]
#[derive(Clone)]
pub(crate) struct PyLens {
    pub(crate) lens: Lens,
}

#[pymethods]
impl PyLens {
    #[new]
    #[pyo3(signature = (width, height, K, dist))]
    #[allow(non_snake_case)] // K is the field's name for it.
    fn new(
        #[pyo3(from_py_with = whole)] width: usize,
        #[pyo3(from_py_with = whole)] height: usize,
        K: &Bound<'_, PyAny>,
        dist: &Bound<'_, PyAny>,
    ) -> PyResult<Self> {
        let py = K.py();
        let shape = |what, expected: &str, got| raise(py, &Error::Shape { what, expected: expected.into(), got });
        let matrix = float_matrix("K", K)?;
        if matrix.shape() != [3, 3] {
            return Err(shape("K", "shape (3, 3)", format!("shape {:?}", matrix.shape())));
        }
        let k = matrix.as_array();
        let below = [k[[1, 0]], k[[2, 0]], k[[2, 1]], k[[2, 2]] - 1.0];
        if k[[0, 1]] != 0.0 || below != [0.0; 4] {
            let expected = "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]: skew is not modelled".into();
            return Err(raise(py, &Error::OutOfRange { what: "K", expected, value: k.to_string().replace('\n', "") }));
        }
        let numbers = floats::<IxDyn>("dist", dist)?;
        // OpenCV's own are of one row, or of one column.
        if numbers.shape().iter().filter(|&&side| side != 1).count() > 1 {
            return Err(shape("dist", "numbers in a row or a column", format!("shape {:?}", numbers.shape())));
        }
        let numbers = numbers.as_slice()?;
        let mut dist = [0.0; 5];
        match numbers.len() {
            n @ (4 | 5) => dist.iter_mut().zip(numbers).take(n).for_each(|(d, v)| *d = *v),
            n => return Err(shape("dist", "k1, k2, p1, p2 and perhaps k3", format!("{n} numbers"))),
        }
        let lens = Lens::new(width, height, [k[[0, 0]], k[[1, 1]]], [k[[0, 2]], k[[1, 2]]], dist);
        Ok(Self { lens: lens.map_err(|e| raise(py, &e))? })
    }

    /// Columns.
    #[getter]
    fn width(&self) -> usize {
        self.lens.width
    }

    /// Rows.
    #[getter]
    fn height(&self) -> usize {
        self.lens.height
    }

    /// The camera matrix, (3, 3), px.
    #[getter]
    #[pyo3(name = "K")]
    fn k<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        let l = &self.lens;
        PyArray2::from_owned_array(py, numpy::ndarray::arr2(&[[l.fx, 0.0, l.cx], [0.0, l.fy, l.cy], [0.0, 0.0, 1.0]]))
    }

    /// k1, k2, p1, p2, k3.
    #[getter]
    fn dist(&self) -> [f64; 5] {
        self.lens.dist
    }

    /// The pixels (n, 2) of points (n, 3) in the device's own frame, mm; NaN behind it and beyond the lens's fold.
    fn project<'py>(&self, points: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let array = float_matrix("points", points)?;
        let points = crate::python::convert::points("points", &array)?;
        let pixels = compute(array.py(), || Ok(self.lens.project_all(points)))?;
        pairs(array.py(), pixels)
    }

    /// The directions (n, 2), x and y of (x, y, 1), that are imaged at pixels (n, 2); NaN where there is none.
    fn undistort<'py>(&self, pixels: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let array = float_matrix("pixels", pixels)?;
        if array.shape()[1] != 2 {
            let got = format!("shape {:?}", array.shape());
            return Err(raise(array.py(), &Error::Shape { what: "pixels", expected: "shape (n, 2)".into(), got }));
        }
        let pixels = array.as_slice()?.as_chunks::<2>().0;
        let directions = compute(array.py(), || Ok(self.lens.undistort_all(pixels)))?;
        pairs(array.py(), directions)
    }

    fn __repr__(&self) -> String {
        let Lens { width, height, fx, fy, cx, cy, dist } = self.lens;
        format!("Lens({width}x{height} px, fx={fx}, fy={fy}, cx={cx}, cy={cy}, dist={dist:?})")
    }

    fn __eq__(&self, other: &Bound<'_, PyAny>) -> bool {
        other.cast::<Self>().is_ok_and(|o| o.get().lens == self.lens)
    }
}

fn pairs(py: Python<'_>, values: Vec<[f64; 2]>) -> PyResult<Bound<'_, PyArray2<f64>>> {
    let rows = values.len();
    values.into_flattened().into_pyarray(py).reshape([rows, 2])
}

/// A structured-light scanner: camera, projector, and where the one stands from the other. Points are in the camera's
/// frame: x right, y down, z forward, mm.
///
/// Args:
///     camera, projector: `Lens`. A projector is a camera used backwards.
///     camera_from_projector: (4, 4), maps projector coordinates to camera coordinates, mm.
///
/// Raises:
///     InputError: `camera_from_projector` is not a rigid transform (wrong shape, mirrored, not orthonormal).
///     GeometryError: camera and projector stand in the same place.
///
/// Example:
///     >>> import numpy as np
///     >>> from weldscan import Lens, Scanner
///     >>> lens = Lens(640, 480, [[500, 0, 320], [0, 500, 240], [0, 0, 1]], [0, 0, 0, 0])
///     >>> pose = np.eye(4)
///     >>> pose[0, 3] = 150.0
///     >>> Scanner(lens, lens, pose).baseline_mm
///     150.0
#[pyclass(frozen, module = "weldscan", name = "Scanner")]
pub(crate) struct PyScanner {
    pub(crate) scanner: Scanner,
}

#[pymethods]
impl PyScanner {
    #[new]
    fn new(
        camera: &Bound<'_, PyLens>,
        projector: &Bound<'_, PyLens>,
        camera_from_projector: &Bound<'_, PyAny>,
    ) -> PyResult<Self> {
        let py = camera.py();
        let pose = transform("camera_from_projector", &float_matrix("camera_from_projector", camera_from_projector)?)?;
        let scanner = Scanner::new(camera.get().lens, projector.get().lens, pose).map_err(|e| raise(py, &e))?;
        Ok(Self { scanner })
    }

    /// The camera.
    #[getter]
    fn camera(&self) -> PyLens {
        PyLens { lens: self.scanner.camera }
    }

    /// The projector.
    #[getter]
    fn projector(&self) -> PyLens {
        PyLens { lens: self.scanner.projector }
    }

    /// Maps projector coordinates to camera coordinates, (4, 4), mm.
    #[getter]
    fn camera_from_projector<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        PyArray2::from_owned_array(py, numpy::ndarray::arr2(&self.scanner.camera_from_projector.to_rows()))
    }

    /// Distance between camera and projector, mm.
    #[getter]
    fn baseline_mm(&self) -> f64 {
        self.scanner.camera_from_projector.translation.norm()
    }

    /// The projector pixels (n, 2) that light points (n, 3) of the scanner's frame, mm; NaN where there is none.
    fn project_to_projector<'py>(&self, points: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let array = float_matrix("points", points)?;
        let points = crate::python::convert::points("points", &array)?;
        let pixels = compute(array.py(), || Ok(self.scanner.project_to_projector(points)))?;
        pairs(array.py(), pixels)
    }

    fn __repr__(&self) -> String {
        let Scanner { camera, projector, .. } = &self.scanner;
        format!(
            "Scanner(camera {}x{}, projector {}x{}, baseline {:.1} mm)",
            camera.width,
            camera.height,
            projector.width,
            projector.height,
            self.baseline_mm()
        )
    }
}

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyLens>()?;
    m.add_class::<PyScanner>()
}
