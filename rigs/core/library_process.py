"""A vendor library in a child process, which is the only way to bound the time of its calls.

A library may hold Python's global interpreter lock while it waits, so that no other thread can end
the wait and Ctrl-C does nothing; or it may crash its process. A child process can be killed after a
timeout, and its death is an error like any other.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.host_clock import STEP_S, StallTimer

T = TypeVar("T")
KILL_S = 2.0
"""Timeout for a child to end after a request or a kill, s."""
_OUTPUT_BYTES = 2000
_OUTPUT_CHARACTERS = 160


class LibraryError(RuntimeError):
    """The library refused, failed or timed out; the text says which."""


def of_device(device: str, work: Callable[[], T]) -> T:
    """Return the result of `work`, a call of a camera's library.

    Raises:
        RigError: of `device`, in place of a LibraryError; without the call's name, which means
            nothing to a user.
    """
    try:
        return work()
    except LibraryError as error:
        reason = str(error).partition(": ")[2]
        raise RigError(device, reason.removeprefix(f"{device}: ")) from None


class LibraryProcess:
    """The parent's side: remote calls by name, each with a timeout.

    The child sends `(True, result)` or `(False, text)` once it has started and after each call,
    which it receives as `(name, arguments, within_s)`. It must end when the pipe closes.

    Args:
        what: name of the child's role, for messages.
        serve: the child's function, `module:name`; its first argument is the pipe's descriptor.
        arguments: further arguments; `eval(repr(argument))` must give each one back.
        start_s: timeout for the child to start, s.
        error: exception class to raise.
        ignore_suspend: timeouts do not count time for which this computer was suspended.

    Raises:
        LibraryError: it was not ready within `start_s`; the child has been killed.
    """

    def __init__(
        self,
        what: str,
        serve: str,
        arguments: tuple[Any, ...],
        start_s: float,
        error: type[LibraryError] = LibraryError,
        *,
        ignore_suspend: bool = False,
    ) -> None:
        self._what, self._error, self._ignore_suspend = what, error, ignore_suspend
        self._pending = 1
        ours, theirs = socket.socketpair()
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the child
        self._lock = threading.Lock()
        module, function = serve.split(":")
        given = ", ".join(map(repr, (theirs.fileno(), *arguments)))
        code = (
            # a stop of all processes is the parent's to handle, too: it stops the arm through this
            "import signal, sys; signal.signal(signal.SIGTERM, signal.SIG_IGN); "
            f"sys.path[:] = {sys.path!r}; from {module} import {function}; "
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
        """Call a function of the child and return its result. Thread-safe; calls are serialised.

        Raises:
            LibraryError: the library raised, died, or did not answer within `within_s`. In the
                last two cases the child has ended and every later call fails at once.
        """
        if not self._lock.acquire(timeout=within_s):
            raise self._error(f"{name}: the previous call has not ended")
        try:
            if self._pipe.closed or self._child.poll() is not None:
                raise self._error(f"{name}: the {self._what} has exited")
            self._pending += 1  # before sending: a surplus answer would be taken for the next one
            try:
                self._pipe.send((name, arguments, within_s))
            except OSError:
                raise self._error(f"{name}: the {self._what} has exited{self._output()}") from None
            return self._answer(name, within_s)
        finally:
            self._lock.release()

    @property
    def pid(self) -> int:
        """Number of the child's process."""
        return self._child.pid

    def kill(self) -> None:
        """End the child now, whatever it is doing; safe to call more than once."""
        if self._child.poll() is None:
            self._child.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._child.wait(KILL_S)

    def end(self) -> None:
        """Ask the child to end, kill it if it does not within `KILL_S`, and close."""
        with contextlib.suppress(OSError, ValueError):
            self._pipe.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._child.wait(KILL_S)
        self.close()

    def close(self) -> None:
        """Kill the child and release its pipe and log."""
        self.kill()
        self._pipe.close()
        self._log.close()

    def _answer(self, name: str, within_s: float) -> Any:
        fine, result = False, None
        try:
            while self._pending:  # the answer to a call that Ctrl-C interrupted comes first
                if not self._poll(within_s):
                    self.kill()
                    raise self._error(f"{name}: no answer within {within_s:g} s{self._output()}")
                fine, result = self._pipe.recv()
                self._pending -= 1
        except (OSError, EOFError):
            self.kill()
            raise self._error(f"{name}: the {self._what} died{self._output()}") from None
        if not fine:
            raise self._error(f"{name}: {result}")
        return result

    def _poll(self, within_s: float) -> bool:
        """Wait for an answer; return whether one came."""
        if not self._ignore_suspend:
            return self._pipe.poll(within_s)
        stall = StallTimer()
        while stall.waited_s(0) < within_s:
            if self._pipe.poll(STEP_S):
                return True
        return False

    def _output(self) -> str:
        """Return the child's last line of output, as text for a message."""
        size = os.fstat(self._log.fileno()).st_size
        # pread, because the child shares the file offset
        end = os.pread(self._log.fileno(), _OUTPUT_BYTES, max(0, size - _OUTPUT_BYTES))
        lines = end.decode(errors="replace").strip().splitlines()
        last = "".join(c if c.isprintable() else "?" for c in lines[-1]) if lines else ""
        return f" (its last output: {last[:_OUTPUT_CHARACTERS]})" if last else ""
