"""Work that falls into independent pieces: on all cores of this machine, or on a Dask cluster.

A piece is a function of one argument that stands in a module, best in one that loads quickly.
Results come back to the process that asked and are kept there, so they are the same files whoever
made them; a piece that was lost on its way is simply made again.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context
from typing import TYPE_CHECKING, Any

from prefect import flow, task
from prefect.cache_policies import NO_CACHE
from prefect.settings import PREFECT_API_URL

from sliplab.flows.running import stopping
from sliplab.flows.running.orchestration import Opaque, Pickled

if TYPE_CHECKING:
    from sliplab.flows.running.cluster import Cluster

CHUNK = 64
"""Most pieces in a task: what a lost worker loses, and what a stop on a cluster waits for."""
SHARES = 4
"""So many chunks a core of a cluster, so that none waits long for the last one."""

Piece = Callable[[Any], Any]
Done = Callable[[int, Any], None]


class WorkerKilled(RuntimeError):
    """A worker process was killed; what it and the others had handed over is kept."""


def spread(
    name: str, piece: Piece, jobs: Sequence[Any], done: Done, cluster: Cluster | None = None
) -> None:
    """Make `piece` of every job. Stands in a flow; with a cluster, in one that runs on it.

    Args:
        name: what people call it.
        done: called in this thread with a job's number and what came of it, in any order.

    Raises:
        KeyboardInterrupt: a stop was requested; what nobody had begun is not begun.
        WorkerKilled: a process of this machine that did the work was killed.
    """
    if not jobs:
        return
    if cluster is not None:
        _on_cluster(name, piece, jobs, done, cluster)
        return
    local = _local_chunk.with_options(name=f"{name} trials")
    workers = max(1, min(len(jobs), os.cpu_count() or 1))
    with ProcessPoolExecutor(
        workers, mp_context=get_context("spawn"), initializer=stopping.leave_to_parent
    ) as pool:
        try:
            for start in range(0, len(jobs), CHUNK):
                local(Opaque((piece, jobs[start : start + CHUNK], start, pool, done)))
        except BrokenProcessPool:
            raise WorkerKilled(
                f"{name}: a worker process was killed, perhaps because memory was short; what was "
                "made is kept; run the same command to go on"
            ) from None
        except BaseException:
            for worker in active_children():
                worker.terminate()  # what a worker had not handed over is simply made again
            raise


@flow(name="pieces", validate_parameters=False, persist_result=False)
def spread_flow(
    wanted: Opaque[tuple[str, Piece, Sequence[Any], Done, Cluster | None]],
) -> int:
    """`spread` for who has no flow. In a module: Prefect sends a flow along with its tasks."""
    spread(*wanted.content)
    return len(wanted.content[2])


@task(name="chunk of trials", cache_policy=NO_CACHE, persist_result=False)
def _local_chunk(
    argument: Opaque[tuple[Piece, Sequence[Any], int, ProcessPoolExecutor, Done]],
) -> int:
    """Some pieces on all cores; each is handed over as soon as it is there."""
    piece, jobs, start, pool, done = argument.content
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
    """Some pieces, one after the other, on a worker that may have joined after the others."""
    from sliplab.flows.running.cluster import same_program

    piece, jobs, program = payload.content
    same_program(program)
    return [piece(job) for job in jobs]
