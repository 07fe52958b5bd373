//! Decoding as Python sees it.

use numpy::ndarray::IxDyn;
use numpy::{
    PyArray1, PyArray2, PyArrayDyn, PyArrayMethods, PyReadonlyArray2, PyReadonlyArrayDyn, PyUntypedArrayMethods,
};
use pyo3::prelude::*;

use super::response::PyPhaseError;
use super::{Whole, compute, float_matrix, floats, numbers, parts, raise, unmasked, whole};
use crate::error::Error;
use crate::phase::{
    DecodeOptions, Disagreement, FringeSet, Level, PhaseMap, Shot, WrappedPhase, decode_phase as decode_phase_core,
    decode_shot, saturation,
};
use crate::unwrap::{GrayImages, absolute_from_gray, decode_gray as decode_gray_core};

/// Hands a vector to numpy as an image, without a copy.
pub(super) fn image<T: numpy::Element>(
    py: Python<'_>,
    values: Vec<T>,
    height: usize,
    width: usize,
) -> PyResult<Py<PyArray2<T>>> {
    Ok(PyArray1::from_vec(py, values).reshape([height, width])?.unbind())
}

/// Frames of a stack that contradict each other, and the likely cause.
#[pyclass(frozen, get_all, module = "weldscan", name = "Disagreement")]
pub(crate) struct PyDisagreement {
    /// The exposure that is concerned.
    pub(super) exposure: usize,
    /// The fringe set that is concerned; None: several.
    pub(super) set: Option<usize>,
    /// The frames of the exposure that are concerned, from 0.
    pub(super) frames: Vec<usize>,
    /// The likely cause in one line; steps count from 0 in their set.
    pub(super) text: String,
    /// Share of the clear pixels that contradict the frames as they are stated.
    pub(super) share: f64,
    /// How many times better the cause fits than the statement.
    pub(super) strength: f64,
}

#[pymethods]
impl PyDisagreement {
    fn __repr__(&self) -> String {
        format!("Disagreement({:?}, {:.0} % of the pixels)", self.text, 100.0 * self.share)
    }
}

/// What `decode` found. Arrays have the camera's shape (H, W).
#[pyclass(frozen, get_all, module = "weldscan", name = "PhaseMap")]
pub(crate) struct PyPhaseMap {
    /// Projector column (row for fringes along y) that lights each pixel, px, pixel centres at whole numbers; NaN where
    /// rejected. float64.
    pub(super) column_px: Py<PyArray2<f64>>,
    /// Its standard deviation by noise, px; NaN where rejected. float32.
    pub(super) sigma_px: Py<PyArray2<f32>>,
    /// Amplitude of the finest fringes, grey levels, in the exposure that counts most. float32.
    pub(super) modulation: Py<PyArray2<f32>>,
    /// Mean level of the same images. float32.
    pub(super) background: Py<PyArray2<f32>>,
    /// 0 ok, 1 dark, 2 saturated, 3 fringe order in doubt, 4 no fit. uint8.
    pub(super) reason: Py<PyArray2<u8>>,
    /// Number of pixels by reason: ok, dark, saturated, order in doubt, no fit.
    pub(super) counts: [usize; 5],
    /// Variance of the camera's read noise, grey levels squared.
    pub(super) noise_read_variance: f64,
    /// Growth of the variance with the level: variance = noise_read_variance + 1/12 + noise_gain * level.
    pub(super) noise_gain: f64,
    /// What the noise was seen in: "backgrounds", "residuals", "texture" (an upper bound) or "assumed".
    pub(super) noise_source: String,
    /// Level from which a pixel counts as saturated.
    pub(super) saturation: f64,
    /// Whether the images show that the camera clips there, below the full scale of its numbers.
    pub(super) clipped_below_full_scale: bool,
    /// Where the frames contradict each other, and the likely cause. Empty for a stack that agrees with itself.
    pub(super) disagreements: Vec<Py<PyDisagreement>>,
    /// Per fringe set the rms of the higher harmonics over the amplitude (None with three steps, which show none).
    /// Above 0.05 or so the projector's gamma wants correcting.
    pub(super) harmonics: Vec<Option<f64>>,
    /// Per fringe set what was taken off its phase.
    pub(super) phase_error: Vec<Py<PyPhaseError>>,
    /// The chain of frequencies by which the fringes were counted, periods over the projector.
    pub(super) unwrapped_by: Vec<f64>,
}

