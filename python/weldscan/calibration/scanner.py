"""The scanner's own calibration: both lenses and camera_from_projector, from captures of a flat board at several poses.

    images ─ decode both axes ─> board's features in the camera ─ phase at them ─> both devices' pixels
    ─ OpenCV ─> a start ─ one robust adjustment ─> lenses, relation, covariance ─> points, warnings, the next pose

`docs/calibration.md` has the formulas.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from weldscan._weldcore import refuse_masked
from weldscan.calibration import bundle, volume
from weldscan.calibration.board import LEAST_FEATURES, Board, find_board, handedness, parse_board
from weldscan.calibration.captures import Stack, phases_at, read_stack, saturated_share
from weldscan.calibration.standard_weld import standard_weld
from weldscan.errors import GeometryError, InputError
from weldscan.geometry import rigid
from weldscan.records.capture import MANIFEST, Captures, PoseSpec, read_captures
from weldscan.result import BoardPose, CalibratedHull, NextPose, ScannerCalibration, VolumePoint

Floats = NDArray[np.float64]
Progress = Callable[[int, int, str], None]

# Zhang's equations have two per pose and four unknowns per device; the third pose makes up for one that is parallel.
LEAST_POSES = 3
# What of a feature's surroundings the phase is fitted over: up to where the next feature's begin.
NEIGHBOURHOOD = 0.4
# Known worse than this (k = 1), a focal length is not determined to a per cent (k = 2). The same for the image's
# width in a principal point, and for the bend at the image's corner in what the distortion does.
LEAST_KNOWN = 0.005
PRINCIPAL_POINT_SHARE = 0.02
BEND_SHARE = 0.02
VALID_DAYS = 365
# A lens in focus spreads an edge over two to three pixels.
BLURRED_PX = 5.0
SATURATED_SHARE = 0.05
MISSING_SHARE = 0.1
REJECTED_SHARE = 0.05
LEAST_COVERAGE = 0.5
PARALLEL_DEG = 10.0
# So much noise makes of a flat board whose shape is solved for.
FLAT_MM = 0.003
# Above this the poses contradict each other by more than chance does.
CONTRADICTION = 3.0
# `inspect` bars PASS where less of a wall lies inside the hull of the calibrated pixels.
LEAST_INSIDE = 0.8
FIELDS = (8, 6)


@dataclass(frozen=True, eq=False)
class BoardView:
    """What both devices saw of a flat board at one pose.

    `camera_px` and `projector_px` with independent errors, unless `slope` says how the projector's coordinates change
    with the camera's pixel: then they were read from the phase where the camera saw the feature, and its error is in
    both.
    """

    name: str
    board_mm: Floats
    """(n, 3), z = 0."""
    camera_px: Floats
    """(n, 2), pixel centres at integers."""
    projector_px: Floats
    """(n, 2); NaN where there is no phase."""
    slope: Floats | None = None
    """(n, 2, 2), d projector / d camera."""
    sigma_px: Floats | None = None
    """(n,) of the projector's coordinates, relative to each other; absent: all alike."""
    edge_px: float = math.nan
    diameter_mm: float | None = None
    """Of the circles whose centroids the features are: then their perspective bias is taken out."""


