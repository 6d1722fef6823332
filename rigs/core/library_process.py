"""A maker's library in a process of its own, because that is the only way to bound its calls.

A library may hold Python's global lock while it waits, so that no thread of the same process can
end the wait and Ctrl-C does nothing; or it may end the process that it runs in. A child can be
killed at a stated time, and its end is an error like any other.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import tempfile
import threading
from multiprocessing.connection import Connection
from typing import Any

from sliplab.rigs.core.host_clock import STEP_S, StallTimer

KILL_S = 2.0
"""Time limit for a child to end once it was asked to, or killed, s."""
_SAID_BYTES = 2000
_SAID_CHARACTERS = 160


class LibraryError(RuntimeError):
    """The library refused, failed or did not answer in time; the text says which."""


class LibraryProcess:
    """The parent's side: calls by name, each with a bound.

    The child sends `(True, result)` or `(False, text)` once it has begun and after each call, which
    reaches it as `(name, arguments, within_s)`. It must end when the pipe closes.

    Args:
        what: name of the library's part, for messages.
        serve: the child's function, `module:name`; it is given the pipe's descriptor first.
        arguments: what else it is given; each must be its own `repr`.
        start_s: how long the child may take until it has begun, s.
        error: what is raised.
        patient: bounds count time that somebody watched: a computer that stood still for longer
            than a bound has no child at fault.

    Raises:
        LibraryError: it was not ready within `start_s`; the child is gone.
    """

    def __init__(
        self,
        what: str,
        serve: str,
        arguments: tuple[Any, ...],
        start_s: float,
        error: type[LibraryError] = LibraryError,
        *,
        patient: bool = False,
    ) -> None:
        self._what, self._error, self._patient = what, error, patient
        self._owed = 1
        ours, theirs = socket.socketpair()
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the child
        self._lock = threading.Lock()
        module, function = serve.split(":")
        given = ", ".join(map(repr, (theirs.fileno(), *arguments)))
        code = (
            f"import sys; sys.path[:] = {sys.path!r}; from {module} import {function}; "
            f"{function}({given})"
        )
        with theirs:
            self._child = subprocess.Popen(
                [sys.executable, "-c", code],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=self._log,
                stderr=self._log,
                start_new_session=True,  # Ctrl-C is the parent's to handle
            )
        self._pipe = Connection(ours.detach())
        try:
            self.begun: Any = self._answer("connect", start_s)
        except BaseException:  # Ctrl-C too
            self.close()
            raise

    def call(self, name: str, *arguments: Any, within_s: float) -> Any:
        """The result of one call. Thread-safe: a second caller waits for the first.

        Raises:
            LibraryError: the library raised, died, or did not answer within `within_s`. In the
                last two cases the child is gone and every later call fails at once.
        """
        if not self._lock.acquire(timeout=within_s):
            raise self._error(f"{name}: the call before it has not ended")
        try:
            if self._pipe.closed or self._child.poll() is not None:
                raise self._error(f"{name}: the {self._what} is gone")
            self._owed += 1  # before it is sent: an answer too many would be taken for the next
            try:
                self._pipe.send((name, arguments, within_s))
            except OSError:
                raise self._error(f"{name}: the {self._what} is gone{self._said()}") from None
            return self._answer(name, within_s)
        finally:
            self._lock.release()

    def kill(self) -> None:
        """End the child now, whatever it is doing; safe to call more than once."""
        if self._child.poll() is None:
            self._child.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._child.wait(KILL_S)

    def end(self) -> None:
        """Let the child end by itself, and kill it if it does not within `KILL_S`; then close."""
        with contextlib.suppress(OSError, ValueError):
            self._pipe.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._child.wait(KILL_S)
        self.close()

    def close(self) -> None:
        """Kill the child and forget it."""
        self.kill()
        self._pipe.close()
        self._log.close()

    def _answer(self, name: str, within_s: float) -> Any:
        fine, result = False, None
        try:
            while self._owed:  # the answer to a call that Ctrl-C interrupted comes first
                if not self._comes(within_s):
                    self.kill()
                    raise self._error(f"{name}: no answer within {within_s:g} s{self._said()}")
                fine, result = self._pipe.recv()
                self._owed -= 1
        except (OSError, EOFError):
            self.kill()
            raise self._error(f"{name}: the {self._what} died{self._said()}") from None
        if not fine:
            raise self._error(f"{name}: {result}")
        return result

    def _comes(self, within_s: float) -> bool:
        """Return whether there is an answer, after waiting for it."""
        if not self._patient:
            return self._pipe.poll(within_s)
        stall = StallTimer()
        while stall.waited_s(0) < within_s:
            if self._pipe.poll(STEP_S):
                return True
        return False

    def _said(self) -> str:
        """The last line that the child wrote, for a person to read."""
        size = os.fstat(self._log.fileno()).st_size
        # the child's offset stays
        end = os.pread(self._log.fileno(), _SAID_BYTES, max(0, size - _SAID_BYTES))
        lines = end.decode(errors="replace").strip().splitlines()
        last = "".join(c if c.isprintable() else "?" for c in lines[-1]) if lines else ""
        return f" (it said: {last[:_SAID_CHARACTERS]})" if last else ""
