//! What makes a weld doubtful: a cap that is none, edges that cannot be read, walls that are no pipe's.
//!
//! A rule with one false alarm in a hundred stations would lose a third of all sessions of forty: each asks for two or three
//! neighbours, or for a part of all stations.

use super::cap::Candidate;
use super::profile::Profile;
use super::station::{Doubt, Kind, Station, running_median};
use super::view::{Found, View};
use super::walls::TOLERANCE_MM;

/// A cap that is too wide, a wall that is not seen undisturbed: in this part of the stations, and in two at least.
const PART: f64 = 0.10;
/// Two humps, in this part of the stations.
const HUMPS_PART: f64 = 0.15;
/// The valley between two humps of one cap, mm and in heights: multi-pass caps have ridges.
const VALLEY_MM: f64 = 0.4;
const VALLEY_HEIGHTS: f64 = 0.3;
/// Where a crown lies between its toes, as a part of the width.
const CROWN: [f64; 2] = [0.18, 0.82];
/// A second weld: its score, its height in heights of the first, in this part of the stations or in three neighbours.
const SECOND_SCORE: f64 = 0.3;
const SECOND_HEIGHTS: f64 = 0.25;
const SECOND_PART: f64 = 0.25;
/// A second edge beside a flush weld, in this part of the stations.
const SECOND_LINE_PART: f64 = 0.4;
/// A toe jumps where three in a row are off their neighbours by this, mm and in widths.
const JUMP_MM: f64 = 2.0;
const JUMP_WIDTHS: f64 = 0.25;
/// A groove between the toes below the line from toe to toe: what undercut norms allow at most.
const GROOVE_MM: f64 = 0.4;
const GROOVE_THICKNESSES: f64 = 0.1;
/// From this depth on it counts: what the strictest level of ISO 5817 allows an undercut.
const GROOVE_SEEN_THICKNESSES: f64 = 0.05;
const GROOVE_SEEN_MM: [f64; 2] = [0.05, 0.15];
/// A hollow cap is an underfill: deeper, or steeper, it is a groove whose edges nobody knows.
const HOLLOW_MM: [f64; 2] = [0.15, 1.0];
const HOLLOW_THICKNESSES: f64 = 0.1;
const HOLLOW_WIDTHS: f64 = 0.2;
/// Metal that stands up beside the cap, mm and in heights.
const BESIDE_MM: f64 = 0.4;
const BESIDE_HEIGHTS: f64 = 0.25;
/// A wall is extrapolated over at most 1.5 times its length and this.
const EXTRAPOLATED: f64 = 1.5;
const EXTRAPOLATED_MM: f64 = 10.0;
/// Weld shrinkage: half a millimetre at most, over 2.5 lengths of the shell.
const SHRINKAGE_MM: f64 = 0.5;
const SHELL_LENGTHS: f64 = 2.5;

/// How far a station is off, where it is.
type Measure<'a> = dyn Fn(usize, &Station) -> Option<f64> + 'a;
/// Stations that are off, and by how much.
type Wrong = Vec<(usize, f64)>;

/// The worst of them.
type Worst<'a> = dyn Fn(&[(usize, f64)]) -> Option<(usize, f64)> + 'a;

