"""Slip by what the papillae do: one of them falls silent while the others go on.

While the skin is loaded, the markers of all papillae move in the image, and their edges cause
events. A tip that slides is loaded no further, so its marker comes to rest: the first sign of slip
is that one place causes no more events while the others cause as many as before. Nothing is
trained, and nothing is known of the sensor but its size.

Every millisecond:

1. **Places** are cells of the image with more events in the last quarter of a second than noise
   has, and that touch each other: the ring of a marker's edge, or a part of it. They are found anew
   every 10 ms. Noise is what the median cell has.
2. A place's **share** is what it had of all places' events in 100 ms, 5 ms ago. What moves all
   papillae alike leaves the shares as they were.
3. **Page's test** (Page 1954, Biometrika 41): a place's share of the current millisecond's events
   is a tenth of what it was, or its noise, against as it was; the likelihoods are binomial. Places
   that may be at rest, or that cause twice the events, do not count as the others.
4. **Dispersion**: the test's statistic is divided by the square of how much more the other places'
   shares vary than by chance (Pearson's statistic per degree of freedom, McCullagh & Nelder 1989,
   section 4.5). An object that brushes over single papillae changes their shares all the time. The
   quarter of the places that differ most are left out: they may be the tips that slide.

Evidence is the largest statistic of all places; 0 while fewer than `FEWEST_PLACES` of them move.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from sliplab.analysis.detectors.detector import Cost, Detector, Evidence
from sliplab.storage.streams import EventChunk

BIN_US = 1000
CELLS_ACROSS = 80
"""Cells along the image's width: a marker's edge has some ten of them."""
MEMORY_MS, GAP_MS = 100, 5
SEEN_MS = 250
"""Time in which places are looked for: slow markers are rings only then."""
PLACES_MS = 10
"""Interval of finding the places, and of measuring the dispersion."""
DISPERSION_MS = 60
"""Time over which the dispersion is averaged."""
FEWEST_PLACES = 10
"""Moving at once: a slide moves all papillae, an object that brushes over them a few."""
FEWEST_EVENTS = 20
"""Of a place in the memory, so that it says something."""
CELL_EVENTS, PLACE_CELLS = 2, 4
"""Events of a cell of a place beyond noise; cells of a place: hot pixels have fewer."""
NOISE_DEVIATIONS = 3.0
"""Standard deviations of noise (Poisson) that a cell of a place exceeds."""
AT_REST, DISTURBED = 0.1, 2.0
"""Rates of a place whose tip slides, and of one that is pushed, by what it had before."""
SUSPECTED = 6.0
"""Statistic from which a place does not count as one of the others."""
LARGEST = 30.0
"""Statistic of a pushed place at which it stays, so that it counts again soon afterwards."""
MOST = 0.95
"""Of a share, so that a place's rate can change."""
PRIOR_DISPERSION = 4.0
"""Before anything is measured: the weight of one measurement."""
REMAINING_MEAN = 0.368
"""Mean of the lower three quarters of squared normal deviates: F(1.323) / 0.75, with F the
distribution function of chi-squared with 3 degrees of freedom."""

F64 = npt.NDArray[np.float64]


