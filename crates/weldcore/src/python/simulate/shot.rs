//! Simulated shots as Python sees them. Bodies are read by attribute: any object that has them will do.

use std::sync::Arc;

use numpy::{IntoPyArray, PyArray1, PyArray2, PyArray3, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;

use super::attributes::wrong_object;
use crate::error::Error;
use crate::fringes::FringeSet;
use crate::ground::transform::Transform;
use crate::python::call::{compute, raise};
use crate::python::convert::{Whole, float_matrix, floats, numbers, parts, transform, unmasked, whole};
use crate::python::scanner::lens::PyScanner;
use crate::scanner::{Axis, Rays};
use crate::simulate::{
    Bead, Body, Finish, Frames, Fringes, Photometry, Sample, Shape, SimulatedShot, Wall, Weld, simulate,
};

#[derive(FromPyObject)]
struct PyWall {
    radius_mm: f64,
    offset_mm: [f64; 2],
    tilt_rad: [f64; 2],
    ovality_mm: f64,
    ovality_at_rad: f64,
    waviness_mm: f64,
}

#[derive(FromPyObject)]
struct PyBead {
    width_mm: f64,
    height_mm: f64,
    ripple_mm: f64,
    pitch_mm: f64,
    wander_mm: f64,
}

#[derive(FromPyObject)]
struct PyWeld {
    reference: PyWall,
    other: PyWall,
    bead: PyBead,
    length_mm: f64,
}

#[derive(FromPyObject)]
struct PySurface {
    albedo: f64,
    specular: f64,
    shininess: f64,
    brushed: f64,
}

#[derive(FromPyObject)]
struct PyPhotometry {
    lamp: f64,
    distance_mm: f64,
    ambient: f64,
    black: f64,
    gamma: f64,
    blur_px: f64,
    full_well_e: f64,
    read_noise_e: f64,
    bits: u32,
}

fn weld(py: Python<'_>, w: PyWeld) -> PyResult<Weld> {
    let wall = |w: PyWall| Wall {
        radius_mm: w.radius_mm,
        offset_mm: w.offset_mm,
        tilt_rad: w.tilt_rad,
        ovality_mm: w.ovality_mm,
        ovality_at_rad: w.ovality_at_rad,
        waviness_mm: w.waviness_mm,
    };
    let b = w.bead;
    let bead = Bead {
        width_mm: b.width_mm,
        height_mm: b.height_mm,
        ripple_mm: b.ripple_mm,
        pitch_mm: b.pitch_mm,
        wander_mm: b.wander_mm,
    };
    Weld::new(wall(w.reference), wall(w.other), bead, w.length_mm).map_err(|e| raise(py, &e))
}

fn shape(object: &Bound<'_, PyAny>) -> PyResult<Shape> {
    let attribute = |name: &str| object.getattr(name);
    let kind = object.get_type().name()?.to_string();
    Ok(match kind.as_str() {
        "Sphere" => Shape::Sphere { radius_mm: attribute("radius_mm")?.extract()? },
        "Block" => Shape::Block {
            size_mm: attribute("size_mm")?.extract()?,
            squares: attribute("squares")?.extract()?,
            square_mm: attribute("square_mm")?.extract()?,
        },
        "Stem" => {
            Shape::Stem { radius_mm: attribute("radius_mm")?.extract()?, length_mm: attribute("length_mm")?.extract()? }
        }
        "Weld" => Shape::Weld(Box::new(weld(object.py(), object.extract()?)?)),
        _ => return Err(PyTypeError::new_err(format!("no shape is called {kind}"))),
    })
}

fn body(object: &Bound<'_, PyAny>) -> PyResult<Body> {
    let place = float_matrix("scene_from_body", &object.getattr("scene_from_body")?)?;
    let s: PySurface = object.getattr("surface")?.extract()?;
    Ok(Body {
        shape: shape(&object.getattr("shape")?)?,
        scene_from_body: transform("scene_from_body", &place)?,
        surface: Finish { albedo: s.albedo, specular: s.specular, shininess: s.shininess, brushed: s.brushed },
        label: object.getattr("label")?.extract()?,
    })
}

/// One simulated shot: its images, and what each pixel's centre saw.
#[pyclass(frozen, module = "weldscan", name = "SimulatedShot")]
pub(crate) struct PyShot {
    pub(crate) height: usize,
    pub(crate) width: usize,
    pub(crate) shot: SimulatedShot,
    pub(crate) rays: Arc<Rays>,
    /// Per exposure the image under even light, (H, W) uint8 or uint16.
    #[pyo3(get)]
    pub(crate) white: Vec<Py<PyAny>>,
    /// Exposures of frames: `frames[e][i]` is frame i, in the order of the fringes and their steps.
    #[pyo3(get)]
    pub(crate) frames: Vec<Vec<Py<PyAny>>>,
}

impl PyShot {
    fn image<'py>(&self, py: Python<'py>, value: impl Fn(&Sample) -> f64) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let flat: Vec<f64> = self.shot.samples.iter().map(value).collect();
        flat.into_pyarray(py).reshape([self.height, self.width])
    }
}

