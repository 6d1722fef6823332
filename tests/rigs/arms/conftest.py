"""A stand-in UR controller and the real driver on it, each test on an address of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from rigs.arms.settings import UrSettings
from rigs.arms.ur import UrArm
from rigs.wire.ur import UrStandIn
from tests.rigs.loopback import own_address

MakeRobot = Callable[..., UrStandIn]
MakeArm = Callable[..., UrArm]
LIMITS: dict[str, Any] = {"low_mm": (300, -100, 200), "high_mm": (500, 100, 400)}


def ur_settings(host: str, **more: Any) -> UrSettings:
    """A quarter of the controller's rate is enough here, and kind to a busy machine."""
    return UrSettings(**{"host": host, "limits": LIMITS, "frequency_hz": 125, **more})


@pytest.fixture
def robot_of() -> Iterator[MakeRobot]:
    """Makes stand-ins, which are closed after the test."""
    with ExitStack() as stack:

        def make(**how: Any) -> UrStandIn:
            return stack.enter_context(UrStandIn(own_address(), **{"cycle_hz": 125, **how}))

        yield make


@pytest.fixture
def arm_on() -> Iterator[MakeArm]:
    """Makes drivers of stand-ins, which are closed after the test."""
    with ExitStack() as stack:

        def make(robot: UrStandIn, connected: bool = True, **settings: Any) -> UrArm:
            arm = UrArm(ur_settings(robot.host, **settings))
            stack.callback(arm.close)
            if connected:
                arm.connect()
            return arm

        yield make
