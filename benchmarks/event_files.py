"""The other files in which labs keep events, each given every advantage.

- **AEDAT4** (zstd) by dv-processing: its store of events is made before the clock runs.
- **Parquet** by pyarrow, where it is installed: zstd at level 1, times as packed differences, row
  groups as long as our chunks; a window reads only the groups whose statistics allow it.
- **The lab's pickles**: lists of times, one a pixel, made before the clock runs. Reading them stops
  at the lists, and they keep neither polarity nor microseconds.
"""

from __future__ import annotations

import pickle
from importlib import import_module, util
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from sliplab.storage.streams import EventChunk
from sliplab.storage.trials.hdf5_writer import EVENT_CHUNK

WIDTH, HEIGHT = 640, 480
Lists = list[list[list[int]]]


class EventFile(Protocol):
    """One way to keep events; `path` is its file."""

    path: Path

    def write(self) -> None:
        """Write all events."""

    def read(self) -> Any:
        """Read all events."""

    def window(self, start_us: int, end_us: int) -> Any:
        """Open the file and read the events of a window on the camera's clock, us."""


def rivals(folder: Path, data: EventChunk) -> dict[str, EventFile]:
    """Those that can be had here, by the beginning of their figures' names."""
    found: dict[str, EventFile] = {"pickle": Pickle(folder, data), "aedat4": Aedat4(folder, data)}
    if util.find_spec("pyarrow") is not None:
        found["parquet"] = Parquet(folder, data)
    return found


class Pickle:
    """Whole milliseconds since the first event, a list a pixel."""

    def __init__(self, folder: Path, data: EventChunk) -> None:
        self.path = folder / "data.pickle"
        self._first = int(data.t_us[0])
        self._lists: Lists = [[[] for _ in range(WIDTH)] for _ in range(HEIGHT)]
        ms = ((data.t_us - data.t_us[0]) // 1000).tolist()
        for x, y, t in zip(data.x.tolist(), data.y.tolist(), ms, strict=True):
            self._lists[y][x].append(t)

    def write(self) -> None:
        """Dump the lists."""
        with self.path.open("wb") as file:
            pickle.dump(self._lists, file, protocol=pickle.HIGHEST_PROTOCOL)

    def read(self) -> Lists:
        """Load the lists, which this benchmark wrote."""
        with self.path.open("rb") as file:
            loaded: Lists = pickle.load(file)
        return loaded

    def window(self, start_us: int, end_us: int) -> list[tuple[int, int, int]]:
        """Load all lists and look through them."""
        low, high = (start_us - self._first) // 1000, (end_us - self._first) // 1000
        return [
            (x, y, t)
            for y, row in enumerate(self.read())
            for x, times in enumerate(row)
            for t in times
            if low <= t < high
        ]


class Aedat4:
    """The format of iniVation's cameras."""

    def __init__(self, folder: Path, data: EventChunk) -> None:
        self.path = folder / "data.aedat4"
        self._dv: Any = import_module("dv_processing")
        self._store = self._dv.EventStore()
        columns = (data.t_us.tolist(), data.x.tolist(), data.y.tolist(), data.p.tolist())
        for t, x, y, p in zip(*columns, strict=True):
            self._store.push_back(t, x, y, bool(p))

    def write(self) -> None:
        """Write the store; its thread has ended when the writer is gone."""
        made = self._dv.io.MonoCameraWriter
        config = made.EventOnlyConfig("sliplab", (WIDTH, HEIGHT), self._dv.CompressionType.ZSTD)
        writer = made(str(self.path), config)
        writer.writeEvents(self._store)
        del writer

    def read(self) -> list[Any]:
        """All batches, as arrays."""
        recording = self._dv.io.MonoCameraRecording(str(self.path))
        parts = []
        while (batch := recording.getNextEventBatch()) is not None:
            parts.append((batch.timestamps(), batch.coordinates(), batch.polarities()))
        return parts

    def window(self, start_us: int, end_us: int) -> Any:
        """Through the table at the file's end."""
        recording = self._dv.io.MonoCameraRecording(str(self.path))
        found = recording.getEventsTimeRange(start_us, end_us)
        return found.timestamps(), found.coordinates(), found.polarities()


class Parquet:
    """The format of data frames."""

    def __init__(self, folder: Path, data: EventChunk) -> None:
        self.path = folder / "data.parquet"
        self._arrow: Any = import_module("pyarrow")
        self._parquet: Any = import_module("pyarrow.parquet")
        self._columns = {"x": data.x, "y": data.y, "p": data.p, "t": data.t_us}

    def write(self) -> None:
        """Row group by row group."""
        table = self._arrow.table(self._columns)
        self._parquet.write_table(
            table,
            self.path,
            row_group_size=EVENT_CHUNK,
            compression="zstd",
            compression_level=1,
            use_dictionary=False,
            column_encoding={"t": "DELTA_BINARY_PACKED"},
        )

    def read(self) -> list[np.ndarray[Any, Any]]:
        """All columns, as arrays."""
        table = self._parquet.read_table(self.path, use_threads=False)
        return [table[name].to_numpy() for name in "xypt"]

    def window(self, start_us: int, end_us: int) -> Any:
        """Those row groups that may hold some of it."""
        bounds = [("t", ">=", start_us), ("t", "<", end_us)]
        return self._parquet.read_table(self.path, use_threads=False, filters=bounds)
