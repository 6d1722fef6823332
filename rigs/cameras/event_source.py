"""Where events and triggers come from: a DVXplorer on USB, or two streams on the network.

All of them are `dv.io.InputBase` of dv-processing 2.0.4, whose `getNext...` calls return at once,
with None where there is nothing. A network stream carries one kind of data, so there are two; a
camera gives both.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, Protocol, TypeVar

from rigs.cameras.settings import NetworkStream, UsbCamera
from rigs.capabilities import RigError

DEVICE = "event camera"
OPEN_S = 10.0
"""The longest that opening a camera or a stream takes, s."""
COMMIT_MS = 2
"""How often a USB camera hands over what it has, ms: its part of the latency."""
Made = TypeVar("Made")


class Input(Protocol):
    """The part of `dv.io.InputBase` that is used."""

    def getNextEventBatch(self) -> Any:
        """An `EventStore`, or None."""

    def getNextTriggerBatch(self) -> Any:
        """A sequence of triggers, or None."""

    def isRunning(self) -> bool:
        """Whether the device or the connection still lives."""


@dataclass(frozen=True)
class EventSource:
    """Opened inputs.

    Attributes:
        events: input that gives events.
        triggers: input that gives triggers; the same one for a camera.
        camera: the camera, if it is one that can be switched.
        resolution: columns and rows.
        name: model and serial number, or what the stream says of itself.
    """

    events: Input
    triggers: Input
    camera: Any
    resolution: tuple[int, int]
    name: str

    def run(self, on: bool) -> None:
        """Switch a camera's events and its trigger input; a stream flows as it likes.

        Raises:
            RigError: the camera does not answer.
        """
        if self.camera is None:
            return
        try:
            self.camera.setEventsRunning(on)
            self.camera.setDetectorRunning(on)
        except RuntimeError as error:
            raise RigError(DEVICE, f"it cannot be switched: {error}") from None


def open_source(settings: UsbCamera | NetworkStream) -> EventSource:
    """Open what the settings say; bounded by `OPEN_S`.

    Raises:
        RigError: not there, in use, not of the kind that is needed, or too slow.
    """
    if isinstance(settings, UsbCamera):
        return _within(lambda: _open_camera(settings), "opening the camera")
    return _within(lambda: _open_streams(settings), "connecting to the streams")


def _open_camera(settings: UsbCamera) -> EventSource:
    import dv_processing as dv

    try:
        camera = (
            dv.io.camera.open() if settings.serial is None else dv.io.camera.open(settings.serial)
        )
    except RuntimeError as error:
        raise RigError(DEVICE, f"no camera: {error}; look at its cable") from None
    if not isinstance(camera, dv.io.camera.DVXplorer):
        raise RigError(DEVICE, f"{camera.getCameraName()} is no DVXplorer")
    configure(camera, settings)
    width, height = camera.getEventResolution()
    return EventSource(camera, camera, camera, (width, height), camera.getCameraName())


def configure(camera: Any, settings: UsbCamera) -> None:
    """Set a `dv.io.camera.DVXplorer`: read-out, thresholds, rising edges; no IMU.

    What nobody reads would only fill the library's buffers, so the IMU is off.

    Raises:
        RigError: the camera refuses.
    """
    name = settings.readout.upper().replace(" ", "_")
    try:
        camera.setReadoutFPS(getattr(type(camera).ReadoutFPS, name))
        if settings.contrast_on is not None:
            camera.setContrastThresholdOn(settings.contrast_on)
        if settings.contrast_off is not None:
            camera.setContrastThresholdOff(settings.contrast_off)
        camera.setImuRunningAccelerometer(False)
        camera.setImuRunningGyroscope(False)
        camera.setImuRunningTemperature(False)
        camera.setDetectorRisingEdges(True)
        camera.setDetectorFallingEdges(False)
        camera.setTimeInterval(timedelta(milliseconds=COMMIT_MS))
    except (RuntimeError, ValueError) as error:
        raise RigError(DEVICE, f"it refuses a setting: {error}") from None


def _open_streams(settings: NetworkStream) -> EventSource:
    import dv_processing as dv

    inputs = []
    for port in (settings.events_port, settings.triggers_port):
        try:
            inputs.append(dv.io.NetworkReader(settings.host, port))
        except RuntimeError as error:
            raise RigError(DEVICE, f"{settings.host}:{port}: {error}") from None
    events, triggers = inputs
    resolution = events.getEventResolution()
    if not events.isEventStreamAvailable() or resolution is None:
        raise RigError(DEVICE, f"{settings.host}:{settings.events_port} sends no events")
    if not triggers.isTriggerStreamAvailable():
        raise RigError(DEVICE, f"{settings.host}:{settings.triggers_port} sends no triggers")
    width, height = resolution
    return EventSource(events, triggers, None, (width, height), events.getCameraName())


def _within(make: Callable[[], Made], what: str) -> Made:
    """Do it in a thread, for the library may wait for ever."""
    done: list[Made] = []
    failed: list[BaseException] = []

    def work() -> None:
        try:
            done.append(make())
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=work, name=what, daemon=True)
    thread.start()
    thread.join(OPEN_S)
    if failed:
        raise failed[0]
    if not done:
        raise RigError(DEVICE, f"{what} has not ended within {OPEN_S:g} s")
    return done[0]
