"""Benches of sensors and sync boxes, each on its fake."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from sliplab.plugins.driver_kit.arm_bench import ArmBench, Load
from sliplab.plugins.driver_kit.arm_report import clock_offset_ns
from sliplab.plugins.driver_kit.rule import Bounds, NotTried, RuleViolation
from sliplab.plugins.driver_kit.stream_bench import BATCHES, MS_NS, StreamBench
from sliplab.protocols.timing import Code
from sliplab.rigs.core.capabilities import ForceSensor, Sensor, SyncBox
from sliplab.rigs.core.driver import ForceSensorDriver, PulseTrain, SensorDriver, SyncBoxDriver
from sliplab.rigs.core.fakes import Kind
from sliplab.rigs.core.pulse_code import CodeBits
from sliplab.storage.streams import F64, SCALAR, PulseChunk, WrenchChunk

LOAD = np.array([1.0, -2.0, 5.0, 0.1, 0.2, -0.3])
"""Force in N and torque in N m that a fake feels."""
SWING, SWING_HZ = 0.2, 1.0
"""Share by which the load swings, and how often in a second."""
US_NS = 1000
"""Step of a sync box's clock, ns."""
TIMED_S = 0.05
"""Largest error of the time of a load that the arm's controller measures, s."""


def swinging(load: F64, t_s: F64, steady: bool) -> F64:
    """Return the load at times of the device's clock, s, shape (n, 6)."""
    swing = 0.0 if steady else SWING
    return np.outer(1.0 + swing * np.sin(2 * np.pi * SWING_HZ * t_s), load)


class ForceBench(StreamBench):
    """A force sensor with its own fake."""

    capability = ForceSensor
    fields = ("t_ns", "force_n", "torque_nm")
    slack_ns = 200_000
    """A sample counter's step."""
    load = LOAD
    steady = False
    """True for a constant load; else it swings by `SWING`."""

    def __init__(self, driver: ForceSensorDriver[Any], settings: Any, bounds: Bounds) -> None:
        super().__init__(driver, settings, bounds)
        if driver.fake is None or driver.reach is None:
            raise NotTried(
                f"{driver.name} declares no `fake` and `reach`, on which rules are tried"
            )
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
        """Send ten samples of the load within 10 ms."""
        t_ns = self.times(10, 1_000_000)
        load = swinging(self.load, t_ns / 1e9, self.steady)
        chunk = WrenchChunk(t_ns, t_ns, load[:, :3], load[:, 3:])
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


class SensorBench(StreamBench):
    """A sensor of rows of numbers, each of which tells its row: they count on."""

    capability = Sensor
    driver: SensorDriver[Any]

    def __init__(self, driver: SensorDriver[Any], settings: Any, bounds: Bounds) -> None:
        super().__init__(driver, settings, bounds)
        if driver.fake is None or driver.reach is None:
            raise NotTried(
                f"{driver.name} declares no `fake` and `reach`, on which rules are tried"
            )
        self._build: Callable[[Any], Sensor] = driver.build
        self.fake = driver.fake(settings)
        self.settings = driver.reach(settings, self.fake.address)
        self._sent = 0

    def open(self) -> None:
        """Connect the sensor, which then knows its columns. Raises RigError."""
        self.device = self._build(self.settings)
        self.device.connect()
        kind = getattr(self.device, "kind", self.driver.stream or SCALAR)
        numbers = [
            column.field
            for column in kind.columns.values()
            if column.dtype == "float64" and not column.shape
        ]
        if not numbers:
            raise NotTried(f"{kind.name} has no column of one float64 a row, which rules number")
        self.clock_field, self.fields = numbers[0], tuple(numbers)

    def close_fake(self) -> None:
        """Close the fake."""
        self.fake.close()

    def feed(self) -> None:
        """Send ten rows within 10 ms."""
        number = 1.0 + self._sent + np.arange(10)
        self._sent += 10
        rows = {name: number + column for column, name in enumerate(self.fields)}
        self.fed.append(SimpleNamespace(**rows))
        self.fake.send({"t": self.times(10, MS_NS), **rows})

    def mark(self) -> int | None:
        """Return the number of the next row."""
        return self._sent + 1

    def silence(self) -> None:
        """Silence the fake."""
        self.fake.silence()

    def unplug(self) -> None:
        """Unplug the fake."""
        self.fake.close()

    def turn_back(self) -> None:
        """Let the sensor's clock fall back. Raises NotTried: it has none."""
        if not self.fake.clocked:
            raise NotTried("its rows have no times of a clock that must not fall back")
        super().turn_back()


