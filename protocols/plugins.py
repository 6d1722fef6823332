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

_SIGNAL = signal.SIGRTMAX


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
        with _time_limit(LONGEST_S):
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
        with foreign_code():
            return getattr(import_module(module), attribute)
    except ModuleNotFoundError as error:
        raise PluginError(f"ModuleNotFoundError: {error}") from None


@contextmanager
def _time_limit(seconds: float) -> Iterator[None]:
    """Raise TimeoutError in the block after some time; only in the main thread.

    A real-time signal interrupts a call that waits. SIGALRM is not free: the library of Basler
    cameras sets its own handler for it, which Python does not know and would not restore.
    """
    main = threading.main_thread()
    if threading.current_thread() is not main:
        yield
        return

    def ring(number: int, frame: FrameType | None) -> None:
        raise TimeoutError(f"it was not done after {seconds:g} s")

    done = threading.Event()

    def watch() -> None:
        wait = seconds
        while not done.wait(wait):
            signal.pthread_kill(main.ident or 0, _SIGNAL)
            wait = 1.0  # again: code may swallow the first error

    before = signal.signal(_SIGNAL, ring)
    watcher = threading.Thread(target=watch, name="limit of an import", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        done.set()
        watcher.join()
        signal.signal(_SIGNAL, before)
