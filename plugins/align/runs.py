"""Stretches over which two lists of event times agree on one clock, with no jump inside.

A stretch begins where the pairs lie closest to a line, and grows in blocks, each predicted by the
pairs before it. It ends where more events miss their partner than before: a cumulative sum of
log-likelihood ratios (Page 1954), for behind a jump by whole ticks every other event of a code
still finds one. What lies before and behind is searched in turn.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from sliplab.analysis.clocks.clock_line import theil_sen
from sliplab.analysis.clocks.pulse_kernels import median, pair
from sliplab.analysis.clocks.pulse_match import NoMatchError, match_trains, tick_of

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

BEND_PER_NS = 0.4e-15
"""Largest change of a clock's drift, per ns: a crystal that warms by 10 K in a minute."""
MIN_EVENTS = 24
"""Events of a stretch that is found by its pattern."""
MIN_KNOWN = 5
"""Events of a stretch whose pairs are known, by their ids or an approximate offset."""
CHANCE = 1e-10
"""Probability by which chance may pair as many events at one place, of up to a million places."""
MOST_ALIKE = 0.9
"""Share of events paired at the next best place, in that of the best: above, it is ambiguous."""
_BLOCK = 8
_RECENT = 64
_GATE = 6.0
_EVIDENCE = 14.0
"""Log-likelihood ratio at which a stretch ends."""
_SHIFTS = 32
_REFUSALS = {
    "ambiguous": "the lists fit in more than one place, as regular pulses do, or halves of a list "
    "with a jump in its middle: check that both saw the same events, and send a code or random "
    "intervals",
    "too_few_pulses": f"no {MIN_EVENTS} events of A come as close together as those of B",
}


@dataclass(frozen=True)
class PairedRun:
    """Indices (k,) of events of one stretch in both lists, ascending."""

    a: Ints
    b: Ints


