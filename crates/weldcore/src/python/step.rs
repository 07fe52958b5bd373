//! The step for Python: what `measure_step` returns.

use numpy::{IntoPyArray, PyArray1, PyArray2, PyArrayMethods, PyUntypedArrayMethods};
use pyo3::exceptions::PyKeyError;
use pyo3::prelude::*;

use crate::error::Error;
use crate::python::call::{compute, raise};
use crate::python::convert::{Whole, float_matrix, parts, transform};
use crate::python::weld::WeldShot;
use crate::weld::place::{self, Scan};
use crate::weld::step::{self, Known, LabelledShot, Modes, OwnSurface, ProfileBin, Step, StepWave};

/// A column of the profile: its name, and what it holds of a bin.
type Column = (&'static str, fn(&ProfileBin) -> f64);

const COLUMNS: [Column; 8] = [
    ("angle_deg", |b| b.along),
    ("step_mm", |b| b.step_mm),
    ("standard_mm", |b| b.standard_mm),
    ("fit_mm", |b| b.fit_mm),
    ("unevenness_mm", |b| b.unevenness_mm),
    ("angle_mm", |b| b.place_mm),
    ("band_mm", |b| b.band_mm),
    ("departure", |b| b.departure),
];

/// The fields, which `step["mean_mm"]` gives as `step.mean_mm` does.
const FIELDS: [&str; 23] = [
    "mean_mm",
    "median_mm",
    "seam_mean_mm",
    "max_abs_mm",
    "max_abs_at_deg",
    "expanded_mm",
    "quantiles_mm",
    "band_factor",
    "coverage_deg",
    "radius_difference_mm",
    "axis_offset_mm",
    "axis_offset_standard_mm",
    "tilt_rad",
    "tilt_standard_rad",
    "waves_mm",
    "shape_degree",
    "shrinkage_mm",
    "residual_rms_mm",
    "correlation_mm",
    "effective_cells",
    "profile",
    "profile_columns",
    "covariance_mm2",
];

/// How large the largest step of some bins is: its median, the larger half of its 95 % interval, its quantiles 0, 1, ... 100 %, c.
type LargestOf<'py> = (f64, f64, Bound<'py, PyArray1<f64>>, f64);

/// Readings, steps and standard uncertainties.
type AloneArrays<'py> = (Bound<'py, PyArray1<f64>>, Bound<'py, PyArray1<f64>>, Bound<'py, PyArray1<f64>>);

/// The step of the other wall over the reference wall (see `measure_step`).
///
/// Each field also answers as an item, `step["mean_mm"]`, and each column of the profile by its name,
/// `step.column("step_mm")`.
#[pyclass(frozen, module = "weldscan")]
pub(crate) struct WeldStep(pub(crate) Step);

impl WeldStep {
    /// The reference wall's surface in the shot at place `k`.
    pub(crate) fn surface(&self, py: Python<'_>, k: usize) -> PyResult<&OwnSurface> {
        self.0.surfaces.get(k).ok_or_else(|| {
            let expected = format!("the place of one of the step's {} shots", self.0.surfaces.len());
            raise(py, &Error::OutOfRange { what: "shot", expected, value: k.to_string() })
        })
    }
}

