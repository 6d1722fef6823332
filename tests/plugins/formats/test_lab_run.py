"""Folders of the lab's scripts: one trial a recording, with all that its run left of it."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from sliplab.storage.formats.recognition import kind_of, skipped_in
from sliplab.storage.trials.recording import Recording
from tests.patching import loose
from tests.plugins.adapters.adapter_streams import some_frames, write_frames
from tests.storage.formats.files import SMALL, lab_cells, taken

pytestmark = pytest.mark.usefixtures("small")
STEM = "d2_s1.0_dir_up_r3"
UNIX = 1_714_561_200
ON = {(3, 5): [10, 12], (0, 1): [11]}
OFF = {(3, 5): [13], (1, 1): [14, 15, 16]}


def _run(folder: Path) -> Path:
    """Make a run's folder; return that of its events."""
    events = folder / "events"
    events.mkdir(parents=True)
    (folder / "videos").mkdir()
    meta = {"slide_speeds": [1.0], "tip": "IncUndExt_v1"}
    (folder / "meta.json").write_text(json.dumps(meta))
    return events


def _pickle(path: Path, places: Any) -> None:
    path.write_bytes(pickle.dumps(lab_cells(SMALL, places)))


def _stream(path: Path) -> None:
    rows = [
        (t, x, y, p)
        for p, places in ((1, ON), (0, OFF))
        for (y, x), times in places.items()
        for t in times
    ]
    t, x, y, p = np.array(rows).T
    with h5py.File(path, "w") as file:
        file["events/ts"] = UNIX + t / 1000
        file["events/xs"], file["events/ys"], file["events/ps"] = x, y, p.astype(bool)


def _warnings(found: Recording) -> tuple[str, ...]:
    assert found.record.imported is not None
    return found.record.imported.warnings


@pytest.mark.parametrize("ending", ["", ".h5"])
@pytest.mark.parametrize("place", [".", "events"])
def test_pickles_and_stream_of_one_recording_are_one_trial(
    tmp_path: Path, ending: str, place: str
) -> None:
    run = tmp_path / "run"
    events = _run(run)
    _pickle(events / f"{STEM}_events_on", ON)
    _pickle(events / f"{STEM}_events_off", OFF)
    _stream(events / f"{STEM}_events_stream{ending}")
    _, (found,) = taken(tmp_path / "store", run / place)
    assert found.trial_id == STEM
    assert found.record.condition == {"depth": "2", "speed": "1.0", "direction": "up"}
    assert found.record.repetition == 3
    assert (found.events().p.tolist(), found.events().t_us[0]) == (
        [1, 1, 1, 0, 0, 0, 0],
        UNIX * 10**6 + 10_000,
    )
    assert _warnings(found) == ()
    assert loose(found.record.imported).meta["tip"] == "IncUndExt_v1"
    assert skipped_in(run / place, kind_of(run / place)) == []


def test_off_events_in_the_file_of_the_on_events_are_noted(tmp_path: Path) -> None:
    events = _run(tmp_path / "run")
    cells = lab_cells(SMALL, OFF)
    np.save(events / f"{STEM}_events_on", cells, allow_pickle=True)
    _stream(events / f"{STEM}_events_stream")
    _, (found,) = taken(tmp_path / "store", tmp_path / "run")
    assert len(found.events()) == 7
    (text,) = _warnings(found)
    assert text.startswith(f"{STEM}_events_on.npy holds the OFF events of {STEM}_events_stream")


def test_polarity_of_an_overwritten_file_alone_is_unknown(tmp_path: Path) -> None:
    events = _run(tmp_path / "run")
    np.save(events / f"{STEM}_events_on", lab_cells(SMALL, OFF), allow_pickle=True)
    result, (found,) = taken(tmp_path / "store", tmp_path / "run")
    assert "polarity" in loose(found.record.imported).unknown
    assert "may hold the OFF events" in _warnings(found)[0]
    assert result["warnings"]


@pytest.mark.parametrize(("value", "noted"), [(False, True), (True, False)])
def test_a_column_of_polarities_counts_more_than_the_name(
    tmp_path: Path, value: bool, noted: bool
) -> None:
    path = tmp_path / "a_events_on.h5"
    _stream(path)
    with h5py.File(path, "r+") as file:
        file["events/ps"][:] = value
    _, (found,) = taken(tmp_path / "store", path)
    assert set(found.events().p.tolist()) == {int(value)}
    assert any("although its name says ON" in text for text in _warnings(found)) == noted


@pytest.mark.parametrize("name", [f"{STEM}_events_stream", f"{STEM}_events_stream.h5"])
@pytest.mark.parametrize("data", [b"", b"garbage"])
def test_a_stream_without_a_header_leaves_the_pickles(
    tmp_path: Path, name: str, data: bytes
) -> None:
    """It may be the only one of the folder, so that no file says what format it is."""
    _pickle(tmp_path / f"{STEM}_events_on", ON)
    _pickle(tmp_path / f"{STEM}_events_off", OFF)
    (tmp_path / name).write_bytes(data)
    _, (found,) = taken(tmp_path / "store", tmp_path)
    assert len(found.events()) == 7
    assert f"{name} is not imported" in _warnings(found)[0]


