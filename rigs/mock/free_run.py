"""A frame camera that runs by itself: when it exposes, and what the sync box sees of that.

Where the box does not trigger the camera, exposures follow the camera's own clock. To the camera
this is one more source of ticks, like the box: tick k is the start of exposure k.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from sliplab.rigs.mock.clocks import FaultyClock, Jitter, undisturbed
from sliplab.rigs.mock.fault_settings import DeviceGone
from sliplab.rigs.mock.world import World
from sliplab.rigs.scene.randomness import generator
from sliplab.storage.clockmap import ClockMap

I64 = npt.NDArray[np.int64]
U8 = npt.NDArray[np.uint8]


class Trigger(Protocol):
    """What starts the exposures of a simulated frame camera.

    Attributes:
        run: counts the starts, so that the camera notices a new train.
    """

    run: int

    def ticks(self, first: int, until_ns: int) -> I64:
        """Numbers of the ticks from `first` on that came up to the true time `until_ns`."""

    def tick_at(self, true_ns: int) -> int:
        """Number of the first tick at or after a true time, 0 at the least."""

    def true_ns(self, ticks: I64) -> I64:
        """True times of ticks, ns."""

    def bits(self, ticks: I64) -> U8:
        """Level of the sync line that the camera sees at ticks."""


class FreeRun:
    """Cycles of a camera's clock from `start` on; the first one comes within a period."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._period_ns = 1e9 / world.settings.frame_camera.rate_hz
        self.run = 0
        self._begin()
        world.on_begin.append(self._begin)

    def _begin(self) -> None:
        self._clock: ClockMap | None = None
        self._origin_ns = self._starts = 0
        self._stopped_ns: int | None = None

    def start(self) -> None:
        """Begin; cycles that run are given up."""
        world = self._world
        self.run += 1
        self._clock, self._stopped_ns = world.clocks.frame_camera, None
        share = generator(world.seed, "first exposure", self._starts).uniform()
        self._origin_ns = self._shown(self._clock, world.now_ns) + round(share * self._period_ns)
        self._starts += 1

    def stop(self) -> None:
        """No exposure begins from now on."""
        if self._stopped_ns is None:
            self._stopped_ns = self._world.now_ns

    def ticks(self, first: int, until_ns: int) -> I64:
        """Numbers of the exposures from `first` on that began up to the true time `until_ns`."""
        if self._stopped_ns is not None:
            until_ns = min(until_ns, self._stopped_ns)
        return np.arange(first, max(self.tick_at(until_ns + 1), first), dtype=np.int64)

    def tick_at(self, true_ns: int) -> int:
        """Number of the first exposure that begins at or after a true time, 0 at the least."""
        if self._clock is None:
            return 0
        passed = self._shown(self._clock, true_ns) - self._origin_ns
        guess = max(int(passed / self._period_ns) - 1, 0)
        while int(self.true_ns(np.array([guess], np.int64))[0]) < true_ns:
            guess += 1
        return guess

    def true_ns(self, ticks: I64) -> I64:
        """True times at which exposures begin, ns."""
        if self._clock is None:
            return np.zeros(len(ticks), np.int64)
        shown = self._origin_ns + np.rint(ticks * self._period_ns).astype(np.int64)
        true_ns = undisturbed(self._clock).to_device(shown)
        return self._clock.cycle_ns(true_ns) if isinstance(self._clock, FaultyClock) else true_ns

    def bits(self, ticks: I64) -> U8:
        """No sync line reaches this camera."""
        return np.zeros(len(ticks), np.uint8)

    @staticmethod
    def _shown(clock: ClockMap, true_ns: int) -> int:
        """What the camera's cycles are counted by: its clock with its drifts, without its jumps."""
        if isinstance(clock, FaultyClock):
            true_ns = int(clock.pace_ns(np.array([true_ns], np.int64))[0])
        return undisturbed(clock).to_reference(true_ns)


class ExposureLine:
    """The camera's output that is high during exposures, with its edges as the box captures them.

    A frame that is lost on its way to the host was exposed all the same.
    """

    def __init__(self, world: World, camera: FreeRun) -> None:
        self._world, self._camera = world, camera
        self._begin()
        world.on_begin.append(self._begin)

    def _begin(self) -> None:
        self._run, self._read = self._camera.run, 0
        jitter_us = self._world.settings.clocks.exposure_jitter_us
        self._jitter = Jitter(self._world.seed, "exposure edges", jitter_us)

    def edges_ns(self, until_ns: int) -> I64:
        """True times, with jitter, of the starts of exposures since the last call, ns.

        Args:
            until_ns: exposures that begin after this true time are left for a later call.
        """
        camera = self._camera
        if camera.run != self._run:
            self._run, self._read = camera.run, 0
        ticks = camera.ticks(self._read, until_ns)
        self._read += len(ticks)
        true_ns = camera.true_ns(ticks)
        exposed = np.ones(len(ticks), np.bool_)
        for fault, begin_ns, end_ns in self._world.faults.spans(DeviceGone):
            if fault.device == "frame_camera":
                exposed &= (true_ns < begin_ns) | (true_ns >= end_ns)
        edges: I64 = (true_ns + self._jitter.ns(ticks))[exposed]
        return edges
