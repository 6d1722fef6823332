"""Further files of the lab's scripts for a recording: a second copy, video and forces.

A run's folder has `meta.json`, the events below `events`, videos below `videos`, and the times of
the videos' frames in one pickle a camera, `timestamps_CAMERA.pkl`, written when the run ends. All
are named by the recording, such as ``d3_s0.5_dir_back_r0``. What is missing or cannot be read is
noted in the trial's record; the events are imported without it.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from sliplab.plugins.formats.lab.events import Pair, count_events, named_condition
from sliplab.plugins.formats.lab.pickles import read_pickle
from sliplab.protocols.errors import InputError
from sliplab.storage.files import json_text, read_json
from sliplab.storage.formats.foreign import (
    LATEST_US,
    ForeignTrial,
    FormatError,
    read_head,
    resolution_us,
    rounded_us,
)
from sliplab.storage.formats.numpy_files import MAGIC, array_of
from sliplab.storage.formats.pictures import video_frames
from sliplab.storage.streams import FRAMES_KIND, EventChunk, FrameChunk, Json, WrenchChunk

EVENTS_FOLDER, VIDEOS_FOLDER, META = "events", "videos", "meta.json"
_TIMES = "timestamps_{}.pkl"
_CAMERA = re.compile(r"timestamps_(?P<camera>[A-Za-z0-9_-]{1,64})\.(?:pkl|pickle)")
_VIDEO_ENDINGS = (".mp4", ".avi", ".mkv")
_POLARITY = re.compile(r"(?P<stem>.+?)(?:_events)?_(?P<polarity>on|off)", re.IGNORECASE)
_FORCES = re.compile(r"(?:force|forces|ft|wrench|loadcell)s?", re.IGNORECASE)
_FORCE_ENDINGS = {".csv", ".npy", ".pkl", ".pickle", ""}
_AXES = ("fx", "fy", "fz", "tx", "ty", "tz")
_TIME_NAMES = ("t", "ts", "time", "times", "timestamp", "timestamps", "seconds")
_MOST_META = 1 << 16
_FEW_FRAMES = 3


def run_folder(path: Path) -> Path | None:
    """Return the folder of the run whose events a folder or file holds; None without a run."""
    folder = path if path.is_dir() else path.parent
    for each in (folder, folder.parent):
        if each != folder and folder.name != EVENTS_FOLDER:
            continue
        events = each / EVENTS_FOLDER
        there = events.is_dir() and not events.is_symlink()
        if there and ((each / META).is_file() or _cameras(each)):
            return each
    return None


def _cameras(run: Path) -> list[str]:
    found = (_CAMERA.fullmatch(path.name) for path in sorted(run.iterdir()))
    return [match["camera"] for match in found if match is not None]


def is_of_run(entry: Path) -> bool:
    """Return whether a file or folder in a run's folder is read with its recordings."""
    if entry.is_symlink():
        return False
    if entry.is_dir():
        return entry.name in {EVENTS_FOLDER, VIDEOS_FOLDER} or bool(_FORCES.fullmatch(entry.name))
    return entry.name == META or _CAMERA.fullmatch(entry.name) is not None


def check_polarity(trial: ForeignTrial, stem: str) -> ForeignTrial:
    """Note where the file's own polarities contradict its name, such as ``NAME_events_on.h5``."""
    named = _POLARITY.fullmatch(stem)
    if named is None:
        return trial
    wanted = int(named["polarity"].lower() == "on")
    events, counts = _counted(trial)

    def notes() -> tuple[str, ...]:
        wrong, right = counts[1 - wanted], counts[wanted]
        if wrong <= right:
            return trial.notes()
        text = (
            f"holds {counts[1]:,} ON and {counts[0]:,} OFF events although its name says "
            f"{named['polarity'].upper()}; its own column is used"
        )
        return (*trial.notes(), text)

    return replace(trial, events=events, notes=notes)


def compare(trial: ForeignTrial, pair: Pair) -> ForeignTrial:
    """Note where the pickles of a recording contradict its stream, which has both polarities."""
    events, counts = _counted(trial)

    @cache
    def texts() -> tuple[str, ...]:
        return tuple(_differing(pair, counts))

    return replace(trial, events=events, notes=lambda: (*trial.notes(), *texts()))


def _counted(trial: ForeignTrial) -> tuple[Callable[[], Iterator[EventChunk]], Counter[int]]:
    """Return a trial's events, and the numbers of OFF and ON events once they were read."""
    counts: Counter[int] = Counter()

    def events() -> Iterator[EventChunk]:
        counts.clear()
        for chunk in trial.events():
            on = int(chunk.p.sum())
            counts.update({1: on, 0: len(chunk) - on})
            yield chunk

    return events, counts