impl View<'_> {
    pub(super) fn doubts(&self, found: &Found, stations: &[Station]) -> Vec<Doubt> {
        let mut doubts = Vec::new();
        let seen = stations.iter().filter(|s| s.seen).count();
        let part = |n: usize| n as f64 / seen.max(1) as f64;
        let worth = |s: &Station| s.toes_mm.map_or(0.0, |t| t[1] - t[0]);
        let mut say = |code: &'static str, at: usize, text: String| {
            doubts.push(Doubt { code, at: stations[at].at, text });
        };
        let worst = |wrong: &[(usize, f64)]| wrong.iter().max_by(|a, b| a.1.total_cmp(&b.1)).copied();
        let among = |of: &Measure| -> Wrong {
            stations.iter().enumerate().filter(|(_, s)| s.seen).filter_map(|(k, s)| Some((k, of(k, s)?))).collect()
        };

        let wide = among(&|_, s| Some(worth(s)).filter(|w| *w > self.widest_mm));
        if let Some((k, w)) = worst(&wide).filter(|_| wide.len() >= 2 && part(wide.len()) >= PART) {
            let (most, t) = (self.widest_mm, self.thickness_mm);
            say(
                "cap",
                k,
                format!(
                    "what lies between the walls is up to {w:.1} mm wide, a cap on a wall of {t} mm at most {most:.0} mm: \
                 a taper, a machined end or another surface was taken for it"
                ),
            );
        }
        if found.kind == Kind::Raised {
            self.humps(&among, &worst, &part, &mut say);
            let second = among(&|k, _| self.second_weld(k, found));
            if let Some((k, gap)) =
                worst(&second).filter(|_| neighbours(&second, 3) || part(second.len()) >= SECOND_PART)
            {
                say("cap", k, format!("two seams are in view, {gap:.0} mm apart: which of them is to be measured?"));
            }
        }
        if found.second_line > SECOND_LINE_PART {
            let text = "several edges are in view and no cap: which of them is the weld?".into();
            say("cap", stations.len() / 2, text);
        }
        if found.kind == Kind::Hollow {
            let most = (HOLLOW_THICKNESSES * self.thickness_mm).clamp(HOLLOW_MM[0], HOLLOW_MM[1]);
            let deep = among(&|_, s| Some(s.height_mm.abs()).filter(|d| *d > most || *d > HOLLOW_WIDTHS * worth(s)));
            if let Some((k, d)) = worst(&deep).filter(|_| neighbours(&deep, 2)) {
                say(
                    "cap",
                    k,
                    format!("a groove {d:.2} mm deep runs along the seam: the edges of the walls are not known"),
                );
            }
        }
        for side in 0..2 {
            let at: Vec<Option<f64>> = stations.iter().map(|s| s.toes_mm.map(|t| t[side])).collect();
            let jump = among(&|k, s| {
                let off = (at[k]? - running_median(&at, k, 4)?).abs();
                Some(off).filter(|o| *o > JUMP_MM.max(JUMP_WIDTHS * worth(s)))
            });
            if let Some((k, off)) = worst(&jump).filter(|_| neighbours(&jump, 3)) {
                say("cap", k, format!("the cap's {} jumps by {off:.1} mm", ["reference-side toe", "other toe"][side]));
            }
        }
        let groove = among(&|k, s| {
            let depth = self.groove(k, found, s);
            Some(depth).filter(|d| *d > GROOVE_MM.max(GROOVE_THICKNESSES * self.thickness_mm))
        });
        if let Some((k, d)) = worst(&groove).filter(|_| neighbours(&groove, 2)) {
            say(
                "cap",
                k,
                format!(
                    "a groove {d:.2} mm deep lies beside the cap: an undercut, or an edge that was taken for the toe"
                ),
            );
        }
        let no_edge = among(&|_, s| s.edge.is_none().then_some(0.0));
        if let Some((k, _)) = worst(&no_edge).filter(|_| neighbours(&no_edge, 2)) {
            say("edges", k, "the surfaces right beside the weld could not be read".into());
        }
        for (side, name) in [(0, "reference wall"), (1, "other wall")] {
            let beside = among(&|k, s| {
                let most = BESIDE_MM.max(BESIDE_HEIGHTS * s.height_mm.abs());
                Some(self.bulge(k, s, side)?).filter(|b| *b > most)
            });
            if let Some((k, b)) = worst(&beside).filter(|_| neighbours(&beside, 3)) {
                say("transition", k, format!("metal stands {b:.2} mm up on the {name} beside the cap"));
            }
            let unknown = among(&|_, s| {
                let (Some(run), Some(toes)) = (s.walls[side], s.toes_mm) else { return Some(f64::INFINITY) };
                let toe = if side == 0 { -toes[0] } else { toes[1] };
                let (away, length) = (run.from - toe, run.to - run.from);
                (away > EXTRAPOLATED * length + EXTRAPOLATED_MM).then_some(away)
            });
            if let Some((k, away)) = worst(&unknown).filter(|_| unknown.len() >= 2 && part(unknown.len()) > PART) {
                let where_from = if away.is_finite() { format!(" nearer than {away:.0} mm") } else { String::new() };
                say(
                    "walls",
                    k,
                    format!("the {name} is not seen undisturbed{where_from}: what it was before the weld is not known"),
                );
            }
            let shell = SHELL_LENGTHS * self.grid.course.shell_mm(self.thickness_mm).unwrap_or(0.0);
            let off = among(&|_, s| {
                let (run, toes) = (s.walls[side]?, s.toes_mm?);
                let length = run.from - if side == 0 { -toes[0] } else { toes[1] };
                let departs = s.departure_mm[side];
                let too_far = departs > SHRINKAGE_MM;
                (too_far || (length > shell && departs > 2.0 * TOLERANCE_MM)).then_some(departs)
            });
            if let Some((k, d)) = worst(&off).filter(|_| neighbours(&off, 2)) {
                say(
                    "transition",
                    k,
                    format!(
                        "beside the weld the {name} departs by {d:.2} mm from where it runs undisturbed, more than weld \
                     shrinkage explains ({SHRINKAGE_MM} mm over {shell:.0} mm): a taper, a counterbore, a flare, a dent or a coat"
                    ),
                );
            }
        }
        doubts
    }

    /// Two humps, or a crown at one side.
    fn humps(
        &self,
        among: &dyn Fn(&Measure) -> Wrong,
        worst: &Worst,
        part: &dyn Fn(usize) -> f64,
        say: &mut dyn FnMut(&'static str, usize, String),
    ) {
        let heights = |k: usize, s: &Station| -> Option<(Vec<f64>, f64)> {
            let toes = s.toes_mm?;
            let profile = self.profile(k);
            let (from, to) = (profile.boundary(toes[0]), profile.boundary(toes[1]));
            let over = over_chord(profile, from, to)?;
            let top = over.iter().copied().fold(0.0, f64::max);
            Some((over, top))
        };
        let humps = among(&|k, s| {
            let (over, top) = heights(k, s)?;
            let valley = valley(&over);
            Some(valley).filter(|v| *v > VALLEY_MM.max(VALLEY_HEIGHTS * top) + 3.0 * self.sigma)
        });
        if let Some((k, v)) = worst(&humps).filter(|_| humps.len() >= 2 && part(humps.len()) >= HUMPS_PART) {
            say(
                "cap",
                k,
                format!("the cap has two humps with a valley of {v:.2} mm between them: two welds, or an edge in it"),
            );
        }
        let aside = among(&|k, s| {
            let (over, top) = heights(k, s)?;
            let high: Vec<usize> = (0..over.len()).filter(|&i| over[i] >= 0.9 * top).collect();
            let at = high.iter().sum::<usize>() as f64 / high.len().max(1) as f64 / over.len().max(1) as f64;
            (!(CROWN[0]..=CROWN[1]).contains(&at)).then_some((at - 0.5).abs())
        });
        if let Some((k, _)) = worst(&aside).filter(|_| neighbours(&aside, 2) && part(aside.len()) >= PART) {
            say("cap", k, "the crown of the cap lies at one of its toes: a lap, or an edge was taken for it".into());
        }
    }

    /// The distance of a second weld in a station.
    fn second_weld(&self, k: usize, found: &Found) -> Option<f64> {
        let first = found.course.chosen[k].as_ref()?;
        let far = |c: &&Candidate| c.toes[0] > first.toes[1] || c.toes[1] < first.toes[0];
        let second = found.candidates[k]
            .iter()
            .filter(far)
            .find(|c| c.score > SECOND_SCORE && c.height > SECOND_HEIGHTS * first.height)?;
        Some((second.middle() - first.middle()).abs())
    }

    /// Depth of metal below the line from toe to toe, over more than a millimetre.
    pub(super) fn groove(&self, k: usize, found: &Found, s: &Station) -> f64 {
        let (Some(toes), Kind::Raised) = (s.toes_mm, found.kind) else { return 0.0 };
        let profile = self.profile(k);
        // From surface to surface: each as it is in the millimetre beside its toe.
        let surface = |from: f64, to: f64| profile.mean(profile.boundary(from), profile.boundary(to));
        let (Some((xa, ha)), Some((xb, hb))) = (surface(toes[0] - 1.0, toes[0]), surface(toes[1], toes[1] + 1.0))
        else {
            return 0.0;
        };
        let (from, to) = (profile.boundary(toes[0] + 0.3), profile.boundary(toes[1] - 0.3));
        let over: Vec<f64> = (from..to)
            .filter(|&i| profile.heights[i].is_finite())
            .map(|i| profile.heights[i] - ha - (hb - ha) * (profile.x(i) - xa) / (xb - xa))
            .collect();
        let wide = profile.in_bins(1.2);
        let below: Vec<f64> = over
            .windows(wide)
            .map(|w| w.iter().copied().fold(f64::NEG_INFINITY, f64::max))
            .map(|highest| -highest)
            .collect();
        let depth = below.into_iter().fold(0.0, f64::max);
        let [least, most] = GROOVE_SEEN_MM;
        let seen = (GROOVE_SEEN_THICKNESSES * self.thickness_mm).clamp(least, most) + 3.0 * self.sigma;
        if depth > seen { depth } else { 0.0 }
    }

    /// How far the transition stands over the chord between toe and undisturbed wall.
    fn bulge(&self, k: usize, s: &Station, side: usize) -> Option<f64> {
        let (run, toes) = (s.walls[side]?, s.toes_mm?);
        let profile = &self.smooth[k][side];
        let toe = if side == 0 { -toes[0] } else { toes[1] };
        let (from, to) = (profile.boundary(toe + 0.5), profile.boundary(run.from));
        if to < from + 4 {
            return None;
        }
        over_chord(profile, from, to)?.into_iter().reduce(f64::max)
    }
}

