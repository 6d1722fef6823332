"""The source of events and triggers: a DVXplorer on USB, or two streams on the network.

All of them are `dv.io.InputBase` of dv-processing 2.0.4, whose `getNext...` calls return at once,
with None where there is nothing. A network stream carries one kind of data, so there are two; a
camera gives both. The library's constructors have no deadline, and what is no packet ends the
process that it runs in: `rigs.devices.dvxplorer.process` keeps all of this in a process of its own.
"""

from __future__ import annotations

import socket
import struct
import time
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, Protocol

import numpy as np

from sliplab.rigs.core.capabilities import DeviceHealth, RigError
from sliplab.rigs.devices.dvxplorer.settings import DvxplorerSettings, NetworkStream, UsbCamera
from sliplab.storage.streams import I64, U8, EventChunk, Json

DEVICE = "event camera"
COMMIT_MS = 2
"""Period at which a USB camera sends its data, ms: its part of the latency."""
GREETING_S = 2.0
"""A stream that is connected to sends its header at once; it must be there by then, s."""
UNKNOWN = "unknown"
_MOST_HEADER = 1 << 20
"""Bytes; the header of a stream is below 1 kB."""


class Input(Protocol):
    """The part of `dv.io.InputBase` that is used."""

    def getNextEventBatch(self) -> Any:
        """An `EventStore`, or None."""

    def getNextTriggerBatch(self) -> Any:
        """A sequence of triggers, or None."""

    def isRunning(self) -> bool:
        """Return whether the device or the connection still lives."""


@dataclass(frozen=True)
class Look:
    """All that an input had at one moment.

    Attributes:
        events: in the order of arrival, after the noise filter if it is on; None where none came.
        filtered: events that the noise filter dropped.
        trigger_us: times of triggers, us of the camera's clock.
        trigger_kind: `dv.TriggerType` of each.
        running: the device or the connection still lives.
    """

    events: EventChunk | None
    filtered: int
    trigger_us: I64
    trigger_kind: U8
    running: bool

    @property
    def empty(self) -> bool:
        """Nothing had come."""
        return self.events is None and not len(self.trigger_us)


class EventSource:
    """Opened inputs, in the process that opened them.

    Args:
        events: input that gives events.
        triggers: input that gives triggers; the same one for a camera.
        camera: the camera, if it is one that can be switched.
        resolution: columns and rows.
        name: model and serial number, or what the stream says of itself.
        in_force: settings as the camera says them.
    """

    def __init__(
        self,
        events: Input,
        triggers: Input,
        camera: Any,
        resolution: tuple[int, int],
        name: str,
        in_force: Json | None = None,
    ) -> None:
        self._events, self._triggers, self._camera = events, triggers, camera
        self.resolution, self.name, self.in_force = resolution, name, in_force or {}
        self._filter: Any = None

    def run(self, on: bool, noise_filter_us: int | None = None) -> None:
        """Switch a camera's events and its trigger input; a stream flows as it likes.

        Args:
            noise_filter_us: drop events without a neighbour within so many microseconds.

        Raises:
            RigError: the camera does not answer.
        """
        if on:
            self._filter = self._new_filter(noise_filter_us)
        if self._camera is None:
            return
        try:
            self._camera.setEventsRunning(on)
            self._camera.setDetectorRunning(on)
        except RuntimeError as error:
            raise RigError(DEVICE, f"it cannot be switched: {short(error)}") from None

    def look(self) -> Look:
        """Take all that has come; returns at once. Raises whatever the library raises."""
        batch, triggers = self._events.getNextEventBatch(), self._triggers.getNextTriggerBatch()
        events, filtered = None, 0
        if batch is not None:
            if self._filter is not None:
                came = batch.size()
                self._filter.accept(batch)
                batch = self._filter.generateEvents()
                filtered = came - batch.size()
            rows = batch.numpy()
            events = EventChunk(
                rows["x"].astype(np.uint16),
                rows["y"].astype(np.uint16),
                rows["polarity"].astype(np.uint8),
                np.ascontiguousarray(rows["timestamp"], np.int64),
            )
        rows_of = [] if triggers is None else list(triggers)
        return Look(
            events,
            filtered,
            np.array([int(trigger.timestamp) for trigger in rows_of], np.int64),
            np.array([int(trigger.type) for trigger in rows_of], np.uint8),
            bool(self._events.isRunning() and self._triggers.isRunning()),
        )

    def health(self, settings: DvxplorerSettings) -> DeviceHealth:
        """Return the report of the camera, or of the stream.

        Its only thermometer is the IMU's, and the IMU is off.

        Raises:
            RigError: the camera is gone.
        """
        if not (self._events.isRunning() and self._triggers.isRunning()):
            raise RigError(DEVICE, "the connection is gone; look at its cable")
        width, height = self.resolution
        notes = [f"{width} x {height} px", f"{settings.buffer_mb:g} MB for events nobody has read"]
        serial = firmware = UNKNOWN
        camera = self._camera
        if camera is not None:
            try:
                serial = str(camera.getSerialNumber())
                firmware = f"{camera.getFirmwareVersion()}, logic {camera.getLogicVersion()}"
                speed = _plain(camera.getConnectionSpeed()).removeprefix("libusb speed ")
                notes.append(f"link {speed}")
                notes.append(f"read-out {_plain(camera.getReadoutFPS())}")
            except RuntimeError as error:
                raise RigError(DEVICE, f"it does not answer: {short(error)}") from None
        else:
            notes.append("from the network")
        return DeviceHealth(
            device=DEVICE,
            model=self.name,
            serial=serial,
            firmware=firmware,
            temperature_c=None,
            clock="the camera's, 1 us",
            notes=tuple(notes),
        )

    def close(self) -> None:
        """Nothing: the library closes what nobody holds any more."""

    def _new_filter(self, within_us: int | None) -> Any:
        if within_us is None:
            return None
        import dv_processing as dv

        return dv.noise.BackgroundActivityNoiseFilter(
            self.resolution, timedelta(microseconds=within_us)
        )


