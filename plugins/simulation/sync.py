"""Ticks of the simulated sync box and of a free-running camera, and inputs for their edges.

Where the box does not trigger the frame camera, exposures follow the camera's own clock. To the
camera both are sources of ticks: tick k is the start of exposure k.
"""

from __future__ import annotations

import weakref

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.clocks import FaultyClock, Jitter, faulty, undisturbed
from sliplab.plugins.simulation.fault_book import NEVER
from sliplab.plugins.simulation.identity import Identity
from sliplab.plugins.simulation.scene.randomness import generator
from sliplab.plugins.simulation.settings import MockFrameCameraSettings
from sliplab.plugins.simulation.world import SimulatedWorld
from sliplab.protocols.timing import Code
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.faults import (
    DeviceGone,
    PulsesDuplicated,
    PulsesLate,
    PulsesLost,
)
from sliplab.rigs.core.pulse_code import LONGEST_GAP_TICKS, SEEDS, CodeBits
from sliplab.storage.clockmap import ClockMap
from sliplab.storage.streams import ClockReads, PulseChunk

I64 = npt.NDArray[np.int64]
U8 = npt.NDArray[np.uint8]
REPORT_NS = 100_000
"""Delay from an edge to its report; longer than any jitter, so that no edge is reported early."""


class Ticks:
    """Numbered ticks at regular intervals of a clock, from a given time on.

    Attributes:
        run: number of trains, by which readers detect a new one.
        clock: true time to the clock of the ticks.
        stopped_ns: true time after which there are no ticks; None while they continue.
    """

    def __init__(self, world: SimulatedWorld) -> None:
        self._world = world
        self.run = 0
        self._clear()
        world.at_begin(self._clear)

    def _clear(self) -> None:
        """Discard the train, because a trial begins."""
        self.clock = ClockMap.line(0, 0)
        self._period_ns, self._origin_ns = 0.0, 0
        self.stopped_ns: int | None = 0

    def _tick_on(self, clock: ClockMap, period_ns: float, origin_ns: int = 0) -> None:
        """Start a train with tick 0 at `origin_ns` of the clock without its jumps."""
        self.run += 1
        self.clock, self._period_ns, self._origin_ns = clock, period_ns, origin_ns
        self.stopped_ns = None

    @property
    def ticking(self) -> bool:
        """True if a train has started in this trial."""
        return self._period_ns > 0.0

    def _last_ns(self, until_ns: int) -> int:
        """Return the true time of the last possible tick up to `until_ns`."""
        return until_ns if self.stopped_ns is None else min(until_ns, self.stopped_ns)

    def ticks(self, first: int, until_ns: int) -> I64:
        """Return the numbers of the ticks from `first` on up to a true time."""
        end = max(self.tick_at(self._last_ns(until_ns) + 1), first)
        return np.arange(first, end, dtype=np.int64)

    def tick_at(self, true_ns: int) -> int:
        """Return the number of the first tick at or after a true time, 0 at the least."""
        if not self.ticking:
            return 0
        passed = undisturbed(self.clock).to_reference(true_ns) - self._origin_ns
        guess = max(int(passed / self._period_ns) + 1, 0)
        while guess and self._true_of(guess - 1) >= true_ns:
            guess -= 1
        while self._true_of(guess) < true_ns:
            guess += 1
        return guess

    def _true_of(self, tick: int) -> int:
        """Return `true_ns` of one tick without arrays, for speed."""
        if isinstance(self.clock, FaultyClock):
            return int(self.true_ns(np.array([tick], np.int64))[0])
        return self.clock.to_device(self._origin_ns + round(tick * self._period_ns))

    def shown_ns(self, ticks: I64) -> I64:
        """Return the ticks on their own clock, without its jumps, ns."""
        return self._origin_ns + np.rint(ticks * self._period_ns).astype(np.int64)

    def true_ns(self, ticks: I64) -> I64:
        """Return the true times of ticks, ns."""
        true_ns = undisturbed(self.clock).to_device(self.shown_ns(ticks))
        return self.clock.cycle_ns(true_ns) if isinstance(self.clock, FaultyClock) else true_ns

    def bits(self, ticks: I64) -> U8:
        """Return the level of the sync line at ticks; low where none is wired."""
        return np.zeros(len(ticks), np.uint8)


