"""A vendor library in a child process, which is the only way to bound the time of its calls.

A library may hold Python's global interpreter lock while it waits, so that no other thread can end
the wait and Ctrl-C does nothing; or it may crash its process. A child process can be killed after a
timeout, and its death is an error like any other.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import socket
import subprocess
import sys
import tempfile
import threading
import time
import weakref
from collections.abc import Callable, Sequence
from functools import partial
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.host_clock import STEP_S, StallTimer
from sliplab.storage.process import Child
from sliplab.storage.spawn_context import refuse_main

T = TypeVar("T")
KILL_S = 2.0
"""Timeout for a child to end after a request or a kill, s."""
ANSWER_BYTES = 1 << 30
"""Largest answer: a child cannot fill the parent's memory."""
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


class PipeCalls:
    """Calls of a child process over a pipe: thread-safe, one at a time, each with one time limit.

    The child is ended where an answer is late, since it would be taken for the next call's, and
    where an answer has begun and does not end.

    Args:
        kill: ends the child at once, in any thread.
        pending: answers that the child sends without a call, to be read by `answer`.
        ignore_suspend: time for which this computer was suspended is not counted.
        decode: returns an answer of its bytes; raises for others.
    """

    def __init__(
        self,
        pipe: Connection,
        kill: Callable[[], object],
        *,
        pending: int = 0,
        ignore_suspend: bool = False,
        decode: Callable[[bytes], tuple[bool, Any]] = pickle.loads,
    ) -> None:
        self.pipe, self._decode = pipe, decode
        self._kill, self._pending, self._ignore_suspend = kill, pending, ignore_suspend
        self._lock = threading.Lock()
        self._count = 0
        self._reading: tuple[int, float] | None = None
        """Number and time limit, s, of an answer that has begun."""
        self._late = False
        self._closed = threading.Event()
        arguments = weakref.ref(self), self._closed
        threading.Thread(target=_end_late, args=arguments, daemon=True).start()

    def call(self, message: Any, within_s: float) -> tuple[bool, Any]:
        """Send a message, and return its answer.

        Raises:
            TimeoutError: no answer within `within_s`, or none yet to an earlier call.
            Exception: the child has ended, or sent something else.
        """
        if not self._lock.acquire(timeout=within_s):
            raise TimeoutError("the previous call has not ended")
        try:
            self._pending += 1  # before sending: a surplus answer would be taken for the next one
            with contextlib.suppress(OSError):  # a dead child's last message may be in the pipe
                self.pipe.send(message)
            return self._answer(within_s)
        finally:
            self._lock.release()

    def answer(self, within_s: float) -> tuple[bool, Any]:
        """Return an answer that the child sends without a call. Raises as `call`."""
        with self._lock:
            return self._answer(within_s)

    def tell(self, message: Any) -> None:
        """Send a message that gets no answer; not while a call is waited for. Raises OSError."""
        if self._lock.acquire(blocking=False):
            try:
                self.pipe.send(message)
            finally:
                self._lock.release()

    def close(self) -> None:
        """Close the pipe; safe to call more than once."""
        self._closed.set()
        locked = self._lock.acquire(timeout=STEP_S)  # or `tell` might write to what is opened next
        self.pipe.close()
        if locked:
            self._lock.release()

    def end_late(self, stall: StallTimer) -> None:
        """End the child if its answer has begun and does not end in time; call it regularly."""
        reading = self._reading
        if reading is not None and stall.waited_s(reading[0]) > reading[1]:
            self._late = True
            self._kill()

    def _answer(self, within_s: float) -> tuple[bool, Any]:
        found: tuple[bool, Any] = False, None
        while self._pending:  # the answer to a call that Ctrl-C interrupted comes first
            left_s = self._wait(within_s)
            if left_s <= 0:
                self._kill()
                raise TimeoutError(f"no answer within {within_s:g} s")
            self._count += 1
            self._reading = self._count, left_s
            try:
                found = self._decode(self.pipe.recv_bytes(ANSWER_BYTES))
            except BaseException:  # Ctrl-C too: the rest of the message would begin the next one
                self._kill()
                if self._late:
                    raise TimeoutError(f"no whole answer within {within_s:g} s") from None
                raise
            finally:
                self._reading = None
            self._pending -= 1
        return found

    def _wait(self, within_s: float) -> float:
        """Wait until an answer begins; return the time that is left for it, s."""
        if not self._ignore_suspend:
            end_s = time.monotonic() + within_s
            return max(end_s - time.monotonic(), STEP_S) if self.pipe.poll(within_s) else 0.0
        stall = StallTimer()
        while (waited_s := stall.waited_s(0)) < within_s:
            if self.pipe.poll(STEP_S):
                return within_s - waited_s
        return 0.0


