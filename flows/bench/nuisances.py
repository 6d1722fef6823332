"""Nuisances of test scenes: what is no slip and may look like it, by the simulated rig's faults.

Nuisances act in the whole scene, in its hold as in its slide. Sizes are drawn by the scene's seed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from sliplab.rigs.mock.fault_settings import AnyFault, EventBurst, EventGap, MainsLight
from sliplab.rigs.mock.settings import MockSettings

SLIDE_S = 4.0
"""Nuisances go on for so long after the hold."""
EVERY_S = 2.0
Nuisance = Callable[[float, MockSettings, np.random.Generator], tuple[AnyFault, ...]]
"""Faults of a scene, of the length of its hold in seconds and the rig that they disturb."""


def bursts(hold_s: float, rig: MockSettings, rng: np.random.Generator) -> tuple[AnyFault, ...]:
    """Return flickers of 50 ms on the whole sensor, of 0.03 to 3 million events a second."""
    return tuple(
        EventBurst(
            kind="event_burst",
            at_s=at_s,
            seconds=0.05,
            million_per_s=float(10 ** rng.uniform(-1.5, 0.5)),
        )
        for at_s in _moments(hold_s, rng)
    )


def mains_light(hold_s: float, rig: MockSettings, rng: np.random.Generator) -> tuple[AnyFault, ...]:
    """Return a lamp of 100 Hz that pixels see whose threshold is some deviations below the mean."""
    camera = rig.event_camera
    seen = camera.threshold - rng.uniform(2.8, 2.95) * camera.threshold_sigma
    # logarithm of the brightest over the darkest intensity, (1 + share) / (1 - share)
    return (MainsLight(kind="mains_light", share=math.tanh(seen / 2.0)),)


def event_gaps(hold_s: float, rig: MockSettings, rng: np.random.Generator) -> tuple[AnyFault, ...]:
    """Return losses of all events for 20 to 200 ms."""
    return tuple(
        EventGap(kind="event_gap", at_s=at_s, seconds=float(rng.uniform(0.02, 0.2)))
        for at_s in _moments(hold_s, rng)
    )


def _moments(hold_s: float, rng: np.random.Generator) -> list[float]:
    """Return a moment in each so many seconds."""
    starts = np.arange(0.0, hold_s + SLIDE_S, EVERY_S)
    return [float(at_s) for at_s in starts + rng.uniform(0.0, EVERY_S, len(starts))]


NUISANCES: Mapping[str, Nuisance] = {
    "bursts": bursts,
    "mains light": mains_light,
    "event gaps": event_gaps,
}
