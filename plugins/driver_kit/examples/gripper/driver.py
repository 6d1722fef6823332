"""Driver of the example gripper.

Openings on the wire are whole steps of 0.1 mm. Two lines are not answered, so that a reflex need
not wait for them; `STATE` is, with the number that it came with:

    MOVE 350 50.0 20.0                         (opening, mm/s, N at which closing fingers stall)
    STOP
    STATE 7              STATE 7 362 MOVING    (or READY, STALLED, FAULT)
"""

from __future__ import annotations

import math
import socket
import threading
import time
from contextlib import suppress

from sliplab.plugins.driver_kit.examples.gripper import RANGE, ExampleGripperSettings
from sliplab.rigs.core.capabilities import GripperState, RigError
from sliplab.rigs.core.gripper_check import check_move

DEVICE = "gripper"
ANSWER_S = 1.0
"""Time limit of connecting and of every answer, s."""


class ExampleGripper:
    """A `sliplab.rigs.core.capabilities.Gripper`."""

    range = RANGE

    def __init__(self, settings: ExampleGripperSettings) -> None:
        self._settings = settings
        self._socket: socket.socket | None = None
        self._asking = threading.Lock()
        self._unread, self._number = b"", 0

    def connect(self) -> None:
        """Open the connection, and see the gripper answer; at most 2 `ANSWER_S`. Raises RigError.

        A gripper that must be activated is not activated here: that moves its fingers.
        """
        self.close()
        address = self._settings.host, self._settings.port
        try:
            link = socket.create_connection(address, ANSWER_S)
        except OSError as error:
            raise RigError(DEVICE, f"{address}: {error}; check its power and network") from None
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # or a line may wait 40 ms
        self._socket, self._unread = link, b""
        try:
            self.state()
        except RigError:
            self.close()
            raise

    def state(self) -> GripperState:
        """Return opening and motion. Raises RigError: a fault, or no answer in `ANSWER_S`."""
        try:
            steps, word = self._ask_state()
            opening_mm = int(steps) * self.range.step_mm
        except (OSError, ValueError) as error:  # a timeout is an OSError
            raise RigError(
                DEVICE, f"no valid answer: {error}; check its power and network"
            ) from None
        if word == "FAULT":
            raise RigError(DEVICE, "reports a fault; see to its cause and restart it")
        return GripperState(opening_mm, moving=word == "MOVING", stalled=word == "STALLED")

    def move(self, opening_mm: float, speed_mm_s: float, force_n: float) -> None:
        """Start to move the fingers and return at once. Raises RigError."""
        check_move(self.range, opening_mm, speed_mm_s, force_n)
        steps = math.ceil(opening_mm / self.range.step_mm - 1e-6)  # the wider one between two
        self._send(f"MOVE {steps} {speed_mm_s} {force_n}")

    def stop(self) -> None:
        """Stop the fingers where they are; at any time. Raises RigError: it cannot be sent."""
        if self._socket is not None:
            self._send("STOP")

    def close(self) -> None:
        """Close the connection, at any time and more than once; the fingers stay."""
        link, self._socket = self._socket, None
        if link is not None:
            with suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)
            link.close()

    # -- the wire ----------------------------------------------------------------------------

    def _send(self, line: str) -> None:
        if self._socket is None:
            raise RigError(DEVICE, "it is not connected; connect it first")
        try:
            self._socket.sendall(f"{line}\n".encode())
        except OSError as error:
            raise RigError(DEVICE, f"{error}; look at its cable, then connect it again") from None

    def _ask_state(self) -> tuple[str, str]:
        """Return steps and word of the answer to a question, after any late one to another.

        Raises:
            OSError: no answer in time.
            ValueError: an invalid line, or the end of the connection.
        """
        with self._asking:
            self._number += 1
            self._send(f"STATE {self._number}")
            end_s = time.monotonic() + ANSWER_S
            while True:
                _, number, steps, word = self._next_line(end_s).split()
                if int(number) == self._number:
                    return steps, word

    def _next_line(self, end_s: float) -> str:
        link = self._socket
        if link is None:
            raise ValueError("it was closed")
        while b"\n" not in self._unread:
            link.settimeout(max(end_s - time.monotonic(), 1e-3))
            data = link.recv(4096)
            if not data:
                raise ValueError("the connection is gone")
            self._unread += data
        line, _, self._unread = self._unread.partition(b"\n")
        return line.decode("ascii")
