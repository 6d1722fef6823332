"""Foreign files known by their content: names without endings, sizes, nothing in them."""

from __future__ import annotations

import io
import json
import pickle
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from sliplab.protocols.errors import InputError
from sliplab.storage.formats.aedat4 import Aedat4Stream, Aedat4Writer
from sliplab.storage.formats.foreign import EXPORT_MANIFEST
from sliplab.storage.formats.recognition import MIXED, kind_of, skipped_in
from sliplab.storage.streams import EventChunk
from sliplab.storage.trials.store import TrialStore
from tests.command_line import here
from tests.storage.formats.files import SMALL, lab_cells, lab_hdf5, taken

SIZE = SMALL[::-1]


def _pickled(path: Path, cells: Any) -> None:
    path.write_bytes(pickle.dumps(cells))


def _saved(path: Path, cells: Any) -> None:
    with path.open("wb") as file:
        np.save(file, cells, allow_pickle=True)


@pytest.mark.parametrize(
    ("name", "stem", "write"),
    [
        ("d2_s1.0_dir_right_r0_events_{}", "d2_s1.0_dir_right_r0", _pickled),
        ("taps_trial_0_pose_3_events_{}", "taps_trial_0_pose_3", _pickled),
        ("20-7.5-4-1_{}.pickle", "20-7.5-4-1", _pickled),
        ("4-1_{}", "4-1", _pickled),
        ("Wool_trial_2_{}.npy", "Wool_trial_2", _saved),
        ("d2_s1.0_dir_right_r0_events_{}.npy", "d2_s1.0_dir_right_r0", _saved),
        ("d2_s1.0_dir_right_r0_events_{}", "d2_s1.0_dir_right_r0", _saved),
    ],
)
@pytest.mark.usefixtures("small")
def test_the_labs_names_with_and_without_ending(
    tmp_path: Path, name: str, stem: str, write: Callable[[Path, Any], None]
) -> None:
    folder = tmp_path / "theirs"
    folder.mkdir()
    write(folder / name.format("on"), lab_cells(SIZE, {(3, 5): [10, 12]}))
    write(folder / name.format("off"), lab_cells(SIZE, {(7, 0): [11]}).T)
    (folder / "light_on").write_text("a note")
    (folder / "starting_timestamps.pickle").write_bytes(pickle.dumps([1, 2]))
    _, (found,) = taken(tmp_path / "store", folder)
    assert found.trial_id == stem
    events = found.events()
    assert events.t_us.tolist() == [10_000, 11_000, 12_000]
    assert (events.x.tolist(), events.y.tolist()) == ([3, 7, 3], [5, 0, 5])
    assert events.p.tolist() == [1, 0, 1]
    assert found.record.geometry.event_px == SIZE
    assert "OFF events" not in found.record.imported.unknown
    if stem.startswith("d2"):
        assert found.record.condition == {"depth": "2", "speed": "1.0", "direction": "right"}


def test_cameras_of_the_lab_and_lists_of_one_length(tmp_path: Path) -> None:
    """A smaller camera columns first; numpy makes lists of one length an array of numbers."""
    folder = tmp_path / "theirs"
    folder.mkdir()
    on = np.zeros((240, 180, 1))
    on[7, 100] = 3.5
    _saved(folder / "a_events_on.npy", on)
    _pickled(folder / "a_events_off", lab_cells((180, 240), {(2, 1): [1.0]}))
    _, (found,) = taken(tmp_path / "store", folder)
    events = found.events()
    assert len(events) == 240 * 180 + 1
    late = np.flatnonzero(events.t_us == 3500)
    assert [events.x[late].tolist(), events.y[late].tolist()] == [[7], [100]]
    off = np.flatnonzero(events.p == 0)
    assert [events.x[off].tolist(), events.y[off].tolist()] == [[1], [2]]
    assert found.record.geometry.event_px == (240, 180)