class FreeRun(Ticks):
    """Exposures of a free-running camera; the first comes within one period.

    Args:
        own: the camera; the rig's first one by default.
    """

    def __init__(
        self, world: SimulatedWorld, own: Identity[MockFrameCameraSettings] | None = None
    ) -> None:
        self._own = own or Identity("frame_camera", world.settings.frame_camera)
        super().__init__(world)

    def _clear(self) -> None:
        super()._clear()
        self._starts = 0

    def start(self) -> None:
        """Start exposures; running cycles are discarded."""
        world = self._world
        period_ns = 1e9 / self._own.settings.rate_hz
        clock, now_ns = self._own.clock(world), world.now_ns
        if isinstance(clock, FaultyClock):  # cycles follow a clock's drifts, and not its jumps
            now_ns = int(clock.pace_ns(np.array([now_ns], np.int64))[0])
        seed = self._own.trial_seed(world)
        share = generator(seed, "first exposure", self._starts).uniform()
        origin_ns = undisturbed(clock).to_reference(now_ns) + round(share * period_ns)
        self._tick_on(clock, period_ns, origin_ns)
        self._starts += 1

    def stop(self) -> None:
        """Stop exposures; no new one begins."""
        if self.stopped_ns is None:
            self.stopped_ns = self._world.now_ns


class ExposureLine:
    """The camera's output that is high during exposures, as the box captures its edges.

    A frame that is lost in transfer was exposed all the same.
    """

    def __init__(self, world: SimulatedWorld, camera: FreeRun) -> None:
        self._world, self._camera = world, camera
        self._begin()
        world.at_begin(self._begin)

    def _begin(self) -> None:
        self._run, self._read = self._camera.run, 0
        jitter_us = self._world.settings.clocks.exposure_jitter_us
        self._jitter = Jitter(self._world.seed, "exposure edges", jitter_us)

    def edges_ns(self, until_ns: int) -> I64:
        """Return the true times, with jitter, of the starts of exposures since the last call, ns.

        Args:
            until_ns: exposures after this true time are left for a later call.
        """
        camera = self._camera
        if camera.run != self._run:
            self._run, self._read = camera.run, 0
        ticks = camera.ticks(self._read, until_ns)
        self._read += len(ticks)
        true_ns = camera.true_ns(ticks)
        exposed = np.ones(len(ticks), np.bool_)
        for _, begin_ns, end_ns in self._world.faults.spans(DeviceGone, target="frame_camera"):
            exposed &= (true_ns < begin_ns) | (true_ns >= end_ns)
        edges: I64 = (true_ns + self._jitter.ns(ticks))[exposed]
        return edges


class ClockReader:
    """Reads of one device's clock.

    The virtual clock does not advance during a read, so the answer's time is usually ahead of it by
    a fraction of a millisecond; the next request starts after the previous answer.
    """

    def __init__(self, world: SimulatedWorld, device: str) -> None:
        self._world, self._device = world, device
        self._begin()
        world.at_begin(self._begin)

    def _begin(self) -> None:
        self._random = generator(self._world.seed, f"{self._device} clock reads")
        self._answered_ns = 0

    def read(self, clock: ClockMap, unit_ns: int = 1) -> ClockReads:
        """Read the clock once.

        Args:
            clock: true time to the device's clock.
            unit_ns: resolution of the device's clock.
        """
        settings = self._world.settings.clocks
        late_us = settings.read_shortest_us + settings.read_spread_us * (
            self._random.standard_exponential(2)
        )
        late_ns = np.rint(np.minimum(late_us, settings.read_longest_us) * 1000)
        question_ns, answer_ns = late_ns.astype(np.int64).tolist()
        before_ns = max(self._world.now_ns, self._answered_ns)
        shown_ns = clock.to_reference(before_ns + question_ns) // unit_ns * unit_ns
        self._answered_ns = before_ns + question_ns + answer_ns
        row = (shown_ns, before_ns, self._answered_ns)
        return ClockReads(*(np.array([value], np.int64) for value in row))


