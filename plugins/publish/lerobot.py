"""Trials as episodes of a LeRobot v3 data set: rows on a fixed time grid, with the raw trials.

Rows have the times of a grid; the true ones are features of their own: ``time_ns``, and
``frame_time_ns`` of the frame that a row has.

Layout: ``meta/info.json``, ``meta/stats.json``, ``meta/tasks.parquet``, ``meta/episodes/`` and
``data/``, all Parquet of chunk-NNN/file-NNN, and ``videos/``. A row covers 1/100 s of the trial's
time line and has the values known at its end. Counts of events are PNG inside of Parquet. Frames
are the store's own FFV1, in MP4: lossless, and copied without decoding. A feature is there if every
trial has it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from sliplab.plugins.publish.publication import SPLITS, Publication
from sliplab.plugins.publish.sparse_png import sparse_pngs
from sliplab.protocols.errors import InputError
from sliplab.storage.files import write_json_aside
from sliplab.storage.schema.label import LABELS, TrialLabel
from sliplab.storage.streams import EVENTS_KIND, I64, WRENCH, Json
from sliplab.storage.trials.checksums import FRAMES as VIDEO_FILE
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Campaign, TrialStore
from sliplab.storage.trials.video import copy_frames

VERSION, FPS = "v3.0", 100
STEP_NS = 1_000_000_000 // FPS
EVENTS, FRAMES = "observation.images.events", "observation.images.frames"
STATE, SLIP = "observation.state", "slip"
TIME, FRAME_TIME = "time_ns", "frame_time_ns"
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_CHUNK = 1000
"""Files of a folder."""
_SAMPLES, _LEAST_SAMPLES = 64, 8
"""Frames of a data set, and of a trial at least, that are decoded for the statistics of levels."""
_SAMPLE_PX = 150
"""Rows or columns of such a frame that are enough, as LeRobot has it."""
_IMAGE = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
_PLAIN = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
    SLIP: "int64",
    TIME: "int64",
}
_POSE = ("x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg")
_WRENCH = ("fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm")
Array = npt.NDArray[Any]
Kept = TypeVar("Kept", "_Stats", "_Levels")


@dataclass
class _Stats:
    """Figures of one feature over all rows so far, of each component or channel."""

    least: Array | float = np.inf
    most: Array | float = -np.inf
    total: Array | float = 0.0
    squares: Array | float = 0.0
    rows: int = 0

    def add(self, values: Array) -> None:
        """Add rows, shape (n, components)."""
        values = values.astype(np.float64)
        self.least = np.minimum(self.least, values.min(0))
        self.most = np.maximum(self.most, values.max(0))
        self.total = self.total + values.sum(0)
        self.squares = self.squares + (values**2).sum(0)
        self.rows += len(values)

    def to_json(self) -> Json:
        """Return the figures as LeRobot names them."""
        mean = np.asarray(self.total) / self.rows
        spread = np.sqrt(np.maximum(np.asarray(self.squares) / self.rows - mean**2, 0))
        named = {"min": self.least, "max": self.most, "mean": mean, "std": spread}
        return {**{key: np.asarray(v).tolist() for key, v in named.items()}, "count": [self.rows]}


@dataclass
class _Levels:
    """Histogram of the levels in each channel of a feature's images."""

    histogram: I64
    images: int = 0

    def add(self, histogram: I64, images: int) -> None:
        """Add the levels of some images, shape (channels or 1, 256)."""
        self.histogram += histogram
        self.images += images

    def to_json(self) -> Json:
        """Return the figures of levels from 0 to 1, shape (channels, 1, 1)."""
        levels = np.arange(256) / 255
        total = self.histogram.sum(1)
        mean = self.histogram @ levels / total
        found = {
            "min": [levels[row > 0].min() for row in self.histogram],
            "max": [levels[row > 0].max() for row in self.histogram],
            "mean": mean,
            "std": np.sqrt(np.maximum(self.histogram @ levels**2 / total - mean**2, 0)),
        }
        shaped: Json = {key: np.reshape(v, (-1, 1, 1)).tolist() for key, v in found.items()}
        return {**shaped, "count": [self.images]}


