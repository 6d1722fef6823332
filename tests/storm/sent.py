"""What the devices sent in a trial, to be held against what its files have."""

from __future__ import annotations

import zlib
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.storage.streams import Chunk, FrameChunk, PoseChunk, Sink
from sliplab.storage.trials.checksums import DATA
from sliplab.storage.trials.hdf5_reader import StreamReader
from sliplab.storage.trials.hdf5_writer import GROUPS, STREAM_GROUP

Column = list[int]
"""Rows, and a checksum of their bytes."""
_OWN = {(device, kind.name): group for group, (device, kind) in GROUPS.items()}
_NAMED = {"wrench", "scalar"}
"""Kinds of named streams that are compared, too."""
BURST_US = 10_000


class Tee:
    """Passes chunks on to a sink, and keeps count of them.

    Attributes:
        columns: rows and checksum of each column. rows: of each kind of stream.
        poses: places of the arm. frames_lost: numbers that the frame camera left out.
    """

    def __init__(self, sink: Sink) -> None:
        self.inner = sink
        self.columns: dict[str, Column] = defaultdict(lambda: [0, 0])
        self.rows: Counter[str] = Counter()
        self.poses: list[npt.NDArray[np.float64]] = [np.empty((0, 3))]
        self.frames_lost = 0

    def add(self, device: str, chunk: Chunk) -> None:
        """Append a chunk."""
        kind = chunk.KIND
        self.rows[kind.name] += len(chunk)
        if isinstance(chunk, FrameChunk) and device == "frames" and len(chunk):
            frames = self.columns["frames/t"][0] + len(chunk)
            self.frames_lost = int(chunk.number[-1]) + 1 - frames
        group = _OWN.get((device, kind.name), f"{STREAM_GROUP}/{device}")
        if isinstance(chunk, PoseChunk):
            self.poses.append(chunk.xyz_mm)
        if (device, kind.name) in _OWN or kind.name in _NAMED:
            for part, column in kind.columns.items():
                _add(self.columns[f"{group}/{part}"], getattr(chunk, column.field))
        self.inner.add(device, chunk)


def _add(column: Column, values: npt.NDArray[Any]) -> None:
    column[0] += len(values)
    whole = values.astype(np.int64 if values.dtype.kind in "iu" else np.float64)
    column[1] = zlib.crc32(np.ascontiguousarray(whole), column[1])


def most_events(folder: Path) -> int:
    """Return the most events in any 10 ms of a trial that begin with an event."""
    with StreamReader(folder / DATA) as reader:
        t_us = reader.event_times()
    ends = np.searchsorted(t_us, t_us + BURST_US)
    return int((ends - np.arange(len(t_us))).max(initial=0))


def differences(folder: Path, sent: dict[str, Column]) -> list[str]:
    """Return the columns of a trial that are not what its devices sent."""
    found = []
    with StreamReader(folder / DATA) as reader:
        for name, known in sent.items():
            column: Column = [0, 0]
            if name == "events/t":
                _add(column, reader.event_times())
            elif reader.has(name):
                _add(column, reader.column(name))
            if column != known:
                found.append(f"{name}: {column[0]} rows are stored, {known[0]} were sent")
    return found
