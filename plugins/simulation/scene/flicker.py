"""Events of a light that flickers: all pixels see it at once, whatever else they see.

Lamps on the mains flicker at twice its frequency. Intensity I (1 + m sin(2 pi f t + phase)) adds
ln(1 + m sin(...)) to the log intensity of every pixel. It rises and falls by turns between two
levels, P = ln((1 + m) / (1 - m)) apart, and on each such half period it is a monotone function of
time that has an inverse: t = arcsin((e^level - 1) / m) / (2 pi f). So events are exact, and a pixel
whose thresholds are both theta has P / theta - 1 of them in a half period on the mean, if P is at
least theta; else none: its reference level comes to rest.

A pixel has a reference level for the light besides the one for the markers. That is exact where the
image is static. At a rim that moves, the events of both are a superposition, in which neither
advances or delays the other. The levels are at random between two events when the light is first
seen, as in a steady state, and a leak does not move them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.scene.randomness import generator
from sliplab.plugins.simulation.scene.readout import larger
from sliplab.storage.kernels import njit

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]


class FlickeringLight(NamedTuple):
    """A light, and the n pixels that fire by it."""

    share: float
    """Amplitude over mean of the intensity; 0: steady."""
    hz: float
    origin_ns: float
    """A true time at which the intensity rises through its mean, ns."""
    since_ns: int
    """True time from which it flickers."""
    place: I64
    """Column << 12 | row, (n,)."""
    on: F64
    """Thresholds of positive events, (n,)."""
    off: F64
    """Of negative ones, (n,)."""
    level: F64
    """Reference level of log intensity over that of the mean, (n,); written."""


def steady() -> FlickeringLight:
    """Return a light that does not flicker."""
    none = np.empty(0)
    return FlickeringLight(0.0, 1.0, 0.0, 0, np.empty(0, np.int64), none, none, none.copy())


def new_flicker(
    share: float, hz: float, on: F64, off: F64, since_ns: int, seed: int
) -> FlickeringLight:
    """Return the light of a trial, and all pixels that can fire by it for long.

    Args:
        share: amplitude over mean of the intensity, above 0 and below 1.
        on, off: thresholds of all pixels, (height, width).
        since_ns: true time from which it flickers, and pixels look.
        seed: the trial's: phase of the light, and reference levels.
    """
    rng = generator(seed, "mains light")
    origin_ns = float(rng.random() * 1e9 / hz)
    swing = np.log1p(share) - np.log1p(-share)
    lots = rng.random(on.shape)
    y, x = np.nonzero(np.maximum(on, off) <= swing)
    on, off, lots = on[y, x], off[y, x], lots[y, x]
    level = _level_at(float(since_ns), share, hz, origin_ns) - on + lots * (on + off)
    place = x.astype(np.int64) << 12 | y
    return FlickeringLight(float(share), float(hz), origin_ns, since_ns, place, on, off, level)


@njit(cache=True, nogil=True, error_model="numpy")
def _level_at(t_ns: float, share: float, hz: float, origin_ns: float) -> float:
    """Log intensity at a true time over that of the mean."""
    return np.log1p(share * np.sin(2e-9 * np.pi * hz * (t_ns - origin_ns)))


@njit(cache=True, nogil=True, error_model="numpy")
def flicker_events(
    light: FlickeringLight, begin_ns: int, end_ns: int, base_ns: int, events: I64, n: int
) -> tuple[I64, int]:
    """Append the events of a block of true time, and move the reference levels.

    Args:
        base_ns: true time from which events count.
        events: packed events as in `readout`, the first `n` of them.

    Returns:
        the events, which may have moved, and how many there are.
    """
    share, hz, origin_ns, since_ns, place, on, off, levels = light
    begin_ns = max(begin_ns, since_ns)
    if begin_ns >= end_ns:
        return events, n
    half_ns, pace = 0.5e9 / hz, 2e-9 * np.pi * hz
    first = np.int64(np.floor((begin_ns - origin_ns) / half_ns + 0.5))
    last = np.int64(np.floor((end_ns - origin_ns) / half_ns + 0.5))
    for half in range(first, last + 1):
        # the middle of a half period, which ends on both sides where the light turns
        middle_ns = origin_ns + half * half_ns
        rises = half % 2 == 0
        low_ns = max(float(begin_ns), middle_ns - 0.5 * half_ns)
        high_ns = min(float(end_ns), middle_ns + 0.5 * half_ns)
        whole = high_ns < end_ns
        edge = share if rises else -share
        end = np.log1p(edge) if whole else _level_at(high_ns, share, hz, origin_ns)
        for k in range(place.shape[0]):
            level = levels[k]
            step = on[k] if rises else -off[k]
            while (level + step <= end) if rises else (level + step >= end):
                level += step
                sine = np.expm1(level) / share
                away_ns = np.arcsin(min(max(sine, -1.0), 1.0)) / pace
                t_ns = middle_ns + (away_ns if rises else -away_ns)
                t_ns = min(max(t_ns, low_ns), high_ns)
                if n == events.shape[0]:
                    events = larger(events, 2 * n)
                events[n] = (np.int64(t_ns) - base_ns) << 25 | place[k] << 1 | np.int64(rises)
                n += 1
            levels[k] = level
    return events, n