class Papillae(Detector):
    """Detector by the silence of single papillae; see the module."""

    def begin(self, width: int, height: int) -> None:
        """See `Detector`."""
        self._cell_px = max(round(width / CELLS_ACROSS), 1)
        self._shape = -(-height // self._cell_px), -(-width // self._cell_px)
        self._done = 0
        self._ms, self._cell = np.zeros(0, np.int64), np.zeros(0, np.int64)
        self._place = np.full(self._shape[0] * self._shape[1], -1)
        self._rest, self._pushed = np.zeros(0), np.zeros(0)
        self._dispersions = np.full(DISPERSION_MS // PLACES_MS, np.nan)

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        """See `Detector`."""
        row, column = events.y // self._cell_px, events.x // self._cell_px
        self._ms = np.concatenate([self._ms, events.t_us // BIN_US])
        self._cell = np.concatenate([self._cell, row.astype(np.int64) * self._shape[1] + column])
        first, last = self._done, int(until_us) // BIN_US
        value = np.zeros(last - first)
        at = first
        while at < last:
            if at % PLACES_MS == 0:
                self._find_places(at)
            end = min(at - at % PLACES_MS + PLACES_MS, last)
            value[at - first : end - first] = self._advance(at, end)
            if end % PLACES_MS == 0:
                self._measure_dispersion(end)
            at = end
        self._done = last
        past = int(np.searchsorted(self._ms, last - SEEN_MS))
        self._ms, self._cell = self._ms[past:], self._cell[past:]
        return Evidence.of((np.arange(first, last) + 1) * BIN_US, value)

    def cost(self) -> Cost:
        """Return the operations of a millisecond with 20 places, and the bytes of its numbers.

        About 30 for each place, and 4 for each cell every 10 ms.
        """
        cells = CELLS_ACROSS**2 * 0.75
        return Cost(operations=20.0 * 30 + 4 * cells / PLACES_MS, memory_bytes=8 * 14)

    def _between(self, first: int, last: int) -> slice:
        """Return the events of the milliseconds from `first` on, before `last`."""
        return slice(*np.searchsorted(self._ms, (first, last)))

    def _counts(self, first: int, last: int) -> F64:
        """Return the events of each place in each millisecond, (last - first, places)."""
        found = self._between(first, last)
        place, places = self._place[self._cell[found]], len(self._rest)
        inside = place >= 0
        key = (self._ms[found][inside] - first) * places + place[inside]
        counts = np.bincount(key, minlength=(last - first) * places)
        return counts.reshape(last - first, places).astype(np.float64)

    def _find_places(self, at: int) -> None:
        """Find the places at a millisecond; each takes over the statistics of its cells."""
        seen = self._cell[self._between(at - SEEN_MS, at)]
        events = np.bincount(seen, minlength=len(self._place))
        noise = float(np.median(events))
        above = events >= noise + NOISE_DEVIATIONS * np.sqrt(noise) + CELL_EVENTS
        joined, _ = ndimage.label(above.reshape(self._shape), np.ones((3, 3)))
        place = joined.ravel() - 1
        size = np.bincount(place[place >= 0])
        number = np.where(size >= PLACE_CELLS, np.cumsum(size >= PLACE_CELLS) - 1, -1)
        place = np.where(place >= 0, np.append(number, -1)[place], -1)
        places = int(number.max(initial=-1)) + 1
        total = np.bincount(place[place >= 0], events[place >= 0], places)
        both = (place >= 0) & (self._place >= 0)

        def carried(statistic: F64) -> F64:
            sums = np.bincount(place[both], events[both] * statistic[self._place[both]], places)
            return sums / total

        self._rest, self._pushed = carried(self._rest), carried(self._pushed)
        self._place = place
        self._noise = np.bincount(place[place >= 0], minlength=places) * noise / SEEN_MS

    def _advance(self, first: int, last: int) -> F64:
        """Return the evidence of the milliseconds from `first` on, before `last`."""
        value = np.zeros(last - first)
        if len(self._rest) < FEWEST_PLACES:
            self._rest[:] = self._pushed[:] = 0.0
            return value
        now = self._counts(first, last)
        oldest = first - MEMORY_MS - GAP_MS
        sums = np.cumsum(self._counts(oldest, last - GAP_MS), axis=0)
        memory = sums[MEMORY_MS - 1 : MEMORY_MS - 1 + len(value)].copy()
        memory[1:] -= sums[: len(value) - 1]
        dispersion = self._dispersion()
        for k, (n, w) in enumerate(zip(now, memory, strict=True)):
            moving = w >= FEWEST_EVENTS
            w = np.maximum(w, 1.0)
            others = moving & (self._rest < SUSPECTED) & (self._pushed < SUSPECTED)
            if moving.sum() < FEWEST_PLACES or not others.any():
                self._rest[:] = self._pushed[:] = 0.0
                continue
            total = n[others].sum() + np.where(others, 0.0, n)
            share = np.minimum(w / (w[others].sum() + np.where(others, 0.0, w)), MOST)
            at_rest = np.minimum(AT_REST + (1 - AT_REST) * self._noise * MEMORY_MS / w, MOST)
            self._rest = _page(self._rest, at_rest, n, total, share) * moving
            pushed = _page(self._pushed, DISTURBED, n, total, np.minimum(share, MOST / DISTURBED))
            self._pushed = np.minimum(pushed, LARGEST) * moving
            value[k] = self._rest.max() / dispersion**2
        return value

    def _dispersion(self) -> float:
        """Return how much more the shares vary than by chance, at least 1."""
        known = self._dispersions[~np.isnan(self._dispersions)]
        return max((known.sum() + PRIOR_DISPERSION) / (len(known) + 1), 1.0)

    def _measure_dispersion(self, end: int) -> None:
        """Compare the shares of the places in the last 10 ms with those of the memory."""
        found = np.nan
        if len(self._rest) >= FEWEST_PLACES:
            n = self._counts(end - PLACES_MS, end).sum(axis=0)
            w = self._counts(end - MEMORY_MS - GAP_MS, end - GAP_MS).sum(axis=0)
            n, w = n[w >= FEWEST_EVENTS], w[w >= FEWEST_EVENTS]
            if len(w) >= FEWEST_PLACES and n.sum() > 0:
                expected = n.sum() * w / w.sum()
                squares = np.sort((n - expected) ** 2 / expected)
                found = squares[: len(w) - len(w) // 4].mean() / REMAINING_MEAN
        self._dispersions = np.append(self._dispersions[1:], found)


def _page(statistic: F64, ratio: F64 | float, n: F64, total: F64, share: F64) -> F64:
    """Advance Page's test of `ratio` times a share, against the share, by binomial counts."""
    rest = np.log((1 - ratio * share) / (1 - share))
    advanced: F64 = np.maximum(statistic + n * np.log(ratio) + (total - n) * rest, 0.0)
    return advanced
