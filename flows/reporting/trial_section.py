"""The report's look at one trial: its markers, its events, and how many there are in each phase."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.report.figures import trials as figures
from sliplab.analysis.report.page import Figure, Section
from sliplab.analysis.report.published import PAPER
from sliplab.analysis.windows import dataset
from sliplab.analysis.windows.windows import first_pixel
from sliplab.flows.reporting import results
from sliplab.storage.schema.label import LABELS
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Store

Json = dict[str, Any]
F64 = npt.NDArray[np.float64]

BIN_S = 0.03
"""Of the event rate: a window of the network."""
_PHASES = (
    "at rest", "from the start of the motion to the first slip", "in incipient slip",
    "in gross slip",
)  # fmt: skip


def example(
    campaigns: list[Collected], evaluation: Json
) -> tuple[Collected, Recording, Json] | None:
    """The kinematic test trial with the median incipient latency: neither best nor worst."""
    rows = [
        row
        for row in evaluation["trials"]
        if row["experiment"] == "kinematic" and row["latency"] is not None
    ]
    if not rows:
        return None

    def latency(row: Json) -> float:
        value = row["latency"]["latency_incipient_ms"]
        return float("inf") if value is None else float(value)

    row = sorted(rows, key=latency)[len(rows) // 2]
    item = next(item for item in campaigns if item.name == row["campaign"])
    return item, item.campaign.recording(row["trial"]), row


def section(
    store: Store, item: Collected, recording: Recording, row: Json, simulated: bool
) -> Section:
    """Displacements, event rate and events of the trial."""
    arrays = Derived.of(store, LABELS, item.name).arrays(recording.trial_id)
    start, end = dataset.recorded_span(recording)
    event_s, cell = _events(item, recording, start)
    onsets = [results.seconds(row["incipient_ns"], start), results.seconds(row["gross_ns"], start)]
    motion_s = (recording.step(recording.motion_phase)[0] - start) / 1e9
    frame_s = (arrays["frame_ns"] - start) / 1e9
    tracked = recording.frame_source == "tracks"
    svg = figures.trial_overview(
        frame_s, arrays["displacement_px"], event_s, cell - 0.5, onsets, motion_s,
        item.settings.labelling.threshold_px, simulated=simulated,
    )  # fmt: skip
    rates = _rates(event_s, [0.0, motion_s, *onsets, (end - start) / 1e9])
    return Section(
        "One trial",
        [
            f"{results.condition_text(row)}: the test trial with the median incipient latency.",
            "Positive events a second in the crop: "
            + "; ".join(f"{rate:,.0f} {phase}" for phase, rate in rates.items())
            + ".",
        ],
        [
            Figure(
                svg,
                "Top: displacement of every marker since the end of the hold, seen through the "
                f"plate{', from ' + results.tracks_text(simulated) if tracked else ''}; the outer "
                "papillae let go first, the centre last. Middle and bottom: the sensor's own "
                "positive events. They rise as the skin is sheared and fall as one papilla after "
                "the other slips.",
                "trial",
                _data(frame_s, arrays["displacement_px"], event_s, cell),
                f"an event rate that is {PAPER['event_rate'].text}.",
            )
        ],
    )


def _events(item: Collected, recording: Recording, start: int) -> tuple[F64, F64]:
    """Positive events inside the crop: seconds since the recording began, and cell rows."""
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


def _rates(event_s: F64, edges: list[float | None]) -> dict[str, float]:
    """Events a second in each phase whose both ends are known."""
    found = {}
    for phase, (begin, over) in zip(_PHASES, itertools.pairwise(edges), strict=True):
        if begin is not None and over is not None and over > begin:
            inside = int(((event_s >= begin) & (event_s < over)).sum())
            found[phase] = inside / (over - begin)
    return found


def _data(frame_s: F64, displacement_px: F64, event_s: F64, cell: F64) -> dict[str, list[float]]:
    """Displacements frame by frame, and events by bins of 30 ms and cell rows."""
    data = {"frame time (s)": frame_s.tolist()}
    for k in range(displacement_px.shape[1]):
        name = "centre marker" if k == 0 else f"marker {k}"
        data[f"{name}, displacement (px)"] = displacement_px[:, k].tolist()
    count = int(np.ceil(max(float(event_s.max(initial=0.0)), BIN_S) / BIN_S))
    edges = np.arange(count + 1) * BIN_S
    data["bin of 30 ms, begin (s)"] = edges[:-1].tolist()
    data["positive events (1/s)"] = (np.histogram(event_s, edges)[0] / BIN_S).tolist()
    rows = int(cell.max(initial=0.0)) + 1
    table = np.histogram2d(event_s, cell, [edges, np.arange(rows + 1)])[0]
    for k in range(rows):
        data[f"events in cell row {k} (in 30 ms)"] = table[:, k].tolist()
    return data
