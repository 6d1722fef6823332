"""The map from one clock to another, from events that both saw, or a reason why there is none.

Pairs come from ids, from an approximate offset, or from the pattern of the intervals; `runs` finds
the stretches without a jump, `clock_state` the clock within each. A map must say no rather than be
wrong: events that fit in several places are refused, and a time that no stretch covers has no
interval.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from sliplab.analysis.clocks.pulse_match import NoMatchError
from sliplab.plugins.align.clock_state import ClockState
from sliplab.plugins.align.events import ClockEvents, events_from
from sliplab.plugins.align.runs import (
    BEND_PER_NS,
    MIN_EVENTS,
    MIN_KNOWN,
    PairedRun,
    pairs_near,
    runs_by_pairs,
    runs_by_pattern,
)
from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import plural
from sliplab.storage.files import write_bytes

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

MAX_DRIFT_PPM = 500.0
"""Largest difference of two clocks' rates that is searched, by default."""
MOST_DRIFT_PPM = 50_000.0
WITHIN_S = 0.1
"""By how much an approximate offset may be wrong, where nothing else is stated."""
_MOST_OUTSIDE = 0.4
"""Largest share of a stretch's pairs that may lie off its line."""
_BETWEEN = 8
"""Up to so many unpaired events between two stretches, the clock jumped once there."""
_JUMP, _DOUBT = 12.0, 5.0
"""Log-likelihood that a jump gains, to be one, or to be as likely as none: chance gives the first
once in about a million places."""
_WIDER = 2.5
"""Of a jump's share in the interval: the least with which 1 of 21,000 simulated alignments was off
by three half-widths, as with 3; with 2 there were 3."""
_NEAR = 64
"""Events on either side of a break among which the jump is placed."""
_UNLIKELY = 10.0
"""A place of the jump is ruled out that is less likely by this, natural logarithm."""
_EXPECTED = 0.1
"""Share of events taken to be spurious or late."""
_UNCONFIRMED = 3
"""Events at the lists' ends that could lie behind a jump unseen."""
_LONG_NS = 1e12
"""Events so far apart rather have another unit."""
UNKNOWN = -(2**63)
_FITS_NS = 9.2e18
"""What int64 ns hold: 292 years."""


