"""Track the plate's ArUco marker in the outside video, and read a video in a single pass.

In the gravity and disturbance trials the plate moves, and a papilla slips only when it moves on the
plate; so the plate's own marker is the frame of reference. Finding it in a whole frame takes longer
than following all papillae, so it is looked for where it last was, and in the whole frame only when
it is not there. Decoding the video is dearer than either: `track_video` does it once for both.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sliplab.analysis.labels.blobs import Floats, Frame, checked_frame
from sliplab.analysis.labels.markers import FrameMarkers, MarkerTracker, MarkerTracks, stack_tracks
from sliplab.analysis.labels.plate_kernels import cells, refine_square
from sliplab.protocols.later import Later

if TYPE_CHECKING:
    import cv2
else:
    cv2 = Later("cv2")

MAX_BRIDGED = 5
"""Longer gaps stay unknown: over six intervals at 100 frames/s a plate in free fall departs 4 mm
from the straight line, and that grows with the square of the gap."""

_BENT_PX = 1.5
"""Corners that move more than this apart from each other are not those of a stiff square."""
_LIKE = 0.7
"""Least correlation of a marker's cells with those of the last frame."""
_DETECTED_SIGMA_PX = 0.1
"""Standard deviation of a centre from the detector's corners alone (a fast plate is blurred)."""


@dataclass(frozen=True)
class PlateTrack:
    """The plate's marker through a video.

    Attributes:
        xy: (n, 2) float64, its centre (the mean of the corners), pixels; the centre of the top left
            pixel is (0, 0). Bridged linearly over short gaps, NaN in long ones and at the ends.
        corners: (n, 4, 2) float64, clockwise in the picture from the marker's own top left.
        ok: (n,) bool, True where it was seen, so False where it was bridged.
    """

    xy: Floats
    corners: Floats
    ok: NDArray[np.bool_]
    sigma: Floats
    """(n,) standard deviation of a coordinate of the centre, px; NaN where that is."""


@dataclass(frozen=True)
class VideoTracks:
    """All that the labelling needs of one video."""

    markers: MarkerTracks
    plate: PlateTrack | None


class PlatePose(NamedTuple):
    """The plate's marker in one frame.

    Attributes:
        seen: whether it was.
        corners: (4, 2) float64 pixels, clockwise from the marker's own top left; NaN when unseen.
        sigma: standard deviation of a coordinate of their mean, px; NaN when unseen.
    """

    seen: bool
    corners: Floats
    sigma: float

    @property
    def centre(self) -> Floats:
        """(2,) pixels, the corners' mean."""
        result: Floats = self.corners.mean(axis=0)
        return result


UNSEEN = PlatePose(False, np.full((4, 2), np.nan), np.nan)


class PlateTracker:
    """Follows one ArUco marker (dictionary 4x4_50) from frame to frame.

    Its four sides are followed where they must be, and its cells looked at, so that nothing else is
    taken for it. Only where that fails does a detector look around there, and then everywhere. The
    plate's is the largest one in the first frame that has one.
    """

    def __init__(self) -> None:
        self.marker_id: int | None = None
        self.detections = 0
        """Number of calls of the ArUco detector."""
        settings = cv2.aruco.DetectorParameters()
        settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        # a window of up to 0.4 of a cell: larger ones see the next edge, smaller ones more noise
        settings.cornerRefinementWinSize = 7
        settings.relativeCornerRefinmentWinSize = 0.4
        settings.cornerRefinementMinAccuracy = 0.01
        # on a dark ground the white quiet zone is a square, too, one module outside the marker;
        # at OpenCV's default of 0.125 it is taken for the marker's own outline and nothing is found
        settings.minMarkerDistanceRate = 0.05
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        self._detector = cv2.aruco.ArucoDetector(dictionary, settings)
        self._last: Floats | None = None
        self._velocity, self._gain = np.zeros(2), np.zeros(2)
        self._cells: Floats | None = None
        self._here = False

    def update(self, frame: Frame) -> PlatePose:
        """The marker in the next frame.

        Raises:
            TypeError: the frame is not 2-D uint8.
        """
        frame = checked_frame(frame)
        pose = self._follow(frame)
        if pose is None:
            pose = self._detect(frame)
        if not pose.seen:
            self._velocity, self._gain = np.zeros(2), np.zeros(2)
        elif self._last is not None:
            step = pose.centre - self._last.mean(axis=0)
            # a plate in free fall gains as much in every frame
            self._gain = step - self._velocity if self._here else np.zeros(2)
            self._velocity = step
        if pose.seen:
            self._last = pose.corners
        self._here = pose.seen
        return pose

    def _follow(self, frame: Frame) -> PlatePose | None:
        """Its sides where they must be; None where they are not, or it is not sure to be it."""
        if self._last is None or self._cells is None or not self._here:
            return None
        predicted = self._last + self._velocity + self._gain
        corners, sigma = refine_square(frame, predicted, 3)
        if not np.isfinite(sigma):
            return None
        moved = corners - self._last
        if np.abs(moved - moved.mean(axis=0)).max() > _BENT_PX:
            return None
        seen = cells(frame, corners)
        if not np.isfinite(seen).all() or _alike(seen, self._cells) < _LIKE:
            return None
        return PlatePose(True, corners, float(sigma))

    def _detect(self, frame: Frame) -> PlatePose:
        self.detections += 1
        found = None if self._last is None else self._look_near(frame, self._last)
        found = self._look(frame) if found is None else found
        if found is None:
            return UNSEEN
        corners, sigma = refine_square(frame, found, 3)
        if np.isfinite(sigma) and np.abs(corners - found).max() < _BENT_PX:
            self._cells = cells(frame, corners)
            return PlatePose(True, corners, float(sigma))
        return PlatePose(True, found, _DETECTED_SIGMA_PX)

    def _look_near(self, frame: Frame, last: Floats) -> Floats | None:
        box = last + self._velocity + self._gain
        low, high = box.min(axis=0), box.max(axis=0)
        # quiet zone, and what a falling plate may gain on its last velocity
        reach = max(16.0, 0.4 * float((high - low).max()))
        left, top = np.maximum(np.floor(low - reach), 0).astype(int)
        right, bottom = np.maximum(np.ceil(high + reach) + 1, 0).astype(int)
        part = frame[top:bottom, left:right]
        if min(part.shape) < 16:
            return None
        found = self._look(np.ascontiguousarray(part))
        return None if found is None else found + np.array([left, top])

    def _look(self, frame: Frame) -> Floats | None:
        corners, ids, _ = self._detector.detectMarkers(frame)
        if ids is None:
            return None
        quads = np.array(corners, np.float64).reshape(-1, 4, 2)
        names = np.asarray(ids).ravel()
        if self.marker_id is None:
            areas = [cv2.contourArea(quad.astype(np.float32)) for quad in quads]
            self.marker_id = int(names[int(np.argmax(areas))])
        mine = np.flatnonzero(names == self.marker_id)
        return quads[mine[0]] if len(mine) else None