#[pymethods]
impl PyPhaseMap {
    fn __repr__(&self) -> String {
        let [ok, dark, saturated, doubt, no_fit] = self.counts;
        format!(
            "PhaseMap({ok} ok, {dark} dark, {saturated} saturated, {doubt} order in doubt, {no_fit} no fit; noise {:.2} \
             + {:.4} level from {})",
            self.noise_read_variance + 1.0 / 12.0,
            self.noise_gain,
            self.noise_source
        )
    }
}

fn hand_over(py: Python<'_>, map: PhaseMap) -> PyResult<PyPhaseMap> {
    let (h, w) = (map.height, map.width);
    let chain = std::iter::once(map.plan.base.periods).chain(map.plan.links.iter().map(|l| l.signal.periods));
    let errors = map.phase_error.iter().map(|e| Py::new(py, PyPhaseError::from(e)));
    let disagreements = map.disagreements.into_iter().map(|d| {
        let Disagreement { exposure, set, frames, text, share, strength } = d;
        Py::new(py, PyDisagreement { exposure, set, frames, text, share, strength })
    });
    Ok(PyPhaseMap {
        phase_error: errors.collect::<PyResult<_>>()?,
        unwrapped_by: chain.collect(),
        column_px: image(py, map.column_px, h, w)?,
        sigma_px: image(py, map.sigma_px, h, w)?,
        modulation: image(py, map.modulation, h, w)?,
        background: image(py, map.background, h, w)?,
        reason: image(py, map.reason, h, w)?,
        counts: map.counts,
        noise_read_variance: map.noise.read_variance,
        noise_gain: map.noise.gain,
        noise_source: map.noise.source.name().into(),
        saturation: map.saturation,
        clipped_below_full_scale: map.clipped_below_full_scale,
        disagreements: disagreements.collect::<PyResult<_>>()?,
        harmonics: map.harmonics,
    })
}

/// A frame as an array of `T`, or `None` where it is of another type.
fn frame<'py, T: numpy::Element>(given: &Bound<'py, PyAny>) -> PyResult<Option<PyReadonlyArray2<'py, T>>> {
    unmasked("an image", given)?;
    let Ok(array) = given.cast::<PyArray2<T>>() else { return Ok(None) };
    if array.is_c_contiguous() {
        return Ok(Some(array.readonly()));
    }
    let copy = given.py().import("numpy")?.call_method1("ascontiguousarray", (array,))?;
    Ok(Some(copy.cast_into::<PyArray2<T>>()?.readonly()))
}

/// A fringe set as it comes.
#[derive(FromPyObject)]
enum Fringe {
    Plain((f64, Whole)),
    Foreign((f64, Whole, f64, f64)),
}

impl From<Fringe> for FringeSet {
    fn from(fringe: Fringe) -> Self {
        match fringe {
            Fringe::Plain((periods, steps)) => Self::new(periods, steps.0),
            Fringe::Foreign((periods, steps, direction, origin_rad)) => {
                Self { periods, steps: steps.0, direction, origin_rad }
            }
        }
    }
}

