"""Reliable handling of Ctrl-C, SIGTERM and SIGHUP.

Python delivers a signal as an exception wherever it happens to be. Inside a destructor or a weak
reference's callback that exception is dropped, and the program continues, which an arm must not. So
the handler also raises a flag: the rig looks at it in every poll, progress bars at every step. The
traceback that Python prints of a dropped exception is suppressed, since the flag is set.

While files are written that belong together, only the flag is raised, and the exception when they
are complete (`sliplab.storage.interrupts`); the third signal ends that if 10 s have passed. While
the arm stops, further signals are ignored up to ten times (`rigs.core.rig`); while the last message
is printed, they are ignored (`flows.__main__`).
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from sliplab.storage import interrupts
from sliplab.storage.process import leave_to_parent

__all__ = ["SIGNALS", "check", "leave_to_parent", "request", "requested", "signals", "stop", "wait"]

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Ctrl-C, a request to end, and a terminal that was closed: the arm stops first on each."""
_requested = threading.Event()


def _handle(number: int, frame: FrameType | None) -> None:
    _requested.set()
    if not interrupts.defer(frame):
        raise KeyboardInterrupt


def requested() -> bool:
    """Return True where the program was asked to stop."""
    return _requested.is_set()


def request() -> None:
    """Ask whatever waits in this program to stop."""
    _requested.set()


def check() -> None:
    """Stop here if a stop was requested.

    Raises:
        KeyboardInterrupt: a stop was requested.
    """
    if _requested.is_set():
        raise KeyboardInterrupt


def stop() -> None:
    """Stop as on a signal: a stop was requested in another way.

    Raises:
        KeyboardInterrupt: always.
    """
    _requested.set()
    raise KeyboardInterrupt


def wait(seconds: float) -> None:
    """Wait for some time; a stop request raises here.

    Raises:
        KeyboardInterrupt: a stop was requested.
    """
    check()
    # on a separate event: a handler that sets the one that is waited on could wait for itself
    threading.Event().wait(seconds)
    check()


@contextmanager
def signals() -> Iterator[None]:
    """Answer `SIGNALS` while the block runs; only the main thread can, others pass."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in SIGNALS}
    if before[signal.SIGHUP] is signal.SIG_IGN:  # under nohup it is meant to outlive its terminal
        del before[signal.SIGHUP]
    if before[signal.SIGINT] is not _handle:  # a request holds until the outermost block ends
        _requested.clear()
    hook = sys.unraisablehook

    def unless_requested(dropped: sys.UnraisableHookArgs) -> None:
        if not (_requested.is_set() and issubclass(dropped.exc_type, KeyboardInterrupt)):
            hook(dropped)

    sys.unraisablehook = unless_requested
    for number in before:
        signal.signal(number, _handle)
    try:
        yield
    except SystemError as error:  # a compiled function makes one of an exception that meets it
        if _requested.is_set():
            raise KeyboardInterrupt from error
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        sys.unraisablehook = hook