def track_video(
    frames: Iterable[Frame],
    layout_px: Floats,
    with_plate: bool,
) -> VideoTracks:
    """Track papillae and, on request, the plate in one pass over the frames.

    Args:
        frames: (h, w) uint8 frames in order; each is checked once, and none is retained.
        layout_px: (m, 2) nominal marker positions in pixels, relative to the centre marker.
        with_plate: follow the plate's ArUco marker too.
    """
    markers = MarkerTracker(layout_px)
    plate = PlateTracker() if with_plate else None
    rows: list[FrameMarkers] = []
    poses: list[PlatePose] = []
    for frame in frames:
        rows.append(markers.update(frame))
        if plate is not None:
            poses.append(plate.update(frame))
    return VideoTracks(stack_tracks(rows, len(layout_px)), None if plate is None else bridge(poses))


def bridge(poses: list[PlatePose], max_bridged: int = MAX_BRIDGED) -> PlateTrack:
    """The results of `PlateTracker.update` as one track, short gaps filled by straight lines.

    A bridged place's standard deviation grows by what a plate that begins to fall in the gap
    departs from the line.

    Args:
        poses: one result a frame; the frames equally spaced.
        max_bridged: gaps of more frames than this stay NaN.
    """
    if not poses:
        nothing = np.empty(0)
        return PlateTrack(np.empty((0, 2)), np.empty((0, 4, 2)), np.empty(0, np.bool_), nothing)
    ok = np.array([pose.seen for pose in poses], np.bool_)
    # the centre is the corners' mean, bridged or not
    columns = np.stack([pose.corners for pose in poses]).reshape(len(poses), 8)
    sigma = np.array([pose.sigma for pose in poses])
    seen = np.flatnonzero(ok)
    for before, after in pairwise(seen.tolist()):
        if 1 < after - before <= max_bridged + 1:
            gap = np.arange(before + 1, after)
            share = ((gap - before) / (after - before))[:, None]
            columns[gap] = columns[before] * (1 - share) + columns[after] * share
            bow = _bow(columns, before, after)
            sigma[gap] = max(sigma[before], sigma[after]) + bow
    corners = columns.reshape(-1, 4, 2)
    return PlateTrack(corners.mean(axis=1), corners, ok, sigma)


def _bow(columns: Floats, before: int, after: int) -> float:
    """Return a path's largest deviation from its chord in a gap, px, by the change of velocity."""
    if before < 1 or after + 1 >= len(columns):
        return _DETECTED_SIGMA_PX
    change = (columns[after + 1] - columns[after]) - (columns[before] - columns[before - 1])
    if not np.isfinite(change).all():
        return _DETECTED_SIGMA_PX
    return float(np.abs(change.reshape(4, 2).mean(axis=0)).max()) * (after - before) / 8


def _alike(one: Floats, other: Floats) -> float:
    """Correlation of two sets of grey levels."""
    a, b = one - one.mean(), other - other.mean()
    return float(a @ b / (np.sqrt((a @ a) * (b @ b)) + 1e-9))
