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


@njit(cache=True, nogil=True)
def _followed(away: Any) -> Any:
    """Return shift, unsure and sigma of each frame, and whether many markers at rest moved."""
    n, m, _ = away.shape
    shift, unsure, sigma = np.zeros((n, 2)), np.zeros(n, np.bool_), np.full(n, _UNANCHORED_PX)
    stuck, gone = np.ones(m, np.bool_), np.zeros(m, np.int64)
    velocity, before = np.zeros((m, 2)), np.full((m, 2), np.nan)
    now, drifted, fastest, restless = np.zeros(2), False, 0.0, 0
    for f in range(n):
        seen = np.isfinite(away[f, :, 0])
        hold, last, trembles = away[f][stuck & seen], now, restless >= _RESTLESS
        anchored = False
        if len(hold) >= ANCHORS:
            near = _lengths(hold - _median(hold)) < _APART_PX
            anchored = near.sum() >= max(ANCHORS, 0.5 * len(hold))
            if anchored:
                now = _median(hold[near])
                still = _lengths(hold) < LEAST_PX
                if _length(now) > LEAST_PX and still.sum() >= ANCHORS and not trembles:
                    # papillae that do not touch move together, and are more than those that do
                    near, now = still, _median(hold[still])
                sigma[f] = np.sqrt(np.mean((hold[near] - now) ** 2))
                drifted |= near.sum() >= MANY and _length(now) > LEAST_PX
        if not anchored and seen.any():
            # innovations: of what stood still its place, of what slides its step
            new = np.where(stuck[:, None], away[f], away[f] - before - velocity) - now
            known = seen & np.isfinite(new[:, 0])
            step = _median(new[known]) if known.sum() >= ANCHORS else np.zeros(2)
            knock = _length(step) > KNOCK_PX
            if knock and fastest > KNOCK_PX and not trembles:
                knock = _all_took(step, new, known, stuck, velocity)
            if knock:
                now = now + step
                unsure[f] = True
        shift[f] = now
        restless += _length(now - last) > LEAST_PX
        place = away[f] - now
        gone = np.where(seen & (_lengths(place) > 2 * _APART_PX), gone + 1, 0)
        stuck &= gone < _GONE_FRAMES
        moved = np.where(np.isfinite(before), place - before, 0.0)
        fastest = max(fastest, _lengths(moved).max())
        velocity[seen] = _KEEP * velocity[seen] + (1 - _KEEP) * moved[seen]
        before[seen] = place[seen]
    return shift, unsure, sigma, drifted


@njit(cache=True, nogil=True)
def _all_took(step: Any, new: Any, known: Any, stuck: Any, velocity: Any) -> bool:
    """Return whether a median step is the camera's: then all markers jump.

    It is asked once a marker has moved by more than a knock in a frame, as in slides above some
    2 mm/s. There many may let go in a few frames, and each steps so far; but others are still at
    rest, or continue to slide. Where all slide, they may slow down together, as the arm does.

    Args:
        new, velocity: (m, 2) innovations, and motion per frame so far, px.
        known, stuck: (m,) markers with an innovation; those at rest.
    """
    standing = known & stuck
    witnesses = standing if standing.any() else known
    if np.mean(_lengths(new[witnesses]) < _APART_PX) >= _CALM_SHARE:
        return False
    if standing.any():
        return True
    common = _median(velocity[known])
    speed = _length(common)
    if speed <= _APART_PX:
        return True
    slower = -(step[0] * common[0] + step[1] * common[1]) / speed
    across = _length(step + slower * common / speed)
    return not (across < _APART_PX and 0 < slower < speed + _APART_PX)


@njit(cache=True, nogil=True)
def _median(places: Any) -> Any:
    """Median of each coordinate of (k, 2)."""
    return np.array([np.median(places[:, 0]), np.median(places[:, 1])])


@njit(cache=True, nogil=True)
def _lengths(vectors: Any) -> Any:
    """Lengths of (k, 2)."""
    return np.hypot(vectors[:, 0], vectors[:, 1])


@njit(cache=True, nogil=True)
def _length(vector: Any) -> float:
    return np.hypot(vector[0], vector[1])


def no_shift(n: int) -> CameraShift:
    """Return the motion of a camera at rest for n frames."""
    return CameraShift(np.zeros((n, 2)), np.zeros(n, np.bool_), np.zeros(n))
