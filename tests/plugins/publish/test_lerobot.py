"""Trials as episodes of LeRobot v3: every row against the store, by Parquet and OpenCV alone.

LeRobot itself wants an older torch than ours; that its loader reads these files was tried in an
environment of its own (docs/publish.md).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

from sliplab.plugins.publish.forms import publish
from sliplab.protocols.errors import InputError
from sliplab.storage.schema.label import LABELS, TrialLabel
from sliplab.storage.schema.trial import Provenance
from sliplab.storage.streams import PoseChunk, WrenchChunk
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import TrialStore
from tests.plugins.publish.test_croissant import publication
from tests.storage.trial_files import FRAME, IDENTITY, campaign, events, frames, record

GEOMETRY = {"event_px": [640, 480], "frame_px": list(FRAME)}
START_NS = int(events(1000).t_us[0]) * 1000


def _trial(where: Any, name: str, shift: int = 0) -> None:
    """A trial of 1,000 events in 0.1 s, with 12 frames, 50 poses and 50 forces around them."""
    writer = where.begin(name, FRAME, 100)
    writer.add("events", events(1000, seed=shift))
    times = START_NS + np.arange(50, dtype=np.int64) * 2_100_000
    turns = np.outer(np.linspace(0, 90, 50), [0, 0, 1.0])
    writer.add("arm", PoseChunk(times, times, np.arange(150.0).reshape(50, 3) + shift, turns))
    forces = np.stack([np.linspace(0, 1, 50)] * 3, 1)
    writer.add("force", WrenchChunk(times, times, forces, -forces))
    shown = frames(12, seed=shift)
    writer.add("frames", type(shown)(**{**vars(shown), "t_ns": START_NS + shown.t_ns}))
    clock = {"map": IDENTITY, "uncertainty_ns": 1.0}
    clocks = {
        "events": clock,
        "arm": clock,
        "frames": clock,
        "streams": {"force": clock},
    }
    writer.commit(
        record(
            name,
            geometry=GEOMETRY,
            clocks=clocks,
            repetition=shift,
            counts={"events": 1000, "frames": 12, "poses": 50, "pulses": 0},
            streams={"force": {"kind": "wrench", "rows": 50}},
        ),
        Provenance(),
    )


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> TrialStore:
    """Two trials, the second one labelled."""
    where = campaign(tmp_path_factory.mktemp("lerobot") / "store")
    _trial(where, "a")
    _trial(where, "b", shift=1)
    made = TrialStore.open(where.folder.parents[1])
    label = TrialLabel(
        key="k", incipient_ns=START_NS + 25_000_000, gross_ns=START_NS + 60_000_000, end_ns=0
    )
    Derived.of(made, LABELS, "c").write("b", "k", label)
    return made


@pytest.fixture(scope="module")
def published(store: TrialStore, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same, published; the second trial is in the training part, the first one in the test."""
    output = tmp_path_factory.mktemp("out") / "set"
    seen: list[str] = []
    splits = {("c", "a"): "test", ("c", "b"): "train"}
    publish(publication(store, splits=splits), output, "lerobot", seen.append)
    assert seen == ["b", "a"]
    return output


def _images(column: Any) -> list[Any]:
    found = []
    for item in column.to_pylist():
        data = np.frombuffer(item["bytes"], np.uint8)
        found.append(cv2.imdecode(data, cv2.IMREAD_UNCHANGED))
    return found


def _frames(published: Path, episode: int) -> list[Any]:
    """An episode's frames, at the times of its rows."""
    name = f"videos/observation.images.frames/chunk-000/file-{episode:03d}.mp4"
    with av.open(str(published / name)) as file:
        found = list(file.decode(video=0))
    np.testing.assert_allclose([frame.time for frame in found], np.arange(len(found)) / 100)
    return [frame.to_ndarray(format="gray") for frame in found]


