"""Cost and error of each method to simulate a trial.

Every variant runs the same trials with the same seeds. It is timed as the rig file has it, on this
otherwise idle machine, and compared with the dearest variant without noise and
read-out, here or on a Dask cluster, so that the scene alone differs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks import scene_parameters as assumed
from benchmarks.scene_tradeoff import page, running
from benchmarks.scene_tradeoff.running import VariantJob, closed_form
from benchmarks.scene_tradeoff.sensitivity import EVENT_TRIALS, measure_sensitivity
from benchmarks.scene_tradeoff.variants import (
    REFERENCE,
    make_families,
    scene_numbers,
    variants,
)
from sliplab.analysis.sweeps.runner import sample_trials
from sliplab.flows.running import console, orchestration
from sliplab.flows.running.cluster import connected
from sliplab.plugins.simulation import scene_runs
from sliplab.plugins.simulation.levels import at_level, choose_level
from sliplab.plugins.simulation.scene_runs import changed
from sliplab.plugins.simulation.settings import scene_of
from sliplab.protocols.errors import InputError
from sliplab.protocols.plan import load_plan
from sliplab.rigs.rig_file import check_plan, load_rig_file
from sliplab.storage.files import make_folder, write_json, write_text

if TYPE_CHECKING:
    from sliplab.flows.running.cluster import Cluster

ROUNDS = 2
STEPS = (1, 2, 4, 8, 16, 32)
PAGE, NUMBERS, TABLE = "tradeoff.html", "tradeoff.json", "sensitivity.md"


def tradeoff_scene(
    protocol: Path,
    rig_path: Path,
    folder: Path,
    trials: int = 4,
    sensitivity: bool = False,
    steps: Sequence[int] = STEPS,
    dask: str | None = None,
) -> dict[str, Any]:
    """Measure, and write page and numbers into `folder`; return the numbers.

    Args:
        steps: of the contact, ms; the first is the reference's.
        dask: the scheduler whose workers run what is compared; seconds are measured here.

    Raises:
        InputError: anything wrong with the protocol or the rig file, a rig that is real, or a
            `folder` that is not a folder.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError("--out", "", str(folder), "must be a folder")
    plan = load_plan(protocol)
    rig, _ = load_rig_file(rig_path)
    if not rig.simulated:
        raise InputError("--rig", "", str(rig_path), "must be a simulated rig: it has the scene")
    check_plan(rig, plan, str(rig_path))
    # while a plate may fall the contact steps by a millisecond whatever the rig file says
    falls, stated = plan.protocol.collection.plate is not None, scene_of(rig).scene.step_ms
    families = make_families(stated, (stated,) if falls else steps)
    jobs = [VariantJob(rig, plan, trial, families) for trial in sample_trials(plan, trials)]
    count = len(variants(families))
    compared = len({*variants(families), REFERENCE}) + 1  # and another seed
    total = len(jobs) * (compared + ROUNDS * count)
    if sensitivity:
        total += EVENT_TRIALS * (2 + 2 * len(assumed.CONTACT + assumed.CAMERA))
    if dask is not None:
        make_folder(folder)
        orchestration.configure_prefect(folder)
    with connected(dask) as cluster, console.bar("trade-off (runs)", total) as bar:
        scene_runs.timed(changed(rig, REFERENCE.change), plan, jobs[0].trial, 0)  # compiles
        wall_s = [running.wall_seconds(job, ROUNDS, bar.advance) for job in jobs]
        closed = [closed_form(rig, plan, job.trial) for job in jobs]
        each = None if cluster is None else partial(everywhere, cluster=cluster)
        if each is None:
            done = [running.compare_trial(job, bar.advance) for job in jobs]
        else:
            done = each(running.compare_trial, jobs, done=lambda: bar.advance(compared))
        planned = choose_level(at_level(rig, "auto"), plan)
        result = {
            "simulated": True,
            "protocol": plan.protocol.name,
            "rig": rig.name,
            "rig_step_ms": stated,
            "trials": [job.trial.id for job in jobs],
            **scene_numbers(
                families,
                wall_s,
                done,
                closed,
                plan.protocol.analysis.windows,
                {"level": planned.name, "reason": planned.reason},
            ),
            "needs": {} if rig.twin is None else rig.twin.needs,
            "left_out": page.left_out(falls, sum(form is not None for form in closed), len(jobs)),
        }
        if sensitivity:
            result["sensitivity"] = measure_sensitivity(rig, plan, bar.advance, each)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / NUMBERS, result)
    if sensitivity:
        text = page.sensitivity_markdown(result["sensitivity"])
        write_text(folder / TABLE, text)
    write_text(folder / PAGE, page.render(result))
    return result


def everywhere(
    work: Callable[[Any], Any], jobs: Sequence[Any], cluster: Cluster, done: Callable[[], None]
) -> list[Any]:
    """Return `work` of every job, by a cluster's workers; results in the jobs' order.

    Args:
        done: called in this thread after each.
    """
    from sliplab.flows.running.parallel_map import parallel_map_flow

    found: dict[int, Any] = {}

    def keep(number: int, result: Any) -> None:
        found[number] = result
        done()

    orchestration.run(parallel_map_flow, "trade-off", work, jobs, keep, cluster, cluster=cluster)
    return [found[number] for number in range(len(jobs))]
