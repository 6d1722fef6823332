"""State of a fake Universal Robots controller: safety, registers, the control program.

It follows ur_rtde 1.6.5 (`scripts/rtde_control.script` in its source distribution) and the vendor's
RTDE guide: input_int_register_0 holds a command, output_int_register_0 is 1 ready or 2 done, and
output_int_register_2 has the progress of an asynchronous move (bit 15: running). The sockets are in
`plugins.devices.ur.fake`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from enum import IntEnum

from sliplab.rigs.core.capabilities import Pose
from sliplab.rigs.core.fake_motion import ON_THE_SPOT_MM, StraightMotion
from sliplab.rigs.core.fakes import CLOCK_BACK_S, Fault, FaultPlan, Kind, Stage
from sliplab.rigs.core.pose import MM_PER_M, TURN_PER_M, distance_mm, from_ur, to_ur

READY, DONE = 1, 2
RUNNING_BIT = 1 << 15
PROTECTIVE_DECELERATION_MM_S2 = 5000.0
_CONTROL_MARK = "RTDE Control Script"
_NUMBER = r"([0-9.eE+-]+)"
Load = Callable[[float], Sequence[float] | None]
"""Force and torque on the tool by controller time, base axes, N and N m; None while they are not
known yet, which holds up the packets that have them."""


class Safety(IntEnum):
    """Bits of `safety_status_bits`."""

    NORMAL = 1 << 0
    PROTECTIVE_STOP = 1 << 2
    SAFEGUARD_STOP = 1 << 4
    EMERGENCY_STOP = 1 << 7


class Runtime(IntEnum):
    """Values of `runtime_state`."""

    STOPPED = 1
    PLAYING = 2
    PAUSED = 4


class UrProgram:
    """The controller's work in one cycle, and the values that it reports.

    Args:
        motion: motion of the tool centre point.
        reach_mm: poses farther than this from the base are outside the safety limits.
        joints_deg: reported joint angles; a fake has no joints.
        digital_inputs: levels of the digital inputs by controller time.
        cut: called for the faults of the connection.
        faults: faults to inject.
        rate: controller seconds per host second; the watchdog counts the host's seconds.
        tool_load: load on the tool; none if left out.
    """

    def __init__(
        self,
        motion: StraightMotion,
        reach_mm: float,
        joints_deg: Sequence[float],
        digital_inputs: Callable[[float], int],
        cut: Callable[[Kind], None],
        faults: Sequence[Fault] = (),
        rate: float = 1.0,
        tool_load: Load | None = None,
    ) -> None:
        self.motion, self._reach_mm, self._cut, self._rate = motion, reach_mm, cut, rate
        self.joints_deg = list(joints_deg)
        self.digital_inputs = digital_inputs
        self.ints_in, self.doubles_in = [0] * 48, [0.0] * 48
        self.ints_out, self.doubles_out = [0] * 48, [0.0] * 48
        self.safety = Safety.NORMAL
        self.remote = True
        self.runtime = Runtime.STOPPED
        self.tcp = [0.0] * 6
        self.tool_load: Load = tool_load or (lambda t_s: (0.0,) * 6)
        self._zero_load: Sequence[float] = (0.0,) * 6
        self._zeroed_s: float | None = None
        """Time of a request to take the load for zero, until the load of that time is known."""
        self.payload_kg = 0.0
        self.uploads = 0
        self.faults = FaultPlan(faults, self.inject)
        self._watchdog_s: float | None = None
        self._written_s = 0.0
        self._executing = False
        self._blocking = False
        self._asynchronous = False
        self._operation = 0
        self._left_from: Pose | None = None
        self._t = 0.0
        self._here = motion.pose(0.0).xyz_mm
        self._tcp_at: tuple[float, list[float]] = (math.nan, [])
        self._speed_mm_s = [0.0, 0.0, 0.0]
        self.foreign = False
        """True while another client's program runs, which reads no register and moves nothing."""
        self.hung = False
        """True to report a running program that ignores commands."""
        self.speed_fraction = 1.0
        """Position of the pendant's speed slider, which scales every move."""
        self.powered = True
        self.clock_shift_s = 0.0
        """Error of the time in the packets."""
        self.refused: list[str] = []
        """Requests that are not simulated."""
        self._leg: tuple[Pose, float, float, float] | None = None
        """Target, speed and acceleration of the last move, and the slider's position."""

    @property
    def program_running(self) -> bool:
        """True if a program is on the controller, a paused one included."""
        return self.runtime is not Runtime.STOPPED

    def cycle(self, t_s: float) -> None:
        """Advance to controller time `t_s`."""
        x, y, z = (value * MM_PER_M for value in self._tcp(t_s)[:3])
        here = (x, y, z)
        seconds = max(t_s - self._t, 1e-9)
        self._speed_mm_s = [(b - a) / seconds for a, b in zip(self._here, here, strict=True)]
        self._here, self._t = here, t_s
        self._moving_faults()
        self._idle_faults()
        if self._watchdog_s is not None and t_s - self._written_s > self._watchdog_s:
            self.end_program()  # rtde_set_watchdog(..., "stop")
        if self.runtime is not Runtime.PLAYING or self.foreign:
            return
        self._follow_slider()
        if self._asynchronous and not self.motion.moving(t_s):
            self._signal_async(False)
        if self._blocking:
            if self.motion.moving(t_s):
                return
            self._blocking = False
            self.ints_out[0] = DONE
        if not self.hung:
            self._command(self.ints_in[0])

    def write(self, name: str, value: int | float) -> None:
        """Write one input register."""
        index = int(name.rsplit("_", 1)[1])
        if name.startswith("input_int"):
            self.ints_in[index] = int(value)
            if index == 0:
                self._written_s = self._t
        else:
            self.doubles_in[index] = float(value)

    def postpone_watchdog(self, seconds: float) -> None:
        """Postpone the watchdog by `seconds`, for which the fake itself was suspended."""
        self._written_s += seconds

    def script(self, text: str) -> None:
        """Run a script from the script port; it ends the program that ran before."""
        if not self.remote:
            return
        self.end_program()
        able = self.safety is Safety.NORMAL and self.powered
        if _CONTROL_MARK in text:
            self.uploads += 1
            if able:
                self.runtime = Runtime.PLAYING
                self.ints_out[0] = READY
                self.ints_out[2] = 0
            return
        if text.startswith("def "):
            if able:
                self.runtime, self.foreign = Runtime.PLAYING, True
            return
        if found := re.search(rf"stopl\({_NUMBER}\)", text):
            self.motion.stop(float(found[1]) * MM_PER_M, self._t)
        else:
            self.refused.append(f"script {text.strip()[:60]!r}")

    def end_program(self) -> None:
        """End the program; the arm decelerates to rest."""
        self.runtime, self.foreign = Runtime.STOPPED, False
        self._watchdog_s = self._leg = None
        self._executing = self._blocking = self._asynchronous = False
        self.motion.stop(PROTECTIVE_DECELERATION_MM_S2, self._t)

    def inject(self, kind: Kind) -> None:
        """Inject a fault now."""
        if kind is Kind.EMERGENCY_STOP:
            self.safety = Safety.EMERGENCY_STOP
            self.end_program()
        elif kind in {Kind.PROTECTIVE_STOP, Kind.SAFEGUARD_STOP}:
            protective = kind is Kind.PROTECTIVE_STOP
            self.safety = Safety.PROTECTIVE_STOP if protective else Safety.SAFEGUARD_STOP
            self._pause()
        elif kind is Kind.PROGRAM_PAUSED:
            self._pause()
        elif kind is Kind.POWER_OFF:
            self.powered = False
            self.end_program()
        elif kind is Kind.CLOCK_BACK:
            self.clock_shift_s -= CLOCK_BACK_S
        elif kind is Kind.REMOTE_OFF:
            self.remote = False
            self.end_program()
        elif kind is Kind.PROGRAM_END:
            self.end_program()
        else:
            self._cut(kind)

    def _pause(self) -> None:
        """Stop the arm; a program waits to be resumed, which is not simulated."""
        self.motion.stop(PROTECTIVE_DECELERATION_MM_S2, self._t)
        if self.program_running:
            self.runtime = Runtime.PAUSED

    def unlock(self) -> bool:
        """Unlock a protective stop, if there is one; a paused program stays paused."""
        was = self.safety is Safety.PROTECTIVE_STOP
        if was:
            self.safety = Safety.NORMAL
        return was

    def value(self, name: str, t_s: float) -> int | float | list[float]:
        """Return the value of an RTDE output at `t_s`; 0 where it is not modelled."""
        return self.reader(name)(t_s)

    def reader(self, name: str) -> Callable[[float], int | float | list[float]]:
        """Return the function from controller time to the value of an RTDE output."""
        kind, _, index = name.rpartition("_")
        if kind == "output_int_register":
            return lambda t_s, k=int(index): self.ints_out[k]  # type: ignore[misc]
        if kind == "output_double_register":
            return lambda t_s, k=int(index): self.doubles_out[k]  # type: ignore[misc]
        known: dict[str, Callable[[float], int | float | list[float]]] = {
            "timestamp": lambda t_s: t_s + self.clock_shift_s,
            "actual_TCP_pose": self._tcp,
            "target_TCP_pose": self._tcp,
            "target_TCP_speed": lambda _: self._velocity(),
            "target_speed_fraction": lambda _: self.speed_fraction,
            "actual_q": lambda _: [angle * 0.017453292519943295 for angle in self.joints_deg],
            "actual_digital_input_bits": self.digital_inputs,
            "robot_status_bits": lambda _: self.powered | (2 if self.program_running else 0),
            "safety_status_bits": lambda _: int(self.safety),
            "runtime_state": lambda _: int(self.runtime),
            "robot_mode": lambda _: 7 if self.powered else 3,
            "payload": lambda _: self.payload_kg,
        }
        return known.get(name, lambda _: 0)

    def felt(self, t_s: float) -> list[float] | None:
        """Return force and torque on the tool since it was zeroed; None if not known yet."""
        load = self.tool_load(t_s)
        if load is not None and self._zeroed_s is not None and self._zeroed_s <= t_s:
            self._zero_load = self.tool_load(self._zeroed_s) or self._zero_load
            self._zeroed_s = None
        return None if load is None else [a - b for a, b in zip(load, self._zero_load, strict=True)]

    def _velocity(self) -> list[float]:
        """Return the tool centre point's linear velocity in the last cycle, m/s."""
        return [*(v / MM_PER_M for v in self._speed_mm_s), 0.0, 0.0, 0.0]

    def _tcp(self, t_s: float) -> list[float]:
        """Return the tool centre point as RTDE reports it; computed once per cycle."""
        if self._tcp_at[0] != t_s:
            self._tcp_at = t_s, to_ur(self.motion.pose(t_s))
        return self._tcp_at[1]

    def _command(self, command: int) -> None:
        if command == 0:
            self._executing = False
            self.ints_out[0] = READY
        elif not self._executing:
            self._executing = True
            self._execute(command)
            if not self._blocking and self.program_running:
                self.ints_out[0] = DONE

    def _execute(self, command: int) -> None:
        values = self.doubles_in
        if command == 3:
            self._left_from = self.motion.pose(self._t)
            to, speed = from_ur(values[:6]), values[6] * MM_PER_M
            acceleration = values[7] * MM_PER_M
            if distance_mm(self._left_from, to) < ON_THE_SPOT_MM:  # the motion counts degrees then
                speed, acceleration = (
                    math.degrees(value * TURN_PER_M) for value in (values[6], values[7])
                )
            self._leg = to, speed, acceleration, self.speed_fraction
            self.motion.move(to, speed * self.speed_fraction, self._leg[2], self._t)
            self._begin(bool(self.ints_in[1]))
        elif command in {33, 34}:
            self._signal_async(False)
            self._leg = None
            # stopJ is given in rad/s^2; without joints it is treated as m/s^2
            self.motion.stop(values[0] * MM_PER_M, self._t)
            self._begin(bool(self.ints_in[1]))
        elif command == 8:
            self._zeroed_s = self._t
        elif command == 17:
            self.payload_kg = values[0]
        elif command == 29:
            self.tcp = values[:6]
        elif command == 31:
            self.inject(Kind.PROTECTIVE_STOP)
        elif command == 35:
            self._watchdog_s, self._written_s = self._rate / values[0], self._t
        elif command == 36:
            far = distance_mm(from_ur(values[:6]), Pose((0, 0, 0), (0, 0, 0)))
            self.ints_out[1] = int(far <= self._reach_mm)
        else:  # 255 ends the program; other commands are not simulated and make it fail
            if command != 255:
                self.refused.append(f"command {command}")
            self.end_program()

    def _follow_slider(self) -> None:
        """Change the speed of the current move once the slider has been moved."""
        if self._leg is None or self._leg[3] == self.speed_fraction:
            return
        to, speed, acceleration, _ = self._leg
        self._leg = to, speed, acceleration, self.speed_fraction
        if self.motion.moving(self._t):
            self.motion.move(to, max(speed * self.speed_fraction, 1e-6), acceleration, self._t)

    def _begin(self, asynchronous: bool) -> None:
        if asynchronous:
            self._signal_async(True)
        else:
            self._blocking = True

    def _signal_async(self, running: bool) -> None:
        self._asynchronous = running
        if running:
            self._operation = (self._operation + 1) % 128
        self.ints_out[2] = (self._operation << 24) | (RUNNING_BIT if running else 0)

    def _moving_faults(self) -> None:
        if self._left_from is None or not self.motion.moving(self._t) or not self.faults:
            return
        gone = distance_mm(self._left_from, self.motion.pose(self._t))
        self.faults.reach(Stage.MOVING, gone)

    def _idle_faults(self) -> None:
        if self.faults and self.runtime is Runtime.PLAYING and not self.motion.moving(self._t):
            self.faults.reach(Stage.IDLE)
