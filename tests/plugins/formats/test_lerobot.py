"""LeRobot data sets of others: frames, states and forces into a store, the rest unknown."""

from __future__ import annotations

import json
import math
import random
import shutil
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sliplab.plugins.publish.forms import publish
from sliplab.protocols.errors import InputError
from sliplab.storage.errors import DamagedFile
from sliplab.storage.formats.import_trials import import_trials
from sliplab.storage.formats.recognition import kind_of, skipped_in, trials_in
from sliplab.storage.streams import Json
from sliplab.storage.trials.catalogue import catalogue
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify
from tests.fuzz.mutate import mutate
from tests.plugins.publish.test_croissant import publication
from tests.plugins.publish.test_lerobot import _trial
from tests.storage.trial_files import campaign

FPS = 30
LENGTHS = (5, 4)
SIZE = (24, 16)
STATE = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad", "gripper.pos")
FORCE = ("fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm")


def _pixels(rows: int) -> Any:
    """Colours of frames, blue, green, red: smooth, as a lossy video keeps them best."""
    slope = np.linspace(0, 200, SIZE[0])[None, :, None] * np.ones((SIZE[1], 1, 3))
    return np.stack([np.clip(slope + 6 * row, 0, 255).astype(np.uint8) for row in range(rows)])


def _png(image: Any) -> Json:
    done, data = cv2.imencode(".png", image)
    assert done
    return {"bytes": data.tobytes(), "path": None}


def _video(path: Path, images: Any) -> None:
    path.parent.mkdir(parents=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=FPS)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        stream.bit_rate = 4_000_000
        for number, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="bgr24")
            frame.pts, frame.time_base = number, Fraction(1, FPS)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def foreign(folder: Path) -> dict[str, Any]:
    """A data set as lerobot writes one, both episodes in one file; returns what is in it."""
    count = sum(LENGTHS)
    rng = np.random.default_rng(5)
    state = rng.normal(size=(count, len(STATE))).astype(np.float32)
    force = rng.normal(size=(count, 6)).astype(np.float32)
    seconds = np.concatenate([np.arange(n) / FPS for n in LENGTHS]).astype(np.float32)
    images = _pixels(count)
    episode = np.repeat(np.arange(len(LENGTHS)), LENGTHS)
    starts = [0, LENGTHS[0]]
    features = {
        "observation.images.wrist": {"dtype": "image", "shape": [16, 24, 3], "names": None},
        "observation.images.top": {"dtype": "video", "shape": [3, 16, 24], "names": None},
        "observation.state": {
            "dtype": "float32",
            "shape": [len(STATE)],
            "names": {"motors": list(STATE)},
        },
        "observation.wrist_force": {"dtype": "float32", "shape": [6], "names": list(FORCE)},
        "action": {"dtype": "float32", "shape": [2], "names": None},
        "next.done": {"dtype": "bool", "shape": [1], "names": None},
        "instruction": {"dtype": "string", "shape": [1], "names": None},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    }
    info = {
        "codebase_version": "v3.0",
        "robot_type": "so101",
        "fps": FPS,
        "features": features,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    }
    for part in ("meta/episodes/chunk-000", "data/chunk-000"):
        (folder / part).mkdir(parents=True)
    (folder / "meta/info.json").write_text(json.dumps(info))
    rows = pa.table(
        {
            "observation.images.wrist": [_png(image) for image in images],
            "observation.state": state.tolist(),
            "observation.wrist_force": force.tolist(),
            "action": pa.array(state[:, :2].tolist(), pa.list_(pa.float32(), 2)),
            "next.done": [False, *[True] * (count - 1)],
            "instruction": ["push"] * count,
            "timestamp": pa.array(seconds),
            "episode_index": episode,
        }
    )
    pq.write_table(rows, folder / "data/chunk-000/file-000.parquet", row_group_size=3)
    top = "videos/observation.images.top"
    _video(folder / f"{top}/chunk-000/file-000.mp4", images)
    pq.write_table(
        pa.Table.from_pylist(
            [
                {
                    "episode_index": number,
                    "tasks": ["push the block"],
                    "length": length,
                    "data/chunk_index": 0,
                    "data/file_index": 0,
                    f"{top}/chunk_index": 0,
                    f"{top}/file_index": 0,
                    f"{top}/from_timestamp": starts[number] / FPS,
                }
                for number, length in enumerate(LENGTHS)
            ]
        ),
        folder / "meta/episodes/chunk-000/file-000.parquet",
    )
    return {"state": state, "force": force, "images": images, "seconds": seconds}


