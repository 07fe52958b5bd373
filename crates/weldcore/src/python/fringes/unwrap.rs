//! From wrapped to absolute phase as Python sees it.

use numpy::{PyArray2, PyArrayDyn, PyArrayMethods, PyReadonlyArray2, PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::prelude::*;

use super::images::{image, shaped, slices};
use crate::error::Error;
use crate::fringes::{DecodeOptions, GrayImages, absolute_from_gray, decode_gray as decode_gray_core};
use crate::python::call::{compute, raise};
use crate::python::convert::{float_matrix, floats, numbers, unmasked};

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
    let out = compute(py, || crate::fringes::unwrap_temporal(&phases, &periods, z))?;
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
    let out = compute(py, || crate::fringes::unwrap_spatial(phase, shape[1], m, q))?;
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
    let shape = super::images::images("images", images)?.1;
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

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(unwrap_temporal, m)?)?;
    m.add_function(wrap_pyfunction!(unwrap_spatial, m)?)?;
    m.add_function(wrap_pyfunction!(decode_gray, m)?)
}
