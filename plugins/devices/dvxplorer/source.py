"""The source of events and triggers: a DVXplorer on USB, or two network streams.

Both are `dv.io.InputBase` of dv-processing 2.0.4, whose `getNext...` calls return at once, with
None if there are no data. A network stream carries one kind of data, so there are two; a camera
provides both. The library's constructors have no timeout, and an invalid packet terminates the
process: `plugins.devices.dvxplorer.process` runs all of this in a child process.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, Protocol

import numpy as np

from sliplab.plugins.devices.dvxplorer.settings import DvxplorerSettings, NetworkStream, UsbCamera
from sliplab.rigs.core.capabilities import DeviceHealth, RigError
from sliplab.rigs.core.network import BoundedSocket
from sliplab.storage.streams import I64, U8, EventChunk, Json

DEVICE = "event camera"
COMMIT_MS = 2
"""Period at which a USB camera sends data, ms; it adds to the latency."""
HEADER_S = 2.0
"""Timeout for a stream's header, which is sent on connecting, s."""
UNKNOWN = "unknown"
_MOST_HEADER = 1 << 20
"""Largest accepted header, bytes; real headers are below 1 kB."""


class Input(Protocol):
    """The part of `dv.io.InputBase` that is used."""

    def getNextEventBatch(self) -> Any:
        """An `EventStore`, or None."""

    def getNextTriggerBatch(self) -> Any:
        """A sequence of triggers, or None."""

    def isRunning(self) -> bool:
        """Return whether the device or the connection is alive."""


@dataclass(frozen=True)
class EventBatch:
    """The data that one read of an input returned.

    Attributes:
        events: in order of arrival, after the noise filter if it is on; None if there are none.
        filtered: number of events that the noise filter dropped.
        trigger_us: times of triggers, us of the camera's clock.
        trigger_kind: `dv.TriggerType` of each.
        running: True while the device or the connection is alive.
    """

    events: EventChunk | None
    filtered: int
    trigger_us: I64
    trigger_kind: U8
    running: bool

    @property
    def empty(self) -> bool:
        """True if there were no data."""
        return self.events is None and not len(self.trigger_us)


class DvxEventSource:
    """Opened inputs, in the process that opened them.

    Args:
        events: input that provides events.
        triggers: input that provides triggers; the same one for a camera.
        camera: the camera; None for streams.
        resolution: columns and rows.
        name: model and serial number, or the name in the stream's header.
        in_force: active settings as the camera reports them.
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
        """Switch a camera's events and its trigger input on or off; streams are not affected.

        Args:
            noise_filter_us: drop events without a neighbour within this time, us.

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
            raise RigError(DEVICE, f"cannot be switched on or off: {short(error)}") from None

    def poll(self) -> EventBatch:
        """Read all available data at once. Raises any exception of the library."""
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
        return EventBatch(
            events,
            filtered,
            np.array([int(trigger.timestamp) for trigger in rows_of], np.int64),
            np.array([int(trigger.type) for trigger in rows_of], np.uint8),
            bool(self._events.isRunning() and self._triggers.isRunning()),
        )

    def health(self, settings: DvxplorerSettings) -> DeviceHealth:
        """Return the health report of the camera, or of the stream.

        The only temperature sensor is in the IMU, which is off.

        Raises:
            RigError: the camera is disconnected.
        """
        if not (self._events.isRunning() and self._triggers.isRunning()):
            raise RigError(DEVICE, "the connection is lost; check its cable")
        width, height = self.resolution
        notes = [f"{width} x {height} px", f"{settings.buffer_mb:g} MB for unread events"]
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
                raise RigError(DEVICE, f"does not answer: {short(error)}") from None
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
        """Do nothing: the library closes inputs on deletion."""

    def _new_filter(self, within_us: int | None) -> Any:
        if within_us is None:
            return None
        import dv_processing as dv

        return dv.noise.BackgroundActivityNoiseFilter(
            self.resolution, timedelta(microseconds=within_us)
        )


def open_source(settings: UsbCamera | NetworkStream) -> DvxEventSource:
    """Open the source in the settings, in this process; the library may hang or terminate it.

    Raises:
        RigError: not found, in use, or not of the required kind.
    """
    if isinstance(settings, UsbCamera):
        return _open_camera(settings)
    return _open_streams(settings)


def find_camera(serial: str | None) -> Any:
    """Return the descriptor of a connected DVXplorer.

    Raises:
        RigError: none, none with this serial number, or several to choose from; the message lists
            the cameras found.
    """
    import dv_processing as dv

    found = dv.io.camera.discover()
    kind = dv.io.camera.CameraModel.DVXPLORER
    fitting = [c for c in found if c.cameraModel == kind and serial in (None, c.serialNumber)]
    if len(fitting) == 1:
        return fitting[0]
    there = ", ".join(f"{_plain(camera.cameraModel)} {camera.serialNumber}" for camera in found)
    if fitting:
        raise RigError(DEVICE, f"found several: {there}; select one by source.serial")
    wanted = "a DVXplorer" if serial is None else f"a DVXplorer with serial number {serial}"
    raise RigError(
        DEVICE,
        f"{wanted} was not found; found: {there or 'none'}. Check its cable and iniVation's udev "
        "rules",
    )


