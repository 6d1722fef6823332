"""Small files as other programs write them, with known content."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sliplab.storage.formats.import_trials import import_trials
from sliplab.storage.formats.recognition import kind_of, trials_in
from sliplab.storage.streams import EventChunk, Json
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify

SMALL = (6, 8)
"""Rows and columns of a camera of few pixels."""


def take(store: TrialStore, path: Path, kind: str = "", *, salvage: bool = False) -> Json:
    """Import as the campaign `theirs`; the store is whole then."""
    kind = kind or kind_of(path)
    found = trials_in(path, kind, salvage=salvage)
    result = import_trials(store, "theirs", found, path, kind, salvage=salvage)
    assert verify(store) == []
    return result


def taken(
    folder: Path, path: Path, kind: str = "", *, salvage: bool = False
) -> tuple[Json, list[Recording]]:
    """Import into a new store; return the result and what is there."""
    store = TrialStore.create(folder)
    return take(store, path, kind, salvage=salvage), list(store.campaign("theirs").recordings())


def lab_hdf5(path: Path) -> EventChunk:
    """The lab's layout: float seconds, polarities as -1 and 1; returns what is in it."""
    rng = np.random.default_rng(3)
    t_us = np.sort(rng.integers(0, 2_000_000, 50)).astype(np.int64)
    x, y, p = rng.integers(0, 640, 50), rng.integers(0, 480, 50), rng.integers(0, 2, 50)
    with h5py.File(path, "w") as file:
        file["events/ts"], file["events/xs"] = t_us / 1e6, x
        file["events/ys"], file["events/ps"] = y, 2 * p - 1
    return EventChunk(x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8), t_us)


def lab_cells(size: tuple[int, int], places: dict[tuple[int, int], list[float]]) -> Any:
    """An array of columns x rows with a list in every cell, with times, ms, in some."""
    cells = np.frompyfunc(lambda _: [], 1, 1)(np.zeros(size))
    for place, times in places.items():
        cells[place] = times
    return cells


def lab_pickles(folder: Path, stem: str, size: tuple[int, int], *, by_columns: bool) -> None:
    """Two pickles of columns x rows with some times, ms, in some pixels."""
    width, height = size
    for polarity, places in (
        ("on", {(3, 5): [10.0, 12.5], (width - 1, height - 1): [11]}),
        ("off", {(3, 5): [11.25], (0, 0): [0.125]}),
    ):
        cells = lab_cells(size, places)
        cells = cells if by_columns else np.ascontiguousarray(cells.T)
        (folder / f"{stem}_events_{polarity}.pickle").write_bytes(pickle.dumps(cells))
