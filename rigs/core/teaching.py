"""Motions that teach a rig where its plate is: touches, and what a person jogs by hand.

Every motion here ends by itself, has a hard limit beyond which the arm never goes, and looks at
stop requests every 10 ms; whatever goes wrong, the arm is stopped before anything else.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sliplab.protocols.program import Move, Position
from sliplab.rigs.core.capabilities import ArmFault, ArmState, Pose, RigError, Segment
from sliplab.rigs.core.pulse_code import SEEDS
from sliplab.rigs.core.rig import RETRACT_SPEED_MM_S, Rig, StopRequested, arm_fault
from sliplab.rigs.core.touching import LOOK_S, QUIET_S, MarkerTouch, RateTouch
from sliplab.storage.streams import FrameChunk

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
MarkerFinder = Callable[[FrameChunk], F64]
"""From frames to column and row of every marker, the centre's first, (k, m, 2), NaN where lost."""

FRAMES_HZ = 100
APPROACH_MM_S = 5.0
"""From clear of the plate to where creeping begins; events are watched on the way."""
MOST_CREEP_MM_S = 1.0
ASLANT = 0.1
"""Sideways motion of an oblique path for each mm in."""
_UNTRUE = {ArmState.PROTECTIVE_STOP, ArmState.EMERGENCY_STOP, ArmState.DISCONNECTED}
_APPROACH_LOOK_S = 0.05
_GRACE_S = 5.0
_OVER_MM = 0.05
"""Distance beyond its limit at which the arm is stopped; poses are noisy."""


@dataclass(frozen=True)
class Creep:
    """Parameters of the search for a touch.

    Attributes:
        speed_mm_s: creeping speed, at most `MOST_CREEP_MM_S`.
        search_mm: hard limit beyond the plane that the rig assumes.
        clearance_mm: how far before that plane creeping begins.
        after_mm: how much farther it may go, within the limit, after events have shown a touch
            and the markers, which are looked at, have not.
    """

    speed_mm_s: float = 0.5
    search_mm: float = 2.0
    clearance_mm: float = 3.0
    after_mm: float = 0.3

    def __post_init__(self) -> None:
        """Raises ValueError where a number is not positive or creeping would not be creeping."""
        numbers = (self.speed_mm_s, self.search_mm, self.clearance_mm, self.after_mm)
        if not all(0.0 < number < 1e3 for number in numbers):
            raise ValueError("creeping speed and distances must be more than 0")
        if self.speed_mm_s > MOST_CREEP_MM_S:
            raise ValueError(f"a creeping speed is at most {MOST_CREEP_MM_S:g} mm/s")


@dataclass(frozen=True)
class Touch:
    """One touch at (x, y) of the assumed plane; depths in mm from it into the plate.

    Attributes:
        depth_mm: of the surface; by event rate `touch_mm` of the rig is taken off.
        deepest_mm: how deep the arm went.
    """

    x_mm: float
    y_mm: float
    depth_mm: float
    deepest_mm: float


