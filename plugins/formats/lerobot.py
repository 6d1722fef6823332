"""Reader of LeRobot v3 data sets of others: an episode is a trial, with frames and rows of numbers.

Such a data set has no events. Images and videos become cameras; vectors of numbers become poses and
forces where the names of their components have their units, and otherwise a scalar stream for each
component, without a unit. One that SlipLab published has its raw trials next to the rows, and those
are read instead (format `croissant`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from sliplab.protocols.errors import InputError
from sliplab.storage.errors import DamagedFile
from sliplab.storage.files import read_json
from sliplab.storage.formats.foreign import (
    LATEST_US,
    Damage,
    ForeignTrial,
    FormatError,
    broken,
    resolution_us,
    rounded_us,
)
from sliplab.storage.formats.format import Format
from sliplab.storage.formats.pictures import decode_picture, levels_of, opened_video
from sliplab.storage.streams import (
    EVENTS_KIND,
    F64,
    FRAMES_KIND,
    I64,
    U8,
    Chunk,
    FrameChunk,
    Json,
    PoseChunk,
    ScalarChunk,
    WrenchChunk,
)
from sliplab.storage.trials.store import STORE

INFO = "meta/info.json"
_PUBLISHED = (STORE, "croissant.json")
"""Files of a data set that SlipLab published."""
_LAYOUT = {
    "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
}
_GRID = {"timestamp", "frame_index", "episode_index", "index", "task_index"}
"""Columns that number the rows."""
_KEY = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]{0,99}")
_NUMBERS = re.compile(r"(float|int|uint)\d+|bool")
_LENGTHS, _ANGLES = {"mm": 1.0, "m": 1000.0}, {"deg": 1.0, "rad": 180 / math.pi}
_MOST_COMPONENTS, _MOST_ROWS, _MOST_GROUP, _MOST_NAME = 64, 1 << 24, 1 << 31, 32
_FRAMES_AT_ONCE = 32
_ROUNDING = 4
"""Steps of the times' type by which a quotient may differ that was computed in this type."""
_DAMAGES = (
    pa.ArrowException,
    OSError,
    ValueError,
    KeyError,
    TypeError,
    OverflowError,
)


@dataclass(frozen=True)
class _Vector:
    """A feature of numbers with the names of its components."""

    key: str
    names: tuple[str, ...]

    @property
    def base(self) -> str:
        """Beginning of its streams' names."""
        return self.key.removeprefix("observation.")

    def of(self, axes: tuple[str, ...], units: Mapping[str, float]) -> tuple[list[int], float]:
        """Return the components of some axes, and what a value is multiplied by; none: empty."""
        for unit, factor in units.items():
            wanted = [f"{axis}_{unit}" for axis in axes]
            if set(wanted) <= set(self.names):
                return [self.names.index(name) for name in wanted], factor
        return [], 1.0


@dataclass(frozen=True)
class _DataSet:
    """Description of a data set.

    Attributes:
        cameras: `image` or `video` by feature.
        streams: stream by camera's feature, the first one `frames`.
    """

    folder: Path
    fps: float
    robot: str | None
    simulated: bool
    cameras: dict[str, str] = field(default_factory=dict)
    streams: dict[str, str] = field(default_factory=dict)
    vectors: list[_Vector] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)

    def file(self, part: str, **place: object) -> Path:
        """Return one of its files. Raises FormatError where it is missing or a link."""
        path = self.folder / part.format(**place)
        if not path.is_file() or path.resolve() != self.folder.resolve() / part.format(**place):
            raise FormatError("is missing or a link; a copy by `cp -rL` has no links", path)
        return path


def is_lerobot(path: Path) -> bool:
    """Return whether a folder is a LeRobot data set of others, of format 2 or later."""
    return (path / INFO).is_file() and not all((path / name).is_file() for name in _PUBLISHED)


def read_lerobot(path: Path) -> Iterator[ForeignTrial]:
    """Yield the episodes of a data set as trials.

    Raises:
        InputError: it is of another version or layout, or damaged (`DamagedFile`).
    """
    data = _described(path)
    seen: set[int] = set()
    with _refused(path):
        for row in _episodes(data):
            try:
                yield _trial(data, row, seen)
            except FormatError as error:
                yield _broken(row, error)


