"""`weldscan-response/1`: the light of a projector over its level, as a camera saw it.

Written by `weldscan devices check` and `weldscan calibrate response`, read by whoever corrects for it: a projector
before the light (`response` in its section), an inspection afterwards (`--response`). The one home of the format.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from weldscan._weldcore import phase_error_of_harmonics, refuse_masked
from weldscan.errors import GeometryError, InputError
from weldscan.session import explain, read_text

Steps = Annotated[int, Field(ge=3)]
Coefficients = tuple[float, ...]


class FringeResponse(BaseModel):
    """What the fringes of one frequency showed. Blur softens harmonics, so each frequency has its own."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)

    periods: Annotated[float, Field(gt=0)]
    """Over the projector."""
    steps: Steps
    """Of the images that it was seen in."""
    harmonics: Coefficients = ()
    """Amplitude of the second, third ... harmonic of the light over the fundamental's, with its sign; empty where
    nothing was seen."""
    sin_rad: Coefficients = Field(default=(), max_length=16)
    """Where the phase showed it: the error of a measured phase p is the sum of `sin_rad[m - 1] sin(m steps p)`."""
    standard_rad: Coefficients = ()
    """Standard deviations of these coefficients, also where none stands above the noise."""


class Response(BaseModel):
    """`weldscan-response/1`. Levels rise from 0 to 255; `light` is in any unit that is linear, such as grey values."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True, populate_by_name=True)

    schema_: Literal["weldscan-response/1"] = Field(alias="schema")
    level: tuple[float, ...] = Field(min_length=3)
    light: tuple[float, ...] = Field(min_length=3)
    method: Literal["ramp", "harmonics", "phase"] = "ramp"
    """Seen in even images, in the harmonics of fringes of four or more steps, or in the phase error of three."""
    fringes: tuple[FringeResponse, ...] = ()
    """Per frequency; empty for a ramp."""
    date: str | None = None
    """ISO 8601."""
    id: str | None = None
    """A hash of what was measured; `document` writes it, nothing checks it."""

    @model_validator(mode="after")
    def _is_a_table(self) -> Response:
        if len(self.level) != len(self.light):
            raise ValueError(f"light: {len(self.light)} values for {len(self.level)} levels")
        if self.level[0] != 0 or self.level[-1] != 255 or any(np.diff(self.level) <= 0):
            raise ValueError("level: should rise from 0 to 255")
        if not max(self.light) > self.light[0]:
            raise ValueError("light: does not rise from black to white")
        return self

    def table(self) -> NDArray[np.float64]:
        """Return the light of the levels 0 to 255, from 0 to 1: rising, for what falls in a measurement is noise."""
        rising = np.maximum.accumulate(np.interp(np.arange(256), self.level, self.light))
        scaled: NDArray[np.float64] = (rising - rising[0]) / (rising[-1] - rising[0])
        return scaled

    @property
    def gamma(self) -> float:
        """The exponent of the power law that fits best, in logarithms: 1 is linear; NaN where no level says."""
        x, y = np.asarray(self.level) / 255, np.asarray(self.light) - self.light[0]
        y = y / y[-1] if y[-1] > 0 else np.full_like(y, np.nan)
        used = (x > 0.05) & (x < 1) & (y > 0.01)
        if not used.any():
            return math.nan
        return float(np.sum(np.log(x[used]) * np.log(y[used])) / np.sum(np.log(x[used]) ** 2))

    def harmonics(self, count: int = 24) -> Coefficients:
        """Return the harmonics that the table makes of full fringes, over the fundamental, from the second on."""
        points = 4096
        wave = 0.5 + 0.5 * np.cos(2 * np.pi * np.arange(points) / points)
        spectrum = np.fft.rfft(np.interp(255 * wave, np.arange(256), self.table())).real
        return tuple((spectrum[2 : count + 2] / spectrum[1]).tolist())

    def phase_error(self, steps: int, periods: float | None = None) -> Coefficients:
        """Return the error of a measured N-step phase p, as the coefficients of sin(m N p), m = 1, 2 ..., rad.

        Args:
            steps: N.
            periods: of the fringes over the projector; None: full harmonics, not softened by any blur. Fringes that
                were not looked at go by those that were and are nearest in the ratio of the frequencies.

        Raises:
            InputError: fewer than three steps, or a response under which two phases would be measured as one.
        """
        harmonics: Sequence[float] = self.harmonics()
        shown = [f for f in self.fringes if f.harmonics]
        if periods is not None and shown:

            def distance(seen: FringeResponse) -> tuple[float, int]:
                return round(abs(math.log(seen.periods / periods)), 9), abs(seen.steps - steps)

            nearest = min(shown, key=distance)
            if distance(nearest) == (0, 0) and nearest.sin_rad:
                return nearest.sin_rad
            harmonics = nearest.harmonics
        try:
            return tuple(phase_error_of_harmonics(list(harmonics), steps).sin_rad)
        except GeometryError as error:
            raise InputError(f"response: {error}") from None

    def document(self) -> dict[str, Any]:
        """Return what the file holds, with its id."""
        document = self.model_dump(mode="json", by_alias=True, exclude_none=True, exclude={"id", "date"})
        known = {} if self.date is None else {"date": self.date}
        return document | known | {"id": _hash(document)}

    def __repr__(self) -> str:
        return f"Response({self.method}, gamma {self.gamma:.3f}, {len(self.level)} levels, {len(self.fringes)} fringes)"

    __str__ = __repr__


def _hash(document: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()[:12]


def measured(
    level: ArrayLike,
    light: ArrayLike,
    method: Literal["ramp", "harmonics", "phase"] = "ramp",
    fringes: Sequence[FringeResponse] = (),
) -> Response:
    """Return the response of measured levels and their light, dated now. Raises `InputError` for what is no such table.

    >>> measured([0, 128, 255], [10.0, 60.0, 210.0]).table()[[0, 128, 255]]
    array([0.  , 0.25, 1.  ])
    """
    try:
        return Response(
            schema="weldscan-response/1",
            level=np.asarray(level, np.float64).tolist(),
            light=np.asarray(light, np.float64).tolist(),
            method=method,
            fringes=tuple(fringes),
            date=datetime.now(UTC).isoformat(timespec="seconds"),
        )
    except ValidationError as error:
        raise InputError(f"response: {explain(error)}") from None


RAMP_LEVELS = 8
"""A power law through fewer is a guess about what lies between them."""


def response_of_ramp(level: ArrayLike, light: ArrayLike, *, noise: float = 0.0) -> Response:
    """The response that even images of several levels show.

    Args:
        level: of each image, 0 to 255 with both ends, in any order; of repeated ones the mean counts.
        light: mean grey value of each, over pixels that do not saturate.
        noise: standard deviation of a light. By how much the next level may be darker: five times that, at least 1 %
            of the range.

    Raises:
        InputError: fewer than 8 levels, a light that is not finite or falls with the level, white that is clipped.

    Example:
        >>> from weldscan.response import response_of_ramp
        >>> level = [0, 36, 73, 109, 146, 182, 219, 255]
        >>> round(response_of_ramp(level, [10 + 180 * (v / 255) ** 2.2 for v in level]).gamma, 2)
        2.2
    """
    refuse_masked("level", level)
    refuse_masked("light", light)
    levels, lights = np.asarray(level, np.float64), np.asarray(light, np.float64)
    if levels.ndim != 1 or levels.shape != lights.shape:
        raise InputError(f"ramp: {levels.shape} levels for {lights.shape} lights")
    if not np.isfinite(lights).all():
        raise InputError(f"ramp: light: not finite at level {levels[~np.isfinite(lights)][0]:g}")
    at, which = np.unique(levels, return_inverse=True)
    if at.size < RAMP_LEVELS:
        raise InputError(f"ramp: {at.size} levels, at least {RAMP_LEVELS} needed from 0 to 255")
    means = np.bincount(which, lights) / np.bincount(which)
    span = float(means[-1] - means[0])
    if not span > 0:
        raise InputError(f"ramp: light does not rise from black ({means[0]:.1f}) to white ({means[-1]:.1f})")
    fall = np.maximum.accumulate(means) - means
    if fall.max() > max(5 * noise, 0.01 * span):
        raise InputError(
            f"ramp: light falls by {100 * fall.max() / span:.1f} % of its range up to level {at[fall.argmax()]:g}: "
            "images out of order, an automatic exposure, or a display that switches its contrast"
        )
    clipped = at[means >= means[-1] - max(noise, 1e-3 * span)]
    # A display may well clip its own uppermost levels: a table corrects that.
    if clipped.size >= 3 and clipped[0] < 0.8 * 255:
        raise InputError(f"ramp: all levels from {clipped[0]:g} on are equally bright: saturated; expose less")
    return measured(at, means)


def write_response(path: str | os.PathLike[str], response: Response) -> None:
    """Write a `weldscan-response/1` file; an earlier one is replaced. Raises `InputError` where it cannot be."""
    path = Path(path)
    fresh = path.with_name(f".{path.name}.new")
    try:
        fresh.write_text(json.dumps(response.document(), indent=1, allow_nan=False) + "\n", encoding="utf-8")
        fresh.replace(path)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None


def gamma_of_second_harmonic(ratio: float) -> float:
    """Return the power law's exponent whose second harmonic is this part of the fundamental, (g - 1)/(g + 2).

    >>> from weldscan import harmonics_of_gamma
    >>> round(gamma_of_second_harmonic(harmonics_of_gamma(1.8)[0]), 6)
    1.8
    """
    return (1 + 2 * ratio) / (1 - ratio)


def read_response(path: str | os.PathLike[str]) -> Response:
    """Read a `weldscan-response/1` file. Raises `InputError`, naming the file and the field."""
    path = Path(path)
    try:
        return Response.model_validate_json(read_text(path))
    except ValidationError as error:
        raise InputError(f"{path}: {explain(error)}") from None
