"""Events to the network's samples: crop, pool and count, once, for training and live alike.

Every sample in the project, whether cut for training from a stored trial or taken from a running
camera, comes out of these functions, so training and live inputs are identical.
They read the sorted event columns in place; a campaign's hundreds of millions of events pass
through at tens of millions a second on one core.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.protocols.windows import Windows
from sliplab.storage.kernels import njit
from sliplab.storage.streams import EventChunk

_UNSORTED = -1


def bin_events(
    events: EventChunk,
    starts_us: NDArray[np.int64],
    settings: Windows,
    width: int = 640,
    height: int = 480,
    centre_px: tuple[float, float] | None = None,
) -> NDArray[np.uint8]:
    """Event counts of windows, by step, polarity and pooled cell.

    An event counts in the window [start, start + length), in step ``(t - start) // step``, in the
    cell of ``pool`` x ``pool`` pixels of the square crop that holds its pixel. With taxels all of
    the sensor counts: taxel ``row * width + column`` is a channel, and there is one cell; each part
    of a window has channels of its own, one part's after the other's.

    Args:
        events: k of them, sorted by time; pixels may be integers of any kind, polarity also bool or
            signed, positive where greater than 0.
        starts_us: (n,) int64, the windows' starts on the same clock, any order, may overlap.
        settings: window length, step, crop, pooling and polarity.
        width, height: the sensor's pixels.
        centre_px: column and row of the crop's middle, as near as it can be without leaving the
            sensor; the sensor's own middle by default. Taxels have no crop.

    Returns:
        (n, steps, channels, cells, cells) uint8, rows before columns; a count over 255 stays 255.
        With both polarities the negative channels are before the positive ones.

    Raises:
        ValueError: columns of unequal length or not 1-D, times not sorted, a pixel outside the
            sensor, a crop larger than the sensor, or another number of taxels than it has.
        TypeError: a column holds no integers.
    """
    columns = _columns(events)
    starts = _times(starts_us, "starts_us")
    of_x, of_y = _cells(settings, width, height, centre_px)
    shape = (starts.size, settings.steps, settings.channels, settings.cells, settings.cells)
    out = np.zeros((*shape[:2], settings.polarities, *_plane(settings, width, height)), np.uint8)
    state = _bin(
        *columns, starts, settings.step_ms * 1000, _CODES[settings.polarity], of_x, of_y, out
    )
    _raise_for_status(state, columns, width, height)
    if settings.parts == 1:
        return out.reshape(shape)
    found = np.zeros((*shape[:2], settings.parts, math.prod(out.shape[2:])), np.uint8)
    for step in range(settings.steps):
        found[:, step, settings.part(step)] = out[:, step].reshape(len(out), found.shape[3])
    return found.reshape(shape)


def list_events(
    events: EventChunk,
    starts_us: NDArray[np.int64],
    settings: Windows,
    width: int = 640,
    height: int = 480,
    centre_px: tuple[float, float] | None = None,
) -> SparseWindows:
    """The same windows as lists of their non-empty cells, in one pass.

    Arguments and errors as `bin_events`; ``list_events(...).dense()`` is what that returns.
    """
    columns = _columns(events)
    starts = _times(starts_us, "starts_us")
    of_x, of_y = _cells(settings, width, height, centre_px)
    shape = (settings.steps, settings.channels, settings.cells, settings.cells)
    times = columns[3]
    ends = np.searchsorted(times, starts + settings.length_ms * 1000)
    most = int((ends - np.searchsorted(times, starts)).clip(min=0).sum())
    offsets = np.zeros(starts.size * settings.steps + 1, np.int64)
    cell, count = np.empty(most, np.uint32), np.empty(most, np.uint8)
    rows, across = _plane(settings, width, height)
    plane = np.zeros(settings.polarities * rows * across + 1, np.uint8)
    state = _list(
        *columns,
        starts,
        settings.step_ms * 1000,
        settings.steps,
        _CODES[settings.polarity],
        of_x,
        of_y,
        rows,
        across,
        plane,
        np.empty(plane.size, np.uint32),
        offsets,
        cell,
        count,
    )
    _raise_for_status(state, columns, width, height)
    cell, count = cell[: offsets[-1]].copy(), count[: offsets[-1]].copy()
    if settings.parts > 1:
        first = [settings.part(step) * (plane.size - 1) for step in range(settings.steps)]
        cell += np.repeat(np.tile(np.array(first, np.uint32), starts.size), np.diff(offsets))
    return SparseWindows(shape, offsets, cell, count)


_CODES = {"negative": 0, "positive": 1, "both": 2}

_Columns = tuple[NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint8], NDArray[np.int64]]


def _columns(events: EventChunk) -> _Columns:
    x, y, p, t_us = events.x, events.y, events.p, events.t_us
    if not len(x) == len(y) == len(p) == len(t_us):
        lengths = f"x {len(x)}, y {len(y)}, p {len(p)}, t_us {len(t_us)}"
        raise ValueError(f"event columns of unequal length: {lengths}")
    polarity: NDArray[Any] = np.asarray(p)
    if polarity.dtype.kind not in "iub" or polarity.ndim != 1:
        raise TypeError(
            f"p must be a 1-D integer or bool array, not {polarity.dtype} {polarity.shape}"
        )
    if polarity.dtype.itemsize > 1 or polarity.dtype.kind == "i":
        polarity = polarity > 0
    return (
        _pixels(x, "x"),
        _pixels(y, "y"),
        np.ascontiguousarray(polarity).view(np.uint8),
        _times(t_us, "t_us"),
    )


def _pixels(values: NDArray[Any], name: str) -> NDArray[np.uint16]:
    array = np.asarray(values)
    if array.dtype.kind not in "iu" or array.ndim != 1:
        raise TypeError(f"{name} must be a 1-D integer array, not {array.dtype} {array.shape}")
    if array.dtype != np.uint16:
        if array.size and not (array.min() >= 0 and array.max() < 1 << 16):
            raise ValueError(f"{name} holds {array.min()} to {array.max()}: not pixels")
        array = array.astype(np.uint16)
    return np.ascontiguousarray(array)


def _times(values: NDArray[Any], name: str) -> NDArray[np.int64]:
    array = np.asarray(values)
    if array.dtype.kind not in "iu" or array.ndim != 1:
        raise TypeError(f"{name} must be 1-D int64 microseconds, not {array.dtype} {array.shape}")
    return np.ascontiguousarray(array, np.int64)


def first_pixel(size: int, crop: int, centre: float | None) -> int:
    """First pixel of a crop of `crop` pixels along a side of `size` pixels."""
    if centre is None:
        return (size - crop) // 2
    return min(max(round(centre - (crop - 1) / 2), 0), size - crop)


def _cells(
    settings: Windows, width: int, height: int, centre_px: tuple[float, float] | None
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """The cell column of each x and the cell row of each y; -1 outside the crop."""
    if settings.taxels is not None:
        if settings.taxels != width * height:
            raise ValueError(
                f"taxels = {settings.taxels}: the sensor has {width} x {height} = {width * height}"
            )
        return np.arange(width, dtype=np.int32), np.arange(height, dtype=np.int32)
    crop, pool = settings.crop_px, settings.pool_px
    if crop > width or crop > height:
        raise ValueError(f"crop_px = {crop}: larger than the sensor's {width} x {height} pixels")

    def along(size: int, centre: float | None) -> NDArray[np.int32]:
        inside = np.arange(size) - first_pixel(size, crop, centre)
        cells = np.where((inside >= 0) & (inside < crop), inside // pool, -1)
        return cells.astype(np.int32)

    column, row = centre_px or (None, None)
    return along(width, column), along(height, row)


def _plane(settings: Windows, width: int, height: int) -> tuple[int, int]:
    """Rows and columns of the places that `_cells` gives."""
    return (settings.cells,) * 2 if settings.taxels is None else (height, width)


def _raise_for_status(state: int, columns: _Columns, width: int, height: int) -> None:
    if state == 0:
        return
    if state == _UNSORTED:
        i = int(np.flatnonzero(np.diff(columns[3]) < 0)[0])
        raise ValueError(
            f"events not sorted by time: event {i} at {columns[3][i]} us, then {columns[3][i + 1]}"
        )
    i = state - 1
    raise ValueError(
        f"event {i} at pixel ({columns[0][i]}, {columns[1][i]}): outside {width} x {height}"
    )


@njit(cache=True, nogil=True)
def _fault(x: Any, y: Any, t: Any, width: int, height: int) -> int:
    """0, or _UNSORTED, or one plus the index of the first event outside the sensor."""
    # no early exit, so that the loop is vectorised
    unsorted = False
    for i in range(1, t.size):
        unsorted |= t[i] < t[i - 1]
    if unsorted:
        return _UNSORTED
    outside = False
    for i in range(x.size):
        outside |= (x[i] >= width) | (y[i] >= height)
    if outside:
        for i in range(x.size):
            if x[i] >= width or y[i] >= height:
                return i + 1
    return 0


@njit(cache=True, nogil=True)
def _bin(
    x: Any,
    y: Any,
    p: Any,
    t: Any,
    starts: Any,
    step_us: int,
    polarity: int,
    of_x: Any,
    of_y: Any,
    out: Any,
) -> int:
    state = _fault(x, y, t, of_x.size, of_y.size)
    if state != 0:
        return state
    steps = out.shape[1]
    for n in range(starts.size):
        end = starts[n] + step_us
        step = 0
        for i in range(np.searchsorted(t, starts[n]), t.size):
            # times are sorted: walking the step along spares a division an event
            while t[i] >= end and step < steps:
                end += step_us
                step += 1
            if step == steps:
                break
            column, row = of_x[x[i]], of_y[y[i]]
            positive = p[i] != 0
            if column < 0 or row < 0 or (polarity != 2 and positive != (polarity == 1)):
                continue
            channel = 1 if polarity == 2 and positive else 0
            count = out[n, step, channel, row, column]
            if count < 255:
                out[n, step, channel, row, column] = count + 1
    return 0


@njit(cache=True, nogil=True)
def _list(
    x: Any,
    y: Any,
    p: Any,
    t: Any,
    starts: Any,
    step_us: int,
    steps: int,
    polarity: int,
    of_x: Any,
    of_y: Any,
    rows: int,
    across: int,
    plane: Any,
    touched: Any,
    offsets: Any,
    cell: Any,
    count: Any,
) -> int:
    state = _fault(x, y, t, of_x.size, of_y.size)
    if state != 0:
        return state
    both, wanted, dummy = polarity == 2, polarity == 1, plane.size - 1
    e = 0
    for n in range(starts.size):
        end = starts[n]
        i = np.searchsorted(t, end)
        for step in range(steps):
            end += step_us
            m = 0
            while i < t.size and t[i] < end:
                column, row, positive = of_x[x[i]], of_y[y[i]], p[i] != 0
                i += 1
                # half of the events have the other polarity, unpredictable for the processor:
                # they are written to a dummy last cell, without a branch
                selected = (column >= 0) & (row >= 0) & (both | (positive == wanted))
                place = ((both & positive) * rows + row) * across + column if selected else dummy
                found = plane[place]
                touched[m] = place
                m += (found == 0) & selected
                plane[place] = found + (found < 255)
            for k in range(m):
                # few, and nearly sorted: each goes down to where it belongs
                place = touched[k]
                at = k
                while at > 0 and touched[at - 1] > place:
                    touched[at] = touched[at - 1]
                    at -= 1
                touched[at] = place
            for k in range(m):
                cell[e] = touched[k]
                count[e] = plane[touched[k]]
                plane[touched[k]] = 0
                e += 1
            offsets[n * steps + step + 1] = e
    return 0
