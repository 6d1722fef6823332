"""Driver of the event camera inside the sensor: a DVXplorer through dv-processing 2.0.4.

The library buffers data only briefly, so a thread reads them continuously from the moment the
camera is opened, and discards them while no run is active. The driver's own buffer is bounded.
Times are the camera's, integer microseconds in 64 bits, which the library extends from the camera's
32-bit counter, so nothing wraps here.
"""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Protocol

import numpy as np

from sliplab.plugins.devices.dvxplorer.process import EventProcess
from sliplab.plugins.devices.dvxplorer.settings import DvxplorerSettings
from sliplab.plugins.devices.dvxplorer.source import DEVICE, EventBatch
from sliplab.rigs.core.capabilities import DeviceHealth, RigError
from sliplab.rigs.core.host_clock import OR_BUSY, StallTimer
from sliplab.storage.streams import I64, EventChunk, Json, PulseChunk

POLL_S = 0.001
"""Pause after a poll without data, s."""
SETTLE_S = 1.0
"""Timeout for `start` and `stop` to read all earlier data, s."""
HANG_S = 10.0
"""Time after which a poll counts as hung, s; longer than `process.ANSWER_S`."""
CLOSE_S = 3.0
"""Timeout for the thread to end in `close`, s."""
RISING_EDGE, TIMESTAMP_RESET = 1, 0
"""`EXTERNAL_SIGNAL_RISING_EDGE` and `TIMESTAMP_RESET` of `dv.TriggerType`."""
_EVENT_BYTES = 13
_POLL_NS = 10_000_000
"""Longest silence that one poll without data is counted as, ns."""


@dataclass
class EventCounts:
    """Counts of the data received in one run.

    Attributes:
        events: events accepted, read or not.
        pulses: rising edges.
        gaps: intervals of more than `gap_s` between events, on the camera's clock.
        longest_gap_us: longest interval between two events.
        filtered: events dropped by the noise filter, if it is on.
        overflowed: events dropped because the buffer was full; the run then ends with an error.
        other_triggers: triggers other than rising edges, and repeated ones.
        before: events discarded before the run.
    """

    events: int = 0
    pulses: int = 0
    gaps: int = 0
    longest_gap_us: int = 0
    filtered: int = 0
    overflowed: int = 0
    other_triggers: int = 0
    before: int = 0


class OpenedInputs(Protocol):
    """Opened inputs: a `DvxEventSource`, or an `EventProcess` that has one."""

    name: str
    resolution: tuple[int, int]
    in_force: Json

    def run(self, on: bool, noise_filter_us: int | None = None) -> None:
        """Switch events and triggers. Raises RigError."""

    def poll(self) -> EventBatch:
        """Read all available data."""

    def health(self, settings: DvxplorerSettings) -> DeviceHealth:
        """Return the camera's health report. Raises RigError."""

    def close(self) -> None:
        """Close the inputs; safe to call more than once."""


