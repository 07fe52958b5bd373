# The Rust core as Python sees it. One section per room, in the order of the flow.
from collections.abc import Sequence
from typing import Any, Literal, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "Cloud",
    "Cylinder",
    "CylinderFit",
    "Follower",
    "FoundSphere",
    "KdTree",
    "Lens",
    "Mesh",
    "PhaseError",
    "PhaseMap",
    "Plane",
    "PlaneFit",
    "ReferencePlane",
    "Registration",
    "RigidFit",
    "Scanner",
    "SimulatedShot",
    "Sphere",
    "SphereFit",
    "WeakDirection",
    "WeldShot",
    "WeldSurface",
    "WrappedPhase",
    "__version__",
    "calibrate_reference_plane",
    "decode",
    "decode_gray",
    "decode_phase",
    "decode_png",
    "distance",
    "estimate_normals",
    "estimate_phase_error",
    "find_spheres",
    "fit_cylinder",
    "fit_plane",
    "fit_sphere",
    "harmonics_of_gamma",
    "height_from_reference",
    "measure_step",
    "phase_error_of_harmonics",
    "place_shots",
    "register_icp",
    "register_rigid",
    "segment_weld",
    "set_threads",
    "simulate_shot",
    "simulated_step",
    "sphere_through_points",
    "triangulate",
    "unwrap_spatial",
    "unwrap_temporal",
]

__version__: str

def decode_png(data: bytes, size: tuple[int, int] | None = None) -> NDArray[np.uint8] | NDArray[np.uint16]: ...
def set_threads(threads: int | None = None) -> None: ...

# scanner
@final
class Lens:
    def __new__(cls, width: int, height: int, K: ArrayLike, dist: ArrayLike) -> Lens: ...
    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def K(self) -> NDArray[np.float64]: ...
    @property
    def dist(self) -> list[float]: ...
    def project(self, points: ArrayLike) -> NDArray[np.float64]: ...
    def undistort(self, pixels: ArrayLike) -> NDArray[np.float64]: ...
    def __eq__(self, value: object, /) -> bool: ...

@final
class Scanner:
    def __new__(cls, camera: Lens, projector: Lens, camera_from_projector: ArrayLike) -> Scanner: ...
    @property
    def camera(self) -> Lens: ...
    @property
    def projector(self) -> Lens: ...
    @property
    def camera_from_projector(self) -> NDArray[np.float64]: ...
    @property
    def baseline_mm(self) -> float: ...
    def project_to_projector(self, points: ArrayLike) -> NDArray[np.float64]: ...

# phase
@final
class PhaseMap:
    @property
    def column_px(self) -> NDArray[np.float64]: ...
    @property
    def sigma_px(self) -> NDArray[np.float32]: ...
    @property
    def modulation(self) -> NDArray[np.float32]: ...
    @property
    def background(self) -> NDArray[np.float32]: ...
    @property
    def reason(self) -> NDArray[np.uint8]: ...
    @property
    def counts(self) -> list[int]: ...
    @property
    def noise_read_variance(self) -> float: ...
    @property
    def noise_gain(self) -> float: ...
    @property
    def noise_source(self) -> str: ...
    @property
    def saturation(self) -> float: ...
    @property
    def harmonics(self) -> list[float | None]: ...
    @property
    def phase_error(self) -> list[PhaseError]: ...
    @property
    def unwrapped_by(self) -> list[float]: ...

def decode(
    exposures: Sequence[Sequence[NDArray[Any]] | NDArray[Any]] | NDArray[Any],
    fringes: Sequence[tuple[float, int]],
    projector_size: int,
    *,
    saturation: float | None = None,
    z: float = 5.0,
    phase_error: Literal["auto"] | Sequence[Sequence[float] | None] | None = None,
) -> PhaseMap: ...

# response
@final
class PhaseError:
    @property
    def steps(self) -> int: ...
    @property
    def sin_rad(self) -> list[float]: ...
    @property
    def standard_rad(self) -> list[float]: ...
    @property
    def source(self) -> str: ...
    @property
    def largest_rad(self) -> float: ...