@contextmanager
def _refused(path: Path) -> Iterator[None]:
    try:
        yield
    except FormatError as error:
        kind = DamagedFile if isinstance(error, Damage) else InputError
        raise kind(error.file or path, "", None, str(error)) from None


@contextmanager
def _damage(file: Path) -> Iterator[None]:
    """Report what the libraries find wrong with a file."""
    try:
        yield
    except FormatError as error:
        raise type(error)(str(error), error.file or file) from None
    except _DAMAGES as error:
        text = " ".join(str(error).split())[:200] or type(error).__name__
        raise Damage(f"is damaged: {text}", file) from None


def _broken(row: Json, error: FormatError) -> ForeignTrial:
    """Return an episode that cannot be read."""
    number = row.get("episode_index")
    name = f"episode-{number:06d}" if type(number) is int and 0 <= number < 10**9 else "episode"
    return broken(name, INFO if error.file is None else error.file.name, error)


def _described(path: Path) -> _DataSet:
    info = path / INFO
    try:
        found = read_json(info)
    except (OSError, ValueError) as error:
        text = str(error).removeprefix(f"{info}: ")
        raise DamagedFile(info, "", None, f"cannot be read: {text}") from None

    def wrong(key: str, expected: str) -> InputError:
        return InputError(info, key, found.get(key), expected)

    if not str(found.get("codebase_version")).startswith("v3."):
        raise wrong("codebase_version", "must be v3.0; lerobot converts older data sets")
    for key, layout in _LAYOUT.items():
        if found.get(key) not in (layout, None):
            raise wrong(key, f"must be {layout}")
    fps, robot, features = (found.get(key) for key in ("fps", "robot_type", "features"))
    if isinstance(fps, bool) or not isinstance(fps, int | float) or not 0 < fps < 1e6:
        raise wrong("fps", "must be a number of rows a second")
    if robot is not None and not (isinstance(robot, str) and robot.isprintable()):
        raise wrong("robot_type", "must be a name or null")
    if not isinstance(features, dict):
        raise wrong("features", "must be a mapping")
    card = path / "README.md"
    simulated = card.is_file() and card.read_bytes()[:15] == b"Simulated data."
    data = _DataSet(path, float(fps), robot, simulated)
    for key, feature in features.items():
        if not _KEY.fullmatch(key) or ".." in key:
            raise InputError(info, "features", key, "must be letters, digits, `_`, `.` and `-`")
        if not isinstance(feature, dict):
            raise InputError(info, f"features.{key}", feature, "must be a mapping")
        if key not in _GRID:
            _add(data, key, feature)
    if not data.cameras and not data.vectors:
        raise InputError(
            info,
            "features",
            ", ".join(features) or "none",
            "must have an image, a video from a camera, or numbers: a trial needs a stream",
        )
    return data


def _add(data: _DataSet, key: str, feature: Json) -> None:
    """Sort a feature: a camera, numbers, or left out."""
    kind, shape = str(feature.get("dtype")), feature.get("shape")
    if kind in {"image", "video"}:
        data.cameras[key] = kind
        taken = {*data.streams.values(), EVENTS_KIND, FRAMES_KIND}
        name = _stream_name(key.removeprefix("observation.images."), taken)
        data.streams[key] = name if data.streams else FRAMES_KIND
    elif (
        _NUMBERS.fullmatch(kind)
        and isinstance(shape, list)
        and len(shape) == 1
        and type(shape[0]) is int
        and 0 < shape[0] <= _MOST_COMPONENTS
    ):
        data.vectors.append(_Vector(key, _components(feature.get("names"), shape[0])))
    else:
        data.left_out.append(key)