def calibrate_scanner(
    folder: str | os.PathLike[str],
    board: str | Board | None = None,
    *,
    k3: bool = False,
    board_shape: bool | None = None,
    temperature_c: float | None = None,
    valid_days: int = VALID_DAYS,
    progress: Progress | None = None,
) -> ScannerCalibration:
    """Both lenses and camera_from_projector, from a folder of captures of a flat board under fringes along both axes.

    Args:
        folder: `weldscan-calibration/1` (docs/formats.md), or SLStudio's calseq folders.
        board: as `parse_board` reads it, `chessboard:9x13:10mm` for one; absent: what calibration.json says.
        k3: solve for the third radial term of both lenses; 0 otherwise.
        board_shape: solve for how the board departs from its drawing; absent: where its residuals repeat.
        temperature_c: for the record; absent: what calibration.json says.
        valid_days: after how many days `inspect` says that the calibration is out of date.
        progress: called with (done, total, what).

    Returns:
        ScannerCalibration: parameters with their covariance, the uncertainty of points, residuals per pose, warnings.
        Parameters that the poses do not determine are named in `undetermined` and in `warnings`.

    Raises:
        InputError: a file, a field or the board is wrong, images are missing, axes are exchanged or images mirrored.
        GeometryError: fewer than three poses can be used; the message says why, pose by pose.

    Source: Z. Zhang, IEEE TPAMI 22 (2000) 1330; S. Zhang, P. Huang, Opt. Eng. 45 (2006) 083601. docs/calibration.md.
    """
    tell = progress or (lambda done, of, what: None)
    captures = read_captures(folder)
    wanted = _board_of(captures, board)
    temperature = captures.spec.temperature_c if temperature_c is None else temperature_c
    if valid_days < 1:
        raise InputError(f"valid_days: {valid_days}, should be at least 1")
    views: list[BoardView] = []
    left_out: list[tuple[str, str]] = []
    warnings: list[str] = []
    size: tuple[int, int] | None = None
    first: Stack | None = None
    for number, pose in enumerate(captures.poses):
        tell(number, len(captures.poses) + 1, pose.name)
        stack = read_stack(captures, pose, size)
        size, first = stack.size, first or stack
        try:
            view, said = _view(pose, stack, wanted)
        except GeometryError as error:
            left_out.append((pose.name, str(error)))
        else:
            views.append(view)
            warnings += said
    tell(len(captures.poses), len(captures.poses) + 1, "adjustment")
    where = captures.folder
    if not views and first is not None and wanted.kind == "chessboard":
        other = _other_size(first, wanted)
        if other is not None:
            raise InputError(
                f"board: no pose shows a chessboard of {wanted.columns}x{wanted.rows} inner corners, "
                f"but one of {other[0]}x{other[1]} is in view"
            )
    if len(views) < LEAST_POSES:
        why = "; ".join(f"{name}: {reason}" for name, reason in left_out)
        raise GeometryError(
            f"{where}: {len(views)} of {len(captures.poses)} poses can be used, at least {LEAST_POSES} with different "
            f"tilts are needed{f' ({why})' if why else ''}"
        )
    assert size is not None
    projector = captures.spec.projector.width, captures.spec.projector.height
    found = solve_scanner(
        views,
        size,
        projector,
        board=str(wanted),
        k3=k3,
        board_shape=board_shape,
        temperature_c=temperature,
        valid_days=valid_days,
    )
    return replace(found, left_out=tuple(left_out) + found.left_out, warnings=(*warnings, *found.warnings))


