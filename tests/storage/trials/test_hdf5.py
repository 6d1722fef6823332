"""The HDF5 file of a trial gives back what was put in, in the layout that others read."""

import subprocess
import sys
from pathlib import Path

import h5py
import hdf5plugin
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplab.storage.streams import Chunk, EventChunk, FrameChunk, PulseChunk, ScalarChunk
from sliplab.storage.trials.hdf5_reader import StreamReader
from sliplab.storage.trials.hdf5_writer import COLUMNS, SMALL_HELD, StreamFile
from tests.storage.trial_files import events


def write(path: Path, whole: EventChunk, pieces: int) -> None:
    """Write events in pieces of equal size."""
    file = StreamFile(path)
    for rows in np.array_split(np.arange(len(whole)), pieces):
        file.add("events", whole[rows])
    file.finish()


@pytest.mark.parametrize("count", [0, 1, 65_535, 65_536, 65_537, 200_000])
def test_events_come_back_however_they_were_chunked(count: int, tmp_path: Path) -> None:
    whole = events(count)
    for pieces in (1, 7):
        write(tmp_path / f"{pieces}.h5", whole, pieces)
        with StreamReader(tmp_path / f"{pieces}.h5") as reader:
            found = reader.events()
            assert np.array_equal(reader.event_times(), whole.t_us)
        for name in ("x", "y", "p", "t_us"):
            assert np.array_equal(getattr(found, name), getattr(whole, name))


def test_the_same_data_are_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.h5", "b.h5"):
        write(tmp_path / name, events(70_000), 5)
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_the_layout_is_that_of_dsec(tmp_path: Path) -> None:
    whole = events(5000)
    write(tmp_path / "t.h5", whole, 3)
    with h5py.File(tmp_path / "t.h5") as file:
        times = file["events/t"][:]
        assert np.array_equal(times + file["t_offset"][()], whole.t_us)
        marks = file["ms_to_idx"][:]
        for ms, index in enumerate(marks):
            assert index == np.searchsorted(times, ms * 1000)
        assert file["events/t"].attrs["unit"].startswith("us")


@given(st.integers(-50_000, 300_000), st.integers(-50_000, 300_000))
def test_a_window_is_what_a_mask_would_give(start: int, end: int) -> None:
    whole = events(2000, seed=3)
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "t.h5"
        write(path, whole, 2)
        low, high = 5_000_000 + start, 5_000_000 + end
        with StreamReader(path) as reader:
            found = reader.events(low, high)
    mask = (whole.t_us >= low) & (whole.t_us < high)
    assert np.array_equal(found.t_us, whole.t_us[mask])
    assert np.array_equal(found.x, whole.x[mask])


def test_times_that_run_backwards_are_refused(tmp_path: Path) -> None:
    file = StreamFile(tmp_path / "t.h5")
    file.add("events", events(10))
    with pytest.raises(ValueError, match="backwards"):
        file.add("events", events(10))
    file.abandon()


def test_times_near_two_to_the_62_stay_apart(tmp_path: Path) -> None:
    start = 2**62 // 1000
    whole = EventChunk(
        np.zeros(3, np.uint16),
        np.zeros(3, np.uint16),
        np.zeros(3, np.uint8),
        np.array([start, start + 1, start + 2], np.int64),
    )
    write(tmp_path / "t.h5", whole, 1)
    with StreamReader(tmp_path / "t.h5") as reader:
        assert np.array_equal(reader.events().t_us, whole.t_us)


@pytest.mark.parametrize("before", [1, 70_000])
def test_times_longer_than_32_bits_are_kept_in_64(before: int, tmp_path: Path) -> None:
    first = events(before)
    gap = 2**32 - int(first.t_us[-1] - first.t_us[0])
    late = events(70_000, start_us=int(first.t_us[-1]) + gap - 500)
    file = StreamFile(tmp_path / "t.h5")
    for chunk in (first, late):
        file.add("events", chunk)
    file.finish()
    wanted = np.concatenate([first.t_us, late.t_us])
    assert wanted[-1] - wanted[0] > 2**32
    with StreamReader(tmp_path / "t.h5") as reader:
        assert np.array_equal(reader.event_times(), wanted)
        assert np.array_equal(reader.events().t_us, wanted)
        assert np.array_equal(reader.column("events/t"), wanted - wanted[0])
        middle = (int(late.t_us[30_000]), int(late.t_us[60_000]))
        window = reader.events(*middle)
        assert np.array_equal(window.t_us, wanted[(wanted >= middle[0]) & (wanted < middle[1])])
    with h5py.File(tmp_path / "t.h5") as opened:
        assert opened["events/t"].dtype == np.int64
        assert set(opened["events"]) == {"x", "y", "p", "t"}


