"""What is drawn of a scene before its weld is made."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from weldscan.simulated.scenes.scene import FIELD_MM, View, limit_for
from weldscan.simulated.scenes.seen_arc import BIN_DEG
from weldscan.simulated.scenes.welds import Cap, SceneWall, SceneWeld, Wander


@dataclass
class Case:
    """Everything that is drawn before the weld is made."""

    random: np.random.Generator
    seed: int
    diameter_mm: float
    thickness_mm: float
    shots: int
    whole: bool = False
    lean_deg: float = 6.0
    noise_mm: float = 0.03
    sd_mm: float = 0.01
    width_mm: float = 0.0
    height_mm: float = 0.0
    target: tuple[float, float] | None = None
    """Of the largest step, in parts of the limit; by default what the group asks."""
    bins: list[int] = field(default_factory=list)
    views: tuple[View, ...] = ()
    base: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of the walls' misfit: direction, share of it that is a difference of radius, sign of that."""
    reference: SceneWall = field(default_factory=SceneWall)
    other: SceneWall = field(default_factory=SceneWall)
    cap: Cap = field(default_factory=Cap)
    seam_mm: float = 0.0
    seam_wander: Wander = field(default_factory=Wander)
    one_arc: bool = False
    """All shots look at the same place."""
    dark_rad: tuple[float, float] = (0.0, 0.0)

    @property
    def radius_mm(self) -> float:
        return self.diameter_mm / 2

    @property
    def limit(self) -> float:
        return limit_for(self.thickness_mm)

    @property
    def field_mm(self) -> float:
        """Along the pipe: 60 mm for one of 25, as much as the usual scanner sees from 150 on."""
        return float(np.clip(60.0 * (self.diameter_mm / 25.0) ** 0.7, 60.0, FIELD_MM))

    def uniform(self, low: float, high: float) -> float:
        return float(self.random.uniform(low, high))

    def log(self, low: float, high: float) -> float:
        return float(math.exp(self.random.uniform(math.log(low), math.log(high))))

    def sign(self) -> float:
        return float(self.random.choice([-1.0, 1.0]))

    def inside(self, share: float = 0.3) -> float:
        """An angle in the seam that is seen, rad, away from the ends of an arc."""
        if len(self.bins) == 360 // BIN_DEG:
            return math.radians(self.uniform(0.0, 360.0))
        arc = self.arc()
        return math.radians(arc[len(arc) // 2] + self.uniform(-share, share) * BIN_DEG * len(arc))

    def arc(self) -> list[int]:
        """The longest run of bins, in order; its degrees may pass 360."""
        seen = set(self.bins)
        if len(seen) == 360 // BIN_DEG:
            return sorted(seen)
        best: list[int] = []
        for start in (b for b in self.bins if (b - BIN_DEG) % 360 not in seen):
            run = [start]
            while (run[-1] + BIN_DEG) % 360 in seen:
                run.append(run[-1] + BIN_DEG)
            best = max(best, run, key=len)
        return best

    def degrees(self, low: float, high: float, least_mm: float = 5.0) -> float:
        """An angle's width, rad, not shorter than some mm of girth (what can be dented is not narrower)."""
        return max(math.radians(self.uniform(low, high)), least_mm / self.radius_mm)

    def misfit(self, amplitude: float, wall: SceneWall | None = None) -> SceneWall:
        """The other wall moved and widened by an amplitude."""
        at, share, sign = self.base
        wall = self.other if wall is None else wall
        moved = amplitude * (1.0 - share)
        return replace(
            wall,
            radius_difference_mm=wall.radius_difference_mm + sign * amplitude * share,
            offset_mm=(moved * math.cos(at), moved * math.sin(at)),
        )

    def weld(self, **change: Any) -> SceneWeld:
        made = SceneWeld(
            self.radius_mm,
            self.thickness_mm,
            half_length_mm=round(1.1 * self.field_mm, 1),
            reference=self.reference,
            other=self.other,
            cap=self.cap,
            seam_mm=self.seam_mm,
            seam_wander=self.seam_wander,
            seed=self.seed,
        )
        return replace(made, **change)


# What changes a case before its views are set up.


def with_values(**values: Any) -> Callable[[Case], None]:
    def change(case: Case) -> None:
        for name, value in values.items():
            setattr(case, name, value(case) if callable(value) else value)

    return change


def pipe_of(low_mm: float, high_mm: float, thickness: tuple[float, float] = (1.0, 60.0)) -> Callable[[Case], None]:
    def change(case: Case) -> None:
        case.diameter_mm = rounded_diameter(case.log(low_mm, high_mm))
        case.thickness_mm = drawn_thickness(case, *thickness)

    return change


def in_turn(*changes: Callable[[Case], None]) -> Callable[[Case], None]:
    def change(case: Case) -> None:
        for one in changes:
            one(case)

    return change


def usual_width(case: Case) -> float:
    """The widest cap that the preparations of a butt weld give for this wall is about 8 + 1.75 t."""
    return 8.0 + 1.75 * case.thickness_mm


def rounded_diameter(mm: float) -> float:
    return round(mm, 1)


def drawn_thickness(case: Case, low: float = 1.0, high: float = 60.0) -> float:
    """A wall not thinner than a 260th of the diameter (it would not stay round), nor thicker than a quarter."""
    thinnest = max(low, case.diameter_mm / 260.0)
    return round(case.log(thinnest, max(thinnest, min(high, case.diameter_mm / 4.0))), 1)
