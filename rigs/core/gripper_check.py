"""Check of a gripper's move against its range, before anything is sent."""

from __future__ import annotations

import math

from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.gripper_range import GripperRange

_EPS = 1e-9


def check_move(allowed: GripperRange, opening_mm: float, speed_mm_s: float, force_n: float) -> None:
    """Check a move.

    Raises:
        RigError: the first value that is out of range, with its unit and what is allowed.
    """
    for name, value, (low, high), unit in (
        ("opening", opening_mm, allowed.opening_mm, "mm"),
        ("speed", speed_mm_s, allowed.speed_mm_s, "mm/s"),
        ("force", force_n, allowed.force_n, "N"),
    ):
        if not (math.isfinite(value) and low - _EPS <= value <= high + _EPS):
            span = f"{low:g} to {high:g} {unit}"
            raise RigError("gripper", f"{name} {value:g} {unit} is out of its range, {span}")
