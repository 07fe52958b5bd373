"""`weldscan scan`: goes through a plan, shot by shot, and leaves a session folder that `weldscan inspect` reads.

At each pose: move, or wait for the operator; wait until the robot stands; read the pose, take the images, read the pose
again - a robot that moved rejects the shot; look at the quality, once more with another exposure where that helps; keep
the shot, which is written while the robot goes to the next.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, field
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field

from weldscan.devices.cameras import Camera, Image
from weldscan.devices.projectors import Projector
from weldscan.devices.projectors.patterns import flat_pattern, fringe_patterns
from weldscan.devices.robots import Robot, StampedPose, distance, wait_until_still
from weldscan.errors import DeviceError, InputError, WeldscanError
from weldscan.pose import KukaPose
from weldscan.records.files import own_file
from weldscan.records.hand_eye import read_hand_eye
from weldscan.records.plan import read_plan
from weldscan.records.session import FlangePose, Session, ShotSpec
from weldscan.station.capture import Quality, Stopwatch, capture_stack, judge, set_exposure
from weldscan.station.cell import CellConfig, check
from weldscan.station.store import LOG, SetAside, ShotStore

Tell = Callable[[int, int, str], None]
Operator = Callable[[ShotSpec], None]
Share = Annotated[float, Field(ge=0, le=1)]
EXPOSURE_STEP = 2.0
"""The one other exposure: half where too much is saturated, twice where too little can be measured."""
MOVED_ATTEMPTS = 2

log = logging.getLogger("weldscan.scan")


class ScanSettings(BaseModel):
    """`[scan]`. Lengths of pose differences are those of the flange."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)

    plan: Path
    """A `weldscan-session/1` document: its shots, with the poses where the flange shall go."""
    still_window_s: Annotated[float, Field(gt=0, le=60)] = 0.3
    still_mm: Annotated[float, Field(gt=0)] = 0.02
    """Standing, and not moved during the images: two thirds of the repeatability of a small KUKA."""
    still_deg: Annotated[float, Field(gt=0)] = 0.003
    still_timeout_s: Annotated[float, Field(gt=0, le=3600)] = 30.0
    most_saturated: Share = 0.05
    least_usable: Share = 0.02
    """Of the image: a plate with three spheres in front of nothing is about 5 %."""
    least_modulation: Share = 0.02
    """5 of 255 grey levels: below it 4 steps give the phase no better than 0.2 rad, with a noise of 1.5 levels."""


@dataclass(frozen=True)
class ScanResult:
    """What came of it."""

    folder: Path
    whole: int
    planned: int
    rejected: tuple[tuple[str, str], ...]
    """Shots that were tried and not kept, with the reason."""
    set_aside: tuple[SetAside, ...] = ()
    """Shots that were there and damaged: why, and where they are now."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Where the time of the shots went, all together: motion, standing, projector, camera, judging; and writing, which
    goes on beside them."""


class Rejected(WeldscanError):
    """A shot that must not count."""


def scan(
    cell: CellConfig,
    out: Path,
    resume: bool = False,
    tell: Tell = lambda done, of, what: None,
    operator: Operator | None = None,
    retake: bool = False,
) -> ScanResult:
    """Scan what the plan says and is not there yet.

    Args:
        cell: which devices, which plan.
        out: the session folder; new, or with `resume` one that an earlier scan of the same plan began.
        resume: go on with that.
        tell: called with (whole shots, planned shots, what is being done); from another thread when a shot is kept.
        operator: called before a shot when weldscan may not move the robot; returns when the robot is at its pose.
        retake: set aside more than one damaged shot, too.

    Raises:
        InputError: configuration, plan or folder. Unreadable: a shot that is there; nothing was touched.
        DeviceError: a device failed; the shots so far are kept.
    """
    settings, plan = read_settings(cell)
    for kind in ("projector", "camera", *(["robot"] if plan.has_robot else [])):
        cell.settings(kind)  # a wrong configuration is told before anything is written
    with ShotStore(out, plan, resume, retake) as store, _log_to(out / LOG), ExitStack() as devices:
        log.info("scan of %d shots, %d are there", len(plan.shots), len(store.whole))
        for each in store.set_aside:
            log.warning("%s is taken again: %s; it was moved to %s", each.shot, each.reason, each.folder)
            tell(len(store.whole), len(plan.shots), f"set aside {each.shot} as {each.folder}: {each.reason}")
        if not store.missing:
            return ScanResult(out, len(store.whole), len(plan.shots), ())
        try:
            projector: Projector = devices.enter_context(cell.open("projector"))
            camera: Camera = devices.enter_context(cell.open("camera"))
            robot: Robot | None = devices.enter_context(cell.open_robot()) if plan.has_robot else None
            with _Scan(settings, plan, store, projector, camera, robot, tell, operator) as scanning:
                return scanning.run()
        except BaseException as error:
            log.error(
                "stopped with %d of %d shots: %s", len(store.whole), len(plan.shots), str(error) or type(error).__name__
            )
            raise


