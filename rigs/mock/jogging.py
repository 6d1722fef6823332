"""What the simulated person does with hands: jogs the arm, holds a board before the camera."""

from __future__ import annotations

import numpy as np

from sliplab.rigs.core.capabilities import Pose, Segment
from sliplab.rigs.mock.geometry import matrix, rotvec_deg
from sliplab.rigs.mock.world import World
from sliplab.rigs.scene.lens import VIEWS
from sliplab.rigs.scene.randomness import generator

HAND_MM = 0.02
"""Standard deviation of where a person stops, along each axis."""
PIN_MM = (0.0, 0.0, -40.0)
"""The point of the pin that the tip is brought to, in the plate's coordinates."""
_TOUCHED = {
    "centre": (0.0, 0.0), "right": (12.0, 0.0), "above": (0.0, 12.0), "check": (-9.0, -9.0),
}  # fmt: skip
_SPEED_MM_S = 20.0


def jog(world: World, expected: str) -> bool:
    """Bring the tip to where `expected` says (``touched right``, ``pivot 3``); others do nothing.

    Returns:
        False where the arm is not healthy, and nobody can jog it.
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


def _pivoted(world: World, number: int) -> Pose:
    """The tip on the pin, the tool leaning another way each time."""
    lean, way = np.radians(25.0), np.radians(100.0 * number)
    leaning = matrix((
        float(np.degrees(lean * np.cos(way))), float(np.degrees(lean * np.sin(way))),
        15.0 * (number % 3 - 1),
    ))  # fmt: skip
    tool = world.plane.rotation @ leaning
    pin = world.plane.origin_mm + world.plane.rotation @ np.array(PIN_MM)
    x, y, z = (pin - tool @ world.plane.tip_mm).tolist()
    return Pose((x, y, z), rotvec_deg(tool))


def hold_board(world: World, expected: str) -> None:
    """Hold the board up as ``view 3`` wants it, or take it away."""
    what, _, which = expected.partition(" ")
    world.board = VIEWS[int(which) % len(VIEWS)] if what == "view" and which.isdigit() else None