class AlignmentRefused(ValueError):
    """No map can be trusted for these events.

    Attributes:
        reason: ``too_few_pulses``, ``ambiguous`` or ``no_match``.
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


@dataclass(frozen=True)
class MappedTimes:
    """Times on clock B, each (n,) int64 ns.

    Attributes:
        ns: the times; -2**63 where they are unknown.
        low_ns, high_ns: the interval of 95 % of each.
        known: (n,) whether a time is known.
        within: (n,) whether events on both sides confirm it; beyond the events the clock is
            taken to change its drift by up to 0.4 ppm a second.
        far: (n,) whether it is unknown because its interval is longer than int64 ns hold.
    """

    ns: Ints
    low_ns: Ints
    high_ns: Ints
    known: Bools
    within: Bools
    far: Bools

    def write(self, times_ns: Ints, path: Path) -> None:
        """Write a CSV with the times before and after, ns; empty cells where unknown."""
        lines = ["a_ns,b_ns,b_low_ns,b_high_ns,within"]
        columns = (times_ns, self.ns, self.low_ns, self.high_ns, self.known, self.within)
        for a, b, low, high, known, within in zip(*(c.tolist() for c in columns), strict=True):
            lines.append(f"{a},{b},{low},{high},{within:d}" if known else f"{a},,,,0")
        write_bytes(path, ("\n".join(lines) + "\n").encode())


@dataclass(frozen=True)
class Stretch:
    """A stretch without a jump.

    Attributes:
        first_ns, last_ns: the events of A between which it is confirmed.
        valid_ns: the times of A for which it may hold; None where nothing bounds it.
        events, outliers: pairs on the clock, and off it.
        rate_ppm: gain of B on A, mean.
        middle_ns, offset_ns: a time of A, and B less A there.
        scatter_ns: of the events about the clock, 1 sigma.
        half_ns: half the interval of 95 % in its middle.
        doubt_ns: the part of it for a jump that is neither ruled out nor certain, and for what the
            stamps' unit hides. A delay that all events share is in no interval.
        unit_ns: what all stamps of A or of B are multiples of.
        jump_ns, hidden_ns: what a jump may add, in quadrature, and what the unit hides.
    """

    first_ns: int
    last_ns: int
    valid_ns: tuple[int | None, int | None]
    events: int
    outliers: int
    rate_ppm: float
    middle_ns: int
    offset_ns: int
    scatter_ns: float
    half_ns: float
    doubt_ns: float
    unit_ns: float
    state: ClockState = field(repr=False)
    jump_ns: float = field(repr=False)
    hidden_ns: float = field(repr=False)

    def doubted(self, half: Floats) -> Floats:
        """Widen half an interval of the clock by what its jumps and its unit may add."""
        result: Floats = np.hypot(half, self.jump_ns) + self.hidden_ns
        return result

    def to_json(self) -> dict[str, Any]:
        """All but the clock itself."""
        return {part.name: getattr(self, part.name) for part in fields(self) if part.repr}


@dataclass(frozen=True)
class Jump:
    """A jump of A against B between two times of A.

    Attributes:
        after_ns, before_ns: it lies between; `before_ns` is the smaller where A fell back.
        size_ns: what B gained.
        certain: whether one jump explains the events in between; else times there are unknown.
    """

    after_ns: int
    before_ns: int
    size_ns: int
    certain: bool


@dataclass(frozen=True)
class Alignment:
    """The map from clock A to clock B.

    Attributes:
        stretches: at least one, in the order of recording.
        jumps: those between them.
        by: how events were paired: ``ids``, ``offset`` or ``pattern``.
        unclear_ns: times that A took a second time, after it fell back, which are unknown.
        events_a, events_b: how many there were.
    """

    stretches: tuple[Stretch, ...]
    jumps: tuple[Jump, ...]
    by: str
    unclear_ns: tuple[tuple[int, int], ...]
    events_a: int
    events_b: int
    _origin_a: int = field(repr=False)
    _origin_b: int = field(repr=False)

    def map(self, times: ArrayLike, unit: str | None = None) -> MappedTimes:
        """Map times of clock A to clock B.

        Args:
            times: (n,) in any order, floats in s or integers in ns.
            unit: of the times, ``s``, ``ms``, ``us`` or ``ns``, if another one.

        Returns:
            times with their intervals; unknown where no stretch applies. Where two apply, as next
            to a jump, the interval contains both.
        """
        ns = events_from(times, "times", unit).ns
        x = (ns - self._origin_a).astype(np.float64)
        low, high = np.full(x.size, np.inf), np.full(x.size, -np.inf)
        within = np.zeros(x.size, np.bool_)
        for stretch in self.stretches:
            lower, upper = stretch.valid_ns
            valid = np.ones(x.size, np.bool_)
            if lower is not None:
                valid &= ns >= lower
            if upper is not None:
                valid &= ns <= upper
            here = np.flatnonzero(valid)
            here = here[np.argsort(x[here], kind="stable")]
            gain, half = stretch.state.at(x[here])
            beyond = np.maximum(np.maximum(stretch.first_ns - ns, ns - stretch.last_ns), 0)[here]
            half = stretch.doubted(half) + 0.5 * BEND_PER_NS * beyond.astype(np.float64) ** 2
            low[here] = np.minimum(low[here], gain - half)
            high[here] = np.maximum(high[here], gain + half)
            within |= (ns >= stretch.first_ns) & (ns <= stretch.last_ns)
        for begin, end in self.unclear_ns:
            low[(ns >= begin) & (ns <= end)] = np.inf
        known = high >= low
        reach = np.abs(x + self._origin_b) + np.maximum(np.abs(low), np.abs(high))
        far = known & (reach > _FITS_NS)
        known &= ~far
        base = ns - self._origin_a + self._origin_b

        def shifted(by: Floats) -> Ints:
            moved = base + np.rint(np.where(known, by, 0.0)).astype(np.int64)
            return np.where(known, moved, UNKNOWN)

        middle = np.where(known, low, 0.0) / 2 + np.where(known, high, 0.0) / 2
        return MappedTimes(
            shifted(middle),
            shifted(np.floor(low)),
            shifted(np.ceil(high)),
            known,
            within & known,
            far,
        )

    def to_json(self) -> dict[str, Any]:
        """Return the summary that ``sliplab align --json`` prints."""
        return {
            "paired_by": self.by,
            "events_a": self.events_a,
            "events_b": self.events_b,
            "stretches": [stretch.to_json() for stretch in self.stretches],
            "unclear_ns": list(self.unclear_ns),
            "jumps": [vars(jump) for jump in self.jumps],
        }


def align(
    a: Any,
    b: Any,
    *,
    offset_s: float | None = None,
    within_s: float = WITHIN_S,
    max_drift_ppm: float = MAX_DRIFT_PPM,
    unit: str | None = None,
    harp: bool = False,
) -> Alignment:
    """Fit the map from clock A to clock B, from events that both saw.

    Events may be missing or spurious on either side, and the clocks may jump. They are paired by
    ids if both have some, by an approximate offset if one is given, else by the pattern of their
    intervals, which must be random or a code.

    Args:
        a, b: event times: a CSV file, an array (floats in s, integers in ns), or a pair of times
            and integer ids; see `sliplab.plugins.align.events.events_from`. `b` may be the word
            ``harp``: the ids of A are then seconds of clock B.
        offset_s: B less A at the first event of A, approximately.
        within_s: by how much `offset_s` may be wrong.
        max_drift_ppm: largest difference of the clocks' rates, up to 50,000.
        unit: of both lists: s, ms, us or ns; by default as named in a file, or by dtype.
        harp: both lists are edges of a Harp clock's slow copy, with levels in place of ids.

    Raises:
        AlignmentRefused: no map can be trusted; `reason` is a word for it.
        InputError: an argument or a file that cannot be right.
    """
    if not 0 < max_drift_ppm <= MOST_DRIFT_PPM:
        raise InputError("align", "max_drift_ppm", max_drift_ppm, "must be in (0, 50000]")
    if not (0 < within_s < 1e6 and (offset_s is None or abs(offset_s) < 4e9)):
        raise InputError("align", "within_s", within_s, "must be positive, offset_s a time in s")
    first = events_from(a, "a", unit, harp=harp)
    if isinstance(b, str) and b == "harp":
        if first.ids is None:
            raise InputError("align", "b", b, "needs ids of A that are a Harp clock's seconds")
        second = ClockEvents("harp", first.ids * 10**9, first.ids)
    else:
        second = events_from(b, "b", unit, harp=harp)
    for events in (first, second):
        if events.ns.size < MIN_KNOWN:
            raise AlignmentRefused(
                "too_few_pulses",
                f"{events.name} has {plural(events.ns.size, 'event')}; at least {MIN_KNOWN} are "
                f"needed with ids or an offset, {MIN_EVENTS} without",
            )
        if not np.ptp(events.ns):
            raise events.error(0, f"is the time of all {events.ns.size} events")
    return _Fit(first, second, max_drift_ppm * 1e-6, offset_s).align(within_s)


@dataclass(frozen=True)
class _Part:
    """Pairs of one stretch: indices into the sorted pieces, and what lies on its clock."""

    piece: int
    run: PairedRun
    state: ClockState
    outliers: int
    jump: float
    hidden: float


class _Fit:
    """Both lists as floats near 0, in pieces within which their times rise."""

    def __init__(
        self, a: ClockEvents, b: ClockEvents, max_drift: float, offset_s: float | None
    ) -> None:
        self.a, self.b, self.max_drift, self.offset_s = a, b, max_drift, offset_s
        self.origin_a, self.origin_b = int(np.median(a.ns)), int(np.median(b.ns))
        self.unit = float(max(a.unit_ns, b.unit_ns))
        self.floor = max(0.3 * self.unit, 0.5)
        self.x, self.pieces_a, order_a = _rising(a.ns, self.origin_a)
        self.y, self.pieces_b, order_b = _rising(b.ns, self.origin_b)
        known = offset_s is not None or (a.ids is not None and b.ids is not None)
        for events, pieces in ((a, self.pieces_a), (b, self.pieces_b)):
            if len(pieces) > 2 and max(np.diff(pieces)) < (MIN_KNOWN if known else MIN_EVENTS):
                raise _not_in_order(events, pieces)
        self.ids_a = None if a.ids is None else a.ids[order_a]
        self.ids_b = None if b.ids is None else b.ids[order_b]

    def align(self, within_s: float) -> Alignment:
        try:
            if self.ids_a is not None and self.ids_b is not None:
                by, runs = "ids", self._by_ids(self.ids_a, self.ids_b)
            elif self.offset_s is not None:
                by, runs = "offset", self._by_offset(self.offset_s, within_s)
            else:
                by, runs = "pattern", self._by_pattern()
        except NoMatchError as error:
            text = self._explained(error.reason, str(error))
            raise AlignmentRefused(error.reason, text) from None
        least = MIN_EVENTS if by == "pattern" else MIN_KNOWN
        parts = [
            part for piece, run in self._merged(runs) for part in self._split(piece, run, least)
        ]
        steep = [part for part in parts if abs(part.state.rate) > self.max_drift]
        if steep or not parts:
            text = self._explained("no_match", self._no_clock(steep, by))
            raise AlignmentRefused("no_match", text)
        return self._finished(parts, by)

    def _no_clock(self, steep: list[_Part], by: str) -> str:
        if not steep:
            return "the pairs lie on no straight line: check that both saw the same events"
        ppm = 1e6 * steep[0].state.rate
        if abs(ppm) > MOST_DRIFT_PPM:
            what = "ids" if by == "ids" else "times"
            return (
                f"paired by {by}, the clocks differ by {ppm:.0f} ppm, as no two clocks do: check "
                f"that the {what} of both mean the same, in the same order"
            )
        return (
            f"the clocks differ by {ppm:.0f} ppm; at most {1e6 * self.max_drift:g} ppm are "
            f"allowed: raise it, or check that {'the offset is right and ' * (by == 'offset')}both "
            "saw the same events"
        )

    def _explained(self, reason: str, text: str) -> str:
        """Return a refusal with further likely causes; a wrong unit explains all others."""
        units = []
        steps = [float(np.median(np.abs(np.diff(events.ns)))) for events in (self.a, self.b)]
        power = 3 * round(float(np.log10(steps[0] / steps[1])) / 3) if min(steps) > 0 else 0
        if power and 0.5 < steps[0] / steps[1] / 10.0**power < 2:
            units.append(f"intervals of A are about 1e{power} times those of B: check the units")
        for events, step in zip((self.a, self.b), steps, strict=True):
            if events.column and step > _LONG_NS:
                column = f"{events.name}, {events.column}"
                units.append(f"{column}: events come {step / 1e9:.3g} s apart: is the unit right?")
        known = reason != "ambiguous" or self.offset_s is not None
        found = [] if known else ["or give an approximate offset"]
        for events, pieces in ((self.a, self.pieces_a), (self.b, self.pieces_b)):
            if len(pieces) > 2:
                found.append(str(_not_in_order(events, pieces)))
        return "; ".join([*units, text, *found])

    def _by_ids(self, ids_a: Ints, ids_b: Ints) -> list[tuple[int, PairedRun]]:
        once_a, once_b = _unique(ids_a), _unique(ids_b)
        _, i, j = np.intersect1d(ids_a[once_a], ids_b[once_b], return_indices=True)
        i, j = once_a[i], once_b[j]
        order = np.argsort(i)
        i, j = i[order], j[order]
        if i.size < MIN_KNOWN:
            raise NoMatchError(
                "too_few_pulses",
                f"{plural(i.size, 'id')} in both lists, once in each; at least {MIN_KNOWN} are "
                "needed",
            )
        found = []
        for piece, (begin, end) in enumerate(pairwise(self.pieces_a)):
            low, high = np.searchsorted(i, (begin, end)).tolist()
            u, v = i[low:high], j[low:high]
            for run in runs_by_pairs(self.x[u], self.y[v], self.floor):
                found.append((piece, PairedRun(u[run.a], v[run.b])))
        if not found:
            raise NoMatchError("no_match", "the times of equal ids lie on no common clock")
        return found

    def _by_offset(self, offset_s: float, within_s: float) -> list[tuple[int, PairedRun]]:
        if len(self.pieces_a) > 2 or len(self.pieces_b) > 2:
            raise NoMatchError("no_match", "a clock falls back, so that no one offset holds")
        offset = float(round(offset_s * 1e9) - (self.origin_b - self.origin_a))
        run = pairs_near(self.x, self.y, offset, within_s * 1e9, self.max_drift, self.floor)
        return [(0, run)]

    def _by_pattern(self) -> list[tuple[int, PairedRun]]:
        found, refusal = [], None
        for piece, (begin, end) in enumerate(pairwise(self.pieces_a)):
            for low, high in pairwise(self.pieces_b):
                try:
                    runs = runs_by_pattern(
                        self.x[begin:end], self.y[low:high], self.max_drift, self.floor
                    )
                except NoMatchError as error:
                    refusal = refusal or error
                    continue
                found += [(piece, PairedRun(run.a + begin, run.b + low)) for run in runs]
        if not found and refusal is not None:
            raise refusal
        return sorted(found, key=lambda item: int(item[1].a[0]))

    def _merged(self, runs: list[tuple[int, PairedRun]]) -> list[tuple[int, PairedRun]]:
        """Join neighbours with no jump between them, as on both sides of a gap."""
        merged = runs[:1]
        for piece, run in runs[1:]:
            before = merged[-1][1]
            both = PairedRun(np.concatenate((before.a, run.a)), np.concatenate((before.b, run.b)))
            rising = (np.diff(self.x[both.a]) > 0).all() and (np.diff(self.y[both.b]) > 0).all()
            if rising:
                one, two = self._state(before), self._state(run)
                middle = np.array([(one.x[-1] + two.x[0]) / 2])
                (gain_1, half_1), (gain_2, half_2) = one.at(middle), two.at(middle)
                if abs(gain_2 - gain_1)[0] < 2 * (half_1 + half_2)[0]:
                    merged[-1] = (piece, both)
                    continue
            merged.append((piece, run))
        return merged

    def _state(self, run: PairedRun) -> ClockState:
        return ClockState.through(self.x[run.a], self.y[run.b])

    def _split(self, piece: int, run: PairedRun, least: int) -> list[_Part]:
        """Cut a run where its clock jumps, and leave out what is off it."""
        if run.a.size < least:
            return []
        state = self._state(run)
        step = state.jump(least // 2)
        if step is not None and step.gain > _JUMP:
            at = step.at
            halves = PairedRun(run.a[:at], run.b[:at]), PairedRun(run.a[at:], run.b[at:])
            least = max(least // 2, MIN_KNOWN)
            return [part for half in halves for part in self._split(piece, half, least)]
        inside = ~state.outside
        if inside.mean() < 1 - _MOST_OUTSIDE:
            return []
        return [self._part(piece, PairedRun(run.a[inside], run.b[inside]), int((~inside).sum()))]

    def _part(self, piece: int, run: PairedRun, outliers: int) -> _Part:
        state = self._state(run)
        step = state.jump(min(MIN_KNOWN, run.a.size // 3))
        # one that may be there, and would be half as wrong on either side
        jump = 0.0
        if step is not None:
            likely = float(special.expit(1.5 * (step.gain - _DOUBT)))
            jump = _WIDER * likely * abs(step.size) / 2
        # what a unit hides that no jitter shakes (Widrow and Kollar 2008)
        shaken = state.sigma / self.unit
        hidden = 0.5 * self.unit * float(np.exp(-2 * np.pi**2 * shaken**2))
        return _Part(piece, run, state, outliers, jump, hidden)

    def _finished(self, parts: list[_Part], by: str) -> Alignment:
        least = MIN_EVENTS // 2 if by == "pattern" else MIN_KNOWN
        jumps, trimmed = self._jumps(parts)
        while thin := [k for k, part in enumerate(trimmed) if part.run.a.size < least]:
            # what the jumps on both sides leave so little of was paired by chance
            parts = [part for k, part in enumerate(parts) if k != thin[0]]
            jumps, trimmed = self._jumps(parts)
        parts = trimmed
        stretches = []
        for k, part in enumerate(parts):
            lower = self._open_end(part, False) if k == 0 else None
            upper = self._open_end(part, True) if k == len(parts) - 1 else None
            # where not all is explained, a jump back may hide next to the outermost event
            if k:
                lower = self._ns(part, 1)
                if jumps[k - 1].certain:
                    lower = self._ns(part, 0)
                    lower = min(jumps[k - 1].after_ns, lower - self._between(parts[k - 1], part))
            if k < len(jumps):
                upper = self._ns(part, -2)
                if jumps[k].certain:
                    upper = self._ns(part, -1)
                    upper = max(jumps[k].before_ns, upper + self._between(part, parts[k + 1]))
            # what lies at the lists' ends is not confirmed by what follows
            first = min(_UNCONFIRMED, part.run.a.size // 4) if k == 0 else 0
            last = min(_UNCONFIRMED, part.run.a.size // 4) if k == len(parts) - 1 else 0
            stretches.append(self._stretch(part, (lower, upper), first, last))
        return Alignment(
            tuple(stretches),
            tuple(jumps),
            by,
            self._unclear(parts),
            self.x.size,
            self.y.size,
            self.origin_a,
            self.origin_b,
        )

    def _unclear(self, parts: list[_Part]) -> tuple[tuple[int, int], ...]:
        """Return the times of A's pieces that could not be aligned.

        A piece goes on beyond its outermost events for up to the longest interval of events.
        """
        found = []
        longest = max(
            float(np.diff(times[begin:end]).max(initial=0.0))
            for times, pieces in ((self.x, self.pieces_a), (self.y, self.pieces_b))
            for begin, end in pairwise(pieces)
        )
        for piece, (begin, end) in enumerate(pairwise(self.pieces_a)):
            if end - begin > _BETWEEN and all(part.piece != piece for part in parts):
                first, last = self.x[begin] - longest, self.x[end - 1] + longest
                found.append((self.origin_a + int(first), self.origin_a + int(last)))
        return tuple(found)

    def _between(self, one: _Part, two: _Part) -> int:
        """Return the time on B from one part's last event to the next part's first, ns.

        If A fell back in between, so long before and behind these events its times mean two.
        """
        return int(self.y[two.run.b[0]] - self.y[one.run.b[-1]])

    def _ns(self, part: _Part, index: int) -> int:
        return self.origin_a + int(self.x[part.run.a[index]])

    def _stretch(
        self, part: _Part, valid: tuple[int | None, int | None], first: int, last: int
    ) -> Stretch:
        x = self.x[part.run.a]
        middle = np.array([np.rint((x[0] + x[-1]) / 2)])
        gain, half = part.state.at(middle)
        whole = float(np.hypot(half[0], part.jump)) + part.hidden
        return Stretch(
            first_ns=self._ns(part, first),
            last_ns=self._ns(part, -1 - last),
            valid_ns=valid,
            events=x.size,
            outliers=part.outliers,
            rate_ppm=1e6 * part.state.rate,
            middle_ns=self.origin_a + int(middle[0]),
            offset_ns=self.origin_b - self.origin_a + round(float(gain[0])),
            scatter_ns=part.state.sigma,
            half_ns=whole,
            doubt_ns=whole - float(half[0]),
            unit_ns=self.unit,
            state=part.state,
            jump_ns=part.jump,
            hidden_ns=part.hidden,
        )

    def _open_end(self, part: _Part, behind: bool) -> int | None:
        """Return the last confirmed time where later events find no partner; else None."""
        edge = int(part.run.a[-1 if behind else 0])
        left = self.x[edge + 1 :] if behind else self.x[:edge]
        predicted = left + part.state.at(left)[0] if left.size else left
        other = self.y[int(part.run.b[-1]) + 1 :] if behind else self.y[: int(part.run.b[0])]
        if not (predicted.size and other.size):
            return None
        seen = int(((predicted >= other[0]) & (predicted <= other[-1])).sum())
        there = int(((other >= predicted[0]) & (other <= predicted[-1])).sum())
        return self._ns(part, -1 if behind else 0) if min(seen, there) > _BETWEEN else None

    def _jumps(self, parts: list[_Part]) -> tuple[list[Jump], list[_Part]]:
        """Place the jump between each two neighbours, and leave out the pairs near it."""
        jumps, trimmed = list[Jump](), parts[:1]
        for part in parts[1:]:
            jump, trimmed[-1:] = self._jump(trimmed[-1], part)
            jumps.append(jump)
        return jumps, trimmed

    def _jump(self, one: _Part, two: _Part) -> tuple[Jump, list[_Part]]:
        """Find between which events the clock jumped, and drop those in doubt."""
        middle = np.array([(self.x[one.run.a[-1]] + self.x[two.run.a[0]]) / 2])
        size = round(float(two.state.at(middle)[0][0] - one.state.at(middle)[0][0]))
        if one.piece != two.piece:
            return Jump(self._ns(one, -1), self._ns(two, 0), size, True), [one, two]
        low = max(int(one.run.a[-1]) - _NEAR, int(one.run.a[0]))
        high = min(int(two.run.a[0]) + _NEAR, int(two.run.a[-1])) + 1
        events = self.x[low:high]
        scores = [self._log_likelihood(events, part) for part in (one, two)]
        # the jump comes before the event of each index
        before = np.concatenate([[0.0], np.cumsum(scores[0])])
        behind = np.concatenate([np.cumsum(scores[1][::-1])[::-1], [0.0]])
        score = before + behind
        likely = np.flatnonzero(score >= score.max() - _UNLIKELY)
        first, last = low + int(likely[0]), low + int(likely[-1])
        kept = [
            self._part(one.piece, _until(one.run, first), one.outliers),
            self._part(two.piece, _from(two.run, last), two.outliers),
        ]
        after, upto = max(first - 1, int(kept[0].run.a[-1])), min(last, int(kept[1].run.a[0]))
        # what fits neither line lies between
        unpaired = int((np.maximum(*scores)[after - low + 1 : upto - low] <= 0).sum())
        return (
            Jump(
                self.origin_a + int(self.x[after]),
                self.origin_a + int(self.x[upto]),
                size,
                unpaired <= _BETWEEN,
            ),
            kept,
        )

    def _log_likelihood(self, events: Floats, part: _Part) -> Floats:
        """Log-likelihood ratio of each event: on a stretch's clock, against anywhere."""
        gain, half = part.state.at(events)
        predicted = events + gain
        right = np.clip(np.searchsorted(self.y, predicted), 1, self.y.size - 1)
        rest = np.minimum(np.abs(self.y[right] - predicted), np.abs(self.y[right - 1] - predicted))
        sigma = np.hypot(max(part.state.sigma, self.floor), half / 2)
        gap = float(np.median(np.diff(self.y)))
        on = (1 - _EXPECTED) * np.exp(-0.5 * (rest / sigma) ** 2) / (2.5066 * sigma)
        result: Floats = np.log(on * gap + _EXPECTED)
        return result


