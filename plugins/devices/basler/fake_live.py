"""A fake Basler camera on pylon's emulation that shows a scene simulated in another process.

Every frame of the scene is one software trigger of the emulated camera, so it passes through
pylon's own buffers, threads and results; only the image, its number and its chunks, which the
emulation lacks, come from the scene. A frame that pylon loses is lost here too. Settings that the
scene's images do not simulate are refused, and so is a grab while one is active.

The emulation (pylon 12.4) has image sizes, formats, software triggers, free run, images from a
folder, failed buffers and exposure-end events, but no chunks, line triggers or readable clock.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from sliplab.plugins.devices.basler.driver import find_camera
from sliplab.rigs.core.driver import SceneFrames
from sliplab.storage.streams import U8, FrameChunk

EMULATED = "BaslerCamEmu"
"""pylon's device class of emulated cameras."""


def emulate(cameras: int = 1) -> None:
    """Make pylon list `cameras` emulated cameras in this process and its children.

    Raises:
        RuntimeError: pylon was loaded before, and does not enumerate again.
    """
    os.environ["PYLON_CAMEMU"] = str(cameras)
    from pypylon import pylon

    found = pylon.TlFactory.GetInstance().EnumerateDevices()
    there = sum(info.GetDeviceClass() == EMULATED for info in found)
    if there < cameras:
        raise RuntimeError(f"{there} emulated cameras instead of {cameras}: pylon loaded first")


class CameraFeature:
    """A setting and its simulated values.

    Args:
        name: GenICam name.
        factory: value in the factory user set; always simulated.
        choices: simulated values of an enumeration or a switch.
        limits: simulated range of a number; only `factory` if neither is given.
        stored: value stored in the camera, simulated or not.
        node: the emulation's node for this setting, which is written too; None if it has none.
    """

    def __init__(
        self,
        name: str,
        factory: Any,
        choices: tuple[Any, ...] = (),
        limits: tuple[float, float] | None = None,
        stored: Any = None,
        node: Any = None,
    ) -> None:
        self.name, self._factory, self._node = name, factory, node
        self._choices = choices or (() if limits else (factory,))
        self._limits = limits or (factory, factory)
        self._left = factory if stored is None else stored
        self._value = self._left

    @property
    def Symbolics(self) -> tuple[str, ...]:
        """Values of an enumeration."""
        return tuple(choice for choice in self._choices if isinstance(choice, str))

    @property
    def Min(self) -> Any:
        """Smallest simulated number."""
        return self._limits[0]

    @property
    def Max(self) -> Any:
        """Largest simulated number."""
        return self._limits[1]

    @property
    def Value(self) -> Any:
        """Active value."""
        return self._value

    @Value.setter
    def Value(self, value: Any) -> None:
        from pypylon import genicam

        if not self._simulates(value):
            raise genicam.InvalidArgumentException(self.refusal(value))
        if self._node is not None and self._node.GetAccessMode() == genicam.RW:
            self._node.Value = value
        self._value = value

    def GetAccessMode(self) -> int:
        """Return read-write access."""
        from pypylon import genicam

        mode: int = genicam.RW
        return mode

    @property
    def simulated(self) -> bool:
        """True if the images simulate the active value."""
        return self._simulates(self._value)

    def refusal(self, value: Any) -> str:
        """Return the reason why a value is refused."""
        low, high = self._limits
        those = " or ".join(map(str, self._choices)) if self._choices else f"{low} to {high}"
        return f"the fake simulates {self.name} {those}, not {value}"

    def load(self, stored: bool) -> None:
        """Load the value of the factory user set, or the stored one."""
        self._value = self._left if stored else self._factory

    def _simulates(self, value: Any) -> bool:
        if self._choices:
            return value in self._choices
        return bool(self._limits[0] <= value <= self._limits[1])


class Selected:
    """A switch for each choice of a selector, initially off."""

    def __init__(self, selector: CameraFeature) -> None:
        self._selector, self._on = selector, set[Any]()

    @property
    def Value(self) -> bool:
        """Switch of the current choice."""
        return self._selector.Value in self._on

    @Value.setter
    def Value(self, on: bool) -> None:
        (self._on.add if on else self._on.discard)(self._selector.Value)

    @property
    def on(self) -> frozenset[Any]:
        """Choices that are switched on."""
        return frozenset(self._on)

    def GetAccessMode(self) -> int:
        """Return read-write access."""
        return self._selector.GetAccessMode()


