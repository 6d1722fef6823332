"""A plan for people and for programs: the trials in order, and what it all comes to."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sliplab.flows.running import console
from sliplab.protocols import Plan

if TYPE_CHECKING:  # a plan without a rig is answered before numpy is loaded
    from sliplab.flows.planning.plan_scene import Scene


def as_json(found: Plan, needed: int | None, scene: Scene | None) -> dict[str, Any]:
    """The plan as one JSON object; `needed` is its bytes, None without a rig."""
    rows = [
        {
            "index": trial.index,
            "id": trial.id,
            "role": trial.role,
            "block": trial.block,
            "repetition": trial.repetition,
            "condition": found.describe(trial),
            "split": trial.split,
            "seconds": found.seconds(trial),
            "before": [
                {"kind": task.kind, "by_person": task.by_person, "prompt": task.prompt}
                for task in found.tasks_before(trial)
            ],
        }
        for trial in found
    ]
    return {
        "protocol": found.protocol.name,
        "trials": rows,
        "count": len(found),
        "seconds": found.total_seconds,
        "bytes": needed,
        "scene": scene.as_json() if scene else None,
        "stretches": found.stretches(),
        "warnings": found.warnings(),
    }


def show(found: Plan, needed: int | None, scene: Scene | None) -> None:
    """Print the plan as tables."""
    factors = list(found.protocol.collection.factors)
    table = []
    for trial in found:
        known = found.describe(trial)
        before = ", ".join(
            f"{task.kind} (person)" if task.by_person else task.kind
            for task in found.tasks_before(trial)
        )
        table.append(
            [
                trial.index,
                trial.block,
                *(known[name].split()[0] for name in factors),
                trial.repetition,
                trial.split if trial.role == "measured" else trial.role,
                f"{found.seconds(trial):.1f}",
                before,
            ]
        )
    units = {name: factor.unit for name, factor in found.protocol.collection.factors.items()}
    named = [f"{name} ({units[name]})" if units[name] else name for name in factors]
    columns = ["#", "block", *named, "rep.", "split", "motion (s)", "before it"]
    console.print_table(f"{found.file}: {found.protocol.title}", columns, table, limit=40)
    console.print_pairs(
        "In all",
        {
            "trials": len(found),
            "motion": console.duration(found.total_seconds),
            "disk": console.size(needed) if needed is not None else "give --rig to know",
            "stretches without a person": ", ".join(
                f"{last - first + 1} trials" for first, last in found.stretches()
            ),
        },
    )
    if scene is not None:
        console.print_pairs("The simulated scene", scene.as_pairs())
    for warning in found.warnings():
        console.say(f"note: {warning}")