def _components(names: Any, count: int) -> tuple[str, ...]:
    """Return the names of a vector's components; their numbers where it has none."""
    while isinstance(names, dict) and len(names) == 1:  # {"motors": [...]}
        (names,) = names.values()
    if isinstance(names, dict):  # {"left": 0, "right": 1}, in any order; else it numbers nothing
        numbers = {name: at for name, at in names.items() if type(at) is int}
        fits = len(numbers) == len(names) and sorted(numbers.values()) == list(range(count))
        names = sorted(numbers, key=numbers.__getitem__) if fits else None
    fits = isinstance(names, list) and len(names) == count
    if (
        fits
        and all(isinstance(name, str) and name.isprintable() for name in names)
        and len(set(names)) == count
    ):
        return tuple(names)
    return ("",) if count == 1 else tuple(map(str, range(count)))


def _stream_name(text: str, taken: set[str]) -> str:
    """Make a stream's name from a feature's: small letters, digits and ``_``, and not taken."""
    plain = re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")
    plain = plain if plain[:1].isalpha() else f"s_{plain}"
    name, number = plain[:_MOST_NAME].rstrip("_"), 1
    while name in taken:
        number += 1
        end = f"_{number}"
        name = plain[: _MOST_NAME - len(end)] + end
    return name


def _rows(file: Path, columns: list[str], episode: int | None = None) -> Iterator[pa.RecordBatch]:
    """Yield rows of some columns, of one episode or of all."""
    with pq.ParquetFile(file) as found:
        columns = [name for name in columns if name in found.schema_arrow.names]
        for number in range(found.num_row_groups):
            group = found.metadata.row_group(number)
            if group.total_byte_size > _MOST_GROUP:
                raise FormatError(f"holds {group.total_byte_size} bytes in one group of rows")
            if episode is not None and not _may_hold(group, episode):
                continue
            for batch in found.iter_batches(_FRAMES_AT_ONCE, [number], columns):
                if episode is not None:
                    batch = batch.filter(pa.array(_numbers(batch["episode_index"], 1) == episode))
                if len(batch):
                    yield batch


def _may_hold(group: Any, episode: int) -> bool:
    for at in range(group.num_columns):
        column = group.column(at)
        known = column.statistics
        if column.path_in_schema == "episode_index" and known is not None and known.has_min_max:
            return bool(known.min <= episode <= known.max)
    return True


def _numbers(column: Any, width: int) -> F64:
    """Return a column of numbers as rows of floats; a single component without its axis."""
    rows: F64 = _raw(column, width).astype(np.float64)
    return rows


def _raw(column: Any, width: int) -> Any:
    """Return the same in the type of the file."""
    count = len(column)
    while pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type):
        column = column.flatten()
    values = column.to_numpy(zero_copy_only=False)
    if column.null_count or values.dtype.kind not in "fiub" or len(values) != count * width:
        raise Damage(f"holds a column whose rows are not {width} numbers each")
    rows = values.reshape(count, width)
    return rows[:, 0] if width == 1 else rows


def _seconds(table: pa.Table, fps: float) -> tuple[F64, float]:
    """Return the times of an episode's rows, s, and the resolution of their type, us.

    LeRobot writes ``frame_index / fps`` as 32-bit floats, which are wrong by over 1 us after 16 s:
    times that differ from the quotient by rounding only are the quotient.
    """
    stated = np.atleast_1d(_raw(table["timestamp"].combine_chunks(), 1))
    seconds = stated.astype(np.float64)
    number = np.arange(len(table), dtype=np.float64)
    if "frame_index" in table.column_names:
        number = np.atleast_1d(_numbers(table["frame_index"].combine_chunks(), 1))
    rounding = min(_ROUNDING * resolution_us(stated, 1.0), 0.5 / fps)
    if np.all(np.abs(seconds - number / fps) <= rounding):
        return number / fps, 0.0
    return seconds, resolution_us(stated, 1e6, whole_us=1e6)


