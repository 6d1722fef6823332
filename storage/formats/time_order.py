"""The longest consistent part of times that run back.

Rows are left out such that times do not decrease and the fewest rows are lost: the longest
non-decreasing subsequence. One wrong time costs one row, wherever it is, and rows of an earlier
recording at the start of a file cost those rows alone.

A clock that restarted within the recording gives two sequences, whose times overlap. Parts of both
would fit together, but were not recorded so. Such a place shows as many rows in a row that are left
out and whose times join those of the rows that stay. Then the part before and the part after the
restart are compared, and the longer one is taken whole.

Rows whose times are exactly those of rows before, such as of a packet that was sent twice, are no
restart: they are left out first.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.storage.kernels import njit
from sliplab.storage.streams import I64

Mask = npt.NDArray[np.bool_]
MOST_ROWS = 1 << 27
"""Rows that are searched, with 16 bytes of memory each; of more the longest run is taken."""
_RESTART_SHARE = 0.01
"""Share of the rows from which on those that are left out in a row may be a restart."""
_REPEATED, _MOST_FALLS = 8, 1000
"""Rows that make a repetition, and steps back up to which repetitions are looked for."""


def falls(times: I64) -> bool:
    """Return whether a time is earlier than the one before it."""
    return bool(np.any(times[1:] < times[:-1]))


def in_order(times: I64) -> Mask:
    """Return which rows form the longest consistent part, shape (n,).

    Args:
        times: in any unit, shape (n,).
    """
    if not falls(times):
        return np.ones(len(times), np.bool_)
    if len(times) > MOST_ROWS:
        return _longest_run(times)
    found = ~_repeated(times)
    found[found] = _consistent(times[found])
    return found


def _consistent(times: I64) -> Mask:
    """Return the longest consistent part of times that repeat none."""
    retained: Mask = _longest(np.ascontiguousarray(times, np.int64))
    at = _restart(times, retained)
    if at is None:
        return retained
    parts = [in_order(times[:at]), in_order(times[at:])]
    parts[int(parts[0].sum() >= parts[1].sum())][:] = False
    return np.concatenate(parts)


def _repeated(times: I64) -> Mask:
    """Return which rows repeat the times of rows before, as those of a packet sent twice do."""
    found = np.zeros(len(times), np.bool_)
    starts = np.flatnonzero(times[1:] < times[:-1]) + 1
    if len(starts) > _MOST_FALLS:
        return found
    latest = np.maximum.accumulate(times)
    for start, end in zip(starts, [*starts[1:], len(times)], strict=True):
        run = times[start:end]
        run = run[: np.searchsorted(run, latest[start - 1], "right")]
        first = int(np.searchsorted(latest[:start], run[0]))
        if first == 0 and run[-1] == latest[start - 1]:
            continue  # all of it again: a restart
        before = times[first:start][~found[first:start]]
        same = before[(before > run[0]) & (before <= run[-1])]
        again = run[run > run[0]][: len(same)]  # rows of the next packet may have the last time
        if len(same) >= _REPEATED and np.array_equal(again, same):
            found[start : start + int((run == run[0]).sum()) + len(again)] = True
    return found


def _longest_run(times: I64) -> Mask:
    """Return the longest run of rows without a step back."""
    ends = [0, *np.flatnonzero(times[1:] < times[:-1]) + 1, len(times)]
    at = int(np.diff(ends).argmax())
    retained = np.zeros(len(times), np.bool_)
    retained[ends[at] : ends[at + 1]] = True
    return retained


def _restart(times: I64, retained: Mask) -> int | None:
    """Return the row at which the clock restarted; None where it did not."""
    rows = np.flatnonzero(retained)
    gaps = np.diff(rows) - 1
    for gap in np.flatnonzero(gaps > _RESTART_SHARE * len(times)):
        low, high = int(rows[gap]), int(rows[gap + 1])
        part = times[low : high + 1]
        back = 1 + int(np.diff(part).argmin())
        before, after = part[1:back], part[back:-1]
        joins_before = len(before) and before[0] - part[0] <= before[-1] - before[0]
        joins_after = len(after) and part[-1] - after[-1] <= after[-1] - after[0]
        if joins_before or joins_after:
            return low + back
    return None


@njit(cache=True, nogil=True)
def _longest(times: Any) -> Any:
    """Return which rows form the longest non-decreasing subsequence (patience sorting)."""
    count = 0
    last = np.empty(len(times), np.int32)  # row at which the best sequence of each length ends
    before = np.empty(len(times), np.int32)  # row before each one, in its sequence
    for row in range(len(times)):
        low, high = 0, count
        if count and times[last[count - 1]] <= times[row]:
            low = count
        while low < high:
            middle = (low + high) // 2
            if times[last[middle]] <= times[row]:
                low = middle + 1
            else:
                high = middle
        before[row] = last[low - 1] if low else -1
        last[low] = row
        count = max(count, low + 1)
    retained = np.zeros(len(times), np.bool_)
    row = last[count - 1] if count else -1
    while row >= 0:
        retained[row] = True
        row = before[row]
    return retained
