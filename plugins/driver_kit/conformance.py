"""Conformance of a driver as pytest cases, or as a report.

A package with a driver tries every rule that applies to its kind by two lines of a test module:

    from sliplab.testing import conformance
    test_driver = conformance(DRIVER, MySettings(host="127.0.0.30"))
"""

from __future__ import annotations

import gc
import socket
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, cast

from sliplab.plugins.driver_kit import (
    arm_rules,
    gripper_rules,
    motion_rules,
    stream_rules,
    sync_rules,
)
from sliplab.plugins.driver_kit.arm_bench import ArmBench
from sliplab.plugins.driver_kit.bench import settle
from sliplab.plugins.driver_kit.camera_benches import EventBench, FrameBench
from sliplab.plugins.driver_kit.gripper_bench import GripperBench
from sliplab.plugins.driver_kit.rule import Bounds, NotTried, Rule, RuleBroken, Rules, RuleViolation
from sliplab.plugins.driver_kit.sensor_benches import (
    ArmForceBench,
    ForceBench,
    SensorBench,
    SyncBench,
)
from sliplab.rigs.core.arm_settings import BaseArmSettings
from sliplab.rigs.core.device_settings import DriverSettings
from sliplab.rigs.core.driver import (
    ArmDriver,
    Driver,
    EventCameraDriver,
    ForceSensorDriver,
    FrameCameraDriver,
    GripperDriver,
    SensorDriver,
    SyncBoxDriver,
)

Make = Callable[[], Any]


@dataclass(frozen=True)
class Case:
    """One rule for one driver; every try has a new device and a new fake."""

    driver: str
    rule: Rule[Any]
    make: Make

    def __call__(self) -> None:
        """Try the rule.

        Raises:
            RuleBroken: the driver breaks it.
            NotTried: it cannot be tried on this driver.
        """
        if self.rule.warm:
            self._warm()
        with self.make() as bench:
            self.rule.hold(self.driver, bench)

    def _warm(self) -> None:
        """Open and close a device, forget it, and wait for threads that are ending."""
        with self.make() as bench, suppress(RuleViolation):  # the rule itself will see it, too
            bench.refusal("connect", bench.open, bench.bounds.connect_s)
        del bench
        gc.collect()
        settle()


def cases(
    driver: Driver[Any],
    settings: DriverSettings,
    bounds: Bounds | None = None,
    *,
    arm: tuple[ArmDriver[Any], BaseArmSettings] | None = None,
) -> list[Case]:
    """Return the cases of a driver; its kind decides which rules apply.

    Args:
        settings: settings of a rig file; the fake of an arm listens at their address.
        bounds: time limits of the driver's calls.
        arm: driver and settings of the arm, for a force sensor that the arm's controller measures.
    """
    limits, common = bounds or Bounds(), stream_rules.RULES

    def of(make: Make, *rules: Rules[Any]) -> list[Case]:
        return [Case(driver.name, rule, make) for part in rules for rule in part.all]

    if isinstance(driver, ArmDriver):
        own = cast(BaseArmSettings, settings)
        return of(lambda: ArmBench(driver, own, limits), arm_rules.RULES, motion_rules.RULES)
    if isinstance(driver, EventCameraDriver):
        own_rules = stream_rules.CLOCK_RULES, stream_rules.EVENT_RULES
        return of(lambda: EventBench(driver, settings, limits), common, *own_rules)
    if isinstance(driver, FrameCameraDriver):
        timed = stream_rules.CLOCK_RULES, stream_rules.HOST_RULES, stream_rules.FRAME_RULES
        return of(lambda: FrameBench(driver, settings, limits), common, *timed)
    if isinstance(driver, SyncBoxDriver):
        return of(lambda: SyncBench(driver, settings, limits), common, sync_rules.RULES)
    if isinstance(driver, GripperDriver):
        return of(lambda: GripperBench(driver, settings, limits), gripper_rules.RULES)
    if isinstance(driver, SensorDriver):
        return of(lambda: SensorBench(driver, settings, limits), common, stream_rules.HOST_RULES)
    if not isinstance(driver, ForceSensorDriver):
        raise TypeError(f"{driver.name}: there are no rules for a {driver.kind}")
    rules = common, stream_rules.CLOCK_RULES, stream_rules.HOST_RULES, stream_rules.FORCE_RULES
    if arm is None:
        return of(lambda: ForceBench(driver, settings, limits), *rules)
    return of(
        lambda: ArmForceBench(driver, settings, limits, lambda load: ArmBench(*arm, limits, load)),
        *rules,
    )


def conformance(
    driver: Driver[Any],
    settings: DriverSettings,
    bounds: Bounds | None = None,
    *,
    arm: tuple[ArmDriver[Any], BaseArmSettings] | None = None,
) -> Callable[..., None]:
    """Return a pytest test of a driver, with one case a rule; arguments as in `cases`.

    A rule that the fake cannot simulate is skipped with the reason.
    """
    import pytest

    found = cases(driver, settings, bounds, arm=arm)

    @pytest.mark.parametrize("case", found, ids=[case.rule.name for case in found])
    def test(case: Case) -> None:
        broken = ""
        try:
            case()
        except NotTried as reason:
            pytest.skip(str(reason))
        except RuleBroken as error:
            broken = str(error)
        if broken:  # its text says it all: neither a traceback nor the exceptions before it
            pytest.fail(broken, pytrace=False)

    return test


def free_port() -> int:
    """Return a free TCP port of this computer."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        found: int = probe.getsockname()[1]
        return found
