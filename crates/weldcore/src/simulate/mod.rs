//! Fringe images of analytic scenes by ray casting, and the truth that belongs to them.
//!
//! Each camera pixel's ray (lens undone) is cut with the bodies of the scene in closed form, except for what has none
//! (ovality, waviness, the bead: Newton and regula falsi to a hundredth of a nanometre). From the hit a second ray goes to the
//! projector: blocked, turned away or outside the projector's image, it is in shadow; else the projector's lens gives
//! the exact place (column, row) whose light falls there. All frames of a shot are shaded from this one pass.
//!
//! What a frame shows: the pattern `(0.5 + 0.5 cos(2π (periods (u + 0.5)/width - i/steps)))^gamma`, softened by the
//! projector's square pixels and its blur, on a Lambert surface with a Blinn-Phong lobe, falling off with the square of
//! the distance; plus room light; times the exposure; plus shot and read noise, clipped and quantised. Pixels on an
//! edge average four rays. There is no light from body to body.
//!
//! Random numbers are a hash of seed, frame and pixel: the same bits in any order and on any number of threads.

pub mod scene;
mod shapes;
mod weld;

use std::f64::consts::TAU;

use rayon::prelude::*;

use crate::Vec3;
use crate::error::{Error, Result, require_positive};
use crate::memory::require;
use crate::scanner::{Lens, Scanner};
use crate::stop::polled;
use crate::threads::{self, Lasting};
use crate::transform::Transform;

pub use shapes::{Body, Hit, Ray, Shape, Surface};
pub use weld::{Bead, Wall, Weld};

/// Rows that one task renders.
const BAND: usize = 8;
/// A shadow ray starts this far above the surface, mm, so that rounding does not let a surface shade itself.
const LIFT_MM: f64 = 1e-3;
/// Harmonics kept of a pattern with a gamma; the next is below 1e-5 of full scale for gammas of 0.5 to 4.
const HARMONICS: usize = 32;
/// More frames than that are a mistake, and would not fit into the memory.
const MOST_FRAMES: usize = 2048;
/// Neighbours whose depths differ by more than this share of the depth lie on different surfaces.
const EDGE: f64 = 0.004;

/// Which way the phase runs on the projector.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Axis {
    /// Along a row: the fringes stand upright.
    X,
    /// Along a column.
    Y,
}

/// One set of phase-shifted fringes, by the convention of [`crate::phase::FringeSet`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FringeSet {
    /// Direction of the phase.
    pub axis: Axis,
    /// Periods over the projector's width (or height).
    pub periods: f64,
    /// Frames, shifted by 2π/steps each.
    pub steps: usize,
    /// 1, or -1 where the fringes move the other way from step to step.
    pub direction: f64,
    /// The pattern's phase at the projector's border in the first step.
    pub origin_rad: f64,
}

/// Lamp, room, projector and sensor. Light is in parts of the sensor's full scale.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Photometry {
    /// What a white Lambert surface returns that is lit squarely from `distance_mm`, at exposure 1.
    pub lamp: f64,
    /// The distance that `lamp` refers to, mm.
    pub distance_mm: f64,
    /// What a white surface returns of the room's light, at exposure 1.
    pub ambient: f64,
    /// The sensor's black level.
    pub black: f64,
    /// The projector's response: light = pattern^gamma.
    pub gamma: f64,
    /// Standard deviation of the projector's blur, projector pixels.
    pub blur_px: f64,
    /// Electrons at full scale: shot noise has a variance of one per electron.
    pub full_well_e: f64,
    /// Read noise, electrons rms.
    pub read_noise_e: f64,
    /// 8 or 16 bits per pixel.
    pub bits: u32,
    /// Start of the random numbers; another shot takes another seed.
    pub seed: u64,
}

/// What one ray found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// Depth in the camera's frame, mm; NaN for the background.
    pub depth_mm: f64,
    /// The projector pixel whose light falls here; NaN in the dark.
    pub column_px: f64,
    /// Its row.
    pub row_px: f64,
    /// Height of the other wall over the reference wall at a lit point of the other wall, waviness left out, mm; NaN
    /// elsewhere.
    pub deviation_mm: f64,
    /// Its angle about the axis, rad (plates: place along the seam, mm), for walls in the light; NaN elsewhere.
    pub along: f64,
    /// Light from the projector at exposure 1 where the pattern is white.
    pub(crate) direct: f32,
    /// Light from the room at exposure 1.
    pub(crate) ambient: f32,
    /// Label of the body, 0 for the background.
    pub label: u8,
}

