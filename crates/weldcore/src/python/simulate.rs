//! The simulator as Python sees it. Bodies are read by attribute: any object that has them will do.

use std::sync::Arc;

use numpy::{IntoPyArray, PyArray1, PyArray2, PyArray3, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::exceptions::{PyAttributeError, PyOverflowError, PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use super::scanner::PyScanner;
use super::{Whole, compute, float_matrix, floats, numbers, parts, raise, raise_as, transform, unmasked, whole};
use crate::error::Error;
use crate::scanner::Rays;
use crate::simulate::scene;
use crate::simulate::{
    Axis, Bead, Body, Frames, FringeSet, Photometry, Sample, Shape, Shot, Surface, Wall, Weld, simulate,
};
use crate::transform::Transform;

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
        surface: Surface { albedo: s.albedo, specular: s.specular, shininess: s.shininess, brushed: s.brushed },
        label: object.getattr("label")?.extract()?,
    })
}

/// An object that lacks an attribute, or has one of the wrong type, is a wrong input.
fn wrong_object(py: Python<'_>, what: &str, error: PyErr) -> PyErr {
    let wrong = error.is_instance_of::<PyAttributeError>(py)
        || error.is_instance_of::<PyTypeError>(py)
        || error.is_instance_of::<PyOverflowError>(py)
        || error.is_instance_of::<PyValueError>(py);
    if wrong { raise_as(py, "InputError", format!("{what}: {}", error.value(py))) } else { error }
}

