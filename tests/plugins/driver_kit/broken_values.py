"""Drivers with wrong magnitudes: units, signs, orders, times and speeds that the rules catch.

Each is an example driver with one defect. Unlike one of `broken`, such a defect may break several
rules; those that are about it are named here. None can be named in a rig file.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sliplab.plugins.driver_kit.examples import arm, events, force, frames, gripper, sync
from sliplab.plugins.driver_kit.examples.arm.driver import ExampleArm
from sliplab.plugins.driver_kit.examples.events.driver import ExampleEvents
from sliplab.plugins.driver_kit.examples.force.driver import ExampleForce
from sliplab.plugins.driver_kit.examples.frames.fake import FakedExampleFrames
from sliplab.plugins.driver_kit.examples.gripper.driver import ExampleGripper
from sliplab.plugins.driver_kit.examples.sync.driver import ExampleSync
from sliplab.rigs.core.capabilities import ArmState, Pose, Progress
from sliplab.rigs.core.driver import Driver
from sliplab.rigs.core.pose import distance_mm
from sliplab.storage.streams import EventChunk, PoseChunk
from tests.patching import put
from tests.plugins.driver_kit.broken import Broken
from tests.protocols.planning import rows

Change = Callable[[Any], Any]
COUNTER = 1 << 32
WAIT_S = 0.3


def reports(base: type[Any], change: Change, *methods: str) -> type[Any]:
    """Derive a driver whose methods return what `change` makes of a result that is not empty."""

    def changed(name: str) -> Callable[..., Any]:
        def method(self: Any, *arguments: Any) -> Any:
            found = getattr(base, name)(self, *arguments)
            return found if hasattr(found, "__len__") and not len(found) else change(found)

        return method

    return type("Reports", (base,), {name: changed(name) for name in methods})


def takes(base: type[Any], name: str, change: Callable[..., tuple[Any, ...]]) -> type[Any]:
    """Derive a driver one of whose methods gets its arguments changed by `change`."""

    def method(self: Any, *arguments: Any) -> Any:
        return getattr(base, name)(self, *change(self, *arguments))

    return type("Takes", (base,), {name: method})


def scaled(**factors: Any) -> Change:
    """Return a change that multiplies fields, or swaps their columns by a list of these."""

    def change(chunk: Any) -> Any:
        new = {}
        for name, factor in factors.items():
            old = getattr(chunk, name)
            new[name] = old[:, factor] if isinstance(factor, list) else old * factor
        return replace(chunk, **new)

    return change


def wrapped(name: str, step: int) -> Change:
    """Return a change that takes a time for a counter of 32 bits of so many units."""
    return lambda chunk: replace(chunk, **{name: getattr(chunk, name) % (COUNTER * step)})


def us(name: str) -> Change:
    """Return a change that takes a time in ns for one in us."""
    return lambda chunk: replace(chunk, **{name: getattr(chunk, name) // 1000})


def at_host(time_ns: Callable[[], int]) -> Change:
    """Return a change that sets the host's time."""
    return lambda chunk: replace(chunk, host_ns=np.full_like(chunk.host_ns, time_ns()))


# -- arms ----------------------------------------------------------------------------------------


def moves(change: Callable[[ExampleArm, list[float]], list[float]]) -> type[Any]:
    """Derive an arm that is sent other numbers: place, rotation vector, speed."""

    def request(self: ExampleArm, text: str) -> tuple[str]:
        word, *numbers = text.split()
        if word != "MOVE":
            return (text,)
        values = change(self, [float(number) for number in numbers])
        return ("MOVE " + " ".join(f"{value:.6f}" for value in values),)

    return takes(ExampleArm, "_ask", request)


def poses(change: Change) -> type[Any]:
    """Derive an arm whose `pose` and samples are changed alike."""

    def of_pose(pose: Pose) -> Pose:
        none = np.zeros(1, np.int64)
        chunk = PoseChunk(none, none, np.array([pose.xyz_mm]), np.array([pose.rotvec_deg]))
        new = change(chunk)
        return Pose((*new.xyz_mm[0].tolist(),), (*new.rotvec_deg[0].tolist(),))

    return reports(reports(ExampleArm, change, "read_poses"), of_pose, "pose")


