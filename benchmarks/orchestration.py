"""Prefect's overhead per trial, compared with a bare loop and Bluesky; catalogue and start-up.

864 empty trials go through the task of `flows.collect`, 25 a task as on a mock rig
(`batched_ms`) and one a task as on a real one (`per_trial_ms`). Both are milliseconds a trial over
the bare loop, until the server has kept every task run as completed, and with what an empty flow
right behind takes longer than one after that. `bluesky_ms` is a run of the RunEngine a trial (open,
an empty message, close) and nothing that listens, `bluesky_plan_ms` one plan with all of them. The
server is started before the clock runs. Processor time stands beside wall time (`*_cpu_ms`: this
program and the server), for it tells more on a machine that has other things to do.

`catalogue_100k_s` is one filtered query over 100,000 trial records whose index is built;
`startup_s` from the command to the first motion of a mock rig in a new store, with the caches that
a first collection leaves; `memory_growth_mb` what this program holds more after 10,000 trials, one
a task, than after 1,000 (`server_growth_mb`: the server).
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.catalogues import catalogue_figures
from benchmarks.measure import RUNS, Figures, Seconds, alternate, spread
from benchmarks.start_up import startup_seconds
from sliplab.flows.running.orchestration import (
    Opaque,
    configure_prefect,
    embedded,
    run,
    start_server,
)

DRAIN_LIMIT_S = 120.0


class _EmptySession:
    """Stands where a session does: takes trials and does nothing."""

    def __init__(self) -> None:
        self.taken = 0

    def take(self, trials: range) -> None:
        """Take some."""
        for _ in trials:
            self.taken += 1


def measure(
    trials: int = 864,
    runs: int = RUNS,
    records: int = 100_000,
    starts: int = RUNS,
    long: int = 10_000,
) -> Figures:
    """Everything in one go."""
    figures: Figures = {}
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        configure_prefect(Path(folder))  # before Prefect is imported
        start_server()
        figures |= _compare(trials, runs)
        figures |= _memory(long)
    figures |= catalogue_figures(records, runs)
    if starts:
        figures |= spread("startup_s", startup_seconds(starts))
    return figures


def _flows() -> Any:
    """A flow of so many trials, so many a task, and one of none."""
    from prefect import flow
    from prefect.runtime import flow_run

    from sliplab.flows.collect import take_trials

    @flow(name="collect", validate_parameters=False, persist_result=False)
    def collect(every: range, size: int, look: Any) -> str:
        session: Any = _EmptySession()
        for at in range(0, len(every), size):
            take_trials(Opaque(session), Opaque(every[at : at + size]))
            look(session.taken)
        if session.taken != len(every):
            raise RuntimeError(f"{session.taken} of {len(every)} trials were taken")
        return str(flow_run.id)

    @flow(name="empty", validate_parameters=False, persist_result=False)
    def empty() -> None:
        pass

    return collect, empty


def _compare(trials: int, runs: int) -> Figures:
    from sliplab.flows.collect import BATCH

    collect, empty = _flows()
    every = range(trials)
    spent: dict[str, Seconds] = {"batched": [], "per_trial": []}

    def loop() -> None:
        _EmptySession().take(every)

    def through_prefect(name: str, size: int) -> None:
        before = time.process_time() + _server_cpu_s()
        run_id = run(collect, every, size, lambda taken: None)
        _drained(run_id, -(-trials // size))
        spent[name].append(time.process_time() + _server_cpu_s() - before)

    def alone() -> None:
        run(empty)

    one_plan, a_run_each = _bluesky(trials)
    taken = alternate(
        runs,
        loop=loop,
        batched=lambda: through_prefect("batched", BATCH),
        behind_batched=alone,
        per_trial=lambda: through_prefect("per_trial", 1),
        behind_per_trial=alone,
        empty=alone,
        bluesky=a_run_each,
        bluesky_plan=one_plan,
    )
    figures = spread("loop_ms", [1e3 * each / trials for each in taken["loop"]])
    for name in ("batched", "per_trial"):
        rounds = zip(
            taken[name], taken[f"behind_{name}"], taken["empty"], taken["loop"], strict=True
        )
        over = [full + max(0.0, behind - empty_s) - bare for full, behind, empty_s, bare in rounds]
        figures |= spread(f"{name}_ms", [1e3 * each / trials for each in over])
        figures[f"{name}_cpu_ms"] = 1e3 * median(spent[name][1:]) / trials
    for name in ("bluesky", "bluesky_plan"):
        over = [full - bare for full, bare in zip(taken[name], taken["loop"], strict=True)]
        figures |= spread(f"{name}_ms", [1e3 * each / trials for each in over])
    return figures | spread("empty_flow_ms", [1e3 * each for each in taken["empty"]])


def _bluesky(trials: int) -> Any:
    """All trials as one plan, and as a run of the engine each."""
    import bluesky.plan_stubs as bps
    from bluesky import RunEngine

    engine = RunEngine(context_managers=[])  # without its handler of Ctrl-C, which costs more

    def one() -> Any:
        yield from bps.open_run()
        yield from bps.null()
        yield from bps.close_run()

    def plan() -> Any:
        for _ in range(trials):
            yield from one()

    def a_run_each() -> None:
        for _ in range(trials):
            engine(one())

    return lambda: engine(plan()), a_run_each


def _memory(long: int) -> Figures:
    """Return the memory growth, MB, between a tenth of the trials and all of them."""
    from benchmarks.measure import resident_mb

    server = embedded()
    held: dict[int, tuple[float, float]] = {}

    def look(taken: int) -> None:
        for mark in (long // 10, long):
            if taken >= mark and mark not in held:
                held[mark] = (resident_mb(), resident_mb(server.pid))

    from sliplab.flows.collect import BATCH

    collect, _ = _flows()
    # in the batches of a collection: so many tasks of nothing at once are more than a server keeps
    run_id = run(collect, range(long), BATCH, look)
    _drained(run_id, -(-long // BATCH))
    (ours, its), (ours_late, its_late) = held[long // 10], held[long]
    return {"memory_growth_mb": ours_late - ours, "server_growth_mb": its_late - its}


def _server_cpu_s() -> float:
    """Return the server's processor time so far, s; 0 if the system does not report it."""
    try:
        fields = Path(f"/proc/{embedded().pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _drained(run_id: str, count: int) -> None:
    """Wait until the server has kept so many task runs of a flow run with their end."""
    wanted = {
        "flow_runs": {"id": {"any_": [run_id]}},
        "task_runs": {"state": {"type": {"any_": ["COMPLETED", "FAILED"]}}},
    }
    from prefect.client.orchestration import get_client
    from prefect.settings import temporary_settings

    end = time.monotonic() + DRAIN_LIMIT_S
    retained = 0
    with temporary_settings(embedded().settings()), get_client(sync_client=True) as client:
        while time.monotonic() < end:
            retained = client.request("POST", "/task_runs/count", json=wanted).json()
            if retained >= count:
                return
    raise RuntimeError(f"the server keeps {retained} of {count} task runs")
