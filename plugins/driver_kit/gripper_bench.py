"""Bench of grippers, each on its fake, whose fingers the bench can stall."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from sliplab.plugins.driver_kit.bench import DeviceBench
from sliplab.plugins.driver_kit.rule import Bounds, NotTried
from sliplab.rigs.core.capabilities import Gripper, GripperState
from sliplab.rigs.core.driver import GripperDriver, GripperScene
from sliplab.rigs.core.finger_motion import FingerMotion

REACTION_NS = 8_000_000
ACCELERATION_MM_S2 = 1000.0


class GripperBench(DeviceBench):
    """A gripper that begins at the opening of its settings, in real time."""

    def __init__(self, driver: GripperDriver[Any], settings: Any, bounds: Bounds) -> None:
        super().__init__(bounds)
        if driver.fake is None or driver.reach is None:
            raise NotTried(
                f"{driver.name} declares no `fake` and `reach`, on which rules are tried"
            )
        self.driver, self.range = driver, driver.range(settings)
        self.opening_mm: float = settings.opening_mm
        self.fingers = FingerMotion(self.opening_mm, REACTION_NS, ACCELERATION_MM_S2)
        self.fake = driver.fake(settings, GripperScene(self.fingers, time.monotonic_ns))
        self.settings = driver.reach(settings, self.fake.address)
        self.device: Gripper = driver.build(self.settings)

    def open(self) -> None:
        """Make the gripper and connect it. Raises RigError."""
        self.device = self.driver.build(self.settings)
        self.device.connect()

    def connect(self) -> None:
        """Open within its time limit."""
        self.call("connect", self.open, self.bounds.connect_s)

    def close_device(self) -> None:
        """Close the gripper."""
        self.device.close()

    def close_fake(self) -> None:
        """Close the fake."""
        self.fake.close()

    def state(self) -> GripperState:
        """Return the driver's report."""
        return self.call("state", self.device.state)

    def true_mm(self, *t_ns: int) -> list[float]:
        """Return the true openings at increasing times of the host's clock, ns."""
        found: list[float] = self.fingers.opening_mm(np.array(t_ns, np.int64)).tolist()
        return found

    def moving(self) -> bool:
        """Return whether the fingers truly move, or are about to."""
        return self.fingers.moving(time.monotonic_ns())

    def move(
        self, opening_mm: float, speed_mm_s: float | None = None, force_n: float | None = None
    ) -> None:
        """Start a move, at the largest speed and with the least force if none is given."""
        speed = self.range.speed_mm_s[1] if speed_mm_s is None else speed_mm_s
        force = self.range.force_n[0] if force_n is None else force_n
        self.call("move", lambda: self.device.move(opening_mm, speed, force))

    def stall(self) -> None:
        """Let the fingers meet an object now."""
        self.fingers.stall(time.monotonic_ns())
