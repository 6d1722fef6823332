"""Mean event rates of trials before the motion and in it: a study that the report shows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sliplab.analysis.report.programs import CommandResult
from sliplab.analysis.study import Finding, Study
from sliplab.analysis.study_plan import Search, StudyPlan
from sliplab.flows.cli.common import CampaignOption, StoreArgument
from sliplab.storage.schema.document import Bool, Document, Number, Part

if TYPE_CHECKING:
    from sliplab.analysis.campaigns import Collected
    from sliplab.analysis.report.page import Table
    from sliplab.storage.trials.recording import Recording
    from sliplab.storage.trials.store import TrialStore

RESULT = CommandResult("derived/lab_rates/rates.json", "sliplab rates {store}")
COLUMNS = ("trial", "hold (1/s)", "motion (1/s)")
SECONDS = 0.02
"""Of a trial, as a study expects it."""


class Rate(Part):
    """Mean event rates of a trial, events/s."""

    trial: str
    hold: Number
    motion: Number


class Rates(Document):
    """The rates of all trials with events."""

    simulated: Bool
    rates: tuple[Rate, ...]


def measure(store: StoreArgument, campaign: CampaignOption = None) -> Finding[Rates]:
    """Measure event rates before and in the motion of each trial."""
    from sliplab.analysis.campaigns import collected
    from sliplab.storage.trials.store import TrialStore

    opened = TrialStore.open(store)
    return find(opened, collected(opened, campaign))


def find(store: TrialStore, campaigns: Sequence[Collected]) -> Finding[Rates]:
    """Return the rates of the campaigns of a store."""
    found = tuple(
        rate(f"{item.name}/{trial.id}", recording)
        for item in campaigns
        for trial, recording in item.trials
        if recording.record.counts.events
    )
    result = Rates(simulated=store.simulated, rates=found)
    return Finding(result, (store.folder / RESULT.file).parent)


def rate(name: str, recording: Recording) -> Rate:
    """Return a trial's rates before its motion and in it."""
    start_ns, end_ns = recording.motion_ns
    moving = recording.events(start_ns, end_ns)
    hold_ns = min(start_ns, 500_000_000)
    still = recording.events(start_ns - hold_ns, start_ns)
    return Rate(
        trial=name,
        hold=1e9 * len(still) / hold_ns if hold_ns > 0 else 0.0,
        motion=1e9 * len(moving) / (end_ns - start_ns),
    )


def table(result: Rates) -> Table:
    """Return the rates below `COLUMNS`."""
    from sliplab.analysis.report.page import Table

    rows = [[it.trial, f"{it.hold:.0f}", f"{it.motion:.0f}"] for it in result.rates]
    return Table(COLUMNS, rows, f"Event rates{' (simulated)' if result.simulated else ''}")


def shown(result: Rates) -> Iterator[Table | str]:
    """Yield what the terminal shows."""
    yield table(result)
    yield "the next report shows them"


def view(result: Rates) -> dict[str, Any]:
    """Return the values of page.html."""
    return {"rates": table(result)}


STUDY = Study(
    name="rates",
    title="Event rates of trials",
    measure=measure,
    result=Rates,
    page=Path(__file__).with_name("page.html"),
    view=view,
    shown=shown,
    example="sliplab rates my-store",
)


def search(planned: StudyPlan, run_requests: Sequence[object]) -> Search:
    """Return the study as a step of `sliplab study --searches`."""

    def run(store: TrialStore, campaigns: list[Collected]) -> int:
        found = find(store, campaigns)
        STUDY.write(found)
        return len(found.result.rates)

    count = sum(len(item.plan.trials) for item in planned.campaigns)
    return Search("rates", "trials", SECONDS * count, run)
