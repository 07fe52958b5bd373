"""`weldscan calibrate response`: how the projector's light follows its level, from a ramp or from fringe images; and
what that does to phases that were recorded without a correction.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from weldscan._weldcore import (
    PhaseError,
    WrappedPhase,
    decode_phase,
    estimate_phase_error,
    harmonics_of_gamma,
    phase_error_of_harmonics,
    refuse_masked,
)
from weldscan.errors import GeometryError, InputError
from weldscan.records.frames import read_frames
from weldscan.records.images import read_image
from weldscan.records.response import FringeResponse, Response, measured
from weldscan.records.session import read_session

Floats = NDArray[np.float64]
Image = NDArray[Any]
ROWS = 120
"""Rows of an image that are looked at where there is time."""
Z = 5.0
CLEAR = 10.0
"""Fringes count where their amplitude is this many times the noise of a grey level."""
TAIL = 12
"""Harmonics that are kept; what was not seen follows the power law of the second one."""
GAMMAS = (0.3, 4.0)
RAMP_LEVELS = 8
"""A power law through fewer is a guess about what lies between them."""


def estimate_response(
    images: Sequence[Image] | Image,
    fringes: Sequence[tuple[float, int]],
    *,
    mask: ArrayLike | None = None,
    saturation: float | None = None,
) -> Response:
    """The projector's response from the fringe images of any scene: a table, and the harmonics of every frequency.

    With four or more steps the harmonics up to half the steps are seen in the images themselves (least squares over
    all pixels, in the ratio to the fundamental, which surface and ambient light do not change). With three steps none
    is: there the error of the phase that they make is seen, see `estimate_phase_error`, and the power law that makes
    it. Either way that error is kept for each frequency, as far as it stands above the noise.

    Args:
        images: (H, W) uint8 or uint16 images, sets after sets, steps in order.
        fringes: (periods over the projector, steps) of each set.
        mask: (H, W), True where a pixel counts. Dark and saturated pixels never do.
        saturation: the camera's full scale; by default 255 for uint8, else the largest value that was seen, plus one.

    Returns:
        Response; its table comes from the coarsest frequency that shows it, for blur softens the finer ones most.

    Raises:
        InputError: images that do not fit the fringes or each other.
        GeometryError: too few pixels with clear fringes.

    Example:
        >>> import numpy as np
        >>> from weldscan import estimate_response
        >>> phase = np.add.outer(0.002 * np.arange(200), 0.3 * np.arange(400))
        >>> light = [(0.5 + 0.5 * np.cos(phase - 2 * np.pi * k / 6)) ** 1.5 for k in range(6)]
        >>> response = estimate_response([np.rint(10 + 200 * x).astype(np.uint8) for x in light], [(64, 6)])
        >>> round(response.gamma, 1)
        1.5
    """
    refuse_masked("images", images)
    refuse_masked("mask", mask)
    frames = [np.asarray(image) for image in images]
    needed = sum(steps for _, steps in fringes)
    if not fringes or len(frames) != needed:
        raise InputError(f"images: {len(frames)}, but the fringes {list(fringes)} have {needed} steps")
    shape = frames[0].shape
    for frame in frames:
        if frame.shape != shape or frame.ndim != 2 or frame.dtype not in (np.uint8, np.uint16):
            raise InputError(f"images: (H, W) uint8 or uint16 of one size needed, got {frame.shape} {frame.dtype}")
    full = saturation or (255 if frames[0].dtype == np.uint8 else 1 + max(int(frame.max()) for frame in frames))
    wanted = np.ones(shape, bool) if mask is None else np.asarray(mask, bool)
    if wanted.shape != shape:
        raise InputError(f"mask: {wanted.shape} for images of {shape}")
    seen, at = [], 0
    for periods, steps in fringes:
        seen.append(_one_set(np.stack(frames[at : at + steps]), float(periods), int(steps), wanted, full))
        at += steps
    direct = [f for f in seen if f.steps >= 4 and f.harmonics]
    shown = direct or [f for f in seen if f.sin_rad]
    if not shown:
        # Three steps, and no error above the noise: linear as far as can be told.
        return measured(np.arange(256), np.arange(256) / 255, "phase", seen)
    best = min(shown, key=lambda f: f.periods)
    return measured(np.arange(256), _light(best.harmonics).round(6), "harmonics" if direct else "phase", seen)


def _one_set(stack: Image, periods: float, steps: int, wanted: NDArray[np.bool_], full: float) -> FringeResponse:
    phase = decode_phase(list(stack), steps)
    clear = wanted & (stack.max(axis=0) < full) & (phase.modulation > CLEAR * _noise(phase.background, steps))
    if clear.sum() < 1000:
        raise GeometryError(f"fringes of {periods:g} periods: clear in {int(clear.sum())} pixels, at least 1000 needed")
    error = estimate_phase_error(np.where(clear, phase.phase_rad, np.nan), steps, z=Z, rows=ROWS)
    shown = error is not None and error.source == "phase"
    sines = tuple(error.sin_rad) if error is not None and shown else ()
    standard = tuple(error.standard_rad) if error is not None else ()
    if steps == 3:
        harmonics = tuple(harmonics_of_gamma(_gamma_of_error(sines[0]))[:TAIL]) if shown else ()
        return _seen(periods, steps, harmonics, sines, standard)
    # The phase itself errs by the harmonics that are looked for, but little, and less once its own error is taken off.
    true_phase = phase.phase_rad - _series(phase.phase_rad, steps, sines)
    ratios = _harmonics_in(stack, true_phase, phase.modulation, clear)
    gamma = float(np.clip(gamma_of_second_harmonic(ratios[0]), *GAMMAS))
    tail = harmonics_of_gamma(gamma)[len(ratios) : TAIL]
    return _seen(periods, steps, (*ratios, *tail), sines, standard)


def _seen(
    periods: float, steps: int, harmonics: Sequence[float], sines: Sequence[float], standard: Sequence[float]
) -> FringeResponse:
    harmonics, sines, standard = (tuple(round(float(v), 6) for v in values) for values in (harmonics, sines, standard))
    return FringeResponse(periods=periods, steps=steps, harmonics=harmonics, sin_rad=sines, standard_rad=standard)


def _harmonics_in(
    stack: Image, phase: Floats, modulation: NDArray[np.float32], clear: NDArray[np.bool_]
) -> list[float]:
    """Harmonics 2 to N/2 over the fundamental, with their sign: minimises the squared misfit over all clear pixels."""
    steps = len(stack)
    levels = stack[:, clear].astype(np.float64)
    p0, b = phase[clear], modulation[clear].astype(np.float64)
    found = []
    for p in range(2, steps // 2 + 1):
        angle = 2 * np.pi * p * np.arange(steps) / steps
        cosine = (2 / steps) * np.cos(angle) @ levels
        if 2 * p == steps:
            # The steps see this one's cosine alone, and twice.
            model = 2 * b * np.cos(p * p0)
            found.append(float(cosine @ model / (model @ model)))
        else:
            sine = (2 / steps) * np.sin(angle) @ levels
            found.append(float((cosine @ (b * np.cos(p * p0)) + sine @ (b * np.sin(p * p0))) / (b @ b)))
    return found


def _noise(background: NDArray[np.float32], steps: int) -> float:
    """Standard deviation of a grey level, from neighbours' second differences in the mean image: an upper bound."""
    second = np.abs(background[:, :-2] - 2 * background[:, 1:-1] + background[:, 2:])
    return float(max(1.4826 * np.median(second) / np.sqrt(6) * np.sqrt(steps), 12**-0.5))


