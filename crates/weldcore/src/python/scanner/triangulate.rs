//! Triangulation as Python sees it.

use numpy::{PyArray1, PyArray2, PyArray3, PyArrayMethods, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::prelude::*;

use crate::error::Error;
use crate::python::call::{compute, raise};
use crate::python::convert::{float_matrix, numbers, unmasked};
use crate::python::fringes::images::image;
use crate::python::scanner::lens::PyScanner;
use crate::scanner::Axis;
use crate::scanner::reference_plane::{
    ReferenceGeometry, ReferencePlane, calibrate_reference_plane as calibrate_core, height_from_calibration,
    height_from_reference as height_core,
};
use crate::scanner::triangulate::triangulate as core;

/// Points on the camera's pixel grid, scanner frame.
#[pyclass(frozen, get_all, module = "weldscan", name = "Cloud")]
pub(crate) struct PyCloud {
    /// (H, W, 3) float64, mm, scanner frame; NaN where there is no point.
    pub(crate) points_mm: Py<PyArray3<f64>>,
    /// (H, W) float32, mm: standard deviation along the camera's ray, NaN where there is no point; None if no sigma_px
    /// was given.
    pub(crate) sigma_mm: Option<Py<PyArray2<f32>>>,
}

#[pymethods]
impl PyCloud {
    fn __repr__(&self, py: Python<'_>) -> String {
        let points = self.points_mm.bind(py).readonly();
        let n = points.as_array().iter().skip(2).step_by(3).filter(|z| z.is_finite()).count();
        let shape = points.shape();
        format!("Cloud({n} points on a grid of {} x {})", shape[1], shape[0])
    }
}

/// The point on each camera ray that the projector lights with this column, exactly with both lenses.
///
/// Newton on the depth along each ray against the distorted projector column, to 1e-11. Pixels without a column have no
/// point, nor have those whose point would lie behind either device or outside the projector's image.
///
/// Args:
///     column: (H, W), projector columns (rows for axis "y"), px; NaN for none. The camera's size.
///     scanner: `Scanner`. The camera's rays are computed once and kept in it.
///     sigma_px: (H, W), standard deviation of `column`; then `sigma_mm` along the ray follows by the derivative.
///     axis: "x" if `column` holds columns, "y" if it holds rows.
///
/// Returns:
///     Cloud: `points_mm` (H, W, 3) float64, scanner frame, NaN where none; `sigma_mm` (H, W) float32 or None.
///
/// Raises:
///     InputError: arrays that do not have the camera's size; another axis.
///
/// Example:
///     >>> import numpy as np
///     >>> from weldscan import Lens, Scanner, triangulate
///     >>> lens = Lens(64, 48, [[500, 0, 32], [0, 500, 24], [0, 0, 1]], [0, 0, 0, 0])
///     >>> pose = np.eye(4)
///     >>> pose[0, 3] = 10.0
///     >>> u = np.arange(64.0)[None, :].repeat(48, axis=0)
///     >>> cloud = triangulate(u - 12.5, Scanner(lens, lens, pose))
///     >>> float(np.nanmedian(cloud.points_mm[..., 2]))
///     400.0
#[pyfunction]
#[pyo3(signature = (column, scanner, sigma_px=None, axis="x"))]
fn triangulate(
    column: &Bound<'_, PyAny>,
    scanner: &Bound<'_, PyScanner>,
    sigma_px: Option<&Bound<'_, PyAny>>,
    axis: &str,
) -> PyResult<PyCloud> {
    let py = column.py();
    let axis = match axis {
        "x" => Axis::X,
        "y" => Axis::Y,
        other => {
            let value = format!("{other:?}");
            return Err(raise(py, &Error::OutOfRange { what: "axis", expected: "\"x\" or \"y\"".into(), value }));
        }
    };
    let column = float_matrix("column", column)?;
    let scanner = &scanner.get().scanner;
    let (h, w) = (scanner.camera.height, scanner.camera.width);
    let same_size = |what, shape: &[usize]| {
        let expected = format!("the camera's shape ({h}, {w})");
        if shape == [h, w] {
            Ok(())
        } else {
            Err(raise(py, &Error::Shape { what, expected, got: format!("{shape:?}") }))
        }
    };
    same_size("column", column.shape())?;
    let sigma: Option<PyReadonlyArray2<'_, f32>> = match sigma_px {
        Some(given) => {
            unmasked("sigma_px", given)?;
            let array = py.import("numpy")?.call_method1("ascontiguousarray", (given, "float32"));
            let array = array.ok().and_then(|a| a.cast_into::<PyArray2<f32>>().ok()).ok_or_else(|| {
                let got = given.get_type().to_string();
                raise(py, &Error::Shape { what: "sigma_px", expected: "an (H, W) array of numbers".into(), got })
            })?;
            same_size("sigma_px", array.shape())?;
            Some(array.readonly())
        }
        None => None,
    };
    let (column, sigma) = (column.as_slice()?, sigma.as_ref().map(|s| s.as_slice()).transpose()?);
    let cloud = compute(py, || core(column, scanner, sigma, axis))?;
    let points = PyArray1::from_vec(py, cloud.points_mm.into_flattened()).reshape([h, w, 3])?.unbind();
    let sigma_mm = sigma.map(|_| image(py, cloud.sigma_mm, h, w)).transpose()?;
    Ok(PyCloud { points_mm: points, sigma_mm })
}

