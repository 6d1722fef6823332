"""Motions that teach a rig where its plate is: automatic touches, and poses jogged by hand.

Every motion here is bounded in time, has a hard limit beyond which the arm never goes, and checks
for stop requests every 10 ms. On any failure the arm is stopped before anything else.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sliplab.protocols.program import Move, Position
from sliplab.protocols.protocol_limits import MAX_CREEP_MM_S
from sliplab.rigs.core.capabilities import ArmFault, ArmState, Pose, RigError, Segment
from sliplab.rigs.core.host_clock import OR_BUSY, StallTimer
from sliplab.rigs.core.pulse_code import SEEDS
from sliplab.rigs.core.rig import RETRACT_SPEED_MM_S, Rig, StopRequested, arm_fault
from sliplab.rigs.core.surface_search import central_events, measure_noise
from sliplab.rigs.core.touching import POLL_S, MarkerTouch, RateTouch
from sliplab.storage.streams import FrameChunk

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
MarkerFinder = Callable[[FrameChunk], F64]
"""Maps frames to column and row of every marker, the centre's first, (k, m, 2), NaN if lost."""

FRAMES_HZ = 100
APPROACH_MM_S = 5.0
"""Speed from clear of the plate to where creeping begins; events are monitored meanwhile."""
OBLIQUE_SLOPE = 0.1
"""Lateral motion of an oblique approach per mm of depth."""
STILL_S = 1.0
"""Longest time without a new image, s, while the markers move in it."""
_POSE_INVALID = {ArmState.PROTECTIVE_STOP, ArmState.EMERGENCY_STOP, ArmState.DISCONNECTED}
_APPROACH_POLL_S = 0.05
_GRACE_S = 5.0
_OVERTRAVEL_MM = 0.05
"""Distance beyond the limit at which the arm is stopped, because measured poses are noisy."""


@dataclass(frozen=True)
class Creep:
    """Parameters of the search for a touch.

    Attributes:
        speed_mm_s: creeping speed, at most `MAX_CREEP_MM_S`.
        search_mm: hard limit beyond the plane that the rig assumes.
        clearance_mm: distance before that plane at which creeping begins.
        after_mm: when the markers decide, the distance that the arm may still go, within the
            limit, once events have shown a touch and the markers have not.
    """

    speed_mm_s: float = 0.5
    search_mm: float = 2.0
    clearance_mm: float = 3.0
    after_mm: float = 0.3

    def __post_init__(self) -> None:
        """Raise ValueError if a number is not positive or the speed is too high for creeping."""
        numbers = (self.speed_mm_s, self.search_mm, self.clearance_mm, self.after_mm)
        if not all(0.0 < number < 1e3 for number in numbers):
            raise ValueError("creeping speed and distances must be more than 0")
        if self.speed_mm_s > MAX_CREEP_MM_S:
            raise ValueError(f"the creeping speed must be at most {MAX_CREEP_MM_S:g} mm/s")


@dataclass(frozen=True)
class Touch:
    """One touch at (x, y) of the assumed plane; depths in mm from it into the plate.

    Attributes:
        depth_mm: depth of the surface; `touch_mm` of the rig is subtracted where events decided.
        deepest_mm: greatest depth that the arm reached.
    """

    x_mm: float
    y_mm: float
    depth_mm: float
    deepest_mm: float


def touch(
    rig: Rig, x_mm: float, y_mm: float, creep: Creep, seed: int, find: MarkerFinder | None = None
) -> Touch:
    """Touch the plate once at (x, y) of the plane that the rig assumes, and retract.

    The arm moves out along the plate's normal, then across, then in at `APPROACH_MM_S` to
    `clearance_mm` before the plane. From there it creeps until a touch is detected, or to
    `search_mm` beyond the plane, where its path ends. Without `find` the event rate shows the
    touch, and the path goes straight in. With `find` the motion of the markers shows it, on an
    oblique path: a papilla that sticks to the plate then stays behind the free ones.

    Args:
        seed: seed of a simulated rig's randomness.
        find: finds the markers in frames of the outside camera.

    Raises:
        StopRequested: `rig.should_stop` became true; the arm is stopped and clear.
        RigError: no touch was detected within the limit, contact was made before creeping began,
            or a device failed; the arm is stopped, and clear if it is healthy.
    """
    slope = 0.0 if find is None else OBLIQUE_SLOPE
    clear = Position(x_mm - slope * creep.clearance_mm, y_mm, -creep.clearance_mm)
    deepest = Position(x_mm + slope * creep.search_mm, y_mm, creep.search_mm)
    with rig.safely(clear):
        at = rig.position()
        out = Position(at.x_mm, at.y_mm, min(at.depth_mm, clear.depth_mm))
        across = Position(clear.x_mm, clear.y_mm, out.depth_mm)
        out_mm_s = rig.at_most(RETRACT_SPEED_MM_S)
        rig.move(Move("out", out, out_mm_s), at)
        rig.move(Move("across", across, out_mm_s), out)
        rig.begin_clear(seed)
        # on any failure `safely` stops the streams, after the arm
        _start(rig, seed, find is not None)
        rate = measure_noise(rig)
        _approach(rig, across, clear, rate)
        detector = _TouchDetector(rig, creep, rate, find)
        _creep(rig, clear, deepest, detector)
        for device in (rig.events, rig.frames, rig.sync):
            with suppress(RigError):
                device.stop()
        at = rig.position()
        rig.move(Move("release", Position(at.x_mm, at.y_mm, clear.depth_mm), out_mm_s), at)
    if detector.touched_mm is None:
        raise detector.not_found()
    return Touch(x_mm, y_mm, detector.touched_mm, detector.deepest_mm)


