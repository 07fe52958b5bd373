//! The undisturbed part of a wall: grown inward from the edge of the view as long as it is a straight wall that a weld has
//! drawn in. Right-hand walls: the toe lies at smaller x.
//!
//! A girth weld shrinks and draws both pipes in. A thin shell under a ring load bends as `exp(-βz)(cos βz + sin βz)` with
//! `β = 1.285/√(R t)` (Timoshenko, Theory of Plates and Shells, §114, ν = 0.3), so that this term belongs to an undisturbed
//! wall, with an amplitude of some tenths of a millimetre. What a wall departs from it is judged by what drawn pipes wave,
//! never by the scanner's noise: a better scanner must not measure less.

use nalgebra::{Matrix3, Vector3};

use super::profile::Profile;

/// What drawn walls wave, 2.5 times 0.05 mm: a wall that departs further is another surface.
pub(crate) const TOLERANCE_MM: f64 = 0.12;
/// Amplitude of weld shrinkage, one sigma: half a millimetre is much.
const SHRINKAGE_MM: f64 = 0.25;
/// The first stretch of a wall, and as a part of its side.
const FIRST_MM: f64 = 15.0;
const FIRST_PART: f64 = 0.25;
/// It grows by so much, and the mean over so much tells whether it may.
const GROWTH_MM: f64 = 2.0;
const BLOCK_MM: f64 = 3.0;
/// Unevenness counts as one value per this length: drawn and rolled walls wave over centimetres.
const WAVE_MM: f64 = 15.0;

/// Timoshenko's shell term at a distance from the ring that draws it in; `shell_mm` is `√(R t)`. Without a ring there is none.
pub(crate) fn shell_term(distance_mm: f64, shell_mm: Option<f64>) -> f64 {
    let Some(shell_mm) = shell_mm else { return 0.0 };
    let x = 1.285 * distance_mm.abs() / shell_mm;
    (-x).exp() * (x.cos() + x.sin())
}

/// [`shell_term`] of many places: straight between values so near that it is off by a millionth.
pub(crate) struct ShellTable {
    values: Vec<f64>,
    /// Entries per mm.
    density: f64,
}

impl ShellTable {
    const ENTRIES: usize = 4096;
    /// In `√(R t)`: what is left beyond is less than a thousandth.
    const REACH: f64 = 6.0;

    pub fn new(shell_mm: Option<f64>) -> Self {
        let Some(shell_mm) = shell_mm else { return Self { values: vec![0.0; 2], density: 0.0 } };
        let per_length = Self::ENTRIES as f64 / Self::REACH;
        let mut values: Vec<f64> = (0..Self::ENTRIES).map(|k| shell_term(k as f64 / per_length, Some(1.0))).collect();
        values.extend([0.0; 2]);
        Self { values, density: per_length / shell_mm }
    }

    #[inline]
    pub fn at(&self, distance_mm: f64) -> f64 {
        let last = self.values.len() - 2;
        let place = (distance_mm.abs() * self.density).min(last as f64);
        // A shorter way than as usize, which asks for the largest numbers.
        let k = (place as i32 as usize).min(last);
        let [a, b] = [self.values[k], self.values[k + 1]];
        a + (place - k as f64) * (b - a)
    }
}

/// An undisturbed wall of one station.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct WallRun {
    /// From where it is undisturbed, and to where it was looked at.
    pub from: f64,
    pub to: f64,
    /// Of its straight line: height at the centreline, and slope.
    pub height: f64,
    pub slope: f64,
    /// Amplitude of the shrinkage at the centreline.
    pub shrinkage: f64,
    pub rms: f64,
    /// Standard uncertainty of the slope.
    pub slope_u: f64,
    pub(crate) centre: f64,
}

impl WallRun {
    /// The straight wall without its shrinkage.
    pub fn straight(&self, x: f64) -> f64 {
        self.height + self.slope * (x - self.centre)
    }
}

/// What a wall may depart from its line, for cells of this noise.
pub(super) fn tolerance(sigma: f64) -> f64 {
    // A block of 3 mm is of five bins and more.
    TOLERANCE_MM.max(4.0 * sigma / 5f64.sqrt())
}

/// Grows the wall to the right of `toe` from the edge of the view; `None` where no stretch of it is one.
pub(super) fn grow(profile: &Profile, toe: f64, centre: f64, shell: &ShellTable, sigma: f64) -> Option<WallRun> {
    let side = Side::of(profile, toe, centre, shell);
    let end = profile.edge(side.bins.last()?.index + 1);
    let tolerance = tolerance(sigma);
    let first = FIRST_MM.max(FIRST_PART * (end - toe)).min(end - toe);
    let mut to = end;
    let mut run = loop {
        let from = (to - first).max(toe);
        let run = side.fit(from, to, sigma)?;
        if side.blocks(from, to, &run).all(|mean| mean.abs() <= tolerance) {
            break run;
        }
        to -= GROWTH_MM;
        if to - first < toe - 0.5 * GROWTH_MM {
            return None;
        }
    };
    while run.from > toe {
        let from = (run.from - GROWTH_MM).max(toe);
        let Some(longer) = side.fit(from, to, sigma) else { break };
        if side.blocks(from, from + BLOCK_MM, &longer).any(|mean| mean.abs() > tolerance) {
            break;
        }
        run = longer;
    }
    Some(run)
}

/// A bin of a side that holds points.
#[derive(Debug, Clone, Copy)]
struct SideBin {
    index: usize,
    /// From the centreline.
    z: f64,
    height: f64,
    shell: f64,
}

/// Sums of 1, z, z², shell, z·shell, shell², h, zh, shell·h, h².
const SUMS: usize = 10;

