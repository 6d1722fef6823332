"""Writers of trials as files of AEDAT4 and DSEC; the store is only read."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sliplab.storage.formats.aedat4 import (
    EVENTS,
    FRAMES,
    SIMULATED,
    TRIGGERS,
    Aedat4Stream,
    Aedat4Writer,
)
from sliplab.storage.formats.dsec import write_dsec
from sliplab.storage.formats.foreign import RISING, Triggers
from sliplab.storage.streams import EVENTS_KIND, I64, EventChunk
from sliplab.storage.trials.recording import Recording

_PIECE = 1 << 20


def _source(recording: Recording) -> str:
    return f"sliplab {SIMULATED}" if recording.simulated else "sliplab"


def export_aedat4(recording: Recording, path: Path, stream: str) -> dict[str, int]:
    """Write everything on the event camera's clock, us; frames at the middle of their exposure."""
    if not (_has_events(recording, stream) or recording.has_video):
        raise ValueError("has neither events nor a video, and AEDAT4 holds those alone")
    triggers = _triggers(recording, stream)
    streams = {0: Aedat4Stream(EVENTS, "events", _size(recording, stream), _source(recording))}
    frame_us = np.empty(0, np.int64)
    if recording.has_video:
        frame_us = recording.frame_times() // 1000
        if _has_events(recording, stream):
            frame_us = recording.clock(stream).to_device(recording.frame_times()) // 1000
        first = recording.frame(0) if len(frame_us) else np.empty((1, 1))
        height, width = first.shape
        streams[1] = Aedat4Stream(FRAMES, "frames", (width, height), _source(recording))
    streams[2] = Aedat4Stream(TRIGGERS, "triggers", None, _source(recording))
    if len(frame_us) and int(frame_us.min()) < 0:
        raise ValueError("has frames before the event camera's clock started")
    with Aedat4Writer(path, streams) as file:
        count = 0
        for chunk in _pieces(recording, stream):
            file.events(0, chunk)
            count += len(chunk)
        file.triggers(2, triggers)
        if recording.has_video:
            for image, t_us in zip(recording.frames(), frame_us.tolist(), strict=True):
                file.picture(1, image, t_us)
    return {"events": count, "frames": len(frame_us), "triggers": len(triggers.t_us)}


def export_dsec(recording: Recording, path: Path, stream: str) -> dict[str, int]:
    """Write events and triggers; DSEC's event file holds no frames."""
    if not _has_events(recording, stream):
        raise ValueError("has no events, and DSEC's file holds those alone")
    triggers = _triggers(recording, stream)
    with recording.open(stream) as reader:
        events = reader.events()
    write_dsec(path, events, triggers, simulated=recording.simulated)
    return {"events": len(events), "frames": 0, "triggers": len(triggers.t_us)}


def _has_events(recording: Recording, stream: str) -> bool:
    return stream != EVENTS_KIND or recording.record.counts.events > 0


def _pieces(recording: Recording, stream: str) -> Iterator[EventChunk]:
    """Yield all events, about `_PIECE` at a time."""
    with recording.open(stream) as reader:
        cuts = np.unique(reader.event_times()[::_PIECE]).tolist()
        if not cuts:
            return
        for start, end in zip(cuts, [*cuts[1:], None], strict=True):
            yield reader.events(start, end)


def _triggers(recording: Recording, stream: str) -> Triggers:
    """Return triggers as they were imported, or else the sync pulses as rising edges."""
    with recording.open(stream) as reader:
        if reader.has("triggers/t"):
            t_ns: I64 = reader.column("triggers/t")
            kinds = reader.column("triggers/kind").astype(np.uint8)
        else:
            t_ns = reader.pulses("event_pulses")
            kinds = np.full(len(t_ns), RISING, np.uint8)
    return Triggers(t_ns // 1000, kinds)


def _size(recording: Recording, stream: str) -> tuple[int, int]:
    """Return columns and rows of an event camera, or the least that its events need."""
    about = recording.record.streams.get(stream)
    known = recording.record.geometry.event_px if about is None else about.size_px
    if known is not None:
        return known
    with recording.open(stream) as reader:
        events = reader.events()
    return (
        int(events.x.max(initial=0)) + 1,
        int(events.y.max(initial=0)) + 1,
    )
