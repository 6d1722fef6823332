"""ur_rtde's control client in a child process, which is the only way to bound its calls.

When a connection dies, ur_rtde 1.6.5 behaves as follows (from its source, and confirmed by trial):
the constructor holds Python's global interpreter lock while it connects, reads answers and uploads,
without a timeout, so no thread of the same process can end the wait; a blocking call waits up to
300 s; and after a lost connection the client reconnects automatically, uploads the script again and
*repeats the interrupted move*. A child process can be killed after a timeout, which prevents all
of this.

The child also ends itself if a call exceeds its timeout (a timer in C that needs no lock), and
stops the arm first when its parent has died. It keeps the controller's watchdog content, so it has
to know that its parent still watches the arm: a parent that is suspended (SIGSTOP, Ctrl-Z, a
machine out of memory) says nothing, and after `SILENT_S` the child stops the arm.
"""

from __future__ import annotations

import contextlib
import faulthandler
import os
import threading
import time
import weakref
from multiprocessing.connection import Connection
from typing import Any

from sliplab.rigs.core.library_process import LibraryError, LibraryProcess

START_S = 10.0
"""Timeout for the child to connect, upload the control script and see it running, s."""
KICK_S = 0.1
"""Period of the writes that keep the watchdog from expiring while nothing else is sent, s."""
ALIVE_S = 0.1
"""Period at which the parent says that it runs, s."""
SILENT_S = 1.0
"""Time without a word of the parent after which the child stops the arm, s.

A thread of the parent speaks, whatever its other threads wait for: images, a disk, a compiler. What
keeps it from running is a call that holds the interpreter, and a busy host, for half a second at
worst; the controller's watchdog gives the same second.
"""
_IDLE_KICK_S = 1.0
"""The same once the controller's program has ended, s."""
_SELF_END_S = 2.0
"""Time after the parent's timeout at which the child ends itself, s."""
_PARENT_GONE_STOP_S = 2.0
_STOP_DECELERATION_M_S2 = 1.0


class ControlError(LibraryError):
    """The control client refused, failed or timed out; the text says which."""


class ControlProcess(LibraryProcess):
    """The parent's side: calls of `RTDEControlInterface` by name, each with a timeout.

    Args:
        host: the controller's address.
        frequency_hz: rate at which the client reads the controller's state.

    Raises:
        ControlError: it was not ready within `START_S`; the child has been killed.
    """

    def __init__(self, host: str, frequency_hz: float) -> None:
        super().__init__(
            "control client",
            "sliplab.plugins.devices.ur.control:serve",
            (host, frequency_hz, START_S),
            START_S,
            ControlError,
        )
        threading.Thread(target=_say_alive, args=(weakref.ref(self),), daemon=True).start()

    def say_alive(self) -> bool:
        """Tell the child that this process runs; return False once it is no use any more."""
        try:
            self._calls.tell(None)
        except (OSError, ValueError):  # it has ended, or is closed
            return False
        return True


def _say_alive(process: weakref.ref[ControlProcess]) -> None:
    """Tell a child that this process runs, until it ends or is no longer referenced; a thread."""
    pause = threading.Event()
    while (client := process()) is not None and client.say_alive():
        del client
        pause.wait(ALIVE_S)


def serve(fd: int, host: str, frequency_hz: float, start_s: float) -> None:
    """Run the child: serve calls from the pipe on `fd` until it closes, then stop the arm."""
    pipe = Connection(fd)
    faulthandler.dump_traceback_later(start_s + _SELF_END_S, exit=True)
    try:
        from rtde_control import RTDEControlInterface

        control: Any = RTDEControlInterface(host, frequency_hz)
    except Exception as error:
        pipe.send((False, str(error)))
        os._exit(1)
    pipe.send((True, None))
    server = _Server(pipe, control)
    with contextlib.suppress(EOFError, OSError):
        while True:
            server.serve_one()
    faulthandler.dump_traceback_later(_PARENT_GONE_STOP_S, exit=True)
    with contextlib.suppress(Exception):
        control.stopL(_STOP_DECELERATION_M_S2, True)
    os._exit(0)  # the client's own clean-up may hang, and nothing depends on it


class _Server:
    """The child's loop: serves calls, keeps the watchdog content, and stops a forsaken arm."""

    def __init__(self, pipe: Connection, control: Any) -> None:
        self._pipe, self._control = pipe, control
        self._heard_s = time.monotonic()
        self._kick_s = self._heard_s + KICK_S
        self._stopped = False

    def serve_one(self) -> None:
        """Wait for one message, and serve it; reset the watchdog when that is due."""
        if self._pipe.poll(max(self._kick_s - time.monotonic(), 0.0)):
            message = self._pipe.recv()
            if message is not None:
                self._call(*message)
                self._kick_s = time.monotonic() + KICK_S
            # not the time before a call, which may take long and is the child's own
            self._heard_s, self._stopped = time.monotonic(), False
        if time.monotonic() >= self._kick_s:
            self._kick()

    def _call(self, name: str, arguments: tuple[Any, ...], within_s: float) -> None:
        faulthandler.dump_traceback_later(within_s + _SELF_END_S, exit=True)
        try:
            answer = (True, getattr(self._control, name)(*arguments))
        except Exception as error:
            answer = (False, f"{type(error).__name__}: {error}")
        self._pipe.send(answer)

    def _kick(self) -> None:
        """Reset the watchdog, once the arm of a silent parent has been stopped.

        A stop that raises leaves the arm to the watchdog.
        """
        faulthandler.dump_traceback_later(START_S, exit=True)
        alive = self._control.isConnected()
        if alive and not self._stopped and time.monotonic() - self._heard_s > SILENT_S:
            with contextlib.suppress(Exception):
                self._control.stopL(_STOP_DECELERATION_M_S2, True)
                self._stopped = True
        if alive and (self._stopped or time.monotonic() - self._heard_s <= SILENT_S):
            alive = self._control.kickWatchdog()
        self._kick_s = time.monotonic() + (KICK_S if alive else _IDLE_KICK_S)
