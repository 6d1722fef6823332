"""`sliplab tradeoff --scene`: what each way of simulating a trial costs, and how far off it is.

Every variant runs the same trials with the same seeds. It is timed as the rig file has it, and
compared with the dearest variant without noise and read-out, so that the scene alone differs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sliplab.analysis.sweeps.scene_error import (
    SceneError,
    choose_by_windows,
    compare,
    mean_error,
)
from sliplab.analysis.sweeps.scene_windows import pooled
from sliplab.flows.running import console, orchestration
from sliplab.flows.running.cluster import connected
from sliplab.flows.searching.scene_runs import Variant, closed_form, sample_trials, timed
from sliplab.flows.searching.sensitivity import measure_sensitivity, runs_needed
from sliplab.flows.searching.tradeoff_page import render, sensitivity_markdown
from sliplab.flows.searching.tradeoff_runs import (
    REFERENCE,
    Comparing,
    compare_trial,
    everywhere,
    total_runs,
    variant_key,
    wall_seconds,
)
from sliplab.protocols import Plan
from sliplab.protocols.errors import InputError
from sliplab.protocols.plan import load_plan
from sliplab.rigs.levels import HIGHEST, at_level, choose_level
from sliplab.rigs.rig_file import RigFile, check_plan, load_rig_file
from sliplab.storage.files import make_folder, write_json, write_text

if TYPE_CHECKING:
    from sliplab.flows.running.cluster import Cluster

ROUNDS = 2
STEPS = (1, 2, 4, 8, 16, 32)
PAGE, NUMBERS, TABLE = "tradeoff.html", "tradeoff.json", "sensitivity.md"


def tradeoff(
    protocol: Path,
    rig_path: Path,
    folder: Path,
    trials: int = 4,
    sensitivity: bool = False,
    steps: Sequence[int] = STEPS,
    dask: str | None = None,
) -> dict[str, Any]:
    """Measure, and write page and numbers into `folder`; returns the numbers.

    Args:
        steps: of the contact, ms; the first is the reference's.
        dask: the scheduler whose workers run what is compared; seconds are measured here.

    Raises:
        InputError: anything wrong with the protocol or the rig file, a rig that is real, or a
            `folder` that is no folder.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError("--out", "", str(folder), "must be a folder")
    plan = load_plan(protocol)
    rig, _ = load_rig_file(rig_path)
    if not rig.simulated:
        raise InputError("--rig", "", str(rig_path), "must be a simulated rig: it has the scene")
    check_plan(rig, plan, str(rig_path))
    chosen = sample_trials(plan, trials)
    families = variants_of(rig, plan, steps)
    jobs = [Comparing(rig, plan, trial, families) for trial in chosen]
    compared, timings = total_runs(families, len(chosen), ROUNDS)
    total = len(chosen) * compared + timings
    if sensitivity:
        total += runs_needed()
    if dask is not None:
        make_folder(folder)
        orchestration.prepare(folder)
    with connected(dask) as cluster, console.bar("trade-off (runs)", total) as bar:
        result = _measure(jobs, bar, cluster, compared)
        if sensitivity:
            each = None if cluster is None else partial(everywhere, cluster=cluster)
            result["sensitivity"] = measure_sensitivity(rig, plan, lambda: bar.advance(), each)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / NUMBERS, result)
    if sensitivity:
        write_text(folder / TABLE, sensitivity_markdown(result["sensitivity"]))
    write_text(folder / PAGE, render(result))
    return result


def variants_of(rig: RigFile, plan: Plan, steps: Sequence[int]) -> dict[str, list[Variant]]:
    """What is compared, by family; each family but the levels has the reference's level.

    With a plate that may fall the contact steps by a millisecond whatever the rig file says, so
    only the rig's own step is there.
    """
    stated = rig.scene.scene.step_ms
    if falls(plan):
        steps = (stated,)
    return {
        "levels": [Variant(f"L{level}", level, stated) for level in (1, 2, 3)],
        "cubic": [Variant(str(step), HIGHEST, step) for step in steps],
        "chord": [Variant(str(step), HIGHEST, step, "chord") for step in steps],
    }


def falls(plan: Plan) -> bool:
    """Whether the protocol has a plate that may fall."""
    return plan.protocol.collection.plate is not None


def _measure(
    jobs: list[Comparing], bar: console.Bar, cluster: Cluster | None, compared: int
) -> dict[str, Any]:
    """All timings first, one at a time; then, perhaps elsewhere, what the runs differ by."""
    rig, plan, families = jobs[0].rig, jobs[0].plan, jobs[0].families
    timed(REFERENCE.of(rig), plan, jobs[0].trial, 0)  # so that compiling is not timed
    wall_s = [wall_seconds(job, ROUNDS, lambda: bar.advance()) for job in jobs]
    stated = [closed_form(rig, plan, job.trial) for job in jobs]
    if cluster is None:
        done = [compare_trial(job, lambda: bar.advance()) for job in jobs]
    else:
        done = everywhere(compare_trial, jobs, cluster, lambda: bar.advance(compared))
    windows = plan.protocol.analysis.windows
    closed = [
        (form[1], compare(item.onsets, replace(item.onsets, slips=form[0], markers=None), windows))
        for form, item in zip(stated, done, strict=True)
        if form is not None
    ]
    steps = {level: mean_error([item.gaps[level] for item in done]) for level in (1, 2)}
    seeds = mean_error([item.seed for item in done])
    measured = choose_by_windows(steps, seeds)
    reckoned = choose_level(at_level(rig, "auto"), plan)
    assert reckoned is not None
    rows = [
        _row(
            name,
            variant,
            _mean([seconds[variant_key(variant)] for seconds in wall_s]),
            mean_error([item.errors[name][index] for item in done]),
        )
        for name, family in families.items()
        for index, variant in enumerate(family)
    ]
    if closed:
        bare = mean_error([error for _, error in closed])
        rows.insert(0, _row("levels", Variant("L0", 0, 0), _mean([s for s, _ in closed]), bare))
    return {
        "simulated": True,
        "protocol": plan.protocol.name,
        "rig": rig.name,
        "rig_step_ms": rig.scene.scene.step_ms,
        "trials": [job.trial.id for job in jobs],
        "variants": rows,
        "seeds": asdict(seeds),
        "levels": {f"L{k} against L{k + 1}": asdict(error) for k, error in steps.items()},
        "choice": {
            "measured": {"level": f"L{measured.level}", "reason": measured.reason},
            "closed_form": {"level": reckoned.name, "reason": reckoned.reason},
            "agree": measured.level == reckoned.level,
        },
        "windows": pooled([item.windows for item in done]),
        "left_out": _left_out(plan, len(closed), len(jobs)),
    }


def _left_out(plan: Plan, closed: int, trials: int) -> list[str]:
    stated = []
    if falls(plan):
        stated.append(
            "Longer steps are left out: while a plate may fall the scene steps by a millisecond."
        )
    if closed < trials:
        stated.append(
            f"L0 is told for {closed} of {trials} trials: a retraction that also goes sideways "
            "has no closed form."
        )
    return stated


def _row(family: str, variant: Variant, wall_s: float, error: SceneError) -> dict[str, Any]:
    return {
        "family": family,
        "name": variant.name,
        "level": f"L{variant.level}",
        "step_ms": variant.step_ms or None,
        "path": variant.path if variant.level else None,
        "rows_per_s": variant.rows_per_s,
        "wall_s": wall_s,
        "error": asdict(error),
    }


def _mean(values: Sequence[float]) -> float:
    return math.fsum(values) / len(values)
