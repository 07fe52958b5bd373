//! The cells of a cloud: tiles of a pixel grid, or voxels, each with a mean and a normal.

use std::collections::HashMap;
use std::hash::{BuildHasherDefault, Hasher};

use nalgebra::Matrix3;
use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::ground::robust::median;
use crate::ground::stop::{poll, polled};
use crate::ground::threads::{self, CHUNK};
use crate::ground::transform::Vec3;
use crate::surfaces::least_squares::principal;

/// A small patch of the cloud.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Voxel {
    pub(super) points: usize,
    pub(super) mean: Vec3,
    /// Mean of the points that the normal comes from: those of the cell or, in a bare cloud, also of its neighbours.
    pub(super) foot: Vec3,
    /// Unit normal; zero where there is none. On a grid its sign is that of the camera's side.
    pub(super) normal: Vec3,
    /// Mean column and row.
    pub(super) pixel: [f64; 2],
}

pub(super) enum Layout {
    Grid { width: usize, tile: usize, columns: usize },
    Bare { order: Vec<usize>, starts: Vec<usize> },
}

pub(super) struct CelledCloud<'a> {
    pub(super) points: &'a [[f64; 3]],
    pub(super) layout: Layout,
    pub(super) cells: Vec<Voxel>,
    /// Side of a cell, mm.
    pub(super) side: f64,
    /// Cells by the cube of side `reach` that holds their mean.
    pub(super) cubes: Table<Vec<u32>>,
    pub(super) reach: f64,
}

pub(super) fn finite(p: &[f64; 3]) -> bool {
    (p[0] + p[1] + p[2]).is_finite()
}

impl<'a> CelledCloud<'a> {
    fn new(points: &'a [[f64; 3]], layout: Layout, cells: Vec<Voxel>, side: f64, radius: f64) -> Self {
        // All that concerns a sphere lies within one and a half radii of its centre.
        let reach = 1.5 * radius;
        let mut cubes: Table<Vec<u32>> = Table::default();
        for (i, cell) in cells.iter().enumerate().filter(|(_, c)| c.points > 0) {
            cubes.entry(key(&cell.mean, reach)).or_default().push(i as u32);
        }
        Self { points, layout, cells, side, cubes, reach }
    }

    /// Cells around a place, and their numbers, in a fixed order.
    pub(super) fn around(&self, place: Vec3) -> impl Iterator<Item = (usize, &Voxel)> {
        let lists = neighbours(key(&place, self.reach)).filter_map(|k| self.cubes.get(&k));
        lists.flatten().filter_map(|&i| Some((i as usize, self.cells.get(i as usize)?)))
    }

    pub(super) fn of_grid(points: &'a [[f64; 3]], width: usize, radius: f64) -> Result<Self> {
        if width == 0 || !points.len().is_multiple_of(width) {
            let got = format!("{} points", points.len());
            return Err(Error::Shape { what: "points", expected: format!("rows of {width} pixels"), got });
        }
        let (tile, side) = tile_size(points, width, radius);
        let columns = width.div_ceil(tile);
        let rows: Vec<std::result::Result<Vec<Voxel>, usize>> = threads::install(|| {
            points
                .par_chunks(width * tile)
                .inspect(polled)
                .enumerate()
                .map(|(r, band)| band_cells(band, width, tile, r))
                .collect()
        });
        let mut cells = Vec::with_capacity(rows.len() * columns);
        for row in rows {
            cells.extend(row.map_err(|index| Error::NonFinite { what: "points", index })?);
        }
        Ok(Self::new(points, Layout::Grid { width, tile, columns }, cells, side, radius))
    }

    pub(super) fn of_bare(points: &'a [[f64; 3]], radius: f64) -> Self {
        // Normals need about this many points.
        const ENOUGH: f64 = 12.0;
        let mut size = radius / 8.0;
        loop {
            let voxels = Voxels::of(points, size);
            let merged: Vec<VoxelSums> = threads::install(|| {
                (0..voxels.keys.len()).into_par_iter().inspect(polled).map(|i| voxels.merged(i)).collect()
            });
            // As a typical point sees it: strays fill many voxels.
            let mut counts: Vec<(f64, f64)> = merged.iter().zip(&voxels.sums).map(|(m, s)| (m.n, s.n)).collect();
            counts.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
            let mut below = 0.0;
            let middle = counts.iter().find(|c| {
                below += c.1;
                2.0 * below >= points.len() as f64
            });
            let typical = middle.map_or(0.0, |c| c.0);
            if typical < ENOUGH && size < radius / 3.0 && !points.is_empty() {
                size *= 1.3;
                continue;
            }
            let cell = |i: usize| {
                let m = &merged[i];
                let (foot, normal) = m.plane();
                let own = &voxels.sums[i];
                let offset = Vec3::from_fn(|k, _| voxels.origin[k] + (voxels.keys[i][k] as f64 + 0.5) * size);
                Voxel {
                    points: own.n as usize,
                    mean: own.sum / own.n * size + offset,
                    foot: foot * size + offset,
                    normal,
                    pixel: [0.0; 2],
                }
            };
            let cells = threads::install(|| (0..merged.len()).into_par_iter().map(cell).collect());
            let layout = Layout::Bare { order: voxels.order, starts: voxels.starts };
            return Self::new(points, layout, cells, size, radius);
        }
    }

