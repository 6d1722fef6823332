"""Mean event rates of trials before the motion and in it: a study that the report shows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sliplab.analysis.report.programs import CommandResult
from sliplab.analysis.study import Finding, Study
from sliplab.flows.cli.common import CampaignOption, StoreArgument
from sliplab.storage.schema.document import Bool, Document, Number, Part

if TYPE_CHECKING:
    from sliplab.analysis.campaigns import Collected
    from sliplab.analysis.report.page import Table
    from sliplab.storage.trials.store import TrialStore

RESULT = CommandResult("derived/lab_rates/rates.json", "sliplab rates {store}")


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

    return find(opened := TrialStore.open(store), collected(opened, campaign))


def find(store: TrialStore, campaigns: Sequence[Collected]) -> Finding[Rates]:
    """Return the rates of the campaigns of a store."""
    rates = []
    trials = ((item.name, *each) for item in campaigns for each in item.trials)
    for campaign, trial, recording in trials:
        if recording.record.counts.events == 0:
            continue
        start_ns, end_ns = recording.motion_ns
        hold_ns = min(start_ns, 500_000_000)
        hold = 1e9 * len(recording.events(start_ns - hold_ns, start_ns)) / max(hold_ns, 1)
        motion = 1e9 * len(recording.events(start_ns, end_ns)) / (end_ns - start_ns)
        rates.append(Rate(trial=f"{campaign}/{trial.id}", hold=hold, motion=motion))
    found = Rates(simulated=store.simulated, rates=tuple(rates))
    return Finding(found, (store.folder / RESULT.file).parent)


def table(result: Rates) -> Table:
    """Return the rates as a table."""
    from sliplab.analysis.report.page import Table

    rows = [[it.trial, f"{it.hold:.0f}", f"{it.motion:.0f}"] for it in result.rates]
    title = f"Event rates{' (simulated)' if result.simulated else ''}"
    return Table(("trial", "hold (1/s)", "motion (1/s)"), rows, title)


STUDY = Study(
    name="rates",
    title="Event rates of trials",
    measure=measure,
    result=Rates,
    page=Path(__file__).with_name("page.html"),
    view=lambda result: {"rates": table(result)},  # the values of page.html
    shown=lambda result: [table(result), "the next report shows them"],
    example="sliplab rates my-store",
)
