"""Signals that arrive while files are written: the writing is finished first.

Ctrl-C raises wherever Python happens to be, which may be between two files that belong together.
A function that writes such files is decorated with `uninterrupted`: a signal inside it raises when
it returns. A function that it calls and that may take long, such as a trial's motion, is registered
with `interruptible`: there a signal raises at once.

The handler (`sliplab.flows.running.stopping`) decides by the stack of calls, so no instruction lies
between "may raise" and "must wait". Without that handler nothing is deferred.
"""

from __future__ import annotations

import functools
import inspect
import sys
import threading
import time
from collections.abc import Callable
from types import CodeType, FrameType
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

PATIENCE_S = 10.0
INSISTENCE = 3
"""Signals that end even an uninterrupted function: the third one, if `PATIENCE_S` have passed since
the first. A disk that does not answer must not hold the program for ever."""
_defers: dict[CodeType, bool] = {}
_deferred: list[float] = []
"""Monotonic times of the signals that wait for the end of an uninterrupted function, s."""


def uninterrupted(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function that finishes its files before a signal interrupts the program.

    Raises:
        KeyboardInterrupt: when the function has returned, if a signal came meanwhile. A function
            that fails raises its own error.
    """
    _defers[inspect.unwrap(function).__code__] = True

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        due = False
        try:
            result = function(*args, **kwargs)
        finally:
            if _deferred and _is_main_thread() and not _waits(sys._getframe()):
                _deferred.clear()
                due = True
        if due:
            raise KeyboardInterrupt
        return result

    return wrapper


def interruptible(function: Callable[P, R]) -> Callable[P, R]:
    """Register a function in which a signal raises at once, also below an uninterrupted one."""
    _defers[inspect.unwrap(function).__code__] = False
    return function


def defer(frame: FrameType | None) -> bool:
    """Return True if a signal that found the main thread at `frame` has to wait.

    It is remembered then, and raises at the end of the outermost uninterrupted function.
    """
    if not _waits(frame):
        _deferred.clear()
        return False
    _deferred.append(time.monotonic())
    return len(_deferred) < INSISTENCE or _deferred[-1] - _deferred[0] < PATIENCE_S


def _waits(frame: FrameType | None) -> bool:
    """Return what the innermost registered function of a stack says; False without one."""
    while frame is not None:
        if (found := _defers.get(frame.f_code)) is not None:
            return found
        frame = frame.f_back
    return False


def _is_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()
