"""Streams of further cameras and small sensors: files of their own, checked as the first ones'."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.flows.api import Trial, open_store
from sliplab.storage.errors import StoreError
from sliplab.storage.remote.mirror import CACHE, open_mirror
from sliplab.storage.remote.objects import Remote
from sliplab.storage.remote.push import push
from sliplab.storage.schema.trial import Provenance, TrialRecord
from sliplab.storage.streams import ClockReads, PulseChunk, ScalarChunk, WrenchChunk
from sliplab.storage.trials.hdf5_reader import StreamReader
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify
from sliplab.storage.trials.writer import TrialWriter
from tests.storage.trial_files import (
    FRAME,
    IDENTITY,
    campaign,
    commit,
    events,
    fill,
    frames,
    record,
)

PULSES = PulseChunk(np.arange(7, dtype=np.int64) * 1000)
READS = ClockReads(*(np.arange(4, dtype=np.int64) + shift for shift in (5, 0, 9)))
SIDE = events(3000, seed=4)
BACK = frames(9, seed=5)
WARM = ScalarChunk(
    np.arange(20, dtype=np.int64), np.arange(20, dtype=np.int64) + 3, np.linspace(20, 21, 20), "°C"
)
CLOCK = {"map": IDENTITY, "uncertainty_ns": 2000.0}


def said() -> TrialRecord:
    """A record of all of it."""
    plain = record("t").to_json()
    clocks = {**plain["clocks"], "streams": dict.fromkeys(("side", "back", "warm"), CLOCK)}
    streams = {
        "side": {"kind": "events", "rows": len(SIDE), "pulses": 7, "size_px": [640, 480]},
        "back": {"kind": "frames", "rows": 9, "size_px": list(FRAME)},
        "warm": {"kind": "scalar", "rows": 20, "unit": "°C"},
    }
    return record("t", clocks=clocks, streams=streams)


def send(writer: TrialWriter) -> None:
    """Send a second event camera, a second frame camera and a thermometer."""
    fill(writer)
    for low in range(0, len(SIDE), 1000):
        rows = slice(low, low + 1000)
        writer.add("side", SIDE[rows])
    writer.add("side", PULSES)
    writer.add("back", BACK)
    writer.add("back", READS)
    writer.add("warm", WARM)


def taken(folder: Path, *, spool: bool = False) -> Path:
    writer = campaign(folder / "s").begin("t", FRAME, 100, spool=spool)
    send(writer)
    return writer.commit(said(), Provenance())


@pytest.mark.parametrize("spool", [False, True])
def test_everything_comes_back_by_its_name(spool: bool, tmp_path: Path) -> None:
    folder = taken(tmp_path, spool=spool)
    names = "checksums.json data.h5 frames.mkv provenance.json record.json"
    names += " stream-back.h5 stream-back.mkv stream-side.h5"
    assert sorted(path.name for path in folder.iterdir()) == names.split()
    recording = Recording(folder)
    found = recording.events(stream="side")
    for name, sent in vars(SIDE).items():
        assert np.array_equal(getattr(found, name), sent)
    some = recording.events(5_050_000_000, 5_060_000_000, stream="side")
    inside = (SIDE.t_us >= 5_050_000) & (SIDE.t_us < 5_060_000)
    assert len(some) == np.count_nonzero(inside) > 10
    assert np.array_equal(list(recording.frames(stream="back")), BACK.images)
    assert np.array_equal(recording.frame(8, "back"), BACK.images[8])
    assert np.array_equal(recording.frame_times("back"), BACK.t_ns)
    warm = recording.scalars("warm")
    assert np.array_equal(warm.value, WARM.value)
    assert warm.unit == "°C"
    with recording.open("side") as reader:
        assert np.array_equal(reader.pulses("event_pulses"), PULSES.t_ns)
    with recording.open("back") as reader:
        assert np.array_equal(reader.clock_reads("frame_camera_reads").before_ns, READS.before_ns)
    # the first cameras are what they were
    assert len(recording.events()) == 1000
    assert len(list(recording.frames())) == 12
    assert verify(TrialStore.open(tmp_path / "s")) == []


def test_the_public_interface_reads_them(tmp_path: Path) -> None:
    taken(tmp_path)
    trial = open_store(tmp_path / "s").trial("t")
    first, further = {"events": "events", "frames": "frames"}, {"side": "events", "back": "frames"}
    assert trial.streams() == {**first, **further, "warm": "scalar"}
    assert len(trial.events(stream="side")) == len(SIDE)
    assert next(trial.frames("back")).shape == (FRAME[1], FRAME[0])
    assert trial.frame(3, "back").shape == (FRAME[1], FRAME[0])
    assert len(trial.frame_times("back")) == 9
    assert (len(trial.scalars("warm")), trial.scalars("warm").unit) == (20, "°C")
    row = open_store(tmp_path / "s").trials().iloc[0]
    assert (row["events"], row["side_events"], row["back_frames"]) == (1000, len(SIDE), 9)


@pytest.mark.parametrize(
    ("read", "text"),
    [
        (lambda t: t.events(stream="none"), "no events 'none'; it has: events, side"),
        (lambda t: t.events(stream="back"), "no events 'back'; it has: events, side"),
        (lambda t: t.frames("side"), "no frames 'side'; it has: frames, back"),
        (lambda t: t.scalars("force"), "no scalar 'force'; it has: warm"),
    ],
)
def test_a_wrong_name_is_answered_with_those_there_are(
    read: Callable[[Trial], object], text: str, tmp_path: Path
) -> None:
    taken(tmp_path)
    with pytest.raises(StoreError, match=text):
        read(open_store(tmp_path / "s").trial("t"))


def test_the_trials_own_file_is_as_without_further_cameras(tmp_path: Path) -> None:
    plain = commit(campaign(tmp_path / "plain"), "t")
    writer = campaign(tmp_path / "more").begin("t", FRAME, 100)
    fill(writer)
    writer.add("side", SIDE)
    folder = writer.seal()
    for name in ("data.h5", "frames.mkv"):
        assert (folder / name).read_bytes() == (plain / name).read_bytes()
    assert not [path for path in plain.iterdir() if path.name.startswith("stream-")]


def test_the_same_streams_are_the_same_bytes(tmp_path: Path) -> None:
    one, other = (taken(tmp_path / name) for name in "ab")
    assert (one / "checksums.json").read_bytes() == (other / "checksums.json").read_bytes()
    assert len(json.loads((one / "checksums.json").read_text())) == 6


def test_a_stream_keeps_its_kind_and_its_name(tmp_path: Path) -> None:
    writer = campaign(tmp_path / "s").begin("t", FRAME, 100)
    writer.add("side", PULSES)
    with pytest.raises(ValueError, match="'side': is of kind 'events', not 'frames'"):
        writer.add("side", BACK)
    with pytest.raises(ValueError, match="a name must match"):
        writer.add("../side", SIDE)
    writer.discard()


@pytest.mark.parametrize(
    ("how", "problem"),
    [
        ("bytes", ("stream-side.h5", "does not match its checksum")),
        ("lost", ("stream-back.mkv", "is missing")),
        ("foreign", ("stream-other.h5", "does not belong here")),
    ],
)
def test_verify_finds_what_was_spoilt(how: str, problem: tuple[str, str], tmp_path: Path) -> None:
    folder = taken(tmp_path)
    side = folder / "stream-side.h5"
    if how == "bytes":
        side.write_bytes(side.read_bytes()[:-1] + b"x")
    elif how == "lost":
        (folder / "stream-back.mkv").unlink()
    else:
        shutil.copy(side, folder / "stream-other.h5")
    assert [(Path(p.path).name, p.what) for p in verify(TrialStore.open(tmp_path / "s"))] == [
        problem
    ]
    found = Recording(folder)
    if how == "bytes":
        with pytest.raises(StoreError, match="is damaged"):
            found.events(stream="side")
    if how == "lost":
        with pytest.raises(StoreError, match="is damaged"):
            found.frame(0, "back")


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"side": {"rows": 2999}}, "3000 rows of events/t, the record says 2999"),
        ({"side": {"pulses": 6}}, "7 rows of event_pulses/t, the record says 6"),
        ({"back": {"rows": 10}}, "9 rows of frames/t, the record says 10"),
        ({"back": None}, "is of a stream that is not in the record"),
        ({"more": {"kind": "events", "rows": 0}}, "is missing, the record has its stream"),
        ({"warm": {"rows": 19}}, "20 rows of streams/warm/t, the record says 19"),
    ],
)
def test_verify_holds_files_and_record_against_each_other(
    changes: dict[str, dict[str, object] | None], problem: str, tmp_path: Path
) -> None:
    writer = campaign(tmp_path / "s").begin("t", FRAME, 100)
    send(writer)
    data = said().to_json()
    for name, change in changes.items():
        known = data["streams"].pop(name, {})
        if change is not None:
            data["streams"][name] = {**known, **change}
    writer.commit(TrialRecord.model_validate(data), Provenance())
    assert any(problem in found.what for found in verify(TrialStore.open(tmp_path / "s")))


def test_a_killed_trial_goes_to_quarantine_with_its_streams(where: Any, tmp_path: Path) -> None:
    writer = where.begin("t", FRAME, 100)
    send(writer)
    writer.abandon()
    again = where.begin("t", FRAME, 100)
    send(again)
    again.commit(said(), Provenance())
    (aside,) = (where.folder / "quarantine").iterdir()
    assert {"stream-side.h5", "stream-back.h5", "stream-back.mkv"} <= {
        path.name for path in aside.iterdir()
    }
    assert verify(TrialStore.open(tmp_path / "s")) == []


def test_they_are_pushed_and_fetched_when_read(tmp_path: Path, monkeypatch: Any) -> None:
    folder = taken(tmp_path)
    monkeypatch.setenv(CACHE, str(tmp_path / "cache"))
    url = f"file://{tmp_path / 'bucket'}"
    push(TrialStore.open(tmp_path / "s"), Remote(url))
    mirrored, _ = open_mirror(url)
    (recording,) = mirrored.campaign("c").recordings()
    assert not (recording.folder / "stream-side.h5").exists()
    assert len(recording.events(stream="side")) == len(SIDE)
    assert np.array_equal(recording.frame(2, "back"), BACK.images[2])
    for name in ("stream-side.h5", "stream-back.mkv"):
        assert (recording.folder / name).read_bytes() == (folder / name).read_bytes()


def test_scalars_are_no_wrenches(tmp_path: Path) -> None:
    folder = taken(tmp_path)
    with StreamReader(folder / "data.h5") as reader:
        assert reader.streams() == {"warm": "scalar"}
        assert len(reader.scalars("none")) == 0
        with pytest.raises(ValueError, match="is of kind 'scalar', no wrench"):
            reader.wrenches("warm")
    writer = campaign(tmp_path / "u").begin("t", FRAME, 100)
    units = {"plain": "", "long": "\N{OHM SIGN}" * 20}
    for name, unit in units.items():
        writer.add(name, ScalarChunk(WARM.t_ns, WARM.host_ns, WARM.value, unit))
    with StreamReader(writer.seal() / "data.h5") as reader:
        assert {name: reader.scalars(name).unit for name in units} == units
    writer = campaign(tmp_path / "f").begin("t", FRAME, 100)
    writer.add("warm", WARM)
    with pytest.raises(ValueError, match="is of kind 'scalar', not 'wrench'"):
        writer.add("warm", WrenchChunk.empty())
    writer.discard()
