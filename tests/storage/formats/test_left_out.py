"""One wrong event, row, message, episode or file: left out and counted, and the rest imported."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sliplab.analysis.campaigns import Collected
from sliplab.flows.verify import verify as verify_store
from sliplab.storage.files import safe_name
from sliplab.storage.formats import import_trials as import_module
from sliplab.storage.formats.aedat4 import Aedat4Stream, Aedat4Writer
from sliplab.storage.formats.flatbuffers import events_buffer
from sliplab.storage.formats.foreign import Triggers
from sliplab.storage.formats.recognition import kind_of, name_of, trials_in
from sliplab.storage.streams import EventChunk
from sliplab.storage.trials.catalogue import catalogue
from sliplab.storage.trials.checksums import CHECKSUMS, sha256
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify
from tests.command_line import here
from tests.plugins.adapters.adapters import SLIDES, bring, slides
from tests.plugins.formats.test_lerobot import foreign
from tests.storage.formats.files import SMALL, lab_cells, lab_hdf5, take, taken

BACK = "events whose times run back"
NO_TIME = "events without a valid time"
NEGATIVE = "events with a negative time"
OUTSIDE = "events outside of the sensor"
COUNT = 500
NUMBER = np.arange(COUNT)
TIMES = NUMBER * 10
ODD = NUMBER % 2


def _one(folder: Path, path: Path, *, salvage: bool = False) -> Recording:
    _, (found,) = taken(folder, path, salvage=salvage)
    return found


def _line(tmp_path: Path, path: Path, *options: str) -> Any:
    """Import on the command line."""
    return here("import", path, "--store", tmp_path / "store", "--name", "theirs", *options)


def _dropped(found: Recording) -> dict[str, int]:
    return found.record.imported.dropped


def _events(times: Any) -> EventChunk:
    count = len(times)
    column = np.arange(count, dtype=np.uint16) % 40
    return EventChunk(column, column, (column % 2).astype(np.uint8), np.asarray(times, np.int64))


def _aedat4(path: Path, *packets: Any) -> None:
    with Aedat4Writer(path, {0: Aedat4Stream("EVTS", "events", (40, 40), "camera")}) as file:
        for times in packets:
            file._write(0, events_buffer(_events(times)))


def _dsec(path: Path, t: Any, **changed: Any) -> None:
    events = _events(t)
    columns = {"x": events.x, "y": events.y, "p": events.p, "t": t} | changed
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file[name if "offset" in name else f"events/{name}"] = np.asarray(values)


@pytest.mark.parametrize("salvage", [False, True])
def test_events_of_the_run_before_are_left_out(tmp_path: Path, salvage: bool) -> None:
    times = 10**15 + TIMES
    _aedat4(tmp_path / "a.aedat4", times[:20] + 10**9, times[:300], times[300:])
    found = _one(tmp_path / "store", tmp_path / "a.aedat4", salvage=salvage)
    np.testing.assert_array_equal(found.events().t_us, times)
    assert _dropped(found) == {BACK: 20}
    assert found.record.lost is None
    assert found.record.imported.warnings == (f"20 {BACK} left out",)


def test_a_packet_twice_costs_no_other_events(tmp_path: Path) -> None:
    parts = TIMES[:200], TIMES[200:300], TIMES[200:300], TIMES[300:]
    _aedat4(tmp_path / "a.aedat4", *parts)
    found = _one(tmp_path / "store", tmp_path / "a.aedat4")
    np.testing.assert_array_equal(found.events().t_us, TIMES)
    assert _dropped(found) == {BACK: 100}


def _lab(path: Path, t: Any, **changed: Any) -> None:
    """As the lab's own program writes it: seconds, of a camera of 40 x 30 pixels."""
    rng = np.random.default_rng(1)
    columns = {"xs": rng.integers(0, 40, len(t)), "ys": rng.integers(0, 30, len(t))}
    columns |= {"ps": rng.integers(0, 2, len(t)), "ts": t} | changed
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file[f"events/{name}"] = np.asarray(values)
        file.attrs["sensor_resolution"] = np.array([40, 30])


