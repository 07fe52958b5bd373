"""The one way in and the one way out: whatever is read from outside is opened here, and every file is written here.

In: a regular file of bounded size, opened without waiting, so that neither a pipe nor a device in place of a file does
harm; JSON and TOML of bounded depth, without doubled fields. Out: a file or a folder appears whole or not at all, and
is on the disk before it has its name. Whatever is wrong is an `InputError` in one line that names the file.
"""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import re
import secrets
import shutil
import stat
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, BinaryIO, NoReturn, Self

import numpy as np

from weldscan.errors import InputError, Unreadable

try:
    import fcntl
except ImportError:  # Windows: what killed processes left is then not tidied up
    fcntl = None  # type: ignore[assignment]

MAX_TEXT_BYTES = 16 * 1024 * 1024
MAX_TOML_BYTES = 256 * 1024
MAX_DEPTH = 64
"""Of lists and objects within each other; the deepest document has 7."""
IS_NO_FILE = (errno.ENOTDIR, errno.EISDIR, errno.ELOOP, errno.ENAMETOOLONG, errno.ENXIO)
"""Errors that say of a path what it is; all others, but that there is none, say nothing about what a file holds."""
# A name of so many parts is as deep a document. `tomllib` would take minutes for some 10,000 dots.
DEEP_NAME = re.compile(rf"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){{{MAX_DEPTH}}}""")


# --- in ---------------------------------------------------------------------------------------------------------------


def read_bytes(path: Path, most: int = MAX_TEXT_BYTES, what: str = "file") -> bytes:
    """The contents of a regular file.

    Args:
        path: the file; a link to one is as good.
        most: how many bytes it may have.
        what: it is, for the message where there is none.

    Raises:
        InputError: there is none, it is a pipe, a device or a folder, or it is larger.
        Unreadable: the system does not give it.
    """
    try:
        # Without O_NONBLOCK the opening of a pipe would wait for somebody to write into it.
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0) | getattr(os, "O_BINARY", 0)
        descriptor = os.open(path, flags)
    except FileNotFoundError:
        raise InputError(f"{path}: no such {what}") from None
    except (OSError, ValueError) as error:
        raise unread(path, error) from None
    try:
        found = os.fstat(descriptor)
        if stat.S_ISDIR(found.st_mode):
            raise InputError(f"{path}: cannot be read: {os.strerror(errno.EISDIR)}")
        if not stat.S_ISREG(found.st_mode):
            raise InputError(f"{path}: is no regular file but a pipe, a device or a socket")
        data = b""
        # What says 0 bytes may still have some, and a file may grow while it is read.
        chunk = max(min(found.st_size, most), 1 << 16) + 1
        while found.st_size <= most and len(data) <= most and (part := os.read(descriptor, chunk)):
            data += part
    except OSError as error:
        raise unread(path, error) from None
    finally:
        os.close(descriptor)
    if max(found.st_size, len(data)) > most:
        raise InputError(f"{path}: is larger than {f'{most >> 20} MB' if most >> 20 else f'{most >> 10} kB'}")
    return data


def unread(path: Path, error: OSError | ValueError) -> InputError:
    """What to raise for a file that could not be read: `Unreadable`, unless the error says what is wrong with it."""
    known = isinstance(error, ValueError) or error.errno in IS_NO_FILE
    return (InputError if known else Unreadable)(f"{path}: cannot be read: {_reason(error)}")