class CameraCommand:
    """A command that calls a function, and then the emulation's command if it has one."""

    def __init__(self, work: Callable[[], None], node: Any = None) -> None:
        self._work, self._node = work, node

    def Execute(self) -> None:
        """Execute the command."""
        self._work()
        if self._node is not None:
            self._node.Execute()

    def IsDone(self) -> bool:
        """Return whether the command has ended."""
        return True

    def GetAccessMode(self) -> int:
        """Return write-only access."""
        from pypylon import genicam

        mode: int = genicam.WO
        return mode


class ReadOnly:
    """A value that the camera computes."""

    def __init__(self, read: Callable[[], float]) -> None:
        self._read = read

    @property
    def Value(self) -> float:
        """Current value."""
        return self._read()

    def GetAccessMode(self) -> int:
        """Return read-only access."""
        from pypylon import genicam

        mode: int = genicam.RO
        return mode


class NodeMap:
    """Node map of an emulated camera with some nodes replaced."""

    def __init__(self, node_map: Any, own: Mapping[str, Any]) -> None:
        self._map, self._own = node_map, own

    def GetNode(self, name: str) -> Any:
        """Return a node by its name; None if there is none."""
        own = self._own.get(name)
        return own if own is not None else self._map.GetNode(name)


TRIES = 3
MISSED_S = 0.2
"""Timeout after which a trigger without an image counts as missed, s."""
POLL_S = 0.001
POLL_MS = 100
READY_S = 2.0
"""Timeout for the emulated camera to be ready for the next trigger, s."""
EXPOSURE_US = 100.0
"""Exposure of the emulated camera; the scene's exposure is in its images."""
FEED_S = 5.0
"""Timeout for the feeding thread to end, s."""
MOST_HZ = 160.0
"""Maximum frame rate of the sensor."""
LINES = (1, 2, 3)
"""Numbers of the inputs: one has the sync line; any other may have the ticks."""


_Frame = tuple[U8, int, int, int]
"""Image, number, middle of the exposure in ns, and level of the sync line."""