/// A shot without a place, and without modes.
fn labelled(shot: &WeldShot) -> LabelledShot<'_> {
    LabelledShot {
        modes: None,
        unrolled: &shot.0.unrolled,
        labels: &shot.0.labels,
        seam: shot.0.seam,
        thickness_mm: shot.0.thickness_mm,
        base_from_scanner: None,
    }
}

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
    /// Mean step at the seam over the profile's bins, and its standard uncertainty (k = 1), mm.
    #[getter]
    fn seam_mean_mm(&self) -> (f64, f64) {
        self.0.seam_mean_mm
    }
    /// Largest |step| of the profile: the median of its distribution, mm.
    #[getter]
    fn max_abs_mm(&self) -> f64 {
        self.0.largest.about_median().0
    }
    /// Where the profile is largest, degrees.
    #[getter]
    fn max_abs_at_deg(&self) -> f64 {
        self.0.profile.get(self.0.largest.at).map_or(f64::NAN, |b| b.along)
    }
    /// Expanded uncertainty of `max_abs_mm`: the larger half of its 95 % interval, mm.
    #[getter]
    fn expanded_mm(&self) -> f64 {
        self.0.largest.about_median().1
    }
    /// (101,) float64, mm: quantiles of the largest |step|, 0, 1, ... 100 %.
    #[getter]
    fn quantiles_mm<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_slice(py, &self.0.largest.quantiles)
    }
    /// So many standard uncertainties hold all bins at once in 95 % of all cases.
    #[getter]
    fn band_factor(&self) -> f64 {
        self.0.largest.band_factor
    }
    /// The largest |step| of some of the profile's bins, given by their place in it: its median, the larger half of its 95 %
    /// interval, its quantiles 0, 1, ... 100 % (101,), mm, and the factor of their band. Raises InputError without bins.
    fn largest_of<'py>(&self, py: Python<'py>, bins: &Bound<'py, PyAny>) -> PyResult<LargestOf<'py>> {
        let bins: Vec<usize> = parts::<Vec<Whole>>("bins", "whole numbers", bins)?.iter().map(|w| w.0).collect();
        let Some(found) = compute(py, || Ok(self.0.largest_of(&bins)))? else {
            let expected = format!("some of the {} bins of the profile", self.0.profile.len());
            return Err(raise(py, &Error::OutOfRange { what: "bins", expected, value: format!("{bins:?}") }));
        };
        let (median, half) = found.about_median();
        Ok((median, half, PyArray1::from_vec(py, found.quantiles), found.band_factor))
    }
    /// Further Fourier terms of the step around the seam: a list of (n, cosine, sine, their standard uncertainties (k = 1), that of
    /// each before the scan), mm, for n = 2 and up.
    #[getter]
    fn waves_mm(&self) -> Vec<(usize, f64, f64, f64, f64, f64)> {
        let row = |w: &StepWave| {
            let ([c, s], [uc, us]) = (w.amplitude_mm, w.standard_mm);
            (w.n, c, s, uc, us, w.prior_mm)
        };
        self.0.waves.iter().map(row).collect()
    }
    /// (n, n) float64, mm²: covariance of the profile's steps, without what is not known of the angle.
    #[getter]
    fn covariance_mm2<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let n = self.0.profile.len();
        PyArray1::from_slice(py, &self.0.covariance_mm2).reshape([n, n])
    }
    /// From which size of the profile's `departure` on the walls do not run on to the cap as they run further away.
    #[getter]
    fn departure_limit(&self) -> f64 {
        self.0.departure_limit
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
    /// The highest Fourier term of the step that stands out of its uncertainty; 1 where none does.
    #[getter]
    fn shape_degree(&self) -> usize {
        let told = |w: &&StepWave| w.amplitude_mm.iter().zip(w.standard_mm).any(|(a, u)| a.abs() > 3.0 * u);
        self.0.waves.iter().filter(told).map(|w| w.n).max().unwrap_or(1)
    }
    /// What the weld drew the reference wall and the other wall in, mm.
    #[getter]
    fn shrinkage_mm(&self) -> [f64; 2] {
        self.0.shrinkage_mm.map(|(value, _)| -value)
    }
    /// Rms of the walls' cells about the model, mm.
    #[getter]
    fn residual_rms_mm(&self) -> f64 {
        self.0.residual_rms_mm
    }
    /// Where the correlation of the less even wall's unevenness ends (below 0.04), along and across the seam, mm.
    #[getter]
    fn correlation_mm(&self) -> [f64; 2] {
        let [first, second] = &self.0.unevenness;
        let wall = if first.sd_mm > second.sd_mm { first } else { second };
        wall.reach_mm.map(|length| 3.0 * length)
    }
    /// Of each wall, reference wall first: standard deviation of the unevenness (mm), its reach along and across the seam (mm), and
    /// the variance of a cell over what the scatter of its points makes of it.
    #[getter]
    fn unevenness(&self) -> [(f64, f64, f64, f64); 2] {
        self.0.unevenness.map(|u| (u.sd_mm, u.reach_mm[0], u.reach_mm[1], u.noise))
    }
    /// How many independent cells on each wall would tell the mean step as well.
    #[getter]
    fn effective_cells(&self) -> f64 {
        2.0 * (self.0.residual_rms_mm / self.0.seam_mean_mm.1).powi(2)
    }
    /// (n, 8) float64: the bins in order along the seam, with the columns `profile_columns`.
    #[getter]
    fn profile<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let bins = &self.0.profile;
        let flat: Vec<f64> = bins.iter().flat_map(|bin| COLUMNS.map(|(_, of)| of(bin))).collect();
        flat.into_pyarray(py).reshape([bins.len(), COLUMNS.len()])
    }
    /// Names of the profile's columns: place of the bin (degrees), step, its standard uncertainty (k = 1) and that one's parts, half
    /// width of the band that holds all bins at once (mm), and by how many standard uncertainties the step beside the cap departs from
    /// what the walls further away predict.
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
    /// How far every point of a shot stands off the reference wall, (H * W,) float32, mm: `shot` is the one at place `k` of those
    /// that the step was measured on. Raises InputError where there is none.
    fn deviation_of<'py>(&self, py: Python<'py>, shot: &WeldShot, k: Whole) -> PyResult<Bound<'py, PyArray1<f32>>> {
        let surface = self.surface(py, k.0)?;
        Ok(compute(py, || Ok(surface.deviations(&shot.0.unrolled)))?.into_pyarray(py))
    }
    /// The step as one shot tells it by itself, in its own frame: readings (n,), step and standard uncertainty (k = 1, mm), bin by
    /// bin. What its walls' unevenness is like comes from all shots. Raises GeometryError where its walls do not determine it.
    #[pyo3(signature = (shot, angle_sigma_rad=0.0))]
    fn alone<'py>(&self, py: Python<'py>, shot: &WeldShot, angle_sigma_rad: f64) -> PyResult<AloneArrays<'py>> {
        let known = Known { at: angle_sigma_rad };
        let found = compute(py, || step::alone(&labelled(shot), &known, &self.0.unevenness))?;
        let column = |k: usize| found.iter().map(|b| b[k]).collect::<Vec<f64>>().into_pyarray(py);
        Ok((column(0), column(1), column(2)))
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
        let ((most, u), at) = (self.0.largest.about_median(), self.max_abs_at_deg());
        format!("WeldStep(max_abs_mm={most:.3}, expanded_mm={u:.3}, at_deg={at:.1}, bins={})", self.0.profile.len())
    }
}

