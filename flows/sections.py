"""What stands in the report, section by section: from stored results to figures and tables."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from analysis import dataset, figures
from analysis.detection import detect
from analysis.metrics import CLASSES
from analysis.report import Figure, Number, Section, Table, number, percent
from analysis.training import Fitted
from flows.campaigns import Collected
from flows.evaluate import trial_counts
from flows.label import STEP as LABELS
from protocols.factors import Level
from protocols.settings import Detection
from storage.derived import Derived
from storage.recording import Recording
from storage.store import Store

_STATISTICS = ("n", "median", "p95", "mean", "std", "min", "max", "missed", "false_early")


def headline(summary: dict[str, Any]) -> list[Number]:
    """The numbers on top of the page."""
    accuracy = summary["kinematic"]["accuracy"]
    latency = summary["kinematic"]["latency_ms"]["incipient"]
    lead = summary["gravity"]["lead_ms"]
    return [
        Number(
            "trials committed",
            str(summary["quality"]["committed"]),
            f"of {summary['quality']['planned']} planned",
        ),
        Number("window accuracy", percent(accuracy["strict"]), f"strict, n = {accuracy['n']}"),
        Number(
            "incipient latency",
            number(latency["median"], 0, "ms"),
            f"median of {latency['n']}; {latency['missed']} missed, "
            f"{latency['false_early']} false early",
        ),
        Number(
            "gravity lead",
            number(lead["median"], 0, "ms"),
            f"median; smallest {number(lead['min'], 0, 'ms')}, n = {lead['n']}",
        ),
        Number(
            "clock uncertainty",
            number(summary["sync"]["worst_uncertainty_us"], 1, "µs"),
            f"worst trial, {summary['sync']['grade']}",
        ),
    ]


def make_sections(
    store: Store,
    campaigns: list[Collected],
    evaluation: dict[str, Any],
    summary: dict[str, Any],
    fitted: Fitted,
) -> list[Section]:
    """All sections, in order."""
    simulated = bool(summary["simulated"])
    example = _example(campaigns, evaluation)
    found: list[Section | None] = [_collected(campaigns, summary, simulated)]
    if example is not None:
        found.append(_one_trial(store, *example, simulated))
    found += [
        _network(evaluation, fitted, simulated),
        _outputs(store, evaluation, example, simulated),
        _latency(evaluation, summary, simulated),
        _lead(evaluation, summary, simulated),
        _labels(summary),
        _provenance(summary),
    ]
    return [section for section in found if section is not None]


def _collected(campaigns: list[Collected], summary: dict[str, Any], simulated: bool) -> Section:
    pictures = []
    for item in campaigns:
        factors = item.plan.protocol.collection.factors
        names = list(factors)[:2]
        if len(names) < 2:
            continue
        levels = [item.plan.enabled[name] for name in names]
        shape = (len(levels[0]), len(levels[1]))
        counts, planned = np.zeros(shape, np.int64), np.zeros(shape, np.int64)

        def cell(
            condition: tuple[tuple[str, Level], ...],
            names: list[str] = names,
            levels: list[tuple[Level, ...]] = levels,
        ) -> tuple[int, int]:
            there = dict(condition)
            return levels[0].index(there[names[0]]), levels[1].index(there[names[1]])

        for trial in item.plan:
            if trial.role == "measured":
                planned[cell(trial.condition)] += 1
        for trial, _ in item.trials:
            if trial.role == "measured":
                counts[cell(trial.condition)] += 1
        axes = [f"{name} ({factors[name].unit})" if factors[name].unit else name for name in names]
        pictures.append(
            Figure(
                figures.collected_grid(
                    levels[0], levels[1], counts, planned, axes[0], axes[1], simulated=simulated
                ),
                f"Campaign {item.name}: trials committed of trials planned, by {names[0]} and "
                f"{names[1]}; the other factors and repetitions are counted together.",
            )
        )
    rows = []
    for item in campaigns:
        known = summary["planned"][item.name]
        rows.append(
            [
                item.name,
                item.experiment,
                str(len(item.plan)),
                str(len(item.trials)),
                number(known["seconds"] / 60, 2),
                number(known["seconds_collected"] / 60, 2),
                number(known["bytes"] / 1e6, 1),
                number(known["bytes_collected"] / 1e6, 1),
            ]
        )
    quality = summary["quality"]
    columns = [
        "campaign",
        "experiment",
        "planned",
        "committed",
        "planned (min)",
        "taken (min)",
        "planned (MB)",
        "taken (MB)",
    ]
    return Section(
        "What was collected",
        [
            f"{quality['committed']} of {quality['planned']} planned trials are committed; "
            f"{quality['retaken']} attempts failed a quality gate and were taken again or set "
            f"aside, {quality['quarantined']} attempts stand in quarantine.",
        ],
        pictures,
        [Table(columns, rows, "Minutes are of the trials' own clocks, people's work left out.")],
    )


def _example(
    campaigns: list[Collected], evaluation: dict[str, Any]
) -> tuple[Collected, Recording, dict[str, Any]] | None:
    """The kinematic test trial with the median incipient latency: neither best nor worst."""
    rows = [
        row
        for row in evaluation["trials"]
        if row["experiment"] == "kinematic" and row["latency"] is not None
    ]
    if not rows:
        return None

    def latency(row: dict[str, Any]) -> float:
        value = row["latency"]["latency_incipient_ms"]
        return float("inf") if value is None else float(value)

    row = sorted(rows, key=latency)[len(rows) // 2]
    item = next(item for item in campaigns if item.name == row["campaign"])
    return item, item.campaign.recording(row["trial"]), row


def _seconds(value: int | None, origin: int) -> float | None:
    return None if value is None else (value - origin) / 1e9


def _condition(row: dict[str, Any]) -> str:
    return ", ".join(f"{name} {text}" for name, text in row["condition"].items())


def _one_trial(
    store: Store, item: Collected, recording: Recording, row: dict[str, Any], simulated: bool
) -> Section:
    label = Derived.of(store, LABELS, item.name)
    arrays = label.arrays(recording.trial_id)
    start, _ = dataset.recorded_span(recording)
    events = recording.events()
    windows = item.settings.windows
    _, height = recording.record["geometry"]["event_px"]
    top = (height - windows.crop_px) // 2
    cell = (events.y.astype(np.int64) - top) / windows.pool_px
    keep = (events.p > 0) & (cell >= 0) & (cell < windows.cells)
    to_line = recording.clock("events")
    event_s = (np.asarray(to_line.to_reference(events.t_us[keep] * 1000)) - start) / 1e9
    svg = figures.trial_overview(
        (arrays["frame_ns"] - start) / 1e9,
        arrays["displacement_px"],
        event_s,
        cell[keep] - 0.5,
        [_seconds(row["incipient_ns"], start), _seconds(row["gross_ns"], start)],
        (recording.step(recording.motion_phase)[0] - start) / 1e9,
        item.settings.labelling.threshold_px,
        simulated=simulated,
    )
    return Section(
        "One trial",
        [f"{_condition(row)}: the test trial with the median incipient latency."],
        [
            Figure(
                svg,
                "Top: displacement of every marker since the end of the hold, seen through the "
                "plate; the outer papillae let go first, the centre last. Middle and bottom: the "
                "sensor's own positive events. They rise as the skin is sheared and fall as one "
                "papilla after the other slips.",
            )
        ],
    )


def _network(evaluation: dict[str, Any], fitted: Fitted, simulated: bool) -> Section:
    windows = evaluation["windows"]
    accuracy = windows["accuracy"]
    beside = windows["baselines"]
    rows = [
        [
            "spiking network",
            percent(accuracy["argmax"]),
            percent(accuracy["strict"]),
            percent(accuracy["margin"]),
        ],
        ["logistic regression on the event count", percent(beside["logistic"]), "", ""],
        ["event-rate threshold", percent(beside["rate_threshold"]), "", ""],
        ["majority class", percent(beside["majority"]), "", ""],
    ]
    classes = [
        [word, percent(windows["precision"][name]), percent(windows["recall"][name])]
        for name, word in zip(CLASSES, figures.CLASS_WORDS, strict=True)
    ]
    trials = [row["argmax"] for row in windows["by_trial"].values() if row["argmax"] is not None]
    return Section(
        "The network on windows of 30 ms" if fitted.windows.length_ms == 30 else "The network",
        [
            f"{accuracy['n']} windows of test trials that were used neither for training nor for "
            "choosing the model. Argmax shares a tie among its classes, strict wants a unique "
            "winner, margin wants it to lead as a detection must. By trial the argmax accuracy "
            f"runs from {percent(min(trials, default=None))} to "
            f"{percent(max(trials, default=None))}.",
            *(f"Warning: {text}" for text in fitted.warnings),
        ],
        [
            Figure(
                figures.confusion(np.asarray(windows["confusion"]), simulated=simulated),
                "Rows are true classes and add up to 100 %. The last column holds windows whose "
                "two highest spike counts are equal.",
            ),
            Figure(
                figures.training_curves(
                    [vars(record) for record in fitted.history],
                    fitted.chosen_epoch,
                    simulated=simulated,
                ),
                "Training; the dashed line is the epoch with the best strict validation accuracy, "
                "whose weights are used.",
            ),
        ],
        [
            Table(["method", "argmax", "strict", "margin"], rows, "Accuracy on the same windows."),
            Table(["class", "precision", "recall"], classes),
        ],
    )


def _outputs(
    store: Store,
    evaluation: dict[str, Any],
    example: tuple[Collected, Recording, dict[str, Any]] | None,
    simulated: bool,
) -> Section | None:
    if example is None:
        return None
    item, recording, row = example
    found = trial_counts(store, item.name, recording.trial_id)
    settings = Detection.model_validate(evaluation["detection"][item.name])
    detections = detect(found["counts"], found["end_ns"], settings)
    start, _ = dataset.recorded_span(recording)
    svg = figures.outputs(
        (found["end_ns"] - start) / 1e9,
        found["counts"],
        detections.smoothed,
        [_seconds(row["incipient_ns"], start), _seconds(row["gross_ns"], start)],
        [_seconds(detections.incipient_ns, start), _seconds(detections.gross_ns, start)],
        simulated=simulated,
    )
    return Section(
        "From outputs to detections",
        [
            f"Output spikes are averaged over {settings.smoothing} windows; a class is believed "
            f"when it leads every other by {settings.margin:g} spikes. A detection is dated by "
            "the end of its newest window."
        ],
        [Figure(svg, f"The same trial ({_condition(row)}): raw outputs above, smoothed below.")],
    )


def _latency(evaluation: dict[str, Any], summary: dict[str, Any], simulated: bool) -> Section:
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
            "false early detection: it is counted, and it has no latency."
        ],
        [
            Figure(
                figures.distributions(
                    groups, "latency (ms)", simulated=simulated, zero="true onset"
                ),
                "Each dot is a trial; the bar is the median.",
            )
        ],
        [Table(["onset", *_names()], table, "Milliseconds; n counts trials.")],
    )


def _lead(evaluation: dict[str, Any], summary: dict[str, Any], simulated: bool) -> Section | None:
    experiments = [name for name in ("gravity", "disturbance") if summary[name]["trials"]]
    if not experiments:
        return None
    groups: dict[str, list[float]] = {}
    for row in evaluation["trials"]:
        if row["experiment"] in experiments:
            values = groups.setdefault(_condition(row), [])
            if row["latency"] is not None and row["latency"]["lead_ms"] is not None:
                values.append(row["latency"]["lead_ms"])
    counts = Counter(
        _condition(row) for row in evaluation["trials"] if row["experiment"] in experiments
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
            "stands left of zero."
        ],
        [
            Figure(
                figures.distributions(
                    named, "lead before gross slip (ms)", simulated=simulated, zero="gross slip"
                ),
                "Each dot is a trial, by configuration; the bar is the median.",
            )
        ],
        [
            Table(
                ["experiment", *_names(), "detected first"], table, "Milliseconds; n counts trials."
            )
        ],
    )


def _names() -> list[str]:
    return [name.replace("_", " ") for name in _STATISTICS]


def _statistics(values: dict[str, Any]) -> list[str]:
    return [number(values[name]) for name in _STATISTICS]


def _labels(summary: dict[str, Any]) -> Section | None:
    errors = summary["labels"]["error_ms"]
    if not errors["incipient"]["n"]:
        return None
    rows = [
        [
            f"{kind} onset",
            str(values["n"]),
            number(values["median"], 2),
            number(values["median_abs"], 2),
            number(values["max_abs"], 2),
        ]
        for kind, values in ((kind, errors[kind]) for kind in ("incipient", "gross"))
    ]
    return Section(
        "How exact the labels are",
        [
            "The mock rig knows when each papilla truly crossed the threshold. Labels are read "
            "from the video alone; this is their distance from that truth. Nothing else reads it."
        ],
        (),
        [
            Table(
                ["label", "trials", "median (ms)", "median distance (ms)", "largest (ms)"],
                rows,
                "Label minus simulation truth; one frame is 10 ms.",
            )
        ],
    )


def _provenance(summary: dict[str, Any]) -> Section:
    timing = [[name, number(value, 1)] for name, value in summary["timing_s"].items()]
    versions = [[name, value] for name, value in summary["versions"].items()]
    hashes = [
        [name, value["collection"][:16], value["analysis"][:16]]
        for name, value in summary["protocols"].items()
    ]
    seeds = summary["seeds"]
    return Section(
        "How it was made",
        [
            f"Network seeds {', '.join(map(str, seeds['network']))} (used: {seeds['chosen']}). "
            f"Clocks: {summary['sync']['grade']}, at worst "
            f"{number(summary['sync']['worst_uncertainty_us'], 1)} µs (95 %)."
        ],
        (),
        [
            Table(["protocol", "collection hash", "analysis hash"], hashes),
            Table(["step", "wall time (s)"], timing),
            Table(["package", "version"], versions),
        ],
    )
