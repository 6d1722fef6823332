"""What a protocol asks for before a trial: changes by a person, warm-up and depth zero."""

from __future__ import annotations

from sliplab.flows.running import console
from sliplab.protocols import Plan, PlannedTrial, Task
from sliplab.protocols.hashing import hash_integer
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.rig import RETRACT_SPEED_MM_S, Rig
from sliplab.rigs.core.surface_search import TouchedZero, rezero, touch_off
from sliplab.rigs.core.touching import QUIET_S
from sliplab.rigs.rig_file import RigFile


def announce(rig: RigFile, step: str) -> None:
    """Say what is being done where it takes real time: the bar moves after the first trial only."""
    if not rig.in_virtual_time:
        console.say(f"{step} ...")


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


def warm_up(rig: Rig, plan: Plan, trial: PlannedTrial) -> None:
    """Press the skin as a protocol asks for; a touch finds the surface before the first press.

    The depth of a press counts from depth zero, and nothing has measured it yet: a plane that was
    taught too deep, or another skin, would make every press too deep by as much. A rig without an
    event camera cannot touch off, and relies on its rig file.

    Raises:
        RigError: the touch or a press failed.
    """
    collection = plan.protocol.collection
    asked, touching = collection.maintenance.warm_up, collection.maintenance.rezero
    if asked is None:
        return
    if touching is not None and rig.event_camera is not None:
        # a seed of its own: the touches of `find_zero`, and the trials, stay what they were
        seed = hash_integer(collection.seed, "before warm-up", plan.rezero_task(trial).slot)
        touch_off(rig, float(touching.speed), float(touching.search), seed)
    rig.press(float(asked.depth), float(asked.speed), float(asked.clearance), asked.presses)


def preparation_seconds(rig: Rig, plan: Plan, *, warm: bool, zeroed: bool) -> float:
    """Return the planned time of warm-up and touches, without ramps, s.

    Args:
        warm: the skin is warm.
        zeroed: depth zero is found.
    """
    upkeep = plan.protocol.collection.maintenance
    pressed, touching = None if warm else upkeep.warm_up, upkeep.rezero
    out_mm_s = rig.at_most(RETRACT_SPEED_MM_S)
    seconds = 0.0
    if pressed is not None:
        way_mm = float(pressed.depth + pressed.clearance)
        seconds += pressed.presses * way_mm * (1 / float(pressed.speed) + 1 / out_mm_s)
    if touching is not None and rig.event_camera is not None:
        touches = (0 if zeroed else touching.touches) + (pressed is not None)
        way_mm = 2 * float(touching.search)  # from as far before the plane to as far beyond it
        seconds += touches * (QUIET_S + way_mm * (1 / float(touching.speed) + 1 / out_mm_s))
    return seconds


def find_zero(rig: Rig, plan: Plan, trial: PlannedTrial) -> TouchedZero | None:
    """Find the depth zero that a trial relies on; None where the protocol asks for none.

    Raises:
        RigError: a touch failed.
    """
    collection = plan.protocol.collection
    if collection.maintenance.rezero is None:
        return None
    seed = hash_integer(collection.seed, "rezero", plan.rezero_task(trial).slot)
    return rezero(rig, collection.maintenance.rezero, seed)
