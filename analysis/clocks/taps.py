"""Two clocks by taps: sharp events that both of two signals show.

The onset of a tap lies between two times. The later one is the first sample that stands out of the
noise. The earlier one is the last quiet sample before it, less the time that the signal takes from
there to half its peak: a signal that rises as a power of time, up to its square, stays unseen for
no longer. A map keeps both intervals of every tap, and the largest drift that two clocks may have.
A delay that all taps of a signal share, as that of a filter, is in no interval.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sliplab.analysis.clocks.pulse_match import NoMatchError
from sliplab.protocols.shown import plural

Ints = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]

APART_S = 0.3
"""Least time between two taps; what comes sooner is the first one's ringing."""
_CLEAR, _LEAST_SHARE = 40.0, 0.2
"""Peak of a tap in the noise's standard deviations, and in the largest tap's peak."""
_NOISE = 6.0
"""What stands out of the noise, in its standard deviations."""
_QUIET_S, _QUIET = 0.03, 5
"""Time and samples without anything before a tap."""
_SLOW_S = 0.05
"""Longest rise of a tap."""
_MOST = 200


@dataclass(frozen=True)
class Taps:
    """Onsets of taps: each lies between two times, (n,) int64 ns."""

    low_ns: Ints
    high_ns: Ints


def find_taps(name: str, t_ns: Ints, values: Floats) -> Taps:
    """The taps in a signal.

    Args:
        name: of the signal, for messages.
        t_ns: (n,) times, ascending. values: (n,) or (n, axes), in any unit.

    Raises:
        NoMatchError: there is no clear tap.
        ValueError: a value is no number, or times fall back.
    """
    signal = np.asarray(values, np.float64).reshape(len(t_ns), -1)
    if not np.isfinite(signal).all():
        raise ValueError(f"{name}: a value is not a finite number")
    if np.any(np.diff(t_ns) < 0):
        raise ValueError(f"{name}: times fall back")
    if len(t_ns) < 4 * _QUIET:
        raise NoMatchError("too_few_pulses", f"{name} has {plural(len(t_ns), 'sample')}")
    size = _above_noise(signal)
    peak = float(size.max())
    if peak < _CLEAR:
        raise NoMatchError(
            "no_match",
            f"{name} shows no clear tap: its largest change is {peak:.0f} times its noise, at "
            f"least {_CLEAR:g} are needed",
        )
    high = np.flatnonzero(size >= max(_CLEAR, _LEAST_SHARE * peak))
    first = high[np.diff(t_ns[high], prepend=t_ns[high[0]] - 10**10) > APART_S * 1e9]
    if first.size > _MOST:
        raise NoMatchError("no_match", f"{name} shows {first.size} taps: cut it to a few")
    onsets = [_onset(name, t_ns, size, int(k)) for k in first]
    low_ns, high_ns = np.array(onsets, np.int64).T
    return Taps(low_ns, high_ns)


def _above_noise(signal: Floats) -> Floats:
    """Return how far each sample is from the usual one, in the noise's standard deviations."""
    away = np.abs(signal - np.median(signal, axis=0))
    steps = np.abs(np.diff(np.sort(signal, axis=0), axis=0))
    resolution = np.min(np.where(steps > 0, steps, np.inf), axis=0)
    floor = np.where(np.isfinite(resolution), resolution, 1.0)  # a constant axis shows nothing
    noise = np.maximum(1.4826 * np.median(away, axis=0), np.minimum(floor, away.max() / 100))
    result: Floats = (away / np.where(noise > 0, noise, 1.0)).max(axis=1)
    return result


def _onset(name: str, t_ns: Ints, size: Floats, peak: int) -> tuple[int, int]:
    """Return between which times the tap begins that is large at a sample."""
    loud = np.flatnonzero(size[: peak + 1] >= _NOISE)
    # the last pause before the peak that is long enough, in time and in samples
    before = np.concatenate([[-1], loud[:-1]])
    since_ns = t_ns[loud] - np.where(before < 0, t_ns[0], t_ns[before])
    pauses = np.flatnonzero((since_ns >= _QUIET_S * 1e9) & (loud - before > _QUIET))
    if not pauses.size:
        raise NoMatchError("no_match", f"{name} is not quiet for {_QUIET_S:g} s before a tap")
    first = int(loud[pauses[-1]])
    end = int(np.searchsorted(t_ns, t_ns[first] + round(APART_S * 1e9)))
    half = first + int(np.argmax(size[first:end] >= size[first:end].max() / 2))
    rise_ns = int(t_ns[half] - t_ns[first - 1])
    if t_ns[half] - t_ns[first] > _SLOW_S * 1e9:
        raise NoMatchError(
            "no_match",
            f"{name} rises in {rise_ns / 1e6:.0f} ms at {t_ns[first] / 1e9:.3f} s, which is no tap",
        )
    return int(t_ns[first - 1]) - rise_ns, int(t_ns[first])


