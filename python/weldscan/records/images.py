"""Images of documents: grey PNGs of 8 or 16 bits."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import decode_png
from weldscan.errors import InputError
from weldscan.records.files import read_bytes

Image: TypeAlias = NDArray[np.uint8] | NDArray[np.uint16]
Frames: TypeAlias = Sequence[Sequence[Image]]
"""Exposures x frames of one shot, each (height, width) uint8 or uint16, all alike."""

MAX_IMAGE_BYTES = 512 * 1024 * 1024
# A file is not larger than its pixels in the widest format, four channels of 16 bits, and some remarks.
PIXEL_BYTES, REMARKS_BYTES = 8, 1024 * 1024
# Camera noise has no repetitions to look for: a Huffman code of the differences is smaller and three times as fast.
PNG_PARAMETERS = [
    *(cv2.IMWRITE_PNG_COMPRESSION, 1),
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY),
    *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP),
]


def read_image(path: Path, size: tuple[int, int] | None = None) -> Image:
    """One grey PNG of 8 or 16 bits, (height, width) uint8 or uint16; strictly, unlike OpenCV (docs/decisions/0002).

    Args:
        path: the file.
        size: (width, height) that it must have, pixels.

    Raises:
        InputError: missing, no regular file, damaged, in colour, of another size; the line names the file.
    """
    most = MAX_IMAGE_BYTES if size is None else PIXEL_BYTES * size[0] * size[1] + REMARKS_BYTES
    data = read_bytes(path, min(most, MAX_IMAGE_BYTES), "image")
    try:
        return decode_png(data, size)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def encode_png(image: Image) -> bytes:
    """The PNG of an image, for its file. Raises `InputError` for what cannot be one."""
    try:
        done, data = cv2.imencode(".png", image, PNG_PARAMETERS)
    except cv2.error:
        done = False
    if not done:
        raise InputError(f"an image of {image.shape} {image.dtype} cannot be encoded")
    return data.tobytes()
