"""Reading a binary motion program as the RAPID module on an ABB controller reads it.

Layout from abb_motion_program_exec's RAPID module (`motion_program_exec.mod`, file version 10011):
little-endian float32 throughout; strings are a length and 32 characters.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from sliplab.rigs.core.capabilities import Pose
from sliplab.rigs.core.pose import from_quaternion

FILE_VERSION = 10011
_MOVE_L, _WAIT = 3, 5
_WORK_OBJECT_BEFORE, _WORK_OBJECT_AFTER = 2, 14
_LOAD = 11


class ProgramError(ValueError):
    """Not a motion program, or one with commands that are not known here."""


@dataclass(frozen=True)
class MoveL:
    """One straight move."""

    to: Pose
    speed_mm_s: float


@dataclass(frozen=True)
class Wait:
    """Standing still for some seconds."""

    seconds: float


@dataclass(frozen=True)
class Program:
    """A whole motion program without EGM commands."""

    tool: Pose
    tool_mass_kg: float
    commands: tuple[MoveL | Wait, ...]


class _Reader:
    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    @property
    def ended(self) -> bool:
        return self._at >= len(self._data)

    def numbers(self, count: int) -> tuple[float, ...]:
        try:
            values = struct.unpack_from(f"<{count}f", self._data, self._at)
        except struct.error:
            raise ProgramError("the file ends too soon") from None
        self._at += 4 * count
        return values

    def number(self) -> float:
        return self.numbers(1)[0]

    def skip_text(self) -> None:
        self.number()
        self._at += 32

    def pose(self) -> Pose:
        values = self.numbers(7)
        return from_quaternion(values[:3], values[3:])


def read_program(data: bytes) -> Program:
    """The motion program in a file's bytes. Raises ProgramError."""
    reader = _Reader(data)
    if reader.number() != FILE_VERSION:
        raise ProgramError("another file version")
    reader.number()  # the robot holds the tool
    tool = reader.pose()
    mass_kg = reader.numbers(_LOAD)[0]
    reader.numbers(_WORK_OBJECT_BEFORE)
    reader.skip_text()
    reader.numbers(_WORK_OBJECT_AFTER + _LOAD)
    reader.skip_text()
    reader.number()  # sequence number
    if reader.number() != 0:
        raise ProgramError("EGM commands are not known here")
    commands: list[MoveL | Wait] = []
    while not reader.ended:
        _, operation = reader.numbers(2)
        if operation == _MOVE_L:
            to = reader.pose()
            reader.numbers(4 + 6)  # configuration, external axes
            speed = reader.numbers(4)[0]
            reader.numbers(7)  # zone: every point is a fine point here
            commands.append(MoveL(to, speed))
        elif operation == _WAIT:
            commands.append(Wait(reader.number()))
        else:
            raise ProgramError(f"the command {operation:g} is not known here")
    return Program(tool, mass_kg, tuple(commands))