@pytest.mark.usefixtures("small")
def test_two_files_of_one_polarity_cost_their_recording_alone(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    for name in ("a_events_on", "a_events_on.pickle", "b_events_on"):
        _pickled(tmp_path / "run" / name, lab_cells(SIZE, {(1, 2): [3.0]}))
    done = here("import", tmp_path / "run", "--store", tmp_path / "store", "--name", "x", "--json")
    assert done.returncode == 1
    found = json.loads(done.stdout)
    assert found["imported"] == ["b"]
    assert "ON events of a, as a_events_on does" in str(found["failed"])


def _aedat4(path: Path, chunk: EventChunk) -> None:
    with Aedat4Writer(path, {0: Aedat4Stream("EVTS", "e", (64, 48), "x")}) as file:
        file.events(0, chunk)


def _events(x: list[int]) -> EventChunk:
    column = np.array(x, np.uint16)
    return EventChunk(column, column // 2, column.astype(np.uint8) % 2, np.arange(len(x)))


@pytest.mark.parametrize("ending", ["", ".bin", ".raw"])
def test_content_comes_before_the_ending(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"d2_s1.0_stream{ending}"
    _aedat4(path, _events([3, 4]))
    _, (found,) = taken(tmp_path / "a", path)
    assert found.events().x.tolist() == [3, 4]
    if not ending:
        assert found.trial_id == "d2_s1.0_stream"
    lab_hdf5(path)
    assert kind_of(path) == "lab-hdf5"
    _, (found,) = taken(tmp_path / "b", path)
    assert len(found.events()) == 50


def _stream(path: Path, resolution: Any, x: list[int], y: list[int]) -> None:
    """As the lab's own program writes it: truth values, 16-bit pixels, attributes."""
    with h5py.File(path, "w") as file:
        file["events/ps"] = np.array([True, False])
        file["events/ts"] = np.array([1_700_000_000.25, 1_700_000_000.5])
        file["events/xs"], file["events/ys"] = np.array(x, "int16"), np.array(y, "int16")
        file.attrs["t0"], file.attrs["num_events"] = 1_700_000_000.0, 2
        file.attrs["sensor_resolution"] = resolution


def _dsec(path: Path, count: int) -> None:
    with h5py.File(path, "w") as file:
        for name in "xypt":
            file[f"events/{name}"] = np.arange(count)


@pytest.mark.parametrize(
    ("resolution", "x", "y", "size"),
    [
        (np.array([640, 480]), [1, 639], [2, 479], [640, 480]),
        (np.array([180, 240]), [1, 239], [2, 179], [240, 180]),  # rows first, as others write it
        (np.array([180, 240, 3]), [1, 9], [2, 9], [240, 180]),
        (np.array([480, 640]), [1, 2], [2, 500], [480, 640]),  # a sensor that stands upright
        (np.array([[640, 480]]), [1, 2], [2, 3], None),
        ("640x480", [1, 2], [2, 3], None),
        (np.zeros(1000, int), [1, 2], [2, 3], None),
        (np.array([0, -1]), [1, 2], [2, 3], None),
    ],
)
def test_the_resolution_of_the_labs_streams(
    tmp_path: Path, resolution: Any, x: list[int], y: list[int], size: list[int] | None
) -> None:
    _stream(tmp_path / "a.h5", resolution, x, y)
    _, (found,) = taken(tmp_path / "store", tmp_path / "a.h5")
    assert found.record.geometry.event_px == (None if size is None else tuple(size))
    assert ("sensor size" in found.record.imported.unknown) == (size is None)
    events = found.events()
    assert [events.p.tolist(), events.x.tolist(), events.y.tolist()] == [[1, 0], x, y]


def _es(path: Path) -> None:
    """Of a sensor of 320 x 16, with an event in row 200."""
    path.write_bytes(b"Event Stream\2\0\0\1\x40\1\x10\0" + bytes([7, 1, 0, 200, 0]))


def _raw(path: Path, header: str = "% evt 2.0\n", words: tuple[int, ...] = ()) -> None:
    path.write_bytes(header.encode() + struct.pack(f"<{len(words)}I", *words))


def _npy(cells: Any) -> bytes:
    file = io.BytesIO()
    np.save(file, cells, allow_pickle=True)
    return file.getvalue()


NAME = "d2_s1.0_dir_right_r0_events_on"
NOTHING, PAIRS = lab_cells(SIZE, {}), _npy(np.zeros((6, 8, 2)))
OTHER = _npy(NOTHING).split(b"\n")[0] + b"\n" + pickle.dumps([1])
WHOLE = r"byte \d+: is no whole pickle: it ends after \d+ bytes .* as a copy cut short; .*dump"
BEYOND = r"a\.\w+: events: 1 up to column 64 and row {}, outside of the 64 x 48 pixels"
# the file, its bytes or how it is written, and what is said of it
BAD: list[tuple[str, bytes | Callable[[Path], object], str]] = [
    ("a.aedat4", lambda path: _aedat4(path, _events([])), "contains no events"),
    ("a.h5", lambda path: _dsec(path, 0), "contains no events"),
    (NAME, pickle.dumps(NOTHING), "contains no events"),
    ("a.aedat4", lambda path: _aedat4(path, _events([3, 64])), BEYOND.format(32)),
    ("a.h5", lambda path: _stream(path, [64, 48], [3, 64], [3, 64]), BEYOND.format(64)),
    (NAME, b"not events", f"{NAME}: byte 0: is no whole pickle"),
    (NAME, b"", "the file is empty"),
    (NAME, pickle.dumps(NOTHING)[:-1], WHOLE),
    ("a_on.npy", PAIRS[:-3], r"a_on\.npy: is truncated"),
    ("a_on.npy", PAIRS.replace(b"8, 2), ", b"8, 9**9)"), r"a_on\.npy: has a damaged numpy header"),
    ("a_on.npy", PAIRS.replace(b"2), }", b"2 , }"), r"a_on\.npy: has a damaged numpy header"),
    (
        "a_on.npy",
        lambda path: _saved(path, np.zeros((6, 8, 420_000), np.uint8)),
        r"a_on\.npy: holds 20160000 times, the same number for every pixel",
    ),
    ("a_on.npy", OTHER, r"a_on\.npy: contains data other than the array \(8, 6\)"),
    ("a_on.npy", _npy(np.zeros((39, 2, 250))), r"shape \(39, 2, 250\); the lab's"),
    (NAME, pickle.dumps(lab_cells((5, 5), {})), r"shape \(5, 5\); the lab's files hold"),
    ("a.raw", f"% evt 2.0\n% {'x' * 47}\n".encode(), "contains no events"),
    ("a.raw", b"% date today\n", "gives no format: a .raw file"),
    ("a.dat", b"not events", "gives no format"),
]


@pytest.mark.parametrize(("file", "data", "says"), BAD)
@pytest.mark.usefixtures("small")
def test_a_bad_file_is_named_with_what_would_be_right(
    tmp_path: Path, file: str, data: Any, says: str
) -> None:
    if isinstance(data, bytes):
        (tmp_path / file).write_bytes(data)
    else:
        data(tmp_path / file)
    with pytest.raises(InputError, match=says) as caught:
        taken(tmp_path / "store", tmp_path / file)
    assert caught.value.message.count(file) == 1
    assert TrialStore.open(tmp_path / "store").campaigns() == []


def test_a_bad_file_of_faerys(tmp_path: Path) -> None:
    pytest.importorskip("faery")
    _es(tmp_path / "a.es")
    says = r"after 0 events faery stops with: y overflow .*outside of the 320 x 16"
    with pytest.raises(InputError, match=says) as caught:
        taken(tmp_path / "store", tmp_path / "a.es")
    assert caught.value.message.count("a.es") == 1


EVT2 = (0x80000001, 1 << 28 | 2 << 22 | 5 << 11 | 7, 3 << 22 | 1500 << 11 | 1400)
"""Time 64 us and on: an ON event at column 5, row 7, and an OFF one at column 1500, row 1400."""


@pytest.mark.parametrize(
    ("header", "size"), [("", None), ("% format EVT2;width=1600;height=1500\n", [1600, 1500])]
)
def test_a_size_that_no_header_gives_is_unknown(tmp_path: Path, header: str, size: Any) -> None:
    _raw(tmp_path / "a", f"% evt 2.0\n{header}", EVT2)
    _, (found,) = taken(tmp_path / "store", tmp_path / "a")
    assert found.record.geometry.event_px == (None if size is None else tuple(size))
    assert ("sensor size" in found.record.imported.unknown) == (size is None)
    events = found.events()
    assert [events.x.tolist(), events.y.tolist()] == [[5, 1500], [7, 1400]]


def _mixed(folder: Path) -> None:
    """One recording of each kind, and what is none."""
    folder.mkdir()
    _aedat4(folder / "b.aedat4", _events([3, 4]))
    lab_hdf5(folder / "a.h5")
    _dsec(folder / "d.hdf5", 2)
    _pickled(folder / "c_events_on", lab_cells(SIZE, {(3, 5): [10, 12]}))
    (folder / "notes.txt").write_text("a note")
    (folder / "video_on").write_text("a note")
    (folder / "more").mkdir()
    (folder / "link.h5").symlink_to(folder / "a.h5")


@pytest.mark.usefixtures("small")
def test_a_folder_of_several_formats_is_sorted(tmp_path: Path) -> None:
    folder = tmp_path / "theirs"
    _mixed(folder)
    _, found = taken(tmp_path / "store", folder)
    origins = {one.trial_id: one.record.imported.format for one in found}
    assert origins == {"a": "lab-hdf5", "b": "aedat4", "c": "lab-pickles", "d": "dsec"}
    assert [len(one.events()) for one in found] == [50, 2, 2, 2]
    skipped = {item.file: item.reason for item in skipped_in(folder, kind_of(folder))}
    assert list(skipped) == ["link.h5", "more", "notes.txt", "video_on"]
    assert skipped["link.h5"] == "is a link"
    assert skipped["more"] == "is a folder; import it by itself"
    assert skipped["notes.txt"].startswith("is of no known format (aedat4, dsec, ")
    others = {item.file: item.reason for item in skipped_in(folder, "aedat4")}
    assert others["a.h5"] == "is no aedat4 file"
    assert "b.aedat4" not in others


def test_two_formats_of_one_name_are_left_out_and_the_rest_is_imported(tmp_path: Path) -> None:
    """They are mostly one recording, which must not count twice."""
    folder = tmp_path / "theirs"
    folder.mkdir()
    _aedat4(folder / "a.aedat4", _events([3, 4]))
    for name in ("b.aedat4", "b.h5"):
        (lab_hdf5 if name == "b.h5" else lambda path: _aedat4(path, _events([3])))(folder / name)
    done = here("import", folder, "--store", tmp_path / "store", "--name", "theirs")
    assert done.returncode == 1
    assert "holds 2 files for the trial b: b.aedat4, b.h5; " in " ".join(done.stderr.split())
    campaign = TrialStore.open(tmp_path / "store").campaign("theirs")
    assert [one.trial_id for one in campaign.recordings()] == ["a"]
    assert [one.trial_id for one in taken(tmp_path / "s", folder, "aedat4")[1]] == ["a", "b"]


def test_two_files_of_one_name_and_nothing_else_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "theirs"
    folder.mkdir()
    _aedat4(folder / "b.aedat4", _events([3]))
    lab_hdf5(folder / "b.h5")
    with pytest.raises(InputError, match=r"2 files for the trial b: b\.aedat4, b\.h5; .*KIND"):
        taken(tmp_path / "store", folder)
    assert TrialStore.open(tmp_path / "store").campaigns() == []


def test_a_missing_library_is_said_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sliplab.plugins.formats.event_stream.LIBRARY", "no_such_library")
    folder = tmp_path / "theirs"
    folder.mkdir()
    _aedat4(folder / "a.aedat4", _events([3, 4]))
    _raw(folder / "b.raw", words=EVT2)
    _es(folder / "c.es")
    with pytest.raises(InputError, match=r"c\.es: .*pip install 'sliplab\[formats\]'"):
        taken(tmp_path / "store", folder)
    assert TrialStore.open(tmp_path / "store").campaigns() == []
    (folder / "c.es").unlink()
    assert [one.trial_id for one in taken(tmp_path / "other", folder)[1]] == ["a", "b"]


def test_an_export_among_other_files_is_imported_by_its_manifest(tmp_path: Path) -> None:
    folder = tmp_path / "theirs"
    folder.mkdir()
    _aedat4(folder / "a.aedat4", _events([3, 4]))
    lab_hdf5(folder / "b.h5")
    item = {"trial": "t", "file": "a.aedat4", "condition": {}, "events": 2}
    item |= dict.fromkeys(("frames", "triggers", "repetition"), 0)
    manifest = {"sliplab_export": 1, "simulated": True, "trials": [item]}
    (folder / EXPORT_MANIFEST).write_text(json.dumps(manifest))
    assert kind_of(folder) == MIXED
    _, (found,) = taken(tmp_path / "store", folder)
    assert (found.trial_id, found.simulated, len(found.events())) == ("t", True, 2)
    assert [(one.file, one.reason) for one in skipped_in(folder, MIXED)] == [
        ("b.h5", f"is not in {EXPORT_MANIFEST}")
    ]
    item["file"] = "notes.txt"
    (folder / "notes.txt").write_text("a note")
    (folder / EXPORT_MANIFEST).write_text(json.dumps(manifest))
    with pytest.raises(InputError, match=r"notes\.txt: is of no known format"):
        taken(tmp_path / "again", folder)