/// Heights of bins over the chord between the means of the outermost three bins on either side; bins without points are
/// passed over.
pub(super) fn over_chord(profile: &Profile, from: usize, to: usize) -> Option<Vec<f64>> {
    if to < from + 4 {
        return None;
    }
    let (xa, ha) = profile.mean(from.saturating_sub(2), from + 1)?;
    let (xb, hb) = profile.mean(to - 1, (to + 2).min(profile.len()))?;
    let chord = |x: f64| ha + (hb - ha) * (x - xa) / (xb - xa);
    let over = (from..to).filter(|&i| profile.heights[i].is_finite());
    Some(over.map(|i| profile.heights[i] - chord(profile.x(i))).collect())
}

/// The deepest valley between two humps: what the lower of them stands over the lowest place between, smoothed over five.
fn valley(over: &[f64]) -> f64 {
    let smooth: Vec<f64> =
        over.windows(5.min(over.len().max(1))).map(|w| w.iter().sum::<f64>() / w.len() as f64).collect();
    let mut highest_after = vec![f64::NEG_INFINITY; smooth.len() + 1];
    for i in (0..smooth.len()).rev() {
        highest_after[i] = highest_after[i + 1].max(smooth[i]);
    }
    let (mut before, mut deepest) = (f64::NEG_INFINITY, 0.0_f64);
    for (i, &h) in smooth.iter().enumerate() {
        deepest = deepest.max(before.min(highest_after[i + 1]) - h);
        before = before.max(h);
    }
    deepest.max(0.0)
}

/// Whether `count` of the stations follow each other.
fn neighbours(wrong: &[(usize, f64)], count: usize) -> bool {
    wrong.windows(count).any(|w| w[count - 1].0 - w[0].0 == count - 1)
}
