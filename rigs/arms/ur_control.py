"""ur_rtde's control client in a process of its own, because that is the only way to bound it.

What ur_rtde 1.6.5 does when a link dies (its source, and tried): the constructor holds Python's
global lock while it connects, reads answers and uploads, without a deadline, so no thread of the
same process could end the wait; a blocking call waits up to 300 s; and when the connection is lost
it connects again by itself, uploads the script again and *sends the interrupted move again*. A
process can be killed at a stated time, and then nothing of this happens.

The child ends itself too if a call outlives its bound (a timer in C that needs no lock), and when
its parent is gone it stops the arm first.
"""

from __future__ import annotations

import contextlib
import faulthandler
import os
import socket
import subprocess
import sys
import tempfile
import threading
from multiprocessing.connection import Connection
from typing import Any

START_S = 10.0
"""How long the child may take to connect, upload the control script and see it run, s."""
WATCHDOG_HZ = 1.0
"""The controller ends the program, and with it any move, unless it is written to this often.

A host that records cameras may keep a process waiting for half a second; and a move that goes on
for a second more goes no further than its own target, which was held against all limits.
"""
KICK_S = 0.1
"""How often the child writes to the controller when there is nothing else to say, s."""
_IDLE_KICK_S = 1.0
"""The same once the controller's program has ended and there is nothing to keep alive."""
_SELF_END_S = 2.0
"""How much later than its parent's bound the child ends itself, s."""
_KILL_S = 2.0
"""How long a killed child may take to be gone, s."""
_PARENT_GONE_STOP_S = 2.0
_STOP_DECELERATION_M_S2 = 1.0


class ControlError(RuntimeError):
    """The control client refused, failed or did not answer in time; the text says which."""


class ControlProcess:
    """The parent's side: calls of `RTDEControlInterface` by name, each with a bound.

    Args:
        host: the controller's address.
        frequency_hz: rate at which the client reads the controller's state.

    Raises:
        ControlError: it was not ready within `START_S`; the child is gone.
    """

    def __init__(self, host: str, frequency_hz: float) -> None:
        start_s = START_S
        ours, theirs = socket.socketpair()
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the child
        self._lock = threading.Lock()
        code = (
            f"import sys; sys.path[:] = {sys.path!r}; from rigs.arms.ur_control import serve; "
            f"serve({theirs.fileno()}, {host!r}, {frequency_hz!r}, {start_s!r})"
        )
        with theirs:
            self._child = subprocess.Popen(
                [sys.executable, "-c", code],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=self._log,
                stderr=self._log,
                start_new_session=True,  # Ctrl-C is the parent's to handle: it stops the arm first
            )
        self._pipe = Connection(ours.detach())
        try:
            self._answer("connect", start_s)
        except ControlError:
            self.close()
            raise

    def call(self, name: str, *arguments: Any, within_s: float) -> Any:
        """The result of one call. Thread-safe: a second caller waits for the first.

        Raises:
            ControlError: the client raised, died, or did not answer within `within_s`. In the
                last two cases the child is gone and every later call fails at once.
        """
        if not self._lock.acquire(timeout=within_s):
            raise ControlError(f"{name}: the call before it has not ended")
        try:
            if self._child.poll() is not None:
                raise ControlError(f"{name}: the control client is gone")
            try:
                self._pipe.send((name, arguments, within_s))
            except OSError:
                raise ControlError(f"{name}: the control client is gone") from None
            return self._answer(name, within_s)
        finally:
            self._lock.release()

    def kill(self) -> None:
        """End the child now, whatever it is doing; safe to call more than once."""
        if self._child.poll() is None:
            self._child.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._child.wait(_KILL_S)

    def close(self) -> None:
        """End the child and forget it."""
        self.kill()
        self._pipe.close()
        self._log.close()

    def _answer(self, name: str, within_s: float) -> Any:
        try:
            if not self._pipe.poll(within_s):
                self.kill()
                raise ControlError(f"{name}: no answer within {within_s:g} s{self._said()}")
            fine, result = self._pipe.recv()
        except (OSError, EOFError):
            self.kill()
            raise ControlError(f"{name}: the control client died{self._said()}") from None
        if not fine:
            raise ControlError(f"{name}: {result}")
        return result

    def _said(self) -> str:
        """The last line that the client wrote, for a person to read."""
        size = os.fstat(self._log.fileno()).st_size
        end = os.pread(self._log.fileno(), 2000, max(0, size - 2000))  # the child's offset stays
        lines = end.decode(errors="replace").strip().splitlines()
        return f" (it said: {lines[-1]})" if lines else ""


def serve(fd: int, host: str, frequency_hz: float, start_s: float) -> None:
    """The child: take calls from the pipe on `fd` until it closes, then stop the arm and end."""
    pipe = Connection(fd)
    faulthandler.dump_traceback_later(start_s + _SELF_END_S, exit=True)
    try:
        from rtde_control import RTDEControlInterface

        control: Any = RTDEControlInterface(host, frequency_hz)
    except Exception as error:
        pipe.send((False, str(error)))
        os._exit(1)
    pipe.send((True, None))
    wait_s = KICK_S
    with contextlib.suppress(EOFError, OSError):
        while True:
            wait_s = _serve_one(pipe, control, wait_s)
    faulthandler.dump_traceback_later(_PARENT_GONE_STOP_S, exit=True)
    with contextlib.suppress(Exception):
        control.stopL(_STOP_DECELERATION_M_S2, True)
    os._exit(0)  # the client's own clean-up may hang, and holds nothing that matters


def _serve_one(pipe: Connection, control: Any, wait_s: float) -> float:
    """One call, or one sign of life to the controller; how long to wait for the next call, s."""
    if not pipe.poll(wait_s):
        faulthandler.dump_traceback_later(START_S, exit=True)
        alive = control.isConnected() and control.kickWatchdog()
        return KICK_S if alive else _IDLE_KICK_S
    name, arguments, within_s = pipe.recv()
    faulthandler.dump_traceback_later(within_s + _SELF_END_S, exit=True)
    try:
        answer = (True, getattr(control, name)(*arguments))
    except Exception as error:
        answer = (False, f"{type(error).__name__}: {error}")
    pipe.send(answer)
    return KICK_S
