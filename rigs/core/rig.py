"""One rig: runs one trial's motion while its streams are recorded, and performs the safe stop.

The same code drives simulated and real rigs: it uses capabilities only. On any failure the arm is
stopped before anything else; it retracts only if it is healthy; nothing here unlocks a protective
stop.
"""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sliplab.protocols.motion import UNTWIST_DEG_S
from sliplab.protocols.nuisances import TrialNuisances
from sliplab.protocols.program import (
    ACTING,
    Move,
    PlateStep,
    Position,
    Program,
    Step,
    Twist,
)
from sliplab.protocols.timing import ForceTiming, StreamTiming, Timing
from sliplab.rigs.core import force_watch
from sliplab.rigs.core.capabilities import (
    UNKNOWN,
    Arm,
    ArmFault,
    ArmState,
    Clock,
    DeviceHealth,
    EventCamera,
    ForceSensor,
    FrameCamera,
    Gripper,
    GripperState,
    Operator,
    Plate,
    Pose,
    PoseFault,
    RigError,
    Segment,
    Simulation,
    StaysInContact,
    StoppingArm,
    SyncBox,
    Truth,
)
from sliplab.rigs.core.device_stream import DeviceStream
from sliplab.rigs.core.force_watch import ForceLimitError, ForceWatch, PressPlaces
from sliplab.rigs.core.gripper_check import check_move, check_state
from sliplab.rigs.core.guard import Guard
from sliplab.rigs.core.motion_watch import (
    POSE_AGE_S,
    MotionWatch,
    RestWatch,
    check_pose,
    is_near,
    seen_at_rest,
)
from sliplab.rigs.core.plate_frame import PlateFrame
from sliplab.rigs.core.pose import angle_deg, distance_mm
from sliplab.rigs.core.pulse_code import SEEDS
from sliplab.rigs.core.touching import POLL_S, NoiseWatch
from sliplab.storage.schema.trial import StreamRecord
from sliplab.storage.streams import (
    EVENTS_KIND,
    FRAMES_KIND,
    ExposureChunk,
    Json,
    PathSegment,
    Sink,
    StepTimes,
)

RETRACT_SPEED_MM_S = 10.0
"""Speed of moves that no protocol names; a rig's lower limit applies."""
TAIL_S = 0.1
"""Default time for which cameras are read after the last pulse."""
FINGERS_S = 10.0
"""Timeout for the fingers to end a move, s; the slowest takes 4.3 s for the whole stroke."""
FINGERS_MM = 0.01
"""Difference from an opening below which the fingers are left there."""
FINGERS_POLL_S = 0.002
FORCE = "force"
"""Name of the force sensor's stream."""
MOVE_GRACE_S = 10.0
_POSE_SETTLE_S = 0.5
"""Longest time for the pose to show the end of a path that was reported as finished."""
_TURN_DEG = 1.0
"""Turn of the tool from which the weight of the tool may show in a force sensor."""
_STOP_RETRIES = 10
"""Attempts at a stop that Ctrl-C interrupts."""
_SAME_SIGNAL_S = 0.2
"""Signals that follow the first one sooner are the same: a wrapper may pass Ctrl-C on once more."""
_CLEAR_MM = 1.0
"""Distance from the plate below which the sensor may touch it."""
_UNWATCHED_S = 2.0
"""Longest time without a look at a moving arm: a slow disk or computer must not hide its motion."""


class StopRequested(Exception):
    """A stop of the rig was requested; the arm has been stopped."""


@dataclass(frozen=True)
class TrialRun:
    """The record of a trial apart from its streams."""

    steps: tuple[tuple[StepTimes, bool], ...]
    """Each step's times, and True for a recorded step."""
    zero_mm: float
    truth: Truth | None
    path: tuple[PathSegment, ...] = ()
    """Commanded segments of the recorded steps."""
    pressed_mm: float | None = None

    @property
    def recorded_ns(self) -> tuple[int, int]:
        """Start and end of the recorded steps on the arm's clock."""
        recorded = [step for step, is_recorded in self.steps if is_recorded]
        return recorded[0].start_ns, recorded[-1].end_ns


def ignore_step(step: Step) -> None:
    """Take no note of a step."""


