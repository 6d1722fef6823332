"""Driver of Robotiq 2F grippers by the socket of their URCap.

A move is one line, whose `ack` is read with the next answer, so a move returns at once. A gripper
reports the state of its last move until it has taken up the new one; it is taken to move until it
echoes the position that was asked for. The gripper is never activated from here: that moves its
fingers over their whole stroke.
"""

from __future__ import annotations

import contextlib
import socket
import threading

from sliplab.rigs.core.capabilities import DeviceHealth, GripperState, RigError
from sliplab.rigs.core.gripper_check import check_move
from sliplab.rigs.devices.robotiq_2f import protocol
from sliplab.rigs.devices.robotiq_2f.settings import Robotiq2fSettings

DEVICE = "gripper"
ACK = b"ack"
_MOST_BYTES = 4096


class Robotiq2f:
    """A Robotiq 2F gripper; a `Gripper` of `rigs.core.capabilities`."""

    def __init__(self, settings: Robotiq2fSettings) -> None:
        self._settings = settings
        self.range = protocol.range_of(settings.model)
        self._socket: socket.socket | None = None
        self._lock = threading.Lock()
        self._received = b""
        self._asked: int | None = None
        """Counts of the move that was sent last; None after a stop."""

    def connect(self) -> None:
        """Open the connection, and check that the gripper is activated and has no fault.

        Raises:
            RigError: no answer, not activated, or a fault.
        """
        self.close()
        settings = self._settings
        address = settings.host, settings.port
        try:
            self._socket = socket.create_connection(address, settings.answer_s)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except OSError as error:
            raise self._absent(str(error)) from None
        try:
            self._check_fault()
            if self._get("STA") != protocol.ACTIVE:
                raise RigError(DEVICE, "is not activated: activate it at the pendant")
        except BaseException:
            self.close()
            raise

    def state(self) -> GripperState:
        """Return opening and motion.

        Raises:
            RigError: a fault, or no answer.
        """
        self._check_fault()
        counts, at = self._get("POS"), self._get("OBJ")
        moving = False
        if self._asked is not None:
            moving = at == protocol.MOVING or self._get("PRE") != self._asked
        stalled = not moving and at in (protocol.OPENING_ON, protocol.CLOSING_ON)
        return GripperState(protocol.opening_mm(counts, self.range), moving, stalled)

    def move(self, opening_mm: float, speed_mm_s: float, force_n: float) -> None:
        """Start to move the fingers. Raises RigError."""
        check_move(self.range, opening_mm, speed_mm_s, force_n)
        counts = protocol.position_counts(opening_mm, self.range)
        speed = protocol.least_counts(speed_mm_s, self.range.speed_mm_s)
        force = protocol.least_counts(force_n, self.range.force_n)
        with self._lock:
            self._send(f"SET POS {counts} SPE {speed} FOR {force} GTO 1")
            self._asked = counts

    def stop(self) -> None:
        """Stop the fingers where they are. Raises RigError where it cannot be sent."""
        if self._socket is not None:
            with self._lock:
                self._send("SET GTO 0")
                self._asked = None

    def close(self) -> None:
        """Close the connection; the fingers stay."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.close()
        self._socket, self._received, self._asked = None, b"", None

    def health(self) -> DeviceHealth:
        """Return what the gripper reports. Raises RigError."""
        opening = self.state().opening_mm
        return DeviceHealth(
            device=DEVICE,
            model=f"Robotiq {self._settings.model}",
            serial="unknown",
            firmware="unknown",
            temperature_c=None,
            clock="none",
            notes=(f"opening {opening:.1f} mm, in steps of {self.range.step_mm:.2f} mm",),
        )

    def _check_fault(self) -> None:
        fault = self._get("FLT")
        if fault:
            text = protocol.FAULTS.get(fault, "reports an unknown fault")
            raise RigError(DEVICE, f"{text} (fault {fault}); see to it at the pendant")

    def _get(self, name: str) -> int:
        """Return the value of a register."""
        with self._lock:
            self._send(f"GET {name}")
            while (answer := self._next_answer(name)) is None:
                self._receive()
            return answer

    def _next_answer(self, name: str) -> int | None:
        """Return the value of a complete answer that has come, after any `ack`."""
        while self._received.lstrip().startswith(ACK):
            self._received = self._received.lstrip().removeprefix(ACK)
        line, end, rest = self._received.lstrip(b"\r\n ").partition(b"\n")
        if not end:
            return None
        self._received = rest
        found, _, value = line.decode("ascii", "replace").strip().partition(" ")
        if found != name or not value.isdigit():
            raise RigError(DEVICE, f"answered {line!r} to GET {name}; connect it again")
        return int(value)

    def _receive(self) -> None:
        assert self._socket is not None
        try:
            data = self._socket.recv(_MOST_BYTES)
        except OSError as error:
            raise self._absent(str(error)) from None
        if not data:
            raise self._absent("it closed the connection")
        self._received += data

    def _send(self, line: str) -> None:
        if self._socket is None:
            raise RigError(DEVICE, "is not connected; connect it first")
        try:
            self._socket.sendall(f"{line}\n".encode("ascii"))
        except OSError as error:
            raise self._absent(str(error)) from None

    def _absent(self, why: str) -> RigError:
        where = f"{self._settings.host}:{self._settings.port}"
        return RigError(
            DEVICE,
            f"no answer from {where}: {why}; check power and network of the arm's controller, and "
            "that its URCap is installed",
        )