def estimate_phase_error(phase_rad: ArrayLike, steps: int, *, z: float = 5.0, rows: int = 24) -> PhaseError | None: ...
def phase_error_of_harmonics(harmonics: Sequence[float], steps: int) -> PhaseError: ...
def harmonics_of_gamma(gamma: float) -> list[float]: ...

@final
class WrappedPhase:
    @property
    def phase_rad(self) -> NDArray[np.float64]: ...
    @property
    def modulation(self) -> NDArray[np.float32]: ...
    @property
    def background(self) -> NDArray[np.float32]: ...
    @property
    def residual(self) -> NDArray[np.float32]: ...
    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]: ...

def decode_phase(images: Sequence[ArrayLike] | NDArray[Any], steps: int | Sequence[int]) -> WrappedPhase: ...
def unwrap_temporal(wrapped: ArrayLike | WrappedPhase, periods: Sequence[float]) -> NDArray[np.float64]: ...
def unwrap_spatial(
    wrapped: ArrayLike | WrappedPhase, mask: ArrayLike | None = None, quality: ArrayLike | None = None
) -> NDArray[np.float64]: ...
def decode_gray(
    images: Sequence[ArrayLike] | NDArray[Any],
    *,
    white: ArrayLike | None = None,
    black: ArrayLike | None = None,
    inverse: Sequence[ArrayLike] | NDArray[Any] | None = None,
    wrapped: ArrayLike | None = None,
    contrast: float | None = None,
) -> NDArray[Any]: ...

# triangulate
@final
class Cloud:
    @property
    def points_mm(self) -> NDArray[np.float64]: ...
    @property
    def sigma_mm(self) -> NDArray[np.float32] | None: ...

@final
class ReferencePlane:
    @property
    def a(self) -> NDArray[np.float64]: ...
    @property
    def b(self) -> NDArray[np.float64]: ...
    @property
    def rms_mm(self) -> NDArray[np.float32]: ...

def calibrate_reference_plane(
    reference_phase: ArrayLike, phases: Sequence[ArrayLike] | NDArray[Any], heights_mm: Sequence[float]
) -> ReferencePlane: ...
def height_from_reference(
    phase: ArrayLike,
    reference_phase: ArrayLike,
    *,
    baseline_mm: float | None = None,
    distance_mm: float | None = None,
    period_mm: float | None = None,
    calibration: ReferencePlane | None = None,
) -> NDArray[np.float64]: ...
def triangulate(column: ArrayLike, scanner: Scanner, sigma_px: ArrayLike | None = None, axis: str = "x") -> Cloud: ...

# kdtree
@final
class KdTree:
    def __new__(cls, points: ArrayLike) -> KdTree: ...
    def nearest(self, queries: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.uint32]]: ...
    def knn(self, queries: ArrayLike, k: int) -> tuple[NDArray[np.float64], NDArray[np.uint32]]: ...
    def radius(self, queries: ArrayLike, r: float) -> tuple[list[NDArray[np.float64]], list[NDArray[np.uint32]]]: ...
    def __len__(self) -> int: ...

@final
class Follower:
    def __new__(cls, tree: KdTree) -> Follower: ...
    def nearest(self, queries: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.uint32]]: ...

# transform
@final
class RigidFit:
    @property
    def target_from_source(self) -> NDArray[np.float64]: ...
    @property
    def rms_mm(self) -> float: ...

def register_rigid(source: ArrayLike, target: ArrayLike, weights: ArrayLike | None = None) -> RigidFit: ...

# simulate
@final
class SimulatedShot:
    @property
    def white(self) -> list[NDArray[np.uint8] | NDArray[np.uint16]]: ...
    @property
    def frames(self) -> list[list[NDArray[np.uint8] | NDArray[np.uint16]]]: ...
    @property
    def points_mm(self) -> NDArray[np.float64]: ...
    @property
    def column_px(self) -> NDArray[np.float64]: ...
    @property
    def row_px(self) -> NDArray[np.float64]: ...
    @property
    def deviation_mm(self) -> NDArray[np.float64]: ...
    @property
    def along(self) -> NDArray[np.float64]: ...
    @property
    def labels(self) -> NDArray[np.uint8]: ...
    def capture(
        self, picture: NDArray[np.uint8], *, exposure: float = 1.0, number: int = 0
    ) -> NDArray[np.uint8] | NDArray[np.uint16]: ...