def touch(
    rig: Rig, x_mm: float, y_mm: float, creep: Creep, seed: int, find: MarkerFinder | None = None
) -> Touch:
    """Touch the plate once at (x, y) of the plane that the rig assumes, and let go.

    Out along the plate's normal, across, in at `APPROACH_MM_S` to `clearance_mm` before the plane
    and at creeping speed from there, until the touch is noticed, or to `search_mm` beyond the
    plane, where the arm's path ends. Without `find` a touch is noticed by event rate, on a path
    straight in. With it by the motion of markers, on a path that goes aslant: then a papilla that
    holds on to the plate stays behind the free ones.

    Args:
        seed: what a simulated rig draws its randomness from.
        find: finds the markers in frames of the outside camera.

    Raises:
        StopRequested: `rig.should_stop` became true; the arm is stopped and clear.
        RigError: nothing was noticed within the limit, something was met before creeping began,
            or a device failed; the arm is stopped, and clear if it is healthy.
    """
    aslant = 0.0 if find is None else ASLANT
    clear = Position(x_mm - aslant * creep.clearance_mm, y_mm, -creep.clearance_mm)
    deepest = Position(x_mm + aslant * creep.search_mm, y_mm, creep.search_mm)
    with rig.safely(clear):
        at = rig.position()
        out = Position(at.x_mm, at.y_mm, min(at.depth_mm, clear.depth_mm))
        across = Position(clear.x_mm, clear.y_mm, out.depth_mm)
        rig.move(Move("out", out, RETRACT_SPEED_MM_S), at)
        rig.move(Move("across", across, RETRACT_SPEED_MM_S), out)
        if rig.simulation is not None:
            rig.simulation.begin_trial(seed)
        # on any failure it is left to `safely` to stop them: the arm comes first
        _start(rig, seed, find is not None)
        rig.wait(QUIET_S)
        rate = RateTouch(rig.central_events())
        _approach(rig, across, clear, rate)
        watch = _Watch(rig, creep, rate, find)
        _creep(rig, clear, deepest, watch)
        for device in (rig.events, rig.frames, rig.sync):
            with suppress(RigError):
                device.stop()
        at = rig.position()
        rig.move(
            Move("release", Position(at.x_mm, at.y_mm, clear.depth_mm), RETRACT_SPEED_MM_S), at
        )
    if watch.touched_mm is None:
        raise watch.nothing()
    return Touch(x_mm, y_mm, watch.touched_mm, watch.deepest_mm)


def _start(rig: Rig, seed: int, with_frames: bool) -> None:
    rig.events.start()
    if not with_frames:
        return
    by_itself = rig.timing.frames == "exposure line"
    if not by_itself:
        rig.frames.start()
    rig.sync.start(FRAMES_HZ, seed % SEEDS + 1, rig.timing.code)
    if by_itself:
        rig.frames.start()


def _approach(rig: Rig, begin: Position, end: Position, rate: RateTouch) -> None:
    """In to where creeping begins, faster; whatever is met on the way ends it."""
    way = begin.distance_mm(end)
    if way == 0.0:
        return
    rig.arm.start([Segment(rig.plate_frame.pose(end), APPROACH_MM_S)])
    deadline = rig.clock.now_ns() + int((2 * way / APPROACH_MM_S + _GRACE_S) * 1e9)
    while not (progress := rig.arm.progress()).done:
        if rig.clock.now_ns() > deadline:
            raise ArmFault("arm", "did not come near the plate in time")
        rig.wait(_APPROACH_LOOK_S)
        if rig.central_events() > rate.limit:
            rig.arm.stop()
            depth = rig.position().depth_mm
            raise RigError(
                "arm",
                f"met something {-depth:.1f} mm before the plane that the rig assumes, where it "
                "was not creeping yet: begin farther away (--clearance), or teach by hand",
            )
    if not progress.state.healthy:
        raise arm_fault(progress.state, "approach")
    if not progress.finished:
        raise ArmFault("arm", f"was stopped from outside, at {rig.position().depth_mm:.2f} mm")


class _Watch:
    """Looks for a touch while the arm creeps, and knows how deep it may go."""

    def __init__(self, rig: Rig, creep: Creep, rate: RateTouch, find: MarkerFinder | None) -> None:
        self._rig, self._creep, self._rate, self._find = rig, creep, rate, find
        self._markers = MarkerTouch()
        self._host_ns: list[int] = []
        self._depth_mm: list[float] = []
        self._by_events_mm: float | None = None
        self._limit_mm = creep.search_mm + _OVER_MM
        self.speed_mm_s = creep.speed_mm_s
        self.deepest_mm = -creep.clearance_mm
        self.touched_mm: float | None = None

    def look(self) -> bool:
        """Look once; whether creeping is over."""
        rig = self._rig
        depth = rig.position().depth_mm
        self.deepest_mm = max(self.deepest_mm, depth)
        if self._rate.touched(rig.central_events()) and self._by_events_mm is None:
            self._by_events_mm = depth - self.speed_mm_s * self._rate.LATE_S - rig.touch_mm
            self._limit_mm = min(self._limit_mm, depth + self._creep.after_mm)
            if self._find is None:
                self.touched_mm = self._by_events_mm
        if self._find is not None:
            self._host_ns.append(rig.clock.now_ns())
            self._depth_mm.append(depth)
            chunk = rig.frames.read()
            rig.sync.read_pulses()
            when = self._markers.add(self._find(chunk), chunk.host_ns) if len(chunk) else None
            if when is not None:
                self.touched_mm = float(np.interp(when, self._host_ns, self._depth_mm))
        return self.touched_mm is not None or depth > self._limit_mm

    def nothing(self) -> RigError:
        """Return the error that says why nothing was found."""
        if self._by_events_mm is not None:
            return RigError(
                "frame camera",
                f"saw no marker move up to {self.deepest_mm:.3f} mm, but events told of a touch "
                f"at {self._by_events_mm:.3f} mm: does it see the centre marker? (--by events "
                "does without)",
            )
        if self.deepest_mm < self._creep.search_mm - _OVER_MM:
            return ArmFault("arm", f"was stopped from outside, at {self.deepest_mm:.2f} mm")
        return RigError(
            "arm",
            f"met nothing within the hard limit of {self._creep.search_mm:g} mm beyond the plane "
            "that the rig assumes, and has gone back: teach by hand, or allow more (--search)",
        )


