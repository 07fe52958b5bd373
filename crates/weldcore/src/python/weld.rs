//! Segmentation and step for Python: the two calls of `weldscan.measure.inspection`.

mod agreement;
mod paper;
mod whitening;

use numpy::{
    IntoPyArray, IxDyn, PyArray1, PyArray2, PyArray3, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2,
    PyReadonlyArrayDyn, PyUntypedArrayMethods,
};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::error::Error;
use crate::ground::transform::Vec3;
use crate::python::call::{compute, raise};
use crate::python::convert::vector;
use crate::python::convert::{Whole, floats, parts, unmasked};
use crate::python::seam::PySeam;
use crate::weld::sections::Station;
use crate::weld::segment::{self, Segmentation};
use crate::weld::{Course, Nominal};

/// One part shot, cut into reference wall, other wall and bead (see `segment_weld`).
#[pyclass(frozen, module = "weldscan")]
pub(crate) struct WeldShot(pub(crate) Segmentation);

#[pymethods]
impl WeldShot {
    /// The seam's frame, on the surface of the reference wall: what turns points into along, across, height.
    #[getter]
    fn seam(&self) -> PySeam {
        PySeam(self.0.seam)
    }
    /// (3,) float64, mm: on the axis at the seam's centreline, frame of the points.
    #[getter]
    fn origin_mm<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_slice(py, self.0.seam.origin_mm.as_slice())
    }
    /// (3,) float64, unit: from the reference wall to the other wall.
    #[getter]
    fn axis<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_slice(py, self.0.seam.across.as_slice())
    }
    /// (3,) float64, unit: towards angle 0.
    #[getter]
    fn zero<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_slice(py, self.0.seam.zero.as_slice())
    }
    /// Radius of the reference wall, mm.
    #[getter]
    fn radius_mm(&self) -> f64 {
        self.0.seam.course.radius_mm()
    }
    /// Whether the radius was fitted; False: the arc is too short for that and the nominal one was used.
    #[getter]
    fn radius_fitted(&self) -> bool {
        self.0.course_fitted
    }
    /// Noise of one point across the wall, mm (robust, 1 sigma).
    #[getter]
    fn noise_mm(&self) -> f64 {
        self.0.noise_mm
    }
    /// Mean distance between the weld's toes, mm.
    #[getter]
    fn bead_width_mm(&self) -> f64 {
        self.0.bead_width_mm
    }
    /// (H * W,) uint8: `weldscan.result.Label` per pixel.
    #[getter]
    fn labels<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<u8>> {
        PyArray1::from_slice(py, &self.0.labels)
    }
    /// (H * W,) float32, rad, in [-pi, pi]; NaN without a point.
    #[getter]
    fn angle_rad<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        PyArray1::from_slice(py, &self.0.unrolled.at)
    }
    /// (H * W,) float32, mm from the seam's centreline; the reference wall is negative.
    #[getter]
    fn axial_mm<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        PyArray1::from_slice(py, &self.0.unrolled.across_mm)
    }
    /// (H * W,) float32, mm: radial deviation from the reference wall's cylinder.
    #[getter]
    fn deviation_mm<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        PyArray1::from_slice(py, &self.0.unrolled.height_mm)
    }
    /// Some of the points again, (n, 3) float64, mm, in the scanner's frame, by their place in the shot, (n,) int64; to a ten-thousandth
    /// of a millimetre, for the shot keeps them in single precision. NaN where there is none. Raises InputError for a place beyond
    /// the last.
    fn points_mm<'py>(&self, py: Python<'py>, indices: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        const NAME: &str = "indices";
        unmasked(NAME, indices)?;
        let indices: Vec<usize> = match indices.cast::<PyArray1<i64>>() {
            // An array is not taken apart number by number; what lies below 0 is beyond the last.
            Ok(array) => {
                array.readonly().as_array().iter().map(|&i| usize::try_from(i).unwrap_or(usize::MAX)).collect()
            }
            Err(_) => parts::<Vec<Whole>>(NAME, "whole numbers", indices)?.iter().map(|w| w.0).collect(),
        };
        let flat = compute(py, || self.0.points(&indices))?;
        let n = flat.len() / 3;
        flat.into_pyarray(py).reshape([n, 3])
    }
    /// (H * W,) uint8: what became of each point: 0 none, 1 wall, 2 transition, 3 cap, 4 gated, 5 off line, 6 other.
    #[getter]
    fn fates<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<u8>> {
        PyArray1::from_slice(py, &self.0.fates)
    }
    /// The cross-sections along the seam: a dict of arrays over the stations (n,), NaN for what is not known: `along`
    /// (middle of the station, as a reading of the seam; also as `angle_deg`), `seen` (bool), `kind` (uint8: 0 unknown, 1 raised, 2 hollow, 3 flush), `by_course` (bool: the
    /// toes are those of the seam's course), `toes_mm` (n, 2) from the seam's centreline, reference side first, with their standard uncertainty
    /// `toes_standard_mm` (n, 2), `height_mm` of the cap, `edge_step_mm` (other over reference, right beside the toes), `edge_standard_mm` (k = 1), `edge_hull_mm` (what the
    /// choice of the toes may hide, in full), `local_step_mm` (how far the surfaces' step is off that of both neighbours read at the
    /// same places, 0 where that is noise), `undisturbed_mm` (n, 2): from where outward the walls are undisturbed,
    /// `departure_mm` (n, 2): of the transition from the straight wall, `wall_step_mm` of both straight walls.
    #[getter]
    fn sections<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let stations = &self.0.sections.stations;
        let out = PyDict::new(py);
        let one = |pick: &dyn Fn(&Station) -> Option<f64>| -> Bound<'py, PyArray1<f64>> {
            stations.iter().map(|s| pick(s).unwrap_or(f64::NAN)).collect::<Vec<f64>>().into_pyarray(py)
        };
        let two = |pick: &dyn Fn(&Station) -> [Option<f64>; 2]| -> PyResult<Bound<'py, PyArray2<f64>>> {
            let flat: Vec<f64> = stations.iter().flat_map(|s| pick(s).map(|v| v.unwrap_or(f64::NAN))).collect();
            flat.into_pyarray(py).reshape([stations.len(), 2])
        };
        let course = self.0.seam.course;
        let along = one(&|s| Some(course.reading(s.at)));
        out.set_item("along", &along)?;
        out.set_item("angle_deg", along)?;
        out.set_item("seen", stations.iter().map(|s| s.seen).collect::<Vec<bool>>().into_pyarray(py))?;
        out.set_item("kind", stations.iter().map(|s| s.kind as u8).collect::<Vec<u8>>().into_pyarray(py))?;
        out.set_item("by_course", stations.iter().map(|s| s.by_course).collect::<Vec<bool>>().into_pyarray(py))?;
        out.set_item("toes_mm", two(&|s| s.toes_mm.map_or([None; 2], |t| t.map(Some)))?)?;
        out.set_item("toes_standard_mm", two(&|s| s.toes_mm.map_or([None; 2], |_| s.toes_standard_mm.map(Some)))?)?;
        out.set_item("height_mm", one(&|s| s.toes_mm.map(|_| s.height_mm)))?;
        out.set_item("edge_step_mm", one(&|s| s.edge.map(|e| e.step_mm)))?;
        out.set_item("edge_standard_mm", one(&|s| s.edge.map(|e| e.standard_mm)))?;
        out.set_item("edge_hull_mm", one(&|s| s.edge.map(|e| e.hull_mm)))?;
        out.set_item("local_step_mm", one(&|s| s.local_step_mm))?;
        out.set_item("undisturbed_mm", two(&|s| s.undisturbed_mm)?)?;
        out.set_item("departure_mm", two(&|s| s.departure_mm.map(Some))?)?;
        out.set_item("wall_step_mm", one(&|s| s.wall_step_mm))?;
        Ok(out)
    }
    /// Length of a station of `sections` along the seam, mm.
    #[getter]
    fn station_mm(&self) -> f64 {
        self.0.sections.station_mm
    }
    /// Why the weld's edges may not be what they seem: a list of (code, angle in degrees, text).
    #[getter]
    fn doubts(&self) -> Vec<(&'static str, f64, String)> {
        let doubts = self.0.sections.doubts.iter();
        doubts.map(|d| (d.code, self.0.seam.course.reading(d.at), d.text.clone())).collect()
    }
    fn __repr__(&self) -> String {
        let count = |l: u8| self.0.labels.iter().filter(|x| **x == l).count();
        format!("WeldShot(reference_wall={}, other_wall={}, bead={})", count(1), count(2), count(3))
    }
}