def solve_scanner(
    views: Sequence[BoardView],
    camera_size: tuple[int, int],
    projector_size: tuple[int, int],
    *,
    board: str = "",
    k3: bool = False,
    board_shape: bool | None = None,
    temperature_c: float | None = None,
    valid_days: int = VALID_DAYS,
    date: datetime | None = None,
) -> ScannerCalibration:
    """Both lenses and camera_from_projector from what both devices saw: one robust adjustment over all views.

    Args:
        views: at least three, of a flat board at different tilts.
        camera_size: width, height.
        projector_size: width, height.
        board: its name, for the record.
        k3: solve for the third radial term of both lenses.
        board_shape: solve for how the board departs from its drawing; absent: where its residuals repeat.
        temperature_c: for the record.
        valid_days: how long it is valid.
        date: of the calibration; now, by default.

    Returns:
        ScannerCalibration.

    Raises:
        InputError: a view's arrays are not as described, or the two devices see the board from different sides.
        GeometryError: fewer than three views, or they contradict each other.

    Example:
        >>> import numpy as np
        >>> from weldscan import BoardView, solve_scanner
        >>> from weldscan.calibration.board import parse_board
        >>> from weldscan.simulated import make_scanner, tilted_views
        >>> truth, board = make_scanner(), parse_board("chessboard:8x11:8mm").points_mm()
        >>> views = []
        >>> for i, board_from_camera in enumerate(tilted_views(np.eye(4), 6)):
        ...     points = (board - board_from_camera[:3, 3]) @ board_from_camera[:3, :3]
        ...     both = truth.camera.project(points), truth.project_to_projector(points)
        ...     views.append(BoardView(f"view {i}", board, *both))
        >>> found = solve_scanner(views, (1280, 960), (1280, 800))
        >>> abs(found.baseline_mm - truth.baseline_mm) < 1e-3, found.undetermined
        (True, ())
    """
    checked = [_checked(view) for view in views]
    if len(checked) < LEAST_POSES:
        raise GeometryError(
            f"{len(checked)} poses of the board, at least {LEAST_POSES} with different tilts are needed"
        )
    _same_hand(checked)
    linked = any(view.slope is not None for view in checked)
    f = _features(checked)
    first = bundle.start(f, camera_size, projector_size)
    priors = bundle.prior_sigmas(first, camera_size, projector_size)
    rough = bundle.solve(f, first, priors, k3=k3, rough=True)
    for _ in range(2 if any(view.diameter_mm for view in checked) else 0):
        f = _without_bias(_features(checked), checked, rough.model)
        rough = bundle.solve(f, rough.model, priors, k3=k3, rough=True)
    if board_shape or (board_shape is None and bundle.repeats(f, rough)):
        solved = bundle.solve_with_board(f, rough)
    else:
        solved = bundle.solve(f, rough.model, priors, k3=k3)
    return _result(checked, f, solved, linked, camera_size, projector_size, board, temperature_c, valid_days, date)


# --- from images to views ---------------------------------------------------------------------------------------------


def _board_of(captures: Captures, board: str | Board | None) -> Board:
    """The board that was told, here or there; both must agree."""
    told = None if captures.spec.board is None else parse_board(captures.spec.board)
    given = parse_board(board) if isinstance(board, str) else board
    if given is None and told is None:
        raise InputError(f"{captures.folder / MANIFEST}: board: missing, and none was given (chessboard:9x13:10mm ...)")
    if given is not None and told is not None and given != told:
        raise InputError(f"board: {given} was given, but {captures.folder / MANIFEST} says {told}")
    wanted = given or told
    assert wanted is not None
    return wanted


def _view(pose: PoseSpec, stack: Stack, board: Board) -> tuple[BoardView, list[str]]:
    """One pose: the board in the camera's image, the phase at its features; and what is not good about it."""
    saturated = float(np.mean(np.asarray(stack.columns.reason) == 2))
    try:
        seen = find_board(stack.white, board)
    except GeometryError as error:
        if saturated > SATURATED_SHARE:
            raise GeometryError(f"{error} ({saturated:.0%} of the image is saturated)") from None
        raise
    field, sigma = stack.projector()
    points = board.points_mm()[seen.numbers]
    phases = phases_at(field, sigma, seen.pixels, NEIGHBOURHOOD * seen.spacing_px)
    with_phase = np.isfinite(phases.projector_px).all(axis=1)
    around = saturated_share(stack, seen, board)
    if with_phase.sum() < LEAST_FEATURES:
        counts = [int(a) + int(b) for a, b in zip(stack.columns.counts, stack.rows.counts, strict=True)]
        total = sum(counts)
        reasons = ", ".join(
            f"{100 * count / total:.0f} % {name}"
            for name, count in zip(("dark", "saturated", "order in doubt", "no fit"), counts[1:], strict=True)
            if count
        )
        raise GeometryError(
            f"the board is in view, but {int(with_phase.sum())} of its {len(points)} features have a phase along both "
            f"axes (pixels: {reasons})"
        )
    warnings: list[str] = []
    if around > SATURATED_SHARE:
        warnings.append(f"{pose.name}: {around:.0%} of the board is saturated: expose less")
    if seen.edge_px > BLURRED_PX:
        warnings.append(f"{pose.name}: the image is blurred: edges are {seen.edge_px:.1f} px wide")
    missing = 1 - float(with_phase.mean())
    if missing > MISSING_SHARE:
        warnings.append(
            f"{pose.name}: {int((~with_phase).sum())} of {len(points)} features have no phase and count for the camera "
            "alone"
        )
    diameter = None
    if board.kind in ("circles", "acircles"):
        scale = seen.spacing_px / board.pitch_mm
        diameter = board.second_mm or seen.diameter_px / scale
    spread = phases.sigma_px.copy()
    spread[~with_phase] = np.nan
    view = BoardView(pose.name, points, seen.pixels, phases.projector_px, phases.slope, spread, seen.edge_px, diameter)
    return view, warnings