const NOTHING: Sample = Sample {
    depth_mm: f64::NAN,
    column_px: f64::NAN,
    row_px: f64::NAN,
    deviation_mm: f64::NAN,
    along: f64::NAN,
    direct: 0.0,
    ambient: 0.0,
    label: 0,
};

/// Frames of a shot: exposure by exposure white, then the sets in order, each with its steps.
#[derive(Debug, Clone, PartialEq)]
pub enum Frames {
    /// 8 bits.
    Eight(Vec<Vec<u8>>),
    /// 16 bits.
    Sixteen(Vec<Vec<u16>>),
}

/// A shot: its frames, row-major, and what each pixel's centre saw.
#[derive(Debug, Clone)]
pub struct Shot {
    /// The images.
    pub frames: Frames,
    /// The truth, per pixel.
    pub samples: Vec<Sample>,
    /// The rays of pixels on edges.
    pub(crate) edges: Vec<(usize, [Sample; 4])>,
    pub(crate) photometry: Photometry,
    pub(crate) projector: Lens,
}

impl Shot {
    /// What the camera sees while the projector shows any picture, 8 bits, row-major. `number` tells the noise of one
    /// frame from that of another.
    ///
    /// # Errors
    /// [`Error::Shape`] for a picture that is not of the projector's size, [`Error::OutOfRange`] for the exposure.
    pub fn capture(&self, picture: &[u8], exposure: f64, number: u32) -> Result<Frames> {
        require_positive("exposure", exposure)?;
        let (width, height) = (self.projector.width, self.projector.height);
        if picture.len() != width * height {
            let (expected, got) = (format!("{height} x {width} pixels"), format!("{} pixels", picture.len()));
            return Err(Error::Shape { what: "picture", expected, got });
        }
        require(self.samples.len() + picture.len(), 24);
        let light = Light::of(picture, width, height, &self.photometry);
        let value = |s: &Sample| s.direct * light.at(s.column_px, s.row_px) + s.ambient;
        let mut signal: Vec<f32> =
            threads::map_chunks(&self.samples, |_, chunk| chunk.iter().map(value).collect::<Vec<_>>()).concat();
        for (index, rays) in &self.edges {
            if let Some(out) = signal.get_mut(*index) {
                *out = 0.25 * rays.iter().map(value).sum::<f32>();
            }
        }
        signal.iter_mut().for_each(|s| *s *= exposure as f32);
        // The frames of `simulate` count from 0.
        let stream = (1 << 32) | u64::from(number);
        Ok(if self.photometry.bits == 8 {
            Frames::Eight(vec![self.photometry.develop_all(stream, &signal)])
        } else {
            Frames::Sixteen(vec![self.photometry.develop_all(stream, &signal)])
        })
    }
}

/// The light that a picture throws, per projector pixel, blurred; between pixel centres it is interpolated.
struct Light {
    width: usize,
    height: usize,
    light: Vec<f32>,
}

impl Light {
    fn of(picture: &[u8], width: usize, height: usize, photometry: &Photometry) -> Self {
        let response: Vec<f32> = (0..=255u8).map(|g| (f64::from(g) / 255.0).powf(photometry.gamma) as f32).collect();
        let shown: Vec<f32> = picture.iter().filter_map(|&g| response.get(usize::from(g)).copied()).collect();
        let across = blur(&shown, width, photometry.blur_px);
        let turned = transpose(&across, width);
        let light = transpose(&blur(&turned, height, photometry.blur_px), height);
        Self { width, height, light }
    }

    #[inline]
    fn at(&self, column: f64, row: f64) -> f32 {
        if column.is_nan() {
            return 0.0;
        }
        let (u, v) = (column.clamp(0.0, self.width as f64 - 1.0), row.clamp(0.0, self.height as f64 - 1.0));
        let (i, j) = (u as usize, v as usize);
        let (a, b) = ((u - i as f64) as f32, (v - j as f64) as f32);
        let (right, below) = ((i + 1).min(self.width - 1), (j + 1).min(self.height - 1));
        let pixel = |i: usize, j: usize| self.light.get(j * self.width + i).copied().unwrap_or(0.0);
        let (top, bottom) =
            (pixel(i, j) * (1.0 - a) + pixel(right, j) * a, pixel(i, below) * (1.0 - a) + pixel(right, below) * a);
        top * (1.0 - b) + bottom * b
    }
}

