"""The devices' clocks: each counts from another day and at a slightly different speed.

True time is the virtual time of the simulation, in integer nanoseconds since the trial began. It
is known to the simulated devices and to nobody else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rigs.mock.settings import Clocks
from rigs.scene.randomness import generator
from storage.clockmap import ClockMap

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
HOUR_NS = 3_600_000_000_000
JITTER_BLOCK = 4096


@dataclass(frozen=True)
class TrialClocks:
    """True time to device time for one trial, ns."""

    arm: ClockMap
    event_camera: ClockMap
    frame_camera: ClockMap
    sync_box_ppb: int
    """The sync box counts from its own start: it has a drift and no offset."""


def trial_clocks(settings: Clocks, rig_seed: int, trial_seed: int) -> TrialClocks:
    """Drifts that belong to the rig's seed, offsets that belong to the trial's."""
    drift = generator(rig_seed, "clock drift").uniform(-1.0, 1.0, 4)
    longest = int(settings.offset_h * HOUR_NS)
    offset = generator(trial_seed, "clock offset").integers(0, longest, 3, endpoint=True)
    largest = (settings.arm_ppm, settings.event_camera_ppm, settings.frame_camera_ppm)
    arm, events, frames = (
        ClockMap(0, int(start), round(share * ppm * 1000))
        for start, share, ppm in zip(offset, drift, largest, strict=False)
    )
    return TrialClocks(arm, events, frames, round(drift[3] * settings.sync_box_ppm * 1000))


class Noise:
    """Normal numbers that belong to numbered instants, in whatever pieces they are asked for."""

    def __init__(self, seed: int, purpose: str, width: int) -> None:
        self._seed, self._purpose, self._width = seed, purpose, width
        self._blocks: dict[int, F64] = {}

    def of(self, numbers: I64) -> F64:
        """Standard normal, cut at four, for the instants `numbers` (not negative), (n, width)."""
        result = np.empty((len(numbers), self._width))
        if not len(numbers):
            return result
        block, inside = np.divmod(numbers, JITTER_BLOCK)
        for index in range(int(block.min()), int(block.max()) + 1):
            if index not in self._blocks:
                if len(self._blocks) > 1:
                    self._blocks.pop(min(self._blocks))
                rng = generator(self._seed, self._purpose, index)
                draw = rng.standard_normal((JITTER_BLOCK, self._width))
                self._blocks[index] = np.clip(draw, -4.0, 4.0)
            here = block == index
            result[here] = self._blocks[index][inside[here]]
        return result


class Jitter:
    """Random offsets of numbered instants."""

    def __init__(self, seed: int, purpose: str, sigma_us: float) -> None:
        self._noise, self._sigma_ns = Noise(seed, purpose, 1), sigma_us * 1000

    def ns(self, numbers: I64) -> I64:
        """Offsets of the instants `numbers` (not negative), cut at four sigma, shape (n,)."""
        if self._sigma_ns == 0.0:
            return np.zeros(len(numbers), np.int64)
        return np.rint(self._noise.of(numbers)[:, 0] * self._sigma_ns).astype(np.int64)
