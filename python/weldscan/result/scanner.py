"""A scanner as calibrated, with what its report shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import Lens, Scanner

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BoardPose:
    """One pose of the board in a scanner's calibration."""

    name: str
    camera_from_board: Floats
    """(4, 4), mm."""
    tilt_deg: float
    """Between the board's normal and the camera's axis."""
    distance_mm: float
    camera_px: Floats
    """(n, 2) the features as the camera saw them."""
    projector_px: Floats
    """(n, 2) the projector's coordinates there; NaN where there was no phase."""
    camera_residual_px: Floats
    """(n, 2) modelled minus seen."""
    projector_residual_px: Floats
    used: NDArray[np.bool_]
    """(n, 2): camera and projector; not rejected as an outlier."""
    rms_px: tuple[float, float]
    """Of the used features, camera and projector."""
    left_out_mm: float | None
    """How much the shape of the volume changes (rms) when the calibration does without this pose."""
    edge_px: float
    """How wide an edge of the board is in the image; NaN where unknown."""

    @property
    def kept(self) -> tuple[int, int]:
        """How many features were used, camera and projector."""
        return int(self.used[:, 0].sum()), int(self.used[:, 1].sum())

    @property
    def missing(self) -> int:
        """Features without a phase."""
        return int(np.isnan(self.projector_px[:, 0]).sum())


@dataclass(frozen=True, eq=False)
class VolumePoint:
    """What the calibration leaves unknown of a point, k = 1."""

    name: str
    point_mm: Floats
    """(3,), scanner frame."""
    u_mm: Floats
    """(3,), in the scanner's frame, which is not known better than its camera's axis."""
    shape_u_mm: Floats
    """(3,), without a common motion of all points: that is the hand-eye's."""


@dataclass(frozen=True, eq=False)
class NextPose:
    """The pose of the board that would add most to a calibration."""

    point_mm: Floats
    """(3,), where the board's middle should be, scanner frame."""
    tilt_deg: float
    around_deg: float
    """Which way it leans: its normal turns to the image's right at 0, down at 90."""
    lowers: str
    """What it improves."""
    from_value: float
    to_value: float


@dataclass(frozen=True, eq=False)
class CalibratedHull:
    """Where a scanner is calibrated: the convex hulls of the board's features in both images, and their depths."""

    camera_px: Floats
    """(n, 2), corners in order."""
    projector_px: Floats
    """(m, 2)"""
    depth_mm: tuple[float, float]
    """Nearest and furthest feature, along the camera's axis."""

    def holds(self, camera_px: Floats, projector_px: Floats) -> NDArray[np.bool_]:
        """Which places lie in both, (n, 2) each; NaN lies in none."""
        inside = np.ones(len(camera_px), dtype=bool)
        for corners, places in ((self.camera_px, camera_px), (self.projector_px, projector_px)):
            sides = np.roll(corners, -1, axis=0) - corners
            x, y = corners.T
            way = np.sign(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))
            off = places[:, None] - corners
            inside &= (way * (sides[:, 0] * off[..., 1] - sides[:, 1] * off[..., 0]) >= 0).all(axis=1)
        return inside


@dataclass(frozen=True)
class StandardWeld:
    """What a calibration leaves unknown of a pipe of 219 mm in the middle of where the boards stood."""

    u_mm: float
    """Of its step, k = 1; inf: it is not in view."""
    inside: float
    """Which share of its walls lies in the hull of the calibrated pixels."""
    deep_enough: float
    """And which between the nearest and the furthest feature."""
    distance_mm: float
    """Of the weld from the camera."""


@dataclass(frozen=True, eq=False)
class ScannerCalibration:
    """A scanner as calibrated: what `weldscan-scanner/2` keeps, and what its report shows."""

    id: str
    date: str
    valid_until: str | None
    board: str
    temperature_c: float | None
    camera_size: tuple[int, int]
    projector_size: tuple[int, int]
    parameters: tuple[str, ...]
    values: Floats
    """In the order of `parameters`; the turn as a rotation vector (rad)."""
    covariance: Floats
    """Of `parameters`; rotations are small turns about the camera's axes, R_true = exp(w) R. Times the square of
    `jackknife_ratio` where that is above 1."""
    camera_from_projector: Floats
    """(4, 4)"""
    rms_px: tuple[float, float, float]
    """Camera, projector, both, over the used features: root of the mean squared length; both: over the two devices."""
    sigma_px: tuple[float, float]
    """Noise of one coordinate: the camera's features, and the phase at them."""
    poses: tuple[BoardPose, ...]
    left_out: tuple[tuple[str, str], ...]
    """Poses that could not be used, with the reason."""
    volume: tuple[VolumePoint, ...]
    """The middle and the corners."""
    coverage: tuple[float, float]
    """Share of the camera's and of the projector's image (8 x 6 fields) in which there is a feature."""
    board_sigma_mm: tuple[float, float] | None
    """How far the board's features are off its drawing, one coordinate, in its plane and out of it; None: not seen."""
    jackknife_mm: float | None
    """Standard uncertainty of the volume's shape (rms) by leaving out one pose after the other."""
    shape_u_mm: float
    """The same by the noise of the features, before the covariance was scaled."""
    jackknife_ratio: float | None
    """`jackknife_mm` over `shape_u_mm`; None: too few poses to leave one out."""
    hull: CalibratedHull
    weld: StandardWeld
    undetermined: tuple[str, ...]
    """Parameters that the poses do not determine."""
    next_pose: NextPose | None
    warnings: tuple[str, ...]

    @property
    def standard_uncertainty(self) -> dict[str, float]:
        """Of every parameter, k = 1."""
        return dict(zip(self.parameters, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def baseline_mm(self) -> float:
        """Between camera and projector."""
        return float(np.linalg.norm(self.camera_from_projector[:3, 3]))

    def lens(self, device: str) -> tuple[Floats, list[float]]:
        """K and k1 k2 p1 p2 k3 of "camera" or "projector"."""
        value = dict(zip(self.parameters, self.values.tolist(), strict=True))
        fx, fy, cx, cy = (value[f"{device}.{name}"] for name in ("fx", "fy", "cx", "cy"))
        dist = [value.get(f"{device}.{name}", 0.0) for name in ("k1", "k2", "p1", "p2", "k3")]
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), dist

    @property
    def scanner(self) -> Scanner:
        """For `triangulate`."""
        camera, projector = (
            Lens(*size, *self.lens(device))
            for device, size in (("camera", self.camera_size), ("projector", self.projector_size))
        )
        return Scanner(camera, projector, self.camera_from_projector)
