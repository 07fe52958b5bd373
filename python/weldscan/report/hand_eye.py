"""The page of a hand-eye calibration: residuals by shot and sphere, each shot against the others, what was found."""

from __future__ import annotations

import math
import os
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from weldscan._weldcore import __version__
from weldscan.errors import InputError
from weldscan.report.charts import LEFT, RIGHT, WIDTH, Svg, nice_ticks, number
from weldscan.result import HandEye
from weldscan.session import write_whole

MARK = '<meta name="generator" content="weldscan calibrate">'


def write_hand_eye_page(found: HandEye, path: str | os.PathLike[str], session: str = "") -> Path:
    """Writes the page as one self-contained file; an earlier page of a calibration is replaced.

    Raises:
        InputError: the file cannot be written, or is there already and is something else.
    """
    return write_page(
        Path(path),
        "hand_eye.html",
        h=found,
        session=session,
        residuals=str(residuals(found)),
        matrix=matrix(found),
        degrees=math.degrees,
    )


def write_page(path: Path, template: str, **values: Any) -> Path:
    """Fills a template of this folder into a file that appears whole; names of drawings are those that hold SVG."""
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup

    check_page(path)
    here = resources.files("weldscan.report")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    drawn = {k: Markup(v) if isinstance(v, str) and v.startswith("<svg") else v for k, v in values.items()}
    text = environment.from_string((here / template).read_text(encoding="utf-8")).render(
        css=Markup((here / "style.css").read_text(encoding="utf-8")),
        mark=Markup(MARK),
        version=__version__,
        created=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        mm=lambda v: "–" if v is None or not math.isfinite(v) else f"{v:.3f}".replace("-", "−"),
        **drawn,
    )
    write_whole(path, text)
    return path


def check_page(path: Path) -> None:
    """Says early what would be in the way of a page."""
    if path.exists() and (not path.is_file() or MARK not in path.read_text(encoding="utf-8", errors="replace")[:2000]):
        raise InputError(f"{path}: exists and is no page of a calibration: remove it or name another")
    if not path.absolute().parent.is_dir():
        raise InputError(f"{path}: cannot be written: {path.absolute().parent} is not a folder")


def matrix(found: HandEye) -> str:
    """flange_from_scanner as text."""
    rows = found.flange_from_scanner.tolist()
    return "\n".join(" ".join(f"{v:12.8f}" for v in row[:3]) + f" {row[3]:12.4f}" for row in rows)


def residuals(found: HandEye) -> Svg:
    """Per shot the residuals of its three spheres, and its error under the hand-eye of the other shots."""
    top, bottom = 16, 256
    svg = Svg(WIDTH, 318, "Residual of every sphere of every shot, and each shot's error without it")
    sizes = [[s.residual_mm or 0.0 for s in shot.spheres] for shot in found.per_shot]
    without = [shot.left_out_error_mm or 0.0 for shot in found.per_shot]
    high = 1.12 * max(float(np.max(sizes, initial=0.0)), max(without, default=0.0), 1e-3)

    def y(value: float) -> float:
        return bottom - value / high * (bottom - top)

    svg.add("rect", x=LEFT, y=top, width=WIDTH - LEFT - RIGHT, height=bottom - top, class_="panel")
    for tick in nice_ticks(0.0, high, 6):
        svg.line(LEFT, y(tick), WIDTH - RIGHT, y(tick), "zero" if tick == 0 else "grid")
        svg.text(LEFT - 9, y(tick) + 4, number(tick), "tick", "end")
    step = (WIDTH - LEFT - RIGHT) / max(len(found.per_shot), 1)
    for i, shot in enumerate(found.per_shot):
        middle = LEFT + (i + 0.5) * step
        half = min(0.36 * step, 34.0)
        if shot.left_out_error_mm is not None:
            at = y(shot.left_out_error_mm)
            class_ = "dropped" if shot.outlier is None else "guard"
            svg.add("rect", x=middle - half, y=at, width=2 * half, height=bottom - at, class_=class_)
            svg.line(middle - half, at, middle + half, at, "zero" if shot.outlier is None else "limit")
        for j, size in enumerate(sizes[i]):
            x = middle + (j - 1) * 0.55 * half
            svg.add("circle", cx=x, cy=y(size), r=4.0, class_="dot")
            svg.text(x, y(size) - 8, str(j + 1), "tick")
        name = shot.shot.removeprefix("artefact-") if len(found.per_shot) > 8 else shot.shot
        svg.text(middle, bottom + 18, name, "tick" if shot.outlier is None else "limit-label")
        if shot.chi2 is not None:
            svg.text(middle, bottom + 35, f"χ² {shot.chi2:.0f}", "tick" if shot.outlier is None else "limit-label")
    svg.upright(16, (top + bottom) / 2, "mm")
    svg.text((LEFT + WIDTH - RIGHT) / 2, bottom + 57, "artefact shots; χ² has 9 degrees of freedom", "axis")
    return svg
