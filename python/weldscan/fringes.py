"""Fringe images to phase: decode, its steps one by one, the projector's response, and the patterns to project."""

from weldscan._later import later
from weldscan._weldcore import (
    Disagreement,
    PhaseError,
    PhaseMap,
    WrappedPhase,
    decode,
    decode_gray,
    decode_phase,
    decode_png,
    estimate_phase_error,
    harmonics_of_gamma,
    phase_error_of_harmonics,
    saturation_level,
    unwrap_spatial,
    unwrap_temporal,
)

TYPE_CHECKING = False
if TYPE_CHECKING:
    from weldscan.calibration.response import (
        compensate_phase,
        estimate_response,
        response_of_folder,
        response_of_ramp,
    )
    from weldscan.devices.projectors.patterns import (
        board_fringes,
        flat_pattern,
        fringe_patterns,
    )
    from weldscan.records.frames import (
        iter_frames,
        read_frames,
    )
    from weldscan.records.response import (
        FringeResponse,
        Response,
        read_response,
        write_response,
    )

__getattr__ = later(
    __name__,
    {
        "weldscan.calibration.response": (
            "compensate_phase",
            "estimate_response",
            "response_of_folder",
            "response_of_ramp",
        ),
        "weldscan.devices.projectors.patterns": ("board_fringes", "flat_pattern", "fringe_patterns"),
        "weldscan.records.frames": ("iter_frames", "read_frames"),
        "weldscan.records.response": ("FringeResponse", "Response", "read_response", "write_response"),
    },
)

__all__ = [
    "Disagreement",
    "FringeResponse",
    "PhaseError",
    "PhaseMap",
    "Response",
    "WrappedPhase",
    "board_fringes",
    "compensate_phase",
    "decode",
    "decode_gray",
    "decode_phase",
    "decode_png",
    "estimate_phase_error",
    "estimate_response",
    "flat_pattern",
    "fringe_patterns",
    "harmonics_of_gamma",
    "iter_frames",
    "phase_error_of_harmonics",
    "read_frames",
    "read_response",
    "response_of_folder",
    "response_of_ramp",
    "saturation_level",
    "unwrap_spatial",
    "unwrap_temporal",
    "write_response",
]
