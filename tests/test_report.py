"""The result's files: their contract, that they appear as a whole, and that the page needs nothing but itself."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest

from synthetic import inspection, nothing_measured
from weldscan import InputError
from weldscan.report import FILES, write_report
from weldscan.report.charts import arcs_of, nice_ticks
from weldscan.report.pictures import diverging
from weldscan.result import Label, bar


@pytest.fixture(scope="module")
def made():
    return inspection(20_000)


def read(folder):
    return json.loads((folder / "result.json").read_text(), parse_constant=lambda word: pytest.fail(f"{word} in JSON"))


def test_result_json_keeps_its_contract(made, tmp_path):
    write_report(made, tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(FILES)
    result = read(tmp_path / "out")
    assert result["schema"] == "weldscan-result/1"
    step = result["step_mm"]
    assert {"mean", "median", "max_abs", "max_abs_at_deg", "expanded_uncertainty", "histogram"} <= set(step)
    assert step["max_abs"] == made.step.max_abs_mm and step["histogram"] == made.step.histogram.step_mm
    assert result["profile"][3] == {
        "angle_deg": made.step.angle_deg[3],
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


def test_nan_becomes_null(made, tmp_path):
    step = replace(made.step, expanded_uncertainty_mm=math.nan, u_mm=np.full_like(made.step.u_mm, np.inf))
    write_report(replace(made, step=step), tmp_path / "out")
    result = read(tmp_path / "out")
    assert result["step_mm"]["expanded_uncertainty"] is None and result["profile"][0]["u_mm"] is None


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
    table = np.loadtxt(tmp_path / "out" / "profile.csv", delimiter=",", skiprows=1)
    assert np.allclose(table, np.stack([made.step.angle_deg, made.step.step_mm, made.step.u_mm], 1), atol=5e-6)


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
    evil = "<script>alert(1)</script>"
    write_report(
        replace(made, session=evil, findings=(bar("cap", evil),), left_out=((evil, evil),), software={"x": evil}),
        tmp_path / "out",
    )
    assert "<script" not in (tmp_path / "out" / "report.html").read_text()


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
    assert len({int(label) for label in Label}) == 4