def _other_size(stack: Stack, board: Board) -> tuple[int, int] | None:
    """The chessboard that is in view instead, if it is nearly as large."""
    sizes = [(board.columns + i, board.rows + j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]
    for columns, rows in sorted(sizes, key=lambda s: -s[0] * s[1]):
        if columns < 3 or rows < 3:
            continue
        try:
            find_board(stack.white, replace(board, columns=columns, rows=rows))
        except GeometryError:
            continue
        return columns, rows
    return None


def _without_bias(f: bundle.Features, views: Sequence[BoardView], model: bundle.BundleModel) -> bundle.Features:
    """Features moved from the centroids of imaged circles to the images of their centres (J. Heikkilä, TPAMI 22, 2000).

    The centroid of a circle's image is taken of its outline, a polygon of 64 corners seen through the lens.
    """
    turn = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    outline = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(64)])
    camera, projector = f.camera_px.copy(), f.projector_px.copy()
    for i, view in enumerate(views):
        if not view.diameter_mm:
            continue
        mine = np.flatnonzero(f.view == i)
        points = f.board_mm[mine]
        around = points[:, None] + outline * (view.diameter_mm / 2)
        seen, _, _ = bundle.project(model.camera, around.reshape(-1, 3) @ model.turns[i].T + model.shifts[i])
        middle, _, _ = bundle.project(model.camera, points @ model.turns[i].T + model.shifts[i])
        x, y = np.moveaxis(seen.reshape(-1, 64, 2) - middle[:, None], 2, 0)
        x1, y1 = np.roll(x, -1, axis=1), np.roll(y, -1, axis=1)
        cross = x * y1 - x1 * y
        area = cross.sum(axis=1)
        bias = np.column_stack([((x + x1) * cross).sum(axis=1), ((y + y1) * cross).sum(axis=1)]) / (3 * area[:, None])
        camera[mine] -= bias
        projector[mine] -= np.einsum("nab,nb->na", f.slope[mine], bias)
    return replace(f, camera_px=camera, projector_px=projector)


# --- from views to the result -----------------------------------------------------------------------------------------


def _array(value: ArrayLike, shape: tuple[int, ...], what: str, *, gaps: bool = False) -> Floats:
    refuse_masked(what, value)
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{what}: is not an array of numbers") from None
    if array.shape != shape:
        raise InputError(f"{what}: has the shape {array.shape}, not {shape}")
    if not gaps and not np.isfinite(array).all():
        raise InputError(f"{what}: {int((~np.isfinite(array)).sum())} numbers are not finite")
    return array


def _checked(view: BoardView) -> BoardView:
    n = len(view.camera_px)
    name = f"view {view.name!r}"
    if n < LEAST_FEATURES:
        raise InputError(f"{name}: {n} features, at least {LEAST_FEATURES} are needed")
    board = _array(view.board_mm, (n, 3), f"{name}: board_mm")
    if np.abs(board[:, 2]).max() > 0:
        raise InputError(f"{name}: board_mm: z is not 0: the board should be flat")
    if np.linalg.svd(board[:, :2] - board[:, :2].mean(axis=0), compute_uv=False)[1] < 1e-6 * np.abs(board).max():
        raise InputError(f"{name}: board_mm: all features lie on one line")
    projector = _array(view.projector_px, (n, 2), f"{name}: projector_px", gaps=True).copy()
    projector[~np.isfinite(projector).all(axis=1)] = np.nan
    sigma = None
    if view.sigma_px is not None:
        sigma = _array(view.sigma_px, (n,), f"{name}: sigma_px", gaps=True)
        if (sigma[np.isfinite(projector[:, 0])] < 0).any():
            raise InputError(f"{name}: sigma_px: is negative")
    return replace(
        view,
        board_mm=board,
        camera_px=_array(view.camera_px, (n, 2), f"{name}: camera_px"),
        projector_px=projector,
        slope=None if view.slope is None else _array(view.slope, (n, 2, 2), f"{name}: slope"),
        sigma_px=sigma,
    )


