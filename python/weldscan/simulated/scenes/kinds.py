"""The kinds of scene: how each one's weld is made from an amplitude, and what is special about it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Literal, TypeAlias

import numpy as np

from weldscan.simulated.scenes.case import (
    Case,
    drawn_thickness,
    in_turn,
    pipe_of,
    rounded_diameter,
    usual_width,
    with_values,
)
from weldscan.simulated.scenes.scene import Scene
from weldscan.simulated.scenes.seen_arc import BIN_DEG
from weldscan.simulated.scenes.welds import (
    Counterbore,
    Dent,
    Flare,
    Harmonic,
    SceneWall,
    SceneWeld,
    SecondSeam,
    Spatter,
    Strip,
    Taper,
    Wander,
)

Group: TypeAlias = Literal["clean", "other-honest", "defective"]


@dataclass(frozen=True)
class Kind:
    """A kind of scene: how its weld is made from an amplitude, and what is special about its case."""

    name: str
    what: str
    group: Group
    weld: Callable[[Case], Callable[[float], SceneWeld]]
    """From a case to the weld of an amplitude, mm: the amplitude is sought that gives the step that was drawn."""
    case: Callable[[Case], None] = lambda case: None
    """Changes the case before its views are set up."""
    finish: Callable[[Case, Scene], Scene] = lambda case, scene: scene
    """Changes the scene at the end: darkness, saturation, another pipe."""


def _aligned(case: Case) -> SceneWall:
    """The other wall with a misfit of up to a third of the limit: what undisturbed walls show of a defective weld."""
    return case.misfit(case.uniform(0.0, 0.33) * case.limit)


def _misfit(case: Case) -> Callable[[float], SceneWeld]:
    return lambda a: case.weld(other=case.misfit(a))


def _on_either(case: Case, change: Callable[[SceneWall, float], SceneWall]) -> Callable[[float], SceneWeld]:
    """What is done to a wall is done to the one or the other."""
    other = _aligned(case)
    if case.random.random() < 0.5:
        return lambda a: case.weld(other=change(other, a))
    return lambda a: case.weld(other=other, reference=change(case.reference, a))


def _taper(slope: float | None) -> Callable[[Case], Callable[[float], SceneWeld]]:
    def weld(case: Case) -> Callable[[float], SceneWeld]:
        steep = case.log(0.05, 0.25) if slope is None else slope
        return _on_either(case, lambda wall, a: replace(wall, taper=Taper(a, steep)))

    return weld


def _counterbore(low_mm: float, high_mm: float) -> Callable[[Case], Callable[[float], SceneWeld]]:
    def weld(case: Case) -> Callable[[float], SceneWeld]:
        floor, slope = min(case.uniform(low_mm, high_mm), 0.25 * case.field_mm), case.log(0.25, 1.0)
        return _on_either(case, lambda wall, a: replace(wall, counterbore=Counterbore(a, floor, slope)))

    return weld


def _flare(case: Case) -> Callable[[float], SceneWeld]:
    decay, sign = case.uniform(3.0, 6.0), case.sign()
    return _on_either(case, lambda wall, a: replace(wall, flare=Flare(sign * a, decay)))


def _dent(
    low_deg: float, high_deg: float, decay: tuple[float, float], sign: float = 1.0
) -> Callable[[Case], Callable[[float], SceneWeld]]:
    def weld(case: Case) -> Callable[[float], SceneWeld]:
        at, width = case.inside(), case.degrees(low_deg, high_deg)
        length = math.inf if math.isinf(decay[1]) else case.uniform(*decay)
        cosine = bool(case.random.random() < 0.5)
        dent = Dent(0.0, at, width, length, cosine)
        return _on_either(case, lambda wall, a: replace(wall, dents=(replace(dent, depth_mm=sign * a),)))

    return weld


def _ring(case: Case) -> Callable[[float], SceneWeld]:
    between = min(case.uniform(8.0, 30.0), 0.25 * case.field_mm)
    width = case.cap.width_mm * case.uniform(0.8, 1.1)
    distance = 0.5 * (width + case.cap.width_mm) + between
    side, sign = case.sign(), case.sign()
    other = _aligned(case)
    second = SecondSeam(side * distance, width, case.cap.height_mm * case.uniform(0.8, 1.1), 0.0)
    return lambda a: case.weld(other=other, second=replace(second, ring_mm=sign * a))


def _coat(case: Case) -> Callable[[float], SceneWeld]:
    start = case.uniform(15.0, 30.0) - case.cap.width_mm / 2
    start = float(np.clip(start, 3.0, 0.2 * case.field_mm))
    # The coat hides the step: the other wall stands out by nearly as much.
    hidden, edge = case.uniform(0.8, 1.0), case.log(0.2, 2.0)

    def weld(a: float) -> SceneWeld:
        other = replace(case.other, radius_difference_mm=case.other.radius_difference_mm + a)
        coat = Strip(hidden * a, start, math.inf, edge)
        return case.weld(other=other, reference=replace(case.reference, strips=(coat,)))

    return weld


def _tape(case: Case) -> Callable[[float], SceneWeld]:
    thickness = min(case.uniform(0.2, 1.0), 0.8 * case.limit)
    start = case.uniform(1.0, 6.0)
    tape = Strip(thickness, start, start + case.uniform(20.0, 80.0), case.log(0.1, 0.5))

    def weld(a: float) -> SceneWeld:
        # The other wall lies deeper; the tape on it brings it up.
        other = replace(case.other, radius_difference_mm=case.other.radius_difference_mm - a, strips=(tape,))
        return case.weld(other=other)

    return weld


def _bump(case: Case, at_rad: float, width_rad: float) -> Callable[[float], SceneWeld]:
    """An arc of the whole wall that stands off."""
    other, sign = _aligned(case), case.sign()
    dent = Dent(0.0, at_rad, width_rad, math.inf)
    return lambda a: case.weld(other=replace(other, dents=(replace(dent, depth_mm=sign * a),)))


def _in_the_dark(case: Case) -> Callable[[float], SceneWeld]:
    at, width = case.inside(0.2), case.degrees(4.0, 8.0, 6.0)
    case.dark_rad = (at - width / 2, at + width / 2)
    return _bump(case, at, width / 2)


def _hardly_lit(case: Case) -> Callable[[float], SceneWeld]:
    arc = case.arc()
    lit = max(math.radians(float(case.random.choice([2.0, 4.0, 10.0]))), 4.0 / case.radius_mm)
    lit = min(lit, 0.4 * math.radians(BIN_DEG * len(arc)))
    start, end = math.radians(arc[0] - 1), math.radians(arc[-1] + 1)
    at = case.uniform(start + 0.1 * lit, end - 1.1 * lit)
    case.dark_rad = (at + lit, at + 2 * math.pi)
    # The step is in the longer dark part.
    before, after = at - start, end - at - lit
    middle = start + before / 2 if before > after else end - after / 2
    return _bump(case, middle, max(before, after) / 2)


def _growing(case: Case) -> Callable[[float], SceneWeld]:
    arc = case.arc()
    end = math.radians(arc[-1] if case.random.random() < 0.5 else arc[0])
    return _bump(case, end, math.radians(BIN_DEG * len(arc)) * case.uniform(0.4, 1.0))


def _oval(n: int, both: bool) -> Callable[[Case], Callable[[float], SceneWeld]]:
    def weld(case: Case) -> Callable[[float], SceneWeld]:
        at, turn = case.uniform(0.0, 2 * math.pi), case.uniform(0.6, 1.0) * math.pi / n
        other = _aligned(case)

        def made(a: float) -> SceneWeld:
            reference = case.reference
            if both:
                wave = (*reference.ovality, Harmonic(n, 0.6 * a, at + turn))
                reference = replace(reference, ovality=wave)
            wave = (*other.ovality, Harmonic(n, a, at))
            return case.weld(other=replace(other, ovality=wave), reference=reference)

        return made

    return weld


def _deep_dent(case: Case) -> Callable[[float], SceneWeld]:
    # 8 mm over 3 degrees of a pipe of 630: no steeper than that elsewhere.
    width = max(math.radians(3.0), 16.0 / case.radius_mm)
    dent = Dent(0.0, case.inside(), width, math.inf, cosine=False)
    other = _aligned(case)
    return lambda a: case.weld(other=replace(other, dents=(replace(dent, depth_mm=a),)))


def _with_cap(
    make: Callable[[Case], Callable[[float], SceneWeld]], **cap: Any
) -> Callable[[Case], Callable[[float], SceneWeld]]:
    def weld(case: Case) -> Callable[[float], SceneWeld]:
        case.cap = replace(case.cap, **{k: v(case) if callable(v) else v for k, v in cap.items()})
        return make(case)

    return weld


def _spatter(case: Case) -> Callable[[float], SceneWeld]:
    arc, count = case.arc(), int(case.random.integers(5, 41))
    reach = 0.3 * case.field_mm
    drops = tuple(
        Spatter(math.radians(case.uniform(arc[0], arc[-1])), case.uniform(-reach, reach), case.uniform(0.3, 1.0))
        for _ in range(count)
    )
    return lambda a: case.weld(other=case.misfit(a), spatter=drops)


def _girth(case: Case) -> None:
    case.diameter_mm = rounded_diameter(case.log(40.0, 300.0))
    case.thickness_mm = drawn_thickness(case)
    case.whole = True


def _shrunk(case: Case) -> None:
    """Both sides got the same heat: they shrank by nearly the same."""
    most = min(0.5, 0.1 * case.thickness_mm)
    first = case.uniform(min(0.1, most), most)
    case.reference = replace(case.reference, shrinkage_mm=first)
    case.other = replace(case.other, shrinkage_mm=first * case.uniform(0.8, 1.2))


def _out_of_round(case: Case) -> None:
    """Two pipes of one lot: out of round by up to 0.3 % of the radius alike, and a little by themselves."""
    at = case.uniform(0.0, 2 * math.pi)
    common = Harmonic(2, case.uniform(0.0, 0.003) * case.radius_mm, at)
    own = [Harmonic(n, case.uniform(0.0, 0.1) * case.limit, case.uniform(0.0, 2 * math.pi)) for n in (2, 3, 4, 5)]
    case.reference = replace(case.reference, ovality=(common, own[0]))
    case.other = replace(case.other, ovality=(common, *own[1:]))


def _dark(case: Case, scene: Scene) -> Scene:
    start, end = case.dark_rad
    return replace(scene, dark_deg=((math.degrees(start), math.degrees(end)),))


def _blinded(case: Case, scene: Scene) -> Scene:
    return replace(scene, saturated=case.uniform(0.8, 0.93))


def _holed(case: Case, scene: Scene) -> Scene:
    return replace(scene, holes=case.uniform(0.1, 0.5))


def _two_pipes(case: Case, scene: Scene) -> Scene:
    good = replace(case.weld(other=case.misfit(case.uniform(0.0, 0.3) * case.limit)), seed=scene.welds[0].seed + 1)
    shown = tuple(replace(view, weld=i % 2) for i, view in enumerate(scene.views))
    return replace(scene, welds=(scene.welds[0], good), views=shown)


_THIN = pipe_of(100.0, 1220.0, (1.5, 12.0))


_TABLE = (
    # Honest, and nothing about them that should cost the verdict.
    Kind("plain", "two round pipes, moved and of other radius", "clean", _misfit),
    Kind("oval", "both pipes out of round", "clean", _misfit, _out_of_round),
    Kind("shrinkage", "both walls drawn in by the weld by 0.1 to 0.5 mm", "clean", _misfit, _shrunk),
    Kind(
        "leaning",
        "the scanner leans by 25 to 50 degrees",
        "clean",
        _misfit,
        with_values(lean_deg=lambda c: c.uniform(25.0, 50.0)),
    ),
    Kind(
        "wide cap",
        "a wide cap on a thick wall",
        "clean",
        _misfit,
        in_turn(
            pipe_of(150.0, 1220.0, (20.0, 60.0)),
            with_values(width_mm=lambda c: min(c.uniform(0.8, 1.0) * usual_width(c), 0.42 * c.field_mm)),
        ),
    ),
    Kind(
        "asymmetric",
        "the crown is nearer to one toe",
        "clean",
        _with_cap(_misfit, crown=lambda c: 0.5 + c.sign() * c.uniform(0.08, 0.25)),
    ),
    Kind(
        "ripple",
        "ripples of 0.1 to 0.3 mm on the cap",
        "clean",
        _with_cap(_misfit, ripple_mm=lambda c: c.uniform(0.1, 0.3), pitch_mm=lambda c: c.uniform(2.0, 6.0)),
    ),
    Kind("holes", "10 to 50 % of the pixels without a point, in patches", "clean", _misfit, finish=_holed),
    Kind(
        "misplaced seam",
        "the seam is not in the middle of the view, and wanders",
        "clean",
        _misfit,
        with_values(
            seam_mm=lambda c: c.sign() * c.uniform(0.06, 0.18) * c.field_mm,
            seam_wander=lambda c: Wander(c.uniform(0.2, 1.0), c.uniform(40.0, 200.0)),
        ),
    ),
    Kind("small pipe", "25 to 60 mm across", "clean", _misfit, pipe_of(25.0, 60.0)),
    # Honest, but with something that may cost it.
    Kind("spatter", "5 to 40 drops of 0.3 to 1 mm", "other-honest", _spatter),
    Kind(
        "flush",
        "ground flush, a uniform step",
        "other-honest",
        _with_cap(_misfit, height_mm=0.0, ripple_mm=0.0, crest=Wander(), width_mm=lambda c: c.uniform(2.0, 8.0)),
    ),
    Kind("small counterbore", "a counterbore 3 to 15 mm long", "other-honest", _counterbore(3.0, 15.0)),
    Kind("benign taper", "a wall machined by a taper of 1:20 to 1:4", "other-honest", _taper(None)),
    Kind(
        "very noisy",
        "point noise of 0.1 to 0.2 mm",
        "other-honest",
        _misfit,
        with_values(noise_mm=lambda c: c.uniform(0.1, 0.2)),
    ),
    Kind(
        "undercut",
        "undercuts of 0.1 to 0.5 mm inside the toes",
        "other-honest",
        _with_cap(
            _misfit,
            undercut_mm=lambda c: tuple(min(c.uniform(0.1, 0.5), 0.1 * c.thickness_mm) for _ in range(2)),
            undercut_width_mm=lambda c: c.uniform(0.8, 2.0),
        ),
    ),
    Kind(
        "low cap",
        "a cap 0.2 to 0.6 mm high",
        "other-honest",
        _with_cap(_misfit, height_mm=lambda c: c.uniform(0.2, 0.6), crest=Wander(0.02, 15.0)),
    ),
    Kind(
        "flat cap",
        "an elliptic or flat cap",
        "other-honest",
        _with_cap(_misfit, power=lambda c: c.uniform(2.0, 6.0), blend=lambda c: c.uniform(0.5, 1.0)),
    ),
    Kind(
        "soft toes",
        "a cap that blends into the walls",
        "other-honest",
        _with_cap(_misfit, blend=lambda c: c.uniform(1.3, 2.0)),
    ),
    Kind(
        "underfilled",
        "a cap below its walls by up to a tenth of the thickness",
        "other-honest",
        _with_cap(
            _misfit, height_mm=lambda c: -c.uniform(0.2, 1.0) * min(1.0, 0.1 * c.thickness_mm), crest=Wander(0.02, 15.0)
        ),
    ),
    # A step over the limit.
    Kind("plain step", "two round pipes, moved too far", "defective", _misfit),
    Kind("taper 1:4", "a wall machined by a taper 1:4", "defective", _taper(0.25)),
    Kind("taper 1:10", "a wall machined by a taper 1:10", "defective", _taper(0.1)),
    Kind("taper 1:20", "a wall machined by a taper 1:20", "defective", _taper(0.05)),
    Kind("counterbore", "a wall machined by a counterbore 10 to 30 mm long", "defective", _counterbore(10.0, 30.0)),
    Kind(
        "flush taper",
        "a taper, the weld ground flush",
        "defective",
        _with_cap(_taper(None), height_mm=0.0, ripple_mm=0.0, crest=Wander(), width_mm=lambda c: c.uniform(2.0, 8.0)),
    ),
    Kind(
        "flush counterbore",
        "a counterbore, the weld ground flush",
        "defective",
        _with_cap(
            _counterbore(10.0, 30.0),
            height_mm=0.0,
            ripple_mm=0.0,
            crest=Wander(),
            width_mm=lambda c: c.uniform(2.0, 8.0),
        ),
    ),
    Kind("flare", "an end bent, decaying over 3 to 6 mm", "defective", _flare),
    Kind(
        "dent",
        "a dent at the seam, 2 to 10 degrees wide, decaying over 6 to 30 mm",
        "defective",
        _dent(2.0, 10.0, (6.0, 30.0)),
    ),
    Kind(
        "bulge",
        "a bulge at the seam, 2 to 10 degrees wide, decaying over 6 to 30 mm",
        "defective",
        _dent(2.0, 10.0, (6.0, 30.0), -1.0),
    ),
    Kind("long dent", "a narrow dent along the whole wall", "defective", _dent(1.5, 4.0, (math.inf, math.inf))),
    Kind(
        "deep dent",
        "a narrow dent 4 to 9 mm deep along the whole wall",
        "defective",
        _deep_dent,
        in_turn(
            pipe_of(150.0, 1220.0, (1.5, 20.0)),
            with_values(target=lambda c: (max(1.05, 4.0 / c.limit), max(1.1, 9.0 / c.limit))),
        ),
    ),
    Kind(
        "two seams",
        "two welds, a ring of 8 to 30 mm between them",
        "defective",
        _ring,
        in_turn(_THIN, with_values(width_mm=lambda c: min(c.uniform(0.4, 0.7) * usual_width(c), 0.15 * c.field_mm))),
    ),
    Kind("coat", "a coat on the reference wall up to 15 to 30 mm from the seam", "defective", _coat),
    Kind("tape", "tape on the other wall", "defective", _tape),
    Kind("dark arc", "4 to 8 degrees are dark, the step is only there", "defective", _in_the_dark, finish=_dark),
    Kind("hardly lit", "2, 4 or 10 degrees are lit, the step is elsewhere", "defective", _hardly_lit, finish=_dark),
    Kind("saturated", "80 to 93 % of the pixels are saturated", "defective", _misfit, finish=_blinded),
    Kind(
        "two pipes",
        "shots of one arc of two pipes",
        "defective",
        _misfit,
        with_values(shots=2, one_arc=True),
        _two_pipes,
    ),
    Kind("oval girth", "a whole girth, one wall out of round", "defective", _oval(2, both=False), _girth),
    Kind("two ovals", "both walls out of round, turned against each other", "defective", _oval(2, both=True)),
    Kind("growing", "the misfit grows along the arc", "defective", _growing),
    Kind("two humps", "a cap of two humps", "defective", _with_cap(_misfit, valley=lambda c: c.uniform(0.35, 0.8))),
    Kind(
        "too wide cap",
        "a cap wider than a weld of that wall can be",
        "defective",
        _misfit,
        in_turn(
            pipe_of(150.0, 1220.0, (2.0, 20.0)),
            with_values(width_mm=lambda c: min(1.25 * c.uniform(1.1, 1.5) * usual_width(c), 0.55 * c.field_mm)),
        ),
    ),
)


KINDS: Mapping[str, Kind] = MappingProxyType({kind.name: kind for kind in _TABLE})
"""All kinds by name."""
