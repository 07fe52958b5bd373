"""The welded part of a session, as the drawing has it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from weldscan._weldcore import SeamCourse
from weldscan.records.fields import PARALLEL_SINE, Direction, Model, Positive


def _measured_yet(kind: object) -> object:
    if kind in ("plate", "shell"):
        raise ValueError(f"a {kind} cannot be measured yet, only the girth weld of a pipe ('pipe')")
    return kind


class PartSpec(Model):
    """The welded part, as the drawing has it. Directions are in base, or in the scanner's frame without a robot."""

    kind: Annotated[Literal["pipe"], BeforeValidator(_measured_yet)]
    outside_diameter: Positive
    wall_thickness: Positive
    joint: Annotated[str, Field(min_length=1, max_length=100)]
    axis_base: Direction | None = None
    """From the reference wall to the other wall."""
    zero_base: Direction | None = None
    """The 0 degree mark; angles are right-handed about the axis."""
    other_wall_thickness: Positive | None = None
    """Rated thickness of the other wall, where it differs."""
    machined_after_welding: bool = False
    side: Literal["welding", "opposite"] = "welding"
    """Which side of the joint was scanned."""
    required_coverage_deg: Annotated[float, Field(gt=0, le=360)] | None = None
    """How much of the seam must be seen for a PASS; 360: all of it."""

    @property
    def course(self) -> SeamCourse:
        """How its seam runs, by its rated size."""
        return SeamCourse(self.outside_diameter / 2)

    @model_validator(mode="after")
    def _is_a_pipe(self) -> Self:
        for name in ("wall_thickness", "other_wall_thickness"):
            wall = getattr(self, name)
            if wall is not None and wall >= self.outside_diameter / 2:
                raise ValueError(
                    f"{name}: {wall:g} mm is not less than the outside radius of {self.outside_diameter / 2:g} mm"
                )
        if self.axis_base is not None and self.zero_base is not None:
            axis, zero = np.asarray(self.axis_base), np.asarray(self.zero_base)
            if np.linalg.norm(np.cross(axis, zero)) < PARALLEL_SINE * np.linalg.norm(axis) * np.linalg.norm(zero):
                raise ValueError("zero_base: is parallel to axis_base, so no angle about the axis is defined")
        elif (self.axis_base is None) != (self.zero_base is None):
            absent = "axis_base" if self.axis_base is None else "zero_base"
            raise ValueError(f"{absent}: missing, while the other of axis_base and zero_base is given")
        return self


def course_of(part: Mapping[str, Any]) -> SeamCourse | None:
    """How the seam of a part runs, by its rated size as results keep it; None where no size is known.

    >>> course = course_of({"outside_diameter": 400.0})
    >>> round(course.along_mm(course.at(90.0)), 3)
    314.159
    """
    diameter = part.get("outside_diameter")
    return SeamCourse(diameter / 2) if diameter else None