def _same_hand(views: Sequence[BoardView]) -> None:
    """Both devices look at the same side of the board; what one of them sees mirrored was exchanged or flipped."""
    wrong, counted = [], 0
    for view in views:
        seen = np.isfinite(view.projector_px[:, 0])
        if seen.sum() < LEAST_FEATURES:
            continue
        counted += 1
        camera, projector = (handedness(view.board_mm[seen], p[seen]) for p in (view.camera_px, view.projector_px))
        if camera * projector < 0:
            wrong.append(view.name)
    if not counted:
        raise GeometryError(f"no view has {LEAST_FEATURES} features with a phase: nothing ties the projector to it")
    if wrong:
        raise InputError(
            f"the projector sees the board mirrored in {len(wrong)} of {counted} poses ({', '.join(wrong[:3])}): are "
            "the fringes' axes x and y exchanged, or is an image or the board mirrored?"
        )


def _features(views: Sequence[BoardView]) -> bundle.Features:
    spreads = [np.ones(len(v.camera_px)) if v.sigma_px is None else v.sigma_px for v in views]
    spread = np.concatenate(spreads)
    typical = float(np.nanmedian(spread)) if np.isfinite(spread).any() else 1.0
    # What the phase's noise does not explain is the same for all: nobody counts for more than a typical feature.
    relative = np.maximum(np.where(np.isfinite(spread), spread, typical) / max(typical, 1e-12), 1.0)
    board = np.concatenate([v.board_mm for v in views])
    # Views share a board: what has the same place on it is the same feature.
    _, number = np.unique(np.rint(board / 1e-6), axis=0, return_inverse=True)
    return bundle.Features(
        np.repeat(np.arange(len(views)), [len(v.camera_px) for v in views]),
        board,
        np.concatenate([v.camera_px for v in views]),
        np.concatenate([v.projector_px for v in views]),
        np.concatenate([np.zeros((len(v.camera_px), 2, 2)) if v.slope is None else v.slope for v in views]),
        relative,
        np.asarray(number, dtype=np.intp).ravel(),
    )


def _rms(residuals: Floats, used: NDArray[np.bool_]) -> float:
    """Root of the mean squared length."""
    return float(np.sqrt(np.square(residuals[used]).sum(axis=1).mean())) if used.any() else math.nan