def test_a_file_of_format_1_reads_the_same(tmp_path: Path) -> None:
    whole = events(70_000)
    write(tmp_path / "2.h5", whole, 3)
    (tmp_path / "1.h5").write_bytes((tmp_path / "2.h5").read_bytes())
    zstd = hdf5plugin.Bitshuffle(nelems=1 << 16, cname="zstd", clevel=1)
    with h5py.File(tmp_path / "1.h5", "r+") as old:
        old.attrs["format"] = 1
        for name, dtype in (("x", "uint16"), ("y", "uint16"), ("p", "uint8"), ("t", "int64")):
            values = old[f"events/{name}"][:].astype(dtype)
            del old[f"events/{name}"]
            old.create_dataset(
                f"events/{name}", data=values, chunks=(1 << 16,), maxshape=(None,), **zstd
            )
    start = int(whole.t_us[1000])
    found = []
    for name in ("1.h5", "2.h5"):
        with StreamReader(tmp_path / name) as reader:
            found.append((reader.events(), reader.events(start, start + 50_000)))
    for one, two in zip(*found, strict=True):
        assert len(one) == len(two) > 0
        for column in ("x", "y", "p", "t_us"):
            values = getattr(one, column), getattr(two, column)
            assert np.array_equal(*values)
            assert values[0].dtype == values[1].dtype
    assert np.array_equal(found[0][0].t_us, whole.t_us)


def test_small_columns_come_back_from_beyond_what_is_held(tmp_path: Path) -> None:
    times = np.arange(2 * SMALL_HELD + 5, dtype=np.int64)
    file = StreamFile(tmp_path / "t.h5")
    for start in range(0, len(times), 1000):
        file.add("arm", PulseChunk(times[start : start + 1000]))
    file.add("sync_box", PulseChunk(times))
    assert file.counts["arm_pulses/t"] == len(times)
    file.finish()
    with StreamReader(tmp_path / "t.h5") as reader:
        assert np.array_equal(reader.pulses("arm_pulses"), times)
        assert np.array_equal(reader.pulses("sync_pulses"), times)
        assert reader.counts()["arm_pulses/t"] == len(times)
        assert reader.counts()["tracks/markers"] == 0


def test_a_file_without_anything_has_every_column(tmp_path: Path) -> None:
    StreamFile(tmp_path / "t.h5").finish()
    with StreamReader(tmp_path / "t.h5") as reader:
        assert set(reader.counts().values()) == {0}
        assert not reader.has("tracks/markers")
        assert len(reader.event_times()) == 0
    with h5py.File(tmp_path / "t.h5") as file:
        assert all(file[name].attrs["unit"] for name in (*COLUMNS, "ms_to_idx", "t_offset"))


def _sparse(times: list[int]) -> EventChunk:
    count = len(times)
    column = np.arange(count, dtype=np.uint16)
    return EventChunk(
        column, column, (column % 2).astype(np.uint8), np.asarray(times, dtype=np.int64)
    )


