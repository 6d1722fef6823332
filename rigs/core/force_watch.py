"""Forces on the plate while the arm moves: the limit that stops it, and the end of a press."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from sliplab.protocols.program import Move, Position, Step, Twist, step_seconds
from sliplab.rigs.core.capabilities import ForceSensor, RigError
from sliplab.rigs.core.plate_frame import PlateFrame
from sliplab.storage.streams import WrenchChunk

POLL_S = 0.02
"""Interval at which forces are read, s: how late a limit, or the end of a press, may be seen."""
_RECENT_NS = 10_000_000


class ForceWatch:
    """A force sensor that is read for its limit; it streams from now on.

    Args:
        limit_n: largest force on the plate, in any direction; None for no limit.

    Attributes:
        normal_n: normal force on the plate, mean of the last 10 ms that were read.
    """

    def __init__(self, sensor: ForceSensor, plate: PlateFrame, limit_n: float | None) -> None:
        self._sensor, self._limit_n = sensor, limit_n
        self._to_plate = np.array(plate.force_matrix(sensor.mounting))
        self.normal_n = 0.0
        sensor.start()

    def read(self) -> WrenchChunk:
        """Return the forces since the last call.

        Raises:
            RigError: the limit is exceeded, or the sensor is at fault.
        """
        chunk = self._sensor.read()
        if not len(chunk):
            return chunk
        forces = chunk.force_n @ self._to_plate.T
        recent = chunk.t_ns > chunk.t_ns[-1] - _RECENT_NS
        self.normal_n = float(forces[recent, 2].mean())
        most = float(np.linalg.norm(forces, axis=1).max())
        if self._limit_n is not None and most > self._limit_n:
            raise RigError(
                "force sensor",
                f"{most:.2f} N on the plate, above limits.force = {self._limit_n:g} N of "
                "the rig; the arm was stopped: press less, or see what it touches",
            )
        return chunk


@dataclass
class Course:
    """The places of a program, where a press ends at its force and not at the planned depth.

    Attributes:
        at: place at which the last step ends.
        pressed_mm: depth at which a press to a force ended; None before one.
    """

    at: Position
    pressed_mm: float | None = None
    _shallower_mm: float = field(default=0.0, init=False)

    def step(self, planned: Step) -> Step:
        """Return a step that is less deep, where it is in contact, by as much as the press was."""
        if not self._shallower_mm or not isinstance(planned, Move | Twist):
            return planned
        if planned.to.depth_mm <= 0:
            return planned
        to = replace(planned.to, depth_mm=planned.to.depth_mm - self._shallower_mm)
        return replace(planned, to=to)

    def taken(self, step: Step, position: Callable[[], Position]) -> None:
        """Follow a step that was taken; `position` is asked where a press has ended."""
        self.at = step_seconds(step, self.at)[1]
        if isinstance(step, Move) and step.until_force_n is not None:
            self.pressed_mm = position().depth_mm
            self._shallower_mm = step.to.depth_mm - self.pressed_mm
            self.at = replace(self.at, depth_mm=self.pressed_mm)
