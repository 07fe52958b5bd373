//! The error of a phase by the projector's response, as Python sees it.

use numpy::PyUntypedArrayMethods;
use pyo3::prelude::*;

use crate::error::Error;
use crate::fringes::{
    Compensation, FringeSet, PhaseError, error_of_harmonics, harmonics_of_gamma as harmonics_of_gamma_core,
    seen_in_phase,
};
use crate::python::call::{compute, raise};
use crate::python::convert::{float_matrix, parts, unmasked, whole};

/// The error of a measured phase p of N steps, by light that is not proportional to the projector's level:
/// `sum over m of sin_rad[m - 1] sin(m N p)`. Take it off, and what is left is the phase.
#[pyclass(frozen, get_all, module = "weldscan", name = "PhaseError")]
pub(crate) struct PyPhaseError {
    /// N.
    pub(crate) steps: usize,
    /// Coefficients, rad; all zero where nothing was seen.
    pub(crate) sin_rad: Vec<f64>,
    /// Their standard deviations, rad; zero where they were given or computed.
    pub(crate) standard_rad: Vec<f64>,
    /// What it is known from: "phase", "finer set" (this one's waves are too long to be seen against the surface),
    /// "given", "nothing" (no error above the noise).
    pub(crate) source: String,
    /// The largest error of a phase, rad.
    pub(crate) largest_rad: f64,
}

#[pymethods]
impl PyPhaseError {
    fn __repr__(&self) -> String {
        let (n, largest, source) = (self.steps, self.largest_rad, &self.source);
        format!("PhaseError({n} steps, up to {largest:.4} rad, from {source})")
    }
}

impl From<&PhaseError> for PyPhaseError {
    fn from(e: &PhaseError) -> Self {
        Self {
            steps: e.steps,
            sin_rad: e.sin_rad.to_vec(),
            standard_rad: e.standard_rad.to_vec(),
            source: e.source.name().into(),
            largest_rad: e.largest_rad(),
        }
    }
}

/// What `decode` takes as `phase_error`.
pub(crate) fn compensation(
    py: Python<'_>,
    given: Option<&Bound<'_, PyAny>>,
    sets: &[FringeSet],
) -> PyResult<Compensation> {
    let wrong = |got: String| {
        let expected = "None, \"auto\", or the sine coefficients (or None) of each fringe set".into();
        raise(py, &Error::Shape { what: "phase_error", expected, got })
    };
    let Some(given) = given else { return Ok(Compensation::Off) };
    unmasked("phase_error", given)?;
    if let Ok(word) = given.extract::<String>() {
        return if word == "auto" { Ok(Compensation::Auto) } else { Err(wrong(format!("{word:?}"))) };
    }
    let Ok(series) = given.extract::<Vec<Option<Vec<f64>>>>() else {
        return Err(wrong(given.get_type().to_string()));
    };
    if series.len() != sets.len() {
        return Err(wrong(format!("{} for {} sets", series.len(), sets.len())));
    }
    let each = series.iter().zip(sets).map(|(s, set)| match s {
        Some(s) => PhaseError::given(set.steps, s).map_err(|e| raise(py, &e)),
        None => Ok(PhaseError::none(set.steps)),
    });
    Ok(Compensation::Given(each.collect::<PyResult<_>>()?))
}