/// A calibration of every pixel against planes of known height: 1/height = a + b/dphi.
#[pyclass(frozen, get_all, module = "weldscan", name = "ReferencePlane")]
pub(crate) struct PyReferencePlane {
    /// (H, W) float64, 1/mm. In the paper's geometry 1/distance.
    pub(crate) a: Py<PyArray2<f64>>,
    /// (H, W) float64, rad/mm. In the paper's geometry 2 pi baseline/(distance period).
    pub(crate) b: Py<PyArray2<f64>>,
    /// (H, W) float32, mm: root mean square error of the calibration heights.
    pub(crate) rms_mm: Py<PyArray2<f32>>,
}

#[pymethods]
impl PyReferencePlane {
    fn __repr__(&self, py: Python<'_>) -> String {
        format!("ReferencePlane(shape {:?})", self.a.bind(py).shape())
    }
}

/// Fits 1/height = a + b/dphi in every pixel to planes at known heights over the reference plane.
///
/// Minimised is the error in height, to first order; dphi = reference phase - phase (the paper's Eq. 1).
///
/// Args:
///     reference_phase: (H, W), absolute phase of the reference plane, rad.
///     phases: (planes, H, W), absolute phase of the other planes, rad; two or more.
///     heights_mm: height of each over the reference, towards the scanner, mm; not 0, not all equal.
///
/// Returns:
///     ReferencePlane: `a`, `b`, `rms_mm` (H, W), for `height_from_reference`. NaN where fewer than two planes are seen.
///
/// Raises:
///     InputError: sizes that do not fit; a height of zero. GeometryError: fewer than two planes, or all at one height.
///
/// Example:
///     >>> import numpy as np
///     >>> from weldscan import calibrate_reference_plane, height_from_reference
///     >>> seen = lambda h: np.full((1, 1), -2 * np.pi * 150 * h / (4 * (500 - h)))
///     >>> plane = calibrate_reference_plane(seen(0), [seen(10), seen(40)], [10, 40])
///     >>> float(height_from_reference(seen(25), seen(0), calibration=plane)[0, 0].round(9))
///     25.0
#[pyfunction]
fn calibrate_reference_plane(
    reference_phase: &Bound<'_, PyAny>,
    phases: &Bound<'_, PyAny>,
    heights_mm: &Bound<'_, PyAny>,
) -> PyResult<PyReferencePlane> {
    let py = reference_phase.py();
    let reference = float_matrix("reference_phase", reference_phase)?;
    let shape = reference.shape().to_vec();
    let heights_mm = numbers("heights_mm", heights_mm)?;
    unmasked("phases", phases)?;
    let planes = phases.try_iter()?.map(|p| float_matrix("phases", &p?)).collect::<PyResult<Vec<_>>>()?;
    if let Some(plane) = planes.iter().find(|p| p.shape() != shape) {
        let (expected, got) = (format!("the shape of reference_phase, {shape:?}"), format!("{:?}", plane.shape()));
        return Err(raise(py, &Error::Shape { what: "phases", expected, got }));
    }
    let slices = planes.iter().map(|p| p.as_slice()).collect::<Result<Vec<_>, _>>()?;
    let reference = reference.as_slice()?;
    let ReferencePlane { a, b, rms_mm } = compute(py, || calibrate_core(reference, &slices, &heights_mm))?;
    let (h, w) = (shape[0], shape[1]);
    Ok(PyReferencePlane { a: image(py, a, h, w)?, b: image(py, b, h, w)?, rms_mm: image(py, rms_mm, h, w)? })
}