def turns_twice(self: ExampleArm, values: list[float]) -> list[float]:
    """Double the speed of a turn on the spot."""
    x, y, z, *turn, speed = values
    spot = distance_mm(self.pose(), Pose((x, y, z), (0.0, 0.0, 0.0))) < 1e-3
    return [x, y, z, *turn, (2.0 if spot else 1.0) * speed]


def scalar_last(chunk: PoseChunk) -> PoseChunk:
    """Take quaternions w x y z for x y z w."""
    wxyz = Rotation.from_rotvec(chunk.rotvec_deg, degrees=True).as_quat(scalar_first=True)
    turned = Rotation.from_quat(wxyz, scalar_first=False)
    return replace(chunk, rotvec_deg=turned.as_rotvec(degrees=True))


def counted(line: str) -> str:
    """Cut the time in a line of a pose to 32 bits."""
    word, *words = line.split(" ")
    if word == "POSE":
        words[0] = str(int(words[0]) % COUNTER)
    return " ".join([word, *words])


def inverted(line: str) -> str:
    """Invert the level of the sync input in a line of a pose."""
    return line[:-1] + "10"[int(line[-1])] if line.startswith("POSE ") else line


class CutsCorners(ExampleArm):
    """The arm goes straight to the end of the path."""

    def _follow_path(self, run: Any) -> None:
        whole, run.path = run.path, run.path[-1:]
        super()._follow_path(run)
        run.finished[:] = run.finished * len(whole)


class KeepsFinished(ExampleArm):
    """Segments of the path before count as finished, too."""

    def start(self, path: Any) -> None:
        """Begin to follow a path."""
        before = self._run.finished
        super().start(path)
        self._run.finished[:0] = before


class DoneTooEarly(ExampleArm):
    """The path counts as done shortly before its end."""

    def progress(self) -> Progress:
        """Return the progress."""
        path = self._run.path
        if not path or distance_mm(self.pose(), path[-1].to) > 2.0:
            return super().progress()
        now_ns = self.now_ns()
        return Progress(ArmState.READY, ((now_ns, now_ns),) * len(path), done=True)


class ProgressWaits(ExampleArm):
    """Progress waits for the end of the path."""

    def progress(self) -> Progress:
        """Return the progress."""
        self._run.join(3.0)
        return super().progress()


class StopDoesNotWait(ExampleArm):
    """Stop returns once it is sent, and the arm still brakes."""

    def _halt(self) -> None:
        self._ask("STOP")


class SamplesTwice(ExampleArm):
    """Each read returns the last sample of the one before, too."""

    last: PoseChunk | None = None

    def read_poses(self) -> PoseChunk:
        """Return the poses since the last call."""
        found, last = super().read_poses(), self.last
        if not len(found):
            return found
        self.last = found[-1:]
        return found if last is None else PoseChunk.concatenate([last, found])


class CommandedPose(ExampleArm):
    """The pose is that which was commanded last."""

    def pose(self) -> Pose:
        """Return a pose."""
        path = self._run.path
        return path[-1].to if path else super().pose()


class PoseLate(ExampleArm):
    """The pose is that of half a second ago."""

    def pose(self) -> Pose:
        """Return a pose."""
        seen, now = self.__dict__.setdefault("seen", []), time.monotonic()
        seen.append((now, super().pose()))
        return next((pose for at, pose in reversed(seen) if at < now - 0.5), seen[0][1])


class ClockStands(ExampleArm):
    """`now_ns` is the time of the first pose."""

    first_ns: int | None = None

    def now_ns(self) -> int:
        """Return a time."""
        self.first_ns = self.first_ns or super().now_ns()
        return self.first_ns


class StopsOnce(ExampleArm):
    """Only the first stop of a moving arm is sent."""

    stopped = False

    def _halt(self) -> None:
        if not self.stopped:
            super()._halt()
        self.stopped, self._may_move = True, False


