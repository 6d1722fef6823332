"""Slips of the papillae in a pilot's slides, from the markers' tracks: the input of all estimates.

A tip sticks to the plate until its spring reaches friction, then follows its base at a distance:
its lag. Both are seen directly: base motion as the arm reported it less the marker's displacement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sliplab.plugins.twin.pilot import PilotTrial
from sliplab.storage.streams import F64, I64

Mask = npt.NDArray[np.bool_]

DEPARTED_SIGMAS = 6.0
"""A marker moves when two frames in a row are this far from its place of rest."""
LEAST_NOISE_MM = 1e-4
"""Noise of a marker's place is taken to be at least this."""
FREE_MM = 0.02
"""A marker that goes before its base has gone this far never stuck: its papilla is in the air."""
SETTLES_S = 0.3
"""After this long a tip that let go slides as its base moves."""
LEAST_PATH_MM = 1.0
"""A lag is a mean over at least this path."""
AFTER_S = np.array([0.06, 0.1, 0.16, 0.25, 0.4, 0.6, 0.9, 1.3, 1.8, 2.5, 3.5, 5.0, 7.0])
"""Times after a slip at which the lag is looked at, s."""


@dataclass(frozen=True)
class SlideSlips:
    """Slips of m papillae in k slides.

    Attributes:
        trials: the slides, all with m markers.
        depth_mm, speed_mm_s: (k,). direction: (k, 2).
        noise_mm: of a marker's place, (k,).
        free: never stuck, (k, m). slipped_s: time of the first slip, NaN: never, (k, m).
        stretch_mm: base's path until then, which is what the spring was stretched, (k, m).
        after_mm: lag at `AFTER_S` after the slip, NaN beyond the slide, (k, m, AFTER_S).
        lag_mm: lag along the slide in its frames, one array (n, m) a slide, with their times
            `frame_s` (n,) and the tips' paths `path_mm` (n, m).
    """

    trials: tuple[PilotTrial, ...]
    depth_mm: F64
    speed_mm_s: F64
    direction: F64
    noise_mm: F64
    free: Mask
    slipped_s: F64
    stretch_mm: F64
    after_mm: F64
    lag_mm: list[F64]
    frame_s: list[F64]
    path_mm: list[F64]

    @property
    def slid(self) -> Mask:
        """Papillae that stuck first and then slipped, (k, m)."""
        return np.isfinite(self.slipped_s) & ~self.free

    @property
    def depths(self) -> tuple[F64, I64]:
        """The levels of depth in rising order, and each slide's level, (k,)."""
        levels, which = np.unique(np.round(self.depth_mm, 3), return_inverse=True)
        return levels, which.astype(np.int64)


def mean_seen(values: F64, axis: int | tuple[int, ...] = 0) -> F64:
    """Mean of the numbers that are not NaN; NaN without any, and no warning."""
    seen = np.isfinite(values)
    count = seen.sum(axis=axis)
    total = np.where(seen, values, 0.0).sum(axis=axis)
    result: F64 = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return result


def find_slips(trials: Sequence[PilotTrial]) -> SlideSlips | None:
    """Return the slips in those slides that have the usual number of markers; None without any."""
    counts = [trial.tips_mm.shape[1] for trial in trials]
    if not counts or max(counts) == 0:
        return None
    usual = max(set(counts), key=counts.count)
    retained = tuple(trial for trial in trials if trial.tips_mm.shape[1] == usual)
    found = [_slips_of(trial) for trial in retained]
    noise, free, slipped, stretch, after, lag, frame_s, path = zip(*found, strict=True)
    return SlideSlips(
        retained,
        np.array([trial.slide.depth_mm for trial in retained]),
        np.array([trial.slide.speed_mm_s for trial in retained]),
        np.array([trial.slide.direction for trial in retained]),
        np.array(noise),
        np.array(free),
        np.array(slipped),
        np.array(stretch),
        np.array(after),
        list(lag),
        list(frame_s),
        list(path),
    )


def _slips_of(trial: PilotTrial) -> tuple[float, Mask, F64, F64, F64, F64, F64, F64]:
    """Return the columns of `SlideSlips` from `noise_mm` on."""
    held = (trial.frame_s < 0.0) & (trial.frame_s >= -0.5)
    moving = (trial.frame_s >= 0.0) & (trial.frame_s <= trial.slide_s)
    along = trial.slide.direction
    rest = mean_seen(trial.tips_mm[held])
    t, base = trial.frame_s[moving], trial.base_mm[moving] @ along
    path = (trial.tips_mm[moving] - rest) @ along
    noise = _noise((trial.tips_mm[held] @ along)[:, :])
    m = path.shape[1]
    slipped, stretch = np.full(m, np.nan), np.full(m, np.nan)
    after = np.full((m, len(AFTER_S)), np.nan)
    free = np.zeros(m, bool)
    lag = base[:, None] - path
    for j in range(m):
        seen = np.flatnonzero(np.isfinite(path[:, j]))
        away = path[seen, j] > DEPARTED_SIGMAS * noise
        gone = np.flatnonzero(away[:-1] & away[1:])
        if not len(gone):
            continue
        k = int(gone[0])
        here, then = seen[k], seen[k + 1]
        # back to its place at the speed that it has now, but not before it was last seen there
        pace = (path[then, j] - path[here, j]) / (t[then] - t[here])
        earliest = t[seen[k - 1]] if k > 0 else 0.0
        at = t[here] - path[here, j] / pace if pace > 0.0 else earliest
        at = min(max(at, earliest), t[here])
        slipped[j], stretch[j] = at, np.interp(at, t, base)
        free[j] = stretch[j] < FREE_MM
        ends = at + AFTER_S <= t[-1]
        after[j, ends] = np.interp(at + AFTER_S[ends], t[seen], lag[seen, j])
    return noise, free, slipped, stretch, after, lag, t, path


def _noise(held: F64) -> float:
    """Noise of a place from frame to frame in the hold, mm; `held`: (n, m)."""
    steps = np.abs(np.diff(held, axis=0))
    steps = steps[np.isfinite(steps)]
    found = float(np.median(steps)) / 0.6745 / np.sqrt(2.0) if len(steps) else 0.0
    return max(found, LEAST_NOISE_MM)