@dataclass
class Rig:
    """Arm, cameras, sync box and the other parts that a trial needs.

    Attributes:
        event_camera, frame_camera: None on a rig without one; a rig has one of them at least.
        poll_s: period at which streams are read and stop requests checked.
        timing: signals that reach each device, which decide what else must be read.
        touch_mm: depth of the centre papilla when touching off detects it.
        centre_px: that papilla in the event camera's image; by default the image centre.
        tail_s: time for which cameras are read after the last pulse: they send in blocks, and a
            busy host reads them late.
        force: a force/torque sensor, or None.
        force_limit_n: largest force on the plate, in any direction, before the arm is stopped.
        guard: limits of all motion, whatever the arm's driver checks itself.
        further: devices with streams of their own names.
        gripper: its fingers hold the sensor; or None.
        grip_opening_mm: opening at which the arm's depth is the depth in contact; every trial
            begins with it.
        simulation: the world behind a simulated rig, None on a real one.
        on_close: called last when the rig is closed.
    """

    name: str
    clock: Clock
    arm: Arm
    event_camera: EventCamera | None
    frame_camera: FrameCamera | None
    sync: SyncBox
    operator: Operator
    plate_frame: PlateFrame
    poll_s: float
    timing: Timing = field(default_factory=Timing)
    touch_mm: float = 0.0
    centre_px: tuple[float, float] | None = None
    tail_s: float = TAIL_S
    plate: Plate | None = None
    force: ForceSensor | None = None
    force_limit_n: float | None = None
    guard: Guard = field(default_factory=lambda: Guard(None))
    further: tuple[DeviceStream, ...] = ()
    gripper: Gripper | None = None
    grip_opening_mm: float = 0.0
    simulation: Simulation | None = None
    should_stop: Callable[[], bool] = field(default=lambda: False)
    on_close: tuple[Callable[[], None], ...] = ()
    _reading: tuple[DeviceStream, ...] = field(default=(), init=False)
    """The streams that are recorded now, besides the arm's, the sync box's and the first forces."""
    _forces: ForceWatch | None = field(default=None, init=False)
    """Forces while they are watched, whether or not they are recorded."""
    _motion: MotionWatch | None = field(default=None, init=False)
    """The arm's motion while it is watched."""
    _resting: Pose | None = field(default=None, init=False)
    """The end of the last motion, while the arm rests; None outside a program."""
    _rest: RestWatch | None = field(default=None, init=False)
    """Where the arm has to stay from its last motion until the next."""
    _looked_ns: int = field(default=0, init=False)
    """When the moving arm was looked at last."""
    _sent: bool = field(default=False, init=False)
    """A motion was sent, and the arm was not seen at rest since."""
    noise: NoiseWatch | None = field(default=None, init=False)
    """The event camera's noise while the arm approaches the plate."""
    _zeroed: bool = field(default=False, init=False)
    """The present load was taken for zero since the sensor was connected."""
    _fingers_mm: float | None = field(default=None, init=False)
    """Opening to which the fingers were last sent, or that they had when connected."""
    _insisted: bool = field(default=False, init=False)
    """Ctrl-C came once more while the arm was being stopped: it does not retract."""
    _reported: str = field(default="", init=False)
    """Text of the failed stop that `safely` has raised already."""
    _twisted: bool = field(default=False, init=False)
    """The sensor is rotated with respect to the plate's axes."""
    _plate_uncaught: bool = field(default=False, init=False)
    """True while the plate is released and not caught: it hangs on the sensor, or falls."""

    @property
    def events(self) -> EventCamera:
        """The event camera. Raises RigError on a rig that has none."""
        if self.event_camera is None:
            raise RigError("event camera", f"the rig {self.name} has none")
        return self.event_camera

    @property
    def frames(self) -> FrameCamera:
        """The frame camera. Raises RigError on a rig that has none."""
        if self.frame_camera is None:
            raise RigError("frame camera", f"the rig {self.name} has none")
        return self.frame_camera

    @property
    def _through_host(self) -> bool:
        """True if some device has no wire, so that the host has to read the sync box's clock."""
        by_host = self.force is not None and self.force.grade == "host time"
        further = any(device.through_host for device in self._reading)
        return self.timing.reads_clocks or by_host or further

    def _devices(self) -> list[Any]:
        """Return arm, cameras, sync box and sensors, as far as the rig has them, the arm first."""
        found = (
            self.arm,
            self.event_camera,
            self.frame_camera,
            self.sync,
            self.force,
            self.gripper,
        )
        return [*(device for device in found if device is not None), *self.further]

    def connect(self) -> None:
        """Connect sync box, arm and sensors; cameras connect on construction.

        Raises:
            RigError: one of them does not answer.
        """
        self.sync.connect()
        self.arm.connect()
        self._zeroed = False
        for device in (self.force, self.gripper, *self.further):
            if device is not None:
                device.connect()
        if self.gripper is not None:  # its fingers may be closed already
            self._fingers_mm = check_state(self.gripper.range, self.gripper.state()).opening_mm

    def close(self) -> None:
        """Stop the arm, then close every device; safe to call more than once.

        A device that fails does not keep the others from being closed.

        Raises:
            ArmFault: everything is closed, but the arm could not be confirmed at rest. Not raised
                again where `safely` has raised the same.
        """
        before = sys.exception()
        with ExitStack() as closing:  # a signal that interrupts one does not keep the others open
            for end in reversed(self.on_close):
                closing.callback(end)
            for device in reversed(self._devices()):
                closing.callback(_close_quietly, device)
            fault = self._stop_arm()
        if fault is not None and str(fault) not in {self._reported, str(before)}:
            text = f" (before that: {before})" if isinstance(before, RigError) else ""
            raise ArmFault("arm", f"{_text(fault)}{text}")

    def health(self) -> list[DeviceHealth]:
        """Return the health reports of the connected devices; simulated devices have none.

        Raises:
            RigError: a device does not answer.
        """
        found = [device.health() for device in self._devices() if hasattr(device, "health")]
        return [report for report in found if report is not None]

    @property
    def event_serial(self) -> str | None:
        """Serial number of the event camera; None where it reports none. Raises RigError."""
        report = getattr(self.event_camera, "health", None)
        serial: str = UNKNOWN if report is None else report().serial
        return None if serial == UNKNOWN else serial

    def describe(self) -> dict[str, Json]:
        """Return settings, counts and losses of the trial that just ran, by device."""
        described = {}
        devices = {
            "arm": self.arm,
            "event_camera": self.event_camera,
            "frame_camera": self.frame_camera,
            "force_sensor": self.force,
            **{stream.name: stream for stream in self.further},
        }
        for name, device in devices.items():
            if (settings := getattr(device, "describe", lambda: None)()) is not None:
                described[name] = settings
        losses = getattr(self.sync, "losses", None)
        if losses is not None:
            described["sync_box"] = {"losses": vars(losses)}
        return described

    def run_trial(
        self,
        program: Program,
        sink: Sink,
        seed: int,
        frame_px: tuple[int, int] | None,
        rate_hz: int,
        with_events: bool = True,
        on_step: Callable[[Step], None] = ignore_step,
    ) -> TrialRun:
        """Run one trial; the streams of its recorded steps go to `sink`.

        Args:
            frame_px: region of the frames that are recorded; None records none.
            with_events: record events, where the rig has an event camera.
            on_step: called with each step before it is carried out.

        Raises:
            StopRequested: `should_stop` became true; the arm is stopped and clear.
            RigError: anything failed; the arm is stopped.
        """
        with self.safely(program.home):
            if frame_px is not None:
                self.frames.set_region(*frame_px)
            self.begin_trial(program.home, seed, nuisances_of(program))
            if self.simulation is not None:
                sink = self.simulation.sink(sink)
            if self.force is not None and self._forces is None:
                self._watch_forces()  # a simulated sensor without a limit has its range
            steps, path = [], []
            course, recording, reference = PressPlaces(program.home), False, 0
            for index, planned in enumerate(program.steps):
                step, began = course.step(planned), course.at
                if step.recorded and not recording:
                    self.start_streams(seed, rate_hz, frame_px is not None, with_events)
                    recording = True
                if recording and not step.recorded:
                    self.stop_streams(sink)
                    recording = False
                if step.phase in ACTING and not reference:
                    reference = self.arm.now_ns()
                on_step(step)
                times = self.take_step(index, step, began, sink if recording else None)
                steps.append((times, step.recorded))
                course.taken(step, self.position)
                # a nuisance is over before it has a speed, and is not part of the planned path
                if step.recorded and step.phase != "nuisance":
                    speed = step.speed_mm_s if isinstance(step, Move) else 0.0
                    path.append(self._segment(times, began, course.at, speed))
            truth = None
            if self.simulation is not None:
                hold = next(times.start_ns for times, recorded in steps if recorded)
                truth = self.simulation.truth(reference, hold)
            return TrialRun(
                tuple(steps), self.plate_frame.zero_mm, truth, tuple(path), course.pressed_mm
            )

    @property
    def holds_plate(self) -> bool:
        """True while the plate is released and not caught: a way out would drop it."""
        return self._plate_uncaught

    @property
    def _watches_closely(self) -> bool:
        """Return True if forces and poses are checked every `force_watch.POLL_S`.

        Not on a simulated rig without a limit of force, where an overload breaks nothing.
        """
        return self.simulation is None or self.force_limit_n is not None

    @property
    def _closed_mm(self) -> float:
        """Depth that the fingers add to the arm's."""
        return 0.0 if self._fingers_mm is None else max(self.grip_opening_mm - self._fingers_mm, 0)

    def _watch_forces(self, turns: bool = False, leaving: bool = False) -> ForceWatch:
        """Read forces from now on, and compare them with the limit.

        Args:
            turns: the tool turns, so that its weight changes the readings of a sensor whose load
                was never taken for zero: these have no limit then.
            leaving: the arm moves clear of the plate.
        """
        assert self.force is not None
        delay = (self.timing.force or ForceTiming()).delay
        zeroed = self._zeroed or self.force.zeroing != "trial"
        limit_n = None if turns and not zeroed else self.force_limit_n
        self._forces = ForceWatch(
            self.force,
            self.plate_frame,
            limit_n,
            delay.shortest_us * 1e-6,
            longest_s=delay.longest_us * 1e-6,
            now_ns=self.clock.now_ns,
            zeroed=zeroed,
            leaving=leaving,
        )
        self._forces.needed = self.force_limit_n is not None
        return self._forces

    def _end_watch(self) -> None:
        """Stop reading forces."""
        if self._forces is not None and self.force is not None:
            self._forces = None
            self.force.stop()

    def at_most(self, speed_mm_s: float) -> float:
        """Return a speed, or the rig's limit if that is lower."""
        return min(speed_mm_s, self.guard.speed_mm_s)

    @contextmanager
    def moving(self, segment: Segment, *, leaving: bool = False) -> Iterator[None]:
        """Send one segment to the arm, and watch forces and poses while the block waits.

        Args:
            leaving: it leads clear of the plate, which unloads the sensor.

        Raises:
            GuardError: a limit forbids the segment, and nothing was sent; or the arm's pose left
                the limits on the way.
            ArmFault: the arm's pose cannot be used.
        """
        begin = self.pose()
        unzeroed = not self._zeroed and self.force is not None and self.force.zeroing == "trial"
        if self._watches_closely and self.force is not None and (self._forces is None or unzeroed):
            turns = angle_deg(begin, segment.to) > _TURN_DEG
            self._watch_forces(turns=turns, leaving=leaving)
        self._send(segment, begin)
        try:
            yield
        finally:
            self._motion, self._resting = None, segment.to

    def rests_here(self, speed_mm_s: float) -> None:
        """Note where the arm was stopped in a motion: leaving it before the next one is a fault."""
        if self._watches_closely:
            stop_s = self.arm.stopping_s(speed_mm_s) if isinstance(self.arm, StoppingArm) else 0.0
            coasts_mm = speed_mm_s * (2 * stop_s + POSE_AGE_S)
            self._rest = RestWatch(self.pose(), self.clock.now_ns, coasts_mm)

    def _send(self, segment: Segment, begin: Pose) -> None:
        """Check a segment, and send it: the one place from which the arm receives its motion."""
        self._resting = self._rest = None
        self.guard.check_segment(begin, segment, self.plate_frame, self._closed_mm)
        self._sent, self._looked_ns = True, self.clock.now_ns()
        self.arm.start([segment])
        self._motion = MotionWatch(
            self.guard,
            segment,
            begin,
            self.plate_frame,
            self._closed_mm,
            self.clock.now_ns,
            self.poll_s,
        )

    def move_fingers(self, opening_mm: float, speed_mm_s: float, force_n: float) -> None:
        """Start to move the gripper's fingers and return at once; forces are watched.

        Raises:
            RigError: no gripper, a value out of its range, or closing would pass the limit of
                depth; nothing was sent.
        """
        gripper = self.gripper
        if gripper is None:
            raise RigError("gripper", "this rig has none to move")
        check_move(gripper.range, opening_mm, speed_mm_s, force_n)
        closed_mm = max(self.grip_opening_mm - opening_mm, 0.0)
        if closed_mm > self._closed_mm:
            self.guard.check_depth(self.position().depth_mm + closed_mm, "gripper")
        if self._watches_closely and self.force is not None and self._forces is None:
            self._watch_forces()
        gripper.move(opening_mm, speed_mm_s, force_n)
        self._fingers_mm = opening_mm

    def press(self, depth_mm: float, speed_mm_s: float, clearance_mm: float, times: int) -> None:
        """Warm up the skin: press at the plate's centre and release, `times` times."""
        home = Position(0.0, 0.0, -clearance_mm)
        with self.safely(home):
            out_mm_s = self.at_most(RETRACT_SPEED_MM_S)
            self._come_clear(home)
            self._turn_back(home)
            self.move(Move("home", home, out_mm_s), self.position(), None)
            self._open_fingers()
            if self._watches_closely:
                self._zero_forces()
            for _ in range(times):
                deep = Position(0.0, 0.0, depth_mm)
                self.move(Move("warm up", deep, speed_mm_s), home, None)
                self.move(Move("warm up", home, out_mm_s), deep, None)

    def listen(self, seconds: float, sink: Sink, rate_hz: int) -> None:
        """Record events, poses and pulses to `sink` without moving anything.

        Raises:
            RigError: a device is at fault, or the limit of force is exceeded.
            StopRequested: as `wait`.
        """
        if self.simulation is not None:
            self.simulation.begin_trial(0)
        with ExitStack() as stopping:
            if self.event_camera is not None:
                stopping.callback(self.event_camera.stop)
            stopping.callback(self.sync.stop)
            if self.force is not None:
                stopping.callback(self.force.stop)
            stopping.callback(self._end_watch)
            for device in self.further:
                stopping.callback(device.stop)
            self.start_streams(0, rate_hz, False)
            try:
                self.wait(seconds, sink)
            except ForceLimitError:
                self._stop_arm()  # it is not moved by this program
                raise
            self.stop_streams(sink)

    def take_step(self, index: int, step: Step, at: Position, sink: Sink | None) -> StepTimes:
        """Carry out one step of a program from `at`, the arm's position; call it inside `safely`.

        Raises:
            StopRequested, ArmFault: as `move`.
            RigError: the step moves a plate, and this rig has none.
        """
        start = self.arm.now_ns()
        if isinstance(step, Move) and step.until_force_n is not None:
            start, end = self._press_to_force(step, step.until_force_n, at)
            return StepTimes(index, step.phase, start, end)
        if isinstance(step, Move):
            start, end = self.move(step, at, sink)
            return StepTimes(index, step.phase, start, end)
        if isinstance(step, Twist):
            self._twisted = True
            start, end = self.twist(step, at, sink)
            self._twisted = step.to.twist_deg != 0.0
            return StepTimes(index, step.phase, start, end)
        if isinstance(step, PlateStep):
            if self.plate is None:
                raise RigError("plate", f"this rig has no sliding plate to {step.action}")
            self._plate_uncaught = step.action == "release" or self._plate_uncaught
            self._move_plate(self.plate, step, sink)
            self._plate_uncaught = step.action == "release"
        self.wait(step.seconds, sink)
        return StepTimes(index, step.phase, start, self.arm.now_ns())

    def _move_plate(self, plate: Plate, step: PlateStep, sink: Sink | None) -> None:
        """Have the plate moved. A person may take minutes: the arm is watched meanwhile."""
        if not self._watches_closely:
            plate.act(step.action, step.seconds)
            return
        errors: list[BaseException] = []

        def act() -> None:
            try:
                plate.act(step.action, step.seconds)
            except BaseException as error:  # raised again where the arm is stopped
                errors.append(error)

        acting = threading.Thread(target=act, name="plate", daemon=True)
        acting.start()
        while acting.is_alive():
            self.wait(self.poll_s, sink)
        if errors:
            raise errors[0]

    def move(self, step: Move, at: Position, sink: Sink | None = None) -> tuple[int, int]:
        """Move from `at`, the arm's position, and wait for the end; return controller times, ns.

        Raises:
            StopRequested: as `wait`; the arm is still moving then, and `safely` stops it.
            ArmFault: the arm stopped, or did not finish in time.
        """
        seconds = path_seconds(at.distance_mm(step.to), step.speed_mm_s)
        segment = Segment(self.plate_frame.pose(step.to), step.speed_mm_s)
        return self._follow(segment, seconds, step.phase, sink)[:2]

    def _press_to_force(self, step: Move, force_n: float, at: Position) -> tuple[int, int]:
        """Press, and stop where the arm will rest at the normal force; return times as `move`.

        Raises:
            StopRequested, ArmFault: as `move`.
            RigError: there is no force sensor, or the deepest place came first.
        """
        if self.force is None:
            raise RigError("force sensor", f"this rig has none to press to {force_n:g} N")
        if not force_n > 0:
            raise RigError("force sensor", f"{force_n:g} N is no force to press to")
        forces = self._forces or self._watch_forces()
        forces.needed = True
        arm, goes_on_s = self.arm, 0.0
        if isinstance(arm, StoppingArm):
            goes_on_s = arm.stopping_s(step.speed_mm_s)
            if not 0.0 <= goes_on_s < math.inf:
                raise RigError("arm", f"states {goes_on_s} s as its time to stop")

        def left_s() -> float:
            return forces.seconds_to(force_n, self.clock.now_ns()) - goes_on_s

        seconds = path_seconds(at.distance_mm(step.to), step.speed_mm_s)
        segment = Segment(self.plate_frame.pose(step.to), step.speed_mm_s)
        start, end, stopped = self._follow(segment, seconds, step.phase, None, left_s)
        forces.needed = self.force_limit_n is not None
        if not stopped and not forces.normal_n >= force_n:
            raise RigError(
                "force sensor",
                f"reads {forces.normal_n:.2f} N at the deepest place, {step.to.depth_mm:g} mm, not "
                f"the {force_n:g} N to press to; allow more depth, or ask for less force",
            )
        return start, end

    def twist(self, step: Twist, at: Position, sink: Sink | None = None) -> tuple[int, int]:
        """Turn about the plate's normal on the spot; as `move`."""
        seconds = path_seconds(abs(step.to.twist_deg - at.twist_deg), step.speed_deg_s)
        bound_mm_s = self.at_most(RETRACT_SPEED_MM_S)
        segment = Segment(self.plate_frame.pose(step.to), bound_mm_s, step.speed_deg_s)
        return self._follow(segment, seconds, step.phase, sink)[:2]

    def _follow(
        self,
        segment: Segment,
        seconds: float,
        phase: str,
        sink: Sink | None,
        left_s: Callable[[], float] | None = None,
        *,
        leaving: bool = False,
    ) -> tuple[int, int, bool]:
        """Send one segment of known duration, and wait for its end, or stop it on the way.

        Args:
            left_s: time until the arm has to be stopped, s; asked every `force_watch.POLL_S`, and
                again when half of it is over.
            leaving: as `moving`.

        Returns:
            start and end, controller times in ns, and True where it was stopped on the way.
        """
        start, stopped_ns = self.arm.now_ns(), None
        if seconds == 0:
            if self._watches_closely:
                self._check_end(segment, phase, sink)
            return start, start, False
        with self.moving(segment, leaving=leaving):
            deadline = self.clock.now_ns() + int((2 * seconds + MOVE_GRACE_S) * 1e9)
            while not (progress := self.arm.progress()).done:
                if not progress.state.healthy:
                    raise arm_fault(progress.state, phase)
                if self.clock.now_ns() > deadline:
                    raise ArmFault("arm", f"did not finish the phase '{phase}' in time")
                most = self.poll_s
                if left_s is not None:
                    stop_s = left_s()
                    if not stop_s > 0:
                        self.arm.stop()
                        stopped_ns = self.arm.now_ns()
                        break
                    most = min(stop_s / 2, force_watch.POLL_S)
                left = seconds - (self.arm.now_ns() - start) / 1e9
                self.wait(max(min(most, left), 1e-3), sink)
            self._note_look()
        if stopped_ns is not None:
            self.rests_here(segment.speed_mm_s)
            return start, stopped_ns, True
        if not progress.state.healthy:
            raise arm_fault(progress.state, phase)
        if not progress.finished:
            raise ArmFault("arm", f"was stopped from outside in the phase '{phase}'")
        self._check_end(segment, phase, sink)
        self._rest = RestWatch(segment.to, self.clock.now_ns)
        return *progress.finished[-1], False

    def _check_end(self, segment: Segment, phase: str, sink: Sink | None) -> None:
        """Check that the arm is where its path ends; a pose may show it a little later.

        Raises:
            ArmFault: it is not.
        """
        deadline = self.clock.now_ns() + round(_POSE_SETTLE_S * 1e9)
        while not is_near(here := self.pose(), segment.to):
            if self.clock.now_ns() > deadline:
                off = f"{distance_mm(here, segment.to):.1f} mm, {angle_deg(here, segment.to):.1f}"
                text = f"reports the phase '{phase}' as finished, and its pose is {off} deg off"
                raise PoseFault(
                    "arm", f"{text}; it stays where it is: check the arm before the next move"
                )
            self.wait(force_watch.POLL_S, sink)

    def wait(self, seconds: float, sink: Sink | None = None) -> None:
        """Let time pass; read streams and check for stop requests every `poll_s`.

        Raises:
            StopRequested: `should_stop` became true.
        """
        end = self.clock.now_ns() + round(seconds * 1e9)
        while (left := end - self.clock.now_ns()) > 0:
            self._pass(min(self.poll_s, left / 1e9), sink)
            if sink is not None:
                self._drain(sink)
            if self.should_stop():
                raise StopRequested

    def _pass(self, seconds: float, sink: Sink | None) -> None:
        """Let time pass; forces and the arm's pose are checked meanwhile and at its end."""
        resting = self._resting if self._watches_closely else None
        if self._forces is None and self._motion is None and resting is None:
            self.clock.wait(seconds)
            return
        most_s = force_watch.POLL_S if self._watches_closely else seconds
        end = self.clock.now_ns() + round(seconds * 1e9)
        while (left := end - self.clock.now_ns()) > 0:
            self.clock.wait(min(most_s, left / 1e9))
            if self._forces is not None:
                forces = self._forces.read()
                if sink is not None:
                    sink.add(FORCE, forces)
            if self._motion is not None:
                self._look(self._motion)
            elif resting is not None:  # no motion was sent, but another program may send one
                pose, plate = self.pose(), self.plate_frame
                self.guard.check_measured(pose, resting, plate, self._closed_mm, "at rest")
                if self._rest is not None:
                    self._rest.look(pose)

    def _look(self, motion: MotionWatch) -> None:
        """Hold the moving arm's pose against its motion, its limits and the forces."""
        asked_ns = self._note_look()
        pose = self.pose()
        motion.look(pose, asked_ns)
        if self._forces is not None and self._forces.needed:
            depth_mm = self.plate_frame.position(pose.xyz_mm).depth_mm + self._closed_mm
            self._forces.follow(pose, depth_mm)

    def _note_look(self) -> int:
        """Return the time of this look at the moving arm. Raises RigError if it is far too late."""
        now_ns = self.clock.now_ns()
        unwatched_s, self._looked_ns = (now_ns - self._looked_ns) * 1e-9, now_ns
        if self._watches_closely and unwatched_s > _UNWATCHED_S:
            text = f"did not look at the moving arm for {unwatched_s:.1f} s"
            raise RigError("computer", f"{text}: its disk or its load is too much for a trial")
        return now_ns

    def start_streams(
        self,
        seed: int,
        rate_hz: int,
        with_frames: bool,
        with_events: bool = True,
        with_further: bool = True,
    ) -> None:
        """Start the streams; earlier data are discarded. Raises RigError."""
        self.arm.read_poses()
        self.arm.read_pulses()
        if self._forces is not None:
            self._forces.start()
        elif self.force is not None and self._watches_closely:
            self._watch_forces()
        elif self.force is not None:
            self.force.start()
        own = self._own_streams(with_events, with_frames)
        self._reading = (*own, *(self.further if with_further else ()))
        for stream in self._reading:
            if not self._by_exposures(stream):
                stream.start()
        self.sync.start(rate_hz, seed % SEEDS + 1, self.timing.code)
        for stream in filter(self._by_exposures, self._reading):
            stream.start()

    def _own_streams(self, with_events: bool, with_frames: bool) -> list[DeviceStream]:
        """Return the streams of the first cameras that are to be recorded."""
        found = []
        if with_events and self.event_camera is not None:
            about = StreamRecord(kind=EVENTS_KIND, rows=0)
            found.append(DeviceStream(EVENTS_KIND, self.event_camera, about))
        if with_frames:
            by_reads = self.timing.frames == "device time stamps"
            timing = StreamTiming(grade="device time stamps") if by_reads else None
            about = StreamRecord(kind=FRAMES_KIND, rows=0, timing=timing)
            found.append(DeviceStream(FRAMES_KIND, self.frames, about))
        return found

    def _by_exposures(self, stream: DeviceStream) -> bool:
        """Return whether the box stamps a stream's exposures: it must run from the first one on."""
        return stream.name == FRAMES_KIND and self.timing.frames == "exposure line"

    def stop_streams(self, sink: Sink) -> None:
        """Stop the pulses, and read the data that cameras still hold before and after they stop.

        Events later than `tail_s` after the motion are discarded; late pulses and frames are read.
        """
        for stream in filter(self._by_exposures, self._reading):
            stream.stop()
        self.sync.stop()
        self.wait(self.tail_s, sink)
        for stream in self._reading:
            stream.finish(sink)
        self._reading = ()
        if self.force is not None:
            self._forces = None
            self.force.stop()
            sink.add(FORCE, self.force.read())

    def _drain(self, sink: Sink) -> None:
        for stream in self._reading:
            stream.drain(sink)
        poses = self.arm.read_poses()
        if not (np.isfinite(poses.xyz_mm).all() and np.isfinite(poses.rotvec_deg).all()):
            raise ArmFault("arm", "reports poses that are not finite; check its controller's state")
        sink.add("arm", poses)
        sink.add("arm", self.arm.read_pulses())
        sink.add("sync_box", self.sync.read_pulses())
        if self.timing.frames == "exposure line":
            sink.add("sync_box", ExposureChunk(self.sync.read_exposures().t_ns))
        if self._through_host:
            sink.add("sync_box", self.sync.read_clock())
        if (forces := self._forces or self.force) is not None:
            sink.add(FORCE, forces.read())

    def begin_trial(
        self, home: Position, seed: int, nuisances: TrialNuisances | None = None
    ) -> None:
        """Move to the start position, then let the simulation draw its random values.

        The sensor is clear of the plate there, so a force sensor is zeroed.
        """
        self._come_clear(home)
        self._turn_back(home)
        out_mm_s = self.at_most(RETRACT_SPEED_MM_S)
        self.move(Move("home", home, out_mm_s), self.position(), None)
        self.begin_clear(seed, nuisances)
        for device in self.further:
            device.prepare()

    def _come_clear(self, home: Position) -> None:
        """Leave the plate straight out, as turned as now, where the sensor may still touch it.

        A trial that ended in contact leaves it there: after a safe state, a fault that a person
        cleared, or a way out that was interrupted.
        """
        begin, at = self.pose(), self.position()
        if not self._is_clear(at):
            depth_mm = min(home.depth_mm, -_CLEAR_MM) - self._closed_mm
            out = self.plate_frame.pose(Position(at.x_mm, at.y_mm, depth_mm))
            speed_mm_s = self.at_most(RETRACT_SPEED_MM_S)
            segment = Segment(replace(out, rotvec_deg=begin.rotvec_deg), speed_mm_s)
            seconds = (at.depth_mm - depth_mm) / speed_mm_s
            self._follow(segment, seconds, "come clear", None, leaving=True)
        self._open_fingers()  # closed ones add to the depth of the way home

    def _is_clear(self, at: Position) -> bool:
        """Return whether the sensor cannot touch the plate there."""
        return at.depth_mm + self._closed_mm <= -_CLEAR_MM

    def _turn_back(self, home: Position) -> None:
        """Turn a turned sensor back on the spot, where the way home is too short to do it there.

        An earlier trial ended in its twist, or an earlier command was stopped in it.
        """
        here = self.position()
        left = angle_deg(self.pose(), self.plate_frame.pose(here))
        on_way = self.guard.turn_deg_s * here.distance_mm(home) / self.at_most(RETRACT_SPEED_MM_S)
        if self._twisted or (here.depth_mm <= 0.0 and left > max(_TURN_DEG, on_way)):
            speed_deg_s = min(UNTWIST_DEG_S, self.guard.turn_deg_s)
            self.twist(Twist("untwist", here, speed_deg_s), replace(here, twist_deg=left))
            self._twisted = False

    def begin_clear(self, seed: int, nuisances: TrialNuisances | None = None) -> None:
        """Open the fingers, let the simulation draw its random values, zero the force sensor.

        The sensor is clear of the plate. Forces are watched from now on, where they have a limit.

        Raises:
            RigError: gripper or force sensor is at fault.
        """
        self._open_fingers()
        if self.force is not None and self.force_limit_n is not None:
            forces = self._forces or self._watch_forces()
            while not forces.fresh:  # or the sensor is silent, which it raises
                self.wait(POLL_S)
        self._end_watch()
        if self.simulation is not None:
            self.simulation.begin_trial(seed, nuisances)
        self._zero_forces()

    def _zero_forces(self) -> None:
        """Take the present load for zero, if the rig does so, and watch forces from now on."""
        if self.force is None:
            return
        self._end_watch()
        if self.force.zeroing == "trial":
            self.force.zero()
            self._zeroed = True
        if self._watches_closely:
            self._watch_forces()

    def _open_fingers(self) -> None:
        """Move a gripper's fingers to the opening with which a trial begins, and wait for it."""
        if (gripper := self.gripper) is None:
            return
        opening_mm, allowed = self.grip_opening_mm, gripper.range
        state = check_state(allowed, gripper.state())
        if state.moving or not self._is_open(gripper, state, opening_mm):
            self.move_fingers(opening_mm, allowed.speed_mm_s[0], allowed.force_n[0])
            state = self.await_fingers(gripper)
            if not self._is_open(gripper, state, opening_mm):
                raise RigError(
                    "gripper",
                    f"stalled at {state.opening_mm:g} mm, on its way to the {opening_mm:g} mm with "
                    "which a trial begins: look what holds it",
                )
        self._fingers_mm = opening_mm

    def _is_open(self, gripper: Gripper, state: GripperState, opening_mm: float) -> bool:
        """Return whether the fingers are at an opening, to a step of them."""
        return abs(state.opening_mm - opening_mm) <= max(gripper.range.step_mm, FINGERS_MM)

    def await_fingers(self, gripper: Gripper, sink: Sink | None = None) -> GripperState:
        """Wait for the fingers to end their move; bounded.

        Raises:
            RigError: they still move after `FINGERS_S`, or ended elsewhere without a stall, or the
                gripper is at fault.
            StopRequested: as `wait`.
        """
        deadline = self.clock.now_ns() + round(FINGERS_S * 1e9)
        while (state := check_state(gripper.range, gripper.state())).moving:
            if self.clock.now_ns() > deadline:
                raise RigError(
                    "gripper", f"still moves {FINGERS_S:g} s after its command: look what holds it"
                )
            self.wait(min(self.poll_s, FINGERS_POLL_S), sink)
        to_mm = self._fingers_mm
        if to_mm is not None and not state.stalled and not self._is_open(gripper, state, to_mm):
            raise RigError(
                "gripper",
                f"ended at {state.opening_mm:g} mm, not at the {to_mm:g} mm to which it was sent",
            )
        return state

    def _segment(
        self, times: StepTimes, begin: Position, end: Position, speed: float
    ) -> PathSegment:
        places = self.plate_frame.pose(begin).xyz_mm, self.plate_frame.pose(end).xyz_mm
        return PathSegment(times.start_ns, times.end_ns, *places, speed)

    def position(self) -> Position:
        """Return the current tool centre point in plate coordinates. Raises ArmFault."""
        return self.plate_frame.position(self.pose().xyz_mm)

    def pose(self) -> Pose:
        """Return the arm's current pose. Raises ArmFault if it is invalid."""
        return check_pose(self.arm.pose())

    @contextmanager
    def safely(self, clear: Position) -> Iterator[None]:
        """Stop on any exception inside: stop arm and fingers, retract the arm, stop the rest.

        A device that fails to stop does not keep the others from being stopped. The first error is
        raised; but an arm that could not be stopped or moved clear, and a plate that was not
        caught, are always reported.
        """
        try:
            yield
        except BaseException as error:
            self._forces, self._resting, self._reading = None, None, ()
            self._insisted = False
            fault: RigError | None = None
            try:
                fault = self._stop_arm()
                if fault is None and not isinstance(error, StaysInContact):
                    fault = self._retract(clear, error)
            finally:
                for device in self._devices()[1:]:
                    with suppress(Exception):
                        device.stop()
            self._reported = str(fault or "")
            if fault is not None and str(fault) != str(error):
                if isinstance(error, RigError) and error.device == "arm":
                    fault = ArmFault("arm", f"{_text(error)}. It {_text(fault)}")
                raise self._with_plate_warning(fault) from error
            held = isinstance(error, StaysInContact) and error.plate_held
            if self._plate_uncaught and not held:
                if isinstance(error, RigError):
                    raise self._with_plate_warning(error) from error
                if isinstance(error, StopRequested | KeyboardInterrupt):
                    stopped = RigError("plate", "the trial was stopped")
                    raise self._with_plate_warning(stopped) from error
            raise
        self._resting = None
        with suppress(Exception):  # the motion is over
            self._end_watch()

    def _with_plate_warning(self, error: RigError) -> RigError:
        """Return the error with a warning if the plate was released and not caught."""
        if not self._plate_uncaught:
            return error
        text = f"{_text(error)}. The plate was released and not caught: catch it first"
        return ArmFault("arm", text) if error.device == "arm" else RigError(error.device, text)

    def _stop_arm(self) -> RigError | None:
        """Stop the arm, and then the fingers; return None once it was seen at rest, else the error.

        A second Ctrl-C must not interrupt the stop. It is noted: the arm does not retract then.
        """
        began, moving = time.monotonic(), 0
        for _ in range(_STOP_RETRIES):
            try:
                self.arm.stop()
                if self.gripper is not None:
                    with suppress(Exception):
                        self.gripper.stop()
                if not self._sent or seen_at_rest(self.arm, self.clock):
                    self._sent = False
                    return None
                moving += 1
            except KeyboardInterrupt:
                self._insisted = time.monotonic() - began > _SAME_SIGNAL_S
            except RigError as fault:
                return fault
            except Exception as error:
                return ArmFault("arm", f"could not be stopped: {error!r}; check the arm")
            if moving == 2:
                return ArmFault("arm", "was stopped twice, and moves on: press the emergency stop")
        return ArmFault("arm", "could not be confirmed at rest: its stop was interrupted")

    def _left_in_contact(self) -> RigError | None:
        """Return the error for a way out that a person prevented; None where the arm is clear."""
        at = self.position()
        if self._is_clear(at):
            return None
        return ArmFault(
            "arm",
            f"did not come clear of the plate: its way out was interrupted at a depth of "
            f"{at.depth_mm:.2f} mm; look at it: the next trial begins with the way straight out; "
            "every committed trial is kept",
        )

    def _retract(self, clear: Position, error: BaseException) -> RigError | None:
        """Retract straight out along the plate's normal if the arm is healthy, bounded in time.

        Forces are watched, unless `error` is a fault of their sensor, which must not keep the arm
        in contact.

        Returns:
            the error if a healthy arm did not come clear, in which case it has been stopped.
        """
        try:
            if not self.arm.state().healthy:
                return None
            if self._insisted:
                return self._left_in_contact()
            begin, at = self.pose(), self.position()
            out = Position(at.x_mm, at.y_mm, min(at.depth_mm, clear.depth_mm))
            if at.distance_mm(out) == 0:
                return None
            # with its present rotation: it turns back once clear
            pose = replace(self.plate_frame.pose(out), rotvec_deg=begin.rotvec_deg)
            speed_mm_s = self.at_most(RETRACT_SPEED_MM_S)
            blind = _of_sensor(error) and not isinstance(error, ForceLimitError)
            if self.force is not None and self._watches_closely and not blind:
                with suppress(RigError):
                    self._watch_forces(leaving=True)
            self._send(Segment(pose, speed_mm_s), begin)
            most_s = at.distance_mm(out) / speed_mm_s + 2.0 + self.poll_s
            deadline = self.clock.now_ns() + round(most_s * 1e9)
            while self.clock.now_ns() < deadline:
                if (progress := self.arm.progress()).done:
                    if progress.finished:
                        return None
                    raise ArmFault(
                        "arm", f"did not come clear of the plate: {progress.state.value}"
                    )
                self._pass_leaving(self.poll_s)
            raise ArmFault("arm", "did not come clear of the plate in time")
        except RigError as fault:
            return self._stop_arm() or fault
        except BaseException:
            left = self._stop_arm() or self._left_in_contact()
            if left is None:
                raise
            return left
        finally:
            self._motion = self._forces = None

    def _pass_leaving(self, seconds: float) -> None:
        """Let time pass while the arm moves clear; a force sensor that fails is no longer read."""
        try:
            self._pass(seconds, None)
        except ForceLimitError:
            raise
        except RigError as fault:
            if not _of_sensor(fault):
                raise
            self._forces = None


