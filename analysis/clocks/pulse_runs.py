"""Do the pulses that a line leaves out lie here and there, or do they stand together?

Pulses that are lost, late or spurious lie anywhere. A clock that jumps, or begins to drift
otherwise, leaves out all that come after; then the line is right before and wrong after, and its
residuals look as good as ever, for what lies off the line is not in them. So where device and
reference both have pulses one after the other and few of them fit, the fit must be refused.
"""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import special

from sliplab.analysis.clocks.pulse_kernels import most_off

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

CHANCE = 1e-5
"""How often a train whose bad pulses lie anywhere is taken for one whose clock jumped."""
BURST = 9
"""Pulses in a row that may be bad at once for another reason, as when a device is busy."""
BURST_AT_END = 2
"""The same at the trains' ends, where nothing after it vouches for the line. A clock that jumps at
the last two pulses cannot be told from two late pulses."""
_WIDTHS = (16, 24, 32, 48, 64, 96, 128)
_WIDTHS_AT_END = (8, 12, 16, 24, 32)
_LEAST, _MOST_DEVICE, _MOST_REFERENCE = 0.02, 0.25, 0.4
"""Shares of bad pulses that are assumed at least and at most: a jump must not vouch for itself."""
_MOST_LOSSY = 0.48
"""The same where both trains have more bad ones than that, which then is asked of their best
quarters."""


def stray_stretch(
    predicted: Floats, reference: Floats, i: Ints, j: Ints, slack_ns: float
) -> str | None:
    """What is wrong with a fit that leaves out a stretch of pulses, in words; None if it is fine.

    In a window of w reference pulses let a be those off the line, and b the device's pulses there
    that are. Chance makes both large at once with at most P(a >= k) P(b >= k), k = min(a, b).

    Args:
        predicted: (m,) device pulses on the reference clock by the fitted line, ns, ascending.
        reference: (n,) reference pulses, ns, ascending.
        i, j: (k,) indices of pulses that belong together and lie on the line, ascending.
        slack_ns: how far a pulse on the line may be from it.
    """
    bad_device, bad_reference = _share(i), _share(j)
    if min(bad_device, bad_reference) > _MOST_DEVICE:
        bad_device, bad_reference = (min(_best_quarter(k), _MOST_LOSSY) for k in (i, j))
    else:
        bad_device = min(bad_device, _MOST_DEVICE)
        bad_reference = min(bad_reference, _MOST_REFERENCE)
    places = reference.size.bit_length()
    # between pulses on the line: those that both trains have there, and neither on the line
    both = np.minimum(_left_out(i, predicted.size), _left_out(j, reference.size))
    off_line = f"lie off the line, by more than {slack_ns / 1e3:.1f} us"
    run = int(both[1:-1].max(initial=0))
    most = max(BURST, _limit(run, bad_device, bad_reference, places))
    if run > most:
        return f"{run} pulses in a row {off_line} (at most {most} may)"
    run = int(max(both[0], both[-1]))
    most = max(BURST_AT_END, _limit(run, bad_device, bad_reference, 1))
    if run > most:
        which = "first" if both[0] == run else "last"
        return f"the {which} {run} pulses {off_line} (at most {most} may)"
    fits = np.zeros(reference.size + 1, np.int64)
    fits[j + 1] = 1
    fits = np.cumsum(fits)
    low = np.searchsorted(predicted, reference - slack_ns, side="left")
    high = np.searchsorted(predicted, reference + slack_ns, side="right")
    for widths, at_ends, least, log_places in (
        (_WIDTHS, False, BURST, places), (_WIDTHS_AT_END, True, BURST_AT_END, 1),
    ):  # fmt: skip
        for width in widths:
            if width > reference.size:
                continue
            off = most_off(width, fits, low, high, at_ends)
            most = max(least, _limit(width, bad_device, bad_reference, log_places))
            if off > most:
                where = "at one end" if at_ends else "in a row"
                return f"of {width} pulses {where} {off} {off_line} (at most {most} may)"
    return None


def _left_out(on_line: Ints, size: int) -> Ints:
    """How many pulses lie before the first, between two, and after the last that is on the line."""
    return np.diff(np.concatenate([[-1], on_line, [size]])) - 1


def _share(on_line: Ints) -> float:
    """Share of bad pulses between the first and the last good one, in steps of 2 %, rounded up."""
    total = int(on_line[-1] - on_line[0]) + 1
    return max(math.ceil(50 * (1.0 - on_line.size / total)) / 50, _LEAST)


def _best_quarter(on_line: Ints) -> float:
    """The same of the quarter with the fewest, and two standard deviations of it."""
    first, total = int(on_line[0]), int(on_line[-1] - on_line[0]) + 1
    edges = [first + k * total // 4 for k in range(5)]
    there = np.searchsorted(on_line, edges).tolist()
    quarters = zip(pairwise(there), pairwise(edges), strict=True)
    bad, count = min((1.0 - (b - a) / max(d - c, 1), d - c) for (a, b), (c, d) in quarters)
    bad += 2.0 * ((bad * (1.0 - bad) + 1.0 / max(count, 1)) / max(count, 1)) ** 0.5
    return math.ceil(50 * bad) / 50


def unevenness(on_line: Ints) -> float:
    """By how many standard deviations the share of pulses on the line differs before and after.

    The largest of all times that leave 16 pulses on either side.
    """
    total = int(on_line[-1] - on_line[0]) + 1
    good = np.zeros(total)
    good[on_line - on_line[0]] = 1.0
    before, count = np.cumsum(good)[15:-16], np.arange(16, total - 15)
    if not count.size:
        return 0.0
    share = on_line.size / total
    away = np.abs(before - share * count)
    chance = np.sqrt(share * (1.0 - share) * count * (total - count) / total)
    return float((away / np.maximum(chance, 1e-9)).max())


@lru_cache(maxsize=4096)
def _limit(width: int, device: float, reference: float, log_places: int) -> int:
    """As many of `width` pulses may be off the line by chance, in one of 2**log_places windows."""
    k = np.arange(width)
    both = special.bdtrc(k, width, device) * special.bdtrc(k, width, reference)
    return int((both * 2.0**log_places * 10 > CHANCE).sum())