    /// Calls `job` with the index of every point of a cell.
    pub(super) fn members(&self, cell: usize, mut job: impl FnMut(usize)) {
        match &self.layout {
            Layout::Grid { width, tile, columns } => {
                let (row, column) = (cell / columns * tile, cell % columns * tile);
                for r in row..(row + tile).min(self.points.len() / width) {
                    for c in column..(column + tile).min(*width) {
                        job(r * width + c);
                    }
                }
            }
            Layout::Bare { order, starts } => {
                let end = starts.get(cell + 1).copied().unwrap_or(order.len());
                order.get(starts[cell]..end).unwrap_or_default().iter().for_each(|&i| job(i));
            }
        }
    }
}

/// Pixels along the side of a tile that is an eighth of the radius wide, and its width in mm, from the typical distance
/// of neighbours.
fn tile_size(points: &[[f64; 3]], width: usize, radius: f64) -> (usize, f64) {
    const APART: usize = 4;
    // A prime stride visits all columns; some thousand pairs tell the median well enough.
    let stride = (points.len() / 8192).max(1) | 1;
    let mut pitches: Vec<f64> = (0..points.len())
        .step_by(stride)
        .filter(|i| i % width + APART < width)
        .map(|i| (Vec3::from(points[i + APART]) - Vec3::from(points[i])).norm() / APART as f64)
        .filter(|d| d.is_finite() && *d > 0.0)
        .collect();
    if pitches.is_empty() {
        return (2, radius);
    }
    let pitch = median(&mut pitches);
    let tile = ((radius / 8.0 / pitch) as usize).clamp(2, 64);
    (tile, tile as f64 * pitch)
}

/// The cells of a band of `tile` rows; the index of an infinite coordinate if there is one.
fn band_cells(band: &[[f64; 3]], width: usize, tile: usize, number: usize) -> std::result::Result<Vec<Voxel>, usize> {
    let columns = width.div_ceil(tile);
    let mut cells = Vec::with_capacity(columns);
    for first in (0..width).step_by(tile) {
        let mut sums = [0.0; 15];
        let mut origin = None;
        for (row, line) in band.chunks(width).enumerate() {
            let Some(part) = line.get(first..(first + tile).min(width)) else { continue };
            for (column, p) in part.iter().enumerate() {
                if !finite(p) {
                    if p.iter().any(|v| v.is_infinite()) {
                        return Err((number * tile + row) * width + first + column);
                    }
                    continue;
                }
                let o = *origin.get_or_insert(*p);
                let (u, v) = (column as f64, row as f64);
                let (x, y, z) = (p[0] - o[0], p[1] - o[1], p[2] - o[2]);
                let terms = [1.0, u, v, u * u, u * v, v * v, x, y, z, x * u, y * u, z * u, x * v, y * v, z * v];
                sums.iter_mut().zip(terms).for_each(|(s, t)| *s += t);
            }
        }
        cells.push(tile_cell(&sums, origin, first, number * tile, tile));
    }
    Ok(cells)
}

/// Mean and normal of a tile: the points as a linear function of the pixel, whose slopes span the surface. The pixel is
/// exact and the depth noisy, so this is also right where the surface is steep.
fn tile_cell(sums: &[f64; 15], origin: Option<[f64; 3]>, column: usize, row: usize, tile: usize) -> Voxel {
    let Some(origin) = origin else { return Voxel::default() };
    let [n, u, v, uu, uv, vv, ..] = *sums;
    let (mu, mv) = (u / n, v / n);
    let mean = Vec3::new(sums[6], sums[7], sums[8]) / n;
    let mut cell = Voxel {
        points: n as usize,
        mean: mean + Vec3::from(origin),
        foot: mean + Vec3::from(origin),
        normal: Vec3::zeros(),
        pixel: [column as f64 + mu, row as f64 + mv],
    };
    let (suu, suv, svv) = (uu / n - mu * mu, uv / n - mu * mv, vv / n - mv * mv);
    let determinant = suu * svv - suv * suv;
    // Half a tile must be there, in both directions.
    if 2.0 * n >= (tile * tile) as f64 && determinant > 1e-3 {
        let pu = Vec3::new(sums[9], sums[10], sums[11]) / n - mean * mu;
        let pv = Vec3::new(sums[12], sums[13], sums[14]) / n - mean * mv;
        let along_u = (pu * svv - pv * suv) / determinant;
        let along_v = (pv * suu - pu * suv) / determinant;
        cell.normal = along_v.cross(&along_u).try_normalize(0.0).unwrap_or_default();
    }
    cell
}