#[pymethods]
impl PyShot {
    /// The point that each pixel sees, (H, W, 3) float64, scanner's frame, mm; NaN for the background.
    #[getter]
    fn points_mm<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f64>>> {
        let rays = self.rays.x.iter().zip(&self.rays.y);
        let points = self.shot.samples.iter().zip(rays);
        let flat: Vec<f64> = points.flat_map(|(s, (x, y))| [x * s.depth_mm, y * s.depth_mm, s.depth_mm]).collect();
        flat.into_pyarray(py).reshape([self.height, self.width, 3])
    }

    /// The projector column that lights each pixel, (H, W) float64, px; NaN in the dark.
    #[getter]
    fn column_px<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        self.image(py, |s| s.column_px)
    }

    /// The projector row that lights each pixel, (H, W) float64, px; NaN in the dark.
    #[getter]
    fn row_px<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        self.image(py, |s| s.row_px)
    }

    /// Height of lit points of the other wall over the reference wall, (H, W) float64, mm; NaN elsewhere.
    #[getter]
    fn deviation_mm<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        self.image(py, |s| s.deviation_mm)
    }

    /// Angle about the axis of lit points of both walls, (H, W) float64, rad (plates: place along the seam, mm).
    #[getter]
    fn along<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        self.image(py, |s| s.along)
    }

    /// What each pixel sees, (H, W) uint8: the bodies' labels, 0 for the background.
    #[getter]
    fn labels<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<u8>>> {
        let flat: Vec<u8> = self.shot.samples.iter().map(|s| s.label).collect();
        flat.into_pyarray(py).reshape([self.height, self.width])
    }

    /// What the camera sees while the projector shows any picture.
    ///
    /// Args:
    ///     picture: (H, W) uint8, of the projector's size.
    ///     exposure: factor on the light.
    ///     number: tells the noise of one frame from that of another.
    ///
    /// Returns:
    ///     (H, W) uint8 or uint16, of the camera's size.
    ///
    /// Raises:
    ///     InputError: the picture is not of the projector's size, the exposure is not above zero.
    #[pyo3(signature = (picture, *, exposure=1.0, number=0))]
    fn capture(
        &self,
        picture: &Bound<'_, PyAny>,
        exposure: f64,
        #[pyo3(from_py_with = whole)] number: usize,
    ) -> PyResult<Py<PyAny>> {
        let py = picture.py();
        unmasked("picture", picture)?;
        let picture: PyReadonlyArray2<'_, u8> = picture.extract()?;
        let number = u32::try_from(number).map_err(|_| {
            let expected = "0 to 2^32 - 1".into();
            raise(py, &Error::OutOfRange { what: "number", expected, value: number.to_string() })
        })?;
        let pixels: Vec<u8> = picture.as_array().iter().copied().collect();
        match compute(py, || self.shot.capture(&pixels, exposure, number))? {
            Frames::Eight(frames) => array(py, frames.concat(), self.height, self.width),
            Frames::Sixteen(frames) => array(py, frames.concat(), self.height, self.width),
        }
    }

    fn __repr__(&self) -> String {
        let frames = self.frames.iter().map(Vec::len).sum::<usize>();
        format!("SimulatedShot({frames} frames of {}x{} px)", self.width, self.height)
    }
}

