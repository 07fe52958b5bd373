"""`weldscan-response/1`: the light of a projector over its level, as a camera saw it.

Written by `weldscan devices check` and by whatever else measures a response, read by whoever corrects for it: a
projector before the light (`response` in its section), an inspection afterwards. This is the one home of the format.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from weldscan.errors import InputError
from weldscan.session import explain, read_text


class Response(BaseModel):
    """`weldscan-response/1`. Levels rise from 0 to 255; `light` is in any unit that is linear, such as grey values."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True, populate_by_name=True)

    schema_: Literal["weldscan-response/1"] = Field(alias="schema")
    level: tuple[float, ...] = Field(min_length=3)
    light: tuple[float, ...] = Field(min_length=3)

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

    def document(self) -> dict[str, Any]:
        """Return what the file holds."""
        return self.model_dump(mode="json", by_alias=True)


def measured(level: ArrayLike, light: ArrayLike) -> Response:
    """Return the response of measured levels and their light. Raises `InputError` for what is no such table.

    >>> measured([0, 128, 255], [10.0, 60.0, 210.0]).table()[[0, 128, 255]]
    array([0.  , 0.25, 1.  ])
    """
    try:
        return Response(
            schema="weldscan-response/1", level=np.asarray(level).tolist(), light=np.asarray(light).tolist()
        )
    except ValidationError as error:
        raise InputError(f"response: {explain(error)}") from None


def read_response(path: Path) -> Response:
    """Read a `weldscan-response/1` file. Raises `InputError`, naming the file and the field."""
    try:
        return Response.model_validate_json(read_text(path))
    except ValidationError as error:
        raise InputError(f"{path}: {explain(error)}") from None