class MovesAfterStop(ExampleArm):
    """A pending move is sent to the controller after the stop."""

    def _follow_path(self, run: Any) -> None:
        threading.Event().wait(0.08)
        run.cancelled = False
        super()._follow_path(run)


class ArmHostTimeOfRead(ExampleArm):
    """Poses have the host's time at which they were read."""

    def read_poses(self) -> PoseChunk:
        """Return the poses since the last call."""
        chunk = super().read_poses()
        return replace(chunk, host_ns=np.full(len(chunk), time.monotonic_ns()))


class LastSegmentOnly(ExampleArm):
    """Only the last segment of a path is held against the limits."""

    def start(self, path: Any) -> None:
        """Start a path whose last segment lies within the limits."""
        last, check = path[-1:], self._guard.check
        put(self._guard, "check", lambda begin, path: check(begin, last))
        try:
            super().start(path)
        finally:
            put(self._guard, "check", check)


def averaged(chunk: PoseChunk) -> PoseChunk:
    """Set all places to their mean."""
    return replace(chunk, xyz_mm=np.broadcast_to(chunk.xyz_mm.mean(axis=0), chunk.xyz_mm.shape))


def always_ready(progress: Progress) -> Progress:
    """Report an arm as ready in every state."""
    return replace(progress, state=ArmState.READY)


def taken_for_ready(*states: ArmState) -> Callable[[ArmState], ArmState]:
    """Return a change that takes some states for ready."""
    return lambda state: ArmState.READY if state in states else state


def without_tilt(self: ExampleArm, path: Any) -> tuple[Any]:
    """Lift the limit of a turn."""
    limits = self._guard._limits
    assert limits is not None
    self._guard._limits = limits.model_copy(update={"tilt_deg": 180.0})
    return (path,)


def host_spans(progress: Progress) -> Progress:
    """Set the times of segments to the host's."""
    now_ns = time.monotonic_ns()
    return replace(progress, finished=tuple((now_ns, now_ns) for _ in progress.finished))


def ready(state: ArmState) -> ArmState:
    """Take an arm that moves for one that is ready."""
    return ArmState.READY if state is ArmState.MOVING else state


def swapped_stops(state: ArmState) -> ArmState:
    """Take a protective stop for an emergency stop."""
    return ArmState.EMERGENCY_STOP if state is ArmState.PROTECTIVE_STOP else state


