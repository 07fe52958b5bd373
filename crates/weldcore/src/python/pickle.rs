//! Pickling and copying of every class: one function that takes an object apart, and one that puts it together again.
//!
//! What the core made is packed number by number, to the last bit; a tree or a mesh is built anew from what it was built
//! of, which gives the same one. A packed state is for the same version of weldscan: another one refuses it.

use std::sync::Arc;

use nalgebra::SMatrix;
use pyo3::PyClass;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict, PyTuple};

use crate::clouds::icp;
use crate::clouds::kdtree::KdTree;
use crate::clouds::mesh::Mesh;
use crate::ground::transform::Transform;
use crate::python::call::{compute, raise, raise_as};
use crate::python::clouds::distance::PyMesh;
use crate::python::clouds::icp::{PyRegistration, PyWeak};
use crate::python::clouds::kdtree::{PyFollower, PyKdTree};
use crate::python::fringes::decode::{PyDisagreement, PyPhaseMap};
use crate::python::fringes::response::PyPhaseError;
use crate::python::fringes::wrapped::PyWrappedPhase;
use crate::python::ground::transform::PyRigidFit;
use crate::python::scanner::lens::{PyLens, PyScanner};
use crate::python::scanner::triangulate::{PyCloud, PyReferencePlane};
use crate::python::seam::{PyCourse, PySeam};
use crate::python::simulate::scene::PyWeldSurface;
use crate::python::simulate::shot::PyShot;
use crate::python::step::WeldStep;
use crate::python::surfaces::find_spheres::PyFoundSphere;
use crate::python::surfaces::fit::{Common, CylinderFit, PlaneFit, SphereFit};
use crate::python::surfaces::shapes::{PyCylinder, PyPlane, PySphere};
use crate::python::weld::WeldShot;
use crate::scanner::{Lens, Rays, Scanner};
use crate::simulate::{Frames, Photometry, Sample, SimulatedShot};
use crate::surfaces::find_spheres::FoundSphere;
use crate::surfaces::{Cylinder, Plane, Sphere};
use crate::weld::sections::{Doubt, Edge, Grid, Kind, Sections, Station, WallRun};
use crate::weld::segment::Segmentation;
use crate::weld::step::{FoundUnevenness, LargestStep, OwnSurface, ProfileBin, Step, StepWave, Stretched};
use crate::weld::{Course, Seam, Unrolled};

const VERSION: &str = env!("CARGO_PKG_VERSION");

/// What can be packed into bytes and taken from them again.
trait State: Sized {
    fn put(&self, to: &mut Vec<u8>);
    /// None where the bytes are none of this.
    fn take(from: &mut &[u8]) -> Option<Self>;
}

macro_rules! numbers {
    ($($number:ty),*) => { $(
        impl State for $number {
            fn put(&self, to: &mut Vec<u8>) {
                to.extend_from_slice(&self.to_le_bytes());
            }
            fn take(from: &mut &[u8]) -> Option<Self> {
                let (bytes, rest) = from.split_first_chunk()?;
                *from = rest;
                Some(Self::from_le_bytes(*bytes))
            }
        }
    )* };
}

numbers!(u8, u32, u64, f32, f64);

/// By way of another type.
macro_rules! by_way_of {
    ($($type:ty: $way:ty, $to:expr, $from:expr;)*) => { $(
        impl State for $type {
            fn put(&self, to: &mut Vec<u8>) {
                <$way>::put(&$to(self), to);
            }
            fn take(from: &mut &[u8]) -> Option<Self> {
                $from(<$way>::take(from)?)
            }
        }
    )* };
}

by_way_of! {
    usize: u64, |n: &usize| *n as u64, |n| usize::try_from(n).ok();
    Course: f64, |c: &Course| c.radius_mm(), |radius_mm| Course::of_radius(radius_mm).ok();
    bool: u8, |b: &bool| u8::from(*b), |n| (n < 2).then_some(n == 1);
    String: Vec<u8>, |text: &String| text.clone().into_bytes(), |bytes| String::from_utf8(bytes).ok();
    Kind: u8, |k: &Kind| *k as u8, |n| [Kind::Unknown, Kind::Raised, Kind::Hollow, Kind::Flush].get(usize::from(n)).copied();
    icp::WeakKind: u8, |k: &icp::WeakKind| *k as u8,
        |n| [icp::WeakKind::Translation, icp::WeakKind::Rotation, icp::WeakKind::Screw].get(usize::from(n)).copied();
    &'static str: String, |text: &&str| (*text).to_string(), |text| Some(lasting(text));
}

/// One of the core's own words, of which there are a few.
fn lasting(text: String) -> &'static str {
    let known = ["cap", "edges", "transition", "walls", "points-without-wall"];
    known.into_iter().find(|k| *k == text).unwrap_or_else(|| text.leak())
}

