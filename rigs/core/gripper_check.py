"""Checks of a gripper's move before it is sent, and of its state, against its range."""

from __future__ import annotations

import math

from sliplab.rigs.core.capabilities import GripperState, RigError
from sliplab.rigs.core.gripper_range import GripperRange

_EPS = 1e-9
STATE_MM = 2.0
"""Largest distance of a reported opening beyond the range: the ends are nominal."""


def check_move(allowed: GripperRange, opening_mm: float, speed_mm_s: float, force_n: float) -> None:
    """Check a move.

    Raises:
        RigError: the first value that is out of range, with its unit and the allowed range.
    """
    for name, value, (low, high), unit in (
        ("opening", opening_mm, allowed.opening_mm, "mm"),
        ("speed", speed_mm_s, allowed.speed_mm_s, "mm/s"),
        ("force", force_n, allowed.force_n, "N"),
    ):
        if not (math.isfinite(value) and low - _EPS <= value <= high + _EPS):
            span = f"{low:g} to {high:g} {unit}"
            raise RigError("gripper", f"{name} {value:g} {unit} is out of its range, {span}")


def check_state(allowed: GripperRange, state: GripperState) -> GripperState:
    """Return a reported state.

    Raises:
        RigError: its opening is not finite, or far out of the range.
    """
    low, high = allowed.opening_mm
    if not low - STATE_MM <= state.opening_mm <= high + STATE_MM:
        text = f"reports an opening of {state.opening_mm} mm; its range is {low:g} to {high:g} mm"
        raise RigError("gripper", f"{text}: check its connection")
    return state
