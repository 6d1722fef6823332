"""pylon's own camera emulation with images and losses on request.

The real driver runs on the real pylon; only the camera is emulated (pylon 12.4). Under load the
emulation slows down where a camera would lose frames: `LossyDevice` loses frames instead.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sliplab.plugins.simulation.scene.frames import FrameOptics, PlateView
from sliplab.storage.streams import U8


def scene_frames(count: int, width: int, height: int, seed: int = 1) -> U8:
    """Render images of seven markers that slide over the plate, (count, height, width), grey.

    The markers slide back and forth by 0.1 mm per image, with camera noise.
    """
    ring = 5.6 * np.exp(2j * np.pi * np.arange(6) / 6)
    layout = np.concatenate(([0j], ring))
    slide = 0.1 * (np.abs(np.arange(count) % 40 - 20) - 10)
    tips = np.stack((layout.real[None] + slide[:, None], np.tile(layout.imag, (count, 1))), axis=-1)
    images = np.empty((count, height, width), np.uint8)
    view = PlateView(FrameOptics(tip_radius_mm=1.0), width, height)
    view.draw(images, tips, None, np.arange(count, dtype=np.int64), seed)
    return images


def write_frames(folder: Path, images: U8) -> None:
    """Write images as files for the emulation; as bitmaps, which decode fast."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, image in enumerate(images):
        path = folder / f"{number:06d}.bmp"
        if not cv2.imwrite(str(path), image):
            raise OSError(f"{path} cannot be written")


def show(device: Any, folder: Path) -> None:
    """Make an open emulated camera, which is not grabbing, deliver the images in `folder`."""
    device.GetNodeMap().GetNode("TestImageSelector").Value = "Off"
    device.GetNodeMap().GetNode("ImageFilename").Value = str(folder)
    device.GetNodeMap().GetNode("ImageFileMode").Value = "On"


def fail_buffers(device: Any, count: int) -> None:
    """Make the next `count` buffers of an emulated camera incomplete."""
    nodes = device.GetNodeMap()
    nodes.GetNode("ForceFailedBufferCount").Value = count
    nodes.GetNode("ForceFailedBuffer").Execute()


def unplug(device: Any) -> None:
    """Simulate an unplugged cable."""
    device.GetNodeMap().GetNode("FirePnPCallback").Execute()


class LossyDevice:
    """A wrapper of a pypylon camera that loses results on request.

    Everything except `RetrieveResult` is delegated to the device.
    """

    def __init__(self, device: Any) -> None:
        self._device, self._drop, self._mute = device, 0, False
        self.dropped = 0
        """Number of results lost on request, including those of a silent camera."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._device, name)

    def drop_frames(self, count: int) -> None:
        """Lose the next `count` results."""
        self._drop += count

    def fall_silent(self) -> None:
        """Lose every result from now on."""
        self._mute = True

    def RetrieveResult(self, timeout_ms: int, handling: Any) -> Any:
        """Return the next result, or an empty one in place of a lost one."""
        from pypylon import pylon

        result = self._device.RetrieveResult(timeout_ms, handling)
        if not result.IsValid() or not (self._drop or self._mute):
            return result
        self._drop = max(self._drop - 1, 0)
        self.dropped += 1
        result.Release()
        return pylon.GrabResult()
