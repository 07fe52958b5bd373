"""What documents are made of: their fields' types, how one is read into its model, and how a complaint reads.

A complaint is one line that names the file and the field: `open-630/session.json: shots.3.flange_pose.B: NaN is not a
number`.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from weldscan.errors import InputError
from weldscan.records.files import parse_json, read_text

# How far a matrix of a file may be from a rotation: what six printed decimals leave, and no more.
ROTATION_TOLERANCE = 1e-5
# Below this sine of the angle between two directions (0.06 degrees) they are taken for parallel.
PARALLEL_SINE = 1e-3
# More pixels than any camera has: a typing error, or an attempt to exhaust the memory.
MAX_SIDE_PX = 65_535


# A billion of anything (1000 km, for a length) is a typing error, and squares of it still fit into a number.
Real = Annotated[float, Field(ge=-1e9, le=1e9)]
Positive = Annotated[float, Field(gt=0, le=1e9)]
Vector = tuple[Real, Real, Real]
Matrix = tuple[tuple[Real, ...], ...]
Pixels = Annotated[int, Field(ge=1, le=MAX_SIDE_PX)]


def square(size: int) -> Callable[[Matrix], Matrix]:
    def check(matrix: Matrix) -> Matrix:
        if len(matrix) != size or any(len(row) != size for row in matrix):
            raise ValueError(f"should be {size} rows of {size} numbers")
        return matrix

    return check


def _rigid(matrix: Matrix) -> Matrix:
    """A 4x4 rigid transform: orthonormal, right-handed, last row 0 0 0 1."""
    array = np.asarray(square(4)(matrix))
    rotation = array[:3, :3]
    if not np.array_equal(array[3], [0, 0, 0, 1]):
        raise ValueError("the last row should be 0 0 0 1")
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if not off <= ROTATION_TOLERANCE:
        raise ValueError(
            f"the rotation is not orthonormal: off by {off:.2g}, at most {ROTATION_TOLERANCE:g} is accepted"
        )
    if np.linalg.det(rotation) < 0:
        raise ValueError("the rotation is mirrored (its determinant is -1)")
    return matrix


def _camera_matrix(matrix: Matrix) -> Matrix:
    (fx, skew, _), (zero, fy, _), last = square(3)(matrix)
    if not (fx > 0 and fy > 0):
        raise ValueError("the focal lengths K[0][0] and K[1][1] should be positive")
    if skew != 0 or zero != 0 or last != (0, 0, 1):
        raise ValueError("should read [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; skew is not supported")
    return matrix


def _non_zero(vector: Vector) -> Vector:
    if not math.hypot(*vector) > 1e-9:
        raise ValueError("is a zero vector")
    return vector


def _day(text: str) -> str:
    """A date as YYYY-MM-DD."""
    try:
        return date.fromisoformat(text).isoformat()
    except ValueError:
        raise ValueError(f"{text!r} is not a day as YYYY-MM-DD") from None


def _convex(corners: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    """The corners of a convex polygon, in either direction."""
    array = np.asarray(corners)
    sides = np.roll(array, -1, axis=0) - array
    after = np.roll(sides, -1, axis=0)
    turns = sides[:, 0] * after[:, 1] - sides[:, 1] * after[:, 0]
    around = float(np.arctan2(turns, (sides * after).sum(axis=1)).sum())
    if not ((turns >= 0).all() or (turns <= 0).all()) or abs(abs(around) - 2 * math.pi) > PARALLEL_SINE:
        raise ValueError("should be the corners of a convex polygon, in order")
    return corners


def plain_name(name: str) -> str:
    """A name that is also a folder's: it can neither leave the session's folder nor hide in it."""
    if not re.fullmatch(r"[^\W_][\w .+-]{0,99}", name) or name[-1] in ". ":
        raise ValueError(f"{name!r} cannot name a folder: letters, digits, '_', '-', '+', '.' and spaces only")
    return name


def check_covariance(matrix: Matrix, size: int = 6) -> Matrix:
    array = np.asarray(square(size)(matrix))
    # Parameters of different kinds differ by many orders: they are compared as correlations.
    units = np.sqrt(np.maximum(np.diag(array), 0))
    array = array / np.outer(units, units) if (units > 0).all() else array
    scale = float(np.abs(array).max())
    if not np.allclose(array, array.T, atol=1e-9 * scale) or np.linalg.eigvalsh(array).min() < -1e-9 * scale:
        raise ValueError("is not a covariance: it should be symmetric and without negative eigenvalues")
    return matrix


Rigid = Annotated[Matrix, AfterValidator(_rigid)]
CameraMatrix = Annotated[Matrix, AfterValidator(_camera_matrix)]
Polygon = Annotated[tuple[tuple[Real, Real], ...], Field(min_length=3, max_length=1000), AfterValidator(_convex)]
PlainName = Annotated[str, AfterValidator(plain_name)]
Direction = Annotated[Vector, AfterValidator(_non_zero)]
Day = Annotated[str, AfterValidator(_day)]


class Model(BaseModel):
    """What the documents' models have in common: nothing unknown, nothing converted, nothing changed later."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True, strict=True, populate_by_name=True)


