"""Drivers with wrong magnitudes: units, signs, orders, times and speeds that the rules catch.

Each is an example driver with one defect. Unlike those of `broken`, a defect of this kind may break
several rules; the one that is about it is named here. None can be named in a rig file.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sliplab.protocols.timing import Code
from sliplab.rigs.core.capabilities import (
    ArmState,
    GripperState,
    Pose,
    Progress,
    Segment,
)
from sliplab.rigs.core.driver import Driver
from sliplab.rigs.core.pose import distance_mm
from sliplab.rigs.testing.broken import Broken, arm_driver, event_driver, force_driver
from sliplab.rigs.testing.examples import frames, gripper, sync
from sliplab.rigs.testing.examples.arm.driver import ExampleArm
from sliplab.rigs.testing.examples.events.driver import ExampleEvents
from sliplab.rigs.testing.examples.force.driver import ExampleForce
from sliplab.rigs.testing.examples.frames.fake import FakedExampleFrames
from sliplab.rigs.testing.examples.gripper.driver import ExampleGripper
from sliplab.rigs.testing.examples.sync.driver import ExampleSync
from sliplab.storage.streams import (
    I64,
    ClockReads,
    EventChunk,
    FrameChunk,
    PoseChunk,
    PulseChunk,
    WrenchChunk,
)

_UNSIGNED = 1 << 32

# -- arms ----------------------------------------------------------------------------------------


class _Commands(ExampleArm):
    """An arm whose moves are changed on their way to the controller."""

    def _ask(self, request: str) -> int:
        word, *numbers = request.split()
        if word == "MOVE":
            values = self._changed([float(number) for number in numbers])
            request = "MOVE " + " ".join(f"{value:.6f}" for value in values)
        return super()._ask(request)

    def _changed(self, values: list[float]) -> list[float]:
        raise NotImplementedError

    def _turns(self, values: list[float]) -> bool:
        x, y, z = values[:3]
        return distance_mm(self.pose(), Pose((x, y, z), (0.0, 0.0, 0.0))) < 1e-3


class TenTimesTooFast(_Commands):
    """Speeds are sent in a unit ten times smaller."""

    def _changed(self, values: list[float]) -> list[float]:
        return [*values[:6], 10.0 * values[6]]


class SpeedIgnored(_Commands):
    """Every move has the same speed."""

    def _changed(self, values: list[float]) -> list[float]:
        return [*values[:6], 50.0]


class TurnsTwiceTooFast(_Commands):
    """Moves have their speed, turns on the spot twice theirs."""

    def _changed(self, values: list[float]) -> list[float]:
        return [*values[:6], values[6] * (2.0 if self._turns(values) else 1.0)]


class CommandsRadians(_Commands):
    """Rotation vectors are sent in radians to a controller that takes degrees."""

    def _changed(self, values: list[float]) -> list[float]:
        return [*values[:3], *np.radians(values[3:6]).tolist(), values[6]]


class CutsCorners(ExampleArm):
    """The arm goes straight to the end of the path."""

    def _follow_path(self, run: Any) -> None:
        whole, run.path = run.path, run.path[-1:]
        super()._follow_path(run)
        run.finished[:] = run.finished * len(whole)


class HostSegmentTimes(ExampleArm):
    """Begin and end of segments are times of the host's clock."""

    def progress(self) -> Progress:
        """Return the progress."""
        found = super().progress()
        now_ns = time.monotonic_ns()
        return replace(found, finished=tuple((now_ns, now_ns) for _ in found.finished))


class DoneTooEarly(ExampleArm):
    """The path counts as done shortly before its end."""

    def progress(self) -> Progress:
        """Return the progress."""
        found, path = super().progress(), self._run.path
        near = bool(path) and distance_mm(self.pose(), path[-1].to) < 2.0
        if not near:
            return found
        now_ns = self.now_ns()
        return Progress(ArmState.READY, ((now_ns, now_ns),) * len(path), done=True)


class ReadyWhileMoving(ExampleArm):
    """The state is ready as long as the link is good."""

    def state(self) -> ArmState:
        """Return the state."""
        found = super().state()
        return ArmState.READY if found is ArmState.MOVING else found


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


