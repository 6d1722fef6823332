"""Sorting of events by time: a radix sort, because a comparison sort costs more than the scene."""

from __future__ import annotations

import numpy as np
from numba import njit

_BITS = 9
_SIZE = 1 << _BITS


@njit(cache=True, nogil=True)
def sort_tail(t, x, y, p, begin, end, origin):  # type: ignore[no-untyped-def]
    """Sort rows `begin` to `end` of four columns by `t`, stable, in place.

    `t` (int64) is not below `origin`; the passes needed grow with its span: three for 134 ms.
    """
    n = end - begin
    if n < 2:
        return
    keys = np.empty(n, np.int64)
    order, other = np.arange(n), np.empty(n, np.int64)
    longest = 0
    for k in range(n):
        keys[k] = t[begin + k] - origin
        longest = max(longest, keys[k])
    shift = 0
    counts = np.empty(_SIZE, np.int64)
    while longest >> shift > 0:
        counts[:] = 0
        for k in range(n):
            counts[(keys[k] >> shift) & (_SIZE - 1)] += 1
        total = 0
        for k in range(_SIZE):
            count = counts[k]
            counts[k] = total
            total += count
        for k in range(n):
            row = order[k]
            digit = (keys[row] >> shift) & (_SIZE - 1)
            other[counts[digit]] = row
            counts[digit] += 1
        order, other = other, order
        shift += _BITS
    sorted_x, sorted_y = x[begin:end][order], y[begin:end][order]
    sorted_p = p[begin:end][order]
    t[begin:end] = origin + keys[order]
    x[begin:end], y[begin:end], p[begin:end] = sorted_x, sorted_y, sorted_p
