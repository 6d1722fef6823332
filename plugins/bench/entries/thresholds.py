"""Thresholds without training: a fall of the event rate, and of the motion in the image.

While the skin is loaded, all markers move and the camera sees many events; a tip that slides is
loaded no further, and its marker comes to rest. So slip begins with a fall of either.
"""

from __future__ import annotations

from abc import abstractmethod

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view

from sliplab.analysis.detectors.detector import Cost
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.plugins.bench.windowed import WindowDetector
from sliplab.protocols.windows import Windows

STRIDE_MS = 10
SMOOTHED, REMEMBERED = 8, 50
"""Windows of a mean, and means of which the largest is remembered."""
STATE_BYTES = 4 * (SMOOTHED + REMEMBERED)
PATCHES = 5
"""Patches along a side, in each of which motion is measured."""


class Fall(WindowDetector):
    """Drop of a mean over 80 ms below its largest value of the last half second."""

    def __init__(self) -> None:
        super().__init__(Windows(polarity="both"), STRIDE_MS)

    def restart(self) -> None:
        """See `WindowDetector`."""
        self._last = np.zeros(SMOOTHED + REMEMBERED - 2)

    def decide(self, x: SparseWindows) -> tuple[npt.ArrayLike, npt.ArrayLike | None]:
        """See `WindowDetector`."""
        every = np.concatenate([self._last, self.measured(x)])
        self._last = every[-(SMOOTHED + REMEMBERED - 2) :]
        means = sliding_window_view(every, SMOOTHED).mean(axis=1)
        return sliding_window_view(means, REMEMBERED).max(axis=1) - means[REMEMBERED - 1 :], None

    @abstractmethod
    def measured(self, x: SparseWindows) -> npt.NDArray[np.float64]:
        """Return the quantity that falls, (n,)."""


class EventRate(Fall):
    """Events of a window."""

    def measured(self, x: SparseWindows) -> npt.NDArray[np.float64]:
        """See `Fall`."""
        return x.totals.astype(np.float64)

    def cost(self) -> Cost:
        """Return the operations besides counting events."""
        return Cost(SMOOTHED + REMEMBERED, STATE_BYTES)


class Flow(Fall):
    """Motion of the image: of the difference between brighter and darker events' places.

    A bright marker that moves has brighter events in front and darker ones behind. In each patch of
    cells the difference of their centroids, times the events, is its motion; patches are added as
    vectors.
    """

    def measured(self, x: SparseWindows) -> npt.NDArray[np.float64]:
        """See `Fall`."""
        total = motions(x).sum(axis=1)
        return np.hypot(total[:, 0], total[:, 1])

    def cost(self) -> Cost:
        """Return the sums over all cells."""
        sums = 4 * self.windows.channels * self.windows.cells**2
        return Cost(sums + SMOOTHED + REMEMBERED, STATE_BYTES)


def motions(x: SparseWindows) -> npt.NDArray[np.float64]:
    """Return the motion of each patch of windows, cells times events, (n, patches, 2).

    Args:
        x: windows of both polarities, the darker events first.
    """
    steps, _, rows, columns = x.shape
    step = np.repeat(np.arange(len(x) * steps), np.diff(x.offsets))
    channel, place = np.divmod(x.cell.astype(np.int64), rows * columns)
    row, column = np.divmod(place, columns)
    side = rows // PATCHES
    patch = (row // side) * PATCHES + column // side
    key = ((step // steps) * 2 + channel) * PATCHES**2 + patch
    size = len(x) * 2 * PATCHES**2

    def sums(weights: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        found = np.bincount(key, weights, size).astype(np.float64)
        return found.reshape(len(x), 2, PATCHES**2)

    count = x.count.astype(np.float64)
    events = sums(count)
    centroids = np.stack([sums(count * row), sums(count * column)], axis=-1)
    centroids /= np.maximum(events, 1.0)[..., None]
    return (centroids[:, 1] - centroids[:, 0]) * events.min(axis=1)[..., None]
