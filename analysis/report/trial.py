"""One trial in the report: its markers, its events, the network's outputs, and its detections."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.detectors.smoothing_rule import detect
from sliplab.analysis.report.campaign import tracks_words
from sliplab.analysis.report.figures import trials as figures
from sliplab.analysis.report.figures.style import CLASS_WORDS
from sliplab.analysis.report.latency import choice_note
from sliplab.analysis.report.page import Content, Figure
from sliplab.analysis.windows import dataset
from sliplab.analysis.windows.windows import first_pixel
from sliplab.protocols.detection import Detection
from sliplab.storage.schema.evaluation import TrialScore
from sliplab.storage.schema.label import LABELS
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore

F64 = npt.NDArray[np.float64]

_PHASES = (
    "at rest",
    "from the start of the motion to the first slip",
    "in incipient slip",
    "in gross slip",
)


@dataclass(frozen=True)
class Example:
    """The trial that is shown.

    Attributes:
        row: of the evaluation.
    """

    item: Collected
    recording: Recording
    row: TrialScore

    @property
    def condition(self) -> str:
        """The trial's condition as text."""
        return ", ".join(f"{name} {text}" for name, text in self.row.condition.items())

    def onsets_s(self) -> list[float | None]:
        """Return both onsets of the label, seconds since the recording began."""
        return [self.seconds(self.row.incipient_ns), self.seconds(self.row.gross_ns)]

    def seconds(self, time_ns: int | None) -> float | None:
        """Return a time in seconds since the recording began."""
        start, _ = dataset.recorded_span(self.recording)
        return None if time_ns is None else (time_ns - start) / 1e9


