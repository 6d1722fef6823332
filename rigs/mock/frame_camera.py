"""The simulated frame camera: pictures on every tick, on its own clock, and what gets lost."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rigs.capabilities import RigError
from rigs.mock.clocks import Jitter
from rigs.mock.settings import MockSettings
from rigs.mock.sync import MockSyncBox
from rigs.mock.world import World
from rigs.scene.frames import FrameOptics, PlateView
from storage.streams import FrameChunk

I64 = npt.NDArray[np.int64]
_NEVER = 1 << 62


class MockFrameCamera:
    """The camera that looks through the plate, triggered by every tick of the sync box."""

    def __init__(self, world: World, box: MockSyncBox) -> None:
        self._world, self._box = world, box
        settings = world.settings.frame_camera
        self.px_per_mm, self.rate_hz = settings.px_per_mm, settings.rate_hz
        self.mid_exposure_ns = settings.exposure_us * 500
        """From a tick to the middle of its exposure."""
        self._size = (settings.width, settings.height)
        self._view: PlateView | None = None
        self._begin()
        world.on_begin.append(self._begin)

    def _begin(self) -> None:
        self._running, self._until_ns = False, 0
        self._run, self._next_tick, self._number = self._box.run, 0, 0
        self._jitter = Jitter(
            self._world.seed, "frame stamps", self._world.settings.clocks.frame_jitter_us
        )

    def set_region(self, width_px: int, height_px: int) -> None:
        """Read out a centred region only.

        Raises:
            RigError: while grabbing, or a region that does not fit the sensor.
        """
        settings = self._world.settings.frame_camera
        if self._running:
            raise RigError("frame camera", "the region cannot change while it grabs; stop first")
        if not (1 <= width_px <= settings.width and 1 <= height_px <= settings.height):
            raise RigError(
                "frame camera",
                f"region {width_px} x {height_px} px: must lie within "
                f"{settings.width} x {settings.height}",
            )
        if self._size != (width_px, height_px):
            self._size, self._view = (width_px, height_px), None

    def start(self) -> None:
        """Begin to grab on the sync box's ticks."""
        self._run, self._number = self._box.run, 0
        self._next_tick = self._box.tick_at(self._world.now_ns)
        self._running, self._until_ns = True, _NEVER

    def read(self) -> FrameChunk:
        """Frames since the last call whose read-out is over."""
        world, box, settings = self._world, self._box, self._world.settings.frame_camera
        world.advance()
        if box.run != self._run:
            self._run, self._next_tick = box.run, 0
        after_ns = 2 * self.mid_exposure_ns + settings.latency_us * 1000
        seen_ns = world.now_ns - max(after_ns, self.mid_exposure_ns + world.step_ns)
        ticks = box.ticks(self._next_tick, min(seen_ns, self._until_ns))
        if self._until_ns == 0:
            ticks = ticks[:0]
        number = self._number + np.arange(len(ticks), dtype=np.int64)
        self._next_tick += len(ticks)
        self._number += len(ticks)
        kept = ~np.isin(ticks, self._lost())
        ticks, number = ticks[kept], number[kept]
        mid = box.true_ns(ticks) + self.mid_exposure_ns if len(ticks) else ticks
        width, height = self._size
        images = np.empty((len(ticks), height, width), np.uint8)
        if len(ticks):
            if self._view is None:
                self._view = PlateView(_optics(world.settings), width, height)
            tips, plate_mm = world.tips_at(mid)
            marked = plate_mm if world.plate_marked else None
            self._view.draw(images, tips, marked, number, world.seed)
        stamp = world.clocks.frame_camera.to_reference(mid + self._jitter.ns(ticks))
        host = mid + (after_ns - self.mid_exposure_ns)
        sync = box.bits(ticks) if len(ticks) else np.empty(0, np.uint8)
        return FrameChunk(images, number, stamp, host, sync)

    def stop(self) -> None:
        """Stop grabbing; frames exposed before can still be read."""
        if self._running:
            self._running, self._until_ns = False, self._world.now_ns

    def close(self) -> None:
        """Give the device back."""
        self.stop()

    def _lost(self) -> I64:
        lost: list[int] = []
        for fault in self._world.faults.of("frames_lost"):
            due = self._world.faults.due_ns(fault, self._world.recording_ns)
            if due is not None:
                first = self._box.tick_at(due)
                lost += range(first, first + fault.count)
        return np.array(lost, np.int64)


def _optics(settings: MockSettings) -> FrameOptics:
    camera, plate = settings.frame_camera, settings.scene.plate
    return FrameOptics(
        px_per_mm=camera.px_per_mm,
        tip_radius_mm=settings.frame_camera.tip_radius_mm,
        tip_level=camera.tip_level,
        ground_level=camera.ground_level,
        noise=camera.noise,
        marker_id=plate.marker_id,
        marker_side_mm=plate.marker_side_mm,
        marker_centre_mm=plate.marker_centre_mm,
    )
