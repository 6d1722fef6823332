"""A Basler camera without a camera: pylon's own emulation, with pictures and losses on request.

The real driver talks to the real pylon; only the camera is emulated (pylon 12.4). It has sizes,
formats, software triggers, free run, pictures from a folder, failed buffers and exposure-end
events. It has no chunks, line triggers or clock that can be read, and under load it slows down
where a camera would lose frames: `LossyDevice` loses them instead.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sliplab.rigs.scene.frames import FrameOptics, PlateView
from sliplab.storage.streams import U8

VARIABLE = "PYLON_CAMEMU"
EMULATED = "BaslerCamEmu"
"""pylon's class of devices that are not there."""


def emulate(cameras: int = 1) -> None:
    """List `cameras` emulated cameras from now on in this process and in those that it starts.

    Raises:
        RuntimeError: pylon was loaded before and does not look again.
    """
    os.environ[VARIABLE] = str(cameras)
    from pypylon import pylon

    found = pylon.TlFactory.GetInstance().EnumerateDevices()
    there = sum(info.GetDeviceClass() == EMULATED for info in found)
    if there < cameras:
        raise RuntimeError(f"{there} emulated cameras instead of {cameras}: pylon began before")


def scene_frames(count: int, width: int, height: int, seed: int = 1) -> U8:
    """Pictures of seven markers that slide over the plate, (count, height, width), grey.

    The slide is 0.1 mm a picture to and fro, with the camera's noise.
    """
    ring = 5.6 * np.exp(2j * np.pi * np.arange(6) / 6)
    layout = np.concatenate(([0j], ring))
    way = 0.1 * (np.abs(np.arange(count) % 40 - 20) - 10)
    tips = np.stack((layout.real[None] + way[:, None], np.tile(layout.imag, (count, 1))), axis=-1)
    images = np.empty((count, height, width), np.uint8)
    view = PlateView(FrameOptics(tip_radius_mm=1.0), width, height)
    view.draw(images, tips, None, np.arange(count, dtype=np.int64), seed)
    return images


def write_frames(folder: Path, images: U8) -> None:
    """Pictures as files that the emulation reads in order; bitmaps, for it decodes each anew."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, image in enumerate(images):
        path = folder / f"{number:06d}.bmp"
        if not cv2.imwrite(str(path), image):
            raise OSError(f"{path} cannot be written")


def show(device: Any, folder: Path) -> None:
    """Feed an open emulated camera, which does not grab, with the pictures in `folder`."""
    device.GetNodeMap().GetNode("TestImageSelector").Value = "Off"
    device.GetNodeMap().GetNode("ImageFilename").Value = str(folder)
    device.GetNodeMap().GetNode("ImageFileMode").Value = "On"


def fail_buffers(device: Any, count: int) -> None:
    """Let the next `count` buffers of an emulated camera come incomplete."""
    nodes = device.GetNodeMap()
    nodes.GetNode("ForceFailedBufferCount").Value = count
    nodes.GetNode("ForceFailedBuffer").Execute()


def unplug(device: Any) -> None:
    """Let pylon believe that the cable was pulled."""
    device.GetNodeMap().GetNode("FirePnPCallback").Execute()


class LossyDevice:
    """A camera of pypylon between which and its driver results get lost on request.

    Everything but `RetrieveResult` is the device's own.
    """

    def __init__(self, device: Any) -> None:
        self._device, self._drop, self._mute = device, 0, False
        self.dropped = 0
        """Results lost on request so far, those of a silent camera too."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._device, name)

    def drop_frames(self, count: int) -> None:
        """Lose the next `count` results."""
        self._drop += count

    def fall_silent(self) -> None:
        """Lose every result from now on."""
        self._mute = True

    def RetrieveResult(self, timeout_ms: int, handling: Any) -> Any:
        """The next result, or an empty one in place of one that gets lost."""
        from pypylon import pylon

        result = self._device.RetrieveResult(timeout_ms, handling)
        if not result.IsValid() or not (self._drop or self._mute):
            return result
        self._drop = max(self._drop - 1, 0)
        self.dropped += 1
        result.Release()
        return pylon.GrabResult()