@dataclass
class _Set:
    """A data set while it is written."""

    folder: Path
    features: dict[str, Json]
    wrenches: tuple[str, ...]
    samples: int
    stats: dict[str, _Stats | _Levels] = field(default_factory=dict)
    tasks: dict[str, int] = field(default_factory=dict)
    episodes: list[Json] = field(default_factory=list)
    rows: int = 0

    def figures(self, name: str) -> _Stats:
        """Return the figures of a feature of numbers."""
        return self._of(name, _Stats)

    def levels(self, name: str) -> _Levels:
        """Return the levels of a feature of images."""
        channels = self.features[name]["shape"][2]
        return self._of(name, lambda: _Levels(np.zeros((channels, 256), np.int64)))

    def _of(self, name: str, make: Callable[[], Kept]) -> Kept:
        if name not in self.stats:
            self.stats[name] = make()
        return self.stats[name]  # type: ignore[return-value]  # a feature is of one kind


def write_lerobot(
    publication: Publication, folder: Path, on_trial: Callable[[str], None] = lambda name: None
) -> None:
    """Write ``data`` and ``meta`` of all trials into the folder of a publication.

    Raises:
        InputError: a trial has neither events nor poses on its time line.
        StoreError: a trial is damaged.
    """
    order = {name: at for at, name in enumerate(SPLITS)}
    trials = sorted(
        publication.recordings,
        key=lambda item: order[publication.split(item[0].name, item[1].folder.name)],
    )
    features, wrenches = _features([recording for _, recording in trials])
    made = _Set(folder, features, wrenches, max(_SAMPLES // len(trials), _LEAST_SAMPLES))
    parts: dict[str, list[int]] = {}
    for campaign, recording in trials:
        on_trial(recording.folder.name)
        split = publication.split(campaign.name, recording.folder.name)
        parts.setdefault(split, []).append(len(made.episodes))
        _episode(made, publication.store, campaign, recording)
    _meta(made, {name: f"{found[0]}:{found[-1] + 1}" for name, found in parts.items()})


def _features(recordings: list[Recording]) -> tuple[dict[str, Json], tuple[str, ...]]:
    """Return the features that every trial has, and the names of their wrenches."""
    features: dict[str, Json] = {
        name: {"dtype": kind, "shape": [1], "names": None} for name, kind in _PLAIN.items()
    }
    if all(r.record.counts.poses and r.record.clocks.arm is not None for r in recordings):
        features[STATE] = _vector(_POSE)
    shared = set(recordings[0].streams(WRENCH.name))
    for recording in recordings:
        shared &= set(recording.streams(WRENCH.name)) & recording.clocks.devices().keys()
    for name in sorted(shared):
        features[f"observation.{name}"] = _vector(_WRENCH)
    event_px = {r.record.geometry.event_px for r in recordings}
    if all(r.record.counts.events for r in recordings) and len(event_px) == 1:
        (size,) = event_px
        if size is not None:
            features[EVENTS] = _pictures(size, 3)
    if all(r.has_video and r.record.clocks.frames is not None for r in recordings):
        frame_px = {r.frame(0).shape for r in recordings}
        if len(frame_px) == 1:
            ((height, width),) = frame_px
            features[FRAMES] = _pictures((width, height), 3) | {
                "dtype": "video",
                "info": {
                    "video.height": height,
                    "video.width": width,
                    "video.codec": "ffv1",
                    "video.pix_fmt": "gray",
                    "video.is_depth_map": False,
                    "video.fps": FPS,
                    "video.channels": 3,
                    "has_audio": False,
                },
            }
            features[FRAME_TIME] = {"dtype": "int64", "shape": [1], "names": None}
    return features, tuple(sorted(shared))


def _vector(names: tuple[str, ...]) -> Json:
    return {"dtype": "float32", "shape": [len(names)], "names": list(names)}


def _pictures(size: tuple[int, int], channels: int) -> Json:
    names = ["height", "width", "channels"]
    return {"dtype": "image", "shape": [size[1], size[0], channels], "names": names}


def _episode(made: _Set, store: TrialStore, campaign: Campaign, recording: Recording) -> None:
    """Write one trial's rows as a separate file."""
    start, count = _grid(recording)
    ends = start + STEP_NS * np.arange(1, count + 1, dtype=np.int64)
    number = len(made.episodes)
    task = made.tasks.setdefault(_task(recording), len(made.tasks))
    columns: dict[str, pa.Array] = {}
    plain: dict[str, Array] = {
        "timestamp": (np.arange(count) / FPS).astype(np.float32),
        "frame_index": np.arange(count),
        "episode_index": np.full(count, number),
        "index": made.rows + np.arange(count),
        "task_index": np.full(count, task),
        SLIP: _slip(store, campaign, recording, ends),
        TIME: ends,
    }
    vectors: dict[str, Array] = {}
    if STATE in made.features:
        with recording.open() as reader:
            poses = reader.poses()
        times = np.asarray(recording.clock("arm").to_reference(poses.t_ns))
        turned = _turned(ends, times, poses.rotvec_deg)
        vectors[STATE] = np.hstack([_at(ends, times, poses.xyz_mm), turned])
    for name in made.wrenches:
        found = recording.wrenches(name)
        times = np.asarray(recording.clock(name).to_reference(found.t_ns))
        vectors[f"observation.{name}"] = _at(
            ends, times, np.hstack([found.force_n, found.torque_nm])
        )
    if EVENTS in made.features:
        shape = tuple(made.features[EVENTS]["shape"])
        columns[EVENTS] = _event_images(made, recording, shape, start, count)
    if FRAMES in made.features:
        times = np.asarray(recording.frame_times())
        # the first one where there is none yet
        shown = np.maximum(np.searchsorted(times, ends, "right") - 1, 0)
        _frame_video(made, recording, shown)
        plain[FRAME_TIME] = times[shown]
    for name, values in plain.items():
        dtype = np.dtype(made.features[name]["dtype"])
        columns[name] = pa.array(values, pa.from_numpy_dtype(dtype))
        made.figures(name).add(values[:, None])
    for name, rows in vectors.items():
        flat = pa.array(rows.astype(np.float32).reshape(-1))
        columns[name] = pa.FixedSizeListArray.from_arrays(flat, rows.shape[1])
        made.figures(name).add(rows)
    place = _place(number)
    path = made.folder / DATA.format(**place)
    path.parent.mkdir(parents=True, exist_ok=True)
    table = pa.table({key: columns[key] for key in made.features if key in columns})
    pq.write_table(table, path, compression="zstd")
    video = {f"videos/{FRAMES}/{key}": value for key, value in place.items()} | {
        f"videos/{FRAMES}/from_timestamp": 0.0,
        f"videos/{FRAMES}/to_timestamp": count / FPS,
    }
    made.episodes.append(
        {
            "episode_index": number,
            "tasks": [_task(recording)],
            "length": count,
            "data/chunk_index": place["chunk_index"],
            "data/file_index": place["file_index"],
            "dataset_from_index": made.rows,
            "dataset_to_index": made.rows + count,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
            "campaign": campaign.name,
            "trial": recording.folder.name,
            "start_ns": start,
            **(video if FRAMES in made.features else {}),
        }
    )
    made.rows += count


def _place(episode: int) -> dict[str, int]:
    return {"chunk_index": episode // _CHUNK, "file_index": episode % _CHUNK}


def _grid(recording: Recording) -> tuple[int, int]:
    """Return the start of the first row on the time line, ns, and the number of rows.

    The rows hold every event, or without events every pose.
    """
    with recording.open() as reader:
        device, times = EVENTS_KIND, reader.event_times() * 1000
        if not len(times):
            device, times = "arm", reader.column("poses/t")
    if not len(times) or device not in recording.clocks.devices():
        raise InputError(
            "--as",
            "",
            "lerobot",
            f"trial {recording.folder.name} has neither events nor poses; it fits croissant",
        )
    first, last = recording.clock(device).to_reference(times[[0, -1]]).tolist()
    return first, (last - first) // STEP_NS + 1


def _task(recording: Recording) -> str:
    record = recording.record
    return ", ".join(
        [
            record.experiment,
            *(f"{k} {v}" for k, v in sorted({**record.condition, **record.context}.items())),
        ]
    )


def _slip(store: TrialStore, campaign: Campaign, recording: Recording, ends: I64) -> I64:
    """Return 0 before slip, 1 from its first onset, 2 from its second; -1 without a label."""
    try:
        label = Derived.of(store, LABELS, campaign.name).load(recording.folder.name, TrialLabel)
    except FileNotFoundError:
        return np.full(len(ends), -1, np.int64)
    found = np.zeros(len(ends), np.int64)
    for value, onset in ((1, label.incipient_ns), (2, label.gross_ns)):
        if onset is not None:
            found[ends >= onset] = value
    return found


def _at(ends: I64, times: I64, values: Array) -> Array:
    """Interpolate rows at some times, component by component."""
    origin = int(ends[0])
    at, known = (ends - origin).astype(np.float64), (times - origin).astype(np.float64)
    return np.stack([np.interp(at, known, column) for column in values.T], 1)


def _turned(ends: I64, times: I64, rotvec_deg: Array) -> Array:
    """Interpolate rotations along the shortest path between two of them."""
    from scipy.spatial.transform import Rotation, Slerp

    times, first = np.unique(times, return_index=True)
    rotations = Rotation.from_rotvec(rotvec_deg[first], degrees=True)
    if len(times) < 2:
        return np.repeat(rotations.as_rotvec(degrees=True), len(ends), 0)
    known = (times - times[0]).astype(np.float64)
    at = np.clip((ends - times[0]).astype(np.float64), 0, known[-1])
    return np.asarray(Slerp(known, rotations)(at).as_rotvec(degrees=True))


def _event_images(
    made: _Set, recording: Recording, shape: tuple[int, ...], start: int, count: int
) -> pa.Array:
    """Pack counts of events of each row: brighter, darker, 0; at most 255."""
    clock = recording.clock(EVENTS_KIND)
    events = recording.events()
    rows = (np.asarray(clock.to_reference(events.t_us * 1000)) - start) // STEP_NS
    height, width, channels = shape
    size = height * width * channels
    pixels = (rows, events.y.astype(np.int64), events.x, 1 - events.p.astype(np.int64))
    # pairs of row and pixel, in one sort
    seen, counted = np.unique(np.ravel_multi_index(pixels, (count, *shape)), return_counts=True)
    level = np.minimum(counted, 255).astype(np.uint8)
    found = np.bincount(seen % channels * 256 + level, minlength=channels * 256)
    found = found.reshape(channels, 256)
    found[:, 0] = count * height * width - found[:, 1:].sum(1)
    made.levels(EVENTS).add(found, count)
    edges = np.searchsorted(seen, size * np.arange(count + 1))
    packed = sparse_pngs(seen % size, level, edges, height, width)
    paths = pa.nulls(count, pa.string())
    return pa.StructArray.from_arrays([pa.array(packed, pa.binary()), paths], fields=list(_IMAGE))


def _frame_video(made: _Set, recording: Recording, shown: I64) -> None:
    """Write the frame of each row into the episode's video."""
    path = made.folder / VIDEO.format(video_key=FRAMES, **_place(len(made.episodes)))
    path.parent.mkdir(parents=True, exist_ok=True)
    copy_frames(recording.files()[VIDEO_FILE], path, shown, FPS)
    levels = made.levels(FRAMES)
    with recording.frame_reader() as reader:
        for number in shown[:: -(-len(shown) // made.samples)].tolist():
            image = reader.frame(number)
            step = max(min(image.shape) // _SAMPLE_PX, 1)
            image = image[::step, ::step]
            levels.add(np.bincount(image.reshape(-1), minlength=256)[None], 1)


def _meta(made: _Set, splits: Mapping[str, str]) -> None:
    folder = made.folder / "meta"
    (folder / "episodes" / "chunk-000").mkdir(parents=True)
    episodes = pa.Table.from_pylist(made.episodes)
    pq.write_table(episodes, folder / "episodes" / "chunk-000" / "file-000.parquet")
    tasks = pd.DataFrame({"task_index": list(made.tasks.values())}, index=list(made.tasks))
    tasks.to_parquet(folder / "tasks.parquet")
    stats = {name: found.to_json() for name, found in made.stats.items()}
    write_json_aside(folder / "stats.json", stats)
    info = {
        "codebase_version": VERSION,
        "robot_type": None,
        "total_episodes": len(made.episodes),
        "total_frames": made.rows,
        "total_tasks": len(made.tasks),
        "chunks_size": _CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": FPS,
        "splits": dict(splits),
        "data_path": DATA,
        "video_path": VIDEO if FRAMES in made.features else None,
        "features": made.features,
    }
    write_json_aside(folder / "info.json", info)