def _result(
    views: Sequence[BoardView],
    f: bundle.Features,
    solved: bundle.Solution,
    linked: bool,
    camera_size: tuple[int, int],
    projector_size: tuple[int, int],
    board: str,
    temperature_c: float | None,
    valid_days: int,
    date: datetime | None,
) -> ScannerCalibration:
    model, free = solved.model, solved.free
    toward = -model.turn.T @ model.shift
    axis = "x" if abs(toward[0]) >= abs(toward[1]) else "y"
    where = volume.volume_of(model, f, projector_size)
    jacobian = volume.rigid_part(where.points) @ volume.point_jacobian(model, where.points, axis).reshape(-1, 24)
    moved = (solved.without @ jacobian.T).reshape(len(views), -1, 3)
    left_out_mm = np.sqrt(np.square(moved).sum(axis=2).mean(axis=1))
    share = 1 - 1 / len(views)
    jackknife = _root_mean(np.square(moved - moved.mean(axis=0)).sum(axis=2).sum(axis=0) * share)
    _, by_noise = volume.uncertainties(model, where, solved.covariance, axis)
    shape = _root_mean(np.square(by_noise).sum(axis=1))
    # What the poses contradict each other by is uncertainty too, whatever the noise of the features says.
    told = len(views) > bundle.LEAST_VIEWS
    ratio = jackknife / shape if told else None
    scaled = solved.scaled(max(1.0, ratio or 1.0))
    u, shape_u = volume.uncertainties(model, where, scaled.covariance, axis)
    apart = solved.without - solved.without.mean(axis=0)
    spread = np.sqrt(np.maximum(np.diag(scaled.covariance), np.square(apart).sum(axis=0) * share))
    poses = tuple(_pose(view, f, solved, i, float(left_out_mm[i])) for i, view in enumerate(views))
    camera_used, projector_used = solved.used[:, 0], solved.used[:, 1] & f.seen
    rms = _rms(solved.camera_residual_px, camera_used), _rms(solved.projector_residual_px, projector_used)
    both = np.concatenate([solved.camera_residual_px[camera_used], solved.projector_residual_px[projector_used]])
    undetermined = _undetermined(model, spread, scaled.covariance, free, camera_size, projector_size)
    coverage = tuple(
        _coverage(pixels, size)
        for pixels, size in ((f.camera_px, camera_size), (f.projector_px[f.seen], projector_size))
    )
    when = date or datetime.now(UTC)
    turn = cv2.Rodrigues(model.turn)[0].ravel()
    values = np.concatenate([model.camera, model.projector, turn, model.shift])[free]
    covariance = scaled.covariance[np.ix_(free, free)]
    hull = _hull(model, f, camera_used, projector_used)
    found = ScannerCalibration(
        id=hashlib.sha256(values.tobytes() + covariance.tobytes()).hexdigest()[:16],
        date=when.isoformat(timespec="seconds"),
        valid_until=(when + timedelta(days=valid_days)).date().isoformat(),
        board=board,
        temperature_c=temperature_c,
        camera_size=camera_size,
        projector_size=projector_size,
        parameters=tuple(bundle.PARAMETERS[i] for i in free),
        values=values,
        covariance=covariance,
        camera_from_projector=model.camera_from_projector,
        rms_px=(*rms, _rms(both, np.ones(len(both), dtype=bool))),
        sigma_px=solved.sigma_px,
        poses=poses,
        left_out=(),
        volume=tuple(
            VolumePoint(name, where.points[i], u[i], shape_u[i])
            for name, i in zip(where.NAMES, where.SHOWN, strict=True)
        ),
        coverage=(coverage[0], coverage[1]),
        board_sigma_mm=solved.board_sigma_mm,
        jackknife_mm=jackknife if told else None,
        shape_u_mm=shape,
        jackknife_ratio=ratio,
        hull=hull,
        weld=standard_weld(model.scanner(camera_size, projector_size), scaled.covariance, hull, where.points[13], axis),
        undetermined=tuple(name for name, _ in undetermined),
        next_pose=_next(views, scaled, where, linked, axis, undetermined, camera_size, projector_size),
        warnings=(),
    )
    return replace(found, warnings=tuple(_warnings(found, f, solved, undetermined)))


def _hull(
    model: bundle.BundleModel, f: bundle.Features, camera: NDArray[np.bool_], projector: NDArray[np.bool_]
) -> CalibratedHull:
    """Of the features that were used."""

    def corners(pixels: Floats) -> Floats:
        return np.asarray(cv2.convexHull(pixels.astype(np.float32))[:, 0], dtype=np.float64)

    depths = np.einsum("nab,nb->na", model.turns[f.view], f.board_mm)[:, 2] + model.shifts[f.view][:, 2]
    used = depths[camera]
    return CalibratedHull(
        corners(f.camera_px[camera]), corners(f.projector_px[projector]), (float(used.min()), float(used.max()))
    )


def _root_mean(squares: Floats) -> float:
    return float(np.sqrt(squares.mean()))