def _differing(pair: Pair, counts: Counter[int]) -> Iterator[str]:
    stream = pair.stream.name if pair.stream is not None else ""
    for path, polarity, name in ((pair.on, 1, "ON"), (pair.off, 0, "OFF")):
        if path is None:
            continue
        try:
            count = count_events(path)
        except (FormatError, InputError) as error:
            yield f"{path.name} was not compared with {stream}: {error}"
            continue
        if count == counts[polarity]:
            continue
        other = "OFF" if polarity else "ON"
        if count == counts[1 - polarity]:
            yield f"{path.name} holds the {other} events of {stream}, which is imported"
        else:
            yield (
                f"{path.name} holds {count:,} events, and {stream}, which is imported, "
                f"{counts[polarity]:,} {name} events"
            )


def with_run(trial: ForeignTrial, stem: str, run: Path | None) -> ForeignTrial:
    """Return a trial with its files in its run's folder.

    Args:
        stem: the recording's name.
    """
    if run is None or trial.error is not None:
        return trial
    notes: list[str] = []
    about = {**trial.about, **_meta(run, notes)}
    if untimed := _untimed(run, stem):
        about["left_out"] = [*about.get("left_out", ()), *untimed]
    cameras = _video_streams(run, stem, notes)
    frames, size = cameras.pop(FRAMES_KIND, (trial.frames, trial.frame_px))
    forces, resolution = _forces(run, stem, notes)
    unknown = [what for what in trial.unknown if what != "frames" or frames is None]
    unknown += ["clock of frames"] if frames is not None and trial.frames is None else []
    unknown += [f"clock of {name}" for name in forces]
    return replace(
        trial,
        about=about,
        frames=frames,
        frame_px=size,
        unknown=tuple(unknown),
        cameras={**trial.cameras, **{n: read for n, (read, _) in cameras.items() if read}},
        streams={**trial.streams, **forces},
        resolution_us={**trial.resolution_us, **resolution},
        notes=lambda: (*trial.notes(), *dict.fromkeys(notes)),
    )


def _meta(run: Path, notes: list[str]) -> Json:
    path = run / META
    if not path.is_file():
        notes.append(f"{META} is missing")
        return {}
    try:
        if path.stat().st_size > _MOST_META:
            raise ValueError(f"is larger than {_MOST_META >> 10} KiB")
        found = read_json(path)
        json_text(found)  # no NaN, no infinity
    except (OSError, ValueError, RecursionError) as error:
        text = str(error).removeprefix(f"{path}: ")
        notes.append(f"{META} is not read: {text}")
        return {}
    return {"meta": found}


Camera = tuple[Callable[[], Iterator[FrameChunk]] | None, tuple[int, int] | None]


def _video_streams(run: Path, stem: str, notes: list[str]) -> dict[str, Camera]:
    """Return the cameras whose video and times are there; the outside one is the frames'."""
    found: dict[str, Camera] = {}
    for camera in sorted(_cameras(run), key=lambda name: ("out" not in name, name)):
        times = _times(run, camera, stem, notes)
        video = _video(run, camera, stem)
        if times is None and video is None:
            continue
        if times is None or video is None:
            what = "no times" if times is None else "no video"
            notes.append(f"{camera}: {what} of {stem}; its frames are not imported")
            continue
        try:
            first = next(video_frames(video), None)
        except FormatError as error:
            notes.append(f"{video.name} {error}; its frames are not imported")
            continue
        if first is None:
            notes.append(f"{video.name} holds no frame")
            continue
        name = FRAMES_KIND if not found else re.sub(r"[^a-z0-9]+", "_", camera.lower()).strip("_")
        size = (first.shape[1], first.shape[0])
        found[name] = partial(_frames, video, times, notes), size
    return found


def _untimed(run: Path, stem: str) -> list[str]:
    """Return the videos of a recording of whose camera there are no times."""
    folders = (run, run / VIDEOS_FOLDER)
    found = (
        path
        for folder in folders
        if folder.is_dir()
        for path in sorted(folder.iterdir())
        if path.stem.endswith(f"_{stem}") and path.suffix.lower() in _VIDEO_ENDINGS
    )
    cameras = _cameras(run)
    return [path.name for path in found if path.stem.removesuffix(f"_{stem}") not in cameras]


def _video(run: Path, camera: str, stem: str) -> Path | None:
    places = (
        folder / f"{camera}_{stem}{ending}"
        for folder in (run / VIDEOS_FOLDER, run)
        for ending in _VIDEO_ENDINGS
    )
    return next((path for path in places if path.is_file() and not path.is_symlink()), None)


def _times(run: Path, camera: str, stem: str, notes: list[str]) -> Any:
    """Return the times of a video's frames, s; None where there are none."""
    path = run / _TIMES.format(camera)
    if not path.is_file():
        path = path.with_suffix(".pickle")
    try:
        found = _by_recording(path, path.stat().st_mtime_ns)
    except (OSError, InputError) as error:
        notes.append(f"{path.name} is not read: {error}")
        return None
    times = found.get(f"{camera}_{stem}", found.get(stem)) if isinstance(found, dict) else None
    if times is None or not len(times):
        return None
    try:
        values = np.asarray(times)
        if values.ndim != 1 or values.dtype.kind not in "iuf":
            raise ValueError("they are not numbers")
    except (ValueError, TypeError) as error:
        notes.append(f"the times of {stem} in {path.name} are not read: {error}")
        return None
    return values


