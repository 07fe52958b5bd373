"""The result's files: their contract, that they appear as a whole, and that the page needs nothing but itself."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from synthetic import PART, barred, inspection, nothing_measured, seam_bin, with_findings
from weldscan import InputError, read_result
from weldscan.records.result import BOTH_STEPS
from weldscan.report import FATE_NAMES, FILES, write_report
from weldscan.report.charts import Limit, arcs_of, nice_ticks, seam_chart, unseen_arcs
from weldscan.report.pictures import COLOURS, diverging
from weldscan.result import CODES, FATES, Coverage, Label, Standing, Verdict, bar, note, warning

DATA = Path(__file__).parents[1] / "data"
FORMATS = Path(__file__).resolve().parents[2] / "docs" / "formats.md"


@pytest.fixture(scope="module")
def made():
    return inspection(20_000)


def read(folder):
    return json.loads((folder / "result.json").read_text(), parse_constant=lambda word: pytest.fail(f"{word} in JSON"))


def test_result_json_keeps_its_contract(made, tmp_path):
    write_report(made, tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(FILES)
    result = read(tmp_path / "out")
    assert result["schema"] == "weldscan-result/2"
    step = result["step_mm"]
    assert {"mean", "median", "max_abs", "max_abs_at_deg", "expanded_uncertainty", "histogram"} <= set(step)
    assert step["max_abs"] == made.step.max_abs_mm and step["histogram"] == made.step.histogram.step_mm
    assert result["profile"][3] == {
        "angle_deg": made.step.angle_deg[3],
        "along_mm": pytest.approx(made.step.angle_deg[3] / 360 * math.pi * 630),
        "step_mm": made.step.step_mm[3],
        "u_mm": made.step.u_mm[3],
    }
    assert np.shape(result["hand_eye"]["flange_from_scanner"]) == (4, 4)
    assert result["hand_eye"]["residual_rms_mm"] == 0.0351 and len(result["hand_eye"]["per_shot"]) == 6
    label = made.cloud.label
    assert result["counts"] == {
        "points": 20_000,
        "reference_wall": int((label == 1).sum()),
        "other_wall": int((label == 2).sum()),
        "bead": int((label == 3).sum()),
        "transition": int((label == 4).sum()),
    }
    assert set(result["verdicts"][0]) >= {"norm", "clause", "limit_mm", "value_mm", "verdict", "reason"}
    assert result["verdicts"][0]["verdict"] == result["verdict"] == "PASS"
    assert result["timing_s"] == made.timing_s and result["software"]["version"]


def test_what_was_not_measured_is_null_and_has_its_reason(tmp_path):
    write_report(nothing_measured(), tmp_path / "out")
    result = read(tmp_path / "out")
    assert result["step_mm"]["max_abs"] is None and result["profile"] == [] and result["hand_eye"] is None
    assert result["counts"]["points"] == 0
    assert result["verdict"] == "NOT MEASURED" and result["verdicts"][0]["reason"] == "only one wall is in view"
    page = (tmp_path / "out" / "report.html").read_text()
    assert "only one wall is in view" in page and "nan" not in re.sub(r"data:[^\"]*", "", page).lower().split()


def test_a_bin_without_uncertainty_is_no_measurement(made, tmp_path):
    u_mm = made.step.u_mm.copy()
    u_mm[[0, 5]] = np.inf, np.nan
    step = replace(made.step, expanded_uncertainty_mm=math.nan, u_mm=u_mm)
    write_report(replace(made, step=step), tmp_path / "out")
    result = read(tmp_path / "out")
    assert result["step_mm"]["expanded_uncertainty"] is None
    assert [row["angle_deg"] for row in result["profile"]] == np.delete(step.angle_deg, [0, 5]).tolist()
    assert all(math.isfinite(value) for row in result["profile"] for value in row.values())
    nothing = replace(made, step=replace(step, u_mm=np.full_like(u_mm, np.nan)))
    write_report(nothing, tmp_path / "out")
    assert read(tmp_path / "out")["profile"] == []


def test_what_bars_is_in_the_result(tmp_path):
    made = barred(2000)
    write_report(made, tmp_path / "out")
    result = read(tmp_path / "out")
    assert result["verdict"] == "INCONCLUSIVE"
    assert [each["code"] for each in result["bars"]] == ["coverage", *["points-without-wall"] * 4, "shots-disagree"]
    assert result["bars"][1] == {
        "code": "points-without-wall",
        "shot": "part-1",
        "at_deg": 84.0,
        "text": "984 points beside the seam that neither wall nor cap explains",
    }
    assert [each["severity"] for each in result["findings"]] == ["bar"] * 6 + ["warning", "note"]
    assert result["warnings"] == [finding.text for finding in made.findings[-2:]]
    assert result["coverage"] == {
        "seen_deg": 100.0,
        "required_deg": 158.0,
        "required_by": "views",
        "gaps": [[113.0, 171.0]],
    }
    assert len(result["seam"]) == len(made.seam) == 81 and set(result["seam"][0]["fate"]) == set(FATES)
    assert result["seam"][11] == {
        "angle_deg": 84.0,
        "along_mm": pytest.approx(84 / 360 * math.pi * 630),
        "measured": True,
        "fate": dict.fromkeys(FATES, 0)
        | {"wall": 1800, "transition": 300, "cap": 700, "gated": 900, "off_line": 40, "dark": 20},
        "cap_width_mm": 12.4,
        "toes_mm": [-6.1, 6.3],
        "toes_u_mm": None,
        "transition_mm": None,
        "transition_depth_mm": None,
    }
    judgement = result["judgements"][0]
    assert judgement["barred_by"] == ["coverage", "points-without-wall", "shots-disagree"]
    assert judgement["upper"] == pytest.approx(judgement["value"] + judgement["u"])
    assert judgement["margin"] == pytest.approx((1.1 - judgement["upper"]) / 1.1)
    assert [set(each) for each in result["judgements"]] == [set(judgement)] * 3 and len(result["verdicts"]) == 3


def test_the_headline_is_the_judgement_of_least_margin(tmp_path):
    made = inspection(500, norms=("iso-5817:B", "nb-4232", "pnae-g-7-010-89"))
    write_report(made, tmp_path / "out")
    result = read(tmp_path / "out")
    least = min(result["judgements"], key=lambda each: each["margin"])
    assert result["headline"]["norm"] == least["norm"] == "pnae-g-7-010-89"
    assert result["headline"]["words"] == "PASS over 100° of 360°"
    write_report(inspection(500, norms=("iso-5817:B", "nb-4232")), tmp_path / "out")
    headline = read(tmp_path / "out")["headline"]
    assert headline["evidence"] == "unverified: from memory" and "nb-4232" in headline["text"]
    assert "[limit from memory]" in headline["text"]
    # What fails is told before what passes by a hair, and what is not known before what is close.
    parted = inspection(500, scale=3.3, norms=("iso-5817:B", "pnae-g-7-010-89"))
    assert parted.headline.verdict == Verdict.FAIL and parted.headline.norm == "pnae-g-7-010-89"
    assert nothing_measured().headline.verdict == Verdict.NOT_MEASURED
    assert replace(made, verdicts=()).headline is None
    write_report(replace(made, verdicts=()), tmp_path / "out")
    assert read(tmp_path / "out")["headline"]["text"] == "NOT MEASURED: no norm was asked"


@pytest.mark.parametrize(
    ("seen", "words"), [(54.9, "PASS over 54° of 360°"), (359.9, "PASS over 359° of 360°"), (360.0, "PASS")]
)
def test_how_much_was_seen_is_in_the_word_and_in_the_colour(made, tmp_path, seen, words):
    found = replace(made, coverage=Coverage(seen, 0.0, "views", ()))
    write_report(found, tmp_path / "out")
    text = (tmp_path / "out" / "report.html").read_text()
    assert found.words() == words and f'<div class="word">{words}</div>' in text
    assert f'<section class="verdict {"PASS" if seen == 360 else "PART"}">' in text
    assert found.words(Verdict.FAIL) == "FAIL"


def test_every_standing_of_the_scanner(made, tmp_path):
    for state, relied_on in (("verified", True), ("none", True), ("expired", False), ("failed", False)):
        standing = Standing(state, "what is on record")
        assert standing.good == (state == "verified") and standing.relied_on == relied_on
        assert replace(standing, accepted="by hand").relied_on
        write_report(replace(made, verification=standing), tmp_path / "out")
        found = read(tmp_path / "out")
        assert found["verification"]["state"] == state and found["verification"]["good"] is standing.good
        assert found["calibration"] == "not stated"
    write_report(replace(made, verification=None, calibration="stated"), tmp_path / "out")
    assert read(tmp_path / "out")["verification"]["state"] == "none"
    assert read(tmp_path / "out")["calibration"] == "stated"


def test_what_is_not_observable_is_named_and_has_no_number(made, tmp_path):
    step = replace(
        made.step,
        harmonics_mm={"diameter_difference": 0.5, "diameter_difference_u": 0.01},
        angle_between_walls_deg=None,
        angle_between_walls_u_deg=None,
        not_observable=("axis_offset", "angle_between_walls"),
    )
    write_report(replace(made, step=step), tmp_path / "out")
    found = read(tmp_path / "out")["step_mm"]
    assert found["not_observable"] == ["axis_offset", "angle_between_walls"]
    assert "angle_between_walls_deg" not in found and set(found["harmonics"]) == set(step.harmonics_mm)
    assert (tmp_path / "out" / "report.html").read_text().count("not observable</b>") == 2


def test_a_result_of_the_first_version_is_read_on():
    old = json.loads((DATA / "result-1.json").read_text())
    found = read_result(DATA / "result-1.json")
    assert found["schema"] == "weldscan-result/1"
    for name in ("verdict", "judged_mm", "verdicts", "counts", "warnings", "uncertainty_budget", "hand_eye", "masks"):
        assert found[name] == old[name]
    assert found["step_mm"].items() >= old["step_mm"].items()
    assert found["profile"][0].items() >= old["profile"][0].items() and found["profile"][0]["along_mm"] > 0
    assert found["bars"] == found["seam"] == [] and found["findings"][0]["text"] == old["warnings"][0]
    assert found["coverage"]["seen_deg"] == 100.0 and found["calibration"] == "not stated"
    # It said `good` where there was no verification at all.
    assert old["verification"]["good"] is True
    assert found["verification"]["good"] is False and found["verification"]["state"] == "none"
    assert found["headline"]["words"] == "PASS over 100° of 360°" and found["headline"]["norm"] == "pnae-g-7-010-89"
    assert found["judgements"][1]["margin"] == pytest.approx((2.0 - old["judged_mm"] - 0.031) / 2.0)


def test_a_result_is_read_as_it_was_written(tmp_path):
    write_report(barred(500), tmp_path / "out")
    assert read_result(tmp_path / "out") == read(tmp_path / "out")
    # Whatever /2 has, /1 is given.
    assert set(read(tmp_path / "out")) == set(read_result(DATA / "result-1.json"))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (None, "no such file"),
        ("{", "is not JSON"),
        ("[" * 100_000, "is nested too deeply"),
        ("[]", "schema: must be one of weldscan-result/1, weldscan-result/2, got None"),
        ('{"schema": "weldscan-result/3"}', "got 'weldscan-result/3'"),
        ('{"schema": "weldscan-result/1"}', "is no whole result"),
    ],
)
def test_what_is_no_result_is_refused(tmp_path, text, says):
    if text is not None:
        (tmp_path / "result.json").write_text(text)
    with pytest.raises(InputError, match=re.escape(says)):
        read_result(tmp_path / "result.json")


def test_the_cloud_is_binary_ply_that_reads_back(made, tmp_path):
    points = made.cloud.points_mm.copy()
    points[7] = np.nan
    write_report(replace(made, cloud=replace(made.cloud, points_mm=points)), tmp_path / "out")
    header, _, body = (tmp_path / "out" / "cloud.ply").read_bytes().partition(b"end_header\n")
    assert header.startswith(b"ply\nformat binary_little_endian 1.0\n") and b"element vertex 19999\n" in header
    rows = np.frombuffer(body, np.dtype("<f4,<f4,<f4,u1,<f4"))
    good = np.delete(np.arange(20_000), 7)
    xyz = np.stack([rows[f"f{i}"] for i in range(3)], axis=1)
    assert np.array_equal(xyz, points[good].astype(np.float32))
    assert np.array_equal(rows["f3"], made.cloud.label[good])
    assert np.array_equal(rows["f4"], made.cloud.deviation_mm[good])


def test_the_profile_is_a_table(made, tmp_path):
    write_report(made, tmp_path / "out")
    text = (tmp_path / "out" / "profile.csv").read_text()
    assert text.startswith("angle_deg,step_mm,u_mm,along_mm\n")
    both = {name: made.step.u_mm + k for k, name in enumerate(BOTH_STEPS)}
    write_report(replace(made, step=replace(made.step, **both)), tmp_path / "both")
    more = (tmp_path / "both" / "profile.csv").read_text().splitlines()
    assert more[0] == "angle_deg,step_mm,u_mm,along_mm,wall_step_mm,wall_u_mm,edge_step_mm,edge_u_mm"
    assert np.allclose(np.loadtxt(more, delimiter=",", skiprows=1)[:, 4:], np.stack([*both.values()], 1), atol=5e-6)
    table = np.loadtxt(text.splitlines(), delimiter=",", skiprows=1)
    assert np.allclose(table[:, :3], np.stack([made.step.angle_deg, made.step.step_mm, made.step.u_mm], 1), atol=5e-6)
    assert np.allclose(table[:, 3], made.step.angle_deg / 360 * math.pi * PART["outside_diameter"], atol=5e-4)


class Page(HTMLParser):
    """What a page refers to, and whether its elements are closed in order."""

    VOID = ("meta", "br", "img", "link", "input", "hr")

    def __init__(self):
        super().__init__()
        self.references, self.open, self.text = [], [], []

    def handle_starttag(self, tag, attrs):
        self.references += [value for name, value in attrs if name in ("src", "href", "xlink:href", "action")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.references += [value for name, value in attrs if name in ("src", "href", "xlink:href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def test_the_page_is_self_contained_and_well_formed(made, tmp_path):
    write_report(made, tmp_path / "out")
    text = (tmp_path / "out" / "report.html").read_text()
    page = Page()
    page.feed(text)
    assert page.open == []
    assert page.references and all(reference.startswith("data:image/png;base64,") for reference in page.references)
    assert "url(http" not in text and "@import" not in text and "<script" not in text
    words = " ".join(" ".join(page.text).split())
    for expected in ("PASS", "0.412", "1.100", "artefact-7", "20 % of the highest count", "open-630", "7e7e"):
        assert expected in words


def test_names_from_outside_are_escaped(made, tmp_path):
    evil = "<script>alert(1)</script>\"'&"
    found = with_findings(made, bar("cap", evil, evil, 70.0), warning("pose", evil, evil), note("paper", evil))
    found = replace(
        found,
        session=evil,
        left_out=((evil, evil),),
        software={"x": evil},
        calibration=evil,
        verification=Standing("failed", evil, notes=(evil,)),
        coverage=Coverage(100.0, 158.0, evil, ((113.0, 171.0),)),
        verdicts=tuple(replace(each, norm=evil, clause=evil, reason=evil) for each in found.verdicts),
        step=replace(found.step, not_observable=(evil,), harmonics_mm={evil: 1.0, evil + "_u": 0.1}),
    )
    write_report(found, tmp_path / "out")
    text = (tmp_path / "out" / "report.html").read_text()
    assert "<script" not in text and "&lt;script&gt;" in text
    page = Page()
    page.feed(text)
    assert page.open == []


@pytest.mark.parametrize(("severity", "code"), [*((bar, code) for code in CODES), (warning, "cap"), (note, "paper")])
def test_every_finding_is_on_the_page(severity, code, tmp_path):
    found = with_findings(inspection(500), severity(code, "what was found there", "part-2", 84.0))
    write_report(found, tmp_path / "out")
    text = (tmp_path / "out" / "report.html").read_text()
    body = text[text.index("<body>") :]
    assert found.verdict == (Verdict.INCONCLUSIVE if severity is bar else Verdict.PASS)
    # What bars stands before everything else, what does not bar below the verdict.
    first, verdict = body.index("what was found there"), body.index('<section class="verdict')
    assert (first < body.index("<header") < verdict) == (severity is bar) and (first > verdict) == (severity is not bar)
    if severity is bar:
        assert f'<b class="code">{code}</b> <span class="place">part-2, at 84°</span>' in body
        assert f"would be PASS but for: <b>{code}</b>" in body
        # On the curve with its number, and on the ring.
        assert body.count('class="bar-column"') == 1 and ">1</text>" in body and body.count('class="ring-bar"') == 1
    else:
        assert "bar-column" not in body and "ring-bar" not in body and "but for" not in body


def test_fail_stays_fail_with_what_bars_above_it(tmp_path):
    found = with_findings(inspection(500, scale=5.0), bar("cap", "two humps"))
    write_report(found, tmp_path / "out")
    text = (tmp_path / "out" / "report.html").read_text()
    assert found.verdict == Verdict.FAIL and "two humps" in text and "would be PASS" not in text


def test_many_bars_of_one_kind_are_one_line(made, tmp_path):
    found = with_findings(made, *(bar("cap", f"hump {i}", "part-1", 64.0 + 2 * i) for i in range(12)))
    write_report(found, tmp_path / "out")
    text = (tmp_path / "out" / "report.html").read_text()
    box = text[text.index('<section class="barred"') : text.index("<header")]
    assert box.count("<li>") == 1 and "part-1, at 64°, 66°, 68°, 70°, 72°, 74°, 76° … 86°" in box
    assert "and 9 more of this kind" in box and text.count("hump 11") == 1


def test_a_gap_is_hatched_and_no_line_crosses_it():
    made = barred(500)
    gap = {78.0, 80.0, 112.0}
    u_mm = np.where(np.isin(made.step.angle_deg, list(gap)), np.nan, made.step.u_mm)
    step = replace(made.step, u_mm=u_mm)
    chart = seam_chart(step, [], 0.0, made.seam, made.coverage)
    # Two arcs, one of them in two pieces.
    assert chart.count('class="curve"') == chart.count('class="band"') == 3
    assert chart.count('class="dot"') == step.angle_deg.size - len(gap)
    # Both ends of what was required, and the gap between.
    assert unseen_arcs(made.seam, made.coverage) == [(61.0, 63.0), (113.0, 171.0), (221.0, 223.0)]
    assert chart.count('fill="url(#unseen)"') == 3 and "not seen" in chart
    assert unseen_arcs((), None) == [] and unseen_arcs((), Coverage(0, 360, "option", ((0, 360),))) == [(0, 360)]
    assert unseen_arcs((), Coverage(350, 360, "option", ((355.0, 5.0),))) == [(355, 365)]
    across = [seam_bin(angle, False) for angle in (0.0, 2.0, 100.0, 358.0)]
    assert unseen_arcs(across, None) == [(99, 101), (357, 363)]
    assert unseen_arcs([seam_bin(angle, False) for angle in np.arange(0, 360, 2.0)], None) == [(0, 360)]


def test_a_bin_alone_still_shows_its_uncertainty(made):
    alone = replace(made.step, u_mm=np.where(made.step.angle_deg == 70.0, made.step.u_mm, np.nan))
    chart = seam_chart(alone)
    assert chart.count('class="whisker"') == chart.count('class="dot"') == 1 and "curve" not in chart


def test_the_strip_shows_every_fate_to_scale():
    assert tuple(FATE_NAMES) == FATES
    seam = [seam_bin(10.0, False, **{name: 12 for name in FATES}), seam_bin(12.0, True, wall=9, cap=3)]
    chart = seam_chart(None, seam=seam)
    for name in FATES:
        (path,) = re.findall(rf'<path d="([^"]*)" class="fate-{name}"', chart)
        heights = [float(height) for height in re.findall(r"v(-?[\d.]+)h", path)]
        full = 60.0
        expected = {"wall": [full / 12, 0.75 * full], "cap": [full / 12, 0.25 * full]}.get(name, [full / 12])
        assert heights == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("scale", [1.0, -1.0, -0.1])
def test_all_limits_are_drawn(scale):
    step = inspection(500, scale=scale).step
    chart = seam_chart(
        step, [Limit(1.1, "limit 1.1 mm: a"), Limit(1.12, "limit 1.12 mm: b"), Limit(4.0, "limit 4 mm: c")]
    )
    for name in "abc":
        assert f"mm: {name}</text>" in chart
    assert chart.count('class="limit"') >= 3


def test_nothing_measured_still_shows_where(tmp_path):
    whole = barred(500)
    made = replace(nothing_measured(), seam=whole.seam, coverage=Coverage(0.0, 158.0, "views", ((62.0, 222.0),)))
    write_report(made, tmp_path / "out")
    text = (tmp_path / "out" / "report.html").read_text()
    assert "fate-dark" in text and "158° required" in text and 'class="curve"' not in text


def test_the_list_of_codes_is_that_of_the_code():
    text = FORMATS.read_text(encoding="utf-8")
    table = text[text.index("### Codes of findings") :].split("\n\n")[2]
    assert re.findall(r"^\| `([a-z-]+)` \|", table, re.MULTILINE) == list(CODES)


@pytest.mark.parametrize("scale", [-1.0, 0.01, 4.0])
def test_every_verdict_has_a_page(scale, tmp_path):
    made = inspection(2000, scale=scale, norms=("pnae-g-7-010-89", "nb-4232"))
    write_report(made, tmp_path / "out")
    assert made.verdict in (tmp_path / "out" / "report.html").read_text()


def test_an_earlier_result_is_replaced_and_nothing_else(made, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    write_report(made, out)
    write_report(nothing_measured(), out)
    assert read(out)["verdict"] == "NOT MEASURED"
    (out / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="holds something else"):
        write_report(made, out)
    assert read(out)["verdict"] == "NOT MEASURED" and (out / "notes.txt").exists()
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="is not a folder"):
        write_report(made, tmp_path / "file")
    with pytest.raises(InputError, match="cannot be written"):
        write_report(made, tmp_path / "file" / "below")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "out"]


def test_a_failure_half_way_leaves_the_earlier_result(made, tmp_path, monkeypatch):
    write_report(made, tmp_path / "out")
    monkeypatch.setattr("weldscan.report.html", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_report(nothing_measured(), tmp_path / "out")
    assert read(tmp_path / "out")["verdict"] == "PASS"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_the_deviation_colours_are_even_and_told_apart():
    colours = diverging(np.linspace(-1, 1, 201))
    lightness = cv2.cvtColor(colours[None], cv2.COLOR_RGB2LAB)[0, :, 0].astype(int)
    assert lightness.argmax() in range(98, 103)
    # Falls on both sides, and alike: a reader in grey still sees the size, if not the sign.
    assert (np.diff(lightness[:99]) >= -1).all() and (np.diff(lightness[102:]) <= 1).all()
    assert np.abs(lightness - lightness[::-1]).max() < 25
    assert colours[0, 2] > colours[0, 0] + 60 and colours[-1, 0] > colours[-1, 2] + 60


def test_arcs_of_the_seam():
    assert arcs_of([]) == []
    assert arcs_of(np.arange(0, 360, 2)) == [(0.0, 360.0)]
    assert arcs_of([350, 352, 354, 356, 358, 0, 2, 4, 100, 102]) == [(99.0, 103.0), (349.0, 365.0)]
    assert arcs_of([90]) == [(89.0, 91.0)]


def test_ticks_are_round():
    assert nice_ticks(-0.02, 1.13, 7) == [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]
    assert nice_ticks(0, 0, 5) == [0]


def test_labels_are_told_apart():
    colours = [COLOURS[label] for label in Label if label is not Label.NONE]
    rgb = np.array([[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in colours])
    # In print too: no two are equally light.
    assert np.diff(np.sort(rgb @ [0.299, 0.587, 0.114])).min() > 20


@pytest.mark.parametrize(
    ("judged", "said"), [("wall", "Both walls extrapolated to"), ("edge", "The surfaces right beside both")]
)
def test_the_curve_says_which_step_it_is(made, tmp_path, judged, said):
    write_report(replace(made, step=replace(made.step, judged=judged)), tmp_path / "out")
    assert said in (tmp_path / "out/report.html").read_text()
