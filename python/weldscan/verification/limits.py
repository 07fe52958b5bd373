"""What a scanner must keep: the limits of `weldscan verify`, from TOML."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from weldscan.errors import InputError
from weldscan.records.fields import explain
from weldscan.records.files import read_toml

# No scanner of a hand's or an arm's reach has a limit of centimetres: those are micrometres.
Limit = Annotated[float, Field(gt=0, le=5, allow_inf_nan=False, strict=True)]
Count = Annotated[int, Field(ge=1, le=1000, strict=True)]


class Positions(BaseModel):
    """How many distinct places in the volume each characteristic needs; VDI/VDE 2634 part 2, from memory."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    pf: Count = 10
    ps: Count = 10
    sd: Count = 7
    f: Count = 6


class VerificationLimits(BaseModel):
    """What a scanner must keep, as `limits.toml` or the section `[verification]` of `cell.toml` has it.

    Lengths are in mm. A characteristic without a limit is measured and not judged.

    Example:
        >>> from weldscan import VerificationLimits
        >>> limits = VerificationLimits(pf_mm=0.15, sd_mm=0.05)
        >>> limits.validity_days, limits.positions.sd
        (365, 7)
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    pf_mm: Limit | None = None
    ps_mm: Limit | None = None
    sd_mm: Limit | None = None
    f_mm: Limit | None = None
    share: Annotated[float, Field(ge=0.95, le=1, strict=True)] = 1.0
    """Share of the points that PF, PS and F are about: 1 (all), 0.997 (VDI/VDE 2634), 0.95 (ISO 10360-13)."""
    decision: Literal["guarded", "simple"] = "guarded"
    """`guarded`: ISO 14253-1, the test value uncertainty is taken off the limit. `simple`: the limit as it stands."""
    positions: Positions = Positions()
    validity_days: Annotated[float, Field(gt=0, le=3660, strict=True)] = 365
    history: Annotated[str, Field(min_length=1)] | None = None
    """The history file, relative to the configuration's folder."""

    @model_validator(mode="before")
    @classmethod
    def _speaks_of_millimetres(cls, given: Any) -> Any:
        for name in given if isinstance(given, Mapping) else ():
            if name not in cls.model_fields:
                known = ", ".join(cls.model_fields)
                raise ValueError(f"{name}: unknown; limits are in mm, and the fields are {known}")
        for name, value in given.items() if isinstance(given, Mapping) else ():
            if name.endswith("_mm") and isinstance(value, int | float) and not isinstance(value, bool) and value > 5:
                raise ValueError(f"{name}: {value:g} mm is no scanner's limit: are these micrometres?")
        return given

    def limit_mm(self, name: str) -> float | None:
        """Of PF, PS, SD or F."""
        limit: float | None = getattr(self, f"{name.lower()}_mm")
        return limit


def read_limits(path: str | os.PathLike[str]) -> VerificationLimits:
    r"""The limits of a TOML file: its section `[verification]`, or the file itself where it has none.

    Args:
        path: `limits.toml` or `cell.toml`. `history` in it comes back relative to the working folder.

    Raises:
        InputError: missing, not TOML, or a field is unknown or out of range; one line that names file and field.

    Example:
        >>> import pathlib, tempfile
        >>> from weldscan import read_limits
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "limits.toml"
        >>> _ = path.write_text("pf_mm = 0.15\nsd_mm = 0.05\n")
        >>> read_limits(path).sd_mm
        0.05
    """
    path = Path(path)
    document = read_toml(path)
    where = str(path)
    if "verification" in document:
        where, document = f"{path}: verification", document["verification"]
    elif {"robot", "camera", "projector", "scan"} & set(document):
        raise InputError(f"{path}: verification: missing; a cell's limits stand in its section [verification]")
    limits = limits_from(document, where)
    if limits.history is None:
        return limits
    return limits.model_copy(update={"history": str(path.parent / limits.history)})


def limits_from(document: Mapping[str, Any] | VerificationLimits | None, where: str = "limits") -> VerificationLimits:
    """Limits given as a mapping, checked."""
    if isinstance(document, VerificationLimits):
        return document
    try:
        return VerificationLimits.model_validate({} if document is None else document)
    except ValidationError as error:
        raise InputError(f"{where}: {explain(error)}") from None
