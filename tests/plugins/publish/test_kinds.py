"""Columns of every type and rank, of a package's kind of stream: published and read back."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

import sliplab
from sliplab.plugins.record.recorder import record
from sliplab.plugins.record.sources import HOST, Source, push
from sliplab.rigs.core.device_stream import DeviceStream
from sliplab.storage.schema.trial import StreamRecord
from sliplab.storage.streams import SCALAR, Chunk, Column, StreamKind, chunk_type
from sliplab.storage.trials.recording import Recording

NUMBERS = ["?", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f2", "f4", "f8", ">u2", ">f8"]
RANKS = [(), (3,), (2, 3), (2, 1, 3), (2, 1, 3, 2)]


def kind_of(types: list[str], shapes: list[tuple[int, ...]]) -> StreamKind:
    """Return a kind of stream with a column of every type and shape."""
    columns = {name: SCALAR.columns[name] for name in ("t", "host")}
    for number, dtype in enumerate(types):
        for rank, shape in enumerate(shapes):
            name = f"c{number}_{rank}"
            columns[name] = Column(name, dtype, shape, f"unit {number}")
    return StreamKind("odd", columns)


class Device:
    """A sensor that sends three rows at its start."""

    def __init__(self, kind: StreamKind) -> None:
        self.type, self.waiting = chunk_type(kind), False

    def connect(self) -> None:
        """Nothing is to be opened."""

    stop = close = connect

    def start(self) -> None:
        """Send the rows."""
        self.waiting = True

    def read(self) -> Chunk:
        """Return the rows once."""
        if not self.waiting:
            return self.type.empty()
        self.waiting, columns = False, self.type.KIND.columns
        found = {name: rows(column) for name, column in columns.items()}
        t_ns = time.monotonic_ns() + np.arange(3)
        return self.type.from_columns({**found, "t": t_ns, "host": t_ns})


def rows(column: Column) -> np.ndarray:
    """Return three rows at the ends of what the type holds."""
    dtype, size = np.dtype(column.dtype), (3, *column.shape)
    found = np.arange(np.prod(size)).reshape(size).astype(dtype)
    if dtype.kind in "iu":
        found.flat[:2] = np.iinfo(dtype).min, np.iinfo(dtype).max
    if dtype.kind == "f":
        found.flat[:2] = np.nan, np.finfo(dtype).max
    return found


def stored(folder: Path, kind: StreamKind) -> Recording:
    """Record one trial with a stream of a kind."""
    about = StreamRecord(kind=kind.name, rows=0)
    source = Source(DeviceStream("wrist", Device(kind), about), HOST, 0.0, declared=kind)
    streams = [source, push("events", events_px=(4, 4))]
    with record(streams, folder, "c") as recording, recording.trial() as trial:
        t_us = time.monotonic_ns() // 1000 + np.arange(1000) * 10
        trial.push("events", t_us, x=t_us % 4, y=t_us % 3, p=t_us % 2)
    return sliplab.open_store(folder).trial(trial.id).recording


@pytest.fixture(scope="module")
def all_columns(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """A recording with columns of every type and rank."""
    return stored(tmp_path_factory.mktemp("kinds") / "a", kind_of(NUMBERS, RANKS))


@pytest.mark.parametrize("form", ["mcap", "croissant", "lerobot"])
def test_published_columns_come_back(form: str, all_columns: Recording, tmp_path: Path) -> None:
    store = all_columns.folder.parents[3]
    about = {"licence": "CC0-1.0", "creator": ["Ada"], "title": "t"}
    sliplab.export(store, form, tmp_path / "pub", **about)
    sliplab.import_data(tmp_path / "pub", tmp_path / "b", name="again")
    found = sliplab.open_store(tmp_path / "b").trial(all_columns.trial_id).recording
    with all_columns.open() as before, found.open() as after:
        names = [f"streams/wrist/{part}" for part in before.parts("wrist")]
        assert len(names) == 2 + len(NUMBERS) * len(RANKS)
        for name in names:
            one, other = before.column(name), after.column(name)
            assert one.dtype.newbyteorder("=") == other.dtype.newbyteorder("="), name
            np.testing.assert_array_equal(one, other)
            part = name.rpartition("/")[2]
            assert before.column_unit("wrist", part) == after.column_unit("wrist", part)


def test_every_rank_is_an_array_of_xarray(all_columns: Recording) -> None:
    trial = sliplab.open_store(all_columns.folder.parents[3]).trial(all_columns.trial_id)
    found = trial.to_xarray()
    for name, values in all_columns.samples("wrist").items():
        if name != "t":
            np.testing.assert_array_equal(found[f"wrist_{name}"], values)
    last = f"wrist_c0_{len(RANKS) - 1}"
    axes = [f"{last}_axis{n}" for n in ("", 2, 3, 4)]
    assert found[last].dims == ("wrist", *axes)


@pytest.mark.parametrize(
    ("name", "dtype", "shape"),
    [
        *[("a", "longdouble", ()), ("a", "c16", ()), ("a", "S3", ()), ("a", "u1", (1,) * 5)],
        *[("t", "f8", ()), ("host", "u8", ())],
    ],
)
def test_columns_that_no_file_holds_are_refused(
    name: str, dtype: str, shape: tuple[int, ...]
) -> None:
    kind = kind_of([], [])
    with pytest.raises(ValueError, match=f"stream kind odd: column {name} = {dtype}, "):
        StreamKind("odd", {**kind.columns, name: Column("a", dtype, shape, "")})


@pytest.mark.parametrize(
    ("name", "columns", "wrong"),
    [
        ("odd", ["a"], "has no column t"),
        ("Odd", ["t"], "name 'Odd' must match"),
        ("odd", ["t", "A b"], "name 'A b' must match"),
        ("odd", ["t", *(f"c{n}" for n in range(512))], "more than 512 columns"),
    ],
)
def test_kinds_that_no_file_holds_are_refused(name: str, columns: list[str], wrong: str) -> None:
    with pytest.raises(ValueError, match=wrong):
        StreamKind(name, {each: Column("a", "i8", (), "") for each in columns})
