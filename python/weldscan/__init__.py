"""weldscan measures the edge displacement of butt welds from structured-light scans."""

TYPE_CHECKING = False  # what `typing` has, without importing it
if TYPE_CHECKING:
    from typing import Any

    from weldscan._weldcore import (
        Cloud,
        Cylinder,
        CylinderFit,
        Disagreement,
        Follower,
        FoundSphere,
        KdTree,
        Lens,
        Mesh,
        PhaseError,
        PhaseMap,
        Plane,
        PlaneFit,
        ReferencePlane,
        Registration,
        RigidFit,
        Scanner,
        SimulatedShot,
        Sphere,
        SphereFit,
        WeakDirection,
        WeldShot,
        WeldStep,
        WrappedPhase,
        __version__,
        calibrate_reference_plane,
        decode,
        decode_gray,
        decode_phase,
        decode_png,
        distance,
        estimate_normals,
        estimate_phase_error,
        find_spheres,
        fit_cylinder,
        fit_plane,
        fit_sphere,
        harmonics_of_gamma,
        height_from_reference,
        measure_step,
        phase_error_of_harmonics,
        place_shots,
        register_icp,
        register_rigid,
        segment_weld,
        set_threads,
        simulate_shot,
        simulated_step,
        sphere_through_points,
        triangulate,
        unwrap_spatial,
        unwrap_temporal,
    )
    from weldscan.calibration.artefact import PlateView, find_plate
    from weldscan.calibration.hand_eye import solve_hand_eye
    from weldscan.calibration.response import compensate_phase, estimate_response, response_of_folder, response_of_ramp
    from weldscan.calibration.scanner import BoardView, calibrate_scanner, solve_scanner
    from weldscan.errors import DeviceError, DeviceTimeout, GeometryError, InputError, NotMeasured, WeldscanError
    from weldscan.measure.inspection import inspect
    from weldscan.measure.paper_method import paper_step
    from weldscan.measure.scanner_standing import standing_of
    from weldscan.norms import judge, limit_mm, norm_ids
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
    from weldscan.records.frames import iter_frames, read_frames
    from weldscan.records.history import append_history, read_history
    from weldscan.records.response import FringeResponse, Response, read_response, write_response
    from weldscan.records.result import read_result
    from weldscan.records.scanner import read_scanner, write_scanner
    from weldscan.records.session import Session, read_session, write_session
    from weldscan.report import write_report
    from weldscan.report.validation import write_validation
    from weldscan.report.verification import write_verification
    from weldscan.result import (
        HandEye,
        Inspection,
        Label,
        ScannerCalibration,
        Standing,
        Validation,
        Verdict,
        Verification,
    )
    from weldscan.verification import VerificationLimits, flatness_error, probing_error, read_limits, verify
    from weldscan.verification.validation import validate

# Names are imported when they are asked for: a command is to stand behind its error boundary before anything heavy is
# loaded, and an algorithm needs neither pydantic nor OpenCV. What is in none of these is the core's.
_LAZY = {
    "weldscan.calibration.artefact": ("PlateView", "find_plate"),
    "weldscan.calibration.hand_eye": ("solve_hand_eye",),
    "weldscan.calibration.response": (
        "compensate_phase",
        "estimate_response",
        "response_of_folder",
        "response_of_ramp",
    ),
    "weldscan.calibration.scanner": ("BoardView", "calibrate_scanner", "solve_scanner"),
    "weldscan.errors": ("DeviceError", "DeviceTimeout", "GeometryError", "InputError", "NotMeasured", "WeldscanError"),
    "weldscan.measure.inspection": ("inspect",),
    "weldscan.measure.paper_method": ("paper_step",),
    "weldscan.norms": ("judge", "limit_mm", "norm_ids"),
    "weldscan.pose": (
        "KukaPose",
        "format_e6axis",
        "format_e6pos",
        "format_frame",
        "kuka_from_matrix",
        "matrix_from_kuka",
        "parse_e6axis",
        "parse_e6pos",
        "parse_frame",
    ),
    "weldscan.records.frames": ("iter_frames", "read_frames"),
    "weldscan.records.history": ("append_history", "read_history"),
    "weldscan.records.response": ("FringeResponse", "Response", "read_response", "write_response"),
    "weldscan.records.result": ("read_result",),
    "weldscan.records.scanner": ("read_scanner", "write_scanner"),
    "weldscan.records.session": ("Session", "read_session", "write_session"),
    "weldscan.report": ("write_report",),
    "weldscan.report.validation": ("write_validation",),
    "weldscan.report.verification": ("write_verification",),
    "weldscan.result": (
        "HandEye",
        "Inspection",
        "Label",
        "ScannerCalibration",
        "Standing",
        "Validation",
        "Verdict",
        "Verification",
    ),
    "weldscan.verification.validation": ("validate",),
    "weldscan.verification": ("VerificationLimits", "flatness_error", "probing_error", "read_limits", "verify"),
    "weldscan.measure.scanner_standing": ("standing_of",),
}