def test_every_row_is_what_the_store_has(store: TrialStore, published: Path) -> None:
    for number, name in enumerate(("b", "a")):
        rows = pq.read_table(published / f"data/chunk-000/file-{number:03d}.parquet")
        trial = store.campaign("c").recording(name)
        found, count = trial.events(), len(rows)
        start = int(found.t_us[0]) * 1000
        ends = start + 10_000_000 * np.arange(1, count + 1)
        assert ends[-2] <= found.t_us[-1] * 1000 < ends[-1]
        images = _images(rows["observation.images.events"])
        expected = np.zeros((count, 480, 640, 3), np.int64)
        for x, y, p, t_us in zip(*vars(found).values(), strict=True):
            # blue, green, red as OpenCV has them
            expected[(int(t_us) * 1000 - start) // 10_000_000, y, x, 1 + int(p)] += 1
        assert expected.sum() == 1000
        np.testing.assert_array_equal(images, expected)
        levels, times = list(trial.frames()), trial.frame_times()
        np.testing.assert_array_equal(rows["time_ns"].to_numpy(), ends)
        shown = rows["frame_time_ns"].to_numpy()
        np.testing.assert_array_equal(shown, times[np.searchsorted(times, ends, "right") - 1])
        for image, end in zip(_frames(published, number), ends, strict=True):
            np.testing.assert_array_equal(image, levels[np.flatnonzero(times <= end)[-1]])
        state = np.array(rows["observation.state"].to_pylist())
        with trial.open() as reader:
            poses = reader.poses()
        for axis in range(3):
            place = np.interp(ends, poses.t_ns, poses.xyz_mm[:, axis])
            np.testing.assert_allclose(state[:, axis], place, rtol=1e-6)
        turn = np.interp(ends, poses.t_ns, poses.rotvec_deg[:, 2])
        np.testing.assert_allclose(state[:, 3:], np.outer(turn, [0, 0, 1]), atol=1e-4)
        force = np.array(rows["observation.force"].to_pylist())
        forces = trial.wrenches()
        pressed = np.interp(ends, forces.t_ns, forces.force_n[:, 0])
        np.testing.assert_allclose(force[:, [0, 5]], np.stack([pressed, -pressed], 1), rtol=1e-6)
        slip = rows["slip"].to_numpy()
        if name == "a":
            assert set(slip) == {-1}
        else:
            after = ends - START_NS
            np.testing.assert_array_equal(
                slip, (after >= 25_000_000).astype(int) + (after >= 60_000_000)
            )
        np.testing.assert_allclose(rows["timestamp"].to_numpy(), np.arange(count) / 100, atol=1e-6)
        assert rows["episode_index"].unique().to_pylist() == [number]
        assert rows["frame_index"].to_pylist() == list(range(count))


def test_meta_says_what_the_files_hold(published: Path) -> None:
    info = json.loads((published / "meta/info.json").read_text())
    files = sorted((published / "data").glob("*/*.parquet"))
    tables = [pq.read_table(file) for file in files]
    total = sum(map(len, tables))
    assert (info["codebase_version"], info["fps"], info["total_episodes"]) == ("v3.0", 100, 2)
    assert (info["total_frames"], info["splits"]) == (total, {"train": "0:1", "test": "1:2"})
    index = np.concatenate([table["index"].to_numpy() for table in tables])
    np.testing.assert_array_equal(index, np.arange(total))
    for table in tables:
        assert {*table.column_names, "observation.images.frames"} == info["features"].keys()
    episodes = pd.read_parquet(published / "meta/episodes/chunk-000/file-000.parquet")
    assert episodes["trial"].tolist() == ["b", "a"]
    assert episodes["length"].tolist() == list(map(len, tables))
    assert episodes["dataset_from_index"].tolist() == [0, len(tables[0])]
    assert episodes["dataset_to_index"].tolist() == [len(tables[0]), total]
    assert episodes["start_ns"].tolist()[1] == START_NS
    assert episodes["videos/observation.images.frames/file_index"].tolist() == [0, 1]
    tasks = pd.read_parquet(published / "meta/tasks.parquet")
    assert tasks.index.tolist() == ["kinematic, depth 2.4 mm, side left"]
    stats = json.loads((published / "meta/stats.json").read_text())
    state = np.concatenate([np.array(t["observation.state"].to_pylist()) for t in tables])
    np.testing.assert_allclose(stats["observation.state"]["mean"], state.mean(0), rtol=1e-5)
    np.testing.assert_allclose(
        stats["observation.state"]["std"], state.std(0), rtol=1e-4, atol=1e-4
    )
    # of so few rows each one is in the statistics
    shown = np.concatenate([_frames(published, number) for number in range(2)]) / 255
    for channel in range(3):
        ((mean,),) = stats["observation.images.frames"]["mean"][channel]
        ((spread,),) = stats["observation.images.frames"]["std"][channel]
        np.testing.assert_allclose([mean, spread], [shown.mean(), shown.std()], rtol=1e-9)
    counted = np.concatenate([_images(t["observation.images.events"]) for t in tables])
    most = np.array(stats["observation.images.events"]["max"]).reshape(-1) * 255
    np.testing.assert_allclose(most, counted.max((0, 1, 2))[::-1])
    assert stats["observation.images.events"]["count"] == [total]


def test_the_raw_trials_are_beside_the_rows(store: TrialStore, published: Path) -> None:
    theirs = TrialStore.open(published).campaign("c")
    for one in store.campaign("c").recordings():
        assert theirs.recording(one.folder.name).raw_checksum == one.raw_checksum
    card = (published / "README.md").read_text()
    assert card.startswith("Simulated data.\n")
    assert "red counts brighter" in card


def test_a_turn_is_interpolated_on_the_shortest_way() -> None:
    """Rotation vectors jump at 180 degrees; what they mean does not."""
    from sliplab.plugins.publish.lerobot import _turned

    known = Rotation.from_rotvec([[0, 0, 179], [0, 0, 181]], degrees=True).as_rotvec(degrees=True)
    assert known[0, 2] * known[1, 2] < 0
    times = np.array([0, 10], np.int64)
    (half,) = _turned(np.array([5], np.int64), times, known)
    np.testing.assert_allclose(np.abs(half), [0, 0, 180], atol=1e-9)


def test_a_trial_without_a_time_of_its_own_is_refused(tmp_path: Path) -> None:
    where = campaign(tmp_path / "store")
    counts = {"events": 0, "frames": 0, "poses": 0, "pulses": 0}
    where.begin("t", None, 100).commit(
        record("t", counts=counts, clocks={}, quality={"passed": False}), Provenance()
    )
    with pytest.raises(InputError, match="neither events nor poses"):
        publish(publication(TrialStore.open(tmp_path / "store")), tmp_path / "out", "lerobot")
    assert [path.name for path in tmp_path.iterdir()] == ["store"]
