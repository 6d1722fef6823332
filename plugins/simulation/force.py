"""The simulated force sensor: the contact's true forces on the plate, as a transducer shows them.

A reading is (1 + C) load + drift + noise - bias, with the load on the straight line between two
rows of the physics. Samples follow the sensor's own clock.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.clocks import FaultyClock, Lateness, Noise, faulty, undisturbed
from sliplab.plugins.simulation.history import GrowingTable
from sliplab.plugins.simulation.scene.randomness import generator, key
from sliplab.plugins.simulation.settings import MockForceSensorSettings
from sliplab.plugins.simulation.world import SimulatedWorld
from sliplab.protocols.timing import ForceGrade
from sliplab.rigs.core.capabilities import Mounting, RigError
from sliplab.storage.clockmap import ClockMap
from sliplab.storage.streams import WrenchChunk

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
DEVICE = "force sensor"
BEHIND_NS = 64_000_000
"""Length of the history of loads before the last sample that was read, ns."""
_HOUR_NS = 3_600_000_000_000
_SEEDS = 2**63


class MockForceSensor:
    """A force/torque sensor behind the plate, its axes those of the plate.

    Args:
        name: of a further sensor's stream, which no fault disturbs; the first one has none.

    Attributes:
        clock: true time to the sensor's, with its faults.
    """

    mounting = Mounting()
    grade: ForceGrade = "host time"
    timed_by_host = False

    def __init__(
        self, world: SimulatedWorld, settings: MockForceSensorSettings, name: str = ""
    ) -> None:
        self._world, self._settings, self._name = world, settings, name
        self.zeroing: Literal["trial", "session", "never"] = settings.bias
        seed = self._own(world.settings.seed if settings.seed is None else settings.seed)
        self._mix: F64 = np.eye(6) + _cross_talk(settings, seed)
        self._ppb = round(
            float(generator(seed, "force sensor drift").uniform(-1.0, 1.0))
            * settings.clock_ppm
            * 1000
        )
        self._period_ns = 1_000_000_000 // settings.rate_hz
        self._bias = np.zeros(6)
        self._begin()
        world.at_begin(self._begin)

    def _begin(self) -> None:
        world, settings = self._world, self._settings
        seed = self._own(world.seed)
        rng = generator(seed, "force sensor")
        longest = int(world.settings.clocks.offset_h * _HOUR_NS)
        clock = ClockMap.line(0, int(rng.integers(0, longest, endpoint=True)), self._ppb)
        self.clock: ClockMap = clock
        if not self._name:
            self.clock = faulty(clock, "force_sensor", world.faults)
        self._cycles = undisturbed(self.clock)
        most = np.repeat([settings.drift_n_per_min, settings.drift_nm_per_min], 3) / 60.0
        self._drift_per_s: F64 = rng.uniform(-1.0, 1.0, 6) * most
        self._noise = Noise(seed, "force noise", 6)
        self._late = Lateness(seed, "force reception", settings.arrival_jitter_us)
        self._first = -(-self._cycles.to_reference(world.now_ns) // self._period_ns)
        self._read, self._arrived_ns = self._first, 0
        self._loads: GrowingTable | None = None
        self._until_ns: int | None = None

    def connect(self) -> None:
        """Open the connection."""
        if self.zeroing == "session":
            self.zero()

    def start(self) -> None:
        """Start streaming; earlier samples are dropped."""
        self._loads, self._until_ns = self._world.keep_wrench(self._name), None
        now = self._cycles.to_reference(self._loads.end_ns)
        self._read = -(-now // self._period_ns)

    def read(self) -> WrenchChunk:
        """Forces and torques since the last call that have reached the host.

        Raises:
            RigError: a force is out of range.
        """
        loads, done_ns = self._loads, self._world.advance()
        if loads is None:
            return WrenchChunk.empty()
        now_ns = self._world.now_ns
        if self._until_ns is not None:
            done_ns = min(done_ns, self._until_ns)
        end = self._cycles.to_reference(done_ns) // self._period_ns + 1
        cycles = np.arange(self._read, max(end, self._read), dtype=np.int64)
        true_ns = self._cycles.to_device(cycles * self._period_ns)
        host_ns = true_ns + self._settings.latency_us * 1000
        host_ns += self._late.ns(cycles - self._first)
        # in order: a sample that is late holds up the next one
        host_ns = np.maximum(np.maximum.accumulate(host_ns), self._arrived_ns)
        here = int(np.searchsorted(host_ns, now_ns, side="right"))
        cycles, true_ns, host_ns = cycles[:here], true_ns[:here], host_ns[:here]
        if not here:
            return WrenchChunk.empty()
        self._read += here
        self._arrived_ns = int(host_ns[-1])
        load = self._mixed(loads.at(true_ns), true_ns)
        load += self._noise.of(cycles - self._first) * self._scatter()
        loads.forget(int(true_ns[-1]) - BEHIND_NS)
        worst = float(np.max(np.abs(load[:, :3])))
        if worst > self._settings.range_n:
            raise RigError(
                DEVICE,
                f"reads {worst:.1f} N, beyond its range of {self._settings.range_n:g} N "
                "(simulated); press less",
            )
        load -= self._bias
        stamps = cycles * self._period_ns
        if isinstance(self.clock, FaultyClock):
            stamps = self.clock.to_reference(true_ns)
        return WrenchChunk(stamps, host_ns, load[:, :3].copy(), load[:, 3:].copy())

    def zero(self) -> None:
        """Take one sample, with its noise, for zero from now on."""
        streaming = self._loads is not None and self._until_ns is None
        self._world.advance()
        loads = self._loads if streaming else self._world.keep_wrench(self._name)
        assert loads is not None
        at_ns = np.array([loads.end_ns], np.int64)
        # no instant of a sample: its noise is drawn apart
        noise = generator(self._own(self._world.seed), "force bias").standard_normal((1, 6))
        self._bias = (self._mixed(loads.at(at_ns), at_ns) + noise * self._scatter())[0]
        if not streaming:
            self._world.drop_wrench(self._name)

    def stop(self) -> None:
        """Stop streaming; samples up to the last whole step can still be read."""
        if self._loads is not None and self._until_ns is None:
            self._world.advance()
            self._world.drop_wrench(self._name)
            self._until_ns = self._world.now_ns

    def close(self) -> None:
        """Close the device."""
        self.stop()

    def _own(self, seed: int) -> int:
        """Return a seed of this sensor's own: a further one has other draws than the first."""
        return key(seed, f"stream {self._name}") % _SEEDS if self._name else seed

    def _mixed(self, load: F64, true_ns: I64) -> F64:
        """Return what the axes show of loads (k, 6) at true times, without noise."""
        shown: F64 = load @ self._mix.T + np.outer(true_ns * 1e-9, self._drift_per_s)
        return shown

    def _scatter(self) -> F64:
        return np.repeat([self._settings.noise_n, self._settings.noise_nm], 3)


def _cross_talk(settings: MockForceSensorSettings, seed: int) -> F64:
    """Return the matrix C: given, or drawn."""
    if settings.cross_talk is not None:
        return np.array(settings.cross_talk)
    share = settings.cross_talk_share
    drawn = generator(seed, "force cross-talk").uniform(-share, share, (6, 6))
    np.fill_diagonal(drawn, 0.0)
    lever = np.repeat([1.0, settings.lever_m], 3)
    scaled: F64 = drawn * lever[:, None] / lever[None, :]
    return scaled