def test_a_damaged_stream_leaves_the_pickles(tmp_path: Path) -> None:
    events = _run(tmp_path / "run")
    _pickle(events / f"{STEM}_events_on", ON)
    _pickle(events / f"{STEM}_events_off", OFF)
    (events / f"{STEM}_events_stream.h5").write_bytes(b"")
    _, (found,) = taken(tmp_path / "store", tmp_path / "run")
    assert len(found.events()) == 7
    assert f"{STEM}_events_stream.h5 is not imported" in _warnings(found)[0]


def test_two_files_of_one_polarity_leave_the_other_recordings(tmp_path: Path) -> None:
    events = _run(tmp_path / "run")
    for name in ("a_events_on", "a_events_on.pickle", "b_events_on"):
        _pickle(events / name, ON)
    result, (found,) = taken(tmp_path / "store", tmp_path / "run")
    assert found.trial_id == "b"
    assert "keep one of the two" in result["failed"][0]["reason"]


def test_pickles_without_a_polarity_are_read_with_a_warning(tmp_path: Path) -> None:
    folder = tmp_path / "eDVS"
    folder.mkdir()
    _pickle(folder / "SingleTap_run_0_orientation_0.pickle", ON)
    (folder / "targets_video.csv").write_text("id,pose\n1,0\n")
    _, (found,) = taken(tmp_path / "store", folder)
    assert (found.trial_id, len(found.events())) == ("SingleTap_run_0_orientation_0", 3)
    assert "does not say whether its events are ON or OFF" in _warnings(found)[0]


def _with_video(run: Path, times: list[float]) -> None:
    write_frames(run / "videos", "video", some_frames(4))
    (run / "videos" / "film.mkv").rename(run / "videos" / f"tactip_out_{STEM}.mkv")
    (run / "timestamps_tactip_out.pkl").write_bytes(pickle.dumps({f"tactip_out_{STEM}": times}))


@pytest.mark.parametrize(("times", "count"), [(4, 4), (5, 4), (3, 3)])
def test_outside_video_has_its_times(tmp_path: Path, times: int, count: int) -> None:
    run = tmp_path / "run"
    _pickle(_run(run) / f"{STEM}_events_on", ON)
    _with_video(run, [UNIX + k / 60 for k in range(times)])
    _, (found,) = taken(tmp_path / "store", run)
    expected = [round((UNIX + k / 60) * 1e6) * 1000 for k in range(count)]
    assert found.frame_times().tolist() == expected
    assert len(list(found.frames())) == count
    assert any("paired from the first one on" in text for text in _warnings(found)) == (times != 4)
    assert "clock of frames" in loose(found.record.imported).unknown


def test_unreadable_video_times_and_meta_leave_the_events(tmp_path: Path) -> None:
    run = tmp_path / "run"
    _pickle(_run(run) / f"{STEM}_events_on", ON)
    _with_video(run, [UNIX + k / 60 for k in range(4)])
    (run / "videos" / f"tactip_out_{STEM}.mkv").write_bytes(b"\0\0\0\x20ftypisom")
    (run / "videos" / f"event_stream_{STEM}.mp4").write_bytes(b"")
    (run / "meta.json").write_text("{")
    _, (found,) = taken(tmp_path / "store", run)
    assert (len(found.events()), found.record.counts.frames) == (3, 0)
    texts = " ".join(_warnings(found))
    assert "meta.json is not read" in texts
    assert f"tactip_out_{STEM}.mkv is no video that can be read" in texts
    assert loose(found.record.imported).left_out == [f"event_stream_{STEM}.mp4"]
    (run / "timestamps_tactip_out.pkl").write_bytes(b"cos\nsystem\n(V/nowhere\ntR.")
    (tmp_path / "again").mkdir()
    _, (again,) = taken(tmp_path / "again" / "store", run)
    assert "timestamps_tactip_out.pkl is not read" in " ".join(_warnings(again))


@pytest.mark.parametrize("form", ["csv", "npy", "pickle"])
def test_force_file_becomes_a_stream(tmp_path: Path, form: str) -> None:
    run = tmp_path / "run"
    _pickle(_run(run) / f"{STEM}_events_on", ON)
    rows = np.array([[0.0, 1, 2, 3], [0.001, 4, 5, 6], [0.002, 7, 8, np.nan]])
    path = run / f"{STEM}_force.{form}"
    if form == "csv":
        path.write_text(
            "Time (s),Fx (N),Fy (N),Fz (N)\n"
            + "\n".join(",".join(map(str, row)) for row in rows.tolist())
            + "\n"
        )
    elif form == "npy":
        np.save(path, rows)
    else:
        columns = dict(zip(("t", "fx", "fy", "fz"), rows.T.tolist(), strict=True))
        path.write_bytes(pickle.dumps(columns))
    _, (found,) = taken(tmp_path / "store", run)
    forces = found.wrenches("force")
    assert forces.t_ns.tolist() == [0, 1_000_000]
    assert forces.force_n.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert loose(found.record.imported).dropped == {
        "rows of force with a value that is not a number": 1
    }