/// Each row under a Gaussian; the border repeats its last pixel.
fn blur(image: &[f32], width: usize, sigma_px: f64) -> Vec<f32> {
    let reach = (4.0 * sigma_px).ceil() as usize;
    if reach == 0 {
        return image.to_vec();
    }
    let weights: Vec<f64> =
        (0..=2 * reach).map(|i| (-0.5 * ((i as f64 - reach as f64) / sigma_px).powi(2)).exp()).collect();
    let sum: f64 = weights.iter().sum();
    let weights: Vec<f32> = weights.iter().map(|w| (w / sum) as f32).collect();
    let row = |row: &[f32]| -> Vec<f32> {
        let at = |i: usize| row.get(i.saturating_sub(reach).min(row.len() - 1)).copied().unwrap_or(0.0);
        (0..row.len()).map(|u| weights.iter().enumerate().map(|(k, w)| w * at(u + k)).sum()).collect()
    };
    threads::install(|| image.par_chunks(width).inspect(polled).flat_map_iter(row).collect())
}

fn transpose(image: &[f32], width: usize) -> Vec<f32> {
    (0..width).flat_map(|u| image.iter().skip(u).step_by(width).copied()).collect()
}

/// Renders one shot of `bodies` from where the scanner stands.
///
/// # Errors
/// [`Error::OutOfRange`] or [`Error::NonFinite`] naming the parameter; [`Error::TooFew`] without exposures. Without fringes
/// there are only white images.
pub fn simulate(
    scanner: &Scanner,
    scene_from_scanner: &Transform,
    bodies: &[Body],
    fringes: &[FringeSet],
    exposures: &[f64],
    photometry: &Photometry,
) -> Result<Shot> {
    check(bodies, fringes, exposures, photometry)?;
    let view = View::new(scanner, scene_from_scanner, bodies, photometry);
    let rays = scanner.camera_rays();
    let (width, height) = (scanner.camera.width, scanner.camera.height);
    let frames = exposures.len() * (1 + fringes.iter().map(|f| f.steps).sum::<usize>());
    require(width * height, 3 * size_of::<Sample>() + frames * if photometry.bits == 8 { 1 } else { 2 });
    let row = |v: usize| {
        let pixels = v * width..(v + 1) * width;
        let directions = rays.x.get(pixels.clone()).into_iter().flatten().zip(rays.y.get(pixels).into_iter().flatten());
        directions.map(|(&x, &y)| view.sample(x, y)).collect::<Vec<_>>()
    };
    let samples: Vec<Sample> = threads::install(|| {
        (0..height).into_par_iter().with_min_len(BAND).inspect(polled).flat_map_iter(row).collect()
    });
    let edges = antialias(scanner, &view, &samples);
    let shader = Shader { scanner, fringes, exposures, photometry, samples: &samples, edges: &edges };
    let frames = if photometry.bits == 8 { Frames::Eight(shader.render()) } else { Frames::Sixteen(shader.render()) };
    Ok(Shot { frames, samples, edges, photometry: *photometry, projector: scanner.projector })
}

