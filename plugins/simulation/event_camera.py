"""The simulated event camera: its events, their times on its own clock, and losses."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.clocks import HighestStamp
from sliplab.plugins.simulation.fault_book import NEVER
from sliplab.plugins.simulation.history import GrowingTable
from sliplab.plugins.simulation.identity import Identity
from sliplab.plugins.simulation.nuisances import brushing
from sliplab.plugins.simulation.scene.events import MarkerSensor
from sliplab.plugins.simulation.scene.randomness import generator
from sliplab.plugins.simulation.scene.readout import ScanTimes
from sliplab.plugins.simulation.settings import MockEventCameraSettings
from sliplab.plugins.simulation.sync import REPORT_NS, MockSyncBox, SyncInput
from sliplab.plugins.simulation.world import SimulatedWorld
from sliplab.rigs.core.faults import EventBurst, EventNoise
from sliplab.storage.streams import EventChunk, PulseChunk

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
U16 = npt.NDArray[np.uint16]
U8 = npt.NDArray[np.uint8]
Events = tuple[I64, U16, U16, U8]
"""True times ns, columns, rows and polarities, (n,) each, in order of time."""

_BIN_NS, _LONG_BIN_NS = 1_000_000, 64_000_000


class Bursts:
    """Events of `event_burst` and `event_noise`: Poisson in time, uniform over their pixels."""

    def __init__(self, world: SimulatedWorld, width: int, height: int) -> None:
        self._world, self._width, self._height = world, width, height
        self._noisy: dict[tuple[int, int], I64] = {}

    def into(self, events: Events, begin_ns: int, end_ns: int, scans: ScanTimes) -> Events:
        """Merge the burst's events into `events` of the interval `begin_ns` (excluded) to `end_ns`.

        Args:
            scans: scans of the read-out; the burst's events also carry the times of its columns.
        """
        faults = self._world.faults
        if not faults.of(EventBurst) and not faults.of(EventNoise):
            return events
        burst = self.between(begin_ns, end_ns, scans)
        return _merge([events, burst]) if len(burst[0]) else events

    def between(self, begin_ns: int, end_ns: int, scans: ScanTimes) -> Events:
        """Return only the burst's events, independent of how the interval is divided."""
        # a scan is delivered when its last column has been read
        begin_ns, end_ns = begin_ns - scans.reading_ns, end_ns - scans.reading_ns
        faults, parts = self._world.faults, [_none()]
        sources: list[tuple[int, int, int, Callable[[int], Events]]] = []
        for index, (burst, first_ns, last_ns) in enumerate(faults.spans(EventBurst)):
            sources.append((first_ns, last_ns, _BIN_NS, partial(self._burst, burst, index)))
        for index, (noise, first_ns, last_ns) in enumerate(faults.spans(EventNoise)):
            sources.append((first_ns, last_ns, _LONG_BIN_NS, partial(self._noise, noise, index)))
        for first_ns, last_ns, bin_ns, events_of in sources:
            low, high = max(begin_ns - scans.period_ns, first_ns), min(end_ns, last_ns)
            for number in range(low // bin_ns, high // bin_ns + 1 if high >= low else 0):
                t_ns, x, y, p = events_of(number)
                retained = (t_ns >= first_ns) & (t_ns < last_ns)
                if scans.period_ns:
                    t_ns = scans.begin(t_ns)
                retained &= (t_ns > begin_ns) & (t_ns <= end_ns)
                t_ns, x, y, p = t_ns[retained], x[retained], y[retained], p[retained]
                parts.append((scans.stamp(t_ns, x), x, y, p))
        return _merge(parts)

    def _burst(self, fault: EventBurst, index: int, number: int) -> Events:
        rng = generator(self._world.seed, "event burst", index, number)
        count = int(rng.poisson(fault.million_per_s * 1e6 * _BIN_NS * 1e-9))
        t_ns = number * _BIN_NS + rng.integers(0, _BIN_NS, count)
        return (
            t_ns,
            rng.integers(0, self._width, count).astype(np.uint16),
            rng.integers(0, self._height, count).astype(np.uint16),
            rng.integers(0, 2, count).astype(np.uint8),
        )

    def _noise(self, fault: EventNoise, index: int, number: int) -> Events:
        rng = generator(self._world.seed, "event noise", index, number)
        size = self._width * self._height
        pixels = min(fault.pixels or size, size)
        count = int(rng.poisson(fault.hz * pixels * _LONG_BIN_NS * 1e-9))
        t_ns = number * _LONG_BIN_NS + rng.integers(0, _LONG_BIN_NS, count)
        place = rng.integers(0, pixels, count)
        if fault.pixels is not None:  # the camera's own, whatever the trial
            if (index, pixels) not in self._noisy:
                drawn = generator(self._world.settings.seed, "noisy pixels", index)
                self._noisy[index, pixels] = drawn.choice(size, pixels, replace=False)
            place = self._noisy[index, pixels][place]
        y, x = np.divmod(place, self._width)
        polarity = rng.random(count) < fault.positive
        return t_ns, x.astype(np.uint16), y.astype(np.uint16), polarity.astype(np.uint8)


def _merge(parts: list[Events]) -> Events:
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    # inside a scan pixels are read by column, then by row
    order = np.lexsort((columns[3], columns[2], columns[1], columns[0]))
    t_ns, x, y, p = (column[order] for column in columns)
    return t_ns, x, y, p


def _none() -> Events:
    empty = np.empty(0, np.uint16)
    return np.empty(0, np.int64), empty, empty, np.empty(0, np.uint8)


class MockEventCamera:
    """The event camera inside the sensor.

    It sends complete blocks of the scene's steps (32 ms by default), which is its latency. After
    `stop`, the remaining events can still be read.

    Args:
        own: of a further camera, to whose stream no fault happens; the rig's first one by default.

    Attributes:
        clock: true time to the camera's, in the running trial.
    """

    timed_by_host = False

    def __init__(
        self,
        world: SimulatedWorld,
        box: MockSyncBox,
        own: Identity[MockEventCameraSettings] | None = None,
    ) -> None:
        self._world = world
        self._own = own or Identity("event_camera", world.settings.event_camera)
        settings = self._own.settings
        self.width, self.height = settings.width, settings.height
        seed = self._own.fabrication_seed(world)
        self._sensor = MarkerSensor(settings, world.skin.layout_mm, seed)
        self._loads_of = "" if self._own.first else self._own.name
        self._bursts = Bursts(world, self.width, self.height) if self._own.first else None
        self._input = SyncInput(world, box, self._own.name)
        self._begin()
        world.at_begin(self._begin)

    def _begin(self) -> None:
        self._running = False
        self._until_ns = 0
        self._next_ns = 0
        self._loads: GrowingTable | None = None
        self._stamps = HighestStamp()
        self.clock = self._own.clock(self._world)

    def start(self) -> None:
        """Start streaming: every pixel takes the current image as its reference."""
        world = self._world
        loads = self._loads = world.keep_loads(self._loads_of)
        self._next_ns = loads.end_ns
        row_ns, rows = loads.between(self._next_ns, self._next_ns)
        self._sensor.reset(self._on_skin(row_ns, rows)[0], self._own.trial_seed(world))
        self._begun_ns, self._until_ns, self._running = world.now_ns, NEVER, True
        self._input.skip()

    def read(self) -> EventChunk:
        """Return events since the last call, camera clock, integer microseconds."""
        world = self._world
        done_ns = world.advance()
        loads = self._loads
        if loads is None:
            return EventChunk.empty()
        # complete and unsent data, in whole blocks of the global grid
        last_ns = done_ns
        if self._running:
            last_ns -= last_ns % self._sensor.optics.block_ns
        elif done_ns > self._until_ns:
            last_ns = int(loads.between(self._until_ns, self._until_ns)[0][0])
        sent_ns = self._sent_until_ns()
        if sent_ns < last_ns:
            last_ns = sent_ns - sent_ns % self._sensor.optics.block_ns
        if last_ns <= self._next_ns:
            return EventChunk.empty()
        row_ns, rows = loads.between(self._next_ns, last_ns)
        flicker = world.faults.flicker() if self._own.first else None
        t_ns, x, y, p = self._sensor.sense(self._on_skin(row_ns, rows), row_ns, flicker)
        if self._bursts is not None:
            t_ns, x, y, p = self._bursts.into(
                (t_ns, x, y, p), self._next_ns, last_ns, self._sensor.scans
            )
        self._next_ns = last_ns
        loads.forget(last_ns)
        gaps = [(t_ns[0], self._begun_ns)] if len(t_ns) and t_ns[0] < self._begun_ns else []
        for begin, end in [*gaps, *self._gaps_ns()]:
            retained = (t_ns < begin) | (t_ns >= end)
            t_ns, x, y, p = t_ns[retained], x[retained], y[retained], p[retained]
        stamps = self.clock.to_reference(t_ns) // 1000
        return EventChunk(x, y, p, self._stamps.of(stamps))

    def _on_skin(self, t_ns: I64, loads: F64) -> F64:
        """Loads in the sensor's own axes, which turn with it, from those in the plate's.

        What brushes over the skin adds to them.
        """
        world = self._world
        turn = world.turn_at(t_ns)
        if turn.any():
            cosine, sine = np.cos(turn)[:, None], np.sin(turn)[:, None]
            turned = loads.copy()
            turned[:, 0::3] = cosine * loads[:, 0::3] + sine * loads[:, 1::3]
            turned[:, 1::3] = cosine * loads[:, 1::3] - sine * loads[:, 0::3]
            loads = turned
        brushed = brushing(world.faults, world.skin.layout_mm, world.seed, t_ns)
        if brushed is not None:
            loads = loads.copy()
            loads[:, 0::3] += brushed[:, :, 0]
            loads[:, 1::3] += brushed[:, :, 1]
        return loads

    def read_pulses(self) -> PulseChunk:
        """Sync pulses since the last call, camera clock in ns."""
        t_ns = self._input.edges_ns(self._sent_until_ns())
        if not self._running and self._until_ns == 0:
            return PulseChunk(np.empty(0, np.int64))
        retained = (t_ns >= self._begun_ns - REPORT_NS) & (t_ns <= self._until_ns)
        for begin, end in self._gaps_ns():
            retained &= (t_ns < begin) | (t_ns >= end)
        stamp = self.clock.to_reference(t_ns[retained])
        return PulseChunk(stamp // 1000 * 1000)

    def stop(self) -> None:
        """Stop streaming; the rest, up to the last complete step, can still be read."""
        if self._running:
            self._world.advance()
            self._world.drop_loads(self._loads_of)
            self._running, self._until_ns = False, self._world.now_ns

    def _sent_until_ns(self) -> int:
        """Return the true time up to which the camera has sent its data."""
        now_ns = self._world.now_ns
        return self._world.faults.sent_until_ns(now_ns) if self._own.first else now_ns

    def _gaps_ns(self) -> list[tuple[int, int]]:
        """Return the true intervals of which the camera loses its data."""
        return self._world.faults.gaps_ns() if self._own.first else []

    def close(self) -> None:
        """Close the device."""
        self.stop()
