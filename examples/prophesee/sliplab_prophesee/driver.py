"""Driver of a Prophesee camera on any of its sources; a thread reads it from opening to closing."""

from __future__ import annotations

import threading
from contextlib import suppress

import numpy as np

from sliplab.rigs.core.capabilities import UNKNOWN, DeviceHealth, RigError
from sliplab.rigs.core.host_clock import StallTimer
from sliplab.storage.streams import EventChunk, Json, PulseChunk
from sliplab_prophesee import PropheseeSettings
from sliplab_prophesee.evt import Decoded, FormatFault
from sliplab_prophesee.sources import ANSWER_S, DEVICE, Source

EVENT_BYTES = 13


class Prophesee:
    """A `sliplab.rigs.core.capabilities.EventCamera`; it is open from the beginning."""

    def __init__(self, settings: PropheseeSettings, source: Source) -> None:
        self._settings, self._source = settings, source
        self.width, self.height = source.width, source.height
        self._changed = threading.Condition()
        self._fault: str | None = None
        self._running = self._wanted = self._closed = False
        self._last_us = self._last_pulse_us = -1
        self._forget()
        self._thread = threading.Thread(target=self._run, name=settings.where, daemon=True)
        self._thread.start()

    def _forget(self) -> None:
        self._events: list[EventChunk] = []
        self._pulses: list[int] = []
        self._held = self._parts = 0
        self._stall = StallTimer()

    def start(self) -> None:
        """Begin to stream; what came before is dropped. Takes at most `ANSWER_S`.

        Raises:
            RigError: the camera is gone.
        """
        self._switch(True)

    def read(self) -> EventChunk:
        """Return the events since the last call.

        Raises:
            RigError: the camera is gone, silent, set its clock back or was not read in time, and
                all that came before was read.
        """
        with self._changed:
            parts, self._events, self._held = self._events, [], 0
            self._check(news=bool(parts))
        return EventChunk.concatenate(parts)

    def read_pulses(self) -> PulseChunk:
        """Return the rising edges of the trigger input since the last call, camera clock in ns.

        Raises as `read`.
        """
        with self._changed:
            pulses, self._pulses = self._pulses, []
            self._check(news=bool(pulses or self._events))
        return PulseChunk(np.array(pulses, np.int64) * 1000)

    def stop(self) -> None:
        """Stop streaming; what has come can still be read. Takes at most `ANSWER_S`."""
        with suppress(RigError):  # a camera that is gone streams no more
            self._switch(False)

    def close(self) -> None:
        """Release the device; idempotent."""
        self.stop()
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(ANSWER_S)
        self._source.close()

    def health(self) -> DeviceHealth:
        """Return what the camera says of itself. Raises RigError: it is gone."""
        with self._changed:
            self._check_fault()
        return DeviceHealth(
            device=DEVICE,
            model=f"Prophesee {self._source.name}",
            serial=self._source.serial,
            firmware=UNKNOWN,
            temperature_c=None,
            clock="its own, 1 us",
            notes=(f"{self.width} x {self.height} px", self._settings.where),
        )

    def describe(self) -> Json:
        """Return the source that was read."""
        return {
            "source": self._settings.source,
            "sensor": self._source.name,
            "serial": self._source.serial,
        }

    # ----------------------------------------------------------------------------------------

    def _check_fault(self) -> None:
        if self._closed:
            raise RigError(DEVICE, "it is closed; open it again")
        if self._fault is not None:
            raise RigError(DEVICE, f"{self._fault}; look at it and its cable, and open it again")

    def _check(self, news: bool) -> None:
        """Raise what is wrong, once all that came before was read."""
        if news:
            return
        self._check_fault()
        if self._running:
            silent_s = self._stall.waited_s(self._parts)
            if silent_s > self._settings.stall_s:
                raise RigError(DEVICE, f"silent for {silent_s:.1f} s; look at it and its cable")

    def _switch(self, on: bool) -> None:
        """Let the reading thread start or stop the source. Raises RigError."""
        with self._changed:
            if not on and not self._running:
                return
            self._check_fault()
            self._wanted = on
            self._changed.notify_all()

            def switched() -> bool:
                return self._running == on or self._fault is not None

            if on and self._running:  # what came before is dropped
                self._forget()
            if not self._changed.wait_for(switched, ANSWER_S):
                raise RigError(DEVICE, f"no answer within {ANSWER_S:g} s; look at it")
            self._check_fault()

    def _run(self) -> None:
        """The reading thread, the only one that uses the source; it ends with the source."""
        try:
            while True:
                with self._changed:
                    if self._closed:
                        return
                    wanted, running = self._wanted, self._running
                if wanted != running:
                    (self._source.start if wanted else self._source.stop)()
                    with self._changed:
                        if wanted:
                            self._forget()
                        if self._settings.source != "stream":  # its times may begin anew
                            self._last_us = self._last_pulse_us = -1
                        self._running = wanted
                        self._changed.notify_all()
                if wanted or self._settings.source == "stream":
                    found = self._source.read()
                    if found is not None:
                        with self._changed:
                            self._take(found)
                else:
                    with self._changed:
                        self._changed.wait_for(lambda: self._closed or self._wanted)
        except (OSError, FormatFault, RuntimeError) as error:
            with self._changed:
                self._fault = str(error)
                self._changed.notify_all()

    def _take(self, found: Decoded) -> None:
        """Take a part of the stream. Raises FormatFault: a clock fell back, or nobody reads."""
        kept = found.trigger_up & (found.trigger_id == self._settings.trigger)
        pulses = found.trigger_us[kept].tolist()
        t_us = found.events.t_us
        if len(t_us):
            if t_us[0] < self._last_us or np.any(np.diff(t_us) < 0):
                raise FormatFault(f"its clock fell back after {self._last_us} us")
            self._parts += int(t_us[-1]) > self._last_us  # times that stay the same are none
            self._last_us = int(t_us[-1])
        if pulses:
            if pulses[0] < self._last_pulse_us or pulses != sorted(pulses):
                text = f"its clock fell back after the pulse at {self._last_pulse_us} us"
                raise FormatFault(text)
            self._parts += pulses[-1] > self._last_pulse_us
            self._last_pulse_us = pulses[-1]
        if not self._running:
            return
        if self._stall.waited_s(self._parts) > self._settings.stall_s:
            raise FormatFault(f"its clock has stopped at {self._last_us} us")
        if len(t_us):
            self._events.append(found.events)
        self._pulses += pulses
        self._held += len(t_us) * EVENT_BYTES
        if self._held > self._settings.buffer_mb * 1e6:
            raise FormatFault(
                f"nobody read for so long that {self._settings.buffer_mb:g} MB are full"
            )
