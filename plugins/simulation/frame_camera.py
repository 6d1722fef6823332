"""The simulated frame camera: images or tracks on every tick, on its own clock, and losses.

Ticks are the sync box's, or the camera's own in free run.

At the level `tracks` no image is rendered: every frame has the marker positions that tracking its
image would give, with the measured tracking noise. Times, numbers and sync bits are the same.
"""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.clocks import Jitter, Lateness
from sliplab.plugins.simulation.fault_book import NEVER
from sliplab.plugins.simulation.identity import Identity
from sliplab.plugins.simulation.scene.frames import (
    ExposurePath,
    Exposures,
    FrameOptics,
    PlateView,
    expose,
)
from sliplab.plugins.simulation.scene.lens import BoardCamera, BoardPlace, BoardPrint, draw_board
from sliplab.plugins.simulation.scene.randomness import generator
from sliplab.plugins.simulation.settings import MockFrameCameraSettings, MockSettings
from sliplab.plugins.simulation.sync import ClockReader, FreeRun, Ticks
from sliplab.plugins.simulation.world import SimulatedWorld
from sliplab.protocols.timing import FrameGrade
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.faults import DeviceGone, FrameLate, FramesLost, MarkerOccluded
from sliplab.storage.kernels import njit
from sliplab.storage.streams import ClockReads, FrameChunk

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
U8 = npt.NDArray[np.uint8]
_NOISE_FRAMES = 256
"""Number of frames whose centroid noise is drawn at once."""


