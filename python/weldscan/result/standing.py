"""Whether an inspection may rely on its scanner."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Standing:
    """Whether an inspection may rely on its scanner: what the history of verifications says."""

    state: Literal["verified", "failed", "expired", "none"]
    """`verified`: the last verification of this scanner passed and is valid; `expired`: it passed once; `none`: none is
    on record, and none was asked for; `failed`: everything else, a history that names another scanner too."""
    text: str
    history: str | None = None
    id: str | None = None
    """Of the verification that decides."""
    date: str | None = None
    valid_until: str | None = None
    accepted: str | None = None
    """Why an inspector relied on the scanner all the same."""
    notes: tuple[str, ...] = ()

    @property
    def good(self) -> bool:
        """The last verification of this scanner passed and is still valid."""
        return self.state == "verified"

    @property
    def relied_on(self) -> bool:
        """Whether results of this scanner are judged: where no verification is asked for, too."""
        return self.state in ("verified", "none") or self.accepted is not None

    @property
    def statement(self) -> str:
        """What a report says."""
        if self.accepted is None:
            return self.text if self.relied_on else f"not relied on: {self.text}"
        return f"relied on all the same ({self.accepted}); {self.text}"
