//! The seam's frame for Python: what else there is behind it asks it for places, lengths, bins and labels.

use numpy::ndarray::Ix1;
use numpy::{IntoPyArray, PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;

use crate::error::Error;
use crate::ground::threads;
use crate::ground::transform::Vec3;
use crate::python::call::{compute, raise};
use crate::python::convert::{array, float_matrix, floats, points, transform, vector, words};
use crate::weld::{Course, Seam};

type Numbers<'py> = Bound<'py, PyArray1<f64>>;

/// How a seam runs, and how places along it are counted.
///
/// A place is kept as `at`, in the seam's own parameter (of a closed seam the angle, rad); people read a `reading` of it
/// (degrees from the zero mark). Bins are numbered from 0 and centred on multiples of `bin_width`.
///
/// Args:
///     radius_mm: of the reference wall's surface.
///
/// Raises:
///     InputError: a radius that is none.
///
/// Example:
///     >>> from weldscan._weldcore import SeamCourse
///     >>> course = SeamCourse(200.0)
///     >>> course.bins, course.bin_width, course.unit
///     (180, 2.0, '°')
///     >>> round(course.along_mm(course.at(90.0)), 3)
///     314.159
#[pyclass(frozen, module = "weldscan", name = "SeamCourse")]
pub(crate) struct PyCourse(pub(crate) Course);

#[pymethods]
impl PyCourse {
    #[new]
    fn new(py: Python<'_>, radius_mm: f64) -> PyResult<Self> {
        Course::of_radius(radius_mm).map(Self).map_err(|e| raise(py, &e))
    }
    /// Radius of the reference wall's surface, mm.
    #[getter]
    fn radius_mm(&self) -> f64 {
        self.0.radius_mm()
    }
    /// Difference of readings after which the seam comes back to where it began; None: it has two ends.
    #[getter]
    fn turn(&self) -> Option<f64> {
        self.0.turn()
    }
    /// How many bins the seam has.
    #[getter]
    fn bins(&self) -> usize {
        self.0.bins()
    }
    /// Width of a bin, as a difference of readings.
    #[getter]
    fn bin_width(&self) -> f64 {
        self.0.bin_width()
    }
    /// Sign of the unit of readings, as it follows a number.
    #[getter]
    fn unit(&self) -> &'static str {
        self.0.unit()
    }
    /// What readings are, as the title of an axis.
    #[getter]
    fn label(&self) -> &'static str {
        self.0.label()
    }
    /// The place of a reading.
    fn at(&self, reading: f64) -> f64 {
        self.0.at_reading(reading)
    }
    /// The reading of a place.
    fn reading(&self, at: f64) -> f64 {
        self.0.reading(at)
    }
    /// A reading as it is told: of a closed seam without whole turns.
    fn told(&self, reading: f64) -> f64 {
        self.0.told(reading)
    }
    /// The difference of places that is so long.
    fn difference(&self, along_mm: f64) -> f64 {
        self.0.difference(along_mm)
    }
    /// The difference of readings that is so long.
    fn reading_of_mm(&self, along_mm: f64) -> f64 {
        self.0.reading_of_mm(along_mm)
    }
    /// Length along the seam, mm, of a difference of two places.
    fn along_mm(&self, difference: f64) -> f64 {
        self.0.along_mm(difference)
    }
    /// The bin so many beyond another; None beyond the end of a seam that has ends.
    fn beyond(&self, bin: i64, count: i64) -> Option<usize> {
        self.0.beyond(bin, count)
    }
    /// Differences of readings (n,) from one, the short way.
    fn apart<'py>(&self, readings: PyReadonlyArray1<'py, f64>, from_reading: f64) -> Numbers<'py> {
        let py = readings.py();
        readings.as_array().iter().map(|r| self.0.readings_apart(*r, from_reading)).collect::<Vec<_>>().into_pyarray(py)
    }
    /// Differences of places (n,) from one, the short way.
    fn places_apart<'py>(&self, at: PyReadonlyArray1<'py, f64>, from_at: f64) -> Numbers<'py> {
        let py = at.py();
        at.as_array().iter().map(|a| self.0.apart(*a, from_at)).collect::<Vec<_>>().into_pyarray(py)
    }
    /// Which of equal cells along the seam, of about this length, places (n,) lie in: a whole number around a closed one.
    fn cells<'py>(&self, at: PyReadonlyArray1<'py, f64>, cell_mm: f64) -> Bound<'py, PyArray1<i64>> {
        let py = at.py();
        at.as_array().iter().map(|at| self.0.cell(*at, cell_mm)).collect::<Vec<_>>().into_pyarray(py)
    }
    /// The bins of places (n,).
    fn bins_of<'py>(&self, at: PyReadonlyArray1<'py, f64>) -> Bound<'py, PyArray1<i64>> {
        let py = at.py();
        at.as_array().iter().map(|at| self.0.bin(*at) as i64).collect::<Vec<_>>().into_pyarray(py)
    }
    /// The middle of places (n,).
    fn middle(&self, at: PyReadonlyArray1<'_, f64>) -> f64 {
        self.0.middle(at.as_array().iter().copied())
    }
    fn __repr__(&self) -> String {
        format!("SeamCourse(radius_mm={})", self.0.radius_mm())
    }
}

