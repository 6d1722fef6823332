"""Import of other packages' code: an error, an exit or a hang of it is one error that names it.

A package is imported where a rig file, a protocol or a command names what it provides. Its module
may raise anything, call `sys.exit`, or wait for a device that does not answer.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from types import FrameType
from typing import Any

LONGEST_S = 120.0
"""Longest import of a package, s; PyTorch takes up to 20 s on a busy machine."""


class PluginError(RuntimeError):
    """Code of another package that cannot be imported or called; the text says why, in one line."""


@contextmanager
def foreign_code() -> Iterator[None]:
    """Guard the import or the first call of another package's code in the block.

    Raises:
        PluginError: it raised an error, exited, or took longer than `LONGEST_S`. A hang is ended
            in the main thread alone.
        ModuleNotFoundError: a module is missing; the caller knows whether that is an extra.
    """
    try:
        with _alarm(LONGEST_S):
            yield
    except ModuleNotFoundError:
        raise
    except SystemExit as error:
        raise PluginError(f"it ended with exit code {error.code} while it was imported") from None
    except Exception as error:  # another package's code: whatever it raises
        text = " ".join(f"{type(error).__name__}: {error}".split())
        raise PluginError(text) from error


def import_foreign(place: str) -> Any:
    """Return what ``module:attribute`` names.

    Raises:
        PluginError: see `foreign_code`; a missing module, too.
    """
    module, _, attribute = place.partition(":")
    try:
        if module.startswith("sliplab."):  # no other package's code
            return getattr(import_module(module), attribute)
        with foreign_code():
            return getattr(import_module(module), attribute)
    except ModuleNotFoundError as error:
        raise PluginError(f"ModuleNotFoundError: {error}") from None


@contextmanager
def _alarm(seconds: float) -> Iterator[None]:
    """Raise TimeoutError in the block after some time; only in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def ring(number: int, frame: FrameType | None) -> None:
        raise TimeoutError(f"it was not done after {seconds:g} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds, 1.0)  # again: code may swallow the first one
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