M = TypeVar("M", bound=BaseModel)


def read_model(path: Path, model: type[M], fill: Callable[[dict[str, Any]], dict[str, Any]] = lambda it: it) -> M:
    """A JSON file as its model.

    Args:
        path: the file.
        model: of the document.
        fill: puts into the document what stands in other files, before it is checked.

    Raises:
        InputError: it cannot be read, is not JSON, or a field of it is unknown, missing, doubled, out of range or
            contradicts another; one line that names file and field.
    """
    text = read_text(path)
    document = parse_json(text, path)
    filled = fill(document) if isinstance(document, dict) else document
    # What came is checked as it came; JSON has no tuples, which strict models want, but pydantic knows that of a text.
    return parse_model(text if filled is document else json.dumps(filled), model, path)


def parse_model(text: str | bytes, model: type[M], where: Path | str) -> M:
    """A JSON text as its model. Raises `InputError` with one line that names `where` and the field."""
    try:
        return model.model_validate_json(text)
    except ValidationError as error:
        raise InputError(f"{where}: {explain(error)}") from None


def moment(text: str, where: str) -> datetime:
    """A date or time in ISO 8601; UTC where it names no zone."""
    try:
        found = datetime.fromisoformat(text)
    except ValueError:
        raise InputError(f"{where}: {text!r} is not a date as 2026-01-31 or 2026-01-31T12:00:00+00:00") from None
    try:
        return (found.replace(tzinfo=UTC) if found.tzinfo is None else found).astimezone(UTC)
    except (OverflowError, ValueError):
        raise InputError(f"{where}: {text!r} is out of range") from None


def explain(error: ValidationError) -> str:
    """The first complaint of pydantic in one line, as `field.path: what is wrong`, and how many more there are."""
    complaints = error.errors(include_url=False)
    first = complaints[0]
    value = _short(first.get("input"))
    match first["type"]:
        case "missing":
            message = "missing"
        case "extra_forbidden":
            message = "unknown field"
        case "finite_number":
            message = f"{value} is not a number"
        case "value_error":
            message = str(first["ctx"]["error"])
        case "tuple_type" | "list_type":
            message = f"should be a list, not {value}"
        case "model_type" | "model_attributes_type" | "dict_type":
            message = f"should be an object, not {value}"
        case _:
            message = first["msg"].removeprefix("Input ").removeprefix("should be a valid ")
            message = f"should be a valid {message}" if "valid" in first["msg"] else message
            message = f"{message}, not {value}" if message.startswith("should be") else message
    # A union's branch is not part of the field's name.
    where = ".".join(str(step) for step in first["loc"] if str(step) not in ("HandEyeSpec", "constrained-str", "str"))
    more = f" (and {len(complaints) - 1} more)" if len(complaints) > 1 else ""
    return f"{where}: {message}{more}" if where else f"{message}{more}"


def _short(value: Any) -> str:
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "infinity"
    text = json.dumps(value, default=str, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}..."