class MockFrameCamera:
    """The camera that sees the skin through the plate.

    Args:
        trigger: source of its exposures, the sync box or the camera itself.
        grade: grade of its time stamps; only `host arrival` changes them.
        own: of a further camera; the rig's first one by default.

    Attributes:
        clock: true time to the camera's, in the running trial.
        timed_by_host: its frames carry no time but that of their arrival.
    """

    def __init__(
        self,
        world: SimulatedWorld,
        trigger: Ticks,
        grade: FrameGrade = "hardware trigger",
        own: Identity[MockFrameCameraSettings] | None = None,
    ) -> None:
        self._world, self._trigger = world, trigger
        self._own = own or Identity("frame_camera", world.settings.frame_camera)
        self._faults = FrameFaults(world, trigger, first=self._own.first)
        self.timed_by_host = grade == "host arrival"
        self._clock_reader = ClockReader(world, self._own.name)
        settings = self._settings = self._own.settings
        self.px_per_mm, self.rate_hz = settings.px_per_mm, settings.rate_hz
        self.mid_exposure_ns = settings.exposure_us * 500
        """Time from the start of an exposure, which is its tick, to its middle."""
        self._size = (settings.width, settings.height)
        self._view: PlateView | None = None
        self._shown: tuple[tuple[BoardPlace, tuple[int, int]], U8] | None = None
        self._begin()
        world.at_begin(self._begin)

    def _begin(self) -> None:
        self._running, self._until_ns = False, 0
        self._run, self._next_tick, self._number = self._trigger.run, 0, 0
        self.clock = self._own.clock(self._world)
        self._seed = self._own.trial_seed(self._world)
        self._jitter = Jitter(
            self._seed, "frame stamps", self._world.settings.clocks.frame_jitter_us
        )
        late_us = self._settings.arrival_jitter_us if self.timed_by_host else 0.0
        self._late = Lateness(self._seed, "frame arrivals", late_us)
        self._arrived_ns = 0
        self._noise: tuple[int, F64] | None = None

    def set_region(self, width_px: int, height_px: int) -> None:
        """Read out only a centred region.

        Raises:
            RigError: the camera is grabbing, or the region exceeds the sensor.
        """
        settings = self._settings
        if self._running:
            raise RigError("frame camera", "the region cannot change while grabbing; stop first")
        if not (1 <= width_px <= settings.width and 1 <= height_px <= settings.height):
            raise RigError(
                "frame camera",
                f"region {width_px} x {height_px} px: must lie within "
                f"{settings.width} x {settings.height}",
            )
        if self._size != (width_px, height_px):
            self._size, self._view = (width_px, height_px), None

    def start(self) -> None:
        """Start grabbing, on the sync box's ticks or its own."""
        if isinstance(self._trigger, FreeRun):
            self._trigger.start()
        self._run, self._number = self._trigger.run, 0
        self._next_tick = self._trigger.tick_at(self._world.now_ns)
        self._running, self._until_ns = True, NEVER

    def read(self) -> FrameChunk:
        """Return the frames since the last call whose read-out is complete."""
        world, trigger, settings = self._world, self._trigger, self._settings
        world.advance()
        if trigger.run != self._run:
            self._run, self._next_tick = trigger.run, 0
        exposed_ns = 2 * self.mid_exposure_ns
        after_ns = exposed_ns + settings.latency_us * 1000
        seen_ns = world.now_ns - max(after_ns, exposed_ns + world.step_ns)
        ticks = trigger.ticks(self._next_tick, min(seen_ns, self._until_ns))
        if self._until_ns == 0:
            ticks = ticks[:0]
        true = trigger.true_ns(ticks) if len(ticks) else ticks
        host = self._faults.arrival_ns(ticks, true + after_ns) + self._late.ns(ticks)
        # in order: a late frame delays the next one
        host = np.maximum(np.maximum.accumulate(host), self._arrived_ns)
        host = host[host <= world.now_ns]
        ticks = ticks[: len(host)]
        number = self._number + np.arange(len(ticks), dtype=np.int64)
        self._next_tick += len(ticks)
        self._number += len(ticks)
        self._arrived_ns = max(self._arrived_ns, int(host.max(initial=0)))
        # who reads later than the scene is remembered has lost these frames
        begin_ns = world.physics.track.begin_ns
        retained = ~self._faults.lost(ticks) & (true[: len(ticks)] >= begin_ns)
        mid = true[: len(ticks)][retained] + self.mid_exposure_ns
        ticks, number, host = ticks[retained], number[retained], host[retained]
        stamp = host
        if not self.timed_by_host:
            stamp = self.clock.to_reference(mid + self._jitter.ns(ticks))
        sync = trigger.bits(ticks) if len(ticks) else np.empty(0, np.uint8)
        if self._view is None:
            self._view = PlateView(_optics(world.settings, settings), *self._size)
        seen = expose(world.tips_at, mid, exposed_ns, self.px_per_mm)
        seen = self._faults.hide(mid, seen)
        if settings.level == "tracks":
            empty = np.empty((len(ticks), 0, 0), np.uint8)
            return FrameChunk(
                empty, number, stamp, host, sync, *self._tracks(self._view, seen, number)
            )
        width, height = self._size
        images = np.empty((len(ticks), height, width), np.uint8)
        if world.board is not None:
            images[:] = self._board(world.board)
            return FrameChunk(images, number, stamp, host, sync)
        marked = seen.plate_mm if world.plate_marked else None
        self._view.draw(images, seen.tips_mm, marked, number, self._seed, seen.paths)
        return FrameChunk(images, number, stamp, host, sync)

    def read_clock(self) -> ClockReads:
        """Read the camera's clock: one row."""
        return self._clock_reader.read(self.clock)

    def stop(self) -> None:
        """Stop grabbing; frames exposed before can still be read."""
        if isinstance(self._trigger, FreeRun):
            self._trigger.stop()
        if self._running:
            self._running, self._until_ns = False, self._world.now_ns

    def close(self) -> None:
        """Close the device."""
        self.stop()

    def _tracks(self, view: PlateView, seen: Exposures, number: I64) -> tuple[F32, F32 | None]:
        """Return the result of tracking the images of `seen`: markers and the plate."""
        settings = self._settings
        noise = self._centroid_noise(number)
        markers = view.centre_px(seen.tips_mm)
        # like the tracker: a marker cut off by the image's edge is not measured
        _blank_cut(markers, view.radius_px(seen.tips_mm) + 1.0, *self._size)
        markers += settings.centroid_noise_px * noise[:, 1:]
        if not self._world.plate_marked:
            return markers.astype(np.float32), None
        plate = view.marker.centre_px(seen.plate_mm)
        whole = np.full((len(plate), 1), 0.5 * view.marker.size_px)
        _blank_cut(plate[:, None], whole, *self._size)
        plate += settings.plate_noise_px * noise[:, 0]
        return markers.astype(np.float32), plate.astype(np.float32)

    def _board(self, place: BoardPlace) -> U8:
        """Return the image of the board in front of the camera, which hides the scene."""
        if self._shown is None or self._shown[0] != (place, self._size):
            optics = self._settings
            camera = BoardCamera(
                optics.px_per_mm, *self._size, optics.tilt_deg, (optics.k1,), optics.distance_mm
            )
            levels = optics.ground_level, optics.tip_level
            picture = draw_board(camera, place, BoardPrint(), dark=levels[0], bright=levels[1])
            draw = generator(self._own.fabrication_seed(self._world), "board noise")
            noisy = picture + optics.noise * draw.standard_normal(picture.shape)
            self._shown = (place, self._size), np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
        return self._shown[1]

    def _centroid_noise(self, number: I64) -> F64:
        """Unit noise of the plate's marker and every papilla, (k, 1 + m, 2), by frame number."""
        things = 1 + len(self._world.skin)
        result = np.empty((len(number), things, 2))
        blocks, inside = np.divmod(number, _NOISE_FRAMES)
        # numbers increase, so those of one block are contiguous
        edges = [0, *(np.flatnonzero(np.diff(blocks)) + 1).tolist(), len(number)]
        for first, last in itertools.pairwise(edges if len(number) else ()):
            block = int(blocks[first])
            if self._noise is None or self._noise[0] != block:
                draw = generator(self._seed, "centroid noise", block)
                self._noise = block, draw.standard_normal((_NOISE_FRAMES, things, 2))
            result[first:last] = self._noise[1][inside[first:last]]
        return result


