"""Motion of a knocked camera: the common motion of all markers, which is subtracted.

While papillae are stuck their markers do not move on a plate at rest, so the median of their motion
is the camera's own motion, and it is subtracted. Once all but the last have slipped nothing shows
where the camera points. A sudden step of all markers is still distinguished from slip, a slower
motion is not, and labels are flagged as doubtful where that happens. Trials with a sliding plate
are measured from the plate's own marker and need none of this.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sliplab.storage.kernels import njit

Floats = NDArray[np.float64]

LEAST_PX = 0.15
"""Smallest common shift of many markers at rest; below it nothing is corrected."""
KNOCK_PX = 0.4
"""A common step from one frame to the next that no slip makes."""
ANCHORS, MANY = 5, 10
"""Markers at rest that show where the camera points, and so many that they cannot all have slipped
together by chance."""
_APART_PX = 0.3
_CALM_SHARE = 0.1
"""Share of the markers that may go on as they did by chance in a frame with a knock."""
_RESTLESS = 5
"""Steps of more than `LEAST_PX` after which a camera trembles: then any further step is its own."""
_GONE_FRAMES = 3
_KEEP = 0.8
_UNANCHORED_PX = 0.15


@dataclass(frozen=True)
class CameraShift:
    """Motion of the camera.

    Attributes:
        px: (n, 2) common shift, 0 if there is none.
        unsure: (n,) bool, True where it moved and too few markers were at rest to measure it.
    """

    px: Floats
    unsure: NDArray[np.bool_]
    sigma: Floats
    """(n,) standard deviation that its correction adds to a coordinate, px."""

    @property
    def largest_px(self) -> float:
        """Largest shift over the trial, px."""
        return float(np.hypot(*self.px.T).max(initial=0.0))


def camera_shift(away: Floats) -> CameraShift:
    """The common shift of markers.

    Args:
        away: (n, m, 2) offsets from their positions at rest, px, NaN where unknown.
    """
    shift, unsure, sigma, drifted = _followed(np.asarray(away, np.float64))
    knocked = np.hypot(*np.diff(shift, axis=0, prepend=0.0).T).max(initial=0.0) > KNOCK_PX
    if not (drifted or knocked):
        return no_shift(len(away))
    return CameraShift(shift, unsure, sigma)


# loops rather than expressions of arrays, of which each takes numba as long as a whole kernel
@njit(cache=True, nogil=True)
def _followed(away: Any) -> Any:
    """Return shift, unsure and sigma of each frame, and whether many markers at rest moved."""
    n, m, _ = away.shape
    shift, unsure, sigma = np.zeros((n, 2)), np.zeros(n, np.bool_), np.full(n, _UNANCHORED_PX)
    stuck, gone = np.ones(m, np.bool_), np.zeros(m, np.int64)
    velocity, before = np.zeros((m, 2)), np.full((m, 2), np.nan)
    seen, hold = np.zeros(m, np.bool_), np.zeros(m, np.bool_)
    near, still = np.zeros(m, np.bool_), np.zeros(m, np.bool_)
    known, new, sorting = np.zeros(m, np.bool_), np.empty((m, 2)), np.empty(m)
    x, y, drifted, fastest, restless = 0.0, 0.0, False, 0.0, 0
    for f in range(n):
        now = away[f]
        last_x, last_y, trembles = x, y, restless >= _RESTLESS
        for i in range(m):
            seen[i] = np.isfinite(now[i, 0])
            hold[i] = stuck[i] and seen[i]
        held = _count(hold)
        anchored = False
        if held >= ANCHORS:
            middle_x, middle_y = _median(now, hold, sorting)
            for i in range(m):
                near[i] = (
                    hold[i] and _length(now[i, 0] - middle_x, now[i, 1] - middle_y) < _APART_PX
                )
                still[i] = hold[i] and _length(now[i, 0], now[i, 1]) < LEAST_PX
            anchored = _count(near) >= max(ANCHORS, 0.5 * held)
            if anchored:
                x, y = _median(now, near, sorting)
                if _length(x, y) > LEAST_PX and _count(still) >= ANCHORS and not trembles:
                    # papillae that do not touch move together, and are more than those that do
                    near[:] = still
                    x, y = _median(now, still, sorting)
                squares = 0.0
                for i in range(m):
                    if near[i]:
                        squares += (now[i, 0] - x) * (now[i, 0] - x)
                        squares += (now[i, 1] - y) * (now[i, 1] - y)
                sigma[f] = np.sqrt(squares / (2 * _count(near)))
                drifted |= _count(near) >= MANY and _length(x, y) > LEAST_PX
        if not anchored and _count(seen) > 0:
            # innovations: of what stood still its place, of what slides its step
            for i in range(m):
                for c in range(2):
                    if stuck[i]:
                        new[i, c] = now[i, c]
                    else:
                        new[i, c] = now[i, c] - before[i, c] - velocity[i, c]
                new[i, 0] -= x
                new[i, 1] -= y
                known[i] = seen[i] and np.isfinite(new[i, 0])
            step_x, step_y = 0.0, 0.0
            if _count(known) >= ANCHORS:
                step_x, step_y = _median(new, known, sorting)
            knock = _length(step_x, step_y) > KNOCK_PX
            if knock and fastest > KNOCK_PX and not trembles:
                knock = _all_took(step_x, step_y, new, known, stuck, velocity, sorting)
            if knock:
                x, y = x + step_x, y + step_y
                unsure[f] = True
        shift[f, 0], shift[f, 1] = x, y
        restless += _length(x - last_x, y - last_y) > LEAST_PX
        quickest, whole = 0.0, True
        for i in range(m):
            at_x, at_y = now[i, 0] - x, now[i, 1] - y
            gone[i] = gone[i] + 1 if seen[i] and _length(at_x, at_y) > 2 * _APART_PX else 0
            stuck[i] = stuck[i] and gone[i] < _GONE_FRAMES
            moved_x = at_x - before[i, 0] if np.isfinite(before[i, 0]) else 0.0
            moved_y = at_y - before[i, 1] if np.isfinite(before[i, 1]) else 0.0
            length = _length(moved_x, moved_y)
            whole = whole and not np.isnan(length)
            quickest = max(quickest, length)
            if seen[i]:
                velocity[i, 0] = _KEEP * velocity[i, 0] + (1 - _KEEP) * moved_x
                velocity[i, 1] = _KEEP * velocity[i, 1] + (1 - _KEEP) * moved_y
                before[i, 0], before[i, 1] = at_x, at_y
        if whole:  # a marker that is lost leaves the largest motion open
            fastest = max(fastest, quickest)
    return shift, unsure, sigma, drifted


@njit(cache=True, nogil=True)
def _all_took(
    step_x: float, step_y: float, new: Any, known: Any, stuck: Any, velocity: Any, sorting: Any
) -> bool:
    """Return whether a median step is the camera's: then all markers jump.

    It is asked once a marker has moved by more than a knock in a frame, as in slides above some
    2 mm/s. There many may let go in a few frames, and each steps so far; but others are still at
    rest, or continue to slide. Where all slide, they may slow down together, as the arm does.

    Args:
        new, velocity: (m, 2) innovations, and motion per frame so far, px.
        known, stuck: (m,) markers with an innovation; those at rest.
        sorting: (m,) room.
    """
    standing = 0
    for i in range(len(known)):
        standing += known[i] and stuck[i]
    witnesses, calm = 0, 0
    for i in range(len(known)):
        if known[i] and (stuck[i] or standing == 0):
            witnesses += 1
            calm += _length(new[i, 0], new[i, 1]) < _APART_PX
    if calm / witnesses >= _CALM_SHARE:
        return False
    if standing > 0:
        return True
    common_x, common_y = _median(velocity, known, sorting)
    speed = _length(common_x, common_y)
    if speed <= _APART_PX:
        return True
    slower = -(step_x * common_x + step_y * common_y) / speed
    across = _length(step_x + slower * common_x / speed, step_y + slower * common_y / speed)
    return not (across < _APART_PX and 0 < slower < speed + _APART_PX)


@njit(cache=True, nogil=True)
def _median(places: Any, which: Any, sorting: Any) -> tuple[Any, Any]:
    """Median of each coordinate of some of (m, 2) places; `sorting` is room."""
    return _middle(places[:, 0], which, sorting), _middle(places[:, 1], which, sorting)


@njit(cache=True, nogil=True)
def _middle(values: Any, which: Any, sorting: Any) -> Any:
    k = 0
    for i in range(len(which)):
        if which[i]:
            sorting[k] = values[i]
            k += 1
    sorting[:k].sort()
    return 0.5 * (sorting[(k - 1) // 2] + sorting[k // 2])


@njit(cache=True, nogil=True)
def _count(which: Any) -> Any:
    found = 0
    for each in which:
        found += each
    return found


@njit(cache=True, nogil=True)
def _length(x: Any, y: Any) -> Any:
    return np.hypot(x, y)


def no_shift(n: int) -> CameraShift:
    """Return the motion of a camera at rest for n frames."""
    return CameraShift(np.zeros((n, 2)), np.zeros(n, np.bool_), np.zeros(n))
