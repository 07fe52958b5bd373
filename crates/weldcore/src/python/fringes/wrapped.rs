//! The phase of N steps as Python sees it.

use numpy::{PyArrayDyn, PyUntypedArrayMethods};
use pyo3::prelude::*;

use super::images::{Images, shaped, slices};
use crate::fringes::{WrappedPhase, decode_phase as decode_phase_core};
use crate::python::call::compute;
use crate::python::convert::Whole;

/// What `decode_phase` found: arrays (H, W), or (sets, H, W) where `steps` is a list. Used as an array it is the phase.
#[pyclass(frozen, get_all, module = "weldscan", name = "WrappedPhase")]
pub(crate) struct PyWrappedPhase {
    /// In (-pi, pi], rad. float64.
    pub(crate) phase_rad: Py<PyArrayDyn<f64>>,
    /// Amplitude, grey levels. float32.
    pub(crate) modulation: Py<PyArrayDyn<f32>>,
    /// Mean level. float32.
    pub(crate) background: Py<PyArrayDyn<f32>>,
    /// Root of the summed squared residuals over N - 3, grey levels; 0 with three steps. float32.
    pub(crate) residual: Py<PyArrayDyn<f32>>,
}

#[pymethods]
impl PyWrappedPhase {
    #[pyo3(signature = (dtype=None, copy=None))]
    fn __array__<'py>(
        &self,
        py: Python<'py>,
        dtype: Option<&Bound<'py, PyAny>>,
        copy: Option<bool>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let phase = self.phase_rad.bind(py).as_any();
        match (dtype, copy) {
            (Some(dtype), _) => phase.call_method1("astype", (dtype,)),
            (None, Some(true)) => phase.call_method0("copy"),
            (None, _) => Ok(phase.clone()),
        }
    }

    fn __repr__(&self, py: Python<'_>) -> String {
        format!("WrappedPhase(shape {:?})", self.phase_rad.bind(py).shape())
    }
}

/// The number of steps of each set.
#[derive(FromPyObject)]
enum Steps {
    One(Whole),
    Many(Vec<Whole>),
}

/// The wrapped phase of N-step images: the least-squares sinusoid `A + B cos(phi - 2 pi k/N)` in every pixel.
///
/// `phi = atan2(sum I sin(2 pi k/N), sum I cos(2 pi k/N))`, in double precision throughout. No noise, no mask, no
/// unwrapping: `decode` has them.
///
/// Args:
///     images: (N, H, W) stack or list of (H, W) images, uint8, uint16 or floating point; sets after sets.
///     steps: N >= 3, or a list of the steps of each set.
///
/// Returns:
///     WrappedPhase: `phase_rad` in (-pi, pi], `modulation` B, `background` A, `residual`; (H, W), or (sets, H, W) where
///     `steps` is a list. A level that is not finite makes its pixel NaN. Used as an array it is the phase.
///
/// Raises:
///     InputError: as many images as steps are needed, of one size; fewer than three steps.
///
/// Source: N-bucket phase shifting, e.g. Zuo et al., Optics and Lasers in Engineering 109 (2018) 23, Eq. 9.
///
/// Example:
///     >>> import numpy as np
///     >>> from weldscan import decode_phase
///     >>> images = [np.full((1, 2), 100 + 50 * np.cos(0.7 - 2 * np.pi * k / 3)) for k in range(3)]
///     >>> decode_phase(images, 3).phase_rad.round(6)
///     array([[0.7, 0.7]])
#[pyfunction]
fn decode_phase(py: Python<'_>, images: &Bound<'_, PyAny>, steps: Steps) -> PyResult<PyWrappedPhase> {
    let (found, [h, w]) = super::images::images("images", images)?;
    let (sets, one) = match steps {
        Steps::One(n) => (vec![n.0], true),
        Steps::Many(list) => (list.into_iter().map(|n| n.0).collect(), false),
    };
    let WrappedPhase { phase_rad, modulation, background, residual } = match &found {
        Images::U8(a) => {
            let a = slices(a)?;
            compute(py, || decode_phase_core(&a, &sets))?
        }
        Images::U16(a) => {
            let a = slices(a)?;
            compute(py, || decode_phase_core(&a, &sets))?
        }
        Images::F64(a) => {
            let a = slices(a)?;
            compute(py, || decode_phase_core(&a, &sets))?
        }
    };
    let shape = if one { vec![h, w] } else { vec![sets.len(), h, w] };
    Ok(PyWrappedPhase {
        phase_rad: shaped(py, phase_rad, &shape)?,
        modulation: shaped(py, modulation, &shape)?,
        background: shaped(py, background, &shape)?,
        residual: shaped(py, residual, &shape)?,
    })
}

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyWrappedPhase>()?;
    m.add_function(wrap_pyfunction!(decode_phase, m)?)
}
