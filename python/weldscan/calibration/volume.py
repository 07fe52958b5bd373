"""What a scanner's calibration says about points: their uncertainty, and which pose of the board would add most."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weldscan.calibration.bundle import (
    CAMERA,
    PROJECTOR,
    BundleModel,
    Features,
    Solution,
    project,
    rows_of,
)
from weldscan.geometry import rigid, rotation_of, skew

Floats = NDArray[np.float64]

# The board is asked for at these tilts: below 20 degrees it says little about focal lengths, beyond 45 corners blur.
TILTS_DEG = (0.0, 25.0, 40.0)
AROUND_DEG = tuple(range(0, 360, 45))
# A pose counts as possible when so much of the board is seen by both devices.
LEAST_IN_VIEW = 0.85


def point_jacobian(model: BundleModel, points: Floats, axis: str) -> Floats:
    """How triangulated points (n, 3) move with PARAMETERS, (n, 3, 24): their pixel and projector column are as seen."""
    row = 0 if axis == "x" else 1
    n = len(points)
    _, lens_c, point_c = project(model.camera, points)
    offset = points - model.shift
    _, lens_p, point_p = project(model.projector, offset @ model.turn)
    by_point = point_p[:, row : row + 1] @ model.turn.T
    seen = np.concatenate([point_c, by_point], axis=1)
    by_parameters = np.zeros((n, 3, 24))
    by_parameters[:, :2, CAMERA] = lens_c
    by_parameters[:, 2:, PROJECTOR] = lens_p[:, row : row + 1]
    by_parameters[:, 2:, 18:21] = by_point @ skew(offset)
    by_parameters[:, 2:, 21:24] = -by_point
    return np.asarray(-np.linalg.solve(seen, by_parameters))


def rigid_part(points: Floats) -> Floats:
    """(3n, 3n) projector onto what no motion of all the points together explains."""
    moves = np.zeros((len(points), 3, 6))
    moves[..., :3] = -skew(points - points.mean(axis=0))
    moves[..., 3:] = np.eye(3)
    q, _ = np.linalg.qr(moves.reshape(-1, 6))
    return np.asarray(np.eye(3 * len(points)) - q @ q.T)


@dataclass(frozen=True, eq=False)
class Volume:
    """Places at which the calibration is asked for its uncertainty: 27, of which the middle and eight corners show."""

    points: Floats
    """(27, 3), scanner frame: near to far, then image rows, then columns."""

    SHOWN = (13, 0, 2, 6, 8, 18, 20, 24, 26)
    NAMES = (
        "middle",
        *(
            f"{depth}, {row} {column}"
            for depth in ("near", "far")
            for row in ("top", "bottom")
            for column in ("left", "right")
        ),
    )


def volume_of(model: BundleModel, f: Features, projector_size: tuple[int, int]) -> Volume:
    """The volume that the boards filled: from the nearest to the furthest feature, as wide as the camera saw features.

    Corners are drawn in towards the middle until the projector sees them as well.
    """
    depth = np.einsum("nab,nb->na", model.turns[f.view], f.board_mm)[:, 2] + model.shifts[f.view][:, 2]
    near, far = (float(v) for v in np.quantile(depth, (0.02, 0.98)))
    low, high = np.quantile(f.camera_px, (0.01, 0.99), axis=0)
    middle, reach = (low + high) / 2, (high - low) / 2
    out = []
    for z in np.linspace(near, far, 3):
        for v in (-1, 0, 1):
            for u in (-1, 0, 1):
                for share in np.linspace(1.0, 0.0, 41):
                    pixel = middle + share * reach * np.array([u, v])
                    point = _on_ray(model.camera, pixel, z)
                    if share == 0 or _in_image(model, point[None], projector_size)[0]:
                        out.append(point)
                        break
    return Volume(np.array(out))


def _on_ray(lens: Floats, pixel: Floats, z: float) -> Floats:
    """The point at a depth that a lens images at a pixel: Newton on the lens."""
    point = np.array([(pixel[0] - lens[2]) / lens[0], (pixel[1] - lens[3]) / lens[1], 1.0])
    for _ in range(20):
        seen, _, by_point = project(lens, point[None])
        point[:2] -= np.linalg.lstsq(by_point[0, :, :2], seen[0] - pixel, rcond=None)[0]
    return np.asarray(point * z)


def _in_image(model: BundleModel, points: Floats, size: tuple[int, int]) -> NDArray[np.bool_]:
    inside = (points - model.shift) @ model.turn
    ahead = inside[:, 2] > 0
    pixels, _, _ = project(model.projector, np.where(ahead[:, None], inside, [0.0, 0.0, 1.0]))
    return np.asarray(ahead & (pixels >= 0).all(axis=1) & (pixels <= np.array(size) - 1).all(axis=1))


def uncertainties(model: BundleModel, volume: Volume, covariance: Floats, axis: str) -> tuple[Floats, Floats]:
    """Standard uncertainties of the volume's points, (27, 3): in the scanner's frame, and of their shape alone.

    The scanner's frame is its camera's, and where exactly that looks is the least known of all; whatever places the
    scanner (the hand-eye) takes a common motion of all points up. What is left of it is the shape.
    """
    jacobian = point_jacobian(model, volume.points, axis).reshape(-1, 24)
    whole = jacobian @ covariance @ jacobian.T
    free = rigid_part(volume.points)
    shape = free @ whole @ free
    return tuple(np.sqrt(np.maximum(np.diag(c), 0)).reshape(-1, 3) for c in (whole, shape))  # type: ignore[return-value]


@dataclass(frozen=True, eq=False)
class Candidate:
    """A pose of the board that could be added."""

    camera_from_board: Floats
    tilt_deg: float
    around_deg: float
    """Which way the board's normal leans in the image: 0 to the right, 90 down."""
    point_mm: Floats
    score: float
    """What it makes of the score (`best_pose`)."""


