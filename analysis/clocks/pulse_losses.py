"""Pulses that a fit leaves out: whether losses and noise explain them, or the fit is wrong.

A fit's residuals show those pulses alone that have a partner. A clock that jumps, or another
trial's train, has pulses without one. Each test here compares what is left out with what chance
makes of one trial's trains, as often as they lose pulses elsewhere. Two of them look at the ticks
of the code, on which pulses lie and noise does not: a train of another trial whose code began some
ticks earlier has pulses before the first one and lacks as many ticks at its end, and behind a jump
by whole ticks pulses fit better some ticks on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import special

from sliplab.analysis.clocks.pulse_kernels import best_shift, most_off

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

CHANCE = 1e-5
"""Probability that scattered bad pulses are mistaken for a jump of the clock."""
BURST = 9
"""Pulses in a row that may be bad at once for another reason, as when a device is busy."""
BURST_AT_END = 2
"""The same at the trains' ends, where nothing later confirms the line. A clock that jumps at
the last two pulses cannot be distinguished from two late pulses."""
_WIDTHS = (16, 24, 32, 48, 64, 96, 128)
_WIDTHS_AT_END = (8, 12, 16, 24, 32)
_LEAST, _MOST_DEVICE, _MOST_REFERENCE = 0.02, 0.25, 0.4
"""Shares of bad pulses that are assumed at least and at most: a jump must not confirm itself."""
_MOST_LOSSY = 0.48
"""The same where both trains have more bad ones than that, which then is asked of their best
quarters."""
END_TICKS = 32
"""Ticks beyond a train's end in which the other's pulses count: noise lies on so few by accident
once in hundreds of trains. A code is silent for no longer."""
JUMP_TICKS = 100
"""Largest jump that is searched, in either direction, ticks."""


def stray_stretch(
    predicted: Floats, reference: Floats, i: Ints, j: Ints, slack_ns: float
) -> str | None:
    """Describe a stretch of pulses that a fit leaves out; None if there is none.

    Pulses that are lost, late or spurious lie anywhere. A clock that jumps, or begins to drift
    otherwise, leaves out all that come after: the line is right before and wrong after, and its
    residuals do not show it. So where both trains have pulses in a row and few of them fit, the fit
    must be refused.

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
        (_WIDTHS, False, BURST, places),
        (_WIDTHS_AT_END, True, BURST_AT_END, 1),
    ):
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
    """Count pulses before the first, between two, and after the last that is on the line."""
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
    """Change of the share of pulses on the line from before to after, standard deviations.

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
    """Return how many of `width` pulses may be off by chance, in one of 2**log_places windows."""
    k = np.arange(width)
    both = special.bdtrc(k, width, device) * special.bdtrc(k, width, reference)
    return int((both * 2.0**log_places * 10 > CHANCE).sum())


@dataclass(frozen=True)
class TickTrains:
    """Ticks on which the device has a pulse and those on which the reference has one.

    Attributes:
        device, reference: (m,) and (n,) ascending, each once, from the reference's first pulse.
    """

    device: Ints
    reference: Ints

    @cached_property
    def both(self) -> Ints:
        """Ticks on which both have a pulse."""
        return np.intersect1d(self.device, self.reference, assume_unique=True)

    def covered(self, ticks: Ints, beyond: int = 0) -> Ints:
        """Return those from the first to the last tick on which both have a pulse, or beyond."""
        low, high = int(self.both[0]) - beyond, int(self.both[-1]) + beyond
        found: Ints = ticks[(ticks >= low) & (ticks <= high)]
        return found


def on_ticks(predicted: Floats, reference: Floats, tick: float, slack_ns: float) -> TickTrains:
    """Number the ticks of two trains.

    Args:
        predicted: (m,) device pulses on the reference clock, ns, ascending.
        reference: (n,) reference pulses, ns, ascending; two at least.
        tick: a tick, ns, nearly: how many the train has makes it exact.
        slack_ns: a device pulse that is further from the next tick lies on none.
    """
    numbers = np.concatenate([[0], np.cumsum(np.rint(np.diff(reference) / tick))])
    tick = float(reference[-1] - reference[0]) / max(float(numbers[-1]), 1.0)
    right = np.clip(np.searchsorted(reference, predicted), 1, reference.size - 1)
    near = right - (predicted - reference[right - 1] < reference[right] - predicted)
    away = (predicted - reference[near]) / tick
    whole = np.rint(away)
    on = np.abs(away - whole) * tick <= slack_ns
    return TickTrains(
        np.unique(numbers[near[on]] + whole[on]).astype(np.int64),
        np.unique(numbers).astype(np.int64),
    )


@dataclass(frozen=True)
class Ends:
    """Pulses of one train that precede the other, and of the other that follow it.

    Attributes:
        earlier, later: which is which, ``device`` or ``reference``.
        first: pulses of the earlier one before the later one begins.
        last: pulses of the later one behind the earlier one's end.
        chance: probability that the trains of one trial, with their losses, look so.
    """

    earlier: str
    later: str
    first: int
    last: int
    chance: float


def staggered_ends(trains: TickTrains) -> Ends:
    """Judge the trains' ends: one trial's pulses are lost there as often as anywhere.

    The earlier train's first pulses are then lost by the later one, and the later one's last by the
    earlier. How often a train loses pulses is known from those between the ends: after k of n, the
    next is lost with probability (k + 1) / (n + 2) (Laplace's rule of succession).
    """
    device = _ends("device", trains.device, "reference", trains.reference, trains)
    reference = _ends("reference", trains.reference, "device", trains.device, trains)
    return min(device, reference, key=lambda ends: ends.chance)


def _ends(earlier: str, one: Ints, later: str, other: Ints, trains: TickTrains) -> Ends:
    first = int(((one < other[0]) & (one >= other[0] - END_TICKS)).sum())
    last = int(((other > one[-1]) & (other <= one[-1] + END_TICKS)).sum())
    chance = 1.0
    if first and last:
        for lost, ticks in ((first, one), (last, other)):
            of = trains.covered(ticks).size
            missed = of - trains.both.size
            chance *= math.prod((missed + 1 + k) / (of + 2 + k) for k in range(lost))
    return Ends(earlier, later, first, last, chance)


def better_shift(trains: TickTrains) -> tuple[int, float]:
    """Find the jump by whole ticks that explains two trains best, and how likely chance does.

    A pulse of the device has a partner with probability p where the trains fit, and with q, the
    share of ticks with a pulse, where they do not. If the clock jumped by s ticks, each pulse from
    there on (or up to there) that has a partner s ticks away and none in its place makes the jump
    more likely by p (1 - q) / (q (1 - p)), and the other way round less. Without a jump these
    products are martingales: one of them ever exceeds c with a probability of 1 / c at most (Ville
    1939), and any of them all with as many times that.

    Returns:
        the jump, ticks; and the most that this probability is, 1 where nothing speaks for a jump.
    """
    device = trains.covered(trains.device)
    first, count = int(device[0]), int(device[-1] - device[0]) + 1
    there = np.zeros(count + 2 * JUMP_TICKS, np.int8)
    there[trains.covered(trains.reference, JUMP_TICKS) - first + JUMP_TICKS] = 1
    at = device - first + JUMP_TICKS
    here = there[at]
    half = device.size // 2
    # behind a jump few pulses fit
    share = min(max(float(here[:half].mean()), float(here[half:].mean())), 0.95) if half else 0.0
    density = float(there[JUMP_TICKS : JUMP_TICKS + count].mean())
    if share <= density:
        return 0, 1.0
    more_likely = math.log(share * (1.0 - density) / (density * (1.0 - share)))
    jump, more = best_shift(there, at, JUMP_TICKS)
    # either side of the pulse at which it jumped
    ways = 4 * JUMP_TICKS
    return int(jump), min(ways * math.exp(-more_likely * more), 1.0)
