"""What Prefect costs a collection of 864 empty trials, in the shape of `flows.collect`.

One flow, a task for every 25 trials. `loop_ms` is the bare loop; `batched_ms` is what the flow
takes over it, to the flow's end, and with what it leaves for the server to do: the time that an
empty flow right behind it takes longer than another empty flow after that. Both are for all 864
together. `empty_flow_ms` is what any flow costs. The server is started before the clock runs.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from benchmarks.measure import RUNS, Figures, alternate, spread
from flows.orchestration import Parcel, prepare, run


def measure(trials: int = 864, runs: int = RUNS) -> Figures:
    """Milliseconds for `trials` empty steps, bare and in batches."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        prepare(Path(folder))  # before Prefect is imported
        return _compare(trials, runs)


def _compare(trials: int, runs: int) -> Figures:
    from prefect import flow, task
    from prefect.cache_policies import NO_CACHE

    from flows.collect import MOCK_BATCH

    def step(trial: int) -> int:
        return trial

    @task(name="trials", cache_policy=NO_CACHE, persist_result=False)
    def take(part: Parcel[range]) -> int:
        return sum(1 for trial in part.content if step(trial) >= 0)

    @flow(name="collect", validate_parameters=False, persist_result=False)
    def collect(wanted: Parcel[range]) -> int:
        every = wanted.content
        return sum(
            take(Parcel(every[at : at + MOCK_BATCH])) for at in range(0, len(every), MOCK_BATCH)
        )

    @flow(name="empty", validate_parameters=False, persist_result=False)
    def empty(wanted: Parcel[None]) -> None:
        assert wanted.content is None

    def loop() -> int:
        return sum(1 for trial in range(trials) if step(trial) >= 0)

    def batched() -> None:
        done: Any = run(collect, Parcel(range(trials)))
        if done != trials:
            raise RuntimeError(f"{done} of {trials} steps were taken")

    def alone() -> None:
        run(empty, Parcel(None))

    taken = alternate(runs, loop=loop, batched=batched, behind=alone, empty=alone)
    over = [
        1e3 * (full + max(0.0, behind - empty_s) - bare)
        for full, behind, empty_s, bare in zip(
            taken["batched"], taken["behind"], taken["empty"], taken["loop"], strict=True
        )
    ]
    return {
        **spread("loop_ms", [each * 1e3 for each in taken["loop"]]),
        **spread("batched_ms", over),
        **spread("empty_flow_ms", [each * 1e3 for each in taken["empty"]]),
    }