/// Measures the step of the other wall over the reference wall on all shots together.
///
/// shots: a list of WeldShot. angle_sigma_rad: standard uncertainty of the angle about the axis (k = 1). base_from_scanner: a (4, 4)
/// matrix per shot; without them the frames of the shots' seams are taken for one. calibration_modes: of every shot points, by their
/// place in it, (n,) int64, and how far each mode of the scanner's covariance moves them along the surface's normal, (n, m) float64,
/// mm: unknowns of unit variance, common to all shots. Returns a WeldStep. Raises InputError where there is not one matrix, or one
/// set of modes, per shot, GeometryError where the walls do not determine the step. Source:
/// `crates/weldcore/src/weld/step/mod.rs`.
#[pyfunction]
#[pyo3(signature = (shots, angle_sigma_rad=0.0, base_from_scanner=None, calibration_modes=None))]
fn measure_step(
    py: Python<'_>,
    shots: Vec<PyRef<'_, WeldShot>>,
    angle_sigma_rad: f64,
    base_from_scanner: Option<Vec<Bound<'_, PyAny>>>,
    calibration_modes: Option<Bound<'_, PyAny>>,
) -> PyResult<WeldStep> {
    const NAME: &str = "base_from_scanner";
    const MODES: &str = "calibration_modes";
    let poses = match base_from_scanner {
        Some(given) if given.len() != shots.len() => {
            let (expected, got) = (format!("{} matrices, one per shot", shots.len()), given.len().to_string());
            return Err(raise(py, &Error::Shape { what: NAME, expected, got }));
        }
        Some(given) => {
            let one = |m: &Bound<'_, PyAny>| transform(NAME, &float_matrix(NAME, m)?).map(Some);
            given.iter().map(one).collect::<PyResult<Vec<_>>>()?
        }
        None => vec![None; shots.len()],
    };
    let given = calibration_modes
        .map(|m| {
            parts::<Vec<(Vec<Whole>, Bound<'_, PyAny>)>>(
                MODES,
                "numbers of points and their modes, a pair per shot",
                &m,
            )
        })
        .transpose()?;
    let modes = match &given {
        Some(given) if given.len() != shots.len() => {
            let (expected, got) = (format!("{} sets, one per shot", shots.len()), given.len().to_string());
            return Err(raise(py, &Error::Shape { what: MODES, expected, got }));
        }
        Some(given) => given
            .iter()
            .map(|(points, rows)| {
                let rows = float_matrix(MODES, rows)?;
                let points: Vec<usize> = points.iter().map(|w| w.0).collect();
                Ok((points, rows.as_array().iter().copied().collect::<Vec<f64>>(), rows.shape()[1]))
            })
            .collect::<PyResult<Vec<_>>>()?,
        None => Vec::new(),
    };
    let views: Vec<LabelledShot> = shots
        .iter()
        .zip(poses)
        .enumerate()
        .map(|(k, (s, base_from_scanner))| LabelledShot {
            modes: modes.get(k).map(|(points, rows, count)| Modes { points, deviation_mm: rows, count: *count }),
            base_from_scanner,
            ..labelled(s)
        })
        .collect();
    let known = Known { at: angle_sigma_rad };
    compute(py, || step::measure(&views, &known)).map(WeldStep)
}

