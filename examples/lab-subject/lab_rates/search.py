"""The study of event rates as a step of `sliplab study --searches`."""

from __future__ import annotations

from collections.abc import Sequence

from lab_rates.study import STUDY, find
from sliplab.analysis.campaigns import Collected
from sliplab.analysis.study_plan import Search, StudyPlan
from sliplab.storage.trials.store import TrialStore

SECONDS = 0.02
"""Of a trial, as a study expects it."""


def search(planned: StudyPlan, run_requests: Sequence[object]) -> Search:
    """Return the step for the campaigns that are planned."""

    def run(store: TrialStore, campaigns: list[Collected]) -> int:
        found = find(store, campaigns)
        STUDY.write(found)
        return len(found.result.rates)

    count = sum(len(item.plan.trials) for item in planned.campaigns)
    return Search("rates", "trials", SECONDS * count, run)