fn check(bodies: &[Body], fringes: &[FringeSet], exposures: &[f64], photometry: &Photometry) -> Result<()> {
    bodies.iter().try_for_each(Body::check)?;
    crate::error::require_count("exposures", 1, exposures.len())?;
    for set in fringes {
        require_positive("fringe periods", set.periods)?;
        if !(1..=1024).contains(&set.steps) {
            let value = set.steps.to_string();
            return Err(Error::OutOfRange { what: "fringe steps", expected: "1 to 1024".into(), value });
        }
        if set.direction.abs() != 1.0 || !set.origin_rad.is_finite() {
            let value = format!("{}, {}", set.direction, set.origin_rad);
            let expected = "1 or -1, and finite".into();
            return Err(Error::OutOfRange { what: "fringe direction and origin_rad", expected, value });
        }
    }
    exposures.iter().try_for_each(|&e| require_positive("exposures", e))?;
    let frames = exposures.len() * (1 + fringes.iter().map(|f| f.steps).sum::<usize>());
    if frames > MOST_FRAMES {
        let expected = format!("at most {MOST_FRAMES}");
        return Err(Error::OutOfRange { what: "frames of a shot", expected, value: frames.to_string() });
    }
    let p = photometry;
    require_positive("distance_mm", p.distance_mm)?;
    require_positive("full_well_e", p.full_well_e)?;
    for (what, v, most) in [
        ("lamp", p.lamp, 1e6),
        ("ambient", p.ambient, 1e6),
        ("black", p.black, 1.0),
        ("blur_px", p.blur_px, 1e3),
        ("read_noise_e", p.read_noise_e, 1e9),
    ] {
        if !(0.0..=most).contains(&v) {
            return Err(Error::OutOfRange { what, expected: format!("0 to {most}"), value: v.to_string() });
        }
    }
    if !(0.2..=5.0).contains(&p.gamma) {
        return Err(Error::OutOfRange { what: "gamma", expected: "0.2 to 5".into(), value: p.gamma.to_string() });
    }
    if p.bits != 8 && p.bits != 16 {
        return Err(Error::OutOfRange { what: "bits", expected: "8 or 16".into(), value: p.bits.to_string() });
    }
    Ok(())
}

/// The scene as one shot sees it.
struct View<'a> {
    scanner: &'a Scanner,
    projector_from_camera: Transform,
    photometry: &'a Photometry,
    bodies: Vec<Placed<'a>>,
}

struct Placed<'a> {
    body: &'a Body,
    body_from_camera: Transform,
    /// The body's origin in the camera's frame.
    centre: Vec3,
    bound_squared: f64,
}

impl Placed<'_> {
    /// Whether a ray (camera's frame) comes near enough to be worth the closed form.
    #[inline]
    fn near(&self, ray: &Ray) -> bool {
        let to = self.centre - ray.origin;
        let along = to.dot(&ray.direction);
        to.norm_squared() - along * along / ray.direction.norm_squared() <= self.bound_squared
    }
}

impl<'a> View<'a> {
    fn new(
        scanner: &'a Scanner,
        scene_from_camera: &Transform,
        bodies: &'a [Body],
        photometry: &'a Photometry,
    ) -> Self {
        let place = |body: &'a Body| {
            let body_from_camera = body.scene_from_body.inverse() * *scene_from_camera;
            let bound = body.bound_mm() + 1e-6;
            let centre = body_from_camera.inverse().translation;
            Placed { body, body_from_camera, centre, bound_squared: bound * bound }
        };
        Self {
            scanner,
            projector_from_camera: scanner.camera_from_projector.inverse(),
            photometry,
            bodies: bodies.iter().map(place).collect(),
        }
    }

    fn first_hit(&self, ray: &Ray) -> Option<(&Placed<'a>, Hit)> {
        let mut best: Option<(&Placed<'a>, Hit)> = None;
        for placed in self.bodies.iter().filter(|b| b.near(ray)) {
            if let Some(hit) = placed.body.hit(&ray.seen_from(&placed.body_from_camera), 0.0)
                && best.as_ref().is_none_or(|(_, found)| hit.t < found.t)
            {
                best = Some((placed, hit));
            }
        }
        best
    }

    fn shadowed(&self, from: Vec3, to: Vec3) -> bool {
        let ray = Ray { origin: from, direction: to - from };
        self.bodies
            .iter()
            .filter(|b| b.near(&ray))
            .any(|placed| placed.body.hit(&ray.seen_from(&placed.body_from_camera), 0.0).is_some_and(|hit| hit.t < 1.0))
    }

    /// What the ray along (x, y, 1) finds.
    fn sample(&self, x: f64, y: f64) -> Sample {
        let ray = Ray { origin: Vec3::zeros(), direction: Vec3::new(x, y, 1.0) };
        // A pixel beyond the lens's fold has no direction.
        let Some((placed, hit)) = (x.is_finite() && y.is_finite()).then(|| self.first_hit(&ray)).flatten() else {
            return NOTHING;
        };
        let body = placed.body;
        let p = ray.at(hit.t);
        let in_body = placed.body_from_camera.apply(&p);
        let normal = placed.body_from_camera.rotation.transpose() * hit.normal;
        let albedo = body.albedo(&in_body);
        let mut sample = Sample {
            depth_mm: p.z,
            ambient: (self.photometry.ambient * albedo) as f32,
            label: body.label.saturating_add(hit.part),
            ..NOTHING
        };
        let lamp = self.scanner.camera_from_projector.translation;
        let to_lamp = lamp - p;
        let facing = normal.dot(&to_lamp) / to_lamp.norm();
        if facing <= 0.0 {
            return sample;
        }
        let projector = &self.scanner.projector;
        let Some((column, row)) = projector.project(&self.projector_from_camera.apply(&p)) else { return sample };
        if !projector.contains(column, row) || self.shadowed(p + normal * LIFT_MM, lamp) {
            return sample;
        }
        (sample.column_px, sample.row_px) = (column, row);
        let halfway = (to_lamp.normalize() - p.normalize()).normalize();
        let gloss = body.surface.specular * normal.dot(&halfway).max(0.0).powf(body.surface.shininess);
        let falloff = self.photometry.distance_mm.powi(2) / to_lamp.norm_squared();
        sample.direct = (self.photometry.lamp * falloff * (albedo * facing + gloss)) as f32;
        if let Shape::Weld(weld) = &body.shape
            && hit.part < 2
        {
            sample.along = weld.along(&in_body);
            if hit.part == 1 {
                sample.deviation_mm = weld.step_at(&in_body);
            }
        }
        sample
    }
}