/// A fringe set as it comes.
#[derive(FromPyObject)]
enum AxisFringe {
    Plain((String, f64, Whole)),
    Foreign((String, f64, Whole, f64, f64)),
}

/// Renders the fringe images of one shot of an analytic scene, with their truth.
///
/// Args:
///     scanner: `Scanner`.
///     scene_from_scanner: (4, 4), where the scanner (its camera) stands in the scene, mm.
///     bodies: what stands in the scene: `weldscan.simulated.Body`.
///     fringes: sets of (axis "x" or "y", periods, steps), or these and (direction 1 or -1, origin_rad) as a session has
///         them; none for white images alone.
///     photometry: lamp, room, projector and sensor: `weldscan.simulated.Photometry`.
///     exposures: factors on the light, one stack of frames each.
///     seed: start of the random numbers.
///
/// Returns:
///     `SimulatedShot`: `white`, `frames`, and per pixel `points_mm`, `column_px`, `row_px`, `labels`, `deviation_mm`.
///
/// Raises:
///     InputError: a parameter is out of its range; the message names it.
///
/// Example:
///     >>> import numpy as np
///     >>> from weldscan import simulate_shot
///     >>> from weldscan.simulated import DEFAULT, Body, Photometry, Sphere
///     >>> ball = np.eye(4)
///     >>> ball[2, 3] = 420.0
///     >>> shot = simulate_shot(DEFAULT.scanner, np.eye(4), [Body(Sphere(10.0), ball)], [("x", 8, 4)], Photometry())
///     >>> float(round(np.nanmin(shot.points_mm[..., 2]), 3))
///     410.0
#[pyfunction]
#[pyo3(signature = (scanner, scene_from_scanner, bodies, fringes, photometry, *, exposures=None, seed=0))]
#[allow(clippy::too_many_arguments)] // They are what a shot depends on.
fn simulate_shot(
    scanner: &Bound<'_, PyScanner>,
    scene_from_scanner: &Bound<'_, PyAny>,
    bodies: Vec<Bound<'_, PyAny>>,
    fringes: &Bound<'_, PyAny>,
    photometry: &Bound<'_, PyAny>,
    exposures: Option<&Bound<'_, PyAny>>,
    #[pyo3(from_py_with = whole)] seed: usize,
) -> PyResult<PyShot> {
    let py = scanner.py();
    let exposures = exposures.map_or(Ok(vec![1.0]), |e| numbers("exposures", e))?;
    let pose: Transform = transform("scene_from_scanner", &float_matrix("scene_from_scanner", scene_from_scanner)?)?;
    let bodies = bodies
        .iter()
        .enumerate()
        .map(|(i, b)| body(b).map_err(|e| wrong_object(py, &format!("bodies[{i}]"), e)))
        .collect::<PyResult<Vec<_>>>()?;
    let axis = |name: &str| match name {
        "x" => Ok(Axis::X),
        "y" => Ok(Axis::Y),
        _ => {
            let value = name.to_string();
            Err(raise(py, &Error::OutOfRange { what: "fringe axis", expected: "\"x\" or \"y\"".into(), value }))
        }
    };
    let expected = "a list of (axis, periods, steps) or (axis, periods, steps, direction, origin_rad)";
    let fringes = parts::<Vec<AxisFringe>>("fringes", expected, fringes)?
        .into_iter()
        .map(|fringe| {
            let (name, periods, steps, direction, origin_rad) = match fringe {
                AxisFringe::Plain((name, periods, steps)) => (name, periods, steps, 1.0, 0.0),
                AxisFringe::Foreign(all) => all,
            };
            let set = FringeSet { periods, steps: steps.0, direction, origin_rad };
            Ok(Fringes { axis: axis(&name)?, set })
        })
        .collect::<PyResult<Vec<_>>>()?;
    let p: PyPhotometry = photometry.extract().map_err(|e| wrong_object(py, "photometry", e))?;
    let photometry = Photometry {
        lamp: p.lamp,
        distance_mm: p.distance_mm,
        ambient: p.ambient,
        black: p.black,
        gamma: p.gamma,
        blur_px: p.blur_px,
        full_well_e: p.full_well_e,
        read_noise_e: p.read_noise_e,
        bits: p.bits,
        seed: seed as u64,
    };
    let scanner = &scanner.get().scanner;
    let (mut shot, rays) = compute(py, || {
        let shot = simulate(scanner, &pose, &bodies, &fringes, &exposures, &photometry)?;
        Ok((shot, scanner.camera_rays()))
    })?;
    let (height, width) = (scanner.camera.height, scanner.camera.width);
    let rendered = std::mem::replace(&mut shot.frames, Frames::Eight(Vec::new()));
    let mut images = match rendered {
        Frames::Eight(frames) => frames.into_iter().map(|f| array(py, f, height, width)).collect::<PyResult<Vec<_>>>(),
        Frames::Sixteen(frames) => frames.into_iter().map(|f| array(py, f, height, width)).collect(),
    }?
    .into_iter();
    let steps = fringes.iter().map(|f| f.set.steps).sum();
    let stack = |_| (images.next(), images.by_ref().take(steps).collect());
    let (white, frames): (Vec<Option<_>>, Vec<_>) = exposures.iter().map(stack).unzip();
    Ok(PyShot { height, width, shot, rays, white: white.into_iter().flatten().collect(), frames })
}

