"""What a step makes of every trial by itself: on all cores, in chunks, each kept at once.

Labels and clocks are made this way. A stop is answered between two trials; what was made until
then is kept, and the next run makes the rest.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import active_children, get_context
from typing import Any

from prefect import flow, task
from prefect.cache_policies import NO_CACHE

from flows import console, stopping
from flows.orchestration import Parcel, run
from flows.timing import timed
from storage.derived import Derived
from storage.recording import Recording
from storage.store import Store

CHUNK = 64

Make = Callable[[Recording, Any], tuple[dict[str, Any], dict[str, Any]]]
"""Of a trial and settings, a result's JSON and its arrays. It runs in processes of their own, so it
stands in a module, best in one that loads quickly."""


@dataclass(frozen=True)
class TrialWork:
    """One result that is wanted of one trial, with the key it must have."""

    recording: Recording
    campaign: str
    key: str
    settings: Any = None


@dataclass(frozen=True)
class _Step:
    """A step with what it has to do.

    Attributes:
        name: where its results are kept; title: what people call it.
    """

    store: Store
    name: str
    title: str
    work: list[TrialWork]
    make: Make


def stale_trials(store: Store, step: str, wanted: list[TrialWork]) -> list[TrialWork]:
    """Those of `wanted` that have to be made."""
    return [
        work
        for work in wanted
        if not Derived.of(store, step, work.campaign).fresh(work.recording.folder.name, work.key)
    ]


def run_trials(
    store: Store,
    step: str,
    title: str,
    work: list[TrialWork],
    make: Make,
) -> None:
    """Make every result of `work` and keep it among the derived results of `step`."""
    if work:
        named = _trials_flow.with_options(name=title, validate_parameters=False)
        run(named, Parcel(_Step(store, step, title, work, make)))


@task(name="chunk of trials", cache_policy=NO_CACHE, persist_result=False)
def _chunk(parcel: Parcel[tuple[_Step, list[TrialWork], ProcessPoolExecutor, console.Bar]]) -> int:
    """Some trials on all cores; each is kept as soon as it is there."""
    step, work, pool, bar = parcel.content
    futures = {pool.submit(step.make, item.recording, item.settings): item for item in work}
    for future in as_completed(futures):
        item = futures[future]
        name = item.recording.folder.name
        data, arrays = future.result()
        Derived.of(step.store, step.name, item.campaign).write(name, item.key, data, arrays)
        bar.advance(1, name)
    return len(work)


@flow(name="trials", validate_parameters=False, persist_result=False)
def _trials_flow(wanted: Parcel[_Step]) -> int:
    """All that is stale, in core-sized chunks."""
    step = wanted.content
    chunk = _chunk.with_options(name=f"{step.title} trials")
    workers = max(1, min(len(step.work), os.cpu_count() or 1))
    with (
        timed(step.store, step.title),
        ProcessPoolExecutor(
            workers, mp_context=get_context("spawn"), initializer=stopping.leave_to_parent
        ) as pool,
        console.bar(f"{step.title} (trials)", len(step.work)) as bar,
    ):
        try:
            for start in range(0, len(step.work), CHUNK):
                chunk(Parcel((step, step.work[start : start + CHUNK], pool, bar)))
        except BaseException:
            for worker in active_children():
                worker.terminate()  # what a worker had not handed over is simply made again
            raise
    return len(step.work)
