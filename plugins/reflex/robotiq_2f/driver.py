"""Driver of Robotiq 2F grippers by the socket of their URCap.

A move is one line, whose `ack` is read with the next answer, so a move returns at once. A gripper
reports the state of its last move until it has taken up the new one; it is taken to move until it
echoes the requested position. The gripper is never activated from here: that moves its fingers
over their whole stroke.

Every answer has one time limit, and at most `MOST_BYTES`. After one that is missing or wrong the
connection is no longer used: a late answer would be taken for the next one's. A stop is still sent,
without waiting for an answer that another thread waits for.
"""

from __future__ import annotations

import contextlib
import re
import socket
import threading

from sliplab.plugins.reflex.robotiq_2f import protocol
from sliplab.plugins.reflex.robotiq_2f.settings import Robotiq2fSettings
from sliplab.rigs.core.capabilities import DeviceHealth, GripperState, RigError
from sliplab.rigs.core.gripper_check import check_move
from sliplab.rigs.core.network import BoundedSocket

DEVICE = "gripper"
MOST_BYTES = 4096
"""Largest answer, with every `ack` before it."""
LONGEST_LINE = 64
_ACKS = re.compile(rb"(?:ack|\s)*")


class Robotiq2f:
    """A Robotiq 2F gripper; a `Gripper` of `rigs.core.capabilities`."""

    def __init__(self, settings: Robotiq2fSettings) -> None:
        self._settings = settings
        self.range = protocol.range_of(settings.model)
        self._link: BoundedSocket | None = None
        self._broken: str | None = None
        """Reason that this connection is no longer used."""
        self._asking = threading.Lock()
        """Held from a request to its answer; a stop does not wait for it."""
        self._sending = threading.Lock()
        """Held while a line is sent."""
        self._received = b""
        self._asked: int | None = None
        """Counts of the move that was sent last; None after a stop."""

    def connect(self) -> None:
        """Open the connection, and check that the gripper is activated and has no fault.

        Raises:
            RigError: no answer, not activated, or a fault.
        """
        self.close()
        try:
            self._link = self._open()
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
        asked = self._asked
        # whether the move was taken up is read first: what OBJ says before is of the one before
        waits = asked is not None and self._get("PRE") != asked
        counts, at = self._get("POS"), self._get("OBJ")
        moving = asked is not None and (waits or at == protocol.MOVING)
        stalled = not moving and at in (protocol.OPENING_ON, protocol.CLOSING_ON)
        return GripperState(protocol.opening_mm(counts, self.range), moving, stalled)

    def move(self, opening_mm: float, speed_mm_s: float, force_n: float) -> None:
        """Start to move the fingers. Raises RigError."""
        check_move(self.range, opening_mm, speed_mm_s, force_n)
        counts = protocol.position_counts(opening_mm, self.range)
        speed = protocol.least_counts(speed_mm_s, self.range.speed_mm_s)
        force = protocol.least_counts(force_n, self.range.force_n)
        with self._sending:
            self._send(self._usable(), f"SET POS {counts} SPE {speed} FOR {force} GTO 1")
            self._asked = counts

    def stop(self) -> None:
        """Stop the fingers where they are; nothing to do where it was never connected.

        Sent over the open connection, and over a new one where that is broken; takes at most three
        `answer_s`, whatever other threads wait for.

        Raises:
            RigError: it could not be sent.
        """
        link = self._link
        if link is None:
            return
        with self._sending:
            self._asked = None
            if self._broken is None:
                with contextlib.suppress(RigError):
                    self._send(link, "SET GTO 0")
                    return
        with self._open() as new:
            self._send(new, "SET GTO 0")
            try:
                new.receive(1)  # its ack
            except OSError as error:
                raise self._absent(error) from None

    def close(self) -> None:
        """Close the connection; the fingers stay."""
        link, self._link = self._link, None
        if link is not None:
            with contextlib.suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)  # wakes a thread that waits for an answer
            link.close()
        self._received, self._asked, self._broken = b"", None, None

    def health(self) -> DeviceHealth:
        """Return the gripper's report. Raises RigError."""
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

    def _open(self) -> BoundedSocket:
        settings = self._settings
        try:
            return BoundedSocket.open(settings.host, settings.port, settings.answer_s)
        except OSError as error:
            raise self._absent(error) from None

    def _usable(self) -> BoundedSocket:
        """Return the connection, unless it is broken."""
        if self._broken is not None:
            raise RigError(DEVICE, self._broken)
        if self._link is None:
            raise RigError(DEVICE, "is not connected; connect it first")
        return self._link

    def _get(self, name: str) -> int:
        """Return the value of a register. Raises RigError: no answer in time, or a wrong one."""
        with self._asking:
            link = self._usable()
            try:
                with self._sending:
                    self._send(link, f"GET {name}")
                link.expect(self._settings.answer_s, MOST_BYTES)
                return protocol.register(name, self._next_line(link))
            except OSError as error:
                fault = self._absent(error)
            except ValueError as error:
                fault = RigError(DEVICE, f"{error}; connect it again")
            except RigError as error:
                fault = error
            self._broken = str(fault).removeprefix(f"{DEVICE}: ")
            raise fault

    def _next_line(self, link: BoundedSocket) -> bytes:
        """Return the next line, after any `ack`. Raises OSError or ValueError."""
        while True:
            begun = _ACKS.match(self._received)
            assert begun is not None
            line, end, rest = self._received[begun.end() :].partition(b"\n")
            if len(line) > LONGEST_LINE:
                raise ValueError(f"answered {line[:LONGEST_LINE]!r}..., which is no line")
            if end:
                self._received = rest
                return line
            self._received = line + link.receive(MOST_BYTES)

    def _send(self, link: BoundedSocket, line: str) -> None:
        try:
            link.sendall(f"{line}\n".encode("ascii"))
        except OSError as error:
            raise self._absent(error) from None

    def _absent(self, error: OSError) -> RigError:
        where = f"{self._settings.host}:{self._settings.port}"
        return RigError(
            DEVICE,
            f"no answer from {where}: {error}; check power and network of the arm's controller, "
            "and that its URCap is installed",
        )
