"""What 20 % more or less of each guessed number of the scene changes: onsets and event rates.

None of these numbers was measured on a real skin. Which of them are worth measuring first is told
by what a fifth of each does. Onsets come from contact alone, over trials spread over the plan;
event rates from whole runs of two trials, with noise and read-out as the rig file has them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sliplab.analysis.sweeps.scene_error import Seen
from sliplab.analysis.sweeps.scene_windows import PHASES, SceneWindows, look, pooled
from sliplab.flows.searching.scene_runs import Variant, changed, run, sample_trials, with_true_times
from sliplab.protocols import Plan, Trial
from sliplab.protocols.program import Move
from sliplab.rigs.levels import slides_of, with_level
from sliplab.rigs.mock.physics import springs_of
from sliplab.rigs.mock.settings import MockSettings
from sliplab.rigs.mock.skins import skin_of
from sliplab.rigs.rig_file import RigFile
from sliplab.rigs.scene.slides import run_slide

CHANGE = 0.2
EVENT_TRIALS, CONTACT_TRIALS = 2, 12
STEP_MM = 0.05
LARGEST_POISSON = 0.499
CONTACT = (
    "scene.skin.youngs_modulus_mpa", "scene.skin.poisson_ratio",
    "scene.skin.base_normal_n_per_m", "scene.skin.base_tangential_n_per_m",
    "scene.skin.height_scatter_mm", "scene.skin.relaxation_share", "scene.skin.relaxation_s",
    "scene.friction.kinetic", "scene.friction.static_excess", "scene.friction.strengthening",
    "scene.friction.path_variation", "scene.friction.correlation_mm",
    "scene.friction.papilla_scatter",
)  # fmt: skip
CAMERA = tuple(
    f"event_camera.{name}"
    for name in (
        "shift_mm_per_n", "growth_mm_per_n", "radius_mm", "edge_px", "contrast", "threshold",
        "threshold_sigma", "refractory_us", "noise_hz", "readout_hz",
    )
)  # fmt: skip
OTHER_SEED = "another seed"


@dataclass(frozen=True)
class _Outcome:
    """What a setting gave: onsets of each trial (first slip, incipient duration, s; NaN: none)."""

    onsets_s: np.ndarray[Any, np.dtype[np.float64]]
    rates: dict[str, float | None]


def runs_needed() -> int:
    """How many whole runs `measure_sensitivity` makes at most."""
    return EVENT_TRIALS * (2 + 2 * len(CONTACT + CAMERA))


@dataclass(frozen=True)
class _Job:
    """A setting that is tried.

    Attributes:
        known_s: onsets that do not depend on it.
    """

    rig: RigFile
    plan: Plan
    trials: list[Trial]
    other_seed: bool = False
    known_s: np.ndarray[Any, np.dtype[np.float64]] | None = None


Each = Callable[..., list[Any]]
"""Of a function, jobs and ``done=``, which is called after each: what came of all, in order."""


def measure_sensitivity(
    rig: RigFile, plan: Plan, advance: Callable[[], None], each: Each | None = None
) -> dict[str, Any]:
    """Change of onsets and event rates for each parameter, 20 % lower and higher, as JSON.

    Args:
        advance: called after each whole run, or, with `each`, after a setting's runs.
        each: makes the settings elsewhere.

    Returns:
        `rows`, each with `parameter`, `value`, and `change`: a list of two (lower, higher) of
        `first_slip_ms`, `first_slip_percent`, `incipient_percent` and by phase `percent`; None
        where there is nothing to compare. The last row is another seed and has one change.
    """
    rig = with_level(rig, plan)
    trials = sample_trials(plan, CONTACT_TRIALS)
    base = _outcome(_Job(rig, plan, trials), advance)
    jobs = {(OTHER_SEED, 0): _Job(rig, plan, trials, other_seed=True)}
    for name in CONTACT + CAMERA:
        value = value_of(rig.scene, name)
        for k, factor in enumerate((1.0 - CHANGE, 1.0 + CHANGE)):
            if not value:
                continue  # a rigid base, or something switched off
            new = value * factor
            if name.endswith("poisson_ratio"):
                new = min(new, LARGEST_POISSON)
            other = changed(rig, nested(name, new))
            onsets = base.onsets_s if name in CAMERA else None
            jobs[name, k] = _Job(other, plan, trials, known_s=onsets)
    if each is None:
        made = [_outcome(job, advance) for job in jobs.values()]
    else:
        made = each(_outcome, list(jobs.values()), done=advance)
    changes = {key: _change(base, other) for key, other in zip(jobs, made, strict=True)}
    rows = [
        {
            "parameter": name,
            "value": value_of(rig.scene, name),
            "change": [changes.get((name, k)) for k in range(2)],
        }
        for name in CONTACT + CAMERA
    ]
    rows.append({"parameter": OTHER_SEED, "value": None, "change": [changes[OTHER_SEED, 0]]})
    return {
        "simulated": True,
        "change": CHANGE,
        "contact_trials": len(base.onsets_s),
        "event_trials": min(EVENT_TRIALS, len(trials)),
        "base": {
            "first_slip_s": _mean(base.onsets_s[:, 0]),
            "incipient_s": _mean(base.onsets_s[:, 1]),
            "events_per_s": base.rates,
        },
        "rows": rows,
    }


def _outcome(job: _Job, advance: Callable[[], None] | None = None) -> _Outcome:
    rig, plan, trials, known_s = job.rig, job.plan, job.trials, job.known_s
    analysis = plan.protocol.analysis
    variant = Variant("", 3, rig.scene.scene.step_ms, other_seed=job.other_seed)
    seen: list[Seen] = []
    counted: list[SceneWindows] = []
    for trial in trials[:EVENT_TRIALS]:
        seen.append(run(with_true_times(rig), plan, trial, variant.seed(trial)))
        counted.append(look(seen[-1], analysis.windows, analysis.samples, trial.seed))
        if advance is not None:
            advance()
    if known_s is None:
        onsets = [_slide_onsets(rig.scene, plan, trial, variant.seed(trial)) for trial in trials]
        slides = [onset for onset in onsets if onset is not None]
        # a falling plate has no contact-only run: whole ones tell
        known = slides or [_seen_onsets(item) for item in seen]
        known_s = np.array(known, np.float64).reshape(-1, 2)
    return _Outcome(known_s, pooled(counted)["events_per_s"])


def _slide_onsets(
    mock: MockSettings, plan: Plan, trial: Trial, seed: int
) -> tuple[float, float] | None:
    """First slip and duration of incipient slip by contact alone, s; None without a slide."""
    slides = slides_of(replace(plan, trials=(trial,)))
    if not slides:
        return None
    (slide,) = slides
    steps = plan.program(trial).steps
    at = next(step.to for step in steps if isinstance(step, Move) and step.phase == "press")
    to = next(step.to for step in steps if isinstance(step, Move) and step.phase == "slide")
    done = run_slide(
        springs_of(mock, skin_of(mock), seed), slide.depth_mm, slide.speed_mm_s,
        math.degrees(math.atan2(to.y_mm - at.y_mm, to.x_mm - at.x_mm)),
        length_mm=at.distance_mm(to), press_mm_s=slide.press_mm_s, settled_s=slide.settled_s,
        step_mm=STEP_MM,
    )  # fmt: skip
    slipped = done.slipped_s
    first = float(np.nanmin(slipped)) if np.isfinite(slipped).any() else math.nan
    return first, float(slipped[0]) - first


def _seen_onsets(seen: Seen) -> tuple[float, float]:
    first, centre = (math.nan if slip is None else slip * 1e-9 for slip in seen.slips)
    return first, centre - first


def _change(base: _Outcome, other: _Outcome) -> dict[str, Any]:
    both = np.isfinite(base.onsets_s) & np.isfinite(other.onsets_s)
    apart = np.where(both, other.onsets_s - base.onsets_s, np.nan)
    first = _mean(apart[:, 0])
    whole = [_mean(np.where(both, base.onsets_s, np.nan)[:, k]) for k in range(2)]
    return {
        "first_slip_ms": None if first is None else 1e3 * first,
        "first_slip_percent": _percent(first, whole[0]),
        "incipient_percent": _percent(_mean(apart[:, 1]), whole[1]),
        "percent": {
            phase: _percent(_less(other.rates[phase], base.rates[phase]), base.rates[phase])
            for phase in PHASES
        },
    }


def _less(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else a - b


def _percent(part: float | None, whole: float | None) -> float | None:
    return None if part is None or not whole else 100.0 * part / whole


def _mean(values: np.ndarray[Any, np.dtype[np.float64]]) -> float | None:
    there = values[np.isfinite(values)]
    return float(there.mean()) if len(there) else None


def value_of(mock: MockSettings, name: str) -> float | None:
    """A setting of a simulated rig by its dotted name."""
    value: Any = mock
    for part in name.split("."):
        value = getattr(value, part)
    return None if value is None else float(value)


def nested(name: str, value: float) -> dict[str, Any]:
    """A value by its dotted name as mappings in each other."""
    *above, last = name.split(".")
    found: dict[str, Any] = {last: value}
    for part in reversed(above):
        found = {part: found}
    return found
