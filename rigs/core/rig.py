"""One rig: runs one trial's motion while its streams flow, and owns the ordered safe stop.

The same code drives a simulated and a real rig: it knows only capabilities. On any failure the
arm is stopped before anything else; it retracts only if it is healthy; nothing here unlocks a
protective stop.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field

from sliplab.protocols.program import Move, PlateStep, Position, Program, Step, step_seconds
from sliplab.protocols.timing import Timing
from sliplab.rigs.core.capabilities import (
    Arm,
    ArmFault,
    ArmState,
    Clock,
    DeviceHealth,
    EventCamera,
    ForceSensor,
    FrameCamera,
    Operator,
    Plate,
    RigError,
    Segment,
    Simulation,
    SyncBox,
)
from sliplab.rigs.core.plate_frame import PlateFrame
from sliplab.rigs.core.pulse_code import SEEDS
from sliplab.rigs.core.touching import LOOK_S, QUIET_S, RateTouch, count_central
from sliplab.storage.streams import Json, PathSegment, Sink, StepTimes

RETRACT_SPEED_MM_S = 10.0
TAIL_S = 0.1
"""Time for which cameras are read after the last pulse, unless a rig says otherwise."""
FORCE = "force"
"""Name of the force sensor's stream."""
_MOVE_GRACE_S = 10.0
_STOP_RETRIES = 10
"""Retries of a stop that was interrupted."""


class StopRequested(Exception):
    """A person asked the rig to stop; the arm has been stopped."""


@dataclass(frozen=True)
class TrialRun:
    """The record of a trial besides its streams."""

    steps: tuple[tuple[StepTimes, bool], ...]
    """Each step with its times, and whether it was recorded."""
    zero_mm: float
    truth: Json | None
    path: tuple[PathSegment, ...] = ()
    """Commanded segments of the recorded steps."""

    @property
    def recorded_ns(self) -> tuple[int, int]:
        """Start and end of the recorded steps on the arm's clock."""
        recorded = [step for step, kept in self.steps if kept]
        return recorded[0].start_ns, recorded[-1].end_ns


