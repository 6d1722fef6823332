"""Forces on the plate while the arm moves: the limit that stops it, and the end of a press.

A press to a force is stopped ahead of it. The normal force is taken on the straight line through
its last 10 ms, which filters noise, and that line is followed through all that passes until the arm
is at rest: the age of the newest sample, and the arm's reaction and braking.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from sliplab.protocols.program import Move, Position, Step, Twist, step_seconds
from sliplab.rigs.core.capabilities import ForceSensor, RigError
from sliplab.rigs.core.plate_frame import PlateFrame
from sliplab.storage.streams import WrenchChunk

POLL_S = 0.02
"""Interval at which forces are read, s: how late a limit, an overload or the end of a press may be
seen. A simulated rig without a limit reads them with its other streams."""
_LINE_NS = 10_000_000
_FEWEST = 5
"""Samples through which a straight line is laid: those of the last 10 ms, at least five."""
_I64 = npt.NDArray[np.int64]
_F64 = npt.NDArray[np.float64]


class ForceWatch:
    """A force sensor that is read for its limit; it streams from now on.

    Args:
        limit_n: largest force on the plate, in any direction; None for no limit.
        delay_s: shortest time from a load to the host that has its sample.
    """

    def __init__(
        self,
        sensor: ForceSensor,
        plate: PlateFrame,
        limit_n: float | None,
        delay_s: float = 0.0,
    ) -> None:
        self._sensor, self._limit_n, self._delay_s = sensor, limit_n, delay_s
        self._to_plate = np.array(plate.force_matrix(sensor.mounting))
        self._t_ns: _I64 = np.empty(0, np.int64)
        self._host_ns: _I64 = np.empty(0, np.int64)
        self._normal_n: _F64 = np.empty(0)
        sensor.start()

    @property
    def normal_n(self) -> float:
        """Normal force on the plate, mean of the last 10 ms that were read; 0 before."""
        return float(self._normal_n.mean()) if len(self._normal_n) else 0.0

    def read(self) -> WrenchChunk:
        """Return the forces since the last call.

        Raises:
            RigError: the limit is exceeded, or the sensor is at fault.
        """
        chunk = self._sensor.read()
        if not len(chunk):
            return chunk
        forces = chunk.force_n @ self._to_plate.T
        self._keep(chunk, forces[:, 2])
        most = float(np.linalg.norm(forces, axis=1).max())
        if self._limit_n is not None and most > self._limit_n:
            raise RigError(
                "force sensor",
                f"{most:.2f} N on the plate, above limits.force = {self._limit_n:g} N of "
                "the rig; the arm was stopped: press less, or see what it touches",
            )
        return chunk

    def seconds_to(self, force_n: float, now_ns: int) -> float:
        """Return the time until the normal force will be `force_n`, if it goes on as it does.

        The straight line of least squares through the last 10 ms is followed. A sample's age is
        known by the one that came fastest among them: what came later waited on its way.

        Args:
            now_ns: the host's clock.

        Returns:
            seconds, negative if it is passed; infinite while the force does not rise to it.
        """
        if len(self._t_ns) < 2:
            return np.inf
        age_s = (self._t_ns - (now_ns - int((self._host_ns - self._t_ns).min()))) * 1e-9
        age_s -= self._delay_s
        middle_s, mean_n = age_s.mean(), self._normal_n.mean()
        off_s = age_s - middle_s
        rate = float(off_s @ (self._normal_n - mean_n) / (off_s @ off_s))
        missing_n = force_n - (mean_n - rate * middle_s)
        if rate <= 0:
            return -np.inf if missing_n <= 0 else np.inf
        return float(missing_n / rate)

    def _keep(self, chunk: WrenchChunk, normal_n: _F64) -> None:
        """Keep what the line is laid through."""
        t_ns = np.concatenate([self._t_ns, chunk.t_ns])
        first = int(np.searchsorted(t_ns, t_ns[-1] - _LINE_NS, side="right"))
        kept = slice(max(min(first, len(t_ns) - _FEWEST), 0), None)
        self._t_ns = t_ns[kept]
        self._host_ns = np.concatenate([self._host_ns, chunk.host_ns])[kept]
        self._normal_n = np.concatenate([self._normal_n, normal_n])[kept]


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
