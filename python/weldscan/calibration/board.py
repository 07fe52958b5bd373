"""Flat boards: what `--board` says, and where their features are in an image, to a fraction of a pixel.

OpenCV finds the boards; corners of squares are then refined where the gradients point to (Förstner), circles by their
grey-weighted centroid. Board frame: x along a row, y along the columns, mm, the middle of
the features at the origin; seen from the front x, y run as in the image (z goes into the board).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from itertools import product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from weldscan.errors import GeometryError, InputError

Floats = NDArray[np.float64]
Grey = NDArray[np.uint8]

KINDS = ("chessboard", "charuco", "circles", "acircles")
SPELLING = (
    "chessboard:COLSxROWS:SQUAREmm (inner corners), "
    "charuco:COLSxROWS:SQUAREmm:MARKERmm[:DICTIONARY][:legacy] (squares), "
    "circles:COLSxROWS:PITCHmm[:DIAMETERmm] or acircles:COLSxROWS:PITCHmm[:DIAMETERmm] (OpenCV's asymmetric grid)"
)
# Every code of the smaller dictionaries is in the largest one of its size.
DICTIONARIES = ("4X4_1000", "5X5_1000", "6X6_1000", "7X7_1000", "ARUCO_ORIGINAL", "APRILTAG_36H11")
# A board of fewer features cannot be told from dirt, and gives a pose no redundancy.
LEAST_FEATURES = 6


@dataclass(frozen=True)
class Board:
    """A flat board as `--board` names it."""

    kind: str
    columns: int
    rows: int
    pitch_mm: float
    second_mm: float | None = None
    """Side of a marker, or diameter of a circle."""
    dictionary: str | None = None
    legacy: bool = False

    def __str__(self) -> str:
        parts = [self.kind, f"{self.columns}x{self.rows}", f"{self.pitch_mm:g}mm"]
        parts += [f"{self.second_mm:g}mm"] if self.second_mm is not None else []
        parts += [self.dictionary] if self.dictionary else []
        return ":".join(parts + (["legacy"] if self.legacy else []))

    def points_mm(self) -> Floats:
        """All features, (n, 3), in the order of their numbers."""
        columns, rows = (self.columns - 1, self.rows - 1) if self.kind == "charuco" else (self.columns, self.rows)
        x, y = np.meshgrid(np.arange(columns, dtype=np.float64), np.arange(rows, dtype=np.float64))
        if self.kind == "acircles":
            x = 2 * x + y % 2
        points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) * self.pitch_mm
        return np.asarray(points - (points.max(axis=0) + points.min(axis=0)) / 2)


@dataclass(frozen=True, eq=False)
class Seen:
    """A board's features in one image."""

    numbers: NDArray[np.intp]
    """(n,) which of the board's features."""
    pixels: Floats
    """(n, 2)"""
    spacing_px: float
    """From a feature to its neighbour, median."""
    edge_px: float
    """How wide an edge of the board is: contrast over steepest slope, median; NaN where it cannot be told."""
    diameter_px: float = math.nan
    """Of a circle, median."""


def parse_board(text: str) -> Board:
    """The board that a text like `chessboard:9x13:10mm` names.

    Raises:
        InputError: it names none.

    >>> parse_board("chessboard:9x13:10mm").points_mm().shape
    (117, 3)
    """

    def wrong(why: str) -> InputError:
        return InputError(f"board: {text!r}: {why}; known are {SPELLING}")

    kind, *rest = str(text).strip().split(":")
    kind = {"charucoboard": "charuco", "checkerboard": "chessboard", "circle": "circles"}.get(
        kind.lower(), kind.lower()
    )
    if kind not in KINDS:
        raise wrong(f"{kind!r} is no kind of board")
    if len(rest) < 2:
        raise wrong("needs COLSxROWS and a length")
    grid = re.fullmatch(r"(\d{1,3})[xX](\d{1,3})", rest[0])
    if grid is None:
        raise wrong(f"{rest[0]!r} is not COLSxROWS")
    columns, rows = int(grid[1]), int(grid[2])
    lengths: list[float] = []
    words: list[str] = []
    for word in rest[1:]:
        length = re.fullmatch(r"(\d+\.?\d*|\.\d+)\s*(mm)?", word)
        if length is not None and not words:
            lengths.append(float(length[1]))
        else:
            words.append(word)
    if not 1 <= len(lengths) <= (1 if kind == "chessboard" else 2) or not all(0 < v < 1e4 for v in lengths):
        raise wrong("the lengths are not as they should be")
    least = 3 if kind in ("chessboard", "charuco") else 2
    if columns < least or rows < least:
        raise wrong(f"at least {least}x{least} are needed")
    second = lengths[1] if len(lengths) == 2 else None
    if kind == "charuco" and second is None:
        raise wrong("the side of a marker is missing")
    if second is not None and second >= lengths[0] * (2 if kind == "acircles" else 1):
        raise wrong(f"{second:g} mm is not less than {lengths[0]:g} mm")
    legacy = "legacy" in words
    words = [word for word in words if word != "legacy"]
    dictionary = None
    if words and kind == "charuco":
        dictionary = words.pop(0).upper().removeprefix("DICT_")
        if not hasattr(cv2.aruco, f"DICT_{dictionary}") and not hasattr(
            cv2.aruco, f"DICT_{dictionary.replace('H', 'h')}"
        ):
            raise wrong(f"{dictionary!r} is no dictionary of OpenCV's")
    if words or (legacy and kind != "charuco"):
        raise wrong(f"{':'.join(words) or 'legacy'!r} is not understood")
    return Board(kind, columns, rows, lengths[0], second, dictionary, legacy)


