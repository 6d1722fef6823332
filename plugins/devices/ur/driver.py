"""Driver of Universal Robots e-Series arms (PolyScope 5.6 and later 5.x, remote control on).

The driver uses three independent channels to the controller, so that losing one leaves two: the
pose stream (`rtde`), the control client ur_rtde in a child process
(`control`), and the two text ports (`ports`). Every wait has a
timeout, one of the constants of its settings; `docs/arms.md` has measured times.

A segment is one `movel`, from rest to rest. Its start and end are the first controller cycles in
which the control script reports that the move is running, and that it has ended (bit 15 of
output_int_register_2), so they are known to one cycle (2 ms at 500 Hz).
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Sequence
from typing import Any

from sliplab.plugins.devices.ur import ports
from sliplab.plugins.devices.ur.control import ControlError, ControlProcess
from sliplab.plugins.devices.ur.rtde import (
    OUTPUTS,
    WRENCH,
    Packet,
    RtdeError,
    RtdeReader,
    UrStatus,
    status_of,
)
from sliplab.plugins.devices.ur.settings import (
    ANSWER_S,
    ARRIVED_MM,
    BEGIN_S,
    COMMAND_S,
    FULL_SPEED,
    JUMP_S,
    NEWS_S,
    OVERTIME_S,
    PORT_S,
    REACTION_S,
    SILENCE_S,
    STILL_MM_S,
    STILL_S,
    STOP_DECELERATION_MM_S2,
    TURN_DEG_S2,
    TURN_LATE_S,
    TURN_SHARE,
    WATCHDOG_HZ,
    UrSettings,
)
from sliplab.plugins.devices.ur.wrench_log import WrenchLog
from sliplab.rigs.core.capabilities import (
    ArmFault,
    ArmState,
    DeviceHealth,
    Pose,
    RigError,
    Segment,
)
from sliplab.rigs.core.pose import MM_PER_M, TURN_PER_M, distance_mm, segment_seconds, to_ur
from sliplab.rigs.core.pose_stream import PoseCheck, PoseJumpError, Sample
from sliplab.rigs.core.threaded_arm import Run, ThreadedArm
from sliplab.storage.streams import Json

_UNKNOWN_NS = 1 << 62
"""Marks a move that is being sent, before the time of its acceptance is known."""


def measuring_arm(settings: UrSettings) -> UrArm:
    """Return an arm whose controller also sends the wrench at the tool."""
    return UrArm(settings, WrenchLog())


class UrArm(ThreadedArm):
    """A Universal Robots arm; an `Arm` of `rigs.core.capabilities`.

    Args:
        wrenches: keeps the wrench of every packet; if left out, the controller does not send it.
    """

    def __init__(self, settings: UrSettings, wrenches: WrenchLog | None = None) -> None:
        super().__init__(settings.limits)
        self._settings = settings
        self._reader: RtdeReader | None = None
        self._control: ControlProcess | None = None
        self._listener: threading.Thread | None = None
        self._status: UrStatus | None = None
        self._check_pose = PoseCheck()
        self._advanced_ns: int | None = None
        """Host time of the last packet with a new time."""
        self._remote = True
        self._closing = False
        self._moved_ns: int | None = None
        """Host time at which the last move was sent; None once the arm is confirmed at rest."""
        self.wrenches = wrenches
        self._missing = 0
        self._rose_ns: int | None = None
        self._fell_ns: int | None = None
        self._starting = threading.Lock()
        self._commanding = threading.Lock()
        """Held while a move or a stop is sent: no move may follow the stop that ends it."""

    def connect(self) -> None:
        """Open the pose stream, take control, set tool, payload and watchdog.

        Takes at most `ANSWER_S` + 3 `SILENCE_S` + 3 `PORT_S` + 2 `STILL_S` +
        `control.START_S` + 3 `COMMAND_S`.

        Raises:
            ArmFault: no connection, another client has control, or the arm is not ready to move.
        """
        if self._lost is None and self._control is not None:
            return
        try:
            self._open_stream()
            self._check_remote()
            self._check_free()
            self._take_control()
            self._check_pose.active = True
        except BaseException:
            self.close()
            raise

    def state(self) -> ArmState:
        """Return the state in the last packet without waiting."""
        if self._lost is not None or self._status is None:
            return ArmState.DISCONNECTED
        if self._status.stopped is not None:
            return self._status.stopped
        if not self._remote:
            return ArmState.REMOTE_CONTROL_OFF
        if not self._status.running:
            return ArmState.NOT_RUNNING
        return ArmState.READY if self._run.done else ArmState.MOVING

    def pose(self) -> Pose:
        """Return the tool centre point in the last packet. Raises ArmFault without one."""
        return self._last().pose

    def now_ns(self) -> int:
        """Return the controller's clock in the last packet, ns. Raises ArmFault without one."""
        return self._last().t_ns

    def health(self) -> DeviceHealth:
        """Return the controller's health report; takes at most 8 s.

        Raises:
            ArmFault: it does not answer.
        """
        notes = (f"sync line on digital input {self._settings.sync_input}",)
        try:
            return ports.read_health(self._settings.host, notes)
        except ports.PortError as error:
            raise ArmFault("arm", f"{error}; check its power and network") from None

    def describe(self) -> Json:
        """Return the counts of missing poses, by gaps in the clock, and of those not believed."""
        return {"poses_missing": self._missing, "poses_implausible": self._check_pose.dropped}

    def start(self, path: Sequence[Segment]) -> None:
        """Check `path` against all limits, and start its first move on the controller.

        Takes at most `PORT_S` + `BEGIN_S` + (1 + segments) `COMMAND_S`, and 2 `PORT_S` on a fault.

        Raises:
            GuardError: a limit forbids the path; nothing was sent.
            ArmFault: the arm cannot move.
            RigError: it is still moving, or the path is empty.
        """
        with self._starting:
            self._refuse(path, moving=False)
            self._check_remote()
            state = self.state()
            self._refuse(path, moving=state is ArmState.MOVING)
            if state is not ArmState.READY:
                raise self._fault(state, "cannot move")
            self._check(path)
            run = Run(path)
            self._run = run
            try:
                self._send(run, path[0])
            except ArmFault:
                run.done = True
                raise
            self._begin(run)

    def zero_force(self) -> None:
        """Take the present load of the tool for zero; takes at most `COMMAND_S` and 3 `STILL_S`.

        Raises:
            ArmFault: the arm is not connected, or its control client is lost.
        """
        if not self._call("zeroFtSensor"):
            raise self._fault(self.state(), "did not zero its force sensor")

    def stop(self) -> None:
        """Stop the arm over every available channel; never unlocks anything.

        Takes at most 2 `COMMAND_S` + 4 `PORT_S` + 3 `STILL_S`.

        Raises:
            ArmFault: a move was sent, and the arm is not confirmed at rest since, neither by its
                stream nor over a new connection. The controller's watchdog ends the move after
                1 / `settings.WATCHDOG_HZ` s if the network has failed.
        """
        run = self._run
        run.cancelled = True
        self._stream.wake()
        resting = self._status is None or self._is_still()
        if run.done and resting and self._moved_ns is None:
            return
        if not (self._stop_by_control() and self._wait_still()):
            reached = self._end_program()
            if not (self._wait_still() if self._lost is None else self._is_still_by_new_stream()):
                if self._lost is None:
                    raise ArmFault("arm", "does not stop: press its emergency stop")
                if reached:
                    raise ArmFault(
                        "arm",
                        f"accepted a stop but cannot be confirmed at rest ({self._lost}): check "
                        "the arm before you go near it",
                    )
                raise ArmFault(
                    "arm",
                    f"cannot be reached to stop it ({self._lost}); its own watchdog ends a "
                    f"move after {1 / WATCHDOG_HZ:g} s: check the arm before you go near it",
                )
        self._moved_ns = None
        run.join(STILL_S)
        run.done = True

    def stopping_s(self, speed_mm_s: float) -> float:
        """Stopping distance as time at full speed; see `StoppingArm`."""
        return REACTION_S + speed_mm_s / (2 * STOP_DECELERATION_MM_S2)

    def close(self) -> None:
        """Stop the arm, end the control program and close every connection.

        Raises nothing; call `stop` before or after it to confirm that the arm is at rest.
        """
        self._closing = True
        control, self._control = self._control, None
        if control is not None:
            if self._lost is not None:
                if self._moved_ns is not None:
                    self._end_program()
            else:
                try:
                    control.call("stopL", STOP_DECELERATION_MM_S2 / MM_PER_M, True, within_s=PORT_S)
                    control.call("stopScript", within_s=PORT_S)
                except ControlError:
                    self._end_program()
            control.close()
        self._run.cancelled = True
        self._lost = self._lost or "closed"
        if self._reader is not None:
            self._reader.close()
        self._stream.wake()
        for thread in (self._listener, self._run.thread):
            if thread is not None:
                thread.join(SILENCE_S + STILL_S)
        self._reader = self._listener = None
        self._run.done = True

    def _open_stream(self) -> None:
        reader = RtdeReader(self._settings.host, ANSWER_S, SILENCE_S)
        names = OUTPUTS if self.wrenches is None else (*OUTPUTS, WRENCH)
        try:
            reader.open(names, self._settings.frequency_hz)
        except RtdeError as error:
            raise ArmFault(
                "arm", f"{error}; check its power, its network and its address"
            ) from None
        self._reader, self._status, self._lost, self._closing = reader, None, None, False
        self._missing, self._advanced_ns = 0, None
        self._check_pose = PoseCheck(self._settings.limits.speed_mm_s)
        self._check_pose.active = False  # until the tool is set, which moves its centre point
        self._listener = threading.Thread(target=self._listen, args=(reader,), daemon=True)
        self._listener.start()
        first = self._stream.wait_for(lambda: bool(self._status or self._lost), SILENCE_S + 0.5)
        if not first or self._lost is not None:
            raise ArmFault("arm", f"sent no pose: {self._lost}")

    def _check_free(self) -> None:
        """Check that the arm is at rest, may move, and has no program loaded.

        Raises:
            ArmFault: it does not. The control client would end any program, even a paused one,
                and would wait in vain for an arm without power.
        """

        def has_program() -> bool:  # ending a program takes a cycle or two
            return self._status is not None and self._status.program

        state = self.state()
        if state not in {ArmState.READY, ArmState.NOT_RUNNING}:
            raise self._fault(state, "cannot connect")
        self._stream.wait_for(lambda: not has_program(), NEWS_S)
        status = self._status
        assert status is not None
        if status.program:
            what = "running" if status.playing else "paused"
            raise ArmFault("arm", f"a program is already {what} on it; end it at the pendant first")
        if status.off:
            raise ArmFault("arm", f"is not switched on ({status.off}); {self.state().advice}")
        if not self._stream.wait_for(self._is_still, STILL_S):
            raise ArmFault("arm", "is moving though no program is running on it; check the arm")
        self._moved_ns = None

    def _take_control(self) -> None:
        settings, tool = self._settings, self._settings.tool
        try:
            self._control = ControlProcess(settings.host, settings.frequency_hz)
        except ControlError as error:
            if "already in use" in str(error):
                raise ArmFault(
                    "arm",
                    "another client has control of it, or a fieldbus holds its registers; end "
                    f"that client first, or switch the fieldbus off. The client reports: {error}",
                ) from None
            self._end_program()  # its script may have arrived
            raise ArmFault("arm", f"did not give control: {error}") from None
        tcp = to_ur(Pose(tool.tcp_mm, tool.tcp_rotvec_deg))
        centre = [value / MM_PER_M for value in tool.centre_of_mass_mm]
        self._call("setTcp", tcp)
        self._call("setPayload", tool.mass_kg, centre)
        self._call("setWatchdog", WATCHDOG_HZ)
        self._stream.wait_for(lambda: self.state() is ArmState.READY, SILENCE_S)
        if self.state() is not ArmState.READY:
            raise self._fault(self.state(), "cannot connect")

    def _listen(self, reader: RtdeReader) -> None:
        """Receive packets in the reader's thread until the stream ends or is invalid."""
        try:
            while not self._closing:
                for packet in reader.read():
                    self._take(packet)
        except Exception as error:  # a thread that dies must not look like an arm at rest
            if self._closing:
                return
            named = isinstance(error, RtdeError | PoseJumpError)
            self._lost = str(error) if named else f"its stream: {error!r}"
            if self._control is not None:
                self._control.kill()  # or it would reconnect and repeat the move
            self._stream.wake()

    def _take(self, packet: Packet) -> None:
        status = status_of(packet.values, self._settings.sync_input)
        before = self._status
        if before is not None and not 0 <= status.t_ns - before.t_ns <= JUMP_S * 1e9:
            seconds = (status.t_ns - before.t_ns) / 1e9
            how = (
                f"jumped back by {-seconds:.3f} s" if seconds < 0 else f"jumped by {seconds:.3f} s"
            )
            raise RtdeError(f"its clock {how}: the controller restarted, or packets are invalid")
        if before is not None and status.t_ns == before.t_ns and self._advanced_ns is not None:
            if packet.host_ns - self._advanced_ns > SILENCE_S * 1e9:
                raise RtdeError(f"its clock has stopped for {SILENCE_S:g} s")
            return
        self._advanced_ns = packet.host_ns
        x, y, z, a, b, c = packet.values[1:7]
        xyz_mm = (x * MM_PER_M, y * MM_PER_M, z * MM_PER_M)
        rotvec_deg = (math.degrees(a), math.degrees(b), math.degrees(c))
        pose = Pose(xyz_mm, rotvec_deg)
        if not self._check_pose.believes(status.t_ns, packet.host_ns, pose):
            return
        if before is not None:
            cycles = (status.t_ns - before.t_ns) * self._settings.frequency_hz / 1e9
            self._missing += max(round(cycles) - 1, 0)
        if before is not None and status.move_runs != before.move_runs:
            if status.move_runs:
                self._rose_ns, self._fell_ns = status.t_ns, None
            else:
                self._fell_ns = status.t_ns
        self._status = status
        moved_ns = self._moved_ns
        if moved_ns is not None and packet.host_ns > moved_ns + NEWS_S * 1e9 and _rests(status):
            self._rested(moved_ns)
        self._stream.add(Sample(status.t_ns, packet.host_ns, xyz_mm, rotvec_deg, status.sync))
        if self.wrenches is not None:
            self.wrenches.add(status.t_ns, packet.host_ns, packet.values[-6:])

    def _rested(self, moved_ns: int) -> None:
        """Record that the arm is at rest after the move of `moved_ns`, if that is the last one."""
        if self._commanding.acquire(blocking=False):  # held: another move is being sent
            try:
                if self._moved_ns == moved_ns:
                    self._moved_ns = None
            finally:
                self._commanding.release()

    def _check(self, path: Sequence[Segment]) -> None:
        """Check a path against the rig's limits, then against the controller's."""
        assert self._status is not None
        self._guard.check(self.pose(), path)
        self._guard.check_joints(self._status.joints_deg)
        self._check_slider("every move would be too slow")
        for segment in path:
            if not self._call("isPoseWithinSafetyLimits", to_ur(segment.to)):
                # The client also answers no once its program has ended.
                if self._stream.wait_for(lambda: self.state() is not ArmState.READY, NEWS_S):
                    raise self._fault(self.state(), "cannot move")
                x, y, z = segment.to.xyz_mm
                raise RigError(
                    "arm",
                    f"its controller reports ({x:.1f}, {y:.1f}, {z:.1f}) mm as outside its safety "
                    "limits or its reach",
                )

    def _check_slider(self, so: str) -> None:
        """Raise ArmFault, with the consequence `so`, if the speed slider slows the arm down."""
        status = self._status
        if status is not None and status.speed_fraction < FULL_SPEED:
            raise ArmFault(
                "arm",
                f"its speed slider is at {status.speed_fraction:.0%}, so {so}: set it to "
                "100 % at the pendant",
            )

    def _send(self, run: Run, segment: Segment) -> bool:
        """Send one move to the controller; return False if a stop came first.

        Raises:
            ArmFault: it was not accepted.
        """
        self._stream.wait_for(lambda: not self._moves(), BEGIN_S)
        speed = segment.speed_mm_s / MM_PER_M
        acceleration = self._settings.acceleration_mm_s2 / MM_PER_M
        if segment.turn_deg_s is not None:
            speed = math.radians(segment.turn_deg_s) / TURN_PER_M
            acceleration = math.radians(TURN_DEG_S2) / TURN_PER_M
        with self._commanding:
            if run.cancelled:
                return False
            self._rose_ns = self._fell_ns = None
            self._moved_ns = _UNKNOWN_NS
            taken = self._call("moveL", to_ur(segment.to), speed, acceleration, True)
            self._moved_ns = time.monotonic_ns()
        if not taken:
            raise self._fault(self.state(), "did not accept a move")
        return True

    def _follow_path(self, run: Run) -> None:
        """Wait for each segment to end, and send the next one."""
        for index, segment in enumerate(run.path):
            if index and not self._send(run, segment):
                return
            times = self._await_segment(run, segment)
            if times is None:
                return
            run.finished.append(times)

    def _abort(self) -> None:
        if not (self._stop_by_control() and self._wait_still()):
            self._end_program()

    def _await_segment(self, run: Run, segment: Segment) -> tuple[int, int] | None:
        """Return start and end of the move that was just sent; None if it was stopped."""

        def slowed() -> bool:
            return self._status is not None and self._status.speed_fraction < FULL_SPEED

        def ended() -> bool:
            over = self._fell_ns is not None or run.cancelled or not self.state().healthy
            return over or slowed()

        begun = self._stream.wait_for(lambda: self._rose_ns is not None or ended(), BEGIN_S)
        if not begun and not self._is_at(segment.to):
            raise ArmFault("arm", f"accepted a move but did not start it within {BEGIN_S:g} s")
        if not begun:  # a move of no length ends before a packet can show it running
            now = self.now_ns()
            return now, now
        seconds = segment_seconds(self.pose(), segment)
        if not self._stream.wait_for(ended, 1.5 * seconds + OVERTIME_S):
            raise ArmFault("arm", f"did not finish a {seconds:.1f} s move in time; it was stopped")
        if not self.state().healthy:
            self._end_program()  # so that nothing continues when the stop is unlocked
            return None
        if not run.cancelled:
            self._check_slider("the move was too slow and was aborted")
        if run.cancelled or self._rose_ns is None or self._fell_ns is None:
            return None
        if segment.turn_deg_s is not None:
            self._check_turn(seconds, (self._fell_ns - self._rose_ns) / 1e9, segment.turn_deg_s)
        return (self._rose_ns, self._fell_ns) if self._is_at(segment.to) else None

    def _check_turn(self, planned_s: float, took_s: float, turn_deg_s: float) -> None:
        """Raise ArmFault if a turn on the spot was not at its speed; see `TURN_PER_M`."""
        ramps_s = turn_deg_s / TURN_DEG_S2
        if abs(took_s - planned_s - ramps_s) > TURN_SHARE * planned_s + TURN_LATE_S:
            raise ArmFault(
                "arm",
                f"turned in {took_s:.2f} s instead of {planned_s + ramps_s:.2f} s: its controller "
                "does not turn the tool at the speed that was set",
            )

    def _stop_by_control(self) -> bool:
        """Stop over the control client, after any move in progress there; return success."""
        if self._control is None or self._lost is not None:
            return False
        if not self._commanding.acquire(timeout=COMMAND_S):
            return False
        deceleration = STOP_DECELERATION_MM_S2 / MM_PER_M
        try:
            self._control.call("stopL", deceleration, True, within_s=COMMAND_S)
        except ControlError:
            return False
        finally:
            self._commanding.release()
        return True

    def _end_program(self) -> bool:
        """End the controller's program over the text ports; return whether it was confirmed."""
        deceleration = STOP_DECELERATION_MM_S2 / MM_PER_M
        return ports.end_program(self._settings.host, deceleration, PORT_S)

    def _wait_still(self) -> bool:
        """Return whether a packet read from now on shows the arm at rest within `STILL_S`."""
        now_ns = time.monotonic_ns()

        def still() -> bool:
            last = self._stream.last
            return last is not None and last.host_ns > now_ns and self._is_still()

        return self._stream.wait_for(still, STILL_S)

    def _is_still(self) -> bool:
        return self._status is not None and _rests(self._status)

    def _is_still_by_new_stream(self) -> bool:
        """Return whether a new connection shows the arm at rest in time."""
        reader = RtdeReader(self._settings.host, PORT_S, PORT_S)
        end = time.monotonic() + PORT_S + STILL_S
        with contextlib.suppress(RtdeError):
            try:
                reader.open(OUTPUTS, self._settings.frequency_hz)
                while time.monotonic() < end:
                    newest = reader.read()[-1]
                    if _rests(status_of(newest.values, self._settings.sync_input)):
                        return True
            finally:
                reader.close()
        return False

    def _moves(self) -> bool:
        return self._status is not None and self._status.move_runs

    def _is_at(self, pose: Pose) -> bool:
        return distance_mm(self.pose(), pose) <= ARRIVED_MM

    def _check_remote(self) -> None:
        try:
            answer = ports.dashboard(self._settings.host, "is in remote control", PORT_S)
        except ports.PortError as error:
            raise ArmFault("arm", f"does not answer: {error}") from None
        self._remote = answer.strip().lower() == "true"

    def _call(self, name: str, *arguments: Any) -> Any:
        if self._control is None:
            raise self._fault(ArmState.DISCONNECTED, "cannot move")
        try:
            return self._control.call(name, *arguments, within_s=COMMAND_S)
        except ControlError as error:
            self._end_program()
            stopped = self._lost is None and self._wait_still()
            how = "it was stopped" if stopped else "it cannot be confirmed at rest"
            raise ArmFault("arm", f"lost its control client; {how}: {error}") from None

    def _last(self) -> Sample:
        last = self._stream.last
        if last is None:
            raise self._fault(ArmState.DISCONNECTED, "has no pose")
        return last


def _rests(status: UrStatus) -> bool:
    """Return whether a packet shows the arm at rest; an ended program leaves `move_runs` set."""
    return status.speed_mm_s < STILL_MM_S and not (status.move_runs and status.running)
