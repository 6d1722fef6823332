"""Between a rig's streams and the detector: what arrives when, and what came of it when.

Latency is counted from a window's last event to its decision. Its first part, until the event was
read, runs on the rig's clock (virtual on the mock rig); its second part, until the decision was
there, on the real one.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sliplab.analysis.detectors.live import Decision, FreshestArrival, LiveDetector
from sliplab.analysis.metrics.classification import CLASSES, INCIPIENT
from sliplab.rigs.core.capabilities import Clock
from sliplab.rigs.core.reacting import SlipSeen
from sliplab.storage.streams import EventChunk, PulseChunk, Unheeded

PATIENCE_US = 200_000
"""A window without an event after it is judged so long after its end, by the camera's clock as it
is known here: what was sent before must have arrived by then."""
KEPT = 100_000
"""Latencies that are kept for the summary: the last 55 minutes of 30 ms windows."""
UNDECIDED = "undecided"


@dataclass(frozen=True)
class Timed:
    """A decision and its times.

    Attributes:
        trial_s: end of the window since the stream began, on the camera's clock.
        phase: of the motion in which it was made; empty where nothing moves.
        latency_ms: from the window's last event to the decision, on the rig's clock, the freshest
            arrival counting as immediate; None in a window without events.
        compute_ms: from when the events were read to the decision.
    """

    decision: Decision
    trial_s: float
    phase: str
    latency_ms: float | None
    compute_ms: float

    @property
    def state(self) -> str:
        """The valid class by name, or `UNDECIDED`."""
        return state_name(self.decision.valid_class)

    def as_json(self) -> dict[str, Any]:
        """One line of the decisions' file."""
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
    """A valid class in words."""
    return UNDECIDED if valid_class < 0 else CLASSES[valid_class]


class DetectSink(Unheeded):
    """A `rigs.core.reacting.Watcher` that feeds a detector.

    Args:
        clock: the rig's, by which arrivals are dated.
        on_decision: called with each decision as soon as it is made.
        every_poll: called each time that the streams were read.
    """

    def __init__(
        self,
        detector: LiveDetector,
        clock: Clock,
        on_decision: Callable[[Timed], None],
        every_poll: Callable[[], None] = lambda: None,
    ) -> None:
        self.detector, self.armed, self.phase = detector, False, ""
        self._clock, self._on_decision, self._every_poll = clock, on_decision, every_poll
        self._camera = FreshestArrival()
        self._latency: deque[float] = deque(maxlen=KEPT)
        self._compute: deque[float] = deque(maxlen=KEPT)
        self._states: Counter[str] = Counter()
        self.events = self.quiet = 0
        self.onsets: dict[str, dict[str, Any]] = {}

    def step(self, phase: str, acting: bool) -> None:
        """A step of the motion begins."""
        self.phase = phase

    def add_events(self, chunk: EventChunk) -> None:
        """Events, and at the end of each read what the clock alone decides.

        Raises:
            SlipSeen: incipient slip is detected while `armed`; the rest of the read is reported.
            ClockFellBack: the camera's clock is another one.
        """
        here_ns, began_ns = self._clock.now_ns(), time.monotonic_ns()
        if len(chunk):
            self.events += len(chunk)
            self._camera.observe(int(chunk.t_us.max()), here_ns)
        self._report(self.detector.push(chunk), here_ns, began_ns)

    def add_event_pulses(self, chunk: PulseChunk) -> None:
        """Pulses tell the camera's time where events do not.

        Raises:
            SlipSeen: as `add_events`.
        """
        here_ns, began_ns = self._clock.now_ns(), time.monotonic_ns()
        if len(chunk):
            self._camera.observe(int(chunk.t_ns.max()) // 1000, here_ns)
        now_us = self._camera.camera_us(here_ns)
        if now_us is not None:
            # the first time that is known begins the windows; from then on events may be late
            late_us = 0 if self.detector.now_us is None else PATIENCE_US
            self._report(self.detector.advance(now_us - late_us), here_ns, began_ns)
        self._every_poll()

    def _report(self, made: list[Decision], here_ns: int, began_ns: int) -> None:
        slip = False
        for decision in made:
            compute_ms = (decision.decided_ns - began_ns) / 1e6
            latency_ms = None
            if decision.last_event_us is not None:
                sent_ns = self._camera.host_ns(decision.last_event_us)
                assert sent_ns is not None
                latency_ms = (here_ns - sent_ns) / 1e6 + compute_ms
                self._latency.append(latency_ms)
            self.quiet += decision.events == 0
            self._compute.append(compute_ms)
            origin_us = self.detector.origin_us
            assert origin_us is not None
            timed = Timed(
                decision, (decision.end_us - origin_us) / 1e6, self.phase, latency_ms, compute_ms
            )
            self._states[timed.state] += 1
            if decision.onset is not None:
                self.onsets[decision.onset] = timed.as_json()
            slip |= decision.valid_class == INCIPIENT
            self._on_decision(timed)
        if slip and self.armed:
            self.armed = False
            raise SlipSeen

    def summary(self) -> dict[str, Any]:
        """What was seen, in numbers."""
        return {
            "events": self.events,
            "windows": sum(self._states.values()),
            "quiet_windows": self.quiet,
            "states": {name: self._states[name] for name in (*CLASSES, UNDECIDED)},
            "onsets": {name: self.onsets.get(name) for name in CLASSES[1:]},
            "latency_ms": _spread(self._latency),
            "compute_ms": _spread(self._compute),
            "losses": vars(self.detector.losses),
        }


def _spread(values: deque[float]) -> dict[str, float | int | None]:
    """Median, 95 and 99 %, and the largest of what was measured, ms."""
    names = ("median", "p95", "p99", "max")
    if not values:
        return {**dict.fromkeys(names), "n": 0}
    found = np.percentile(np.array(values), [50, 95, 99, 100]).tolist()
    return {**dict(zip(names, found, strict=True)), "n": len(values)}
