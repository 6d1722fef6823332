"""The simulated gripper: its fingers belong to the world, which they press the sensor into."""

from __future__ import annotations

import numpy as np

from sliplab.plugins.simulation.settings import MockGripperSettings
from sliplab.plugins.simulation.world import SimulatedWorld
from sliplab.rigs.core.capabilities import GripperState, RigError
from sliplab.rigs.core.gripper_check import check_move
from sliplab.rigs.core.gripper_range import GripperRange


class MockGripper:
    """A gripper that reacts after a delay; its fingers stall at the force of their move."""

    def __init__(self, world: SimulatedWorld, settings: MockGripperSettings) -> None:
        assert world.fingers is not None
        self._world, self._fingers, self._connected = world, world.fingers, False
        self.range = GripperRange(settings.range_mm, settings.speed_mm_s, settings.force_n)

    def connect(self) -> None:
        """Open the connection."""
        self._connected = True

    def state(self) -> GripperState:
        """Return opening and motion."""
        self._world.advance()  # they may have stalled
        now_ns = self._world.now_ns
        opening = self._fingers.opening_mm(np.array([now_ns], np.int64))
        return GripperState(float(opening[0]), self._fingers.moving(now_ns), self._fingers.stalled)

    def move(self, opening_mm: float, speed_mm_s: float, force_n: float) -> None:
        """Start to move the fingers. Raises RigError where a value is out of range."""
        check_move(self.range, opening_mm, speed_mm_s, force_n)
        if not self._connected:
            raise RigError("gripper", "is not connected")
        self._world.advance()
        self._fingers.move(opening_mm, speed_mm_s, force_n, self._world.now_ns)

    def stop(self) -> None:
        """Stop the fingers where they are."""
        self._world.advance()
        now_ns = self._world.now_ns
        if self._fingers.moving(now_ns):
            self._fingers.stop(now_ns)

    def close(self) -> None:
        """Close the connection; the fingers stay."""
        self._connected = False
