"""What stands in the report, section by section: from stored results to figures and tables."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.networks.training import Fitted
from sliplab.analysis.report.page import Number, Section, number, percent
from sliplab.flows.reporting import (
    campaign_section,
    clock_section,
    clock_words,
    detector_section,
    failures_section,
    guesses_section,
    holdout_section,
    label_section,
    latency_section,
    others_section,
    paper_section,
    results,
    trial_section,
)
from sliplab.flows.reporting.window_section import window_sections
from sliplab.storage.trials.store import Store

Json = dict[str, Any]


@dataclass(frozen=True)
class Material:
    """All that the report is made of.

    Attributes:
        extras: results of other programs, by name; see `flows.reporting.report_extras`.
    """

    store: Store
    campaigns: list[Collected]
    evaluation: Json
    summary: Json
    fitted: Fitted
    extras: dict[str, Json]


def headline(summary: Json) -> list[Number]:
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
            f"median of {latency['n']}; {latency['missed']} missed, {latency['late']} late, "
            f"{latency['false_early']} false early; {clock_words.short_note(summary)}"
            f"{_chosen_on_test(summary)}",
        ),
        Number(
            "gravity lead",
            number(lead["median"], 0, "ms"),
            f"median; smallest {number(lead['min'], 0, 'ms')}, n = {lead['n']}, "
            f"{lead['missed']} missed, {lead['late']} late; "
            f"{clock_words.short_note(summary)}{_chosen_on_test(summary)}",
        ),
        Number("clock uncertainty", uncertain, f"worst trial, {device}"),
    ]


def _chosen_on_test(summary: Json) -> str:
    chosen = any(item["choose"] == "test" for item in summary["detection"].values())
    return "; smoothing and margin chosen on test trials" if chosen else ""


def make_sections(material: Material) -> list[Section]:
    """All sections, in order."""
    store, campaigns, evaluation = material.store, material.campaigns, material.evaluation
    summary, extras = material.summary, material.extras
    simulated = bool(summary["simulated"])
    example = trial_section.example(campaigns, evaluation)
    found: list[Section | None] = [
        paper_section.section(summary),
        holdout_section.section(store, extras.get("holdout"), summary) if simulated else None,
        campaign_section.collected(campaigns, summary, simulated),
        campaign_section.quality(store, campaigns, simulated),
        None if example is None else trial_section.section(store, *example, simulated),
        *window_sections(
            evaluation["windows"],
            summary["kinematic"]["trained_baselines"],
            material.fitted,
            simulated,
        ),
        results.outputs(store, evaluation, example, simulated),
        latency_section.kinematic(campaigns, evaluation, summary, simulated),
        latency_section.gravity(campaigns, evaluation, summary, simulated),
        latency_section.disturbance(campaigns, evaluation, summary, simulated),
        failures_section.section(store, summary),
        detector_section.section(evaluation, simulated),
        label_section.section(store, campaigns, summary, simulated),
        clock_section.section(store, campaigns, summary, simulated),
        others_section.skins(store, extras.get("generalisation"), summary, simulated),
        guesses_section.section(store, extras.get("guesses")) if simulated else None,
        others_section.tradeoff(store, extras),
        results.provenance(summary),
    ]
    return [section for section in found if section is not None]