@dataclass(frozen=True)
class _Line:
    """y = x + level + slope (x - centre), from pairs whose x span `run` and scatter by `sigma`."""

    slope: float
    level: float
    centre: float
    run: float
    sigma: float
    size: int

    @staticmethod
    def through(x: Floats, y: Floats, floor: float) -> _Line:
        centre = float(x[x.size // 2])
        slope, level = theil_sen(x - centre, y - x)
        rest = np.abs(y - x - level - slope * (x - centre))
        sigma = max(1.4826 * median(rest), floor)
        return _Line(slope, level, centre, max(float(np.ptp(x)), 1.0), sigma, x.size)

    def at(self, x: Floats) -> Floats:
        result: Floats = x + self.level + self.slope * (x - self.centre)
        return result

    def gate(self, x: Floats) -> float:
        """Return how far events at x may be off the line, ns."""
        away = float(np.abs(x - self.centre).max())
        turn = 4.0 * self.sigma / self.run / self.size**0.5
        beyond = max(away - self.run / 2, 0.0)
        return _GATE * (self.sigma + turn * away) + 0.5 * BEND_PER_NS * beyond**2


Pairing = Callable[[int, int, _Line], tuple[Ints, Ints, int]]
"""Pairs of events of A from one index up to another by a line, and how many there could be."""


def runs_by_pattern(x: Floats, y: Floats, max_drift: float, floor: float) -> list[PairedRun]:
    """Stretches in which both lists show the same pattern of intervals.

    Args:
        x, y: event times of A and B, ascending, ns, as floats near 0.
        max_drift: of A against B, a share.
        floor: smallest scatter of the stamps, ns.

    Raises:
        NoMatchError: the lists fit nowhere, or in several places.
    """
    found: list[PairedRun] = []
    first: NoMatchError | None = None
    # remainders: events of A and of B from one index up to another
    left = [(0, x.size, 0, y.size)]
    while left:
        a, b, c, d = left.pop()
        if min(b - a, d - c) < MIN_EVENTS:
            continue
        try:
            run = _one_run(x[a:b], y[c:d], max_drift, floor)
        except NoMatchError as error:
            first = first or error
            continue
        run = PairedRun(run.a + a, run.b + c)
        found.append(run)
        left.append((a, int(run.a[0]), c, int(run.b[0])))
        left.append((int(run.a[-1]) + 1, b, int(run.b[-1]) + 1, d))
    if not found:
        raise first or NoMatchError(
            "too_few_pulses",
            f"A has {x.size} events and B {y.size}; at least {MIN_EVENTS} are needed, or events "
            "with ids, or an approximate offset",
        )
    return sorted(found, key=lambda run: int(run.a[0]))


def _one_run(x: Floats, y: Floats, max_drift: float, floor: float) -> PairedRun:
    tick = tick_of(np.rint(y).astype(np.int64))
    try:
        match = match_trains(x, y, tick, 1.02 * max_drift, None)
    except NoMatchError as error:  # it speaks of a sync line
        raise NoMatchError(error.reason, _REFUSALS.get(error.reason, str(error))) from None
    if match.device.size < MIN_EVENTS:
        raise NoMatchError("no_match", f"only {match.device.size} events match")
    begin, end = _best_window(x, y, match.device, match.reference, MIN_EVENTS, floor)
    seed = PairedRun(match.device[begin:end], match.reference[begin:end])
    line = _Line.through(x[seed.a], y[seed.b], floor)

    def paired(first: int, last: int, by: _Line) -> tuple[Ints, Ints, int]:
        return _nearest(x, y, first, last, by)

    i, j, could = paired(int(seed.a[0]), int(seed.a[-1]) + 1, line)
    by_chance, _ = _other_places(x, y, PairedRun(i, j), line)
    run = _grown(x, y, PairedRun(i, j), paired, (i.size / max(could, 1), by_chance), floor)
    by_chance, next_best = _other_places(x, y, run, _Line.through(x[run.a], y[run.b], floor))
    share = run.a.size / (min(int(np.ptp(run.a)), int(np.ptp(run.b))) + 1)
    if next_best > MOST_ALIKE * share:
        raise NoMatchError(
            "ambiguous",
            f"the lists fit in more than one place: the next best fits {next_best / share:.2f} "
            f"times as well (at most {MOST_ALIKE}), as regular pulses do: send a "
            "code or random intervals",
        )
    could = min(int(np.ptp(run.a)), int(np.ptp(run.b))) + 1
    chance = float(stats.binom.sf(run.a.size - 1, could, min(1.1 * by_chance + 0.01, 1.0)))
    if run.a.size < MIN_EVENTS or chance > CHANCE:
        raise NoMatchError(
            "no_match",
            f"{run.a.size} of {could} events match at the best place; chance does that with a "
            f"probability of {chance:.1g} (at most {CHANCE:g}): check that both saw the same "
            "events",
        )
    return run


def runs_by_pairs(x: Floats, y: Floats, floor: float) -> list[PairedRun]:
    """Stretches of pairs that lie on one clock.

    Args:
        x, y: (k,) times of the same events on A and B, x ascending, ns.
    """

    found: list[PairedRun] = []
    left = [(0, x.size)]
    while left:
        a, b = left.pop()
        if b - a < MIN_KNOWN:
            continue
        u, v = x[a:b], y[a:b]

        def paired(first: int, last: int, by: _Line) -> tuple[Ints, Ints, int]:
            part = slice(first, last)
            near = np.abs(v[part] - by.at(u[part])) <= by.gate(u[part])  # noqa: B023
            i = np.flatnonzero(near).astype(np.int64) + first
            return i, i, last - first

        every = np.arange(u.size)
        begin, end = _best_window(u, v, every, every, min(MIN_EVENTS // 2, u.size), floor)
        i, _, could = paired(begin, end, _Line.through(u[begin:end], v[begin:end], floor))
        if i.size < MIN_KNOWN:
            continue
        run = _grown(u, v, PairedRun(i, i), paired, (i.size / could, 0.02), floor)
        run = PairedRun(run.a + a, run.b + a)
        found.append(run)
        left += [(a, int(run.a[0])), (int(run.a[-1]) + 1, b)]
    return sorted(found, key=lambda run: int(run.a[0]))


def pairs_near(
    x: Floats, y: Floats, offset: float, within: float, max_drift: float, floor: float
) -> PairedRun:
    """Pairs by an approximate offset, which holds at the first event of A and drifts from there.

    Raises:
        NoMatchError: an event has several partners within the limits, or hardly any has one.
    """
    line = _Line(0.0, offset, float(x[0]), 1.0, floor, 1)
    i_all: list[Ints] = []
    j_all: list[Ints] = []
    done = 0
    while done < x.size:
        last = min(done + _BLOCK, x.size)
        part = x[done:last]
        known = sum(part.size for part in i_all)
        if known < MIN_KNOWN:
            reach = within + max_drift * float(part[-1] - x[0])
            if reach > 0.5 * float(np.diff(y).min(initial=np.inf)):
                raise NoMatchError(
                    "ambiguous",
                    f"events of B come {np.diff(y).min() / 1e9:g} s apart, so an offset known to "
                    f"{reach / 1e9:g} s fits several: state it to less than half of that",
                )
        else:
            i, j = (np.concatenate(column)[-_RECENT:] for column in (i_all, j_all))
            line = _Line.through(x[i], y[j], floor)
            reach = min(line.gate(part), 0.25 * float(np.median(np.diff(y))))
        predicted = line.at(part)
        i, j = pair(predicted, y, reach)
        i_all.append(i + done)
        j_all.append(j)
        done = last
    i, j = np.concatenate(i_all), np.concatenate(j_all)
    if i.size < MIN_KNOWN:
        raise NoMatchError(
            "no_match",
            f"{i.size} events of A have a partner within {within / 1e9:g} s of the offset; at "
            f"least {MIN_KNOWN} are needed",
        )
    return PairedRun(i, j)


def _best_window(
    x: Floats, y: Floats, i: Ints, j: Ints, width: int, floor: float
) -> tuple[int, int]:
    """Return the window of pairs that miss few events and lie closest to a line."""
    starts = np.arange(0, i.size - width + 1, max(width // 3, 1))
    ends = starts + width - 1
    share = width / (np.minimum(i[ends] - i[starts], j[ends] - j[starts]) + 1)
    starts = starts[share >= 0.9 * share.max()]
    windows = [slice(s, s + width) for s in starts.tolist()]
    scatter = [_Line.through(x[i[part]], y[j[part]], floor).sigma for part in windows]
    # of equally good ones the middle one
    good = np.flatnonzero(np.array(scatter) <= 1.5 * min(scatter))
    start = int(starts[good[good.size // 2]])
    return start, start + width


def _nearest(x: Floats, y: Floats, first: int, last: int, line: _Line) -> tuple[Ints, Ints, int]:
    predicted = line.at(x[first:last])
    gate = line.gate(x[first:last])
    low, high = np.searchsorted(y, (predicted[0] - gate, predicted[-1] + gate)).tolist()
    if low == high:
        return np.empty(0, np.int64), np.empty(0, np.int64), 0
    i, j = pair(predicted, y[low:high], gate)
    return i + first, j + low, min(last - first, high - low)


def _other_places(x: Floats, y: Floats, run: PairedRun, line: _Line) -> tuple[float, float]:
    """Share of a run's events that find a partner when shifted by some events: mean, and most."""
    middle = run.a.size // 2
    part = x[run.a[max(middle - 200, 0) : middle + 200]]
    predicted, j = line.at(part), int(run.b[middle])
    shares = []
    for k in range(max(j - _SHIFTS, 0), min(j + _SHIFTS + 1, y.size)):
        shift = float(y[k] - y[j])
        if abs(shift) <= 2 * line.gate(part):
            continue
        moved = predicted + shift
        low, high = np.searchsorted(y, (moved[0], moved[-1])).tolist()
        if high - low < MIN_EVENTS // 2:
            continue
        hits = pair(moved, y[low:high], line.gate(part))[0].size
        inside = int(((moved >= y[0]) & (moved <= y[-1])).sum())
        shares.append(hits / max(inside, 1))
    return (float(np.mean(shares)), max(shares)) if shares else (0.0, 0.0)


def _grown(
    x: Floats,
    y: Floats,
    seed: PairedRun,
    paired: Pairing,
    shares: tuple[float, float],
    floor: float,
) -> PairedRun:
    """The run that grows from a seed to both sides.

    Args:
        shares: of events that find a partner on the run, and off it.
    """
    good, by_chance = (min(max(share, 0.02), 0.98) for share in shares)
    hit = np.log(by_chance / good)
    miss = np.log((1 - by_chance) / (1 - good))
    i, j = seed.a, seed.b
    for forward in (True, False):
        evidence, last_good = 0.0, i.size
        edge = int(i[-1]) + 1 if forward else int(i[0])
        while (edge < x.size if forward else edge > 0) and evidence <= _EVIDENCE:
            recent = slice(-_RECENT, None) if forward else slice(_RECENT)
            if evidence > 0:  # what is in doubt predicts nothing
                keep = slice(last_good) if forward else slice(i.size - last_good, None)
                line = _Line.through(x[i[keep][recent]], y[j[keep][recent]], floor)
            else:
                line = _Line.through(x[i[recent]], y[j[recent]], floor)
            first = edge if forward else max(edge - _BLOCK, 0)
            last = min(edge + _BLOCK, x.size) if forward else edge
            edge = last if forward else first
            new_i, new_j, could = paired(first, last, line)
            if new_i.size:
                taken = new_j > j[-1] if forward else new_j < j[0]
                new_i, new_j = new_i[taken], new_j[taken]
            hits = new_i.size
            i = np.concatenate((i, new_i) if forward else (new_i, i))
            j = np.concatenate((j, new_j) if forward else (new_j, j))
            evidence = max(evidence + hits * hit + max(could - hits, 0) * miss, 0.0)
            if evidence == 0.0:
                last_good = i.size
        if evidence > 0.0:
            keep = slice(last_good) if forward else slice(i.size - last_good, None)
            i, j = i[keep], j[keep]
    return PairedRun(i, j)
