"""The network with its rule as a detector: events in, spikes and a class out for each window.

Events are counted into the windows that are open when they arrive, so no past event is stored or
binned again, and a window is evaluated by the functions that score a stored trial: the same
events give the same windows, counts and decisions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.detectors.detector import NOTHING_US, Evidence, JudgedWindow, StreamDetector
from sliplab.analysis.detectors.detectors import Predictions, Tuned
from sliplab.analysis.detectors.smoothing_rule import paper_rule
from sliplab.analysis.metrics.classification import CLASSES, GROSS, INCIPIENT
from sliplab.analysis.networks.training import Fitted
from sliplab.analysis.windows.windows import bin_events
from sliplab.protocols.detection import Detection
from sliplab.protocols.windows import Windows
from sliplab.storage.streams import EventChunk


@dataclass(frozen=True)
class RuleStep:
    """Answer of the rule after one more window.

    Attributes:
        value: evidence for incipient slip; -inf where there is none yet.
        smoothed: trailing mean counts in the order of `metrics.classification.CLASSES`, over the
            windows there are.
        valid_class: the detected class; -1 where none is valid.
        onset: ``incipient`` or ``gross`` where this window is the first such detection.
    """

    value: float
    smoothed: tuple[float, float, float]
    valid_class: int
    onset: str | None


class RunningRule:
    """A rule at its levels, window by window: the decisions of the whole trial, to the bit.

    After an interruption evidence is reset; onsets stay.

    Args:
        detection: the paper's rule by its settings, or another rule with its levels.
    """

    def __init__(self, detection: Detection | Tuned) -> None:
        self._tuned = paper_rule(detection) if isinstance(detection, Detection) else detection
        self._windows, self._incipient, self._gross = 0, False, False
        self._state: Any = self._tuned.detector.begin()

    @property
    def span(self) -> int:
        """Fewest windows that a decision is based on."""
        return self._tuned.detector.span

    def step(self, counts: npt.NDArray[np.integer[Any]], events: int = 0) -> RuleStep:
        """Take the output spikes, integer (3,), and events of the window after the last one.

        Raises:
            ValueError: another shape or type.
        """
        row = np.asarray(counts)
        if row.shape != (len(CLASSES),) or not np.issubdtype(row.dtype, np.integer):
            raise ValueError(f"counts are {row.dtype} {row.shape}; expected integers (3,)")
        self._windows += 1
        window = Predictions(
            row[None].astype(np.int64), np.array([events]), np.array([self._windows])
        )
        rule, levels = self._tuned.detector, self._tuned.levels
        self._state, evidence = rule.push(self._state, window)
        onset = None
        if not self._incipient:
            if evidence.incipient[0] > levels.incipient:
                self._incipient, onset = True, CLASSES[INCIPIENT]
                self._state = rule.detected(self._state)
        elif not self._gross and evidence.gross_after(-1)[0] > levels.gross:
            self._gross, onset = True, CLASSES[GROSS]
        a, b, c = evidence.smoothed[0].tolist()
        valid = int(self._tuned.classes(evidence, self._gross)[0])
        return RuleStep(float(evidence.incipient[0]), (a, b, c), valid, onset)

    def interrupt(self) -> None:
        """Forget the windows, as the next one does not follow them."""
        rule = self._tuned.detector
        self._state = rule.detected(rule.begin()) if self._incipient else rule.begin()


Counting = Callable[[npt.NDArray[np.uint8]], npt.NDArray[np.int64]]
"""Output spikes int64 (1, 3) of one window, uint8 (1, steps, channels, cells, cells)."""


def counting_of(fitted: Fitted) -> Counting:
    """The network's spike counts by the event-driven kernels, in the calling thread alone.

    Raises:
        InputError: its classes are not those of slip.
    """
    fitted.check_slip("the model", "detection")
    fast = fitted.engine
    return lambda x: fast.counts(x, 1)


@dataclass
class _Open:
    """A window that is still open."""

    start_us: int
    x: npt.NDArray[np.uint8]
    events: int = 0
    last_us: int | None = None


class NetworkDetector(StreamDetector):
    """A network and its rule; the labels are the rule's, -1 where no class is valid.

    The evidence is the rule's for incipient slip.

    Args:
        counts: the network.
        windows: shape of a sample.
        detection: sliding window and margin of the paper's rule, or another detector.
        centre_px: middle of the crop, as for `analysis.windows.windows.bin_events`.
        stride_us: from one window's start to the next one's; the window's length by default.
        starts: start of each window by its number, strictly increasing, instead of an even grid.

    Raises:
        ValueError: a stride that is not positive.
    """

    def __init__(
        self,
        counts: Counting,
        windows: Windows,
        detection: Detection | Tuned,
        *,
        centre_px: tuple[float, float] | None = None,
        stride_us: int | None = None,
        starts: Callable[[int], int] | None = None,
    ) -> None:
        self._counts, self._windows, self._detection = counts, windows, detection
        self._centre_px = centre_px
        if isinstance(detection, Tuned):
            self.level = detection.levels.incipient
        self._length_us = windows.length_ms * 1000
        stride = self._length_us if stride_us is None else stride_us
        if stride <= 0:
            raise ValueError(f"stride_us = {stride}: must be positive")
        self._start = starts or (lambda number: number * stride)
        self._rule = RunningRule(detection)
        self.span_us = self._length_us + (self._rule.span - 1) * stride

    def begin(self, width: int, height: int) -> None:
        """See `Detector`.

        Raises:
            ValueError: the crop is larger than the sensor.
        """
        self._geometry = (width, height, self._centre_px)
        self._rule = RunningRule(self._detection)
        self._open: dict[int, _Open] = {}
        self._next, self._settled_us = 0, NOTHING_US
        self._bin(EventChunk.empty(), 0)

    def warm_up(self, width: int, height: int) -> None:
        """See `StreamDetector`."""
        self._counts(self._empty())

    def resume(self, at_us: int) -> None:
        """Give up open windows; the sliding window restarts, and onsets stay."""
        self._open.clear()
        self._rule.interrupt()
        self._next = self._first_from(at_us)
        self._settled_us = self._start(self._next)

    @property
    def settled_us(self) -> int:
        """End of the last window that was evaluated, or start of the first one after a gap."""
        return self._settled_us

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        """See `StreamDetector`. Raises ValueError for an event outside the sensor."""
        last_us = int(events.t_us[-1]) if len(events) else None
        ends, steps, windows = [], [], []
        number = self._next
        while True:
            start_us = self._start(number)
            ended = start_us + self._length_us <= until_us
            begun = last_us is not None and start_us <= last_us
            if begun:
                self._fill(number, start_us, events)
            if ended:
                step, window = self._judge(number, start_us)
                ends.append(self._settled_us)
                steps.append(step)
                windows.append(window)
            elif not begun:
                break
            number += 1
        values, labels = [step.value for step in steps], [step.valid_class for step in steps]
        return Evidence(
            np.array(ends, np.int64),
            np.array(values, np.float64),
            np.array(labels, np.int8),
            tuple(windows),
        )

    def _fill(self, number: int, start_us: int, chunk: EventChunk) -> None:
        """Count the events of one window, which is opened for them."""
        bounds = np.searchsorted(chunk.t_us, [start_us, start_us + self._length_us])
        begin, end = bounds.tolist()
        window = self._opened(number, start_us)
        if begin == end:
            return
        more = self._bin(chunk[begin:end], start_us)
        # 255 stays 255, as if all had been counted at once
        window.x += np.minimum(more, 255 - window.x)
        window.events += end - begin
        last_us = int(chunk.t_us[end - 1])
        window.last_us = last_us if window.last_us is None else max(window.last_us, last_us)

    def _bin(self, chunk: EventChunk, start_us: int) -> npt.NDArray[np.uint8]:
        starts = np.array([start_us], np.int64)
        return bin_events(chunk, starts, self._windows, *self._geometry)

    def _opened(self, number: int, start_us: int) -> _Open:
        if number not in self._open:
            self._open[number] = _Open(start_us, self._empty())
        return self._open[number]

    def _empty(self) -> npt.NDArray[np.uint8]:
        w = self._windows
        return np.zeros((1, w.steps, w.channels, w.cells, w.cells), np.uint8)

    def _judge(self, number: int, start_us: int) -> tuple[RuleStep, JudgedWindow]:
        """Close the first window that is not evaluated."""
        window = self._opened(number, start_us)
        del self._open[number]
        counts = self._counts(window.x)[0]
        step = self._rule.step(counts, window.events)
        self._next, self._settled_us = number + 1, start_us + self._length_us
        a, b, c = counts.tolist()
        judged = JudgedWindow(
            number, start_us, window.events, window.last_us, (a, b, c), step.smoothed
        )
        return step, judged

    def _first_from(self, t_us: int) -> int:
        """Number of the first window, not judged yet, that begins at `t_us` or later."""
        low, step = self._next, 1
        while self._start(low + step) < t_us:
            step *= 2
        high = low + step
        while low < high:
            middle = (low + high) // 2
            low, high = (low, middle) if self._start(middle) >= t_us else (middle + 1, high)
        return low
