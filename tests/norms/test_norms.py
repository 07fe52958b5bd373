"""Every row of every table against values worked out by hand, and the decision rule at its edges."""

from __future__ import annotations

import math

import pytest

from weldscan import InputError
from weldscan.norms import judge, limit_mm, load_norm, norm_ids
from weldscan.result import CODES, Verdict, bar, note, warning

PNAE = "pnae-g-7-010-89"
PIPE = {"kind": "pipe", "outside_diameter": 630.0, "wall_thickness": 6.0, "joint": "circumferential butt"}
# Just above an edge; large against rounding, small against the tables' slopes.
ABOVE = 1e-9

# Thickness, then columns 1, 2, 3 of Table 1 (column 3: the lower of its two readings); worked out with a pencil.
TABLE_1 = [
    (1, 0.2, 0.2, 0.2),
    (4, 0.8, 0.8, 0.8),
    (5, 1.0, 1.0, 1.0),
    (6, 1.1, 1.1, 1.5),
    (8, 1.3, 1.3, 2.0),
    (10, 1.5, 1.5, 2.5),
    (20, 2.5, 2.5, 3.5),
    (25, 3.0, 3.0, 4.0),
    (30, 3.2, 3.3, 4.3),
    (50, 4.0, 4.5, 5.5),
    (70, 4.4, 5.1, 6.3),
    (100, 5.0, 6.0, 7.5),
    (150, 5.5, 6.75, 8.75),
    (200, 6.0, 7.5, 10.0),
    (300, 6.0, 7.5, 10.0),
]


@pytest.mark.parametrize("row", TABLE_1)
def test_pnae_table_1(row):
    thickness, *columns = row
    for column, expected in enumerate(columns, 1):
        assert limit_mm(PNAE, f"Table 1, column {column}", thickness)[0] == expected


@pytest.mark.parametrize(
    ("edge", "reading", "at", "above"),
    [(5, "as_printed", 1.0, 1.25), (50, "as_printed", 5.5, 5.75), (100, "as_printed", 8.0, 7.5)]
    + [(edge, "continuous", at, at) for edge, at in ((5, 1.25), (10, 2.5), (25, 4.0), (50, 5.5), (100, 7.5))],
)
def test_pnae_column_3_jumps_as_printed_and_is_continuous_when_read_so(edge, reading, at, above):
    assert limit_mm(PNAE, "Table 1, column 3", edge)[2][reading] == at
    assert limit_mm(PNAE, "Table 1, column 3", edge + ABOVE)[2][reading] == pytest.approx(above, abs=1e-8)


def test_pnae_column_3_is_judged_by_the_lower_reading_and_says_so():
    part = PIPE | {"joint": "circumferential butt of a casing", "wall_thickness": 70}
    (judgement,) = judge(PNAE, 6.4, 0.05, part)
    assert judgement.limit_mm == 6.3 and judgement.verdict == Verdict.FAIL
    assert judgement.details["readings_mm"] == {"as_printed": 6.65, "continuous": 6.3}
    assert "judged by the lower, continuous" in judgement.details["reading_note"]
    (thin,) = judge(PNAE, 1.1, 0.05, part | {"wall_thickness": 5.0})
    assert thin.limit_mm == 1.0 and thin.details["reading"] == "as_printed"


@pytest.mark.parametrize("column", [1, 2])
@pytest.mark.parametrize("edge", [5, 10, 25, 50, 100])
def test_pnae_columns_1_and_2_are_continuous(column, edge):
    clause = f"Table 1, column {column}"
    assert limit_mm(PNAE, clause, edge + ABOVE)[0] == pytest.approx(limit_mm(PNAE, clause, edge)[0], abs=1e-8)


@pytest.mark.parametrize(
    ("clause", "thickness", "b", "c", "d"),
    [
        ("5071", 0.5, 0.25, 0.275, 0.325),
        ("5071", 2, 0.4, 0.5, 0.7),
        ("5071", 3, 0.5, 0.65, 0.95),
        ("5071", 4, 0.4, 0.6, 1.0),
        ("5071", 20, 2.0, 3.0, 5.0),
        ("5071", 40, 3.0, 4.0, 5.0),
        ("5072", 0.5, 0.25, 0.25, 0.25),
        ("5072", 3, 1.5, 1.5, 1.5),
        ("5072", 5, 2.0, 2.5, 2.5),
        ("5072", 6, 2.0, 3.0, 3.0),
        ("5072", 20, 2.0, 3.0, 4.0),
    ],
)
def test_iso_5817(clause, thickness, b, c, d):
    assert [limit_mm(f"iso-5817:{level}", clause, thickness)[0] for level in "BCD"] == [b, c, d]
    assert limit_mm("iso-5817:B", clause, 0.49) is None


