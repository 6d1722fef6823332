"""The load on the tool that an arm's controller measures, from the contact in a simulated scene.

The plate's load is that of the simulated force sensor, with its noise, drift and cross-talk; the
tool feels its reaction. An arm's fake asks for the load at times of its controller's clock, in its
own thread; the scene follows some milliseconds later.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.force import MockForceSensor
from sliplab.plugins.simulation.path import SENSOR
from sliplab.plugins.simulation.world import SimulatedWorld
from sliplab.storage.clockmap import ClockMap

F64 = npt.NDArray[np.float64]
KEPT_S = 2.0
"""Length of the history of loads before the newest one, s."""


class ToolLoad:
    """The load on the tool, as far as the scene has come.

    Args:
        sensor: the simulated sensor, which is read here and nowhere else.
        controller: total true time to the arm controller's clock, ns.
        range_n: force along any axis that the controller takes for a collision.
    """

    def __init__(
        self, world: SimulatedWorld, sensor: MockForceSensor, controller: ClockMap, range_n: float
    ) -> None:
        self._world, self._sensor, self._controller = world, sensor, controller
        self._range_n, self._beyond = range_n, False
        self._known: tuple[F64, F64] = np.empty(0), np.empty((0, 6))
        """Controller times, s, and loads; replaced as a whole, for the fake's thread."""

    def follow(self) -> bool:
        """Take what the sensor has measured since the last call.

        Returns:
            whether the load has gone beyond the range now; once each time that it does.
        """
        found = self._sensor.read()
        if not len(found):
            return False
        true_ns = self._sensor.clock.to_device(found.t_ns)
        times = self._controller.to_reference(true_ns + self._world.past_ns) * 1e-9
        sensor = self._world.path.states(true_ns, SENSOR)
        force, torque = found.force_n, found.torque_nm
        about_tip = torque - np.cross(sensor[:, :3] * 1e-3, force)
        axes = self._world.plane.rotation
        load = -np.hstack([force @ axes.T, about_tip @ axes.T])
        retained = self._known[0] > times[-1] - KEPT_S
        self._known = (
            np.concatenate([self._known[0][retained], times]),
            np.concatenate([self._known[1][retained], load]),
        )
        before, self._beyond = self._beyond, bool(np.abs(force).max() > self._range_n)
        return self._beyond and not before

    def at(self, t_s: float) -> list[float] | None:
        """Return force (N) and torque about the tip (N m) on the tool, axes of the arm's base.

        Args:
            t_s: time of the controller's clock.

        Returns:
            None if the scene has not reached that time.
        """
        times, loads = self._known
        if not len(times) or t_s > times[-1]:
            return None
        after = max(int(np.searchsorted(times, t_s)), 1) if len(times) > 1 else 0
        if after == 0 or t_s <= times[0]:
            first: list[float] = loads[0].tolist()
            return first
        share = (t_s - times[after - 1]) / (times[after] - times[after - 1])
        found: list[float] = (loads[after - 1] + share * (loads[after] - loads[after - 1])).tolist()
        return found
