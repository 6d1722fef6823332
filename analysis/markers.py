"""The white papilla tops in the outside video: one track each, to a few hundredths of a pixel.

The paper thresholds every frame and finds its blobs; at 100 frames a second over hours of video
that is the slowest step of the labelling, and the blobs have no names. Here the first frame is
searched so, the blobs get their names from the skin's layout, and from then on each marker is
followed inside a small disc around where it must be. A marker that cannot be measured well is lost,
not guessed: half-hidden discs shift by more than the 2 pixels that count as slip.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist

from analysis.blobs import (
    MIN_CONTRAST,
    Floats,
    Frame,
    checked_frame,
    find_blobs,
    match_layout,
)

_LOST, _WHOLE, _PARTIAL = 0, 1, 2


@dataclass(frozen=True)
class MarkerTracks:
    """One track a marker.

    Attributes:
        xy: (n, m, 2) float64, pixels, NaN where the marker was lost or partly out of the frame.
        ok: (n, m) bool, False where it is NaN.
    """

    xy: Floats
    ok: NDArray[np.bool_]


class MarkerTracker:
    """Follows the markers from frame to frame.

    Args:
        layout_px: (m, 2) nominal marker positions in pixels, relative to the centre marker.
        threshold: grey level that parts marker and background; by default taken from the first
            frame, a quarter of the way up.
        area_tolerance: a marker whose area differs by more than this share from its area in the
            first frame is lost (hidden, blurred, or merged with something bright).

    Raises:
        ValueError: the layout is not (m, 2), or two of its markers coincide.
    """

    def __init__(
        self, layout_px: Floats, *, threshold: int | None = None, area_tolerance: float = 0.15
    ) -> None:
        layout = np.array(layout_px, np.float64)
        if layout.ndim != 2 or layout.shape[1] != 2 or len(layout) == 0:
            raise ValueError(f"layout_px has the shape {layout.shape}: must be (markers, 2)")
        self._spacing = float(pdist(layout).min()) if len(layout) > 1 else 100.0
        if not self._spacing > 8:
            raise ValueError(f"layout_px has markers {self._spacing:.1f} px apart: too near")
        self._layout = layout
        self._fixed_threshold = threshold
        self._tolerance = area_tolerance
        m = len(layout)
        self._found = False
        self._threshold = 0
        self._xy = np.full((m, 2), np.nan)
        self._velocity = np.zeros((m, 2))
        self._area = np.zeros(m)
        self._state = np.zeros(m, np.int64)
        self._radius = 0.0
        self._margin = 0.0

    @property
    def radius_px(self) -> float:
        """The markers' median radius; 0 before they were found."""
        return self._radius

    def update(self, frame: Frame) -> tuple[Floats, NDArray[np.bool_]]:
        """The markers in the next frame.

        Returns:
            (m, 2) float64 pixels, NaN where lost, and (m,) bool.

        Raises:
            TypeError: the frame is not 2-D uint8.
        """
        frame = checked_frame(frame)
        if not self._found:
            self._find(frame)
        else:
            self._follow(frame)
        ok = self._state == _WHOLE
        return np.where(ok[:, None], self._xy, np.nan), ok

    def _find(self, frame: Frame) -> None:
        """Search the whole frame; the layout names the blobs."""
        level = self._fixed_threshold
        # the papillae's radius is 2.0 mm at a spacing of 5.6 mm: 0.36 of it
        limits = (np.pi * (0.15 * self._spacing) ** 2, np.pi * (0.5 * self._spacing) ** 2)
        blobs = find_blobs(frame, level, *limits)
        shift, index = match_layout(blobs.xy, self._layout, 0.35 * self._spacing)
        seen = index >= 0
        if seen.sum() * 2 < len(index):
            return
        centres = np.round(blobs.xy[index[seen]]).astype(np.int64)
        bright = float(np.median(frame[centres[:, 1], centres[:, 0]]))
        dark = float(np.median(frame))
        if bright - dark < MIN_CONTRAST:
            return
        # low on the flank: cutting at half the height bends the edges' weight by 0.015 px
        self._threshold = round(dark + (bright - dark) / 4) if level is None else level
        area = float(np.median(blobs.area[index[seen]]))
        self._radius = float(np.sqrt(area / np.pi))
        self._margin = max(3.0, 0.12 * self._radius)
        self._xy = np.where(seen[:, None], blobs.xy[index], self._layout + shift)
        self._area = np.full(len(index), area)
        self._state[:] = np.where(seen, _WHOLE, _LOST)
        self._found = True
        # measured as in every later frame, so that the first is no step
        self._measure(frame, self._xy.copy(), np.inf)
        whole = self._state == _WHOLE
        self._area[whole] = self._measured[whole]
        self._velocity[:] = 0.0

    def _follow(self, frame: Frame) -> None:
        before = self._xy.copy()
        known = self._state != _LOST
        self._measure(frame, self._xy + self._velocity, self._tolerance)
        seen = self._state != _LOST
        if (self._state == _WHOLE).sum() * 2 < len(seen) and self._find_again(frame):
            return
        both = known & seen
        steps = self._xy - before
        common = np.median(steps[both], axis=0) if both.any() else np.zeros(2)
        for i in np.flatnonzero(~seen):
            self._xy[i] = before[i] + common
            self._recover(frame, int(i))
        self._velocity = np.where(both[:, None], steps, common)

    def _measure(self, frame: Frame, predicted: Floats, tolerance: float) -> None:
        self._measured = np.zeros(len(predicted))
        _follow_all(
            frame, predicted, self._radius, self._margin, self._threshold, self._area, tolerance,
            self._state, self._measured,
        )  # fmt: skip
        self._xy = predicted

    def _recover(self, frame: Frame, i: int) -> None:
        """Look for a lost marker around where the others' motion has carried it."""
        reach = int(self._spacing)
        x, y = (round(float(v)) for v in self._xy[i])
        left, top = max(0, x - reach), max(0, y - reach)
        part = frame[top : max(0, y + reach + 1), left : max(0, x + reach + 1)]
        if part.shape[0] < 8 or part.shape[1] < 8:
            return
        area = self._area[i]
        blobs = find_blobs(
            part, self._threshold, area * (1 - self._tolerance), area * (1 + self._tolerance)
        )
        places = blobs.xy + np.array([left, top])
        taken = self._xy[self._state != _LOST]
        if len(taken):
            apart = np.hypot(*np.moveaxis(places[:, None] - taken[None], -1, 0))
            places = places[(apart > self._radius).all(axis=1)]
        distance = np.hypot(*(places - self._xy[i]).T)
        # less than half the way to a neighbour's place: it cannot be the neighbour
        if len(distance) and distance.min() < 0.45 * self._spacing:
            self._xy[i] = places[int(distance.argmin())]
            inside = _inside(self._xy[i], frame.shape, self._radius)
            self._state[i] = _WHOLE if inside else _PARTIAL

    def _find_again(self, frame: Frame) -> bool:
        """Most are lost (the camera was covered, the sensor jumped): search the whole frame."""
        area = float(np.median(self._area))
        limits = (area * (1 - self._tolerance), area * (1 + self._tolerance))
        blobs = find_blobs(frame, self._threshold, *limits)
        _, index = match_layout(blobs.xy, self._xy, 0.35 * self._spacing)
        seen = index >= 0
        if seen.sum() * 4 < 3 * len(seen):
            return False
        shift = np.median(blobs.xy[index[seen]] - self._xy[seen], axis=0)
        self._measure(
            frame, np.where(seen[:, None], blobs.xy[index], self._xy + shift), self._tolerance
        )
        self._velocity[:] = 0.0
        return True