class TiltNotChecked(ExampleArm):
    """The limit of a turn is not held against the path."""

    def start(self, path: Sequence[Segment]) -> None:
        """Start a path."""
        limits = self._guard._limits
        self._guard._limits = limits.model_copy(update={"tilt_deg": 180.0})
        super().start(path)


class _Poses(ExampleArm):
    """An arm whose poses are changed when they are reported."""

    def pose(self) -> Pose:
        """Return the last pose."""
        found = super().pose()
        chunk = PoseChunk(
            np.zeros(1, np.int64), np.zeros(1, np.int64), np.array([found.xyz_mm]),
            np.array([found.rotvec_deg]),
        )  # fmt: skip
        wrong = self._changed(chunk)
        return Pose((*wrong.xyz_mm[0].tolist(),), (*wrong.rotvec_deg[0].tolist(),))

    def read_poses(self) -> PoseChunk:
        """Return the poses since the last call."""
        found = super().read_poses()
        return self._changed(found) if len(found) else found

    def _changed(self, poses: PoseChunk) -> PoseChunk:
        raise NotImplementedError


class PosesInMetres(_Poses):
    """Positions are reported in metres."""

    def _changed(self, poses: PoseChunk) -> PoseChunk:
        return replace(poses, xyz_mm=poses.xyz_mm / 1000.0)


class PosesInRadians(_Poses):
    """Rotation vectors are reported in radians."""

    def _changed(self, poses: PoseChunk) -> PoseChunk:
        return replace(poses, rotvec_deg=np.radians(poses.rotvec_deg))


class ScalarPartLast(_Poses):
    """Quaternions w x y z are taken for x y z w."""

    def _changed(self, poses: PoseChunk) -> PoseChunk:
        wxyz = Rotation.from_rotvec(poses.rotvec_deg, degrees=True).as_quat(scalar_first=True)
        turned = Rotation.from_quat(wxyz, scalar_first=False)
        return replace(poses, rotvec_deg=turned.as_rotvec(degrees=True))


class _Samples(ExampleArm):
    """An arm whose samples are changed when they are read."""

    def read_poses(self) -> PoseChunk:
        """Return the poses since the last call."""
        found = super().read_poses()
        return self._changed(found) if len(found) else found

    def _changed(self, poses: PoseChunk) -> PoseChunk:
        raise NotImplementedError


class AxesSwapped(_Samples):
    """Samples have y before x."""

    def _changed(self, poses: PoseChunk) -> PoseChunk:
        return replace(poses, xyz_mm=poses.xyz_mm[:, [1, 0, 2]])


class HeightFlipped(_Samples):
    """Samples have z downwards."""

    def _changed(self, poses: PoseChunk) -> PoseChunk:
        return replace(poses, xyz_mm=poses.xyz_mm * [1.0, 1.0, -1.0])


class SamplesTwice(_Samples):
    """Each read returns the last sample of the one before, too."""

    before: PoseChunk | None = None

    def _changed(self, poses: PoseChunk) -> PoseChunk:
        last, self.before = self.before, poses
        if last is None:
            return poses
        names = vars(poses)
        return PoseChunk(*(np.concatenate([getattr(last, n)[-1:], names[n]]) for n in names))


class HostTimeIsZero(_Samples):
    """The host's time is not set."""

    def _changed(self, poses: PoseChunk) -> PoseChunk:
        return replace(poses, host_ns=np.zeros_like(poses.host_ns))


class HostWallClock(_Samples):
    """The host's time is the time of day, not the monotonic clock."""

    def _changed(self, poses: PoseChunk) -> PoseChunk:
        return replace(poses, host_ns=poses.host_ns + time.time_ns() - time.monotonic_ns())


class HostTimeStands(_Samples):
    """The host's time is that of the first sample."""

    first_ns: int | None = None

    def _changed(self, poses: PoseChunk) -> PoseChunk:
        self.first_ns = self.first_ns or int(poses.host_ns[0])
        return replace(poses, host_ns=np.full_like(poses.host_ns, self.first_ns))


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
        kept = self.__dict__.setdefault("kept", [])
        now = time.monotonic()
        kept.append((now, super().pose()))
        return next((pose for at, pose in reversed(kept) if at < now - 0.5), kept[0][1])


class ClockStands(ExampleArm):
    """`now_ns` is the time of the first pose."""

    first_ns: int | None = None

    def now_ns(self) -> int:
        """Return a time."""
        self.first_ns = self.first_ns or super().now_ns()
        return self.first_ns


