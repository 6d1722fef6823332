"""A reader of Universal Robots' Real-Time Data Exchange (port 30004) with a timeout on every wait.

The driver commands the arm through ur_rtde but does not read poses through it: ur_rtde 1.6.5 skips
a packet whenever two have arrived, returns time and pose in separate calls, reads its set-up
answers without a timeout, and reconnects automatically. This reader keeps every packet complete, in
order, with the host's time of its reception.

Protocol (the vendor's RTDE guide, version 2): big-endian `u16 size, u8 command`, then a body.
"""

from __future__ import annotations

import contextlib
import math
import socket
import struct
import time
from collections.abc import Sequence
from dataclasses import dataclass

from sliplab.plugins.devices.ur.settings import RTDE_PORT
from sliplab.rigs.core.capabilities import ArmState

HEADER = struct.Struct(">HB")
TYPES = {"DOUBLE": "d", "UINT32": "I", "INT32": "i", "UINT64": "Q", "VECTOR6D": "6d"}
"""Format characters of `struct` by the RTDE names of the types used here."""
_LAST_READ_S = 0.01
REQUEST_PROTOCOL_VERSION, SETUP_OUTPUTS, SETUP_INPUTS = 86, 79, 73
GET_VERSION, START, PAUSE, DATA, TEXT = 118, 83, 80, 85, 77
_COMMANDS = {
    REQUEST_PROTOCOL_VERSION,
    SETUP_OUTPUTS,
    SETUP_INPUTS,
    GET_VERSION,
    START,
    PAUSE,
    DATA,
    TEXT,
}


class RtdeError(RuntimeError):
    """The exchange could not be set up, or has ended; the text says why."""


@dataclass(frozen=True)
class Packet:
    """One packet of outputs."""

    host_ns: int
    """Host's monotonic clock when its last byte was read."""
    values: tuple[float, ...]
    """Every number of every output, flat, in the requested order."""


class RtdeReader:
    """One connection that requests outputs and then only receives.

    Args:
        host: name or address of the controller.
        answer_s: timeout to connect and set up the stream.
        silence_s: silence after which the stream counts as lost.
    """

    def __init__(self, host: str, answer_s: float, silence_s: float) -> None:
        self._host, self._answer_s, self._silence_s = host, answer_s, silence_s
        self._socket: socket.socket | None = None
        self._rest = bytearray()
        self._layout, self._recipe = struct.Struct(">"), 0
        self._late = False
        self.version = (0, 0, 0, 0)

    def open(self, names: Sequence[str], frequency_hz: float) -> None:
        """Connect and start the stream of the named outputs.

        Raises:
            RtdeError: no connection, no answer in time, or an output unknown to the controller.
        """
        deadline = time.monotonic() + self._answer_s
        try:
            self._socket = socket.create_connection((self._host, RTDE_PORT), self._answer_s)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            body = self._ask(REQUEST_PROTOCOL_VERSION, struct.pack(">H", 2), deadline)
            if body != b"\x01":
                raise RtdeError("the controller does not support version 2 of RTDE")
            self.version = struct.unpack(">4I", self._ask(GET_VERSION, b"", deadline)[:16])
            recipe = struct.pack(">d", frequency_hz) + ",".join(names).encode()
            answer = self._ask(SETUP_OUTPUTS, recipe, deadline)
            self._recipe, kinds = answer[0], answer[1:].decode().split(",")
            unknown = [name for name, kind in zip(names, kinds, strict=True) if kind not in TYPES]
            if unknown:
                raise RtdeError(f"the controller does not know {', '.join(unknown)}")
            self._layout = struct.Struct(">" + "".join(TYPES[kind] for kind in kinds))
            if self._ask(START, b"", deadline) != b"\x01":
                raise RtdeError("the controller did not start the stream")
        except (OSError, struct.error, ValueError, IndexError) as error:
            self.close()
            raise RtdeError(f"cannot read from {self._host}:{RTDE_PORT}: {error}") from None
        except RtdeError:
            self.close()
            raise

    def read(self) -> list[Packet]:
        """Return every packet received, at least one.

        Raises:
            RtdeError: no packet came for `silence_s`, whatever else did; the connection has ended;
                or the data are not the requested stream.
        """
        deadline = time.monotonic() + self._silence_s
        packets: list[Packet] = []
        try:
            while not packets:
                while (message := self._message()) is not None:
                    if message[0] == DATA:
                        packets.append(Packet(time.monotonic_ns(), self._values(message[1])))
                if not packets:
                    self._more(deadline)
        except OSError as error:
            raise RtdeError(f"the pose stream of {self._host} has ended: {error}") from None
        return packets

    def close(self) -> None:
        """Close the connection; safe to call more than once and from another thread."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.shutdown(socket.SHUT_RDWR)  # wakes a thread that waits in `read`
            self._socket.close()

    def _ask(self, command: int, body: bytes, deadline: float) -> bytes:
        assert self._socket is not None
        self._socket.sendall(HEADER.pack(HEADER.size + len(body), command) + body)
        while True:
            while (message := self._message()) is not None:
                if message[0] == command:
                    return message[1]
            self._more(deadline)

    def _values(self, body: bytes) -> tuple[float, ...]:
        """Unpack the numbers of one packet; checks recipe, size, and that they are finite."""
        if len(body) != 1 + self._layout.size or body[0] != self._recipe:
            raise ConnectionError(
                f"received a packet of {len(body)} bytes of recipe {body[0] if body else 'none'} "
                f"instead of recipe {self._recipe} with {1 + self._layout.size} bytes"
            )
        values: tuple[float, ...] = self._layout.unpack_from(body, 1)
        if not all(map(math.isfinite, values)):
            raise ConnectionError("a packet has a number that is not finite")
        return values

    def _message(self) -> tuple[int, bytes] | None:
        if len(self._rest) < HEADER.size:
            return None
        size, command = HEADER.unpack_from(self._rest)
        if size < HEADER.size or command not in _COMMANDS:
            raise ConnectionError(f"not an RTDE packet: size {size}, command {command}")
        if len(self._rest) < size:
            return None
        body = bytes(self._rest[HEADER.size : size])
        del self._rest[:size]
        return command, body

    def _more(self, deadline: float) -> None:
        left = deadline - time.monotonic()
        if self._socket is None:
            raise ConnectionError("closed")
        # A thread that was itself delayed still reads once what has arrived meanwhile.
        if left <= 0 and self._late:
            raise TimeoutError("timed out; no answer and no packet was received")
        self._late = left <= 0
        self._socket.settimeout(max(left, _LAST_READ_S))
        data = self._socket.recv(65536)
        if not data:
            raise ConnectionError("the controller closed the connection")
        self._rest += data


OUTPUTS = (
    "timestamp",
    "actual_TCP_pose",
    "actual_q",
    "target_TCP_speed",
    "actual_digital_input_bits",
    "robot_status_bits",
    "safety_status_bits",
    "runtime_state",
    "robot_mode",
    "target_speed_fraction",
    "output_int_register_2",
)
"""Output fields that the driver requests, in this order."""
WRENCH = "actual_TCP_force"
"""Force and torque on the tool in the base's axes, N and N m; requested last, where needed."""
_EMERGENCY = 0b1110_0000
"""System, robot and any emergency stop."""
_PROTECTIVE = 0b111_0001_1100
"""Protective stop, recovery mode, safeguard stop, violation, fault, stopped due to safety."""
_STOPPED, _PLAYING = 1, 2
"""Values of runtime_state; 0 stopping, 3 pausing, 4 paused and 5 resuming have a program too."""
_MODE_RUNNING = 7
_MODES = {
    -1: "no controller",
    0: "disconnected",
    1: "safety to be confirmed",
    2: "booting",
    3: "power off",
    4: "power on",
    5: "idle, brakes on",
    6: "backdrive",
    8: "updating firmware",
}
"""Values of robot_mode in which no program can move the arm."""
_POWERED, _PROGRAM = 1, 2
_MOVE_RUNS = 1 << 15


