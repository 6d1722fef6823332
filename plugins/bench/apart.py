"""A detector in a process of its own, which has nothing but what it was given.

The scenes, the seed of the test worlds and the truth stay with the judge. So a detector can neither
look ahead nor know where a slip is.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from typing import Any

from sliplab.analysis.detectors.detector import Cost, Detector, DetectorError, Evidence, Scene
from sliplab.analysis.detectors.registry import make_detector
from sliplab.rigs.core.library_process import LibraryError, LibraryProcess
from sliplab.storage.streams import EventChunk

START_S, ANSWER_S = 180.0, 180.0
"""Time limits to start, and of an answer: kernels may have to be compiled, s."""
TRAIN_S = 4 * 3600.0


class ApartDetector(Detector):
    """A detector by its name in a process of its own.

    Attributes:
        decisions_us: time of each `push` that brought decisions, over their number.

    Raises:
        DetectorError: it cannot be made, or does not start in time.
    """

    def __init__(self, name: str) -> None:
        self.decisions_us: list[float] = []
        with _as_detector_error():
            self._process = LibraryProcess(
                "detector's process", f"{__name__}:serve", (name, os.getcwd()), START_S
            )

    def train(self, scenes: Sequence[Scene], validation: Sequence[Scene]) -> None:
        """See `Detector`. Raises DetectorError."""
        self._call("train", tuple(scenes), tuple(validation), within_s=TRAIN_S)

    def begin(self, width: int, height: int) -> None:
        """See `Detector`. Raises DetectorError."""
        self._call("begin", width, height)

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        """See `Detector`. Raises DetectorError."""
        found, taken_us = self._call("push", events, until_us)
        if isinstance(found, Evidence) and len(found):
            self.decisions_us.append(taken_us / len(found))
        evidence: Evidence = found
        return evidence

    def cost(self) -> Cost:
        """See `Detector`. Raises DetectorError."""
        found: Cost = self._call("cost")
        return found

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
    except LibraryError as error:
        raise DetectorError(str(error)) from error


def serve(fd: int, name: str, folder: str) -> None:
    """Run the process: answer calls from the pipe on `fd` until it closes.

    Args:
        folder: that a detector's module or file may lie in.
    """
    pipe = Connection(fd)
    with suppress(EOFError, OSError):
        try:
            os.chdir(folder)
            os.environ["OMP_NUM_THREADS"] = "1"  # torch's threads wait for each other busily
            detector = make_detector(name)
        except Exception as error:
            pipe.send((False, _said(error)))
            os._exit(1)
        pipe.send((True, None))

        def push(events: EventChunk, until_us: int) -> tuple[Evidence, float]:
            start = time.perf_counter()
            found = detector.push(events, until_us)
            return found, 1e6 * (time.perf_counter() - start)

        calls: dict[str, Callable[..., Any]] = {
            "train": detector.train,
            "begin": detector.begin,
            "push": push,
            "cost": detector.cost,
        }
        try:
            while True:
                what, arguments, _ = pipe.recv()
                try:
                    answer = True, calls[what](*arguments)
                except Exception as error:  # another package's code: whatever it raises
                    answer = False, _said(error)
                pipe.send(answer)
        finally:
            detector.close()
    os._exit(0)


def _said(error: Exception) -> str:
    return str(error) if isinstance(error, DetectorError) else f"{type(error).__name__}: {error}"