def open_source(settings: UsbCamera | NetworkStream) -> EventSource:
    """Open what the settings say, in this process: the library may hang, or end it.

    Raises:
        RigError: not there, in use, or not of the kind that is needed.
    """
    if isinstance(settings, UsbCamera):
        return _open_camera(settings)
    return _open_streams(settings)


def find_camera(serial: str | None) -> Any:
    """The descriptor of a DVXplorer that is plugged in.

    Raises:
        RigError: none, none with this serial number, or several to choose from; with all that are
            there.
    """
    import dv_processing as dv

    found = dv.io.camera.discover()
    kind = dv.io.camera.CameraModel.DVXPLORER
    fitting = [c for c in found if c.cameraModel == kind and serial in (None, c.serialNumber)]
    if len(fitting) == 1:
        return fitting[0]
    there = ", ".join(f"{_plain(camera.cameraModel)} {camera.serialNumber}" for camera in found)
    if fitting:
        raise RigError(DEVICE, f"there are several: {there}; name one by source.serial")
    wanted = "a DVXplorer" if serial is None else f"a DVXplorer with serial number {serial}"
    raise RigError(
        DEVICE,
        f"{wanted} was not found; there: {there or 'none'}. Look at its cable, and at iniVation's "
        "udev rules",
    )


def _open_camera(settings: UsbCamera) -> EventSource:
    import dv_processing as dv

    there = find_camera(settings.serial)
    try:
        camera = dv.io.camera.open(there)
    except RuntimeError as error:
        raise RigError(
            DEVICE,
            f"{there.serialNumber} cannot be opened: {short(error)}; is another program using it?",
        ) from None
    if not isinstance(camera, dv.io.camera.DVXplorer):
        raise RigError(DEVICE, f"{camera.getCameraName()} is no DVXplorer")
    configure(camera, settings)
    found = in_force(camera)
    check_taken(found, settings)
    width, height = camera.getEventResolution()
    return EventSource(camera, camera, camera, (width, height), camera.getCameraName(), found)


def configure(camera: Any, settings: UsbCamera) -> None:
    """Set a `dv.io.camera.DVXplorer`: all that changes its events, whatever was set before.

    The whole sensor, every pixel, both polarities, not mirrored, global hold as the maker has it;
    read-out, thresholds, rising edges. What nobody reads would only fill the library's buffers, so
    the IMU is off, and so is the camera's own signal generator.

    Raises:
        RigError: the camera refuses.
    """
    import dv_processing as dv

    kind = dv.io.camera.DVXplorer
    name = settings.readout.upper().replace(" ", "_")
    width, height = camera.getEventResolution()
    try:
        camera.setCropArea((0, 0, width, height))
        camera.setSubSampleHorizontal(kind.SubSample.EVERY_PIXEL)
        camera.setSubSampleVertical(kind.SubSample.EVERY_PIXEL)
        camera.setDualBinning(False)
        camera.setFlatten(kind.Flatten.NONE)
        camera.setFlipHorizontal(False)
        camera.setFlipVertical(False)
        camera.setGlobalHold(True)
        camera.setGlobalReset(False)
        camera.setReadoutFPS(getattr(kind.ReadoutFPS, name))
        if settings.contrast_on is not None:
            camera.setContrastThresholdOn(settings.contrast_on)
        if settings.contrast_off is not None:
            camera.setContrastThresholdOff(settings.contrast_off)
        camera.setImuRunningAccelerometer(False)
        camera.setImuRunningGyroscope(False)
        camera.setImuRunningTemperature(False)
        camera.setGeneratorRunning(False)
        camera.setGeneratorInjectTriggerOnRisingEdge(False)
        camera.setGeneratorInjectTriggerOnFallingEdge(False)
        camera.setDetectorRisingEdges(True)
        camera.setDetectorFallingEdges(False)
        camera.setTimeInterval(timedelta(milliseconds=COMMIT_MS))
    except (RuntimeError, ValueError) as error:
        raise RigError(DEVICE, f"it refuses a setting: {short(error)}") from None


