"""The camera that looks through the plate: a Basler camera through pylon.

Written for the a2A1920-160ucBAS (USB 3 Vision) and pypylon 26.9, which includes pylon 12.4. The
driver queries the camera's features, so other Basler models may work. Settings have their GenICam
SFNC 2.5 names and, where pylon's emulation of an older family differs, its older name too. For the
meaning of a frame's time see `frame_time.py`; docs/cameras.md lists what is untested on a real
camera.
"""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any

import numpy as np

from sliplab.plugins.devices.basler.frame_time import Abilities, choose
from sliplab.plugins.devices.basler.grabbing import Grab, GrabCounts, GrabSettings
from sliplab.plugins.devices.basler.nodes import (
    DEVICE,
    Nodes,
    centre_region,
    check_rate,
    has_latch,
    latch_clock,
    read_back,
    write_settings,
)
from sliplab.plugins.devices.basler.settings import BaslerSettings
from sliplab.rigs.core.capabilities import UNKNOWN, DeviceHealth, RigError
from sliplab.storage.streams import ClockReads, FrameChunk, Json

TRIGGER_READY_MS = 1000
"""Time for which a software trigger waits for the camera to be ready, ms."""
_LEAST_BUFFERS = 8
_END_OF_EXPOSURE = "EventExposureEndData"


def find_device_info(serial: str | None, device_class: str | None = None) -> Any:
    """Return pylon's description of a connected camera, without opening it.

    Args:
        device_class: pylon's device class, such as `BaslerCamEmu`; any if None.

    Raises:
        RigError: no camera, none with this serial number, or several to choose from.
    """
    from pypylon import pylon

    found = [
        info
        for info in pylon.TlFactory.GetInstance().EnumerateDevices()
        if device_class in (None, info.GetDeviceClass())
    ]
    fitting = [info for info in found if serial in (None, info.GetSerialNumber())]
    if len(fitting) == 1:
        return fitting[0]
    there = ", ".join(info.GetSerialNumber() for info in found) or "none"
    if fitting:
        raise RigError(DEVICE, f"found several: {there}; select one by serial")
    wanted = "no camera" if serial is None else f"no camera with serial number {serial}"
    raise RigError(DEVICE, f"{wanted}; found: {there}. Check its cable and its power")


def find_camera(serial: str | None, device_class: str | None = None) -> Any:
    """Return a pypylon `InstantCamera` that is not open yet; see `find_device_info`.

    Raises:
        RigError: no camera, several to choose from, or another program has it.
    """
    from pypylon import genicam, pylon

    info = find_device_info(serial, device_class)
    try:
        return pylon.InstantCamera(pylon.TlFactory.GetInstance().CreateDevice(info))
    except genicam.GenericException as error:
        raise RigError(DEVICE, f"{info.GetFriendlyName()}: {error}") from None


