"""Ground truth of one recorded trial: its video tracked once, its onsets by the protocol's rule."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from analysis.onsets import Onsets, displacements, paper_onsets
from analysis.plate import track_video
from protocols.settings import Labelling
from storage.recording import Recording

VERSION = 1


@dataclass(frozen=True)
class Label:
    """Onsets of one trial and what they were read from.

    Attributes:
        onsets: on the trial's time line.
        frame_ns: (n,) int64, middle of exposure of every frame on the time line.
        displacement_px: (n, m) float64, NaN where a marker was lost.
    """

    onsets: Onsets
    frame_ns: npt.NDArray[np.int64]
    displacement_px: npt.NDArray[np.float64]
    markers_lost: int
    plate_lost: int

    def as_json(self) -> dict[str, Any]:
        """What is kept as JSON."""
        return {
            "incipient_ns": self.onsets.incipient_ns,
            "gross_ns": self.onsets.gross_ns,
            "first_marker": self.onsets.first_marker,
            "per_marker_ns": self.onsets.per_marker_ns.tolist(),
            "markers_lost": self.markers_lost,
            "plate_lost": self.plate_lost,
        }

    def as_arrays(self) -> dict[str, Any]:
        """What is kept as arrays; displacements to a thousandth of a pixel."""
        return {
            "frame_ns": self.frame_ns,
            "displacement_px": np.round(self.displacement_px, 3).astype(np.float32),
        }


def label_recording(recording: Recording, settings: Labelling) -> Label:
    """Track a trial's video and find its onsets.

    Displacements count from the markers' mean positions over the last part of the hold; in
    trials with a sliding plate they are taken relative to the plate's own marker.

    Raises:
        ValueError: the trial has no video, or its markers cannot be told apart.
    """
    if not recording.has_video:
        raise ValueError(f"{recording.trial_id}: has no video to label from")
    geometry = recording.record["geometry"]
    layout = np.asarray(geometry["skin_mm"], np.float64) * geometry["px_per_mm"]
    layout[:, 1] *= -1  # rows count downwards
    with_plate = recording.record["experiment"] != "kinematic"
    video = track_video(recording.frames(), layout, with_plate)
    frame_ns = recording.frame_times()
    start_ns = recording.step(recording.motion_phase)[0]
    reference = (frame_ns < start_ns) & (frame_ns >= start_ns - int(settings.reference_ms * 1e6))
    moved = displacements(
        video.markers.xy, reference, video.plate.xy if video.plate is not None else None
    )
    onsets = paper_onsets(frame_ns, moved, int(geometry["centre"]), settings, start_ns)
    return Label(
        onsets,
        frame_ns,
        moved,
        int(np.count_nonzero(~video.markers.ok)),
        int(np.count_nonzero(~video.plate.ok)) if video.plate is not None else 0,
    )
