"""Trials out of and into the files of others: counts and times exact, damage refused whole."""

from __future__ import annotations

import json
import os
import pickle
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

from sliplab.plugins.formats.lab import events as lab
from sliplab.protocols.errors import InputError
from sliplab.storage.files import read_json
from sliplab.storage.formats.aedat4 import Aedat4File, Aedat4Stream, Aedat4Writer
from sliplab.storage.formats.export_trials import export_trials, label_table
from sliplab.storage.formats.flatbuffers import events_buffer, frame_buffer
from sliplab.storage.formats.foreign import EXPORT_MANIFEST, FormatError, Triggers
from sliplab.storage.formats.import_trials import import_trials
from sliplab.storage.formats.recognition import name_of, trials_in
from sliplab.storage.streams import EventChunk
from sliplab.storage.trials.catalogue import catalogue, write_table
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore
from tests.storage.formats.files import SMALL, lab_hdf5, lab_pickles, take
from tests.storage.trial_files import campaign, commit


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> TrialStore:
    """Two trials of a thousand events and twelve frames, and one without frames."""
    folder = tmp_path_factory.mktemp("exchange") / "store"
    where = campaign(folder)
    for trial in ("depth=2.4mm,r=1", "depth=2.4mm,r=2"):
        commit(where, trial)
    return TrialStore.open(folder)


def _import(folder: Path, path: Path, kind: str = "") -> TrialStore:
    made = TrialStore.create(folder)
    take(made, path, kind)
    return made


def _events(recording: Recording) -> EventChunk:
    with recording.open() as reader:
        return reader.events()