fn decode_as<T: Level + numpy::Element>(
    py: Python<'_>,
    exposures: &[Vec<Bound<'_, PyAny>>],
    sets: &[FringeSet],
    projector_size: usize,
    options: &DecodeOptions,
) -> PyResult<PyPhaseMap> {
    let mut arrays = Vec::new();
    let mut size = None;
    for (e, frames) in exposures.iter().enumerate() {
        for (k, given) in frames.iter().enumerate() {
            let wrong = |expected: String, got: String| {
                let expected = format!("{expected} at exposure {e}, frame {k}");
                raise(py, &Error::Shape { what: "exposures", expected, got })
            };
            let Some(array) = frame::<T>(given)? else {
                let dtype = given.getattr("dtype").map_or(String::from("no array"), |d| d.to_string());
                let shape = given.getattr("shape").map_or(String::new(), |s| s.to_string());
                return Err(wrong("(H, W) arrays, all uint8 or all uint16,".into(), format!("{dtype} {shape}")));
            };
            let shape = (array.shape()[0], array.shape()[1]);
            if *size.get_or_insert(shape) != shape {
                return Err(wrong(format!("one size, {size:?},"), format!("{shape:?}")));
            }
            arrays.push(array);
        }
    }
    let (height, width) = size.unwrap_or((0, 0));
    let mut slices = arrays.iter().map(|a| a.as_slice()).collect::<Result<Vec<_>, _>>()?.into_iter();
    let shot =
        Shot { exposures: exposures.iter().map(|f| slices.by_ref().take(f.len()).collect()).collect(), width, height };
    let map = compute(py, || decode_shot(&shot, sets, projector_size, options))?;
    hand_over(py, map)
}

/// The projector column that lights each camera pixel, from N-step fringe images of one axis.
///
/// Step i of a set projects `0.5 + 0.5 cos(2 pi (periods (u + 0.5)/projector_size - direction i/steps) + origin_rad)` into
/// column u; direction is 1 and origin_rad 0 where they are not given. Any number of steps from 3 on and any frequencies that count the fringes over the whole projector will do, in any order: a set
/// of one period and finer ones (1, 8, 64), or sets whose beats come down to one period (59, 64, 70).
///
/// The camera's noise, `variance = read² + 1/12 + gain level`, is estimated from the images: from the differences of the
/// sets' backgrounds; for one set from its residuals; for one set of three steps from the background's neighbour
/// differences (an upper bound). Exposures are fused per pixel and set, weighted by 1/sigma², leaving out those in which
/// any frame of the set is saturated. Sets of more than half the finest frequency are averaged with it.
///
/// Args:
///     exposures: list of stacks; a stack is a list of (H, W) uint8 or uint16 images, sets after sets, steps in order.
///     fringes: list of (periods, steps) or (periods, steps, direction, origin_rad), in the order of the images. A
///         direction of -1 and an origin read stacks that others projected.
///     projector_size: extent of the projector along the fringes' axis, px (width for axis x).
///     saturation: level at which the camera saturates. Default: where values are piled up at the upper end, as those of a
///         camera that clips at 235 of 255; else 255 for uint8, and for uint16 the full scale of the narrowest of 8, 10,
///         12, 14 and 16 bits that holds the largest value, after a shift by the low bits that are always zero.
///     z: safety factor on sigma, for what is dark and for fringe orders.
///     phase_error: what is taken off each set's phase for the projector's response (gamma). None: nothing. "auto": what
///         the phases themselves show above the noise, see `estimate_phase_error`. Or per set the coefficients of
///         `sin(m steps phase)`, m = 1, 2 ..., rad (None: nothing).
///
/// Returns:
///     PhaseMap: `column_px`, `sigma_px`, `modulation`, `background`, `reason` (H, W), the noise model, and `disagreements`
///     where frames are copied, exchanged, displaced or of another convention than stated. Rejected pixels
///     are NaN in column and sigma, with a reason:
///     1 dark: the modulation is below z sigma, or z sigma of a fringe-order decision reaches half a fringe;
///     2 saturated: some set is saturated in every exposure;
///     3 order in doubt: frequencies disagree by more than z sigma and a quarter fringe (the quarter is left to smooth
///     errors such as gamma and light between walls), or the pixel is within z sigma of the projector's border, or its
///     fringe order is unlike its neighbours';
///     4 no fit: the residual exceeds both the noise and the harmonics of an uncorrected gamma of 2.2.
///
/// Raises:
///     InputError: images that do not fit the fringes or each other; fringes that cannot be counted over the projector.
///
/// Source: N-step phase shifting and temporal unwrapping as in Zuo et al., Optics and Lasers in Engineering 85 (2016) 84
/// and 109 (2018) 23.
///
/// Example:
///     >>> import numpy as np
///     >>> from weldscan import decode
///     >>> u = np.arange(320.0)[None, :].repeat(4, axis=0)
///     >>> fringes = [(1, 4), (8, 4)]
///     >>> phase = [2 * np.pi * (p * (u + 0.5) / 320 - i / n) for p, n in fringes for i in range(n)]
///     >>> images = [np.uint8(120 + 100 * np.cos(p)) for p in phase]
///     >>> found = decode([images], fringes, 320)
///     >>> bool(np.nanmax(np.abs(found.column_px - u)) < 0.1)
///     True
#[pyfunction]
#[pyo3(signature = (exposures, fringes, projector_size, *, saturation=None, z=5.0, phase_error=None))]
fn decode(
    py: Python<'_>,
    exposures: &Bound<'_, PyAny>,
    fringes: &Bound<'_, PyAny>,
    #[pyo3(from_py_with = whole)] projector_size: usize,
    saturation: Option<f64>,
    z: f64,
    phase_error: Option<&Bound<'_, PyAny>>,
) -> PyResult<PyPhaseMap> {
    let wrong = |got: String| {
        let expected = "a list of stacks of (H, W) images".into();
        raise(py, &Error::Shape { what: "exposures", expected, got })
    };
    let list = |given: &Bound<'_, PyAny>| -> PyResult<Vec<Py<PyAny>>> {
        let items = given.try_iter().map_err(|_| wrong(given.get_type().to_string()))?;
        items.map(|item| Ok(item?.unbind())).collect()
    };
    unmasked("exposures", exposures)?;
    let mut stacks = Vec::new();
    for stack in list(exposures)? {
        let frames: Vec<_> = list(stack.bind(py))?.into_iter().map(|f| f.into_bound(py)).collect();
        stacks.push(frames);
    }
    let sets: Vec<FringeSet> = parts::<Vec<Fringe>>(
        "fringes",
        "a list of (periods, steps) or (periods, steps, direction, origin_rad)",
        fringes,
    )?
    .into_iter()
    .map(FringeSet::from)
    .collect();
    let options = DecodeOptions { saturation, z, compensation: super::response::compensation(py, phase_error, &sets)? };
    let wide = stacks.first().and_then(|f| f.first()).is_some_and(|f| f.cast::<PyArray2<u16>>().is_ok());
    if wide {
        decode_as::<u16>(py, &stacks, &sets, projector_size, &options)
    } else {
        decode_as::<u8>(py, &stacks, &sets, projector_size, &options)
    }
}