def _with(values: Any, **at: Any) -> Any:
    """Values with others at places: ``p4=9``."""
    made = np.array(values)
    for place, value in at.items():
        made[int(place[1:])] = value
    return made


UNKNOWN = "events with an unknown polarity"
SIGNED = np.where(NUMBER % 3, 1, -1).astype(np.int8)
WRONG = {
    "t": _with(TIMES, _5=-7, _6=1 << 60),
    "x": _with(NUMBER % 40, _3=-1, _4=1 << 14, _5=1 << 20),  # wrong twice: counted once
    "p": _with(ODD, _4=9),
}
SECONDS = NUMBER / 100
SHUFFLED = np.random.default_rng(2).permutation(COUNT)
BLOCKS = NUMBER.reshape(-1, 5)[:, ::-1].ravel()
BY_SIGN = np.argsort(ODD, kind="stable")
ON = {each: np.where(NUMBER % 3, each[1], each[0]) for each in ((0, 1), (-1, 1), (0, 255))}
# how it is written, its columns, the events that stay, their polarities, what is left out
EVENTS: dict[str, tuple[Any, dict[str, Any], Any, Any, dict[str, int]]] = {
    "bytes": (_dsec, {"t": TIMES, "p": (ODD * 255).astype(np.uint8)}, TIMES, ODD, {}),
    "restart": (_dsec, {"t": np.r_[TIMES, TIMES[:200]]}, TIMES, None, {BACK: 200}),
    "offset": (_dsec, {"t": NUMBER, "t_offset": 7}, 7 + NUMBER, None, {}),
    "offset in a list": (_dsec, {"t": NUMBER, "t_offset": [7]}, 7 + NUMBER, None, {}),
    "offset in two": (_dsec, {"t": NUMBER, "t_offset": [[7]]}, 7 + NUMBER, None, {}),
    "minus one": (_dsec, {"t": NUMBER, "p": SIGNED}, NUMBER, SIGNED > 0, {}),
    "wrong": (
        _dsec,
        WRONG,
        np.delete(TIMES, range(3, 7)),
        None,
        {OUTSIDE: 1, "events at a column or row above 16,383": 2, NO_TIME: 1},
    ),
    "negative": (
        _dsec,
        {"t": _with(TIMES, _1=-(1 << 62), _2=-7)},
        np.delete(TIMES, [1, 2]),
        None,
        {NEGATIVE: 1, NO_TIME: 1},
    ),
    **{
        f"{name} of the lab": (_lab, {"t": SECONDS[rows], "ps": ODD[rows]}, 10**4 * NUMBER, ODD, {})
        for name, rows in (("polarity", BY_SIGN), ("packets", BLOCKS), ("pixel", SHUFFLED))
    },
    **{
        f"{pair} of the lab": (
            _lab,
            {"t": SECONDS, "ps": _with(p, _7=9)},
            10**4 * np.delete(NUMBER, 7),
            np.delete(p, 7) == pair[1],
            {UNKNOWN: 1},
        )
        for pair, p in ON.items()
    },
    "outside": (
        _lab,
        {"t": SECONDS, "xs": _with(NUMBER % 40, _3=41, _70=4000)},
        10**4 * np.delete(NUMBER, [3, 70]),
        None,
        {OUTSIDE: 2},
    ),
}


@pytest.mark.parametrize("case", EVENTS)
def test_events_that_can_be_right_are_kept_and_others_counted(tmp_path: Path, case: str) -> None:
    write, columns, times, polarities, dropped = EVENTS[case]
    write(tmp_path / "a.h5", **columns)
    found = _one(tmp_path / "store", tmp_path / "a.h5")
    np.testing.assert_array_equal(found.events().t_us, times)
    if polarities is not None:
        np.testing.assert_array_equal(found.events().p, polarities)
    if write is _lab:
        assert found.record.geometry.event_px == (40, 30)
    assert _dropped(found) == dropped


