"""The virtual clock, the sliding plate and the person at the simulated rig."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

from sliplab.protocols.program import PlateAction
from sliplab.rigs.core.capabilities import ArmState, RigError
from sliplab.rigs.core.people import mass_of
from sliplab.rigs.mock.jogging import hold_board, jog
from sliplab.rigs.mock.world import World

_TRACELESS = {"clean", "warm_up", "rezero"}
_LONGEST_S = 3600.0


class VirtualClock:
    """The host's clock of a simulated rig: it stands still unless somebody waits.

    It starts at 0 with every trial, so that host times in a recording depend on the trial alone.
    """

    def __init__(self, world: World) -> None:
        self._world = world

    def now_ns(self) -> int:
        """True nanoseconds since the trial began."""
        return self._world.now_ns

    def wait(self, seconds: float) -> None:
        """Let `seconds` of virtual time pass."""
        if not seconds >= 0.0:
            raise ValueError(f"seconds = {seconds}: must not be negative")
        self._world.pass_time(round(seconds * 1e9))


class MockPlate:
    """The plate on its slider."""

    def __init__(self, world: World) -> None:
        self._world = world

    def act(self, action: PlateAction, seconds: float) -> None:
        """Raise and hold, release over `seconds`, or catch.

        Raises:
            RigError: another action, or a time that cannot be.
        """
        if action not in get_args(PlateAction) or not 0.0 <= seconds < _LONGEST_S:
            raise RigError("plate", f"'{action}' over {seconds} s is not simulated")
        self._world.act(action, seconds)

    def mass_kg(self) -> float:
        """Mass mounted now."""
        return self._world.mass_kg


@dataclass(frozen=True)
class Asked:
    """One thing that the operator was asked to do."""

    task: str
    prompt: str
    expected: str


class SimulatedOperator:
    """Does at once what it is asked, and says so.

    `changeover` mounts the mass that `expected` names (``0.205 kg``); `protective_stop` clears a
    stop at the pendant; `jog` brings the tip to a point and `board` holds a printed board before
    the camera (`rigs.mock.jogging`). What leaves no trace in the simulation is only confirmed.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        self.asked: list[Asked] = []

    def ask(self, task: str, prompt: str, expected: str) -> bool:
        """Do it, and confirm.

        Raises:
            RigError: a changeover whose expected mass cannot be read, or a task that is not
                simulated.
        """
        self.asked.append(Asked(task, prompt, expected))
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
