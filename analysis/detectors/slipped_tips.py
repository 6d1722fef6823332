"""Which tips have let go, once one has: the share of the skin that slips.

A tip that slides is loaded no further. Its marker does not rest: it moves on, by a tenth to a half
of its speed, as the tips that still stick take over its load. So each tip is followed by itself,
as a hidden Markov model of two states: it sticks, and its marker causes as many events as just
before the first slip, or it has let go, and causes `SLID` of them. Events are Poisson variables
that vary `DISPERSION` times as much. The filter is the forward recursion (Rabiner 1989, Proceedings
of the IEEE 77). A tip that moves as before once more sticks again, by the evidence alone.

A tip's events are those in the cells around its marker, which moves on by less than `REACH_CELLS`.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from sliplab.storage.kernels import njit

SLID = 0.4
"""Rate of a tip that has let go, as a share of what it had."""
DISPERSION = 2.0
LETS_GO_MS = 1000.0
"""Mean time that a tip sticks on, once others slide; outer tips take tenths, inner ones seconds."""
FIRST = 0.02
"""Probability at first that a tip has let go."""
FOLLOWED_MS = 100.0
"""Time in which the rate of a tip that sticks is measured again: it grows as others let go."""
REACH_CELLS = 5
ONE_TIP_CELLS = 4
"""Places with centres nearer than this are of one tip; those of two are about 8 apart."""
LARGEST = 8.0
"""Log odds at most, so that a state can change."""
LEAST_RATE = 0.02
"""Events a millisecond, at least."""

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]


def regions(place_of_cells: I64, columns: int) -> I64:
    """Return the tip of each cell, row by row: the nearest one within reach; -1 for none.

    Args:
        place_of_cells: the place of each cell, from 0 on; negative for none. columns: of a row.

    Raises:
        ValueError: no cell has a place.
    """
    cell = np.arange(len(place_of_cells)) % columns + 1j * (
        np.arange(len(place_of_cells)) // columns
    )
    inside = place_of_cells >= 0
    centres = _centres(cell[inside], place_of_cells[inside])
    # parts of one marker's edge are one tip
    first = (np.abs(centres[:, None] - centres) < ONE_TIP_CELLS).argmax(axis=1)
    _, tip = np.unique(first, return_inverse=True)
    centres = _centres(cell[inside], tip[place_of_cells[inside]])
    distance = np.abs(cell[:, None] - centres)
    return np.where(distance.min(axis=1) <= REACH_CELLS, distance.argmin(axis=1), -1)


def _centres(cell: npt.NDArray[np.complex128], number: I64) -> npt.NDArray[np.complex128]:
    """Return the mean cell of each number; columns are real, rows imaginary."""
    centres = np.zeros(number.max() + 1, np.complex128)
    np.add.at(centres, number, cell)
    centres /= np.bincount(number)
    return centres


class SlippedTips:
    """The probability that each of n tips has let go.

    Args:
        rate: events a millisecond of each tip before the first slip, (n,).
        noise: those that no marker causes, (n,).
    """

    def __init__(self, rate: F64, noise: F64) -> None:
        self._rate, self._noise = rate.copy(), noise
        self.probability = np.full(len(rate), FIRST)

    def push(self, counts: I64) -> F64:
        """Return the share of the tips that have let go, after each millisecond, (m,).

        Args:
            counts: events by millisecond and tip, (m, n).
        """
        share = np.zeros(len(counts))
        _forward(counts, self._rate, self._noise, self.probability, share)
        return share


@njit(cache=True, nogil=True)
def _forward(counts: I64, rate: F64, noise: F64, probability: F64, share: F64) -> None:
    """Advance the filter; `rate` and `probability` are changed, `share` is written."""
    for k in range(len(counts)):
        for j in range(len(rate)):
            sticks = max(rate[j], LEAST_RATE)
            slid = max(SLID * max(rate[j] - noise[j], 0.0) + noise[j], SLID * LEAST_RATE)
            ratio = counts[k, j] * math.log(slid / sticks) - (slid - sticks)
            p = probability[j] + (1 - probability[j]) / LETS_GO_MS
            odds = math.log(p / (1 - p)) + ratio / DISPERSION
            p = 1 / (1 + math.exp(-min(max(odds, -LARGEST), LARGEST)))
            probability[j] = p
            if p < 0.5:
                rate[j] += (1 - p) / FOLLOWED_MS * (counts[k, j] - rate[j])
            share[k] += p / len(rate)
