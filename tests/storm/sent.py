"""What the devices sent in a trial, to be held against what its files have."""

from __future__ import annotations

import zlib
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.storage.streams import Chunk, Sink
from sliplab.storage.trials.checksums import DATA
from sliplab.storage.trials.hdf5_reader import StreamReader
from sliplab.storage.trials.hdf5_writer import GROUPS, STREAM_GROUP

Column = list[int]
"""Rows, and a checksum of their bytes."""
_OWN = {(device, kind.name): group for group, (device, kind) in GROUPS.items()}
_MORE = {"poses": ("xyz",), "wrench": ("force",), "scalar": ("value",)}
"""Parts of each kind that are compared besides its times."""


class Tee:
    """Passes chunks on to a sink, and keeps count of them."""

    def __init__(self, sink: Sink) -> None:
        self.inner = sink
        self.columns: dict[str, Column] = defaultdict(lambda: [0, 0])

    def add(self, device: str, chunk: Chunk) -> None:
        """Append a chunk."""
        kind = chunk.KIND
        group = _OWN.get((device, kind.name), f"{STREAM_GROUP}/{device}")
        known = (device, kind.name) in _OWN or kind.name in _MORE
        for part in ("t", *_MORE.get(kind.name, ())) if known else ():
            _add(self.columns[f"{group}/{part}"], getattr(chunk, kind.columns[part].field))
        self.inner.add(device, chunk)


def _add(column: Column, values: npt.NDArray[Any]) -> None:
    column[0] += len(values)
    whole = values.astype(np.int64 if values.dtype.kind in "iu" else np.float64)
    column[1] = zlib.crc32(np.ascontiguousarray(whole), column[1])


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