def track(
    frames: Iterable[Frame], layout_px: Floats, *, threshold: int | None = None
) -> MarkerTracks:
    """All markers through a video; see `MarkerTracker`.

    Frames before the markers are first found are NaN.
    """
    tracker = MarkerTracker(layout_px, threshold=threshold)
    rows = [tracker.update(frame) for frame in frames]
    return stack_tracks(rows, len(layout_px))


def stack_tracks(rows: list[tuple[Floats, NDArray[np.bool_]]], markers: int) -> MarkerTracks:
    """The results of `MarkerTracker.update` as one `MarkerTracks`."""
    if not rows:
        return MarkerTracks(np.empty((0, markers, 2)), np.empty((0, markers), np.bool_))
    return MarkerTracks(np.stack([xy for xy, _ in rows]), np.stack([ok for _, ok in rows]))


def _inside(xy: Floats, shape: tuple[int, ...], radius: float) -> bool:
    reach = radius + 1
    return bool(reach <= xy[0] <= shape[1] - 1 - reach and reach <= xy[1] <= shape[0] - 1 - reach)


@numba.njit(cache=True, nogil=True)
def _disc_sums(frame: Any, cx: int, cy: int, halves: Any, cuts: Any, threshold: int) -> Any:
    """Pixel count, weight and weighted sums of x and y above the threshold in a disc.

    A cut (x0, y0, dx, dy) takes away what lies beyond (x0, y0) in the direction (dx, dy).
    """
    height, width = frame.shape
    reach = halves.size - 1
    count, total, sum_x, sum_y = 0, 0, 0, 0
    for i in range(max(0, cy - reach), min(height, cy + reach + 1)):
        half = halves[abs(i - cy)]
        left, right = max(0, cx - half), min(width, cx + half + 1)
        for x0, y0, dx, dy in cuts:
            beyond = (i - y0) * dy
            if abs(dx) < 1e-9:
                right = left if beyond > 0 else right
            elif dx > 0:
                right = min(right, int(np.floor(x0 - beyond / dx)) + 1)
            else:
                left = max(left, int(np.ceil(x0 - beyond / dx)))
        row = frame[i, left : max(left, right)]
        row_n, row_w, row_x = 0, 0, 0
        for j in range(row.size):
            excess = row[j] - threshold
            w = excess if excess > 0 else 0
            row_w += w
            row_x += w * j
            row_n += w > 0
        count += row_n
        total += row_w
        sum_x += row_x + row_w * left
        sum_y += row_w * i
    return count, total, sum_x, sum_y


