//! The cap of a weld in a profile across the seam: raised, one-humped, between two surfaces that are smooth beside it.
//!
//! A cap is looked for as such, for what is merely "not wall" may be anything. In every place and for 26 widths the inside is
//! held against the two lines beside it. A cap rises over the chord between them, on both of its halves, and turns the
//! profile at both of its toes the same way. A taper, a counterbore, a flare or the edge of a coat turns it at one place, or
//! once up and once down, and is none. Of overlapping candidates the one with the largest `height · √width` is the cap: that
//! product grows with the width up to the toes and falls beyond them, whatever the cap's form.

use super::profile::{Line, Profile};

/// Widths that are tried, from the narrowest cap on.
const WIDTHS: usize = 26;
const NARROWEST_MM: f64 = 2.5;
/// The lines beside a candidate are half its width long, within these bounds.
const BESIDE_MM: [f64; 2] = [4.0, 12.0];
/// The turn of a profile at a toe, rad: that of a toe angle of 176 degrees. Walls turn by less than 0.02.
pub(super) const KINK_RAD: f64 = 0.07;
/// A cap lower than this is flush: nobody can see it beside the walls' own waves of 0.05 mm.
const LEAST_HEIGHT_MM: f64 = 0.08;
/// A jump between two walls turns the profile at one side alone.
const KINKS_ALIKE: f64 = 0.1;
/// Each half of a cap is at least this part of its mean height.
const HALVES_ALIKE: f64 = 0.3;
/// What lies beside a cap is a wall: its line fits to this part of the cap's height.
const SMOOTH_BESIDE: f64 = 0.3;
/// So many candidates are kept per station.
const KEPT: usize = 6;

/// The widest cap that a weld of this wall can have, mm. 8 + 1.75 t is within 1.3 mm of the widest cap, with its tolerance, in the
/// tables of GOST 16037, GOST 5264 and PNAE G-7-009 for walls of 3 to 60 mm; a quarter more is for repairs and preparations
/// that are not listed.
pub fn widest_cap_mm(thickness_mm: f64) -> f64 {
    1.25 * (8.0 + 1.75 * thickness_mm)
}

/// A place where a profile looks like a cap.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Candidate {
    /// Its ends, as bin boundaries.
    pub from: usize,
    pub to: usize,
    /// The same in mm.
    pub toes: [f64; 2],
    /// Mean height over the chord.
    pub height: f64,
    pub score: f64,
}

impl Candidate {
    pub fn middle(&self) -> f64 {
        0.5 * (self.toes[0] + self.toes[1])
    }

    pub fn width(&self) -> f64 {
        self.toes[1] - self.toes[0]
    }
}

/// The best candidates of a profile, best first, none over another; `sign` −1 looks for hollows instead.
pub(super) fn candidates(profile: &Profile, widest_mm: f64, sigma: f64, sign: f64) -> Vec<Candidate> {
    let view = profile.bin * profile.len() as f64;
    let widest = widest_mm.min(view - 2.0 * BESIDE_MM[0]);
    let mut found: Vec<Candidate> = Vec::new();
    if widest <= NARROWEST_MM {
        return found;
    }
    let ratio = (widest / NARROWEST_MM).powf(1.0 / (WIDTHS - 1) as f64);
    for k in 0..WIDTHS {
        let wide = profile.in_bins(NARROWEST_MM * ratio.powi(k as i32)).max(4);
        let beside = profile.in_bins((0.5 * profile.bin * wide as f64).clamp(BESIDE_MM[0], BESIDE_MM[1]));
        // Toes are placed later: a twelfth of the width is near enough to recognise a cap.
        let stride = (wide / 12).max(1);
        let last = profile.len().saturating_sub(wide + beside);
        let mut at = beside;
        while at <= last {
            if let Some(one) = candidate(profile, at, at + wide, beside, sigma, sign) {
                found.push(one);
            }
            at += stride;
        }
    }
    found.sort_by(|a, b| b.score.total_cmp(&a.score).then(a.from.cmp(&b.from)));
    let mut kept: Vec<Candidate> = Vec::new();
    for one in found {
        if kept.iter().all(|k| one.toes[1] <= k.toes[0] || one.toes[0] >= k.toes[1]) {
            kept.push(one);
            if kept.len() == KEPT {
                break;
            }
        }
    }
    kept
}

