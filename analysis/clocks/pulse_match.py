"""Pair the pulses of two trains: find the place where the trains fit, then the pairs.

A short piece of the device's train is laid on the reference wherever it may belong (a
cross-correlation by FFT, under several drifts); the best place must be the only one. From there the
pairs are followed outwards, strip by strip, each strip predicted from the pulses before it, so that
a clock that bends is not lost. A train without a code can only be placed by its start.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from sliplab.analysis.clocks.clock_line import theil_sen
from sliplab.analysis.clocks.pulse_kernels import fullest, pair, partners, quantile
from sliplab.protocols.shown import plural

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

MIN_PULSES = 24
"""Fewer than this may fit a 16-bit code in more than one place once some are lost."""
MAX_PEAK_RATIO = 0.9
"""Second correlation peak over the first: about 0.6 to 0.75 for the code, near 1 when regular."""

WIRED = "check the cable of the sync line, and that the recording is long enough"
"""Advice where pulses are too few."""

_PIECE_TICKS = 400
_PIECES = 5
_BINS_A_TICK = 4
_MAX_BINS = 1 << 22
_MAX_PLACES = 12
_STRIP_NS = 30e9


class NoMatchError(ValueError):
    """The trains fit nowhere, in several places, or hold too little; `reason` is a word for it."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


@dataclass(frozen=True)
class Match:
    """Indices (k,) of pulses in both trains that belong together, ascending; and how sure that is.

    peak_ratio: second best place over the best, 0 to 1; low is unambiguous.
    """

    device: Ints
    reference: Ints
    peak_ratio: float


@dataclass(frozen=True)
class _LocalFit:
    """Fit of a piece of the device's train: y = x + lag + drift (x - centre) near centre."""

    lag: float
    drift: float
    centre: float
    half: float


def match_trains(
    x: Floats, y: Floats, tick: float, max_drift: float, start_marker: float | None
) -> Match:
    """Pairs of pulses of two trains.

    Args:
        x, y: pulses of device and reference, ascending, ns, as floats near 0.
        tick: see `tick_of`.
        max_drift: of the device against the reference, a share.
        start_marker: silence after the first pulse by which a regular train is placed, ns.

    Raises:
        NoMatchError: there is no place, or more than one.
    """
    if start_marker is not None:
        return Match(*_follow(x, y, _by_marker(x, y, tick, start_marker), tick), 0.0)
    places, ratio = _coarse(x, y, tick, max_drift)
    pairs = [_follow(x, y, place, tick) for place in places]
    counts = [int(device.size) for device, _ in pairs]
    best = int(np.argmax(counts))
    if len(places) > 1:
        # the code has come round: only where all of the train fits is the right place
        ratio = sorted(counts)[-2] / max(counts[best], 1)
        _refuse_ambiguous(ratio)
    return Match(*pairs[best], ratio)


def tick_of(reference: Ints) -> float:
    """The grid on which pulses come: the shortest common interval between pulses, ns."""
    steps = np.diff(reference)
    tick = quantile(steps[steps > 0], 0.1) if (steps > 0).any() else 0.0
    if tick < 1_000:
        raise NoMatchError(
            "no_match",
            f"pulses of the reference come {tick:.0f} ns apart; at least 1000 ns are needed: check "
            "the unit of their times",
        )
    return tick


def _refuse_ambiguous(ratio: float) -> None:
    if ratio > MAX_PEAK_RATIO:
        raise NoMatchError(
            "ambiguous",
            f"the train fits in more than one place: the second best fits {ratio:.3f} times as "
            f"well as the best (at most {MAX_PEAK_RATIO}): send a code (lfsr), and check that both "
            "recordings are of the same trial",
        )