@numba.njit(cache=True, nogil=True)
def _near_cuts(xy: Any, k: int, x: float, y: float, known: Any, reach: float, cuts: Any) -> Any:
    """The lines half-way to those neighbours of marker k that may look into its disc."""
    n = 0
    for other in range(xy.shape[0]):
        dx, dy = xy[other, 0] - x, xy[other, 1] - y
        apart = np.hypot(dx, dy)
        if other != k and known[other] and reach < apart < 2 * reach:
            cuts[n] = (x + dx / 2, y + dy / 2, dx / apart, dy / apart)
            n += 1
    return cuts[:n]


@numba.njit(cache=True, nogil=True)
def _verdict(
    x: float, y: float, count: int, radius: float, width: int, height: int, area: float,
    tolerance: float,
) -> int:  # fmt: skip
    inside = radius + 1 <= x <= width - 2 - radius and radius + 1 <= y <= height - 2 - radius
    if not inside:
        return _PARTIAL
    return _WHOLE if abs(count - area) <= tolerance * area else _LOST


@numba.njit(cache=True, nogil=True)
def _follow_all(
    frame: Any, xy: Any, radius: float, margin: float, threshold: int, area: Any, tolerance: float,
    state: Any, measured: Any,
) -> None:  # fmt: skip
    """Move every marker of `xy` from its prediction to its centroid, and say how it fared."""
    height, width = frame.shape
    reach = int(np.ceil(radius + margin))
    halves = np.empty(reach + 1, np.int64)
    for i in range(reach + 1):
        halves[i] = int(np.sqrt(max(0.0, (radius + margin) ** 2 - i * i)))
    predicted = xy.copy()
    known = state != _LOST
    cuts = np.empty((xy.shape[0], 4))
    # again when something moved far: the cuts stood where the neighbours no longer are
    for _ in range(3):
        farthest = 0.0
        for k in range(xy.shape[0]):
            x, y = xy[k, 0], xy[k, 1]
            state[k] = _LOST
            # the disc is moved on until the whole marker lies inside it
            for _ in range(8):
                if not (-reach < x < width + reach and -reach < y < height + reach):
                    break
                cx, cy = int(np.round(x)), int(np.round(y))
                near = _near_cuts(xy, k, x, y, known, radius + margin, cuts)
                count, total, sum_x, sum_y = _disc_sums(frame, cx, cy, halves, near, threshold)
                if count < 0.3 * area[k]:
                    break
                x, y = sum_x / total, sum_y / total
                if (x - cx) ** 2 + (y - cy) ** 2 <= (margin - 1) ** 2:
                    state[k] = _verdict(x, y, count, radius, width, height, area[k], tolerance)
                    measured[k] = count
                    break
            if state[k] != _LOST:
                farthest = max(farthest, np.hypot(x - xy[k, 0], y - xy[k, 1]))
                xy[k, 0], xy[k, 1] = x, y
        if farthest < 1.5:
            break
    # two on one blob: it belongs to the one that had less far to go
    for a in range(xy.shape[0]):
        for b in range(a):
            if state[a] != _LOST and state[b] != _LOST:
                apart = (xy[a, 0] - xy[b, 0]) ** 2 + (xy[a, 1] - xy[b, 1]) ** 2
                if apart < radius * radius:
                    way_a = np.hypot(xy[a, 0] - predicted[a, 0], xy[a, 1] - predicted[a, 1])
                    way_b = np.hypot(xy[b, 0] - predicted[b, 0], xy[b, 1] - predicted[b, 1])
                    state[a if way_a > way_b else b] = _LOST
