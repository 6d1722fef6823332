"""Protocol of the small RAPID socket server that some labs run on ABB controllers (port 5000).

Big-endian. A request is `u16 command` and its float32s; a reply is `u16` 1 (done) or 0 (error) and
its float32s. There is one connection at a time. No request is answered during a move, because a
move is answered when the RAPID instruction returns. There is no stop command and no timeout.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from enum import IntEnum

from sliplab.rigs.core.capabilities import UNKNOWN, DeviceHealth
from sliplab.rigs.core.network import BoundedSocket

_WORD = struct.Struct(">H")
_UNIT_TOLERANCE = 0.01
"""Largest deviation of a quaternion from length 1; the server sends single floats."""


class ServerCommand(IntEnum):
    """Commands of the server."""

    INFO = 0
    MOVE_JOINTS = 1
    MOVE_LINEAR = 2
    MOVE_CIRCULAR = 3
    SET_TCP = 4
    SET_WORK_OBJECT = 5
    SET_SPEED = 6
    SET_ZONE = 7
    JOINTS = 8
    POSE = 9
    CLOSE = 99


ARGUMENTS = {
    ServerCommand.INFO: "",
    ServerCommand.MOVE_JOINTS: "6f",
    ServerCommand.MOVE_LINEAR: "7f",
    ServerCommand.MOVE_CIRCULAR: "14f",
    ServerCommand.SET_TCP: "7f",
    ServerCommand.SET_WORK_OBJECT: "7f",
    ServerCommand.SET_SPEED: "2f",
    ServerCommand.SET_ZONE: "H3f",
    ServerCommand.JOINTS: "",
    ServerCommand.POSE: "",
    ServerCommand.CLOSE: "",
}
"""Arguments of each command: joints in degrees; x y z in mm and a quaternion w x y z; mm/s and
degrees/s; fine point, zone in mm, orientation zone in mm and in degrees."""
RESULTS = {ServerCommand.JOINTS: 6, ServerCommand.POSE: 7}
"""Count of numbers after the reply's first word."""


class RapidError(RuntimeError):
    """The server refused, or did not answer in time; the text says which."""


class RapidSocket:
    """One connection.

    Args:
        host: the controller's address.
        port: port of the server, 5000 by default.
        within_s: timeout to connect.

    Raises:
        RapidError: no connection.
    """

    def __init__(self, host: str, port: int, within_s: float) -> None:
        try:
            self._socket = BoundedSocket.open(host, port, within_s)
        except OSError as error:
            raise RapidError(f"no connection to {host}:{port}: {error}") from None

    def ask(
        self, command: ServerCommand, *arguments: float | Sequence[float], within_s: float
    ) -> tuple[float, ...]:
        """Send one request and return the numbers of its reply.

        Raises:
            RapidError: a refusal, no complete reply within `within_s` seconds, or a malformed one.
        """
        flat = [
            value
            for argument in arguments
            for value in (argument if isinstance(argument, Sequence) else [argument])
        ]
        try:
            self._socket.expect(within_s)
            self._socket.sendall(_WORD.pack(command) + pack(command, flat))
            (fine,) = _WORD.unpack(self._receive(_WORD.size))
            if fine not in {0, 1}:
                raise RapidError(f"the answer to {command.name} begins with {fine}, not 0 or 1")
            if fine == 0:
                raise RapidError(f"the controller refused {command.name}")
            if command is ServerCommand.INFO:
                return ()
            numbers = struct.Struct(f">{RESULTS.get(command, 0)}f")
            values = numbers.unpack(self._receive(numbers.size))
        except OSError as error:
            raise RapidError(f"no answer to {command.name}: {error}") from None
        if not all(map(math.isfinite, values)):
            raise RapidError(f"the answer to {command.name} has a number that is not finite")
        if command is ServerCommand.POSE and abs(math.hypot(*values[3:]) - 1) > _UNIT_TOLERANCE:
            raise RapidError("the answer to POSE has a quaternion whose norm is not 1")
        return values

    def info(self, within_s: float) -> str:
        """Return the server's description: text without a length prefix, read in one piece.

        Raises:
            RapidError: as `ask`; also if another client holds the only connection.
        """
        self.ask(ServerCommand.INFO, within_s=within_s)
        try:
            self._socket.expect(within_s)
            return self._socket.receive(4096).decode("ascii", errors="replace").strip()
        except OSError as error:
            raise RapidError(f"no answer to INFO: {error}") from None

    def close(self) -> None:
        """Send CLOSE, so that the server accepts the next client, and close the socket."""
        try:
            self._socket.sendall(_WORD.pack(ServerCommand.CLOSE))
        except OSError:
            pass  # the connection is lost already
        finally:
            self._socket.close()

    def _receive(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            data += self._socket.receive(size - len(data))
        return data


def pack(command: ServerCommand, values: Sequence[float]) -> bytes:
    """Encode the numbers of a request."""
    layout = ARGUMENTS[command]
    first = [int(values[0]), *values[1:]] if layout.startswith("H") else values
    return struct.pack(">" + layout, *first)


def socket_health(info: str) -> DeviceHealth:
    """Return the health report of the RAPID socket server."""
    return DeviceHealth(
        device="arm",
        model=info or UNKNOWN,
        serial=UNKNOWN,
        firmware=UNKNOWN,
        temperature_c=None,
        clock="the host's: this server reports no time",
    )