@dataclass(frozen=True)
class UrStatus:
    """One packet without its pose."""

    t_ns: int
    joints_deg: tuple[float, ...]
    speed_mm_s: float
    """Commanded speed of the tool centre point."""
    sync: bool
    """Level of the sync input."""
    stopped: ArmState | None
    """Active safety stop."""
    running: bool
    """True if powered, with brakes released and the control program running."""
    program: bool
    """True if a program has not ended: it is playing, paused, or about to be."""
    playing: bool
    """True if a program is playing, ours or another."""
    off: str
    """Robot mode of an arm that is not switched on; empty if it is."""
    speed_fraction: float
    """Position of the pendant's speed slider, 0 to 1."""
    move_runs: bool
    """True if the control script reports a running asynchronous move."""


def status_of(values: Sequence[float], sync_input: int) -> UrStatus:
    """Extract the status from one packet's flat values."""
    inputs, robot, safety, runtime, mode = (int(value) for value in values[19:24])
    stopped = None
    if safety & _EMERGENCY:
        stopped = ArmState.EMERGENCY_STOP
    elif safety & _PROTECTIVE:
        stopped = ArmState.PROTECTIVE_STOP
    return UrStatus(
        t_ns=round(values[0] * 1e9),
        joints_deg=tuple(math.degrees(value) for value in values[7:13]),
        speed_mm_s=math.hypot(*values[13:16]) * 1000.0,
        sync=bool(inputs >> sync_input & 1),
        stopped=stopped,
        running=bool(robot & _POWERED and robot & _PROGRAM)
        and runtime == _PLAYING
        and mode == _MODE_RUNNING,
        program=runtime != _STOPPED,
        playing=runtime == _PLAYING,
        off="" if mode == _MODE_RUNNING else _MODES.get(mode, f"robot mode {mode}"),
        speed_fraction=values[24],
        move_runs=bool(int(values[25]) & _MOVE_RUNS),
    )
