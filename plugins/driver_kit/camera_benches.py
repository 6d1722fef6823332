"""Benches of event cameras and frame cameras, each on its fake."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sliplab.plugins.driver_kit.bench import wraps_s
from sliplab.plugins.driver_kit.rule import Bounds, NotTried, RuleViolation
from sliplab.plugins.driver_kit.stream_bench import StreamBench
from sliplab.rigs.core.capabilities import EventCamera, FrameCamera
from sliplab.rigs.core.driver import EventCameraDriver, FrameCameraDriver
from sliplab.storage.streams import EventChunk, FrameChunk, PulseChunk

FRAME_NS = 10_000_000
"""Period of frames, ns."""
SIZE = 64, 48
"""Columns and rows of the fakes' cameras."""
PX_PER_MM = 10.0


class EventBench(StreamBench):
    """An event camera; its chunks' times are us."""

    capability = EventCamera
    clock_field = "t_us"
    fields = ("t_us", "x", "y", "p")

    def __init__(self, driver: EventCameraDriver[Any], settings: Any, bounds: Bounds) -> None:
        super().__init__(driver, settings, bounds)
        if driver.fake is None or driver.reach is None:
            raise NotTried(
                f"{driver.name} declares no `fake` and `reach`, on which rules are tried"
            )
        self._build = driver.build
        self.fake = driver.fake(SIZE)
        self.settings = driver.reach(settings, self.fake.address)
        self.pulses: list[int] = []
        self.fed_pulses: list[int] = []

    def open(self) -> None:
        """Open the camera. Raises RigError."""
        self.device = self._build(self.settings)

    def close_fake(self) -> None:
        """Close the fake."""
        self.fake.close()

    def feed(self) -> None:
        """Send a hundred events within 10 ms, some at the same time, and a pulse."""
        t_us = self.times(100, 100_000) // 1000
        at = t_us // 100
        t_us[9::10] = t_us[8::10]
        chunk = EventChunk(
            (at % SIZE[0]).astype(np.uint16),
            (at % SIZE[1]).astype(np.uint16),
            (at % 2).astype(np.uint8),
            t_us,
        )
        pulse = PulseChunk(t_us[-1:] * 1000)
        self.fed.append(chunk)
        self.fed_pulses.extend(pulse.t_ns.tolist())
        self.fake.send(chunk, pulse)

    def read(self) -> list[int]:
        """Return the times of events, us; pulses are appended to `pulses`."""
        self.pulses.extend(self.call("read_pulses", self.device.read_pulses).t_ns.tolist())
        return super().read()

    def mark(self) -> int | None:
        """Return the time of the next batch, us."""
        self.fed_pulses.clear()
        return self._next_ns // 1000

    def complete(self, times: Sequence[int]) -> bool:
        """Return whether all events and pulses have come."""
        pulses = bool(self.pulses) and self.pulses[-1] >= self.fed_pulses[-1]
        return pulses and super().complete(times)

    def missing(self, times: Sequence[int]) -> str:
        """Return in words what was sent last, and what came."""
        pulses = f"pulses up to {self.fed_pulses[-1]} ns, up to {max(self.pulses, default=0)} ns"
        return f"{super().missing(times)}; {pulses} came"

    def check_content(self) -> None:
        """Raise Seen if events or pulses came otherwise than they were sent."""
        super().check_content()
        found = [pulse for pulse in self.pulses if pulse >= (self._mark or 0) * 1000]
        if found != self.fed_pulses:
            raise RuleViolation(f"{len(self.fed_pulses)} pulses were sent and {len(found)} came")

    def check_fresh(self, mark: int) -> None:
        """Raise Seen if a pulse came from before a time, us."""
        if min(self.pulses) < mark * 1000:
            raise RuleViolation("the second run began with pulses of the first one")

    def forget(self) -> None:
        """Forget what was fed and what came."""
        super().forget()
        self.fed_pulses.clear()
        self.pulses.clear()

    def check_steps(self) -> None:
        """Raise Seen if the times of events or pulses came with other differences."""
        super().check_steps()
        self.quiet()
        sent, found = np.diff(self.fed_pulses), np.diff(self.pulses)
        if sent.tolist() != found.tolist():
            raise RuleViolation(f"pulses {sent.tolist()} ns apart came {found.tolist()} ns apart")

    def silence(self) -> None:
        """Stall the fake."""
        self.fake.stall()

    def unplug(self) -> None:
        """Break the fake's connections."""
        self.fake.close()


