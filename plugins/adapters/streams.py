"""Streams of a foreign data set from its files: events, frames, poses, forces and readings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

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
    ForeignChunk,
    ForeignTrial,
    FormatError,
    Whole,
    check_size,
    event_chunk,
    resolution_us,
)
from sliplab.storage.formats.known import joined, known_format
from sliplab.storage.formats.numpy_files import MAGIC, array_of
from sliplab.storage.formats.pictures import decode_picture, video_frames
from sliplab.storage.formats.recognition import read_file
from sliplab.storage.formats.tables import column_chunks, read_columns, times_ns
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

_BLOCK_CELLS = 1 << 20
_BLOCK_EVENTS = 1 << 18
_FRAMES_AT_ONCE = 32
_FEW_FRAMES = 3
"""Difference of the numbers of frames and of their times that is accepted; or a tenth."""
UNKNOWN = 2
"""A polarity that is left out."""
NO_COUNT = "events of cells that hold no whole number"
NO_ROW = "{} in rows that are not all numbers"
MOST_EVENTS = 1 << 32
"""Events that an array of counts may state."""


def read_counts(array: Any, part: EventFiles) -> ForeignTrial:
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
    if 0 in array.shape:
        raise FormatError(f"holds counts of {columns} x {rows} places in {steps} steps")
    check_size("holds counts", (columns, rows))
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
            for low, high in _parts(counts):
                chunk = _spread(counts[low:high], first + low, step_us, polarity)
                yield replace(chunk, left_out={NO_COUNT: wrong}) if wrong else chunk
                wrong = 0

    whole = Whole((0, steps * step_us * 1000))
    size = columns, rows
    return ForeignTrial("trial", "", chunks, "", lambda: size, whole=lambda seen: whole)


def _parts(counts: I64) -> Iterator[tuple[int, int]]:
    """Yield ranges of steps with about `_BLOCK_EVENTS` events each; of more, a single step."""
    part = np.cumsum(counts.sum(axis=(1, 2, 3))) // _BLOCK_EVENTS
    starts = np.flatnonzero(np.diff(part, prepend=-1)).tolist()
    yield from pairwise([*starts, len(counts)])


def _whole(counts: Any, part: EventFiles) -> tuple[I64, int]:
    """Return counts with 0 in place of invalid cells, and the number of such cells.

    Raises:
        FormatError: there are as many of those as of counts above 0.
    """
    if counts.dtype.kind == "f":
        counts = counts.astype(np.float64, copy=False)  # 16 bits do not reach the limit
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
) -> ForeignTrial:
    """Open the events of a trial, and what else their files hold.

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
    if known_format(part.format).read is None:
        found = joined(dict.fromkeys(paths), part.format, paths[0])
        if len(found) != 1:
            raise FormatError(f"are files of {len(found)} recordings of {part.format}, not of one")
        return found[0].read("trial", salvage)
    if len(paths) != 1:
        raise FormatError(f"are {len(paths)} files for one trial")
    return read_file(part.format, paths[0], "trial", salvage)


def _event_table(folder: DataFolder, name: str, part: EventFiles) -> ForeignTrial:
    assert part.columns is not None
    assert part.unit is not None
    columns = {
        key: column for key, column in part.columns.model_dump().items() if column is not None
    }
    unit, size, positive = part.unit, part.size_px, part.positive

    def chunks() -> Iterator[EventChunk]:
        seen: list[int] = []
        for found, wrong in column_chunks(folder, name, part.format, columns):
            t_us = (times_ns(found["t"], unit) + 500) // 1000
            resolution = resolution_us(
                found["t"], TIME_UNITS[unit] / 1000, whole_us=1e6 if unit == "s" else 0.0
            )
            x = _places(found["x"])
            y = _places(found["y"]) if "y" in found else np.zeros(len(x), np.int64)
            p = np.ones(len(x), np.int8)
            if "p" in found:
                if not positive:
                    _check_polarities(found["p"], seen)
                p[:] = np.isin(found["p"], positive) if positive else found["p"] > 0
                p[np.isnan(found["p"])] = UNKNOWN
            chunk = event_chunk(x, y, p, t_us, resolution)
            if wrong:
                chunk = replace(chunk, left_out={**chunk.left_out, NO_ROW.format("events"): wrong})
            yield chunk

    return ForeignTrial("trial", "", chunks, "", lambda: size, any_order=True)


def _check_polarities(values: Any, seen: list[int]) -> None:
    """Check that integers on one side of 0 are not two polarities, such as 1 and 2.

    Args:
        seen: the lowest and highest one so far; changed.
    """
    if values.dtype.kind not in "iu" or not len(values):
        return
    seen.extend((int(values.min()), int(values.max())))
    seen[:] = low, high = min(seen), max(seen)
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
    return partial(video_frames, paths[0])


@dataclass(frozen=True)
class TableSamples:
    """Rows of a table.

    Attributes:
        resolution_us: of the type of their times, us.
        wrong: number of rows that were left out because they are not all numbers.
    """

    chunk: PoseChunk | WrenchChunk | ScalarChunk
    resolution_us: float
    wrong: int


def read_samples(
    folder: DataFolder, name: str, part: PoseFiles | WrenchFiles | ScalarFiles
) -> TableSamples:
    """Read the poses of a trial, its forces and torques, or readings of one quantity.

    Raises:
        FormatError: the table cannot be right.
    """
    columns = {
        key: column for key, column in part.columns.model_dump().items() if column is not None
    }
    found, wrong = read_columns(folder, name, part.format, columns)
    t_ns = times_ns(found["t"], part.unit)

    def vectors(*keys: str) -> F64:
        each = [found.get(key, np.zeros(len(t_ns))) for key in keys]
        return np.stack([np.asarray(column, np.float64) for column in each], axis=1)

    chunk: PoseChunk | WrenchChunk | ScalarChunk
    if isinstance(part, PoseFiles):
        xyz = vectors("x", "y", "z") * (1000.0 if part.length == "m" else 1.0)
        turned = vectors("rx", "ry", "rz")
        turned = np.rad2deg(turned) if part.angle == "rad" else turned
        chunk = PoseChunk(t_ns, t_ns, xyz, turned)
    elif isinstance(part, WrenchFiles):
        force, torque = vectors("fx", "fy", "fz"), vectors("tx", "ty", "tz")
        chunk = WrenchChunk(t_ns, t_ns, force, torque)
    else:
        values = found["value"].astype(np.float64)
        chunk = ScalarChunk(t_ns, t_ns, values, part.quantity_unit)
    return TableSamples(chunk, resolution_us(found["t"], TIME_UNITS[part.unit] / 1000), wrong)