def find_board(image: Grey, board: Board) -> Seen:
    """Find a board's features in an evenly lit image.

    Args:
        image: (height, width) uint8.
        board: what to look for.

    Returns:
        Seen, with all features (chessboard, circles) or those in view (ChArUco).

    Raises:
        GeometryError: it is not there; the message says what is, where that can be told.
    """
    if board.kind == "chessboard":
        numbers, pixels = _chessboard(image, board)
        diameter = math.nan
    elif board.kind == "charuco":
        numbers, pixels = _charuco(image, board)
        diameter = math.nan
    else:
        numbers, pixels, diameter = _circles(image, board)
    points = board.points_mm()[numbers]
    spacing = _spacing(points, pixels, board)
    edge = math.nan if board.kind in ("circles", "acircles") else _edge_width(image, points, pixels, board, spacing)
    return Seen(numbers, pixels, spacing, edge, diameter)


def handedness(points_mm: Floats, pixels: Floats) -> float:
    """Determinant of the affine map from the board to pixels, px²/mm²; negative: seen mirrored."""
    rows = np.column_stack([points_mm[:, :2] - points_mm[:, :2].mean(axis=0), np.ones(len(points_mm))])
    return float(np.linalg.det(np.linalg.lstsq(rows, pixels, rcond=None)[0][:2]))


# --- kinds ------------------------------------------------------------------------------------------------------------


def _upright(numbers: NDArray[np.intp], pixels: Floats, board: Board) -> Floats:
    """A chessboard or a grid of circles has no front of its own: number it as seen from the front."""
    points = board.points_mm()[numbers]
    if handedness(points, pixels) >= 0:
        return pixels
    return np.asarray(pixels.reshape(board.rows, board.columns, 2)[:, ::-1].reshape(-1, 2))


def _chessboard(image: Grey, board: Board) -> tuple[NDArray[np.intp], Floats]:
    size = board.columns, board.rows
    classic = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, corners = cv2.findChessboardCorners(image, size, flags=classic | cv2.CALIB_CB_FAST_CHECK)
    for extra in (0, cv2.CALIB_CB_EXHAUSTIVE):
        if not found:
            found, corners = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE | extra)
    if not found:
        raise GeometryError(
            f"no chessboard of {board.columns}x{board.rows} inner corners is in view: out of the image in part, "
            "covered, blurred or of another size?"
        )
    rough = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    half = _half_window(_spacing(board.points_mm(), rough, board))
    fine = cv2.cornerSubPix(image, np.asarray(corners, dtype=np.float32), (half, half), (-1, -1), REFINED)
    pixels = np.asarray(fine, dtype=np.float64).reshape(-1, 2)
    beyond = _goes_on(image, pixels, board, half)
    if beyond is not None:
        raise GeometryError(
            f"the chessboard in view goes on {beyond} of the {board.columns}x{board.rows} inner corners: it is larger"
        )
    return np.arange(len(pixels)), _upright(np.arange(len(pixels)), pixels, board)


# Half of a window that holds a corner's four quadrants and no other corner.
REFINED = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-4)


def _half_window(spacing: float, share: float = 0.35) -> int:
    return max(2, min(int(share * spacing), 15))