ARMS: dict[str, type[Any]] = {
    "TenTimesTooFast": moves(lambda self, v: [*v[:6], 10 * v[6]]),
    "SpeedIgnored": moves(lambda self, v: [*v[:6], 50.0]),
    "SlowMovesTooFast": moves(lambda self, v: [*v[:6], max(v[6], 10.0)]),
    "StopsOnce": StopsOnce,
    "MovesAfterStop": MovesAfterStop,
    "DropsThirdSegment": takes(ExampleArm, "start", lambda self, path: (path[:2],)),
    "LastSegmentOnly": LastSegmentOnly,
    "EmergencyIsReady": reports(ExampleArm, taken_for_ready(ArmState.EMERGENCY_STOP), "state"),
    "OffIsReady": reports(ExampleArm, taken_for_ready(ArmState.NOT_RUNNING), "state"),
    "ProgressAlwaysReady": reports(ExampleArm, always_ready, "progress"),
    "PosesAveraged": reports(ExampleArm, averaged, "read_poses"),
    "ArmHostTimeOfRead": ArmHostTimeOfRead,
    "TurnsTwiceTooFast": moves(turns_twice),
    "CommandsRadians": moves(lambda self, v: [*v[:3], *np.radians(v[3:6]), v[6]]),
    "CutsCorners": CutsCorners,
    "HostSegmentTimes": reports(ExampleArm, host_spans, "progress"),
    "DoneTooEarly": DoneTooEarly,
    "KeepsFinished": KeepsFinished,
    "ReadyWhileMoving": reports(ExampleArm, ready, "state"),
    "StopsSwapped": reports(ExampleArm, swapped_stops, "state"),
    "ProgressWaits": ProgressWaits,
    "StopDoesNotWait": StopDoesNotWait,
    "TiltNotChecked": takes(ExampleArm, "start", without_tilt),
    "PosesInMetres": poses(scaled(xyz_mm=1e-3)),
    "PosesInRadians": poses(scaled(rotvec_deg=np.pi / 180)),
    "ScalarPartLast": poses(scalar_last),
    "AxesSwapped": reports(ExampleArm, scaled(xyz_mm=[1, 0, 2]), "read_poses"),
    "HeightFlipped": reports(ExampleArm, scaled(xyz_mm=np.array([1, 1, -1])), "read_poses"),
    "SamplesTwice": SamplesTwice,
    "NewestSampleOnly": reports(ExampleArm, lambda c: c[-1:], "read_poses"),
    "LosesLastSample": reports(ExampleArm, lambda c: c[:-1], "read_poses"),
    "HostTimeIsZero": reports(ExampleArm, at_host(lambda: 0), "read_poses"),
    "HostTimeOld": reports(
        ExampleArm, lambda c: replace(c, host_ns=c.host_ns - 600_000_000), "read_poses"
    ),
    "HostWallClock": reports(ExampleArm, at_host(time.time_ns), "read_poses"),
    "HostTimeStands": reports(ExampleArm, at_host(cache(time.monotonic_ns)), "read_poses"),
    "CommandedPose": CommandedPose,
    "PoseLate": PoseLate,
    "ClockStands": ClockStands,
    "ClockInMicroseconds": reports(
        reports(ExampleArm, us("t_ns"), "read_poses"), lambda t_ns: t_ns // 1000, "now_ns"
    ),
    "ArmCounterWraps": takes(ExampleArm, "_take", lambda self, line: (counted(line),)),
    "PulsesLate": reports(
        ExampleArm, lambda c: replace(c, t_ns=c.t_ns + 60_000_000), "read_pulses"
    ),
    "NoPulses": reports(ExampleArm, lambda c: replace(c, t_ns=c.t_ns[:0]), "read_pulses"),
    "FallingEdges": takes(ExampleArm, "_take", lambda self, line: (inverted(line),)),
}


# -- cameras and sensors -------------------------------------------------------------------------


class ReadWaits(ExampleEvents):
    """Read waits for events."""

    def read(self) -> EventChunk:
        """Events since the last call."""
        found = super().read()
        if not len(found):
            threading.Event().wait(WAIT_S)
        return found


class StopDrops(ExampleEvents):
    """Stop drops what was not read."""

    def stop(self) -> None:
        """Stop streaming."""
        super().stop()
        self._buffer.take("events")


class EventsTwice(ExampleEvents):
    """Each read returns the events of the one before, too."""

    last: EventChunk | None = None

    def read(self) -> EventChunk:
        """Events since the last call."""
        found, last = super().read(), self.last
        self.last = found if len(found) else last
        return EventChunk.concatenate([last, found]) if last is not None and len(found) else found


class OldPulses(ExampleEvents):
    """Start keeps the pulses that were not read."""

    old: Any = None

    def start(self) -> None:
        """Start streaming."""
        self.old = super().read_pulses()
        super().start()

    def read_pulses(self) -> Any:
        """Sync pulses since the last call."""
        found, old, self.old = super().read_pulses(), self.old, None
        return found if old is None else replace(found, t_ns=np.append(old.t_ns, found.t_ns))


class SizeSwapped(ExampleEvents):
    """Columns and rows are swapped."""

    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        self.width, self.height = self.height, self.width


class RegionStays(FakedExampleFrames):
    """The first region stays."""

    first: tuple[int, int] | None = None

    def set_region(self, width_px: int, height_px: int) -> None:
        """Read out a region."""
        self.first = self.first or (width_px, height_px)
        super().set_region(*self.first)