def simulate_shot(
    scanner: Scanner,
    scene_from_scanner: ArrayLike,
    bodies: Sequence[Any],
    fringes: Sequence[tuple[str, float, int]],
    photometry: Any,
    *,
    exposures: Sequence[float] = ...,
    seed: int = 0,
) -> SimulatedShot: ...
def simulated_step(weld: Any, along: ArrayLike) -> NDArray[np.float64]: ...

@final
class WeldSurface:
    def __new__(cls, weld: Any) -> WeldSurface: ...
    def height(self, angle_rad: ArrayLike, z_mm: ArrayLike) -> NDArray[np.float64]: ...
    def edges(self, angle_rad: ArrayLike) -> NDArray[np.float64]: ...
    def cast(self, scanner: Scanner, weld_from_scanner: ArrayLike) -> dict[str, NDArray[Any]]: ...

# fit
@final
class PlaneFit:
    @property
    def point_mm(self) -> NDArray[np.float64]: ...
    @property
    def normal(self) -> NDArray[np.float64]: ...
    @property
    def rms_mm(self) -> float: ...
    @property
    def covariance(self) -> NDArray[np.float64]: ...
    @property
    def iterations(self) -> int: ...
    @property
    def inliers(self) -> NDArray[np.int64] | None: ...

@final
class SphereFit:
    @property
    def center_mm(self) -> NDArray[np.float64]: ...
    @property
    def radius_mm(self) -> float: ...
    @property
    def rms_mm(self) -> float: ...
    @property
    def covariance(self) -> NDArray[np.float64]: ...
    @property
    def iterations(self) -> int: ...
    @property
    def inliers(self) -> NDArray[np.int64] | None: ...

@final
class CylinderFit:
    @property
    def point_mm(self) -> NDArray[np.float64]: ...
    @property
    def axis(self) -> NDArray[np.float64]: ...
    @property
    def radius_mm(self) -> float: ...
    @property
    def rms_mm(self) -> float: ...
    @property
    def covariance(self) -> NDArray[np.float64]: ...
    @property
    def iterations(self) -> int: ...
    @property
    def inliers(self) -> NDArray[np.int64] | None: ...

def fit_plane(
    points: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    sigma_mm: float | None = None,
    robust: bool = False,
    seed: int = 0,
) -> PlaneFit: ...
def fit_sphere(
    points: ArrayLike,
    radius_mm: float | None = None,
    *,
    weights: ArrayLike | None = None,
    sigma_mm: float | None = None,
    robust: bool = False,
    seed: int = 0,
) -> SphereFit: ...
def fit_cylinder(
    points: ArrayLike,
    radius_mm: float | None = None,
    *,
    weights: ArrayLike | None = None,
    sigma_mm: float | None = None,
    robust: bool = False,
    seed: int = 0,
) -> CylinderFit: ...
def sphere_through_points(points: ArrayLike) -> tuple[NDArray[np.float64], float]: ...

@final
class FoundSphere:
    @property
    def center_mm(self) -> NDArray[np.float64]: ...
    @property
    def radius_mm(self) -> float: ...
    @property
    def covariance(self) -> NDArray[np.float64]: ...
    @property
    def rms_mm(self) -> float: ...
    @property
    def inliers(self) -> NDArray[np.int64]: ...
    @property
    def coverage(self) -> float: ...
    @property
    def free_radius_mm(self) -> float: ...
    @property
    def free_radius_sigma_mm(self) -> float: ...

def find_spheres(points: ArrayLike, radius_mm: float, count: int | None = None) -> list[FoundSphere]: ...

# distance
@final
class Plane:
    def __new__(cls, point_mm: ArrayLike, normal: ArrayLike) -> Plane: ...
    @property
    def point_mm(self) -> NDArray[np.float64]: ...
    @property
    def normal(self) -> NDArray[np.float64]: ...

