"""Benches of force sensors and sync boxes, each on its fake."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sliplab.protocols.timing import Code
from sliplab.rigs.core.capabilities import ForceSensor, SyncBox
from sliplab.rigs.core.driver import ForceSensorDriver, SyncBoxDriver
from sliplab.rigs.core.fakes import Kind
from sliplab.rigs.core.pulse_code import CodeBits
from sliplab.rigs.testing.arm_bench import ArmBench
from sliplab.rigs.testing.rule import Bounds, NotTried, Seen
from sliplab.rigs.testing.stream_bench import BATCHES, StreamBench
from sliplab.storage.streams import PulseChunk, WrenchChunk


class ForceBench(StreamBench):
    """A force sensor with a fake of its own."""

    capability = ForceSensor
    fields = ("t_ns", "force_n", "torque_nm")
    load = np.array([1.0, -2.0, 5.0, 0.1, 0.2, -0.3])
    """Force in N and torque in N m that the fake feels."""

    def __init__(self, driver: ForceSensorDriver[Any], settings: Any, bounds: Bounds) -> None:
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