def _start(rig: Rig, seed: int, with_frames: bool) -> None:
    rig.events.start()
    if not with_frames:
        return
    free_running = rig.timing.frames == "exposure line"
    if not free_running:
        rig.frames.start()
    rig.sync.start(FRAMES_HZ, seed % SEEDS + 1, rig.timing.code)
    if free_running:
        rig.frames.start()


def _approach(rig: Rig, begin: Position, end: Position, rate: RateTouch) -> None:
    """Move fast to where creeping begins; contact before that is an error."""
    distance = begin.distance_mm(end)
    if distance == 0.0:
        return
    speed_mm_s = rig.at_most(APPROACH_MM_S)
    with rig.moving(Segment(rig.plate_frame.pose(end), speed_mm_s)):
        deadline = rig.clock.now_ns() + int((2 * distance / speed_mm_s + _GRACE_S) * 1e9)
        while not (progress := rig.arm.progress()).done:
            if rig.clock.now_ns() > deadline:
                raise ArmFault("arm", "did not finish its approach to the plate in time")
            rig.wait(_APPROACH_POLL_S)
            if central_events(rig) > rate.limit:
                rig.arm.stop()
                depth = rig.position().depth_mm
                raise RigError(
                    "arm",
                    f"made contact {-depth:.1f} mm before the plane that the rig assumes, during "
                    "the fast approach: begin farther away (--clearance), or teach by hand",
                )
    if not progress.state.healthy:
        raise arm_fault(progress.state, "approach")
    if not progress.finished:
        raise ArmFault("arm", f"was stopped from outside, at {rig.position().depth_mm:.2f} mm")


class _TouchDetector:
    """Detects a touch while the arm creeps, and holds the depth limit."""

    def __init__(self, rig: Rig, creep: Creep, rate: RateTouch, find: MarkerFinder | None) -> None:
        self._rig, self._creep, self._rate, self._find = rig, creep, rate, find
        self._markers = MarkerTouch()
        self._images = StallTimer(rig.clock.now_ns)
        self._image: tuple[int | None] = (None,)
        self._host_ns: list[int] = []
        self._depth_mm: list[float] = []
        self._by_events_mm: float | None = None
        self._limit_mm = creep.search_mm + _OVERTRAVEL_MM
        self.speed_mm_s = creep.speed_mm_s
        self.deepest_mm = -creep.clearance_mm
        self.touched_mm: float | None = None

    def poll(self) -> bool:
        """Read the streams once; return whether creeping is over."""
        rig = self._rig
        depth = rig.position().depth_mm
        self.deepest_mm = max(self.deepest_mm, depth)
        touched = self._rate.touched(central_events(rig), depth, rig.clock.now_ns())
        if touched and self._by_events_mm is None:
            self._look_back()
            self._limit_mm = min(self._limit_mm, depth + self._creep.after_mm)
        if self._find is not None:
            self._host_ns.append(rig.clock.now_ns())
            self._depth_mm.append(depth)
            chunk = rig.frames.read()
            rig.sync.read_pulses()
            self._check_images(chunk)
            when = self._markers.add(self._find(chunk), chunk.host_ns) if len(chunk) else None
            if when is not None:
                self.touched_mm = float(np.interp(when, self._host_ns, self._depth_mm))
        return self.touched_mm is not None or depth > self._limit_mm

    def _check_images(self, chunk: FrameChunk) -> None:
        """Raise RigError if the camera's image has not changed for too long."""
        if len(chunk):
            last = chunk.images[-1] if chunk.markers_px is None else chunk.markers_px[-1]
            self._image = (zlib.crc32(last.tobytes()),)
        still_s = self._images.waited_s(self._image)
        if still_s > STILL_S:
            raise RigError(
                "frame camera",
                f"sent no new image for {still_s:.1f} s while the sensor moves in it; the arm was "
                f"stopped: check the camera's trigger and cable, or use --by events{OR_BUSY}",
            )

    def end(self) -> None:
        """Look at the events of the whole creep, if no touch was noticed on the way."""
        if self._by_events_mm is None and not self._stopped_outside():
            self._look_back()

    def _look_back(self) -> None:
        surface = self._rate.surface_mm(self.speed_mm_s)
        if surface is not None:
            self._by_events_mm = surface - self._rig.touch_mm
            if self._find is None:
                self.touched_mm = self._by_events_mm

    def _stopped_outside(self) -> bool:
        return self.deepest_mm < self._creep.search_mm - _OVERTRAVEL_MM

    def not_found(self) -> RigError:
        """Return the error that says why no touch was found."""
        if self._by_events_mm is not None:
            return RigError(
                "frame camera",
                f"saw no marker move up to {self.deepest_mm:.3f} mm, but events showed a touch "
                f"at {self._by_events_mm:.3f} mm: check that the centre marker is in view, or use "
                "--by events",
            )
        if self._stopped_outside():
            return ArmFault("arm", f"was stopped from outside, at {self.deepest_mm:.2f} mm")
        return RigError(
            "arm",
            f"found no plate within the hard limit of {self._creep.search_mm:g} mm beyond the "
            "assumed plane, and has retracted: teach by hand, or allow more (--search)",
        )


