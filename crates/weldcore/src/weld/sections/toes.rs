//! Where a cap ends: the place that two free parabolas, one on its flank and one on what lies beside it, meet at best.
//!
//! Everything here looks at a right-hand toe: the inside lies at smaller x.

use super::profile::Profile;

/// The flank is looked at from where the cap has come down to this part of its height: crowns are flat or ridged.
const FLANK_FROM: f64 = 0.65;
/// And at least so many bins of it.
const FLANK_BINS: usize = 6;
/// How far beyond the detected toe the surface beside it is looked at, and the same in widths.
const BEYOND_MM: f64 = 5.0;
const BEYOND_WIDTHS: f64 = 0.25;
/// Bins further than this from both parabolas are spatter or holes' edges (MADs; once).
const CLIP_MADS: f64 = 3.0;
/// Toes whose sum of squares is this much larger (in units of the residual's variance) are as plausible.
const PLAUSIBLE: f64 = 10.0;
/// The range of plausible toes reaches to so many standard deviations, as chi-square has it for one place.
pub(super) const PLAUSIBLE_SIGMAS: f64 = 3.0;

/// Undercuts are no wider than this; they are seen from this depth on, beside a wall that is straight over so much.
const UNDERCUT_MM: f64 = 2.5;
const UNDERCUT_SEEN_MM: f64 = 0.03;
const UNDERCUT_WALL_MM: f64 = 6.0;
/// And comes back to itself between the undercut and where it is looked at.
const QUIET_MM: f64 = 1.0;

/// A toe with the range in which it may as well be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Toe {
    pub at: f64,
    pub from: f64,
    pub to: f64,
    /// Depth of an undercut inside it, drawn on to its inner side: it may as well be a bevel of the wall.
    pub undercut_mm: f64,
}

/// The toe of a cap whose candidate ends at the bin boundary `end` and begins at `begin`; `band` narrows the search.
pub(super) fn toe(profile: &Profile, begin: usize, end: usize, sigma: f64, band: Option<[f64; 2]>) -> Option<Toe> {
    let width = profile.edge(end) - profile.edge(begin);
    let from = flank(profile, begin, end)?;
    let to = profile.boundary(profile.edge(end) + (BEYOND_WIDTHS * width).max(BEYOND_MM));
    if to < from + 8 {
        return None;
    }
    let (best, _) = search(profile, from, to, sigma, band)?;
    let kept = {
        let (inside, beside) = (profile.parabola(from, best)?, profile.parabola(best, to)?);
        let off = |i: usize| {
            let model = if i < best { inside.at(profile.x(i)) } else { beside.at(profile.x(i)) };
            (profile.heights[i] - model).abs()
        };
        // Each by its own: a flank is less of a parabola than a wall, and must not go for it.
        let [flank, wall] = [from..best, best..to].map(|bins| {
            let mut sizes: Vec<f64> = bins.map(off).filter(|d| d.is_finite()).collect();
            CLIP_MADS * (crate::ground::robust::MEDIAN_TO_SIGMA * crate::ground::robust::median(&mut sizes)).max(sigma)
        });
        profile.keeping(|i| i < from || i >= to || off(i) <= if i < best { flank } else { wall })
    };
    let (best, range) = search(&kept, from, to, sigma, band)?;
    let mut at = kept.edge(best);
    // The parabolas' own crossing, where it is next to the boundary of two bins.
    if let (Some(inside), Some(beside)) = (kept.parabola(from, best), kept.parabola(best, to)) {
        let gap = |x: f64| inside.at(x) - beside.at(x);
        let (low, high) = (at - 1.5 * kept.bin, at + 1.5 * kept.bin);
        if gap(low) * gap(high) < 0.0 {
            let (mut low, mut high) = (low, high);
            for _ in 0..40 {
                let middle = 0.5 * (low + high);
                if gap(low) * gap(middle) <= 0.0 {
                    high = middle;
                } else {
                    low = middle;
                }
            }
            at = 0.5 * (low + high);
        }
    }
    let found = Toe { at, from: range[0].min(at), to: range[1].max(at), undercut_mm: 0.0 };
    Some(beyond_undercut(profile, found, sigma).unwrap_or(found))
}

/// A toe whose parabolas met at the inner side of an undercut, put to its outer side: where the surface comes back to the wall.
fn beyond_undercut(profile: &Profile, toe: Toe, sigma: f64) -> Option<Toe> {
    let beyond = profile.boundary(toe.at + UNDERCUT_MM + QUIET_MM);
    let wall = profile.line(beyond, (beyond + profile.in_bins(UNDERCUT_WALL_MM)).min(profile.len()))?;
    let (inside, quiet) = (profile.boundary(toe.at - UNDERCUT_MM), profile.in_bins(QUIET_MM));
    let seen = UNDERCUT_SEEN_MM.max(3.0 * sigma);
    let below = |i: usize| wall.at(profile.x(i)) - profile.heights[i];
    // Two beside each other, so that no single bin is one.
    let last = (inside..beyond).rev().find(|&i| below(i) > seen && i > 0 && below(i - 1) > seen)? + 1;
    let depths = (inside..last).map(|i| (below(i), i)).filter(|d| d.0.is_finite());
    let (deepest, bottom) = depths.max_by(|a, b| a.0.total_cmp(&b.0))?;
    // A wall that bends down towards the weld comes back to nothing.
    let comes_back = last + quiet <= beyond && deepest > 2.0 * seen;
    let at = profile.edge(last);
    // A bin tells the mean of its width: a bevel goes on beyond the middle of the lowest one.
    let undercut_mm = deepest * (1.0 + profile.bin / (at - profile.x(bottom)));
    (comes_back && at > toe.at).then(|| Toe { at, from: toe.from, to: toe.to.max(at + profile.bin), undercut_mm })
}

