"""Benches of devices that stream: cameras, force sensors and sync boxes, each on its fake."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np

from sliplab.protocols.timing import Code
from sliplab.rigs.core.capabilities import (
    Arm,
    EventCamera,
    ForceSensor,
    FrameCamera,
    RigError,
    SyncBox,
)
from sliplab.rigs.core.driver import (
    Driver,
    EventCameraDriver,
    ForceSensorDriver,
    FrameCameraDriver,
    SyncBoxDriver,
)
from sliplab.rigs.core.fakes import Kind
from sliplab.rigs.core.pulse_code import CodeBits
from sliplab.rigs.testing.arm_bench import ArmBench
from sliplab.rigs.testing.bench import POLL_S, QUIET_S, Bench
from sliplab.rigs.testing.rule import Bounds, NotTried, Seen
from sliplab.storage.streams import I64, EventChunk, FrameChunk, PulseChunk, WrenchChunk

FIRST_NS = 5_000_000_000
"""First time of the fakes' clocks, ns."""
BACK_NS = 2_000_000_000
"""Step by which a clock falls back, ns."""
BATCHES = 3
SIZE = 64, 48
"""Columns and rows of the fakes' cameras."""
PX_PER_MM = 10.0


class StreamBench(Bench):
    """A device that streams, and its fake, which sends what the bench feeds it."""

    capability: ClassVar[type]
    clock_field: ClassVar[str] = "t_ns"
    fields: tuple[str, ...] = ()
    """Fields of a chunk that must come as they were sent."""
    device: Any = None

    def __init__(self, driver: Driver[Any], settings: Any, bounds: Bounds) -> None:
        super().__init__(bounds)
        self.driver, self.settings = driver, settings
        self.fed: list[Any] = []
        self.came: list[Any] = []
        self._next_ns = FIRST_NS
        self._mark: int | None = None

    # -- the fake, by kind -----------------------------------------------------------------

    @abstractmethod
    def feed(self) -> None:
        """Let the fake send the next batch."""

    @abstractmethod
    def silence(self) -> None:
        """Let the fake send and answer nothing from now on."""

    @abstractmethod
    def unplug(self) -> None:
        """Break the connection."""

    def turn_back(self) -> None:
        """Let the device's clock fall back."""
        self._next_ns -= BACK_NS

    # -- the device ------------------------------------------------------------------------

    def close_device(self) -> None:
        """Close the device, where it was made."""
        if self.device is not None:
            self.device.close()

    def connect(self) -> None:
        """Make the device and connect it, within the bound. Raises Seen or RigError."""
        self.call("connect", self.open, self.bounds.connect_s)

    def begin(self) -> None:
        """Start the stream. Raises RigError."""
        self.device.start()

    def start(self) -> None:
        """Start the stream within the bound. Raises Seen or RigError."""
        self.call("start", self.begin)

    def stop(self) -> None:
        """Stop the stream within the bound. Raises Seen or RigError."""
        self.call("stop", self.device.stop)

    def take(self) -> Any:
        """Return the device's next chunk. Raises RigError."""
        return self.device.read()

    def read(self) -> list[int]:
        """Return the times that came since the last call, in the unit of the chunk."""
        chunk = self.call("read", self.take)
        if len(chunk):
            self.came.append(chunk)
        times: list[int] = getattr(chunk, self.clock_field).tolist()
        return times

    def fault(self) -> bool:
        """Return whether the next read reports a fault."""
        try:
            self.read()
        except RigError:
            return True
        return False

    # -- data ------------------------------------------------------------------------------

    def gather(self) -> list[int]:
        """Feed and read some batches; return all times that came.

        Raises:
            Seen: nothing comes, or not all.
            RigError: the driver reports a fault.
        """
        got: list[int] = []

        def first() -> bool:
            self.feed()
            self.wait(POLL_S)
            got.extend(self.read())
            return bool(got)

        if not self.until(first, self.bounds.call_s):
            raise Seen(f"read returned nothing within {self.bounds.call_s:g} s of start")
        self.fed.clear()
        self._mark = self.mark()
        for _ in range(BATCHES):
            self.feed()

        def complete() -> bool:
            got.extend(self.read())
            return self.complete(got)

        if not self.until(complete, self.bounds.call_s):
            raise Seen(f"not all that was sent had been read after {self.bounds.call_s:g} s")
        return got

    def mark(self) -> int | None:
        """Return a time that all data from now on have reached, in the unit of the chunk.

        None where the device begins each run with a clock of its own.
        """
        return self._next_ns

    def complete(self, times: Sequence[int]) -> bool:
        """Return whether all that was fed has come."""
        last: int = getattr(self.fed[-1], self.clock_field)[-1]
        return bool(times) and times[-1] >= last

    def check_content(self) -> None:
        """Raise Seen if what came differs from what `gather` fed last."""
        for name in self.fields:
            sent = np.concatenate([getattr(chunk, name) for chunk in self.fed])
            found = np.concatenate(
                [
                    getattr(chunk, name)[getattr(chunk, self.clock_field) >= (self._mark or 0)]
                    for chunk in self.came
                ]
            )
            if len(sent) != len(found):
                raise Seen(f"{len(sent)} were sent and {len(found)} came ({name})")
            if not np.allclose(sent, found, atol=1e-3):
                raise Seen(f"{name} came otherwise than it was sent")

    def times(self, count: int, step_ns: int) -> I64:
        """Return the next times of the fake's clock, ns, shape (count,)."""
        found = self._next_ns + step_ns * np.arange(count, dtype=np.int64)
        self._next_ns += count * step_ns
        return found

    def quiet(self) -> list[int]:
        """Return the times that are read within `QUIET_S`."""
        got = self.read()
        self.wait(QUIET_S)
        return [*got, *self.read()]


