"""Numbers on top of a report about slip."""

from __future__ import annotations

from sliplab.analysis.report.alarms import COMMAND, DISTURBED, QUIET, rate_words
from sliplab.analysis.report.latency import smallest_lead
from sliplab.analysis.report.page import Number, number, percent
from sliplab.analysis.report.seeds import seed_words
from sliplab.protocols.shown import plural
from sliplab.storage.schema.summary import Experiment, Kinematic, OneCameraSummary, Summary

_BODIES = {"kinematic": "the slide", "gravity": "the plate", "disturbance": "the plate"}
"""Bodies whose rest ends gross slip, by experiment."""


def slip_tiles(summary: Summary | OneCameraSummary, note: str = "") -> list[Number]:
    """Return accuracy with its cost in false alarms, latencies and leads; none if not evaluated.

    Args:
        note: of what else latencies depend on.
    """
    if summary.kinematic is None:
        return []
    latency = summary.kinematic.latency_ms.incipient
    found = [
        _accuracy(summary.kinematic),
        _alarms(summary.kinematic),
        Number(
            "incipient latency",
            number(latency.median, 0, "ms"),
            f"median of {plural(latency.n + latency.missed + latency.late, 'trial')}; "
            f"{latency.missed} "
            f"missed, {latency.late} late, {latency.false_early} false early{note}",
        ),
        *_gross(summary),
    ]
    gravity = summary.gravity
    if gravity is not None and (gravity.trials or isinstance(summary, Summary)):
        lead = gravity.lead_ms
        smallest = smallest_lead(summary, "gravity")
        found.append(
            Number(
                "gravity lead",
                number(lead.median, 0, "ms"),
                f"median; smallest {smallest}; {lead.missed} missed, {lead.late} late{note}",
            )
        )
    return found


def _accuracy(kinematic: Kinematic) -> Number:
    seeds = seed_words(kinematic.seeds)
    return Number(
        "window accuracy",
        percent(kinematic.accuracy.strict),
        f"strict, n = {plural(kinematic.interval.trials, 'trial')} "
        f"({plural(kinematic.accuracy.n, 'window')}); {seeds}",
    )


def _alarms(kinematic: Kinematic) -> Number:
    quiet = kinematic.false_alarms.get(QUIET)
    disturbed = kinematic.false_alarms.get(DISTURBED)
    sure = "no interval" if quiet is None or quiet.high is None else "95 %"
    held = "" if quiet is None else f", {plural(quiet.clusters, 'trial')}, {quiet.hours:.3f} h"
    under = f"not measured ({COMMAND})" if disturbed is None else rate_words(disturbed)
    return Number(
        "false alarms an hour",
        rate_words(quiet),
        f"in quiet holding ({sure}){held}; under nuisances {under}",
    )


def _gross(summary: Summary | OneCameraSummary) -> list[Number]:
    """Return how many gross detections came in time, and what became of the others."""
    counted, every, notes = 0, 0, []
    for name, body in _BODIES.items():
        experiment: Experiment | None = getattr(summary, name)
        if experiment is None or not experiment.trials:
            continue
        gross = experiment.latency_ms.gross
        trials = gross.n + gross.missed + gross.late + gross.false_early
        counted, every = counted + gross.n, every + trials
        others = [f"{gross.missed} missed"] if gross.missed else []
        others += [f"{gross.false_early} false early"] if gross.false_early else []
        if gross.late:
            late = f"{gross.late} of {trials} gross detections came after {body} had stopped"
            others.append(late)
        notes.append(f"{name} {gross.n} of {trials}" + "".join(f", {text}" for text in others))
    return [Number("gross slip in time", f"{counted} of {every}", "; ".join(notes))]
