"""The simulated thermometer: a sensor of one quantity without its own clock."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.clocks import Lateness, Noise
from sliplab.plugins.simulation.further_settings import Thermometer
from sliplab.plugins.simulation.scene.randomness import generator, key
from sliplab.plugins.simulation.world import SimulatedWorld
from sliplab.storage.clockmap import IDENTITY, ClockMap
from sliplab.storage.streams import ScalarChunk

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
_SEEDS = 2**63


class MockThermometer:
    """A thermometer on a body that cools; its readings are timed by their arrival at the host."""

    timed_by_host = True
    clock: ClockMap = IDENTITY

    def __init__(self, world: SimulatedWorld, settings: Thermometer, name: str, unit: str) -> None:
        self._world, self._settings, self._name, self.unit = world, settings, name, unit
        self._period_ns = round(1e9 / settings.rate_hz)
        self._begin()
        world.at_begin(self._begin)

    def _begin(self) -> None:
        seed = key(self._world.seed, f"stream {self._name}") % _SEEDS
        share = float(generator(seed, "first temperature").uniform())
        self._above = share * self._settings.above
        self._noise = Noise(seed, "readings", 1)
        self._late = Lateness(seed, "reading arrivals", self._settings.arrival_jitter_us)
        self._next, self._arrived_ns = 0, 0
        self._running, self._until_ns = False, 0

    def connect(self) -> None:
        """Do nothing: the simulated thermometer is always connected."""

    def start(self) -> None:
        """Start readings; earlier ones are dropped."""
        self._next = -(-self._world.now_ns // self._period_ns)
        self._running = True

    def read(self) -> ScalarChunk:
        """Return the readings since the last call that have reached the host."""
        now_ns = self._world.now_ns
        end_ns = now_ns if self._running else self._until_ns
        numbers = np.arange(self._next, end_ns // self._period_ns + 1, dtype=np.int64)
        true_ns = numbers * self._period_ns
        host_ns = true_ns + self._settings.latency_us * 1000 + self._late.ns(numbers)
        # in order: a late reading delays the next one
        host_ns = np.maximum(np.maximum.accumulate(host_ns), self._arrived_ns)
        here = int(np.searchsorted(host_ns, now_ns, side="right"))
        numbers, true_ns, host_ns = numbers[:here], true_ns[:here], host_ns[:here]
        if not here:
            return ScalarChunk.empty(self.unit)
        self._next += here
        self._arrived_ns = int(host_ns[-1])
        value = self.true_at(true_ns) + self._settings.noise * self._noise.of(numbers)[:, 0]
        if self._settings.resolution:
            value = np.round(value / self._settings.resolution) * self._settings.resolution
        return ScalarChunk(host_ns, host_ns, value, self.unit)

    def true_at(self, true_ns: I64) -> F64:
        """Return the body's temperature at true times of the trial, by Newton's law of cooling."""
        cooled: F64 = np.exp(-true_ns * 1e-9 / self._settings.time_constant_s)
        return self._settings.ambient + self._above * cooled

    def stop(self) -> None:
        """Stop readings; those taken before can still be read."""
        if self._running:
            self._running, self._until_ns = False, self._world.now_ns

    def close(self) -> None:
        """Close the device."""
        self.stop()