class EventBench(StreamBench):
    """An event camera; its chunks' times are us."""

    capability = EventCamera
    clock_field = "t_us"
    fields = ("t_us", "x", "y", "p")

    def __init__(self, driver: EventCameraDriver[Any], settings: Any, bounds: Bounds) -> None:
        super().__init__(driver, settings, bounds)
        if driver.fake is None or driver.reach is None:
            raise NotTried(f"{driver.name} declares no fake")
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
        """Send a hundred events within 10 ms, and a pulse."""
        t_us = self.times(100, 100_000) // 1000
        at = t_us // 100
        chunk = EventChunk(
            (at % SIZE[0]).astype(np.uint16), (at % SIZE[1]).astype(np.uint16),
            (at % 2).astype(np.uint8), t_us,
        )  # fmt: skip
        pulse = PulseChunk(t_us[-1:] * 1000)
        self.fed.append(chunk)
        self.fed_pulses.extend(pulse.t_ns.tolist())
        self.fake.send(chunk, pulse)

    def read(self) -> list[int]:
        """Return the times of events, us; pulses are kept in `pulses`."""
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

    def check_content(self) -> None:
        """Raise Seen if events or pulses came otherwise than they were sent."""
        super().check_content()
        found = [pulse for pulse in self.pulses if pulse >= (self._mark or 0) * 1000]
        if found != self.fed_pulses:
            raise Seen(f"{len(self.fed_pulses)} pulses were sent and {len(found)} came")

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
            raise NotTried(f"{driver.name} declares no fake")
        self._fake, self._unplug = driver.fake, driver.unplug
        self.on_frames: Callable[[FrameChunk], None] = lambda frames: None
        self.shape = SIZE
        self._grabbing, self._number, self._begun_ns = False, 0, 0
        self._by_arrival = driver.grade == "host arrival"
        if self._by_arrival:
            self.fields = ("number", "images")

    def turn_back(self) -> None:
        """Let the camera's clock fall back. Raises NotTried: it has none."""
        if self._by_arrival:
            raise NotTried("its frames are timed by their arrival")
        super().turn_back()

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
        if self._by_arrival:  # frames are told by their numbers: their times are the host's
            first = self.fed[0].number[0]
            self._mark = min(
                int(chunk.t_ns[chunk.number >= first][0])
                for chunk in self._of_run()
                if chunk.number[-1] >= first
            )
        super().check_content()

    def _of_run(self) -> list[FrameChunk]:
        """Return what came since the last start; numbers begin anew with each."""
        return [chunk for chunk in self.came if chunk.t_ns[0] >= self._begun_ns]

    def open(self) -> None:
        """Open the camera on the scene's frames. Raises RigError."""
        mid_ns = round(self.settings.exposure_us * 500)
        self.device = self._fake(self.settings, PX_PER_MM, self, mid_ns)
        self.device.set_region(*SIZE)

    def close_fake(self) -> None:
        """Nothing to close: the fake is the camera's."""

    def grab(self, width_px: int, height_px: int) -> None:
        """Begin to expose a region."""
        self.shape, self._number, self._grabbing = (width_px, height_px), 0, True
        self._begun_ns = time.monotonic_ns()

    def stop_grabbing(self) -> None:
        """Stop; an empty chunk ends the frames."""
        self._grabbing = False
        self.on_frames(self._chunk(0))

    def feed(self) -> None:
        """Expose a frame, each unlike the one before."""
        if self._grabbing:
            chunk = self._chunk(1)
            self.fed.append(chunk)
            self.on_frames(chunk)

    def _chunk(self, count: int) -> FrameChunk:
        t_ns, (width, height) = self.times(count, 10_000_000), self.shape
        number = self._number + np.arange(count, dtype=np.int64)
        self._number += count
        noise = np.random.default_rng(self._number)
        images = noise.integers(0, 256, (count, height, width)).astype(np.uint8)
        return FrameChunk(images, number, t_ns, t_ns, np.zeros(count, np.uint8))

    def silence(self) -> None:
        """A scene that shows nothing is silent."""

    def unplug(self) -> None:
        """Unplug the fake camera. Raises NotTried: the driver does not say how."""
        if self._unplug is None:
            raise NotTried(f"{self.driver.name} declares no unplug")
        self._unplug(self.device)