def _episodes(data: _DataSet) -> Iterator[Json]:
    """Yield the rows of all episodes."""
    keys = ["episode_index", "length", "tasks", "data/chunk_index", "data/file_index"]
    for key, kind in data.cameras.items():
        if kind == "video":
            parts = ("chunk_index", "file_index", "from_timestamp")
            keys += [f"videos/{key}/{part}" for part in parts]
    folder = data.folder / "meta/episodes"
    files = sorted(folder.glob("chunk-*/file-*.parquet"))
    if not files:
        raise Damage("holds no file of episodes", folder)
    for path in files:
        with _damage(path):
            file = data.file(path.relative_to(data.folder).as_posix())
            rows = [row for batch in _rows(file, keys) for row in batch.to_pylist()]
        for row in rows:
            row["file"] = path
            yield row


def _whole(row: Json, key: str, most: int) -> int:
    value = row.get(key)
    if type(value) is not int or not 0 <= value < most:
        raise Damage(f"holds {key} = {value!r:.40}, which must be a whole number from 0")
    return value


def _place(row: Json, of: str) -> dict[str, int]:
    keys = ("chunk_index", "file_index")
    return {key: _whole(row, f"{of}/{key}", 10**6) for key in keys}


def _trial(data: _DataSet, row: Json, seen: set[int]) -> ForeignTrial:
    with _damage(row["file"]):
        number, length = _whole(row, "episode_index", 10**9), _whole(row, "length", _MOST_ROWS)
        if number in seen:
            raise Damage(f"holds the episode {number} twice")
        seen.add(number)
    file = data.file(_LAYOUT["data_path"], **_place(row, "data"))
    keys = ["episode_index", "frame_index", "timestamp", *(vector.key for vector in data.vectors)]
    with _damage(file):
        batches = list(_rows(file, keys, number))
        table = pa.Table.from_batches(batches).combine_chunks() if batches else None
        if table is None or len(table) != length:
            count = 0 if table is None else len(table)
            raise Damage(f"holds {count} rows of episode {number}, which has {length}")
        seconds, resolution = _seconds(table, data.fps)
        times = rounded_us(seconds, 1e6)
        if times.min() < 0 or times[-1] >= LATEST_US or np.any(np.diff(times) < 0):
            raise Damage(
                f"holds decreasing or invalid times of episode {number}, or what is not a number"
            )
        t_ns = times * 1000
        found = _Streams(t_ns, {*data.streams.values(), EVENTS_KIND, FRAMES_KIND})
        for vector in data.vectors:
            values = _numbers(table[vector.key].combine_chunks(), len(vector.names))
            found.add(vector, values.reshape(length, -1))
    cameras = {
        name: _frames(_pictures(data, row, key, file, number, seconds), t_ns)
        for key, name in data.streams.items()
    }
    frames = cameras.pop(FRAMES_KIND, None)
    first = None if frames is None else next(frames())
    size = None if first is None else (first.images.shape[2], first.images.shape[1])
    names = {name: key for key, name in data.streams.items() if name != FRAMES_KIND}
    tasks = row.get("tasks") or ()
    about = {
        "robot": data.robot or "unknown",
        "tasks": [str(task)[:500] for task in tasks][:100],
        "camera": next(iter(data.cameras), None),
        "streams": {**names, **found.sources},
        "left_out": data.left_out,
    }
    unknown = ["sync grade", "motion", "condition"]
    unknown += [] if found.poses is not None else ["poses"]
    unknown += ["units"] if any(isinstance(s, ScalarChunk) for s in found.streams.values()) else []
    return ForeignTrial(
        f"episode-{number:06d}",
        file.relative_to(data.folder).as_posix(),
        lambda: iter(()),
        "the episode's start; seconds of its rows, rounded to us",
        frames=frames,
        frame_px=size,
        simulated=data.simulated,
        about=about,
        unknown=tuple(unknown),
        kind="lerobot",
        poses=found.poses,
        streams=found.streams,
        resolution_us=dict.fromkeys((*data.streams.values(), "poses", *found.streams), resolution),
        cameras=cameras,
    )


