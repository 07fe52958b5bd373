"""What several test files need."""

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared"


def shared(path: str) -> Path:
    """A file or folder of the outside data beside the project; the test is skipped where it is missing."""
    found = SHARED / path
    if not found.exists():
        pytest.skip(f"outside data missing: {found}")
    return found