class NumbersOfItsOwn(FakedExampleFrames):
    """Frames are numbered as they come."""

    count = 0

    def start(self) -> None:
        """Start grabbing."""
        self.count = 0
        super().start()

    def read(self) -> Any:
        """Frames since the last call."""
        found = super().read()
        first, self.count = self.count, self.count + len(found)
        return replace(found, number=np.arange(first, self.count, dtype=np.int64))


class StartOfExposure(FakedExampleFrames):
    """Times are those of the beginning of the exposure."""

    def read(self) -> Any:
        """Frames since the last call."""
        found = super().read()
        return replace(found, t_ns=found.t_ns - self.mid_exposure_ns)


class BufferReused(ExampleForce):
    """Each read writes into the arrays of the one before."""

    forces = np.empty((10_000, 3))

    def read(self) -> Any:
        """Forces and torques since the last call."""
        chunk = super().read()
        self.forces[: len(chunk)] = chunk.force_n
        return replace(chunk, force_n=self.forces[: len(chunk)])


class ZeroHides(ExampleForce):
    """After zero every load is zero."""

    share = 1.0

    def zero(self) -> None:
        """Take the present load for zero."""
        self.share = 0.0

    def read(self) -> Any:
        """Forces and torques since the last call."""
        return scaled(force_n=self.share, torque_nm=self.share)(super().read())


class ZeroOnce(ExampleForce):
    """Only the first zero counts."""

    zeroed = False

    def zero(self) -> None:
        """Take the present load for zero."""
        if not self.zeroed:
            super().zero()
        self.zeroed = True


class KeepsTicking(ExampleSync):
    """Stop drops what comes, and the box ticks on."""

    def stop(self) -> None:
        """Stop."""
        self._buffer.end()


def first_of_each_time(chunk: EventChunk) -> EventChunk:
    """Keep the first one of events at the same time."""
    _, rows = np.unique(chunk.t_us, return_index=True)
    return chunk[rows]


def first_load(chunk: Any) -> Any:
    """Repeat the force of the first sample."""
    return replace(chunk, force_n=np.repeat(chunk.force_n[:1], len(chunk), axis=0))


def wall_reads(reads: Any) -> Any:
    """Set the host's times of a read to the time of day."""
    ahead_ns = time.time_ns() - time.monotonic_ns()
    return replace(reads, before_ns=reads.before_ns + ahead_ns, after_ns=reads.after_ns + ahead_ns)


def _read(base: type[Any], change: Change) -> type[Any]:
    return reports(base, change, "read")