@cache
def _by_recording(path: Path, changed_ns: int) -> Any:
    """Return the content of a pickle of times, which has those of all recordings of a run."""
    return read_pickle(path)


def _frames(video: Path, times: Any, notes: list[str]) -> Iterator[FrameChunk]:
    """Yield the frames of a video with their times, from the first one on."""
    t_ns = _in_ns(times)
    count = 0
    try:
        for count, image in enumerate(video_frames(video), 1):
            if count <= len(t_ns):
                row = t_ns[count - 1 : count]
                number = np.array([count - 1], np.int64)
                yield FrameChunk(image[None], number, row, row, np.zeros(1, np.uint8))
    except FormatError as error:
        notes.append(f"{video.name} {error}, after {count:,} frames")
    if count != len(t_ns):
        notes.append(
            f"{video.name} holds {count:,} frames, and there are {len(t_ns):,} times; paired from "
            "the first one on"
        )


def _in_ns(seconds: Any) -> Any:
    t_us = rounded_us(seconds, 1e6)
    return np.where(np.abs(t_us // 2) < LATEST_US, t_us, LATEST_US) * 1000


def _forces(
    run: Path, stem: str, notes: list[str]
) -> tuple[dict[str, WrenchChunk], dict[str, float]]:
    """Return the forces of a recording, and the resolution of their times, us."""
    folders = [run, *(each for each in sorted(run.iterdir()) if each.is_dir())]
    for path in (path for folder in folders for path in sorted(folder.iterdir())):
        if path.is_symlink() or not path.is_file() or path.suffix.lower() not in _FORCE_ENDINGS:
            continue
        rest = path.stem.replace(stem, "", 1).strip("_-") if stem in path.stem else ""
        in_folder = path.stem == stem and _FORCES.fullmatch(path.parent.name)
        if not (in_folder or _FORCES.fullmatch(rest)):
            continue
        try:
            columns = _force_columns(path)
        except (FormatError, InputError, ValueError, OSError) as error:
            notes.append(f"{path.name} is not read: {error}")
            continue
        t_ns = _in_ns(columns["t"])
        vectors = [
            np.stack([columns.get(axis, np.zeros(len(t_ns))) for axis in axes], axis=1)
            for axes in (_AXES[:3], _AXES[3:])
        ]
        notes.append(f"{path.name}: forces are taken as N and Nm, times as s")
        chunk = WrenchChunk(t_ns, t_ns, *(np.asarray(each, np.float64) for each in vectors))
        return {"force": chunk}, {"force": resolution_us(columns["t"], 1e6)}
    return {}, {}


def _force_columns(path: Path) -> dict[str, Any]:
    """Return time, s, forces and torques of a table: CSV with a heading, an array, or a pickle.

    Raises:
        FormatError: it has no such columns. InputError: it cannot be read.
    """
    if path.suffix.lower() == ".csv":
        import pandas as pd

        table = pd.read_csv(path, skipinitialspace=True)
        found: Any = {name: pd.to_numeric(table[name], errors="coerce") for name in table.columns}
    elif read_head(path).startswith(MAGIC):
        found = array_of(path.read_bytes())
    else:
        found = read_pickle(path)
    if isinstance(found, dict):
        plain = {re.sub(r"[ _\[(/].*", "", str(key)).lower(): found[key] for key in reversed(found)}
        time = next((plain[name] for name in _TIME_NAMES if name in plain), None)
        columns = {axis: plain[axis] for axis in _AXES if axis in plain}
        if time is None or not set(_AXES[:3]) <= set(columns):
            raise FormatError(
                f"has the columns {', '.join(map(str, found))}; t, fx, fy and fz are read"
            )
        columns = {"t": time, **columns}
    else:
        array = np.asarray(found)
        if array.ndim != 2 or array.shape[1] not in {4, 7} or array.dtype.kind not in "iuf":
            raise FormatError("holds no rows of t, fx, fy, fz (and tx, ty, tz)")
        columns = dict(zip(("t", *_AXES), array.T, strict=False))
    arrays = {key: np.asarray(values) for key, values in columns.items()}
    if any(a.ndim != 1 or a.dtype.kind not in "iuf" for a in arrays.values()):
        raise FormatError("holds values that are not numbers")
    if len({len(a) for a in arrays.values()}) != 1:
        raise FormatError("has columns of different lengths")
    return arrays


def described(trial: ForeignTrial, stem: str) -> ForeignTrial:
    """Return a trial with the condition and repetition that its recording's name says."""
    condition, repetition = named_condition(stem)
    if not condition:
        return trial
    unknown = ("units of the condition", *(what for what in trial.unknown if what != "condition"))
    return replace(trial, condition=condition, repetition=repetition, unknown=unknown)
