"""Values that a gripper's commands may have; cheap to import, for rig files."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class GripperRange:
    """Least and largest values that a gripper's commands may have.

    Attributes:
        step_mm: smallest step of the opening; 0 where every opening can be reached.
    """

    opening_mm: tuple[float, float]
    speed_mm_s: tuple[float, float]
    force_n: tuple[float, float]
    step_mm: float = 0.0
