"""Auditing a detector: its alarms may not depend on how much it is given at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sliplab.analysis.detectors.detector import Detector, DetectorError, Evidence, Scene
from sliplab.analysis.detectors.feeding import feed

FINE_US = 5_000
"""Chunks in which test scenes are given, as a live stream would come."""
COARSE_US = 20_000, 100_000
"""Shortest and longest chunk where causality is checked; each length is drawn."""
TOLERANCE = 1e-3
"""Share of a level by which evidence may differ: matrix products of other sizes round otherwise."""


def drawn_edges(scene: Scene, seed: int) -> list[int]:
    """Return the edges of a test scene's longer chunks, which no detector can foresee."""
    most = scene.end_us // COARSE_US[0] + 1
    lengths = np.random.default_rng(seed).integers(*COARSE_US, most, endpoint=True)
    edges = np.cumsum(lengths)
    return [*edges[edges < scene.end_us].tolist(), scene.end_us]


def audit(
    detector: Detector,
    scene: Scene,
    edges_us: Sequence[int],
    expected: Evidence,
    levels: Sequence[float],
) -> Evidence:
    """Return a detector's evidence in longer chunks.

    Args:
        edges_us: of these chunks.
        expected: what it answered to fine ones.
        levels: above which evidence is an alarm.

    Raises:
        DetectorError: as `feed`; or an alarm at one of the levels depends on the size of chunks, so
            that it may rest on events that come later.
    """
    found = feed(detector, scene, edges_us)
    if not np.array_equal(expected.t_us, found.t_us):
        raise DetectorError(f"{scene.name}: {_SAID}")
    for level in levels:
        other = (expected.value > level) != (found.value > level)
        near = np.abs(np.array([expected.value[other], found.value[other]]) - level)
        if (near.max(axis=0, initial=0.0) > TOLERANCE * max(abs(level), TOLERANCE)).any():
            raise DetectorError(f"{scene.name}: {_SAID}")
    return found


_SAID = (
    f"evidence is other in chunks of {FINE_US // 1000} ms than in longer ones; it must depend on "
    "earlier events alone"
)
