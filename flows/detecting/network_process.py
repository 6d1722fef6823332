"""A network in a separate process, so that the arm stops if the network hangs or crashes."""

from __future__ import annotations

import os
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.rigs.core.library_process import LibraryError, LibraryProcess

START_S = 180.0
"""Timeout for the process to start: kernels may have to be compiled, s."""
PATIENT_S = 30.0
"""Timeout of an answer in virtual time, where none is late, s."""


class NetworkLost(LibraryError):
    """The network's process died, or did not answer in time."""


class NetworkProcess:
    """A network in a separate process that counts spikes (`analysis.detectors.live.Counting`).

    Args:
        model: its file.
        answer_s: timeout of an answer.

    Raises:
        NetworkLost: it does not start.
    """

    def __init__(self, model: Path, answer_s: float) -> None:
        self._answer_s = answer_s
        self._process = LibraryProcess(
            "network's process", f"{__name__}:serve", (str(model),), START_S, NetworkLost
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


def serve(fd: int, model: str) -> None:
    """Run the process: answer windows from the pipe on `fd` until it closes."""
    pipe = Connection(fd)
    with suppress(EOFError, OSError):
        try:
            # only here, because the parent needs no second copy
            from sliplab.analysis.detectors.live import counting_of
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
        while True:
            _, (x,), _ = pipe.recv()
            answer: tuple[bool, Any]
            try:
                answer = True, counting(x)
            except Exception as error:
                answer = False, repr(error)
            pipe.send(answer)
    os._exit(0)