/// Where a camera saturates, by the images of one stack: (level, full scale, whether it clips below full scale).
///
/// Full scale is 255 for uint8, for uint16 that of the narrowest of 8, 10, 12, 14 and 16 bits that holds the largest value,
/// after a shift by the low bits that are always zero. Fringe images show a pile-up of values where a camera clips below.
///
/// Args:
///     images: (H, W) uint8 or uint16 images, all alike.
///
/// Returns:
///     (float, float, bool), grey levels.
///
/// Raises:
///     InputError: no images, or images that are not alike.
///
/// Example:
///     >>> import numpy as np
///     >>> from weldscan._weldcore import saturation_level
///     >>> saturation_level([np.full((4, 4), 700, np.uint16)])
///     (1023.0, 1023.0, False)
#[pyfunction]
fn saturation_level(py: Python<'_>, images: &Bound<'_, PyAny>) -> PyResult<(f64, f64, bool)> {
    fn look<T: Level + numpy::Element>(
        py: Python<'_>,
        arrays: &[PyReadonlyArray2<'_, T>],
        [height, width]: [usize; 2],
    ) -> PyResult<(f64, f64, bool)> {
        let shot = Shot { exposures: vec![slices(arrays)?], width, height };
        let found = compute(py, || Ok(saturation(&shot)))?;
        Ok((found.level, found.full_scale, found.below_full_scale))
    }
    let (found, size) = self::images("images", images)?;
    match &found {
        Images::U8(a) => look(py, a, size),
        Images::U16(a) => look(py, a, size),
        Images::F64(_) => {
            let (expected, got) = ("uint8 or uint16 images, all alike".into(), "another type".into());
            Err(raise(py, &Error::Shape { what: "images", expected, got }))
        }
    }
}

/// What `decode_phase` found: arrays (H, W), or (sets, H, W) where `steps` is a list. Used as an array it is the phase.
#[pyclass(frozen, get_all, module = "weldscan", name = "WrappedPhase")]
pub(crate) struct PyWrappedPhase {
    /// In (-pi, pi], rad. float64.
    pub(super) phase_rad: Py<PyArrayDyn<f64>>,
    /// Amplitude, grey levels. float32.
    pub(super) modulation: Py<PyArrayDyn<f32>>,
    /// Mean level. float32.
    pub(super) background: Py<PyArrayDyn<f32>>,
    /// Root of the summed squared residuals over N - 3, grey levels; 0 with three steps. float32.
    pub(super) residual: Py<PyArrayDyn<f32>>,
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

/// Images as the core takes them: a list of (H, W) arrays or a stack (N, H, W), of one type, levels as they are.
enum Images<'py> {
    U8(Vec<PyReadonlyArray2<'py, u8>>),
    U16(Vec<PyReadonlyArray2<'py, u16>>),
    F64(Vec<PyReadonlyArray2<'py, f64>>),
}

/// The images of an argument, and their shape.
fn images<'py>(what: &'static str, given: &Bound<'py, PyAny>) -> PyResult<(Images<'py>, [usize; 2])> {
    let py = given.py();
    unmasked(what, given)?;
    let wrong = |expected: &str, got: String| raise(py, &Error::Shape { what, expected: expected.into(), got });
    let Ok(items) = given.try_iter() else {
        return Err(wrong("a stack (N, H, W) or a list of (H, W) images", given.get_type().to_string()));
    };
    let frames: Vec<Bound<'py, PyAny>> = items.collect::<PyResult<_>>()?;
    let mut shape = None;
    for f in &frames {
        let here: Option<[usize; 2]> = f.getattr("shape").ok().and_then(|s| s.extract().ok());
        let here = match here {
            Some(here) => here,
            // A nested list is an image, too.
            None => {
                let array = float_matrix(what, f)?;
                [array.shape()[0], array.shape()[1]]
            }
        };
        if *shape.get_or_insert(here) != here {
            return Err(wrong("images of one size", format!("{shape:?} and {here:?}")));
        }
    }
    fn all<'py, T: numpy::Element>(frames: &[Bound<'py, PyAny>]) -> PyResult<Option<Vec<PyReadonlyArray2<'py, T>>>> {
        frames.iter().map(frame::<T>).collect()
    }
    let shape = shape.ok_or_else(|| wrong("images", "none".into()))?;
    let images = if let Some(frames) = all::<u8>(&frames)? {
        Images::U8(frames)
    } else if let Some(frames) = all::<u16>(&frames)? {
        Images::U16(frames)
    } else {
        Images::F64(frames.iter().map(|f| float_matrix(what, f)).collect::<PyResult<_>>()?)
    };
    Ok((images, shape))
}

