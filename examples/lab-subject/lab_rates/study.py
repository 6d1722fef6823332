"""Mean event rates of trials before the motion and in it, stored with other results."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.report.programs import CommandResult
from sliplab.analysis.study_plan import Search, StudyPlan
from sliplab.storage.files import make_folder, write_json
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Store

RESULT = CommandResult("derived/lab_rates/results.json", "sliplab rates {store}")
SECONDS = 0.02
"""Of a trial, as a study expects it."""


def measure(store: Store, campaigns: Sequence[Collected]) -> dict[str, Any]:
    """Return the rates by trial, events/s, and write them into the store."""
    trials = {
        f"{item.name}/{trial.id}": rates(recording)
        for item in campaigns
        for trial, recording in item.trials
        if recording.record.counts.events
    }
    result = {"simulated": store.simulated, "trials": trials}
    path = store.folder / RESULT.file
    make_folder(path.parent)
    write_json(path, result)
    return result


COLUMNS = ("trial", "hold (1/s)", "motion (1/s)")


def rows(result: dict[str, Any]) -> list[list[str]]:
    """Return the rates of each trial below `COLUMNS`."""
    return [
        [name, f"{found['hold']:.0f}", f"{found['motion']:.0f}"]
        for name, found in result["trials"].items()
    ]


def rates(recording: Recording) -> dict[str, float]:
    """Return a trial's rates before its motion and in it, events/s."""
    start_ns, end_ns = recording.motion_ns
    moving = recording.events(start_ns, end_ns)
    hold_ns = min(start_ns, 500_000_000)
    still = recording.events(start_ns - hold_ns, start_ns)
    return {
        "hold": 1e9 * len(still) / hold_ns if hold_ns > 0 else 0.0,
        "motion": 1e9 * len(moving) / (end_ns - start_ns),
    }


def search(planned: StudyPlan, run_requests: Sequence[object]) -> Search:
    """Return the study as a step of `sliplab study --searches`."""
    count = sum(len(item.plan.trials) for item in planned.campaigns)
    return Search(
        "rates",
        "trials",
        SECONDS * count,
        lambda store, campaigns: len(measure(store, campaigns)["trials"]),
    )
