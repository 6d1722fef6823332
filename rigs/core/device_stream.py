"""A device of a rig and its stream, which has a name.

The streams of a trial are started before the pulses, read with them, and stopped after them. What a
further device raises names its stream, and ends a trial as a fault of a first camera does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

from sliplab.rigs.core.capabilities import DeviceHealth, RigError
from sliplab.storage.schema.trial import StreamRecord
from sliplab.storage.streams import EVENTS_KIND, FRAMES_KIND, Chunk, Json, Sink


@dataclass(frozen=True)
class DeviceStream:
    """A camera or sensor and its stream.

    Attributes:
        name: of the stream: ``events`` and ``frames`` are those of the first cameras.
        device: has `start`, `stop`, `close`, and `read`, which returns chunks of its kind; sensors
            have `connect` too. Cameras connect on construction.
        about: what a trial's record says of the stream; its rows are counted later.
    """

    name: str
    device: Any
    about: StreamRecord

    @property
    def through_host(self) -> bool:
        """True if the host has to read the sync box's clock to time this device."""
        return self.about.timing is not None and self.about.timing.through_host

    @contextmanager
    def _named(self) -> Iterator[None]:
        try:
            yield
        except RigError as error:
            if self.name in {EVENTS_KIND, FRAMES_KIND}:
                raise
            text = str(error).removeprefix(f"{error.device}: ")
            raise RigError(f"{self.name} ({error.device})", text) from error

    def connect(self) -> None:
        """Open the connection, unless that was done on construction."""
        if not self.about.of_camera:
            with self._named():
                self.device.connect()

    def prepare(self) -> None:
        """Take the present load for zero, where that is done before each trial.

        The arm is clear of the plate.
        """
        if getattr(self.device, "zeroing", None) == "trial":
            with self._named():
                self.device.zero()

    def start(self) -> None:
        """Start streaming; earlier data are discarded."""
        with self._named():
            self.device.start()

    def stop(self) -> None:
        """Stop streaming; safe to call in any state."""
        with self._named():
            self.device.stop()

    def close(self) -> None:
        """Release the device."""
        self.device.close()

    def drain(self, sink: Sink) -> None:
        """Read what has come: pulses of an event camera too, and a clock that times frames."""
        timing = self.about.timing
        reads = [self.device.read]
        if self.about.kind == EVENTS_KIND:
            reads.append(self.device.read_pulses)
        elif timing is not None and timing.grade == "device time stamps":
            reads.append(self.device.read_clock)
        self._read(sink, *reads)

    def finish(self, sink: Sink) -> None:
        """Stop, and read what was sent before; of an event camera only late pulses."""
        self.stop()
        with_events = self.about.kind == EVENTS_KIND
        self._read(sink, self.device.read_pulses if with_events else self.device.read)

    def _read(self, sink: Sink, *reads: Callable[[], Chunk]) -> None:
        with self._named():
            chunks = [read() for read in reads]
        for chunk in chunks:
            sink.add(self.name, chunk)

    def health(self) -> DeviceHealth | None:
        """Return the device's health report; None where it has none."""
        report = getattr(self.device, "health", None)
        if report is None:
            return None
        with self._named():
            found: DeviceHealth = report()
        return replace(found, device=f"{self.name} ({found.device})")

    def describe(self) -> Json | None:
        """Return settings, counts and losses of the trial that just ran, if it reports any."""
        describe = getattr(self.device, "describe", None)
        return None if describe is None else describe()
