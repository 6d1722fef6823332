"""One trial as a reviewer sees it: displacements, event rate, frames, flags; loaded when chosen."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.windows.dataset import recorded_span
from sliplab.flows.reviewing.review_list import Row
from sliplab.storage.schema.label import LABELS, TrialLabel
from sliplab.storage.streams import F64, I64, U8
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.review import Onsets
from sliplab.storage.trials.store import Store
from sliplab.storage.trials.video import FrameReader

RATE_NS = 10_000_000
"""Width of a bin of the event rate."""


@dataclass
class Shown:
    """A trial that is looked at. Times are seconds on the trial's time line unless they say ns.

    Attributes:
        label: its label, None where it has none; label_key: the label's own key.
        frame_ns: (n,) int64; displacement_px: (n, m), NaN where unknown; both empty without label.
        xy_px: (n, m, 2) places of the markers, NaN where lost; None where they were not kept.
        plate_px: (n, 2) the same of the plate's marker; None without.
        rate_s: (k,) middle of each bin of 10 ms; rate: (k,) events a second.
        span_s: start and end of the recording; motion_s: of the slide or retraction.
    """

    row: Row
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
    _reader: FrameReader | None = field(default=None, repr=False)

    @property
    def label_key(self) -> str:
        """The key of the label that is shown; empty without one."""
        return "" if self.label is None else self.label.key

    @property
    def centre(self) -> int:
        """Index of the centre marker."""
        return self.recording.record.geometry.centre

    @property
    def threshold_px(self) -> float:
        """Displacement that counts as slip."""
        return self.item.settings.labelling.threshold_px

    @cached_property
    def frame_s(self) -> F64:
        """(n,) float64, the frames' times."""
        return self.frame_ns / 1e9

    @property
    def onsets(self) -> Onsets:
        """The label's onsets."""
        if self.label is None:
            return Onsets()
        return Onsets(self.label.incipient_ns, self.label.gross_ns)

    @property
    def suggested(self) -> Onsets:
        """Onsets that the seen markers give, also where the label calls them doubtful."""
        known = self.onsets
        times = () if self.label is None else self.label.per_marker_ns
        slipped = [time for time in times if time >= 0]
        incipient = known.incipient_ns
        if incipient is None:
            incipient = min(slipped, default=None)
        gross = known.gross_ns
        if gross is None and self.centre < len(times) and times[self.centre] >= 0:
            gross = times[self.centre]
        return Onsets(incipient, gross)

    def frame_at(self, time_s: float) -> int:
        """The frame nearest to a time; -1 where there is none."""
        if not len(self.frame_ns):
            return -1
        return int(np.argmin(np.abs(self.frame_ns - round(time_s * 1e9))))

    def picture(self, index: int) -> U8 | None:
        """A frame of the video, uint8 (height, width); None where none was kept."""
        if not self.recording.has_video:
            return None
        if self._reader is None:
            self._reader = self.recording.frame_reader()
        return self._reader.frame(index)

    def places(self, index: int) -> F64:
        """(m, 2) places of the markers in a frame, px, NaN where lost; m is 0 if none were kept."""
        return np.empty((0, 2)) if self.xy_px is None else self.xy_px[index]

    def close(self) -> None:
        """Close the video."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None


def load(store: Store, item: Collected, row: Row) -> Shown:
    """Read what is shown of a trial; frames are read when they are looked at.

    Raises:
        StoreError: the trial is damaged.
    """
    recording = item.campaign.recording(row.trial)
    derived = Derived.of(store, LABELS, item.name)
    label: TrialLabel | None = None
    arrays: dict[str, Any] = {}
    if row.label != "missing":
        label, arrays = derived.load(row.trial, TrialLabel), derived.arrays(row.trial)
    frame_ns = np.asarray(arrays.get("frame_ns", recording.frame_times()), np.int64)
    moved = np.asarray(arrays.get("displacement_px", np.empty((len(frame_ns), 0))), np.float64)
    places, plate = arrays.get("xy_px"), arrays.get("plate_px")
    if places is None and recording.has_tracks:
        tracks = recording.tracks()
        places, plate = tracks.markers_px, tracks.plate_px
    start, end = recorded_span(recording)
    motion = recording.step(recording.motion_phase)
    rate_s, rate = event_rate(recording, start, end)
    return Shown(
        row, item, recording, label, frame_ns, moved,
        None if places is None else np.asarray(places, np.float64),
        None if plate is None else np.asarray(plate, np.float64),
        rate_s, rate, (start / 1e9, end / 1e9), (motion[0] / 1e9, motion[1] / 1e9),
    )  # fmt: skip


def event_rate(recording: Recording, start_ns: int, end_ns: int) -> tuple[F64, F64]:
    """Events a second in bins of 10 ms from the recording's start, whole bins only.

    Returns:
        (k,) float64 middle of each bin, s; (k,) float64 events a second.
    """
    bins = max(0, (end_ns - start_ns) // RATE_NS)
    edges = start_ns + np.arange(bins + 1, dtype=np.int64) * RATE_NS
    device_us = -(-np.asarray(recording.clock("events").to_device(edges)) // 1000)
    with recording.open() as reader:
        times = reader.event_times()
    counted = np.diff(np.searchsorted(times, device_us, "left"))
    return (edges[:-1] + RATE_NS // 2) / 1e9, counted * (1e9 / RATE_NS)