class FrameBench(StreamBench):
    """A frame camera on frames of a scene that the bench shows; also the `SceneFrames`."""

    capability = FrameCamera
    fields: tuple[str, ...] = ("number", "t_ns", "images")

    def __init__(self, driver: FrameCameraDriver[Any], settings: Any, bounds: Bounds) -> None:
        super().__init__(driver, settings, bounds)
        if driver.fake is None:
            raise NotTried(f"{driver.name} declares no `fake`, on which rules are tried")
        self._fake, self._unplug = driver.fake, driver.unplug
        self._on_frames: Callable[[FrameChunk], None] = lambda frames: None
        self.shape = SIZE
        self.mid_exposure_ns = round(settings.exposure_us * 500)
        self.region = SIZE
        self._grabbing, self._number, self._begun_ns = False, 0, 0
        self._by_arrival = driver.grade == "host arrival"
        if self._by_arrival:
            self.fields = ("number", "images")

    def turn_back(self) -> None:
        """Let the camera's clock fall back. Raises NotTried: it has none."""
        self._check_clock()
        super().turn_back()

    @property
    def wraps_s(self) -> tuple[float, ...]:
        """Times of the camera's clock at which counters wrap, s. Raises NotTried: it has none."""
        self._check_clock()
        return wraps_s(self.device)

    def _check_clock(self) -> None:
        if self._by_arrival:
            raise NotTried("its frames are timed by their arrival")

    def lose(self, count: int) -> None:
        """Lose the next frames: their numbers are missing. Raises NotTried: it has no numbers."""
        if self._by_arrival:
            raise NotTried("a camera whose frames are timed by their arrival does not number them")
        self._number += count
        self.times(count, FRAME_NS)

    def check_sync(self) -> None:
        """Raise Seen if levels of the sync line came otherwise; NotTried: none was reported."""
        sent = {
            int(number): int(level)
            for chunk in self.fed
            for number, level in zip(chunk.number, chunk.sync, strict=True)
        }
        found = {
            int(number): int(level)
            for chunk in self._of_run()
            for number, level in zip(chunk.number, chunk.sync, strict=True)
            if int(number) in sent
        }
        if not any(found.values()):
            raise NotTried("it reports no level of the sync line: none is wired to it")
        wrong = [number for number, level in found.items() if level != sent[number]]
        if wrong:
            raise RuleViolation(
                f"frame {wrong[0]} was exposed at level {sent[wrong[0]]} of the sync line, and "
                f"came with {found[wrong[0]]}"
            )

    def mark(self) -> int | None:
        """Return the time from which batches will be compared, ns."""
        return time.monotonic_ns() if self._by_arrival else super().mark()

    def complete(self, times: Sequence[int]) -> bool:
        """Return whether all that was fed has come."""
        if not self._by_arrival:
            return super().complete(times)
        return any(chunk.number[-1] >= self.fed[-1].number[-1] for chunk in self._of_run())

    def check_content(self) -> None:
        """Raise Seen if what came differs from what `gather` fed last."""
        if self._by_arrival:  # frames are matched by their numbers: their times are the host's
            first = self.fed[0].number[0]
            self._mark = min(
                int(chunk.t_ns[chunk.number >= first][0])
                for chunk in self._of_run()
                if chunk.number[-1] >= first
            )
        super().check_content()

    def _of_run(self) -> list[FrameChunk]:
        """Return what came since the last start, as far as that is known from times of arrival."""
        if not self._by_arrival:
            return list(self.came)
        return [chunk for chunk in self.came if chunk.t_ns[0] >= self._begun_ns]

    def open(self) -> None:
        """Open the camera on the scene's frames. Raises RigError."""
        self.device = self._fake(self.settings, PX_PER_MM, self, self.mid_exposure_ns)
        self.device.set_region(*self.region)

    def close_fake(self) -> None:
        """Nothing to close: the fake is the camera's."""

    def grab(self, width_px: int, height_px: int, on_frames: Callable[[FrameChunk], None]) -> None:
        """Begin to expose a region."""
        self._on_frames = on_frames
        self.shape, self._number, self._grabbing = (width_px, height_px), 0, True
        self._begun_ns = time.monotonic_ns()

    def stop_grabbing(self) -> None:
        """Stop; an empty chunk ends the frames."""
        self._grabbing = False
        self._on_frames(self._chunk(0))

    def feed(self) -> None:
        """Expose a frame, each unlike the one before."""
        if self._grabbing:
            chunk = self._chunk(1)
            self.fed.append(chunk)
            self._on_frames(chunk)

    def _chunk(self, count: int) -> FrameChunk:
        t_ns, (width, height) = self.times(count, FRAME_NS), self.shape
        number = self._number + np.arange(count, dtype=np.int64)
        self._number += count
        noise = np.random.default_rng(self._number)
        images = noise.integers(0, 256, (count, height, width)).astype(np.uint8)
        sync = (number % 3 == 0).astype(np.uint8)
        return FrameChunk(images, number, t_ns, t_ns, sync)

    def silence(self) -> None:
        """A scene that shows nothing is silent."""

    def unplug(self) -> None:
        """Unplug the fake camera. Raises NotTried: the driver does not say how."""
        if self._unplug is None:
            raise NotTried(f"{self.driver.name} declares no unplug")
        self._unplug(self.device)
