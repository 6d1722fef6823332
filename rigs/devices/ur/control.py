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
from multiprocessing.connection import Connection
from typing import Any

from sliplab.rigs.core.library_process import LibraryError, LibraryProcess

START_S = 10.0
"""Time limit for the child to connect, upload the control script and see it run, s."""
WATCHDOG_HZ = 1.0
"""The controller ends the program, and with it any move, unless it is written to this often.

A host that records cameras may keep a process waiting for half a second; and a move that goes on
for a second more goes no further than its own target, which was held against all limits.
"""
KICK_S = 0.1
"""Period at which the child writes to the controller when it has nothing else to send, s."""
_IDLE_KICK_S = 1.0
"""The same once the controller's program has ended and there is nothing to keep alive."""
_SELF_END_S = 2.0
"""Time after its parent's bound at which the child ends itself, s."""
_PARENT_GONE_STOP_S = 2.0
_STOP_DECELERATION_M_S2 = 1.0


class ControlError(LibraryError):
    """The control client refused, failed or did not answer in time; the text says which."""


class ControlProcess(LibraryProcess):
    """The parent's side: calls of `RTDEControlInterface` by name, each with a bound.

    Args:
        host: the controller's address.
        frequency_hz: rate at which the client reads the controller's state.

    Raises:
        ControlError: it was not ready within `START_S`; the child is gone.
    """

    def __init__(self, host: str, frequency_hz: float) -> None:
        super().__init__(
            "control client",
            "sliplab.rigs.devices.ur.control:serve",
            (host, frequency_hz, START_S),
            START_S,
            ControlError,
        )


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
