"""Detectors of event windows: windows are cut from the stream, and some are decided at once."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.special import log_softmax

from sliplab.analysis.detectors.detector import Detector, Evidence, Scene
from sliplab.analysis.metrics.classification import GROSS, INCIPIENT, NO_SLIP
from sliplab.analysis.windows.dataset import SampleSet, TrialId
from sliplab.analysis.windows.samples import choose_windows
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.analysis.windows.windows import list_events
from sliplab.protocols.windows import Windows
from sliplab.storage.streams import EventChunk

PER_CLASS = 50
"""Windows of a class and training scene at most, as in the paper."""


class WindowDetector(Detector):
    """A detector that answers at the end of each window.

    Args:
        windows: shape of a window.
        stride_ms: from one window's start to the next one's.
    """

    def __init__(self, windows: Windows, stride_ms: int) -> None:
        self.windows = windows
        self._length_us, self._stride_us = windows.length_ms * 1000, stride_ms * 1000

    def begin(self, width: int, height: int) -> None:
        """See `Detector`."""
        self._size = (width, height)
        self._held = EventChunk.empty()
        self._next_us = 0
        self.restart()

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        """See `Detector`."""
        held = EventChunk.concatenate([self._held, events])
        starts = np.arange(
            self._next_us, until_us - self._length_us + 1, self._stride_us, dtype=np.int64
        )
        if len(starts):
            self._next_us = int(starts[-1]) + self._stride_us
        x = list_events(held, starts, self.windows, *self._size)
        old = slice(int(np.searchsorted(held.t_us, self._next_us)), None)
        self._held = held[old]
        if not len(starts):
            return Evidence.of([], [])
        value, label = self.decide(x)
        return Evidence.of(starts + self._length_us, value, label)

    @abstractmethod
    def decide(self, x: SparseWindows) -> tuple[npt.ArrayLike, npt.ArrayLike | None]:
        """Return evidence (n,) of the next windows, and their classes (n,) or None."""

    def restart(self) -> None:
        """Forget the windows of the last scene. By default none are stored."""


def samples(scenes: Sequence[Scene], windows: Windows, *, by_paper: bool = False) -> SampleSet:
    """Return windows of scenes for training, as the paper selects them.

    Args:
        by_paper: incipient slip begins by the 2-pixel rule and not with the first tip's sliding.
    """
    parts = []
    for number, scene in enumerate(scenes):
        slip = scene.slip
        onset_us = slip.incipient_us(by_paper)
        chosen = choose_windows(
            0, scene.end_us, onset_us, slip.gross_us, windows.length_ms * 1000, PER_CLASS, number
        )
        starts = np.concatenate([chosen[key] for key in sorted(chosen)])
        classes = np.concatenate([np.full(len(chosen[key]), key) for key in sorted(chosen)])
        x = list_events(scene.events, starts, windows, scene.width, scene.height)
        nothing = np.zeros(len(starts), np.int64)
        name = (TrialId("bench", scene.name),)
        parts.append(SampleSet(x, classes.astype(np.int64), nothing, starts * 1000, name))
    return SampleSet.join(parts, windows)


LARGEST = 6.0
"""Largest log odds of a window, either way: classifiers are surer of themselves than they may."""
SMOOTHED = 6
"""Windows over which log odds are averaged."""


class MeanOdds:
    """Mean log odds of slip over the last windows, of windows that follow each other."""

    def __init__(self) -> None:
        self._last = np.empty(0)

    def step(
        self, votes: npt.NDArray[np.floating]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
        """Return evidence and class of the next windows, (n,) each.

        Args:
            votes: log odds of the classes (n, 3), up to a constant a window.
        """
        log_p = log_softmax(votes.astype(np.float64), axis=1)
        slip = np.logaddexp(log_p[:, INCIPIENT], log_p[:, GROSS])
        odds = np.clip(slip - log_p[:, NO_SLIP], -LARGEST, LARGEST)
        every = np.concatenate([self._last, odds])
        self._last = every[-SMOOTHED + 1 :]
        sums = np.concatenate([[0.0], every.cumsum()])
        ends = np.arange(len(every) - len(odds), len(every)) + 1
        begins = np.maximum(ends - SMOOTHED, 0)
        return (sums[ends] - sums[begins]) / (ends - begins), log_p.argmax(axis=1)


class Classifier(WindowDetector):
    """A classifier of single windows; its evidence is the mean log odds of the last windows."""

    def restart(self) -> None:
        """See `WindowDetector`."""
        self._odds = MeanOdds()

    def decide(self, x: SparseWindows) -> tuple[npt.ArrayLike, npt.ArrayLike | None]:
        """See `WindowDetector`."""
        return self._odds.step(self.votes(x))

    @abstractmethod
    def votes(self, x: SparseWindows) -> npt.NDArray[np.floating]:
        """Return log odds of each window's classes (n, 3), up to a constant a window."""
