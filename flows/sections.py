"""What stands in the report, section by section: from stored results to figures and tables."""

from __future__ import annotations

from typing import Any

import numpy as np

from analysis import dataset, figures
from analysis.report import Figure, Number, Section, Table, number, percent
from analysis.training import Fitted
from analysis.windows import first_pixel
from flows import clock_words, detector_section, label_section, results
from flows.campaigns import Collected
from flows.label import STEP as LABELS
from flows.window_section import window_sections
from protocols.factors import Level
from storage.derived import Derived
from storage.recording import Recording
from storage.store import Store


def headline(summary: dict[str, Any]) -> list[Number]:
    """The numbers on top of the page."""
    accuracy = summary["kinematic"]["accuracy"]
    latency = summary["kinematic"]["latency_ms"]["incipient"]
    lead = summary["gravity"]["lead_ms"]
    uncertain, device = clock_words.worst(summary)
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
            f"{latency['false_early']} false early; {clock_words.short_note(summary)}"
            f"{_chosen_on_test(summary)}",
        ),
        Number(
            "gravity lead",
            number(lead["median"], 0, "ms"),
            f"median; smallest {number(lead['min'], 0, 'ms')}, n = {lead['n']}; "
            f"{clock_words.short_note(summary)}{_chosen_on_test(summary)}",
        ),
        Number("clock uncertainty", uncertain, f"worst trial, {device}"),
    ]


def _chosen_on_test(summary: dict[str, Any]) -> str:
    chosen = any(item["choose"] == "test" for item in summary["detection"].values())
    return "; smoothing and margin chosen on test trials" if chosen else ""


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
        *window_sections(
            evaluation["windows"], summary["kinematic"]["trained_baselines"], fitted, simulated
        ),
        results.outputs(store, evaluation, example, simulated),
        results.latency(evaluation, summary, simulated),
        results.lead(evaluation, summary, simulated),
        detector_section.section(evaluation, simulated),
        label_section.section(summary),
        clock_words.section(store, summary),
        results.provenance(summary),
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
            f"Kept of the outside camera: {results.source_text(summary)}.",
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


def _one_trial(
    store: Store, item: Collected, recording: Recording, row: dict[str, Any], simulated: bool
) -> Section:
    label = Derived.of(store, LABELS, item.name)
    arrays = label.arrays(recording.trial_id)
    start, _ = dataset.recorded_span(recording)
    events = recording.events()
    windows = item.settings.windows
    _, height = recording.record["geometry"]["event_px"]
    centre = dataset.crop_centre_px(recording)
    top = first_pixel(height, windows.crop_px, None if centre is None else centre[1])
    cell = (events.y.astype(np.int64) - top) / windows.pool_px
    keep = (events.p > 0) & (cell >= 0) & (cell < windows.cells)
    to_line = recording.clock("events")
    event_s = (np.asarray(to_line.to_reference(events.t_us[keep] * 1000)) - start) / 1e9
    tracked = recording.frame_source == "tracks"
    svg = figures.trial_overview(
        (arrays["frame_ns"] - start) / 1e9,
        arrays["displacement_px"],
        event_s,
        cell[keep] - 0.5,
        [results.seconds(row["incipient_ns"], start), results.seconds(row["gross_ns"], start)],
        (recording.step(recording.motion_phase)[0] - start) / 1e9,
        item.settings.labelling.threshold_px,
        simulated=simulated,
    )
    return Section(
        "One trial",
        [f"{results.condition_text(row)}: the test trial with the median incipient latency."],
        [
            Figure(
                svg,
                "Top: displacement of every marker since the end of the hold, seen through the "
                f"plate{', from ' + results.tracks_text(simulated) if tracked else ''}; the outer "
                "papillae let go first, the centre last. Middle and bottom: the sensor's own "
                "positive events. They rise as the skin is sheared and fall as one papilla after "
                "the other slips.",
            )
        ],
    )
