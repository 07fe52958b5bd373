"""Pixels for the report: colours, the deviation map, the view of the cloud. NumPy and OpenCV only, to be quick."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from weldscan.result import Label, PartCloud

Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]

# Told apart by everyone, in print as well: they differ in lightness too.
COLOURS = {
    Label.REFERENCE_WALL: "#3f72af",
    Label.OTHER_WALL: "#e8a33d",
    Label.BEAD: "#8b94a1",
    Label.TRANSITION: "#8c1d40",
}
MAP_ROWS = 150
MAP_COLUMNS = 620
# Points that the pictures are made of; more would not be seen.
SPLATS = 250_000
MAP_POINTS = 800_000


def diverging(values: NDArray[np.floating]) -> Bytes:
    """Blue - white - red for -1 .. 0 .. 1, (..., 3) uint8.

    Lightness falls evenly on both sides of zero in OKLab (Ottosson 2020), where equal differences look equal; the two
    hues are those that colour-blind eyes keep apart.
    """
    strength = np.abs(steps := np.linspace(-1, 1, 257))
    hue = np.where(steps < 0, np.radians(255), np.radians(38))
    lightness, chroma = 0.97 - 0.55 * strength, 0.15 * np.sin(np.pi / 1.35 * strength)
    a, b = chroma * np.cos(hue), chroma * np.sin(hue)
    cones = np.stack(
        [
            lightness + 0.3963377774 * a + 0.2158037573 * b,
            lightness - 0.1055613458 * a - 0.0638541728 * b,
            lightness - 0.0894841775 * a - 1.2914855480 * b,
        ]
    )
    to_rgb = [
        [4.0767416621, -3.3077115913, 0.2309699292],
        [-1.2684380046, 2.6097574011, -0.3413193965],
        [-0.0041960863, -0.7034186147, 1.7076147010],
    ]
    linear = np.clip(np.array(to_rgb) @ cones**3, 0, 1)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    table = np.rint(encoded.T * 255).astype(np.uint8)
    colours: Bytes = table[np.rint((np.clip(values, -1, 1) + 1) * 128).astype(np.intp)]
    return colours


def data_uri(image: Bytes) -> str:
    """An RGB or RGBA image as a PNG inside a URL."""
    order = cv2.COLOR_RGBA2BGRA if image.shape[2] == 4 else cv2.COLOR_RGB2BGR
    done, data = cv2.imencode(".png", cv2.cvtColor(image, order), [cv2.IMWRITE_PNG_COMPRESSION, 2])
    if not done:
        raise RuntimeError("OpenCV could not encode a PNG")
    return "data:image/png;base64," + base64.b64encode(data.tobytes()).decode("ascii")


@dataclass(frozen=True)
class Extent:
    """What a deviation map shows: arcs of the seam, degrees, and a stretch of the axis, mm."""

    arcs: tuple[tuple[float, float], ...]
    low_mm: float
    high_mm: float


def deviation_map(cloud: PartCloud, extent: Extent, scale_mm: float) -> list[str]:
    """The mean deviation in cells of angle x axis, one picture per arc, the other wall on top.

    White is zero and full colour +-`scale_mm`; the bead is grey (lighter is higher) and what was not seen transparent.
    """
    total = sum(end - start for start, end in extent.arcs)
    some = slice(None, None, max(1, -(-cloud.label.size // MAP_POINTS)))
    label, axial, angle = cloud.label[some], cloud.axial_mm[some], cloud.angle_deg[some]
    row = ((extent.high_mm - axial) * (MAP_ROWS / (extent.high_mm - extent.low_mm))).astype(np.int32)
    is_bead, deviation = label == Label.BEAD, cloud.deviation_mm[some]
    pictures = []
    for start, end in extent.arcs:
        columns = max(8, round(MAP_COLUMNS * (end - start) / total))
        column = (np.mod(angle - np.float32(start), 360) * (columns / (end - start))).astype(np.int32)
        inside = np.flatnonzero((column < columns) & (row >= 0) & (row < MAP_ROWS) & (label != Label.NONE))
        cell, cells = row[inside] * columns + column[inside], MAP_ROWS * columns
        count = np.bincount(cell, minlength=cells)
        mean = np.bincount(cell, deviation[inside], cells) / np.maximum(count, 1)
        bead = np.bincount(cell[is_bead[inside]], minlength=cells) * 2 > count
        colour = diverging(mean / scale_mm)
        # The bead is no wall: its height would drown the step.
        top = max(float(mean[bead].max()), 1e-9) if bead.any() else 1.0
        colour[bead] = (100 + 120 * np.clip(mean[bead] / top, 0, 1)).astype(np.uint8)[:, None]
        alpha = np.where(count > 0, 255, 0).astype(np.uint8)
        pictures.append(data_uri(np.column_stack([colour, alpha]).reshape(MAP_ROWS, columns, 4)))
    return pictures


def cloud_view(cloud: PartCloud, width: int = 1100, height: int = 480) -> str | None:
    """The cloud from outside the pipe, coloured by label, by a z-buffer and lit from the side; None if it is empty.

    Where the pipe stands is read off the cloud itself: but for the deviation, the position is linear in `axial_mm` and
    in the cosine and sine of `angle_deg`.
    """
    chosen = np.flatnonzero(cloud.label != Label.NONE)
    chosen = chosen[:: max(1, -(-chosen.size // SPLATS))]
    if chosen.size < 100:
        return None
    points, label = cloud.points_mm[chosen], cloud.label[chosen]
    angle = np.radians(cloud.angle_deg[chosen])
    few = slice(None, None, max(1, chosen.size // 4000))
    terms = np.stack([np.ones_like(angle), cloud.axial_mm[chosen], np.cos(angle), np.sin(angle)], axis=1)[few]
    centre, axis, zero, quarter = np.linalg.lstsq(terms.astype(np.float64), points[few], rcond=None)[0]
    axis = axis / np.linalg.norm(axis)

    # From outside the middle of what was seen, a little from the other wall's end.
    outward = points[few].mean(axis=0) - centre
    outward -= axis * (axis @ outward)
    outward /= np.linalg.norm(outward)
    look = -(outward + 0.45 * axis)
    look /= np.linalg.norm(look)
    right = np.cross(look, axis)
    right /= np.linalg.norm(right)
    view = np.stack([right, np.cross(look, right), look], axis=1).astype(np.float32)

    placed = (points - centre).astype(np.float32) @ view
    low, high = placed[:, :2].min(axis=0), placed[:, :2].max(axis=0)
    scale = float(min((width - 40) / (high[0] - low[0] + 1e-6), (height - 40) / (high[1] - low[1] + 1e-6)))
    middle = np.array([width, height]) / 2 - scale * (low + high) / 2

    canvas = np.zeros((height, width, 4), np.uint8)
    _draw_rims(canvas, (axis, zero, quarter), np.percentile(terms[:, 1], (0.5, 99.5)), view, scale, middle)
    colour, alpha = _splat(placed * np.float32(scale), label, middle, (height, width))
    canvas[alpha] = np.dstack([colour, np.full(alpha.shape, 255, np.uint8)])[alpha]
    return data_uri(canvas)


def _draw_rims(
    canvas: Bytes,
    frame: tuple[Floats, Floats, Floats],
    ends: Floats,
    view: NDArray[np.float32],
    scale: float,
    middle: Floats,
) -> None:
    """The whole pipe's two rims, so that one sees how much of it was scanned."""
    axis, zero, quarter = frame
    turn = np.linspace(0, 2 * np.pi, 361)[:, None]
    for end in ends:
        rim = (axis * end + np.cos(turn) * zero + np.sin(turn) * quarter) @ view[:, :2] * scale + middle
        cv2.polylines(canvas, [np.rint(rim * 8).astype(np.int32)], True, (139, 148, 161, 150), 1, cv2.LINE_AA, 3)