fn direction(py: Python<'_>, what: &'static str, given: Option<&Bound<'_, PyAny>>) -> PyResult<Option<Vec3>> {
    let Some(given) = given else { return Ok(None) };
    let v = Vec3::from(vector(what, given)?);
    match v.try_normalize(0.0).filter(|u| u.iter().all(|c| c.is_finite())) {
        Some(u) => Ok(Some(u)),
        None => Err(raise(py, &Error::Degenerate { what, reason: "it has no direction".into() })),
    }
}

/// Cuts one part shot into reference wall, other wall and bead, without seeds.
///
/// points_mm: (H, W, 3) float64, NaN where there is no point, or a cloud (n, 3) in any order; one frame (the scanner's: the
/// scanner stands at its origin).
/// radius_mm, wall_thickness_mm: the pipe's nominal ones. axis: (3,), from the reference wall to the other wall, in the
/// frame of the points, within some degrees; None: from the points. zero: (3,), towards angle 0; None: angle 0 faces the
/// scanner. Returns a WeldShot. Raises InputError on bad arguments, GeometryError with the reason where no weld or
/// only one wall is in view. Source: `crates/weldcore/src/segment.rs`.
#[pyfunction]
#[pyo3(signature = (points_mm, radius_mm, wall_thickness_mm, axis=None, zero=None))]
fn segment_weld(
    py: Python<'_>,
    points_mm: &Bound<'_, PyAny>,
    radius_mm: f64,
    wall_thickness_mm: f64,
    axis: Option<&Bound<'_, PyAny>>,
    zero: Option<&Bound<'_, PyAny>>,
) -> PyResult<WeldShot> {
    let points_mm = floats::<IxDyn>("points_mm", points_mm)?;
    let wrong = |got: String| {
        let expected = "an array of shape (H, W, 3) or (n, 3)".into();
        raise(py, &Error::Shape { what: "points_mm", expected, got })
    };
    let width = match *points_mm.shape() {
        [_, 3] => 1,
        [_, width, 3] => width,
        ref shape => return Err(wrong(format!("shape {shape:?}"))),
    };
    let points = points_mm.as_slice().map_err(|_| wrong("strided".into()))?.as_chunks::<3>().0;
    let (axis, zero) = (direction(py, "axis", axis)?, direction(py, "zero", zero)?);
    let segmented = compute(py, || {
        let course = Course::of_radius(radius_mm)?;
        segment::segment(points, width, &Nominal { course, wall_thickness_mm, axis, zero })
    });
    segmented.map(WeldShot)
}

