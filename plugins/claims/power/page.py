"""The page of how many trials a protocol's claims need."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from sliplab.analysis.report.page import Figure, Table, percent, render_page
from sliplab.flows.planning.plan_view import Forecast
from sliplab.plugins.claims.power import plot as figures
from sliplab.plugins.claims.power.document import ClaimPower, Learning, PowerRecord, Spread
from sliplab.plugins.claims.power.drawing import MOST_OPEN
from sliplab.protocols.shown import plural

COLUMNS = ("claim", "trials", "80 %", "holds", "refuted", "open", "repetitions needed")
TOGETHER = "all claims"


def forecast_of(record: PowerRecord) -> Forecast:
    """Return after how many trials, and hours at the rig, claims are expected to be called."""
    kind = "simulated pilot" if record.simulated else "pilot"
    title = f"claims of {record.protocol}, by {plural(record.pilot_trials, 'trial')} of a {kind}"
    lines = [*(f"note: {note}" for note in record.notes), *sentence(record)]
    return Forecast(title, COLUMNS, rows(record), lines, record.to_json())


def rows(record: PowerRecord) -> list[list[str]]:
    """Return claims as rows below `COLUMNS`, and all of them together."""
    found = [
        [
            it.claim,
            *_trials(it.trials, record),
            *(percent(x, 0) for x in (it.holds, it.refuted)),
            percent(it.never, 0),
            _repetitions(it, record),
        ]
        for it in record.claims
    ]
    together = [*_trials(record.together, record), "–", "–", percent(record.never, 0), "–"]
    return [*found, [TOGETHER, *together]]


def _trials(spread: Spread, record: PowerRecord) -> tuple[str, str]:
    low, median, high = (
        f"> {record.planned}" if n is None else str(n)
        for n in (spread.low, spread.median, spread.high)
    )
    return median, f"{low} to {high}"


def _repetitions(it: ClaimPower, record: PowerRecord) -> str:
    if it.never <= MOST_OPEN:
        return "–"
    return "unknown" if it.repetitions is None else f"about {it.repetitions}"


def sentence(record: PowerRecord) -> Iterator[str]:
    """Yield the findings: claims out of reach, hours, and the learning curve."""
    for it in record.claims:
        if it.never > MOST_OPEN:
            yield f"cannot be had by this plan: {it.claim}: {impossible(it, record)}"
    low, median, high = map(hours, record.expected_hours)
    yield (
        f"a campaign that ends by its claims is expected to take {median} of motion "
        f"({low} to {high}), the whole plan {hours(record.hours)}"
    )
    if record.learning is not None:
        yield expected(record.learning, simulated=record.simulated)


def hours(number: float) -> str:
    """Return a time in hours, or in minutes below one."""
    return f"{number:.1f} h" if number >= 1.0 else f"{60.0 * number:.0f} min"


def impossible(it: ClaimPower, record: PowerRecord) -> str:
    """Return why a claim is out of reach, and how many repetitions would call it."""
    said = f"it is open at the end in {percent(it.never, 0)} of the drawn campaigns; "
    if it.repetitions is None:
        return f"{said}no number of repetitions is foreseen that calls it"
    return (
        f"{said}about {plural(it.repetitions, 'repetition')} of each condition in place of "
        f"{record.repetitions} would call it (an estimate: widths fall with the root of the number "
        "of trials)"
    )


def expected(curve: Learning, *, simulated: bool) -> str:
    """Return what the learning curve predicts for the whole plan."""
    last = curve.points[-1]
    return (
        f"{curve.classifier}: {percent(last.accuracy)} ({_span(last.low, last.high)}) by "
        f"{last.trials}{' simulated' if simulated else ''} training trials; {curve.planned}, as "
        f"planned, are expected to give {percent(curve.expected)} "
        f"({_span(curve.low, curve.high)})"
    )


def _span(low: float, high: float) -> str:
    return f"{percent(low).removesuffix(' %')} to {percent(high)}"


def render(record: PowerRecord) -> str:
    """Return the page as text."""
    simulated = record.simulated
    calls = {it.claim: it.called for it in record.claims} | {TOGETHER: record.ended}
    curve = record.learning
    return render_page(
        Path(__file__).with_name("page.html"),
        simulated=simulated,
        record=record,
        texts=list(sentence(record)),
        claims=Table(COLUMNS, rows(record)),
        decisions=Figure(figures.decisions(calls, record.planned, simulated=simulated)),
        widths=Figure(figures.widths(record.claims, simulated=simulated)),
        learning=None
        if curve is None
        else Figure(figures.learning_curve(curve, simulated=simulated)),
        curve=curve,
    )
