"""Independent jobs on all cores of this machine or on a Dask cluster.

`parallel_map` takes any jobs. `each_trial` computes a result for every trial, and `run_trials`
stores it among the derived results. Labels and clocks are made this way, samples and spike counts
on a cluster. A stop is answered between two jobs. Finished results are stored, and the next run
makes the rest.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import active_children
from typing import TYPE_CHECKING, Any

from prefect import flow, task
from prefect.cache_policies import NO_CACHE
from prefect.settings import PREFECT_API_URL

from sliplab.analysis.trial_work import Make, TrialWork
from sliplab.flows.running import console, stopping
from sliplab.flows.running.orchestration import Opaque, Pickled, run
from sliplab.flows.running.run_records import timed
from sliplab.storage.process import out_of_reach
from sliplab.storage.remote.mirror import open_for_trial, place_of
from sliplab.storage.schema.document import Document
from sliplab.storage.schema.trial import SyncResult
from sliplab.storage.spawn_context import WORKERS, check_work
from sliplab.storage.streams import Json
from sliplab.storage.trials.derived import Arrays, Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import StoreError, TrialStore

if TYPE_CHECKING:
    from sliplab.flows.running.cluster import Cluster

CHUNK = 64
"""Largest number of jobs in a task, which a lost worker loses and a stop on a cluster waits for."""
SHARES = 4
"""Chunks per core of a cluster, so that no core waits long for the last one."""

Piece = Callable[[Any], Any]
Done = Callable[[int, Any], None]


class WorkerKilled(RuntimeError):
    """A worker process was killed; results that were returned before are stored."""


def parallel_map(
    name: str, piece: Piece, jobs: Sequence[Any], done: Done, cluster: Cluster | None = None
) -> None:
    """Call `piece` on every job. Must run in a flow; with a cluster, in one that runs on it.

    Args:
        name: display name.
        done: called in this thread with a job's number and its result, in any order.

    Raises:
        KeyboardInterrupt: a stop was requested; jobs that had not begun are not started.
        WorkerKilled: a process of this machine that did the work was killed.
        MainModuleError: the work needs the script that runs.
    """
    if not jobs:
        return
    if cluster is not None:
        _on_cluster(name, piece, jobs, done, cluster)
        return
    check_work(piece, jobs[0])
    local = _local_chunk.with_options(name=f"{name} trials")
    workers = max(1, min(len(jobs), os.cpu_count() or 1))
    with ProcessPoolExecutor(
        workers, mp_context=WORKERS, initializer=stopping.leave_to_parent
    ) as pool:
        try:
            for start in range(0, len(jobs), CHUNK):
                local(Opaque((piece, jobs[start : start + CHUNK], start, pool, done)))
        except BrokenProcessPool:
            raise WorkerKilled(
                f"{name}: a worker process was killed, perhaps because memory was short; what was "
                "made is kept; run the same command to resume"
            ) from None
        except BaseException:
            for worker in active_children():
                worker.terminate()  # what a worker had not provided is simply made again
            raise


@flow(name="parallel jobs", validate_parameters=False, persist_result=False)
def parallel_map_flow(
    name: str, piece: Piece, jobs: Sequence[Any], done: Done, cluster: Cluster | None = None
) -> None:
    """Run jobs as `parallel_map` does, for a caller that is not in a flow.

    It is in a module, since Prefect sends a flow along with its tasks.
    """
    parallel_map(name, piece, jobs, done, cluster)


@task(name="chunk of trials", cache_policy=NO_CACHE, persist_result=False)
def _local_chunk(
    argument: Opaque[tuple[Piece, Sequence[Any], int, ProcessPoolExecutor, Done]],
) -> int:
    """Run jobs on all cores; pass each result on as soon as it is ready."""
    piece, jobs, start, pool, done = argument.content
    with out_of_reach():
        futures = {pool.submit(piece, job): start + k for k, job in enumerate(jobs)}
    for future in as_completed(futures):
        done(futures[future], future.result())
    return len(jobs)


def _on_cluster(name: str, piece: Piece, jobs: Sequence[Any], done: Done, cluster: Cluster) -> None:
    from sliplab.flows.running.cluster import this_program

    url = PREFECT_API_URL.value()
    if url is not None:
        cluster.check_server(url)
    size = max(1, min(CHUNK, len(jobs) // (SHARES * cluster.cores)))
    starts = range(0, len(jobs), size)
    remote = _remote_chunk.with_options(name=f"{name} trials")
    program = this_program()
    futures = [
        remote.submit(Pickled((piece, jobs[start : start + size], program))) for start in starts
    ]

    def handed_over(number: int, results: list[Any]) -> None:
        for k, result in enumerate(results):
            done(starts[number] + k, result)

    try:
        cluster.gather(futures, handed_over)
    finally:
        cluster.report()


@task(name="chunk of trials", cache_policy=NO_CACHE, persist_result=False)
def _remote_chunk(payload: Pickled[tuple[Piece, Sequence[Any], dict[str, str]]]) -> list[Any]:
    """Run jobs one after another on a worker, which may have joined late."""
    from sliplab.flows.running.cluster import same_program

    piece, jobs, program = payload.content
    same_program(program)
    return [piece(job) for job in jobs]


START_S = 3.0
"""Time for which work runs in this process before others are started, which takes as long: what is
short is done by then, and what is long takes two starts at the most."""


@dataclass(frozen=True)
class TrialJob:
    """A trial as another process, perhaps on another machine, finds it.

    Attributes:
        place: the store's path or URL.
        checksum: what the trial and its clocks must be there, too.
        clocks: those that were fitted again; None for the record's.
    """

    place: str
    campaign: str
    trial: str
    checksum: str
    clocks: SyncResult | None
    make: Make
    settings: Any


def trial_job(store: TrialStore, work: TrialWork, make: Make) -> TrialJob:
    """Return some work as another process can do it, by `make_in_process`."""
    recording = work.recording
    return TrialJob(
        place_of(store),
        work.campaign,
        recording.folder.name,
        recording.checksum,
        recording.clocks_elsewhere,
        make,
        work.settings,
    )


def run_trials(
    store: TrialStore,
    step: str,
    title: str,
    work: list[TrialWork],
    make: Make,
    cluster: Cluster | None = None,
) -> None:
    """Make every result of `work` and keep it among the derived results of `step`.

    Args:
        title: the step's display name.
    """
    if work:
        named = _trials_flow.with_options(name=title, validate_parameters=False)
        run(named, store, step, title, work, make, cluster, cluster=cluster)


@flow(name="trials", validate_parameters=False, persist_result=False)
def _trials_flow(
    store: TrialStore,
    step: str,
    title: str,
    work: list[TrialWork],
    make: Make,
    cluster: Cluster | None,
) -> None:
    """Compute missing and stale results of trials."""
    with timed(store, title):
        keep_trials(store, step, title, work, make, cluster)


def keep_trials(
    store: TrialStore,
    step: str,
    title: str,
    work: list[TrialWork],
    make: Make,
    cluster: Cluster | None = None,
    *,
    processes: bool = True,
) -> None:
    """Do the work of `run_trials` inside a flow that runs already."""
    with console.bar(f"{title} (trials)", len(work)) as bar:

        def keep(number: int, result: tuple[Json | Document, Arrays]) -> None:
            item = work[number]
            name = item.recording.folder.name
            Derived.of(store, step, item.campaign).write(name, item.key, *result)
            bar.advance(1, name)

        each_trial(store, title, work, make, keep, cluster, processes=processes)


def each_trial(
    store: TrialStore,
    title: str,
    work: Sequence[TrialWork],
    make: Make,
    done: Done,
    cluster: Cluster | None = None,
    *,
    processes: bool = True,
) -> None:
    """Pass on the result of `make` for every trial, in any order. Call it inside a flow.

    Args:
        done: called with the number of an item of `work` and its result.
        processes: without a cluster, use all cores; False where `make` does that by itself, or
            takes little time. Either way the first ones are made here, for `START_S`.
    """
    here = 0
    if cluster is None:
        began = time.monotonic()
        while here < len(work) and not (processes and time.monotonic() - began >= START_S):
            done(here, make(work[here].recording, work[here].settings))
            here += 1
    jobs = [trial_job(store, item, make) for item in work[here:]]
    if cluster is not None and jobs:
        cluster.check_store(_find, jobs[0])
    parallel_map(
        title, make_in_process, jobs, lambda number, made: done(here + number, made), cluster
    )


def _find(job: TrialJob) -> None:
    """Check on a worker that it can read the trial. Raises as `_recording`."""
    _recording(job)


def make_in_process(job: TrialJob) -> Any:
    """Return what a job makes of its trial."""
    return job.make(_recording(job), job.settings)


def _recording(job: TrialJob) -> Recording:
    """Return the trial. Raises StoreError if it cannot be read, or is another take."""
    store = open_for_trial(job.place, job.campaign, job.trial)
    recording = store.campaign(job.campaign).recording(job.trial)
    recording.use_clocks(job.clocks)
    if recording.checksum != job.checksum:
        raise StoreError(f"{recording.folder}: was replaced while the command ran; run it again")
    return recording