/// A part shot whose walls are known: takes the place of `segment_weld` where somebody else has labelled the points.
///
/// points_mm: (n, 3) float64, one frame. labels: (n,) uint8, `weldscan.result.Label` per point. seam: a SeamFrame, right to some
/// millimetres; the reference wall's surface is fitted, the centreline is taken as given. Returns a WeldShot without sections. Raises
/// InputError on bad arguments, GeometryError where the reference wall does not determine its surface.
#[pyfunction]
fn label_weld(
    py: Python<'_>,
    points_mm: &Bound<'_, PyAny>,
    labels: PyReadonlyArray1<'_, u8>,
    seam: &PySeam,
    wall_thickness_mm: f64,
) -> PyResult<WeldShot> {
    let points_mm = floats("points_mm", points_mm)?;
    let (points, near) = (flat(py, &points_mm)?, seam.0);
    let labels = labels.as_slice()?;
    compute(py, || segment::labelled(points, labels, &near, wall_thickness_mm)).map(WeldShot)
}

/// A shot's points, float64 of n x 3 whatever its shape, as the core's points.
fn flat<'a>(py: Python<'_>, array: &'a PyReadonlyArrayDyn<'_, f64>) -> PyResult<&'a [[f64; 3]]> {
    let wrong = |got: String| {
        let expected = "a C-contiguous float64 array of shape (..., 3)".into();
        raise(py, &Error::Shape { what: "points_mm", expected, got })
    };
    if array.shape().last() != Some(&3) {
        return Err(wrong(format!("shape {:?}", array.shape())));
    }
    Ok(array.as_slice().map_err(|_| wrong("strided".into()))?.as_chunks::<3>().0)
}

