"""A plan: a session's document whose poses are where the flange shall go, and what one is made from."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from weldscan.errors import InputError, Unreadable
from weldscan.records.fields import read_model
from weldscan.records.files import check_file, read_json, to_json, write_file
from weldscan.records.hand_eye import HandEyeSpec
from weldscan.records.scanner import ScannerSpec, with_scanner
from weldscan.records.session import ArtefactSpec, FringeSet, RobotSpec, Session, ShotSpec, parse_session

PLAN = "plan.json"
# How a plan for a hand-eye calibration is called: after its session, with this.
NAME = " hand-eye"


def read_plan(path: Path) -> Session:
    """Read a plan: a session document whose poses are where the flange shall go."""
    return parse_session(path)


def planned(folder: Path) -> Session | None:
    """Return the plan that a session folder was scanned by; None where no scan wrote it."""
    path = folder / PLAN
    return read_plan(path) if path.is_file() else None


# --- plans of a hand-eye calibration ----------------------------------------------------------------------------------


class PlanSource(BaseModel):
    """What planning needs of a session or plan; all else in the file is not looked at."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False, frozen=True, strict=True)

    name: str = "hand-eye"
    scanner: ScannerSpec
    fringes: tuple[FringeSet, ...]
    artefact: ArtefactSpec
    robot: RobotSpec | None = None
    hand_eye: HandEyeSpec | str | None = None
    shots: tuple[ShotSpec, ...] = ()


def read_source(path: str | os.PathLike[str]) -> PlanSource:
    """Scanner, fringes and plate from a session folder, its session.json, or a plan.

    Raises:
        InputError: missing, not JSON, a field is wrong, or the plate's centres are not known.
    """
    path = Path(path)
    file = path / "session.json" if path.is_dir() else path
    source = read_model(file, PlanSource, partial(with_scanner, file))
    if source.artefact.centres_base is None:
        raise InputError(
            f"{file}: artefact.centres_base: missing; poses are planned around the plate, so its spheres must be known "
            "to some millimetres"
        )
    return source


def check_plan(path: Path) -> None:
    """Says early what would be in the way of a plan: only an earlier plan for a hand-eye calibration is replaced."""
    check_file(path)
    if not path.exists():
        return
    try:
        ours = str(read_json(path)["name"]).endswith(NAME)
    except Unreadable:
        raise
    except (InputError, KeyError, TypeError):
        ours = False
    # A session's own document has its images beside it.
    if not ours or (path.parent / "shots").exists():
        raise InputError(f"{path}: exists and is no plan of a hand-eye calibration: remove it or name another")


def write_plan(path: Path, plan: Session) -> None:
    """Writes a plan for a hand-eye calibration; the file appears whole or not at all."""
    check_plan(path)
    write_file(path, to_json(plan.model_dump(mode="json", exclude_none=True, by_alias=True)))