/// One simulated shot: its images, and what each pixel's centre saw.
#[pyclass(frozen, module = "weldscan", name = "SimulatedShot")]
pub(crate) struct PyShot {
    pub(super) height: usize,
    pub(super) width: usize,
    pub(super) shot: Shot,
    pub(super) rays: Arc<Rays>,
    /// Per exposure the image under even light, (H, W) uint8 or uint16.
    #[pyo3(get)]
    pub(super) white: Vec<Py<PyAny>>,
    /// Exposures of frames: `frames[e][i]` is frame i, in the order of the fringes and their steps.
    #[pyo3(get)]
    pub(super) frames: Vec<Vec<Py<PyAny>>>,
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
enum Fringe {
    Plain((String, f64, Whole)),
    Foreign((String, f64, Whole, f64, f64)),
}

/// Renders the fringe images of one shot of an analytic scene, with their truth.
///
/// Args:
///     scanner: `Scanner`.
///     scene_from_scanner: (4, 4), where the scanner (its camera) stands in the scene, mm.
///     bodies: what stands in the scene: `weldscan.simulated.cell.Body`.
///     fringes: sets of (axis "x" or "y", periods, steps), or these and (direction 1 or -1, origin_rad) as a session has
///         them; none for white images alone.
///     photometry: lamp, room, projector and sensor: `weldscan.simulated.cell.Photometry`.
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
///     >>> from weldscan.simulated.cell import DEFAULT, Body, Photometry, Sphere
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
    let fringes = parts::<Vec<Fringe>>("fringes", expected, fringes)?
        .into_iter()
        .map(|fringe| {
            let (name, periods, steps, direction, origin_rad) = match fringe {
                Fringe::Plain((name, periods, steps)) => (name, periods, steps, 1.0, 0.0),
                Fringe::Foreign(all) => all,
            };
            Ok(FringeSet { axis: axis(&name)?, periods, steps: steps.0, direction, origin_rad })
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
    let steps = fringes.iter().map(|f| f.steps).sum();
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
///     weld: `weldscan.simulated.cell.Weld`.
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
///     >>> from weldscan.simulated.cell import Bead, Wall, Weld
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

#[derive(FromPyObject)]
struct PyHarmonic {
    n: u32,
    amplitude_mm: f64,
    at_rad: f64,
}

#[derive(FromPyObject)]
struct PyUnevenness {
    sd_mm: f64,
    around_mm: f64,
    along_mm: f64,
}

#[derive(FromPyObject)]
struct PyWander {
    sd_mm: f64,
    length_mm: f64,
}

#[derive(FromPyObject)]
struct PyTaper {
    depth_mm: f64,
    slope: f64,
}

#[derive(FromPyObject)]
struct PyCounterbore {
    depth_mm: f64,
    floor_mm: f64,
    slope: f64,
}

#[derive(FromPyObject)]
struct PyFlare {
    amplitude_mm: f64,
    decay_mm: f64,
}

#[derive(FromPyObject)]
struct PyDent {
    depth_mm: f64,
    at_rad: f64,
    width_rad: f64,
    decay_mm: f64,
    cosine: bool,
}

#[derive(FromPyObject)]
struct PyStrip {
    thickness_mm: f64,
    from_mm: f64,
    to_mm: f64,
    edge_mm: f64,
}

#[derive(FromPyObject)]
struct PySceneWall {
    radius_difference_mm: f64,
    offset_mm: [f64; 2],
    tilt_rad: [f64; 2],
    ovality: Vec<PyHarmonic>,
    unevenness: Vec<PyUnevenness>,
    shrinkage_mm: f64,
    taper: Option<PyTaper>,
    counterbore: Option<PyCounterbore>,
    flare: Option<PyFlare>,
    dents: Vec<PyDent>,
    strips: Vec<PyStrip>,
}

#[derive(FromPyObject)]
struct PyCap {
    width_mm: f64,
    height_mm: f64,
    power: f64,
    blend: f64,
    crown: f64,
    valley: f64,
    ripple_mm: f64,
    pitch_mm: f64,
    toes: PyWander,
    crest: PyWander,
    undercut_mm: [f64; 2],
    undercut_width_mm: f64,
}

#[derive(FromPyObject)]
struct PySecondSeam {
    distance_mm: f64,
    width_mm: f64,
    height_mm: f64,
    ring_mm: f64,
}

#[derive(FromPyObject)]
struct PySpatter {
    at_rad: f64,
    z_mm: f64,
    radius_mm: f64,
}

#[derive(FromPyObject)]
struct PyScene {
    radius_mm: f64,
    thickness_mm: f64,
    half_length_mm: f64,
    reference: PySceneWall,
    other: PySceneWall,
    cap: PyCap,
    seam_mm: f64,
    seam_wander: PyWander,
    second: Option<PySecondSeam>,
    spatter: Vec<PySpatter>,
    seed: u64,
}

impl From<PyWander> for scene::Wander {
    fn from(w: PyWander) -> Self {
        Self { sd_mm: w.sd_mm, length_mm: w.length_mm }
    }
}

impl From<PySceneWall> for scene::Wall {
    fn from(w: PySceneWall) -> Self {
        let harmonic = |h: PyHarmonic| scene::Harmonic { n: h.n, amplitude_mm: h.amplitude_mm, at_rad: h.at_rad };
        let uneven =
            |u: PyUnevenness| scene::Unevenness { sd_mm: u.sd_mm, around_mm: u.around_mm, along_mm: u.along_mm };
        let dent = |d: PyDent| scene::Dent {
            depth_mm: d.depth_mm,
            at_rad: d.at_rad,
            width_rad: d.width_rad,
            decay_mm: d.decay_mm,
            cosine: d.cosine,
        };
        let strip = |s: PyStrip| scene::Strip {
            thickness_mm: s.thickness_mm,
            from_mm: s.from_mm,
            to_mm: s.to_mm,
            edge_mm: s.edge_mm,
        };
        Self {
            radius_difference_mm: w.radius_difference_mm,
            offset_mm: w.offset_mm,
            tilt_rad: w.tilt_rad,
            ovality: w.ovality.into_iter().map(harmonic).collect(),
            unevenness: w.unevenness.into_iter().map(uneven).collect(),
            shrinkage_mm: w.shrinkage_mm,
            taper: w.taper.map(|t| scene::Taper { depth_mm: t.depth_mm, slope: t.slope }),
            counterbore: w.counterbore.map(|c| scene::Counterbore {
                depth_mm: c.depth_mm,
                floor_mm: c.floor_mm,
                slope: c.slope,
            }),
            flare: w.flare.map(|f| scene::Flare { amplitude_mm: f.amplitude_mm, decay_mm: f.decay_mm }),
            dents: w.dents.into_iter().map(dent).collect(),
            strips: w.strips.into_iter().map(strip).collect(),
        }
    }
}

impl From<PyScene> for scene::Scene {
    fn from(s: PyScene) -> Self {
        let c = s.cap;
        Self {
            radius_mm: s.radius_mm,
            thickness_mm: s.thickness_mm,
            half_length_mm: s.half_length_mm,
            reference: s.reference.into(),
            other: s.other.into(),
            cap: scene::Cap {
                width_mm: c.width_mm,
                height_mm: c.height_mm,
                power: c.power,
                blend: c.blend,
                crown: c.crown,
                valley: c.valley,
                ripple_mm: c.ripple_mm,
                pitch_mm: c.pitch_mm,
                toes: c.toes.into(),
                crest: c.crest.into(),
                undercut_mm: c.undercut_mm,
                undercut_width_mm: c.undercut_width_mm,
            },
            seam_mm: s.seam_mm,
            seam_wander: s.seam_wander.into(),
            second: s.second.map(|s| scene::SecondSeam {
                distance_mm: s.distance_mm,
                width_mm: s.width_mm,
                height_mm: s.height_mm,
                ring_mm: s.ring_mm,
            }),
            spatter: (s.spatter.into_iter())
                .map(|d| scene::Spatter { at_rad: d.at_rad, z_mm: d.z_mm, radius_mm: d.radius_mm })
                .collect(),
            seed: s.seed,
        }
    }
}

/// The surface of a weld as a height field over a pipe, its random parts drawn.
///
/// Args:
///     weld: `weldscan.simulated.drawn.Weld`.
///
/// Raises:
///     InputError: a number is out of its range or not finite; the message names it.
#[pyclass(frozen, module = "weldscan._weldcore", name = "WeldSurface")]
pub(crate) struct PyWeldSurface {
    surface: scene::Surface,
    /// What it is pickled as.
    pub(super) weld: Py<PyAny>,
}

#[pymethods]
impl PyWeldSurface {
    #[new]
    pub(super) fn new(weld: &Bound<'_, PyAny>) -> PyResult<Self> {
        let py = weld.py();
        let given: PyScene = weld.extract().map_err(|e| wrong_object(py, "weld", e))?;
        let surface = compute(py, || scene::Surface::new(given.into()))?;
        Ok(Self { surface, weld: weld.clone().unbind() })
    }

    /// Height of the surface over the nominal radius.
    ///
    /// Args:
    ///     angle_rad: (n,) angles about the pipe, rad.
    ///     z_mm: (n,) places along the pipe, mm.
    ///
    /// Returns:
    ///     (n,) float64, mm.
    ///
    /// Raises:
    ///     InputError: the lengths differ, or a number is not finite.
    fn height<'py>(
        &self,
        angle_rad: &Bound<'py, PyAny>,
        z_mm: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let py = angle_rad.py();
        let (angle, z) = (finite("angle_rad", angle_rad)?, finite("z_mm", z_mm)?);
        if angle.len() != z.len() {
            let (expected, got) = (format!("{} as angle_rad", angle.len()), z.len().to_string());
            return Err(raise(py, &Error::Shape { what: "z_mm", expected, got }));
        }
        let places: Vec<[f64; 2]> = angle.into_iter().zip(z).map(|(a, z)| [a, z]).collect();
        Ok(compute(py, || Ok(self.surface.heights_at(&places)))?.into_pyarray(py))
    }

    /// The truth at the two toes.
    ///
    /// Args:
    ///     angle_rad: (n,) angles about the pipe, rad.
    ///
    /// Returns:
    ///     (n, 6) float64, mm: z of the reference wall's toe and of the other wall's; height of the reference wall's and
    ///     of the other wall's surface there over the nominal radius; height of the cap; step at the second weld.
    ///
    /// Raises:
    ///     InputError: an angle is not finite.
    fn edges<'py>(&self, angle_rad: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let py = angle_rad.py();
        let angle = finite("angle_rad", angle_rad)?;
        let edges = compute(py, || Ok(self.surface.edges_at(&angle)))?;
        let row = |e: &scene::Edges| {
            [e.toes_mm[0], e.toes_mm[1], e.heights_mm[0], e.heights_mm[1], e.cap_mm, e.second_step_mm]
        };
        let flat: Vec<f64> = edges.iter().flat_map(row).collect();
        flat.into_pyarray(py).reshape([edges.len(), 6])
    }

    /// What every pixel of a scanner sees.
    ///
    /// Args:
    ///     scanner: `Scanner`.
    ///     weld_from_scanner: (4, 4), where the scanner (its camera) stands in the weld's frame, mm.
    ///
    /// Returns:
    ///     A dict of arrays of the camera's size: `points_mm` (H, W, 3) in the scanner's frame; `column_px` and `row_px`,
    ///     the projector pixel that lights the point; `angle_rad`, `z_mm`; `light` and `gloss`, the cosines of the
    ///     surface's normal to the light and to the bisector of light and view; `part` (1 reference wall, 2 other wall,
    ///     3 cap, 4 second cap, 5 spatter, 0 nothing); `status` (0 lit, 1 grazing, 2 shaded, 3 outside the projector's
    ///     image, 4 nothing).
    ///
    /// Raises:
    ///     InputError: the pose is not a rigid transform.
    fn cast<'py>(
        &self,
        scanner: &Bound<'py, PyScanner>,
        weld_from_scanner: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyDict>> {
        let py = scanner.py();
        let pose = transform("weld_from_scanner", &float_matrix("weld_from_scanner", weld_from_scanner)?)?;
        let scanner = &scanner.get().scanner;
        let (seen, rays) = compute(py, || Ok((self.surface.cast(scanner, &pose), scanner.camera_rays())))?;
        let size = [scanner.camera.height, scanner.camera.width];
        let image =
            |of: &dyn Fn(&scene::Seen) -> f64| seen.iter().map(of).collect::<Vec<f64>>().into_pyarray(py).reshape(size);
        let bytes =
            |of: &dyn Fn(&scene::Seen) -> u8| seen.iter().map(of).collect::<Vec<u8>>().into_pyarray(py).reshape(size);
        let points = seen.iter().zip(rays.x.iter().zip(&rays.y));
        let flat: Vec<f64> = points.flat_map(|(s, (x, y))| [x * s.depth_mm, y * s.depth_mm, s.depth_mm]).collect();
        let found = PyDict::new(py);
        found.set_item("points_mm", flat.into_pyarray(py).reshape([size[0], size[1], 3])?)?;
        found.set_item("column_px", image(&|s| s.column_px)?)?;
        found.set_item("row_px", image(&|s| s.row_px)?)?;
        found.set_item("angle_rad", image(&|s| s.angle_rad)?)?;
        found.set_item("z_mm", image(&|s| s.z_mm)?)?;
        found.set_item("light", image(&|s| f64::from(s.light))?)?;
        found.set_item("gloss", image(&|s| f64::from(s.gloss))?)?;
        found.set_item("part", bytes(&|s| s.part)?)?;
        found.set_item("status", bytes(&|s| s.status as u8)?)?;
        Ok(found)
    }

    fn __repr__(&self) -> String {
        let scene = self.surface.scene();
        format!("WeldSurface({} x {} mm)", 2.0 * scene.radius_mm, scene.thickness_mm)
    }
}

/// A 1-D array of finite numbers.
fn finite(what: &'static str, given: &Bound<'_, PyAny>) -> PyResult<Vec<f64>> {
    let array: PyReadonlyArray1<'_, f64> = floats(what, given)?;
    match array.as_array().iter().position(|a| !a.is_finite()) {
        Some(index) => Err(raise(given.py(), &Error::NonFinite { what, index })),
        None => Ok(array.as_array().to_vec()),
    }
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyShot>()?;
    m.add_class::<PyWeldSurface>()?;
    m.add_function(wrap_pyfunction!(simulate_shot, m)?)?;
    m.add_function(wrap_pyfunction!(simulated_step, m)?)
}
