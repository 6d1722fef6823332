"""The detector on a running stream: events in as they come, one decision out for each window.

Events are counted into the windows that are open when they arrive, so no past event is stored or
binned again, and a window is evaluated by the functions that score a stored trial: the same
events give the same windows, counts and decisions. What a stream does that a file does not
(silence, events out of order, events too late, a clock that leaps) has one outcome each:

- A window ends when an event at or after its end has come, or when `advance` says that the
  camera's clock is past it; so a quiet scene is evaluated too.
- Events out of order count where they belong while their window is open.
- An event of an already evaluated window is dropped and counted as late; nothing is revised.
- Time that leaps ahead by more than `gap_us` is a gap: the open windows are given up, the sliding
  window restarts, and the gap is counted.
- Time that falls back by more than `back_us` is another clock: `ClockFellBack`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypedDict

import numpy as np
import numpy.typing as npt

from sliplab.analysis.detectors.detectors import Predictions, Tuned
from sliplab.analysis.detectors.smoothing_rule import paper_rule
from sliplab.analysis.metrics.classification import CLASSES, GROSS, INCIPIENT
from sliplab.analysis.networks.training import Fitted
from sliplab.analysis.windows.windows import bin_events
from sliplab.protocols.detection import Detection
from sliplab.protocols.windows import Windows
from sliplab.storage.streams import EventChunk

UNDECIDED = "undecided"


@dataclass(frozen=True)
class LiveDecision:
    """Decision on one window. Times on the camera's clock, microseconds.

    Attributes:
        number: of the window, from 0; gaps leave numbers out.
        counts: output spikes in the order of `analysis.metrics.classification.CLASSES`.
        smoothed, valid_class, onset: as `RuleStep`.
        events: events of the window, all over the sensor and of both polarities.
        last_event_us: the latest of them; None in a window without events.
        by_event: an event ended the window, and not the clock alone.
        decided_ns: monotonic clock when the decision was there.
    """

    number: int
    start_us: int
    end_us: int
    counts: tuple[int, int, int]
    smoothed: tuple[float, float, float]
    valid_class: int
    onset: str | None
    events: int
    last_event_us: int | None
    by_event: bool
    decided_ns: int = field(compare=False)


class DecisionJson(TypedDict):
    """`TimedDecision` as one line of the decisions' file."""

    window: int
    start_us: int
    end_us: int
    trial_s: float
    phase: str
    state: str
    onset: str | None
    counts: list[int]
    smoothed: list[float]
    events: int
    by_event: bool
    latency_ms: float | None
    compute_ms: float


@dataclass(frozen=True)
class TimedDecision:
    """A decision and its times.

    Attributes:
        trial_s: end of the window since the stream began, on the camera's clock.
        phase: of the motion in which it was made; empty where nothing moves.
        latency_ms: from the window's last event to the decision, on the rig's clock, the freshest
            arrival counting as immediate; None in a window without events.
        compute_ms: from when the events were read to the decision.
    """

    decision: LiveDecision
    trial_s: float
    phase: str
    latency_ms: float | None
    compute_ms: float

    @property
    def state(self) -> str:
        """The valid class by name, or `UNDECIDED`."""
        return state_name(self.decision.valid_class)

    def as_json(self) -> DecisionJson:
        """Return it as one line of the decisions' file."""
        made = self.decision
        return {
            "window": made.number,
            "start_us": made.start_us,
            "end_us": made.end_us,
            "trial_s": self.trial_s,
            "phase": self.phase,
            "state": self.state,
            "onset": made.onset,
            "counts": list(made.counts),
            "smoothed": list(made.smoothed),
            "events": made.events,
            "by_event": made.by_event,
            "latency_ms": self.latency_ms,
            "compute_ms": self.compute_ms,
        }


def state_name(valid_class: int) -> str:
    """Return the name of a valid class."""
    return UNDECIDED if valid_class < 0 else CLASSES[valid_class]


@dataclass
class StreamFaults:
    """Faults of a live stream that stored trials do not have."""

    late: int = 0
    """Events left out: their window had been evaluated."""
    disordered: int = 0
    """Events that came after a younger one, the late ones among them."""
    gaps: int = 0
    longest_gap_us: int = 0


@dataclass(frozen=True)
class RuleStep:
    """Answer of the rule after one more window.

    Attributes:
        smoothed: trailing mean counts in the order of `metrics.classification.CLASSES`, over the
            windows there are.
        valid_class: the detected class; -1 where none is valid.
        onset: ``incipient`` or ``gross`` where this window is the first such detection.
    """

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
        return RuleStep((a, b, c), int(self._tuned.classes(evidence, self._gross)[0]), onset)

    def interrupt(self) -> None:
        """Forget the windows, as the next one does not follow them."""
        rule = self._tuned.detector
        self._state = rule.detected(rule.begin()) if self._incipient else rule.begin()