class ClockInMicroseconds(_Samples):
    """Times are microseconds, called ns."""

    def now_ns(self) -> int:
        """Return a time."""
        return super().now_ns() // 1000

    def _changed(self, poses: PoseChunk) -> PoseChunk:
        return replace(poses, t_ns=poses.t_ns // 1000)


class ArmCounterWraps(ExampleArm):
    """The controller's microseconds are taken for a counter of 32 bits that never wraps."""

    def _take(self, line: str) -> None:
        word, *words = line.split(" ")
        if word == "POSE":
            words[0] = str(int(words[0]) % _UNSIGNED)
        super()._take(" ".join([word, *words]))


class FallingEdges(ExampleArm):
    """Falling edges of the sync input are reported."""

    def _take(self, line: str) -> None:
        if line.startswith("POSE "):
            line = line[:-1] + ("0" if line.endswith("1") else "1")
        super()._take(line)


# -- event cameras -------------------------------------------------------------------------------


class SizeSwapped(ExampleEvents):
    """Columns are taken for rows."""

    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        self.width, self.height = self.height, self.width


class _Events(ExampleEvents):
    """A camera whose events are changed when they are read."""

    def read(self) -> EventChunk:
        """Events since the last call."""
        found = super().read()
        return self._changed(found) if len(found) else found

    def _changed(self, events: EventChunk) -> EventChunk:
        raise NotImplementedError


class ColumnsSwapped(_Events):
    """Columns and rows of events are swapped."""

    def _changed(self, events: EventChunk) -> EventChunk:
        return replace(events, x=events.y, y=events.x)


class PolarityInverted(_Events):
    """Brighter is 0."""

    def _changed(self, events: EventChunk) -> EventChunk:
        return replace(events, p=1 - events.p)


class PolaritySigned(_Events):
    """Darker is -1."""

    def _changed(self, events: EventChunk) -> EventChunk:
        return replace(events, p=events.p.astype(np.int8) * 2 - 1)


class EventsInNanoseconds(_Events):
    """Times of events are ns."""

    def _changed(self, events: EventChunk) -> EventChunk:
        return replace(events, t_us=events.t_us * 1000)


class EventCounterWraps(_Events):
    """The camera's counter of 32 bits is not unwrapped."""

    def _changed(self, events: EventChunk) -> EventChunk:
        return replace(events, t_us=events.t_us % _UNSIGNED)


class EventsTwice(_Events):
    """Each read returns the events of the one before, too."""

    before: EventChunk | None = None

    def _changed(self, events: EventChunk) -> EventChunk:
        last, self.before = self.before, events
        return EventChunk.joined([last, events]) if last is not None else events


class OneEventATime(_Events):
    """Of events at the same time only the first is returned."""

    def _changed(self, events: EventChunk) -> EventChunk:
        _, first = np.unique(events.t_us, return_index=True)
        return EventChunk(*(column[first] for column in vars(events).values()))


class PulsesInMicroseconds(ExampleEvents):
    """Times of pulses are us, called ns."""

    def read_pulses(self) -> PulseChunk:
        """Sync pulses since the last call."""
        return PulseChunk(super().read_pulses().t_ns // 1000)


class ReadWaits(ExampleEvents):
    """Read waits for events."""

    def read(self) -> EventChunk:
        """Events since the last call."""
        found = super().read()
        if not len(found):
            threading.Event().wait(0.3)
        return found


# -- frame cameras -------------------------------------------------------------------------------


class _Frames(FakedExampleFrames):
    """A camera whose frames are changed when they are read."""

    def read(self) -> FrameChunk:
        """Frames since the last call."""
        found = super().read()
        return self._changed(found) if len(found) else found

    def _changed(self, frames: FrameChunk) -> FrameChunk:
        raise NotImplementedError


class Transposed(_Frames):
    """Images have columns before rows."""

    def _changed(self, frames: FrameChunk) -> FrameChunk:
        return replace(frames, images=frames.images.transpose(0, 2, 1))


class UpsideDown(_Frames):
    """Images begin with their last row."""

    def _changed(self, frames: FrameChunk) -> FrameChunk:
        return replace(frames, images=frames.images[:, ::-1])


class StartOfExposure(_Frames):
    """Times are those of the beginning of the exposure."""

    def _changed(self, frames: FrameChunk) -> FrameChunk:
        return replace(frames, t_ns=frames.t_ns - self.mid_exposure_ns)


class LevelInverted(_Frames):
    """The sync line is taken for active low."""

    def _changed(self, frames: FrameChunk) -> FrameChunk:
        return replace(frames, sync=1 - frames.sync)


class HostTimeOfCamera(_Frames):
    """The host's time is the camera's."""

    def _changed(self, frames: FrameChunk) -> FrameChunk:
        return replace(frames, host_ns=frames.t_ns)


class HostTimeOfRead(_Frames):
    """The host's time is that of the read."""

    def _changed(self, frames: FrameChunk) -> FrameChunk:
        return replace(frames, host_ns=np.full_like(frames.host_ns, time.monotonic_ns()))


class FrameCounterWraps(_Frames):
    """The camera's microseconds of 32 bits are not unwrapped."""

    def _changed(self, frames: FrameChunk) -> FrameChunk:
        return replace(frames, t_ns=frames.t_ns % (_UNSIGNED * 1000))


class NumbersOfItsOwn(_Frames):
    """Frames are numbered as they come."""

    count = 0

    def start(self) -> None:
        """Start grabbing."""
        self.count = 0
        super().start()

    def _changed(self, frames: FrameChunk) -> FrameChunk:
        first, self.count = self.count, self.count + len(frames)
        return replace(frames, number=np.arange(first, self.count, dtype=np.int64))


class RegionKept(_Frames):
    """The first region stays."""

    def set_region(self, width_px: int, height_px: int) -> None:
        """Read out a region."""
        if "region" not in self.__dict__:
            self.region = width_px, height_px
        super().set_region(*self.region)

    def _changed(self, frames: FrameChunk) -> FrameChunk:
        return frames


# -- force sensors -------------------------------------------------------------------------------


class _Loads(ExampleForce):
    """A sensor whose samples are changed when they are read."""

    def read(self) -> WrenchChunk:
        """Forces and torques since the last call."""
        found = super().read()
        return self._changed(found) if len(found) else found

    def _changed(self, load: WrenchChunk) -> WrenchChunk:
        raise NotImplementedError


class MilliNewtons(_Loads):
    """Forces are mN."""

    def _changed(self, load: WrenchChunk) -> WrenchChunk:
        return replace(load, force_n=load.force_n * 1000.0)


class NewtonMillimetres(_Loads):
    """Torques are N mm."""

    def _changed(self, load: WrenchChunk) -> WrenchChunk:
        return replace(load, torque_nm=load.torque_nm * 1000.0)


class Reaction(_Loads):
    """Forces have the other sign."""

    def _changed(self, load: WrenchChunk) -> WrenchChunk:
        return replace(load, force_n=-load.force_n)


class ForceAxesSwapped(_Loads):
    """Forces have z first."""

    def _changed(self, load: WrenchChunk) -> WrenchChunk:
        return replace(load, force_n=load.force_n[:, ::-1])


class OneLoad(_Loads):
    """Every sample of a read has the load of the first one."""

    def _changed(self, load: WrenchChunk) -> WrenchChunk:
        return replace(load, force_n=np.repeat(load.force_n[:1], len(load), axis=0))


class ForceHostTimeIsZero(_Loads):
    """The host's time is not set."""

    def _changed(self, load: WrenchChunk) -> WrenchChunk:
        return replace(load, host_ns=np.zeros_like(load.host_ns))


class ForceCounterWraps(_Loads):
    """The sensor's ms of 32 bits are not unwrapped."""

    def _changed(self, load: WrenchChunk) -> WrenchChunk:
        return replace(load, t_ns=load.t_ns % (_UNSIGNED * 1_000_000))


class ZeroHides(_Loads):
    """After zero every load is zero."""

    zeroed = False

    def zero(self) -> None:
        """Take the present load for zero."""
        self.zeroed = True

    def _changed(self, load: WrenchChunk) -> WrenchChunk:
        share = 0.0 if self.zeroed else 1.0
        return replace(load, force_n=share * load.force_n, torque_nm=share * load.torque_nm)


# -- sync boxes ----------------------------------------------------------------------------------


class SeedIgnored(ExampleSync):
    """Every train has the same seed."""

    def start(self, rate_hz: float, seed: int, code: Code) -> None:
        """Start a train."""
        super().start(rate_hz, seed and 77, code)


class CodeIgnored(ExampleSync):
    """Every train has the same code."""

    def start(self, rate_hz: float, seed: int, code: Code) -> None:
        """Start a train."""
        super().start(rate_hz, seed, "lfsr")


class HalfTheRate(ExampleSync):
    """The rate is that of pulses and gaps together."""

    def start(self, rate_hz: float, seed: int, code: Code) -> None:
        """Start a train."""
        super().start(rate_hz / 2, seed, code)


class KeepsTicking(ExampleSync):
    """Stop drops what comes, and the box ticks on."""

    def stop(self) -> None:
        """Stop."""
        self._buffer.end()


class _Clock(ExampleSync):
    """A box whose clock is changed when it is read."""

    def read_clock(self) -> ClockReads:
        """Read the clock."""
        return self._changed(super().read_clock())

    def _changed(self, reads: ClockReads) -> ClockReads:
        raise NotImplementedError


class BoxClockInMicroseconds(_Clock):
    """The clock is us, called ns."""

    def _changed(self, reads: ClockReads) -> ClockReads:
        return replace(reads, device_ns=reads.device_ns // 1000)


class BoxHostWallClock(_Clock):
    """The host's times are the time of day."""

    def _changed(self, reads: ClockReads) -> ClockReads:
        ahead_ns = time.time_ns() - time.monotonic_ns()
        return replace(
            reads, before_ns=reads.before_ns + ahead_ns, after_ns=reads.after_ns + ahead_ns
        )


class ClockOfPowerOn(_Clock):
    """The clock counts from an earlier time than tick 0."""

    def _changed(self, reads: ClockReads) -> ClockReads:
        return replace(reads, device_ns=reads.device_ns + 3_000_000_000)


class BoxCounterWraps(_Clock):
    """The box's counter of 32 bits is not unwrapped."""

    def read_pulses(self) -> PulseChunk:
        """Pulses since the last call."""
        return PulseChunk(self._wrapped(super().read_pulses().t_ns))

    def _changed(self, reads: ClockReads) -> ClockReads:
        return replace(reads, device_ns=self._wrapped(reads.device_ns))

    def _wrapped(self, t_ns: I64) -> I64:
        return t_ns % (_UNSIGNED * 1000)


class BitsInverted(ExampleSync):
    """Pulses are reported half a tick late, as of a line that is active low."""

    def read_pulses(self) -> PulseChunk:
        """Pulses since the last call."""
        return PulseChunk(super().read_pulses().t_ns + 2_500_000)


class ExposuresInMilliseconds(ExampleSync):
    """Times of exposures are a thousand times too small."""

    def read_exposures(self) -> PulseChunk:
        """Starts of exposures since the last call."""
        return PulseChunk(super().read_exposures().t_ns // 1000)


# -- grippers ------------------------------------------------------------------------------------


class OpensToClose(ExampleGripper):
    """Openings are sent as strokes from the open end."""

    def move(self, opening_mm: float, speed_mm_s: float, force_n: float) -> None:
        """Start a move."""
        super().move(self.range.opening_mm[1] - opening_mm, speed_mm_s, force_n)


class GripperSpeedIgnored(ExampleGripper):
    """Every move has the largest speed."""

    def move(self, opening_mm: float, speed_mm_s: float, force_n: float) -> None:
        """Start a move."""
        speed = speed_mm_s if speed_mm_s != speed_mm_s else self.range.speed_mm_s[1]
        super().move(opening_mm, speed, force_n)


class GripperForceInPercent(ExampleGripper):
    """The force is sent in percent of the largest one."""

    def _send(self, line: str) -> None:
        word, *values = line.split()
        if word == "MOVE":
            values[2] = str(100.0 * float(values[2]) / self.range.force_n[1])
        super()._send(" ".join([word, *values]))


class OpeningInSteps(ExampleGripper):
    """The opening is reported in the gripper's steps."""

    def state(self) -> GripperState:
        """Return opening and motion."""
        found = super().state()
        return replace(found, opening_mm=found.opening_mm / self.range.step_mm)


class TargetReported(ExampleGripper):
    """The opening is that which was asked for."""

    target: float | None = None

    def move(self, opening_mm: float, speed_mm_s: float, force_n: float) -> None:
        """Start a move."""
        super().move(opening_mm, speed_mm_s, force_n)
        self.target = opening_mm

    def state(self) -> GripperState:
        """Return opening and motion."""
        found = super().state()
        return found if self.target is None else replace(found, opening_mm=self.target)


class RestsAtOnce(ExampleGripper):
    """The fingers count as at rest once they are near the end of their move."""

    target = 0.0

    def move(self, opening_mm: float, speed_mm_s: float, force_n: float) -> None:
        """Start a move."""
        super().move(opening_mm, speed_mm_s, force_n)
        self.target = opening_mm

    def state(self) -> GripperState:
        """Return opening and motion."""
        found = super().state()
        return replace(found, moving=found.moving and abs(found.opening_mm - self.target) > 3.0)


class OpensWhenClosed(ExampleGripper):
    """Connecting opens the fingers, as an activation does."""

    def connect(self) -> None:
        """Open the connection."""
        super().connect()
        self.move(self.range.opening_mm[1], self.range.speed_mm_s[1], self.range.force_n[0])


def _frames(broken: Any) -> Driver[Any]:
    return replace(frames.DRIVER, name=broken.__name__, fake=broken)


def _sync(broken: type[ExampleSync]) -> Driver[Any]:
    return replace(sync.DRIVER, name=broken.__name__, build=broken)


def _gripper(broken: type[ExampleGripper]) -> Driver[Any]:
    return replace(gripper.DRIVER, name=broken.__name__, build=broken)


SPEED, CALLS, POSES, HOST = "speed and length", "calls while moving", "poses", "host times"
WRAPS, MOVE, STATE = "counter wraps", "values of a move", "state while moving"
WRONG_VALUES = (
    Broken(arm_driver(TenTimesTooFast), (SPEED,), "followed at .* instead of 40 mm/s"),
    Broken(arm_driver(SpeedIgnored), (SPEED,), "followed at 50.0 mm/s instead of 40 mm/s"),
    Broken(arm_driver(TurnsTwiceTooFast), ("turn",), "followed at 40.0 deg/s instead of 20"),
    Broken(arm_driver(CommandsRadians), ("orientation",), "orientation was|aborted|done"),
    Broken(arm_driver(CutsCorners), (SPEED,), "came no nearer to the end of segment 1"),
    Broken(arm_driver(HostSegmentTimes), (SPEED,), "segment 1 was reported to begin"),
    Broken(arm_driver(DoneTooEarly), ("path", CALLS), "before the end of the path"),
    Broken(arm_driver(ReadyWhileMoving), (CALLS,), "its state was ArmState.READY"),
    Broken(arm_driver(ProgressWaits), (CALLS,), "had not returned before the arm was at rest"),
    Broken(arm_driver(StopDoesNotWait), ("stop while moving",), "still moving when the call"),
    Broken(arm_driver(TiltNotChecked), ("limits of turn and depth",), "turns the tool too far"),
    Broken(arm_driver(PosesInMetres), (POSES,), r"pose returned \(0\.4"),
    Broken(arm_driver(PosesInRadians), ("orientation",), "returned the rotation vector"),
    Broken(arm_driver(ScalarPartLast), ("orientation",), "returned the rotation vector"),
    Broken(arm_driver(AxesSwapped), (POSES,), "read_poses returned"),
    Broken(arm_driver(HeightFlipped), (POSES,), r"read_poses returned .*, -3"),
    Broken(arm_driver(SamplesTwice), (POSES,), "was read twice"),
    Broken(arm_driver(HostTimeIsZero), (HOST,), "host_ns was 0, received between"),
    Broken(arm_driver(HostWallClock), (HOST,), "host_ns was 1"),
    Broken(arm_driver(HostTimeStands), (HOST,), "host_ns was"),
    Broken(arm_driver(CommandedPose), (POSES,), "and not there in the"),
    Broken(arm_driver(PoseLate), (POSES,), "and not there in the"),
    Broken(arm_driver(ClockStands), ("clock",), "now_ns went on by -?0.00|came when now_ns"),
    Broken(arm_driver(ClockInMicroseconds), ("clock",), "now_ns went on by|came when now_ns"),
    Broken(arm_driver(ArmCounterWraps), (WRAPS,), "fell back|came after"),
    Broken(arm_driver(FallingEdges), ("sync input",), "from the nearest rising edge"),
    Broken(event_driver(SizeSwapped), ("sensor size",), "width and height were 48 x 64"),
    Broken(event_driver(ColumnsSwapped), ("data",), "x came otherwise"),
    Broken(event_driver(PolarityInverted), ("data",), "p came otherwise"),
    Broken(event_driver(PolaritySigned), ("arrays",), "p was an array of int8"),
    Broken(event_driver(EventsInNanoseconds), ("data",), "t_us came otherwise|were sent and"),
    Broken(event_driver(EventCounterWraps), (WRAPS,), "came after|came as"),
    Broken(event_driver(EventsTwice), ("data",), "came after|were sent and"),
    Broken(event_driver(OneEventATime), ("data",), "were sent and"),
    Broken(event_driver(PulsesInMicroseconds), ("data",), "pulses up to"),
    Broken(event_driver(ReadWaits), ("read at once",), "read took"),
    Broken(_frames(Transposed), ("region",), "frames of"),
    Broken(_frames(UpsideDown), ("data",), "images came otherwise"),
    Broken(_frames(StartOfExposure), ("data",), "t_ns up to 50.* was sent"),
    Broken(_frames(LevelInverted), ("level of the sync line",), "of the sync line, and came with"),
    Broken(_frames(HostTimeOfCamera), (HOST,), "host_ns was"),
    Broken(_frames(HostTimeOfRead), (HOST,), "s or more after a sample was sent"),
    Broken(_frames(FrameCounterWraps), (WRAPS,), "came after|came as"),
    Broken(_frames(NumbersOfItsOwn), ("lost frames",), "number came otherwise"),
    Broken(_frames(RegionKept), ("another region",), "frames of"),
    Broken(force_driver(MilliNewtons), ("data",), "force_n came otherwise"),
    Broken(force_driver(NewtonMillimetres), ("data",), "torque_nm came otherwise"),
    Broken(force_driver(Reaction), ("data",), "force_n came otherwise"),
    Broken(force_driver(ForceAxesSwapped), ("data",), "force_n came otherwise"),
    Broken(force_driver(OneLoad), ("data",), "force_n came otherwise"),
    Broken(force_driver(ForceHostTimeIsZero), (HOST,), "host_ns was 0"),
    Broken(force_driver(ForceCounterWraps), (WRAPS,), "came after|came as"),
    Broken(force_driver(ZeroHides), ("zero",), "its change was not read"),
    Broken(_sync(SeedIgnored), ("trains",), "the box sent 200 Hz, seed 77"),
    Broken(_sync(CodeIgnored), ("trains",), "and code lfsr"),
    Broken(_sync(HalfTheRate), ("trains",), "the box sent 100 Hz"),
    Broken(_sync(KeepsTicking), ("ticks stop",), "the box still ticked"),
    Broken(_sync(BoxClockInMicroseconds), ("clock",), "between two reads the clock went on"),
    Broken(_sync(BoxHostWallClock), ("clock",), "as the host's times before and after"),
    Broken(_sync(ClockOfPowerOn), ("clock at start",), "after start its clock was"),
    Broken(_sync(BoxCounterWraps), (WRAPS,), "went on by|no pulse had"),
    Broken(_sync(BitsInverted), ("data",), "pulses came at"),
    Broken(_sync(ExposuresInMilliseconds), ("exposures",), "an exposure between"),
    Broken(_gripper(OpensToClose), (MOVE, "move of the fingers"), "asked for"),
    Broken(_gripper(GripperSpeedIgnored), (MOVE,), "the fingers went at"),
    Broken(_gripper(GripperForceInPercent), (MOVE,), "the gripper was sent"),
    Broken(_gripper(OpeningInSteps), (STATE,), "the fingers were at"),
    Broken(_gripper(TargetReported), (STATE,), "the fingers were at"),
    Broken(_gripper(RestsAtOnce), (STATE, MOVE), "while the fingers moved it said"),
    Broken(_gripper(OpensWhenClosed), ("fingers stay",), "the fingers went from"),
)
"""Each driver with wrong magnitudes, with the rules about its defect and what the first one sees."""
