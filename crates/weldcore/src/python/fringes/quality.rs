//! The quality of captures for Python (see `weldscan.station.capture`).

use numpy::PyReadonlyArray2;
use pyo3::prelude::*;

use super::images::{Images, images, slices};
use crate::error::Error;
use crate::fringes::{Level, Quality, Shot, quality};
use crate::python::call::{compute, raise};
use crate::python::convert::whole;

/// Judges whether a shot's exposures can be measured, by the frames of its finest fringes; nothing is decoded.
///
/// exposures: lists of (H, W) uint8 or uint16 images, all alike. first, steps: which frames of each are the finest fringes'.
/// least_modulation: in parts of full scale: below it a pixel counts as dark. full_scale: of the camera's numbers; by default the
/// narrowest that holds the images, which for dark images is too narrow. Returns the shares of pixels that are usable,
/// saturated and dark, and the median modulation of the usable ones in parts of full scale. Raises InputError for images that are
/// not alike or too few. Source: `crates/weldcore/src/fringes/quality.rs`.
#[pyfunction]
#[pyo3(signature = (exposures, first, steps, least_modulation, full_scale=None))]
fn capture_quality(
    py: Python<'_>,
    exposures: Vec<Bound<'_, PyAny>>,
    #[pyo3(from_py_with = whole)] first: usize,
    #[pyo3(from_py_with = whole)] steps: usize,
    least_modulation: f64,
    full_scale: Option<u32>,
) -> PyResult<(f64, f64, f64, f64)> {
    let wrong = |got: &str| {
        let expected = "uint8 or uint16 images, all alike".into();
        raise(py, &Error::Shape { what: "exposures", expected, got: got.into() })
    };
    let (mut narrow, mut wide, mut size) = (Vec::new(), Vec::new(), None);
    for exposure in &exposures {
        let (found, here) = images("exposures", exposure)?;
        if *size.get_or_insert(here) != here {
            return Err(wrong("images of two sizes"));
        }
        match found {
            Images::U8(frames) => narrow.push(frames),
            Images::U16(frames) => wide.push(frames),
            Images::F64(_) => return Err(wrong("another type")),
        }
    }
    let size = size.ok_or_else(|| wrong("none"))?;
    let finest = first..first.saturating_add(steps);
    let found = match (narrow.is_empty(), wide.is_empty()) {
        (false, true) => look(py, &narrow, size, finest, (least_modulation, full_scale)),
        (true, false) => look(py, &wide, size, finest, (least_modulation, full_scale)),
        _ => Err(wrong("both types")),
    }?;
    Ok((found.usable, found.saturated, found.dark, found.median_modulation))
}

fn look<T: Level + numpy::Element>(
    py: Python<'_>,
    exposures: &[Vec<PyReadonlyArray2<'_, T>>],
    [height, width]: [usize; 2],
    finest: std::ops::Range<usize>,
    (least_modulation, full_scale): (f64, Option<u32>),
) -> PyResult<Quality> {
    let exposures = exposures.iter().map(|frames| slices(frames)).collect::<PyResult<Vec<_>>>()?;
    let shot = Shot { exposures, width, height };
    compute(py, || quality(&shot, finest, least_modulation, full_scale))
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(capture_quality, m)?)
}