class LiveBasler:
    """A pypylon `InstantCamera` whose images come from a scene.

    Everything else is delegated to the emulated camera.

    Args:
        scene: source of frames while the camera grabs.
        mid_exposure_ns: time from a frame's start to its middle; the scene's times are middles.
        sync_line: number of the input with the sync line.
        stored: settings by name in the camera's user set `UserSet1`.

    Attributes:
        fed: number of frames that pylon accepted since the grab began.
    """

    def __init__(
        self,
        scene: SceneFrames,
        mid_exposure_ns: int,
        sync_line: int,
        stored: Mapping[str, Any] | None = None,
    ) -> None:
        emulate(1)
        # never a real camera on this computer
        self._device = find_camera(None, EMULATED)
        self._scene, self._mid_exposure_ns, self._bit = scene, mid_exposure_ns, sync_line - 1
        self._coming: deque[_Frame | None] = deque()
        self._came = threading.Condition()
        self._fed: deque[tuple[int, _Frame]] = deque()
        self._triggers = self._retrieved = 0
        self._feeder: threading.Thread | None = None
        self._drop, self._gone = 0, False
        self.fed = 0
        self._stored = dict(stored or {})
        self._nodes: dict[str, Any] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._device, name)

    # -- faults ----------------------------------------------------------------------------

    def drop_frames(self, count: int) -> None:
        """Lose the next `count` results."""
        self._drop += count

    def unplug(self) -> None:
        """Simulate an unplugged cable."""
        self._gone = True

    # -- as pylon's ------------------------------------------------------------------------

    def GetNodeMap(self) -> Any:
        """Return the emulated camera's nodes, with those that it lacks or ignores replaced."""
        emulated = self._device.GetNodeMap()
        if not self._nodes:
            self._nodes = self._own_nodes(emulated)
        return NodeMap(emulated, self._nodes)

    def _own_nodes(self, emulated: Any) -> dict[str, Any]:
        """Return the replaced nodes by name; the camera must be open."""
        exposure_us = self._mid_exposure_ns / 500
        ticks = tuple(f"Line{number}" for number in LINES if number - 1 != self._bit)
        plain: dict[str, tuple[Any, tuple[Any, ...]]] = {
            "PixelFormat": ("Mono8", ()),
            "ReverseX": (False, ()),
            "ReverseY": (False, ()),
            "BinningHorizontal": (1, ()),
            "BinningVertical": (1, ()),
            "Gain": (0.0, ()),
            "GainAuto": ("Off", ()),
            "BlackLevel": (0.0, ()),
            "Gamma": (1.0, ()),
            "DigitalShift": (0, ()),
            "ExposureAuto": ("Off", ()),
            "ExposureMode": ("Timed", ()),
            "AcquisitionMode": ("Continuous", ()),
            "AcquisitionFrameRateEnable": (False, ()),
            "TriggerActivation": ("RisingEdge", ()),
            "LineInverter": (False, ()),
            "LUTEnable": (False, ()),
            "TestPattern": ("Off", ()),
            "BslInputFilterTime": (0.0, ()),
            "ChunkModeActive": (False, (False, True)),
            "ChunkSelector": ("Timestamp", ("Timestamp", "LineStatusAll")),
            "UserSetSelector": ("Default", ("Default", "UserSet1")),
            # the emulated exposure stays short, so that no trigger comes too early
            "ExposureTime": (exposure_us, ()),
            "ExposureTimeAbs": (exposure_us, ()),
            "TriggerSource": (ticks[0], ticks),
        }
        held = {"ChunkModeActive", "UserSetSelector", "ExposureTime", "ExposureTimeAbs"}
        held |= {"TriggerSource"}
        if unknown := set(self._stored) - set(plain):
            raise ValueError(f"the fake has no {', '.join(sorted(unknown))} to store")
        own: dict[str, Any] = {
            name: CameraFeature(
                name,
                factory,
                choices,
                stored=self._stored.get(name),
                node=None if name in held else emulated.GetNode(name),
            )
            for name, (factory, choices) in plain.items()
        }
        own["ChunkEnable"] = Selected(own["ChunkSelector"])
        own["UserSetLoad"] = CameraCommand(self._load_user_set)
        # frames exposed by then must still reach pylon
        own["AcquisitionStop"] = CameraCommand(
            self._end_frames, emulated.GetNode("AcquisitionStop")
        )
        own["BslResultingAcquisitionFrameRate"] = ReadOnly(lambda: min(MOST_HZ, 1e6 / exposure_us))
        return own

    def _load_user_set(self) -> None:
        chosen = self._nodes["UserSetSelector"].Value
        for name, node in self._nodes.items():
            if isinstance(node, CameraFeature) and name != "UserSetSelector":
                node.load(stored=chosen != "Default")

    def _chunks(self) -> frozenset[str]:
        """Return the chunks sent with every frame."""
        active = self._nodes and self._nodes["ChunkModeActive"].Value
        return self._nodes["ChunkEnable"].on if active else frozenset()

    def IsCameraDeviceRemoved(self) -> bool:
        """Return whether the camera was unplugged."""
        return self._gone or bool(self._device.IsCameraDeviceRemoved())

    def StartGrabbing(self, strategy: Any) -> None:
        """Start grabbing: the scene sends frames of the configured region.

        Raises:
            genicam.GenericException: a setting is active that the scene does not simulate.
        """
        from pypylon import genicam

        nodes = self._device.GetNodeMap()
        for own in self._nodes.values():
            if isinstance(own, CameraFeature) and not own.simulated:
                raise genicam.InvalidArgumentException(own.refusal(own.Value))
        for choice in nodes.GetNode("TriggerSelector").Symbolics:
            nodes.GetNode("TriggerSelector").Value = choice
            mode = nodes.GetNode("TriggerMode").Value
            if mode != ("On" if choice == "FrameStart" else "Off"):
                raise genicam.InvalidArgumentException(
                    f"the fake simulates only a trigger of FrameStart, not {choice} {mode}"
                )
        nodes.GetNode("TriggerSelector").Value = "FrameStart"
        nodes.GetNode("TriggerSource").Value = "Software"
        nodes.GetNode("ExposureTimeAbs").Value = EXPOSURE_US
        self._coming.clear()
        self._fed.clear()
        self._triggers = self._retrieved = self.fed = 0
        self._device.StartGrabbing(strategy)
        self._feeder = threading.Thread(target=self._feed, name="scene's frames", daemon=True)
        self._feeder.start()
        width_px, height_px = (nodes.GetNode(side).Value for side in ("Width", "Height"))
        self._scene.grab(width_px, height_px, self._take)

    def StopGrabbing(self) -> None:
        """Stop grabbing; earlier frames have reached pylon."""
        try:
            self._end_frames()
        finally:
            self._device.StopGrabbing()

    def RetrieveResult(self, timeout_ms: int, handling: Any) -> Any:
        """Return pylon's next result with the scene's image in it."""
        result = self._device.RetrieveResult(timeout_ms, handling)
        if result is None or not result.IsValid():
            return result
        with self._came:
            # a trigger that pylon's camera missed has no result
            while self._fed[0][0] < result.BlockID:
                self._fed.popleft()
            frame = self._fed.popleft()[1]
            self._retrieved += 1
            self._came.notify()
        if self._drop:
            from pypylon import pylon

            self._drop -= 1
            result.Release()
            return pylon.GrabResult()
        return _Result(result, *frame, self._mid_exposure_ns, self._bit, self._chunks())

    # --------------------------------------------------------------------------------------

    def _end_frames(self) -> None:
        """Stop the scene's frames, and wait until pylon has all of them, at most `FEED_S`."""
        feeder, self._feeder = self._feeder, None
        if feeder is None:
            return
        try:
            self._scene.stop_grabbing()
            feeder.join(FEED_S)
        finally:
            with self._came:  # a scene that has died sends no end
                self._coming.append(None)
                self._came.notify()

    def _take(self, frames: FrameChunk) -> None:
        """Queue frames; called in the thread that receives them from the scene."""
        rows = zip(
            frames.images,
            frames.number.tolist(),
            frames.t_ns.tolist(),
            frames.sync.tolist(),
            strict=True,
        )
        with self._came:
            self._coming.extend(rows if len(frames.number) else (None,))
            self._came.notify()

    def _feed(self) -> None:
        from pypylon import genicam

        while True:
            with self._came:
                if not self._came.wait_for(lambda: self._coming, READY_S):
                    continue
                frame = self._coming.popleft()
            if frame is None:
                return
            try:
                self._give(frame)
            except genicam.GenericException:
                return  # no longer grabbing: later frames are lost, and their numbers missing

    def _give(self, frame: _Frame) -> None:
        """Trigger once per frame, with retries, since the emulation misses some triggers."""
        for _ in range(TRIES):
            if self._gone or not self._ready():
                return
            with self._came:
                self._fed.append((self._triggers, frame))
                self._triggers += 1
            self._device.ExecuteSoftwareTrigger()
            end = time.monotonic() + MISSED_S
            while time.monotonic() < end:
                with self._came:
                    if self._retrieved + self._device.NumReadyBuffers.Value > self.fed:
                        self.fed += 1
                        return
                    self._came.wait(POLL_S)

    def _ready(self) -> bool:
        """Wait until the camera is ready for a trigger; return whether it is."""
        from pypylon import pylon

        end = time.monotonic() + READY_S
        while time.monotonic() < end:
            # right after the start it returns False without waiting
            if self._device.WaitForFrameTriggerReady(POLL_MS, pylon.TimeoutHandling_Return):
                return True
        return False


class _Value:
    """A node with the value of a chunk."""

    def __init__(self, value: int) -> None:
        self.Value = value


class _Result:
    """A pylon result with another image and with chunks."""

    def __init__(
        self,
        result: Any,
        image: U8,
        number: int,
        t_ns: int,
        sync: int,
        mid_exposure_ns: int,
        bit: int,
        chunks: frozenset[str],
    ) -> None:
        self._result = result
        self.Array, self.BlockID, self.ImageNumber = image, number, number + 1
        self.NumberOfSkippedImages = 0  # the frame numbers show losses
        self.TimeStamp = t_ns - mid_exposure_ns
        if "Timestamp" in chunks:
            self.ChunkTimestamp = _Value(self.TimeStamp)
        if "LineStatusAll" in chunks:
            self.ChunkLineStatusAll = _Value(sync << bit)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._result, name)