@pytest.mark.parametrize(
    ("clause", "thickness", "expected"),
    [
        ("circumferential", 6, 1.5),
        ("circumferential", 19.05, 4.7625),  # 3/4 in exactly: t/4, and 3/16 in as well
        ("circumferential", 20, 4.7625),
        ("circumferential", 38.1, 4.7625),
        ("circumferential", 38.1 + ABOVE, 4.7625),
        ("circumferential", 50.8, 6.35),
        ("circumferential", 70, 8.75),
        ("circumferential", 200, 19.05),
        ("longitudinal", 12.7, 3.175),
        ("longitudinal", 20, 3.175),
        ("longitudinal", 50.8, 3.175),
        ("longitudinal", 80, 5.0),
        ("longitudinal", 200, 9.525),
    ],
)
def test_asme_nb_4232(clause, thickness, expected):
    assert limit_mm("nb-4232", f"NB-4232, {clause}", thickness)[0] == pytest.approx(expected, abs=1e-9)


def test_the_same_weld_under_three_norms():
    for thickness, *limits in ((6.0, 1.1, 2.0, 1.5), (20.0, 2.5, 2.0, 4.7625), (70.0, 5.1, 2.0, 8.75)):
        part = PIPE | {"wall_thickness": thickness}
        assert [judge(norm, 0.1, 0.01, part)[0].limit_mm for norm in (PNAE, "iso-5817:B", "nb-4232")] == limits


# Limit 1.1, U 0.1: the guard band is 1.0 to 1.2, its lower edge passes and its upper edge does not fail.
@pytest.mark.parametrize(
    ("value", "verdict"),
    [
        (0.0, Verdict.PASS),
        (1.0, Verdict.PASS),
        (-1.0, Verdict.PASS),
        (1.0000001, Verdict.INCONCLUSIVE),
        (-1.1, Verdict.INCONCLUSIVE),
        (1.2, Verdict.INCONCLUSIVE),
        (1.2000001, Verdict.FAIL),
        (-5, Verdict.FAIL),
    ],
)
def test_the_decision_rule(value, verdict):
    (judgement,) = judge(PNAE, value, 0.1, PIPE)
    assert judgement.verdict == verdict
    assert judgement.limit_mm == 1.1 and judgement.clause == "Table 1, column 2" and judgement.value_mm == value
    assert judgement.reason


@pytest.mark.parametrize("uncertainty", [None, math.nan, math.inf, -0.1])
@pytest.mark.parametrize("value", [0.0, 0.5, 9.0])
def test_without_an_uncertainty_nothing_passes(value, uncertainty):
    (judgement,) = judge(PNAE, value, uncertainty, PIPE)
    assert judgement.verdict == Verdict.INCONCLUSIVE and "uncertainty" in judgement.reason


@pytest.mark.parametrize("value", [None, math.nan, math.inf])
def test_without_a_value_it_was_not_measured(value):
    (judgement,) = judge(PNAE, value, 0.1, PIPE, why_not_measured="only one wall is in view")
    assert judgement.verdict == Verdict.NOT_MEASURED and judgement.reason == "only one wall is in view"
    assert judgement.limit_mm == 1.1 and judgement.value_mm is None


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"joint": "fillet"}, "no clause for the joint 'fillet'"),
        ({"other_wall_thickness": 8.0}, "equal rated thickness, these have 6 mm and 8 mm"),
        ({"machined_after_welding": True}, "not machined after welding"),
        ({"side": "opposite"}, "on the side of the welding"),
        ({"wall_thickness": None}, "thickness is not known"),
    ],
)
def test_outside_its_scope_pnae_says_nothing(change, says):
    for value in (0.1, 9.0, None):
        (judgement,) = judge(PNAE, value, 0.1, PIPE | change)
        assert judgement.verdict == Verdict.NOT_ASSESSABLE and says in judgement.reason


def test_other_norms_take_the_thinner_wall():
    (judgement,) = judge("iso-5817:c", 0.1, 0.01, PIPE | {"wall_thickness": 5.0, "other_wall_thickness": 4.0})
    assert judgement.limit_mm == 2.0 and judgement.verdict == Verdict.PASS
    assert judgement.details["level"] == "C" and judgement.details["evidence"] == "second-hand transcription"


def test_an_arc_that_was_not_seen_cannot_pass_where_it_is_required():
    def verdict(value: float, seen: float | None) -> Verdict:
        return judge(PNAE, value, 0.1, PIPE, coverage_deg=seen, required_coverage_deg=360)[0].verdict

    assert verdict(0.1, 360.0) == Verdict.PASS
    assert verdict(0.1, 96.0) == verdict(0.1, None) == Verdict.INCONCLUSIVE
    assert verdict(9.0, 96.0) == Verdict.FAIL
    (judgement,) = judge(PNAE, 0.1, 0.1, PIPE, coverage_deg=96)
    assert judgement.verdict == Verdict.PASS and "in the 96° of the seam that were seen" in judgement.reason


