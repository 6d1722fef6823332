"""A detector in a process of its own, which has nothing but what it was given.

The scenes, the seed of the test worlds and the truth are in the judge's memory, and nowhere else.
So a detector can neither look ahead nor know where a slip is. The judge imports nothing of it, and
reads its answers as numbers and text: bytes of evidence (`ANSWER`), or JSON. Where the system has
namespaces, the detector's process sees no other one but those that it starts.
"""

from __future__ import annotations

import json
import math
import os
import struct
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from sliplab.analysis.detectors.detector import (
    Cost,
    Detector,
    DetectorError,
    Evidence,
    Scene,
    checked,
)
from sliplab.analysis.detectors.registry import contents, make_detector
from sliplab.plugins.bench.entries.program import ANSWER
from sliplab.protocols.errors import InputError
from sliplab.rigs.core.library_process import LibraryError, LibraryProcess
from sliplab.storage.streams import EventChunk

START_S, ANSWER_S = 180.0, 180.0
"""Time limits to start, and of an answer: kernels may have to be compiled, s."""
TRAIN_S = 4 * 3600.0
ALONE = (
    *("unshare", "--user", "--map-user=65534", "--ipc", "--pid", "--fork", "--kill-child"),
    "--mount-proc",
)
"""Runs a command that sees no process but its own, with the files of this user."""
_FAILED, _JSON, _EVIDENCE = b"f", b"j", b"e"
_TIME = struct.Struct("<d")


@cache
def alone() -> tuple[str, ...]:
    """Return `ALONE`; nothing where the system does not allow it."""
    with suppress(OSError, subprocess.SubprocessError):
        subprocess.run([*ALONE, "true"], check=True, capture_output=True, timeout=START_S)
        return ALONE
    return ()


class ApartDetector(Detector):
    """A detector by its name in a process of its own.

    Attributes:
        contents: text that changes with the detector's files, see `registry.contents`.
        decisions_us: time of each `push` that brought decisions, over their number.

    Raises:
        DetectorError: it cannot be made, or does not start in time.
    """

    def __init__(self, name: str) -> None:
        self.decisions_us: list[float] = []
        with _as_detector_error():
            self._process = LibraryProcess(
                "detector's process",
                f"{__name__}:serve",
                (name, os.getcwd()),
                START_S,
                decode=decoded,
                within=alone(),
            )
        self.contents = str(self._process.begun)

    def train(self, scenes: Sequence[Scene], validation: Sequence[Scene]) -> None:
        """See `Detector`. Raises DetectorError."""
        self._call("train", tuple(scenes), tuple(validation), within_s=TRAIN_S)

    def begin(self, width: int, height: int) -> None:
        """See `Detector`. Raises DetectorError."""
        self._call("begin", width, height)

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        """See `Detector`. Raises DetectorError."""
        found: Evidence
        found, taken_us = self._call("push", events, until_us)
        if len(found):
            self.decisions_us.append(taken_us / len(found))
        return found

    def cost(self) -> Cost:
        """See `Detector`. Raises DetectorError."""
        found = self._call("cost")
        if not isinstance(found, list) or not all(
            it is None or (isinstance(it, int | float) and 0 <= it < math.inf) for it in found
        ):
            raise DetectorError(f"cost = {found}: must be positive numbers or None")
        operations, memory_bytes = found
        return Cost(operations, None if memory_bytes is None else int(memory_bytes))

    def close(self) -> None:
        """End the process."""
        self._process.end()

    def _call(self, name: str, *arguments: object, within_s: float = ANSWER_S) -> Any:
        with _as_detector_error():
            return self._process.call(name, *arguments, within_s=within_s)


@contextmanager
def _as_detector_error() -> Iterator[None]:
    try:
        yield
    except LibraryError as error:  # without the call's name
        raise DetectorError(str(error).partition(": ")[2]) from error


def decoded(data: bytes) -> tuple[bool, Any]:
    """Return what `serve` sent: whether a call succeeded, and its result or error.

    Raises:
        ValueError: `serve` did not send this.
    """
    kind, rest = data[:1], data[1:]
    if kind == _FAILED:
        return False, rest.decode("utf-8", "replace")
    if kind == _JSON:
        return True, json.loads(rest)
    taken_us = _TIME.unpack_from(rest)[0]
    if kind != _EVIDENCE or not 0 <= taken_us < math.inf:
        raise ValueError("no answer of a detector's process")
    found = np.frombuffer(rest, ANSWER, offset=_TIME.size)
    return True, (Evidence.of(found["t_us"], found["value"], found["label"]), taken_us)


def serve(fd: int, name: str, folder: str) -> None:
    """Run the process: answer calls from the pipe on `fd` until it closes.

    Args:
        folder: that a detector's module or file may lie in.
    """
    pipe = Connection(fd)
    before_us = 0
    with suppress(EOFError, OSError):
        try:
            os.chdir(folder)
            os.environ["OMP_NUM_THREADS"] = "1"  # torch's threads wait for each other busily
            detector = make_detector(name)
            pipe.send_bytes(_as_json(contents(name)))
        except Exception as error:
            pipe.send_bytes(_said(error))
            os._exit(1)

        def train(*given: Sequence[Scene]) -> bytes:
            detector.train(*given)
            return _as_json(None)

        def begin(width: int, height: int) -> bytes:
            nonlocal before_us
            before_us = 0
            detector.begin(width, height)
            return _as_json(None)

        def push(events: EventChunk, until_us: int) -> bytes:
            nonlocal before_us
            start = time.perf_counter()
            found = detector.push(events, until_us)
            taken_us = 1e6 * (time.perf_counter() - start)
            found = checked(found, before_us, until_us)
            before_us = until_us
            records = np.zeros(len(found), ANSWER)
            for column in ("t_us", "value", "label"):
                records[column] = getattr(found, column)
            return _EVIDENCE + _TIME.pack(taken_us) + records.tobytes()

        def cost() -> bytes:
            found = detector.cost()
            return _as_json([_number(found.operations), _number(found.memory_bytes)])

        calls: dict[str, Callable[..., bytes]] = {
            "train": train,
            "begin": begin,
            "push": push,
            "cost": cost,
        }
        try:
            while True:
                what, arguments, _ = pipe.recv()
                try:
                    answer = calls[what](*arguments)
                except Exception as error:  # another package's code: whatever it raises
                    answer = _said(error)
                pipe.send_bytes(answer)
        finally:
            detector.close()
    os._exit(0)


def _as_json(found: object) -> bytes:
    return _JSON + json.dumps(found).encode()


def _number(stated: float | None) -> float | None:
    return None if stated is None else float(stated)


def _said(error: Exception) -> bytes:
    if isinstance(error, InputError) and error.file == "DETECTOR":
        text = error.expected  # who called knows the name
    else:
        plain = isinstance(error, DetectorError | InputError)
        text = str(error) if plain else f"{type(error).__name__}: {error}"
    return _FAILED + text.encode("utf-8", "replace")