def _close_quietly(device: Any) -> None:
    """Close a device; its faults no longer matter."""
    with suppress(Exception):
        device.close()


def path_seconds(way: float, speed: float) -> float:
    """Return the time that a path takes; infinite at an invalid speed, which is never sent."""
    if way == 0.0:
        return 0.0
    return way / speed if 0.0 < speed < math.inf else math.inf


def _of_sensor(error: BaseException) -> bool:
    """Return whether an error is one of the force sensor."""
    return isinstance(error, RigError) and error.device == force_watch.DEVICE


def nuisances_of(program: Program) -> TrialNuisances | None:
    """Return what disturbs a trial, for the world behind a simulated rig; None if nothing does."""
    if not program.nuisances:
        return None
    return TrialNuisances(program.nuisances, program.seconds(recorded_only=True))


def arm_fault(state: ArmState, phase: str) -> ArmFault:
    """Return the error for an arm's state, with the action that the operator must take."""
    lost = state is ArmState.DISCONNECTED
    where = "the arm may still move" if lost else "the arm stays where it is"
    return ArmFault(
        "arm",
        f"{state.value} in the phase '{phase}'; {where}: {state.advice}, move "
        "it clear of the plate, then run the same command to resume",
    )


def _text(error: RigError) -> str:
    """Return an error's text without the device's name."""
    return str(error).removeprefix(f"{error.device}: ")
