"""What can go wrong, as types. Every message names the thing and, where there is one, the remedy."""

from __future__ import annotations


class WeldscanError(Exception):
    """The root: `except WeldscanError` catches whatever weldscan raises on purpose."""


class InputError(WeldscanError, ValueError):
    """A file, a field or an argument is wrong: missing, of the wrong shape, not finite, out of range."""


class Unreadable(InputError):
    """A file or folder is there, but the system did not give its contents: nothing is known about them."""


class GeometryError(WeldscanError, ValueError):
    """The data do not determine what was asked for: too few points, degenerate, not found."""


class NotMeasured(WeldscanError):
    """The scan does not show what was to be measured. Never a pass."""


class DeviceError(WeldscanError):
    """A projector, camera or robot did not do what it was told."""


class DeviceTimeout(DeviceError, TimeoutError):
    """A device did not answer in time."""
