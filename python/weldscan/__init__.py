"""weldscan measures the edge displacement of butt welds from structured-light scans."""

from weldscan._weldcore import Lens, Scanner, __version__, set_threads
from weldscan.errors import DeviceError, DeviceTimeout, GeometryError, InputError, NotMeasured, WeldscanError
from weldscan.pose import (
    KukaPose,
    format_e6axis,
    format_e6pos,
    format_frame,
    kuka_from_matrix,
    matrix_from_kuka,
    parse_e6axis,
    parse_e6pos,
    parse_frame,
)

__all__ = [
    "DeviceError",
    "DeviceTimeout",
    "GeometryError",
    "InputError",
    "KukaPose",
    "Lens",
    "NotMeasured",
    "Scanner",
    "WeldscanError",
    "__version__",
    "format_e6axis",
    "format_e6pos",
    "format_frame",
    "kuka_from_matrix",
    "matrix_from_kuka",
    "parse_e6axis",
    "parse_e6pos",
    "parse_frame",
    "set_threads",
]
