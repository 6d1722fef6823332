"""Ground truth of one recorded trial: its markers' places, its onsets by the protocol's rule.

The places come from the trial's video, tracked once, or from a camera that handed over tracks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from analysis.onsets import Doubts, Onsets, displacements, doubts, paper_onsets
from analysis.plate import track_video
from protocols.settings import Labelling
from storage.recording import Recording

F64 = npt.NDArray[np.float64]
VERSION = 2

Results = tuple[dict[str, Any], dict[str, Any]]
"""A result's JSON and its arrays."""


@dataclass(frozen=True)
class Label:
    """Onsets of one trial and what they were read from.

    Attributes:
        onsets: on the trial's time line.
        frame_ns: (n,) int64, middle of exposure of every frame on the time line.
        displacement_px: (n, m) float64, NaN where a marker was lost.
        source: ``video`` or ``tracks``.
        doubts: why an onset is not known although the seen markers give one.
    """

    onsets: Onsets
    frame_ns: npt.NDArray[np.int64]
    displacement_px: npt.NDArray[np.float64]
    markers_lost: int
    plate_lost: int
    source: str
    doubts: Doubts

    def as_json(self) -> dict[str, Any]:
        """What is kept as JSON: an onset in doubt is none, and its reason stands beside it."""
        doubt = self.doubts.incipient
        return {
            "incipient_ns": None if doubt else self.onsets.incipient_ns,
            # without the first slip nothing is made of the second
            "gross_ns": None if doubt or self.doubts.gross else self.onsets.gross_ns,
            "doubts": {"incipient": doubt, "gross": self.doubts.gross or doubt},
            "first_marker": self.onsets.first_marker,
            "per_marker_ns": self.onsets.per_marker_ns.tolist(),
            "markers_lost": self.markers_lost,
            "plate_lost": self.plate_lost,
            "source": self.source,
        }

    def as_arrays(self) -> dict[str, Any]:
        """What is kept as arrays; displacements to a thousandth of a pixel."""
        return {
            "frame_ns": self.frame_ns,
            "displacement_px": np.round(self.displacement_px, 3).astype(np.float32),
        }


def label_results(recording: Recording, settings: Labelling) -> Results:
    """A trial's label as it is kept: JSON and arrays."""
    label = label_recording(recording, settings)
    return label.as_json(), label.as_arrays()


def label_recording(recording: Recording, settings: Labelling) -> Label:
    """Find a trial's onsets in its video, or in its tracks where there is no video.

    Displacements count from the markers' mean positions over the last part of the hold; in
    trials with a sliding plate they are taken relative to the plate's own marker.

    Raises:
        ValueError: the trial has neither video nor tracks, or its markers cannot be told apart.
    """
    with_plate = recording.record["experiment"] != "kinematic"
    if recording.has_video:
        markers_px, plate_px, plate_lost = _from_video(recording, with_plate)
    elif recording.has_tracks:
        markers_px, plate_px, plate_lost = _from_tracks(recording, with_plate)
    else:
        raise ValueError(f"{recording.trial_id}: has neither video nor tracks to label from")
    frame_ns = recording.frame_times()
    start_ns = recording.step(recording.motion_phase)[0]
    reference = (frame_ns < start_ns) & (frame_ns >= start_ns - int(settings.reference_ms * 1e6))
    moved = displacements(markers_px, reference, plate_px)
    centre = int(recording.record["geometry"]["centre"])
    onsets = paper_onsets(frame_ns, moved, centre, settings, start_ns)
    lost = int(np.count_nonzero(np.isnan(markers_px).any(axis=2)))
    doubt = doubts(frame_ns, moved, centre, settings, start_ns)
    return Label(onsets, frame_ns, moved, lost, plate_lost, recording.frame_source, doubt)


def _from_video(recording: Recording, with_plate: bool) -> tuple[F64, F64 | None, int]:
    """Places (n, m, 2) and of the plate (n, 2), px, and in how many frames it was not seen."""
    geometry = recording.record["geometry"]
    layout = np.asarray(geometry["skin_mm"], np.float64) * geometry["px_per_mm"]
    layout[:, 1] *= -1  # rows count downwards
    video = track_video(recording.frames(), layout, with_plate)
    if video.plate is None:
        return video.markers.xy, None, 0
    return video.markers.xy, video.plate.xy, int(np.count_nonzero(~video.plate.ok))


def _from_tracks(recording: Recording, with_plate: bool) -> tuple[F64, F64 | None, int]:
    """The same, as the camera gave them."""
    tracks = recording.tracks()
    if not with_plate:
        return tracks.markers_px, None, 0
    if tracks.plate_px is None:
        raise ValueError(f"{recording.trial_id}: its tracks lack the plate's marker")
    lost = int(np.count_nonzero(np.isnan(tracks.plate_px).any(axis=1)))
    return tracks.markers_px, tracks.plate_px, lost