def _until(run: PairedRun, end: int) -> PairedRun:
    keep = max(int(np.searchsorted(run.a, end)), MIN_KNOWN)
    return PairedRun(run.a[:keep], run.b[:keep])


def _from(run: PairedRun, begin: int) -> PairedRun:
    keep = max(min(int(np.searchsorted(run.a, begin)), run.a.size - MIN_KNOWN), 0)
    return PairedRun(run.a[keep:], run.b[keep:])


def _rising(ns: Ints, origin: int) -> tuple[Floats, list[int], Ints]:
    """Times as floats, sorted within pieces, the edges of the pieces, and the order.

    A time that is earlier than the one before by more than jitter begins a piece.
    """
    steps = np.diff(ns)
    usual = float(np.median(np.abs(steps))) if steps.size else 0.0
    cuts = (np.flatnonzero(steps < -0.1 * usual) + 1).tolist()
    edges = [0, *cuts, ns.size]
    order = np.concatenate(
        [begin + np.argsort(ns[begin:end], kind="stable") for begin, end in pairwise(edges)]
    )
    return (ns[order] - origin).astype(np.float64), edges, order


def _not_in_order(events: ClockEvents, pieces: list[int]) -> InputError:
    """Return the error of a list that falls back at the beginning of each of its pieces."""
    k, falls = pieces[1], len(pieces) - 2
    before = f"is earlier than the event before ({events.ns[k - 1] / 1e9:.9g} s)"
    more = f", as {plural(falls - 1, 'other')}" if falls > 1 else ""
    return events.error(k, f"{before}{more}: not in order; sort the events by time")


def _unique(ids: Ints) -> Ints:
    """Return the indices of ids that come once."""
    _, first, count = np.unique(ids, return_index=True, return_counts=True)
    result: Ints = first[count == 1]
    return result