def _pose(view: BoardView, f: bundle.Features, solved: bundle.Solution, i: int, left_out_mm: float) -> BoardPose:
    mine = f.view == i
    used = solved.used[mine]
    camera, projector = solved.camera_residual_px[mine], solved.projector_residual_px[mine]
    turn, shift = solved.model.turns[i], solved.model.shifts[i]
    return BoardPose(
        name=view.name,
        camera_from_board=rigid(turn, shift),
        tilt_deg=math.degrees(math.acos(min(1.0, abs(float(turn[2, 2]))))),
        distance_mm=float(np.linalg.norm(shift)),
        camera_px=f.camera_px[mine],
        projector_px=f.projector_px[mine],
        camera_residual_px=camera,
        projector_residual_px=projector,
        used=used,
        rms_px=(_rms(camera, used[:, 0]), _rms(projector, used[:, 1] & np.isfinite(projector[:, 0]))),
        left_out_mm=left_out_mm,
        edge_px=view.edge_px,
    )


def _coverage(pixels: Floats, size: tuple[int, int]) -> float:
    fields = np.floor(pixels / np.array(size) * np.array(FIELDS)).astype(int)
    inside = ((fields >= 0) & (fields < np.array(FIELDS))).all(axis=1)
    return len({tuple(field) for field in fields[inside]}) / (FIELDS[0] * FIELDS[1])


def _undetermined(
    model: bundle.BundleModel,
    u: Floats,
    covariance: Floats,
    free: NDArray[np.intp],
    camera_size: tuple[int, int],
    projector_size: tuple[int, int],
) -> list[tuple[str, str]]:
    """Parameters whose uncertainty u is beyond use, each with the number that shows it."""
    found: list[tuple[str, str]] = []
    for part, lens, size in ((0, model.camera, camera_size), (9, model.projector, projector_size)):
        device = "camera" if part == 0 else "projector"
        r = math.hypot(*size) / 2 / lens[0]
        for k, direction in ((0, "along x (fx)"), (1, "along y (fy)")):
            share = u[part + k] / lens[k]
            if share > LEAST_KNOWN:
                found.append(
                    (
                        f"{device}.{bundle.LENS_NAMES[k]}",
                        f"the {device}'s focal length {direction}: {lens[k]:.1f} ± {2 * u[part + k]:.1f} px "
                        f"(k = 2, {200 * share:.1f} %)",
                    )
                )
        for k in (2, 3):
            if u[part + k] > PRINCIPAL_POINT_SHARE * size[0]:
                found.append(
                    (
                        f"{device}.{bundle.LENS_NAMES[k]}",
                        f"the {device}'s principal point ({bundle.LENS_NAMES[k]}): ± {2 * u[part + k]:.1f} px (k = 2)",
                    )
                )
        for k, power in ((4, 3), (5, 5), (6, 2), (7, 2), (8, 7)):
            bend = u[part + k] * lens[0] * r**power
            if part + k in free and bend > BEND_SHARE * size[0]:
                found.append(
                    (
                        f"{device}.{bundle.LENS_NAMES[k]}",
                        f"the {device}'s distortion {bundle.LENS_NAMES[k]}: ± {2 * bend:.1f} px at the image's corner "
                        "(k = 2)",
                    )
                )
    baseline = float(np.linalg.norm(model.shift))
    along = model.shift / baseline
    spread = float(np.sqrt(along @ covariance[21:24, 21:24] @ along))
    if spread > LEAST_KNOWN * baseline:
        found.append(("camera_from_projector", f"the baseline: {baseline:.2f} ± {2 * spread:.2f} mm (k = 2)"))
    return found


def _next(
    views: Sequence[BoardView],
    solved: bundle.Solution,
    where: volume.Volume,
    linked: bool,
    axis: str,
    undetermined: Sequence[tuple[str, str]],
    camera_size: tuple[int, int],
    projector_size: tuple[int, int],
) -> NextPose | None:
    """The pose that would lower most what is worst: a parameter that is not determined, else the volume's shape."""
    model = solved.model
    if undetermined and undetermined[0][0] in bundle.PARAMETERS:
        index = bundle.PARAMETERS.index(undetermined[0][0])
        lowers = f"standard uncertainty of {undetermined[0][0]}"

        def score(covariance: Floats) -> float:
            return float(np.sqrt(covariance[index, index]))
    else:
        shape = volume.rigid_part(where.points) @ volume.point_jacobian(model, where.points, axis).reshape(-1, 24)
        lowers = "standard uncertainty of a point, shape of the volume, mm"

        def score(covariance: Floats) -> float:
            return float(np.sqrt(np.einsum("ij,jk,ik->", shape, covariance, shape) / len(where.points)))

    board = max((view.board_mm for view in views), key=len)
    best = volume.best_pose(solved, board, where, linked, camera_size, projector_size, score)
    if best is None:
        return None
    return NextPose(best.point_mm, best.tilt_deg, best.around_deg, lowers, score(solved.covariance), best.score)


