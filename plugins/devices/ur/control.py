"""ur_rtde's control client in a child process, which is the only way to bound its calls.

When a connection dies, ur_rtde 1.6.5 behaves as follows (from its source, and confirmed by trial):
the constructor holds Python's global interpreter lock while it connects, reads answers and uploads,
without a timeout, so no thread of the same process can end the wait; a blocking call waits up to
300 s; and after a lost connection the client reconnects automatically, uploads the script again and
*repeats the interrupted move*. A child process can be killed after a timeout, which prevents all
of this.

The child also ends itself if a call exceeds its timeout (a timer in C that needs no lock), and
stops the arm first when its parent has died.
"""

from __future__ import annotations

import contextlib
import faulthandler
import os
from multiprocessing.connection import Connection
from typing import Any

from sliplab.rigs.core.library_process import LibraryError, LibraryProcess

START_S = 10.0
"""Timeout for the child to connect, upload the control script and see it running, s."""
KICK_S = 0.1
"""Period of the writes that keep the watchdog from expiring while nothing else is sent, s."""
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
    wait_s = KICK_S
    with contextlib.suppress(EOFError, OSError):
        while True:
            wait_s = _serve_one(pipe, control, wait_s)
    faulthandler.dump_traceback_later(_PARENT_GONE_STOP_S, exit=True)
    with contextlib.suppress(Exception):
        control.stopL(_STOP_DECELERATION_M_S2, True)
    os._exit(0)  # the client's own clean-up may hang, and nothing depends on it


def _serve_one(pipe: Connection, control: Any, wait_s: float) -> float:
    """Serve one call, or reset the watchdog; return the time to wait for the next call, s."""
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
