"""`sliplab power`: how many trials the claims of a protocol need."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.analysis.study import Finding, Study
from sliplab.flows.cli.common import CampaignOption, EnableOption, ProtocolArgument
from sliplab.plugins.claims.power.document import ClaimPower, Learning, PowerRecord, TrialSpread
from sliplab.protocols.shown import plural

if TYPE_CHECKING:
    from sliplab.analysis.report.page import Table
    from sliplab.flows.planning.plan_view import Forecast
    from sliplab.protocols import Plan
    from sliplab.storage.trials.store import TrialStore

COLUMNS = ("claim", "trials", "80 %", "holds", "refuted", "open", "repetitions needed")
TOGETHER = "all claims"


def measure(
    protocol: ProtocolArgument,
    store: Annotated[
        Path, typer.Option("--store", help="Folder of a store with trials of a pilot or a twin.")
    ],
    campaign: CampaignOption = None,
    claims: Annotated[
        list[str] | None,
        typer.Option(
            "--claim",
            help="In place of the protocol's claims: '{figure: accuracy, within: 1 %}'. "
            "Repeatable.",
        ),
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option("--model", help="The network that judges trials, in place of the protocol's."),
    ] = None,
    enable: EnableOption = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for the page and its numbers; default: STORE/report."),
    ] = None,
    draws: Annotated[
        int | None,
        typer.Option(
            "--draws",
            min=10,
            max=10_000,
            help="Campaigns to draw; default: 100, and 20 with order: adaptive.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, max=2**31, help="Of the draws.")] = 1,
    sessions: Annotated[
        int,
        typer.Option("--sessions", min=1, max=1000, help="Days, mountings or skins to plan for."),
    ] = 1,
    between: Annotated[
        float | None,
        typer.Option(
            "--between",
            min=0,
            max=100,
            help="Deviation between sessions, as a share of that between trials; default: the "
            "pilot's, or 0.3 where it is of one session.",
        ),
    ] = None,
    drift: Annotated[
        float,
        typer.Option(
            "--drift",
            min=0,
            max=100,
            help="From the first trial to the last, as a share of the deviation between trials.",
        ),
    ] = 0.0,
    network: Annotated[
        bool,
        typer.Option("--network", help="Train the network itself for the learning curve."),
    ] = False,
    no_training: Annotated[
        bool, typer.Option("--no-training", help="Leave the learning curve out.")
    ] = False,
) -> Finding[PowerRecord]:
    """Say after how many trials a protocol's claims are called, by a pilot's labelled trials."""
    from sliplab.flows.steps import prepare_store
    from sliplab.storage.remote.mirror import open_store

    pilot = open_store(store)
    prepare_store(store)  # before anything imports Prefect
    from sliplab.analysis.campaigns import collected
    from sliplab.plugins.claims.power.flow import Classifier, foretell, plan_with_claims, request
    from sliplab.plugins.claims.power.resampling import Sessions

    plan, judging = plan_with_claims(protocol, claims or (), enable or (), model)
    classifier: Classifier | None = "network" if network else "logistic"
    if no_training:
        classifier = None
    time = Sessions(sessions, between, drift)
    asked = request(pilot, collected(pilot, campaign), plan, judging, draws, seed, classifier, time)
    return Finding(foretell(asked), pilot.folder / "report" if out is None else out)


def forecast(plan: Plan, pilot: TrialStore) -> Forecast:
    """Return what a pilot predicts of a plan's claims, for `sliplab plan`.

    Raises:
        InputError: the plan has no claims, or the pilot cannot tell.
    """
    from sliplab.flows.planning.plan_view import Forecast
    from sliplab.plugins.claims.power.flow import of_plan

    record = of_plan(plan, pilot)
    return Forecast(_title(record), COLUMNS, _rows(record), _lines(record), record.to_json())


def shown(record: PowerRecord) -> Iterator[Table | str]:
    """Yield after how many trials, and hours at the rig, claims are expected to be called."""
    from sliplab.analysis.report.page import Table

    yield Table(COLUMNS, _rows(record), _title(record))
    yield from _lines(record)


def view(record: PowerRecord) -> dict[str, object]:
    """Return what the page shows."""
    from sliplab.analysis.report.page import Figure, Table
    from sliplab.plugins.claims.power import plot

    simulated, curve = record.simulated, record.learning
    calls = {it.claim: it.called for it in record.claims} | {TOGETHER: record.ended}
    return {
        "texts": list(_texts(record)),
        "claims": Table(COLUMNS, _rows(record)),
        "decisions": Figure(plot.decisions(calls, record.planned, simulated=simulated)),
        "widths": Figure(plot.widths(record.claims, simulated=simulated)),
        "learning": curve and Figure(plot.learning_curve(curve, simulated=simulated)),
    }


def _title(record: PowerRecord) -> str:
    kind = "simulated pilot" if record.simulated else "pilot"
    return f"claims of {record.protocol}, by {plural(record.pilot_trials, 'trial')} of a {kind}"


def _lines(record: PowerRecord) -> list[str]:
    return [*(f"note: {note}" for note in record.notes), *_texts(record)]


def _rows(record: PowerRecord) -> list[list[str]]:
    """Return claims as rows below `COLUMNS`, and all of them together."""
    found = [
        [
            it.claim,
            *_trials(it.trials, record),
            *(_percent(share, 0) for share in (it.holds, it.refuted, it.never)),
            _repetitions(it),
        ]
        for it in record.claims
    ]
    together = [*_trials(record.together, record), "–", "–", _percent(record.never, 0), "–"]
    return [*found, [TOGETHER, *together]]


def _trials(spread: TrialSpread, record: PowerRecord) -> tuple[str, str]:
    low, median, high = (
        f"> {record.planned}" if n is None else str(n)
        for n in (spread.low, spread.median, spread.high)
    )
    return median, f"{low} to {high}"


def _repetitions(it: ClaimPower) -> str:
    if not it.out_of_reach:
        return "–"
    return "unknown" if it.repetitions is None else f"about {it.repetitions}"


def _texts(record: PowerRecord) -> Iterator[str]:
    """Yield the findings: claims out of reach, hours, and the learning curve."""
    for it in record.claims:
        if it.out_of_reach:
            yield f"cannot be had by this plan: {it.claim}: {_impossible(it, record)}"
    low, median, high = map(_hours, record.expected_hours)
    yield (
        f"a campaign that ends by its claims is expected to take {median} of motion "
        f"({low} to {high}), the whole plan {_hours(record.hours)}"
    )
    if record.learning is not None:
        yield _expected(record.learning, " simulated" if record.simulated else "")


def _hours(number: float) -> str:
    """Return a time in hours, or in minutes below one."""
    return f"{number:.1f} h" if number >= 1.0 else f"{60.0 * number:.0f} min"


def _impossible(it: ClaimPower, record: PowerRecord) -> str:
    """Return why a claim is out of reach, and how many repetitions would call it."""
    stated = f"it is open at the end in {_percent(it.never, 0)} of the drawn campaigns; "
    if it.repetitions is None:
        return f"{stated}no number of repetitions is foreseen that calls it"
    return (
        f"{stated}about {plural(it.repetitions, 'repetition')} of each condition in place of "
        f"{record.repetitions} would call it (an estimate: widths fall with the root of the number "
        "of trials)"
    )


def _expected(curve: Learning, simulated: str) -> str:
    """Return what the learning curve predicts for the whole plan."""
    last = curve.points[-1]
    return (
        f"{curve.classifier}: {_percent(last.accuracy)} ({_span(last.low, last.high)}) by "
        f"{last.trials}{simulated} training trials; {curve.planned}, as planned, are expected to "
        f"give {_percent(curve.expected)} ({_span(curve.low, curve.high)})"
    )


def _span(low: float, high: float) -> str:
    return f"{_percent(low).removesuffix(' %')} to {_percent(high)}"


def _percent(share: float, digits: int = 1) -> str:
    from sliplab.analysis.report.page import percent

    return percent(share, digits)


STUDY = Study(
    name="power",
    title="Trials that claims need, by SlipLab",
    measure=measure,
    result=PowerRecord,
    page=Path(__file__).with_name("page.html"),
    view=view,
    shown=shown,
    example="sliplab power my-protocol.yaml --store my-store",
)