@njit(cache=True, nogil=True)
def _blank_cut(place_px: F64, reach_px: F64, width: int, height: int) -> None:
    """NaN where a square about a place, (k, m, 2), leaves the picture; half sides (k, m)."""
    for k in range(place_px.shape[0]):
        for i in range(place_px.shape[1]):
            (x, y), reach = place_px[k, i], reach_px[k, i]
            inside = x >= reach and y >= reach
            if not (inside and x <= width - 1 - reach and y <= height - 1 - reach):
                place_px[k, i] = np.nan


def _optics(settings: MockSettings, camera: MockFrameCameraSettings) -> FrameOptics:
    plate = settings.scene.plate
    return FrameOptics(
        px_per_mm=camera.px_per_mm,
        tip_radius_mm=camera.tip_radius_mm,
        tip_level=camera.tip_level,
        ground_level=camera.ground_level,
        noise=camera.noise,
        marker_id=plate.marker_id,
        marker_side_mm=plate.marker_side_mm,
        marker_centre_mm=plate.marker_centre_mm,
        tilt_deg=camera.tilt_deg,
        k1=camera.k1,
        distance_mm=camera.distance_mm,
        reflections=camera.reflections,
    )


Mask = npt.NDArray[np.bool_]

OUT_OF_SIGHT_MM = 500.0
"""Distance to the side of the plate's centre, or below it, at which hidden markers are placed."""


class FrameFaults:
    """The current trial's faults of the frame camera; a further one only loses sight of markers."""

    def __init__(self, world: SimulatedWorld, trigger: Ticks, *, first: bool = True) -> None:
        self._world, self._trigger, self._first = world, trigger, first

    def lost(self, ticks: I64) -> Mask:
        """Return a mask of the frames that never reach the host, (k,) for k ticks."""
        lost = np.zeros(len(ticks), np.bool_)
        if not self._first or not len(ticks):
            return lost
        for fault, begin_ns, _ in self._world.faults.spans(FramesLost):
            first = self._trigger.tick_at(begin_ns)
            lost |= (ticks >= first) & (ticks < first + fault.count)
        for _, begin_ns, end_ns in self._world.faults.spans(DeviceGone, target="frame_camera"):
            true_ns = self._trigger.true_ns(ticks)
            lost |= (true_ns >= begin_ns) & (true_ns < end_ns)
        return lost

    def arrival_ns(self, ticks: I64, on_time_ns: I64) -> I64:
        """Return the arrival times of frames, ns; a late frame delays the following ones.

        Args:
            ticks: (k,), increasing.
            on_time_ns: (k,), arrival times without faults.
        """
        arrival = on_time_ns
        if not self._first:
            return arrival
        for fault, begin_ns, _ in self._world.faults.spans(FrameLate):
            first = self._trigger.tick_at(begin_ns)
            after = ticks >= first
            if after.any():
                last_late = np.minimum(ticks[after], first + fault.count - 1)
                # without faults the delay after a tick is constant
                early = self._trigger.true_ns(ticks[after]) - self._trigger.true_ns(last_late)
                late = on_time_ns[after] - early + round(fault.seconds * 1e9)
                arrival = arrival.copy()
                arrival[after] = np.maximum(arrival[after], late)
        return arrival

    def hide(self, mid_ns: I64, seen: Exposures) -> Exposures:
        """Return k exposures around `mid_ns` with hidden markers moved out of the image.

        A torn papilla has lost its marker; an occluded marker is hidden for some time.
        """
        hidden: list[tuple[int | None, Mask]] = [
            (papilla, mid_ns >= due_ns) for papilla, due_ns in self._world.faults.torn()
        ]
        for fault, begin_ns, end_ns in self._world.faults.spans(MarkerOccluded):
            hidden.append((fault.papilla, (mid_ns >= begin_ns) & (mid_ns < end_ns)))
        hidden = [(papilla, when) for papilla, when in hidden if when.any()]
        if not hidden:
            return seen
        tips_mm, plate_mm, paths = seen.tips_mm.copy(), seen.plate_mm.copy(), dict(seen.paths)
        for papilla, when in hidden:
            _put_away(papilla, tips_mm, plate_mm, when)
            for index in paths.keys() & set(np.flatnonzero(when).tolist()):
                path = ExposurePath(paths[index].tips_mm.copy(), paths[index].plate_mm.copy())
                _put_away(papilla, path.tips_mm, path.plate_mm, slice(None))
                paths[index] = path
        return Exposures(tips_mm, plate_mm, paths)


def _put_away(papilla: int | None, tips_mm: F64, plate_mm: F64, when: Mask | slice) -> None:
    if papilla is None:
        plate_mm[when] = -OUT_OF_SIGHT_MM
    else:
        tips_mm[when, papilla] = [-OUT_OF_SIGHT_MM, 0.0]