class ForceBench(StreamBench):
    """A force sensor with a fake of its own."""

    capability = ForceSensor
    fields = ("t_ns", "force_n", "torque_nm")
    load = np.array([1.0, -2.0, 5.0, 0.1, 0.2, -0.3])
    """Force in N and torque in N m that the fake feels."""

    def __init__(
        self, driver: ForceSensorDriver[Any], settings: Any, bounds: Bounds, arm: Arm | None = None
    ) -> None:
        super().__init__(driver, settings, bounds)
        if driver.fake is None or driver.reach is None:
            raise NotTried(f"{driver.name} declares no fake")
        self._build: Callable[[Any, Any], ForceSensor] = driver.build
        self.fake = driver.fake(settings)
        self.settings = driver.reach(settings, self.fake.address)

    def open(self) -> None:
        """Connect the sensor. Raises RigError."""
        self.device = self._build(self.settings, None)
        self.device.connect()

    def close_fake(self) -> None:
        """Close the fake."""
        self.fake.close()

    def feed(self) -> None:
        """Send ten samples of a constant load within 10 ms."""
        t_ns = self.times(10, 1_000_000)
        force, torque = np.tile(self.load[:3], (10, 1)), np.tile(self.load[3:], (10, 1))
        chunk = WrenchChunk(t_ns, t_ns, force, torque)
        self.fed.append(chunk)
        self.fake.send(chunk)

    def silence(self) -> None:
        """Silence the fake."""
        self.fake.silence()

    def unplug(self) -> None:
        """Unplug the fake."""
        self.fake.close()

    def overload(self) -> None:
        """Let the load be out of range from now on."""
        self.fake.overload()


