//! The frames of a shot, shaded from one pass of rays.

use std::f64::consts::TAU;

use rayon::prelude::*;

use super::photometry::{Photometry, SensorValue};
use super::shapes::Body;
use super::shot::{Frames, Sample, SimulatedShot};
use super::view::{BAND, ShotView, antialias};
use crate::error::{Error, Result, require_count, require_positive};
use crate::fringes::FringeSet;
use crate::ground::memory::require;
use crate::ground::stop::polled;
use crate::ground::threads;
use crate::ground::transform::Transform;
use crate::scanner::{Axis, Scanner};

/// Harmonics kept of a pattern with a gamma; the next is below 1e-5 of full scale for gammas of 0.5 to 4.
const HARMONICS: usize = 32;
/// More frames than that are a mistake, and would not fit into the memory.
const MOST_FRAMES: usize = 2048;

/// One set of fringes, and which way its phase runs on the projector.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fringes {
    /// Direction of the phase.
    pub axis: Axis,
    /// The set.
    pub set: FringeSet,
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
    fringes: &[Fringes],
    exposures: &[f64],
    photometry: &Photometry,
) -> Result<SimulatedShot> {
    check(bodies, fringes, exposures, photometry)?;
    let view = ShotView::new(scanner, scene_from_scanner, bodies, photometry);
    let rays = scanner.camera_rays();
    let (width, height) = (scanner.camera.width, scanner.camera.height);
    let frames = exposures.len() * (1 + fringes.iter().map(|f| f.set.steps).sum::<usize>());
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
    Ok(SimulatedShot { frames, samples, edges, photometry: *photometry, projector: scanner.projector })
}

fn check(bodies: &[Body], fringes: &[Fringes], exposures: &[f64], photometry: &Photometry) -> Result<()> {
    bodies.iter().try_for_each(Body::check)?;
    require_count("exposures", 1, exposures.len())?;
    for Fringes { set, .. } in fringes {
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
    let frames = exposures.len() * (1 + fringes.iter().map(|f| f.set.steps).sum::<usize>());
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

struct Shader<'a> {
    scanner: &'a Scanner,
    fringes: &'a [Fringes],
    exposures: &'a [f64],
    photometry: &'a Photometry,
    samples: &'a [Sample],
    edges: &'a [(usize, [Sample; 4])],
}

impl Shader<'_> {
    fn render<L: SensorValue>(&self) -> Vec<Vec<L>> {
        let steps: usize = self.fringes.iter().map(|f| f.set.steps).sum();
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
    fn light(&self, Fringes { axis, set }: &Fringes) -> Vec<f32> {
        let Photometry { gamma, blur_px, .. } = *self.photometry;
        let ratio = |p: usize| (gamma - p as f64 + 1.0) / (gamma + p as f64);
        let series = |count: usize| {
            (1..=count).scan(1.0, move |a, p| {
                *a *= ratio(p);
                Some(*a)
            })
        };
        let sum = 1.0 + 2.0 * series(100_000).sum::<f64>();
        let side = match axis {
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
    fn phase(&self, Fringes { axis, set }: &Fringes, sample: &Sample) -> (f32, f32) {
        let (place, side) = match axis {
            Axis::X => (sample.column_px, self.scanner.projector.width),
            Axis::Y => (sample.row_px, self.scanner.projector.height),
        };
        if place.is_nan() {
            return (1.0, 0.0);
        }
        let (sin, cos) = (TAU * (set.periods * (place + 0.5) / side as f64).fract() + set.origin_rad).sin_cos();
        (cos as f32, sin as f32)
    }

    fn render_band<L: SensorValue>(&self, start: usize, mut parts: Vec<&mut [L]>, light: &[Vec<f32>]) {
        let Some(samples) = self.samples.get(start..(start + BAND * self.scanner.camera.width).min(self.samples.len()))
        else {
            return;
        };
        let first = self.edges.partition_point(|(i, _)| *i < start);
        let last = self.edges.partition_point(|(i, _)| *i < start + samples.len());
        let edges = self.edges.get(first..last).unwrap_or(&[]);
        let mut signal = vec![0.0f32; samples.len()];
        let steps: usize = self.fringes.iter().map(|f| f.set.steps).sum();
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
        for (fringes, light) in self.fringes.iter().zip(light) {
            let phases: Vec<(f32, f32)> = samples.iter().map(|s| self.phase(fringes, s)).collect();
            let set = &fringes.set;
            for i in 0..set.steps {
                let (sin, cos) = (set.direction * TAU * i as f64 / set.steps as f64).sin_cos();
                let (sin, cos) = (sin as f32, cos as f32);
                let value =
                    |s: &Sample, (c, q): (f32, f32)| s.direct * cosine_series(light, c * cos + q * sin) + s.ambient;
                for ((out, s), phase) in signal.iter_mut().zip(samples).zip(&phases) {
                    *out = value(s, *phase);
                }
                soften(&mut signal, &|s| value(s, self.phase(fringes, s)));
                expose(frame, &signal);
                frame += 1;
            }
        }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cosine_series_is_its_sum() {
        let a: Vec<f32> = (0..9).map(|i| 1.0 / (1.0 + i as f32)).collect();
        for i in 0..50 {
            let angle = 0.13 * i as f32;
            let sum: f32 = a.iter().enumerate().map(|(p, a)| a * (p as f32 * angle).cos()).sum();
            // f32 rounding, grown by the recurrence.
            assert!((cosine_series(&a, angle.cos()) - sum).abs() < 2e-5);
            let two = a[0] + a[1] * angle.cos();
            assert!((cosine_series(&a[..2], angle.cos()) - two).abs() < 1e-6);
        }
    }

    #[test]
    fn the_light_of_a_pattern_is_its_blurred_power() {
        let scanner = crate::scanner::lens::tests::example();
        let samples = [];
        for (gamma, blur_px, periods) in [(1.0, 0.6, 64.0), (1.35, 0.5, 100.0), (2.2, 0.0, 8.0), (0.7, 1.0, 200.0)] {
            let photometry = Photometry {
                lamp: 1.0,
                distance_mm: 420.0,
                ambient: 0.0,
                black: 0.0,
                gamma,
                blur_px,
                full_well_e: 1e4,
                read_noise_e: 10.0,
                bits: 8,
                seed: 0,
            };
            let set = Fringes { axis: Axis::X, set: FringeSet::new(periods, 4) };
            let shader = Shader {
                scanner: &scanner,
                fringes: &[set],
                exposures: &[1.0],
                photometry: &photometry,
                samples: &samples,
                edges: &[],
            };
            let light = shader.light(&set);
            let pattern = |u: f64| (0.5 + 0.5 * (TAU * periods * u / 912.0).cos()).powf(gamma);
            for i in 0..40 {
                let u = 0.37 * f64::from(i);
                // The mean over one pixel and a Gaussian cut at six sigma, by midpoints.
                let (mut sum, mut weight) = (0.0, 0.0);
                for a in 0..60 {
                    let du = (f64::from(a) + 0.5) / 60.0 - 0.5;
                    for b in -60..=60 {
                        let sigmas = f64::from(b) / 10.0;
                        let w = (-0.5 * sigmas * sigmas).exp();
                        sum += w * pattern(u + du + sigmas * blur_px);
                        weight += w;
                    }
                }
                let x = (TAU * periods * u / 912.0).cos() as f32;
                let miss = f64::from(cosine_series(&light, x)) - sum / weight;
                // Harmonics beyond the last one kept, and f32.
                assert!(miss.abs() < 1e-4, "gamma {gamma}: {miss}");
            }
        }
    }
}