/// All that lies to the right of a toe, with running sums: a fit of any stretch costs nothing.
struct Side<'a> {
    profile: &'a Profile,
    bins: Vec<SideBin>,
    sums: Vec<[f64; SUMS]>,
    /// z is counted from here in the sums, so that they do not cancel.
    middle: f64,
    centre: f64,
}

impl<'a> Side<'a> {
    fn of(profile: &'a Profile, toe: f64, centre: f64, shell: &ShellTable) -> Self {
        let one = |index: usize| {
            let z = profile.x(index) - centre;
            SideBin { index, z, height: profile.heights[index], shell: shell.at(z) }
        };
        let bins: Vec<SideBin> =
            (profile.boundary(toe)..profile.len()).map(one).filter(|b| b.height.is_finite()).collect();
        let middle = bins.first().zip(bins.last()).map_or(0.0, |(a, b)| 0.5 * (a.z + b.z));
        let mut sums = Vec::with_capacity(bins.len() + 1);
        let mut so_far = [0.0; SUMS];
        sums.push(so_far);
        for b in &bins {
            let (z, s, h) = (b.z - middle, b.shell, b.height);
            for (sum, v) in so_far.iter_mut().zip([1.0, z, z * z, s, z * s, s * s, h, z * h, s * h, h * h]) {
                *sum += v;
            }
            sums.push(so_far);
        }
        Self { profile, bins, sums, middle, centre }
    }

    /// The bins of [from, to).
    fn between(&self, from: f64, to: f64) -> std::ops::Range<usize> {
        let at = |x: f64| {
            let boundary = self.profile.boundary(x);
            self.bins.partition_point(|b| b.index < boundary)
        };
        at(from)..at(to).max(at(from))
    }

    /// Mean residuals of the blocks of [from, to).
    fn blocks(&self, from: f64, to: f64, run: &WallRun) -> impl Iterator<Item = f64> {
        let wide = self.profile.in_bins(BLOCK_MM);
        let first = self.profile.boundary(from);
        let run = *run;
        self.bins[self.between(from, to)]
            .chunk_by(move |a, b| (a.index - first) / wide == (b.index - first) / wide)
            .map(move |block| {
                let off = |b: &SideBin| b.height - run.height - run.slope * b.z - run.shrinkage * b.shell;
                block.iter().map(off).sum::<f64>() / block.len() as f64
            })
    }

    fn fit(&self, from: f64, to: f64, sigma: f64) -> Option<WallRun> {
        let bins = self.between(from, to);
        if bins.len() < 4 {
            return None;
        }
        let sum: [f64; SUMS] = std::array::from_fn(|k| self.sums[bins.end][k] - self.sums[bins.start][k]);
        let [n, z, zz, s, zs, ss, h, zh, sh, square] = sum;
        let normal = Matrix3::new(n, z, s, z, zz, zs, s, zs, ss);
        let right = Vector3::new(h, zh, sh);
        let solve = |variance: f64| {
            let mut a = normal;
            a[(2, 2)] += variance / (SHRINKAGE_MM * SHRINKAGE_MM);
            let inverse = a.cholesky()?.inverse();
            let c = inverse * right;
            let sse = (square - 2.0 * c.dot(&right) + c.dot(&(normal * c))).max(0.0);
            Some((c, inverse, (sse / bins.len() as f64).sqrt()))
        };
        // Waves count as one value per their length.
        let effective = |rms: f64| rms.max(sigma).max(1e-6).powi(2) * (WAVE_MM / self.profile.bin).max(1.0);
        let (_, _, rms) = solve(effective(sigma))?;
        let variance = effective(rms);
        let (c, inverse, rms) = solve(variance)?;
        Some(WallRun {
            from,
            to,
            height: c[0] - c[1] * self.middle,
            slope: c[1],
            shrinkage: c[2],
            rms,
            slope_u: (variance * inverse[(1, 1)]).sqrt(),
            centre: self.centre,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_is_the_term() {
        for shell_mm in [3.0, 12.0, 60.0, 1e200] {
            let table = ShellTable::new(Some(shell_mm));
            let off = |part: f64| {
                let z = part * shell_mm;
                (table.at(z) - shell_term(z, Some(shell_mm))).abs()
            };
            let parts = || (-900..900).map(|k| 0.0123 * f64::from(k));
            assert!(parts().filter(|p| p.abs() < 5.9).map(off).fold(0.0, f64::max) < 2e-6, "{shell_mm}");
            assert!(parts().map(off).fold(0.0, f64::max) < 1e-3, "{shell_mm}");
        }
        assert_eq!(ShellTable::new(None).at(0.0), 0.0);
    }

    #[test]
    fn a_wall_with_its_shrinkage_is_one_wall() {
        // Drawn in by 0.3 mm beside the weld, leaning, a hole in it.
        let shell = ShellTable::new(Some(20.0));
        let height = |x: f64| 0.4 + 0.002 * x - 0.3 * shell_term(x, Some(20.0));
        let scatter = |i: usize| 0.002 * (((i * 7919) % 13) as f64 / 6.0 - 1.0);
        let at = |i: usize| 0.125 + 0.25 * i as f64;
        let heights =
            (0..360).map(|i| if (100..130).contains(&i) { f64::NAN } else { height(at(i)) + scatter(i) }).collect();
        let run = grow(&Profile::new(0.0, 0.25, heights), 5.0, 0.0, &shell, 0.002).unwrap();
        assert!((run.from - 5.0).abs() < 0.26 && (run.slope - 0.002).abs() < 2e-5 && run.rms < 0.002, "{run:?}");
        assert!((run.shrinkage + 0.3).abs() < 0.02 && (run.straight(0.0) - 0.4).abs() < 0.002, "{run:?}");
    }
}