fn slices<'a, T: numpy::Element>(arrays: &'a [PyReadonlyArray2<'_, T>]) -> PyResult<Vec<&'a [T]>> {
    arrays.iter().map(|a| Ok(a.as_slice()?)).collect()
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
    let (found, [h, w]) = self::images("images", images)?;
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

fn shaped<T: numpy::Element>(py: Python<'_>, values: Vec<T>, shape: &[usize]) -> PyResult<Py<PyArrayDyn<T>>> {
    Ok(PyArray1::from_vec(py, values).reshape(IxDyn(shape))?.unbind())
}

/// The absolute phase of the finest fringes, from the wrapped phases of several frequencies.
///
/// The frequencies decide how: hierarchical (1, 8, 64), heterodyne by beats and beats of beats (59, 64, 70), in any order.
/// Every fringe order is the nearest one; `decode` is the function that knows the noise and says when not to trust it.
///
/// Args:
///     wrapped: (sets, ...) rad; any multiple of 2 pi may be missing. One array per frequency.
///     periods: frequency of each set, periods over the projector.
///
/// Returns:
///     (...) float64, rad: phase of the finest set in [0, 2 pi periods); NaN where any is NaN.
///
/// Raises:
///     InputError: sizes that do not fit; frequencies that cannot be counted over the projector, with the remedy.
///
/// Source: Zuo et al., Optics and Lasers in Engineering 85 (2016) 84.
///
/// Example:
///     >>> import numpy as np
///     >>> from weldscan import unwrap_temporal
///     >>> truth = np.linspace(0.1, 8 * 2 * np.pi - 0.1, 5)
///     >>> wrapped = np.angle(np.exp(1j * np.array([truth / 8, truth])))
///     >>> bool(np.allclose(unwrap_temporal(wrapped, [1, 8]), truth))
///     True
#[pyfunction]
fn unwrap_temporal<'py>(wrapped: &Bound<'py, PyAny>, periods: &Bound<'py, PyAny>) -> PyResult<Py<PyArrayDyn<f64>>> {
    let py = wrapped.py();
    let periods = numbers("periods", periods)?;
    let array: PyReadonlyArrayDyn<'_, f64> = floats("wrapped", wrapped)?;
    let shape = array.shape().to_vec();
    let Some((&sets, rest)) = shape.split_first() else {
        let expected = "one array per frequency".into();
        return Err(raise(py, &Error::Shape { what: "wrapped", expected, got: "one number".into() }));
    };
    let all = array.as_slice()?;
    let size = rest.iter().product::<usize>();
    let phases: Vec<&[f64]> = (0..sets).filter_map(|i| all.get(i * size..(i + 1) * size)).collect();
    let z = DecodeOptions::default().z;
    let out = compute(py, || crate::unwrap::unwrap_temporal(&phases, &periods, z))?;
    shaped(py, out, rest)
}

/// Unwraps one phase image in space, reliable pixels first.
///
/// Neighbours are joined in the order of their reliability, the smoothness of their surroundings (second differences
/// along row, column and diagonals); each joint fixes the whole turns between two groups. The answer does not depend on
/// the number of threads.
///
/// Args:
///     wrapped: (H, W), rad. NaN and infinity stay out.
///     mask: (H, W) bool, True where a pixel counts.
///     quality: (H, W), replaces the reliability (modulation, say): pixels of high quality are joined first.
///
/// Returns:
///     (H, W) float64, rad: `wrapped` plus whole turns; NaN where out. Each connected region keeps its first pixel's value.
///
/// Raises:
///     InputError: arrays of different shapes; a quality that is not finite where there is a phase.
///
/// Source: Herráez et al., Applied Optics 41 (2002) 7437.
///
/// Example:
///     >>> import numpy as np
///     >>> from weldscan import unwrap_spatial
///     >>> truth = np.add.outer(np.arange(20) * 0.4, np.arange(30) * 1.1)
///     >>> bool(np.allclose(unwrap_spatial(np.angle(np.exp(1j * truth))), truth))
///     True
#[pyfunction]
#[pyo3(signature = (wrapped, mask=None, quality=None))]
fn unwrap_spatial<'py>(
    wrapped: &Bound<'py, PyAny>,
    mask: Option<&Bound<'py, PyAny>>,
    quality: Option<&Bound<'py, PyAny>>,
) -> PyResult<Py<PyArray2<f64>>> {
    let py = wrapped.py();
    let array = float_matrix("wrapped", wrapped)?;
    let shape = array.shape().to_vec();
    let same = |what, got: &[usize]| {
        let expected = format!("the shape of wrapped, {shape:?}");
        if got == shape { Ok(()) } else { Err(raise(py, &Error::Shape { what, expected, got: format!("{got:?}") })) }
    };
    let quality = quality.map(|q| float_matrix("quality", q)).transpose()?;
    quality.as_ref().map_or(Ok(()), |q| same("quality", q.shape()))?;
    let mask: Option<PyReadonlyArray2<'_, bool>> = match mask {
        Some(given) => {
            unmasked("mask", given)?;
            let numpy = py.import("numpy")?;
            let array = numpy.call_method1("ascontiguousarray", (given,)).ok();
            let array = array.and_then(|a| a.cast_into::<PyArray2<bool>>().ok()).ok_or_else(|| {
                let expected = "an (H, W) array of bool".into();
                raise(py, &Error::Shape { what: "mask", expected, got: given.get_type().to_string() })
            })?;
            same("mask", array.shape())?;
            Some(array.readonly())
        }
        None => None,
    };
    let phase = array.as_slice()?;
    let (m, q) =
        (mask.as_ref().map(|m| m.as_slice()).transpose()?, quality.as_ref().map(|q| q.as_slice()).transpose()?);
    let out = compute(py, || crate::unwrap::unwrap_spatial(phase, shape[1], m, q))?;
    image(py, out, shape[0], shape[1])
}

