"""`sliplab tradeoff --scene`: what each way of simulating a trial costs, and how far off it is.

Every variant runs the same trials with the same seeds. It is timed as the rig file has it, and
compared with the dearest variant without noise and read-out, so that the scene alone differs.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from analysis.scene_error import SceneError, Seen, choose_by_windows, compare, mean_error
from analysis.scene_windows import look, pooled
from flows import console
from flows.scene_runs import (
    Variant,
    closed_form,
    ideal,
    run,
    sample_trials,
    timed,
)
from flows.sensitivity import measure_sensitivity, runs_needed
from flows.tradeoff_page import render, sensitivity_markdown
from protocols import Plan, Trial
from protocols.errors import InputError
from protocols.plan import load_plan
from rigs.levels import HIGHEST, at_level, choose_level
from rigs.rig_file import RigFile, check_plan, load_rig_file
from storage.files import write_json, write_text

ROUNDS = 2
STEPS = (1, 2, 4, 8, 16, 32)
REFERENCE = Variant("1", HIGHEST, 1)
OTHER_SEED = Variant("another seed", HIGHEST, 1, other_seed=True)
PAGE, NUMBERS, TABLE = "tradeoff.html", "tradeoff.json", "sensitivity.md"


def tradeoff(
    protocol: Path,
    rig_path: Path,
    folder: Path,
    trials: int = 4,
    sensitivity: bool = False,
    steps: Sequence[int] = STEPS,
) -> dict[str, Any]:
    """Measure, and write page and numbers into `folder`; returns the numbers.

    Args:
        steps: of the contact, ms; the first is the reference's.

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
    wanted = {variant_key(item) for family in families.values() for item in family}
    compared = wanted | {variant_key(REFERENCE), variant_key(OTHER_SEED)}
    total = len(chosen) * (len(compared) + ROUNDS * len(wanted))
    if sensitivity:
        total += runs_needed()
    with console.bar("trade-off (runs)", total) as bar:
        result = _measure(rig, plan, chosen, families, bar)
        if sensitivity:
            result["sensitivity"] = measure_sensitivity(rig, plan, lambda: bar.advance())
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
    told = rig.scene.scene.step_ms
    if falls(plan):
        steps = (told,)
    return {
        "levels": [Variant(f"L{level}", level, told) for level in (1, 2, 3)],
        "cubic": [Variant(str(step), HIGHEST, step) for step in steps],
        "chord": [Variant(str(step), HIGHEST, step, "chord") for step in steps],
    }


def falls(plan: Plan) -> bool:
    """Whether the protocol has a plate that may fall."""
    return plan.protocol.collection.plate is not None


def variant_key(variant: Variant) -> tuple[int, int, str, bool]:
    """What a run depends on, whatever it is called."""
    return variant.level, variant.step_ms, variant.path, variant.other_seed


class _Runs:
    """Runs of one trial, each compared once and timed in two rounds."""

    def __init__(self, rig: RigFile, plan: Plan, trial: Trial, bar: console.Bar) -> None:
        self._rig, self._plan, self._trial, self._bar = rig, plan, trial, bar
        self._seen: dict[tuple[int, int, str, bool], Seen] = {}

    def of(self, variant: Variant) -> Seen:
        key = variant_key(variant)
        if key not in self._seen:
            rig, seed = variant.of(self._rig), variant.seed(self._trial)
            self._seen[key] = run(ideal(rig), self._plan, self._trial, seed)
            self._bar.advance(1, self._trial.id)
        return self._seen[key]

    def wall_s(self, variants: Iterable[Variant]) -> dict[tuple[int, int, str, bool], float]:
        """The faster of two runs of each; a burst of other work rarely meets both rounds."""
        wall_s: dict[tuple[int, int, str, bool], float] = {}
        wanted = {variant_key(variant): variant for variant in variants}
        for _ in range(ROUNDS):
            for key, variant in wanted.items():
                rig, seed = variant.of(self._rig), variant.seed(self._trial)
                seconds = timed(rig, self._plan, self._trial, seed)
                wall_s[key] = min(seconds, wall_s.get(key, math.inf))
                self._bar.advance(1, self._trial.id)
        return wall_s


def _measure(
    rig: RigFile,
    plan: Plan,
    trials: list[Trial],
    families: dict[str, list[Variant]],
    bar: console.Bar,
) -> dict[str, Any]:
    analysis = plan.protocol.analysis
    walls: dict[str, list[list[float]]] = {name: [[] for _ in f] for name, f in families.items()}
    errors: dict[str, list[list[SceneError]]] = {
        name: [[] for _ in family] for name, family in families.items()
    }
    seeds: list[SceneError] = []
    gaps: dict[int, list[SceneError]] = {1: [], 2: []}
    closed: list[tuple[float, SceneError]] = []
    windows = []
    timed(REFERENCE.of(rig), plan, trials[0], 0)  # so that compiling is not timed
    for trial in trials:
        runs = _Runs(rig, plan, trial, bar)
        reference = runs.of(REFERENCE)
        wall_s = runs.wall_s(variant for family in families.values() for variant in family)
        for name, family in families.items():
            for index, variant in enumerate(family):
                errors[name][index].append(compare(reference, runs.of(variant), analysis.windows))
                walls[name][index].append(wall_s[variant_key(variant)])
        levels = [runs.of(variant) for variant in families["levels"]]
        for level in gaps:
            gaps[level].append(compare(levels[level], levels[level - 1], analysis.windows))
        seeds.append(compare(reference, runs.of(OTHER_SEED), analysis.windows))
        windows.append(look(reference, analysis.windows, analysis.samples, trial.seed))
        told = closed_form(rig, plan, trial)
        if told is not None:
            forms = replace(reference, events=None, slips=told[0], markers=None)
            closed.append((told[1], compare(reference, forms, analysis.windows)))
    steps = {level: mean_error(gap) for level, gap in gaps.items()}
    measured = choose_by_windows(steps, mean_error(seeds))
    reckoned = choose_level(at_level(rig, "auto"), plan)
    assert reckoned is not None
    rows = [
        _row(name, variant, _mean(walls[name][index]), mean_error(errors[name][index]))
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
        "trials": [trial.id for trial in trials],
        "variants": rows,
        "seeds": asdict(mean_error(seeds)),
        "levels": {f"L{k} against L{k + 1}": asdict(error) for k, error in steps.items()},
        "choice": {
            "measured": {"level": f"L{measured.level}", "reason": measured.reason},
            "closed_form": {"level": reckoned.name, "reason": reckoned.reason},
            "agree": measured.level == reckoned.level,
        },
        "windows": pooled(windows),
        "left_out": _left_out(plan, len(closed), len(trials)),
    }


def _left_out(plan: Plan, closed: int, trials: int) -> list[str]:
    told = []
    if falls(plan):
        told.append(
            "Longer steps are left out: while a plate may fall the scene steps by a millisecond."
        )
    if closed < trials:
        told.append(
            f"L0 is told for {closed} of {trials} trials: a retraction that also goes sideways "
            "has no closed form."
        )
    return told


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