/// The tables of `seam_fates`.
type Tables<'py> = (Bound<'py, PyArray2<u32>>, Bound<'py, PyArray2<u32>>, Bound<'py, PyArray3<u32>>);

/// Counts what became of every pixel of a part shot, bin by bin along the seam.
///
/// shot: WeldShot. reason: (H, W) uint8, as `PhaseMap.reason`. scanner: whose camera took it. Returns two (180, 12) uint32
/// arrays over the bins of 2 degrees (centred on even ones) and `weldscan.result.FATES`: of all pixels, and of those on the
/// weld and within 8 mm of its toes; and (180, cells, 2) uint32 of the latter in equal cells of about half a station: pixels,
/// and those with a point. A pixel without a point lies where its ray meets the reference wall's cylinder. Raises
/// InputError where the arrays are not those of one image. Source: `crates/weldcore/src/seam_fates.rs`.
#[pyfunction]
fn seam_fates<'py>(
    py: Python<'py>,
    shot: PyRef<'py, WeldShot>,
    reason: PyReadonlyArray2<'py, u8>,
    scanner: PyRef<'py, crate::python::scanner::lens::PyScanner>,
) -> PyResult<Tables<'py>> {
    let strided = |_| raise(py, &Error::Shape { what: "reason", expected: "contiguous".into(), got: "strided".into() });
    let reasons = reason.as_slice().map_err(strided)?;
    let (shot, camera) = (&shot.0, &scanner.scanner.camera);
    let found = compute(py, || crate::weld::seam_fates::seam_fates(shot, reasons, camera))?;
    let table = |rows: Vec<[u32; crate::weld::seam_fates::FATES]>| {
        let n = rows.len();
        rows.into_flattened().into_pyarray(py).reshape([n, crate::weld::seam_fates::FATES])
    };
    let shape = [found.all.len(), found.cells.len() / found.all.len(), 2];
    let cells = found.cells.into_flattened().into_pyarray(py).reshape(shape)?;
    Ok((table(found.all)?, table(found.near)?, cells))
}

/// Looks at the reference wall of a segmented shot: how far it tells the direction and place of a cylinder fitted to it.
///
/// Returns (angle in the middle of its arc (rad), half the arc (rad), standard deviation of along * sin(angle) (mm), rms of the
/// unevenness that is neither the same all along nor all around (mm)), or None where there is no wall. Source:
/// `crates/weldcore/src/weld/agreement.rs`.
#[pyfunction]
fn wall_seen(py: Python<'_>, shot: PyRef<'_, WeldShot>) -> PyResult<Option<(f64, f64, f64, f64)>> {
    let shot = &shot.0;
    let found = compute(py, || Ok(crate::weld::agreement::wall_seen(shot)))?;
    Ok(found.map(|w| (w.middle_rad, w.half_arc_rad, w.twist_mm, w.waves_mm)))
}

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    agreement::register(m)?;
    paper::register(m)?;
    whitening::register(m)?;
    m.add_function(wrap_pyfunction!(seam_fates, m)?)?;
    m.add_class::<WeldShot>()?;
    m.add_function(wrap_pyfunction!(wall_seen, m)?)?;
    m.add_function(wrap_pyfunction!(segment_weld, m)?)?;
    m.add_function(wrap_pyfunction!(label_weld, m)?)
}
