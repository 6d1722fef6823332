"""What tests of arms have in common: a slide on a fake, and faults within a bound."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest

from sliplab.rigs.core.capabilities import ArmFault, Pose, Segment
from sliplab.rigs.core.fakes import HOME
from tests.rigs.waiting import until

BUSY_S = 3.0
"""Allowance for a busy machine in addition to a timeout, s."""
LIMITS: dict[str, Any] = {"low_mm": (300, -100, 200), "high_mm": (500, 100, 400)}


def at(y_mm: float, z_mm: float = 300.0) -> Pose:
    """A place beside the first one."""
    return Pose((400.0, y_mm, z_mm), HOME.rotvec_deg)


SLIDE = [Segment(at(15.0), 1.6)]


def sliding(arm: Any, robot: Any) -> tuple[Any, Any]:
    """Start a slide, and wait until the arm moves."""
    arm.start(SLIDE)
    until(lambda: robot.pose().xyz_mm[1] > 0.5, 5.0)
    return arm, robot


def fails(action: Callable[[], object], within_s: float, match: str) -> float:
    """An ArmFault in time; how long it took, s."""
    began = time.monotonic()
    with pytest.raises(ArmFault, match=match):
        action()
    took = time.monotonic() - began
    assert took < within_s + BUSY_S
    return took