class BaslerCamera:
    """A `rigs.core.capabilities.FrameCamera`; opened on construction, grabbing from `start`.

    Args:
        device: an `InstantCamera` that is not open; None to search for one.

    Raises:
        RigError: no such camera, or a setting that it refuses.
    """

    def __init__(self, settings: BaslerSettings, device: Any = None) -> None:
        self.settings, self.px_per_mm = settings, settings.px_per_mm or math.nan
        self._device = device if device is not None else find_camera(settings.serial)
        self._nodes: Nodes | None = None
        self._grab: Grab | None = None
        self._running = False
        self._ends: dict[int, int] = {}
        self._chunks: set[str] = set()
        self._listener: Any = None
        self._shape = (0, 0)
        from pypylon import genicam

        self._genicam = genicam
        try:
            self._device.GrabCameraEvents.Value = True
            self._device.Open()
            self._nodes = Nodes(self._device.GetNodeMap())
            self._configure()
        except genicam.GenericException as error:
            self.close()
            raise RigError(DEVICE, f"cannot be opened: {error}") from None
        except RigError:
            self.close()
            raise

    def _configure(self) -> None:
        nodes, settings = self.nodes, self.settings
        write_settings(nodes, settings)
        exposure = "ExposureTime" if nodes.has("ExposureTime") else "ExposureTimeAbs"
        self.mid_exposure_ns = round(float(nodes.get(exposure)) * 500)
        self.stamping = choose(self._abilities(), settings.trigger)
        self._shape = (int(nodes.get("Height")), int(nodes.get("Width")))
        self._in_force = read_back(nodes)

    def _abilities(self) -> Abilities:
        """Detect the camera's abilities, and enable those that are used."""
        nodes, settings = self.nodes, self.settings
        chunk = self._chunk("Timestamp")
        level = chunk and settings.sync_line is not None and self._chunk("LineStatusAll")
        result = bool(self.device.IsUsb() or self.device.IsGigE())
        event = not (chunk or result) and nodes.offers("EventSelector", "ExposureEnd")
        if event:
            self._listen()
        return Abilities(
            chunk=chunk,
            result=result,
            event=event,
            latch=has_latch(nodes),
            sync_level=level,
            exposure_line=settings.exposure_line is not None,
        )

    def _chunk(self, name: str) -> bool:
        """Enable a chunk if the camera has it; return whether it does."""
        nodes = self.nodes
        if not nodes.has("ChunkModeActive"):
            return False
        nodes.put(True, "ChunkModeActive")
        if not nodes.offers("ChunkSelector", name):
            # pylon's emulation has the mode but no chunks: left on, no grab would start
            nodes.put(bool(self._chunks), "ChunkModeActive")
            return False
        nodes.put(name, "ChunkSelector")
        nodes.put(True, "ChunkEnable")
        self._chunks.add(name)
        return True

    def _listen(self) -> None:
        """Record the end of every exposure: frame id and time, ns."""
        from pypylon import pylon

        ends = self._ends

        class Listener(pylon.CameraEventHandler):
            def OnCameraEvent(self, camera: Any, user: int, node: Any) -> None:
                ends[int(camera.EventExposureEndFrameID.Value)] = int(
                    camera.EventExposureEndTimestamp.Value
                )

        # pylon keeps no reference, so deregister the listener before it is deleted
        self._listener = Listener()
        self.device.RegisterCameraEventHandler(
            self._listener,
            _END_OF_EXPOSURE,
            1,
            pylon.RegistrationMode_Append,
            pylon.Cleanup_None,
            pylon.CameraEventAvailability_Mandatory,
        )
        self.nodes.put("ExposureEnd", "EventSelector")
        self.nodes.put("On", "EventNotification")

    @property
    def counts(self) -> GrabCounts:
        """Frame counts of this run, or of the last one."""
        return self._grab.counts if self._grab is not None else GrabCounts()

    def describe(self) -> Json:
        """Return the camera's part of a trial's record: device, region, times and losses."""
        info, stamping = self.device.GetDeviceInfo(), self.stamping
        height, width = self._shape
        return {
            "model": info.GetModelName(),
            "serial": info.GetSerialNumber(),
            "region_px": [width, height],
            "exposure_us": self.mid_exposure_ns / 500,
            "settings": self.settings.model_dump(mode="json"),
            "in_force": self._in_force,
            "time_stamps": stamping.means,
            "grade": stamping.grade,
            "counts": vars(self.counts) | {"lost": self.counts.lost},
        }

    def health(self) -> DeviceHealth:
        """Return the camera's health report, grabbing or not.

        Not tested on a real camera yet: features that a camera lacks are left out or `unknown`.

        Raises:
            RigError: the camera is disconnected.
        """
        device, nodes, stamping = self.device, self.nodes, self.stamping
        if device.IsCameraDeviceRemoved():
            raise RigError(DEVICE, "the camera was unplugged; plug it in and open it again")
        info = device.GetDeviceInfo()
        height, width = self._shape
        notes = [f"region {width} x {height} px"]
        rate = nodes.peek(
            "ResultingFrameRate", "BslResultingAcquisitionFrameRate", "ResultingFrameRateAbs"
        )
        if rate is not None:
            notes.append(f"at most {rate:.0f} frames/s")
        if device.IsGrabbing():
            free = device.NumQueuedBuffers.Value + device.NumEmptyBuffers.Value
            notes.append(f"{free} of {self._buffers} buffers free")
        else:
            notes.append(f"{self._buffers} buffers")
        if (speed := nodes.peek("BslUSBSpeedMode")) is not None:
            notes.append(f"link {speed}")
        if (limit := nodes.peek("DeviceLinkThroughputLimit")) is not None:
            notes.append(f"link limited to {limit / 1e6:.0f} MB/s")
        celsius = nodes.peek("DeviceTemperature", "TemperatureAbs")
        return DeviceHealth(
            device=DEVICE,
            model=info.GetModelName() or UNKNOWN,
            serial=info.GetSerialNumber() or UNKNOWN,
            firmware=str(nodes.peek("DeviceFirmwareVersion", "DeviceVersion") or UNKNOWN),
            temperature_c=None if celsius is None else float(celsius),
            clock=stamping.means
            if stamping.means == stamping.grade
            else f"{stamping.means}, grade {stamping.grade}",
            notes=tuple(notes),
        )

    @property
    def _buffers(self) -> int:
        """Number of pylon's buffers, and length of the queue."""
        half = math.ceil(self.settings.rate_hz * self.settings.back_pressure_s / 2)
        return max(half, _LEAST_BUFFERS)

    def set_region(self, width_px: int, height_px: int) -> None:
        """Read out only a centred region.

        Raises:
            RigError: the camera is grabbing, or the sensor cannot read out this region.
        """
        if self._running:
            raise RigError(DEVICE, "the region cannot change while grabbing; stop first")
        centre_region(self.nodes, width_px, height_px)
        self._shape = (height_px, width_px)

    def start(self) -> None:
        """Start grabbing; unread frames of an earlier run are discarded.

        Raises:
            RigError: already grabbing, the rate is too high, or the camera is disconnected.
        """
        from pypylon import pylon

        if self._running:
            raise RigError(DEVICE, "is already grabbing; stop first")
        settings = self.settings
        check_rate(self.nodes, settings)
        self._ends.clear()
        try:
            self.device.MaxNumBuffer.Value = self._buffers
            self.device.StartGrabbing(pylon.GrabStrategy_OneByOne)
        except self._genicam.GenericException as error:
            raise RigError(DEVICE, f"cannot start grabbing: {error}") from None
        wired = self.stamping.grade == "hardware trigger" and settings.sync_line is not None
        grab_settings = GrabSettings(
            stamping=self.stamping,
            mid_exposure_ns=self.mid_exposure_ns,
            first_id=1 if self.device.IsGigE() else 0,
            period_ns=0 if settings.trigger == "software" else round(1e9 / settings.rate_hz),
            late_ns=round(settings.late_s * 1e9),
            sync_bit=(settings.sync_line or 1) - 1 if wired else None,
            queue=self._buffers,
            first_ns=round(settings.first_frame_s * 1e9) if settings.trigger == "free run" else 0,
            stall_ns=0 if settings.trigger == "software" else round(settings.stall_s * 1e9),
        )
        self._grab, self._running = Grab(self.device, grab_settings, self._ends), True

    def trigger(self) -> None:
        """Trigger one frame, where the trigger is `software`.

        Raises:
            RigError: the camera is not ready for it within `TRIGGER_READY_MS`.
        """
        from pypylon import pylon

        try:
            if self.device.CanWaitForFrameTriggerReady():
                self.device.WaitForFrameTriggerReady(
                    TRIGGER_READY_MS, pylon.TimeoutHandling_ThrowException
                )
            self.device.ExecuteSoftwareTrigger()
        except self._genicam.GenericException as error:
            raise RigError(DEVICE, f"cannot be triggered: {error}") from None

    def read(self) -> FrameChunk:
        """Frames since the last call.

        Raises:
            RigError: the camera is disconnected or silent, and all earlier frames were read.
        """
        frames = self._grab.take() if self._grab is not None else []
        if not frames:
            if self._grab is not None and (fault := self._grab.fault) is not None:
                raise fault
            none = np.empty(0, np.int64)
            return FrameChunk(
                np.empty((0, *self._shape), np.uint8), none, none, none, np.empty(0, np.uint8)
            )
        return FrameChunk(
            # a single frame, the usual case in a fast loop, is passed on without a copy
            np.stack([frame.image for frame in frames])
            if len(frames) > 1
            else frames[0].image[np.newaxis],
            np.array([frame.number for frame in frames], np.int64),
            np.array([frame.t_ns for frame in frames], np.int64),
            np.array([frame.host_ns for frame in frames], np.int64),
            np.array([frame.sync for frame in frames], np.uint8),
        )

    def read_clock(self) -> ClockReads:
        """Latch the camera's clock and read it: one row.

        Raises:
            RigError: this camera has no clock that the host can read.
        """
        return latch_clock(self.nodes)

    def stop(self) -> None:
        """Stop grabbing; frames exposed before can still be read. Bounded by `STOP_S`."""
        if not self._running or self._grab is None:
            return
        self._running = False
        # exposures end first, so that all frames in pylon can be read
        with suppress(RigError):
            self.nodes.execute("AcquisitionStop")
        try:
            self._grab.stop()
        finally:
            with suppress(self._genicam.GenericException):
                self.device.StopGrabbing()

    def close(self) -> None:
        """Close the device; safe at any time and more than once."""
        if self._device is None:
            return
        with suppress(RigError):
            self.stop()
        if self._listener is not None:
            with suppress(self._genicam.GenericException):
                self._device.DeregisterCameraEventHandler(self._listener, _END_OF_EXPOSURE)
                self._listener = None
        with suppress(self._genicam.GenericException):
            self._device.Close()
        # A closed device keeps some 50 file descriptors until the last reference to it goes, and
        # an error's traceback may keep this object: a camera that is often reopened used them up.
        self._device = self._nodes = None
        if self._grab is not None:
            self._grab.forget_device()

    @property
    def device(self) -> Any:
        """pypylon's `InstantCamera`, for fakes and for interactive use.

        Raises:
            RigError: the camera was closed.
        """
        if self._device is None:
            raise RigError(DEVICE, "is closed; open it again")
        return self._device

    @property
    def nodes(self) -> Nodes:
        """The camera's features.

        Raises:
            RigError: the camera was closed, or is not open yet.
        """
        if self._nodes is None:
            raise RigError(DEVICE, "is closed; open it again")
        return self._nodes
