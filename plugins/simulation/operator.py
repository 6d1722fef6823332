"""The virtual clock, the sliding plate and the operator of the simulated rig."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import numpy as np

from sliplab.plugins.simulation.path import matrix, rotvec_deg
from sliplab.plugins.simulation.scene.lens import VIEWS
from sliplab.plugins.simulation.scene.randomness import generator
from sliplab.plugins.simulation.world import SimulatedWorld
from sliplab.protocols.program import PlateAction
from sliplab.rigs.core.capabilities import ArmState, Pose, RigError, Segment
from sliplab.rigs.core.operators import mass_of

_TRACELESS = {"clean", "condition", "warm_up", "rezero"}
_LONGEST_S = 3600.0


class VirtualClock:
    """The host's clock of a simulated rig, which advances only in `wait`.

    It starts at 0 with every trial, so that host times in a recording depend only on the trial.
    """

    def __init__(self, world: SimulatedWorld) -> None:
        self._world = world

    def now_ns(self) -> int:
        """Return the true nanoseconds since the trial began."""
        return self._world.now_ns

    def wait(self, seconds: float) -> None:
        """Let `seconds` of virtual time pass."""
        if not seconds >= 0.0:
            raise ValueError(f"seconds = {seconds}: must not be negative")
        self._world.pass_time(round(seconds * 1e9))


class MockPlate:
    """The plate on its slider."""

    def __init__(self, world: SimulatedWorld) -> None:
        self._world = world

    def act(self, action: PlateAction, seconds: float) -> None:
        """Raise and hold, release over `seconds`, or catch.

        Raises:
            RigError: an unknown action, or an implausible time.
        """
        if action not in get_args(PlateAction) or not 0.0 <= seconds < _LONGEST_S:
            raise RigError("plate", f"'{action}' over {seconds} s is not simulated")
        self._world.act(action, seconds)

    def mass_kg(self) -> float:
        """Mass mounted now."""
        return self._world.mass_kg


@dataclass(frozen=True)
class OperatorRequest:
    """One request to the operator."""

    task: str
    prompt: str
    expected: str


class SimulatedOperator:
    """A simulated operator, who does every request at once and confirms it.

    `changeover` mounts the mass that `expected` names (``0.205 kg``); `protective_stop` clears a
    stop at the pendant; `jog` moves the tip to a point; `board` holds a printed board in front of
    the camera. Tasks without an effect in the simulation, such as a `condition` (another skin, a
    temperature), are only confirmed.
    """

    def __init__(self, world: SimulatedWorld) -> None:
        self._world = world
        self.asked: list[OperatorRequest] = []

    def ask(self, task: str, prompt: str, expected: str) -> bool:
        """Do the task, and confirm it.

        Raises:
            RigError: a changeover whose expected mass cannot be read, or a task that is not
                simulated.
        """
        self.asked.append(OperatorRequest(task, prompt, expected))
        if task == "changeover":
            self._world.mass_kg = mass_of(expected)
        elif task == "protective_stop":
            self._world.arm_state = ArmState.READY
        elif task == "jog":
            return jog(self._world, expected)
        elif task == "board":
            hold_board(self._world, expected)
        elif task not in _TRACELESS:
            raise RigError("operator", f"task '{task}' is not simulated")
        return True


HAND_MM = 0.02
"""Standard deviation of the operator's final position, along each axis."""
PIN_MM = (0.0, 0.0, -40.0)
"""Point of the pin for pivoting, in plate coordinates."""
_TOUCHED = {
    "centre": (0.0, 0.0),
    "right": (12.0, 0.0),
    "above": (0.0, 12.0),
    "check": (-9.0, -9.0),
}
_SPEED_MM_S = 20.0


def jog(world: SimulatedWorld, expected: str) -> bool:
    """Move the tip as `expected` says (``touched right``, ``pivot 3``); others do nothing.

    Returns:
        False if the arm is not healthy, so that it cannot be jogged.
    """
    what, _, which = expected.partition(" ")
    if what == "touched" and which in _TOUCHED:
        target = world.plane.pose(*_TOUCHED[which], 0.0)
        out = world.plane.pose(*_TOUCHED[which], -10.0)
    elif what == "pivot" and which.isdigit():
        target = out = _pivoted(world, int(which))
    else:
        return True
    if not world.arm_state.healthy:
        return False
    slip = HAND_MM * generator(world.settings.seed, f"hand {expected}").standard_normal(3)
    x, y, z = (np.array(target.xyz_mm) + slip).tolist()
    path = [Segment(out, _SPEED_MM_S), Segment(Pose((x, y, z), target.rotvec_deg), _SPEED_MM_S)]
    legs = world.start_arm(path)
    world.pass_time(legs[-1].end_ns - world.now_ns + 1)
    return True


def _pivoted(world: SimulatedWorld, number: int) -> Pose:
    """Return a pose with the tip on the pin, tilted in another direction for each number."""
    tilt, azimuth = np.radians(25.0), np.radians(100.0 * number)
    tilted = matrix(
        (
            float(np.degrees(tilt * np.cos(azimuth))),
            float(np.degrees(tilt * np.sin(azimuth))),
            15.0 * (number % 3 - 1),
        )
    )
    tool = world.plane.rotation @ tilted
    pin = world.plane.origin_mm + world.plane.rotation @ np.array(PIN_MM)
    x, y, z = (pin - tool @ world.plane.tip_mm).tolist()
    return Pose((x, y, z), rotvec_deg(tool))


def hold_board(world: SimulatedWorld, expected: str) -> None:
    """Hold up the board for a request such as ``view 3``, or remove it."""
    what, _, which = expected.partition(" ")
    world.board = VIEWS[int(which) % len(VIEWS)] if what == "view" and which.isdigit() else None
