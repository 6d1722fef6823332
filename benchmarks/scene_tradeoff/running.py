"""Runs of a trial on variants of its scene: by closed forms, compared, and timed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from benchmarks.scene_tradeoff.variants import (
    ClosedForm,
    Families,
    Variant,
    VariantComparison,
    compare_variants,
    variants,
)
from sliplab.plugins.simulation.levels import HIGHEST, expected_onsets, slides_of
from sliplab.plugins.simulation.scene.onsets import retraction_onsets
from sliplab.plugins.simulation.scene_runs import SceneRun, changed, ideal, run, timed
from sliplab.plugins.simulation.settings import scene_of, skin_of
from sliplab.protocols import Plan, PlannedTrial
from sliplab.protocols.program import Move
from sliplab.rigs.rig_file import RigFile


def closed_form(rig: RigFile, plan: Plan, trial: PlannedTrial) -> ClosedForm | None:
    """Return first slip and the centre's (or the plate's fall) at level L0.

    None if there is no closed form: a retraction that also goes sideways.
    """
    start = perf_counter()
    slides = slides_of(replace(plan, trials=(trial,)))
    if slides:
        onsets = expected_onsets(scene_of(rig), slides, HIGHEST)[0]
    else:
        mass_kg, steps = plan.mass_kg(trial), plan.program(trial).steps
        moves = [step for step in steps if isinstance(step, Move)]
        pressed = next(step.to for step in moves if step.phase == "press")
        pulled = next((step for step in moves if step.phase == "retract"), None)
        if mass_kg is None or pulled is None or pulled.to.x_mm != pressed.x_mm:
            return None
        onsets = np.array(
            retraction_onsets(
                skin_of(scene_of(rig)),
                scene_of(rig).scene.friction.kinetic,
                mass_kg,
                pressed.depth_mm,
                pulled.speed_mm_s,
                scene_of(rig).scene.plate.gravity_m_s2,
            )
        )
    seconds = perf_counter() - start
    first, last = (round(float(t) * 1e9) if np.isfinite(t) else None for t in onsets)
    return ClosedForm((first, last), seconds)


@dataclass(frozen=True)
class VariantJob:
    """One trial whose variants are timed and compared."""

    rig: RigFile
    plan: Plan
    trial: PlannedTrial
    families: Families


def compare_trial(job: VariantJob, advance: Callable[[], None] | None = None) -> VariantComparison:
    """Run every variant of a trial once and compare it with the reference.

    What two runs differ by is the same on any machine, so this may go to a Dask cluster.

    Args:
        advance: called after each run.
    """

    def seen(variant: Variant) -> SceneRun:
        rig, seed = ideal(changed(job.rig, variant.change)), variant.seed(job.trial)
        found = run(rig, job.plan, job.trial, seed)
        if advance is not None:
            advance()
        return found

    return compare_variants(seen, job.families, job.plan.protocol.analysis, job.trial.seed)


def wall_seconds(job: VariantJob, rounds: int, advance: Callable[[], None]) -> dict[Variant, float]:
    """Return seconds of each variant: the fastest of some rounds, which other work rarely meets."""
    found = dict.fromkeys(variants(job.families), math.inf)
    for _ in range(rounds):
        for variant in found:
            rig, seed = changed(job.rig, variant.change), variant.seed(job.trial)
            found[variant] = min(found[variant], timed(rig, job.plan, job.trial, seed))
            advance()
    return found
