"""One RTDE client of a stand-in UR controller: what it asked to read, and what it may write.

Names and types as in the maker's RTDE guide, for all that ur_rtde 1.6.5 asks for.
"""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from sliplab.rigs.devices.ur.fake_program import UrProgram
from sliplab.rigs.devices.ur.rtde import HEADER, TYPES

_UINT32 = {"robot_status_bits", "safety_status_bits", "runtime_state"}
_INT32 = {"robot_mode", "safety_mode"}
_UINT64 = {"actual_digital_input_bits", "actual_digital_output_bits"}
_SCALARS = {
    "timestamp", "actual_execution_time", "speed_scaling", "target_speed_fraction",
    "actual_momentum", "actual_main_voltage", "actual_robot_voltage", "actual_robot_current",
    "payload",
}  # fmt: skip
_VECTORS = {
    "joint_mode": "VECTOR6INT32",
    "payload_cog": "VECTOR3D",
    "actual_tool_accelerometer": "VECTOR3D",
    **dict.fromkeys(
        (
            "actual_TCP_force", "actual_TCP_pose", "actual_TCP_speed", "actual_current",
            "actual_joint_voltage", "actual_q", "actual_qd", "ft_raw_wrench",
            "joint_control_output", "joint_temperatures", "payload_inertia", "target_TCP_pose",
            "target_TCP_speed", "target_current", "target_moment", "target_q", "target_qd",
            "target_qdd", "external_force_torque",
        ),
        "VECTOR6D",
    ),
}  # fmt: skip
_UNKNOWN, _IN_USE = "NOT_FOUND", "IN_USE"
"""The controller's answers, in place of a type."""
_LAYOUT = TYPES | {"VECTOR3D": "3d", "VECTOR6INT32": "6i"}
_COUNT = {"VECTOR3D": 3, "VECTOR6D": 6, "VECTOR6INT32": 6}


@dataclass(eq=False)
class Client:
    """One RTDE connection."""

    writer: asyncio.StreamWriter
    every: int = 1
    """One packet in so many controller cycles."""
    streaming: bool = False
    _names: list[str] = field(default_factory=list)
    _kinds: list[str] = field(default_factory=list)
    _readers: list[Callable[[float], int | float | list[float]]] = field(default_factory=list)
    _layout: struct.Struct = field(default_factory=lambda: struct.Struct(">"))
    _recipes: dict[int, list[str]] = field(default_factory=dict)

    def ask_outputs(self, body: bytes, cycle_hz: int) -> bytes:
        """The answer to a request for outputs: recipe 1, or 0 if one is unknown, and types."""
        (hz,) = struct.unpack_from(">d", body)
        self._names = [name for name in body[8:].decode().split(",") if name]
        self._kinds, self._readers = [_kind(name) for name in self._names], []
        if _UNKNOWN in self._kinds:
            kinds, self._names, self._kinds = self._kinds, [], []
            return b"\x00" + ",".join(kinds).encode()
        self.every = max(1, round(cycle_hz / hz))
        self._layout = struct.Struct(">" + "".join(_LAYOUT[kind] for kind in self._kinds))
        return b"\x01" + ",".join(self._kinds).encode()

    def ask_inputs(self, body: bytes, others: Sequence[Client]) -> bytes:
        """The answer to a request for inputs.

        An input belongs to the client that asked for it first, for as long as it stays.
        """
        names = [name for name in body.decode().split(",") if name]
        taken = {name for other in others for recipe in other._recipes.values() for name in recipe}
        kinds = [_IN_USE if name in taken else _kind(name) for name in names]
        if {_IN_USE, _UNKNOWN} & set(kinds):
            return b"\x00" + ",".join(kinds).encode()
        recipe = len(self._recipes) + 1
        self._recipes[recipe] = names
        return bytes([recipe]) + ",".join(kinds).encode()

    def take(self, program: UrProgram, body: bytes) -> None:
        """Write one packet's inputs into the program."""
        names = self._recipes.get(body[0], [])
        if not all("register" in name for name in names):
            return  # an external force, which nothing here feels
        values = struct.unpack(">" + "".join(TYPES[_kind(name)] for name in names), body[1:])
        # The command last: its parameters must be there when it is seen.
        for name, value in sorted(zip(names, values, strict=True), key=_command_last):
            program.write(name, value)

    def packet(self, program: UrProgram, t_s: float) -> bytes:
        """The body of one packet of outputs."""
        if len(self._readers) != len(self._names):
            self._readers = [program.reader(name) for name in self._names]
        flat: list[int | float] = []
        for read, kind in zip(self._readers, self._kinds, strict=True):
            value = read(t_s)
            if kind in _COUNT:
                flat.extend(value if isinstance(value, list) else [0] * _COUNT[kind])
            else:
                assert not isinstance(value, list)
                flat.append(value)
        return b"\x01" + self._layout.pack(*flat)


def send(writer: asyncio.StreamWriter, command: int, body: bytes) -> None:
    """Send one RTDE package, unless the client has left."""
    if not writer.is_closing():
        writer.write(HEADER.pack(HEADER.size + len(body), command) + body)


def _command_last(pair: tuple[str, int | float]) -> bool:
    return pair[0] == "input_int_register_0"


def _kind(name: str) -> str:
    if "_int_register_" in name or name in _INT32:
        return "INT32"
    if "_double_register_" in name or name in _SCALARS or name.startswith("standard_analog"):
        return "DOUBLE"
    if name in _UINT32:
        return "UINT32"
    if name in _UINT64:
        return "UINT64"
    return _VECTORS.get(name, _UNKNOWN)