fn candidate(profile: &Profile, from: usize, to: usize, beside: usize, sigma: f64, sign: f64) -> Option<Candidate> {
    let (n_inside, n_half) = (profile.count(from, to), 0.5 * (to - from) as f64);
    if n_inside < n_half.max(3.0) {
        return None;
    }
    let (left, right) = (profile.line(from - beside, from)?, profile.line(to, to + beside)?);
    let (xa, xb) = (profile.edge(from), profile.edge(to));
    let (ha, hb) = (left.at(xa), right.at(xb));
    let chord = |x: f64| ha + (hb - ha) * (x - xa) / (xb - xa);
    let over = |f: usize, t: usize| profile.mean(f, t).map(|(x, h)| sign * (h - chord(x)));
    let height = over(from, to)?;
    if height <= LEAST_HEIGHT_MM + 4.0 * sigma / n_inside.sqrt() {
        return None;
    }
    let middle = usize::midpoint(from, to);
    if over(from, middle)? <= HALVES_ALIKE * height || over(middle, to)? <= HALVES_ALIKE * height {
        return None;
    }
    let smooth = SMOOTH_BESIDE * height + 3.0 * sigma;
    if left.rms() >= smooth || right.rms() >= smooth {
        return None;
    }
    let quarter = ((to - from) / 4).max(3);
    // A scanner that leans does not see the flank behind the crown: its slope is then that of the way up to what is seen.
    let flank = |seen: Option<Line>, beyond: Option<Line>, toe: [f64; 2]| {
        let slope = |l: Line| (l.slope, 1.0 / l.sxx);
        let way_up = |l: Line| ((l.h - toe[1]) / (l.x - toe[0]), 1.0 / (l.count * (l.x - toe[0]).powi(2)));
        seen.map(slope).or_else(|| beyond.map(way_up))
    };
    let rising = flank(profile.line(from, from + quarter), profile.line(from + quarter, middle), [xa, ha])?;
    let falling = flank(profile.line(to - quarter, to), profile.line(middle, to - quarter), [xb, hb])?;
    let turn = [sign * (rising.0 - left.slope), sign * (right.slope - falling.0)];
    let se = |flank: f64, beside: &Line| sigma * (flank + 1.0 / beside.sxx).sqrt();
    let doubt = [se(rising.1, &left), se(falling.1, &right)];
    let (least, most) = (turn[0].min(turn[1]), turn[0].max(turn[1]));
    let weaker = if turn[0] < turn[1] { doubt[0] } else { doubt[1] };
    if least <= 0.6 * KINK_RAD + 1.5 * weaker
        || turn[0] + turn[1] <= 2.0 * KINK_RAD + 2.0 * doubt[0].hypot(doubt[1])
        || least <= KINKS_ALIKE * most
    {
        return None;
    }
    Some(Candidate { from, to, toes: [xa, xb], height, score: height * (xb - xa).sqrt() })
}

/// The seam's course through the candidates of all stations: their most voted place, then a robust line (the median of all
/// slopes; Theil 1950, Sen 1968), then per station the candidate next to it.
#[derive(Debug, Clone)]
pub(super) struct WeldLine {
    /// Middle of the seam at the place along: `offset + slope · along`.
    pub offset: f64,
    pub slope: f64,
    /// The chosen candidate per station.
    pub chosen: Vec<Option<Candidate>>,
}

impl WeldLine {
    pub fn at(&self, along: f64) -> f64 {
        self.offset + self.slope * along
    }

    pub fn width(&self) -> f64 {
        let mut widths: Vec<f64> = self.chosen.iter().flatten().map(Candidate::width).collect();
        if widths.is_empty() { 0.0 } else { crate::ground::robust::median(&mut widths) }
    }
}

/// Votes fall into cells of this width.
const VOTE_MM: f64 = 3.0;

pub(super) fn course(found: &[Vec<Candidate>], along: &[f64]) -> Option<WeldLine> {
    let mut votes: std::collections::BTreeMap<i64, f64> = Default::default();
    for one in found.iter().flatten() {
        *votes.entry((one.middle() / VOTE_MM).floor() as i64).or_default() += one.score;
    }
    let heap = |k: i64| (-1..=1).map(|d| votes.get(&(k + d)).copied().unwrap_or(0.0)).sum::<f64>();
    let (&cell, _) =
        votes.iter().max_by(|a, b| heap(*a.0).total_cmp(&heap(*b.0)).then(a.1.total_cmp(b.1)).then(b.0.cmp(a.0)))?;
    let voted = (cell as f64 + 0.5) * VOTE_MM;
    let mut width: Vec<f64> =
        found.iter().flatten().filter(|c| (c.middle() - voted).abs() < 1.5 * VOTE_MM).map(Candidate::width).collect();
    let width = crate::ground::robust::median(&mut width);
    // The seam may lean in the frame: a station's candidate is the one nearest to the vote, within a cap's width and what
    // the seam leans over the view.
    let nearest = |middle: &dyn Fn(f64) -> f64, reach: f64| -> Vec<Option<Candidate>> {
        std::iter::zip(found, along)
            .map(|(station, &s)| {
                let off = |c: &&Candidate| (c.middle() - middle(s)).abs();
                station.iter().filter(|c| off(c) < reach).max_by(|a, b| a.score.total_cmp(&b.score)).copied()
            })
            .collect()
    };
    let first = nearest(&|_| voted, width.max(2.0 * VOTE_MM));
    let points: Vec<(f64, f64)> =
        std::iter::zip(&first, along).filter_map(|(c, &s)| c.map(|c| (s, c.middle()))).collect();
    let (offset, slope) = robust_line(&points);
    let chosen = nearest(&|s| offset + slope * s, (0.3 * width).max(VOTE_MM));
    Some(WeldLine { offset, slope, chosen })
}