def _gamma_of_error(first_rad: float) -> float:
    """The power law whose three-step error begins with this term; bisection, for the term falls with the exponent."""
    low, high = GAMMAS
    for _ in range(40):
        middle = 0.5 * (low + high)
        if phase_error_of_harmonics(harmonics_of_gamma(middle), 3).sin_rad[0] > first_rad:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def _light(harmonics: Sequence[float]) -> Floats:
    """Light over 256 levels: the harmonics of a full cosine are the Chebyshev coefficients of the response."""
    wave = np.arange(256) / 127.5 - 1
    light = np.polynomial.chebyshev.chebval(wave, [0.0, 1.0, *harmonics])
    rising: Floats = np.maximum.accumulate((light - light[0]) / (light[-1] - light[0])).astype(np.float64)
    return rising


def _series(phase: Floats, steps: int, sines: Sequence[float]) -> Floats:
    total = np.zeros_like(phase)
    for m, c in enumerate(sines, start=1):
        if c:
            total += c * np.sin(m * steps * phase)
    return total


def compensate_phase(
    wrapped: ArrayLike | WrappedPhase,
    steps: int | Sequence[int],
    response: Response | PhaseError | Sequence[float] | None = None,
    *,
    periods: float | Sequence[float] | None = None,
    mask: ArrayLike | None = None,
    smooth: bool = True,
) -> Floats:
    """The wrapped phase without the error that the projector's response makes, and with less noise.

    Args:
        wrapped: (H, W) rad, or (sets, H, W); a `WrappedPhase` does.
        steps: N of the images that it came from, or of each set.
        response: what is known: a `Response`, a `PhaseError`, or the coefficients of sin(m N phase), rad. None: what
            the phase itself shows, see `estimate_phase_error`.
        periods: of the fringes over the projector, where a `Response` knows several frequencies.
        mask: (H, W), True where a pixel counts; others come back as NaN.
        smooth: a 3x3 filter afterwards, which leaves slopes alone: a third of each pixel and a twelfth of each
            neighbour, in pairs of opposite ones, and only of those on one surface with it (second difference within
            five robust standard deviations). White noise falls to 0.41. False: compensated, not filtered.

    Returns:
        as `wrapped`, float64, in (-pi, pi].

    Raises:
        InputError: shapes that do not fit, fewer than three steps.

    Example:
        >>> import numpy as np
        >>> from weldscan import compensate_phase
        >>> true = np.add.outer(0.01 * np.arange(300), 0.3 * np.arange(400))
        >>> found = compensate_phase(true + 0.1 * np.sin(3 * true), 3)
        >>> bool(np.abs(np.angle(np.exp(1j * (found - true)))).max() < 0.01)
        True
    """
    refuse_masked("wrapped", wrapped)
    refuse_masked("mask", mask)
    phases = np.asarray(wrapped, dtype=np.float64)
    if phases.ndim == 3:
        many = [steps] * len(phases) if isinstance(steps, int) else list(steps)
        freq = list(periods) if isinstance(periods, Sequence) else [periods] * len(phases)
        if not len(many) == len(freq) == len(phases):
            raise InputError(f"wrapped: {len(phases)} sets, {len(many)} steps, {len(freq)} periods")
        each = zip(phases, many, freq, strict=True)
        return np.stack([compensate_phase(p, n, response, periods=f, mask=mask, smooth=smooth) for p, n, f in each])
    if phases.ndim != 2 or not isinstance(steps, int) or isinstance(periods, Sequence):
        raise InputError(f"wrapped: (H, W) with one number of steps, or (sets, H, W), got {phases.shape}")
    if steps < 3:
        raise InputError(f"steps: 3 or more, got {steps}")
    if mask is not None:
        keep = np.asarray(mask, bool)
        if keep.shape != phases.shape:
            raise InputError(f"mask: {keep.shape} for a phase of {phases.shape}")
        phases = np.where(keep, phases, np.nan)
    sines: Sequence[float]
    if response is None:
        seen = estimate_phase_error(phases, steps, z=Z, rows=ROWS)
        sines = [] if seen is None else seen.sin_rad
    elif isinstance(response, Response):
        sines = response.phase_error(steps, periods)
    else:
        sines = response.sin_rad if isinstance(response, PhaseError) else list(response)
    found = phases - _series(phases, steps, sines)
    return _wrap(_filtered(found) if smooth else found)


