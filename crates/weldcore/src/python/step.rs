//! The step for Python: what `measure_step` returns.

use numpy::{IntoPyArray, PyArray1, PyArray2, PyArrayMethods};
use pyo3::exceptions::PyKeyError;
use pyo3::prelude::*;

use crate::error::Error;
use crate::python::call::{compute, raise};
use crate::python::weld::WeldShot;
use crate::weld::step::{self, Known, LabelledShot, ProfileBin, Step};

/// A column of the profile: its name, and what it holds of a bin.
type Column = (&'static str, fn(&ProfileBin) -> f64);

const COLUMNS: [Column; 9] = [
    ("angle_deg", |b| b.along),
    ("seen_at_deg", |b| b.seen_along),
    ("step_mm", |b| b.step_mm),
    ("standard_mm", |b| b.standard_mm),
    ("fit_mm", |b| b.fit_mm),
    ("toe_mm", |b| b.toe_mm),
    ("local_mm", |b| b.local_mm),
    ("angle_mm", |b| b.place_mm),
    ("unevenness_mm", |b| b.unevenness_mm),
];

/// The fields, which `step["mean_mm"]` gives as `step.mean_mm` does.
const FIELDS: [&str; 19] = [
    "mean_mm",
    "median_mm",
    "max_abs_mm",
    "max_abs_at_deg",
    "expanded_mm",
    "coverage_deg",
    "radius_difference_mm",
    "axis_offset_mm",
    "axis_offset_standard_mm",
    "tilt_rad",
    "tilt_standard_rad",
    "shape_degree",
    "shrinkage_mm",
    "residual_rms_mm",
    "correlation_mm",
    "effective_cells",
    "profile",
    "profile_columns",
    "deviation_mm",
];

/// The step of the other wall over the reference wall (see `measure_step`).
///
/// Each field also answers as an item, `step["mean_mm"]`, and each column of the profile by its name,
/// `step.column("step_mm")`.
#[pyclass(frozen, module = "weldscan")]
pub(crate) struct WeldStep(pub(crate) Step);

#[pymethods]
impl WeldStep {
    /// Mean of the other wall's height over the reference wall, over its points, mm.
    #[getter]
    fn mean_mm(&self) -> f64 {
        self.0.mean_mm
    }
    /// Median of the same, mm.
    #[getter]
    fn median_mm(&self) -> f64 {
        self.0.median_mm
    }
    /// Largest |step| of the profile, mm.
    #[getter]
    fn max_abs_mm(&self) -> f64 {
        self.0.max_abs_mm
    }
    /// Where that is, degrees.
    #[getter]
    fn max_abs_at_deg(&self) -> f64 {
        self.0.max_abs_at
    }
    /// Expanded uncertainty (k = 2) of `max_abs_mm`, mm.
    #[getter]
    fn expanded_mm(&self) -> f64 {
        self.0.expanded_mm
    }
    /// How much of the seam was seen on both walls, degrees.
    #[getter]
    fn coverage_deg(&self) -> f64 {
        self.0.coverage
    }
    /// Radius of the other wall less that of the reference wall, and its standard uncertainty (k = 1), mm.
    #[getter]
    fn radius_difference_mm(&self) -> (f64, f64) {
        self.0.curvature_mm
    }
    /// Offset of the other wall's axis at the seam, towards 0 and 90 degrees, mm.
    #[getter]
    fn axis_offset_mm(&self) -> [f64; 2] {
        self.0.offset_mm
    }
    /// Standard uncertainty (k = 1) of that offset along its own direction, mm.
    #[getter]
    fn axis_offset_standard_mm(&self) -> f64 {
        self.0.offset_standard_mm
    }
    /// Angle between the walls' axes, rad.
    #[getter]
    fn tilt_rad(&self) -> f64 {
        self.0.tilt_rad
    }
    /// Its standard uncertainty (k = 1), rad.
    #[getter]
    fn tilt_standard_rad(&self) -> f64 {
        self.0.tilt_standard_rad
    }
    /// Legendre degree up to which the walls' shape was needed (2: their own surfaces suffice).
    #[getter]
    fn shape_degree(&self) -> usize {
        self.0.shape_degree
    }
    /// What the weld drew the reference wall and the other wall in, mm; 0 where the data do not show it.
    #[getter]
    fn shrinkage_mm(&self) -> [f64; 2] {
        self.0.shrinkage_mm
    }
    /// Rms of the walls' cells about the model, mm.
    #[getter]
    fn residual_rms_mm(&self) -> f64 {
        self.0.residual_rms_mm
    }
    /// Where the correlation of the walls' unevenness ends, along and across the seam, mm.
    #[getter]
    fn correlation_mm(&self) -> [f64; 2] {
        self.0.correlation_mm
    }
    /// Effective number of independent cells.
    #[getter]
    fn effective_cells(&self) -> f64 {
        self.0.effective_cells
    }
    /// (n, 9) float64: the bins in order along the seam, with the columns `profile_columns`.
    #[getter]
    fn profile<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let bins = &self.0.profile;
        let flat: Vec<f64> = bins.iter().flat_map(|bin| COLUMNS.map(|(_, of)| of(bin))).collect();
        flat.into_pyarray(py).reshape([bins.len(), COLUMNS.len()])
    }
    /// Names of the profile's columns: place of the bin and mean place of what was seen of it (degrees), step, its standard
    /// uncertainty (k = 1) and that one's parts (mm).
    #[getter]
    fn profile_columns(&self) -> Vec<&'static str> {
        COLUMNS.iter().map(|(name, _)| *name).collect()
    }
    /// One column of the profile, (n,) float64. Raises InputError for a name that `profile_columns` does not hold.
    fn column<'py>(&self, py: Python<'py>, name: &str) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let Some((_, of)) = COLUMNS.iter().find(|(known, _)| *known == name) else {
            let expected = format!("one of {}", COLUMNS.map(|(known, _)| known).join(", "));
            return Err(raise(py, &Error::OutOfRange { what: "name of a column", expected, value: name.into() }));
        };
        Ok(self.0.profile.iter().map(of).collect::<Vec<f64>>().into_pyarray(py))
    }
    /// Per shot (H * W,) float32, mm: how far every point stands off the corrected reference wall.
    #[getter]
    fn deviation_mm<'py>(&self, py: Python<'py>) -> Vec<Bound<'py, PyArray1<f32>>> {
        self.0.deviation_mm.iter().map(|d| PyArray1::from_slice(py, d)).collect()
    }
    /// Names of the fields, so that `dict(step)` holds them all.
    fn keys(&self) -> [&'static str; FIELDS.len()] {
        FIELDS
    }
    fn __getitem__<'py>(slf: &Bound<'py, Self>, name: &str) -> PyResult<Bound<'py, PyAny>> {
        if !FIELDS.contains(&name) {
            return Err(PyKeyError::new_err(name.to_string()));
        }
        slf.getattr(name)
    }
    fn __repr__(&self) -> String {
        let (most, u, at) = (self.0.max_abs_mm, self.0.expanded_mm, self.0.max_abs_at);
        format!("WeldStep(max_abs_mm={most:.3}, expanded_mm={u:.3}, at_deg={at:.1}, bins={})", self.0.profile.len())
    }
}

/// Measures the step of the other wall over the reference wall on all shots together.
///
/// shots: a list of WeldShot. angle_sigma_rad: standard uncertainty of the angle about the axis (k = 1). Returns a WeldStep.
/// Raises GeometryError where the walls do not determine it. Source: `crates/weldcore/src/weld/step/mod.rs`.
#[pyfunction]
#[pyo3(signature = (shots, angle_sigma_rad=0.0))]
fn measure_step(py: Python<'_>, shots: Vec<PyRef<'_, WeldShot>>, angle_sigma_rad: f64) -> PyResult<WeldStep> {
    let views: Vec<LabelledShot> = shots
        .iter()
        .map(|s| LabelledShot {
            unrolled: &s.0.unrolled,
            labels: &s.0.labels,
            course: s.0.seam.course,
            bead_width_mm: s.0.bead_width_mm,
            thickness_mm: s.0.thickness_mm,
        })
        .collect();
    let known = Known { at: angle_sigma_rad };
    compute(py, || step::measure(&views, &known)).map(WeldStep)
}

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<WeldStep>()?;
    m.add_function(wrap_pyfunction!(measure_step, m)?)
}