def _goes_on(image: Grey, pixels: Floats, board: Board, half: int) -> str | None:
    """On which side of the found corners there is another row of them: the board is larger than was said."""
    grid = pixels.reshape(board.rows, board.columns, 2)
    sides = {
        "left": 2 * grid[:, 0] - grid[:, 1],
        "right": 2 * grid[:, -1] - grid[:, -2],
        "above": 2 * grid[0] - grid[1],
        "below": 2 * grid[-1] - grid[-2],
    }
    typical = np.median([_saddle(image, p, half) for p in pixels])
    for name, places in sides.items():
        # The run of corners along the board's edge is no row of saddles: one quadrant pair is missing there.
        strengths = [_saddle(image, p, half) for p in places]
        if np.median(strengths) > 0.5 * typical:
            return name
    return None


def _saddle(image: Grey, at: Floats, half: int) -> float:
    """How far opposite quadrants are alike and neighbouring ones differ: the second harmonic around a place."""
    turn = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    ring = (at + 0.7 * half * np.column_stack([np.cos(turn), np.sin(turn)])).astype(np.float32)
    if not ((ring >= 0) & (ring <= [image.shape[1] - 1, image.shape[0] - 1])).all():
        return 0.0
    values = cv2.remap(image, ring[None, :, 0], ring[None, :, 1], cv2.INTER_LINEAR)[0].astype(np.float64)
    spectrum = np.abs(np.fft.rfft(values - values.mean()))
    return float(spectrum[2] - spectrum[1] - spectrum[3])


def _charuco(image: Grey, board: Board) -> tuple[NDArray[np.intp], Floats]:
    names = (board.dictionary,) if board.dictionary else DICTIONARIES
    best: tuple[int, NDArray[np.intp], Floats] | None = None
    for name, legacy in product(names, (board.legacy,) if board.legacy else (False, True)):
        found = _charuco_of(image, board, name, legacy)
        if found is not None and (best is None or len(found[0]) > best[0]):
            best = len(found[0]), *found
        if best is not None and best[0] > 0.5 * (board.columns - 1) * (board.rows - 1):
            break
    if best is None or best[0] < LEAST_FEATURES:
        count = 0 if best is None else best[0]
        if any(_charuco_of(np.ascontiguousarray(image[:, ::-1]), board, name, board.legacy) for name in names):
            raise GeometryError("the ChArUco board is mirrored: its markers read only in the mirrored image")
        raise GeometryError(
            f"{count} corners of the ChArUco board {board.columns}x{board.rows} are in view, "
            f"at least {LEAST_FEATURES} are needed"
        )
    return best[1], best[2]


def _charuco_of(image: Grey, board: Board, name: str, legacy: bool) -> tuple[NDArray[np.intp], Floats] | None:
    attribute = f"DICT_{name}"
    if not hasattr(cv2.aruco, attribute):
        attribute = attribute.replace("H", "h")
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, attribute))
    assert board.second_mm is not None
    if dictionary.bytesList.shape[0] < board.columns * board.rows // 2:
        return None
    made = cv2.aruco.CharucoBoard((board.columns, board.rows), board.pitch_mm, board.second_mm, dictionary)
    made.setLegacyPattern(legacy)
    detector = cv2.aruco.CharucoDetector(made)
    parameters = detector.getDetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    detector.setDetectorParameters(parameters)
    corners, ids, _, _ = detector.detectBoard(image)
    if ids is None or len(ids) < LEAST_FEATURES:
        return None
    numbers = np.asarray(ids, dtype=np.intp).ravel()
    rough = np.asarray(corners, dtype=np.float32).reshape(-1, 1, 2)
    spacing = _spacing(board.points_mm()[numbers], np.asarray(rough, dtype=np.float64).reshape(-1, 2), board)
    # The window must hold the corner's four quadrants and nothing of a marker.
    margin = (board.pitch_mm - board.second_mm) / 2 / board.pitch_mm
    half = _half_window(spacing, min(0.35, max(margin, 0.1)))
    fine = cv2.cornerSubPix(image, rough.copy(), (half, half), (-1, -1), REFINED)
    order = np.argsort(numbers)
    return numbers[order], np.asarray(fine, dtype=np.float64).reshape(-1, 2)[order]