Counting = Callable[[npt.NDArray[np.uint8]], npt.NDArray[np.int64]]
"""Output spikes int64 (1, 3) of one window, uint8 (1, steps, channels, cells, cells)."""

GAP_US = 10_000_000
BACK_US = 1_000_000


class ClockFellBack(ValueError):
    """The camera's clock fell back, so that earlier times cannot be compared."""


@dataclass
class _Open:
    """A window that is still open."""

    start_us: int
    x: npt.NDArray[np.uint8]
    events: int = 0
    last_us: int | None = None


def counting_of(fitted: Fitted) -> Counting:
    """The network's spike counts by the event-driven kernels, in the calling thread alone.

    Raises:
        InputError: its classes are not those of slip.
    """
    fitted.check_slip("the model", "detection")
    fast = fitted.engine
    return lambda x: fast.counts(x, 1)


class LiveDetector:
    """Windows, counts and decisions of one stream.

    Args:
        counts: the network.
        windows: shape of a sample.
        detection: sliding window and margin of the paper's rule, or another detector.
        width, height: the sensor's pixels.
        centre_px: middle of the crop, as for `analysis.windows.windows.bin_events`.
        stride_us: from one window's start to the next one's; the window's length by default.
        starts: start of each window by its number, strictly increasing, instead of an even grid
            that begins with the first event or time.
        gap_us, back_us: see the module.

    Raises:
        ValueError: a crop larger than the sensor, or a stride, gap or step back that is not
            positive.
    """

    def __init__(
        self,
        counts: Counting,
        windows: Windows,
        detection: Detection | Tuned,
        *,
        width: int = 640,
        height: int = 480,
        centre_px: tuple[float, float] | None = None,
        stride_us: int | None = None,
        starts: Callable[[int], int] | None = None,
        gap_us: int = GAP_US,
        back_us: int = BACK_US,
    ) -> None:
        self._counts, self._windows = counts, windows
        self._rule = RunningRule(detection)
        self._geometry = (width, height, centre_px)
        self._length_us = windows.length_ms * 1000
        self._stride_us = self._length_us if stride_us is None else stride_us
        if min(self._stride_us, gap_us, back_us) <= 0:
            raise ValueError("stride_us, gap_us and back_us must be positive")
        self._starts = starts
        self._gap_us, self._back_us = gap_us, back_us
        self._open: dict[int, _Open] = {}
        self._next = 0
        self._now_us: int | None = None
        self._judged_us: int | None = None
        self.losses = StreamFaults()
        self._bin(_NO_EVENTS, 0)  # raises where the crop does not fit

    def warm_up(self) -> None:
        """Load and compile everything in advance, so that the first window need not wait."""
        self._counts(self._empty())

    @property
    def now_us(self) -> int | None:
        """The latest time of the camera's clock that is known; None before the first."""
        return self._now_us

    @property
    def origin_us(self) -> int | None:
        """Start of the first window; None before the first event or time."""
        return None if self._starts is None else self._starts(0)

    @property
    def span_us(self) -> int:
        """Span of the windows that a decision rests on."""
        return self._length_us + (self._rule.span - 1) * self._stride_us

    @property
    def open_windows(self) -> int:
        """Number of open windows: the detector's memory does not grow with time."""
        return len(self._open)

    def push(self, chunk: EventChunk) -> list[LiveDecision]:
        """Take events; give the decisions of the windows that they end, in order.

        Raises:
            ClockFellBack: see the module.
            ValueError: an event outside the sensor.
        """
        if not len(chunk):
            return []
        chunk = self._ordered(chunk)
        edges = np.flatnonzero(np.diff(chunk.t_us) > self._gap_us) + 1
        made = []
        for part in np.split(np.arange(len(chunk)), edges) if len(edges) else [slice(None)]:
            made += self._push(chunk[part])
        return made

    def advance(self, to_us: int) -> list[LiveDecision]:
        """Advance the clock to `to_us`, up to which all events have arrived; return new decisions.

        A time before the latest known one has no effect.
        """
        if self._now_us is not None and to_us <= self._now_us:
            return []
        self._come_to(to_us)
        self._now_us = to_us
        made = []
        while self._start(self._next) + self._length_us <= to_us:
            made.append(self._judge(self._next, by_event=False))
        return made

    # -- events ------------------------------------------------------------------------------

    def _ordered(self, chunk: EventChunk) -> EventChunk:
        """Return the chunk sorted by time, and count events that arrived out of order."""
        t_us = chunk.t_us
        newest = int(t_us[0]) if self._now_us is None else self._now_us
        if int(t_us.min()) < newest - self._back_us:
            raise ClockFellBack(
                f"an event at {int(t_us.min())} us after the clock had come to {newest} us: "
                "the camera's clock fell back"
            )
        before = np.maximum.accumulate(np.concatenate([t_us[:1], t_us[:-1]]))
        disordered = int(np.count_nonzero(t_us < before))
        if disordered:
            chunk = chunk[np.argsort(t_us, kind="stable")]
        self.losses.disordered += disordered
        if self._judged_us is not None:
            self.losses.late += int(np.searchsorted(chunk.t_us, self._judged_us))
        return chunk

    def _push(self, chunk: EventChunk) -> list[LiveDecision]:
        """Events in order and without a gap among them."""
        self._come_to(int(chunk.t_us[0]))
        last_us = int(chunk.t_us[-1])
        self._now_us = last_us if self._now_us is None else max(self._now_us, last_us)
        made = []
        number = self._next
        while (start_us := self._start(number)) <= last_us:
            self._fill(number, start_us, chunk)
            if start_us + self._length_us <= last_us:
                made.append(self._judge(number, by_event=True))
            number += 1
        return made

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

    # -- windows -----------------------------------------------------------------------------

    def _start(self, number: int) -> int:
        assert self._starts is not None
        return self._starts(number)

    def _opened(self, number: int, start_us: int) -> _Open:
        if number not in self._open:
            self._open[number] = _Open(start_us, self._empty())
        return self._open[number]

    def _empty(self) -> npt.NDArray[np.uint8]:
        w = self._windows
        return np.zeros((1, w.steps, w.channels, w.cells, w.cells), np.uint8)

    def _judge(self, number: int, *, by_event: bool) -> LiveDecision:
        """Close the first window that is not evaluated, `number`, and return its decision."""
        start_us = self._start(number)
        window = self._opened(number, start_us)
        del self._open[number]
        counts = self._counts(window.x)[0]
        stated = self._rule.step(counts, window.events)
        self._next = number + 1
        self._judged_us = start_us + self._length_us
        a, b, c = counts.tolist()
        return LiveDecision(
            number=number,
            start_us=start_us,
            end_us=self._judged_us,
            counts=(a, b, c),
            smoothed=stated.smoothed,
            valid_class=stated.valid_class,
            onset=stated.onset,
            events=window.events,
            last_event_us=window.last_us,
            by_event=by_event,
            decided_ns=time.monotonic_ns(),
        )

    def _come_to(self, t_us: int) -> None:
        """Advance to `t_us`: the first time starts the grid, and gaps are handled."""
        if self._starts is None:
            stride_us = self._stride_us
            self._starts = lambda number: t_us + number * stride_us
        if self._now_us is None or t_us - self._now_us <= self._gap_us:
            return
        self.losses.gaps += 1
        self.losses.longest_gap_us = max(self.losses.longest_gap_us, t_us - self._now_us)
        self._open.clear()
        self._rule.interrupt()
        self._next = self._first_from(t_us)
        self._judged_us = self._start(self._next)

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