class _Scan:
    """One run: what every step needs."""

    def __init__(
        self,
        settings: ScanSettings,
        plan: Session,
        store: ShotStore,
        projector: Projector,
        camera: Camera,
        robot: Robot | None,
        tell: Tell,
        operator: Operator | None,
    ) -> None:
        self.settings, self.plan, self.store = settings, plan, store
        self.projector, self.camera, self.robot = projector, camera, robot
        self.tell, self.operator = tell, operator
        self.took = Stopwatch()
        self._writer = ThreadPoolExecutor(1, "writer")
        self._writing: Future[None] | None = None
        self._before: tuple[KukaPose, KukaPose] | None = None
        """Where the shot before should have been taken, and where it was."""
        lens, size = plan.scanner.projector, (projector.settings.width, projector.settings.height)
        if size != (lens.width, lens.height):
            raise InputError(f"projector: {size[0]}x{size[1]}, but the plan's has {lens.width}x{lens.height} pixels")
        self.sets = [(fringe.axis, fringe.periods, fringe.steps) for fringe in plan.fringes]
        self.patterns = [*fringe_patterns([f.pattern for f in plan.fringes], *size), flat_pattern(255, *size)]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """A shot that is being written is written to its end, whatever ended the scan."""
        self._writer.shutdown(wait=True)

    def run(self) -> ScanResult:
        rejected = []
        for shot in self.store.missing:
            try:
                self._take(shot)
            except Rejected as error:
                log.warning("%s rejected: %s", shot.name, error)
                rejected.append((shot.name, str(error)))
                self._say(f"rejected {shot.name}: {error}")
        self._written()
        log.info("seconds: %s", self.took)
        whole, planned = len(self.store.whole), len(self.plan.shots)
        return ScanResult(
            self.store.folder, whole, planned, tuple(rejected), self.store.set_aside, dict(self.took.seconds)
        )

    def _say(self, what: str) -> None:
        self.tell(len(self.store.whole), len(self.plan.shots), what)

    def _take(self, shot: ShotSpec) -> None:
        self._say(f"going to {shot.name}")
        before, factor = dict(self.took.seconds), 1.0
        with self.took("motion"):
            self._go(shot)
        self._written()
        for attempt in range(2):
            stacks, whites, exposures, record = self._images(shot, factor)
            with self.took("judging"):
                quality = judge(stacks, self.sets, self.settings.least_modulation, self.camera.full_scale)
            log.info("%s: %s", shot.name, quality)
            self._say(f"{shot.name}: {quality}")
            complaint, better = self._complaint(quality)
            if complaint is None:
                break
            if attempt == 1:
                raise Rejected(complaint)
            log.info("%s: %s; once more with %g times the exposure", shot.name, complaint, better)
            factor = better
        pose = record.pop("pose")
        taken = shot.model_copy(update={"exposures": exposures, "flange_pose": pose})
        record |= {"quality": asdict(quality), "seconds": self._since(before)}
        self._writing = self._writer.submit(self._keep, taken, stacks, whites, record)

    def _keep(self, *taken: Any) -> None:
        """Write a shot, and say that it counts; the writer's."""
        with self.took("writing"):
            self.store.keep(*taken)
        name = taken[0].name
        log.info("kept %s", name)
        self._say(f"kept {name}")

    def _written(self) -> None:
        """Wait for the shot that is being written; what went wrong with that stops the scan."""
        if self._writing is not None:
            self._writing.result()
            self._writing = None

    def _since(self, before: Mapping[str, float]) -> dict[str, float]:
        """What the shot took so far."""
        return {what: round(s - before.get(what, 0.0), 3) for what, s in self.took.seconds.items() if what != "writing"}

    def _go(self, shot: ShotSpec) -> None:
        if self.robot is None or not self.robot.settings.allow_motion:
            if self.operator is not None:
                self.operator(shot)
        elif shot.flange_pose is not None:
            self.robot.move_to(KukaPose(*shot.flange_pose.model_dump().values()))

    def _images(
        self, shot: ShotSpec, factor: float
    ) -> tuple[list[list[Image]], list[Image], tuple[float, ...] | None, dict[str, Any]]:
        """All exposures of a shot, from a robot that stood all the while."""
        relative = shot.exposures or (1.0,)
        for attempt in range(MOVED_ATTEMPTS):
            if attempt > 0:
                self._go(shot)
            wanted_s = [self.camera.settings.exposure_s * exposure * factor for exposure in relative]
            with self.took("camera"):
                set_exposure(self.camera, self.projector, wanted_s[0])
                self.camera.prepare()
            with self.took("standing"):
                before = self._standing()
            self._check_moved(shot, before)
            self._say(f"taking {shot.name}")
            started = time.strftime("%Y-%m-%dT%H:%M:%S%z")
            stacks, whites, actual = [], [], []
            for exposure_s in wanted_s:
                with self.took("camera"):
                    actual.append(set_exposure(self.camera, self.projector, exposure_s))
                *frames, white = capture_stack(self.camera, self.projector, self.patterns, self.took)
                self._check_size(white)
                stacks.append(frames)
                whites.append(white)
            if len(set(actual)) < len(actual):
                raise InputError(f"{shot.name}: exposures: {relative} are not whole refreshes apart")
            after = None if self.robot is None else self.robot.pose()
            record: dict[str, Any] = {"started": started, "exposures_s": actual, "full_scale": self.camera.full_scale}
            if before is None or after is None:
                return stacks, whites, self._ratios(shot, actual), {**record, "pose": None}
            moved_mm, moved_deg = distance(before.flange, after.flange)
            if moved_mm <= self.settings.still_mm and moved_deg <= self.settings.still_deg:
                record |= {"moved_mm": moved_mm, "moved_deg": moved_deg}
                return stacks, whites, self._ratios(shot, actual), {**record, "pose": _flange_pose(before)}
            log.warning("%s: the robot moved by %.3f mm, %.4f degrees meanwhile", shot.name, moved_mm, moved_deg)
        raise Rejected(f"the robot moved by {moved_mm:.3f} mm and {moved_deg:.4f} degrees during the images")

    def _check_size(self, image: Image) -> None:
        lens = self.plan.scanner.camera
        if image.shape != (lens.height, lens.width):
            raise DeviceError(
                f"{self.camera.name}: frames of {image.shape[1]}x{image.shape[0]} pixels, "
                f"but the plan's camera has {lens.width}x{lens.height}"
            )

    def _ratios(self, shot: ShotSpec, actual_s: list[float]) -> tuple[float, ...] | None:
        """The exposures as they were, relative to the cell's."""
        if shot.exposures is None:
            return None
        return tuple(round(exposure / self.camera.settings.exposure_s, 6) for exposure in actual_s)

    def _standing(self) -> StampedPose | None:
        if self.robot is None:
            return None
        s = self.settings
        wait_until_still(self.robot, s.still_window_s, s.still_mm, s.still_deg, s.still_timeout_s)
        return self.robot.pose()

    def _check_moved(self, shot: ShotSpec, pose: StampedPose | None) -> None:
        """Two shots from one place, though the plan has two: nobody moved the robot, or what it tells is stale."""
        if pose is None or shot.flange_pose is None:
            return
        wanted, there = KukaPose(*shot.flange_pose.model_dump().values()), pose.flange
        if self._before is not None and not self._same(wanted, self._before[0]) and self._same(there, self._before[1]):
            raise Rejected("the robot is where it was for the shot before: was it moved, is its pose stale?")
        self._before = wanted, there

    def _same(self, a: KukaPose, b: KukaPose) -> bool:
        mm, deg = distance(a, b)
        return mm <= self.settings.still_mm and deg <= self.settings.still_deg

    def _complaint(self, quality: Quality) -> tuple[str | None, float]:
        """What is wrong with a shot, and the exposure that may help."""
        if quality.saturated > self.settings.most_saturated:
            return f"{quality.saturated:.1%} of the image is saturated", 1 / EXPOSURE_STEP
        if quality.usable < self.settings.least_usable:
            return f"only {quality.usable:.1%} of the image can be measured", EXPOSURE_STEP
        return None, 1.0


