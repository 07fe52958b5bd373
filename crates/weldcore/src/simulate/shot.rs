//! A simulated shot: its frames, what each pixel's centre saw, and what the camera sees of any other picture.

use rayon::prelude::*;

use super::photometry::Photometry;
use crate::error::{Error, Result, require_positive};
use crate::ground::memory::require;
use crate::ground::stop::polled;
use crate::ground::threads;
use crate::scanner::Lens;

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

pub(super) const NOTHING: Sample = Sample {
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
pub struct SimulatedShot {
    /// The images.
    pub frames: Frames,
    /// The truth, per pixel.
    pub samples: Vec<Sample>,
    /// The rays of pixels on edges.
    pub(crate) edges: Vec<(usize, [Sample; 4])>,
    pub(crate) photometry: Photometry,
    pub(crate) projector: Lens,
}

impl SimulatedShot {
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
