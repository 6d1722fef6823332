"""What one packet of a Universal Robots controller says of the arm's state.

Bits and values as in the maker's RTDE guide (safety_status_bits, robot_status_bits, runtime_state,
robot_mode) and in ur_rtde 1.6.5's control script (output_int_register_2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from sliplab.rigs.core.capabilities import ArmState

OUTPUTS = (
    "timestamp",
    "actual_TCP_pose",
    "actual_q",
    "target_TCP_speed",
    "actual_digital_input_bits",
    "robot_status_bits",
    "safety_status_bits",
    "runtime_state",
    "robot_mode",
    "target_speed_fraction",
    "output_int_register_2",
)
"""What the driver asks the stream for, in this order."""
_EMERGENCY = 0b1110_0000
"""System, robot and any emergency stop."""
_PROTECTIVE = 0b111_0001_1100
"""Protective stop, recovery mode, safeguard stop, violation, fault, stopped due to safety."""
_STOPPED, _PLAYING = 1, 2
"""Values of runtime_state; 0 stopping, 3 pausing, 4 paused and 5 resuming hold a program too."""
_MODE_RUNNING = 7
_MODES = {
    -1: "no controller",
    0: "disconnected",
    1: "safety to be confirmed",
    2: "booting",
    3: "power off",
    4: "power on",
    5: "idle, brakes on",
    6: "backdrive",
    8: "updating firmware",
}
"""Values of robot_mode in which no program can move the arm."""
_POWERED, _PROGRAM = 1, 2
_MOVE_RUNS = 1 << 15


@dataclass(frozen=True)
class UrStatus:
    """One packet without its pose."""

    t_ns: int
    joints_deg: tuple[float, ...]
    speed_mm_s: float
    """Commanded speed of the tool centre point."""
    sync: bool
    """Level of the sync input."""
    stopped: ArmState | None
    """The safety stop that the arm is in."""
    running: bool
    """Powered, brakes released, and the control program runs."""
    program: bool
    """The controller holds a program that has not ended: it plays, is paused, or is about to."""
    playing: bool
    """A program plays, ours or another."""
    off: str
    """Why the arm is not switched on, in the words of its robot mode; empty if it is."""
    speed_fraction: float
    """Where the pendant's speed slider stands, 0 to 1."""
    move_runs: bool
    """The control script says that an asynchronous move runs."""


def status_of(values: Sequence[float], sync_input: int) -> UrStatus:
    """The status in one packet's flat values."""
    inputs, robot, safety, runtime, mode = (int(value) for value in values[19:24])
    stopped = None
    if safety & _EMERGENCY:
        stopped = ArmState.EMERGENCY_STOP
    elif safety & _PROTECTIVE:
        stopped = ArmState.PROTECTIVE_STOP
    return UrStatus(
        t_ns=round(values[0] * 1e9),
        joints_deg=tuple(math.degrees(value) for value in values[7:13]),
        speed_mm_s=math.hypot(*values[13:16]) * 1000.0,
        sync=bool(inputs >> sync_input & 1),
        stopped=stopped,
        running=bool(robot & _POWERED and robot & _PROGRAM)
        and runtime == _PLAYING
        and mode == _MODE_RUNNING,
        program=runtime != _STOPPED,
        playing=runtime == _PLAYING,
        off="" if mode == _MODE_RUNNING else _MODES.get(mode, f"robot mode {mode}"),
        speed_fraction=values[24],
        move_runs=bool(int(values[25]) & _MOVE_RUNS),
    )