@dataclass
class _Streams:
    """Poses and streams of one episode, from its vectors.

    Attributes:
        sources: feature and component that a stream is made of.
    """

    t_ns: I64
    taken: set[str]
    poses: PoseChunk | None = None
    streams: dict[str, Chunk] = field(default_factory=dict)
    sources: dict[str, str] = field(default_factory=dict)

    def add(self, vector: _Vector, values: F64) -> None:
        """Add the rows of a vector, shape (n, components)."""
        left = list(range(len(vector.names)))
        # what an action asks for is not where the arm was
        observed = vector.key.startswith("observation.")
        place, per_mm = vector.of(("x", "y", "z"), _LENGTHS)
        turn, per_degree = vector.of(("rx", "ry", "rz"), _ANGLES)
        if observed and place and turn and self.poses is None:
            xyz, rotation = values[:, place] * per_mm, values[:, turn] * per_degree
            self.poses = PoseChunk(self.t_ns, self.t_ns, xyz, rotation)
            left = [at for at in left if at not in {*place, *turn}]
        force, _ = vector.of(("fx", "fy", "fz"), {"n": 1.0})
        torque, _ = vector.of(("tx", "ty", "tz"), {"nm": 1.0})
        if force and torque:
            name = self._name(vector.base, vector.key)
            self.streams[name] = WrenchChunk(
                self.t_ns, self.t_ns, values[:, force], values[:, torque]
            )
            left = [at for at in left if at not in {*force, *torque}]
        for at in left:
            of = vector.names[at]
            name = self._name(
                f"{vector.base}_{of}" if of else vector.base,
                f"{vector.key}[{of}]" if of else vector.key,
            )
            self.streams[name] = ScalarChunk(self.t_ns, self.t_ns, values[:, at])

    def _name(self, text: str, source: str) -> str:
        name = _stream_name(text, self.taken)
        self.taken.add(name)
        self.sources[name] = source
        return name


def _pictures(
    data: _DataSet, row: Json, key: str, rows: Path, episode: int, seconds: F64
) -> Callable[[], Iterator[U8]]:
    """Return a reader of a camera's pictures of one episode."""
    if data.cameras[key] == "image":
        return lambda: _images(rows, key, episode)
    of = f"videos/{key}"
    file = data.file(_LAYOUT["video_path"], video_key=key, **_place(row, of))
    start = row.get(f"{of}/from_timestamp")
    if not isinstance(start, float) or not 0 <= start < 1e9:
        raise Damage(f"holds {of}/from_timestamp = {start!r:.40}, which must be seconds")
    return lambda: _video(file, start + seconds, 0.5 / data.fps)


def _images(file: Path, key: str, episode: int) -> Iterator[U8]:
    with _damage(file):
        for batch in _rows(file, [key, "episode_index"], episode):
            for item in batch[key].to_pylist():
                packed = item.get("bytes") if isinstance(item, dict) else item
                if not isinstance(packed, bytes):
                    raise FormatError(f"keeps the images of {key} outside of its rows")
                yield decode_picture(packed)


def _video(file: Path, wanted: F64, tolerance_s: float) -> Iterator[U8]:
    """Yield the frames at some times of a video, s."""
    at = 0
    with _damage(file), opened_video(file) as (container, stream):
        container.seek(int(wanted[0] / float(stream.time_base or 1)), stream=stream)
        for frame in container.decode(stream):
            time = frame.time
            if time is None or time < wanted[at] - tolerance_s:
                continue
            if time > wanted[at] + tolerance_s:
                break
            yield levels_of(frame)
            at += 1
            if at == len(wanted):
                return
        raise Damage(f"has no frame at {wanted[at]:.6f} s, of {len(wanted)} it has {at}")


def _frames(pictures: Callable[[], Iterator[U8]], t_ns: I64) -> Callable[[], Iterator[FrameChunk]]:
    """Return a reader of a camera's frames, with the times of their rows."""

    def read() -> Iterator[FrameChunk]:
        found = 0
        for number, image in enumerate(pictures()):
            row = slice(number, number + 1)
            times = t_ns[row]
            yield FrameChunk(
                image[None], np.arange(number, number + 1), times, times, np.zeros(1, np.uint8)
            )
            found = number + 1
        if found != len(t_ns):
            raise Damage(f"holds {found} frames of an episode of {len(t_ns)} rows")

    return read


LEROBOT = Format(sniff=lambda path, head: is_lerobot(path), read_all=read_lerobot)
