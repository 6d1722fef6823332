"""Conversion of a path to a motion program of abb-motion-program-exec 0.7.4 for ABB arms."""

from __future__ import annotations

from collections.abc import Sequence

from abb_motion_program_exec.abb_motion_program_exec_client import MotionProgram
from abb_motion_program_exec.commands.rapid_types import (
    confdata,
    fine,
    loaddata,
    pose,
    robtarget,
    speeddata,
    tooldata,
)

from sliplab.rigs.core.arm_settings import ToolSettings
from sliplab.rigs.core.capabilities import Pose, Segment
from sliplab.rigs.core.pose import quaternion

PAUSE_S = 0.05
"""Pause after each segment, so that its end can be detected, s."""
TURN_DEG_S = 20.0
"""Largest speed at which the tool turns in a move. The controller takes the longer of the times of
way and turn: a turn on a short way slows the move, instead of being made at once."""
_LINEAR_AXIS_MM_S, _TURNING_AXIS_DEG_S = 5000.0, 1000.0
_NO_AXES = [0.0] * 6


def motion_program(
    tool: ToolSettings, path: Sequence[Segment] = (), configuration: Sequence[float] = ()
) -> MotionProgram:
    """Build the program that follows `path` from rest to rest; without a path it sets the tool.

    Args:
        tool: tool on the flange.
        path: straight segments; the controller plans each at its speed.
        configuration: RAPID's `confdata` of the arm's current configuration (cf1, cf4, cf6, cfx).
    """
    program = MotionProgram(tool=_tooldata(tool))
    for segment in path:
        place, turn = list(segment.to.xyz_mm), list(quaternion(segment.to))
        target = robtarget(place, turn, confdata(*configuration), _NO_AXES)
        turn_deg_s = segment.turn_deg_s or TURN_DEG_S
        speed = speeddata(segment.speed_mm_s, turn_deg_s, _LINEAR_AXIS_MM_S, _TURNING_AXIS_DEG_S)
        program.MoveL(target, speed, fine)
        program.WaitTime(PAUSE_S)
    if not path:
        program.WaitTime(PAUSE_S)
    return program


def _tooldata(tool: ToolSettings) -> tooldata:
    frame = Pose(tool.tcp_mm, tool.tcp_rotvec_deg)
    centre = list(tool.centre_of_mass_mm)
    if not any(centre):
        centre = [0.0, 0.0, 0.001]  # RAPID refuses a load whose centre is the origin
    load = loaddata(max(tool.mass_kg, 0.001), centre, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0)
    return tooldata(True, pose(list(frame.xyz_mm), list(quaternion(frame))), load)
