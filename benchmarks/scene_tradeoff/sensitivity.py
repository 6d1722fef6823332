"""Sensitivity of a simulated scene's onsets and event rates to its assumed numbers.

Onsets come from the contact alone, which many trials can afford; event rates come from whole runs
of a few trials.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks import scene_parameters as assumed
from benchmarks.one_slide import run_slide
from benchmarks.scene_parameters import SceneOutcome
from benchmarks.scene_tradeoff.variants import Variant
from benchmarks.scene_tradeoff.windows import SceneWindows, look, pooled
from sliplab.analysis.sweeps.runner import sample_trials
from sliplab.plugins.simulation.levels import HIGHEST, slides_of
from sliplab.plugins.simulation.physics import springs_of
from sliplab.plugins.simulation.scene_runs import SceneRun, changed, run, with_true_times
from sliplab.plugins.simulation.settings import MockSettings, scene_of, skin_of
from sliplab.protocols import Plan, PlannedTrial
from sliplab.protocols.program import Move
from sliplab.rigs.physics_levels import with_level
from sliplab.rigs.rig_file import RigFile

CONTACT_TRIALS = 12
"""Trials that onsets are taken from."""
EVENT_TRIALS = 2
"""Trials that are run as a whole, for event rates."""
STEP_MM = 0.05
"""Step of the contact in a slide that is simulated by contact alone, mm."""
Each = Callable[..., list[Any]]
"""Call a function on jobs, and ``done=`` after each; return all results in order."""


@dataclass(frozen=True)
class OutcomeJob:
    """A setting of a sensitivity analysis.

    Attributes:
        known: an outcome that has the onsets of this one; None where they may differ.
    """

    rig: RigFile
    plan: Plan
    trials: Sequence[PlannedTrial]
    other_seed: bool = False
    known: SceneOutcome | None = None


def outcome(job: OutcomeJob, advance: Callable[[], None] | None = None) -> SceneOutcome:
    """Return onsets by contact alone, and event rates of whole runs of the first trials.

    Args:
        advance: called after each whole run.
    """
    rig, plan, analysis = job.rig, job.plan, job.plan.protocol.analysis
    variant = Variant(HIGHEST, scene_of(rig).scene.step_ms, other_seed=job.other_seed)
    seen: list[SceneRun] = []
    counted: list[SceneWindows] = []
    for trial in job.trials[:EVENT_TRIALS]:
        seen.append(run(with_true_times(rig), plan, trial, variant.seed(trial)))
        counted.append(look(seen[-1], analysis.windows, analysis.samples, trial.seed))
        if advance is not None:
            advance()
    rates = pooled(counted)["events_per_s"]
    if job.known is not None:
        return SceneOutcome(job.known.onsets_s, rates)
    onsets = [_slide_onsets(scene_of(rig), plan, t, variant.seed(t)) for t in job.trials]
    slides = [onset for onset in onsets if onset is not None]
    # a falling plate has no contact-only run: its whole runs are taken
    known = slides or [_seen_onsets(item) for item in seen]
    return SceneOutcome(np.array(known, np.float64).reshape(-1, 2), rates)


def _slide_onsets(
    mock: MockSettings, plan: Plan, trial: PlannedTrial, seed: int
) -> tuple[float, float] | None:
    """Return first slip and duration of incipient slip by contact alone, s; None: no slide."""
    slides = slides_of(replace(plan, trials=(trial,)))
    if not slides:
        return None
    (slide,) = slides
    steps = plan.program(trial).steps
    at = next(step.to for step in steps if isinstance(step, Move) and step.phase == "press")
    to = next(step.to for step in steps if isinstance(step, Move) and step.phase == "slide")
    done = run_slide(
        springs_of(mock, skin_of(mock), seed),
        slide.depth_mm,
        slide.speed_mm_s,
        math.degrees(math.atan2(to.y_mm - at.y_mm, to.x_mm - at.x_mm)),
        length_mm=at.distance_mm(to),
        press_mm_s=slide.press_mm_s,
        settled_s=slide.settled_s,
        step_mm=STEP_MM,
    )
    slipped = done.slipped_s
    first = float(np.nanmin(slipped)) if np.isfinite(slipped).any() else math.nan
    return first, float(slipped[0]) - first


def _seen_onsets(seen: SceneRun) -> tuple[float, float]:
    first, centre = (math.nan if slip is None else slip * 1e-9 for slip in seen.slips)
    return first, centre - first


def measure_sensitivity(
    rig: RigFile, plan: Plan, advance: Callable[[], None], each: Each | None = None
) -> dict[str, Any]:
    """Return the change of onsets and event rates by each assumed number, as `sensitivity_table`.

    Args:
        advance: called after each whole run, or, with `each`, after a setting's runs.
        each: makes the settings elsewhere.
    """
    rig = with_level(rig, plan)
    trials = sample_trials(plan, CONTACT_TRIALS)
    base = outcome(OutcomeJob(rig, plan, trials), advance)
    names = assumed.CONTACT + assumed.CAMERA
    values = {name: assumed.value_of(scene_of(rig), name) for name in names}
    other_seed = assumed.ParameterSetting()
    jobs = {other_seed: OutcomeJob(rig, plan, trials, other_seed=True)}
    # without a rigid base, or something else that is switched off
    for setting in assumed.lower_and_higher([name for name, value in values.items() if value]):
        known = base if setting.parameter in assumed.CAMERA else None
        other = changed(rig, setting.change(scene_of(rig)))
        jobs[setting] = OutcomeJob(other, plan, trials, known=known)
    if each is None:
        made = [outcome(job, advance) for job in jobs.values()]
    else:
        made = each(outcome, list(jobs.values()), done=advance)
    outcomes = dict(zip(jobs, made, strict=True))
    event_trials = min(EVENT_TRIALS, len(trials))
    return assumed.sensitivity_table(values, base, outcomes, outcomes.pop(other_seed), event_trials)
