"""Columns are checked part by part, as they would be whole."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplab.storage.trials import hdf5_reader
from sliplab.storage.trials.hdf5_reader import StreamReader
from sliplab.storage.trials.hdf5_writer import INDEX
from sliplab.storage.trials.verify import leads_to_events, runs_backwards

TIMES = st.lists(st.integers(0, 5000), max_size=30)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("columns")


@given(TIMES, st.booleans(), st.integers(1, 7), st.integers(-2, 2), st.integers(0, 6))
def test_parts_find_what_the_whole_shows(
    folder: Path, found: list[int], ordered: bool, rows: int, wrong: int, place: int
) -> None:
    times = np.array(sorted(found) if ordered else found, np.int64)
    marks = np.searchsorted(np.sort(times), np.arange(7) * 1000)
    marks[place] += wrong
    with h5py.File(folder / "data.h5", "w") as file:
        file["events/t"] = times
        file[INDEX] = marks.astype(np.uint64)
        file["t_offset"] = np.int64(123)
    with (
        pytest.MonkeyPatch.context() as patch,
        StreamReader(folder / "data.h5") as reader,
    ):
        patch.setattr(hdf5_reader, "EVENTS_AT_ONCE", rows)
        assert runs_backwards(reader, "events/t") == bool(np.any(np.diff(times) < 0))
        if ordered:
            assert leads_to_events(reader) == (wrong == 0)