def _coarse(x: Floats, y: Floats, tick: float, max_drift: float) -> tuple[list[_LocalFit], float]:
    """Fit a piece of the train `x` into `y`; also the second correlation peak over the first.

    There is more than one place only where a handful fit equally well.
    """
    width = tick / _BINS_A_TICK
    y_start = y[0]
    if y[-1] - y_start > _MAX_BINS * width:
        raise NoMatchError(
            "no_match",
            f"the reference's pulses span {(y[-1] - y_start) / 3.6e12:.1f} h (at most "
            f"{_MAX_BINS * width / 3.6e12:.1f} h with such ticks): leave out stray stamps and "
            "other trials",
        )
    y_bins = np.zeros(int((y[-1] - y_start) / width) + 1, np.float32)
    y_bins[((y - y_start) / width).astype(np.int64)] = 1.0
    length = _PIECE_TICKS * tick
    best: list[_LocalFit] = []
    least = np.inf
    # by rank, not by time: a stray stamp far away must not decide where the pieces lie
    for rank in _spread(_PIECES):
        middle = float(x[int(rank * (x.size - 1))])
        first, last = np.searchsorted(x, [middle - length / 2, middle + length / 2])
        if last - first < MIN_PULSES:
            continue
        centre = float(x[first] + x[last - 1]) / 2
        half = float(x[last - 1] - x[first]) / 2
        lags, drifts, ratio = _correlate(x[first:last] - centre, y_bins, width, max_drift)
        if ratio < least:
            least = ratio
            best = [
                _LocalFit(lag + y_start - centre, drift, centre, half)
                for lag, drift in zip(lags, drifts, strict=True)
            ]
        if ratio < 0.8:
            break
    if not best:
        raise NoMatchError(
            "too_few_pulses",
            f"no stretch of {length / 1e9:.1f} s has the {MIN_PULSES} pulses that are needed: "
            f"{WIRED}",
        )
    if len(best) == 1 or len(best) > _MAX_PLACES:
        _refuse_ambiguous(least)
    return best, least


def _spread(count: int) -> list[float]:
    """Places in 0..1, the middle first."""
    return sorted(((i + 0.5) / count for i in range(count)), key=lambda place: abs(place - 0.5))


