"""What several test files need."""

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared"


def shared(path: str) -> Path:
    """A file or folder of the outside data beside the project; the test is skipped where it is missing."""
    found = SHARED / path
    if not found.exists():
        pytest.skip(f"outside data missing: {found}")
    return found


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--soak", action="store_true", help="the long figures: 10,000 RSI cycles, 10,000 poses, 200 kills")


@pytest.fixture
def soak(request: pytest.FixtureRequest) -> bool:
    """Was the long run asked for?"""
    return bool(request.config.getoption("--soak"))


@pytest.fixture
def rsi_cycles(soak: bool) -> int:
    return 10_000 if soak else 150


@pytest.fixture(autouse=True)
def signals() -> Iterator[None]:
    """A command that ran in this process leaves the signals as the end of a process needs them: put back."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)