impl<T: State> State for Vec<T> {
    fn put(&self, to: &mut Vec<u8>) {
        self.len().put(to);
        self.iter().for_each(|item| item.put(to));
    }
    fn take(from: &mut &[u8]) -> Option<Self> {
        let count = usize::take(from)?;
        // No item takes less than a byte.
        (count <= from.len()).then_some(())?;
        (0..count).map(|_| T::take(from)).collect()
    }
}

impl<T: State> State for Option<T> {
    fn put(&self, to: &mut Vec<u8>) {
        self.is_some().put(to);
        self.iter().for_each(|item| item.put(to));
    }
    fn take(from: &mut &[u8]) -> Option<Self> {
        Some(if bool::take(from)? { Some(T::take(from)?) } else { None })
    }
}

impl<T: State, const N: usize> State for [T; N] {
    fn put(&self, to: &mut Vec<u8>) {
        self.iter().for_each(|item| item.put(to));
    }
    fn take(from: &mut &[u8]) -> Option<Self> {
        (0..N).map(|_| T::take(from)).collect::<Option<Vec<T>>>()?.try_into().ok()
    }
}

impl<const R: usize, const C: usize> State for SMatrix<f64, R, C> {
    fn put(&self, to: &mut Vec<u8>) {
        self.iter().for_each(|v| v.put(to));
    }
    fn take(from: &mut &[u8]) -> Option<Self> {
        let mut all = Self::zeros();
        for v in all.iter_mut() {
            *v = f64::take(from)?;
        }
        Some(all)
    }
}

macro_rules! tuples {
    ($(($($name:ident: $place:tt),*))*) => { $(
        impl<$($name: State),*> State for ($($name,)*) {
            fn put(&self, to: &mut Vec<u8>) {
                $(self.$place.put(to);)*
            }
            fn take(from: &mut &[u8]) -> Option<Self> {
                Some(($($name::take(from)?,)*))
            }
        }
    )* };
}

tuples! { (A: 0, B: 1) (A: 0, B: 1, C: 2) }

/// Structs, field by field: one that is left out does not compile.
macro_rules! structs {
    ($($type:path { $($field:ident),* $(,)? })*) => { $(
        impl State for $type {
            fn put(&self, to: &mut Vec<u8>) {
                $(self.$field.put(to);)*
            }
            fn take(from: &mut &[u8]) -> Option<Self> {
                $(let $field = State::take(from)?;)*
                Some(Self { $($field),* })
            }
        }
    )* };
}

structs! {
    Lens { width, height, fx, fy, cx, cy, dist }
    Transform { rotation, translation }
    Rays { x, y }
    Plane { point_mm, normal }
    Sphere { center_mm, radius_mm }
    Cylinder { point_mm, axis, radius_mm }
    FoundSphere {
        sphere, covariance, rms_mm, inliers, coverage, free_radius_mm, free_radius_sigma_mm,
    }
    Common { rms_mm, covariance, iterations, inliers }
    PlaneFit { surface, common }
    SphereFit { surface, common }
    CylinderFit { surface, common }
    PyRigidFit { fit, rms_mm }
    icp::Weak { kind, axis, point_mm, strength, vector }
    icp::Registration { target_from_source, converged, iterations, rms_mm, inliers, covariance, unobserved }
    Seam { origin_mm, across, zero, course }
    Unrolled { at, across_mm, height_mm }
    Grid {
        middle, course, start_along, station_mm, stations, start_across, bin_mm, bins, heights, noise_mm,
        cell_sigma_mm,
    }
    WallRun { from, to, height, slope, shrinkage, rms, slope_u, centre }
    Edge { step_mm, standard_mm, hull_mm, foot_mm }
    Station {
        at, seen, kind, by_course, toes_mm, toes_standard_mm, height_mm, edge, local_step_mm, undisturbed_mm, departure_mm,
        wall_step_mm, walls,
    }
    Doubt { code, at, text }
    Sections { grid, stations, station_mm, doubts, cap_width_mm, cap_height_mm, noise_mm }
    Segmentation {
        seam, labels, unrolled, noise_mm, bead_width_mm, course_fitted, fates, thickness_mm, sections,
    }
    ProfileBin { along, step_mm, standard_mm, fit_mm, unevenness_mm, place_mm, band_mm, departure }
    LargestStep { at, quantiles, interval_mm, band_factor }
    StepWave { n, amplitude_mm, standard_mm, prior_mm }
    Stretched { course, middle, half }
    OwnSurface { stretch, table }
    FoundUnevenness { sd_mm, reach_mm, noise }
    Step {
        mean_mm, median_mm, seam_mean_mm, largest, profile, covariance_mm2, departure_limit, coverage, curvature_mm,
        offset_mm, offset_standard_mm, tilt_rad, tilt_standard_rad, waves, shrinkage_mm, unevenness, residual_rms_mm,
        cells, surfaces,
    }
    Sample { depth_mm, column_px, row_px, deviation_mm, along, direct, ambient, label }
    Photometry { lamp, distance_mm, ambient, black, gamma, blur_px, full_well_e, read_noise_e, bits, seed }
}

