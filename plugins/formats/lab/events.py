"""The lab's pickles: a list of times in ms for every pixel, one file for ON and one for OFF.

File names such as ``d3_s0.5_dir_back_r0_events_on`` give depth, speed, direction and repetition;
the units of the first two are unknown. Most have no extension; ``.pickle``, ``.pkl`` and ``.npy``
(numpy's header before the pickle) hold the same, and some names lack ``_events``.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sliplab.plugins.formats.lab.pickles import parse_pickle, read_bounded
from sliplab.storage.formats.foreign import (
    LATEST_US,
    Damage,
    ForeignTrial,
    FormatError,
    event_chunk,
    read_head,
    rounded_us,
)
from sliplab.storage.formats.numpy_files import MAGIC, read_header
from sliplab.storage.streams import EventChunk

_FILE = re.compile(
    r"(?P<stem>.+?)(?P<events>_events)?_(?P<polarity>on|off)(?P<ending>\.(?:pickle|pkl|npy))?",
    re.IGNORECASE,
)
_STREAM = re.compile(r"(?P<stem>.+?)_events_stream(?:\.(?:h5|hdf5))?", re.IGNORECASE)
_PART = re.compile(
    r"d(?P<depth>[0-9.]+)_s(?P<speed>[0-9.]+)_dir_(?P<direction>[A-Za-z0-9-]+)_r(?P<repetition>\d{1,6})"
)
SIZES = ((480, 640), (260, 346), (180, 240), (128, 128))
"""Rows and columns of the lab's cameras: DVXplorer, DAVIS346, DAVIS240, eDVS."""
_MOST_EVEN = 1 << 24
"""Times of a `.npy` file with the same number for every pixel, which few recordings have."""
_PICKLES = tuple(bytes([0x80, protocol]) for protocol in range(2, 6))
_KNOWN = " or ".join(f"{width} x {height}" for height, width in SIZES)
_RIGHT = f"the lab's files hold a list of times in ms for each pixel of {_KNOWN}"


@dataclass(frozen=True)
class Pair:
    """The files of a recording, some of which may be missing.

    Attributes:
        stream: HDF5 file of the events of both polarities.
        fault: why it cannot be read; empty where it can.
        doubtful: the name of its one file does not say whether its events are ON or OFF.
    """

    stem: str
    on: Path | None
    off: Path | None
    stream: Path | None = None
    fault: str = ""
    doubtful: bool = False

    @property
    def files(self) -> tuple[Path, ...]:
        """Its files, the stream first."""
        return tuple(path for path in (self.stream, self.on, self.off) if path is not None)


def pairs(files: Iterable[Path]) -> list[Pair]:
    """Files of the lab's names by recording; others are left out."""
    found: dict[str, dict[str, Path]] = {}
    faults: dict[str, str] = {}
    for path in files:
        if (match := _STREAM.fullmatch(path.name)) is not None:
            what = "stream"
        elif (match := _FILE.fullmatch(path.name)) is not None and (
            match["events"] or match["ending"] or _is_pickle(path)
        ):
            what = match["polarity"].lower()
        else:
            continue
        parts = found.setdefault(match["stem"], {})
        if (other := parts.setdefault(what, path)) != path:
            faults[match["stem"]] = (
                f"holds the {what.upper()} events of {match['stem']}, as {other.name} does; keep "
                "one of the two"
            )
    return [
        Pair(stem, parts.get("on"), parts.get("off"), parts.get("stream"), faults.get(stem, ""))
        for stem, parts in sorted(found.items())
    ]


def unnamed(files: Iterable[Path]) -> list[Pair]:
    """Return pickles whose names say no polarity, for folders that have no others."""
    return [
        Pair(path.stem, path, None, doubtful=True)
        for path in files
        if path.suffix.lower() in {".pickle", ".pkl"}
        and _is_pickle(path)
        and not path.name.startswith("timestamps_")
    ]


def is_stream(path: Path) -> bool:
    """Return whether a file has the name of the lab's HDF5 files, ``NAME_events_stream``."""
    return _STREAM.fullmatch(path.name) is not None


def named_condition(stem: str) -> tuple[dict[str, str], int]:
    """Return the condition and the repetition that a recording's name says; none: empty."""
    named = _PART.fullmatch(stem)
    if named is None:
        return {}, 0
    parts = named.groupdict()
    return parts, int(parts.pop("repetition"))


def count_events(path: Path) -> int:
    """Return the number of events of one file.

    Raises:
        FormatError, InputError: it cannot be right.
    """
    return len(_events(path, 1)[-1])


def _is_pickle(path: Path) -> bool:
    """Check how a file begins that only half of its name calls the lab's."""
    return read_head(path).startswith((MAGIC, *_PICKLES))


