"""The analysis steps by name, and how one is run on a store."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NotRequired, TypedDict

from sliplab.flows.running import console

if TYPE_CHECKING:
    from sliplab.analysis.labels.reviewed import State


class StepDone(TypedDict):
    """A step's name and the number of results that it made."""

    step: str
    done: int


class StepResult(StepDone):
    """Numbers of what an analysis step did, as `--json` prints them.

    Attributes:
        fresh: results that were up to date.
        reviewed: trials by the state of people's decisions, where these are applied.
    """

    fresh: int
    reviewed: NotRequired[dict[State, int]]


STEPS = {
    "sync": "sliplab.flows.sync",
    "label": "sliplab.flows.label",
    "train": "sliplab.flows.train",
    "evaluate": "sliplab.flows.evaluate",
    "judge_model": "sliplab.flows.judge_network",
    "judge_detector": "sliplab.flows.judge_detector",
    "judge_predictions": "sliplab.flows.judge_network",
    "window_baselines": "sliplab.flows.window_checks",
    "window_checks": "sliplab.flows.window_checks",
    "report": "sliplab.flows.report",
}
"""The module of each step; its function has the step's name."""


def located(place: str) -> Path:
    """Return a store's folder: the folder itself, or the updated mirror of a URL.

    Raises:
        StoreError: it does not exist.
    """
    from sliplab.storage.remote.mirror import open_mirror
    from sliplab.storage.remote.objects import is_url

    if not is_url(place):
        return Path(place)
    with console.bar(f"read {place} (trials)", 0) as bar:
        store, done = open_mirror(place, bar.count)
    for problem in done.problems:
        console.say(f"skipped: {problem}")
    console.say(f"working on {store.folder}; events and videos are downloaded when first read")
    return store.folder


def prepare_store(folder: Path) -> None:
    """Make the store and point Prefect at it; everything that imports Prefect comes after."""
    from sliplab.flows.running import orchestration
    from sliplab.storage.trials.store import TrialStore

    orchestration.configure_prefect(TrialStore.create(folder).folder)


def run_step(
    folder: Path, names: list[str] | None, step: str, dask: str | None = None, **options: Any
) -> StepResult:
    """Run one analysis step on a store.

    Args:
        dask: the scheduler whose workers take the trials.

    Returns:
        the step's result; some have more numbers.
    """
    from sliplab.storage.remote.mirror import open_store

    store = open_store(folder)
    prepare_store(folder)
    from sliplab.analysis.campaigns import collected
    from sliplab.flows.running.cluster import connected

    campaigns = collected(store, names)
    with connected(dask) as cluster:
        if cluster is not None:
            options["cluster"] = cluster
        result: StepResult = getattr(import_module(STEPS[step]), step)(store, campaigns, **options)
    if not result["done"]:
        console.say(f"{step}: nothing to do, all {result['fresh']} results are fresh")
    return result