def choose_example(campaigns: Sequence[Collected], rows: Sequence[TrialScore]) -> Example | None:
    """Return the kinematic test trial with the median incipient latency: neither best nor worst.

    Args:
        rows: of the evaluation.
    """
    judged = []
    for row in rows:
        if row.experiment == "kinematic" and row.latency is not None:
            value = row.latency.latency_incipient_ms
            judged.append((float("inf") if value is None else float(value), row))
    if not judged:
        return None
    _, row = sorted(judged, key=lambda each: each[0])[len(judged) // 2]
    item = next(item for item in campaigns if item.name == row.campaign)
    return Example(item, item.campaign.recording(row.trial), row)


@dataclass(frozen=True)
class TrialSection(Content):
    """Displacements, event rate and events of the trial.

    Attributes:
        rates: positive events a second by phase.
        tracks: the tracks in a video's place, as text; nothing where there is a video.
        fault: that of the file from which it was salvaged; nothing for a whole trial.
    """

    template: ClassVar[str] = "trial.html"
    folded: ClassVar[bool] = True
    condition: str
    rates: Mapping[str, float]
    tracks: str
    markers: bool
    """Their displacements are drawn."""
    figure: Figure
    fault: str = ""


def trial_section(store: TrialStore, example: Example, *, simulated: bool) -> TrialSection:
    """Draw the trial."""
    item, recording = example.item, example.recording
    frame_ns, displacement_px = np.empty(0, np.int64), np.empty((0, 0))
    if "displacement_px" in (
        stored := Derived.of(store, LABELS, item.name).arrays(recording.trial_id)
    ):
        frame_ns, displacement_px = stored["frame_ns"], stored["displacement_px"]
    start, end = dataset.recorded_span(recording)
    event_s, cell = _events(item, recording, start)
    onsets = example.onsets_s()
    motion_s = (recording.motion_ns[0] - start) / 1e9 if recording.record.steps else None
    frame_s = (frame_ns - start) / 1e9
    svg = figures.trial_overview(
        frame_s,
        displacement_px,
        event_s,
        cell - 0.5,
        onsets,
        motion_s,
        item.settings.labelling.threshold_px,
        item.settings.windows.cells,
        simulated=simulated,
    )
    return TrialSection(
        example.condition,
        _rates(event_s, [0.0, motion_s, *onsets, (end - start) / 1e9]),
        tracks_words(simulated) if recording.frame_source == "tracks" else "",
        len(frame_ns) > 0,
        Figure(svg, name="trial", data=_data(frame_s, displacement_px, event_s, cell)),
        "" if recording.record.lost is None else recording.record.lost.reason,
    )


def _events(item: Collected, recording: Recording, start: int) -> tuple[F64, F64]:
    """Return positive events inside the crop: seconds since the recording began, and cell rows."""
    events = recording.events()
    windows = item.settings.windows
    _, height = recording.event_px
    centre = dataset.crop_centre_px(recording)
    top = first_pixel(height, windows.crop_px, None if centre is None else centre[1])
    cell = (events.y.astype(np.int64) - top) / windows.pool_px
    keep = (events.p > 0) & (cell >= 0) & (cell < windows.cells)
    to_line = recording.clock("events")
    times = np.asarray(to_line.to_reference(events.t_us[keep] * 1000))
    return (times - start) / 1e9, cell[keep]


def _rates(event_s: F64, edges: Sequence[float | None]) -> dict[str, float]:
    """Return events a second in each phase whose both ends are known."""
    found = {}
    for phase, (begin, over) in zip(_PHASES, itertools.pairwise(edges), strict=True):
        if begin is not None and over is not None and over > begin:
            inside = int(((event_s >= begin) & (event_s < over)).sum())
            found[phase] = inside / (over - begin)
    return found


def _data(frame_s: F64, displacement_px: F64, event_s: F64, cell: F64) -> dict[str, list[float]]:
    """Return displacements frame by frame, and events by bins of 30 ms and cell rows."""
    data = {"frame time (s)": frame_s.tolist()}
    for k in range(displacement_px.shape[1]):
        name = "centre marker" if k == 0 else f"marker {k}"
        data[f"{name}, displacement (px)"] = displacement_px[:, k].tolist()
    count = int(np.ceil(max(float(event_s.max(initial=0.0)), figures.BIN_S) / figures.BIN_S))
    edges = np.arange(count + 1) * figures.BIN_S
    data["bin of 30 ms, begin (s)"] = edges[:-1].tolist()
    data["positive events (1/s)"] = (np.histogram(event_s, edges)[0] / figures.BIN_S).tolist()
    rows = int(cell.max(initial=0.0)) + 1
    table = np.histogram2d(event_s, cell, [edges, np.arange(rows + 1)])[0]
    for k in range(rows):
        data[f"events in cell row {k} (in 30 ms)"] = table[:, k].tolist()
    return data


@dataclass(frozen=True)
class OutputSection(Content):
    """The same trial's raw and smoothed outputs.

    Attributes:
        choice: how the settings were chosen, as text.
    """

    template: ClassVar[str] = "outputs.html"
    folded: ClassVar[bool] = True
    condition: str
    settings: Detection
    choice: str
    figure: Figure


def output_section(
    example: Example,
    counts: Mapping[str, npt.NDArray[Any]],
    settings: Detection,
    *,
    simulated: bool,
) -> OutputSection:
    """Draw the outputs.

    Args:
        counts: ``counts`` int64 (n, 3) and ``end_ns`` int64 (n,) of the trial's windows.
    """
    spikes = counts["counts"]
    found = detect(spikes, counts["end_ns"], settings)
    start, _ = dataset.recorded_span(example.recording)
    end_s = (counts["end_ns"] - start) / 1e9
    detected = [example.seconds(found.incipient_ns), example.seconds(found.gross_ns)]
    svg = figures.outputs(
        end_s, spikes, found.smoothed, example.onsets_s(), detected, simulated=simulated
    )
    data = {
        f"{kind}, {word} (spikes in a window)": numbers[:, k].tolist()
        for kind, numbers in (("raw", spikes), ("smoothed", found.smoothed))
        for k, word in enumerate(CLASS_WORDS)
    }
    figure = Figure(svg, name="outputs", data={"end of the window (s)": end_s.tolist(), **data})
    return OutputSection(example.condition, settings, choice_note(settings.choose), figure)
