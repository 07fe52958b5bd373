"""The fringe images of a session's shots, read one by one or one ahead."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

from weldscan.errors import InputError
from weldscan.records.images import Image, read_image
from weldscan.records.session import Session, ShotSpec, frame_names


def read_frames(session: Session, shot: ShotSpec) -> list[list[Image]]:
    """The fringe images of one shot: exposures x frames, in the session's order, without the white ones.

    Args:
        session: as `read_session` gave it.
        shot: one of `session.shots`.

    Returns:
        A list per exposure of (height, width) arrays, uint8 or uint16, all of the same depth.

    Raises:
        InputError: an image is missing, damaged, in colour, of another size than the camera, or of another depth than
            the rest; the line names the file, what it is and what it should be.
    """
    return _read_shots(session, [shot])[0]


def iter_frames(session: Session, shots: Iterable[ShotSpec]) -> Iterator[tuple[ShotSpec, list[list[Image]]]]:
    """`read_frames` of one shot after the other; the next shot is read while the caller works on this one."""
    with ThreadPoolExecutor(1) as reader:
        waiting: list[tuple[ShotSpec, Future[list[list[Image]]]]] = []
        for shot in shots:
            waiting.append((shot, reader.submit(read_frames, session, shot)))
            if len(waiting) == 2:
                first, future = waiting.pop(0)
                yield first, future.result()
        for last, future in waiting:
            yield last, future.result()


def _read_shots(session: Session, shots: Sequence[ShotSpec]) -> list[list[list[Image]]]:
    size = session.scanner.camera.width, session.scanner.camera.height
    names = [
        session.folder / "shots" / shot.name / name
        for shot in shots
        for row in frame_names(session, shot)
        for name in row
    ]
    # Inflating takes nearly all the time, and lets go of the interpreter meanwhile.
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        images = iter(list(pool.map(lambda path: read_image(path, size), names)))
    stacks = [[[next(images) for _ in row] for row in frame_names(session, shot)] for shot in shots]
    for shot, exposures in zip(shots, stacks, strict=True):
        depth = exposures[0][0].dtype
        for row, files in zip(exposures, frame_names(session, shot), strict=True):
            for image, name in zip(row, files, strict=True):
                if image.dtype != depth:
                    raise InputError(
                        f"{session.folder / 'shots' / shot.name / name}: is of {image.dtype.itemsize * 8} bits, "
                        f"while the shot's first image is of {depth.itemsize * 8}"
                    )
    return stacks
