"""Simulated devices keep the rules for drivers, as far as these do not ask for a wire.

They run on the world's virtual clock, need no fake, and leave limits to the protocol.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sliplab.plugins.driver_kit import arm_rules, motion_rules, stream_rules
from sliplab.plugins.driver_kit.arm_bench import ArmBench
from sliplab.plugins.driver_kit.bench import POLL_S, DeviceBench, check_methods
from sliplab.plugins.driver_kit.rule import Bounds, NotTried
from sliplab.plugins.driver_kit.sensor_benches import SyncBench
from sliplab.plugins.driver_kit.stream_bench import BATCHES, StreamBench
from sliplab.plugins.simulation.devices import MockDevices, build_mock
from sliplab.plugins.simulation.settings import MockForceSensorSettings as ForceSettings
from sliplab.plugins.simulation.settings import MockFrameCameraSettings as FrameSettings
from sliplab.plugins.simulation.settings import MockSettings
from sliplab.rigs.core.arm_settings import ArmLimits
from sliplab.rigs.core.capabilities import (
    Arm,
    ArmState,
    EventCamera,
    ForceSensor,
    FrameCamera,
    Pose,
    SyncBox,
)
from sliplab.rigs.core.fakes import Kind
from tests.patching import loose

SETTINGS = MockSettings(
    frame_camera=FrameSettings(level="tracks"),
    force=ForceSettings(),
)
ARM_RULES = {
    "path",
    "times in order",
    "one path at a time",
    "stop at rest",
    "stop while moving",
    "protective stop",
    "speed and length",
    "turn",
    "orientation",
    "poses",
    "calls while moving",
    "clock",
    "host times",
}
STREAM_RULES = {"data", "stop", "arrays", "read at once"}
ALL_ARM_RULES = [*arm_rules.RULES.all, *motion_rules.RULES.all]
TIMED = {"frames", "force"}
"""Devices whose chunks have the host's time of reception."""


class OnVirtualClock(DeviceBench):
    """A bench whose time passes in a simulated world only."""

    devices: MockDevices

    def wait(self, seconds: float) -> None:
        self.devices.clock.wait(seconds)

    def until(self, condition: Callable[[], bool], within_s: float) -> bool:
        end_ns = self.devices.clock.now_ns() + round(within_s * 1e9)
        while not condition():
            if self.devices.clock.now_ns() > end_ns:
                return False
            self.wait(POLL_S)
        return True

    def close_fake(self) -> None:
        """There is none."""


class MockArmBench(OnVirtualClock, ArmBench):
    """The simulated arm, clear of the plate; it turns about the plate's normal alone."""

    def __init__(self) -> None:
        DeviceBench.__init__(self, Bounds())
        self.devices = build_mock(SETTINGS)
        self.arm = self.devices.arm
        self.home = self.devices.arm.pose()
        tool = Rotation.from_rotvec(self.home.rotvec_deg, degrees=True)
        self.axis = tuple(tool.apply([0.0, 0.0, 1.0]))
        low, high = ([value + step for value in self.home.xyz_mm] for step in (-20.0, 20.0))
        self.limits = ArmLimits.model_validate({"low_mm": low, "high_mm": high})

    def place(self) -> Pose:
        return self.devices.arm.pose()

    def host_ns(self) -> int:
        return self.devices.clock.now_ns()

    def clock_s(self) -> float:
        world = self.devices.world
        return world.clocks.arm.to_reference(world.now_ns) / 1e9

    def true_pose(self, t_s: float) -> Pose:
        world = self.devices.world
        true_ns = world.clocks.arm.to_device(np.array([round(t_s * 1e9)], np.int64))
        state = world.path.states(true_ns)[0].tolist()
        return Pose((state[0], state[1], state[2]), (state[3], state[4], state[5]))

    def moving(self) -> bool:
        return self.devices.world.path.moving(self.devices.world.now_ns)

    def inject(self, kind: Kind) -> None:
        assert kind is Kind.PROTECTIVE_STOP
        world = self.devices.world
        world.halt_arm(world.now_ns, ArmState.PROTECTIVE_STOP)


class MockStreamBench(OnVirtualClock, StreamBench):
    """A simulated device that streams."""

    def __init__(self, name: str) -> None:
        DeviceBench.__init__(self, Bounds())
        self.devices = build_mock(SETTINGS)
        self.device: Any = getattr(self.devices, name)
        self.clock_field = "t_us" if name == "events" else "t_ns"
        self.fed, self.came, self._next_ns = [], [], 0
        self.box = name == "sync"
        self.seed = 0

    def host_ns(self) -> int:
        return self.devices.clock.now_ns()

    def open(self) -> None:
        if not self.box:
            self.devices.sync.start(100.0, 1, "lfsr")

    def close_device(self) -> None:
        self.device.close()

    def begin(self) -> None:
        if self.box:
            loose(SyncBench).begin(self)
        else:
            self.device.start()

    RATE_HZ, CODE = SyncBench.RATE_HZ, SyncBench.CODE

    def take(self) -> Any:
        return self.device.read_pulses() if self.box else self.device.read()

    def feed(self) -> None:
        self.wait(0.05)

    def complete(self, times: Sequence[int]) -> bool:
        return len(times) > BATCHES

    def check_content(self) -> None:
        if self.box:
            loose(SyncBench).check_content(self)

    def silence(self) -> None:
        raise NotTried("a simulated stall is a fault of a trial")

    def unplug(self) -> None:
        raise NotTried("a simulated loss is a fault of a trial")


@pytest.mark.quick(5)
@pytest.mark.parametrize(
    "rule", [rule for rule in ALL_ARM_RULES if rule.name in ARM_RULES], ids=lambda r: r.name
)
def test_the_simulated_arm_keeps_a_rule(rule: Any) -> None:
    with MockArmBench() as bench:
        check_methods(bench.arm, Arm)
        rule.hold("mock", bench)


@pytest.mark.parametrize(
    ("name", "capability"),
    [
        ("events", EventCamera),
        ("frames", FrameCamera),
        ("force", ForceSensor),
        ("sync", SyncBox),
    ],
)
@pytest.mark.parametrize(
    "rule",
    [rule for rule in stream_rules.RULES.all if rule.name in STREAM_RULES],
    ids=lambda r: r.name,
)
def test_a_simulated_device_keeps_a_rule(rule: Any, name: str, capability: type) -> None:
    with MockStreamBench(name) as bench:
        check_methods(bench.device, capability)
        rule.hold(name, bench)


@pytest.mark.parametrize("name", sorted(TIMED))
def test_a_simulated_device_keeps_the_rule_of_host_times(name: str) -> None:
    (rule,) = stream_rules.HOST_RULES.all
    with MockStreamBench(name) as bench:
        rule.hold(name, bench)


def test_every_rule_that_is_named_here_is_one() -> None:
    assert {rule.name for rule in ALL_ARM_RULES} >= ARM_RULES
    assert {rule.name for rule in stream_rules.RULES.all} >= STREAM_RULES