def test_a_trial_committed_before_a_signal_stays(tmp_path: Path, monkeypatch: Any) -> None:
    _dsec(tmp_path / "a.h5", TIMES)
    whole = import_module._take

    def interrupted(*args: Any) -> Any:
        whole(*args)
        raise KeyboardInterrupt

    monkeypatch.setattr(import_module, "_take", interrupted)
    store = TrialStore.create(tmp_path / "store")
    with pytest.raises(KeyboardInterrupt):
        take(store, tmp_path / "a.h5")
    assert store.campaign("theirs").committed() == {"a"}


def test_a_damaged_trial_is_a_failure_of_its_export(tmp_path: Path) -> None:
    _dsec(tmp_path / "a.h5", TIMES)
    found = _one(tmp_path / "store", tmp_path / "a.h5")
    data = found.folder / "data.h5"
    data.chmod(0o644)
    with h5py.File(data, "r+") as file:
        del file["events/t"]
        file["events/t"] = [b"text"] * COUNT
    sums = json.loads((found.folder / CHECKSUMS).read_text())
    sums["data.h5"] = {"sha256": sha256(data), "bytes": data.stat().st_size}
    (found.folder / CHECKSUMS).write_text(json.dumps(sums))
    options = ("--format", "dsec", "--output", tmp_path / "out")
    done = here("export", tmp_path / "store", "theirs", *options)
    assert done.returncode == 1
    assert "events/t does not contain numbers" in done.stderr
    assert "--format" not in done.stderr


def test_what_stands_before_damage_counts_no_events_that_run_back(tmp_path: Path) -> None:
    path = tmp_path / "a.aedat4"
    _aedat4(path, TIMES[:20] + 10**9, TIMES[:300], TIMES[300:])
    path.write_bytes(path.read_bytes()[:-9])
    done = _line(tmp_path / "s", path)
    assert done.returncode == 1
    assert "--salvage imports 300 events up to 2990 us, in 2 whole packets" in done.stderr
    found = _one(tmp_path / "store", path, salvage=True)
    assert (len(found.events()), _dropped(found)) == (300, {BACK: 20})


def test_times_of_dsec_that_are_floats_are_named_by_their_type(tmp_path: Path) -> None:
    _dsec(tmp_path / "a.h5", t=TIMES.astype(np.float32))
    done = _line(tmp_path, tmp_path / "a.h5")
    assert "contains times of float32, which DSEC's layout has as integers" in done.stderr


def test_a_file_of_many_wrong_events_is_not_imported(tmp_path: Path) -> None:
    _dsec(tmp_path / "a.h5", np.r_[np.full(60, -5), np.arange(COUNT - 60)])
    done = _line(tmp_path, tmp_path / "a.h5")
    assert done.returncode == 2
    assert f"events: 60 {NEGATIVE}; 440 can be right" in done.stderr
    assert not (tmp_path / "store").exists()


