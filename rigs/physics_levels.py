"""The physics level of a simulated rig's scene for a plan, as the rig's driver chooses it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypedDict

from sliplab.protocols.plan import Plan
from sliplab.rigs.core.driver import RigDriver
from sliplab.rigs.core.registry import find_driver
from sliplab.rigs.rig_file import RigFile


@dataclass(frozen=True)
class LevelChoice:
    """A level and the reason for it."""

    level: int
    reason: str

    @property
    def name(self) -> str:
        """Name of the level in rig files."""
        return f"L{self.level}"


class SlipExpected(TypedDict):
    """The slip to expect in a plan's slides: least and most, in seconds.

    Attributes:
        first_slip_s: after the start of the slide; incipient_s: duration of incipient slip.
    """

    simulated: bool
    first_slip_s: list[float]
    incipient_s: list[float]


@dataclass(frozen=True)
class PhysicsLevels:
    """How a driver of simulated rigs chooses the level of physics that a plan needs.

    Attributes:
        choose: the level for a plan.
        at: the rig file with its scene at a level by its name, such as L2.
        stated: the name of the level in a rig file.
        expected: the slip to expect; None for a plan without slides.
    """

    choose: Callable[[RigFile, Plan], LevelChoice]
    at: Callable[[RigFile, str], RigFile]
    stated: Callable[[RigFile], str]
    expected: Callable[[RigFile, Plan], SlipExpected | None]


def levels_of(rig: RigFile) -> PhysicsLevels | None:
    """Return what chooses the physics of a rig; None on a real one."""
    make = find_driver(rig.driver, RigDriver).levels
    levels: PhysicsLevels | None = None if make is None else make()
    return levels


def with_level(rig: RigFile, plan: Plan) -> RigFile:
    """Return the rig file with its scene at the level chosen for a plan; a real rig as it is."""
    levels = levels_of(rig)
    return rig if levels is None else levels.at(rig, levels.choose(rig, plan).name)