def _same(one: EventChunk, other: EventChunk) -> None:
    for name in ("x", "y", "p", "t_us"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("kind", ["aedat4", "dsec"])
def test_a_campaign_goes_out_and_comes_back(store: TrialStore, tmp_path: Path, kind: str) -> None:
    ours = store.campaign("c")
    result = export_trials(list(ours.recordings()), tmp_path / "out", kind, "c")
    assert (result["trials"], result["events"], result["triggers"]) == (2, 2000, 20)
    made = _import(tmp_path / "store", tmp_path / "out")
    theirs = made.campaign("theirs")
    assert theirs.committed() == ours.committed()
    for one, other in zip(ours.recordings(), theirs.recordings(), strict=True):
        _same(_events(one), _events(other))
        assert other.record.condition == one.record.condition
        assert other.record.imported.exported["clocks"] == one.record.clocks.to_json()
        assert other.record.clocks.events.grade == "unknown"
        assert other.simulated
        if kind == "aedat4":
            np.testing.assert_array_equal(one.frame_times() // 1000 * 1000, other.frame_times())
            for mine, yours in zip(one.frames(), other.frames(), strict=True):
                np.testing.assert_array_equal(mine, yours)
    table = catalogue(made)
    assert table["sync_uncertainty_us"].isna().all()
    again = import_trials(made, "theirs", trials_in(tmp_path / "out", kind), tmp_path / "out", kind)
    assert (again["imported"], len(again["there"])) == ([], 2)


def _aedat4(path: Path, t0: int = 1_663_249_605_718_334) -> tuple[EventChunk, Triggers]:
    rng = np.random.default_rng(1)
    count = 70_000  # more than one packet
    x, y, p, steps = (rng.integers(0, below, count) for below in (640, 480, 2, 3))
    t_us = t0 + np.cumsum(steps).astype(np.int64)
    events = EventChunk(x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8), t_us)
    triggers = Triggers(t0 + np.arange(9, dtype=np.int64) * 1000, np.arange(9).astype(np.uint8))
    streams = {
        0: Aedat4Stream("EVTS", "events", (640, 480), "camera"),
        1: Aedat4Stream("FRME", "frames", (33, 21), "camera"),
        2: Aedat4Stream("TRIG", "triggers", None, "camera"),
    }
    with Aedat4Writer(path, streams) as file:
        file.events(0, events)
        file.triggers(2, triggers)
        for index in range(3):
            file.picture(1, rng.integers(0, 256, (21, 33)).astype(np.uint8), t0 + index)
    return events, triggers


_BY_DV = """
import sys, json, numpy as np, dv_processing as dv
found = dv.io.MonoCameraRecording(sys.argv[1])
t, xy, p, triggers, frames = [], [], [], [], []
while (batch := found.getNextEventBatch()) is not None:
    t += batch.timestamps().tolist()
    xy += batch.coordinates().tolist()
    p += batch.polarities().tolist()
while (batch := found.getNextTriggerBatch()) is not None:
    triggers += [(one.timestamp, int(one.type)) for one in batch]
while (one := found.getNextFrame()) is not None:
    frames.append((one.timestamp, one.image.tolist()))
json.dump([t, xy, p, triggers, frames, list(found.getEventResolution())], sys.stdout)
"""
_OF_DV = """
import sys, numpy as np, dv_processing as dv
config = dv.io.MonoCameraWriter.Config("theirs")
config.addEventStream((640, 480)); config.addFrameStream((32, 24)); config.addTriggerStream()
writer = dv.io.MonoCameraWriter(sys.argv[1], config)
store = dv.EventStore()
for i in range(5000):
    store.push_back(10**15 + 7 * i, i % 640, i % 480, i % 3 == 0)
writer.writeEvents(store)
for i in range(4):
    writer.writeFrame(dv.Frame(10**15 + i * 100, np.full((24, 32), 50 * i, np.uint8)))
    writer.writeTrigger(dv.Trigger(10**15 + i, dv.TriggerType.EXTERNAL_SIGNAL_RISING_EDGE))
"""


def _by_library(script: str, path: Path) -> str:
    """In a process of its own: its reader and writer in one can stand still for ever."""
    command = [sys.executable, "-c", script, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_dv_processing_reads_what_we_write(tmp_path: Path) -> None:
    path = tmp_path / "ours.aedat4"
    events, triggers = _aedat4(path)
    t, xy, p, edges, frames, size = json.loads(_by_library(_BY_DV, path))
    assert t == events.t_us.tolist()
    assert xy == np.stack([events.x, events.y], 1).tolist()
    assert p == events.p.tolist()
    assert edges == np.stack([triggers.t_us, triggers.kind], 1).tolist()
    assert size == [640, 480]
    with Aedat4File(path) as file:
        pictures = [(one.t_ns // 1000, one.image.tolist()) for one in file.pictures(1)]
    assert [(t, image) for t, image in frames] == pictures


def test_we_read_what_dv_processing_writes(tmp_path: Path) -> None:
    path = tmp_path / "theirs.aedat4"
    _by_library(_OF_DV, path)
    made = _import(tmp_path / "store", path)
    found = made.campaign("theirs").recording("theirs")
    number = np.arange(5000)
    events = _events(found)
    np.testing.assert_array_equal(events.t_us, 10**15 + 7 * number)
    np.testing.assert_array_equal(events.x, number % 640)
    np.testing.assert_array_equal(events.y, number % 480)
    np.testing.assert_array_equal(events.p, number % 3 == 0)
    assert [int(frame[0, 0]) for frame in found.frames()] == [0, 50, 100, 150]
    np.testing.assert_array_equal(found.frame_times(), (10**15 + np.arange(4) * 100) * 1000)
    with found.open() as reader:
        np.testing.assert_array_equal(reader.pulses("event_pulses"), (10**15 + np.arange(4)) * 1000)


_EXPOSED_BY_DV = """
import sys, datetime, numpy as np, dv_processing as dv
config = dv.io.MonoCameraWriter.Config("theirs")
config.addEventStream((640, 480)); config.addFrameStream((32, 24))
writer = dv.io.MonoCameraWriter(sys.argv[1], config)
store = dv.EventStore()
store.push_back(10**15, 1, 1, True)
writer.writeEvents(store)
for start, exposure in ((0, 20_000), (50_000, 1_001), (100_000, 0)):
    frame = dv.Frame(10**15 + start, np.zeros((24, 32), np.uint8))
    frame.exposure = datetime.timedelta(microseconds=exposure)
    writer.writeFrame(frame)
"""


def test_a_frame_is_at_the_middle_of_its_exposure(tmp_path: Path) -> None:
    """dv-processing's `timestamp` is the start of exposure; start and end are in the file."""
    path = tmp_path / "theirs.aedat4"
    _by_library(_EXPOSED_BY_DV, path)
    found = _import(tmp_path / "store", path).campaign("theirs").recording("theirs")
    middles = 10**15 + np.array([10_000, 50_500, 100_000])
    np.testing.assert_array_equal(found.frame_times(), middles * 1000 + [0, 500, 0])


def _frame(path: Path, *times: int) -> None:
    """A frame with its time stamp and the start and the end of its exposure."""
    streams = {0: Aedat4Stream("EVTS", "e", (8, 6), "x"), 1: Aedat4Stream("FRME", "f", (1, 1), "x")}
    with Aedat4Writer(path, streams) as file:
        made = frame_buffer(np.zeros((1, 1), np.uint8), 99)
        told = struct.pack("<5q", times[0], 0, 0, *times[1:])
        file._write(1, made.replace(struct.pack("<5q", *(5 * [99])), told))


def test_the_middle_of_exposure_in_older_files(tmp_path: Path) -> None:
    # an older file, whose `timestamp` is something else; one without exposure; one without its end
    for times, middle in (((70, 40, 60), 50_000), ((70, 0, 0), 70_000), ((70, 40, 0), 70_000)):
        _frame(tmp_path / "old.aedat4", *times)
        with Aedat4File(tmp_path / "old.aedat4") as file:
            assert [one.t_ns for one in file.pictures(1)] == [middle]


def test_an_exposure_that_ends_before_it_starts_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bad.aedat4"
    _frame(path, 99, 60, 40)
    with pytest.raises(InputError, match=r"bad\.aedat4.*exposure.* 60 .* 40 us"):
        _import(tmp_path / "store", path)


def _packets(path: Path, whole: EventChunk, lengths: list[int]) -> None:
    """Events in packets of such lengths, as cameras write them."""
    with Aedat4Writer(path, {0: Aedat4Stream("EVTS", "events", (640, 480), "camera")}) as file:
        ends = np.cumsum(lengths).tolist()
        for low, high in zip([0, *ends[:-1]], ends, strict=True):
            file._write(0, events_buffer(whole[low:high]))


@pytest.mark.parametrize(
    "lengths",
    [[0, 70_000], [70_000, 0], [300] * 233 + [100], [1, 65_534, 1, 1, 4463], [69_999, 1]],
    ids=str,
)
def test_packets_of_any_length(tmp_path: Path, lengths: list[int]) -> None:
    events, _ = _aedat4(tmp_path / "a.aedat4")
    _packets(tmp_path / "b.aedat4", events, lengths)
    with Aedat4File(tmp_path / "b.aedat4") as file:
        found = list(file.events(0))
    assert all(len(chunk) for chunk in found)
    _same(EventChunk.concatenate(found), events)


@pytest.mark.quick(7)
@pytest.mark.parametrize("at", [0, 299, 300, 66_000, 69_999])
@pytest.mark.parametrize(
    ("column", "value"),
    [("x", -1), ("y", 20_000), ("x", 640), *(("t_us", t) for t in (-5, 1 << 60, 1 << 52, 3))],
)
def test_one_wrong_event_is_left_out(tmp_path: Path, at: int, column: str, value: int) -> None:
    reasons = {-5: "with a negative time", 1 << 60: "without a valid time"}
    # column -1 of a type without a sign is the last one
    reasons |= {-1: "at a column or row above 16,383", 20_000: "at a column or row above 16,383"}
    reasons |= {1 << 52: "whose times run back", 3: "whose times run back"}
    reason = f"events {reasons.get(value, 'outside of the sensor')}"
    events, _ = _aedat4(tmp_path / "a.aedat4")
    getattr(events, column)[at : at + 1] = np.array([value]).astype(getattr(events, column).dtype)
    _packets(tmp_path / "b.aedat4", events, [300] * 233 + [100])
    made = _import(tmp_path / "store", tmp_path / "b.aedat4")
    found = made.campaign("theirs").recording("b")
    in_order = (value, at) in {(1 << 52, 69_999), (3, 0)}
    if not in_order:
        events = events[np.arange(len(events)) != at]
    _same(_events(found), events)
    assert found.record.imported.dropped == ({} if in_order else {reason: 1})


@pytest.mark.parametrize("size", [3, 300_000, 5 << 20])
def test_zstd_frames_that_say_a_wrong_size(tmp_path: Path, size: int) -> None:
    """The size in a frame's header is believed only where its content has it."""
    path = tmp_path / "a.aedat4"
    _aedat4(path)
    data = bytearray(path.read_bytes())
    frame = data.index(b"\x28\xb5\x2f\xfd")
    assert data[frame + 4] >> 6 == 2  # the size has four bytes
    at = frame + 6 - (data[frame + 4] >> 5 & 1)
    data[at : at + 4] = struct.pack("<I", size)
    path.write_bytes(data)
    with Aedat4File(path) as file, pytest.raises(FormatError, match=r"decompressed|too large"):
        list(file.events(0))


@pytest.mark.quick(1)
@pytest.mark.parametrize("later", [1_795_000_000_000_000, 3 * 86_400 * 10**6])
def test_a_gap_of_years_is_imported_with_a_warning_and_exported(tmp_path: Path, later: int) -> None:
    column = np.arange(300, dtype=np.uint16)
    times = np.concatenate([[0], later + np.arange(299)]).astype(np.int64)
    whole = EventChunk(column, column, (column % 2).astype(np.uint8), times)
    with Aedat4Writer(
        tmp_path / "a.aedat4", {0: Aedat4Stream("EVTS", "e", (346, 300), "x")}
    ) as file:
        file.events(0, whole)
    made = TrialStore.create(tmp_path / "store")
    path = tmp_path / "a.aedat4"
    result = import_trials(made, "theirs", trials_in(path, "aedat4"), path, "aedat4")
    (text,) = result["warnings"]
    assert text.startswith("a.aedat4: ")
    assert f"between 0 and {later} us" in text
    found = made.campaign("theirs").recording("a")
    assert [f"a.aedat4: {one}" for one in found.record.imported.warnings] == [text]
    _same(_events(found), whole)
    export_trials([found], tmp_path / "out", "aedat4", "theirs")
    with Aedat4File(tmp_path / "out" / "a.aedat4") as again:
        back = [chunk.t_us for chunk in again.events(0)]
    np.testing.assert_array_equal(np.concatenate(back), times)


def test_aedat4_goes_round_with_every_trigger(tmp_path: Path) -> None:
    events, triggers = _aedat4(tmp_path / "a.aedat4")
    made = _import(tmp_path / "store", tmp_path / "a.aedat4")
    export_trials(list(made.campaign("theirs").recordings()), tmp_path / "out", "aedat4", "theirs")
    with (
        Aedat4File(tmp_path / "out" / "a.aedat4") as file,
        Aedat4File(tmp_path / "a.aedat4") as was,
    ):
        found = file.triggers(2)
        np.testing.assert_array_equal(found.t_us, triggers.t_us)
        np.testing.assert_array_equal(found.kind, triggers.kind)
        times = np.concatenate([chunk.t_us for chunk in file.events(0)])
        np.testing.assert_array_equal(times, events.t_us)
        for mine, yours in zip(was.pictures(1), file.pictures(1), strict=True):
            assert mine.t_ns == yours.t_ns
            np.testing.assert_array_equal(mine.image, yours.image)


@pytest.mark.parametrize("by_columns", [False, True])
@pytest.mark.usefixtures("small")
def test_the_labs_pickles(tmp_path: Path, by_columns: bool) -> None:
    stem = "d3_s0.5_dir_back_r0"
    lab_pickles(tmp_path, stem, SMALL[::-1], by_columns=by_columns)
    (tmp_path / "notes.txt").write_text("is left out")
    made = _import(tmp_path / "store", tmp_path)
    found = made.campaign("theirs").recording(stem)
    events = _events(found)
    columns = (events.t_us, events.x, events.y, events.p)
    rows = list(zip(*(column.tolist() for column in columns), strict=True))
    assert rows[:3] == [(125, 0, 0, 0), (10_000, 3, 5, 1), (11_000, 7, 5, 1)]
    assert rows[3:] == [(11_250, 3, 5, 0), (12_500, 3, 5, 1)]
    assert found.record.condition == {"depth": "3", "speed": "0.5", "direction": "back"}
    assert {"sync grade", "poses", "epoch"} <= set(found.record.imported.unknown)
    assert catalogue(made)["trial"].tolist() == [stem]


def test_the_labs_hdf5(tmp_path: Path) -> None:
    reported = lab_hdf5(tmp_path / "slide 1.h5")
    made = _import(tmp_path / "store", tmp_path / "slide 1.h5")
    _same(_events(made.campaign("theirs").recording("slide_1")), reported)


def test_columns_of_different_lengths_are_refused(tmp_path: Path) -> None:
    lab_hdf5(tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        shorter = file["events/xs"][:-1]
        del file["events/xs"]
        file["events/xs"] = shorter
    with pytest.raises(InputError, match=r"a\.h5: its events' columns .*: xs \d+, ys \d+"):
        _import(tmp_path / "store", tmp_path / "a.h5")


def test_labels_and_catalogue_as_tables(store: TrialStore, tmp_path: Path) -> None:
    table = catalogue(store)
    for name in ("t.csv", "t.parquet"):
        write_table(table, tmp_path / name)
    pd.testing.assert_frame_equal(pd.read_parquet(tmp_path / "t.parquet"), table)
    assert len(pd.read_csv(tmp_path / "t.csv")) == 2
    late = 2**60 + 1
    Derived.of(store, "labels", "c").write(
        "depth=2.4mm,r=1", "k", {"gross_ns": late, "doubt": {"glare": False}, "path": [1]}
    )
    names = sorted(store.campaign("c").committed())
    write_table(label_table(store, "c", names), tmp_path / "l.parquet")
    found = pd.read_parquet(tmp_path / "l.parquet")
    assert found["gross_ns"].tolist() == [late]
    assert found["doubt.glare"].tolist() == [False]
    assert found["simulated"].tolist() == [store.simulated]
    with pytest.raises(InputError, match="must end in"):
        write_table(table, tmp_path / "t.xlsx")


def _cells(value: Any) -> bytes:
    """An array that holds the same thing in every pixel."""
    cells = np.empty(SMALL, object)
    for index in np.ndindex(SMALL):
        cells[index] = value
    return pickle.dumps(cells)


def _h5(fill: Callable[[h5py.File], None]) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        with h5py.File(folder / "bad.h5", "w") as file:
            fill(file)
        return folder / "bad.h5"

    return make


def _written(name: str, data: Callable[[], bytes]) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).write_bytes(data())
        return folder / name

    return make


def _external(file: h5py.File) -> None:
    for name in "xyp":
        file[f"events/{name}"] = np.zeros(3, np.uint16)
    file["events/t"] = h5py.ExternalLink("/etc/passwd", "/t")


def _huge(file: h5py.File) -> None:
    for name in "xypt":
        file.create_dataset(f"events/{name}", (1 << 40,), "u4", chunks=(1 << 16,))


def _columns(**changed: Any) -> Callable[[h5py.File], None]:
    def fill(file: h5py.File) -> None:
        whole: dict[str, Any] = {"x": [1, 2], "y": [1, 2], "p": [0, 1], "t": [5, 6]}
        for name, values in {**whole, **changed}.items():
            file[f"events/{name}"] = np.asarray(values)

    return fill


def _damaged_aedat4(change: Callable[[bytes], bytes]) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = folder / "bad.aedat4"
        _aedat4(path)
        path.write_bytes(change(path.read_bytes()))
        return path

    return make


def _late(folder: Path) -> Path:
    streams = {0: Aedat4Stream("EVTS", "e", (8, 6), "x"), 1: Aedat4Stream("FRME", "f", (2, 2), "x")}
    with Aedat4Writer(folder / "bad.aedat4", streams) as file:
        file.picture(1, np.zeros((2, 2), np.uint8), 1 << 55)  # its nanoseconds need 65 bits
    return folder / "bad.aedat4"


def _late_triggers(file: h5py.File) -> None:
    _columns()(file)
    file["triggers/t"], file["triggers/kind"] = [1 << 55], [1]


BOMB = pa.compress(bytes(300 << 20), codec="zstd", asbytes=True)
RUNS = b"cos\nmkdir\n(V/nowhere/canary\ntR."
PACKED = struct.pack("<ii", 0, len(BOMB)) + BOMB
BAD: dict[str, Callable[[Path], Path]] = {
    "no aedat4": _written("bad.aedat4", lambda: b"hello"),
    "aedat4 cut short": _damaged_aedat4(lambda data: data[:-100]),
    "aedat4 of 2 GB": _damaged_aedat4(lambda data: data + b"\0\0\0\0\xff\xff\xff\x7f"),
    "aedat4 with rubbish in a packet": _damaged_aedat4(lambda data: data + b"\0\0\0\0\4\0\0\0abcd"),
    "aedat4 that defines words": _damaged_aedat4(lambda data: data.replace(b"<dv", b"<!E", 1)),
    "aedat4 of packed 300 MB": _damaged_aedat4(lambda data: data + PACKED),
    "aedat4 with a frame beyond time": _late,
    "triggers beyond time": _h5(_late_triggers),
    "no hdf5": _written("bad.h5", lambda: b"hello"),
    "hdf5 that leads out": _h5(_external),
    "hdf5 of 4 TB": _h5(_huge),
    "times backwards": _h5(_columns(t=[6, 5])),
    "a pixel too far": _h5(_columns(x=[1, 1 << 20])),
    "columns of text": _h5(_columns(x=[b"a", b"b"])),
    "columns of unequal length": _h5(_columns(x=[1, 2, 3])),
    "another layout": _h5(lambda file: None),
    "pickle that runs something": _written("d1_s1_dir_up_r0_events_on.pickle", lambda: RUNS),
    "pickle of text": _written("a_events_on.pickle", lambda: pickle.dumps("text")),
    "pickle of NaN": _written("a_events_on.pickle", lambda: _cells([float("nan")])),
    "pickle of one list told often": _written("a_events_on.pickle", lambda: _cells([1.0] * 1000)),
    "pickle before its clock": _written("a_events_off.pickle", lambda: _cells([-1])),
}


@pytest.mark.quick(6)
@pytest.mark.parametrize("name", BAD)
@pytest.mark.usefixtures("small")
def test_damaged_and_hostile_files_leave_nothing(tmp_path: Path, name: str) -> None:
    path = BAD[name](tmp_path)
    made = TrialStore.create(tmp_path / "store")
    with pytest.raises(InputError) as caught:
        _import(tmp_path / "store", path)
    assert path.name in caught.value.message
    assert made.campaigns() == []
    left = [item.name for item in (tmp_path / "store").rglob("*") if item.is_file()]
    assert left == ["store.json"]


@pytest.mark.parametrize("file", ["../t.h5", "/etc/passwd", "t\0.h5", "", "gone.h5", "link.h5"])
def test_a_manifest_leads_nowhere(tmp_path: Path, store: TrialStore, file: str) -> None:
    out = tmp_path / "out"
    export_trials([store.campaign("c").recording("depth=2.4mm,r=1")], out, "dsec", "c")
    (tmp_path / "t.h5").write_bytes((out / "depth=2.4mm,r=1.h5").read_bytes())
    os.symlink(tmp_path / "t.h5", out / "link.h5")
    reported = read_json(out / EXPORT_MANIFEST)
    reported["trials"][0]["file"] = file
    (out / EXPORT_MANIFEST).write_text(json.dumps(reported))
    with pytest.raises(InputError):
        _import(tmp_path / "store", out, "dsec")
    assert TrialStore.open(tmp_path / "store").campaigns() == []


def test_names_become_plain() -> None:
    assert name_of("../../etc/passwd") == "etc_passwd"
    for name in ("../x", "a/b", "\0", "..", "-x", "a" * 500, "\u202e", "a..b"):
        TrialStore(Path("s")).campaign(name_of(name))


def test_a_collected_campaign_is_left_alone(store: TrialStore, tmp_path: Path) -> None:
    lab_hdf5(tmp_path / "a.h5")
    path, kind = tmp_path / "a.h5", "lab-hdf5"
    with pytest.raises(InputError, match="is a collected campaign"):
        import_trials(store, "c", trials_in(path, kind), path, kind)


def test_pairs_of_pickles(tmp_path: Path) -> None:
    names = ["a_events_on.pickle", "a_events_off.pickle", "b_events_on.pkl", "times.pickle"]
    found = [(p.stem, bool(p.on), bool(p.off)) for p in lab.pairs([tmp_path / n for n in names])]
    assert found == [("a", True, True), ("b", True, False)]