def read_pair(pair: Pair, name: str) -> ForeignTrial:
    """Two files as a trial called `name`; they are read when its events are.

    Raises:
        FormatError: a file cannot be right.
    """
    if pair.fault:
        raise FormatError(pair.fault)
    sides = [(path, polarity) for path, polarity in ((pair.on, 1), (pair.off, 0)) if path]
    missing = [] if len(sides) == 2 else ["OFF events" if pair.off is None else "ON events"]
    names = " and ".join(path.name for path, _ in sides)

    shapes: set[tuple[int, int]] = set()

    def all_events() -> Iterator[EventChunk]:
        parts = []
        for path, polarity in sides:
            try:
                shape, *columns = _events(path, polarity)
            except FormatError as error:
                raise type(error)(str(error), path) from None
            shapes.add(shape)
            parts.append(columns)
        if len(shapes) > 1:
            raise FormatError(
                f"are of cameras of different sizes, rows and columns {sorted(shapes)}"
            )
        x, y, p, t = (np.concatenate(column) for column in zip(*parts, strict=True))
        order = np.lexsort((p, x, y, t))
        yield event_chunk(x[order], y[order], p[order], t[order])

    # the lab's newest script saves both by numpy under the name of the ON events, OFF last
    overwritten = pair.off is None and pair.on is not None and read_head(pair.on).startswith(MAGIC)
    doubtful = pair.doubtful or overwritten
    missing = ["polarity"] if doubtful else missing
    note = (
        f"{names} may hold the OFF events: there is no file of those, and a script of the lab "
        "writes them over the ON events; its polarity is unknown"
        if overwritten
        else f"the name of {names} does not say whether its events are ON or OFF; taken as ON"
    )
    condition, repetition = named_condition(pair.stem)
    return ForeignTrial(
        name,
        names,
        all_events,
        "unknown; ms as the files have them, rounded to us",
        lambda: next((shape[::-1] for shape in shapes), None),
        condition=condition,
        repetition=repetition,
        notes=lambda: (note,) if doubtful else (),
        about={"resolution": "ms as stored; order within one time is lost"},
        unknown=(
            "epoch",
            "units of the condition",
            "sync grade",
            "poses",
            "motion",
            "frames",
            "polarity map",
            *missing,
        ),
    )


def _events(path: Path, polarity: int) -> tuple[tuple[int, int], Any, Any, Any, Any]:
    """Rows and columns of the camera, and columns x, y, p and t of one file, by pixel."""
    data = read_bounded(path)
    found = _from_numpy(data, path) if data.startswith(MAGIC) else parse_pickle(data, path)
    if not isinstance(found, np.ndarray):
        found = _as_array(found)
    if found.dtype != object or found.ndim != 2 or not _is_camera(found.shape):
        raise FormatError(f"holds an array of {found.dtype} of shape {found.shape}; {_RIGHT}")
    if found.shape not in SIZES:  # columns first
        found = found.T
    cells = found.ravel().tolist()
    counts = np.zeros(len(cells), np.int64)
    for index, cell in enumerate(cells):
        if isinstance(cell, np.ndarray) and cell.ndim == 1 and cell.dtype.kind in "iuf":
            cells[index] = cell = cell.tolist()
        if type(cell) not in {list, tuple}:
            raise FormatError(
                f"holds a {type(cell).__name__} where a list of times belongs; {_RIGHT}"
            )
        counts[index] = len(cell)
    # a pickle may hold a list once and refer to it many times
    if counts.sum() > len(data):
        raise FormatError(f"holds {counts.sum()} times, more than its bytes can tell")
    times = [time for cell in cells for time in cell]
    if not {int, float}.issuperset(map(type, times)):
        raise FormatError(f"contains times that are not numbers; {_RIGHT}")
    try:
        t_us = rounded_us(times, 1000.0)
    except OverflowError:  # an integer beyond any float
        t_us = rounded_us([time if abs(time) < LATEST_US else math.nan for time in times], 1000.0)
    place = np.repeat(np.arange(len(cells)), counts)
    shape = (int(found.shape[0]), int(found.shape[1]))
    return shape, place % shape[1], place // shape[1], np.full(len(t_us), polarity), t_us


def _is_camera(shape: tuple[int, ...]) -> bool:
    return shape in SIZES or shape[::-1] in SIZES


def _as_array(found: Any) -> Any:
    """Lists of lists of lists, as the array that they represent."""
    rows = found if type(found) in {list, tuple} else []
    width = len(rows[0]) if rows and type(rows[0]) in {list, tuple} else -1
    if any(type(row) not in {list, tuple} or len(row) != width for row in rows) or width < 0:
        raise FormatError(f"holds a {type(found).__name__}; {_RIGHT}")
    if not _is_camera((len(rows), width)):
        raise FormatError(f"holds {len(rows)} x {width} lists; {_RIGHT}")
    made = np.empty((len(rows), width), object)
    for row, cells in enumerate(rows):
        for column, cell in enumerate(cells):
            made[row, column] = cell
    return made


def _from_numpy(data: bytes, path: Path) -> Any:
    """The array of a `.npy` file, whose objects are a pickle behind numpy's header."""
    file = io.BytesIO(data)
    shape, fortran, dtype = read_header(file)
    at = file.tell()
    if dtype.kind == "O":
        found = parse_pickle(data[at:], path, at)
        if not isinstance(found, np.ndarray) or found.shape != shape:
            raise FormatError(f"contains data other than the array {shape} in its header; {_RIGHT}")
        return found
    # lists of one length: numpy makes them an array of numbers
    if dtype.kind not in "iuf" or len(shape) != 3 or not _is_camera(shape[:2]):
        raise FormatError(f"holds an array of {dtype} of shape {shape}; {_RIGHT}")
    if math.prod(shape) > _MOST_EVEN:
        held = f"holds {math.prod(shape)} times, the same number for every pixel"
        raise FormatError(f"{held}; {_RIGHT}")
    if math.prod(shape) * dtype.itemsize != len(data) - at:
        raise Damage(f"is truncated: {len(data) - at} bytes for an array of shape {shape}")
    numbers = np.frombuffer(data, dtype, offset=at).reshape(shape, order="F" if fortran else "C")
    cells = np.empty(shape[:2], object)
    for index in np.ndindex(shape[:2]):
        cells[index] = numbers[index].tolist()
    return cells
