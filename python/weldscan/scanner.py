"""Camera and projector: lenses, phase to points, the reference plane, and the scanner's calibration."""

from weldscan._later import later
from weldscan._weldcore import (
    Cloud,
    Lens,
    ReferencePlane,
    Scanner,
    calibrate_reference_plane,
    height_from_reference,
    triangulate,
)

TYPE_CHECKING = False
if TYPE_CHECKING:
    from weldscan.calibration.scanner import (
        BoardView,
        calibrate_scanner,
        solve_scanner,
    )
    from weldscan.records.scanner import (
        read_scanner,
        write_scanner,
    )
    from weldscan.result import (
        ScannerCalibration,
    )

__getattr__ = later(
    __name__,
    {
        "weldscan.calibration.scanner": ("BoardView", "calibrate_scanner", "solve_scanner"),
        "weldscan.records.scanner": ("read_scanner", "write_scanner"),
        "weldscan.result": ("ScannerCalibration",),
    },
)

__all__ = [
    "BoardView",
    "Cloud",
    "Lens",
    "ReferencePlane",
    "Scanner",
    "ScannerCalibration",
    "calibrate_reference_plane",
    "calibrate_scanner",
    "height_from_reference",
    "read_scanner",
    "solve_scanner",
    "triangulate",
    "write_scanner",
]
