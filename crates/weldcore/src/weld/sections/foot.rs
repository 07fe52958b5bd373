//! Where a cap's flank flattens outward: its own foot, or the wall's end that flares, which has no kink at its toe.
//!
//! Everything here looks at a right-hand toe: the inside lies at smaller x.

use super::profile::Profile;
use super::walls::WallRun;

/// The flank's slope is that of windows of a millimetre.
const FLANK_WINDOW_MM: f64 = 1.0;
/// The last strip is rounded by the toe itself and by the size of a pixel.
const ROUNDED_MM: f64 = 0.35;
/// A cap is steepest at its toe, but for its ripples. Where the last millimetre has less than this part of the steepest
/// slope, it may be something else than the cap.
const FOOT_SLOPE: f64 = 0.5;
/// A flank that hides behind its cap shows no foot: at least this part of it must be seen.
const FLANK_PART: f64 = 0.7;
/// The steepest place is where the slope is this part of the steepest.
const STEEP_PART: f64 = 0.9;
/// No toe is rounded like this, mm: weld toes have radii of tenths of a millimetre, dressed ones of 3 to 6.
const TOE_RADIUS_MM: f64 = 8.0;
/// And a cap that blends into its walls comes down from its crown over more than it runs out in.
const TAIL_PART: f64 = 0.8;
/// What runs out hangs below its chord: by this part of its height in the middle, where an exponential has 0.2 to 0.35.
const SAG_PART: f64 = 0.1;

/// The outermost place where a flank is as steep as anywhere.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct FlankFoot {
    pub at: f64,
    /// Of the surface there.
    pub height: f64,
    /// How steeply the flank falls.
    pub slope: f64,
}

/// The foot of a flank that flattens before its `toe`; `far` is the other toe, `sign` −1 for hollow caps.
pub(super) fn foot(profile: &Profile, toe: f64, far: f64, sign: f64, sigma: f64) -> Option<FlankFoot> {
    let (from, to) = (profile.boundary(0.5 * (toe + far)), profile.boundary(toe - ROUNDED_MM));
    let window = profile.in_bins(FLANK_WINDOW_MM).max(3);
    if to < from + 2 * window {
        return None;
    }
    let steep: Vec<(f64, f64, f64)> = (from..=to - window)
        .filter_map(|i| {
            let line = profile.line(i, i + window)?;
            Some((0.5 * (profile.edge(i) + profile.edge(i + window)), -sign * line.slope, sigma / line.sxx.sqrt()))
        })
        .collect();
    let &(_, last, se) = steep.last()?;
    let most = steep.iter().map(|s| s.1).fold(0.0, f64::max);
    let &(x, _, _) = steep.iter().rev().find(|s| s.1 >= STEEP_PART * most)?;
    if last >= FOOT_SLOPE * most - 2.0 * se || toe - ROUNDED_MM - x <= FLANK_WINDOW_MM {
        return None;
    }
    let at = profile.boundary(x);
    if profile.count(at, to) < FLANK_PART * (to - at) as f64 {
        return None;
    }
    let (_, height) = profile.mean(at.saturating_sub(1), (at + 1).min(profile.len()))?;
    Some(FlankFoot { at: x, height, slope: most })
}

/// Where the wall ends, if what runs out beyond a foot is its flare and no toe of a cap.
pub(super) fn flare(profile: &Profile, foot: FlankFoot, crown: f64, wall: &WallRun) -> Option<f64> {
    let (begin, end) = (profile.boundary(foot.at), profile.boundary(wall.from));
    let tail = wall.from - foot.at;
    let height = foot.height - wall.straight(foot.at);
    let rounded = 2.0 * height / (foot.slope * foot.slope);
    if end < begin + 6 || tail < TAIL_PART * (foot.at - crown) || rounded < TOE_RADIUS_MM {
        return None;
    }
    let (_, last) = profile.mean(end.saturating_sub(2), (end + 2).min(profile.len()))?;
    let chord = |x: f64| foot.height + (last - foot.height) * (x - foot.at) / tail;
    let third = (end - begin) / 3;
    let sags = [begin, begin + third, begin + 2 * third].map(|at| {
        let (x, h) = profile.mean(at, at + third)?;
        Some(chord(x) - h)
    });
    let [Some(first), Some(middle), Some(third)] = sags else { return None };
    (first > 0.0 && third > 0.0 && middle > SAG_PART * height).then_some(foot.at + 0.25 * FLANK_WINDOW_MM)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::weld::sections::walls;

    /// A cap 10 mm wide and 1.8 mm high with its toe at 5 beside a wall that is bent up by this, dying out over 4 mm; its flank
    /// with a power of its own.
    fn profile(bent: f64, blend: f64) -> Profile {
        let height = |x: f64| match x {
            x if x < -5.0 => 0.0,
            x if x < 5.0 => bent * (x + 5.0) / 10.0 + 1.8 * (1.0 - (x / 5.0).powi(2)).powf(blend),
            _ => bent * ((5.0 - x) / 4.0).exp(),
        };
        Profile::new(-30.0, 0.3, (0..300).map(|i| height(-29.85 + 0.3 * f64::from(i))).collect())
    }

    fn end(profile: &Profile, toe: f64) -> Option<f64> {
        let found = foot(profile, toe, -5.0, 1.0, 0.005)?;
        let wall = walls::grow(profile, toe, 0.0, &walls::ShellTable::new(Some(60.0)), 0.005).unwrap();
        flare(profile, found, 0.0, &wall)
    }

    #[test]
    fn an_end_that_flares_begins_where_the_flank_is_steepest() {
        // Its toe is found in the tail: there is no kink at the true one.
        for toe in [8.0, 9.0, 10.0] {
            let found = end(&profile(1.6, 1.0), toe).unwrap();
            assert!((found - 5.0).abs() < 0.7, "{toe}: {found}");
        }
    }

    #[test]
    fn a_cap_that_blends_into_its_wall_keeps_its_toe() {
        for blend in [1.0, 1.5, 2.0] {
            assert_eq!(end(&profile(0.0, blend), 5.0), None, "{blend}");
        }
    }
}