/// A class that can be taken apart and put together again.
trait Pickled: PyClass {
    fn apart<'py>(object: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>>;
    fn together(state: &Bound<'_, PyAny>) -> PyResult<Self>;
}

fn packed<'py>(py: Python<'py>, state: &impl State) -> Bound<'py, PyAny> {
    let mut bytes = Vec::new();
    state.put(&mut bytes);
    PyBytes::new(py, &bytes).into_any()
}

fn unpacked<T: State>(state: &Bound<'_, PyAny>) -> PyResult<T> {
    let mut bytes = state.cast::<PyBytes>()?.as_bytes();
    let whole = T::take(&mut bytes).filter(|_| bytes.is_empty());
    whole.ok_or_else(|| raise_as(state.py(), "InputError", "the pickled object is damaged".into()))
}

/// What is packed of a class, and how it comes together from it.
macro_rules! by_bytes {
    ($($class:ty: $object:ident => $state:expr, $taken:pat => $made:expr;)*) => { $(
        impl Pickled for $class {
            fn apart<'py>(object: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
                let $object = object.get();
                Ok(packed(object.py(), &$state))
            }
            fn together(state: &Bound<'_, PyAny>) -> PyResult<Self> {
                let $taken = unpacked(state)?;
                Ok($made)
            }
        }
    )* };
}

by_bytes! {
    PyLens: o => o.lens, lens => Self { lens };
    PyPlane: o => o.0, it => Self(it);
    PySphere: o => o.0, it => Self(it);
    PyCylinder: o => o.0, it => Self(it);
    PyWeak: o => o.0, it => Self(it);
    PyRegistration: o => o.0, it => Self(it);
    PyFoundSphere: o => o.0, it => Self(it);
    PyCourse: o => o.0, it => Self(it);
    PySeam: o => o.0, it => Self(it);
    WeldShot: o => o.0, it => Self(it);
    WeldStep: o => o.0, it => Self(it);
    PlaneFit: o => *o, it => it;
    SphereFit: o => *o, it => it;
    CylinderFit: o => *o, it => it;
    PyRigidFit: o => *o, it => it;
}

/// Classes that show all their fields: as a dict of them.
macro_rules! by_fields {
    ($($class:ident { $($field:ident),* $(,)? })*) => { $(
        impl Pickled for $class {
            fn apart<'py>(object: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
                let state = PyDict::new(object.py());
                $(state.set_item(stringify!($field), object.getattr(stringify!($field))?)?;)*
                Ok(state.into_any())
            }
            fn together(state: &Bound<'_, PyAny>) -> PyResult<Self> {
                Ok(Self { $($field: state.get_item(stringify!($field))?.extract()?),* })
            }
        }
    )* };
}

by_fields! {
    PyPhaseMap {
        column_px, sigma_px, modulation, background, reason, counts, noise_read_variance, noise_gain, noise_source,
        saturation, clipped_below_full_scale, disagreements, harmonics, phase_error, unwrapped_by,
    }
    PyDisagreement { exposure, set, frames, text, share, strength }
    PyWrappedPhase { phase_rad, modulation, background, residual }
    PyPhaseError { steps, sin_rad, standard_rad, source, largest_rad }
    PyCloud { points_mm, sigma_mm }
    PyReferencePlane { a, b, rms_mm }
}

impl Pickled for PyScanner {
    fn apart<'py>(object: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        let Scanner { camera, projector, camera_from_projector, .. } = object.get().scanner;
        Ok(packed(object.py(), &(camera, projector, camera_from_projector)))
    }
    fn together(state: &Bound<'_, PyAny>) -> PyResult<Self> {
        let (camera, projector, pose) = unpacked(state)?;
        let scanner = Scanner::new(camera, projector, pose).map_err(|e| raise(state.py(), &e))?;
        Ok(Self { scanner })
    }
}

impl Pickled for PyKdTree {
    fn apart<'py>(object: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        Ok(packed(object.py(), &object.get().tree.points()))
    }
    fn together(state: &Bound<'_, PyAny>) -> PyResult<Self> {
        let points: Vec<[f64; 3]> = unpacked(state)?;
        Ok(Self { tree: compute(state.py(), || KdTree::new(&points))? })
    }
}

impl Pickled for PyFollower {
    fn apart<'py>(object: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        // What it remembers saves time, and changes no answer.
        Ok(object.get().tree.bind(object.py()).clone().into_any())
    }
    fn together(state: &Bound<'_, PyAny>) -> PyResult<Self> {
        Ok(Self { tree: state.cast::<PyKdTree>()?.clone().unbind(), follower: Default::default() })
    }
}

