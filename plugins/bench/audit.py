"""Auditing a detector: its evidence may not depend on the size of chunks; and its time."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from sliplab.analysis.detectors.detector import Detector, DetectorError, Evidence, Scene
from sliplab.analysis.detectors.feeding import CHUNK_US, checked_of, chunks, feed

FINE_US = 10_000
"""Events given at once where causality and time are checked, as a live stream would come."""
TOLERANCE = 1e-3
"""Evidence may differ by this share between chunk sizes: matrix products round otherwise."""


@dataclass(frozen=True)
class Audit:
    """A scene that was fed in fine chunks.

    Attributes:
        decision_us: median time of a chunk that brought decisions, over their number.
        evidence: what was answered.
    """

    decision_us: float
    evidence: Evidence


def audit(detector: Detector, scene: Scene) -> Audit:
    """Feed a scene in fine chunks, and measure the time of decisions.

    Raises:
        DetectorError: as `feed`, or the evidence depends on the size of chunks, so that it may rest
            on events that come later.
    """
    expected = feed(detector, scene)
    detector.begin(scene.width, scene.height)
    parts, seconds = [], []
    for events, before_us, until_us in chunks(scene, FINE_US):
        start = time.perf_counter()
        answer = detector.push(events, until_us)
        taken = time.perf_counter() - start
        parts.append(checked_of(scene, answer, before_us, until_us))
        if len(answer):
            seconds.append(taken / len(answer))
    found = Evidence.joined(parts)
    if not _same(expected, found):
        raise DetectorError(
            f"{scene.name}: evidence is other in chunks of {FINE_US // 1000} ms than in chunks of "
            f"{CHUNK_US // 1000} ms; it must depend on earlier events alone"
        )
    return Audit(1e6 * float(np.median(seconds)) if seconds else 0.0, found)


def _same(one: Evidence, other: Evidence) -> bool:
    """Return whether two answers to the same events agree."""
    if not np.array_equal(one.t_us, other.t_us):
        return False
    finite = np.isfinite(one.value)
    if not np.array_equal(finite, np.isfinite(other.value)):
        return False
    scale = np.abs(one.value[finite]).max(initial=0.0)
    return np.allclose(one.value[finite], other.value[finite], TOLERANCE, TOLERANCE * scale)