class ArmForceBench(StreamBench):
    """A force sensor that the arm's controller measures: its faults are the arm's.

    Args:
        arm: makes the arm under a load.
    """

    capability = ForceSensor

    def __init__(
        self,
        driver: ForceSensorDriver[Any],
        settings: Any,
        bounds: Bounds,
        arm: Callable[[Load], ArmBench],
    ) -> None:
        super().__init__(driver, settings, bounds)
        self._arm = arm(self._load_at)
        self.device = driver.build(settings, self._arm.arm)

    load = LOAD
    steady = False

    def _load_at(self, t_s: float) -> Sequence[float]:
        found: list[float] = swinging(self.load, np.array([t_s]), self.steady)[0].tolist()
        return found

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
        """Raise Seen if forces or torques are not those on the tool at their times."""
        offset_ns = clock_offset_ns(self._arm)
        for chunk in self.came:
            t_s = (chunk.t_ns - offset_ns) / 1e9
            found = np.hstack([chunk.force_n, chunk.torque_nm])
            true = swinging(self.load, t_s, self.steady)
            slope = 2 * np.pi * SWING_HZ * SWING * np.abs(self.load)
            wrong = np.flatnonzero(~(np.abs(found - true) <= TIMED_S * slope + 1e-3).all(axis=1))
            if len(wrong):
                raise RuleViolation(
                    f"force and torque came as {np.round(found[wrong[0]], 4).tolist()} N and N m, "
                    f"on the tool were {np.round(true[wrong[0]], 4).tolist()}"
                )

    @property
    def wraps_s(self) -> tuple[float, ...]:
        """Not tried here. Raises NotTried."""
        raise NotTried("the clock is the arm's, which the rules of arms try")

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
    USUAL: Code = "lfsr"
    CODE: Code = USUAL

    def __init__(self, driver: SyncBoxDriver[Any], settings: Any, bounds: Bounds) -> None:
        super().__init__(driver, settings, bounds)
        if driver.fake is None or driver.reach is None:
            raise NotTried(
                f"{driver.name} declares no `fake` and `reach`, on which rules are tried"
            )
        self._build = driver.build
        self.trains: list[PulseTrain | None] = []
        """Trains that the box has begun, and None at each end."""
        self._ahead_ns = 0
        self.fake = driver.fake(
            lambda: time.monotonic_ns() + self._ahead_ns,
            lambda train, sent: self.trains.append(train),
        )
        self.settings = driver.reach(settings, self.fake.address)
        self.seed = 76

    def open(self) -> None:
        """Connect the box. Raises RigError."""
        self.device = self._build(self.settings)
        self.device.connect()

    def close_fake(self) -> None:
        """Close the fake."""
        self.fake.close()

    def begin(self) -> None:
        """Start a train with another seed than the last one. Raises RigError."""
        self.device.start(self.RATE_HZ, self.seed + 1, self.CODE)
        self.seed += 1
        self.came.clear()

    def pass_time(self, seconds: float) -> None:
        """Let the clock that drives the box jump ahead, as if time had passed."""
        self._ahead_ns += round(seconds * 1e9)

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
        if len(due) < len(found) or np.abs(due - found).max() > US_NS:
            raise RuleViolation(
                f"pulses came at {found.tolist()} ns, those of the code are {due.tolist()}"
            )

    def silence(self) -> None:
        """Let the fake hang."""
        self.fake.silence()

    def unplug(self) -> None:
        """Unplug the fake."""
        self.fake.close()

    def turn_back(self) -> None:
        """Let the box restart."""
        self.fake.reset()
