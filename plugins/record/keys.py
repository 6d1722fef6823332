"""Single keys of a terminal, without waiting."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def pressed_keys() -> Iterator[Callable[[], str] | None]:
    """Yield a function that returns the next key, or an empty text; None without a terminal."""
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        yield None
        return
    handle = sys.stdin.fileno()
    before = termios.tcgetattr(handle)

    def key() -> str:
        ready, _, _ = select.select([handle], [], [], 0.0)
        return os.read(handle, 1).decode("ascii", "replace") if ready else ""

    try:
        tty.setcbreak(handle)
        yield key
    finally:
        termios.tcsetattr(handle, termios.TCSADRAIN, before)
