"""A fake Universal Robots e-Series controller on its three ports.

30004 RTDE, 29999 dashboard, 30003 scripts. The clients fix these ports, so every robot has its own
loopback address (127.0.0.2, .3, ...). ur_rtde 1.6.5's control, receive and dashboard clients accept
it as a PolyScope 5.11 (tested). Its clock may run faster than the host's.

To run it in a separate process: ``python -m sliplab.plugins.devices.ur.fake 127.0.0.2``.
"""

from __future__ import annotations

import argparse
import asyncio
import struct
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

from sliplab.plugins.devices.ur.fake_program import Load, Safety, UrProgram
from sliplab.plugins.devices.ur.rtde import (
    DATA,
    GET_VERSION,
    HEADER,
    PAUSE,
    REQUEST_PROTOCOL_VERSION,
    SETUP_INPUTS,
    SETUP_OUTPUTS,
    START,
    TYPES,
)
from sliplab.plugins.devices.ur.settings import DASHBOARD_PORT, RTDE_PORT, SCRIPT_PORT
from sliplab.rigs.core.fake_motion import ControllerClock, StraightMotion
from sliplab.rigs.core.fakes import (
    PACKETS_LOST,
    Fault,
    Kind,
    ServedController,
    Stage,
)

_UINT32 = {"robot_status_bits", "safety_status_bits", "runtime_state"}
_INT32 = {"robot_mode", "safety_mode"}
_UINT64 = {"actual_digital_input_bits", "actual_digital_output_bits"}
_SCALARS = {
    "timestamp",
    "actual_execution_time",
    "speed_scaling",
    "target_speed_fraction",
    "actual_momentum",
    "actual_main_voltage",
    "actual_robot_voltage",
    "actual_robot_current",
    "payload",
}
_VECTORS = {
    "joint_mode": "VECTOR6INT32",
    "payload_cog": "VECTOR3D",
    "actual_tool_accelerometer": "VECTOR3D",
    **dict.fromkeys(
        (
            "actual_TCP_force",
            "actual_TCP_pose",
            "actual_TCP_speed",
            "actual_current",
            "actual_joint_voltage",
            "actual_q",
            "actual_qd",
            "ft_raw_wrench",
            "joint_control_output",
            "joint_temperatures",
            "payload_inertia",
            "target_TCP_pose",
            "target_TCP_speed",
            "target_current",
            "target_moment",
            "target_q",
            "target_qd",
            "target_qdd",
            "external_force_torque",
        ),
        "VECTOR6D",
    ),
}
_UNKNOWN, _IN_USE = "NOT_FOUND", "IN_USE"
"""The controller's error answers in place of a type."""
_LAYOUT = TYPES | {"VECTOR3D": "3d", "VECTOR6INT32": "6i"}
_COUNT = {"VECTOR3D": 3, "VECTOR6D": 6, "VECTOR6INT32": 6}


FELT = "actual_TCP_force"
Value = int | float | list[float]


