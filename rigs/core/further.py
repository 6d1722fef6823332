"""Devices besides a rig's first cameras and force sensor: each gives one stream with a name.

They are started after the first cameras and before the pulses, read with them, and closed last.
Whatever one of them raises names its stream, and ends a trial as a fault of a first camera does.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

from sliplab.rigs.core.capabilities import (
    DeviceHealth,
    EventCamera,
    ForceSensor,
    FrameCamera,
    RigError,
    ScalarSensor,
)
from sliplab.storage.schema.trial import StreamRecord
from sliplab.storage.streams import Json, Sink


@dataclass(frozen=True)
class _Further:
    """A device and its stream.

    Attributes:
        name: of the stream.
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
            text = str(error).removeprefix(f"{error.device}: ")
            raise RigError(f"{self.name} ({error.device})", text) from error

    def connect(self) -> None:
        """Open the connection, unless that was done on construction."""

    def prepare(self) -> None:
        """Make ready for a trial: the arm is clear of the plate."""

    def start(self) -> None:
        """Start streaming; earlier data are discarded."""
        with self._named():
            self.device.start()

    def stop(self) -> None:
        """Stop streaming; safe to call in any state."""
        with self._named():
            self.device.stop()

    def close(self) -> None:
        """Give the device back."""
        self.device.close()

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


@dataclass(frozen=True)
class FurtherEvents(_Further):
    """A further event camera, with an input for the sync pulses."""

    device: EventCamera

    def drain(self, sink: Sink) -> None:
        """Read what has come."""
        with self._named():
            events, pulses = self.device.read(), self.device.read_pulses()
        sink.add(self.name, events)
        sink.add(self.name, pulses)

    def finish(self, sink: Sink) -> None:
        """Stop, and read late pulses, as of the first event camera."""
        with self._named():
            self.device.stop()
            pulses = self.device.read_pulses()
        sink.add(self.name, pulses)


@dataclass(frozen=True)
class FurtherFrames(_Further):
    """A further frame camera."""

    device: FrameCamera

    def drain(self, sink: Sink) -> None:
        """Read what has come, and the camera's clock where that times it."""
        with self._named():
            frames = self.device.read()
            timing = self.about.timing
            by_reads = timing is not None and timing.grade == "device time stamps"
            reads = self.device.read_clock() if by_reads else None
        sink.add(self.name, frames)
        if reads is not None:
            sink.add(self.name, reads)

    def finish(self, sink: Sink) -> None:
        """Stop, and read the frames that were exposed before."""
        with self._named():
            self.device.stop()
            frames = self.device.read()
        sink.add(self.name, frames)


@dataclass(frozen=True)
class FurtherScalars(_Further):
    """A sensor of one quantity."""

    device: ScalarSensor

    def connect(self) -> None:
        """Open the connection."""
        with self._named():
            self.device.connect()

    def drain(self, sink: Sink) -> None:
        """Read what has come."""
        with self._named():
            readings = self.device.read()
        sink.add(self.name, readings)

    def finish(self, sink: Sink) -> None:
        """Stop, and read what was sent before."""
        with self._named():
            self.device.stop()
            readings = self.device.read()
        sink.add(self.name, readings)


@dataclass(frozen=True)
class FurtherForces(_Further):
    """A further force sensor, which is recorded only."""

    device: ForceSensor

    def connect(self) -> None:
        """Open the connection."""
        with self._named():
            self.device.connect()

    def prepare(self) -> None:
        """Take the present load for zero, where that is done before each trial."""
        if self.device.zeroing == "trial":
            with self._named():
                self.device.zero()

    def drain(self, sink: Sink) -> None:
        """Read what has come."""
        with self._named():
            forces = self.device.read()
        sink.add(self.name, forces)

    def finish(self, sink: Sink) -> None:
        """Stop, and read what was sent before."""
        with self._named():
            self.device.stop()
            forces = self.device.read()
        sink.add(self.name, forces)


FurtherStream = FurtherEvents | FurtherFrames | FurtherForces | FurtherScalars
