"""A network or a detector in a separate process, so that the arm stops if it hangs or crashes."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.detectors.alarms import Level
from sliplab.analysis.detectors.detector import Detector, DetectorError, Evidence
from sliplab.rigs.core.library_process import LibraryError, LibraryProcess
from sliplab.rigs.core.real_time import BELOW, real_time
from sliplab.storage.streams import EventChunk

START_S = 180.0
"""Timeout for the process to start: kernels may have to be compiled, s."""
TRAIN_S = 3600.0
"""The same where it trains a detector first, s."""
PATIENT_S = 30.0
"""Timeout of an answer in virtual time, where none is late, s."""

WORK = ("push", "counts")
"""Calls that compute; the first of each process is before the arm moves (`warm_up`)."""


@dataclass(frozen=True)
class OwnProcess:
    """How a separate process runs.

    Attributes:
        answer_s: timeout of an answer.
        real_time: with real-time priority, where the system allows it.
    """

    answer_s: float
    real_time: bool = False


class NetworkLost(LibraryError):
    """The network's process died, or did not answer in time."""


class NetworkProcess:
    """A network in a separate process: a `Counting` of `analysis.detectors.network_detector`.

    Args:
        model: its file.
        run: how the process runs.

    Raises:
        NetworkLost: it does not start.
    """

    def __init__(self, model: Path, run: OwnProcess) -> None:
        self._answer_s = run.answer_s
        arguments = str(model), run.real_time
        self._process = LibraryProcess(
            "network's process", f"{__name__}:serve", arguments, START_S, NetworkLost
        )

    def __call__(self, x: npt.NDArray[np.uint8]) -> npt.NDArray[np.int64]:
        """Return the output spikes of one window. Raises NetworkLost."""
        counts: npt.NDArray[np.int64] = self._process.call("counts", x, within_s=self._answer_s)
        return counts

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def kill(self) -> None:
        """End the process at once, for tests; every later call fails."""
        self._process.kill()

    def close(self) -> None:
        """End the process."""
        self._process.end()


class DetectorProcess(Detector):
    """A detector by its name in a separate process, which trains it.

    Args:
        name, level, store, promise: as `flows.detecting.sources.NamedSource`.
        run: how the process runs; the first answer takes longer where kernels are compiled.

    Raises:
        DetectorError: it does not start.
    """

    def __init__(
        self,
        name: str,
        level: float | None,
        store: Path | None,
        promise: float | None,
        run: OwnProcess,
    ) -> None:
        self._answer_s, self._warm = run.answer_s, False
        arguments = name, level, None if store is None else str(store), promise, run.real_time
        with _as_detector_error():
            self._process = LibraryProcess(
                "detector's process", f"{__name__}:serve_detector", arguments, TRAIN_S
            )
            self.level: float = self._process.call("level", within_s=PATIENT_S)
            self.set_by: Level | None = self._process.call("set_by", within_s=PATIENT_S)

    def begin(self, width: int, height: int) -> None:
        """See `Detector`. Raises DetectorError."""
        with _as_detector_error():
            self._process.call("begin", width, height, within_s=PATIENT_S)

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        """See `Detector`. Raises DetectorError."""
        within_s = self._answer_s if self._warm else START_S
        with _as_detector_error():
            found: Evidence = self._process.call("push", events, until_us, within_s=within_s)
        self._warm = True
        return found

    def close(self) -> None:
        """End the process."""
        self._process.end()


@contextmanager
def _as_detector_error() -> Iterator[None]:
    try:
        yield
    except LibraryError as error:
        raise DetectorError(str(error)) from error


def serve_detector(
    fd: int,
    name: str,
    level: float | None,
    store: str | None,
    promise: float | None,
    first: bool,
) -> None:
    """Run the process: train the detector, then answer calls from the pipe on `fd`."""
    pipe = Connection(fd)
    with suppress(EOFError, OSError):
        try:
            # only here, because the parent needs no second copy
            from sliplab.analysis.detectors.named import named_detector
            from sliplab.analysis.networks import training

            training.limit_threads(1)
            made = named_detector(name, level, None if store is None else Path(store), promise)
        except Exception as error:
            pipe.send((False, str(error)))
            os._exit(1)
        pipe.send((True, None))
        detector = made.detector
        calls: dict[str, Callable[..., Any]] = {
            "level": lambda: made.level,
            "set_by": lambda: made.set_by,
            "begin": detector.begin,
            "push": detector.push,
        }
        _answer(pipe, lambda what, arguments: calls[what](*arguments), first)
        made.close()
    os._exit(0)


def _answer(pipe: Connection, work: Callable[[str, tuple[Any, ...]], Any], first: bool) -> None:
    """Answer calls until the pipe closes.

    Args:
        first: with real-time priority from the second piece of work on: in the first one, before
            the arm moves, kernels are compiled.
    """
    with ExitStack() as done, suppress(EOFError, OSError):
        while True:
            what, arguments, _ = pipe.recv()
            answer: tuple[bool, Any]
            try:
                answer = True, work(what, arguments)
            except Exception as error:
                answer = False, repr(error)
            if first and what in WORK:
                done.enter_context(real_time(BELOW))
                first = False
            pipe.send(answer)


def serve(fd: int, model: str, first: bool) -> None:
    """Run the process: answer windows from the pipe on `fd` until it closes."""
    pipe = Connection(fd)
    with suppress(EOFError, OSError):
        try:
            # only here, because the parent needs no second copy
            from sliplab.analysis.detectors.network_detector import counting_of
            from sliplab.analysis.networks import model_file, training

            training.limit_threads(1)
            fitted = model_file.load(Path(model))
            counting, w = counting_of(fitted), fitted.windows
            # the first window must not wait for what is loaded and compiled
            counting(np.zeros((1, w.steps, w.channels, w.cells, w.cells), np.uint8))
        except Exception as error:
            pipe.send((False, str(error)))
            os._exit(1)
        pipe.send((True, None))
        _answer(pipe, lambda what, arguments: counting(*arguments), first)
    os._exit(0)
