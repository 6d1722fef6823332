"""Feeding scenes to a detector: chunk by chunk, and checked."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from sliplab.analysis.detectors.detector import Detector, DetectorError, Evidence, Scene, checked
from sliplab.storage.streams import EventChunk

CHUNK_US = 1_000_000
"""Events given at once: in larger chunks a scene passes faster."""


def feed(detector: Detector, scene: Scene, edges_us: Sequence[int] | None = None) -> Evidence:
    """Return a detector's evidence on a scene.

    Args:
        edges_us: moments up to which events are given at once; default: each second.

    Raises:
        DetectorError: the evidence is invalid, or for a time that was not requested.
    """
    detector.begin(scene.width, scene.height)
    return Evidence.joined(
        [
            _pushed(detector, scene, events, before_us, until_us)
            for events, before_us, until_us in chunks(scene, edges_us or steady(scene, CHUNK_US))
        ]
    )


def steady(scene: Scene, chunk_us: int) -> list[int]:
    """Return the edges of chunks of one length; the last one may be shorter."""
    return [*range(chunk_us, scene.end_us, chunk_us), scene.end_us]


def chunks(scene: Scene, edges_us: Sequence[int]) -> Iterator[tuple[EventChunk, int, int]]:
    """Yield a scene's events with the times from which and up to which they are complete."""
    edges = [0, *edges_us]
    cuts = np.searchsorted(scene.events.t_us, edges)
    every = scene.events
    for k, (before_us, until_us) in enumerate(pairwise(edges)):
        yield every[cuts[k] : cuts[k + 1]], before_us, until_us


def _pushed(
    detector: Detector, scene: Scene, events: EventChunk, before_us: int, until_us: int
) -> Evidence:
    """Return evidence that keeps the rules. Raises DetectorError, which names the scene."""
    try:
        return checked(detector.push(events, until_us), before_us, until_us)
    except DetectorError as error:
        raise DetectorError(f"{scene.name}: {error}") from None