_NO_EVENTS = EventChunk.empty()


SPAN_NS = 5_000_000_000
"""Least time for which an arrival counts; twice that at most. 100 ppm of drift are 1 ms then."""


class FreshestArrival:
    """Camera time against the host's monotonic clock, by the freshest thing that has arrived.

    Nothing is fitted while a stream runs. What arrives with the least delay bounds the camera's
    clock from below, so the freshest arrival of the last seconds counts as having taken no time;
    the part of the delay that no arrival is without cannot be seen from here.
    """

    def __init__(self) -> None:
        self._began_ns: int | None = None
        self._before: int | None = None
        self._here: int | None = None

    def observe(self, camera_us: int, host_ns: int) -> None:
        """Record that an event of `camera_us` arrived at `host_ns`."""
        ahead_ns = camera_us * 1000 - host_ns
        if self._began_ns is None or host_ns - self._began_ns >= SPAN_NS:
            self._began_ns, self._before, self._here = host_ns, self._here, ahead_ns
        elif self._here is None or ahead_ns > self._here:
            self._here = ahead_ns

    def camera_us(self, host_ns: int) -> int | None:
        """Lower bound of the camera's clock now; None before the first arrival."""
        ahead_ns = self._ahead_ns
        return None if ahead_ns is None else (host_ns + ahead_ns) // 1000

    def host_ns(self, camera_us: int) -> int | None:
        """Return the earliest arrival of an event of that time."""
        ahead_ns = self._ahead_ns
        return None if ahead_ns is None else camera_us * 1000 - ahead_ns

    @property
    def _ahead_ns(self) -> int | None:
        if self._here is None:
            return None
        return self._here if self._before is None else max(self._before, self._here)
