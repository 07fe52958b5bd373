//! The surfaces of welds as they come, as Python sees them.

use numpy::{IntoPyArray, PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use super::attributes::wrong_object;
use crate::error::Error;
use crate::python::call::{compute, raise};
use crate::python::convert::{float_matrix, floats, transform};
use crate::python::scanner::lens::PyScanner;
use crate::simulate::scene;

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

impl From<PySceneWall> for scene::SceneWall {
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
///     weld: `weldscan.simulated.scenes.SceneWeld`.
///
/// Raises:
///     InputError: a number is out of its range or not finite; the message names it.
#[pyclass(frozen, module = "weldscan._weldcore", name = "WeldSurface")]
pub(crate) struct PyWeldSurface {
    surface: scene::WeldSurface,
    /// What it is pickled as.
    pub(crate) weld: Py<PyAny>,
}

#[pymethods]
impl PyWeldSurface {
    #[new]
    pub(crate) fn new(weld: &Bound<'_, PyAny>) -> PyResult<Self> {
        let py = weld.py();
        let given: PyScene = weld.extract().map_err(|e| wrong_object(py, "weld", e))?;
        let surface = compute(py, || scene::WeldSurface::new(given.into()))?;
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

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyWeldSurface>()
}