def listed(folder: Path) -> list[Path]:
    """What a folder holds, by name; nothing where there is none. Raises `Unreadable`."""
    try:
        return sorted(folder.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise unread(folder, error) from None


def read_text(path: Path, most: int = MAX_TEXT_BYTES, what: str = "file") -> str:
    """The contents of a small text file in UTF-8. Raises `InputError` as `read_bytes` does, and for other bytes."""
    data = read_bytes(path, most, what)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not UTF-8: byte {error.start} is 0x{data[error.start]:02x}") from None


def read_json(path: Path) -> Any:
    """A JSON file as Python's own types. Raises `InputError` as `read_text` and `parse_json` do."""
    return parse_json(read_text(path), path)


def parse_json(text: str, where: Path | str, *, finite: bool = False) -> Any:
    """A JSON text as Python's own types.

    Args:
        text: the document.
        where: it stands, for messages.
        finite: whether NaN and infinity, which are no JSON, are refused here; the models of documents refuse them too,
            and name the field.

    Raises:
        InputError: it is not JSON, nested too deeply, or a field of it is there twice.
    """
    constants: dict[str, Any] = {"parse_constant": _refuse} if finite else {}
    try:
        document = json.loads(text, object_pairs_hook=_no_duplicates, **constants)
    except RecursionError:
        raise InputError(f"{where}: is nested too deeply") from None
    except json.JSONDecodeError as error:
        raise InputError(f"{where}: is not JSON: {error.msg} in line {error.lineno}, column {error.colno}") from None
    except ValueError as error:
        raise InputError(f"{where}: {error}") from None
    return _shallow(document, where)


def read_toml(path: Path, what: str = "file") -> dict[str, Any]:
    """A TOML file as Python's own types.

    Args:
        path: the file.
        what: it is, for the message where there is none.

    Raises:
        InputError: as `read_text` does; it is not TOML, or nested too deeply.
    """
    text = read_text(path, MAX_TOML_BYTES, what)
    if DEEP_NAME.search(text):
        raise InputError(f"{path}: is nested too deeply")
    try:
        document = tomllib.loads(text)
    except RecursionError:
        raise InputError(f"{path}: is nested too deeply") from None
    except ValueError as error:
        raise InputError(f"{path}: not TOML: {error}") from None
    return dict(_shallow(document, path))


def inside(folder: Path, name: str, where: str, what: str = "file", whose: str = "session's folder") -> Path:
    """The file of this name in a folder.

    Args:
        folder: that it must not leave.
        name: as a document has it.
        where: in that document, for the message.
        what: it is.
        whose: the folder is.

    Raises:
        InputError: the name leads out of the folder, or cannot be one.
    """
    try:
        kept = not Path(name).is_absolute() and folder.resolve() in (folder / name).resolve().parents
    except (OSError, RuntimeError, ValueError):  # too long, links in a circle, a NUL in it
        kept = False
    if not kept:
        raise InputError(f"{where}: {name!r} is not a {what} inside the {whose}")
    return folder / name


def _no_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    document = dict(pairs)
    if len(document) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"{next(name for name in names if names.count(name) > 1)}: the field is there twice")
    return document


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is not JSON")


def _shallow(document: Any, where: Path | str) -> Any:
    """The document, unless it is nested beyond `MAX_DEPTH`: what follows, pydantic and json.dumps, may recurse."""
    level = [document]
    for _ in range(MAX_DEPTH):
        level = [child for holder in level for child in _children(holder)]
        if not level:
            return document
    raise InputError(f"{where}: is nested too deeply")


def _children(holder: Any) -> Iterable[Any]:
    return holder.values() if isinstance(holder, dict) else holder if isinstance(holder, list) else ()


def _reason(error: OSError | ValueError) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


# --- out --------------------------------------------------------------------------------------------------------------

CANNOT_SYNC = (errno.EINVAL, errno.ENOTSUP, errno.EBADF)
"""What systems say that do not sync folders."""
CANNOT_WRITE = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EFBIG)


def check_file(path: Path) -> None:
    """Says early that a file cannot be written, before anything is measured for it."""
    if path.is_dir():
        raise InputError(f"{path}: cannot be written: {os.strerror(errno.EISDIR)}")
    _check_folder(path, path.absolute().parent)


def _check_folder(path: Path, folder: Path | None) -> None:
    """Says that what is to go into a folder cannot be written there."""
    if folder is None or not folder.is_dir():
        raise InputError(f"{path}: cannot be written: {folder} is not a folder")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"{path}: cannot be written: {folder} is not a folder that may be written to")


def write_file(path: Path, content: str | bytes) -> None:
    """Gives a file its contents; whoever looks sees the old ones or the new ones, whole, also after a power cut.

    Raises:
        InputError: it cannot be written; what was there is untouched.
    """
    write_files({path: content})