pub(super) type Key = [i64; 3];

/// Spreads the bits of small integers; the default hasher guards against attacks that nobody makes on voxels.
#[derive(Default)]
pub(super) struct Spread(u64);

impl Hasher for Spread {
    fn finish(&self) -> u64 {
        self.0 ^ (self.0 >> 32)
    }

    fn write(&mut self, bytes: &[u8]) {
        for part in bytes.chunks(8) {
            let mut word = [0; 8];
            word.iter_mut().zip(part).for_each(|(w, b)| *w = *b);
            self.write_u64(u64::from_le_bytes(word));
        }
    }

    fn write_u64(&mut self, value: u64) {
        self.0 = (self.0.rotate_left(23) ^ value).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    }

    /// The length that precedes an array: always three.
    fn write_usize(&mut self, _: usize) {}
}

pub(super) type Table<V> = HashMap<Key, V, BuildHasherDefault<Spread>>;

/// A cube and the 26 around it.
pub(super) fn neighbours(k: Key) -> impl Iterator<Item = Key> {
    (0..27_i64).map(move |i| {
        let step = [i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1];
        std::array::from_fn(|a| k[a].saturating_add(step[a]))
    })
}

pub(super) fn key(p: &Vec3, size: f64) -> Key {
    std::array::from_fn(|k| (p[k] / size).floor() as i64)
}

/// Count, sums and second moments of the points of a voxel, about its centre, in units of its size.
#[derive(Debug, Clone, Copy, Default)]
struct VoxelSums {
    n: f64,
    sum: Vec3,
    second: Matrix3<f64>,
}

impl VoxelSums {
    fn add(&mut self, q: Vec3) {
        self.n += 1.0;
        self.sum += q;
        self.second += q * q.transpose();
    }

    fn add_shifted(&mut self, other: &Self, d: Vec3) {
        self.n += other.n;
        self.sum += other.sum + d * other.n;
        let cross = other.sum * d.transpose();
        self.second += other.second + cross + cross.transpose() + d * d.transpose() * other.n;
    }

    /// Mean and normal; no normal where the points do not look like a surface.
    fn plane(&self) -> (Vec3, Vec3) {
        let mean = self.sum / self.n;
        if self.n < 6.0 {
            return (mean, Vec3::zeros());
        }
        let (variances, axes) = principal(&(self.second / self.n - mean * mean.transpose()));
        // Thickness below half the width: a voxel neighbourhood across an edge or in a haze has no normal.
        let surface = variances[0] < 0.25 * variances[1];
        (mean, if surface { axes.column(0).into() } else { Vec3::zeros() })
    }
}

struct Voxels {
    origin: Vec3,
    keys: Vec<Key>,
    table: Table<usize>,
    sums: Vec<VoxelSums>,
    order: Vec<usize>,
    starts: Vec<usize>,
}

impl Voxels {
    fn of(points: &[[f64; 3]], size: f64) -> Self {
        let origin = Vec3::from_fn(|k, _| points.iter().map(|p| p[k]).fold(f64::INFINITY, f64::min));
        let mut table = Table::default();
        let (mut keys, mut sums): (Vec<Key>, Vec<VoxelSums>) = (Vec::new(), Vec::new());
        let mut of_point = Vec::with_capacity(points.len());
        for (i, p) in points.iter().enumerate() {
            if i.is_multiple_of(CHUNK) {
                poll();
            }
            let q = Vec3::from(*p) - origin;
            let k = key(&q, size);
            let id = *table.entry(k).or_insert_with(|| {
                keys.push(k);
                sums.push(VoxelSums::default());
                keys.len() - 1
            });
            sums[id].add(Vec3::from_fn(|i, _| q[i] / size - k[i] as f64 - 0.5));
            of_point.push(id);
        }
        let mut starts = Vec::with_capacity(keys.len());
        let mut at = 0;
        for s in &sums {
            starts.push(at);
            at += s.n as usize;
        }
        let (mut next, mut order) = (starts.clone(), vec![0; points.len()]);
        for (i, &id) in of_point.iter().enumerate() {
            order[next[id]] = i;
            next[id] += 1;
        }
        Self { origin, keys, table, sums, order, starts }
    }

    /// The sums of a voxel and its 26 neighbours.
    fn merged(&self, id: usize) -> VoxelSums {
        let k = self.keys[id];
        let mut all = VoxelSums::default();
        for neighbour in neighbours(k) {
            if let Some(&other) = self.table.get(&neighbour) {
                // Small whole numbers, unless saturated, where it does not matter.
                let step = Vec3::from_fn(|a, _| neighbour[a].saturating_sub(k[a]) as f64);
                all.add_shifted(&self.sums[other], step);
            }
        }
        all
    }
}