def _creep(rig: Rig, clear: Position, deepest: Position, watch: _Watch) -> None:
    seconds = clear.distance_mm(deepest) / watch.speed_mm_s
    rig.arm.start([Segment(rig.plate_frame.pose(deepest), watch.speed_mm_s)])
    deadline = rig.clock.now_ns() + int((2 * seconds + _GRACE_S) * 1e9)
    while not rig.arm.progress().done:
        rig.wait(LOOK_S)
        if watch.look():
            break
        if rig.clock.now_ns() > deadline:
            raise ArmFault("arm", "did not end creeping in time")
    rig.arm.stop()
    state = rig.arm.state()
    if not state.healthy:  # a stopped arm touched nothing, but the plane is not to blame
        raise arm_fault(state, "creeping")


def jogged(rig: Rig, prompts: list[tuple[str, str]]) -> list[Pose]:
    """Poses to which a person jogs the arm, one a prompt.

    Args:
        prompts: what to do, and the word that says that it is done.

    Raises:
        StopRequested: the person said stop, or `rig.should_stop` became true.
        RigError: the arm moves while it should stand, was stopped, or does not answer.
    """
    poses = []
    for prompt, word in prompts:
        if not rig.operator.ask("jog", prompt, word) or rig.should_stop():
            raise StopRequested
        state = rig.arm.state()
        if state in _UNTRUE:  # others, such as local control, only keep it from being commanded
            raise arm_fault(state, word)
        pose = rig.arm.pose()
        rig.wait(0.2)
        if not np.allclose(rig.arm.pose().xyz_mm, pose.xyz_mm, atol=0.05):
            raise RigError("arm", f"still moves after '{word}': let it stand, then confirm")
        poses.append(pose)
    return poses


def look(rig: Rig, seconds: float = 0.3) -> FrameChunk:
    """Frames of the outside camera while nothing moves; the region has to be set before.

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
        raise RigError("frame camera", f"gave no frame in {seconds:g} s")
    return chunks[-1]


def stir(rig: Rig, depth_mm: float, radius_mm: float, speed_mm_s: float, seed: int) -> I64:
    """Press the skin at the plate's centre and move it in a circle, once either way round.

    Returns:
        events of each pixel in the first round and in the second, (2, height, width).

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
        rig.move(Move("out", out, RETRACT_SPEED_MM_S), at)
        rig.move(Move("home", home, RETRACT_SPEED_MM_S), out)
        if rig.simulation is not None:
            rig.simulation.begin_trial(seed)
        rig.move(Move("press", middle, 2.0), home)
        rig.wait(1.0)
        rig.events.start()
        at = middle
        for number, way in enumerate((ring, ring[::-1])):
            for place in (*way, middle):
                rig.move(Move("stir", place, speed_mm_s), at)
                at = place
                chunk = rig.events.read()
                np.add.at(count[number], (chunk.y, chunk.x), 1)
        rig.events.stop()
        rig.move(Move("release", home, RETRACT_SPEED_MM_S), at)
    return count
