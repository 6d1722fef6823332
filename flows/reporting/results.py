"""The report's words on one trial's outputs, and on how it was made."""

from __future__ import annotations

from typing import Any

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.detectors.detection import detect
from sliplab.analysis.report.figures import trials as figures
from sliplab.analysis.report.figures.style import CLASS_WORDS
from sliplab.analysis.report.page import Figure, Section, Table, number
from sliplab.analysis.windows import dataset
from sliplab.flows.learning.evaluate import trial_counts
from sliplab.flows.reporting import clock_words
from sliplab.flows.reporting.detector_section import choice_note
from sliplab.protocols.settings import Detection
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Store


def seconds(value: int | None, origin: int) -> float | None:
    """A time of the time line in seconds after `origin`."""
    return None if value is None else (value - origin) / 1e9


def condition_text(row: dict[str, Any]) -> str:
    """A trial's condition in words."""
    return ", ".join(f"{name} {text}" for name, text in row["condition"].items())


def outputs(
    store: Store,
    evaluation: dict[str, Any],
    example: tuple[Collected, Recording, dict[str, Any]] | None,
    simulated: bool,
) -> Section | None:
    """The example trial's raw and smoothed outputs; None without an example."""
    if example is None:
        return None
    item, recording, row = example
    settings = Detection.model_validate(evaluation["detection"][item.name])
    found = trial_counts(store, item.name, recording.trial_id, settings)
    detections = detect(found["counts"], found["end_ns"], settings)
    start, _ = dataset.recorded_span(recording)
    svg = figures.outputs(
        (found["end_ns"] - start) / 1e9,
        found["counts"],
        detections.smoothed,
        [seconds(row["incipient_ns"], start), seconds(row["gross_ns"], start)],
        [seconds(detections.incipient_ns, start), seconds(detections.gross_ns, start)],
        simulated=simulated,
    )
    return Section(
        "From outputs to detections",
        [
            f"Output spikes are averaged over {settings.smoothing} windows; a class is believed "
            f"when it leads every other by {settings.margin:g} spikes. A detection is dated by "
            "the end of its newest window.",
            *([note] if (note := choice_note(evaluation["detection"][item.name])) else []),
        ],
        [
            Figure(
                svg,
                f"The same trial ({condition_text(row)}): raw outputs above, smoothed below. Lines "
                "are the true onsets, dotted ones the detections; smoothing trades the flicker of "
                "single windows for delay.",
                "outputs",
                {
                    "end of the window (s)": ((found["end_ns"] - start) / 1e9).tolist(),
                    **{
                        f"{kind}, {word} (spikes in a window)": numbers[:, k].tolist()
                        for kind, numbers in (
                            ("raw", found["counts"]),
                            ("smoothed", detections.smoothed),
                        )
                        for k, word in enumerate(CLASS_WORDS)
                    },
                },
                "the same two rows, for one of its trials.",
            )
        ],
    )


def tracks_text(simulated: bool) -> str:
    """Tracks in words that nobody mistakes for a video."""
    if simulated:
        return "simulated tracks of the markers (no video was drawn)"
    return "the camera's own tracks of the markers (no video was kept)"


def source_text(summary: dict[str, Any]) -> str:
    """What the labels were read from."""
    words = {"video": "the video", "tracks": tracks_text(summary["simulated"])}
    return " or ".join(words[name] for name, count in summary["labels"]["source"].items() if count)


def provenance(summary: dict[str, Any]) -> Section:
    """Hashes, wall times and versions."""
    timing = [[name, number(value, 1)] for name, value in summary["timing_s"].items()]
    versions = [[name, value] for name, value in summary["versions"].items()]
    hashes = [
        [name, value["collection"][:16], value["analysis"][:16]]
        for name, value in summary["protocols"].items()
    ]
    seeds = summary["seeds"]
    uncertain, device = clock_words.worst(summary)
    return Section(
        "How it was made",
        [
            f"Network seeds {', '.join(map(str, seeds['network']))} (used: {seeds['chosen']}). "
            f"Clocks: at worst {uncertain}, {device}."
        ],
        (),
        [
            Table(["protocol", "collection hash", "analysis hash"], hashes),
            Table(["step", "wall time (s)"], timing),
            Table(["package", "version"], versions),
        ],
    )
