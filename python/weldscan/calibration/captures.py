"""Captures of a board under fringes along both axes: the images, and what both devices saw.

A projector sees no board: its coordinate of a feature is the absolute phase of both axes at the place
where the camera saw the feature, fitted over the neighbourhood (S. Zhang, P. Huang, Opt. Eng. 45 (2006) 083601).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import PhaseMap, decode, saturation_level
from weldscan.calibration.board import Board, Seen
from weldscan.errors import InputError
from weldscan.records.capture import MANIFEST, Captures, PoseSpec, Size
from weldscan.records.images import Image, read_image
from weldscan.records.session import FringeSet

Floats = NDArray[np.float64]

# A phase that is known worse than this at a feature is no phase: the features themselves are seen ten times better.
MOST_SIGMA_PX = 0.5
# Of the neighbourhood's pixels, at least so many must have a phase.
LEAST_SHARE = 0.3


# --- the images -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Stack:
    """The images of one pose, decoded."""

    white: NDArray[np.uint8]
    """The board evenly lit."""
    columns: PhaseMap
    rows: PhaseMap
    size: tuple[int, int]

    def projector(self) -> tuple[Floats, Floats]:
        """(H, W, 2) projector coordinates, NaN where there is none, and their standard deviations."""
        maps = self.columns, self.rows
        return (
            np.stack([np.asarray(m.column_px) for m in maps], axis=-1),
            np.stack([np.asarray(m.sigma_px, dtype=np.float64) for m in maps], axis=-1),
        )


def read_stack(captures: Captures, pose: PoseSpec, size: tuple[int, int] | None = None) -> Stack:
    """Read and decode a pose's images.

    Args:
        captures: the folder.
        pose: one of its poses.
        size: (width, height) that the images must have.

    Raises:
        InputError: an image is missing, damaged, or not like the rest.
    """
    files = captures.files(pose)
    first = read_image(files[0][0], size)
    size = first.shape[1], first.shape[0]
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        images = iter(list(pool.map(lambda path: read_image(path, size), [p for row in files for p in row])))
    exposures = [[next(images) for _ in row] for row in files]
    for row, paths in zip(exposures, files, strict=True):
        for image, path in zip(row, paths, strict=True):
            if image.dtype != first.dtype:
                raise InputError(f"{path}: is of {image.dtype}, the pose's first image of {first.dtype}")
    return decode_stack(exposures, captures.spec.fringes, captures.spec.projector, captures.folder / MANIFEST)


def decode_stack(
    exposures: Sequence[Sequence[Image]], fringes: Sequence[FringeSet], projector: Size, where: Path | str = "fringes"
) -> Stack:
    """Decode both axes of one pose."""
    maps = []
    for axis, side in (("x", projector.width), ("y", projector.height)):
        frames: list[int] = []
        at = 0
        for fringe in fringes:
            frames += range(at, at + fringe.steps) if fringe.axis == axis else ()
            at += fringe.steps
        sets = [fringe.code for fringe in fringes if fringe.axis == axis]
        try:
            maps.append(decode([[row[i] for i in frames] for row in exposures], sets, side, phase_error="auto"))
        except InputError as error:
            raise InputError(f"{where}: fringes: axis {axis}: {error}") from None
    height, width = exposures[0][0].shape
    return Stack(_white(exposures), maps[0], maps[1], (width, height))


def _white(exposures: Sequence[Sequence[Image]]) -> NDArray[np.uint8]:
    """The mean of a stack is the board evenly lit: the fringes cancel. Of several, the brightest not clipped."""
    means = [np.mean(np.asarray(row, dtype=np.float32), axis=0) for row in exposures]
    top = saturation_level([image for row in exposures for image in row])[0]
    # Full swing between black and white is a mean of half of it.
    whole = [mean for mean in means if np.mean(mean > 0.55 * top) < 0.01] or [min(means, key=lambda m: float(m.mean()))]
    mean = max(whole, key=lambda m: float(m.mean()))
    high = float(np.quantile(mean[::4, ::4], 0.995))
    return np.asarray(np.clip(mean * (250.0 / max(high, 1e-6)), 0, 255), dtype=np.uint8)


# --- what the projector saw -------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Phases:
    """The phase field at features."""

    projector_px: Floats
    """(n, 2), NaN where it is not to be had."""
    slope: Floats
    """(n, 2, 2), by the camera's x and y."""
    sigma_px: Floats
    """(n,) the larger of the two axes'."""


