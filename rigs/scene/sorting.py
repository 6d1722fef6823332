"""Sorting of events packed into one integer each: a radix sort, for a comparison sort costs more
than the scene.

A packed event is, from the highest bit: time, column (12 bits), row (12 bits), polarity (1 bit).
"""

from __future__ import annotations

import numpy as np
from numba import njit

_BITS = 9
_SIZE = 1 << _BITS
_SHORT = 24


@njit(cache=True, nogil=True, error_model="numpy")
def larger(array, capacity):  # type: ignore[no-untyped-def]
    """`array` with room for `capacity` elements."""
    grown = np.empty(capacity, array.dtype)
    grown[: array.shape[0]] = array
    return grown


@njit(cache=True, nogil=True, error_model="numpy")
def sort_packed(keys, n, other, low, high):  # type: ignore[no-untyped-def]
    """Sort the first `n` of `keys` (int64, not negative) in place.

    Bits `low` to `high` (without) are sorted by counting, 9 at a time; what is equal in them is
    put in order by insertion, so they should tell nearly all keys apart.

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
