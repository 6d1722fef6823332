"""Noise of an event camera: leakage, shot noise that bright pixels have less of, and hot pixels.

As in v2e (Hu, Liu and Delbruck, "v2e: From Video Frames to Realistic DVS Events", CVPRW 2021):
leakage makes positive events at a steady rate; shot noise makes events of both polarities, at its
full rate where it is dark and at a quarter of it in the brightest places, linear in intensity.
The bright share is thinned out of candidates that belong to whole seconds of the trial, so that
neither chunks nor what the camera sees change which candidates there are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.scene.edges import CUT, level_at
from sliplab.plugins.simulation.scene.randomness import generator
from sliplab.storage.kernels import njit

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
BIN_NS = 1_000_000_000
BRIGHT_SHARE = 0.25
"""Shot noise of the brightest pixels over that of dark ones: v2e's SHOT_NOISE_INTEN_FACTOR."""


class Candidates(NamedTuple):
    """Possible noise events, (n,) each."""

    t_ns: I64
    """Rising."""
    place: I64
    """Column << 12 | row."""
    lot: F64
    """0 to 1; decides on what becomes of it."""


@dataclass(frozen=True)
class NoiseRates:
    """Noise rates of a camera; its hot pixels are its own, whatever the trial."""

    width: int
    height: int
    noise_hz: float
    """Mean rate of a dark pixel, leakage and shot noise together."""
    leak_share: float
    hot_hz: float
    hot_places: I64
    """Column << 12 | row of each hot pixel, (n,)."""

    @property
    def total_hz(self) -> float:
        """Rate of candidates in the whole picture."""
        return self.noise_hz * self.width * self.height + self.hot_hz * len(self.hot_places)

    @property
    def hot_share(self) -> float:
        """Share of the candidates that are of hot pixels."""
        return self.hot_hz * len(self.hot_places) / self.total_hz if self.total_hz > 0 else 0.0

    @property
    def leak_below(self) -> float:
        """Lots below this are positive whatever a pixel sees: of hot pixels, or leakage."""
        return self.hot_share + self.leak_share * (1.0 - self.hot_share)


def hot_places(width: int, height: int, count: int, seed: int) -> I64:
    """Choose the hot pixels of the camera of a rig with `seed`: column << 12 | row, (count,)."""
    pixel = generator(seed, "hot pixels").choice(width * height, count, replace=False)
    return (pixel % width << 12 | pixel // width).astype(np.int64)


def candidates(rates: NoiseRates, seed: int, index: int) -> Candidates:
    """Candidates for noise events in second `index` of the trial with `seed`.

    The sum of independent Poisson processes is one of the summed rate, whose events belong to each
    with its share; given their number, their times are sorted uniform ones, which the cumulative
    sums of exponential gaps are (Devroye 1986, V.2.2).
    """
    rng = generator(seed, "event noise", index)
    n = int(rng.poisson(rates.total_hz * (BIN_NS * 1e-9)))
    gaps, draws = rng.standard_exponential(n + 1), rng.random((2, n))
    return Candidates(
        *_spread(
            gaps,
            draws,
            index * BIN_NS,
            rates.width,
            rates.height,
            rates.hot_share,
            rates.hot_places,
        )
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _spread(
    gaps: F64, draws: F64, begin_ns: Any, width: int, height: int, hot_share: float, hot: I64
) -> tuple[I64, I64, F64]:
    """Times from exponential gaps, and places and lots from uniform numbers."""
    n = draws.shape[1]
    t_ns, place, lot = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n)
    whole = 0.0
    for k in range(n + 1):
        whole += gaps[k]
    until = 0.0
    for k in range(n):
        until += gaps[k]
        # rounding must not put the last one into the next bin
        t_ns[k] = begin_ns + min(np.int64(until / whole * BIN_NS), BIN_NS - 1)
        lot[k] = draws[1, k]
        if lot[k] < hot_share:
            place[k] = hot[int(draws[0, k] * hot.shape[0])]
        else:
            pixel = np.int64(draws[0, k] * (width * height))
            row = pixel // width
            place[k] = (pixel - row * width) << 12 | row
    return t_ns, place, lot


@njit(cache=True, nogil=True, error_model="numpy")
def brightness(x: int, y: int, discs: F64, contrast: float, edge: float) -> float:
    """Intensity of a pixel between that of the ground (0) and that of a disc (1).

    Args:
        discs: column, row and radius of each disc, px, (n, 3).
    """
    reach = CUT * edge
    for i in range(discs.shape[0]):
        dx, dy, most = x - discs[i, 0], y - discs[i, 1], discs[i, 2] + reach
        square = dx * dx + dy * dy
        if square < most * most:
            level = level_at(np.sqrt(square) - discs[i, 2], contrast, edge)
            return (np.exp(level) - 1.0) / (np.exp(contrast) - 1.0)
    return 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def noise_events(
    candidates: Candidates,
    begin: int,
    end_ns: int,
    base_ns: int,
    leak_below: float,
    contrast: float,
    edge: float,
    discs: F64,
    events: I64,
    n: int,
) -> tuple[int, int]:
    """Turn candidates from `begin` on, and before `end_ns`, into events where their pixel is.

    Args:
        discs: column, row and radius of each disc at this time, px, (n, 3).
        events: packed as in `readout`, ns after `base_ns`; written from `n` on.

    Returns:
        the next candidate, and how many events there are now.
    """
    t_ns, place, lot = candidates
    k = begin
    while k < t_ns.shape[0] and t_ns[k] < end_ns:
        positive, retained = True, True
        if lot[k] >= leak_below:
            # the same lot says which polarity, and whether the pixel is too bright for it
            turn = 2.0 * (lot[k] - leak_below) / (1.0 - leak_below)
            positive = turn < 1.0
            if not positive:
                turn -= 1.0
            if turn >= BRIGHT_SHARE:
                bright = brightness(place[k] >> 12, place[k] & 4095, discs, contrast, edge)
                retained = turn < 1.0 - (1.0 - BRIGHT_SHARE) * bright
        if retained:
            events[n] = (t_ns[k] - base_ns) << 25 | place[k] << 1 | np.int64(positive)
            n += 1
        k += 1
    return k, n