/// Height over a reference plane from the difference of two phases, mm, towards the scanner.
///
/// dphi = phi_A - phi_C, the phase of the plane less that of the surface in the same pixel, is CA = dphi period/(2 pi) on
/// the plane; the similar triangles PID and CAD give height = distance CA/(baseline + CA). Camera and projector stand at
/// one distance from the plane there; a calibration of every pixel (`calibrate_reference_plane`) does without that, and
/// without the pitch. Neither knows a lens: `triangulate` does.
///
/// Args:
///     phase, reference_phase: (H, W), absolute phase of the surface and of the plane, rad.
///     baseline_mm: from camera to projector; positive where the phase grows in that direction.
///     distance_mm: of both from the plane.
///     period_mm: pitch of the fringes on the plane.
///     calibration: ReferencePlane, instead of the three.
///
/// Returns:
///     (H, W) float64, mm; NaN where a phase is NaN.
///
/// Raises:
///     InputError: sizes that do not fit; neither or both of geometry and calibration; a geometry that is none.
///
/// Source: the paper, Eq. 1 and Fig. 1.
///
/// Example:
///     >>> import numpy as np
///     >>> from weldscan import height_from_reference
///     >>> dphi = 2 * np.pi / 4 * 150 * 25 / (500 - 25)
///     >>> float(height_from_reference([[-dphi]], [[0]], baseline_mm=150, distance_mm=500, period_mm=4)[0, 0].round(9))
///     25.0
#[pyfunction]
#[pyo3(signature = (phase, reference_phase, *, baseline_mm=None, distance_mm=None, period_mm=None, calibration=None))]
fn height_from_reference(
    phase: &Bound<'_, PyAny>,
    reference_phase: &Bound<'_, PyAny>,
    baseline_mm: Option<f64>,
    distance_mm: Option<f64>,
    period_mm: Option<f64>,
    calibration: Option<&Bound<'_, PyReferencePlane>>,
) -> PyResult<Py<PyArray2<f64>>> {
    let py = phase.py();
    let (phase, reference) = (float_matrix("phase", phase)?, float_matrix("reference_phase", reference_phase)?);
    let shape = phase.shape().to_vec();
    let same = |what, got: &[usize]| {
        let expected = format!("the shape of phase, {shape:?}");
        if got == shape { Ok(()) } else { Err(raise(py, &Error::Shape { what, expected, got: format!("{got:?}") })) }
    };
    same("reference_phase", reference.shape())?;
    let (phase, reference) = (phase.as_slice()?, reference.as_slice()?);
    let out = match (baseline_mm, distance_mm, period_mm, calibration) {
        (Some(baseline_mm), Some(distance_mm), Some(period_mm), None) => {
            let geometry = ReferenceGeometry { baseline_mm, distance_mm, period_mm };
            compute(py, || height_core(phase, reference, &geometry))?
        }
        (None, None, None, Some(plane)) => {
            let plane = plane.get();
            let (a, b) = (plane.a.bind(py).readonly(), plane.b.bind(py).readonly());
            same("calibration", a.shape())?;
            let plane = ReferencePlane { a: a.as_slice()?.to_vec(), b: b.as_slice()?.to_vec(), rms_mm: Vec::new() };
            compute(py, || height_from_calibration(phase, reference, &plane))?
        }
        _ => {
            let expected = "baseline_mm, distance_mm and period_mm, or else calibration".into();
            let got = "another combination".into();
            return Err(raise(py, &Error::Shape { what: "height_from_reference", expected, got }));
        }
    };
    image(py, out, shape[0], shape[1])
}

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyCloud>()?;
    m.add_class::<PyReferencePlane>()?;
    m.add_function(wrap_pyfunction!(calibrate_reference_plane, m)?)?;
    m.add_function(wrap_pyfunction!(height_from_reference, m)?)?;
    m.add_function(wrap_pyfunction!(triangulate, m)?)
}