# The algorithms by room: each a module that gives its names.
_ROOMS = ("_weldcore", "clouds", "fringes", "scanner", "surfaces", "weld")


def __getattr__(name: str) -> "Any":
    from importlib import import_module

    if name in __all__:
        module = next((module for module, names in _LAZY.items() if name in names), "weldscan._weldcore")
        value = globals()[name] = getattr(import_module(module), name)
        return value
    if f"weldscan.{name}" in _LAZY or name in _ROOMS:
        return import_module(f"weldscan.{name}")
    raise AttributeError(f"module 'weldscan' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


__all__ = [
    "BoardView",
    "Cloud",
    "Cylinder",
    "CylinderFit",
    "DeviceError",
    "DeviceTimeout",
    "Disagreement",
    "Follower",
    "FoundSphere",
    "FringeResponse",
    "GeometryError",
    "HandEye",
    "InputError",
    "Inspection",
    "KdTree",
    "KukaPose",
    "Label",
    "Lens",
    "Mesh",
    "NotMeasured",
    "PhaseError",
    "PhaseMap",
    "Plane",
    "PlaneFit",
    "PlateView",
    "ReferencePlane",
    "Registration",
    "Response",
    "RigidFit",
    "Scanner",
    "ScannerCalibration",
    "Session",
    "SimulatedShot",
    "Sphere",
    "SphereFit",
    "Standing",
    "Validation",
    "Verdict",
    "Verification",
    "VerificationLimits",
    "WeakDirection",
    "WeldShot",
    "WeldStep",
    "WeldscanError",
    "WrappedPhase",
    "__version__",
    "append_history",
    "calibrate_reference_plane",
    "calibrate_scanner",
    "compensate_phase",
    "decode",
    "decode_gray",
    "decode_phase",
    "decode_png",
    "distance",
    "estimate_normals",
    "estimate_phase_error",
    "estimate_response",
    "find_plate",
    "find_spheres",
    "fit_cylinder",
    "fit_plane",
    "fit_sphere",
    "flatness_error",
    "format_e6axis",
    "format_e6pos",
    "format_frame",
    "harmonics_of_gamma",
    "height_from_reference",
    "inspect",
    "iter_frames",
    "judge",
    "kuka_from_matrix",
    "limit_mm",
    "matrix_from_kuka",
    "measure_step",
    "norm_ids",
    "paper_step",
    "parse_e6axis",
    "parse_e6pos",
    "parse_frame",
    "phase_error_of_harmonics",
    "place_shots",
    "probing_error",
    "read_frames",
    "read_history",
    "read_limits",
    "read_response",
    "read_result",
    "read_scanner",
    "read_session",
    "register_icp",
    "register_rigid",
    "response_of_folder",
    "response_of_ramp",
    "segment_weld",
    "set_threads",
    "simulate_shot",
    "simulated_step",
    "solve_hand_eye",
    "solve_scanner",
    "sphere_through_points",
    "standing_of",
    "triangulate",
    "unwrap_spatial",
    "unwrap_temporal",
    "validate",
    "verify",
    "write_report",
    "write_response",
    "write_scanner",
    "write_session",
    "write_validation",
    "write_verification",
]