def test_every_norm_says_where_it_comes_from():
    for norm_id in norm_ids():
        norm, _ = load_norm(norm_id)
        assert norm.edition and norm.unit in ("mm", "in") and set(norm.joints.values()) <= set(norm.clauses)
        for clause in norm.clauses.values():
            assert clause.evidence in "VSM"
    assert judge("nb-4232", 0.1, 0.01, PIPE)[0].details["unverified"] is True
    assert judge(PNAE, 0.1, 0.01, PIPE)[0].details["unverified"] is False


@pytest.mark.parametrize("norm_id", ["", "iso-5817", "iso-5817:A", "pnae-g-7-010-89:B", "../secret"])
def test_an_unknown_norm_is_refused(norm_id):
    with pytest.raises(InputError, match=r"there are .*iso-5817:B, "):
        judge(norm_id, 0.1, 0.1, PIPE)


@pytest.mark.parametrize("code", CODES)
def test_a_bar_turns_pass_into_inconclusive_and_nothing_else(code):
    doubt = bar(code, "what is wrong", "part-2", 113.0)
    (passed,) = judge(PNAE, 0.1, 0.05, PIPE, bars=[doubt])
    assert passed.verdict == Verdict.INCONCLUSIVE and passed.barred_by == (doubt,)
    assert passed.reason.startswith(f"would be PASS but for {code} (part-2, at 113°): what is wrong (0.100 mm")
    for value, uncertainty in ((9.0, 0.05), (1.1, 0.05), (None, None)):
        (without,) = judge(PNAE, value, uncertainty, PIPE)
        (barred,) = judge(PNAE, value, uncertainty, PIPE, bars=[doubt])
        assert barred == without and barred.verdict != Verdict.PASS and barred.barred_by == ()


def test_only_bars_bar_and_the_first_are_named():
    harmless = [note("paper", "a"), warning("pose", "b")]
    assert judge(PNAE, 0.1, 0.05, PIPE, bars=harmless)[0].verdict == Verdict.PASS
    doubts = [bar("cap", f"number {i}") for i in range(5)]
    (judgement,) = judge(PNAE, 0.1, 0.05, PIPE, bars=[*harmless, *doubts])
    assert "cap: number 0; cap: number 1; and 3 more" in judgement.reason and len(judgement.barred_by) == 5


def test_too_little_of_the_seam_is_said_once():
    (judgement,) = judge(PNAE, 0.1, 0.05, PIPE, coverage_deg=96, required_coverage_deg=120)
    assert "coverage: 96° of the seam were seen, 120° are required" in judgement.reason
    (whole,) = judge(PNAE, 0.1, 0.05, PIPE, coverage_deg=358, required_coverage_deg=360)
    assert "the whole seam is required" in whole.reason
    gaps = bar("coverage", "100° to 124° were not seen", at_deg=112.0)
    (told,) = judge(PNAE, 0.1, 0.05, PIPE, coverage_deg=96, required_coverage_deg=120, bars=[gaps])
    assert told.barred_by == (gaps,)


@pytest.mark.parametrize("value", [0.9, -0.9])
def test_bounds_margin_and_probability(value):
    (judgement,) = judge(PNAE, value, 0.2, PIPE)
    assert judgement.interval_mm == pytest.approx((0.7, 1.1)) and judgement.margin == pytest.approx(0.0, abs=1e-12)
    # One tail of a normal distribution at k = 2.
    assert judgement.probability_over_limit == pytest.approx(0.0227501, abs=1e-6)
    (small,) = judge(PNAE, value / 9, 0.2, PIPE)
    assert small.interval_mm == pytest.approx((0.0, 0.3)) and small.margin == pytest.approx(0.8 / 1.1)


def test_the_probability_has_two_sides_and_ends():
    (centred,) = judge(PNAE, 0.0, 2.2, PIPE)
    assert centred.probability_over_limit == pytest.approx(2 * 0.1586553, abs=1e-6)
    assert [judge(PNAE, h, 0.0, PIPE)[0].probability_over_limit for h in (1.1, 1.2)] == [0.0, 1.0]
    assert judge(PNAE, 5.0, 0.1, PIPE)[0].probability_over_limit == 1.0
    for value, uncertainty in ((None, 0.1), (0.1, None), (math.nan, 0.1), (0.1, -1.0)):
        (judgement,) = judge(PNAE, value, uncertainty, PIPE)
        assert judgement.interval_mm is judgement.margin is judgement.probability_over_limit is None


@pytest.mark.parametrize(
    ("norm", "doubt"), [(PNAE, ""), ("iso-5817:B", "limit second-hand"), ("nb-4232", "limit from memory")]
)
def test_how_a_limit_was_come_by_is_said(norm, doubt):
    (judgement,) = judge(norm, 0.1, 0.01, PIPE)
    assert judgement.doubt == doubt and judgement.evidence == judgement.details["evidence"]
    assert judgement.rule == {PNAE: "as_printed", "iso-5817:B": "B", "nb-4232": "as_remembered"}[norm]
