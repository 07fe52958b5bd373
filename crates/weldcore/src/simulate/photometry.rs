//! From light to numbers: lamp, room, projector and sensor.

use crate::ground::random::{mix, normals};
use crate::ground::threads;

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

/// A sensor's number.
pub(super) trait SensorValue: Copy + Default + Send {
    const FULL: f32;
    fn of(value: f32) -> Self;
}

impl SensorValue for u8 {
    const FULL: f32 = 255.0;
    #[inline]
    fn of(value: f32) -> Self {
        (value + 0.5) as u8
    }
}

impl SensorValue for u16 {
    const FULL: f32 = 65535.0;
    #[inline]
    fn of(value: f32) -> Self {
        (value + 0.5) as u16
    }
}

impl Photometry {
    /// From light to numbers: black level, noise, clipping, quantisation. `start` is the place of the first pixel.
    pub(super) fn develop<L: SensorValue>(&self, frame: u64, start: usize, signal: &[f32], out: &mut [L]) {
        let black = self.black as f32;
        let (shot, read) = ((1.0 / self.full_well_e) as f32, (self.read_noise_e / self.full_well_e).powi(2) as f32);
        let key = mix(self.seed ^ mix(frame));
        let normals = normals();
        for (i, (out, s)) in out.iter_mut().zip(signal).enumerate() {
            let noise = (shot * s + read).sqrt() * normals.draw(mix(key ^ (start + i) as u64));
            *out = L::of(((black + s + noise) * L::FULL).clamp(0.0, L::FULL));
        }
    }

    pub(super) fn develop_all<L: SensorValue>(&self, frame: u64, signal: &[f32]) -> Vec<L> {
        let chunk = |start: usize, part: &[f32]| {
            let mut out = vec![L::default(); part.len()];
            self.develop(frame, start, part, &mut out);
            out
        };
        threads::map_chunks(signal, chunk).concat()
    }
}