class ArmForceBench(StreamBench):
    """A force sensor that the arm's controller measures: its faults are the arm's."""

    capability = ForceSensor

    def __init__(
        self, driver: ForceSensorDriver[Any], settings: Any, bounds: Bounds, arm: ArmBench
    ) -> None:
        super().__init__(driver, settings, bounds)
        self._arm = arm
        self.device = driver.build(settings, arm.arm)

    def open(self) -> None:
        """Connect the arm and the sensor. Raises RigError."""
        self._arm.arm.connect()
        self.device.connect()

    def close_device(self) -> None:
        """Close the sensor and the arm."""
        self.device.close()
        self._arm.arm.close()

    def close_fake(self) -> None:
        """Close the arm's fake."""
        self._arm.close_fake()

    def mark(self) -> int | None:
        """Return the controller's time."""
        return self._arm.now_ns()

    def feed(self) -> None:
        """The controller measures by itself."""

    def complete(self, times: Sequence[int]) -> bool:
        """Return whether a few samples have come."""
        return len(times) > BATCHES

    def check_content(self) -> None:
        """The load is the controller's own."""

    def silence(self) -> None:
        """Silence the controller."""
        self._arm.inject(Kind.SILENCE)

    def unplug(self) -> None:
        """Cut the controller's connections."""
        self._arm.inject(Kind.LINK_CUT)

    def turn_back(self) -> None:
        """Let the controller's clock fall back."""
        self._arm.inject(Kind.CLOCK_BACK)

    def overload(self) -> None:
        """Not simulated. Raises NotTried."""
        raise NotTried("a fake controller cannot simulate an overload")


class SyncBench(StreamBench):
    """A sync box, which sends its pulses by itself."""

    capability = SyncBox
    RATE_HZ = 200.0
    CODE: Code = "lfsr"

    def __init__(self, driver: SyncBoxDriver[Any], settings: Any, bounds: Bounds) -> None:
        super().__init__(driver, settings, bounds)
        if driver.fake is None or driver.reach is None:
            raise NotTried(f"{driver.name} declares no fake")
        self._build = driver.build
        self.fake = driver.fake(time.monotonic_ns, lambda train, sent: None)
        self.settings = driver.reach(settings, self.fake.address)
        self.seed = 0

    def open(self) -> None:
        """Connect the box. Raises RigError."""
        self.device = self._build(self.settings)
        self.device.connect()

    def close_fake(self) -> None:
        """Close the fake."""
        self.fake.close()

    def begin(self) -> None:
        """Start a train with another seed than the last one. Raises RigError."""
        self.seed += 1
        self.came.clear()
        self.device.start(self.RATE_HZ, self.seed, self.CODE)

    def take(self) -> PulseChunk:
        """Return the box's next pulses. Raises RigError."""
        found: PulseChunk = self.device.read_pulses()
        return found

    def mark(self) -> int | None:
        """Return None: each train begins at 0."""
        return None

    def feed(self) -> None:
        """The box ticks by itself."""

    def complete(self, times: Sequence[int]) -> bool:
        """Return whether a few pulses have come."""
        return len(times) > BATCHES

    def check_content(self) -> None:
        """Raise Seen if pulses are not those of the code."""
        found = np.concatenate([chunk.t_ns for chunk in self.came])
        ticks = int(found[-1] * self.RATE_HZ / 1e9) + 2
        bits = np.flatnonzero(CodeBits(self.seed, self.CODE).upto(ticks))
        due = (bits * (1e9 / self.RATE_HZ)).astype(np.int64)[: len(found)]
        if len(due) < len(found) or np.abs(due - found).max() > 1000:
            raise Seen(f"pulses came at {found.tolist()} ns, those of the code are {due.tolist()}")

    def silence(self) -> None:
        """Let the fake hang."""
        self.fake.silence()

    def unplug(self) -> None:
        """Unplug the fake."""
        self.fake.close()

    def turn_back(self) -> None:
        """Let the box restart."""
        self.fake.reset()
