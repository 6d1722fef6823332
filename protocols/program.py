"""The motion program of one trial: the steps that a rig executes.

Coordinates are the plate's: `x` to the right and `y` up along the contact surface, origin at the
plate's centre, `depth` the indentation of the highest papilla tip (positive pressed in, negative
clear of the plate). The rig turns them into arm poses with its taught contact plane, so a
program is the same on every rig.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from sliplab.protocols.nuisances import AnyNuisance

ACTING = ("slide", "retract", "twist", "move")
"""Phases of a program in which the sensor moves in contact and slip is looked for."""
PlateAction = Literal["raise", "release", "catch"]


@dataclass(frozen=True)
class Position:
    """A place of the sensor's centre in plate coordinates, millimetres, and how it is turned.

    Attributes:
        twist_deg: rotation about the plate's normal, counterclockwise as the outside camera sees
            it (from x to y).
    """

    x_mm: float
    y_mm: float
    depth_mm: float
    twist_deg: float = 0.0

    def __repr__(self) -> str:
        twist = f", twist_deg={self.twist_deg!r}" if self.twist_deg else ""
        place = f"x_mm={self.x_mm!r}, y_mm={self.y_mm!r}, depth_mm={self.depth_mm!r}"
        return f"Position({place}{twist})"

    def distance_mm(self, other: Position) -> float:
        """Straight-line distance to `other`."""
        return math.dist(
            (self.x_mm, self.y_mm, self.depth_mm), (other.x_mm, other.y_mm, other.depth_mm)
        )


@dataclass(frozen=True)
class Move:
    """A straight move at constant speed (along the whole path, not per axis).

    Attributes:
        until_force_n: normal force at which a press ends, N; `to` is then the deepest that it may
            go, and later places in contact are as much less deep as it was.
    """

    phase: str
    to: Position
    speed_mm_s: float
    recorded: bool = False
    until_force_n: float | None = None

    def __repr__(self) -> str:
        force = "" if self.until_force_n is None else f", until_force_n={self.until_force_n!r}"
        move = f"phase={self.phase!r}, to={self.to!r}, speed_mm_s={self.speed_mm_s!r}"
        return f"Move({move}, recorded={self.recorded!r}{force})"


@dataclass(frozen=True)
class Dwell:
    """Standing still."""

    phase: str
    seconds: float
    recorded: bool = False


@dataclass(frozen=True)
class Twist:
    """A rotation of the sensor about the plate's normal at constant speed; it stays where it is."""

    phase: str
    to: Position
    speed_deg_s: float
    recorded: bool = False


@dataclass(frozen=True)
class PlateStep:
    """Something done to the sliding plate: `release` takes `seconds` as a ramp."""

    phase: str
    action: PlateAction
    seconds: float
    recorded: bool = False


Step = Move | Twist | Dwell | PlateStep


@dataclass(frozen=True)
class Program:
    """The steps of one trial in order; the arm begins and ends at `home`.

    Attributes:
        nuisances: what disturbs the trial besides the steps.
    """

    home: Position
    steps: tuple[Step, ...]
    nuisances: tuple[AnyNuisance, ...] = field(default=(), repr=False)

    def seconds(self, *, recorded_only: bool = False) -> float:
        """Planned duration, without the arm's ramps."""
        total, at = 0.0, self.home
        for step in self.steps:
            duration, at = step_seconds(step, at)
            if step.recorded or not recorded_only:
                total += duration
        return total


def step_seconds(step: Step, at: Position) -> tuple[float, Position]:
    """Duration of `step` begun at `at`, seconds, and where it ends."""
    if isinstance(step, Move):
        return at.distance_mm(step.to) / step.speed_mm_s, step.to
    if isinstance(step, Twist):
        return abs(step.to.twist_deg - at.twist_deg) / step.speed_deg_s, step.to
    return step.seconds, at
