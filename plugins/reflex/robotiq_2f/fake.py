"""A fake of a Robotiq 2F gripper: the URCap's socket, on fingers that a scene moves and stalls.

It sends `ack` without a line feed and takes up a move `ECHO_S` later, as real ones do.
"""

from __future__ import annotations

import contextlib
import socketserver
import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from sliplab.plugins.reflex.robotiq_2f import protocol
from sliplab.plugins.reflex.robotiq_2f.settings import Model
from sliplab.rigs.core.driver import GripperScene
from sliplab.rigs.core.fakes import LOOPBACK
from sliplab.rigs.core.finger_motion import FingerMotion
from sliplab.rigs.core.gripper_range import GripperRange

OVERCURRENT = 14
END_S = 2.0
MS = 1_000_000


class ElasticObject:
    """Object of a thickness and stiffness between the fingers; stalls them as they close.

    Args:
        thickness_mm: opening at which the fingers touch it.
        n_per_mm: stiffness.
    """

    def __init__(self, fingers: FingerMotion, thickness_mm: float, n_per_mm: float) -> None:
        self._fingers, self._thickness, self._stiffness = fingers, thickness_mm, n_per_mm
        self._seen_ns: int | None = None

    def feel(self, now_ns: int) -> None:
        """Stall the fingers where their force was reached up to now, in steps of 1 ms."""
        begin_ns = now_ns if self._seen_ns is None else self._seen_ns
        self._seen_ns = now_ns
        limit = self._fingers.closing_force_n(begin_ns, now_ns)
        if limit is None:
            return
        t_ns = np.arange(begin_ns, now_ns + 1, MS, dtype=np.int64)
        beyond = self._fingers.opening_mm(t_ns) <= self._thickness - limit / self._stiffness
        if beyond.any():
            self._fingers.stall(int(t_ns[beyond][0]))


class FakeRobotiq:
    """A gripper to connect to at `address`; a context manager: its threads end with it.

    Args:
        feel: called with the time before each answer: what stalls the fingers up to then.
        echo_ns: time until a move is taken up.
    """

    def __init__(
        self,
        model: Model,
        scene: GripperScene,
        feel: Callable[[int], None] = lambda now_ns: None,
        echo_ns: int = 2 * MS,
    ) -> None:
        self._range: GripperRange = protocol.range_of(model)
        self._fingers, self._now_ns, self._feel = scene.fingers, scene.now_ns, feel
        self._echo_ns = echo_ns
        self._lock = threading.RLock()
        self.registers = {"ACT": 1, "GTO": 0, "STA": protocol.ACTIVE, "FLT": 0}
        self.registers |= {"POS": 0, "SPE": 0, "FOR": 0}
        self._echoed, self._echo_due_ns = self._counts(), 0
        self._before = self._echoed
        self._silent = False
        self.sets: list[str] = []
        """The commands that were sent, for tests."""
        self._server = _GripperServer((LOOPBACK, 0), _handler_of(self))
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.02,), name="fake gripper", daemon=True
        )
        self._thread.start()

    def __enter__(self) -> FakeRobotiq:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @property
    def address(self) -> tuple[str, int]:
        """Host and port."""
        return LOOPBACK, int(self._server.server_address[1])

    def silence(self) -> None:
        """Answer nothing from now on."""
        self._silent = True

    def fail(self) -> None:
        """Report too much current from now on, and stop."""
        with self._lock:
            self.registers["FLT"] = OVERCURRENT
            self._fingers.stop(self._now_ns())

    def cut(self) -> None:
        """Break the open connections; new ones are accepted."""
        self._server.cut()

    def send(self, data: bytes) -> None:
        """Send unsolicited bytes to every client."""
        for handler in list(self._server.open):
            handler.wfile.write(data)

    def close(self) -> None:
        """Break the connections; safe to call more than once."""
        self._server.shutdown()
        self._server.end()
        self._thread.join(END_S)

    def answer(self, line: str) -> bytes:
        """Carry out a line and return the bytes of its answer."""
        if self._silent:
            return b""
        word, _, rest = line.strip().partition(" ")
        with self._lock:
            self._feel(self._now_ns())
            if word == "GET" and rest:
                return f"{rest} {self._register(rest)}\n".encode("ascii")
            if word == "SET":
                self.sets.append(line.strip())
                self._set(rest.split())
                return b"ack"
        return b"?\n"

    def _set(self, words: list[str]) -> None:
        given = dict(zip(words[::2], map(int, words[1::2]), strict=True))
        self.registers |= given
        now_ns = self._now_ns()
        if self.registers["FLT"]:
            return
        if self.registers["GTO"] == 0:
            if self._fingers.moving(now_ns):
                self._fingers.stop(now_ns)
        elif "POS" in given or "GTO" in given:
            allowed = self._range
            self._before, self._echoed = self._register("PRE"), self.registers["POS"]
            self._echo_due_ns = now_ns + self._echo_ns
            self._fingers.move(
                protocol.opening_mm(self.registers["POS"], allowed),
                protocol.of_counts(self.registers["SPE"], allowed.speed_mm_s),
                protocol.of_counts(self.registers["FOR"], allowed.force_n),
                now_ns,
            )

    def _register(self, name: str) -> int:
        now_ns = self._now_ns()
        taken_up = now_ns >= self._echo_due_ns
        if name == "POS":
            return self._counts()
        if name == "PRE":
            return self._echoed if taken_up else self._before
        if name == "OBJ":
            if taken_up and self._fingers.moving(now_ns):
                return protocol.MOVING
            return protocol.CLOSING_ON if self._fingers.stalled else protocol.ARRIVED
        return self.registers.get(name, 0)

    def _counts(self) -> int:
        now = np.array([self._now_ns()], np.int64)
        opening = float(self._fingers.opening_mm(now)[0])
        return round(protocol.COUNTS * (1.0 - opening / self._range.opening_mm[1]))


class _GripperServer(socketserver.ThreadingTCPServer):
    """Serves connections in threads, and breaks them when it ends."""

    allow_reuse_address, daemon_threads, block_on_close = True, True, False

    def __init__(self, *arguments: Any) -> None:
        self.open: set[socketserver.StreamRequestHandler] = set()
        super().__init__(*arguments)

    def end(self) -> None:
        """Close the port and every connection."""
        self.server_close()
        self.cut()

    def cut(self) -> None:
        """Break every connection."""
        for handler in list(self.open):
            with contextlib.suppress(OSError):
                handler.connection.shutdown(2)


def _handler_of(gripper: FakeRobotiq) -> type[socketserver.StreamRequestHandler]:
    """Return the handler of a gripper's connections."""

    class GripperHandler(socketserver.StreamRequestHandler):
        server: _GripperServer

        def handle(self) -> None:
            self.server.open.add(self)
            with contextlib.suppress(OSError):
                for line in self.rfile:
                    self.wfile.write(gripper.answer(line.decode("ascii", "replace")))
            self.server.open.discard(self)

    return GripperHandler