DAY_US = 86_400 * 10**6
EPOCH_US = 1_795_000_000_000_000
SPARSE = {
    "one event at 0, the rest at today's epoch": [0, *range(EPOCH_US, EPOCH_US + 400, 4)],
    "three days": [*range(0, 3 * DAY_US, DAY_US // 300)],
    "ends where the index does": [0, 5, 2**32 - 700, 2**32 - 1],
    "ends after the index": [0, 5, 2**32 - 700, 2**32 + 700, 2**32 + 701, 2**33],
}


@pytest.mark.quick(1)
@pytest.mark.parametrize("name", SPARSE)
def test_a_gap_costs_neither_memory_nor_a_window(name: str, tmp_path: Path) -> None:
    whole = _sparse(SPARSE[name])
    write(tmp_path / "t.h5", whole, 3)
    assert (tmp_path / "t.h5").stat().st_size < 1_000_000
    with h5py.File(tmp_path / "t.h5") as file:
        marks = file["ms_to_idx"][:]
        times = file["events/t"][:]
    assert len(marks) <= 2**32 // 1000 + 2
    for ms in {0, 1, len(marks) // 2, len(marks) - 1}:
        assert marks[ms] == np.searchsorted(times, ms * 1000)
    edges = sorted({t + d for t in whole.t_us[[0, 1, 2, -2, -1]].tolist() for d in (-1, 0, 1)})
    with StreamReader(tmp_path / "t.h5") as reader:
        assert np.array_equal(reader.events().t_us, whole.t_us)
        for start in edges:
            for end in edges:
                found = reader.events(start, end)
                mask = (whole.t_us >= start) & (whole.t_us < end)
                assert np.array_equal(found.t_us, whole.t_us[mask])
                assert np.array_equal(found.x, whole.x[mask])


def test_only_a_file_whose_index_ends_early_has_the_newer_format(tmp_path: Path) -> None:
    """A version that expects the index to reach the last event would find nothing behind it."""
    for name, times in (("whole", [0, 2**32 - 1]), ("cut", [0, 2**32 + 10**6])):
        write(tmp_path / name, _sparse(times), 1)
    with h5py.File(tmp_path / "whole") as whole, h5py.File(tmp_path / "cut") as cut:
        assert (whole.attrs["format"], cut.attrs["format"]) == (2, 3)


@pytest.mark.long
def test_a_long_file_with_the_full_index_of_older_versions_reads_the_same(tmp_path: Path) -> None:
    whole = _sparse([0, 5, 2**32 - 700, 2**32 + 700, 2**32 + 1_000_000, 2**32 + 1_999_999])
    write(tmp_path / "t.h5", whole, 1)
    with h5py.File(tmp_path / "t.h5", "r+") as file:
        marks = np.searchsorted(whole.t_us, np.arange(2**32 // 1000 + 2002) * 1000)
        file["ms_to_idx"].resize(len(marks) + 1, 0)
        file["ms_to_idx"][:] = [*marks, len(whole)]
        file.attrs["format"] = 2
    edges = sorted({t + d for t in whole.t_us.tolist() for d in (-1, 0, 1)})
    with StreamReader(tmp_path / "t.h5") as reader:
        for start in edges:
            for end in edges:
                mask = (whole.t_us >= start) & (whole.t_us < end)
                assert np.array_equal(reader.events(start, end).t_us, whole.t_us[mask])


ALONE = """
import sys
import h5py
with h5py.File(sys.argv[1]) as file:
    found = []
    file.visititems(lambda name, at: found.append(at[()]) if isinstance(at, h5py.Dataset) else None)
    print(len(file["events/t"]), int(file["events/t"][-1]), file["streams/grip/value"][7])
assert "hdf5plugin" not in sys.modules
"""


def test_a_recording_without_a_protocol_is_read_by_h5py_alone(tmp_path: Path) -> None:
    """Programs of other labs do not have the filters of `hdf5plugin`."""
    path, late_us = tmp_path / "data.h5", 2**33
    t_ns = np.arange(70_000, dtype=np.int64)
    values = ScalarChunk(t_ns, t_ns, np.sin(t_ns / 100.0), "mm")
    expected: dict[str, tuple[Chunk, ...]] = {
        "events": (EventChunk.empty(),),
        "frames": (FrameChunk.empty(),),
        "grip": (values[:0],),
    }
    file = StreamFile(path, expected)
    sent = events(70_000)
    file.add("events", sent)
    file.mark()
    file.add("events", EventChunk(sent.x[:1], sent.y[:1], sent.p[:1], sent.t_us[:1] + late_us))
    file.add("grip", values)
    file.finish()
    read = subprocess.run(
        [sys.executable, "-c", ALONE, path], capture_output=True, text=True, check=False
    )
    assert read.returncode == 0, read.stderr
    assert read.stdout.split() == ["70001", str(late_us), str(np.sin(0.07))]
    with StreamReader(path) as reader:
        np.testing.assert_array_equal(reader.events().x[:-1], sent.x)