class DvxplorerCamera:
    """A `rigs.core.capabilities.EventCamera`, opened on construction.

    Args:
        source: opened inputs; None to open those in the settings.

    Raises:
        RigError: no such camera or stream, or one that does not send events and triggers.
    """

    def __init__(self, settings: DvxplorerSettings, source: OpenedInputs | None = None) -> None:
        self.settings = settings
        self._source: OpenedInputs = source if source is not None else EventProcess(settings)
        self.width, self.height = self._source.resolution
        self._lock = threading.Lock()
        self._wanted = self._keep = False
        self._settled, self._closing = threading.Event(), threading.Event()
        self._closed = False
        self._forget()
        self._thread = threading.Thread(target=self._run, name=DEVICE, daemon=True)
        self._thread.start()

    def _forget(self) -> None:
        self._events: list[EventChunk] = []
        self._pulses: list[int] = []
        self._held = 0
        self._last_us: int | None = None
        self._last_pulse_us: int | None = None
        self._counts = EventCounts()
        self._fault: RigError | None = None
        self._asked_ns = time.monotonic_ns()
        self._stall = StallTimer()
        self._silent_ns = 0

    @property
    def counts(self) -> EventCounts:
        """Counts of this run, or of the last one."""
        with self._lock:
            return EventCounts(**asdict(self._counts))

    def describe(self) -> Json:
        """Return the camera's part of a trial's record."""
        return {
            "camera": self._source.name,
            "resolution_px": [self.width, self.height],
            "settings": self.settings.model_dump(mode="json"),
            "in_force": self._source.in_force,
            "counts": asdict(self.counts),
        }

    def health(self) -> DeviceHealth:
        """Return the camera's health report, streaming or not.

        Raises:
            RigError: the camera is disconnected, or does not answer.
        """
        if self._closed:
            raise RigError(DEVICE, "it is closed; open it again")
        return self._source.health(self.settings)

    def start(self) -> None:
        """Start streaming; earlier data are discarded. Returns within `SETTLE_S`.

        Raises:
            RigError: the camera is disconnected.
        """
        if not self._thread.is_alive():
            raise self._fault or RigError(DEVICE, "it is closed; open it again")
        with self._lock:
            self._forget()
        self._source.run(True, self.settings.noise_filter_us)
        self._want(True)
        with self._lock:
            self._silent_ns = 0
            if self._fault is not None:
                raise self._fault

    def read(self) -> EventChunk:
        """Return the events since the last call.

        Raises:
            RigError: the camera is disconnected or silent, its clock jumped back, or its buffer
                overflowed, and all earlier events were read.
        """
        with self._lock:
            parts, self._events, self._held = self._events, [], 0
            if not parts:
                self._check()
        return EventChunk.concatenate(parts)

    def read_pulses(self) -> PulseChunk:
        """Return the pulses since the last call, camera clock in ns. Raises RigError as `read`."""
        with self._lock:
            pulses, self._pulses = self._pulses, []
            if not pulses and not self._events:
                self._check()
        return PulseChunk(np.array(pulses, np.int64) * 1000)

    def stop(self) -> None:
        """Stop streaming; earlier data can still be read. Returns within `SETTLE_S`."""
        if self._wanted:
            with suppress(RigError):
                self._source.run(False)
            self._want(False)

    def close(self) -> None:
        """Close the device; safe at any time and more than once.

        Raises:
            RigError: the thread does not end within `CLOSE_S`.
        """
        if self._closed:
            return
        self.stop()
        self._closing.set()
        self._thread.join(CLOSE_S)
        self._source.close()
        if self._thread.is_alive():
            raise RigError(DEVICE, f"reading has not ended within {CLOSE_S:g} s")
        self._closed = True

    def _check(self) -> None:
        if self._fault is not None:
            raise self._fault
        silent_s = self._silent_ns / 1e9
        hung_s = self._stall.waited_s(self._asked_ns)
        if self._keep and hung_s > HANG_S:
            raise RigError(DEVICE, f"dv-processing has not answered for {hung_s:.1f} s")
        if self._keep and silent_s > self.settings.stall_s:
            raise RigError(
                DEVICE,
                f"sent no event and no pulse for {silent_s:.1f} s; check cable and lens{OR_BUSY}",
            )

    def _want(self, wanted: bool) -> None:
        """Switch keeping on or off, once all data that have arrived by now are read."""
        self._settled.clear()
        self._wanted = wanted
        self._settled.wait(SETTLE_S)
        # a stream that never pauses is cut at its current position
        with self._lock:
            self._keep = wanted

    def _run(self) -> None:
        source = self._source
        while not self._closing.is_set():
            try:
                wanted = self._wanted
                batch = source.poll()
                news = False
                if batch.events is not None:
                    news = self._take_events(batch.events, batch.filtered)
                if len(batch.trigger_us):
                    news |= self._take_triggers(batch)
                now_ns = time.monotonic_ns()
                with self._lock:
                    # time for which this computer was suspended is not the camera's silence
                    passed_ns = min(now_ns - self._asked_ns, _POLL_NS)
                    self._silent_ns = 0 if news else self._silent_ns + passed_ns
                    stuck = self._keep and self._silent_ns > self.settings.stall_s * 1e9
                if stuck and not batch.empty:
                    self._fail(f"its clock has stopped for {self.settings.stall_s:g} s")
                if batch.empty:
                    with self._lock:
                        self._keep = wanted
                    if wanted == self._wanted:
                        self._settled.set()
                    if not batch.running:
                        self._fail("the connection is lost; check its cable and open it again")
                        break
                    self._closing.wait(POLL_S)
                self._asked_ns = now_ns
            except Exception as error:
                why = str(error).removeprefix(f"{DEVICE}: ")
                self._fail(f"reading failed: {why}; check the sender, and open it again")
                break
        self._settled.set()

    def _fail(self, what: str) -> None:
        with self._lock:
            if self._fault is None:
                self._fault = RigError(DEVICE, what)

    def _take_events(self, chunk: EventChunk, filtered: int) -> bool:
        """Keep events; return whether they show that the camera and its clock run."""
        if not self._keep:
            with self._lock:
                self._counts.before += len(chunk) + filtered
            return True
        with self._lock:
            counts = self._counts
            counts.filtered += filtered
            if not len(chunk) or self._fault is not None:
                counts.overflowed += len(chunk) if counts.overflowed else 0
                return filtered > 0
            if (self._held + len(chunk)) * _EVENT_BYTES > self.settings.buffer_mb * 1e6:
                counts.overflowed += len(chunk)
                self._fault = RigError(
                    DEVICE, f"was not read in time: {self.settings.buffer_mb:g} MB are full"
                )
                return False
            before_us = self._last_us
            if not self._in_order(chunk.t_us):
                self._fault = RigError(
                    DEVICE, f"its clock jumped back after {self._last_us} us; begin a new trial"
                )
                return False
            if int(chunk.x.max()) >= self.width or int(chunk.y.max()) >= self.height:
                self._fault = RigError(
                    DEVICE, f"sent an event outside of its {self.width} x {self.height} px"
                )
                return False
            self._last_us = int(chunk.t_us[-1])
            counts.events += len(chunk)
            self._held += len(chunk)
            self._events.append(chunk)
            return before_us is None or self._last_us > before_us or filtered > 0

    def _in_order(self, t_us: I64) -> bool:
        """Return whether times do not decrease; count gaps."""
        before = t_us[0] if self._last_us is None else self._last_us
        steps = np.diff(t_us, prepend=before)
        if int(steps.min()) < 0:
            return False
        counts = self._counts
        counts.gaps += int(np.count_nonzero(steps > self.settings.gap_s * 1e6))
        counts.longest_gap_us = max(counts.longest_gap_us, int(steps.max()))
        return True

    def _take_triggers(self, batch: EventBatch) -> bool:
        """Keep pulses; return whether there is a new one."""
        if not self._keep:
            return True
        with self._lock:
            before = self._counts.pulses
            kinds = batch.trigger_kind.tolist()
            for at, kind in zip(batch.trigger_us.tolist(), kinds, strict=True):
                if kind == TIMESTAMP_RESET:
                    self._fault = RigError(DEVICE, f"its clock was reset at {at} us")
                elif kind != RISING_EDGE:
                    self._counts.other_triggers += 1
                elif self._last_pulse_us is not None and at < self._last_pulse_us:
                    self._fault = RigError(
                        DEVICE, f"its clock jumped back after the pulse at {self._last_pulse_us} us"
                    )
                elif at == self._last_pulse_us:  # the same pulse again
                    self._counts.other_triggers += 1
                elif self._fault is None:
                    self._last_pulse_us = at
                    self._counts.pulses += 1
                    self._pulses.append(at)
            return self._counts.pulses > before