def _wrap(phase: Floats) -> Floats:
    wrapped: Floats = np.pi - (np.pi - phase) % (2 * np.pi)
    return wrapped


def _filtered(phase: Floats) -> Floats:
    """A third of each pixel and a twelfth of each neighbour, in pairs of opposite ones."""
    out = phase.copy()
    inner = phase[1:-1, 1:-1]
    height, width = phase.shape
    total = np.zeros_like(inner)
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = phase[1 + dy : height - 1 + dy, 1 + dx : width - 1 + dx]
        there = phase[1 - dy : height - 1 - dy, 1 - dx : width - 1 - dx]
        second = _wrap(here + there - 2 * inner)
        known = np.isfinite(second)
        if known.any():
            limit = 5 * 1.4826 * np.median(np.abs(second[known]))
            total += np.where(known & (np.abs(second) <= limit), second, 0.0)
    out[1:-1, 1:-1] = inner + total / 12
    return out


def parse_fringes(text: str) -> list[tuple[float, int]]:
    """Return (periods, steps) per set.

    >>> parse_fringes("1x4, 8x4, 64x4")
    [(1.0, 4), (8.0, 4), (64.0, 4)]
    """
    sets = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*([0-9.]+)\s*[x:]\s*(\d+)\s*", part)
        try:
            periods, steps = (float(match[1]), int(match[2])) if match else (0.0, 0)
        except ValueError:
            periods, steps = 0.0, 0
        if periods <= 0 or steps < 3:
            raise InputError(f"--fringes: {part.strip()!r} is not PERIODSxSTEPS with 3 steps or more, such as 64x4")
        sets.append((periods, steps))
    return sets


