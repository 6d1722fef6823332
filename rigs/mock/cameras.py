"""Both simulated cameras: what they send when, on which clock, and what gets lost."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rigs.capabilities import RigError
from rigs.mock.clocks import Jitter
from rigs.mock.history import History
from rigs.mock.settings import MockSettings
from rigs.mock.sync import REPORT_NS, MockSyncBox, SyncInput
from rigs.mock.world import World
from rigs.scene.events import EventOptics, MarkerSensor
from rigs.scene.frames import FrameOptics, PlateView
from storage.streams import EventChunk, FrameChunk, PulseChunk

I64 = npt.NDArray[np.int64]
_NEVER = 1 << 62


class MockEventCamera:
    """The event camera inside the sensor.

    It sends whole blocks of the scene's steps (32 ms by default): that is its latency. After
    `stop`, what is left can still be read.
    """

    def __init__(self, world: World, box: MockSyncBox) -> None:
        self._world = world
        settings = world.settings.event_camera
        self.width, self.height = settings.width, settings.height
        self._sensor = MarkerSensor(
            EventOptics(**settings.model_dump()), world.skin.layout_mm, world.settings.seed
        )
        self._input = SyncInput(world, box, "event_camera")
        self._begin()
        world.on_begin.append(self._begin)

    def _begin(self) -> None:
        self._running = False
        self._until_ns = 0
        self._next_step = 0
        self._loads: History | None = None

    def start(self) -> None:
        """Begin to stream: every pixel takes the present image as its reference."""
        world = self._world
        loads = self._loads = world.keep_loads()
        self._next_step = loads.base
        self._sensor.reset(loads.rows(loads.base, loads.base + 1)[0], world.seed)
        self._begun_ns, self._until_ns, self._running = world.now_ns, _NEVER, True
        self._input.skip()

    def read(self) -> EventChunk:
        """Events since the last call, camera clock, whole microseconds."""
        world = self._world
        done = world.advance()
        loads = self._loads
        if loads is None:
            return _no_events()
        # steps that are complete and have not been sent, in whole blocks of the global grid
        last = min(done - 1, self._until_ns // world.step_ns)
        if self._running:
            last -= last % self._sensor.optics.block_steps
        if last <= self._next_step:
            return _no_events()
        rows = loads.rows(self._next_step, last + 1)
        t_ns, x, y, p = self._sensor.sense(rows, self._next_step, world.step_ns)
        self._next_step = last
        loads.forget(last)
        kept = t_ns >= self._begun_ns
        for begin, end in world.faults.gaps_ns(world.recording_ns):
            kept &= (t_ns < begin) | (t_ns >= end)
        if not kept.all():
            t_ns, x, y, p = t_ns[kept], x[kept], y[kept], p[kept]
        return EventChunk(x, y, p, world.clocks.event_camera.to_reference(t_ns) // 1000)

    def read_pulses(self) -> PulseChunk:
        """Sync pulses since the last call, camera clock in ns."""
        t_ns = self._input.edges_ns()
        if not self._running and self._until_ns == 0:
            return PulseChunk(np.empty(0, np.int64))
        kept = (t_ns >= self._begun_ns - REPORT_NS) & (t_ns <= self._until_ns)
        for begin, end in self._world.faults.gaps_ns(self._world.recording_ns):
            kept &= (t_ns < begin) | (t_ns >= end)
        stamp = self._world.clocks.event_camera.to_reference(t_ns[kept])
        return PulseChunk(stamp // 1000 * 1000)

    def stop(self) -> None:
        """Stop streaming; the rest, up to the last whole step, can still be read."""
        if self._running:
            self._world.advance()
            self._world.loads = None
            self._running, self._until_ns = False, self._world.now_ns

    def close(self) -> None:
        """Give the device back."""
        self.stop()


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


def _no_events() -> EventChunk:
    empty = np.empty(0, np.uint16)
    return EventChunk(empty, empty, np.empty(0, np.uint8), np.empty(0, np.int64))