def _circles(image: Grey, board: Board) -> tuple[NDArray[np.intp], Floats, float]:
    size = board.columns, board.rows
    grid = cv2.CALIB_CB_ASYMMETRIC_GRID if board.kind == "acircles" else cv2.CALIB_CB_SYMMETRIC_GRID
    parameters: Any = cv2.SimpleBlobDetector.Params()
    parameters.minArea, parameters.maxArea = 20.0, float(image.size / (board.columns * board.rows))
    parameters.minDistBetweenBlobs = 3.0
    for dark, extra in product((True, False), (0, cv2.CALIB_CB_CLUSTERING)):
        parameters.blobColor = 0 if dark else 255
        detector = cv2.SimpleBlobDetector.create(parameters)
        found, centres = cv2.findCirclesGrid(image, size, flags=grid | extra, blobDetector=detector)
        if not found:
            continue
        rough = np.asarray(centres, dtype=np.float64).reshape(-1, 2)
        spacing = _spacing(board.points_mm(), rough, board)
        # Neighbours of an asymmetric grid lie across its diagonals.
        apart = spacing * (math.sqrt(2) if board.kind == "acircles" else 1.0)
        fine = [_centroid(image, centre, apart, dark) for centre in rough]
        if any(blob is None for blob in fine):
            continue
        blobs = np.array([blob for blob in fine if blob is not None])
        numbers = np.arange(len(blobs))
        pixels = blobs[:, :2]
        if board.kind == "circles":
            pixels = _upright(numbers, pixels, board)
        diameter = float(np.median(2 * np.sqrt(blobs[:, 2] / np.pi)))
        return numbers, pixels, diameter
    raise GeometryError(
        f"no grid of {board.columns}x{board.rows} circles is in view: out of the image in part, blurred, "
        "or of another size?"
    )


def _centroid(image: Grey, rough: Floats, spacing: float, dark: bool) -> tuple[float, float, float] | None:
    """Grey-weighted centroid and area of one blob: each pixel counts with the share of it that the blob covers."""
    half = max(2, round(0.48 * spacing))
    x, y = round(float(rough[0])), round(float(rough[1]))
    height, width = image.shape
    if not (half <= x < width - half and half <= y < height - half):
        return None
    patch = image[y - half : y + half + 1, x - half : x + half + 1].astype(np.float64)
    if dark:
        patch = 255 - patch
    high, low = np.quantile(patch, 0.98), np.quantile(patch, 0.1)
    middle = (high + low) / 2
    _, labels = cv2.connectedComponents((patch > middle).astype(np.uint8), connectivity=4)
    label = labels[half, half]
    if label == 0 or not high - low > 4:
        return None
    body = (labels == label).astype(np.uint8)
    inside, outside = patch[body > 0], patch[cv2.dilate(body, np.ones((5, 5), np.uint8)) == 0]
    if outside.size < 8:
        return None
    top, bottom = float(np.median(inside)), float(np.median(outside))
    near = cv2.dilate(body, np.ones((5, 5), np.uint8)) > 0
    share = np.where(near, np.clip((patch - bottom) / max(top - bottom, 1.0), 0, 1), 0)
    v, u = np.mgrid[-half : half + 1, -half : half + 1]
    area = float(share.sum())
    return x + float((share * u).sum()) / area, y + float((share * v).sum()) / area, area


# --- how large, how sharp ---------------------------------------------------------------------------------------------


def _spacing(points_mm: Floats, pixels: Floats, board: Board) -> float:
    """Median distance in pixels of features one pitch apart, by the local scale of the board."""
    rows = np.column_stack([points_mm[:, :2] - points_mm[:, :2].mean(axis=0), np.ones(len(points_mm))])
    affine = np.linalg.lstsq(rows, pixels, rcond=None)[0][:2]
    # The smaller of its two scales: tilted boards are narrow in one direction.
    return float(board.pitch_mm * np.linalg.svd(affine, compute_uv=False).min())


def _edge_width(image: Grey, points_mm: Floats, pixels: Floats, board: Board, spacing: float) -> float:
    """Contrast over steepest slope across the edges between neighbouring corners, median, px."""
    place = {tuple(np.rint(p[:2] / board.pitch_mm * 2).astype(int)): i for i, p in enumerate(points_mm)}
    half = max(3, min(int(0.45 * spacing), 25))
    along = np.linspace(-half, half, 8 * half + 1)
    widths = []
    for (column, row), i in place.items():
        for step in ((2, 0), (0, 2)):
            j = place.get((column + step[0], row + step[1]))
            if j is None:
                continue
            run = pixels[j] - pixels[i]
            across = np.array([-run[1], run[0]]) / max(float(np.linalg.norm(run)), 1e-9)
            line = (pixels[i] + pixels[j]) / 2 + along[:, None] * across
            profile = cv2.remap(
                image, line[None, :, 0].astype(np.float32), line[None, :, 1].astype(np.float32), cv2.INTER_LINEAR
            )[0].astype(np.float64)
            contrast = abs(float(np.median(profile[: half * 2]) - np.median(profile[-half * 2 :])))
            # Over a whole pixel, so that noise makes no slope.
            slope = float(np.abs(profile[4:] - profile[:-4]).max())
            if contrast > 4:
                widths.append(contrast / slope)
    return float(np.median(widths)) if widths else math.nan
