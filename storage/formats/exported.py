"""Content of a trial that exports write on an event camera's clock."""

from __future__ import annotations

import numpy as np

from sliplab.storage.formats.foreign import RISING, Triggers
from sliplab.storage.streams import EVENTS_KIND, I64
from sliplab.storage.trials.recording import Recording


def has_events(recording: Recording, stream: str) -> bool:
    """Return whether a stream of a trial has events."""
    return stream != EVENTS_KIND or recording.record.counts.events > 0


def recorded_triggers(recording: Recording, stream: str) -> Triggers:
    """Return triggers as they were imported, or else the sync pulses as rising edges."""
    with recording.open(stream) as reader:
        if reader.has("triggers/t"):
            t_ns: I64 = reader.column("triggers/t")
            kinds = reader.column("triggers/kind").astype(np.uint8)
        else:
            t_ns = reader.pulses("event_pulses")
            kinds = np.full(len(t_ns), RISING, np.uint8)
    return Triggers(t_ns // 1000, kinds)


def event_size(recording: Recording, stream: str) -> tuple[int, int]:
    """Return columns and rows of an event camera, or the least that its events need."""
    about = recording.record.streams.get(stream)
    known = recording.record.geometry.event_px if about is None else about.size_px
    if known is not None:
        return known
    columns = rows = 0
    with recording.open(stream) as reader:
        for chunk in reader.event_chunks():
            columns, rows = max(columns, int(chunk.x.max())), max(rows, int(chunk.y.max()))
    return columns + 1, rows + 1
