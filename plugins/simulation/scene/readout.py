"""Read-out of an event camera: the dead time of a pixel, and the scans of the array.

The DVXplorer does not send an event when it happens: it scans its pixels, by default 5000 times a
second. A scan begins with a hold of the whole array; what happens later waits for the next scan.
Then column after column is read, at 15 cycles of 50 MHz each: 192 us for 640 columns, and 7 us
until the next hold (dv-processing, `setDVXplorerEFPS`, `EFPS_VARIABLE_5000`). All events of a
column have one stamp, that of its reading (libcaer's `dvxplorer.c`: stamp, column, groups of eight
rows). A column in which many groups fire takes longer, and with it the scan, up to 0.85 ms for all;
that is left out here: at a million events a second a column has fewer than one event in a scan.

A pixel has room for one event: it holds the first until it is read and reports nothing else in
that scan. What it sees meanwhile is not lost from its reference level, as if it were read at once;
with a dead time of half a millisecond there is rarely more than one. Inside a scan, events are
ordered as they are read: by column, then by row. A scan that is not complete when a stream stops
is never read.

Events are packed into one integer each, from the highest bit: time, column (12 bits), row (12
bits), polarity (1 bit). They are sorted by radix, for a comparison sort costs more than the scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.storage.kernels import njit
from sliplab.storage.streams import I64, U8, U16

NEVER_NS = -(1 << 62)
_TIME_BITS = 27


@dataclass(frozen=True)
class ScanTimes:
    """Times at which a read-out scans its array and reads each column, true ns."""

    period_ns: int
    """From one scan to the next; 0: every event has its own time."""
    phase_ns: int
    """A scan begins at this time, and every `period_ns` before and after it."""
    column_ns: float
    """From one column to the next; 0: all of a scan at its begin."""
    width: int
    """Columns of the array."""

    @property
    def reading_ns(self) -> int:
        """From the begin of a scan until its last column has been read."""
        return int(self.width * self.column_ns)

    def begin(self, t_ns: I64) -> I64:
        """Begin of the scan that reads what happened at `t_ns`, int64, (n,)."""
        return self.phase_ns - (self.phase_ns - t_ns) // self.period_ns * self.period_ns

    def stamp(self, begin_ns: I64, x: U16) -> I64:
        """Time at which columns `x` of the scans that begin at `begin_ns` are read, int64, (n,)."""
        return begin_ns + (x * self.column_ns).astype(np.int64)


@njit(cache=True, nogil=True, error_model="numpy")
def bits_for(largest: int) -> int:
    """Count the bits that hold the numbers 0 to `largest`."""
    n = 0
    while largest >> n > 0:
        n += 1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def _row_of(where: int, y_bits: int) -> int:
    return where & ((1 << y_bits) - 1)


@njit(cache=True, nogil=True, error_model="numpy")
def _column_of(where: int, y_bits: int, x_bits: int) -> int:
    return (where >> y_bits) & ((1 << x_bits) - 1)


@njit(cache=True, nogil=True, error_model="numpy")
def read_each(
    events: I64,
    n: int,
    other: I64,
    base_ns: int,
    span_ns: int,
    refractory_ns: int,
    fired: I64,
    t_ns: I64,
    xs: U16,
    ys: U16,
    ps: U8,
    retained: int,
) -> int:
    """Deliver a block's events with their own times.

    Args:
        events: packed (see above), their times ns after `base_ns`, at most `span_ns`; overwritten.
        other: scratch, as long.
        fired: time (ns) at which each pixel last fired, (height, width), written.
        t_ns, xs, ys, ps: output, written from index `kept` on.

    Returns:
        how many they hold now.
    """
    # with literals numba would compile it once more
    sort_packed(events, n, other, np.int64(25), 25 + bits_for(span_ns))
    for k in range(n):
        event = events[k]
        t = base_ns + (event >> 25)
        x, y = (event >> 13) & 4095, (event >> 1) & 4095
        if t - fired[y, x] < refractory_ns:
            continue
        fired[y, x] = t
        t_ns[retained], xs[retained], ys[retained], ps[retained] = t, x, y, event & 1
        retained += 1
    return retained


@njit(cache=True, nogil=True, error_model="numpy")
def read_scans(
    events: I64,
    n: int,
    other: I64,
    base_ns: int,
    end_ns: int,
    period_ns: int,
    phase_ns: int,
    column_ns: float,
    refractory_ns: int,
    fired: I64,
    t_ns: I64,
    xs: U16,
    ys: U16,
    ps: U8,
    retained: int,
) -> tuple[int, int]:
    """Deliver the scans that are read to their last column by `end_ns`; see `read_each`.

    Args:
        period_ns, phase_ns, column_ns: see `ScanTimes`.

    Returns:
        how many events are delivered in all, and how many of later scans are left: these are
        at the front of `events`, their times unchanged.
    """
    height, width = fired.shape
    y_bits, x_bits = bits_for(height - 1), bits_for(width - 1)
    low, mask = _TIME_BITS + 1, (1 << (_TIME_BITS + 1)) - 1
    first = (base_ns - phase_ns) // period_ns
    start_ns = phase_ns + first * period_ns
    lead_ns = base_ns - start_ns + period_ns - 1
    past = (end_ns - np.int64(width * column_ns) - phase_ns) // period_ns - first
    left, inside, per_ns = 0, np.int64(0), 1.0 / period_ns
    for k in range(n):
        event = events[k]
        # exact, for a half is far more than what rounding adds, and cheaper than a division
        scan = np.int64(((event >> 25) + lead_ns + 0.5) * per_ns)
        if scan > past:
            events[left] = event
            left += 1
            continue
        where = (scan << x_bits | (event >> 13) & 4095) << y_bits | (event >> 1) & 4095
        other[inside] = where << low | (event >> 25) << 1 | event & 1
        inside += 1
    # the sorted events are behind the left-over ones
    keys = events[left:]
    for k in range(inside):
        keys[k] = other[k]
    # few events of a scan share a column: insertion puts their rows in order
    sort_packed(keys, inside, other, low + y_bits, low + y_bits + x_bits + bits_for(past))
    for k in range(inside):
        # cache misses are requested together, not one pixel after the other
        other[k] = fired[
            _row_of(keys[k] >> low, y_bits), _column_of(keys[k] >> low, y_bits, x_bits)
        ]
    for k in range(inside):
        key = keys[k]
        t = base_ns + ((key & mask) >> 1)
        where = key >> low
        x, y = _column_of(where, y_bits, x_bits), _row_of(where, y_bits)
        begin = start_ns + (where >> (y_bits + x_bits)) * period_ns
        before = fired[y, x]
        if t - before < refractory_ns or before > begin - period_ns:
            continue
        fired[y, x] = t
        t_ns[retained], xs[retained] = begin + np.int64(x * column_ns), x
        ys[retained], ps[retained] = y, key & 1
        retained += 1
    return retained, left


_BITS = 9
_SIZE = 1 << _BITS
_SHORT = 24


@njit(cache=True, nogil=True, error_model="numpy")
def larger(array: npt.NDArray[Any], capacity: int) -> npt.NDArray[Any]:
    """`array` with room for `capacity` elements."""
    grown = np.empty(capacity, array.dtype)
    grown[: array.shape[0]] = array
    return grown


@njit(cache=True, nogil=True, error_model="numpy")
def sort_packed(keys: I64, n: int, other: I64, low: int, high: int) -> None:
    """Sort the first `n` of `keys` (int64, not negative) in place.

    Bits `low` to `high` (without) are sorted by counting, 9 at a time; keys that are equal in them
    are sorted by insertion, so these bits should distinguish nearly all keys.

    Args:
        other: scratch, as long as `keys`.
    """
    shift = low
    if n > _SHORT:
        counts = np.empty(_SIZE, np.int64)
        source, target = keys, other
        while shift < high:
            mask = (1 << min(_BITS, high - shift)) - 1
            counts[: mask + 1] = 0
            for k in range(n):
                counts[(source[k] >> shift) & mask] += 1
            total = 0
            for k in range(mask + 1):
                count = counts[k]
                counts[k] = total
                total += count
            for k in range(n):
                key = source[k]
                digit = (key >> shift) & mask
                target[counts[digit]] = key
                counts[digit] += 1
            source, target = target, source
            shift += _BITS
        if (high - low + _BITS - 1) // _BITS % 2:
            for k in range(n):
                keys[k] = other[k]
    for k in range(1, n):
        key = keys[k]
        j = k
        while j > 0 and keys[j - 1] > key:
            keys[j] = keys[j - 1]
            j -= 1
        keys[j] = key