/// The four rays of each pixel on an edge, in the order of the pixels.
fn antialias(scanner: &Scanner, view: &View<'_>, samples: &[Sample]) -> Vec<(usize, [Sample; 4])> {
    let camera = &scanner.camera;
    let differ = |a: &Sample, b: &Sample| {
        let lit = a.column_px.is_nan() != b.column_px.is_nan();
        lit || a.label != b.label || (a.depth_mm - b.depth_mm).abs() > EDGE * a.depth_mm
    };
    let row = |v: usize| {
        let at = |u: usize, v: usize| samples.get(v * camera.width + u);
        let is_edge = move |u: &usize| {
            let Some(here) = at(*u, v) else { return false };
            let beside = [(u.wrapping_sub(1), v), (u + 1, v), (*u, v.wrapping_sub(1)), (*u, v + 1)];
            let inside = beside.into_iter().filter(|&(u, v)| u < camera.width && v < camera.height);
            inside.filter_map(|(u, v)| at(u, v)).any(|there| differ(here, there))
        };
        (0..camera.width).filter(is_edge).map(move |u| {
            let rays = [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)];
            let cast =
                |(du, dv)| camera.undistort(u as f64 + du, v as f64 + dv).map_or(NOTHING, |(x, y)| view.sample(x, y));
            (v * camera.width + u, rays.map(cast))
        })
    };
    threads::install(|| {
        (0..camera.height).into_par_iter().with_min_len(BAND).inspect(polled).flat_map_iter(row).collect()
    })
}

/// A sensor's number.
trait Level: Copy + Default + Send {
    const FULL: f32;
    fn of(value: f32) -> Self;
}

impl Level for u8 {
    const FULL: f32 = 255.0;
    #[inline]
    fn of(value: f32) -> Self {
        (value + 0.5) as u8
    }
}

impl Level for u16 {
    const FULL: f32 = 65535.0;
    #[inline]
    fn of(value: f32) -> Self {
        (value + 0.5) as u16
    }
}

struct Shader<'a> {
    scanner: &'a Scanner,
    fringes: &'a [FringeSet],
    exposures: &'a [f64],
    photometry: &'a Photometry,
    samples: &'a [Sample],
    edges: &'a [(usize, [Sample; 4])],
}

