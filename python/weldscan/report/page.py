"""How every page comes about: a template of this folder, filled into one text without any reference to another file."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from typing import Any

from weldscan._weldcore import __version__
from weldscan.errors import InputError
from weldscan.records.files import check_file, read_bytes, write_file

MARK = '<meta name="generator" content="weldscan calibrate">'


def fill(template: str, created: datetime, **values: Any) -> str:
    """Fills a template; what is no drawing (`Svg`) and not marked safe is escaped."""
    from jinja2 import Environment, FunctionLoader, StrictUndefined
    from markupsafe import Markup

    here = resources.files(__package__)
    environment = Environment(
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        loader=FunctionLoader(lambda name: (here / name).read_text(encoding="utf-8")),
    )
    return environment.get_template(template).render(
        css=Markup((here / "style.css").read_text(encoding="utf-8")),
        version=__version__,
        created=created.strftime("%Y-%m-%d %H:%M UTC"),
        **values,
    )


def write_page(path: Path, template: str, **values: Any) -> Path:
    """A calibration's page as a file that appears whole; an earlier page of a calibration is replaced.

    Raises:
        InputError: the file cannot be written, or is there already and is something else.
    """
    from markupsafe import Markup

    def mm(value: float | None) -> str:
        return "–" if value is None or not math.isfinite(value) else f"{value:.3f}".replace("-", "−")

    check_page(path)
    write_file(path, fill(template, datetime.now(UTC), mark=Markup(MARK), mm=mm, **values))
    return path


def check_page(path: Path) -> None:
    """Says early what would be in the way of a page."""
    if path.exists() and (not path.is_file() or MARK.encode() not in read_bytes(path)[:2000]):
        raise InputError(f"{path}: exists and is no page of a calibration: remove it or name another")
    check_file(path)