EVENTS: dict[str, type[Any]] = {
    "SizeSwapped": SizeSwapped,
    "ColumnsSwapped": _read(ExampleEvents, lambda c: replace(c, x=c.y, y=c.x)),
    "PolarityInverted": _read(ExampleEvents, lambda c: replace(c, p=1 - c.p)),
    "PolaritySigned": _read(ExampleEvents, lambda c: replace(c, p=c.p.astype(np.int8) * 2 - 1)),
    "EventsInNanoseconds": _read(ExampleEvents, scaled(t_us=1000)),
    "EventCounterWraps": _read(ExampleEvents, lambda c: replace(c, t_us=c.t_us % COUNTER)),
    "EventsTwice": EventsTwice,
    "OneEventATime": _read(ExampleEvents, first_of_each_time),
    "PulsesInMicroseconds": reports(ExampleEvents, us("t_ns"), "read_pulses"),
    "StopDrops": StopDrops,
    "OldPulses": OldPulses,
    "ReadWaits": ReadWaits,
}
FRAMES: dict[str, type[Any]] = {
    "Transposed": _read(
        FakedExampleFrames, lambda c: replace(c, images=c.images.transpose(0, 2, 1))
    ),
    "UpsideDown": _read(FakedExampleFrames, lambda c: replace(c, images=c.images[:, ::-1])),
    "StartOfExposure": StartOfExposure,
    "LevelInverted": _read(FakedExampleFrames, lambda c: replace(c, sync=1 - c.sync)),
    "HostTimeOfCamera": _read(FakedExampleFrames, lambda c: replace(c, host_ns=c.t_ns)),
    "HostTimeOfRead": _read(FakedExampleFrames, at_host(time.monotonic_ns)),
    "FrameCounterWraps": _read(FakedExampleFrames, wrapped("t_ns", 1000)),
    "FrameNumberOf16Bits": _read(FakedExampleFrames, lambda c: replace(c, number=c.number % 2**16)),
    "NumbersOfItsOwn": NumbersOfItsOwn,
    "RegionStays": RegionStays,
}
FORCE: dict[str, type[Any]] = {
    "MilliNewtons": _read(ExampleForce, scaled(force_n=1e3)),
    "NewtonMillimetres": _read(ExampleForce, scaled(torque_nm=1e3)),
    "Reaction": _read(ExampleForce, scaled(force_n=-1.0)),
    "ForceAxesSwapped": _read(ExampleForce, scaled(force_n=[2, 1, 0])),
    "BufferReused": BufferReused,
    "OneLoad": _read(ExampleForce, first_load),
    "ForceHostTimeIsZero": _read(ExampleForce, at_host(lambda: 0)),
    "ForceCounterWraps": _read(ExampleForce, wrapped("t_ns", 1_000_000)),
    "ZeroOnce": ZeroOnce,
    "ZeroHides": ZeroHides,
}
BOXES: dict[str, type[Any]] = {
    "SeedIgnored": takes(
        ExampleSync, "start", lambda self, hz, seed, code: (hz, seed and 77, code)
    ),
    "CodeIgnored": takes(ExampleSync, "start", lambda self, hz, seed, code: (hz, seed, "lfsr")),
    "HalfTheRate": takes(ExampleSync, "start", lambda self, hz, seed, code: (hz / 2, seed, code)),
    "KeepsTicking": KeepsTicking,
    "BoxClockInMicroseconds": reports(ExampleSync, us("device_ns"), "read_clock"),
    "BoxHostWallClock": reports(ExampleSync, wall_reads, "read_clock"),
    "ClockOfPowerOn": reports(
        ExampleSync, lambda c: replace(c, device_ns=c.device_ns + 3_000_000_000), "read_clock"
    ),
    "BoxCounterWraps": reports(ExampleSync, wrapped("device_ns", 1000), "read_clock"),
    "PulseCounterWraps": reports(ExampleSync, wrapped("t_ns", 1000), "read_pulses"),
    "EndOfPulses": reports(
        ExampleSync, lambda c: replace(c, t_ns=c.t_ns + 2_500_000), "read_pulses"
    ),
    "ExposuresInMicroseconds": reports(ExampleSync, us("t_ns"), "read_exposures"),
}


# -- grippers ------------------------------------------------------------------------------------


class TargetReported(ExampleGripper):
    """The reported opening is the requested one."""

    target: float | None = None

    def move(self, opening_mm: float, speed_mm_s: float, force_n: float) -> None:
        """Start a move."""
        super().move(opening_mm, speed_mm_s, force_n)
        self.target = opening_mm

    def state(self) -> Any:
        """Return opening and motion."""
        found = super().state()
        return found if self.target is None else replace(found, opening_mm=self.target)


class RestsTooEarly(ExampleGripper):
    """The fingers count as at rest once they are near the end of their move."""

    target = 0.0

    def move(self, opening_mm: float, speed_mm_s: float, force_n: float) -> None:
        """Start a move."""
        super().move(opening_mm, speed_mm_s, force_n)
        self.target = opening_mm

    def state(self) -> Any:
        """Return opening and motion."""
        found = super().state()
        return replace(found, moving=found.moving and abs(found.opening_mm - self.target) > 3.0)


class OpensOnConnect(ExampleGripper):
    """Connecting opens the fingers, as an activation does."""

    def connect(self) -> None:
        """Open the connection."""
        super().connect()
        self.move(self.range.opening_mm[1], self.range.speed_mm_s[1], self.range.force_n[0])


