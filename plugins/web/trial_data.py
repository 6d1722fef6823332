"""One trial's data as pages show them: curves over its time line, label, frames with markers."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sliplab.analysis.campaigns import Collected, has_plan
from sliplab.analysis.event_rate import event_rate
from sliplab.analysis.windows.dataset import recorded_span
from sliplab.plugins.web.review.doubt import suggested_onsets
from sliplab.storage.errors import StoreError
from sliplab.storage.schema.label import LABELS, TrialLabel
from sliplab.storage.streams import F64, I64, U8
from sliplab.storage.trials.derived import Arrays, Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.review import ReviewedOnsets
from sliplab.storage.trials.store import TrialStore

SPEED_S = 0.2
"""Interval over which the tool's speed is measured."""


@dataclass
class ShownTrial:
    """The data of a trial that a page shows. Times: seconds on the time line unless in ns.

    Attributes:
        label: its label, None where it has none.
        frame_ns: (n,) int64; displacement_px: (n, m), NaN where unknown; both empty without label.
        xy_px: (n, m, 2) places of the markers, NaN where lost; None where they were not stored.
        plate_px: (n, 2) the same of the plate's marker; None without.
        rate_s: (k,) middle of each bin of 10 ms; rate: (k,) events a second.
        span_s: start and end of the recording; motion_s: of the slide or retraction.
    """

    item: Collected
    recording: Recording
    label: TrialLabel | None
    frame_ns: I64
    displacement_px: F64
    xy_px: F64 | None
    plate_px: F64 | None
    rate_s: F64
    rate: F64
    span_s: tuple[float, float]
    motion_s: tuple[float, float]

    @property
    def centre(self) -> int:
        """Index of the centre marker."""
        return self.recording.record.geometry.centre

    @property
    def threshold_px(self) -> float | None:
        """Displacement that counts as slip; None of a campaign without settings."""
        return self.item.settings.labelling.threshold_px if has_plan(self.item.info) else None

    @cached_property
    def frame_s(self) -> F64:
        """(n,) float64, the frames' times."""
        return self.frame_ns / 1e9

    @property
    def onsets(self) -> ReviewedOnsets:
        """The label's onsets."""
        if self.label is None:
            return ReviewedOnsets()
        return ReviewedOnsets(self.label.incipient_ns, self.label.gross_ns)

    @property
    def suggested(self) -> ReviewedOnsets:
        """Onsets by the markers that were seen, also where the label is in doubt."""
        return ReviewedOnsets() if self.label is None else suggested_onsets(self.label, self.centre)

    def frame_at(self, time_s: float) -> int:
        """Return the index of the frame nearest to a time; -1 without frames."""
        if not len(self.frame_ns):
            return -1
        return int(np.argmin(np.abs(self.frame_s - time_s)))

    def picture(self, index: int) -> U8 | None:
        """Return a frame of the video, uint8 (height, width); None if none was stored."""
        if not self.recording.has_video:
            return None
        with self.recording.frame_reader() as reader:
            return reader.frame(index)

    def places(self, index: int) -> F64:
        """Return the positions of the markers in a frame, (m, 2) px, NaN where lost; m may be 0."""
        return np.empty((0, 2)) if self.xy_px is None else self.xy_px[index]


def load_trial(store: TrialStore, item: Collected, trial: str) -> ShownTrial:
    """Read the displayed data of a trial; frames are read later, one at a time.

    Raises:
        StoreError: the trial is damaged.
    """
    recording = item.campaign.recording(trial)
    derived = Derived.of(store, LABELS, item.name)
    label: TrialLabel | None = None
    arrays: Arrays = {}
    with suppress(OSError, StoreError):  # there is none, or it has to be made again
        label, arrays = derived.load(trial, TrialLabel), derived.arrays(trial)
    frame_ns = np.empty(0, np.int64)
    if "frame_ns" in arrays:
        frame_ns = np.asarray(arrays["frame_ns"], np.int64)
    elif recording.frame_source != "none":
        frame_ns = recording.frame_times()
    moved = np.asarray(arrays.get("displacement_px", np.empty((len(frame_ns), 0))), np.float64)
    places, plate = arrays.get("xy_px"), arrays.get("plate_px")
    if places is None and recording.has_tracks:
        tracks = recording.tracks()
        places, plate = tracks.markers_px, tracks.plate_px
    start, end = recorded_span(recording)
    motion = start, end
    with suppress(KeyError, StoreError):  # a motion that is not known
        motion = recording.motion_ns
    rate_s, rate = np.empty(0), np.empty(0)
    if recording.record.counts.events:
        rate_s, rate = event_rate(recording, start, end)
    return ShownTrial(
        item,
        recording,
        label,
        frame_ns,
        moved,
        None if places is None else np.asarray(places, np.float64),
        None if plate is None else np.asarray(plate, np.float64),
        rate_s,
        rate,
        (start / 1e9, end / 1e9),
        (motion[0] / 1e9, motion[1] / 1e9),
    )


def tool_speed(recording: Recording) -> tuple[F64, F64]:
    """Return the speed of the tool's centre over intervals of at least `SPEED_S`.

    Returns:
        (k,) float64 middle of each interval, s; (k,) float64 mm/s; both empty without poses.
    """
    with recording.open() as reader:
        poses = reader.poses()
    if len(poses) < 2 or "arm" not in recording.clocks.devices():
        return np.empty(0), np.empty(0)
    time_s = np.asarray(recording.clock("arm").to_reference(poses.t_ns)) / 1e9
    first = np.arange(len(time_s))
    last = np.searchsorted(time_s, time_s + SPEED_S, "left")
    first, last = first[last < len(time_s)], last[last < len(time_s)]
    gone_mm = np.linalg.norm(poses.xyz_mm[last] - poses.xyz_mm[first], axis=1)
    return (time_s[first] + time_s[last]) / 2, gone_mm / (time_s[last] - time_s[first])
