"""Import and export hold a bounded number of events at once, whatever the order of the file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.plugins.adapters import streams as adapted_streams
from sliplab.protocols.adapter_parts import EventFiles
from sliplab.storage.formats import aedat4, by_time, dsec, tables
from sliplab.storage.formats.data_folder import DataFolder
from sliplab.storage.formats.foreign import ForeignTrial
from sliplab.storage.formats.import_trials import import_trials
from sliplab.storage.formats.known import known_format
from sliplab.storage.formats.recognition import kind_of, trials_in
from sliplab.storage.streams import EventChunk
from sliplab.storage.trials import hdf5_reader
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore
from tests.storage.formats.recordings import COUNT, FILES, SIZE, all_events

MOST = 256
"""Events held at once: those of two packets of the recordings, and some."""
RECORDED = ("aedat4", "dsec", "contiguous", "lab", "evt2", "evt3", "dat")


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make every limit small."""
    from sliplab.plugins.formats import prophesee

    for module, name, value in (
        (dsec, "PIECE", MOST),
        (tables, "_ROWS", MOST),
        (tables, "_BLOCK_BYTES", 8 * MOST),
        (adapted_streams, "_BLOCK_EVENTS", MOST // 2),
        (by_time, "_PART", MOST),
        (hdf5_reader, "EVENTS_AT_ONCE", MOST),
        (aedat4, "_PACKET_EVENTS", MOST),
        (prophesee, "_CHUNK", MOST),
    ):
        monkeypatch.setattr(module, name, value)


def table(folder: Path, form: str, order: Any) -> Callable[[], Iterator[EventChunk]]:
    """Write all events in some order to a table, and return its reader."""
    chunk = all_events()
    columns = {"t": chunk.t_us, "x": chunk.x, "y": chunk.y, "p": chunk.p}
    columns = {key: values[order] for key, values in columns.items()}
    file = folder / f"a.{form}"
    if form == "csv":
        rows = np.stack(list(columns.values()), 1)
        np.savetxt(file, rows, "%d", ",", header="t,x,y,p", comments="")
    elif form == "npz":
        np.savez_compressed(file, **columns)
    else:
        np.save(file, np.rec.fromarrays(list(columns.values()), names="t,x,y,p"))
    part = EventFiles.model_validate(
        {
            "format": "csv" if form == "csv" else "numpy",
            "columns": {key: key for key in columns},
            "unit": "us",
            "size_px": SIZE,
        }
    )
    return adapted_streams.read_events(DataFolder(folder), [file.name], part, []).events


def same(chunks: Iterator[EventChunk], order: Any = slice(None), most: int = MOST) -> None:
    """Compare chunks with all events, and their lengths with a limit."""
    found = list(chunks)
    assert max(map(len, found)) <= most
    whole = all_events()
    joined = EventChunk.joined(found)
    for name in ("x", "y", "p", "t_us"):
        np.testing.assert_array_equal(getattr(joined, name), getattr(whole, name)[order])


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("form", ["csv", "npz", "npy"])
def test_tables_are_read_in_parts(form: str, tmp_path: Path) -> None:
    same(table(tmp_path, form, slice(None))())


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("name", RECORDED)
def test_recordings_are_read_in_parts(name: str, tmp_path: Path) -> None:
    file, write = FILES[name]
    write(tmp_path / file)
    (trial,) = trials_in(tmp_path, kind_of(tmp_path))
    same(trial.events())


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("form", ["csv", "npy"])
def test_lists_by_pixel_are_sorted_in_parts(form: str, tmp_path: Path) -> None:
    whole = all_events()
    order = np.lexsort((whole.t_us, whole.y, whole.x))
    read = table(tmp_path, form, order)
    same(read(), order)
    found = list(by_time.by_time(read))
    assert max(map(len, found)) <= 3 * MOST
    times = np.concatenate([chunk.t_us for chunk in found])
    np.testing.assert_array_equal(times, whole.t_us)
    rows = {tuple(row) for chunk in found for row in zip(*vars_of(chunk), strict=True)}
    assert rows == set(zip(*vars_of(whole), strict=True))


def vars_of(chunk: EventChunk) -> list[list[int]]:
    """Columns of events as integers."""
    return [getattr(chunk, name).tolist() for name in ("t_us", "x", "y", "p")]


@pytest.mark.usefixtures("small")
def test_counts_are_spread_in_parts(tmp_path: Path) -> None:
    counts = np.random.default_rng(3).integers(0, 4, (40, 6, 8))
    np.save(tmp_path / "a.npy", counts)
    axes = {"axes": ["step", "y", "x"], "step_ms": 1, "polarity_order": ["positive"]}
    part = EventFiles.model_validate({"format": "counts", **axes})
    chunks = list(adapted_streams.read_events(DataFolder(tmp_path), ["a.npy"], part, []).events())
    assert max(map(len, chunks)) <= MOST
    assert sum(map(len, chunks)) == counts.sum()
    assert np.all(np.diff(np.concatenate([chunk.t_us for chunk in chunks])) >= 0)


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("kind", ["aedat4", "dsec"])
def test_exports_read_in_parts(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = FILES["aedat4"][1]
    write(tmp_path / "a.aedat4")
    store = TrialStore(tmp_path / "store")
    import_trials(store, "set", trials_in(tmp_path / "a.aedat4", "aedat4"), tmp_path, "aedat4")
    recording: Recording = store.campaign("set").recording("a")

    def whole(*_: object) -> None:
        raise AssertionError("read at once")

    for name in ("events", "event_times"):
        monkeypatch.setattr(hdf5_reader.StreamReader, name, whole)
    how = known_format(kind)
    assert how.export is not None
    file = tmp_path / f"out{how.suffixes[0]}"
    assert how.export(recording, file, "events")["events"] == COUNT
    found: ForeignTrial
    (found,) = trials_in(file, kind)
    same(found.events())
