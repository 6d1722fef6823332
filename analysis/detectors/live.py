"""A detector on a running stream: events in as they come, decisions out.

The detector is the one that scores a stored trial. What a stream does that a file does not
(silence, events out of order, events too late, a clock that leaps) has one outcome each:

- A window ends when an event at or after its end has come, or when `advance` says that the
  camera's clock is past it; so a quiet scene is evaluated too.
- Events out of order count where they belong while their window is open.
- An event of an already evaluated window is dropped and counted as late; nothing is revised.
- Time that leaps ahead by more than `gap_us` is a gap: the detector resumes after it (a network's
  open windows are given up, and its sliding window restarts), and the gap is counted.
- Time that falls back by more than `back_us` is another clock: `ClockFellBack`.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TypedDict

import numpy as np

from sliplab.analysis.detectors.detector import DetectorError, StreamDetector
from sliplab.analysis.metrics.classification import CLASSES, GROSS, INCIPIENT
from sliplab.storage.streams import EventChunk

UNDECIDED = "undecided"


@dataclass(frozen=True)
class LiveDecision:
    """Decision on one window. Times on the camera's clock, microseconds.

    Attributes:
        number: of the window, from 0; gaps leave numbers out.
        value: evidence for slip; -inf where there is none yet.
        counts, smoothed: as `JudgedWindow`.
        valid_class: the decided class; -1 where none is valid.
        onset: ``incipient`` or ``gross`` where it is decided for the first time, gross after that.
        events: events of the window, all over the sensor and of both polarities.
        last_event_us: the latest of them; None in a window without events.
        by_event: an event ended the window, and not the clock alone.
        decided_ns: monotonic clock when the decision was there.
        slipped: share of the tips that have let go; None where it is not known.
    """

    number: int
    start_us: int
    end_us: int
    value: float
    counts: tuple[int, int, int] | None
    smoothed: tuple[float, float, float] | None
    valid_class: int
    onset: str | None
    events: int
    last_event_us: int | None
    by_event: bool
    decided_ns: int = field(compare=False)
    slipped: float | None = None


class DecisionJson(TypedDict):
    """`TimedDecision` as one line of the decisions' file."""

    window: int
    start_us: int
    end_us: int
    trial_s: float
    phase: str
    state: str
    onset: str | None
    value: float | None
    slipped: float | None
    counts: list[int] | None
    smoothed: list[float] | None
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
            "value": made.value if math.isfinite(made.value) else None,
            "slipped": made.slipped,
            "counts": None if made.counts is None else list(made.counts),
            "smoothed": None if made.smoothed is None else list(made.smoothed),
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


GAP_US = 10_000_000
BACK_US = 1_000_000


class ClockFellBack(ValueError):
    """The camera's clock fell back, so that earlier times cannot be compared."""


class LiveDetector:
    """The decisions of a detector on one stream.

    Args:
        detector: begins with the first event or time.
        width, height: the sensor's pixels.
        origin_us: when it begins, instead.
        gap_us, back_us: see the module.

    Raises:
        ValueError: a sensor that the detector does not work with, or a gap or step back that is not
            positive.
    """

    def __init__(
        self,
        detector: StreamDetector,
        *,
        width: int = 640,
        height: int = 480,
        origin_us: int | None = None,
        gap_us: int = GAP_US,
        back_us: int = BACK_US,
    ) -> None:
        if min(gap_us, back_us) <= 0:
            raise ValueError("gap_us and back_us must be positive")
        self._detector, self.origin_us = detector, origin_us
        """Moment at which the detector began; None before the first event or time."""
        self._gap_us, self._back_us = gap_us, back_us
        self._now_us: int | None = None
        self._found: list[int] = []
        self.losses = StreamFaults()
        detector.begin(width, height)

    @property
    def now_us(self) -> int | None:
        """The latest time of the camera's clock that is known; None before the first."""
        return self._now_us

    @property
    def span_us(self) -> int:
        """Span of the events that a decision rests on; 0 where it is not known."""
        return self._detector.span_us

    def push(self, chunk: EventChunk) -> list[LiveDecision]:
        """Take events; give the decisions that they bring, in order.

        Raises:
            ClockFellBack: see the module.
            ValueError: an event outside the sensor.
            DetectorError: the detector failed, or its evidence is not a number.
        """
        if not len(chunk):
            return []
        chunk = self._ordered(chunk)
        edges = np.flatnonzero(chunk.t_us[1:] - chunk.t_us[:-1] > self._gap_us) + 1
        made = []
        for begin, end in pairwise([0, *edges.tolist(), len(chunk)]):
            events = chunk[begin:end] if len(edges) else chunk
            self._come_to(int(events.t_us[0]))
            last_us = int(events.t_us[-1])
            self._now_us = last_us if self._now_us is None else max(self._now_us, last_us)
            made += self._decisions(events, by_event=True)
        return made

    def advance(self, to_us: int) -> list[LiveDecision]:
        """Advance the clock to `to_us`, up to which all events have arrived; return new decisions.

        A time before the latest known one has no effect.
        """
        if self._now_us is not None and to_us <= self._now_us:
            return []
        self._come_to(to_us)
        self._now_us = to_us
        return self._decisions(EventChunk.empty(), by_event=False)

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
        if self.origin_us is not None:
            settled_us = self.origin_us + self._detector.settled_us
            self.losses.late += int(np.searchsorted(chunk.t_us, settled_us))
        return chunk

    def _come_to(self, t_us: int) -> None:
        """Advance to `t_us`: the detector begins with the first time, and gaps are handled."""
        if self.origin_us is None:
            self.origin_us = t_us
        if self._now_us is None or t_us - self._now_us <= self._gap_us:
            return
        self.losses.gaps += 1
        self.losses.longest_gap_us = max(self.losses.longest_gap_us, t_us - self._now_us)
        self._detector.resume(t_us - self.origin_us)

    def _decisions(self, events: EventChunk, *, by_event: bool) -> list[LiveDecision]:
        """Push events, complete up to now, and return what the detector says."""
        assert self._now_us is not None
        assert self.origin_us is not None
        origin_us = self.origin_us
        moved = replace(events, t_us=events.t_us - origin_us)
        evidence = self._detector.push(moved, self._now_us - origin_us)
        decided_ns = time.monotonic_ns()
        if np.isnan(evidence.value).any():
            raise DetectorError("evidence is no number")
        made, slipped = [], evidence.slipped
        for k, window in enumerate(evidence.windows):
            label, last_us = int(evidence.label[k]), window.last_event_us
            made.append(
                LiveDecision(
                    number=window.number,
                    start_us=origin_us + window.start_us,
                    end_us=origin_us + int(evidence.t_us[k]),
                    value=float(evidence.value[k]),
                    counts=window.counts,
                    smoothed=window.smoothed,
                    valid_class=label,
                    onset=self._onset(label),
                    events=window.events,
                    last_event_us=None if last_us is None else origin_us + last_us,
                    by_event=by_event,
                    decided_ns=decided_ns,
                    slipped=None if slipped is None or np.isnan(slipped[k]) else float(slipped[k]),
                )
            )
        return made

    def _onset(self, label: int) -> str | None:
        """Return the name of a class that is decided for the first time: gross after incipient."""
        following = (INCIPIENT, GROSS)[len(self._found) :]
        if not following or label != following[0]:
            return None
        self._found.append(label)
        return CLASSES[label]


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