def _warnings(
    found: ScannerCalibration,
    f: bundle.Features,
    solved: bundle.Solution,
    undetermined: Sequence[tuple[str, str]],
) -> list[str]:
    out = []
    normals = [pose.camera_from_board[:3, 2] for pose in found.poses]
    widest = max(math.degrees(math.acos(min(1.0, abs(float(a @ b))))) for a, b in combinations(normals, 2))
    if undetermined:
        out.append(
            "the poses do not determine "
            + "; ".join(what for _, what in undetermined)
            + f". The boards' tilts differ by at most {widest:.1f}°: add poses tilted by 30 to 45° to all sides"
        )
    elif widest < PARALLEL_DEG:
        out.append(f"the boards are nearly parallel: their tilts differ by at most {widest:.1f}°")
    for name, share in zip(("camera", "projector"), found.coverage, strict=True):
        if share < LEAST_COVERAGE:
            out.append(f"features cover {share:.0%} of the {name}'s image: its distortion beyond them is not known")
    for column, name in ((0, "camera"), (1, "projector")):
        counted = f.seen if column else np.ones(len(f.view), dtype=bool)
        lost = float((~solved.used[counted, column]).mean())
        if lost > REJECTED_SHARE:
            out.append(f"{lost:.0%} of the {name}'s features were rejected as outliers")
    if found.board_sigma_mm is not None and max(found.board_sigma_mm) > FLAT_MM:
        inside, outside = found.board_sigma_mm
        out.append(
            f"the board departs from its drawing by {inside:.3f} mm in its plane and {outside:.3f} mm out of it (one "
            "coordinate, rms): this was solved for"
        )
    typical = np.nanmedian([pose.rms_px for pose in found.poses], axis=0)
    for pose in found.poses:
        for column, name in ((0, "camera"), (1, "projector")):
            if pose.rms_px[column] > 3 * typical[column]:
                out.append(
                    f"{pose.name}: {name} residuals of {pose.rms_px[column]:.2f} px rms, {typical[column]:.2f} px in "
                    "the others: was the board moved while it was captured?"
                )
    if found.jackknife_ratio is not None and found.jackknife_ratio > CONTRADICTION and len(found.poses) > 3:
        out.append(
            f"the poses agree with each other to {found.jackknife_mm:.3f} mm only, their noise explains "
            f"{found.shape_u_mm:.3f} mm: every uncertainty was taken {found.jackknife_ratio:.1f} times as large; "
            + (
                "is the board flat, and printed as stated?"
                if found.board_sigma_mm is None
                else "too few tilts, heat, or a projector whose response bends the phase?"
            )
        )
    out += _about_weld(found)
    return out


def _about_weld(found: ScannerCalibration) -> list[str]:
    """Where the part will lie outside of where the boards were."""
    weld, (near, far) = found.weld, found.hull.depth_mm
    what = f"a pipe of 219 mm at {weld.distance_mm:.0f} mm"
    if not math.isfinite(weld.u_mm):
        return [f"{what}, the middle of the boards, is not in view of camera and projector"]
    out = []
    if weld.inside < LEAST_INSIDE:
        out.append(
            f"of the walls of {what} {weld.inside:.0%} lie where the boards were in both images, at least "
            f"{LEAST_INSIDE:.0%} are needed for a PASS: let the board reach the images' borders in turn"
        )
    if weld.deep_enough < LEAST_INSIDE:
        out.append(
            f"of the walls of {what} {weld.deep_enough:.0%} lie between {near:.0f} and {far:.0f} mm from the camera, "
            "where the boards were: add poses nearer and further"
        )
    return out