class MockSyncBox(Ticks):
    """The simulated sync box: ticks with a code, and an input for the camera's exposures.

    Args:
        exposures: the frame camera's output; None where it is not wired.
    """

    def __init__(self, world: SimulatedWorld, exposures: ExposureLine | None = None) -> None:
        self._exposures = exposures
        self._clock_reader = ClockReader(world, "sync_box")
        super().__init__(world)

    def _clear(self) -> None:
        super()._clear()
        self.started_ns, self._dark_ns, self._read = 0, NEVER, 0
        self._code = CodeBits(1)
        self._reports = _PulseFaults(self._world, self, "sync_box")

    def connect(self) -> None:
        """Do nothing: the simulated box is always connected."""

    def start(
        self, rate_hz: float, seed: int, code: Code = "lfsr", at_ns: int | None = None
    ) -> None:
        """Start ticks and code, now or at a future true time; a running train is ended."""
        if not 0.0 < rate_hz <= 10_000.0:
            raise RigError("sync box", f"rate {rate_hz} Hz: must lie between 0 and 10,000")
        if not 1 <= seed <= SEEDS:
            raise RigError("sync box", f"seed {seed}: must lie between 1 and {SEEDS}")
        world = self._world
        self.started_ns, self._read = world.now_ns if at_ns is None else at_ns, 0
        clock = ClockMap.line(self.started_ns, 0, world.clocks.sync_box_ppb)
        self._tick_on(faulty(clock, "sync_box", world.faults), 1e9 / rate_hz)
        self._code = CodeBits(seed, code)
        self._reports = _PulseFaults(world, self, "sync_box")
        if world.faults.recording_ns is None:
            world.faults.recording_ns = self.started_ns
        # a box without power does not tick, and does not resume when power returns
        self._dark_ns = world.faults.lost_power_ns("sync_box", self.started_ns)

    def _last_ns(self, until_ns: int) -> int:
        return super()._last_ns(min(until_ns, self._dark_ns - 1))

    def bits(self, ticks: I64) -> U8:
        """Return the code at ticks."""
        return self._code.upto(int(ticks.max(initial=-1)) + 1)[ticks]

    def read_pulses(self) -> PulseChunk:
        """Return the pulses sent since the last call, box clock, integer microseconds."""
        now_ns = self._world.now_ns
        ticks = self.ticks(self._read, now_ns - REPORT_NS)
        self._read += len(ticks)
        ticks = ticks[self.bits(ticks) == 1]
        true_ns, sent = self._reports.of(
            ticks, self.true_ns(ticks), self.shown_ns(ticks), now_ns - 2 * REPORT_NS
        )
        if isinstance(self.clock, FaultyClock):
            sent = sent + self.clock.jumped_ns(true_ns)
        return PulseChunk(sent // 1000 * 1000)

    def read_exposures(self) -> PulseChunk:
        """Return the starts of exposures since the last call, box clock, integer microseconds."""
        if self._exposures is None or not self.ticking:
            return PulseChunk(np.empty(0, np.int64))
        edges = self._exposures.edges_ns(self._world.now_ns - REPORT_NS)
        edges = edges[(edges >= self.started_ns) & (edges < self._dark_ns)]
        return PulseChunk(self.clock.to_reference(edges) // 1000 * 1000)

    def read_clock(self) -> ClockReads:
        """Read the box's clock, integer microseconds: one row."""
        return self._clock_reader.read(self.clock, 1000)

    def stop(self, at_ns: int | None = None) -> None:
        """Stop the ticks, now or at a true time; pulses sent before can still be read."""
        if self.stopped_ns is None:
            self.stopped_ns = self._world.now_ns if at_ns is None else at_ns

    def close(self) -> None:
        """Close the device."""
        self.stop()


class SyncInput:
    """A device's input on the sync line: its edges in true time with the device's jitter."""

    def __init__(self, world: SimulatedWorld, box: MockSyncBox, device: str) -> None:
        self._world, self._box, self._device = world, box, device
        self._reset()
        world.at_begin(self._reset)

    def _reset(self) -> None:
        self._run, self._read = self._box.run, 0
        self._faults = _PulseFaults(self._world, self._box, self._device)
        self._jitter = Jitter(
            self._world.seed, f"{self._device} pulses", self._world.settings.clocks.pulse_jitter_us
        )

    def skip(self) -> None:
        """Discard the edges up to now."""
        self._run, self._read = self._box.run, self._box.tick_at(self._world.now_ns)
        self._faults = _PulseFaults(self._world, self._box, self._device)

    def edges_ns(self, until_ns: int | None = None) -> I64:
        """Return the true times of the edges since the last call, with jitter, ns.

        Args:
            until_ns: edges after this true time are left for a later call.
        """
        box, limit = self._box, self._world.now_ns
        if until_ns is not None:
            limit = min(limit, until_ns)
        if box.run != self._run:
            self._run, self._read = box.run, 0
            self._faults = _PulseFaults(self._world, box, self._device)
        ticks = box.ticks(self._read, limit - REPORT_NS)
        self._read += len(ticks)
        ticks = ticks[box.bits(ticks) == 1] if len(ticks) else ticks
        edges = box.true_ns(ticks) + self._jitter.ns(ticks) if len(ticks) else ticks
        return self._faults.of(ticks, edges, edges, limit - 2 * REPORT_NS)[1]


class _PulseFaults:
    """Faults of the pulses of one train in one device."""

    def __init__(self, world: SimulatedWorld, box: MockSyncBox, device: str) -> None:
        self._box = weakref.proxy(box)  # which has its own
        self._device, self._book = device, world.faults
        self._waiting = np.empty((2, 0), np.int64)
        self._reorders = bool(self._book.of(PulsesDuplicated, PulsesLate, target=device))
        self._whole = not self._reorders and not self._book.of(PulsesLost, target=device)

    def of(self, ticks: I64, true_ns: I64, stamps: I64, until_ns: int) -> tuple[I64, I64]:
        """Return true times and time stamps of the reported pulses on `ticks`.

        Pulses are reported in order of time. Where some come late or twice, those after the true
        time `until_ns` are held for the next call.
        """
        if self._whole:
            return true_ns, stamps
        retained = ~np.isin(ticks, self._hit(PulsesLost)[0])
        ticks, pulses = ticks[retained], np.stack([true_ns[retained], stamps[retained]])
        if not self._reorders:
            return pulses[0], pulses[1]
        hit, late_ns = self._hit(PulsesLate)
        for tick, delay in zip(hit.tolist(), late_ns.tolist(), strict=True):
            pulses[:, ticks == tick] += delay
        hit, after_ns = self._hit(PulsesDuplicated)
        doubles = [pulses[:, ticks == tick] + gap for tick, gap in zip(hit, after_ns, strict=True)]
        pulses = np.concatenate([self._waiting, pulses, *doubles], axis=1)
        pulses = pulses[:, np.lexsort((pulses[1], pulses[0]))]
        there = int(np.searchsorted(pulses[0], until_ns, side="right"))
        self._waiting = pulses[:, there:]
        return pulses[0, :there], pulses[1, :there]

    def _hit(
        self, kind: type[PulsesLost] | type[PulsesLate] | type[PulsesDuplicated]
    ) -> tuple[I64, I64]:
        """Return the ticks whose pulses have a kind of fault, and the shift, ns."""
        ticks: list[int] = []
        shift: list[int] = []
        spans = self._book.spans(kind, target=self._device) if self._box.ticking else ()
        for fault, due, _ in spans:
            first = self._box.tick_at(due)
            most = LONGEST_GAP_TICKS * (fault.count + 1)
            after = np.arange(first, first + most, dtype=np.int64)
            hit = after[self._box.bits(after) == 1][: fault.count].tolist()
            seconds = 0.0 if isinstance(fault, PulsesLost) else fault.seconds
            ticks += hit
            shift += [round(seconds * 1e9)] * len(hit)
        return np.array(ticks, np.int64), np.array(shift, np.int64)