def write_files(contents: Mapping[Path, str | bytes]) -> None:
    """As `write_file`, for files that belong together: none gets its name before the disk has all of them."""
    partials = {path: _sibling(path, "partial") for path in contents}
    path = next(iter(partials))
    try:
        for path, partial in partials.items():
            remove_unfinished(path.parent, path.name)
            write_synced(partial, contents[path])
        for path, partial in partials.items():
            while not _replaced(partial, path):  # it was taken for a dead one's
                write_synced(partial, contents[path])
            sync_folder(path.parent)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {_reason(error)}") from None
    finally:
        for partial in partials.values():
            with contextlib.suppress(OSError):
                partial.unlink(missing_ok=True)


def _replaced(partial: Path, path: Path) -> bool:
    """Gives a finished file its name, if it is still there."""
    with _Claim(partial):
        if not partial.exists():
            return False
        partial.replace(path)
        return True


class whole_folder:
    """A folder that appears complete or not at all: `with whole_folder(path) as partial: ...` fills `partial`.

    What goes into it is written by `write_synced`, so that the disk has it before the folder gets its name.

    Args:
        path: where the folder is to be. It must not exist, or be empty, or be one that `replaces` accepts.
        replaces: says whether an existing folder is an earlier result that the new one may replace.

    Raises:
        InputError: something else is in the way, or it cannot be written.
    """

    def __init__(self, path: Path, replaces: Callable[[Path], bool] = lambda _: False) -> None:
        self.path, self.replaces = (Path(path) if Path(path).name else Path(path).resolve()), replaces
        self.partial = _sibling(self.path, "partial")

    def __enter__(self) -> Path:
        self.check(self.path, self.replaces)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            remove_unfinished(self.path.parent, self.path.name)
            while True:
                self.partial.mkdir()
                self._claim = _Claim(self.partial)
                if self.partial.exists():  # nobody took it for a dead one's before it was claimed
                    return self.partial
                self._claim.release()
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written: {_reason(error)}") from None

    @staticmethod
    def check(path: Path, replaces: Callable[[Path], bool] = lambda _: False) -> None:
        """Says early what would be in the way later."""
        if path.is_symlink() or (path.exists() and not path.is_dir()):
            raise InputError(f"{path}: exists and is not a folder")
        if path.is_dir() and any(path.iterdir()) and not replaces(path):
            raise InputError(f"{path}: exists and holds something else; name another folder or remove it")
        _check_folder(path, next((parent for parent in path.absolute().parents if parent.exists()), None))

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        try:
            if kind is None:
                for folder, _, _ in os.walk(self.partial, onerror=_raise):
                    sync_folder(Path(folder))
                self._swap()
                sync_folder(self.path.parent)
        except OSError as failure:
            raise InputError(f"{self.path}: cannot be written: {_reason(failure)}") from None
        finally:
            shutil.rmtree(self.partial, ignore_errors=True)
            self._claim.release()
        if isinstance(error, OSError) and error.errno in CANNOT_WRITE:
            raise InputError(f"{self.path}: cannot be written: {_reason(error)}") from error
        if isinstance(error, InputError) and str(self.partial) in str(error):
            # What was to be written inside is named by the place where it was to be.
            raise InputError(str(error).replace(str(self.partial), str(self.path))) from error

    def _swap(self) -> None:
        """Moves the old folder aside, the new one in, and only then removes the old."""
        self.check(self.path, self.replaces)
        if not self.path.is_dir():
            self.partial.rename(self.path)
            return
        with _Claim(self.path):
            old = self.path.rename(_sibling(self.path, "old"))
            try:
                self.partial.rename(self.path)
            except OSError:
                old.rename(self.path)
                raise
            finally:
                shutil.rmtree(old, ignore_errors=True)


def write_synced(path: Path, *content: str | bytes | memoryview) -> None:
    """Writes a new file into a folder that is not whole yet, and waits until the disk has it. Raises `OSError`."""
    with path.open("xb") as file:
        for part in content:
            file.write(part.encode() if isinstance(part, str) else part)
        file.flush()
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Waits until the disk has a folder's entries; systems that cannot sync folders do without."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except PermissionError:
        return
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in CANNOT_SYNC:
            raise
    finally:
        os.close(descriptor)