def best_pose(
    solution: Solution,
    board_mm: Floats,
    volume: Volume,
    slopes_known: bool,
    camera_size: tuple[int, int],
    projector_size: tuple[int, int],
    score: Callable[[Floats], float],
) -> Candidate | None:
    """The pose of the board, among those that both devices can see, that lowers a score of the covariance most.

    Args:
        solution: the calibration so far.
        board_mm: the board's features.
        volume: where to put it.
        slopes_known: features come from images, so that the corner's error is in both devices.
        camera_size: width, height.
        projector_size: width, height.
        score: of a (24, 24) covariance.
    """
    model, free = solution.model, solution.free
    best: Candidate | None = None
    step = max(1, len(board_mm) // 40)
    board = board_mm[::step]
    gain = len(board_mm) / len(board)
    sigma = np.maximum(np.array(solution.sigma_px), 1e-6)
    for place in (13, 4, 22, 9, 17, 11, 15):
        target = volume.points[place] * 0.5 + volume.points[13] * 0.5
        for tilt in TILTS_DEG:
            for around in AROUND_DEG if tilt else (0.0,):
                lean = math.radians(around)
                turn = rotation_of(math.radians(tilt) * np.array([-math.sin(lean), math.cos(lean), 0.0]))
                trial = BundleModel(
                    model.camera,
                    model.projector,
                    model.turn,
                    model.shift,
                    turn[None],
                    target[None],
                    np.zeros_like(board),
                )
                features = Features(
                    np.zeros(len(board), dtype=np.intp),
                    board,
                    np.zeros((len(board), 2)),
                    np.zeros((len(board), 2)),
                    np.zeros((len(board), 2, 2)),
                    np.ones(len(board)),
                    np.arange(len(board)),
                )
                rows = rows_of(trial, features)
                if rows is None:
                    continue
                seen = _inside(rows.residuals[:, 0], camera_size) & _inside(rows.raw_projector, projector_size)
                if seen.mean() < LEAST_IN_VIEW:
                    continue
                by_lenses, by_pose = rows.by_lenses[seen], rows.by_pose[seen]
                if slopes_known:
                    slope = _slope(by_pose)
                    by_lenses[:, 1] -= slope @ by_lenses[:, 0]
                    by_pose[:, 1] -= slope @ by_pose[:, 0]
                scale = (math.sqrt(gain) / sigma)[None, :, None, None]
                g, p = (by_lenses * scale).reshape(-1, 24), (by_pose * scale).reshape(-1, 6)
                b, c = g.T @ p, p.T @ p
                added = (g.T @ g - b @ np.linalg.solve(c, b.T))[np.ix_(free, free)]
                information = solution.information[np.ix_(free, free)] + added
                size = np.sqrt(np.diag(information))
                covariance = np.zeros((24, 24))
                covariance[np.ix_(free, free)] = np.linalg.inv(information / np.outer(size, size)) / np.outer(
                    size, size
                )
                value = score(covariance)
                if best is None or value < best.score:
                    best = Candidate(rigid(turn, target), tilt, around, target, value)
    return best


def _inside(pixels: Floats, size: tuple[int, int]) -> NDArray[np.bool_]:
    return np.asarray((pixels >= 0).all(axis=1) & (pixels <= np.array(size) - 1).all(axis=1))


def _slope(by_pose: Floats) -> Floats:
    """How the projector's coordinates change with the camera's pixel: shifts within the board's plane tell."""
    camera, projector = by_pose[:, 0, :, 3:5], by_pose[:, 1, :, 3:5]
    return np.asarray(projector @ np.linalg.inv(camera))