class StopOpens(ExampleGripper):
    """Stop opens the fingers."""

    def stop(self) -> None:
        """Stop."""
        self.move(self.range.opening_mm[1], self.range.speed_mm_s[1], self.range.force_n[0])


class StopWaitsForAnswer(ExampleGripper):
    """Stop is sent only once the answer to another call has come."""

    def stop(self) -> None:
        """Stop."""
        with self._asking:
            super().stop()


def percent(self: ExampleGripper, line: str) -> tuple[str]:
    """Send the force of a move in percent of the largest one."""
    word, *values = line.split()
    if word == "MOVE":
        values[2] = str(100.0 * float(values[2]) / self.range.force_n[1])
    return (" ".join([word, *values]),)


GRIPPERS: dict[str, type[Any]] = {
    "OpensToClose": takes(ExampleGripper, "move", lambda self, mm, *rest: (80.0 - mm, *rest)),
    "GripperSpeedIgnored": takes(
        ExampleGripper, "move", lambda self, mm, speed, force: (mm, 90.0, force)
    ),
    "GripperForceInPercent": takes(ExampleGripper, "_send", percent),
    "OpeningInSteps": reports(
        ExampleGripper, lambda s: replace(s, opening_mm=10 * s.opening_mm), "state"
    ),
    "TargetReported": TargetReported,
    "RestsTooEarly": RestsTooEarly,
    "StopOpens": StopOpens,
    "StopWaitsForAnswer": StopWaitsForAnswer,
    "OpensOnConnect": OpensOnConnect,
}


def _declared(declaration: Driver[Any], name: str, device: type[Any]) -> Driver[Any]:
    if declaration is frames.DRIVER:
        return replace(frames.DRIVER, name=name, fake=device)
    if declaration is force.DRIVER:
        return replace(force.DRIVER, name=name, build=lambda settings, arm: device(settings))
    changes: dict[str, Any] = {"name": name, "build": device}
    return replace(declaration, **changes)


