"""The report's results: network, detections, latency, lead, label errors, and how it was made."""

from __future__ import annotations

from collections import Counter
from typing import Any

from analysis import dataset, figures
from analysis.detection import detect
from analysis.report import Figure, Section, Table, number
from flows import clock_words
from flows.campaigns import Collected
from flows.detector_section import choice_note
from flows.evaluate import trial_counts
from protocols.settings import Detection
from storage.recording import Recording
from storage.store import Store

_STATISTICS = ("n", "median", "p95", "mean", "std", "min", "max", "missed", "false_early")


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
            *_choice(evaluation, item.name),
        ],
        [
            Figure(
                svg, f"The same trial ({condition_text(row)}): raw outputs above, smoothed below."
            )
        ],
    )


def latency(evaluation: dict[str, Any], summary: dict[str, Any], simulated: bool) -> Section:
    """How late detections are on kinematic test trials."""
    rows = [row for row in evaluation["trials"] if row["experiment"] == "kinematic"]
    groups = {}
    for kind in ("incipient", "gross"):
        groups[f"{kind} slip"] = [
            row["latency"][f"latency_{kind}_ms"]
            for row in rows
            if row["latency"] is not None and row["latency"][f"latency_{kind}_ms"] is not None
        ]
    table = [
        [f"{kind} slip", *_statistics(summary["kinematic"]["latency_ms"][kind])]
        for kind in ("incipient", "gross")
    ]
    return Section(
        "Detection latency, kinematic test trials",
        [
            "Detection minus true onset. A detection more than 30 ms before the true onset is a "
            "false early detection: it is counted, and it has no latency.",
            *_choice(evaluation, *{row["campaign"] for row in rows}),
        ],
        [
            Figure(
                figures.distributions(
                    groups, "latency (ms)", simulated=simulated, zero="true onset"
                ),
                "Each dot is a trial; the bar is the median." + clock_words.figure_note(summary),
            )
        ],
        [Table(["onset", *_names()], table, _statistics_caption(summary))],
    )


def lead(evaluation: dict[str, Any], summary: dict[str, Any], simulated: bool) -> Section | None:
    """How far incipient detections are ahead of gross slip; None without such trials."""
    experiments = [name for name in ("gravity", "disturbance") if summary[name]["trials"]]
    if not experiments:
        return None
    groups: dict[str, list[float]] = {}
    for row in evaluation["trials"]:
        if row["experiment"] in experiments:
            values = groups.setdefault(condition_text(row), [])
            if row["latency"] is not None and row["latency"]["lead_ms"] is not None:
                values.append(row["latency"]["lead_ms"])
    counts = Counter(
        condition_text(row) for row in evaluation["trials"] if row["experiment"] in experiments
    )
    named = {f"{name} ({counts[name]} trials)": groups[name] for name in sorted(groups)}
    table = []
    for name in experiments:
        lead = summary[name]["lead_ms"]
        table.append([name, *_statistics(lead), number(lead["detected_first"])])
    return Section(
        "Lead: incipient slip detected before gross slip",
        [
            "True gross onset minus detected incipient onset, for plates that slip by their own "
            "weight. A false early detection is no lead; a detection after gross slip began "
            "stands left of zero.",
            *_choice(
                evaluation,
                *{
                    row["campaign"]
                    for row in evaluation["trials"]
                    if row["experiment"] in experiments
                },
            ),
        ],
        [
            Figure(
                figures.distributions(
                    named, "lead before gross slip (ms)", simulated=simulated, zero="gross slip"
                ),
                "Each dot is a trial, by configuration; the bar is the median."
                + clock_words.figure_note(summary),
            )
        ],
        [Table(["experiment", *_names(), "detected first"], table, _statistics_caption(summary))],
    )


def _choice(evaluation: dict[str, Any], *campaigns: str) -> list[str]:
    """How smoothing and margin came about, once for each way."""
    notes = {choice_note(evaluation["detection"][name]) for name in campaigns}
    return sorted(notes - {""})


def _names() -> list[str]:
    return [name.replace("_", " ") for name in _STATISTICS]


def _statistics_caption(summary: dict[str, Any]) -> str:
    return f"Milliseconds; n counts trials. {clock_words.latency_note(summary)}"


def _statistics(values: dict[str, Any]) -> list[str]:
    return [number(values[name]) for name in _STATISTICS]


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
