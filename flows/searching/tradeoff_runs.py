"""The runs behind the trade-off: comparing falls into trials, timing is done here, one at a time.

What two runs differ by is the same on any machine, so comparisons may go to a Dask cluster. Seconds
are those of this machine, measured before anything is sent away, with nothing of ours beside.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from sliplab.analysis.sweeps.scene_error import SceneError, Seen, compare
from sliplab.analysis.sweeps.scene_windows import SceneWindows, look
from sliplab.flows.searching.scene_runs import Variant, ideal, run, timed
from sliplab.protocols import Plan, Trial
from sliplab.rigs.levels import HIGHEST
from sliplab.rigs.rig_file import RigFile

if TYPE_CHECKING:
    from sliplab.flows.running.cluster import Cluster

REFERENCE = Variant("1", HIGHEST, 1)
OTHER_SEED = Variant("another seed", HIGHEST, 1, other_seed=True)

Key = tuple[int, int, str, bool]
Families = Mapping[str, Sequence[Variant]]


def variant_key(variant: Variant) -> Key:
    """What a run depends on, whatever it is called."""
    return variant.level, variant.step_ms, variant.path, variant.other_seed


@dataclass(frozen=True)
class Comparing:
    """One trial whose runs are to be compared."""

    rig: RigFile
    plan: Plan
    trial: Trial
    families: Families


@dataclass(frozen=True)
class Compared:
    """What came of one trial.

    Attributes:
        errors: against the reference, by family and variant.
        gaps: of each level against the next one; seed: of another seed.
        onsets: the reference without its events.
    """

    errors: dict[str, list[SceneError]]
    gaps: dict[int, SceneError]
    seed: SceneError
    windows: SceneWindows
    onsets: Seen


def compare_trial(job: Comparing, advance: Callable[[], None] | None = None) -> Compared:
    """Run every variant of a trial once, and hold it against the reference."""
    analysis = job.plan.protocol.analysis
    seen: dict[Key, Seen] = {}

    def of(variant: Variant) -> Seen:
        key = variant_key(variant)
        if key not in seen:
            rig, seed = variant.of(job.rig), variant.seed(job.trial)
            seen[key] = run(ideal(rig), job.plan, job.trial, seed)
            if advance is not None:
                advance()
        return seen[key]

    reference = of(REFERENCE)
    errors = {
        name: [compare(reference, of(variant), analysis.windows) for variant in family]
        for name, family in job.families.items()
    }
    levels = [of(variant) for variant in job.families["levels"]]
    return Compared(
        errors,
        {k: compare(levels[k], levels[k - 1], analysis.windows) for k in (1, 2)},
        compare(reference, of(OTHER_SEED), analysis.windows),
        look(reference, analysis.windows, analysis.samples, job.trial.seed),
        replace(reference, events=None),
    )


def wall_seconds(job: Comparing, rounds: int, advance: Callable[[], None]) -> dict[Key, float]:
    """Seconds of each variant: the fastest of some rounds; other work rarely meets all of them."""
    found: dict[Key, float] = {}
    wanted = {variant_key(item): item for family in job.families.values() for item in family}
    for _ in range(rounds):
        for key, variant in wanted.items():
            rig, seed = variant.of(job.rig), variant.seed(job.trial)
            seconds = timed(rig, job.plan, job.trial, seed)
            found[key] = min(seconds, found.get(key, math.inf))
            advance()
    return found


def everywhere(
    piece: Callable[[Any], Any],
    jobs: Sequence[Any],
    cluster: Cluster,
    done: Callable[[], None],
) -> list[Any]:
    """`piece` of every job, by a cluster's workers; results in the jobs' order.

    Args:
        done: called in this thread after each.
    """
    from sliplab.flows.running.orchestration import Opaque
    from sliplab.flows.running.orchestration import run as orchestrate
    from sliplab.flows.running.parallel_map import parallel_map_flow

    found: dict[int, Any] = {}

    def keep(number: int, result: Any) -> None:
        found[number] = result
        done()

    orchestrate(parallel_map_flow, Opaque(("trade-off", piece, jobs, keep, cluster)), cluster)
    return [found[number] for number in range(len(jobs))]


def total_runs(families: Families, trials: int, rounds: int) -> tuple[int, int]:
    """How many runs of one trial are compared, and how many all timings are."""
    wanted = {variant_key(item) for family in families.values() for item in family}
    compared = wanted | {variant_key(REFERENCE), variant_key(OTHER_SEED)}
    return len(compared), rounds * len(wanted) * trials