/// The arrays of `place_shots`: points, labels, deviation, angle, axial, shot; and how many points have each label.
type PlacedArrays<'py> = (
    Bound<'py, PyArray2<f64>>,
    Bound<'py, PyArray1<u8>>,
    Bound<'py, PyArray1<f32>>,
    Bound<'py, PyArray1<f32>>,
    Bound<'py, PyArray1<f32>>,
    Bound<'py, PyArray1<u16>>,
    Vec<usize>,
);

/// Joins the shots that a step was measured on into one cloud in base.
///
/// step: a WeldStep. shots: list of (WeldShot, base_from_scanner (4, 4) float64, number), in the order in which the step has them.
/// cell_mm: keeps one point of every cell of this size of the unrolled part, that of the first shot that saw it; None: all. Returns
/// arrays over the points, in order of the shots and pixels: points_mm (n, 3) float64 in base, label uint8, deviation_mm float32 from
/// the reference wall, angle_deg float32 in [0, 360), axial_mm float32, shot uint16; and of all points, kept or not, how many have
/// each label. Raises InputError for more shots than the step has, and for a size that is none. Source:
/// `crates/weldcore/src/weld/place.rs`.
#[pyfunction]
#[pyo3(signature = (step, shots, cell_mm=None))]
fn place_shots<'py>(
    py: Python<'py>,
    step: &WeldStep,
    shots: &Bound<'py, PyAny>,
    cell_mm: Option<f64>,
) -> PyResult<PlacedArrays<'py>> {
    let expected = "a list of (WeldShot, base_from_scanner, number)";
    let shots: Vec<(PyRef<'py, WeldShot>, Bound<'py, PyAny>, Whole)> = parts("shots", expected, shots)?;
    let mut scans = Vec::with_capacity(shots.len());
    for (k, (shot, base_from_scanner, number)) in shots.iter().enumerate() {
        const NAME: &str = "base_from_scanner";
        scans.push(Scan {
            base_from_scanner: transform(NAME, &float_matrix(NAME, base_from_scanner)?)?,
            unrolled: &shot.0.unrolled,
            seam: shot.0.seam,
            labels: &shot.0.labels,
            surface: step.surface(py, k)?,
            shot: u16::try_from(number.0).map_err(|_| {
                let expected = "0 to 65535".into();
                raise(py, &Error::OutOfRange { what: "number of a shot", expected, value: number.0.to_string() })
            })?,
        });
    }
    let placed = compute(py, || place::place(&scans, cell_mm))?;
    let points = placed.points.into_pyarray(py).reshape([placed.labels.len(), 3])?;
    Ok((
        points,
        placed.labels.into_pyarray(py),
        placed.deviation_mm.into_pyarray(py),
        placed.along.into_pyarray(py),
        placed.across_mm.into_pyarray(py),
        placed.shot.into_pyarray(py),
        placed.counts.to_vec(),
    ))
}

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<WeldStep>()?;
    m.add_function(wrap_pyfunction!(place_shots, m)?)?;
    m.add_function(wrap_pyfunction!(measure_step, m)?)
}