def response_of_ramp(level: ArrayLike, light: ArrayLike, *, noise: float = 0.0) -> Response:
    """The response that even images of several levels show.

    Args:
        level: of each image, 0 to 255 with both ends, in any order; of repeated ones the mean counts.
        light: mean grey value of each, over pixels that do not saturate.
        noise: standard deviation of a light. By how much the next level may be darker: five times that, at least 1 %
            of the range.

    Raises:
        InputError: fewer than 8 levels, a light that is not finite or falls with the level, white that is clipped.

    Example:
        >>> from weldscan import response_of_ramp
        >>> level = [0, 36, 73, 109, 146, 182, 219, 255]
        >>> round(response_of_ramp(level, [10 + 180 * (v / 255) ** 2.2 for v in level]).gamma, 2)
        2.2
    """
    refuse_masked("level", level)
    refuse_masked("light", light)
    levels, lights = np.asarray(level, np.float64), np.asarray(light, np.float64)
    if levels.ndim != 1 or levels.shape != lights.shape:
        raise InputError(f"ramp: {levels.shape} levels for {lights.shape} lights")
    if not np.isfinite(lights).all():
        raise InputError(f"ramp: light: not finite at level {levels[~np.isfinite(lights)][0]:g}")
    at, which = np.unique(levels, return_inverse=True)
    if at.size < RAMP_LEVELS:
        raise InputError(f"ramp: {at.size} levels, at least {RAMP_LEVELS} needed from 0 to 255")
    means = np.bincount(which, lights) / np.bincount(which)
    span = float(means[-1] - means[0])
    if not span > 0:
        raise InputError(f"ramp: light does not rise from black ({means[0]:.1f}) to white ({means[-1]:.1f})")
    fall = np.maximum.accumulate(means) - means
    if fall.max() > max(5 * noise, 0.01 * span):
        raise InputError(
            f"ramp: light falls by {100 * fall.max() / span:.1f} % of its range up to level {at[fall.argmax()]:g}: "
            "images out of order, an automatic exposure, or a display that switches its contrast"
        )
    clipped = at[means >= means[-1] - max(noise, 1e-3 * span)]
    # A display may well clip its own uppermost levels: a table corrects that.
    if clipped.size >= 3 and clipped[0] < 0.8 * 255:
        raise InputError(f"ramp: all levels from {clipped[0]:g} on are equally bright: saturated; expose less")
    return measured(at, means)