def take(store: Path, path: Path) -> Json:
    kind = kind_of(path)
    assert (kind, skipped_in(path, kind)) == ("lerobot", [])
    result = import_trials(TrialStore.create(store), "theirs", trials_in(path, kind), path, kind)
    for item in result.get("failed", ()):
        raise InputError(path, "", None, item["reason"])
    return result


def test_frames_poses_forces_and_scalars_of_every_episode(tmp_path: Path) -> None:
    there = foreign(tmp_path / "set")
    taken = take(tmp_path / "store", tmp_path / "set")
    assert taken["imported"] == ["episode-000000", "episode-000001"]
    assert (taken["events"], taken["frames"]) == (0, sum(LENGTHS))
    store = TrialStore.open(tmp_path / "store")
    assert verify(store) == []
    assert catalogue(store)["experiment"].tolist() == ["imported"] * 2
    low = 0
    for trial, length in zip(store.campaign("theirs").recordings(), LENGTHS, strict=True):
        rows = slice(low, low + length)
        low += length
        record = trial.record
        assert record.imported is not None
        assert record.imported.format == "lerobot"
        assert {"events", "sync grade", "condition", "units"} <= set(record.imported.unknown)
        assert record.clocks.reference == "frame camera"
        assert set(record.clocks.devices()) == {"frames", "arm", *record.streams}
        assert {clock.grade for clock in record.clocks.devices().values()} == {"unknown"}
        times = np.rint(there["seconds"][rows].astype(np.float64) * 1e6) * 1000
        np.testing.assert_array_equal(trial.frame_times(), times)
        assert record.recorded_s == pytest.approx((length - 1) / FPS, abs=1e-6)
        weights = np.array([0.114, 0.587, 0.299])
        expected = there["images"][rows] @ weights
        wrist = np.stack(list(trial.frames()))
        assert np.abs(wrist - expected).max() <= 0.5  # PNG is exact, grey levels are rounded
        top = np.stack(list(trial.frames(stream="top")))
        assert np.abs(top - expected).mean() < 3  # the video is lossy
        np.testing.assert_array_equal(trial.frame_times("top"), times)
        with trial.open() as reader:
            poses = reader.poses()
        state = there["state"][rows].astype(np.float64)
        np.testing.assert_array_equal(poses.xyz_mm, state[:, :3] * 1000)
        np.testing.assert_allclose(poses.rotvec_deg, np.degrees(state[:, 3:6]), rtol=1e-15)
        np.testing.assert_array_equal(trial.scalars("state_gripper_pos").value, state[:, 6])
        np.testing.assert_array_equal(trial.scalars("action_1").value, state[:, 1])
        np.testing.assert_array_equal(
            trial.wrenches("wrist_force").torque_nm, there["force"][rows, 3:]
        )
        assert set(record.streams) == {
            "top",
            "wrist_force",
            "state_gripper_pos",
            "action_0",
            "action_1",
            "next_done",
        }
        kept = record.imported.to_json()
        assert kept["streams"]["state_gripper_pos"] == "observation.state[gripper.pos]"
        assert kept["streams"]["top"] == "observation.images.top"
        assert (kept["tasks"], kept["robot"]) == (["push the block"], "so101")
        assert kept["left_out"] == ["instruction"]


def test_our_rows_without_the_raw_trials(tmp_path: Path) -> None:
    """What others keep of a data set of ours: rows on the grid, still marked as simulated."""
    where = campaign(tmp_path / "ours")
    _trial(where, "a")
    ours = TrialStore.open(tmp_path / "ours")
    publish(publication(ours), tmp_path / "out", "lerobot")
    for name in ("campaigns", "store.json"):
        path = tmp_path / "out" / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    take(tmp_path / "store", tmp_path / "out")
    (trial,) = TrialStore.open(tmp_path / "store").campaign("theirs").recordings()
    assert trial.simulated
    table = pq.read_table(tmp_path / "out/data/chunk-000/file-000.parquet")
    with trial.open() as reader:
        poses = reader.poses()
    state = np.array(table["observation.state"].to_pylist())
    np.testing.assert_array_equal(np.hstack([poses.xyz_mm, poses.rotvec_deg]), state)
    np.testing.assert_array_equal(
        np.hstack([trial.wrenches().force_n, trial.wrenches().torque_nm]),
        np.array(table["observation.force"].to_pylist()),
    )
    np.testing.assert_array_equal(trial.frame_times(), np.arange(len(table)) * 10_000_000)
    assert set(trial.scalars("slip").value) == {-1.0}


def _info(**changes: Any) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / "meta/info.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))

    return change


def _episodes(**changes: Any) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / "meta/episodes/chunk-000/file-000.parquet"
        rows = pq.read_table(path).to_pylist()
        pq.write_table(pa.Table.from_pylist([{**row, **changes} for row in rows]), path)

    return change


