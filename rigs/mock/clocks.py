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


class Jitter:
    """Random offsets of numbered instants, the same in whatever pieces they are asked for."""

    def __init__(self, seed: int, purpose: str, sigma_us: float) -> None:
        self._seed, self._purpose, self._sigma_us = seed, purpose, sigma_us
        self._blocks: dict[int, I64] = {}

    def ns(self, numbers: I64) -> I64:
        """Offsets of the instants `numbers` (not negative), cut at four sigma, shape (n,)."""
        if self._sigma_us == 0.0 or not len(numbers):
            return np.zeros(len(numbers), np.int64)
        block, inside = np.divmod(numbers, JITTER_BLOCK)
        result = np.empty(len(numbers), np.int64)
        for index in np.unique(block).tolist():
            if index not in self._blocks:
                draw = generator(self._seed, self._purpose, index).standard_normal(JITTER_BLOCK)
                scaled = np.clip(draw, -4.0, 4.0) * (self._sigma_us * 1000)
                self._blocks = {index: np.rint(scaled).astype(np.int64)}
            here = block == index
            result[here] = self._blocks[index][inside[here]]
        return result
