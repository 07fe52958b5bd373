//! Where the normals of a cloud meet.

use super::cells::{Table, Voxel, key, neighbours};
use crate::ground::transform::Vec3;

/// Centres that the cells vote for, in voxels as wide as the radius of the ball in which they must meet.
pub(super) struct Votes {
    size: f64,
    places: Vec<Vec3>,
    table: Table<Vec<u32>>,
}

impl Votes {
    pub(super) fn of(cells: &[Voxel], radius: f64, ball: f64) -> Self {
        let mut votes = Self { size: ball, places: Vec::new(), table: Table::default() };
        for cell in cells {
            if cell.points > 0 && cell.normal != Vec3::zeros() {
                for side in [-1.0, 1.0] {
                    let place = cell.foot + cell.normal * (side * radius);
                    let k = key(&place, votes.size);
                    votes.table.entry(k).or_default().push(votes.places.len() as u32);
                    votes.places.push(place);
                }
            }
        }
        votes
    }

    /// Voxels where at least three votes meet, most first.
    pub(super) fn peaks(&self) -> Vec<Vec3> {
        let mut peaks: Vec<(usize, u32)> =
            self.table.values().filter(|v| v.len() >= 3).map(|v| (v.len(), v[0])).collect();
        peaks.sort_unstable_by_key(|&(n, first)| (std::cmp::Reverse(n), first));
        peaks.iter().map(|&(_, first)| self.places[first as usize]).collect()
    }

    /// The mean of the votes around a place, followed uphill, and their number.
    pub(super) fn settle(&self, place: Vec3) -> (Vec3, usize) {
        let (mut center, mut support) = (place, 0);
        for _ in 0..3 {
            let k = key(&center, self.size);
            let (mut sum, mut n) = (Vec3::zeros(), 0);
            for &i in neighbours(k).filter_map(|k| self.table.get(&k)).flatten() {
                let p = self.places[i as usize];
                if (p - center).norm() < self.size {
                    sum += p;
                    n += 1;
                }
            }
            if n > 0 {
                center = sum / n as f64;
            }
            support = n;
        }
        (center, support)
    }
}