/// A seam in space: along, across, height.
///
/// Args:
///     origin_mm: (3,) where its coordinates are counted from; of a closed seam its centre.
///     across: (3,) from the reference wall to the other wall.
///     zero: (3,) from the origin to where `at` is 0; made square to `across`. Along runs right-handed about `across`.
///     course: how it runs.
///
/// Raises:
///     InputError: a wrong shape, NaN or infinity.
///     GeometryError: `across` has no direction, or `zero` lies along it.
///
/// Example:
///     >>> from weldscan._weldcore import SeamCourse, SeamFrame
///     >>> seam = SeamFrame([0, 0, 0], [1, 0, 0], [0, 0, 1], SeamCourse(100.0))
///     >>> at, across_mm, height_mm = seam.place([[5.0, 0.0, 101.0]])
///     >>> at[0], across_mm[0], height_mm[0]
///     (np.float64(0.0), np.float64(5.0), np.float64(1.0))
#[pyclass(frozen, module = "weldscan", name = "SeamFrame")]
pub(crate) struct PySeam(pub(crate) Seam);

#[pymethods]
impl PySeam {
    #[new]
    fn new(
        py: Python<'_>,
        origin_mm: &Bound<'_, PyAny>,
        across: &Bound<'_, PyAny>,
        zero: &Bound<'_, PyAny>,
        course: PyRef<'_, PyCourse>,
    ) -> PyResult<Self> {
        let [origin, across, zero] =
            [vector("origin_mm", origin_mm)?, vector("across", across)?, vector("zero", zero)?].map(Vec3::from);
        Seam::new(origin, across, zero, course.0).map(Self).map_err(|e| raise(py, &e))
    }
    /// (3,) float64, mm: where the coordinates are counted from.
    #[getter]
    fn origin_mm<'py>(&self, py: Python<'py>) -> Numbers<'py> {
        array(py, &self.0.origin_mm)
    }
    /// (3,) float64, unit: from the reference wall to the other wall.
    #[getter]
    fn across<'py>(&self, py: Python<'py>) -> Numbers<'py> {
        array(py, &self.0.across)
    }
    /// (3,) float64, unit: from the origin to where `at` is 0.
    #[getter]
    fn zero<'py>(&self, py: Python<'py>) -> Numbers<'py> {
        array(py, &self.0.zero)
    }
    /// How it runs.
    #[getter]
    fn course(&self) -> PyCourse {
        PyCourse(self.0.course)
    }
    /// The seam in another frame.
    ///
    /// b_from_a: (4, 4) float64, from this seam's frame to the other. Raises InputError for what is no rigid transform.
    fn moved(&self, b_from_a: PyReadonlyArray2<'_, f64>) -> PyResult<Self> {
        let b_from_a = transform("b_from_a", &b_from_a)?;
        let turned = |v: &Vec3| b_from_a.rotation * v;
        let Seam { origin_mm, across, zero, course } = self.0;
        Ok(Self(Seam { origin_mm: b_from_a.apply(&origin_mm), across: turned(&across), zero: turned(&zero), course }))
    }
    /// Places along, distances across (mm) and heights (mm), each (n,) float64, of points (n, 3) in mm.
    fn place<'py>(
        &self,
        py: Python<'py>,
        points_mm: &Bound<'py, PyAny>,
    ) -> PyResult<(Numbers<'py>, Numbers<'py>, Numbers<'py>)> {
        let given = float_matrix("points_mm", points_mm)?;
        let all = points("points_mm", &given)?;
        let placed: Vec<[f64; 3]> = compute(py, || {
            let parts = threads::map_chunks(all, |_, part| part.iter().map(|p| self.0.place(p)).collect::<Vec<_>>());
            Ok(parts.concat())
        })?;
        let column = |k: usize| placed.iter().map(|p| p[k]).collect::<Vec<_>>().into_pyarray(py);
        Ok((column(0), column(1), column(2)))
    }
    /// Points (n, 3) of the reference wall's surface at places `at` (n,), `across_mm` (n,) across. Raises InputError for
    /// arrays of different lengths.
    fn points<'py>(
        &self,
        at: &Bound<'py, PyAny>,
        across_mm: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let (at, across) = (floats::<Ix1>("at", at)?, floats::<Ix1>("across_mm", across_mm)?);
        let [n, m] = [&at, &across].map(|values| values.as_array().len());
        if n != m {
            let (expected, got) = (format!("{n} as at"), m.to_string());
            return Err(raise(at.py(), &Error::Shape { what: "across_mm", expected, got }));
        }
        let (at_each, across) = (at.as_array(), across.as_array());
        rows(at.py(), at_each.iter().zip(across).map(|(at, across)| self.0.point(*at, *across)))
    }
    /// Directions of height (n, 3), unit, at places `at` (n,).
    fn outward<'py>(&self, at: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let at = floats::<Ix1>("at", at)?;
        rows(at.py(), at.as_array().iter().map(|at| self.0.outward(*at)))
    }
    fn __repr__(&self) -> String {
        let Seam { origin_mm, across, zero, course } = &self.0;
        let course = PyCourse(*course).__repr__();
        format!(
            "SeamFrame(origin_mm={}, across={}, zero={}, course={course})",
            words(origin_mm),
            words(across),
            words(zero)
        )
    }
}

fn rows<'py>(py: Python<'py>, vectors: impl Iterator<Item = Vec3>) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let flat: Vec<f64> = vectors.flat_map(<[f64; 3]>::from).collect();
    let count = flat.len() / 3;
    flat.into_pyarray(py).reshape([count, 3])
}

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyCourse>()?;
    m.add_class::<PySeam>()
}
