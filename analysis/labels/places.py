"""Positions of markers and plate in a trial's frames, from its video or the camera's tracks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sliplab.analysis.labels.markers import MarkerTracks
from sliplab.analysis.labels.plane import Perspective, plane_of
from sliplab.analysis.labels.plate_tracking import PlateTrack, track_video
from sliplab.storage.trials.recording import Recording

F64 = npt.NDArray[np.float64]

SURE_PX = 0.25
"""A place with a larger standard deviation is not a measurement: it could be a part of a slip."""
TRACKS_PX, TRACKS_PLATE_PX = 0.006, 0.04
"""Standard deviations assumed for tracks that a camera provides without them."""


@dataclass(frozen=True)
class Places:
    """Markers and plate over n frames.

    Attributes:
        xy: (n, m, 2) px in the picture, NaN where a marker was not seen whole.
        sigma: (n, m) standard deviation of a coordinate, px. quality: (n, m), 0 to 1.
        plate: None in trials without a sliding plate.
        plane: the plate's, where the camera looks askew.
    """

    xy: F64
    sigma: F64
    quality: F64
    plate: PlateTrack | None = None
    plane: Perspective | None = None

    @property
    def flat_xy(self) -> F64:
        """`xy` in the plate's plane, px at the picture's centre."""
        return self.xy if self.plane is None else self.plane.flat(self.xy)

    @property
    def flat_plate(self) -> F64 | None:
        """(n, 2) the plate's own marker, likewise."""
        if self.plate is None or self.plane is None:
            return None if self.plate is None else self.plate.xy
        result: F64 = self.plane.flat(self.plate.corners).mean(axis=1)
        return result

    @property
    def plate_lost(self) -> int:
        """Number of frames in which the plate's marker was not seen."""
        return 0 if self.plate is None else int(np.count_nonzero(~self.plate.ok))

    @property
    def tilted(self) -> bool:
        """True where the camera looks at the plate at an angle."""
        return self.plane is not None


def places_of(recording: Recording) -> Places:
    """All places of a trial.

    Raises:
        ValueError: it has neither video nor tracks, or tracks without the plate that it has.
    """
    with_plate = recording.record.experiment != "kinematic"
    if recording.has_video:
        video = track_video(recording.frames(), recording.layout_px, with_plate)
        return from_tracks(video.markers, video.plate, recording.frame_px)
    if recording.has_tracks:
        tracks = recording.tracks()
        if with_plate and tracks.plate_px is None:
            raise ValueError(f"{recording.trial_id}: its tracks lack the plate's marker")
        return handed_over(tracks.markers_px, tracks.plate_px if with_plate else None)
    raise ValueError(f"{recording.trial_id}: has neither video nor tracks to label from")


def from_tracks(
    markers: MarkerTracks, plate: PlateTrack | None, size_px: tuple[int, ...]
) -> Places:
    """Return the positions that tracking a video of `size_px` gave."""
    plane = None
    if plate is not None:
        plane = plane_of(plate.corners, plate.ok, (size_px[0], size_px[1]))
    return Places(markers.xy, markers.sigma, markers.quality, plate, plane)


def handed_over(markers_px: F64, plate_px: F64 | None) -> Places:
    """Places as a camera hands them over.

    Args:
        markers_px: (n, m, 2), NaN where a marker was not seen. plate_px: (n, 2), likewise, or None.
    """
    seen = np.asarray(np.isfinite(markers_px).all(axis=2))
    sigma, quality = np.where(seen, TRACKS_PX, np.nan), seen.astype(np.float64)
    if plate_px is None:
        return Places(markers_px, sigma, quality)
    ok = np.asarray(np.isfinite(plate_px).all(axis=1))
    plate = PlateTrack(
        plate_px, np.full((len(ok), 4, 2), np.nan), ok, np.where(ok, TRACKS_PLATE_PX, np.nan)
    )
    return Places(markers_px, sigma, quality, plate)
