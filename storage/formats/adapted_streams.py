"""Streams of a foreign data set from its files: events, frames, poses, forces and readings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from sliplab.protocols.adapter_parts import (
    TIME_UNITS,
    EventFiles,
    FrameFiles,
    FrameTimes,
    PoseFiles,
    ScalarFiles,
    WrenchFiles,
)
from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import plural
from sliplab.storage.formats.data_folder import DataFolder
from sliplab.storage.formats.foreign import (
    MOST_PX,
    ForeignChunk,
    ForeignTrial,
    FormatError,
    event_chunk,
    resolution_us,
)
from sliplab.storage.formats.known import known_format
from sliplab.storage.formats.numpy_files import MAGIC, array_of
from sliplab.storage.formats.pictures import decode_picture, levels_of, opened_video
from sliplab.storage.formats.recognition import read_file
from sliplab.storage.formats.tables import read_columns, times_ns
from sliplab.storage.formats.time_order import is_unordered
from sliplab.storage.streams import (
    F64,
    I64,
    U8,
    EventChunk,
    FrameChunk,
    PoseChunk,
    ScalarChunk,
    WrenchChunk,
)

SampleT = TypeVar("SampleT", PoseChunk, WrenchChunk, ScalarChunk)
_BLOCK_CELLS = 1 << 24
_BLOCK_EVENTS = 1 << 22
_FRAMES_AT_ONCE = 32
_FEW_FRAMES = 3
"""Difference of the numbers of frames and of their times that is accepted; or a tenth."""
UNKNOWN = 2
"""A polarity that is left out."""
NO_COUNT = "events of cells that hold no whole number"
NO_ROW = "{} in rows that are not all numbers"
MOST_EVENTS = 1 << 32
"""Events that an array of counts may state."""


@dataclass(frozen=True)
class AdaptedEvents:
    """Events that can be read.

    Attributes:
        chunks: in order of time.
        size_px: columns and rows of the sensor; called once `chunks` were read.
        span_us: begin and end of the recording, where the file says them.
        foreign: the recording of a format that may hold more than events.
    """

    chunks: Callable[[], Iterator[EventChunk]]
    size_px: Callable[[], tuple[int, int] | None]
    span_us: tuple[int, int] | None = None
    foreign: ForeignTrial | None = None


def read_counts(array: Any, part: EventFiles) -> AdaptedEvents:
    """Turn counts per time step into events.

    A count c in step k becomes c events at ``k step + i step / c`` for i from 0 to c - 1, cut to
    microseconds: steps of the same length give the counts back exactly.

    Args:
        array: counts, with the axes that `part` names.

    Raises:
        FormatError: other axes, another size, or an invalid count.
    """
    axes: list[str] = list(part.axes)
    if array.ndim != len(axes):
        raise FormatError(
            f"holds an array of shape {array.shape}; the adapter names {len(axes)} axes "
            f"({', '.join(axes)})"
        )
    if array.dtype.kind not in "iufb":
        raise FormatError(f"holds {array.dtype}, which are no counts")
    for axis in ("polarity", "y"):
        if axis not in axes:
            array, axes = np.expand_dims(array, -1), [*axes, axis]
    places = "taxel" if "taxel" in axes else "x"
    array = array.transpose([axes.index(axis) for axis in ("step", "y", places, "polarity")])
    steps, rows, columns, polarities = array.shape
    order = part.polarity_order if "polarity" in part.axes else ("positive",)
    if polarities != len(order):
        raise FormatError(
            f"holds {polarities} polarities; polarity_order of the adapter names {len(order)}"
        )
    if 0 in array.shape or max(rows, columns) > MOST_PX:
        raise FormatError(f"holds counts of {columns} x {rows} places in {steps} steps")
    if part.size_px is not None and (columns, rows) != part.size_px:
        raise FormatError(
            f"holds {columns} x {rows} places; size_px of the adapter is {list(part.size_px)}"
        )
    step_us = round((part.step_ms or 0.0) * 1000)
    polarity = np.array([name == "positive" for name in order], np.uint8)
    block = max(1, _BLOCK_CELLS // (rows * columns * polarities))

    def chunks() -> Iterator[EventChunk]:
        total = 0
        for first in range(0, steps, block):
            counts, wrong = _whole(array[first : first + block], part)
            total += int(counts.sum())
            if total > MOST_EVENTS:
                raise FormatError(f"holds more than {MOST_EVENTS} events")
            chunk = _spread(counts, first, step_us, polarity)
            yield replace(chunk, left_out={NO_COUNT: wrong}) if wrong else chunk

    return AdaptedEvents(chunks, lambda: (columns, rows), (0, steps * step_us))


def _whole(counts: Any, part: EventFiles) -> tuple[I64, int]:
    """Return counts with 0 in place of invalid cells, and the number of such cells.

    Raises:
        FormatError: there are as many of those as of counts above 0.
    """
    if counts.dtype.kind == "f":
        with np.errstate(invalid="ignore"):
            good = (counts >= 0) & (counts == np.floor(counts)) & (counts <= MOST_EVENTS)
    else:
        good = (counts >= 0) & (counts <= MOST_EVENTS)
    wrong = len(good.ravel()) - int(good.sum())
    if wrong and wrong >= int((np.where(good, counts, 0) > 0).sum()):
        step, row, column, polarity = (int(i) for i in np.argwhere(~good)[0])
        raise FormatError(
            f"holds {counts[step, row, column, polarity]} where a count belongs: step {step} of "
            f"its block, row {row}, {'taxel' if 'taxel' in part.axes else 'column'} {column}, "
            f"polarity {polarity}"
        )
    return np.asarray(np.where(good, counts, 0) if wrong else counts, np.int64), wrong


def _spread(counts: I64, first: int, step_us: int, polarity: U8) -> ForeignChunk:
    step, y, x, p = np.nonzero(counts)
    each = counts[step, y, x, p]
    begin = np.repeat(np.cumsum(each) - each, each)
    index = np.arange(len(begin)) - begin
    step, y, x, p, each = (np.repeat(column, each) for column in (step, y, x, p, each))
    t = (first + step) * step_us + index * step_us // each
    order = np.argsort(t, kind="stable")
    return event_chunk(x[order], y[order], polarity[p[order]], t[order])


def read_events(
    folder: DataFolder,
    names: Sequence[str],
    part: EventFiles,
    paths: Sequence[Path],
    salvage: bool = False,
) -> AdaptedEvents:
    """Open the events of a trial.

    Args:
        names: its files; paths: them on the disk, for formats that need it.
        salvage: read the intact part of a file that is damaged where it begins to be read.

    Raises:
        FormatError: a file cannot be right.
    """
    if part.format == "counts":
        data = folder.read(names[0])
        if not bytes(data[: len(MAGIC)]) == MAGIC:
            raise FormatError(
                "is no array of numpy (.npy), of which counts are read; readings of pressures or "
                "forces are streams under scalars or wrenches, and a trial may be without events"
            )
        return read_counts(array_of(data), part)
    if part.format in {"csv", "numpy"}:
        return _event_table(folder, names[0], part)
    read_files = known_format(part.format).read_files
    if read_files is not None:
        foreign = read_files(paths, "trial")
    else:
        if len(paths) != 1:
            raise FormatError(f"are {len(paths)} files for one trial")
        foreign = read_file(part.format, paths[0], "trial", salvage)
    return AdaptedEvents(foreign.events, foreign.event_px, None, foreign)


def _event_table(folder: DataFolder, name: str, part: EventFiles) -> AdaptedEvents:
    assert part.columns is not None
    assert part.unit is not None
    columns = {
        key: column for key, column in part.columns.model_dump().items() if column is not None
    }
    unit, size, positive = part.unit, part.size_px, part.positive

    def chunks() -> Iterator[EventChunk]:
        found, wrong = read_columns(folder, name, part.format, columns)
        t_us = (times_ns(found["t"], unit) + 500) // 1000
        resolution = resolution_us(
            found["t"], TIME_UNITS[unit] / 1000, whole_us=1e6 if unit == "s" else 0.0
        )
        x = _places(found["x"])
        y = _places(found["y"]) if "y" in found else np.zeros(len(x), np.int64)
        p = np.ones(len(x), np.int8)
        if "p" in found:
            if not positive:
                _check_polarities(found["p"])
            p[:] = np.isin(found["p"], positive) if positive else found["p"] > 0
            p[np.isnan(found["p"])] = UNKNOWN
        valid = t_us >= 0
        if is_unordered(t_us[valid], p[valid] > 0):
            order = np.argsort(t_us, kind="stable")
            t_us, x, y, p = t_us[order], x[order], y[order], p[order]
        for first in range(0, len(t_us), _BLOCK_EVENTS):
            cut = slice(first, first + _BLOCK_EVENTS)
            chunk = event_chunk(x[cut], y[cut], p[cut], t_us[cut], resolution)
            if wrong and not first:
                chunk = replace(chunk, left_out={**chunk.left_out, NO_ROW.format("events"): wrong})
            yield chunk

    return AdaptedEvents(chunks, lambda: size)


def _check_polarities(values: Any) -> None:
    """Check that integers on one side of 0 are not two polarities, such as 1 and 2."""
    if values.dtype.kind not in "iu" or not len(values):
        return
    low, high = int(values.min()), int(values.max())
    if low < high and (low > 0) == (high > 0):
        raise FormatError(
            f"holds polarities from {low} to {high}, {'all' if low > 0 else 'none'} above 0; "
            "`positive` says which of them are ON"
        )


def _places(values: Any) -> Any:
    """Return columns or rows of pixels, -1 for invalid ones."""
    if values.dtype.kind != "f":
        return values
    with np.errstate(invalid="ignore"):
        whole = values.astype(np.int64)
        return np.where(whole == values, whole, -1)


def read_frames(
    folder: DataFolder,
    names: Sequence[str],
    times: Sequence[str],
    part: FrameFiles,
    paths: Sequence[Path],
) -> tuple[tuple[int, int], Callable[[], Iterator[FrameChunk]], FrameNotes]:
    """Open the frames of a trial; return width and height, what reads them, and notes.

    Frames behind the last time are left out. Where the numbers of frames and of times differ, the
    notes state it once the frames were read.

    Raises:
        FormatError: a file cannot be right.
        InputError: the file of times cannot be right.
    """
    images = _images(folder, names, part, paths)
    first = next(images(), None)
    if first is None:
        raise FormatError("holds no frame")
    size = (first.shape[1], first.shape[0])
    notes = FrameNotes()
    stated = None
    if part.times is not None:
        stated, notes.resolution_us = _frame_times(folder, times[0], part.times)

    def chunks() -> Iterator[FrameChunk]:
        held: list[U8] = []
        count = 0
        for image in images():
            if held and (image.shape != held[0].shape or len(held) == _FRAMES_AT_ONCE):
                yield _frames(held, count, stated, part)
                count += len(held)
                held = []
            held.append(image)
        if held:
            yield _frames(held, count, stated, part)
        count += len(held)
        if stated is not None and count != len(stated):
            if abs(count - len(stated)) > max(_FEW_FRAMES, count // 10) or not len(stated):
                raise FormatError(f"holds {count:,} frames, and {len(stated):,} times of frames")
            notes.texts.append(
                f"holds {count:,} frames, and {len(stated):,} times of frames; paired from the "
                "first one on"
            )

    return size, chunks, notes


@dataclass
class FrameNotes:
    """Findings of reading the frames: warnings, and the resolution of their times, us."""

    texts: list[str] = field(default_factory=list)
    resolution_us: float = 0.0


def _frame_times(folder: DataFolder, name: str, part: FrameTimes) -> tuple[I64, float]:
    """Return the times of frames, ns, and their resolution, us."""
    is_numpy = name.lower().endswith((".npy", ".npz"))
    try:
        if is_numpy:
            found = _one_column(folder, name, part.column)
        else:
            columns, wrong = read_columns(folder, name, "csv", {"t": part.column})
            if wrong:  # which frame is of which time is unknown from there on
                raise FormatError(f"has {plural(wrong, 'row')} without a number")
            found = columns["t"]
    except FormatError as error:
        where = "streams.frames.times"
        raise InputError(folder.place(name), where, None, str(error)) from None
    return times_ns(found, part.unit), resolution_us(found, TIME_UNITS[part.unit] / 1000)


def _one_column(folder: DataFolder, name: str, column: str | int) -> Any:
    data = folder.read(name)
    if name.lower().endswith(".npy"):
        array = array_of(data)
        if array.ndim == 1 and array.dtype.kind in "iuf":
            return array
    return read_columns(folder, name, "numpy", {"t": column})[0]["t"]


def _frames(images: list[U8], first: int, stated: I64 | None, part: FrameFiles) -> FrameChunk:
    number = np.arange(first, first + len(images), dtype=np.int64)
    if stated is None:
        t_ns = np.rint(number * (1e9 / float(part.rate_hz or 1))).astype(np.int64)
    else:
        t_ns = stated[first : first + len(images)]
        images, number = images[: len(t_ns)], number[: len(t_ns)]
    levels = np.stack(images) if images else np.empty((0, 0, 0), np.uint8)
    return FrameChunk(levels, number, t_ns, t_ns, np.zeros(len(images), np.uint8))


def _images(
    folder: DataFolder, names: Sequence[str], part: FrameFiles, paths: Sequence[Path]
) -> Callable[[], Iterator[U8]]:
    if part.format == "images":

        def from_images() -> Iterator[U8]:
            for name in names:
                try:
                    yield decode_picture(folder.read(name))
                except FormatError as error:
                    raise type(error)(f"{error}: {name}") from None

        return from_images
    if part.format == "numpy":
        array = array_of(folder.read(names[0]))
        if array.ndim != 3 or array.dtype != np.uint8 or 0 in array.shape:
            raise FormatError(
                f"holds {array.dtype} of shape {array.shape}; frames are uint8 of shape (frames, "
                "height, width)"
            )
        return lambda: iter(array)

    def from_video() -> Iterator[U8]:
        with opened_video(paths[0]) as (video, stream):
            for frame in video.decode(stream):
                yield levels_of(frame)

    return from_video


@dataclass(frozen=True)
class TableSamples(Generic[SampleT]):
    """Rows of a table.

    Attributes:
        resolution_us: of the type of their times, us.
        wrong: number of rows that were left out because they are not all numbers.
    """

    chunk: SampleT
    resolution_us: float
    wrong: int


def read_poses(folder: DataFolder, name: str, part: PoseFiles) -> TableSamples[PoseChunk]:
    """Read the poses of a trial. Raises FormatError: the table cannot be right."""
    t_ns, found, about = _samples(folder, name, part)
    metres, radians = part.length == "m", part.angle == "rad"
    xyz = _vectors(found, ("x", "y", "z"), len(t_ns)) * (1000.0 if metres else 1.0)
    turned = _vectors(found, ("rx", "ry", "rz"), len(t_ns))
    return TableSamples(
        PoseChunk(t_ns, t_ns, xyz, np.rad2deg(turned) if radians else turned), *about
    )


def read_wrench(folder: DataFolder, name: str, part: WrenchFiles) -> TableSamples[WrenchChunk]:
    """Read forces and torques. Raises FormatError: the table cannot be right."""
    t_ns, found, about = _samples(folder, name, part)
    force = _vectors(found, ("fx", "fy", "fz"), len(t_ns))
    torque = _vectors(found, ("tx", "ty", "tz"), len(t_ns))
    return TableSamples(WrenchChunk(t_ns, t_ns, force, torque), *about)


def read_scalar(folder: DataFolder, name: str, part: ScalarFiles) -> TableSamples[ScalarChunk]:
    """Read one quantity. Raises FormatError: the table cannot be right."""
    t_ns, found, about = _samples(folder, name, part)
    values = found["value"].astype(np.float64)
    return TableSamples(ScalarChunk(t_ns, t_ns, values, part.quantity_unit), *about)


def _samples(
    folder: DataFolder, name: str, part: PoseFiles | WrenchFiles | ScalarFiles
) -> tuple[I64, dict[str, Any], tuple[float, int]]:
    """Return times, ns, and columns, with the resolution of the times, us, and rows left out."""
    columns = {
        key: column for key, column in part.columns.model_dump().items() if column is not None
    }
    found, wrong = read_columns(folder, name, part.format, columns)
    resolution = resolution_us(found["t"], TIME_UNITS[part.unit] / 1000)
    return times_ns(found["t"], part.unit), found, (resolution, wrong)


def _vectors(found: dict[str, Any], keys: tuple[str, str, str], rows: int) -> F64:
    columns = [found.get(key, np.zeros(rows)) for key in keys]
    return np.stack([np.asarray(column, np.float64) for column in columns], axis=1)