impl Pickled for PyMesh {
    fn apart<'py>(object: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        Ok(packed(object.py(), &object.get().given))
    }
    fn together(state: &Bound<'_, PyAny>) -> PyResult<Self> {
        let given: (Vec<[f64; 3]>, Vec<[u32; 3]>) = unpacked(state)?;
        Ok(Self { mesh: compute(state.py(), || Mesh::new(&given.0, &given.1))?, given })
    }
}

impl Pickled for PyShot {
    fn apart<'py>(object: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        let (py, o) = (object.py(), object.get());
        let SimulatedShot { samples, edges, photometry, projector, .. } = &o.shot;
        let seen = [packed(py, samples), packed(py, edges), packed(py, photometry), packed(py, projector)];
        let grid = [packed(py, &o.height), packed(py, &o.width), packed(py, &*o.rays)];
        let images = [object.getattr("white")?, object.getattr("frames")?];
        Ok(PyTuple::new(py, seen.into_iter().chain(grid).chain(images).collect::<Vec<_>>())?.into_any())
    }
    fn together(state: &Bound<'_, PyAny>) -> PyResult<Self> {
        let part = |i: usize| state.get_item(i);
        let shot = SimulatedShot {
            frames: Frames::Eight(Vec::new()),
            samples: unpacked(&part(0)?)?,
            edges: unpacked(&part(1)?)?,
            photometry: unpacked(&part(2)?)?,
            projector: unpacked(&part(3)?)?,
        };
        Ok(Self {
            shot,
            height: unpacked(&part(4)?)?,
            width: unpacked(&part(5)?)?,
            rays: Arc::new(unpacked(&part(6)?)?),
            white: part(7)?.extract()?,
            frames: part(8)?.extract()?,
        })
    }
}

impl Pickled for PyWeldSurface {
    fn apart<'py>(object: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        Ok(object.get().weld.bind(object.py()).clone())
    }
    fn together(state: &Bound<'_, PyAny>) -> PyResult<Self> {
        Self::new(state)
    }
}

macro_rules! classes {
    ($($class:ident),* $(,)?) => {
        fn apart<'py>(object: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
            $(if let Ok(object) = object.cast::<$class>() {
                return $class::apart(object);
            })*
            Err(raise_as(object.py(), "InputError", format!("{} is no class of the core", object.get_type())))
        }

        fn together(name: &str, state: &Bound<'_, PyAny>) -> PyResult<Py<PyAny>> {
            let py = state.py();
            $(if py.get_type::<$class>().name()? == name {
                return Ok(Py::new(py, $class::together(state)?)?.into_any());
            })*
            Err(raise_as(py, "InputError", format!("{name} is no class of the core")))
        }

        fn announce(m: &Bound<'_, PyModule>) -> PyResult<()> {
            let (registry, how) = (m.py().import("copyreg")?, m.getattr("_take_apart")?);
            $(registry.call_method1("pickle", (m.py().get_type::<$class>(), &how))?;)*
            Ok(())
        }
    };
}

classes! {
    PyLens, PyScanner, PyPhaseMap, PyDisagreement, PyWrappedPhase, PyPhaseError, PyCloud, PyReferencePlane, PyKdTree,
    PyFollower, PyPlane, PySphere, PyCylinder, PyMesh, PlaneFit, SphereFit, CylinderFit, PyFoundSphere, PyWeak,
    PyRegistration, PyRigidFit, PyCourse, PySeam, WeldShot, WeldStep, PyShot, PyWeldSurface,
}

/// What `_put_together` is called with.
type Apart<'py> = (Bound<'py, PyAny>, (String, &'static str, Bound<'py, PyAny>));

/// Takes an object of the core apart, as `pickle` and `copy` ask for it.
#[pyfunction]
fn _take_apart<'py>(object: &Bound<'py, PyAny>) -> PyResult<Apart<'py>> {
    let function = object.py().import("weldscan._weldcore")?.getattr("_put_together")?;
    Ok((function, (object.get_type().name()?.to_string(), VERSION, apart(object)?)))
}

/// Puts an object of the core together from its parts.
#[pyfunction]
fn _put_together(name: &str, version: &str, state: &Bound<'_, PyAny>) -> PyResult<Py<PyAny>> {
    if version != VERSION {
        let message = format!("{name}: pickled by weldscan {version}, which {VERSION} does not read; make it anew");
        return Err(raise_as(state.py(), "InputError", message));
    }
    together(name, state)
}

pub(crate) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(_take_apart, m)?)?;
    m.add_function(wrap_pyfunction!(_put_together, m)?)?;
    announce(m)
}
