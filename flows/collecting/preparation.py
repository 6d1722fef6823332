"""What a protocol asks for before a trial: changes that a person makes, and depth zero."""

from __future__ import annotations

from sliplab.protocols import Plan, PlannedTrial, Task
from sliplab.protocols.hashing import hash_integer
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.rig import Rig, TouchedZero


def ask(rig: Rig, task: Task) -> None:
    """Ask the operator to do a task. Raises RigError if it is not confirmed."""
    if not rig.operator.ask(task.request, task.prompt, task.expected):
        raise RigError("operator", f"'{task.prompt}' was not confirmed")


def change_over(rig: Rig, plan: Plan, before: PlannedTrial | None, trial: PlannedTrial) -> None:
    """Ask for each change between two trials; a plate that is already mounted stays.

    Raises:
        RigError: a change was not confirmed, or the rig detects another plate.
    """
    for task in plan.changeovers(before, trial):
        if not task.mounts_plate:
            ask(rig, task)
        elif not _mounted(rig, plan, trial):
            ask(rig, task)
            if not _mounted(rig, plan, trial):
                raise RigError("plate", f"{task.prompt}: the rig detects another mass")


def _mounted(rig: Rig, plan: Plan, trial: PlannedTrial) -> bool:
    """Check that the plate that the trial needs hangs on the slider, to a gram."""
    mass = plan.mass_kg(trial)
    return mass is None or rig.plate is None or abs(rig.plate.mass_kg() - mass) < 1e-3


def find_zero(rig: Rig, plan: Plan, trial: PlannedTrial) -> TouchedZero | None:
    """Find the depth zero that a trial relies on; None where the protocol asks for none.

    Raises:
        RigError: a touch failed.
    """
    collection = plan.protocol.collection
    if collection.maintenance.rezero is None:
        return None
    seed = hash_integer(collection.seed, "rezero", plan.rezero_task(trial).slot)
    return rig.rezero(collection.maintenance.rezero, seed)