def _end_late(calls: weakref.ref[PipeCalls], closed: threading.Event) -> None:
    """Watch a child until its pipe is closed or it is no longer referenced; runs in a thread."""
    stall = StallTimer()
    while not closed.wait(STEP_S):
        watched = calls()
        if watched is None:
            return
        watched.end_late(stall)
        del watched


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
        decode: as `PipeCalls`; a pickle, the default, can run code in this process.
        within: command that runs the child, such as `unshare`; ends with it.

    Raises:
        LibraryError: it was not ready within `start_s`; the child has been killed.
        MainModuleError: `serve` is of the script that runs.
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
        decode: Callable[[bytes], tuple[bool, Any]] = pickle.loads,
        within: Sequence[str] = (),
    ) -> None:
        module, function = serve.split(":")
        refuse_main(module, function)
        self._what, self._error = what, error
        ours, theirs = socket.socketpair()
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the child
        given = ", ".join(map(repr, (theirs.fileno(), *arguments)))
        code = (
            # a stop of all processes is the parent's to handle, too: it stops the arm through this
            "import signal, sys; signal.signal(signal.SIGTERM, signal.SIG_IGN); "
            f"sys.path[:] = {sys.path!r}; from {module} import {function}; "
            f"{function}({given})"
        )
        with theirs:
            self._child = Child(
                [*within, sys.executable, "-c", code],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=self._log,
                stderr=self._log,
            )
        self._calls = PipeCalls(
            Connection(ours.detach()),
            partial(self._child.stop, KILL_S, at_once=True),
            pending=1,
            ignore_suspend=ignore_suspend,
            decode=decode,
        )
        try:
            self.begun: Any = self._result("connect", lambda: self._calls.answer(start_s))
        except BaseException:  # Ctrl-C too
            self.close()
            raise

    def call(self, name: str, *arguments: Any, within_s: float) -> Any:
        """Call a function of the child and return its result. Thread-safe; calls are serialised.

        Raises:
            LibraryError: the library raised, died, or did not answer within `within_s`. In the
                last two cases the child has ended and every later call fails at once.
        """
        if self._calls.pipe.closed or self._child.poll() is not None:
            raise self._error(f"{name}: the {self._what} has exited")
        message = name, arguments, within_s
        return self._result(name, lambda: self._calls.call(message, within_s))

    @property
    def pid(self) -> int:
        """Number of the child's process."""
        return self._child.pid

    def kill(self) -> None:
        """End the child now, whatever it is doing; safe to call more than once."""
        self._child.stop(KILL_S, at_once=True)

    def end(self) -> None:
        """Ask the child to end, kill it if it does not within `KILL_S`, and close."""
        with contextlib.suppress(OSError, ValueError):
            self._calls.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._child.wait(KILL_S)
        self.close()

    def close(self) -> None:
        """Kill the child and release its pipe and log."""
        self.kill()
        self._calls.close()
        self._log.close()

    def _result(self, name: str, answer: Callable[[], tuple[bool, Any]]) -> Any:
        try:
            fine, result = answer()
        except TimeoutError as error:
            raise self._error(f"{name}: {error}{self._output()}") from None
        except Exception:
            raise self._error(f"{name}: the {self._what} died{self._output()}") from None
        if not fine:
            raise self._error(f"{name}: {result}")
        return result

    def _output(self) -> str:
        """Return the child's last line of output, as text for a message."""
        size = os.fstat(self._log.fileno()).st_size
        # pread, because the child shares the file offset
        end = os.pread(self._log.fileno(), _OUTPUT_BYTES, max(0, size - _OUTPUT_BYTES))
        lines = end.decode(errors="replace").strip().splitlines()
        last = "".join(c if c.isprintable() else "?" for c in lines[-1]) if lines else ""
        return f" (its last output: {last[:_OUTPUT_CHARACTERS]})" if last else ""