@final
class Sphere:
    def __new__(cls, center_mm: ArrayLike, radius_mm: float) -> Sphere: ...
    @property
    def center_mm(self) -> NDArray[np.float64]: ...
    @property
    def radius_mm(self) -> float: ...

@final
class Cylinder:
    def __new__(cls, point_mm: ArrayLike, axis: ArrayLike, radius_mm: float) -> Cylinder: ...
    @property
    def point_mm(self) -> NDArray[np.float64]: ...
    @property
    def axis(self) -> NDArray[np.float64]: ...
    @property
    def radius_mm(self) -> float: ...

@final
class Mesh:
    def __new__(cls, vertices: ArrayLike, triangles: ArrayLike) -> Mesh: ...
    @property
    def triangles(self) -> int: ...
    @property
    def closed(self) -> bool: ...

def distance(
    points: ArrayLike,
    target: ArrayLike | KdTree | Mesh | Plane | Sphere | Cylinder,
    signed: bool = True,
    *,
    normals: ArrayLike | None = None,
) -> NDArray[np.float64]: ...

# normals
def estimate_normals(
    points: ArrayLike, viewpoint: ArrayLike | None = None, *, k: int = 20, window: int = 5
) -> NDArray[np.float64]: ...

# icp
@final
class WeakDirection:
    @property
    def kind(self) -> Literal["translation", "rotation", "screw"]: ...
    @property
    def axis(self) -> NDArray[np.float64]: ...
    @property
    def point_mm(self) -> NDArray[np.float64] | None: ...
    @property
    def strength(self) -> float: ...
    @property
    def vector(self) -> NDArray[np.float64]: ...

@final
class Registration:
    @property
    def target_from_source(self) -> NDArray[np.float64]: ...
    @property
    def converged(self) -> bool: ...
    @property
    def iterations(self) -> int: ...
    @property
    def rms_mm(self) -> float: ...
    @property
    def inliers(self) -> NDArray[np.uint32]: ...
    @property
    def covariance(self) -> NDArray[np.float64]: ...
    @property
    def unobserved(self) -> list[WeakDirection]: ...

def register_icp(
    source: ArrayLike,
    target: ArrayLike | KdTree | Mesh | Plane | Sphere | Cylinder,
    metric: Literal["point", "plane"] = "point",
    *,
    normals: ArrayLike | None = None,
    start: ArrayLike | None = None,
    max_distance_mm: float = ...,
    trim: float = 0.0,
    kernel: Literal["huber", "tukey"] | None = None,
    kernel_mm: float | None = None,
    max_iterations: int = 100,
    tolerance_mm: float = 1e-7,
    weak: float = 0.01,
    max_points: int | None = None,
) -> Registration: ...

# segment, step, place
@final
class WeldShot:
    @property
    def origin_mm(self) -> NDArray[np.float64]: ...
    @property
    def axis(self) -> NDArray[np.float64]: ...
    @property
    def zero(self) -> NDArray[np.float64]: ...
    @property
    def radius_mm(self) -> float: ...
    @property
    def radius_fitted(self) -> bool: ...
    @property
    def noise_mm(self) -> float: ...
    @property
    def bead_width_mm(self) -> float: ...
    @property
    def labels(self) -> NDArray[np.uint8]: ...
    @property
    def angle_rad(self) -> NDArray[np.float32]: ...
    @property
    def axial_mm(self) -> NDArray[np.float32]: ...
    @property
    def deviation_mm(self) -> NDArray[np.float32]: ...

def segment_weld(
    points_mm: ArrayLike,
    radius_mm: float,
    wall_thickness_mm: float,
    axis: Sequence[float] | None = None,
    zero: Sequence[float] | None = None,
) -> WeldShot: ...
def measure_step(shots: Sequence[WeldShot], angle_sigma_rad: float = 0.0) -> dict[str, Any]: ...
def place_shots(
    shots: Sequence[tuple[WeldShot, NDArray[np.float64], NDArray[np.float64], NDArray[np.float32], int]],
) -> tuple[
    NDArray[np.float64],
    NDArray[np.uint8],
    NDArray[np.float32],
    NDArray[np.float32],
    NDArray[np.float32],
    NDArray[np.uint16],
]: ...
