"""A rig's streams as they are read, fed to the detector: decisions, their times, and a summary.

Latency is counted from a window's last event to its decision. Its first part, until the event was
read, runs on the rig's clock (virtual on the mock rig); its second part, until the decision, on
the real one.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypedDict

import numpy as np

from sliplab.analysis.detectors.detector import DetectorError
from sliplab.analysis.detectors.live import (
    UNDECIDED,
    ClockFellBack,
    DecisionJson,
    FreshestArrival,
    LiveDecision,
    LiveDetector,
    TimedDecision,
)
from sliplab.analysis.detectors.promise_watch import PromiseWatch
from sliplab.analysis.metrics.classification import CLASSES, INCIPIENT
from sliplab.flows.detecting.detector_process import NetworkLost
from sliplab.rigs.core.capabilities import Clock
from sliplab.rigs.core.reacting import DetectionTimes, SenseLost, SlipDetected
from sliplab.storage.streams import EVENTS_KIND, Chunk, EventChunk, NullSink, PulseChunk

PATIENCE_US = 200_000
"""Wait before evaluating a window that no event follows, us on the camera's clock as estimated
here: events that were sent earlier must have arrived by then."""
HOLD = "hold"
"""Phase in which nothing slips, before the motion."""
KEPT = 100_000
"""Latencies stored for the summary: the last 55 minutes of 30 ms windows."""


FAILURES: dict[type[Exception], str] = {
    ClockFellBack: "event camera",
    NetworkLost: "network",
    DetectorError: "detector",
}
"""Exceptions of a detector on a stream, each with the device that it is reported of."""


def failed_device(error: Exception) -> str:
    """Return the device of one of `FAILURES`; of any other error the detector."""
    found = (device for kind, device in FAILURES.items() if isinstance(error, kind))
    return next(found, "detector")


@dataclass(frozen=True)
class Timeouts:
    """Longest times on the rig's clock, ns.

    Attributes:
        stream_ns: without newer data of the camera, and of their delay.
        decision_ns: from events to the decision on them; None for any.
    """

    stream_ns: int
    decision_ns: int | None


class Times(TypedDict):
    """Median, 95 %, 99 % and maximum of n measured times, ms; None without any."""

    median: float | None
    p95: float | None
    p99: float | None
    max: float | None
    n: int


class PromiseJson(TypedDict):
    """What became of a promise of false alarms.

    Attributes:
        per_hour: promised, at most.
        alarms, hours: counted while nothing slipped, as far as was declared.
        declared: a protocol's holds before its motion; else the whole time, in which something may
            have slipped.
        broken_h: counted time at which the alarms contradicted the promise; None if they do not.
    """

    per_hour: float
    alarms: int
    hours: float
    declared: bool
    broken_h: float | None
    says: str


class DetectNumbers(TypedDict):
    """Numbers of a detector's windows and of their times.

    Attributes:
        quiet_windows: windows without an event.
        states: windows by detected class.
        onsets: the first decision of each kind of slip.
        latency_ms: from a window's last event to its decision.
        compute_ms: from the read of the events to the decision.
        losses: as `analysis.detectors.live.StreamFaults`.
        promise: what became of the promise of false alarms; None without one.
    """

    events: int
    windows: int
    quiet_windows: int
    states: dict[str, int]
    onsets: dict[str, DecisionJson | None]
    latency_ms: Times
    compute_ms: Times
    losses: dict[str, int]
    promise: PromiseJson | None


class DetectSink(NullSink):
    """A `rigs.core.reacting.Watcher` that feeds a detector.

    Args:
        clock: the rig's, by which arrivals are dated.
        on_decision: called with each decision as soon as it is made.
        every_poll: called each time that the streams were read.
        timeouts: beyond which slip cannot be detected in time; None: never reported.
        watch: of the promise of false alarms; None without one.
        on_broken: called once with a text, when the alarms contradict that promise.
        on_step: called with the phase when a step of the motion begins.
    """

    def __init__(
        self,
        detector: LiveDetector,
        clock: Clock,
        on_decision: Callable[[TimedDecision], None],
        every_poll: Callable[[], None] = lambda: None,
        timeouts: Timeouts | None = None,
        watch: PromiseWatch | None = None,
        on_broken: Callable[[str], None] = lambda text: None,
        on_step: Callable[[str], None] = lambda phase: None,
    ) -> None:
        self.detector, self.phase = detector, ""
        self._watch, self._on_broken, self._on_step = watch, on_broken, on_step
        self._declared = self._held = self._moved = False
        self.armed = self.guarded = False
        self._clock, self._on_decision, self._every_poll = clock, on_decision, every_poll
        self._timeouts = timeouts
        self._alive_ns: int | None = None
        self._newest_ns = dict.fromkeys(("events", "pulses"), -1)
        self._camera = FreshestArrival()
        self._latency: deque[float] = deque(maxlen=KEPT)
        self._compute: deque[float] = deque(maxlen=KEPT)
        self._states: Counter[str] = Counter()
        self.events = self.quiet = 0
        self.onsets: dict[str, DecisionJson] = {}

    def step(self, phase: str, acting: bool) -> None:
        """Note that a step of the motion begins."""
        self.phase, self._declared = phase, True
        self._held = self._held or phase == HOLD
        self._moved = self._held and (self._moved or phase != HOLD)
        self._on_step(phase)

    def add(self, device: str, chunk: Chunk) -> None:
        """Feed the event camera's stream to the detector.

        Raises:
            SlipDetected, SenseLost, ClockFellBack: as `_feed` and `_advance`.
        """
        if device == EVENTS_KIND and isinstance(chunk, EventChunk):
            self._feed(chunk)
        elif device == EVENTS_KIND and isinstance(chunk, PulseChunk):
            self._advance(chunk)

    def _feed(self, chunk: EventChunk) -> None:
        """Feed events to the detector.

        Raises:
            SlipDetected: incipient slip was detected while `armed`; the whole read is reported.
            SenseLost: the decisions came later than `timeouts` allow.
            ClockFellBack: the camera's clock is another one.
        """
        here_ns, began_ns = self._clock.now_ns(), time.monotonic_ns()
        if len(chunk):
            self.events += len(chunk)
            self._note_life("events", int(chunk.t_us.max()) * 1000, here_ns)
        self._report(self._decided(lambda: self.detector.push(chunk)), here_ns, began_ns)

    def _advance(self, chunk: PulseChunk) -> None:
        """Advance the detector to the camera's time, which pulses show without events.

        Raises:
            SlipDetected: as `_feed`.
            SenseLost: as `_feed`; or neither events nor pulses came for too long.
        """
        here_ns, began_ns = self._clock.now_ns(), time.monotonic_ns()
        if len(chunk):
            self._note_life("pulses", int(chunk.t_ns.max()), here_ns)
        if self._alive_ns is None:
            self._alive_ns = here_ns
        silent_ns = here_ns - self._alive_ns
        if self.guarded and self._timeouts is not None and silent_ns > self._timeouts.stream_ns:
            raise SenseLost(
                f"event camera: neither events nor pulses for {silent_ns / 1e6:.0f} ms, and "
                f"at most {self._timeouts.stream_ns / 1e6:g} ms are allowed (reflex.stream_timeout)"
            )
        now_us = self._camera.camera_us(here_ns)
        if now_us is not None:
            # the first time that is known begins the windows; from then on events may be late
            late_us = 0 if self.detector.now_us is None else PATIENCE_US
            made = self._decided(lambda: self.detector.advance(now_us - late_us))
            self._report(made, here_ns, began_ns)
        self._every_poll()

    def _note_life(self, stream: str, newest_ns: int, here_ns: int) -> None:
        """Note that data of the camera came, where they are newer than those before, and in time.

        Data that come later and later are no news, though each is newer than the last.
        """
        self._camera.observe(newest_ns // 1000, here_ns)
        if newest_ns <= self._newest_ns[stream]:
            return
        self._newest_ns[stream] = newest_ns
        soonest_ns = self._camera.host_ns(newest_ns // 1000)
        assert soonest_ns is not None
        if self._timeouts is None or here_ns - soonest_ns <= self._timeouts.stream_ns:
            self._alive_ns = here_ns

    def _decided(self, work: Callable[[], list[LiveDecision]]) -> list[LiveDecision]:
        """Return the decisions of `work`; while `guarded`, whatever fails in it is a lost sense."""
        try:
            return work()
        except Exception as error:
            if not self.guarded:
                raise
            said = str(error) if type(error) in FAILURES else f"{type(error).__name__}: {error}"
            raise SenseLost(f"{failed_device(error)}: {said}") from error

    def _report(self, made: list[LiveDecision], here_ns: int, began_ns: int) -> None:
        slip: DetectionTimes | None = None
        late_ns = self._clock.now_ns() - here_ns if made else 0
        most_ns = None if self._timeouts is None else self._timeouts.decision_ns
        if self.guarded and most_ns is not None and late_ns > most_ns:
            raise SenseLost(
                f"network: a decision took {late_ns / 1e6:.0f} ms, and reflex.decision_timeout is "
                f"{most_ns / 1e6:g} ms"
            )
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
            timed = TimedDecision(
                decision, (decision.end_us - origin_us) / 1e6, self.phase, latency_ms, compute_ms
            )
            self._states[timed.state] += 1
            self._keep_promise(decision)
            if decision.onset is not None:
                self.onsets[decision.onset] = timed.as_json()
            if slip is None and decision.valid_class == INCIPIENT:
                slip = self._evidence(decision, here_ns, compute_ms)
            self._on_decision(timed)
        if slip is not None and self.armed:
            self.armed = False
            raise SlipDetected(slip)

    def _keep_promise(self, decision: LiveDecision) -> None:
        """Count a decision for the promise, if nothing slips: in holds before the motion.

        Without a motion nothing is declared, and all of the time counts.
        """
        watch = self._watch
        if watch is None or (self._declared and (self._moved or not self._held)):
            return
        before = watch.broken_h
        alarm = decision.valid_class >= INCIPIENT
        if watch.level is not None:
            alarm = decision.value > watch.level
        watch.add(decision.start_us, decision.end_us, alarm)
        if before is None and watch.broken_h is not None:
            self._on_broken(self._promise_words(watch))

    def _promise_words(self, watch: PromiseWatch) -> str:
        return watch.words + ("" if self._declared else ", unless something slipped")

    def _promise(self) -> PromiseJson | None:
        if (watch := self._watch) is None:
            return None
        return {
            "per_hour": watch.per_hour,
            "alarms": watch.alarms,
            "hours": watch.hours,
            "declared": self._declared,
            "broken_h": watch.broken_h,
            "says": self._promise_words(watch),
        }

    def _evidence(self, decision: LiveDecision, here_ns: int, compute_ms: float) -> DetectionTimes:
        ended_ns = self._camera.host_ns(decision.end_us)
        assert ended_ns is not None
        origin_us = self.detector.origin_us
        assert origin_us is not None
        return DetectionTimes(
            (decision.end_us - origin_us) / 1e6,
            self.detector.span_us / 1e3,
            (here_ns - ended_ns) / 1e6,
            compute_ms,
        )

    def summary(self) -> DetectNumbers:
        """Return the numbers of events, windows, states and latencies, and the onsets."""
        return {
            "events": self.events,
            "windows": sum(self._states.values()),
            "quiet_windows": self.quiet,
            "states": {name: self._states[name] for name in (*CLASSES, UNDECIDED)},
            "onsets": {name: self.onsets.get(name) for name in CLASSES[1:]},
            "latency_ms": _spread(self._latency),
            "compute_ms": _spread(self._compute),
            "losses": vars(self.detector.losses),
            "promise": self._promise(),
        }


def _spread(values: deque[float]) -> Times:
    """Summarise measured times, ms."""
    if not values:
        return {"median": None, "p95": None, "p99": None, "max": None, "n": 0}
    median, p95, p99, most = np.percentile(np.array(values), [50, 95, 99, 100]).tolist()
    return {"median": median, "p95": p95, "p99": p99, "max": most, "n": len(values)}
