"""The lab's pickles: a list of times in ms for every pixel, one file for ON and one for OFF.

They are called ``d3_s0.5_dir_back_r0_events_on.pickle``: depth, speed, direction, repetition. What
units the first two have is not in the files.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from storage.exchange.foreign import ForeignTrial, Wrong, event_chunk, rounded_us
from storage.exchange.pickles import read_pickle
from storage.streams import EventChunk

_FILE = re.compile(r"(?P<stem>.+)_events_(?P<polarity>on|off)\.(?:pickle|pkl)")
_PART = re.compile(
    r"d(?P<depth>[0-9.]+)_s(?P<speed>[0-9.]+)_dir_(?P<direction>[A-Za-z0-9-]+)_r(?P<repetition>\d{1,6})"
)
LANDSCAPE = (480, 640)
"""Rows and columns of the lab's camera."""


@dataclass(frozen=True)
class Pair:
    """The two files of a trial; one of them may be missing."""

    stem: str
    on: Path | None
    off: Path | None


def pairs(files: list[Path]) -> list[Pair]:
    """Files of the lab's names by trial; others are left out."""
    found: dict[str, dict[str, Path]] = {}
    for path in files:
        if match := _FILE.fullmatch(path.name):
            found.setdefault(match["stem"], {})[match["polarity"]] = path
    return [Pair(stem, two.get("on"), two.get("off")) for stem, two in sorted(found.items())]


def read_pair(pair: Pair, name: str) -> ForeignTrial:
    """Two files as a trial called `name`; they are read when its events are."""
    sides = [(path, polarity) for path, polarity in ((pair.on, 1), (pair.off, 0)) if path]
    missing = [] if len(sides) == 2 else ["OFF events" if pair.off is None else "ON events"]
    names = " and ".join(path.name for path, _ in sides)

    def all_events() -> Iterator[EventChunk]:
        parts = [_events(path, polarity) for path, polarity in sides]
        x, y, p, t = (np.concatenate(column) for column in zip(*parts, strict=True))
        order = np.lexsort((p, x, y, t))
        yield event_chunk(x[order], y[order], p[order], t[order])

    told = _PART.fullmatch(pair.stem)
    condition = {k: v for k, v in told.groupdict().items() if k != "repetition"} if told else {}
    return ForeignTrial(
        name, names, all_events, "unknown; ms as the files have them, rounded to us",
        LANDSCAPE[::-1],
        condition=condition, repetition=int(told["repetition"]) if told else 0,
        about={"resolution": "ms as stored; order within one time is lost"},
        unknown=("epoch", "units of the condition", "sync grade", "poses", "motion", "frames",
                 "polarity map", *missing),
    )  # fmt: skip


def _events(path: Path, polarity: int) -> tuple[Any, Any, Any, Any]:
    """Columns x, y, p and t of one file, by pixel."""
    found = read_pickle(path)
    if not isinstance(found, np.ndarray):
        found = _as_array(found, path)
    if found.dtype != object or found.ndim != 2 or sorted(found.shape) != sorted(LANDSCAPE):
        raise Wrong(f"{path.name}: an array {found.shape} where {_size()} lists belong")
    if found.shape != LANDSCAPE:  # columns first
        found = found.T
    cells = found.ravel().tolist()
    counts = np.zeros(len(cells), np.int64)
    for index, cell in enumerate(cells):
        if isinstance(cell, np.ndarray) and cell.ndim == 1 and cell.dtype.kind in "iuf":
            cells[index] = cell = cell.tolist()
        if type(cell) not in {list, tuple}:
            raise Wrong(f"{path.name}: a {type(cell).__name__} where a list of times belongs")
        counts[index] = len(cell)
    # lists may be told once and meant many times
    if counts.sum() > path.stat().st_size:
        raise Wrong(f"{path.name}: {counts.sum()} times, more than its bytes can tell")
    times = [time for cell in cells for time in cell]
    if not {int, float}.issuperset(map(type, times)):
        raise Wrong(f"{path.name}: times that are no numbers")
    try:
        t_us = rounded_us(times, 1000.0)
    except OverflowError:
        raise Wrong(f"{path.name}: a time beyond any time") from None
    if len(t_us) and int(t_us.min()) < 0:
        raise Wrong(f"{path.name}: an event before its own clock began")
    place = np.repeat(np.arange(len(cells)), counts)
    return place % LANDSCAPE[1], place // LANDSCAPE[1], np.full(len(t_us), polarity), t_us


def _as_array(found: Any, path: Path) -> Any:
    """Lists of lists of lists, as the array that they stand for."""
    rows = found if type(found) in {list, tuple} else []
    width = len(rows[0]) if rows and type(rows[0]) in {list, tuple} else -1
    if any(type(row) not in {list, tuple} or len(row) != width for row in rows) or width < 0:
        raise Wrong(f"{path.name}: a {type(found).__name__} where {_size()} lists belong")
    if len(rows) * width != LANDSCAPE[0] * LANDSCAPE[1]:
        raise Wrong(f"{path.name}: {len(rows)} x {width} lists where {_size()} belong")
    made = np.empty((len(rows), width), object)
    for row, cells in enumerate(rows):
        for column, cell in enumerate(cells):
            made[row, column] = cell
    return made


def _size() -> str:
    return f"{LANDSCAPE[1]} x {LANDSCAPE[0]}"