def test_a_sensor_larger_than_any_is_refused_and_not_its_events(tmp_path: Path) -> None:
    path, most = tmp_path / "a.aedat4", 1 << 14
    for columns in (most, most + 1):
        with Aedat4Writer(path, {0: Aedat4Stream("EVTS", "events", (columns, 480), "DVX")}) as file:
            far = np.full(50, most - 1, np.uint16)
            file.events(0, EventChunk(far, far % 480, np.ones(50, np.uint8), np.arange(50)))
        if columns == most:
            found = _one(tmp_path / "store", path)
            assert (found.record.geometry.event_px, len(found.events())) == ((most, 480), 50)
    done = _line(tmp_path / "wide", path)
    assert done.returncode != 0
    assert (
        "states a sensor of 16385 x 480 pixels; read are up to 16,384 columns and rows"
        in done.stderr
    )
    _dsec(tmp_path / "a.h5", t=TIMES, x=NUMBER % 40 + 20_000)
    done = _line(tmp_path / "far", tmp_path / "a.h5")
    assert "events: 500 events at a column or row above 16,383; 0 can be right" in done.stderr


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -1.0, 1e30])
def test_floats_that_are_no_times_are_left_out(tmp_path: Path, wrong: float) -> None:
    whole = lab_hdf5(tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file["events/ts"][7] = wrong
    found = _one(tmp_path / "store", tmp_path / "a.h5")
    np.testing.assert_array_equal(found.events().t_us, np.delete(whole.t_us, 7))
    assert _dropped(found) == {NEGATIVE if wrong == -1 else NO_TIME: 1}


@pytest.mark.usefixtures("small")
def test_one_event_before_the_clock_costs_neither_file_nor_folder(tmp_path: Path) -> None:
    folder = tmp_path / "events"
    folder.mkdir()
    for number, times in enumerate(([10, 12], [-7, 10, 12], [10, 12])):
        cells = lab_cells(SMALL, {(3, 5): times})
        (folder / f"d3_s0.5_dir_up_r{number}_events_on").write_bytes(pickle.dumps(cells))
    store = TrialStore.create(tmp_path / "store")
    result = take(store, folder)
    assert [len(one.events()) for one in store.campaign("theirs").recordings()] == [2, 2, 2]
    (item,) = result["left_out"]
    assert (item["trial"], item["left_out"]) == ("d3_s0.5_dir_up_r1", {NEGATIVE: 1})


@pytest.mark.parametrize("table", [False, True])
@pytest.mark.parametrize("fault", ["stale at the start", "stale at the end", "restart", "future"])
def test_lab_files_and_tables_leave_events_that_run_back_out(
    tmp_path: Path, fault: str, table: bool
) -> None:
    right = 100 + np.arange(COUNT) / 100
    t, count = {
        "stale at the start": (np.r_[right[:20] + 1000, right], 20),
        "stale at the end": (np.r_[right, right[:20] - 90], 20),
        "restart": (np.r_[right, right[:300]], 300),
        "future": (np.r_[right[:9], 1e6, right[9:]], 1),
    }[fault]
    if table:
        x, p = np.arange(len(t)) % 40, np.arange(len(t)) % 2
        rows = [f"{a!r},{b},{b % 30},{c}" for a, b, c in zip(t.tolist(), x, p, strict=True)]
        (tmp_path / "theirs").mkdir()
        (tmp_path / "theirs" / "a.csv").write_text("\n".join(["t,x,y,p", *rows]))
        columns = {key: key for key in "txyp"}
        events = {"format": "csv", "columns": columns, "unit": "s", "size_px": [40, 30]}
        adapter = {"adapter": 1, "name": "theirs", "experiment": "classes"}
        adapter |= {"trials": {"files": "*.csv"}, "labels": {"class": "slip"}}
        adapter["streams"] = {"events": events}
        (found,) = bring(adapter, tmp_path / "theirs", tmp_path / "s").recordings()
    else:
        _lab(tmp_path / "a.h5", t)
        found = _one(tmp_path / "s", tmp_path / "a.h5")
    np.testing.assert_array_equal(found.events().t_us, np.rint(right * 1e6))
    assert _dropped(found) == {BACK: count}


def test_lab_files_of_unknown_polarities_are_refused(tmp_path: Path) -> None:
    _lab(tmp_path / "a.h5", np.arange(COUNT) / 100, ps=1 + np.arange(COUNT) % 2)
    done = _line(tmp_path, tmp_path / "a.h5")
    assert done.returncode == 2
    assert f"events: 250 {UNKNOWN}" in done.stderr


@pytest.mark.usefixtures("small")
def test_names_of_the_labs_files_in_capitals_are_one_recording(tmp_path: Path) -> None:
    (tmp_path / "x").mkdir()
    _lab(tmp_path / "x" / "A_EVENTS_STREAM.H5", np.arange(COUNT) / 100)
    for polarity in ("ON", "OFF"):
        cells = lab_cells(SMALL, {(1, 1): [5.0]})
        (tmp_path / "x" / f"A_EVENTS_{polarity}.PKL").write_bytes(pickle.dumps(cells))
    assert [trial.name for trial in trials_in(tmp_path / "x", kind_of(tmp_path / "x"))] == ["A"]


def _folder(folder: Path) -> None:
    folder.mkdir()
    for name in ("a.h5", "c.h5", "e.h5"):
        _dsec(folder / name, np.arange(COUNT))
    (folder / "b.h5").write_bytes((folder / "a.h5").read_bytes()[:3000])
    (folder / "d.h5").touch()
    _aedat4(folder / "f.aedat4", np.arange(COUNT), np.arange(COUNT, 600))
    (folder / "g.aedat4").write_bytes((folder / "f.aedat4").read_bytes()[:-9])


def test_damaged_and_empty_files_of_a_folder_leave_the_others(tmp_path: Path) -> None:
    _folder(tmp_path / "theirs")
    done = _line(tmp_path, tmp_path / "theirs", "--json")
    assert done.returncode == 1
    result = json.loads(done.stdout)
    assert result["imported"] == ["a", "c", "e", "f"]
    assert [item["trial"] for item in result["failed"]] == ["b", "d", "g"]
    assert all(f"/{item['file']}: " in item["reason"] for item in result["failed"])
    assert "not imported: g: " in done.stderr
    assert "--salvage imports 500 events" in done.stderr
    assert verify(TrialStore.open(tmp_path / "store")) == []
    again = _line(tmp_path, tmp_path / "theirs")
    assert again.returncode == 1
    assert "not imported: b: " in again.stderr


def _faulty_lerobot(folder: Path, number: int) -> None:
    """Say a length of an episode that it has not."""
    path = folder / "meta/episodes/chunk-000/file-000.parquet"
    rows = pq.read_table(path).to_pylist()
    rows[number]["length"] = 3
    pq.write_table(pa.Table.from_pylist(rows), path)


@pytest.mark.parametrize("number", [0, 1])
def test_one_bad_episode_leaves_the_others(tmp_path: Path, number: int) -> None:
    foreign(tmp_path / "set")
    _faulty_lerobot(tmp_path / "set", number)
    store = TrialStore.create(tmp_path / "store")
    result = take(store, tmp_path / "set")
    assert result["imported"] == [f"episode-{1 - number:06d}"]
    (failed,) = result["failed"]
    assert failed["trial"] == f"episode-{number:06d}"
    assert f"rows of episode {number}, which has 3" in failed["reason"]


def _frames(path: Path, times: list[int], images: Any) -> None:
    streams = {
        0: Aedat4Stream("EVTS", "events", (40, 40), "camera"),
        1: Aedat4Stream("FRME", "frames", (8, 6), "camera"),
        2: Aedat4Stream("TRIG", "triggers", None, "camera"),
    }
    with Aedat4Writer(path, streams) as file:
        file.events(0, _events(np.arange(COUNT)))
        file.triggers(2, Triggers(np.array([10, 5, 20, 30]), np.ones(4, np.uint8)))
        for t_us, image in zip(times, images, strict=True):
            file.picture(1, image, t_us)


def test_frames_and_triggers_that_run_back_are_left_out(tmp_path: Path) -> None:
    images = [np.full((6, 8), level, np.uint8) for level in range(5)]
    images[3] = np.zeros((3, 4), np.uint8)
    _frames(tmp_path / "a.aedat4", [900, 100, 200, 300, 400], images)
    found = _one(tmp_path / "store", tmp_path / "a.aedat4")
    assert (found.frame_times() // 1000).tolist() == [100, 200, 400]
    assert [int(image[0, 0]) for image in found.frames()] == [1, 2, 4]
    assert _dropped(found) == {
        "frames of another size": 1,
        "frames whose times run back": 1,
        "triggers whose times run back": 1,
    }


def _csv(folder: Path, change: Callable[[list[str]], list[str]]) -> Path:
    path = folder / "rec" / "ann_0.6_0" / "events.csv"
    path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")
    return path


@pytest.mark.quick(2)
@pytest.mark.parametrize(
    "row", ["x,1,1,1", "0.5,1,1", "0.5,1,1,1,1,1", ",1,1,1", "nan,1,1,1", "0.5,,1,1"]
)
def test_a_bad_row_of_a_table_is_left_out(tmp_path: Path, row: str) -> None:
    slides(tmp_path / "set")
    _csv(tmp_path / "set", lambda lines: [*lines[:40], row, *lines[40:]])
    whole = bring(SLIDES, tmp_path / "set", tmp_path / "store").recording("ann_0.6_0")
    assert _dropped(whole) == {"events in rows that are not all numbers": 1}
    _csv(tmp_path / "set", lambda lines: [line for line in lines if line != row])
    found = bring(SLIDES, tmp_path / "set", tmp_path / "again").recording("ann_0.6_0")
    np.testing.assert_array_equal(found.events().t_us, whole.events().t_us)
    assert _dropped(found) == {}


def test_large_whole_numbers_beside_a_bad_row_stay_exact(tmp_path: Path) -> None:
    from sliplab.storage.formats.data_folder import DataFolder
    from sliplab.storage.formats.tables import read_columns

    (tmp_path / "a.csv").write_text("t,x\n1700000000000000001,1\n,2\n1700000000000000003,3\n")
    found, left_out = read_columns(DataFolder(tmp_path), "a.csv", "csv", {"t": "t", "x": "x"})
    assert (found["t"].tolist(), left_out) == ([1700000000000000001, 1700000000000000003], 1)


@pytest.mark.parametrize("blocks", [1, 2])
@pytest.mark.parametrize("cell", ["{}.0", " {}.5", "{}.0e0"])
def test_large_whole_numbers_beside_a_float_stay_exact(
    tmp_path: Path, monkeypatch: Any, blocks: int, cell: str
) -> None:
    from sliplab.storage.formats import tables
    from sliplab.storage.formats.data_folder import DataFolder

    monkeypatch.setattr(tables, "_BLOCK_BYTES", 1 << 21 if blocks == 1 else 200)
    times = 1_700_000_000_123_456_789 + 1_000_001 * np.arange(100)
    rows = [f"{t},{t}" for t in times]
    rows[90] = f"{cell.format(times[90])},1.5"
    (tmp_path / "a.csv").write_text("t,x\n" + "\n".join(rows))
    found, _ = tables.read_columns(DataFolder(tmp_path), "a.csv", "csv", {"t": "t", "x": "x"})
    assert found["x"][[89, 90]].tolist() == [times[89], 1.5]
    times[90] += cell == " {}.5"
    found = tables.times_ns(found["t"], "ns")
    np.testing.assert_array_equal(np.delete(found, 90), np.delete(times, 90))
    assert abs(found[90] - times[90]) <= 1  # halves may be rounded either way


@pytest.mark.parametrize("fault", ["column", "label"])
def test_one_trial_with_a_fault_leaves_the_others(tmp_path: Path, fault: str) -> None:
    slides(tmp_path / "set")
    table = pd.read_csv(tmp_path / "set" / "onsets.csv")
    bad, reason = table["trial"][0], "lies outside of the recording"
    if fault == "label":
        table.loc[0, "full"] = 10**6
        table.to_csv(tmp_path / "set" / "onsets.csv", index=False)
    else:
        bad, reason = "ann_0.6_0", "has no column polarity"
        _csv(tmp_path / "set", lambda lines: [line.replace("polarity", "sign") for line in lines])
    (tmp_path / "a.yaml").write_text(json.dumps(SLIDES))
    line = ("import", "--adapter", tmp_path / "a.yaml", tmp_path / "set")
    done = here(*line, "--store", tmp_path / "store", "--json")
    assert done.returncode == 1
    result = json.loads(done.stdout)
    (failed,) = result["failed"]
    assert failed["trial"] == bad
    assert reason in failed["reason"]
    assert len(result["imported"]) == sum(result["split"].values()) == 3
    done = here(*line, "--store", tmp_path / "store", "--json")
    again = json.loads(done.stdout)
    assert (again["there"], again["split"]) == (result["imported"], result["split"])


@pytest.mark.parametrize("change", [-2, 1])
def test_a_video_and_its_times_of_different_lengths_are_paired(tmp_path: Path, change: int) -> None:
    slides(tmp_path / "set")
    path = tmp_path / "set" / "rec" / "ann_0.6_0" / "img" / "t.npy"
    times = np.load(path)
    count = len(times)
    np.save(path, times[:change] if change < 0 else np.r_[times, times[-1] + 10])
    found = bring(SLIDES, tmp_path / "set", tmp_path / "store").recording("ann_0.6_0")
    assert len(found.frame_times()) == min(count, count + change)
    text = f"holds {count} frames, and {count + change} times of frames"
    assert any(text in each for each in found.record.imported.warnings)


def test_samples_without_a_number_or_order_are_left_out(tmp_path: Path) -> None:
    slides(tmp_path / "set")
    path = tmp_path / "set" / "rec" / "ann_0.6_0" / "force.npz"
    with np.load(path) as file:
        arrays = {name: file[name].astype(float) for name in file.files}
    count = len(arrays["t"])
    arrays = {name: np.tile(values, 3) for name, values in arrays.items()}
    arrays["t"] = np.arange(3.0 * count) * 1000
    arrays["x"][2], arrays["t"][0], arrays["t"][3] = np.nan, 1e9, np.nan
    np.savez(path, **arrays)
    found = bring(SLIDES, tmp_path / "set", tmp_path / "store").recording("ann_0.6_0")
    assert len(found.wrenches("force")) == 3 * count - 3
    assert _dropped(found) == {
        "rows of force without a valid time": 1,
        "rows of force with a value that is not a number": 1,
        "rows of force whose times run back": 1,
    }


def test_single_precision_unix_times_fail_their_gates(tmp_path: Path) -> None:
    _lab(tmp_path / "a.h5", (1.7e9 + NUMBER[:50] / 25).astype(np.float32))
    done = _line(tmp_path, tmp_path / "a.h5")
    assert done.returncode == 0
    assert "the times of events have steps of 1.28e+08 us" in done.stderr
    assert "all 50 events have one time" in done.stderr
    store = TrialStore.open(tmp_path / "store")
    (found,) = store.campaign("theirs").recordings()
    assert not found.record.quality.passed
    assert set(found.record.quality.gates) == {"events_time_resolution_us", "events_times"}
    assert catalogue(store)["passed"].tolist() == [False]
    checked = here("verify", tmp_path / "store")
    assert checked.returncode == 0
    assert "theirs/a: does not pass events_time_resolution_us, events_times" in checked.stderr


LEVELS = [np.full((6, 8), level, np.uint8) for level in range(4)]
FEW, DISTINCT = 5000, {"events_distinct_times"}
# name, how it is written, its times, what else is written, and the gates that it fails
GATES: dict[str, tuple[str, Any, Any, Any, set[str]]] = {
    "microseconds as seconds": ("a.h5", _lab, TIMES, {}, {"events_time_resolution_us"}),
    "near zero": ("a.h5", _lab, (NUMBER[:50] / 25).astype(np.float32), {}, set()),
    "another unit": ("a.h5", _dsec, NUMBER // 300, {}, {"events_rate"}),
    **{
        f"{times} times": ("a.h5", _lab, np.arange(FEW) * times // FEW * 128.0, {}, gates)
        for times, gates in ((2, DISTINCT), (5, DISTINCT), (6, set()))
    },
    "frames": ("a.aedat4", _frames, [100, 200, 300, 400], {"images": LEVELS}, set()),
    "one frame": (
        "a.aedat4",
        _frames,
        [100, 200, 300, 400],
        {"images": LEVELS[:1] * 4},
        {"frames_change"},
    ),
    "one time": ("a.aedat4", _frames, [100] * 4, {"images": LEVELS}, {"frames_times"}),
}


@pytest.mark.quick(3)
@pytest.mark.parametrize("case", GATES)
def test_times_and_frames_that_cannot_be_meant_fail_their_gate(tmp_path: Path, case: str) -> None:
    name, write, times, more, gates = GATES[case]
    write(tmp_path / name, times, **more)
    found = _one(tmp_path / "store", tmp_path / name)
    assert set(found.record.quality.gates) == gates
    assert found.record.quality.passed == (not gates)
    assert bool(verify_store(str(tmp_path / "store")).get("failed_gates")) == bool(gates)


def test_trials_that_fail_their_gates_are_in_no_part_of_a_split(tmp_path: Path) -> None:
    slides(tmp_path / "set")
    folder = tmp_path / "set" / "rec" / "ann_0.6_0" / "img"
    first = cv2.imread(str(sorted(folder.glob("*.png"))[0]))
    for path in folder.glob("*.png"):
        cv2.imwrite(str(path), first)
    campaign = bring(SLIDES, tmp_path / "set", tmp_path / "store")
    assert "ann_0.6_0" in campaign.committed()
    assert "ann_0.6_0" not in {trial.id for trial, _ in Collected(campaign).trials}


def _left_open(path: Path, *, swmr: bool) -> None:
    """Write a file in a process that dies with the file open."""
    code = f"""
import os, h5py, numpy as np
file = h5py.File({str(path)!r}, "w", libver="latest")
for name, values in dict(x=np.arange(500) % 40, y=np.arange(500) % 40, p=np.arange(500) % 2,
                         t=np.arange(500) * 10).items():
    file.create_dataset(f"events/{{name}}", data=values, chunks=(100,), maxshape=(None,))
if {swmr}:
    file.swmr_mode = True
else:
    file.close()
    file = h5py.File({str(path)!r}, "r+", libver="latest")
    file.attrs["more"] = 1
file.flush()
os._exit(1)
"""
    subprocess.run([sys.executable, "-c", code], check=False)


@pytest.mark.parametrize("swmr", [True, False])
def test_a_file_that_its_writer_left_open_is_read(tmp_path: Path, swmr: bool) -> None:
    _left_open(tmp_path / "a.h5", swmr=swmr)
    found = _one(tmp_path / "store", tmp_path / "a.h5")
    np.testing.assert_array_equal(found.events().t_us, np.arange(500) * 10)
    assert "was left open by its writer" in found.record.imported.warnings[0]


def test_names_in_any_script_stay_apart_and_are_in_the_record(tmp_path: Path) -> None:
    folder = tmp_path / "theirs"
    folder.mkdir()
    stems = ["测试", "テスト", "Проба 1", "Проба 2"]
    stems += ["e\u0301", "\u00e9", "TRIAL", "trial", "a b", "a:b"]
    for stem in stems:
        _dsec(folder / f"{stem}.h5", np.arange(COUNT))
    store = TrialStore.create(tmp_path / "store")
    result = take(store, folder)
    names = result["imported"]
    assert len({name.casefold() for name in names}) == len(stems)
    assert all(name.isascii() for name in names)
    records = [one.record for one in store.campaign("theirs").recordings()]
    files = {record.imported.source: record.trial for record in records if record.imported}
    assert set(files) == {f"{stem}.h5" for stem in stems}
    assert files["测试.h5"].startswith("Ce_Shi-")
    assert files["Проба 1.h5"].startswith("Proba_1-")
    assert files["trial.h5"] == "trial"
    assert take(store, folder)["imported"] == []


@pytest.mark.parametrize("name", ["a" * 251, "ü" * 125, "con", "trial.", "...", "\udcff"])
def test_names_that_no_file_system_has_are_changed(name: str) -> None:
    made = name_of(name)
    assert len(made) <= 200
    safe_name(made)
    assert made.lower() not in {"con", "trial."}
    assert not made.endswith(".")


@pytest.mark.parametrize("kind", [(), ("raw",)])
def test_a_pipe_is_no_recording(tmp_path: Path, kind: tuple[str, ...]) -> None:
    os.mkfifo(tmp_path / "a.raw")
    done = here("import", *kind, tmp_path / "a.raw", "--store", tmp_path / "s", "--name", "x")
    assert done.returncode == 2
    assert "a.raw: is neither a file nor a folder" in done.stderr
