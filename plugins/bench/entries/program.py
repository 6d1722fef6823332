"""A program as an entry, in any language: it reads events on standard input and answers on output.

All numbers are little-endian. The program is given messages with a head of 16 bytes, ``char
kind[4]; uint32_t n; int64_t value``:

- ``SCEN``: a scene begins at time 0; `n` and `value` are the sensor's width and height.
- ``EVTS``: `n` events follow, complete up to `value` microseconds, each of 16 bytes: ``int64_t
  t_us; uint16_t x, y; uint8_t p; uint8_t unused[3]``. To be answered by a head of the kind
  ``EVID``, `n` the number of its records and `value` anything, and records of 24 bytes: ``int64_t
  t_us; double value; int32_t label; int32_t unused``; label -1 is without a class.

Standard input is closed at the end. A program that does not answer in time is killed.
"""

from __future__ import annotations

import os
import selectors
import shlex
import signal
import struct
import subprocess
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np

from sliplab.analysis.detectors.detector import Detector, DetectorError, Evidence
from sliplab.protocols.errors import InputError
from sliplab.storage.process import start_tethered, started_ticks
from sliplab.storage.streams import EventChunk

HEAD = struct.Struct("<4sIq")
EVENT = np.dtype([("t_us", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "u1"), ("unused", "u1", (3,))])
ANSWER = np.dtype([("t_us", "<i8"), ("value", "<f8"), ("label", "<i4"), ("unused", "<i4")])
MOST = 1_000_000
"""Records of an answer."""
_PIPE = 1 << 16


class ExternalProcess(Detector):
    """A process that speaks the protocol of the module's docstring.

    Args:
        command: in shell syntax; no shell runs it.
        answer_s: longest wait for an answer. end_s: for its end.

    Raises:
        InputError: there is no such program.
    """

    def __init__(self, command: str, answer_s: float = 60.0, end_s: float = 2.0) -> None:
        words = shlex.split(command)
        if not words:
            raise InputError("DETECTOR", "", "run:", "must name a command, such as run:./detector")
        self._command, self._answer_s, self._end_s = command, answer_s, end_s
        self._open = True
        try:
            # Ctrl-C ends it by `close`
            self._process = start_tethered(
                words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
            )
        except OSError as error:
            text = f"cannot be started: {error.strerror}"
            raise InputError("DETECTOR", "", f"run:{command}", text) from None
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        self._pipes = self._process.stdin, self._process.stdout, self._process.stderr
        self._input, self._output, self._errors = (pipe.fileno() for pipe in self._pipes)
        for number in (self._input, self._output, self._errors):
            os.set_blocking(number, False)
        self._read = bytearray()
        self._last_errors = b""

    def begin(self, width: int, height: int) -> None:
        """See `Detector`."""
        self._exchange(HEAD.pack(b"SCEN", width, height), 0)

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        """See `Detector`."""
        records = np.zeros(len(events), EVENT)
        for name in ("t_us", "x", "y", "p"):
            records[name] = getattr(events, name)
        sent = HEAD.pack(b"EVTS", len(events), until_us) + records.tobytes()
        kind, count, _ = HEAD.unpack(self._exchange(sent, HEAD.size))
        if kind != b"EVID" or count > MOST:
            raise DetectorError(
                f"{self._command}: answered {kind!r} with {count} records; must be b'EVID' with "
                f"{MOST} at most"
            )
        found = np.frombuffer(self._exchange(b"", count * ANSWER.itemsize), ANSWER)
        return Evidence.of(found["t_us"], found["value"], found["label"])

    def _exchange(self, sent: bytes, wanted: int) -> bytes:
        """Write, and return so many bytes of what is answered.

        Raises:
            DetectorError: the program ended, or did not answer in time.
        """
        left, until_s = memoryview(sent), time.monotonic() + self._answer_s
        with selectors.DefaultSelector() as waiting:
            waiting.register(self._output, selectors.EVENT_READ)
            waiting.register(self._errors, selectors.EVENT_READ)
            if left:
                waiting.register(self._input, selectors.EVENT_WRITE)
            while left or len(self._read) < wanted:
                ready = waiting.select(max(until_s - time.monotonic(), 0.0))
                if not ready or time.monotonic() > until_s:
                    self.close()
                    raise DetectorError(
                        f"{self._command}: has not answered in {self._answer_s:g} s, and was killed"
                    )
                if len(self._read) > MOST * ANSWER.itemsize + HEAD.size:
                    self.close()
                    raise DetectorError(f"{self._command}: writes without end, and was killed")
                for key, _ in ready:
                    if key.fd == self._output:
                        self._take()
                    elif key.fd == self._errors:
                        if not self._take_errors():
                            waiting.unregister(self._errors)
                    else:
                        try:
                            left = left[os.write(self._input, left[:_PIPE]) :]
                        except BrokenPipeError:  # the reader reports the end
                            left = left[:0]
                        if not left:
                            waiting.unregister(self._input)
        found = bytes(self._read[:wanted])
        del self._read[:wanted]
        return found

    def _take(self) -> None:
        """Read what has come."""
        found = os.read(self._output, _PIPE)
        if found:
            self._read += found
            return
        ended = self._wait()
        while self._take_errors():
            pass
        lines = self._last_errors.decode(errors="replace").strip().splitlines()
        last = f": {lines[-1]}" if lines else ""
        self.close()
        code = self._process.returncode
        how = f"ended with exit code {code}" if ended else "closed its output"
        raise DetectorError(f"{self._command}: {how}{last}")

    def _wait(self) -> bool:
        """Wait for the end of the process, bounded; return whether it has ended."""
        until_s = time.monotonic() + self._end_s
        while not (ended := _ended(self._process.pid)) and time.monotonic() < until_s:
            threading.Event().wait(0.01)
        return ended

    def _take_errors(self) -> bool:
        """Read what the program says of errors, and keep its end; False at the end, or if none."""
        try:
            found = os.read(self._errors, _PIPE)
        except BlockingIOError:
            return False
        self._last_errors = (self._last_errors + found)[-_PIPE:]
        return bool(found)

    def close(self) -> None:
        """End the process, and kill what is left of it and of the processes that it started."""
        if not self._open:
            return
        self._open = False
        started = _descendants(self._process.pid)
        with suppress(OSError):
            self._pipes[0].close()
        self._wait()
        started |= _descendants(self._process.pid)
        with suppress(ProcessLookupError):  # before it is reaped: its number is not reused yet
            os.killpg(self._process.pid, signal.SIGKILL)
        for pid, began in started:
            if started_ticks(pid) == began:  # the same process still
                with suppress(ProcessLookupError, PermissionError):
                    os.kill(pid, signal.SIGKILL)
        self._process.wait()
        for pipe in self._pipes[1:]:
            pipe.close()


def _ended(pid: int) -> bool:
    """Return whether a child has ended; it stays to be reaped."""
    return os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None


def _descendants(pid: int) -> set[tuple[int, int]]:
    """Return the processes that a process has started, and those started by them, with times."""
    found: set[tuple[int, int]] = set()
    todo = [pid]
    while todo:
        for children in Path(f"/proc/{todo.pop()}/task").glob("*/children"):
            with suppress(OSError):
                for child in map(int, children.read_text().split()):
                    if (began := started_ticks(child)) is not None and (child, began) not in found:
                        found.add((child, began))
                        todo.append(child)
    return found
