"""Slip onset of every papilla of a trial, from the change points of their tracks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sliplab.analysis.labels.change_point import change_point, departure
from sliplab.analysis.labels.onsets import NO_ONSET, LabelOnsets
from sliplab.storage.schema.label import OnsetDoubts

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_MEAN, _CREPT_PX = 5, 0.02
"""Means over so many frames that leave rest by this, px, show a slip too small for a departure."""
WIDEST_NS = 40_000_000
"""A slip's interval may be this wide without making an onset unknown: two frames either way."""


@dataclass(frozen=True)
class SlipTimes:
    """Slip onsets of m papillae: medians and central 95 % intervals, ns, -1 for none.

    A slip that was not seen from near (the marker was hidden) has an onset, its first frame away
    from rest, and an interval from the last frame at rest to that one.
    """

    at_ns: Ints
    low_ns: Ints
    high_ns: Ints
    centre: int
    widest_ns: int = WIDEST_NS

    @property
    def onsets(self) -> LabelOnsets:
        """Onsets of the first papilla and of the centre."""
        slipped = self.at_ns != NO_ONSET
        if not slipped.any():
            return LabelOnsets(None, None, None, self.at_ns)
        first = int(np.where(slipped, self.at_ns, np.iinfo(np.int64).max).argmin())
        gross = int(self.at_ns[self.centre])
        return LabelOnsets(
            int(self.at_ns[first]), None if gross == NO_ONSET else gross, first, self.at_ns
        )

    def doubts(self) -> OnsetDoubts:
        """Return the onsets that these intervals leave ambiguous."""
        onsets, wide = self.onsets, self.high_ns - self.low_ns > self.widest_ns
        gross = incipient = None
        if onsets.gross_ns is not None and wide[self.centre]:
            gross = "the centre marker's slip is only known to " + self._width(self.centre)
        if onsets.incipient_ns is not None:
            for marker in np.flatnonzero(wide).tolist():
                if self.low_ns[marker] < onsets.incipient_ns + self.widest_ns // 2:
                    incipient = f"marker {marker}'s slip is only known to {self._width(marker)}"
        return OnsetDoubts(incipient=incipient, gross=gross)

    def _width(self, marker: int) -> str:
        return f"{(self.high_ns[marker] - self.low_ns[marker]) / 1e6:.0f} ms"


def crept_from(away: Floats, sigma: Floats) -> int:
    """The frame from which a marker was no longer quite where it rested, up to the last one.

    A papilla may slip by less than a departure and stick again; where it is not known which of its
    slips was the first, the interval has to say so.

    Args:
        away: (k, 2) offsets from rest up to the departure, px. sigma: (k,) px.
    """
    known = np.flatnonzero(np.isfinite(away).all(axis=1) & np.isfinite(sigma))
    if len(known) < _MEAN:
        return len(away)
    box = np.ones(_MEAN) / _MEAN
    x, y = (np.convolve(column, box, "valid") for column in away[known].T)
    limit = np.maximum(_CREPT_PX, 5 * np.convolve(sigma[known], box, "valid") / np.sqrt(_MEAN))
    home = np.flatnonzero(np.hypot(x, y) <= limit)
    if not len(home):
        return 0
    # the mean at k is over k to k + 4
    last = int(home[-1]) + _MEAN - 1
    return int(known[last]) if last < len(known) - 1 else len(away)


def slip_times(
    frame_ns: Ints,
    away: Floats,
    sigma: Floats,
    centre: int,
    not_before_ns: int,
    exposure_ns: int,
    threshold_px: float,
) -> SlipTimes:
    """Find every slip.

    Args:
        frame_ns: (n,) int64. away: (n, m, 2) offsets from rest, px, NaN where unknown.
        sigma: (n, m) px, of a coordinate of `away`.
        not_before_ns: start of the motion.
        exposure_ns: how long the shutter is open.
        threshold_px: a marker that never gets so far has not slipped, but crept.
    """
    m = away.shape[1]
    at, low, high = (np.full(m, NO_ONSET, np.int64) for _ in range(3))
    first = int(np.searchsorted(frame_ns, not_before_ns))
    far = np.hypot(away[..., 0], away[..., 1])
    for marker in range(m):
        # a comparison with NaN is False
        if not (far[first:, marker] > threshold_px).any():
            continue
        left = departure(away[:, marker], sigma[:, marker], first)
        if left is None:  # it crept there, or was rarely seen
            over = first + int((far[first:, marker] > threshold_px).argmax())
            at[marker], low[marker], high[marker] = frame_ns[over], not_before_ns, frame_ns[over]
            continue
        known = np.flatnonzero(np.isfinite(away[:left, marker, 0]))
        rested = frame_ns[known[-1]] if len(known) else not_before_ns
        found = change_point(frame_ns, away[:, marker], sigma[:, marker], left, exposure_ns)
        if found is None:
            at[marker], low[marker], high[marker] = frame_ns[left], rested, frame_ns[left]
        else:
            at[marker], high[marker] = found.at_ns, found.high_ns
            began = crept_from(away[:left, marker], sigma[:left, marker])
            low[marker] = min(found.low_ns, int(frame_ns[max(began, first)]))
    return SlipTimes(at, low, high, centre)
