"""What was found: frozen values, one file a concept; reports and records only show and keep them.

Lengths in mm; degrees where the name says so.
"""

from weldscan.result.cloud import Label, PartCloud
from weldscan.result.findings import CODES, Finding, Severity, bar, note, warning
from weldscan.result.hand_eye import ArtefactShot, ArtefactSphere, HandEye
from weldscan.result.inspection import Inspection, ScannerRecord, ShotAgreement
from weldscan.result.scanner import (
    BoardPose,
    CalibratedHull,
    NextPose,
    ScannerCalibration,
    StandardWeld,
    VolumePoint,
)
from weldscan.result.seam import FATES, WHOLE_TURN_DEG, Coverage, SeamBin
from weldscan.result.standing import Standing
from weldscan.result.step import BudgetLine, Histogram, StepResult
from weldscan.result.validation import Validation
from weldscan.result.verdict import Judgement, Verdict
from weldscan.result.verification import BallError, Characteristic, Drift, PlaneError, SpacingError, Verification

__all__ = [
    "CODES",
    "FATES",
    "WHOLE_TURN_DEG",
    "ArtefactShot",
    "ArtefactSphere",
    "BallError",
    "BoardPose",
    "BudgetLine",
    "CalibratedHull",
    "Characteristic",
    "Coverage",
    "Drift",
    "Finding",
    "HandEye",
    "Histogram",
    "Inspection",
    "Judgement",
    "Label",
    "NextPose",
    "PartCloud",
    "PlaneError",
    "ScannerCalibration",
    "ScannerRecord",
    "SeamBin",
    "Severity",
    "ShotAgreement",
    "SpacingError",
    "StandardWeld",
    "Standing",
    "StepResult",
    "Validation",
    "Verdict",
    "Verification",
    "VolumePoint",
    "bar",
    "note",
    "warning",
]