def _flange_pose(pose: StampedPose) -> FlangePose:
    x, y, z, a, b, c = (round(value, 6) for value in pose.flange.values())
    return FlangePose(X=x, Y=y, Z=z, A=a, B=b, C=c)


def read_settings(cell: CellConfig) -> tuple[ScanSettings, Session]:
    """Return a cell's `[scan]` and the plan that it names."""
    settings = check(cell.scan, ScanSettings, f"{cell.path}: scan")
    path = cell.path.parent / settings.plan
    plan = read_plan(path)
    if isinstance(plan.hand_eye, str):
        plan = plan.model_copy(update={"hand_eye": read_hand_eye(path.parent / plan.hand_eye)})
    return settings, plan


class _LogFile(logging.FileHandler):
    def _open(self) -> TextIOWrapper:
        return TextIOWrapper(own_file(Path(self.baseFilename)), encoding="utf-8")

    def close(self) -> None:
        with suppress(OSError):
            super().close()

    def handleError(self, record: logging.LogRecord) -> None:
        """A log that cannot be written, on a full disk, says nothing of its own."""


class _log_to:
    """One log per session folder."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> None:
        try:
            self.handler = _LogFile(self.path, encoding="utf-8")
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written: {error.strerror or error}") from error
        self.handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
        log.addHandler(self.handler)
        log.setLevel(logging.INFO)
        log.propagate = False

    def __exit__(self, *_: object) -> None:
        log.removeHandler(self.handler)
        self.handler.close()
