"""The folder that a scan fills. A shot counts only when it is whole, and one that counted is never lost.

A shot's images go into a hidden folder, each synced; its manifest with their SHA-256 follows; the folder gets its name
by one rename. That rename is the only moment at which a shot comes to be. `session.json` lists the whole shots and is
made anew from them each time, so a scan that was killed anywhere is put right by looking at the folder.
"""

from __future__ import annotations

import contextlib
import hashlib
import shutil
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from pydantic import ValidationError

from weldscan.devices.cameras import Image
from weldscan.errors import InputError
from weldscan.records.files import to_json, whole_folder, write_file, write_synced
from weldscan.records.images import encode_png
from weldscan.records.plan import PLAN, read_plan
from weldscan.records.session import Session, ShotSpec, frame_names
from weldscan.records.shot import SHOT, ShotManifest, read_manifest

try:
    import fcntl
except ImportError:  # Windows: two scans into one folder are then not noticed
    fcntl = None  # type: ignore[assignment]

LOCK, LOG = ".scan.lock", "scan.log"
UNFINISHED = ".*.partial"
"""What a scan that was killed while it wrote may have left."""


class ShotStore:
    """The session folder of one scan."""

    def __init__(self, folder: Path, plan: Session, resume: bool) -> None:
        """Begin a new folder, or go on with one that follows the same plan."""
        self.folder, self.plan = folder, plan
        document = plan.model_dump(mode="json", exclude_none=True, by_alias=True)
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
            for own in (folder / LOCK, folder / LOG):
                if own.exists() and not own.is_file():
                    raise InputError(f"{own}: is no regular file")
            self._lock = (folder / LOCK).open("w")
        try:
            self._begin(None if started else to_json(document))
        except BaseException:
            self._lock.close()
            raise

    def _begin(self, plan: str | None) -> None:
        """Be the only one here, leave the plan, look what is there."""
        if fcntl is not None:
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise InputError(f"{self.folder}: another scan is writing there") from None
        with self._writing():
            for unfinished in self.folder.glob(UNFINISHED):
                unfinished.unlink()
            if plan is not None:
                write_file(self.folder / PLAN, plan)
            self._shots.mkdir(exist_ok=True)
        self.redone: dict[str, str] = {}
        """Shots that were there but not whole, with the reason; they are taken again."""
        self._whole: dict[str, ShotSpec] = {}
        self._look()
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
        names = frame_names(self.plan, shot)
        images = {
            name: image
            for row, stack in zip(names, stacks, strict=True)
            for name, image in zip(row, stack, strict=True)
        }
        for row, white in zip(names, whites, strict=True):
            images[row[0].removesuffix("000.png") + "white.png"] = white
        with whole_folder(self._shots / shot.name) as partial:
            files = {}
            for name, image in images.items():
                data = encode_png(image)
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

    def _look(self) -> None:
        """Find the whole shots; put aside what is none."""
        with self._writing():
            for entry in sorted(self._shots.iterdir()):
                if entry.name.startswith("."):
                    shutil.rmtree(entry, ignore_errors=True)
                    continue
                try:
                    manifest = read_manifest(entry)
                    planned = next((shot for shot in self.plan.shots if shot.name == entry.name), None)
                    if planned is None or manifest.shot.name != entry.name or manifest.shot.of != planned.of:
                        raise InputError(f"{entry}: is no shot of the plan")
                    self._whole[entry.name] = manifest.shot
                except InputError as error:
                    self.redone[entry.name] = str(error)
                    aside = self._shots / f".{entry.name}.damaged"
                    shutil.rmtree(aside, ignore_errors=True)
                    entry.rename(aside)

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
    return all(entry.name in (LOCK, LOG) or entry.match(UNFINISHED) for entry in folder.iterdir())