def _rows(name: str, values: list[Any]) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / "data/chunk-000/file-000.parquet"
        table = pq.read_table(path)
        at = table.column_names.index(name)
        pq.write_table(table.set_column(at, name, pa.array(values)), path)

    return change


def _cut(part: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        data = (folder / part).read_bytes()
        (folder / part).write_bytes(data[: len(data) // 2])

    return change


def _link(folder: Path) -> None:
    path = folder / "data/chunk-000/file-000.parquet"
    path.rename(folder / "elsewhere.parquet")
    path.symlink_to(folder / "elsewhere.parquet")


def _playlist(folder: Path) -> None:
    """A file that other readers would follow to the address that it names."""
    path = folder / "videos/observation.images.top/chunk-000/file-000.mp4"
    path.write_text("#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1:9/secret.ts\n")


COUNT = sum(LENGTHS)
TOP = "videos/observation.images.top"
FAULTS: dict[str, tuple[Callable[[Path], None], str]] = {
    "an older version": (_info(codebase_version="v2.1"), r"version = v2\.1: must be v3\.0"),
    "a layout that leads out": (_info(data_path="../../{chunk_index}"), "data_path = "),
    "no rate": (_info(fps=True), "fps = true"),
    "no features": (_info(features=[]), "features = "),
    "a feature that leads out": (_info(features={"../x": {}}), r"features = \.\./x"),
    "no stream": (_info(features={"task": {"dtype": "string", "shape": [1]}}), "a stream"),
    "info cut short": (_cut("meta/info.json"), "info.json"),
    "rows cut short": (_cut("data/chunk-000/file-000.parquet"), "file-000.parquet: is damaged"),
    "a video cut short": (_cut(f"{TOP}/chunk-000/file-000.mp4"), "file-000.mp4"),
    "a playlist as video": (_playlist, "file-000.mp4: is no video that can be read"),
    "a link": (_link, "is missing or a link"),
    "a file of nowhere": (_episodes(**{"data/file_index": 7}), "file-007.parquet: is missing"),
    "a negative place": (_episodes(**{"data/file_index": -1}), "data/file_index = -1"),
    "another length": (_episodes(length=3), "holds 5 rows of episode 0, which has 3"),
    "an episode twice": (_episodes(episode_index=0, length=5), "holds the episode 0 twice"),
    "a video elsewhere": (_episodes(**{f"{TOP}/from_timestamp": 9.0}), "has no frame at 9.0"),
    "no place in the video": (_episodes(**{f"{TOP}/from_timestamp": None}), "must be seconds"),
    "times that run backwards": (_rows("timestamp", [0.5, 0.1] + [0.6] * 7), "invalid times"),
    "a time that is none": (_rows("timestamp", [math.nan] * COUNT), "not a number"),
    "a pose that is none": (_rows("observation.state", [[math.inf] * 7] * COUNT), "not a number"),
    "rows of other widths": (_rows("action", [[1.0]] * COUNT), "not 2 numbers each"),
    "words for numbers": (_rows("next.done", ["no"] * COUNT), "not 1 numbers each"),
    "an image that is none": (
        _rows("observation.images.wrist", [{"bytes": b"x", "path": None}] * COUNT),
        "cannot be read",
    ),
    "an image elsewhere": (
        _rows("observation.images.wrist", [{"bytes": None, "path": "/etc/passwd"}] * COUNT),
        "outside of its rows",
    ),
}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole data set."""
    folder = tmp_path_factory.mktemp("lerobot") / "set"
    foreign(folder)
    return folder


@pytest.mark.parametrize("fault", FAULTS)
def test_a_faulty_data_set_ends_in_a_message(fault: str, made: Path, tmp_path: Path) -> None:
    path = tmp_path / "set"
    shutil.copytree(made, path)
    change, text = FAULTS[fault]
    change(path)
    with pytest.raises((InputError, DamagedFile), match=text):
        take(tmp_path / "store", path)
    store = TrialStore.create(tmp_path / "store")
    assert verify(store) == []
    names = {p.name for where in store.campaigns() for p in (where.folder / "trials").iterdir()}
    assert names <= {"episode-000000"}


@pytest.mark.long
def test_no_damaged_byte_ends_in_a_traceback(made: Path, tmp_path: Path) -> None:
    files = sorted(path.relative_to(made) for path in made.rglob("*") if path.is_file())
    whole = [(made / file).read_bytes() for file in files]
    messages = []
    for number in range(300):
        rng = random.Random(number)
        path = tmp_path / str(number)
        shutil.copytree(made, path / "set")
        file = path / "set" / rng.choice(files)
        kind = "json" if file.suffix == ".json" else "bytes"
        file.write_bytes(mutate(kind, file.read_bytes(), rng, whole))
        try:
            kind = kind_of(path / "set") if (path / "set/meta/info.json").exists() else "lerobot"
            found = trials_in(path / "set", kind)
            import_trials(TrialStore.create(path / "store"), "t", found, path / "set", kind)
        except InputError as error:
            messages.append(str(error))
        shutil.rmtree(path)
    assert len(messages) > 150
    assert all(str(tmp_path) in text for text in messages)


def test_a_data_set_without_a_camera_is_imported(tmp_path: Path) -> None:
    made = foreign(tmp_path / "set")
    _info(features={"action": {"dtype": "float32", "shape": [2]}})(tmp_path / "set")
    take(tmp_path / "store", tmp_path / "set")
    store = TrialStore.open(tmp_path / "store")
    assert verify(store) == []
    first = store.campaign("theirs").recording("episode-000000")
    np.testing.assert_array_equal(
        first.scalars("action_1").value, made["state"][: LENGTHS[0], 1].astype(np.float64)
    )
    assert first.record.recorded_s == pytest.approx(4 / FPS, abs=1e-6)


@pytest.mark.parametrize(
    ("names", "streams"),
    [
        ({"left": 1, "right": 0}, ["right", "left"]),  # a name's number, in any order
        ({"motors": {"left": 1, "right": 0}}, ["right", "left"]),
        ({"left": 1, "right": 2}, ["0", "1"]),
        ({"left": None, "right": None}, ["0", "1"]),
        ({"left": 0, "right": True}, ["0", "1"]),
    ],
)
def test_components_are_named_by_their_numbers(
    names: Any, streams: list[str], tmp_path: Path
) -> None:
    made = foreign(tmp_path / "set")
    _info(features={"action": {"dtype": "float32", "shape": [2], "names": names}})(tmp_path / "set")
    take(tmp_path / "store", tmp_path / "set")
    first = TrialStore.open(tmp_path / "store").campaign("theirs").recording("episode-000000")
    for at, name in enumerate(streams):
        np.testing.assert_array_equal(
            first.scalars(f"action_{name}").value, made["state"][: LENGTHS[0], at]
        )


SINGLE = np.float32


@pytest.mark.parametrize(
    ("stamps", "exact", "gated"),
    [
        (lambda n: (n / FPS).astype(SINGLE), True, False),  # as LeRobot writes them
        (lambda n: n.astype(SINGLE) * SINGLE(1 / FPS), True, False),
        (lambda n: n / FPS + 1.7e9, False, False),
        (lambda n: n / FPS + 2e-5 * (n % 2), False, False),  # stamps of its own, fine enough
        (lambda n: (n / FPS + 1.7e9).astype(SINGLE), False, True),
        (lambda n: (n / FPS + 2e-3 * (n % 2)).astype(SINGLE), False, True),
        (lambda n: (n / FPS).astype(np.float16), False, True),
        (lambda n: n, False, True),
    ],
)
def test_times_are_as_exact_as_their_type_or_gated(
    stamps: Any, exact: bool, gated: bool, tmp_path: Path
) -> None:
    rows = np.arange(9000)
    foreign(tmp_path / "set")
    (tmp_path / "set/meta/info.json").write_text(
        json.dumps(
            {
                "codebase_version": "v3.0",
                "fps": FPS,
                "features": {
                    "observation.state": {"dtype": "float32", "shape": [6], "names": STATE[:6]},
                    "action": {"dtype": "float32", "shape": [1]},
                },
            }
        )
    )
    table = {
        "observation.state": pa.array(np.zeros((9000, 6)).tolist(), pa.list_(pa.float32(), 6)),
        "action": rows.astype(SINGLE),
        "timestamp": stamps(rows),
        "frame_index": rows,
        "episode_index": np.zeros(9000, int),
    }
    pq.write_table(pa.table(table), tmp_path / "set/data/chunk-000/file-000.parquet")
    _episodes(length=9000)(tmp_path / "set")
    path = tmp_path / "set/meta/episodes/chunk-000/file-000.parquet"
    pq.write_table(pq.read_table(path).slice(0, 1), path)
    take(tmp_path / "store", tmp_path / "set")
    (trial,) = TrialStore.open(tmp_path / "store").campaign("theirs").recordings()
    times = rows / FPS if exact else stamps(rows).astype(np.float64)
    expected = np.rint(times * 1e6).astype(np.int64) * 1000
    np.testing.assert_array_equal(trial.scalars("action").t_ns, expected)
    failed = {f"{name}_time_resolution_us" for name in ("poses", "action")} if gated else set()
    assert set(trial.record.quality.gates) == failed
    assert trial.record.quality.passed == (not gated)