@dataclass(eq=False)
class Client:
    """One RTDE connection."""

    writer: asyncio.StreamWriter
    every: int = 1
    """Controller cycles per packet."""
    streaming: bool = False
    _names: list[str] = field(default_factory=list)
    _kinds: list[str] = field(default_factory=list)
    _readers: list[Callable[[float], Value]] = field(default_factory=list)
    _unsent: deque[tuple[float, list[Value]]] = field(default_factory=deque)
    """Times and values of packets that wait for the load on the tool."""
    _layout: struct.Struct = field(default_factory=lambda: struct.Struct(">"))
    _recipes: dict[int, list[str]] = field(default_factory=dict)

    def ask_outputs(self, body: bytes, cycle_hz: int) -> bytes:
        """Answer a request for outputs: recipe 1, or 0 if one is unknown, and types."""
        (hz,) = struct.unpack_from(">d", body)
        self._unsent.clear()
        self._names = [name for name in body[8:].decode().split(",") if name]
        self._kinds, self._readers = [_kind(name) for name in self._names], []
        if _UNKNOWN in self._kinds:
            kinds, self._names, self._kinds = self._kinds, [], []
            return b"\x00" + ",".join(kinds).encode()
        self.every = max(1, round(cycle_hz / hz))
        self._layout = struct.Struct(">" + "".join(_LAYOUT[kind] for kind in self._kinds))
        return b"\x01" + ",".join(self._kinds).encode()

    def ask_inputs(self, body: bytes, others: Sequence[Client]) -> bytes:
        """Answer a request for inputs.

        An input belongs to the client that requested it first, until that client disconnects.
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
            return  # an external force, which is not simulated
        values = struct.unpack(">" + "".join(TYPES[_kind(name)] for name in names), body[1:])
        # The command last: its parameters must be set when it is read.
        for name, value in sorted(zip(names, values, strict=True), key=_command_last):
            program.write(name, value)

    def cycle(self, program: UrProgram, t_s: float) -> None:
        """Take the outputs of one cycle."""
        if len(self._readers) != len(self._names):
            self._readers = [program.reader(name) for name in self._names]
        self._unsent.append((t_s, [read(t_s) for read in self._readers]))

    def packets(self, program: UrProgram) -> Iterator[bytes]:
        """Build the bodies of the packets whose outputs are all known, in order."""
        while self._unsent:
            t_s, values = self._unsent[0]
            if FELT in self._names:
                felt = program.felt(t_s)
                if felt is None:
                    return
                values[self._names.index(FELT)] = felt
            self._unsent.popleft()
            yield self._packed(values)

    def _packed(self, values: list[Value]) -> bytes:
        flat: list[int | float] = []
        for value, kind in zip(values, self._kinds, strict=True):
            if kind in _COUNT:
                flat.extend(value if isinstance(value, list) else [0] * _COUNT[kind])
            else:
                assert not isinstance(value, list)
                flat.append(value)
        return b"\x01" + self._layout.pack(*flat)


def send(writer: asyncio.StreamWriter, command: int, body: bytes) -> None:
    """Send one RTDE package, unless the client has disconnected."""
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


VERSION = (5, 11, 1, 108318)
"""PolyScope version that it reports."""
JOINTS_DEG = (0.0, -90.0, 90.0, -90.0, -90.0, 0.0)
_TICK_S = 0.001
_STALL_S = 0.02
"""Delay of the fake itself above which its watchdog is postponed, s."""


class FakeUr(ServedController):
    """One fake robot.

    Args:
        host, motion, rate, clock: as in `ServedController`.
        cycle_hz: controller cycles per controller second; 500 on the real controller.
        digital_inputs: levels of the digital inputs by controller time in seconds.
        faults: faults to inject.
        reach_mm: poses farther from the base are outside the safety limits.
        joints_deg: the values of `actual_q`.
        tool_load: load on the tool; none if left out.
    """

    def __init__(
        self,
        host: str,
        motion: StraightMotion | None = None,
        rate: float = 1.0,
        cycle_hz: int = 500,
        digital_inputs: Callable[[float], int] = lambda t_s: 0,
        faults: Sequence[Fault] = (),
        reach_mm: float = 850.0,
        joints_deg: Sequence[float] = JOINTS_DEG,
        clock: ControllerClock | None = None,
        tool_load: Load | None = None,
    ) -> None:
        super().__init__(host, motion, clock, rate)
        self._cycle_hz = cycle_hz
        self.program = UrProgram(
            self.motion,
            reach_mm,
            joints_deg,
            digital_inputs,
            self._cut,
            faults,
            self.clock.rate,
            tool_load,
        )
        self._cycle = int(self.clock.now_s() * cycle_hz)
        self._clients: list[Client] = []
        self._silent = self._cut_off = False
        self._unsent = 0

    def start(self) -> None:
        """Open the ports and run. Raises OSError if one of them is taken."""
        super().start()
        self._inside(self._tick)

    def plan(self, fault: Fault) -> None:
        """Inject a fault when its stage is reached."""
        self._inside(lambda: self.program.faults.add(fault))

    def restore_link(self) -> None:
        """Accept connections again after the link was cut or went silent."""
        self._inside(self._connections.cut)
        self._silent = self._cut_off = False
        self._inside(self._listen)

    def restore(self) -> None:
        """Clear every fault of power, safety, remote control and link, as an operator would."""
        self._inside(lambda: setattr(self.program, "powered", True))
        self.unlock()
        self.set_remote(True)
        if self._silent or self._cut_off:
            self.restore_link()

    def set_remote(self, on: bool) -> None:
        """Switch remote control on (or off, without ending the program)."""
        self._inside(lambda: setattr(self.program, "remote", on))

    def set_slider(self, fraction: float) -> None:
        """Move the pendant's speed slider to `fraction`, above 0 and up to 1."""
        self._inside(lambda: setattr(self.program, "speed_fraction", fraction))

    def hang_program(self, hung: bool) -> None:
        """Make the control program report that it runs, but ignore commands."""
        self._inside(lambda: setattr(self.program, "hung", hung))

    def unlock(self) -> None:
        """Unlock a protective stop, or release an emergency or safeguard stop, at the pendant."""
        self._inside(lambda: setattr(self.program, "safety", Safety.NORMAL))

    def _inject(self, kind: Kind) -> None:
        self.program.inject(kind)

    def _cut(self, kind: Kind) -> None:
        if kind is Kind.SILENCE:
            self._silent = True
        elif kind is Kind.PACKETS_LOST:
            self._unsent += PACKETS_LOST
        elif kind is Kind.LINK_CUT:
            self._cut_off = True
            self._connections.cut()
        else:
            raise ValueError(f"{kind.value} is not simulated by this fake")

    def _listen(self) -> None:
        for port, talk in (
            (RTDE_PORT, self._rtde),
            (DASHBOARD_PORT, self._dashboard),
            (SCRIPT_PORT, self._script),
        ):
            self._connections.listen(self.host, port, talk)

    async def _may_answer(self) -> None:
        """Return at once, or never while the controller is silent."""
        if self._silent:
            await asyncio.get_running_loop().create_future()

    def _tick(self) -> None:
        """Run every controller cycle that is due, each with its own packets."""
        asyncio.get_running_loop().call_later(_TICK_S, self._tick)
        due = int(self.clock.now_s() * self._cycle_hz)
        late_s = (due - self._cycle) / self._cycle_hz
        if late_s > _STALL_S * self.clock.rate:
            self.program.postpone_watchdog(late_s)
        while self._cycle < due:
            self._cycle += 1
            t_s = self._cycle / self._cycle_hz
            self.program.cycle(t_s)
            if self._silent or self._unsent:
                self._unsent = max(self._unsent - 1, 0)
                continue
            for client in self._clients:
                if client.streaming and self._cycle % client.every == 0:
                    client.cycle(self.program, t_s)
        for client in () if self._silent else self._clients:
            for body in client.packets(self.program):
                send(client.writer, DATA, body)

    async def _rtde(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        client = Client(writer)
        self._clients.append(client)
        try:
            while True:
                size, command = HEADER.unpack(await reader.readexactly(HEADER.size))
                body = await reader.readexactly(size - HEADER.size)
                self.program.faults.reach(Stage.CONNECTING)
                if command == SETUP_INPUTS:
                    self.program.faults.reach(Stage.CONTROL)
                await self._may_answer()
                if command == DATA:
                    client.take(self.program, body)
                else:
                    send(writer, command, self._answer(client, command, body))
        finally:
            self._clients.remove(client)

    def _answer(self, client: Client, command: int, body: bytes) -> bytes:
        if command == REQUEST_PROTOCOL_VERSION:
            return b"\x01" if body == b"\x00\x02" else b"\x00"
        if command == GET_VERSION:
            return struct.pack(">4I", *VERSION)
        if command == SETUP_OUTPUTS:
            return client.ask_outputs(body, self._cycle_hz)
        if command == SETUP_INPUTS:
            others = [other for other in self._clients if other is not client]
            return client.ask_inputs(body, others)
        if command in {START, PAUSE}:
            client.streaming = command == START
            return b"\x01"
        raise ConnectionError(f"RTDE command {command} is not simulated")  # ends the connection

    async def _dashboard(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await self._may_answer()
        writer.write(b"Connected: Universal Robots Dashboard Server\n")
        while line := await reader.readline():
            await self._may_answer()
            writer.write((self._dashboard_answer(line.decode().strip()) + "\n").encode())

    def _dashboard_answer(self, request: str) -> str:
        program = self.program
        if request == "stop":
            if not program.remote:
                return "Failed to execute: stop"
            program.end_program()
            return "Stopped"
        if request == "unlock protective stop":
            return (
                "Protective stop releasing" if program.unlock() else f"Failed to execute: {request}"
            )
        if request in {"play", "pause", "power on", "power off", "brake release", "shutdown"}:
            return f"Failed to execute: {request}"  # exists, but is not simulated
        answers = {
            "get robot model": "UR5",
            "get serial number": "20205500000",
            "PolyscopeVersion": "URSoftware " + ".".join(map(str, VERSION)) + " (Jan 01 2021)",
            "is in remote control": str(program.remote).lower(),
            "running": f"Program running: {str(program.program_running).lower()}",
            "robotmode": f"Robotmode: {'RUNNING' if program.powered else 'POWER_OFF'}",
            "safetystatus": f"Safetystatus: {program.safety.name}",
        }
        return answers.get(request, f'could not understand: "{request}"')

    async def _script(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        text = ""
        while data := await reader.read(65536):
            if "def rtde_control" in text + data.decode():
                self.program.faults.reach(Stage.UPLOADING)
            await self._may_answer()
            text += data.decode()
            while (whole := _whole_script(text)) is not None:
                self.program.script(whole)
                text = text[len(whole) :]


def _whole_script(text: str) -> str | None:
    """Return the first complete script of `text`: a function up to its `end`, or one line."""
    if text.startswith("def "):
        end = text.find("\nend\n")
        return None if end < 0 else text[: end + 5]
    line, newline, _ = text.partition("\n")
    return line + newline if newline else None


def main() -> None:
    """Run one fake until the process is terminated."""
    parser = argparse.ArgumentParser(description="A fake Universal Robots controller.")
    parser.add_argument("host", help="loopback address to listen on, such as 127.0.0.2")
    parser.add_argument("--rate", type=float, default=1.0, help="controller seconds per second")
    arguments = parser.parse_args()
    with FakeUr(arguments.host, rate=arguments.rate):
        threading.Event().wait()


if __name__ == "__main__":
    main()