# driver | rules that are about its defect | what the first of them finds
FOUND = r"""
    TenTimesTooFast | speed and length | followed at .* instead of 40 mm/s
    SpeedIgnored | speed and length | followed at 50.0 mm/s
    SlowMovesTooFast | speed and length | 10.0 mm/s instead of 2 mm/s
    StopsOnce | stop while moving | still moving when the call
    MovesAfterStop | stop while moving | still moving when the call|moved
    DropsThirdSegment | path | before the end
    LastSegmentOnly | limits | that leaves the box and returns
    EmergencyIsReady | emergency stop | no call reported it
    OffIsReady | power off | no call reported it
    ProgressAlwaysReady | calls while moving, protective stop | the state of its progress was
    PosesAveraged | poses | read_poses returned
    ArmHostTimeOfRead | host times | of all poses of a read was the same
    TurnsTwiceTooFast | turn | followed at 40.0 deg/s instead of 20
    CommandsRadians | orientation | orientation was
    CutsCorners | speed and length | came no nearer to the end of segment 1
    HostSegmentTimes | speed and length | segment 1 was reported to begin
    DoneTooEarly | path, calls while moving | before the end of the path
    KeepsFinished | path | 4 segments of the next path, of one
    ReadyWhileMoving | calls while moving | its state was ArmState.READY
    StopsSwapped | protective stop | its state was ArmState.EMERGENCY_STOP
    ProgressWaits | calls while moving | had not returned before the arm was at rest
    StopDoesNotWait | stop while moving | still moving when the call
    TiltNotChecked | limits of turn and depth | turns the tool too far
    PosesInMetres | poses | pose returned \(0\.4
    PosesInRadians | orientation | returned the rotation vector
    ScalarPartLast | orientation | returned the rotation vector
    AxesSwapped | poses | read_poses returned
    HeightFlipped | poses | , -3
    SamplesTwice | poses | was read twice
    NewestSampleOnly | poses | returned 1 samples of 0.000 s
    LosesLastSample | poses | each read loses some
    HostTimeIsZero | host times | host_ns was 0, received
    HostTimeOld | host times | was 0.* s old when it was read
    HostWallClock | host times | host_ns was 1
    HostTimeStands | host times | host_ns (was|of)
    CommandedPose | poses | and not there in the
    PoseLate | poses | and not there in the
    ClockStands | clock | now_ns went on by -?0|came when now_ns
    ClockInMicroseconds | clock | now_ns went on by|came when now_ns
    ArmCounterWraps | counter wraps | fell back
    PulsesLate | sync input | or more from its rising edge
    NoPulses | sync input | 0 of about 4 pulses
    FallingEdges | sync input | from the nearest rising edge
    SizeSwapped | sensor size | width and height were 48 x 64
    ColumnsSwapped | data | x came otherwise
    PolarityInverted | data | p came otherwise
    PolaritySigned | arrays | p was an array of int8
    EventsInNanoseconds | data | t_us came otherwise|were sent and
    EventCounterWraps | counter wraps | came after
    EventsTwice | data | came after|were sent and
    OneEventATime | data | were sent and
    PulsesInMicroseconds | data | pulses up to
    StopDrops | read after stop | could not be read after it
    OldPulses | fresh start | began with pulses of the first one
    ReadWaits | read at once | read took
    Transposed | region | frames of
    UpsideDown | data | images came otherwise
    StartOfExposure | data | t_ns up to 50.* was sent
    LevelInverted | level of the sync line | of the sync line, and came with
    HostTimeOfCamera | host times | host_ns was
    HostTimeOfRead | host times | after a sample was sent
    FrameCounterWraps | counter wraps | came after
    FrameNumberOf16Bits | lost frames | number came otherwise
    NumbersOfItsOwn | lost frames | number came otherwise
    RegionStays | another region | frames of
    MilliNewtons | data | force_n came otherwise
    NewtonMillimetres | data | torque_nm came otherwise
    Reaction | data | force_n came otherwise
    ForceAxesSwapped | data | force_n came otherwise
    BufferReused | data | a read changed the arrays
    OneLoad | data | force_n came otherwise
    ForceHostTimeIsZero | host times | host_ns was 0
    ForceCounterWraps | counter wraps | came after
    ZeroOnce | zero | was not zero after a second zero
    ZeroHides | zero | its change was not read
    SeedIgnored | trains | the box sent 200 Hz, seed 77
    CodeIgnored | trains | and code lfsr
    HalfTheRate | trains | the box sent 100 Hz
    KeepsTicking | ticks stop | the box still ticked
    BoxClockInMicroseconds | clock | the clock went on by
    BoxHostWallClock | clock | times before and after
    ClockOfPowerOn | clock at start | after start its clock was
    BoxCounterWraps | counter wraps | went on by
    PulseCounterWraps | counter wraps | no pulse had|silent for
    EndOfPulses | data | pulses came at
    ExposuresInMicroseconds | exposures | an exposure between
    OpensToClose | values of a move, move of the fingers | requested
    GripperSpeedIgnored | values of a move | the fingers went at
    GripperForceInPercent | values of a move | the gripper was sent
    OpeningInSteps | state while moving | the fingers were at
    TargetReported | state while moving | the fingers were at
    RestsTooEarly | state while moving, values of a move | while the fingers moved it reported
    StopOpens | stop of the fingers | the fingers opened to 80 mm after
    StopWaitsForAnswer | silent gripper | it waited for the answer to another call
    OpensOnConnect | fingers stay | the fingers went from
"""


WRONG_VALUES = tuple(
    Broken(_declared(declaration, name, table[name]), tuple(rules.split(", ")), "|".join(seen))
    for name, rules, *seen in rows(FOUND)
    for declaration, table in (
        (arm.DRIVER, ARMS),
        (events.DRIVER, EVENTS),
        (frames.DRIVER, FRAMES),
        (force.DRIVER, FORCE),
        (sync.DRIVER, BOXES),
        (gripper.DRIVER, GRIPPERS),
    )
    if name in table
)
"""Each driver with wrong magnitudes, with the rules that apply and the first rule's finding."""
