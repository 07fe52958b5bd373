//! Decoding as Python sees it.

use numpy::{PyArray2, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::prelude::*;

use super::images::{Images, frame, image, slices};
use super::response::{PyPhaseError, compensation};
use crate::error::Error;
use crate::fringes::{DecodeOptions, Disagreement, FringeSet, Fuse, Level, PhaseMap, Shot, decode_shot, saturation};
use crate::python::call::{compute, raise};
use crate::python::convert::{Whole, parts, unmasked, whole};

/// Frames of a stack that contradict each other, and the likely cause.
#[pyclass(frozen, get_all, module = "weldscan", name = "Disagreement")]
pub(crate) struct PyDisagreement {
    /// The exposure that is concerned.
    pub(crate) exposure: usize,
    /// The fringe set that is concerned; None: several.
    pub(crate) set: Option<usize>,
    /// The frames of the exposure that are concerned, from 0.
    pub(crate) frames: Vec<usize>,
    /// The likely cause in one line; steps count from 0 in their set.
    pub(crate) text: String,
    /// Share of the clear pixels that contradict the frames as they are stated.
    pub(crate) share: f64,
    /// How many times better the cause fits than the statement.
    pub(crate) strength: f64,
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
    pub(crate) column_px: Py<PyArray2<f64>>,
    /// Its standard deviation by noise, px; NaN where rejected. float32.
    pub(crate) sigma_px: Py<PyArray2<f32>>,
    /// Amplitude of the finest fringes, grey levels, in the exposure that counts most. float32.
    pub(crate) modulation: Py<PyArray2<f32>>,
    /// Mean level of the same images. float32.
    pub(crate) background: Py<PyArray2<f32>>,
    /// 0 ok, 1 dark, 2 saturated, 3 fringe order in doubt, 4 no fit. uint8.
    pub(crate) reason: Py<PyArray2<u8>>,
    /// Number of pixels by reason: ok, dark, saturated, order in doubt, no fit.
    pub(crate) counts: [usize; 5],
    /// Variance of the camera's read noise, grey levels squared.
    pub(crate) noise_read_variance: f64,
    /// Growth of the variance with the level: variance = noise_read_variance + 1/12 + noise_gain * level.
    pub(crate) noise_gain: f64,
    /// What the noise was seen in: "backgrounds", "residuals", "texture" (an upper bound) or "assumed".
    pub(crate) noise_source: String,
    /// Level from which a pixel counts as saturated.
    pub(crate) saturation: f64,
    /// Whether the images show that the camera clips there, below the full scale of its numbers.
    pub(crate) clipped_below_full_scale: bool,
    /// Where the frames contradict each other, and the likely cause. Empty for a stack that agrees with itself.
    pub(crate) disagreements: Vec<Py<PyDisagreement>>,
    /// Per fringe set the rms of the higher harmonics over the amplitude (None with three steps, which show none).
    /// Above 0.05 or so the projector's gamma wants correcting.
    pub(crate) harmonics: Vec<Option<f64>>,
    /// Per fringe set what was taken off its phase.
    pub(crate) phase_error: Vec<Py<PyPhaseError>>,
    /// The chain of frequencies by which the fringes were counted, periods over the projector.
    pub(crate) unwrapped_by: Vec<f64>,
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

fn decode_as<T: Fuse + numpy::Element>(
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
    let options = DecodeOptions { saturation, z, compensation: compensation(py, phase_error, &sets)? };
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
        let found = compute(py, || Ok(saturation(&shot, None)))?;
        Ok((found.level, found.full_scale, found.below_full_scale))
    }
    let (found, size) = super::images::images("images", images)?;
    match &found {
        Images::U8(a) => look(py, a, size),
        Images::U16(a) => look(py, a, size),
        Images::F64(_) => {
            let (expected, got) = ("uint8 or uint16 images, all alike".into(), "another type".into());
            Err(raise(py, &Error::Shape { what: "images", expected, got }))
        }
    }
}

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyPhaseMap>()?;
    m.add_class::<PyDisagreement>()?;
    m.add_function(wrap_pyfunction!(decode, m)?)?;
    m.add_function(wrap_pyfunction!(saturation_level, m)?)
}
