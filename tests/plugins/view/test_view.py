"""A trial in Rerun: what its own reader finds in the file is what was recorded, exactly."""

from __future__ import annotations

import json
import os
import socket
import sys
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sliplab.analysis.campaigns import Collected
from sliplab.plugins.record.recorder import record
from sliplab.plugins.record.sources import push
from sliplab.plugins.view import view
from sliplab.protocols.errors import InputError
from sliplab.storage.errors import StoreError
from sliplab.storage.trials import review
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.review import ReviewedOnsets
from sliplab.storage.trials.store import TrialStore
from tests.analysis.labels import reviewable
from tests.analysis.labels.reviewable import EVENTS, FRAMES, NAME, Reviewable, events, frame_times
from tests.flows.listening import listening
from tests.patching import loose

pytestmark = pytest.mark.skipif(
    find_spec("rerun") is None, reason="Rerun is not installed (sliplab[view])"
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Reviewable:
    """Two trials; the first is reviewed and evaluated."""
    found = Reviewable(tmp_path_factory.mktemp("view") / "s", 2)
    trial, known = found.ids[0], reviewable.label()
    old = ReviewedOnsets(known["incipient_ns"], known["gross_ns"])
    new = ReviewedOnsets(310_000_001, 450_000_002)
    known = {"label": found.keys[trial], "old": old, "new": new, "seen": 0, "who": "anna"}
    review.decide(found.store, NAME, trial, "adjust", **known)
    counts = {"counts": np.arange(12).reshape(4, 3), "end_ns": np.array([5, 7, 9, 1 << 60])}
    Derived.of(found.store, "counts", NAME).write(trial, "k", {}, counts)
    return found


class Read:
    """An .rrd file by Rerun's own reader: times, int64 ns, and cells of every entity."""

    def __init__(self, path: Path) -> None:
        from rerun.chunk import RrdReader  # most workers need none of it

        self.columns: dict[tuple[str, str], list[tuple[int | None, Any]]] = {}
        for chunk in RrdReader(path).stream():
            table = chunk.to_record_batch()
            times = [None] * table.num_rows
            if view.TIMELINE in table.schema.names:
                times = table.column(view.TIMELINE).cast("int64").to_pylist()
            for name in table.schema.names:
                if ":" in name:
                    cells = zip(times, table.column(name).to_pylist(), strict=True)
                    rows = self.columns.setdefault((str(chunk.entity_path), name), [])
                    rows += [(time, cell) for time, cell in cells if cell is not None]

    def __getitem__(self, key: tuple[str, str]) -> tuple[list[int | None], list[Any]]:
        rows = sorted(self.columns[key], key=lambda row: -1 if row[0] is None else row[0])
        return [time for time, _ in rows], [cell for _, cell in rows]

    def curve(self, path: str) -> tuple[list[int | None], list[float]]:
        times, cells = self[path, "Scalars:scalars"]
        return times, [value for (value,) in cells]


@pytest.fixture(scope="module")
def saved(made: Reviewable, tmp_path_factory: pytest.TempPathFactory) -> tuple[Read, Any]:
    """The first trial's file, and what was said of it."""
    path = tmp_path_factory.mktemp("rrd") / "a.rrd"
    counts = view.save(view.find(made.store, made.ids[0]), path)
    assert counts.pop("bytes") == path.stat().st_size
    assert os.listdir(path.parent) == ["a.rrd"]
    return Read(path), counts


def test_events_are_all_there(saved: tuple[Read, Any]) -> None:
    read, counts = saved
    assert counts["events"] == EVENTS
    known = events()
    for name, polarity in (("on", 1), ("off", 0)):
        which = known.p == polarity
        times, cells = read[f"/events/{name}", "Points2D:positions"]
        found = np.array([place for cell in cells for place in cell])
        assert np.array_equal(found, np.stack([known.x[which], known.y[which]], axis=1))
        known_ns = known.t_us[which] * 1000
        ends = np.cumsum([len(cell) for cell in cells])
        starts = np.concatenate([[0], ends[:-1]])
        assert times == known_ns[starts].tolist()
        # a row holds what falls into one bin of 5 ms, and all of it
        bins = known_ns // view.BIN_NS
        assert (bins[ends - 1] == bins[starts]).all()
        assert len(set(bins.tolist())) == len(cells)


def test_frames_and_markers_stand_at_their_times(saved: tuple[Read, Any]) -> None:
    read, counts = saved
    assert counts["frames"] == counts["tracked_frames"] == FRAMES
    times, cells = read["/camera", "EncodedImage:blob"]
    assert times == frame_times().tolist()
    for index in (0, 31, FRAMES - 1):
        packed = np.asarray(cells[index][0], np.uint8)
        image = cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE)
        assert np.abs(image.astype(int) - reviewable.pictures()[index]).mean() < 3
    times, cells = read["/camera/markers", "Points2D:positions"]
    assert times == frame_times().tolist()
    assert np.array_equal(np.array(cells, np.float32), reviewable.places())
    _, numbers = read["/camera/markers", "Points2D:class_ids"]
    assert numbers[-1] == list(range(7))
    times, values = read.curve("/displacement/marker_2")
    assert times == frame_times().tolist()
    assert values == pytest.approx(reviewable.displacements()[:, 2], abs=1e-6)