impl Shader<'_> {
    fn render<L: Level>(&self) -> Vec<Vec<L>> {
        let steps: usize = self.fringes.iter().map(|f| f.steps).sum();
        let size = self.samples.len();
        let mut frames = vec![vec![L::default(); size]; (1 + steps) * self.exposures.len()];
        let band = BAND * self.scanner.camera.width;
        // Each task owns the same band of all frames.
        let mut bands: Vec<Vec<&mut [L]>> =
            (0..size.div_ceil(band)).map(|_| Vec::with_capacity(frames.len())).collect();
        for frame in &mut frames {
            for (slot, part) in bands.iter_mut().zip(frame.chunks_mut(band)) {
                slot.push(part);
            }
        }
        let light: Vec<Vec<f32>> = self.fringes.iter().map(|f| self.light(f)).collect();
        threads::install(|| {
            bands
                .into_par_iter()
                .inspect(polled)
                .enumerate()
                .for_each(|(i, parts)| self.render_band(i * band, parts, &light));
        });
        frames
    }

    /// Fourier cosines of the light that a set throws: the pattern through the response, the pixel and the blur.
    ///
    /// cos²ˠ(ψ/2) has the coefficients a_p/a_(p-1) = (γ - p + 1)/(γ + p) and sums to 1 at ψ = 0.
    fn light(&self, set: &FringeSet) -> Vec<f32> {
        let Photometry { gamma, blur_px, .. } = *self.photometry;
        let ratio = |p: usize| (gamma - p as f64 + 1.0) / (gamma + p as f64);
        let series = |count: usize| {
            (1..=count).scan(1.0, move |a, p| {
                *a *= ratio(p);
                Some(*a)
            })
        };
        let sum = 1.0 + 2.0 * series(100_000).sum::<f64>();
        let side = match set.axis {
            Axis::X => self.scanner.projector.width,
            Axis::Y => self.scanner.projector.height,
        };
        let soften = |p: usize| {
            let cycles = p as f64 * set.periods / side as f64;
            let pixel = if cycles == 0.0 { 1.0 } else { (0.5 * TAU * cycles).sin() / (0.5 * TAU * cycles) };
            pixel * (-0.5 * (TAU * cycles * blur_px).powi(2)).exp()
        };
        let count = if gamma == 1.0 { 1 } else { HARMONICS };
        let harmonics = series(count).enumerate().map(|(i, a)| 2.0 * a * soften(i + 1) / sum);
        std::iter::once(1.0 / sum).chain(harmonics).map(|a| a as f32).collect()
    }

    /// Cosine and sine of the phase of a set where a sample is lit.
    #[inline]
    fn phase(&self, set: &FringeSet, sample: &Sample) -> (f32, f32) {
        let (place, side) = match set.axis {
            Axis::X => (sample.column_px, self.scanner.projector.width),
            Axis::Y => (sample.row_px, self.scanner.projector.height),
        };
        if place.is_nan() {
            return (1.0, 0.0);
        }
        let (sin, cos) = (TAU * (set.periods * (place + 0.5) / side as f64).fract() + set.origin_rad).sin_cos();
        (cos as f32, sin as f32)
    }

    fn render_band<L: Level>(&self, start: usize, mut parts: Vec<&mut [L]>, light: &[Vec<f32>]) {
        let Some(samples) = self.samples.get(start..(start + BAND * self.scanner.camera.width).min(self.samples.len()))
        else {
            return;
        };
        let first = self.edges.partition_point(|(i, _)| *i < start);
        let last = self.edges.partition_point(|(i, _)| *i < start + samples.len());
        let edges = self.edges.get(first..last).unwrap_or(&[]);
        let mut signal = vec![0.0f32; samples.len()];
        let steps: usize = self.fringes.iter().map(|f| f.steps).sum();
        let mut exposed = vec![0.0f32; samples.len()];
        let mut expose = |frame: usize, signal: &[f32]| {
            for (e, &exposure) in self.exposures.iter().enumerate() {
                let number = e * (1 + steps) + frame;
                exposed.iter_mut().zip(signal).for_each(|(out, s)| *out = exposure as f32 * s);
                if let Some(out) = parts.get_mut(number) {
                    self.photometry.develop(number as u64, start, &exposed, out);
                }
            }
        };
        // A pixel on an edge shows the mean of its rays.
        let soften = |signal: &mut [f32], value: &dyn Fn(&Sample) -> f32| {
            for (index, rays) in edges {
                if let Some(out) = signal.get_mut(index - start) {
                    *out = 0.25 * rays.iter().map(value).sum::<f32>();
                }
            }
        };

        let white = |s: &Sample| s.direct + s.ambient;
        signal.iter_mut().zip(samples).for_each(|(out, s)| *out = white(s));
        soften(&mut signal, &white);
        expose(0, &signal);
        let mut frame = 1;
        for (set, light) in self.fringes.iter().zip(light) {
            let phases: Vec<(f32, f32)> = samples.iter().map(|s| self.phase(set, s)).collect();
            for i in 0..set.steps {
                let (sin, cos) = (set.direction * TAU * i as f64 / set.steps as f64).sin_cos();
                let (sin, cos) = (sin as f32, cos as f32);
                let value =
                    |s: &Sample, (c, q): (f32, f32)| s.direct * cosine_series(light, c * cos + q * sin) + s.ambient;
                for ((out, s), phase) in signal.iter_mut().zip(samples).zip(&phases) {
                    *out = value(s, *phase);
                }
                soften(&mut signal, &|s| value(s, self.phase(set, s)));
                expose(frame, &signal);
                frame += 1;
            }
        }
    }
}

