"""Feeding scenes to a detector: chunk by chunk, and checked."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sliplab.analysis.metrics.classification import CLASSES
from sliplab.plugins.bench.interface import NO_LABEL, Detector, Evidence, Scene
from sliplab.storage.streams import EventChunk

CHUNK_US = 1_000_000
"""Events given at once: in larger chunks a scene passes faster."""
FINE_US = 10_000
"""The same where causality and time are checked, as a live stream would come."""
TOLERANCE = 1e-3
"""Evidence may differ by this share between chunk sizes: matrix products round otherwise."""


class BenchError(ValueError):
    """A detector broke the rules of the bench."""


@dataclass(frozen=True)
class Audit:
    """A scene that was fed in fine chunks.

    Attributes:
        decision_us: median time of a chunk that brought decisions, over their number.
        evidence: what was answered.
    """

    decision_us: float
    evidence: Evidence


def feed(detector: Detector, scene: Scene, chunk_us: int = CHUNK_US) -> Evidence:
    """Return a detector's evidence on a scene.

    Raises:
        BenchError: the evidence is invalid, or for a time that was not requested.
    """
    detector.begin(scene.width, scene.height)
    return Evidence.joined(
        [
            _checked(detector.push(events, until_us), scene.name, before_us, until_us)
            for events, before_us, until_us in _chunks(scene, chunk_us)
        ]
    )


def audit(detector: Detector, scene: Scene) -> Audit:
    """Feed a scene in fine chunks, and measure the time of decisions.

    Raises:
        BenchError: as `feed`, or the evidence depends on the size of chunks, so that it may rest on
            events that come later.
    """
    expected = feed(detector, scene)
    detector.begin(scene.width, scene.height)
    parts, seconds = [], []
    for events, before_us, until_us in _chunks(scene, FINE_US):
        start = time.perf_counter()
        answer = detector.push(events, until_us)
        taken = time.perf_counter() - start
        parts.append(_checked(answer, scene.name, before_us, until_us))
        if len(answer):
            seconds.append(taken / len(answer))
    found = Evidence.joined(parts)
    if not _same(expected, found):
        raise BenchError(
            f"{scene.name}: evidence is other in chunks of {FINE_US // 1000} ms than in chunks of "
            f"{CHUNK_US // 1000} ms; it must depend on earlier events alone"
        )
    return Audit(1e6 * float(np.median(seconds)) if seconds else 0.0, found)


def _chunks(scene: Scene, chunk_us: int) -> Iterator[tuple[EventChunk, int, int]]:
    """Yield a scene's events with the times from which and up to which they are complete."""
    edges = [*range(0, scene.end_us, chunk_us), scene.end_us]
    cuts = np.searchsorted(scene.events.t_us, edges)
    every = scene.events
    for k, (before_us, until_us) in enumerate(pairwise(edges)):
        yield every[cuts[k] : cuts[k + 1]], before_us, until_us


def _checked(found: Evidence, scene: str, before_us: int, until_us: int) -> Evidence:
    """Return evidence that keeps the rules."""
    if not isinstance(found, Evidence):
        raise BenchError(f"{scene}: push returned {type(found).__name__}; must be Evidence")
    n = len(found.t_us)
    if found.value.shape != (n,) or found.label.shape != (n,):
        raise BenchError(
            f"{scene}: evidence has {n} times, {found.value.shape} values and "
            f"{found.label.shape} labels; must be as many"
        )
    if not n:
        return found
    if (np.diff(found.t_us) <= 0).any():
        raise BenchError(f"{scene}: times of evidence must increase")
    first, last = int(found.t_us[0]), int(found.t_us[-1])
    if first <= before_us or last > until_us:
        wrong = first if first <= before_us else last
        raise BenchError(
            f"{scene}: evidence at {wrong} us; must be after {before_us} us and not after "
            f"{until_us} us, up to which it was given events"
        )
    if np.isnan(found.value).any() or (found.value == np.inf).any():
        raise BenchError(f"{scene}: a value of evidence is nan or inf; must be finite or -inf")
    if found.label.min() < NO_LABEL or found.label.max() >= len(CLASSES):
        wrong = int(found.label.min() if found.label.min() < NO_LABEL else found.label.max())
        raise BenchError(f"{scene}: label = {wrong}: must be -1 (none), 0, 1 or 2")
    return found


def _same(one: Evidence, other: Evidence) -> bool:
    """Return whether two answers to the same events agree."""
    if not np.array_equal(one.t_us, other.t_us):
        return False
    finite = np.isfinite(one.value)
    if not np.array_equal(finite, np.isfinite(other.value)):
        return False
    scale = np.abs(one.value[finite]).max(initial=0.0)
    return np.allclose(one.value[finite], other.value[finite], TOLERANCE, TOLERANCE * scale)
