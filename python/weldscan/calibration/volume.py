"""What a scanner's calibration says about points: their uncertainty, and which pose of the board would add most."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from weldscan.calibration.bundle import (
    CAMERA,
    PROJECTOR,
    BundleModel,
    Features,
    Solution,
    inverse_of,
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
    places = np.array([[z, v, u] for z in np.linspace(near, far, 3) for v in (-1, 0, 1) for u in (-1, 0, 1)])
    shares = np.linspace(1.0, 0.0, 41)
    pixels = middle + shares[:, None, None] * reach * places[:, :0:-1]
    points = _rays(model.camera, pixels.reshape(-1, 2)).reshape(*pixels.shape[:2], 3) * places[:, :1]
    seen = _in_image(model, points.reshape(-1, 3), projector_size).reshape(len(shares), -1)
    seen[-1] = True
    return Volume(points[np.argmax(seen, axis=0), np.arange(len(places))])


def _rays(lens: Floats, pixels: Floats) -> Floats:
    """The points (n, 3) at unit depth that a lens images at pixels (n, 2): Newton on the lens."""
    points = np.column_stack([(pixels - lens[2:4]) / lens[:2], np.ones(len(pixels))])
    for _ in range(20):
        seen, _, by_point = project(lens, points)
        points[:, :2] -= np.linalg.solve(by_point[..., :2], (seen - pixels)[..., None])[..., 0]
    return np.asarray(points)


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
    whole, shape = (
        np.sqrt(np.maximum(((each @ covariance) * each).sum(axis=1), 0)).reshape(-1, 3)
        for each in (jacobian, rigid_part(volume.points) @ jacobian)
    )
    return np.asarray(whole), np.asarray(shape)


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
    # Some twenty of the features tell.
    board = board_mm[:: max(1, len(board_mm) // 20)]
    tried = [
        (volume.points[place] * 0.5 + volume.points[13] * 0.5, tilt, around)
        for place in (13, 4, 22, 9, 17, 11, 15)
        for tilt in TILTS_DEG
        for around in (AROUND_DEG if tilt else (0.0,))
    ]
    turns = np.array([_leaning(tilt, around) for _, tilt, around in tried])
    shifts = np.array([target for target, _, _ in tried])
    placed = np.einsum("cab,nb->cna", turns, board) + shifts[:, None]
    ahead = (placed[..., 2] > 0).all(axis=1) & (((placed - model.shift) @ model.turn)[..., 2] > 0).all(axis=1)
    turns, shifts, tried = turns[ahead], shifts[ahead], [each for each, ok in zip(tried, ahead, strict=True) if ok]
    count, each = len(tried), len(board)
    if not count:
        return None
    none = np.zeros((count * each, 2))
    features = Features(
        view=np.repeat(np.arange(count), each),
        board_mm=np.tile(board, (count, 1)),
        camera_px=none,
        projector_px=none,
        slope=np.zeros((len(none), 2, 2)),
        relative_sigma=np.ones(len(none)),
        number=np.tile(np.arange(each), count),
    )
    rows = rows_of(replace(model, turns=turns, shifts=shifts, shape=np.zeros_like(board)), features, shape=False)
    if rows is None:
        return None
    # Nothing was "seen": the residuals are the projections themselves.
    seen = _inside(rows.residuals[:, 0], camera_size) & _inside(rows.raw_projector, projector_size)
    design = np.concatenate([rows.by_lenses, rows.by_pose], axis=3)
    if slopes_known:
        design[:, 1] -= _slope(rows.by_pose) @ design[:, 0]
    gain = len(board_mm) / len(board)
    design *= (math.sqrt(gain) / np.maximum(np.array(solution.sigma_px), 1e-6))[:, None, None] * seen[
        :, None, None, None
    ]
    design = design.reshape(count, 4 * each, 30)
    sums = np.swapaxes(design, 1, 2) @ design
    best: Candidate | None = None
    for k in np.flatnonzero(seen.reshape(count, each).mean(axis=1) >= LEAST_IN_VIEW):
        # What the pose takes up says nothing of the lenses.
        with_pose = sums[k, :24, 24:]
        added = sums[k, :24, :24] - with_pose @ np.linalg.solve(sums[k, 24:, 24:], with_pose.T)
        information = (solution.information + added)[np.ix_(free, free)]
        covariance = np.zeros((24, 24))
        covariance[np.ix_(free, free)] = inverse_of(information)
        value = score(covariance)
        if best is None or value < best.score:
            _, tilt, around = tried[k]
            best = Candidate(rigid(turns[k], shifts[k]), tilt, around, shifts[k], value)
    return best


def _leaning(tilt_deg: float, around_deg: float) -> Floats:
    """How a board stands whose normal leans by a tilt, to the image's right at 0, down at 90."""
    lean = math.radians(around_deg)
    return rotation_of(math.radians(tilt_deg) * np.array([-math.sin(lean), math.cos(lean), 0.0]))


def _inside(pixels: Floats, size: tuple[int, int]) -> NDArray[np.bool_]:
    return np.asarray((pixels >= 0).all(axis=1) & (pixels <= np.array(size) - 1).all(axis=1))


def _slope(by_pose: Floats) -> Floats:
    """How the projector's coordinates change with the camera's pixel: shifts within the board's plane tell."""
    camera, projector = by_pose[:, 0, :, 3:5], by_pose[:, 1, :, 3:5]
    return np.asarray(projector @ np.linalg.inv(camera))