@dataclass
class Rig:
    """Arm, cameras, sync box and what else a trial needs.

    Attributes:
        poll_s: how often streams are read and stop requests looked at.
        timing: which signal reaches which device, and so what else has to be read.
        touch_mm: how deep the centre papilla is when touching off notices it.
        centre_px: where the event camera sees that papilla; by default in its picture's centre.
        tail_s: how long cameras are read after the last pulse: they send in blocks, and a busy
            host is late to read them.
        force: a sensor of force and torque; None costs nothing.
        simulation: the world behind a simulated rig, None on a real one.
        ending: called last when the rig is closed.
    """

    name: str
    clock: Clock
    arm: Arm
    events: EventCamera
    frames: FrameCamera
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
    simulation: Simulation | None = None
    should_stop: Callable[[], bool] = field(default=lambda: False)
    ending: tuple[Callable[[], None], ...] = ()
    _reported: str = field(default="", init=False)
    """Failure of a stop that `safely` has raised already."""
    _plate_uncaught: bool = field(default=False, init=False)
    """The plate was let go and not caught: it hangs on the sensor, or falls."""

    def connect(self) -> None:
        """Connect sync box, arm and force sensor; cameras connect when they are built.

        Raises:
            RigError: one of them does not answer.
        """
        self.sync.connect()
        self.arm.connect()
        if self.force is not None:
            self.force.connect()

    def close(self) -> None:
        """Give every device back, the arm stopped first; safe to call more than once.

        A device that fails must not stop the others from being closed.

        Raises:
            ArmFault: everything was given back, but the arm could not be seen to stand still.
                Not raised again where `safely` has said the same.
        """
        fault: RigError | None = None
        try:
            fault = self._stop_arm()
        finally:
            for device in (self.arm, self.events, self.frames, self.sync, self.force):
                with suppress(Exception):
                    if device is not None:
                        device.close()
            for end in self.ending:
                end()
        before = sys.exception()
        if fault is not None and str(fault) not in {self._reported, str(before)}:
            text = f" (before that: {before})" if isinstance(before, RigError) else ""
            raise ArmFault("arm", f"{_text(fault)}{text}")

    def health(self) -> list[DeviceHealth]:
        """Return the reports of the connected devices; simulated ones have none.

        Raises:
            RigError: one does not answer.
        """
        devices = (self.arm, self.events, self.frames, self.sync, self.force)
        return [device.health() for device in devices if device and hasattr(device, "health")]

    def describe(self) -> dict[str, Json]:
        """Return settings, counts and losses of the trial that just ran, by device."""
        described = {}
        cameras = ("event_camera", self.events), ("frame_camera", self.frames)
        for name, device in (("arm", self.arm), *cameras, ("force_sensor", self.force)):
            if device is not None and hasattr(device, "describe"):
                described[name] = device.describe()
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
    ) -> TrialRun:
        """Run one trial; its recorded steps flow into `sink`.

        Raises:
            StopRequested: `should_stop` became true; the arm is stopped and clear.
            RigError: anything failed; the arm is stopped.
        """
        with self.safely(program.home):
            if frame_px is not None:
                self.frames.set_region(*frame_px)
            self.begin_trial(program.home, seed)
            if self.simulation is not None:
                sink = self.simulation.sink(sink)
            steps, path = [], []
            at, recording, reference = program.home, False, 0
            for index, step in enumerate(program.steps):
                if step.recorded and not recording:
                    self.start_streams(seed, rate_hz, frame_px is not None)
                    recording = True
                if recording and not step.recorded:
                    self.stop_streams(sink, frame_px is not None)
                    recording = False
                if step.phase in {"slide", "retract"}:
                    reference = self.arm.now_ns()
                times = self.take_step(index, step, at, sink if recording else None)
                steps.append((times, step.recorded))
                began, at = at, step_seconds(step, at)[1]
                if step.recorded:
                    speed = step.speed_mm_s if isinstance(step, Move) else 0.0
                    path.append(self._segment(times, began, at, speed))
            truth = None
            if self.simulation is not None:
                hold = next(times.start_ns for times, kept in steps if kept)
                truth = self.simulation.truth(reference, hold)
            return TrialRun(tuple(steps), self.plate_frame.zero_mm, truth, tuple(path))

    def press(self, depth_mm: float, speed_mm_s: float, clearance_mm: float, times: int) -> None:
        """Warm the skin up: press at the plate's centre and let go, `times` times."""
        home = Position(0.0, 0.0, -clearance_mm)
        with self.safely(home):
            self.move(Move("home", home, RETRACT_SPEED_MM_S), self.position(), None)
            for _ in range(times):
                deep = Position(0.0, 0.0, depth_mm)
                self.move(Move("warm up", deep, speed_mm_s), home, None)
                self.move(Move("warm up", home, RETRACT_SPEED_MM_S), deep, None)

    def touch_off(self, speed_mm_s: float, search_mm: float, seed: int) -> float:
        """Find depth zero: creep in until the event rate says that the centre papilla touches.

        See `rigs.core.touching.RateTouch`. A skin is noticed only some way in: `touch_mm` of the
        rig's calibration.

        Args:
            search_mm: hard limit beyond the taught plane.

        Returns:
            The new depth zero in the taught frame, mm; the frame uses it from now on.

        Raises:
            RigError: nothing was touched within `search_mm`.
        """
        self.plate_frame = self.plate_frame.with_zero(0.0)
        start = Position(0.0, 0.0, -search_mm)
        with self.safely(start):
            self.begin_trial(start, seed)
            self.events.start()
            self.wait(QUIET_S)
            zero = self._approach_until_touch(
                search_mm, speed_mm_s, RateTouch(self.central_events())
            )
            self.events.stop()
            self.move(Move("release", start, RETRACT_SPEED_MM_S), self.position(), None)
        self.plate_frame = self.plate_frame.with_zero(zero)
        return zero

    def listen(self, seconds: float, sink: Sink, rate_hz: int) -> None:
        """Let events, poses and pulses flow into `sink` without moving anything."""
        if self.simulation is not None:
            self.simulation.begin_trial(0)
        with ExitStack() as stopping:
            stopping.callback(self.events.stop)
            stopping.callback(self.sync.stop)
            if self.force is not None:
                stopping.callback(self.force.stop)
            self.start_streams(0, rate_hz, False)
            self.wait(seconds, sink)
            self.stop_streams(sink, False)

    def _approach_until_touch(self, search_mm: float, speed_mm_s: float, rate: RateTouch) -> float:
        target = Position(0.0, 0.0, search_mm)
        self.arm.start([Segment(self.plate_frame.pose(target), speed_mm_s)])
        while not self.arm.progress().done:
            self.wait(LOOK_S)
            depth = self.plate_frame.position(self.arm.pose().xyz_mm).depth_mm
            if rate.touched(self.central_events()):
                self.arm.stop()
                return depth - speed_mm_s * rate.LATE_S - self.touch_mm
        state = self.arm.state()
        if not state.healthy:  # the arm was stopped; the taught plane may still be right
            raise arm_fault(state, "touching off")
        raise RigError(
            "arm",
            f"touching off met nothing within {search_mm:g} mm of the taught plane; "
            "teach the contact plane again",
        )

    def central_events(self) -> int:
        """New events where the event camera sees the centre papilla."""
        size = self.events.width, self.events.height
        return count_central(self.events.read(), size, self.centre_px)

    def take_step(self, index: int, step: Step, at: Position, sink: Sink | None) -> StepTimes:
        """Carry out one step of a program from `at`, where the arm stands; inside `safely`.

        Raises:
            StopRequested, ArmFault: as `move`.
            RigError: the step moves a plate that this rig does not have.
        """
        start = self.arm.now_ns()
        if isinstance(step, Move):
            start, end = self.move(step, at, sink)
            return StepTimes(index, step.phase, start, end)
        if isinstance(step, PlateStep):
            if self.plate is None:
                raise RigError("plate", f"this rig has no sliding plate to {step.action}")
            self._plate_uncaught = step.action == "release" or self._plate_uncaught
            self.plate.act(step.action, step.seconds)
            self._plate_uncaught = step.action == "release"
        self.wait(step.seconds, sink)
        return StepTimes(index, step.phase, start, self.arm.now_ns())

    def move(self, step: Move, at: Position, sink: Sink | None = None) -> tuple[int, int]:
        """Move from `at`, where the arm stands, and wait for the end; controller times, ns.

        Raises:
            StopRequested: as `wait`; the arm still moves then, and `safely` stops it.
            ArmFault: it stopped, or did not come to an end in time.
        """
        start = self.arm.now_ns()
        seconds = at.distance_mm(step.to) / step.speed_mm_s
        if seconds == 0:
            return start, start
        self.arm.start([Segment(self.plate_frame.pose(step.to), step.speed_mm_s)])
        deadline = self.clock.now_ns() + int((2 * seconds + _MOVE_GRACE_S) * 1e9)
        while not (progress := self.arm.progress()).done:
            if not progress.state.healthy:
                raise arm_fault(progress.state, step.phase)
            if self.clock.now_ns() > deadline:
                raise ArmFault("arm", f"did not end the phase '{step.phase}' in time")
            left = seconds - (self.arm.now_ns() - start) / 1e9
            self.wait(min(self.poll_s, max(left, 1e-3)), sink)
        if not progress.state.healthy:
            raise arm_fault(progress.state, step.phase)
        if not progress.finished:
            raise ArmFault("arm", f"was stopped from outside in the phase '{step.phase}'")
        return progress.finished[-1]

    def wait(self, seconds: float, sink: Sink | None = None) -> None:
        """Let time pass in polls; streams are read and stop requests looked at in each.

        Raises:
            StopRequested: `should_stop` became true.
        """
        end = self.clock.now_ns() + round(seconds * 1e9)
        while (left := end - self.clock.now_ns()) > 0:
            self.clock.wait(min(self.poll_s, left / 1e9))
            if sink is not None:
                self._drain(sink)
            if self.should_stop():
                raise StopRequested

    def start_streams(self, seed: int, rate_hz: int, with_frames: bool) -> None:
        """Begin to stream; what came before is dropped. Raises RigError."""
        self.arm.read_poses()
        self.arm.read_pulses()
        self.events.start()
        if self.force is not None:
            self.force.start()
        by_itself = with_frames and self.timing.frames == "exposure line"
        if with_frames and not by_itself:
            self.frames.start()
        self.sync.start(rate_hz, seed % SEEDS + 1, self.timing.code)
        if by_itself:
            # the box must stamp every exposure, the first one too
            self.frames.start()

    def stop_streams(self, sink: Sink, with_frames: bool) -> None:
        """Stop the pulses, and read what the cameras still hold before and after they stop.

        Events later than `tail_s` after the motion are discarded; late pulses and frames are read.
        """
        if with_frames and self.timing.frames == "exposure line":
            self.frames.stop()
        self.sync.stop()
        self.wait(self.tail_s, sink)
        self.events.stop()
        sink.add_event_pulses(self.events.read_pulses())
        if self.force is not None:
            self.force.stop()
            sink.add_stream(FORCE, self.force.read())
        if with_frames:
            self.frames.stop()
            sink.add_frames(self.frames.read())

    def _drain(self, sink: Sink) -> None:
        sink.add_events(self.events.read())
        sink.add_event_pulses(self.events.read_pulses())
        sink.add_poses(self.arm.read_poses())
        sink.add_arm_pulses(self.arm.read_pulses())
        sink.add_sync_pulses(self.sync.read_pulses())
        sink.add_frames(self.frames.read())
        if self.timing.frames == "exposure line":
            sink.add_exposures(self.sync.read_exposures())
        if self.timing.reads_clocks:
            sink.add_box_reads(self.sync.read_clock())
        if self.timing.frames == "device time stamps":
            sink.add_frame_camera_reads(self.frames.read_clock())
        if self.force is not None:
            sink.add_stream(FORCE, self.force.read())

    def begin_trial(self, home: Position, seed: int) -> None:
        """Move to the start position, then let a simulation draw its random values.

        There the sensor is clear of the plate, and a force sensor takes its load for zero.
        """
        self.move(Move("home", home, RETRACT_SPEED_MM_S), self.position(), None)
        if self.simulation is not None:
            self.simulation.begin_trial(seed)
        if self.force is not None and self.force.zeroing == "trial":
            self.force.zero()

    def _segment(
        self, times: StepTimes, begin: Position, end: Position, speed: float
    ) -> PathSegment:
        places = self.plate_frame.pose(begin).xyz_mm, self.plate_frame.pose(end).xyz_mm
        return PathSegment(times.start_ns, times.end_ns, *places, speed)

    def position(self) -> Position:
        """Return where the tool centre point is now, in plate coordinates."""
        return self.plate_frame.position(self.arm.pose().xyz_mm)

    @contextmanager
    def safely(self, clear: Position) -> Iterator[None]:
        """Whatever goes wrong inside, stop: arm first, then retract if healthy, then cameras.

        A device that fails while it is stopped does not keep the others from being stopped. Then
        what went wrong first is raised; but an arm that could not be stopped or moved clear, and a
        plate that nobody has caught, are always reported.
        """
        try:
            yield
        except BaseException as error:
            fault: RigError | None = None
            try:
                fault = self._stop_arm() or self._retract(clear)
            finally:
                for device in (self.events, self.frames, self.sync, self.force):
                    with suppress(Exception):
                        if device is not None:
                            device.stop()
            self._reported = str(fault or "")
            if fault is not None and str(fault) != str(error):
                if isinstance(error, RigError) and error.device == "arm":
                    fault = ArmFault("arm", f"{_text(error)}. It {_text(fault)}")
                raise self._with_plate_warning(fault) from error
            if self._plate_uncaught and isinstance(error, RigError):
                raise self._with_plate_warning(error) from error
            raise

    def _with_plate_warning(self, error: RigError) -> RigError:
        """The same error, with a word on a plate that nobody has caught."""
        if not self._plate_uncaught:
            return error
        text = f"{_text(error)}. The plate was let go and nobody has caught it: catch it first"
        return ArmFault("arm", text) if error.device == "arm" else RigError(error.device, text)

    def _stop_arm(self) -> RigError | None:
        """Stop the arm; why that could not be done or seen, None if it stands still.

        A second Ctrl-C must not interrupt the stop.
        """
        for _ in range(_STOP_RETRIES):
            try:
                self.arm.stop()
            except KeyboardInterrupt:
                continue
            except RigError as fault:
                return fault
            except Exception as error:
                return ArmFault("arm", f"could not be stopped: {error!r}; look at the arm")
            return None
        return ArmFault("arm", "was not seen to stand still: its stop was interrupted")

    def _retract(self, clear: Position) -> RigError | None:
        """Straight out along the plate's normal, only with a healthy arm, bounded in time.

        Returns:
            Why a healthy arm did not come clear; it has been stopped then.
        """
        try:
            if not self.arm.state().healthy:
                return None
            at = self.position()
            out = Position(at.x_mm, at.y_mm, min(at.depth_mm, clear.depth_mm))
            if at.distance_mm(out) == 0:
                return None
            self.arm.start([Segment(self.plate_frame.pose(out), RETRACT_SPEED_MM_S)])
            polls = int((at.distance_mm(out) / RETRACT_SPEED_MM_S + 2.0) / self.poll_s) + 1
            for _ in range(polls):
                if (progress := self.arm.progress()).done:
                    if progress.finished:
                        return None
                    raise ArmFault(
                        "arm", f"did not come clear of the plate: {progress.state.value}"
                    )
                self.clock.wait(self.poll_s)
            raise ArmFault("arm", "did not come clear of the plate in time")
        except RigError as fault:
            return self._stop_arm() or fault
        except BaseException:
            self._stop_arm()
            raise


def arm_fault(state: ArmState, phase: str) -> ArmFault:
    """Return the error for an arm's state, with the action that a person must take."""
    lost = state is ArmState.DISCONNECTED
    where = "the arm may still move" if lost else "the arm stays where it is"
    return ArmFault(
        "arm",
        f"{state.value} in the phase '{phase}'; {where}: {state.advice}, move "
        "it clear of the plate, then run the same command to go on",
    )


def _text(error: RigError) -> str:
    """Return an error's text without the device's name."""
    return str(error).removeprefix(f"{error.device}: ")