def phases_at(field: Floats, sigma: Floats, pixels: Floats, radius: float) -> Phases:
    """A quadratic polynomial of each axis' phase around every feature, robust and weighted by 1/sigma².

    Weights begin with those of least absolute deviations and end with Tukey's, so that wrong fringe orders, dirt and
    what lies beside the board do not count.

    Args:
        field: (H, W, 2) projector coordinates, NaN where there is none.
        sigma: (H, W, 2) their standard deviations.
        pixels: (n, 2) features.
        radius: of the neighbourhood, px.
    """
    n, half = len(pixels), max(2, round(radius))
    height, width = field.shape[:2]
    at = np.rint(pixels).astype(int)
    dy, dx = (v.ravel() for v in np.mgrid[-half : half + 1, -half : half + 1])
    disc = np.hypot(dx, dy) <= half + 0.5
    dx, dy = dx[disc], dy[disc]
    u, v = at[:, :1] + dx, at[:, 1:] + dy
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    u, v = np.clip(u, 0, width - 1), np.clip(v, 0, height - 1)
    x, y = (u - pixels[:, :1]) / half, (v - pixels[:, 1:]) / half
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    values = np.full((n, 2), np.nan)
    slope = np.zeros((n, 2, 2))
    worst = np.zeros(n)
    for axis in (0, 1):
        value, spread = field[v, u, axis], sigma[v, u, axis]
        good = inside & np.isfinite(value) & np.isfinite(spread)
        enough = good.sum(axis=1) >= max(LEAST_SHARE * len(dx), 12)
        typical = np.where(good, spread, np.nan)
        typical = np.nanmedian(typical[enough], axis=1) if enough.any() else np.empty(0)
        some = np.flatnonzero(enough)
        if not some.size:
            worst[:] = np.inf
            continue
        b, w = basis[some], np.where(good[some], 1 / np.maximum(np.nan_to_num(spread[some], nan=1.0), 1e-3), 0.0)
        target = np.nan_to_num(value[some])
        base = np.nanmedian(np.where(good[some], target, np.nan), axis=1)
        target = target - base[:, None]
        robust = np.ones_like(target)
        scale = typical
        for turn in range(12):
            weights = np.square(w) * robust
            normal = np.einsum("nki,nk,nkj->nij", b, weights, b, optimize=True)
            normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(6)
            right = np.einsum("nki,nk,nk->ni", b, weights, target, optimize=True)
            fit = np.linalg.solve(normal, right[..., None])[..., 0]
            whitened = np.abs(target - np.einsum("nki,ni->nk", b, fit)) * w
            middle = np.nanmedian(np.where(w > 0, whitened, np.nan), axis=1)
            scale = np.maximum(1.4826 * middle, 1e-6)
            if turn < 7:
                robust = 1 / np.maximum(whitened / scale[:, None], 0.1)
            else:
                robust = np.square(np.maximum(1 - np.square(whitened / (4.685 * scale[:, None])), 0))
        used = (robust > 0) & (w > 0)
        inverse = np.linalg.inv(normal)
        chi2 = (np.square(whitened) * robust * (w > 0)).sum(axis=1) / np.maximum(robust.sum(axis=1) - 6, 1)
        own = np.sqrt(np.maximum(inverse[:, 0, 0] * np.maximum(chi2, 1e-12), 0))
        fits = (used.sum(axis=1) >= max(LEAST_SHARE * len(dx), 12)) & (own < MOST_SIGMA_PX)
        values[some, axis] = np.where(fits, fit[:, 0] + base, np.nan)
        slope[some, axis] = fit[:, 1:3] / half
        worst[some] = np.maximum(worst[some], own)
        worst[~enough] = np.inf
    values[np.isnan(values).any(axis=1)] = np.nan
    return Phases(values, slope, worst)


def saturated_share(stack: Stack, seen: Seen, board: Board) -> float:
    """Share of the pixels around the features that are saturated."""
    half = max(1, round(0.4 * seen.spacing_px))
    reason = np.asarray(stack.columns.reason)
    shares = []
    for x, y in np.rint(seen.pixels).astype(int):
        window = reason[max(y - half, 0) : y + half + 1, max(x - half, 0) : x + half + 1]
        shares.append(float(np.mean(window == 2)) if window.size else 0.0)
    return float(np.mean(shares)) if shares else 0.0