def _open_camera(settings: UsbCamera) -> DvxEventSource:
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
        raise RigError(DEVICE, f"{camera.getCameraName()} is not a DVXplorer")
    configure(camera, settings)
    found = in_force(camera)
    check_taken(found, settings)
    width, height = camera.getEventResolution()
    return DvxEventSource(camera, camera, camera, (width, height), camera.getCameraName(), found)


def configure(camera: Any, settings: UsbCamera) -> None:
    """Configure a `dv.io.camera.DVXplorer`: every setting that affects its events.

    The full sensor, every pixel, both polarities, not mirrored, global hold as by default;
    read-out, thresholds, rising edges. The IMU is off, because its unread data would fill the
    library's buffers, and so is the camera's signal generator.

    Raises:
        RigError: the camera refuses a setting.
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
        raise RigError(DEVICE, f"refuses a setting: {short(error)}") from None


_READ_BACK = (
    "CropArea",
    "SubSampleHorizontal",
    "SubSampleVertical",
    "DualBinning",
    "Flatten",
    "FlipHorizontal",
    "FlipVertical",
    "GlobalHold",
    "GlobalReset",
    "ReadoutFPS",
    "ContrastThresholdOn",
    "ContrastThresholdOff",
    "DetectorRisingEdges",
    "DetectorFallingEdges",
    "GeneratorInjectTriggerOnRisingEdge",
    "GeneratorInjectTriggerOnFallingEdge",
    "TimeInterval",
    "TimestampOffset",
)
"""Settings that affect recorded data, by the names of the library's `get...` methods."""


def in_force(camera: Any) -> Json:
    """Read back all settings that affect recorded data; None where the camera reports nothing.

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
    """Check the active settings against the rig file, as a camera may set another value.

    Raises:
        RigError: a setting differs.
    """
    for key, name, asked in (
        ("readout", "ReadoutFPS", settings.readout),
        ("contrast_on", "ContrastThresholdOn", settings.contrast_on),
        ("contrast_off", "ContrastThresholdOff", settings.contrast_off),
    ):
        if asked is not None and found[name] != asked:
            raise RigError(
                DEVICE, f"source.{key} = {asked}: the camera set {found[name]}; write a valid value"
            )


def _open_streams(settings: NetworkStream) -> DvxEventSource:
    import dv_processing as dv

    inputs = []
    for port in (settings.events_port, settings.triggers_port):
        check_header(settings.host, port)
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
    return DvxEventSource(events, triggers, None, (width, height), events.getCameraName())


def check_header(host: str, port: int) -> None:
    """Check that a port sends the header of a dv stream. Takes at most 2 `HEADER_S`.

    Raises:
        RigError: nothing listens there, or no such header comes in time; shows what came instead.
    """
    at = f"{host}:{port}"
    expected = "a stream of dv-processing sends its header on connecting"
    came = bytearray()
    try:
        with BoundedSocket.open(host, port, HEADER_S) as link:
            link.expect(HEADER_S, _MOST_HEADER)
            need = 12
            while len(came) < need:
                part = link.recv(need - len(came))
                if not part:
                    break
                came += part
                if len(came) == 12:
                    (length,) = struct.unpack_from("<I", came)
                    if came[8:12] != b"IOHE" or length > _MOST_HEADER:
                        raise RigError(
                            DEVICE,
                            f"{at} is not a dv-processing stream: it began with {bytes(came)!r}; "
                            "check events_port and triggers_port",
                        )
                    need = 4 + length
    except TimeoutError:
        if came:
            raise RigError(DEVICE, f"{at} sent only {len(came)} bytes of its header") from None
        raise RigError(
            DEVICE,
            f"{at}: no answer within {HEADER_S:g} s; {expected}. Check events_port, "
            "triggers_port and the server there",
        ) from None
    except OSError as error:
        raise RigError(DEVICE, f"{at}: {error}; check the address and its server") from None
    if len(came) < need:
        raise RigError(
            DEVICE, f"{at} disconnected after {len(came)} bytes; {expected}. Check its server"
        )


def short(error: Exception) -> str:
    """Return the text of a library error without source line and stack trace."""
    text = str(error).split("\nStacktrace")[0].strip()
    return text.rsplit("Error: ", 1)[-1].strip() or type(error).__name__


def _plain(choice: Any) -> str:
    return str(choice.name).lower().replace("_", " ")