/// The Gray code of every pixel, or the absolute phase that it gives to a wrapped one.
///
/// Args:
///     images: (bits, H, W), most significant bit first, uint8, uint16 or floating point.
///     white, black: (H, W) images of full and no light: a bit is one where it is nearer to white.
///     inverse: (bits, H, W) inverse patterns, instead of white and black: a bit is one where it is brighter.
///     wrapped: (H, W), rad. Then the last bit is the complementary one: it changes at half periods of these fringes, and
///         a period's number changes where its phase is zero. Near that place the order is taken from the code with the
///         last bit, which does not change there, elsewhere from the code without it.
///     contrast: least difference (white - black, or image - inverse) in grey levels that tells a bit. None: five
///         standard deviations of what decides it, the noise taken from the images: between white and black, from how far
///         the bits' levels are from the nearer one; with inverse images, from the sums of the pairs, which should be
///         equal (one pair shows no noise: one grey level is assumed).
///
/// Returns:
///     (H, W) int32, the code from 0 to 2^bits - 1, -1 where a bit cannot be told; with `wrapped` (H, W) float64, the
///     absolute phase in rad, NaN there.
///
/// Raises:
///     InputError: images missing or of different sizes; neither white and black nor inverse, or both.
///
/// Source: complementary Gray code, Zhang et al., Optics and Lasers in Engineering 50 (2012) 574.
///
/// Example:
///     >>> import numpy as np
///     >>> from weldscan import decode_gray
///     >>> gray = np.arange(4) ^ (np.arange(4) >> 1)
///     >>> images = [np.uint8(200 * (gray >> b & 1))[None, :] for b in (1, 0)]
///     >>> decode_gray(images, white=np.full((1, 4), 200, np.uint8), black=np.zeros((1, 4), np.uint8))
///     array([[0, 1, 2, 3]], dtype=int32)
#[pyfunction]
#[pyo3(signature = (images, *, white=None, black=None, inverse=None, wrapped=None, contrast=None))]
fn decode_gray<'py>(
    images: &Bound<'py, PyAny>,
    white: Option<&Bound<'py, PyAny>>,
    black: Option<&Bound<'py, PyAny>>,
    inverse: Option<&Bound<'py, PyAny>>,
    wrapped: Option<&Bound<'py, PyAny>>,
    contrast: Option<f64>,
) -> PyResult<Py<PyAny>> {
    let py = images.py();
    let shape = self::images("images", images)?.1;
    let stack = |what, given: &Bound<'py, PyAny>| -> PyResult<Vec<PyReadonlyArray2<'py, f64>>> {
        let arrays = given.try_iter()?.map(|f| float_matrix(what, &f?)).collect::<PyResult<Vec<_>>>()?;
        match arrays.iter().find(|a| a.shape() != shape) {
            Some(a) => {
                let (expected, got) = (format!("the shape of the images, {shape:?}"), format!("{:?}", a.shape()));
                Err(raise(py, &Error::Shape { what, expected, got }))
            }
            None => Ok(arrays),
        }
    };
    let bits = stack("images", images)?;
    let (others, pair) = match (white, black, inverse) {
        (Some(white), Some(black), None) => {
            (stack("white and black", pyo3::types::PyTuple::new(py, [white, black])?.as_any())?, true)
        }
        (None, None, Some(inverse)) => (stack("inverse", inverse)?, false),
        _ => {
            let (expected, got) = ("white and black, or else inverse".into(), "another combination".into());
            return Err(raise(py, &Error::Shape { what: "images", expected, got }));
        }
    };
    let (bits, others) = (slices(&bits)?, slices(&others)?);
    let against = match (pair, others.as_slice()) {
        (true, &[white, black]) => GrayImages::WhiteBlack(white, black),
        _ => GrayImages::Inverse(&others),
    };
    let code = compute(py, || decode_gray_core(&bits, against, contrast))?;
    let [h, w] = shape;
    match wrapped {
        None => Ok(image(py, code, h, w)?.into_any()),
        Some(given) => {
            let array = float_matrix("wrapped", given)?;
            let phase = array.as_slice()?;
            let out = compute(py, || absolute_from_gray(&code, phase))?;
            Ok(image(py, out, h, w)?.into_any())
        }
    }
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyPhaseMap>()?;
    m.add_class::<PyDisagreement>()?;
    m.add_class::<PyWrappedPhase>()?;
    m.add_function(wrap_pyfunction!(decode, m)?)?;
    m.add_function(wrap_pyfunction!(decode_phase, m)?)?;
    m.add_function(wrap_pyfunction!(saturation_level, m)?)?;
    m.add_function(wrap_pyfunction!(unwrap_temporal, m)?)?;
    m.add_function(wrap_pyfunction!(unwrap_spatial, m)?)?;
    m.add_function(wrap_pyfunction!(decode_gray, m)?)
}