fn array<T: numpy::Element>(py: Python<'_>, flat: Vec<T>, height: usize, width: usize) -> PyResult<Py<PyAny>> {
    Ok(flat.into_pyarray(py).reshape([height, width])?.into_any().unbind())
}

/// The true step of a simulated weld at the seam: other wall minus reference wall along the radius, waviness left out.
///
/// Args:
///     weld: `weldscan.simulated.Weld`.
///     along: (n,) angles about the axis, rad; for plates places along the seam, mm.
///
/// Returns:
///     (n,) float64, mm; positive where the other wall stands further out.
///
/// Raises:
///     InputError: a number is out of its range or not finite.
///
/// Example:
///     >>> import numpy as np
///     >>> from weldscan import simulated_step
///     >>> from weldscan.simulated import Bead, Wall, Weld
///     >>> weld = Weld(Wall(315.0), Wall(315.0, offset_mm=(0.5, 0.0)), Bead())
///     >>> simulated_step(weld, np.array([0.0, np.pi])).round(6)
///     array([ 0.5, -0.5])
#[pyfunction]
fn simulated_step<'py>(weld: &Bound<'py, PyAny>, along: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyArray1<f64>>> {
    let py = weld.py();
    let weld = self::weld(py, weld.extract().map_err(|e| wrong_object(py, "weld", e))?)?;
    let along: PyReadonlyArray1<'py, f64> = floats("along", along)?;
    if let Some(index) = along.as_array().iter().position(|a| !a.is_finite()) {
        return Err(raise(py, &Error::NonFinite { what: "along", index }));
    }
    let along = along.as_slice()?;
    Ok(compute(py, || Ok(weld.steps_at_seam(along)))?.into_pyarray(py))
}

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyShot>()?;
    m.add_function(wrap_pyfunction!(simulate_shot, m)?)?;
    m.add_function(wrap_pyfunction!(simulated_step, m)?)
}
