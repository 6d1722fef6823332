"""The simulated sync box, and the edges that other devices see of its line."""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt

from rigs.capabilities import RigError
from rigs.mock.clocks import Jitter
from rigs.mock.world import World
from rigs.pulse_code import PERIOD, code_bits
from storage.clockmap import ClockMap
from storage.streams import PulseChunk

I64 = npt.NDArray[np.int64]
U8 = npt.NDArray[np.uint8]

REPORT_NS = 100_000
"""From an edge to its report; longer than any jitter, so that no edge is reported early."""


class MockSyncBox:
    """Ticks at a fixed rate with a pseudo-random code on the line.

    Attributes:
        run: counts the starts, so that devices notice a new train.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        self._reset()
        self.run = 0
        world.on_begin.append(self._reset)

    def _reset(self) -> None:
        self.rate_hz = 0.0
        self.started_ns = 0
        self.stopped_ns: int | None = 0
        self.clock = ClockMap(0, 0, 0)
        self._read = 0
        self._bits: U8 = np.zeros(0, np.uint8)

    def start(self, rate_hz: float, seed: int) -> None:
        """Begin ticks and code; a train that runs is given up."""
        if not 0.0 < rate_hz <= 10_000.0:
            raise RigError("sync box", f"rate {rate_hz} Hz: must lie between 0 and 10,000")
        if not 1 <= seed <= PERIOD:
            raise RigError("sync box", f"seed {seed}: must lie between 1 and {PERIOD}")
        world = self._world
        self.run += 1
        self.rate_hz, self.started_ns, self.stopped_ns, self._read = rate_hz, world.now_ns, None, 0
        self.clock = ClockMap(self.started_ns, 0, world.clocks.sync_box_ppb)
        self._bits = code_bits(seed, PERIOD)
        if world.recording_ns is None:
            world.recording_ns = self.started_ns

    def read_pulses(self) -> PulseChunk:
        """Pulses sent since the last call, box clock, whole microseconds."""
        ticks = self.ticks(self._read, self._world.now_ns - REPORT_NS)
        self._read += len(ticks)
        sent = self.box_ns(ticks[self.bits(ticks) == 1])
        return PulseChunk(sent // 1000 * 1000)

    def stop(self) -> None:
        """Stop the ticks; pulses sent before can still be read."""
        if self.stopped_ns is None:
            self.stopped_ns = self._world.now_ns

    def close(self) -> None:
        """Give the device back."""
        self.stop()

    # -- what the other simulated devices see ----------------------------------------------

    def ticks(self, first: int, until_ns: int) -> I64:
        """Numbers of the ticks from `first` on that came up to the true time `until_ns`."""
        if self.rate_hz == 0.0:
            return np.empty(0, np.int64)
        if self.stopped_ns is not None:
            until_ns = min(until_ns, self.stopped_ns)
        end = max(self.tick_at(until_ns + 1), first)
        return np.arange(first, end, dtype=np.int64)

    def tick_at(self, true_ns: int) -> int:
        """Number of the first tick at or after a true time, 0 at the least."""
        if self.rate_hz == 0.0:
            return 0
        box = self.clock.to_reference(true_ns)
        guess = max(int(box * self.rate_hz / 1e9) - 1, 0)
        while int(self.true_ns(np.array([guess], np.int64))[0]) < true_ns:
            guess += 1
        return guess

    def box_ns(self, ticks: I64) -> I64:
        """Ticks on the box's clock, ns."""
        return np.rint(ticks * (1e9 / self.rate_hz)).astype(np.int64)

    def true_ns(self, ticks: I64) -> I64:
        """True times of ticks, ns."""
        return self.clock.to_device(self.box_ns(ticks))

    def bits(self, ticks: I64) -> U8:
        """The code at ticks."""
        return self._bits[ticks % PERIOD]


class SyncInput:
    """A device's input on the sync line: which edges it saw, in true time with its own jitter."""

    def __init__(
        self, world: World, box: MockSyncBox, device: Literal["event_camera", "arm"]
    ) -> None:
        self._world, self._box, self._device = world, box, device
        self._reset()
        world.on_begin.append(self._reset)

    def _reset(self) -> None:
        self._run, self._read = self._box.run, 0
        self._jitter = Jitter(
            self._world.seed, f"{self._device} pulses", self._world.settings.clocks.pulse_jitter_us
        )

    def skip(self) -> None:
        """Forget the edges up to now."""
        self._run, self._read = self._box.run, self._box.tick_at(self._world.now_ns)

    def edges_ns(self) -> I64:
        """True times of the edges since the last call, with jitter, ns."""
        box = self._box
        if box.run != self._run:
            self._run, self._read = box.run, 0
        ticks = box.ticks(self._read, self._world.now_ns - REPORT_NS)
        self._read += len(ticks)
        ticks = ticks[box.bits(ticks) == 1] if len(ticks) else ticks
        ticks = ticks[~np.isin(ticks, self._lost())]
        return box.true_ns(ticks) + self._jitter.ns(ticks) if len(ticks) else ticks

    def _lost(self) -> I64:
        lost: list[int] = []
        for fault in self._world.faults.of("pulses_lost"):
            due = self._world.faults.due_ns(fault, self._world.recording_ns)
            if fault.device == self._device and due is not None:
                first = self._box.tick_at(due)
                after = np.arange(first, first + 16 * fault.count + 16, dtype=np.int64)
                lost += after[self._box.bits(after) == 1][: fault.count].tolist()
        return np.array(lost, np.int64)