def _correlate(
    piece: Floats, y_bins: NDArray[np.float32], width: float, max_drift: float
) -> tuple[list[float], list[float], float]:
    """Lags of the piece's centre from bin 0 (ns) and drifts that fit best, and the peak ratio.

    One lag where the second peak is under `MAX_PEAK_RATIO`, else all that are above that.
    """
    half = max(-float(piece[0]), float(piece[-1])) * (1 + max_drift)
    bins = 2 * int(half / width + 1) + 1
    size = int(fft.next_fast_len(y_bins.size + bins + 2, real=True))
    spectrum = fft.rfft(y_bins, size)
    # one step of drift moves the piece's ends by a bin, or a little more
    steps = round(max_drift * half / width)
    drifts = np.linspace(-max_drift, max_drift, 2 * steps + 1) if steps else np.zeros(1)
    combs = np.zeros((drifts.size, bins + 2), np.float32)
    for comb, drift in zip(combs, drifts, strict=True):
        places = np.round(piece * (1 + drift) / width).astype(np.int64) + bins // 2 + 1
        comb[places] = 1.0
    # a pulse may fall on either side of an edge: let it count in the neighbours too
    combs[:, 1:-1] += 0.5 * (combs[:, 2:] + combs[:, :-2])
    products = fft.rfft(combs, size)
    np.multiply(spectrum, np.conj(products, out=products), out=products)
    every = fft.irfft(products, size, overwrite_x=True)
    # all counts are multiples of a half, which rounding finds again
    scores = np.rint(2.0 * every.max(axis=0))
    first = float(scores.max())
    columns: list[int] = []
    second = 0.0
    left = scores.copy()
    while len(columns) <= _MAX_PLACES:
        column = int(left.argmax())
        peak = float(left[column])
        if columns and peak <= MAX_PEAK_RATIO * first:
            second = max(second, peak)
            break
        second = peak if columns else 0.0
        columns.append(column)
        away = np.arange(column - int(0.6 * _BINS_A_TICK), column + int(0.6 * _BINS_A_TICK) + 1)
        left[away % size] = 0.0
    if first <= 0:
        return [0.0], [0.0], 1.0
    # round the train's end a lag is negative
    lags = [column if column < y_bins.size else column - size for column in columns]
    return (
        [(lag + bins // 2 + 1 + 0.5) * width for lag in lags],
        [float(drifts[np.rint(2.0 * every[:, column]).argmax()]) for column in columns],
        second / first,
    )


def _by_marker(x: Floats, y: Floats, tick: float, silence: float) -> _LocalFit:
    """Find the only pulse with the marker's silence after it, and one as long before it."""
    found = []
    for name, train in (("device", x), ("reference", y)):
        # a second report of a pulse is not another pulse
        once = train[np.concatenate([[True], np.diff(train) > tick / 4])]
        steps = np.diff(once)
        quiet_before = np.concatenate([[True], steps[:-1] > 0.9 * silence])
        marks = np.flatnonzero(quiet_before & (np.abs(steps - silence) < tick / 2))
        if marks.size != 1:
            raise NoMatchError(
                "ambiguous",
                f"the regular train of the {name} has {plural(marks.size, 'start marker')} "
                "(a pulse with "
                f"{silence / 1e9:g} s of silence after it) and needs exactly one: record from "
                "before the box starts, or send a code (lfsr)",
            )
        after = once[marks[0] + 1 :]
        if after.size < MIN_PULSES:
            raise NoMatchError(
                "too_few_pulses",
                f"the {name} has {plural(after.size, 'pulse')} after the start marker; at "
                f"least {MIN_PULSES} "
                f"are needed: {WIRED}",
            )
        found.append((float(once[marks[0]]), float(np.median(np.diff(after)))))
    (begin_x, step_x), (begin_y, step_y) = found
    half = 0.5 * silence + MIN_PULSES * tick
    drift = step_y / step_x - 1
    centre = begin_x + half
    return _LocalFit(begin_y - begin_x + drift * half, drift, centre, half)


def _follow(x: Floats, y: Floats, place: _LocalFit, tick: float) -> tuple[Ints, Ints]:
    """Pairs of the whole train, from a piece of it outwards."""
    slope, level = _first_line(x, y, place, tick)
    centre, half = place.centre, place.half
    first, last = np.searchsorted(x, [centre - half, centre + half], side="left")
    start = _pair_strip(x, y, int(first), int(last), centre, slope, level, tick)
    parts = [start]
    for side in (-1, 1):
        s, c = slope, level
        known, reach, edge = [start], half, (int(last) if side > 0 else int(first))
        while 0 < edge < x.size:
            step = min(2 * reach, _STRIP_NS)
            reach += step
            if side > 0:
                end = int(np.searchsorted(x, centre + reach, side="right"))
                strip = _pair_strip(x, y, edge, end, centre, s, c, tick)
            else:
                end = int(np.searchsorted(x, centre - reach, side="left"))
                strip = _pair_strip(x, y, end, edge, centre, s, c, tick)
            edge = end
            if strip[0].size:
                known.append(strip)
                known = known[-3:]
                i, j = (np.concatenate(column) for column in zip(*known, strict=True))
                near = np.abs(x[i] - x[strip[0]].mean()) < _STRIP_NS
                if near.sum() >= MIN_PULSES:
                    u = x[i[near]] - centre
                    order = np.argsort(u, kind="stable")
                    s, c = theil_sen(u[order], (y[j[near]] - x[i[near]])[order])
            elif reach > 100 * _STRIP_NS:
                break  # stray stamps from another age
            parts.append(strip)
    i, j = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(i, kind="stable")
    i, j = i[order], j[order]
    # at the strips' borders two may match the same partner
    once = np.concatenate([np.diff(j) > 0, [True]]) if j.size else np.zeros(0, np.bool_)
    return i[once], j[once]


def _first_line(x: Floats, y: Floats, place: _LocalFit, tick: float) -> tuple[float, float]:
    """y - x = level + slope (x - centre) in a piece: the mode of differences, then Theil-Sen."""
    first, last = np.searchsorted(x, [place.centre - place.half, place.centre + place.half])
    piece = x[first : last + 1]
    u = piece - place.centre
    predicted = u * (1 + place.drift) + place.centre + place.lag
    which, partner = partners(predicted, y, tick)
    difference = y[partner] - predicted[which]
    window = tick / 2
    start = fullest(np.sort(difference), window)
    chosen = (difference >= start) & (difference <= start + window)
    if chosen.sum() < MIN_PULSES // 2:
        raise NoMatchError(
            "no_match",
            f"{int(chosen.sum())} pulses match where the trains fit best; at least "
            f"{MIN_PULSES // 2} are needed: check that both recordings are of the same trial",
        )
    return theil_sen(u[which[chosen]], y[partner[chosen]] - piece[which[chosen]])


def _pair_strip(
    x: Floats,
    y: Floats,
    first: int,
    last: int,
    centre: float,
    slope: float,
    level: float,
    tick: float,
) -> tuple[Ints, Ints]:
    """Pairs of the device's pulses `first` to `last` that the line brings nearest to each other."""
    part = x[first:last]
    predicted = part + level + slope * (part - centre)
    if not part.size:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    low, high = np.searchsorted(y, [predicted[0] - tick, predicted[-1] + tick])
    if low == high:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    # a quarter tick leaves room for bends
    i, j = pair(predicted, y[low:high], tick / 4)
    return i + first, j + low
