"""`sliplab stress`: the detectors of a store under nuisances."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.analysis.study import Finding, Study
from sliplab.flows.cli.common import CampaignOption, StoreArgument
from sliplab.plugins.bench.stress.document import (
    ALL,
    HourlyRate,
    StressDetector,
    StressFigures,
    StressRecord,
)
from sliplab.protocols.shown import plural
from sliplab.storage.schema.evaluation import Rate

if TYPE_CHECKING:
    from sliplab.analysis.report.page import Table

COLUMNS = (
    "detector",
    "clean trials (95 %)",
    "false alarms an hour (95 %)",
    "missed slips",
    "latency, median (ms)",
    "from physical onset (ms)",
)


def measure(
    store: StoreArgument,
    campaign: CampaignOption = None,
    protocol: Annotated[
        Path,
        typer.Option("--protocol", help="With nuisances; a file, or one that ships: nuisances."),
    ] = Path("nuisances"),
    rig: Annotated[
        Path | None,
        typer.Option("--rig", help="Rig of these trials; default: the simulated one of STORE."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for trials, page and numbers; default: STORE/stress."),
    ] = None,
) -> Finding[StressRecord]:
    """Take trials under nuisances, and judge the detectors that STORE trained by them."""
    from sliplab.flows.steps import prepare_store
    from sliplab.storage.remote.mirror import open_store

    opened = open_store(store)
    prepare_store(store)  # before anything imports Prefect
    from sliplab.analysis.campaigns import collected
    from sliplab.plugins.bench.stress.flow import measure_stress, request

    asked = request(opened, collected(opened, campaign), protocol, rig, out)
    return Finding(measure_stress(asked), asked.out)


def shown(record: StressRecord) -> Iterator[Table | str]:
    """Yield the table of detectors over all trials."""
    from sliplab.analysis.report.page import Table

    simulated = " (simulated)" if record.simulated else ""
    yield Table(
        COLUMNS,
        [cells(it.title, it.under(ALL)) for it in record.detectors],
        f"{plural(record.trials, 'trial')} under nuisances, {record.hold_h:.2f} h of "
        f"holding{simulated}",
    )


def view(record: StressRecord) -> dict[str, object]:
    """Return what the page shows."""
    from sliplab.analysis.metrics.alarm_rates import few_words
    from sliplab.analysis.report.page import Figure, Table
    from sliplab.plugins.bench.stress import plot

    simulated, names = record.simulated, record.nuisances
    titled = [(it.title, it) for it in record.detectors]
    networks = dict.fromkeys(it.network for it in record.accuracy)
    rows = {name: [it for it in record.accuracy if it.network == name] for name in networks}
    best = record.detectors[0]
    return {
        "detectors": Table(COLUMNS, [cells(name, it.under(ALL)) for name, it in titled]),
        "clean": Figure(plot.clean_trials(titled, names, simulated=simulated)),
        "best": titled[0][0],
        "few": few_words(min(best.under(name).trials for name in names)),
        "by_nuisance": Table(
            ("nuisance", *COLUMNS[1:]), [cells(name, best.under(name)) for name in names]
        ),
        "accuracy": Figure(plot.by_strength(rows, names, simulated=simulated)),
        "accuracies": Table(("nuisance", *rows), _accuracies(record, names, list(rows))),
    }


def cells(name: str, it: StressFigures) -> list[str]:
    """Return figures as cells, see `COLUMNS`."""
    from sliplab.analysis.report.page import number

    return [
        name,
        _span(it.clean),
        _hourly(it.per_hour),
        f"{it.missed} of {it.trials}",
        number(it.latency_ms, 0),
        number(it.latency_true_ms, 0),
    ]


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
        if it.is_rule:
            rules.setdefault(it.network, it)
    for name, title in (("none", "false alarms/h, quiet"), (ALL, "false alarms/h, all trials")):
        rates = [
            _hourly(rules[it].under(name).per_hour)
            if it in rules and name in [ALL, *names]
            else "–"
            for it in networks
        ]
        rows.append([title, *rates])
    return rows


def _span(rate: Rate | None) -> str:
    from sliplab.analysis.report.page import percent

    if rate is None:
        return "–"
    low, high = (percent(value).removesuffix(" %") for value in (rate.low, rate.high))
    return f"{percent(rate.value)} ({low} to {high})"


def _hourly(rate: HourlyRate) -> str:
    from sliplab.analysis.report.page import number, with_interval

    if rate.low is None or rate.high is None:
        return number(rate.value, 1)
    return with_interval(rate.value, (rate.low, rate.high), 1)


STUDY = Study(
    name="stress",
    title="Detectors under nuisances, by SlipLab",
    measure=measure,
    result=StressRecord,
    page=Path(__file__).with_name("page.html"),
    view=view,
    shown=shown,
    example="sliplab stress my-study",
)
