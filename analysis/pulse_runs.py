"""Whether the pulses that a clock fit leaves out lie scattered, or all in one stretch.

A robust line shrugs off pulses that are late or spurious here and there. A clock that jumps, or
drifts from some moment on, puts a whole stretch of pulses off the line instead, and the line that
ignores them is wrong there by as much as the clock jumped. So where device and reference both have
pulses one after the other and none of them fit, the fit must be refused.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

MAX_RUN = 9
"""Pulses one after the other that may be off the line on both trains: 0.2 s of the code. Chance
puts ten there once in 10^10 when a tenth of the pulses are bad."""
MAX_RUN_AT_END = 2
"""The same at the trains' ends, where nothing after it vouches for the line. A clock that jumps at
the last two pulses cannot be told from two late pulses."""
_WINDOWS = ((40, 9, False), (16, 3, True), (8, 2, True))
"""Pulses in a window, how many of them may be off the line on both trains, and whether it is only
laid at the ends. Of a clock that jumps by whole ticks, half of the pulses meet others."""


def stray_stretch(
    predicted: Floats, reference: Floats, i: Ints, j: Ints, slack_ns: float
) -> str | None:
    """What is wrong with a fit that leaves out a stretch of pulses, in words; None if it is fine.

    Args:
        predicted: (m,) device pulses on the reference clock by the fitted line, ns, ascending.
        reference: (n,) reference pulses, ns, ascending.
        i, j: (k,) indices of pulses that belong together and lie on the line, ascending.
        slack_ns: how far a pulse on the line may be from it.
    """
    left_out = [
        np.diff(np.concatenate([[-1], index, [size]])) - 1
        for index, size in ((i, predicted.size), (j, reference.size))
    ]
    both = np.minimum(*left_out)
    inner = int(both[1:-1].max(initial=0))
    if inner > MAX_RUN:
        return f"{inner} pulses one after the other lie off the line"
    ends = int(max(both[0], both[-1]))
    if ends > MAX_RUN_AT_END:
        return f"the {ends} pulses at one end lie off the line"
    fits = np.zeros(reference.size + 1, np.int64)
    fits[j + 1] = 1
    fits = np.cumsum(fits)
    for width, allowed, at_ends in _WINDOWS:
        if reference.size < width:
            continue
        first = np.arange(reference.size - width + 1)
        first = first[[0, -1]] if at_ends else first
        low = np.searchsorted(predicted, reference[first] - slack_ns, side="left")
        high = np.searchsorted(predicted, reference[first + width - 1] + slack_ns, side="right")
        on_line = fits[first + width] - fits[first]
        there = high - low
        # a device that reports few pulses lost some: no doubt about its clock. Where it reports
        # far too many, noise hides what the clock does
        clean = there <= 1.5 * width
        off = int((np.minimum(there, width) - on_line).max(initial=0, where=clean))
        if off > allowed:
            return f"of {width} pulses one after the other {off} lie off the line"
    return None