/// Theil's and Sen's line: medians of the slopes of all pairs, and of what is left.
pub(super) fn robust_line(points: &[(f64, f64)]) -> (f64, f64) {
    let mut slopes: Vec<f64> = Vec::new();
    for (i, a) in points.iter().enumerate() {
        slopes.extend(points[..i].iter().filter(|b| b.0 != a.0).map(|b| (a.1 - b.1) / (a.0 - b.0)));
    }
    // Two or three stations show no slope: the seam is then taken as square to the axis.
    let slope = if points.len() < 4 || slopes.is_empty() { 0.0 } else { crate::ground::robust::median(&mut slopes) };
    let mut rest: Vec<f64> = points.iter().map(|p| p.1 - slope * p.0).collect();
    (if rest.is_empty() { 0.0 } else { crate::ground::robust::median(&mut rest) }, slope)
}

/// The largest jump between two lines beside a place, in units of their scatter: a weld that was ground flush.
#[derive(Debug, Clone, Copy)]
pub(super) struct Jump {
    pub at: f64,
    pub strength: f64,
}

/// Lines beside a jump.
const JUMP_BESIDE_MM: f64 = 6.0;
/// And this part of so much on either side of it holds points.
const JUMP_NEAR_MM: f64 = 1.5;
const JUMP_SEEN_PART: f64 = 0.5;

pub(super) fn jumps(profile: &Profile, sigma: f64) -> Vec<Jump> {
    let (beside, near) = (profile.in_bins(JUMP_BESIDE_MM), profile.in_bins(JUMP_NEAR_MM));
    let mut all: Vec<Jump> = Vec::new();
    for at in beside..profile.len().saturating_sub(beside) {
        let (Some(left), Some(right)) = (profile.line(at - beside, at), profile.line(at, at + beside)) else {
            continue;
        };
        let x = profile.edge(at);
        // A jump over a gap is what the gap hides: a flank behind its crown, not an edge.
        let gap = [at.saturating_sub(near)..at, at..(at + near).min(profile.len())];
        if gap.into_iter().any(|g| profile.count(g.start, g.end) < JUMP_SEEN_PART * near as f64) {
            continue;
        }
        let scatter = left.rms().max(right.rms()).max(sigma);
        all.push(Jump { at: x, strength: (right.at(x) - left.at(x)).abs() / scatter });
    }
    all.sort_by(|a, b| b.strength.total_cmp(&a.strength).then(a.at.total_cmp(&b.at)));
    let mut kept: Vec<Jump> = Vec::new();
    for one in all {
        if kept.iter().all(|k| (k.at - one.at).abs() > 2.0 * JUMP_BESIDE_MM) {
            kept.push(one);
            if kept.len() == KEPT {
                break;
            }
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A cap 8 mm wide and 0.9 mm high with its middle at 0; what lies between `hidden` is not seen.
    fn leaning(hidden: [f64; 2]) -> Profile {
        let height = |x: f64| if x.abs() < 4.0 { 0.9 * (1.0 - (x / 4.0).abs().powf(2.5)) } else { 0.0 };
        let seen = |x: f64| if (hidden[0]..hidden[1]).contains(&x) { f64::NAN } else { height(x) };
        Profile::new(-40.0, 0.4, (0..200).map(|i| seen(-39.8 + 0.4 * f64::from(i))).collect())
    }

    #[test]
    fn a_cap_whose_flank_hides_behind_its_crown_is_a_cap() {
        for hidden in [[0.0, 0.0], [-4.4, -2.0], [2.0, 4.4]] {
            let found = candidates(&leaning(hidden), 20.0, 0.01, 1.0);
            let best = found.first().unwrap_or_else(|| panic!("no cap with {hidden:?} hidden"));
            assert!(best.middle().abs() < 1.0 && (best.width() - 8.0).abs() < 1.6, "{best:?}");
        }
    }

    #[test]
    fn a_gap_is_no_jump() {
        let step = |hidden: f64| {
            let height = |x: f64| if x < 0.0 { 0.0 } else { 0.7 };
            let seen = |x: f64| if x.abs() < hidden { f64::NAN } else { height(x) };
            Profile::new(-40.0, 0.4, (0..200).map(|i| seen(-39.8 + 0.4 * f64::from(i))).collect())
        };
        assert!(jumps(&step(0.0), 0.01).iter().any(|j| j.at.abs() < 0.3 && j.strength > 20.0));
        assert!(jumps(&step(1.5), 0.01).iter().all(|j| j.at.abs() > 1.5));
    }
}