@dataclass(frozen=True)
class TapMap:
    """The map from clock A to clock B by taps.

    Attributes:
        taps: number of pairs.
        first_ns, last_ns: the first and the last one on clock A.
    """

    taps: int
    first_ns: int
    last_ns: int
    _origin: tuple[int, int]
    _lines: tuple[Floats, Floats, Floats]
    """Drifts that are possible, and the least and the largest offset at the origin with each."""

    def bounds(self, t_ns: Ints) -> tuple[Ints, Ints]:
        """Return between which times on B times of A lie, (n,) int64 ns each."""
        x = (np.asarray(t_ns, np.int64) - self._origin[0]).astype(np.float64)
        drift, least, most = self._lines
        low, high = np.full(x.size, np.inf), np.full(x.size, -np.inf)
        for slope, below, above in zip(drift, least, most, strict=True):
            low, high = np.minimum(low, below + slope * x), np.maximum(high, above + slope * x)
        base = np.asarray(t_ns, np.int64) - self._origin[0] + self._origin[1]
        return base + np.floor(low).astype(np.int64), base + np.ceil(high).astype(np.int64)

    @property
    def drift_ppm(self) -> tuple[float, float]:
        """The least and the largest drift of B against A that is possible."""
        return float(self._lines[0].min()) * 1e6, float(self._lines[0].max()) * 1e6


def map_by_taps(
    a: Taps, b: Taps, max_drift_ppm: float, near: tuple[int, int] | None = None
) -> TapMap:
    """The map from clock A to clock B that every tap allows.

    Args:
        a, b: of the same taps.
        near: B less A approximately, and by how much that may be wrong, ns: taps that have no
            partner there are left out. Without it both must show equally many.

    Raises:
        NoMatchError: taps have no partner, or several, or they contradict each other.
    """
    i, j = _pairs(a, b, near)
    half = (a.high_ns[i] - a.low_ns[i] + 1) // 2
    at = a.low_ns[i] + half
    origin = int(at[0]), int(b.low_ns[j[0]])
    x = (at - origin[0]).astype(np.float64)
    low = (b.low_ns[j] - half - origin[1] - (at - origin[0])).astype(np.float64)
    high = (b.high_ns[j] + half - origin[1] - (at - origin[0])).astype(np.float64)
    most = max_drift_ppm * 1e-6
    # the corners of the lines that are possible lie where two bounds meet
    ends, levels = np.tile(x, 2), np.concatenate([low, high])
    run = ends[:, None] - ends
    with np.errstate(divide="ignore", invalid="ignore"):
        corners = ((levels[:, None] - levels) / run)[run > 0]
    drift = np.unique(np.concatenate([corners[np.abs(corners) <= most], [-most, most]]))
    below = (low - drift[:, None] * x).max(axis=1)
    above = (high - drift[:, None] * x).min(axis=1)
    fits = below <= above + 1.0  # ns
    if not fits.any():
        raise NoMatchError(
            "no_match",
            f"{plural(i.size, 'tap')} contradict each other for clocks that differ by at most "
            f"{max_drift_ppm:g} ppm: one is not the same in both, or a clock jumped",
        )
    return TapMap(i.size, int(at[0]), int(at[-1]), origin, (drift[fits], below[fits], above[fits]))


def _pairs(a: Taps, b: Taps, near: tuple[int, int] | None) -> tuple[Ints, Ints]:
    """Return which taps of A and B are the same."""
    if near is None:
        if a.low_ns.size != b.low_ns.size:
            raise NoMatchError(
                "ambiguous",
                f"A shows {plural(a.low_ns.size, 'tap')}, B {b.low_ns.size}: cut both to the "
                "same ones, or give an approximate offset",
            )
        every = np.arange(a.low_ns.size)
        return every, every
    offset, within = near
    begins = a.low_ns[:, None] + offset - within, a.high_ns[:, None] + offset + within
    close = (b.high_ns >= begins[0]) & (b.low_ns <= begins[1])
    if not close.any():
        text = f"no tap of A has one of B within {within / 1e9:g} s of the offset"
        raise NoMatchError("no_match", text)
    if (close.sum(axis=0) > 1).any() or (close.sum(axis=1) > 1).any():
        text = f"a tap has two partners within {within / 1e9:g} s of the offset: state it closer"
        raise NoMatchError("ambiguous", text)
    i, j = np.nonzero(close)
    return i, j