/// The bin from which the flank is looked at.
fn flank(profile: &Profile, begin: usize, end: usize) -> Option<usize> {
    let beside = profile.in_bins(4.0);
    let left = profile.line(begin.saturating_sub(beside), begin)?;
    let right = profile.line(end, (end + beside).min(profile.len()))?;
    let (xa, xb) = (profile.edge(begin), profile.edge(end));
    let (ha, hb) = (left.at(xa), right.at(xb));
    let over = |i: usize| (profile.heights[i] - ha - (hb - ha) * (profile.x(i) - xa) / (xb - xa)).abs();
    // The running median of three keeps a single drop from being the crown.
    let smooth = |i: usize| {
        let mut three: Vec<f64> =
            (i.saturating_sub(1)..(i + 2).min(profile.len())).map(over).filter(|h| h.is_finite()).collect();
        if three.is_empty() { f64::NAN } else { crate::ground::robust::median(&mut three) }
    };
    let heights: Vec<f64> = (begin..end).map(smooth).collect();
    let top = heights.iter().copied().filter(|h| h.is_finite()).fold(0.0, f64::max);
    let last = heights.iter().rposition(|&h| h >= FLANK_FROM * top)? + begin;
    Some(last.min(end.saturating_sub(FLANK_BINS)).max(begin))
}

/// The boundary with the least sum of squares, and the range of those that are as plausible.
fn search(profile: &Profile, from: usize, to: usize, sigma: f64, band: Option<[f64; 2]>) -> Option<(usize, [f64; 2])> {
    let (low, high) = band.map_or((from + 3, to - 4), |[low, high]| {
        (profile.boundary(low).max(from + 3), profile.boundary(high).min(to - 4))
    });
    let costs: Vec<(usize, f64)> = (low..=high)
        .filter_map(|at| Some((at, profile.parabola(from, at)?.sse + profile.parabola(at, to)?.sse)))
        .collect();
    let &(best, least) = costs.iter().min_by(|a, b| a.1.total_cmp(&b.1))?;
    let count = profile.count(from, to);
    let variance = (least / (count - 6.0).max(1.0)).max(sigma * sigma);
    let plausible = costs.iter().filter(|c| c.1 <= least + PLAUSIBLE * variance).map(|c| profile.edge(c.0));
    let range = plausible.fold([f64::INFINITY, f64::NEG_INFINITY], |r, x| [r[0].min(x), r[1].max(x)]);
    Some((best, range))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_steep_flank_beside_a_quiet_wall_keeps_its_toe() {
        // A crown of a power 2.4 that comes down within five bins: no parabola, beside a wall that scatters by micrometres.
        let height = |x: f64| {
            let s = ((x - 0.8) / if x < 0.8 { 4.0 } else { 2.2 }).abs();
            if s < 1.0 { 1.05 * (1.0 - s.powf(2.4)) } else { 0.0 }
        };
        let scatter = |i: usize| 0.003 * (((i * 7919) % 13) as f64 / 6.0 - 1.0);
        let heights = (0..160).map(|i| height(-19.875 + 0.25 * i as f64) + scatter(i)).collect();
        let profile = Profile::new(-20.0, 0.25, heights);
        let found = toe(&profile, profile.boundary(-3.2), profile.boundary(3.6), 0.003, None).unwrap();
        assert!((found.at - 3.0).abs() < 0.3 && found.to < 3.6, "{found:?}");
    }

    #[test]
    fn an_undercut_belongs_to_the_weld_and_a_dent_to_the_wall() {
        let cap = |x: f64, end: f64| 1.2 * (1.0 - (x / end).powi(2)).max(0.0);
        let profile = |height: &dyn Fn(f64) -> f64| {
            let scatter = |i: usize| 0.003 * (((i * 7919) % 13) as f64 / 6.0 - 1.0);
            Profile::new(-20.0, 0.25, (0..160).map(|i| height(-19.875 + 0.25 * i as f64) + scatter(i)).collect())
        };
        let of = |profile: &Profile| toe(profile, profile.boundary(-3.0), profile.boundary(3.4), 0.003, None).unwrap();
        for wide in [0.8, 1.4, 2.0] {
            // The groove lies within the toe at 4.
            let inner = 4.0 - wide;
            let undercut = |x: f64| {
                let within = (x - inner) / wide;
                let groove =
                    if (0.0..1.0).contains(&within) { (std::f64::consts::PI * within).sin().powi(2) } else { 0.0 };
                cap(x, inner) - 0.3 * groove
            };
            let found = of(&profile(&undercut));
            assert!((found.at - 4.0).abs() < 0.45, "{wide}: {found:?}");
        }
        // A wall that bends down towards the weld, over a few millimetres.
        for decay in [2.0, 6.0, 15.0] {
            let dented =
                |x: f64| if x < 3.0 { cap(x, 3.0) - 0.8 * (x + 20.0) / 23.0 } else { -0.8 * ((3.0 - x) / decay).exp() };
            let found = of(&profile(&dented));
            assert!((found.at - 3.0).abs() < 0.45, "{decay}: {found:?}");
        }
    }
}
