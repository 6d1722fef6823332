"""The white papilla tops in the outside video: one track each, to a few thousandths of a pixel.

The paper thresholds every frame and finds its blobs (the tests' `reference_tracks`); at 100
frames a second over hours of video that is the slowest step of the labelling, and the blobs have no
names. Here the first frame is searched so, the blobs get their names from the skin's layout, and
from then on each marker is followed inside a small box around where it must be. Each place comes
with its standard deviation and a quality. A marker that cannot be measured well is lost, not
guessed: half-hidden discs shift by more than the 2 pixels that count as slip.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist

from sliplab.analysis.labels.blobs import (
    Blobs,
    Floats,
    Frame,
    checked_frame,
    find_blobs,
    match_layout,
)
from sliplab.analysis.labels.marker_kernels import (
    AREA,
    BRIGHT,
    DARK,
    LEAST_CONTRAST,
    LOST,
    QUALITY,
    SIGMA,
    WHOLE,
    follow,
)
from sliplab.protocols.later import Later

if TYPE_CHECKING:
    import cv2
else:
    cv2 = Later("cv2")

AREA_TOLERANCE = 0.06
"""A marker whose area differs by more than this share from what it was is lost."""
_COARSE_PX = 50.0
"""With markers so far apart the first search examines every other pixel."""
_EAGER_FRAMES = 20
_PATIENT_EVERY = 4
"""A marker lost for more than 20 frames is searched in every fourth."""


class FrameMarkers(NamedTuple):
    """The markers in one frame.

    Attributes:
        xy: (m, 2) float64 pixels, NaN where lost or cut by the picture's edge.
        ok: (m,) bool, False where it is NaN.
        sigma: (m,) float64, standard deviation of a coordinate, px; NaN where not ok.
        quality: (m,) float64, 0 (lost) to 1 (as whole, as white and as evenly lit as it can be).
    """

    xy: Floats
    ok: NDArray[np.bool_]
    sigma: Floats
    quality: Floats


@dataclass(frozen=True)
class MarkerTracks:
    """One track a marker: the columns of `FrameMarkers` over n frames."""

    xy: Floats
    """(n, m, 2)."""
    ok: NDArray[np.bool_]
    """(n, m)."""
    sigma: Floats
    """(n, m)."""
    quality: Floats
    """(n, m)."""


class MarkerTracker:
    """Follows the markers from frame to frame.

    Args:
        layout_px: (m, 2) nominal marker positions in pixels, relative to the centre marker.

    Raises:
        ValueError: the layout is not (m, 2), or two of its markers coincide.
    """

    def __init__(self, layout_px: Floats) -> None:
        layout = np.array(layout_px, np.float64)
        if layout.ndim != 2 or layout.shape[1] != 2 or len(layout) == 0:
            raise ValueError(f"layout_px has the shape {layout.shape}: must be (markers, 2)")
        self._spacing = float(pdist(layout).min()) if len(layout) > 1 else 100.0
        if not self._spacing > 8:
            raise ValueError(f"layout_px has markers {self._spacing:.1f} px apart: too near")
        self._layout = layout
        m = len(layout)
        self._everywhere = np.ones(m, np.bool_)
        self._everywhere.flags.writeable = False
        self._whole = 0
        self._all_followed = False
        self._xy = np.full((m, 2), np.nan)
        self._velocity = np.zeros((m, 2))
        self._area = np.zeros(m)
        self._state = np.full(m, LOST, np.int64)
        self._measured = np.zeros((m, 5))
        self._missed = np.zeros(m, np.int64)
        self._radius = self._margin = 0.0

    def update(self, frame: Frame) -> FrameMarkers:
        """The markers in the next frame.

        Raises:
            TypeError: the frame is not 2-D uint8.
        """
        frame = checked_frame(frame)
        if self._radius == 0.0:
            self._find(frame)
        else:
            self._follow(frame)
        if self._whole == len(self._xy):
            found = self._measured.copy()
            return FrameMarkers(
                self._xy.copy(), self._everywhere, found[:, SIGMA], found[:, QUALITY]
            )
        ok = self._state == WHOLE
        return FrameMarkers(
            np.where(ok[:, None], self._xy, np.nan),
            ok,
            np.where(ok, self._measured[:, SIGMA], np.nan),
            np.where(ok, self._measured[:, QUALITY], 0.0),
        )

    def _find(self, frame: Frame) -> None:
        """Search the whole frame; the layout names the blobs."""
        coarse = self._spacing >= _COARSE_PX and min(frame.shape) > 64
        blobs, shift, index = self._search(frame, 2 if coarse else 1)
        if coarse and (index < 0).any():
            blobs, shift, index = self._search(frame, 1)
        seen = index >= 0
        if seen.sum() * 2 < len(index):
            return
        centres = np.round(blobs.xy[index[seen]]).astype(np.int64)
        bright = float(np.median(frame[centres[:, 1], centres[:, 0]]))
        dark = float(np.median(frame[::8, ::8]))
        if bright - dark < LEAST_CONTRAST:
            return
        area = float(np.median(blobs.area[index[seen]]))
        self._radius = float(np.sqrt(area / np.pi))
        self._margin = max(3.0, 0.12 * self._radius)
        self._xy = np.where(seen[:, None], blobs.xy[index], self._layout + shift)
        self._area[:] = area
        self._measured[:, DARK], self._measured[:, BRIGHT] = dark, bright
        self._state[:] = np.where(seen, WHOLE, LOST)
        # measured as in every later frame, so that the first is not a step
        self._look(frame, seen, 0.5)
        whole = self._state == WHOLE
        usual = float(np.median(self._measured[whole, AREA])) if whole.any() else area
        self._area = np.where(whole, self._measured[:, AREA], usual)
        self._look(frame, seen, AREA_TOLERANCE)

    def _search(self, frame: Frame, shrink: int) -> tuple[Blobs, Floats, NDArray[np.int64]]:
        """Blobs of the frame, the layout's shift, and which blob each marker is.

        Places to half a pixel do: they are measured afterwards.
        """
        part = frame
        if shrink > 1:
            size = frame.shape[1] // shrink, frame.shape[0] // shrink
            cut = frame[: size[1] * shrink, : size[0] * shrink]
            part = np.asarray(cv2.resize(cut, size, interpolation=cv2.INTER_AREA), np.uint8)
        # the papillae's radius is 2.0 mm at a spacing of 5.6 mm: 0.36 of it
        apart = self._spacing / shrink
        limits = (np.pi * (0.15 * apart) ** 2, np.pi * (0.5 * apart) ** 2)
        small = find_blobs(part, *limits)
        places = small.xy * shrink + (shrink - 1) / 2
        blobs = Blobs(places, small.area * shrink**2, small.roundness)
        shift, index = match_layout(blobs.xy, self._layout, 0.35 * self._spacing)
        return blobs, shift, index

    def _follow(self, frame: Frame) -> None:
        before = self._xy.copy()
        known = None if self._all_followed else self._state != LOST
        self._xy += self._velocity
        self._all_followed = not self._look(frame, self._everywhere, AREA_TOLERANCE)
        if self._all_followed:
            if known is None:
                np.subtract(self._xy, before, out=self._velocity)
            else:
                self._velocity[:] = self._common(before, known)
                self._missed[:] = 0
            return
        known = self._everywhere if known is None else known
        if (self._state == WHOLE).sum() * 2 < len(known) and self._find_again(frame):
            return
        seen = self._state != LOST
        both = known & seen
        common = self._common(before, both)
        self._xy[~seen] = before[~seen] + common
        self._missed = np.where(seen, 0, self._missed + 1)
        late = self._missed > _EAGER_FRAMES
        for i in np.flatnonzero(~seen & ~(late & (self._missed % _PATIENT_EVERY > 0))):
            self._recover(frame, int(i))
        self._velocity = np.where(both[:, None], self._xy - before, common)

    def _common(self, before: Floats, of: NDArray[np.bool_]) -> Floats:
        """The step that most markers took."""
        if not of.any():
            return np.zeros(2)
        result: Floats = np.median((self._xy - before)[of], axis=0)
        return result

    def _look(self, frame: Frame, selected: NDArray[np.bool_], tolerance: float) -> int:
        lost, self._whole = follow(
            frame,
            self._xy,
            selected,
            self._radius,
            self._margin,
            self._area,
            tolerance,
            self._state,
            self._measured,
        )
        return int(lost)

    def _recover(self, frame: Frame, i: int) -> None:
        """Search a lost marker around its position as predicted by the others' motion."""
        reach = int(self._spacing)
        x, y = (round(float(v)) for v in self._xy[i])
        left, top = max(0, x - reach), max(0, y - reach)
        part = frame[top : max(0, y + reach + 1), left : max(0, x + reach + 1)]
        if part.shape[0] < 8 or part.shape[1] < 8:
            return
        area = self._area[i]
        blobs = find_blobs(part, 0.85 * area, 1.15 * area)
        places = blobs.xy + np.array([left, top])
        taken = self._xy[self._state != LOST]
        if len(taken):
            apart = np.hypot(*np.moveaxis(places[:, None] - taken[None], -1, 0))
            places = places[(apart > self._radius).all(axis=1)]
        distance = np.hypot(*(places - self._xy[i]).T)
        # less than half the distance to a neighbour's place: it cannot be the neighbour
        if len(distance) and distance.min() < 0.45 * self._spacing:
            expected = self._xy[i].copy()
            self._xy[i] = places[int(distance.argmin())]
            only = np.zeros(len(self._xy), np.bool_)
            only[i] = True
            if self._look(frame, only, AREA_TOLERANCE):
                self._xy[i] = expected

    def _find_again(self, frame: Frame) -> bool:
        """Most are lost (the camera was covered, the sensor jumped): search the whole frame."""
        area = float(np.median(self._area))
        blobs = find_blobs(frame, 0.85 * area, 1.15 * area)
        _, index = match_layout(blobs.xy, self._xy, 0.35 * self._spacing)
        seen = index >= 0
        if seen.sum() * 4 < 3 * len(seen):
            return False
        shift = np.median(blobs.xy[index[seen]] - self._xy[seen], axis=0)
        self._xy = np.where(seen[:, None], blobs.xy[index], self._xy + shift)
        self._state[:] = np.where(seen, WHOLE, LOST)
        self._look(frame, self._everywhere, AREA_TOLERANCE)
        self._velocity[:] = 0.0
        self._missed[:] = 0
        return True


def stack_tracks(rows: list[FrameMarkers], markers: int) -> MarkerTracks:
    """The results of `MarkerTracker.update` as one `MarkerTracks`."""
    if not rows:
        nothing = np.empty((0, markers))
        return MarkerTracks(
            np.empty((0, markers, 2)), np.empty((0, markers), np.bool_), nothing, nothing.copy()
        )
    return MarkerTracks(*(np.stack(column) for column in zip(*rows, strict=True)))
