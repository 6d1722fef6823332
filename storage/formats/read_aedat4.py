"""AEDAT4 files as trials."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sliplab.storage.formats.aedat4 import EVENTS, FRAMES, TRIGGERS, Aedat4File
from sliplab.storage.formats.foreign import ForeignTrial, FormatError
from sliplab.storage.streams import EventChunk, FrameChunk

SIMULATED = "simulated"
"""Stands in the source's name of a file that was written from simulated data."""


def read_aedat4(path: Path, name: str) -> ForeignTrial:
    """A file as a trial called `name`: its first streams of events, triggers and frames.

    Raises:
        FormatError: it is damaged.
    """
    with Aedat4File(path) as file:
        events, triggers, frames = (file.first(kind) for kind in (EVENTS, TRIGGERS, FRAMES))
        if events is None:
            raise FormatError("holds no stream of events")
        streams = file.streams
        found = None if triggers is None else file.triggers(triggers)
        frame_px = None
        if frames is not None:
            first = next(file.pictures(frames), None)
            frame_px = None if first is None else (first.image.shape[1], first.image.shape[0])
    left_out = [s.name for n, s in streams.items() if n not in {events, triggers, frames}]

    def all_events() -> Iterator[EventChunk]:
        with Aedat4File(path) as again:
            yield from again.events(events)

    def all_frames() -> Iterator[FrameChunk]:
        with Aedat4File(path) as again:
            for number, picture in enumerate(again.pictures(frames or 0)):
                t_ns = np.full(1, picture.t_ns, np.int64)
                yield FrameChunk(
                    picture.image[None], np.full(1, number), t_ns, t_ns, np.zeros(1, np.uint8)
                )

    return ForeignTrial(
        name,
        path.name,
        all_events,
        "as the file has it: Unix time, us, where a camera wrote it",
        lambda: streams[events].size,
        found,
        None if frame_px is None else all_frames,
        frame_px,
        simulated=SIMULATED in streams[events].source,
        about={"camera": streams[events].source, "left_out": left_out},
        unknown=("sync grade", "poses", "motion", "condition"),
    )
