"""The page of detectors under nuisances."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sliplab.analysis.detectors.detectors import RULE
from sliplab.analysis.metrics.alarm_rates import few_words
from sliplab.analysis.report.page import Figure, Table, number, percent, render_page, with_interval
from sliplab.plugins.bench.stress import plot as figures
from sliplab.plugins.bench.stress.document import (
    HourlyRate,
    StressDetector,
    StressFigures,
    StressRecord,
)
from sliplab.plugins.bench.stress.judging import ALL
from sliplab.storage.schema.evaluation import Rate

COLUMNS = (
    "detector",
    "clean trials (95 %)",
    "false alarms an hour (95 %)",
    "missed slips",
    "latency, median (ms)",
    "from physical onset (ms)",
)


def title(detector: StressDetector) -> str:
    """Return a detector's name for people."""
    return f"{detector.network}: {detector.rule}, {detector.stride_ms} ms"


def cells(name: str, it: StressFigures) -> list[str]:
    """Return figures as cells, see `COLUMNS`."""
    return [
        name,
        _span(it.clean),
        _hourly(it.per_hour),
        f"{it.missed} of {it.trials}",
        number(it.latency_ms, 0),
        number(it.latency_true_ms, 0),
    ]


def of(detector: StressDetector, nuisance: str, strength: float | None = None) -> StressFigures:
    """Return a detector's figures under one nuisance.

    Raises:
        StopIteration: there are none.
    """
    return next(it for it in detector.figures if (it.nuisance, it.strength) == (nuisance, strength))


def nuisances(record: StressRecord) -> list[str]:
    """Return names of nuisances in the order of the figures."""
    found = dict.fromkeys(it.nuisance for it in record.detectors[0].figures)
    return [name for name in found if name != ALL]


def render(record: StressRecord) -> str:
    """Return the page as text."""
    simulated, names = record.simulated, nuisances(record)
    titled = [(title(detector), detector) for detector in record.detectors]
    networks = dict.fromkeys(it.network for it in record.accuracy)
    rows = {name: [it for it in record.accuracy if it.network == name] for name in networks}
    best = record.detectors[0]
    return render_page(
        Path(__file__).with_name("page.html"),
        simulated=simulated,
        record=record,
        detectors=Table(COLUMNS, [cells(name, of(it, ALL)) for name, it in titled]),
        clean=Figure(figures.clean_trials(titled, names, simulated=simulated)),
        best=titled[0][0],
        few=few_words(min(of(best, name).trials for name in names)),
        by_nuisance=Table(
            ("nuisance", *COLUMNS[1:]), [cells(name, of(best, name)) for name in names]
        ),
        accuracy=Figure(figures.by_strength(rows, names, simulated=simulated)),
        accuracies=Table(("nuisance", *rows), _accuracies(record, names, list(rows))),
    )


def _accuracies(
    record: StressRecord, names: Sequence[str], networks: Sequence[str]
) -> list[list[str]]:
    found = {(it.network, it.nuisance): it.strict for it in record.accuracy if it.strength is None}
    rows = [
        [name, *(_span(found.get((network, name))) for network in networks)]
        for name in [ALL, *names]
    ]
    rules: dict[str, StressDetector] = {}  # the first of a network is its rule
    for it in record.detectors:
        if it.rule.startswith(RULE):
            rules.setdefault(it.network, it)
    for name, title in (("none", "false alarms/h, quiet"), (ALL, "false alarms/h, all trials")):
        cells = [
            _hourly(of(rules[it], name).per_hour) if it in rules and name in [ALL, *names] else "–"
            for it in networks
        ]
        rows.append([title, *cells])
    return rows


def _span(rate: Rate | None) -> str:
    if rate is None:
        return "–"
    low, high = (percent(value).removesuffix(" %") for value in (rate.low, rate.high))
    return f"{percent(rate.value)} ({low} to {high})"


def _hourly(rate: HourlyRate) -> str:
    if rate.low is None or rate.high is None:
        return number(rate.value, 1)
    return with_interval(rate.value, (rate.low, rate.high), 1)