impl Photometry {
    /// From light to numbers: black level, noise, clipping, quantisation. `start` is the place of the first pixel.
    fn develop<L: Level>(&self, frame: u64, start: usize, signal: &[f32], out: &mut [L]) {
        let black = self.black as f32;
        let (shot, read) = ((1.0 / self.full_well_e) as f32, (self.read_noise_e / self.full_well_e).powi(2) as f32);
        let key = mix(self.seed ^ mix(frame));
        let normals = normals();
        for (i, (out, s)) in out.iter_mut().zip(signal).enumerate() {
            let noise = (shot * s + read).sqrt() * normals.draw(mix(key ^ (start + i) as u64));
            *out = L::of(((black + s + noise) * L::FULL).clamp(0.0, L::FULL));
        }
    }

    fn develop_all<L: Level>(&self, frame: u64, signal: &[f32]) -> Vec<L> {
        let chunk = |start: usize, part: &[f32]| {
            let mut out = vec![L::default(); part.len()];
            self.develop(frame, start, part, &mut out);
            out
        };
        threads::map_chunks(signal, chunk).concat()
    }
}

/// `a0 + a1 cos ψ + a2 cos 2ψ + ...` from x = cos ψ (Clenshaw).
#[inline]
fn cosine_series(a: &[f32], x: f32) -> f32 {
    if let [a0, a1] = a {
        return a0 + a1 * x;
    }
    let Some((a0, rest)) = a.split_first() else { return 0.0 };
    let (mut b1, mut b2) = (0.0, 0.0);
    for c in rest.iter().rev() {
        (b1, b2) = (c + 2.0 * x * b1 - b2, b1);
    }
    a0 + x * b1 - b2
}

/// A hash of 64 bits in which every bit of the input matters (the finaliser of SplitMix64, Steele et al. 2014).
#[inline]
pub(crate) fn mix(counter: u64) -> u64 {
    let mut z = counter.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// The normal distribution in 65536 equally likely values: its quantiles, scaled to unit variance.
struct Normals(Vec<f32>);

impl Normals {
    const HALF: usize = 1 << 15;

    fn tabulate() -> Self {
        // dx/dp = 1/density(x) from p = 1/2 up, by Runge-Kutta with four steps from value to value.
        let slope = |x: f64| (0.5 * x * x).exp() * TAU.sqrt();
        let (mut x, h) = (0.0f64, 1.0 / (8.0 * Self::HALF as f64));
        let mut half = Vec::with_capacity(Self::HALF);
        for step in 0..4 * Self::HALF - 1 {
            if step % 4 == 2 {
                half.push(x);
            }
            let a = slope(x);
            let b = slope(x + 0.5 * h * a);
            let c = slope(x + 0.5 * h * b);
            let d = slope(x + h * c);
            x += h * (a + 2.0 * b + 2.0 * c + d) / 6.0;
        }
        let rms = (half.iter().map(|x| x * x).sum::<f64>() / half.len() as f64).sqrt();
        Self(half.iter().map(|x| -x / rms).chain(half.iter().map(|x| x / rms)).map(|x| x as f32).collect())
    }

    #[inline]
    fn draw(&self, random: u64) -> f32 {
        self.0.get((random >> 48) as usize).copied().unwrap_or(0.0)
    }
}

fn normals() -> &'static Normals {
    static TABLE: Lasting<Normals> = Lasting::new();
    TABLE.get(Normals::tabulate)
}

#[cfg(test)]
mod tests;