def _splat(
    placed: NDArray[np.float32], label: Bytes, middle: Floats, shape: tuple[int, int]
) -> tuple[Bytes, NDArray[np.bool_]]:
    """Colours of the nearest points, shaded by the slope of the depth that they make, and where there are any."""
    height, width = shape
    # Far ones first, so that near ones are written over them; 16 bits are enough to tell, and are sorted by radix.
    near, far = placed[:, 2].min(), placed[:, 2].max()
    order = np.argsort(((far - placed[:, 2]) * (65535 / max(far - near, 1e-6))).astype(np.uint16), kind="stable")
    column, row = (np.rint(placed[order, i] + np.float32(middle[i])).astype(np.int32) for i in (0, 1))
    depth_of, label_of = placed[order, 2], label[order]
    depth, kind = np.zeros(shape, np.float32), np.zeros(shape, np.uint8)
    for down in (0, 1):
        for aside in (0, 1):
            at = (row + down).clip(0, height - 1) * width + (column + aside).clip(0, width - 1)
            depth.reshape(-1)[at], kind.reshape(-1)[at] = depth_of, label_of
    # A point is a dot; the surface between the dots is closed as far as a dot's width.
    filled = cv2.morphologyEx(kind, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    seen = (kind > 0).astype(np.float32)
    blurred = cv2.GaussianBlur(depth * seen, (0, 0), 2.4) / np.maximum(cv2.GaussianBlur(seen, (0, 0), 2.4), 1e-6)
    slope = [cv2.Sobel(blurred, cv2.CV_32F, dx, dy, scale=1 / 8) for dx, dy in ((1, 0), (0, 1))]
    normal = np.dstack([*slope, np.full(shape, -1, np.float32)])
    light = np.array([-0.35, -0.45, -0.80], np.float32)
    lambert = normal @ (light / np.linalg.norm(light)) / np.linalg.norm(normal, axis=2)
    palette = np.zeros((256, 3), np.float32)
    for name, colour in COLOURS.items():
        palette[name] = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    shaded = palette[filled] * (0.45 + 0.65 * np.clip(lambert, 0, 1))[..., None]
    return np.clip(shaded, 0, 255).astype(np.uint8), filled > 0