_READ_BACK = (
    "CropArea", "SubSampleHorizontal", "SubSampleVertical", "DualBinning", "Flatten",
    "FlipHorizontal", "FlipVertical", "GlobalHold", "GlobalReset", "ReadoutFPS",
    "ContrastThresholdOn", "ContrastThresholdOff", "DetectorRisingEdges", "DetectorFallingEdges",
    "GeneratorInjectTriggerOnRisingEdge", "GeneratorInjectTriggerOnFallingEdge",
    "TimeInterval", "TimestampOffset",
)  # fmt: skip
"""Settings that change what is recorded, by the names of the library's `get...`."""


def in_force(camera: Any) -> Json:
    """All settings that change what is recorded, as the camera says them; None where it does not.

    Times are microseconds; choices are the library's names.
    """
    found: Json = {}
    for name in _READ_BACK:
        try:
            value = getattr(camera, f"get{name}")()
        except RuntimeError:
            value = None
        if isinstance(value, timedelta):
            value = round(value.total_seconds() * 1e6)
        elif isinstance(value, tuple):
            value = [int(number) for number in value]
        elif not isinstance(value, bool | int | None):
            value = _plain(value)
        found[name] = value
    return found


def check_taken(found: Json, settings: UsbCamera) -> None:
    """Hold what is in force against what the rig file says: a camera may take another value.

    Raises:
        RigError: it did.
    """
    for key, name, asked in (
        ("readout", "ReadoutFPS", settings.readout),
        ("contrast_on", "ContrastThresholdOn", settings.contrast_on),
        ("contrast_off", "ContrastThresholdOff", settings.contrast_off),
    ):
        if asked is not None and found[name] != asked:
            raise RigError(
                DEVICE, f"source.{key} = {asked}: the camera took {found[name]}; give what it takes"
            )


def _open_streams(settings: NetworkStream) -> EventSource:
    import dv_processing as dv

    inputs = []
    for port in (settings.events_port, settings.triggers_port):
        greet(settings.host, port)
        try:
            inputs.append(dv.io.NetworkReader(settings.host, port))
        except RuntimeError as error:
            raise RigError(DEVICE, f"{settings.host}:{port}: {short(error)}") from None
    events, triggers = inputs
    resolution = events.getEventResolution()
    if not events.isEventStreamAvailable() or resolution is None:
        raise RigError(DEVICE, f"{settings.host}:{settings.events_port} sends no events")
    if not triggers.isTriggerStreamAvailable():
        raise RigError(DEVICE, f"{settings.host}:{settings.triggers_port} sends no triggers")
    width, height = resolution
    return EventSource(events, triggers, None, (width, height), events.getCameraName())


def greet(host: str, port: int) -> None:
    """Look at what a port sends first: the header of one of dv's streams. At most 2 `GREETING_S`.

    Raises:
        RigError: nobody listens, or sends no such header in time; with what came instead.
    """
    at = f"{host}:{port}"
    belongs = "a stream of dv-processing sends its header at once"
    came = bytearray()
    end = time.monotonic() + GREETING_S
    try:
        with socket.create_connection((host, port), GREETING_S) as link:
            need = 12
            while len(came) < need:
                link.settimeout(max(end - time.monotonic(), 0.001))
                part = link.recv(need - len(came))
                if not part:
                    break
                came += part
                if len(came) == 12:
                    (length,) = struct.unpack_from("<I", came)
                    if came[8:12] != b"IOHE" or length > _MOST_HEADER:
                        raise RigError(
                            DEVICE,
                            f"{at} is no stream of dv-processing: it began with {bytes(came)!r}; "
                            "look at events_port and triggers_port",
                        )
                    need = 4 + length
    except TimeoutError:
        if came:
            raise RigError(DEVICE, f"{at} sent {len(came)} bytes of its header, no more") from None
        raise RigError(
            DEVICE,
            f"{at}: no answer within {GREETING_S:g} s; {belongs}. Look at events_port, "
            "triggers_port and at what listens there",
        ) from None
    except OSError as error:
        raise RigError(DEVICE, f"{at}: {error}; look at the address and its server") from None
    if len(came) < need:
        raise RigError(
            DEVICE, f"{at} hung up after {len(came)} bytes; {belongs}. Look at its server"
        )


def short(error: Exception) -> str:
    """The text of one of the library's errors, without its source's line and stack."""
    text = str(error).split("\nStacktrace")[0].strip()
    return text.rsplit("Error: ", 1)[-1].strip() or type(error).__name__


def _plain(choice: Any) -> str:
    return str(choice.name).lower().replace("_", " ")
