"""weldscan measures the edge displacement of butt welds from structured-light scans."""

from weldscan._weldcore import __version__, set_threads
from weldscan.errors import DeviceError, DeviceTimeout, GeometryError, InputError, NotMeasured, WeldscanError

__all__ = [
    "DeviceError",
    "DeviceTimeout",
    "GeometryError",
    "InputError",
    "NotMeasured",
    "WeldscanError",
    "__version__",
    "set_threads",
]