def gamma_of_second_harmonic(ratio: float) -> float:
    """Return the power law's exponent whose second harmonic is this part of the fundamental, (g - 1)/(g + 2).

    >>> from weldscan import harmonics_of_gamma
    >>> round(gamma_of_second_harmonic(harmonics_of_gamma(1.8)[0]), 6)
    1.8
    """
    return (1 + 2 * ratio) / (1 - ratio)


# --- from files -------------------------------------------------------------------------------------------------------


def response_of_folder(
    folder: str | os.PathLike[str], fringes: Sequence[tuple[float, int]] | None = None, *, shot: str | None = None
) -> Response:
    """The response from a session, from a folder of fringe images, or from a folder with a ramp.

    Args:
        folder: a `weldscan-session/1` folder; else, with `fringes`, images that are numbered in the order of the sets
            and then of the steps; else even images whose names end in the level that they show (`ramp_128.png`).
        fringes: (periods, steps) of each set.
        shot: of the session; by default the one with the most clear pixels in its first image of fringes.

    Raises:
        InputError: naming the file or folder, and what is wrong with it.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    try:
        if (folder / "session.json").is_file():
            return _of_session(folder, shot)
        files = sorted(folder.glob("*.png"), key=_natural)
        if not files:
            raise InputError("neither session.json nor PNG images")
        if fringes is None:
            return _of_ramp(files)
        return estimate_response([read_image(file) for file in files], fringes)
    except (InputError, GeometryError) as error:
        text = str(error)
        raise type(error)(text if str(folder) in text else f"{folder}: {text}") from None


def _of_session(folder: Path, name: str | None) -> Response:
    session = read_session(folder)
    shots = {shot.name: shot for shot in session.shots}
    if name is not None and name not in shots:
        raise InputError(f"shot: {name!r} is none of {', '.join(shots)}")
    axis = session.fringes[0].axis
    keep: list[int] = []
    fringes: list[tuple[float, int]] = []
    at = 0
    for fringe in session.fringes:
        if fringe.axis == axis:
            keep.extend(range(at, at + fringe.steps))
            fringes.append((fringe.periods, fringe.steps))
        at += fringe.steps
    found: list[tuple[int, Response]] = []
    why: GeometryError | None = None
    for shot in [shots[name]] if name else session.shots:
        stack = read_frames(session, shot)[0]
        frames = [stack[i] for i in keep]
        try:
            response = estimate_response(frames, fringes)
        except GeometryError as error:
            why = error
            continue
        contrast = np.abs(frames[0].astype(np.int32) - frames[1]) > 8
        found.append((int(contrast.sum()), response))
        if len(found) == 3:
            break
    if not found:
        raise why or InputError("no shot")
    return max(found, key=lambda pair: pair[0])[1]


def _of_ramp(files: Sequence[Path]) -> Response:
    levels = []
    for file in files:
        number = re.search(r"(\d+)$", file.stem)
        if number is None or int(number[1]) > 255:
            raise InputError(
                f"{file}: its name should end in the level that it shows, 0 to 255; fringes need --fringes"
            )
        levels.append(int(number[1]))
    images = [read_image(file) for file in files]
    if len({image.shape for image in images}) > 1 or len({image.dtype for image in images}) > 1:
        raise InputError("ramp: images of different sizes or depths")
    # 16-bit files often hold fewer bits: the narrowest scale that holds what was seen.
    brightest = max(int(image.max()) for image in images)
    top = 255 if images[0].dtype == np.uint8 else next(2**b - 1 for b in (8, 10, 12, 14, 16) if brightest < 2**b)
    order = np.argsort(levels)
    black, white = (images[order[i]].astype(np.int64) for i in (0, -1))
    lit = (white < top) & (white - black > 0.05 * top)
    if lit.mean() < 1e-3:
        share = float((white >= top).mean())
        raise InputError(f"ramp: no pixel is lit and unsaturated ({100 * share:.0f} % saturated in white): expose less")
    return response_of_ramp(levels, [float(image[lit].mean()) for image in images])


def _natural(file: Path) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", file.name) if part]