def is_earlier(folder: Path, files: Iterable[str], document: str, schema: str) -> bool:
    """Whether a folder is an earlier result and holds nothing else, so that it may be replaced.

    Args:
        folder: an existing one.
        files: that such a result has, or had.
        document: the one of them that says what it is.
        schema: with which that says it, or how it begins.

    Raises:
        Unreadable: the document is there, but nobody knows what it says.
    """
    if not {entry.name for entry in folder.iterdir()} <= set(files):
        return False
    try:
        return str(read_json(folder / document)["schema"]).startswith(schema)
    except Unreadable:
        raise
    except (InputError, KeyError, TypeError):
        return False


def _sibling(path: Path, suffix: str) -> Path:
    return path.parent / f".{path.name}.{secrets.token_hex(4)}.{suffix}"


UNFINISHED = re.compile(r"\.(?P<name>.+)\.[0-9a-f]{8}\.(?P<what>partial|old)")
"""The names of what is being written, or replaced."""


def is_unfinished(name: str) -> bool:
    """Whether a file or folder of this name is one that is being written, or was when its process died."""
    return UNFINISHED.fullmatch(name) is not None


def remove_unfinished(folder: Path, name: str | None = None) -> None:
    """Tidies up after processes that were killed while they wrote here; what living ones write is left alone.

    Args:
        folder: where.
        name: of the file or folder that was being written; by default any.

    Raises:
        OSError: the folder cannot be listed.
    """
    for entry in folder.iterdir():
        found = UNFINISHED.fullmatch(entry.name)
        if found is None or name not in (None, found["name"]) or entry.is_symlink():
            continue
        with _Claim(entry, wait=False) as claim:
            if not claim.held:
                continue
            if found["what"] == "old" and not os.path.lexists(folder / found["name"]):
                entry.rename(folder / found["name"])  # it was being replaced, and is not
            elif entry.is_dir():
                shutil.rmtree(entry, ignore_errors=True)
            else:
                entry.unlink(missing_ok=True)


class _Claim:
    """Holds a file or folder that is being written, so that others see that its process lives.

    Args:
        path: of the file or folder.
        wait: until it is free; otherwise `held` says whether it was.
    """

    def __init__(self, path: Path, wait: bool = True) -> None:
        self.held, self._descriptor = False, -1
        if fcntl is None:
            return
        with contextlib.suppress(OSError):  # it is gone, or this file system knows no locks: then nobody removes it
            self._descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            self.held = True

    def release(self) -> None:
        """Let others have it."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
        self.held, self._descriptor = False, -1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


def own_file(path: Path) -> BinaryIO:
    """Opens a file of a fixed name to append to, and makes it if need be; never through a link that somebody laid.

    Raises:
        InputError: a link, a folder, a pipe or a device is in its place.
        OSError: it cannot be opened.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    try:
        descriptor = os.open(path, flags, 0o666)
    except OSError as error:
        if error.errno in IS_NO_FILE:
            raise InputError(f"{path}: is no regular file") from None
        raise
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise InputError(f"{path}: is no regular file")
    return os.fdopen(descriptor, "ab")


def _raise(error: OSError) -> NoReturn:
    raise error


def to_json(document: Any) -> str:
    """JSON for people: indented, with innermost lists on one line each; never NaN."""
    text = json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False)
    # No string holds a raw line break, so that what is joined here is white space between values.
    return re.sub(r"\[\n[^\[\]{}\"]*\]", lambda found: "[" + " ".join(found[0][1:-1].split()) + "]", text) + "\n"


def plain(value: Any) -> Any:
    """Python's own types all through, a dataclass by its fields' names, and None for NaN and infinity."""
    if is_dataclass(value):
        value = vars(value)
    if isinstance(value, Mapping):
        return {str(name): plain(item) for name, item in value.items()}
    if isinstance(value, str):
        return str(value)
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, Sequence):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
