"""The fake reads what the real client writes, and refuses the rest."""

from __future__ import annotations

import pytest
from abb_motion_program_exec.abb_motion_program_exec_client import MotionProgram
from abb_motion_program_exec.commands import egm_commands
from abb_motion_program_exec.commands.rapid_types import (
    confdata,
    fine,
    jointtarget,
    loaddata,
    pose,
    robtarget,
    speeddata,
    tooldata,
)

from sliplab.plugins.devices.abb.fake import MoveL, ProgramError, Wait, read_program

LOAD = loaddata(0.4, [0, 0, 50], [1, 0, 0, 0], 0, 0, 0)
SPEED = speeddata(1.6, 500, 5000, 1000)


def test_moves_waits_and_tool_are_read() -> None:
    program = MotionProgram(tool=tooldata(True, pose([0, 0, 120], [1, 0, 0, 0]), LOAD))
    target = robtarget([400, -15, 300], [0, 1, 0, 0], confdata(0, 0, 0, 1), [0] * 6)
    program.MoveL(target, SPEED, fine)
    program.WaitTime(0.5)
    found = read_program(program.get_program_bytes())
    move, wait = found.commands
    assert found.tool.xyz_mm == (0, 0, 120)
    assert found.tool_mass_kg == pytest.approx(0.4)
    assert isinstance(move, MoveL)
    assert move.to.xyz_mm == (400, -15, 300)
    assert move.to.rotvec_deg == pytest.approx((180, 0, 0))
    assert move.speed_mm_s == pytest.approx(1.6)
    assert wait == Wait(0.5)


def test_what_is_not_known_is_refused() -> None:
    joints = MotionProgram()
    joints.MoveAbsJ(jointtarget([0] * 6, [0] * 6), SPEED, fine)
    egm = MotionProgram(
        egm_config=egm_commands.EGMPathCorrectionConfig(pose([0] * 3, [1, 0, 0, 0]))
    )
    for data in (
        joints.get_program_bytes(),
        egm.get_program_bytes(),
        MotionProgram().get_program_bytes()[:40],
        b"\0\0\0\0",
    ):
        with pytest.raises(ProgramError):
            read_program(data)
