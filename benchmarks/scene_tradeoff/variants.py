"""The scene's trade-off: variants of one simulated scene, each with its cost and its error.

Every variant is run on the same trials with the same seeds and compared with the dearest one, so
that the scene alone differs. The function that runs a variant is an argument.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from benchmarks.scene_tradeoff.error import SceneError, choose_by_windows, compare, mean_error
from benchmarks.scene_tradeoff.windows import SceneWindows, look, pooled
from sliplab.plugins.simulation.scene_runs import Onsets, SceneRun
from sliplab.protocols import PlannedTrial
from sliplab.protocols.hashing import hash_integer
from sliplab.protocols.settings import AnalysisSettings
from sliplab.protocols.windows import Windows
from sliplab.storage.streams import Json

HIGHEST = 3
"""The highest level of physics."""


@dataclass(frozen=True)
class Variant:
    """One method to simulate a trial; level 0 is closed forms, without any run."""

    level: int
    step_ms: int
    path: Literal["cubic", "chord"] = "cubic"
    other_seed: bool = False

    @property
    def change(self) -> Json:
        """Settings of the simulated rig, as mappings in each other."""
        scene = {"level": f"L{self.level}", "step_ms": self.step_ms}
        return {"scene": scene, "event_camera": {"path": self.path}, "faults": ()}

    def seed(self, trial: PlannedTrial) -> int:
        """Return the trial's seed, as a campaign's first attempt has it, or another one."""
        return hash_integer(trial.seed, "another seed" if self.other_seed else 0)


REFERENCE = Variant(HIGHEST, 1)
OTHER_SEED = replace(REFERENCE, other_seed=True)

Families = Mapping[str, Mapping[str, Variant]]
"""Variants by family and name."""


def make_families(stated_ms: int, steps_ms: Sequence[int]) -> dict[str, dict[str, Variant]]:
    """Return the compared variants; all families but the levels have the reference's level.

    Args:
        stated_ms: step of the contact in the rig file, which the levels have.
    """
    return {
        "levels": {f"L{level}": Variant(level, stated_ms) for level in range(1, HIGHEST + 1)},
        "cubic": {str(step): Variant(HIGHEST, step) for step in steps_ms},
        "chord": {str(step): Variant(HIGHEST, step, "chord") for step in steps_ms},
    }


def variants(families: Families) -> list[Variant]:
    """Return each variant of some families once, in order."""
    return list(dict.fromkeys(item for family in families.values() for item in family.values()))


@dataclass(frozen=True)
class VariantComparison:
    """Comparisons of the variants of one trial.

    Attributes:
        errors: against the reference, by variant.
        gaps: of each level against the next one; seed: of another seed.
        onsets: the reference without its events.
    """

    errors: dict[Variant, SceneError]
    gaps: dict[int, SceneError]
    seed: SceneError
    windows: SceneWindows
    onsets: SceneRun


def compare_variants(
    run: Callable[[Variant], SceneRun], families: Families, settings: AnalysisSettings, seed: int
) -> VariantComparison:
    """Run every variant of a trial once and compare it with the reference.

    Args:
        seed: of the random windows in incipient slip.
    """
    compared = dict.fromkeys([REFERENCE, *variants(families), OTHER_SEED])
    seen = {variant: run(variant) for variant in compared}
    reference, windows = seen[REFERENCE], settings.windows
    levels = [seen[variant] for variant in families["levels"].values()]
    return VariantComparison(
        {item: compare(reference, seen[item], windows) for item in variants(families)},
        {k: compare(levels[k], levels[k - 1], windows) for k in range(1, HIGHEST)},
        compare(reference, seen[OTHER_SEED], windows),
        look(reference, windows, settings.samples, seed),
        replace(reference, events=None),
    )


@dataclass(frozen=True)
class ClosedForm:
    """Onsets of a trial by closed forms, and the seconds that they took."""

    onsets: Onsets
    seconds: float


@dataclass(frozen=True)
class VariantRow:
    """One variant in the table: means over trials."""

    family: str
    name: str
    level: str
    step_ms: int | None
    path: str | None
    rows_per_s: float | None
    """Rows of the contact a second, which is how many segments a path has."""
    wall_s: float
    error: SceneError


def scene_numbers(
    families: Families,
    wall_s: Sequence[Mapping[Variant, float]],
    compared: Sequence[VariantComparison],
    closed: Sequence[ClosedForm | None],
    windows: Windows,
    planned: Mapping[str, str],
) -> Json:
    """Return rows, differences of seeds and levels, the choice of a level, and the samples.

    Args:
        wall_s: seconds of each variant, by trial; likewise the others.
        closed: None where a trial has no closed form.
        planned: level and reason of the choice that a plan makes by closed forms.
    """
    gaps = {k: mean_error([item.gaps[k] for item in compared]) for k in range(1, HIGHEST)}
    seeds = mean_error([item.seed for item in compared])
    measured = choose_by_windows(gaps, seeds)
    rows = [
        VariantRow(
            family,
            name,
            f"L{variant.level}",
            variant.step_ms,
            variant.path,
            1000.0 / variant.step_ms,
            _mean([seconds[variant] for seconds in wall_s]),
            mean_error([item.errors[variant] for item in compared]),
        )
        for family, members in families.items()
        for name, variant in members.items()
    ]
    stated = [(form, item) for form, item in zip(closed, compared, strict=True) if form is not None]
    if stated:
        errors = [
            compare(item.onsets, replace(item.onsets, slips=form.onsets, markers=None), windows)
            for form, item in stated
        ]
        seconds = _mean([form.seconds for form, _ in stated])
        rows.insert(
            0, VariantRow("levels", "L0", "L0", None, None, None, seconds, mean_error(errors))
        )
    return {
        "variants": [asdict(row) for row in rows],
        "seeds": asdict(seeds),
        "levels": {f"L{k} against L{k + 1}": asdict(error) for k, error in gaps.items()},
        "choice": {
            "measured": {"level": f"L{measured.level}", "reason": measured.reason},
            "closed_form": dict(planned),
            "agree": planned["level"] == f"L{measured.level}",
        },
        "windows": pooled([item.windows for item in compared]),
    }


def _mean(values: Sequence[float]) -> float:
    return math.fsum(values) / len(values)


def table_rows(result: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any]]]:
    """Return the rows of a stored result with their titles, and another seed as the last one."""
    rows = []
    for row in result["variants"]:
        title = row["level"]
        if row["step_ms"] is not None:
            title += f" {row['step_ms']} ms {row['path']}"
        if row["family"] == "cubic" and row["step_ms"] == result["rig_step_ms"]:
            continue  # the same run is among the levels
        rows.append((title, row))
    seed = {"rows_per_s": None, "wall_s": None, "error": result["seeds"]}
    return [*rows, ("another seed", seed)]