def test_arm_and_pulses_stand_at_their_times(saved: tuple[Read, Any]) -> None:
    read, counts = saved
    known = 5_000_000 + np.arange(50) * 12_000_000
    times, cells = read["/arm/tool", "Transform3D:translation"]
    assert (times, counts["poses"]) == (known.tolist(), 50)
    assert [cell[0][0] for cell in cells] == pytest.approx(400 + known / 1e8, abs=1e-4)
    _, turns = read["/arm/tool", "Transform3D:quaternion"]
    assert turns[0] == [[0.0, 0.0, 0.0, 1.0]]
    for name in ("sync_box", "events", "arm"):
        times, _ = read.curve(f"/pulses/{name}")
        assert times == (5_000_000 + np.arange(12) * 50_000_000).tolist()
        assert counts[f"pulses_{name}"] == 12


def test_onsets_of_label_review_and_truth_are_told_apart(saved: tuple[Read, Any]) -> None:
    read, counts = saved
    known = reviewable.label()
    for name, onsets in (
        ("label", (known["incipient_ns"], known["gross_ns"])),
        ("review", (310_000_001, 450_000_002)),
        ("truth_simulated", (310_000_000, 450_000_000)),
    ):
        assert read.curve(f"/onsets/{name}") == ([5_000_000, *onsets], [0.0, 1.0, 2.0])
    times, words = read["/onset_log", "TextLog:text"]
    assert counts["onsets"] == len(words) == 6
    assert "incipient onset: truth, simulated" in [word for (word,) in words]
    assert times == sorted(loose(times), key=int)  # none is None
    _, text = read["/trial", "TextDocument:text"]
    assert "**simulated**" in text[0][0]
    times, values = read.curve("/network/gross")
    assert (times, values) == ([5, 7, 9, 1 << 60], [2.0, 5.0, 8.0, 11.0])
    assert counts["windows"] == 4


@pytest.mark.long
def test_too_many_events_become_pictures_that_count_them(
    made: Reviewable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(view, "MOST_POINTS", EVENTS - 1)
    counts = view.save(view.find(made.store, made.ids[1]), tmp_path / "b.rrd")
    read = Read(tmp_path / "b.rrd")
    times, cells = read["/events/counts", "Image:buffer"]
    known = events()
    assert len(cells) == counts["event_pictures"] == len(times)
    found = np.array([np.asarray(cell[0], np.uint8).view(np.uint16) for cell in cells])
    assert found.sum() == EVENTS
    spread = np.zeros((240, 320), np.int64)
    np.add.at(spread, (known.y // 2, known.x // 2), 1)
    assert np.array_equal(found.sum(axis=0).reshape(240, 320), spread)
    assert times[0] == known.t_us[0] * 1000
    assert set(np.diff(loose(times))) == {view.BIN_NS}  # none is None
    assert ("/events/on", "Points2D:positions") not in read.columns


def test_nothing_is_sent_home(
    made: Reviewable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("a connection was tried")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    own = tmp_path / "settings"
    monkeypatch.setenv("XDG_CONFIG_HOME", str(own))
    view.save(view.find(made.store, made.ids[1]), tmp_path / "b.rrd")
    with view.silent() as environment:
        file = Path(environment["XDG_CONFIG_HOME"]) / "rerun" / "analytics.json"
        assert json.loads(file.read_text())["analytics_enabled"] is False
    assert not own.exists()  # the user's own choice stays
    assert not file.exists()


def gone(group: int) -> bool:
    """Return whether all processes of a group end within 20 s."""
    end = time.monotonic() + 20
    while time.monotonic() < end:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
    return False


def test_the_viewer_is_reached_from_this_computer_only(
    made: Reviewable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # the server of Rerun's own program, with the options that the viewer gets, and no window
    file = tmp_path / "a.rrd"
    view.save(view.find(made.store, made.ids[1]), file)
    found: set[str] = set()
    with (
        view.silent() as environment,
        view.viewer("--serve-grpc", str(file), environment=environment) as server,
    ):
        end = time.monotonic() + 60
        while not found and time.monotonic() < end and server.poll() is None:
            found = listening(server.pid)
    assert found == {"127.0.0.1"}
    assert gone(server.pid)


def test_what_is_missing_is_said(
    made: Reviewable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match="no committed trial of"):
        view.find(made.store, "depth=9mm")
    with pytest.raises(InputError, match="no committed trial of campaign 'x'"):
        view.find(made.store, made.ids[0], "x")
    subject = view.find(made.store, made.ids[0], NAME)
    assert isinstance(subject.item, Collected)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(StoreError, match="no display available; --save"):
        view.show(subject)
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ModuleNotFoundError, match="rerun"):
        view.save(subject, tmp_path / "c.rrd")
    assert not list(tmp_path.iterdir())


def test_a_recording_without_a_protocol_is_shown(tmp_path: Path) -> None:
    """The readings of a stream's clock are no stream to be shown: nothing times them."""
    sources = [push("events", events_px=(8, 4)), push("pull", {"fx": "N"})]
    with record(sources, tmp_path / "s", "grasps") as recording, recording.trial() as trial:
        for n in range(5):
            trial.push("events", None, n, 1, 1)
            trial.push("pull", None, float(n))
    path = tmp_path / "v.rrd"
    view.save(view.find(TrialStore.open(tmp_path / "s"), trial.id), path)
    assert Read(path).curve("/streams/pull")[1] == [0.0, 1.0, 2.0, 3.0, 4.0]
