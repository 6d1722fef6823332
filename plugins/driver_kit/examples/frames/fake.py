"""A fake of the example frame camera, that shows the frames of a scene."""

from __future__ import annotations

import asyncio

from sliplab.plugins.driver_kit.examples.frames import ExampleFramesSettings
from sliplab.plugins.driver_kit.examples.frames.driver import (
    HEAD,
    IMAGE,
    REGION,
    START,
    ExampleFrames,
)
from sliplab.rigs.core.driver import SceneFrames
from sliplab.rigs.core.fakes import FakeStream
from sliplab.storage.streams import FrameChunk


class FakeExampleFrames(FakeStream):
    """A camera on the wire; its frames are a scene's."""

    def __init__(self, scene: SceneFrames, mid_exposure_ns: int) -> None:
        self._scene, self._mid_exposure_ns = scene, mid_exposure_ns
        super().__init__("fake frame camera")

    def _show(self, frames: FrameChunk) -> None:
        for image, number, t_ns, sync in zip(
            frames.images, frames.number, frames.t_ns, frames.sync, strict=True
        ):
            begin_ns = int(t_ns) - self._mid_exposure_ns
            self.write(HEAD.pack(IMAGE, number, begin_ns, *image.shape, sync) + image.tobytes())

    async def _serve(self, reader: asyncio.StreamReader) -> None:
        while True:
            kind, width, height = REGION.unpack(await reader.readexactly(REGION.size))
            if kind == START:
                self._write(HEAD.pack(START, 0, 0, 0, 0, 0))
                self._scene.grab(width, height, self._show)
            else:
                self._scene.stop_grabbing()


class FakedExampleFrames(ExampleFrames):
    """The driver with its own fake, which ends with it."""

    def __init__(
        self,
        settings: ExampleFramesSettings,
        px_per_mm: float,
        scene: SceneFrames,
        mid_exposure_ns: int,
    ) -> None:
        self.fake = FakeExampleFrames(scene, mid_exposure_ns)
        host, port = self.fake.address
        super().__init__(settings.model_copy(update={"host": host, "port": port}), px_per_mm)

    def close(self) -> None:
        """Close the camera and its fake."""
        super().close()
        self.fake.close()
