"""The detection rule one window at a time: what a running detector can know at each moment.

`analysis.detect.detection.detect` sees a whole trial at once. On a live stream the same answer is
needed after each window and in bounded memory; this file gives it, to the bit.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.nets.metrics import CLASSES, GROSS, INCIPIENT, winners
from sliplab.protocols.settings import Detection


@dataclass(frozen=True)
class Step:
    """What the rule says after one more window.

    Attributes:
        smoothed: trailing mean counts in the order of `analysis.nets.metrics.CLASSES`, over the
            windows there are.
        valid_class: the detected class; -1 where none is valid.
        onset: ``incipient`` or ``gross`` where this window is the first such detection.
    """

    smoothed: tuple[float, float, float]
    valid_class: int
    onset: str | None


class StepRule:
    """The rule of `analysis.detect.detection.detect` window by window; holds `smoothing` rows."""

    def __init__(self, settings: Detection) -> None:
        self._width = settings.smoothing
        self._lead = settings.margin * settings.smoothing
        self._held: deque[npt.NDArray[np.int64]] = deque()
        self._sum = np.zeros(len(CLASSES), np.int64)
        self._incipient = self._gross = False

    def step(self, counts: npt.NDArray[np.integer[Any]]) -> Step:
        """Take the counts, integer (3,), of the window after the last one.

        Raises:
            ValueError: another shape or type.
        """
        row = np.asarray(counts)
        if row.shape != (len(CLASSES),) or not np.issubdtype(row.dtype, np.integer):
            raise ValueError(f"counts are {row.dtype} {row.shape}; expected integers (3,)")
        row = row.astype(np.int64)
        self._held.append(row)
        self._sum = self._sum + row
        if len(self._held) > self._width:
            self._sum = self._sum - self._held.popleft()
        valid = -1
        if len(self._held) == self._width:
            valid = int(winners(self._sum[None], self._lead)[0])
        a, b, c = (self._sum / len(self._held)).tolist()
        return Step((a, b, c), valid, self._onset(valid))

    def interrupt(self) -> None:
        """Forget the windows so far: the next one does not follow them. Onsets found stay found."""
        self._held.clear()
        self._sum = np.zeros(len(CLASSES), np.int64)

    def _onset(self, valid: int) -> str | None:
        if not self._incipient:
            self._incipient = valid == INCIPIENT
            return CLASSES[INCIPIENT] if self._incipient else None
        if not self._gross and valid == GROSS:
            self._gross = True
            return CLASSES[GROSS]
        return None