/// The error of a wrapped phase by the projector's response, seen in the phase itself.
///
/// Minimises, robustly (Tukey), the second differences of the phase without the error, over parts of the error's wave: the
/// surface is smooth over a few pixels, the error is not. Whole fringes drop out, so nothing needs to be unwrapped.
///
/// Args:
///     phase_rad: (H, W), wrapped or not, rad; NaN where it does not count.
///     steps: N >= 3, of the images that the phase came from.
///     z: what is not z standard deviations from zero is nothing.
///     rows: how many rows of the image are looked at, 24 at least.
///
/// Returns:
///     PhaseError, with `source` "phase" or, where no term stands above noise and above the rounding of an 8-bit display,
///     "nothing"; None where the fringes are too coarse (the error's wave is beyond 40 px) or too few pixels have a phase.
///
/// Raises:
///     InputError: not an image, fewer than three steps or more than 10,000.
///
/// Source: the alias of harmonics in N-step phases, e.g. Pan et al., Optics Letters 34 (2009) 416; see docs/method.md.
///
/// Example:
///     >>> import numpy as np
///     >>> from weldscan import estimate_phase_error
///     >>> p = np.add.outer(0.01 * np.arange(300), 0.3 * np.arange(400))
///     >>> error = estimate_phase_error(p + 0.1 * np.sin(3 * p), 3)
///     >>> round(error.largest_rad, 2), error.source
///     (0.1, 'phase')
#[pyfunction]
#[pyo3(signature = (phase_rad, steps, *, z=5.0, rows=24))]
fn estimate_phase_error(
    py: Python<'_>,
    phase_rad: &Bound<'_, PyAny>,
    #[pyo3(from_py_with = whole)] steps: usize,
    z: f64,
    #[pyo3(from_py_with = whole)] rows: usize,
) -> PyResult<Option<PyPhaseError>> {
    let image = float_matrix("phase_rad", phase_rad)?;
    let width = image.shape()[1];
    let values = image.as_slice()?;
    let found = compute(py, || seen_in_phase(values, width, steps, z, rows))?;
    Ok(found.as_ref().map(PyPhaseError::from))
}

/// The error of an N-step phase that harmonics of the projected light make.
///
/// Harmonic p is taken for the fundamental where p = mN - 1 or mN + 1; the exact error, as a series in the measured phase.
///
/// Args:
///     harmonics: amplitude of the second, third ... harmonic over the fundamental's, with its sign.
///     steps: N >= 3.
///
/// Returns:
///     PhaseError.
///
/// Raises:
///     InputError: not finite, fewer than three steps, or two phases would be measured as one.
///     GeometryError: the harmonics outweigh the fundamental.
///
/// Example:
///     >>> from weldscan import harmonics_of_gamma, phase_error_of_harmonics
///     >>> round(phase_error_of_harmonics(harmonics_of_gamma(1.35), 3).largest_rad, 3)
///     0.1
#[pyfunction]
fn phase_error_of_harmonics(
    py: Python<'_>,
    harmonics: &Bound<'_, PyAny>,
    #[pyo3(from_py_with = whole)] steps: usize,
) -> PyResult<PyPhaseError> {
    let harmonics: Vec<f64> = parts("harmonics", "a list of ratios", harmonics)?;
    Ok((&error_of_harmonics(&harmonics, steps).map_err(|e| raise(py, &e))?).into())
}

/// The harmonics of light = level^gamma over a full fringe: amplitudes over the fundamental's, from the second on.
///
/// Args:
///     gamma: the exponent, 0.1 to 10; 1 has none.
///
/// Returns:
///     list of 47 ratios: r_p = r_(p-1) (gamma - p + 1)/(gamma + p).
///
/// Raises:
///     InputError: out of its range.
///
/// Example:
///     >>> from weldscan import harmonics_of_gamma
///     >>> [round(r, 3) for r in harmonics_of_gamma(2.2)[:2]]
///     [0.286, 0.011]
#[pyfunction]
fn harmonics_of_gamma(py: Python<'_>, gamma: f64) -> PyResult<Vec<f64>> {
    if !(0.1..=10.0).contains(&gamma) {
        let error = Error::OutOfRange { what: "gamma", expected: "0.1 to 10".into(), value: gamma.to_string() };
        return Err(raise(py, &error));
    }
    Ok(harmonics_of_gamma_core(gamma))
}

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyPhaseError>()?;
    m.add_function(wrap_pyfunction!(estimate_phase_error, m)?)?;
    m.add_function(wrap_pyfunction!(phase_error_of_harmonics, m)?)?;
    m.add_function(wrap_pyfunction!(harmonics_of_gamma, m)?)
}
