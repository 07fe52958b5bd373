"""The folder that a scan fills. A shot counts only when it is whole, and one that counted is never lost.

A shot's images go into a hidden folder, each synced; its manifest with their SHA-256 follows; the folder gets its name
by one rename. That rename is the only moment at which a shot comes to be. `session.json` lists the whole shots and is
made anew from them each time, so a scan that was killed anywhere is put right by looking at the folder.

Looking changes nothing. A shot that cannot be read stops everything; one that is provably not what was taken is moved
to `set-aside/`, from where weldscan never deletes it.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from pydantic import ValidationError

from weldscan.devices.cameras import Image
from weldscan.errors import InputError, Unreadable
from weldscan.records.files import (
    is_unfinished,
    listed,
    own_file,
    remove_unfinished,
    sync_folder,
    to_json,
    whole_folder,
    write_file,
    write_synced,
)
from weldscan.records.images import encode_png
from weldscan.records.plan import PLAN, read_plan
from weldscan.records.session import Session, ShotSpec, frame_names
from weldscan.records.shot import SHOT, NotUnderstood, ShotManifest, read_manifest

try:
    import fcntl
except ImportError:  # Windows: two scans into one folder are then not noticed
    fcntl = None  # type: ignore[assignment]

LOCK, LOG = ".scan.lock", "scan.log"
ASIDE = "set-aside"
"""Where shots go that are not what was taken, each under its name and a number."""


@dataclass(frozen=True)
class SetAside:
    """A shot that was there and is not what was taken; it is taken again."""

    shot: str
    reason: str
    folder: Path
    """Where it is now. weldscan leaves it alone."""


class ShotStore:
    """The session folder of one scan."""

    def __init__(self, folder: Path, plan: Session, resume: bool, retake: bool = False) -> None:
        """Begin a new folder, or go on with one that follows the same plan.

        Args:
            folder: the session folder.
            plan: that it follows.
            resume: go on with a scan that was begun there.
            retake: set aside whatever is damaged; without this, one shot at most.

        Raises:
            InputError: something else is there, or more than one shot is damaged.
            Unreadable: a shot cannot be read, so that nobody knows whether it is whole. Nothing was touched.
        """
        self.folder, self.plan = folder, plan
        document = plan.model_dump(mode="json", exclude_none=True, by_alias=True)
        for name in ("shots", ASIDE):  # whoever may write beside us does not choose where we write
            if (folder / name).is_symlink():
                raise InputError(f"{folder / name}: is a link, not followed; put the folder itself there")
        started = (folder / PLAN).is_file()
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: exists and is not a folder")
        if started and not resume:
            raise InputError(f"{folder}: holds a scan already; --resume goes on with it")
        if not started and folder.is_dir() and not _only_just_begun(folder):
            raise InputError(f"{folder}: exists and holds something else; name another folder or remove it")
        if started and read_plan(folder / PLAN) != plan:
            raise InputError(f"{folder}: was begun with another plan; finish it with that one, or name another folder")
        with self._writing():
            folder.mkdir(parents=True, exist_ok=True)
            own_file(folder / LOG).close()
            self._lock = own_file(folder / LOCK)
        try:
            self._begin(None if started else to_json(document), retake)
        except BaseException:
            self._lock.close()
            raise

    def _begin(self, plan: str | None, retake: bool) -> None:
        """Be the only one here, look what is there, and only then change anything."""
        if fcntl is not None:
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InputError(f"{self.folder}: another scan is writing there") from None
            except OSError as error:
                raise InputError(f"{self.folder / LOCK}: cannot be locked: {error.strerror or error}") from error
        self._whole, damaged = self._look(retake)
        with self._writing():
            if plan is not None:
                write_file(self.folder / PLAN, plan)
            self._shots.mkdir(exist_ok=True)
            remove_unfinished(self.folder)
            remove_unfinished(self._shots)
            self.set_aside = tuple(self._put_aside(name, reason) for name, reason in damaged.items())
        self._write_session()

    @property
    def whole(self) -> list[ShotSpec]:
        """The shots that count, in the order of the plan."""
        return [self._whole[shot.name] for shot in self.plan.shots if shot.name in self._whole]

    @property
    def missing(self) -> list[ShotSpec]:
        """The shots of the plan that are still to be taken."""
        return [shot for shot in self.plan.shots if shot.name not in self._whole]

    def keep(
        self,
        shot: ShotSpec,
        stacks: Sequence[Sequence[Image]],
        whites: Sequence[Image],
        record: dict[str, Any],
    ) -> None:
        """Make a shot count. When this returns, it is on the disk, whole, and part of the session."""
        images = {
            name: image
            for row, stack, white in zip(self._names(shot), stacks, whites, strict=True)
            for name, image in zip(row, (*stack, white), strict=True)
        }
        with whole_folder(self._shots / shot.name) as partial:
            files = {}
            with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
                for name, data in zip(images, pool.map(encode_png, images.values()), strict=True):
                    write_synced(partial / name, data)
                    files[name] = hashlib.sha256(data).hexdigest()
            manifest = ShotManifest(schema="weldscan-shot/1", shot=shot, files=files, record=record)
            text = manifest.model_dump(mode="json", exclude_none=True, by_alias=True)
            write_synced(partial / SHOT, to_json(text))
        self._whole[shot.name] = shot
        self._write_session()

    def close(self) -> None:
        """Let others write there."""
        self._lock.close()

    @property
    def _shots(self) -> Path:
        return self.folder / "shots"

    def _look(self, retake: bool) -> tuple[dict[str, ShotSpec], dict[str, str]]:
        """Return the whole shots, and of the damaged ones what is wrong with them; change nothing."""
        whole: dict[str, ShotSpec] = {}
        damaged: dict[str, str] = {}
        there = {entry.name: entry for entry in listed(self._shots)}
        for planned in self.plan.shots:
            if planned.name not in there:
                continue
            try:
                whole[planned.name] = self._checked(there[planned.name], planned)
            except (Unreadable, NotUnderstood) as error:
                raise type(error)(
                    f"{error}: nobody knows whether {planned.name} is whole, so nothing was touched; make it readable, "
                    f"or move {there[planned.name]} elsewhere to take it again"
                ) from None
            except InputError as error:
                damaged[planned.name] = str(error)
        if (self.folder / "session.json").is_file() and not self._shots.is_dir() and not retake:
            raise InputError(
                f"{self._shots}: is gone, but session.json lists shots. Is it the right disk? --retake takes them again"
            )
        if len(damaged) > 1 and not retake:
            raise InputError(
                f"{self.folder}: {len(damaged)} shots are not what was taken ({'; '.join(damaged.values())}); nothing "
                f"was touched. Is it the right disk? --retake moves them to {ASIDE} and takes them again"
            )
        return whole, damaged

    def _checked(self, folder: Path, planned: ShotSpec) -> ShotSpec:
        """The shot in a folder, held against its manifest and the plan."""
        manifest = read_manifest(folder)
        shot = manifest.shot
        if (shot.name, shot.of, len(shot.exposures or (1.0,))) != (
            planned.name,
            planned.of,
            len(planned.exposures or (1.0,)),
        ):
            raise InputError(f"{folder / SHOT}: is of another shot than the plan's {planned.name}")
        if missing := {name for row in self._names(shot) for name in row} - manifest.files.keys():
            raise InputError(f"{folder / SHOT}: does not list {min(missing)}")
        return shot

    def _names(self, shot: ShotSpec) -> list[list[str]]:
        """The file names of a shot's images: per exposure its frames, then the white one."""
        rows = frame_names(self.plan, shot)
        return [[*row, f"{row[0].removesuffix('000.png')}white.png"] for row in rows]

    def _put_aside(self, name: str, reason: str) -> SetAside:
        """Move a shot's folder to where nobody touches it."""
        there, aside = self._shots / name, self.folder / ASIDE
        aside.mkdir(exist_ok=True)
        number = next(n for n in itertools.count(1) if not os.path.lexists(aside / f"{name}-{n}"))
        kept = there.rename(aside / f"{name}-{number}")
        sync_folder(aside)
        sync_folder(self._shots)
        return SetAside(name, reason, kept)

    def _write_session(self) -> None:
        """Make `session.json` of the whole shots, as soon as they are a session that can be inspected."""
        document = self.plan.model_dump(mode="json", exclude_none=True, by_alias=True)
        document["shots"] = [shot.model_dump(mode="json", exclude_none=True) for shot in self.whole]
        data = to_json(document)
        with self._writing():
            try:
                Session.model_validate_json(data)
            except ValidationError:
                (self.folder / "session.json").unlink(missing_ok=True)
            else:
                write_file(self.folder / "session.json", data)

    @contextlib.contextmanager
    def _writing(self) -> Any:
        try:
            yield
        except OSError as error:
            raise InputError(f"{self.folder}: cannot be written: {error.strerror or error}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _only_just_begun(folder: Path) -> bool:
    """Whether a folder without a plan holds nothing but what a scan that died at once may have left."""
    return all(entry.name in (LOCK, LOG) or is_unfinished(entry.name) for entry in folder.iterdir())