def _creep(rig: Rig, clear: Position, deepest: Position, detector: _TouchDetector) -> None:
    seconds = clear.distance_mm(deepest) / detector.speed_mm_s
    with rig.moving(Segment(rig.plate_frame.pose(deepest), detector.speed_mm_s)):
        deadline = rig.clock.now_ns() + int((2 * seconds + _GRACE_S) * 1e9)
        while not rig.arm.progress().done:
            rig.wait(POLL_S)
            if detector.poll():
                break
            if rig.clock.now_ns() > deadline:
                raise ArmFault("arm", "did not finish creeping in time")
        rig.arm.stop()
    rig.rests_here(detector.speed_mm_s)
    state = rig.arm.state()
    if not state.healthy:  # a stopped arm finds no plate, though the taught plane may be right
        raise arm_fault(state, "creeping")
    detector.end()


def jog_poses(rig: Rig, prompts: list[tuple[str, str]]) -> list[Pose]:
    """Ask the operator to jog the arm, and return the pose after each prompt.

    Args:
        prompts: the instruction, and the word that confirms it.

    Raises:
        StopRequested: the operator requested a stop, or `rig.should_stop` became true.
        RigError: the arm moves while it should be at rest, was stopped, or does not answer.
    """
    poses = []
    for prompt, word in prompts:
        if not rig.operator.ask("jog", prompt, word) or rig.should_stop():
            raise StopRequested
        state = rig.arm.state()
        if state in _POSE_INVALID:  # in others, such as local control, the pose is still right
            raise arm_fault(state, word)
        pose = rig.pose()
        rig.wait(0.2)
        if not np.allclose(rig.pose().xyz_mm, pose.xyz_mm, atol=0.05):
            raise RigError("arm", f"is still moving after '{word}': let it stop, then confirm")
        poses.append(pose)
    return poses


def grab_frames(rig: Rig, seconds: float = 0.3) -> FrameChunk:
    """Return frames of the outside camera while nothing moves; set the camera's region first.

    Raises:
        RigError: no frame came.
    """
    chunks = []
    try:
        _start(rig, 1, True)
        end = rig.clock.now_ns() + round(seconds * 1e9)
        while rig.clock.now_ns() < end:
            rig.wait(0.05)
            chunks.append(rig.frames.read())
            rig.sync.read_pulses()
    finally:
        for device in (rig.frames, rig.sync, rig.events):
            with suppress(RigError):
                device.stop()
    chunks = [chunk for chunk in chunks if len(chunk)]
    if not chunks:
        raise RigError("frame camera", f"delivered no frame within {seconds:g} s")
    return chunks[-1]


def press_in_circles(
    rig: Rig, depth_mm: float, radius_mm: float, speed_mm_s: float, seed: int
) -> I64:
    """Press the skin at the plate's centre and move it in a circle, once in each direction.

    Returns:
        events per pixel in the first circle and in the second, (2, height, width).

    Raises:
        StopRequested, RigError: as `touch`.
    """
    home = Position(0.0, 0.0, -5.0)
    angles = np.linspace(0.0, 2.0 * np.pi, 17)
    ring = [Position(radius_mm * np.cos(a), radius_mm * np.sin(a), depth_mm) for a in angles]
    middle = Position(0.0, 0.0, depth_mm)
    count = np.zeros((2, rig.events.height, rig.events.width), np.int64)
    with rig.safely(home):
        at = rig.position()
        out = Position(at.x_mm, at.y_mm, min(at.depth_mm, home.depth_mm))
        out_mm_s = rig.at_most(RETRACT_SPEED_MM_S)
        rig.move(Move("out", out, out_mm_s), at)
        rig.move(Move("home", home, out_mm_s), out)
        rig.begin_clear(seed)
        rig.move(Move("press", middle, rig.at_most(2.0)), home)
        rig.wait(1.0)
        rig.events.start()
        at = middle
        for number, circle in enumerate((ring, ring[::-1])):
            for place in (*circle, middle):
                rig.move(Move("circle", place, speed_mm_s), at)
                at = place
                chunk = rig.events.read()
                np.add.at(count[number], (chunk.y, chunk.x), 1)
        rig.events.stop()
        rig.move(Move("release", home, out_mm_s), at)
    return count
