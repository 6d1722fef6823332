"""The URCap's text protocol on port 63352, and counts of the registers in physical units.

A client sends `SET POS 120 SPE 255 FOR 0 GTO 1` and gets `ack`; it sends `GET POS` and gets
`POS 120`. Lines end with a line feed, but for `ack`, which some versions send without one. Counts
are 0 to 255: POS 0 is open, SPE and FOR 0 the least that the gripper can do. Their scales are
taken as linear between the ends that the maker states, which for force is an approximation.

Source: Robotiq, instruction manual of 2F-85 and 2F-140, register mapping and specifications.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

from sliplab.plugins.reflex.robotiq_2f.settings import Model
from sliplab.rigs.core.gripper_range import GripperRange

COUNTS = 255
RANGES: Mapping[str, GripperRange] = {
    "2F-85": GripperRange((0.0, 85.0), (20.0, 150.0), (20.0, 235.0), 85.0 / COUNTS),
    "2F-140": GripperRange((0.0, 140.0), (30.0, 250.0), (10.0, 125.0), 140.0 / COUNTS),
}
ACTIVE = 3
"""STA of an activated gripper."""
MOVING, OPENING_ON, CLOSING_ON, ARRIVED = range(4)
"""OBJ: in motion; stopped by an object while opening, while closing; at the requested place."""
FAULTS: Mapping[int, str] = {
    5: "action is delayed: it must be activated again",
    7: "is not activated",
    8: "is too hot: let it cool",
    9: "has no communication",
    10: "has too little voltage",
    11: "releases automatically",
    12: "has an internal fault",
    13: "could not be activated: look for what blocks its fingers",
    14: "draws too much current",
    15: "has released automatically",
}
LARGEST: Mapping[str, int] = {"STA": 3, "OBJ": 3}
"""Largest value of a register that has not all of `COUNTS`."""
_EPS = 1e-6


def register(name: str, line: bytes) -> int:
    """Return a register's value from the answer to its question.

    Raises:
        ValueError: it answers another question, or has no such value.
    """
    found, _, value = line.decode("ascii", "replace").strip().partition(" ")
    most = LARGEST.get(name, COUNTS)
    if found != name or not re.fullmatch("[0-9]{1,3}", value) or int(value) > most:
        raise ValueError(f"answered {line.strip()!r} to GET {name}, not {name} 0 to {most}")
    return int(value)


def range_of(model: Model) -> GripperRange:
    """Return the range of a model's commands."""
    return RANGES[model]


def position_counts(opening_mm: float, allowed: GripperRange) -> int:
    """Counts of an opening, those of the wider one between two."""
    closed = 1.0 - opening_mm / allowed.opening_mm[1]
    return max(0, math.floor(COUNTS * closed + _EPS))


def opening_mm(counts: int, allowed: GripperRange) -> float:
    """Opening of a gripper at its counts."""
    return allowed.opening_mm[1] * (1.0 - counts / COUNTS)


def least_counts(value: float, span: tuple[float, float]) -> int:
    """Counts of a speed or a force, those of the lesser one between two."""
    low, high = span
    return min(COUNTS, max(0, math.floor(COUNTS * (value - low) / (high - low) + _EPS)))


def of_counts(counts: int, span: tuple[float, float]) -> float:
    """Speed or force of counts."""
    low, high = span
    return low + (high - low) * counts / COUNTS
