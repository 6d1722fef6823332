"""Example drivers keep every rule; broken ones break the rule that is about their defect."""

from __future__ import annotations

import gc
import re
from typing import Any

import pytest

from sliplab.plugins.driver_kit.conformance import Case, cases
from sliplab.plugins.driver_kit.examples import arm, events, force, frames, gripper, scalar, sync
from sliplab.plugins.driver_kit.rule import Bounds
from sliplab.rigs.core.driver import Driver
from tests.plugins.devices.arms import LIMITS
from tests.plugins.driver_kit.broken import BROKEN, Broken
from tests.plugins.driver_kit.broken_values import WRONG_VALUES
from tests.plugins.driver_kit.trying import each_apart, try_all
from tests.rigs.waiting import own_address

pytestmark = pytest.mark.realtime
BOUNDS = Bounds(connect_s=2.5, call_s=1.5, news_s=2.5)
SETTINGS: dict[str, Any] = {
    "event camera": events.ExampleEventsSettings(stall_s=0.4),
    "frame camera": frames.ExampleFramesSettings(stall_s=0.4),
    "force sensor": force.ExampleForceSettings(stall_s=0.4),
    "sync box": sync.ExampleSyncSettings(stall_s=0.4),
    "gripper": gripper.ExampleGripperSettings(opening_mm=40),
    "scalar sensor": scalar.ExampleScalarSettings(stall_s=0.4),
}
EXAMPLES = [kind.DRIVER for kind in (arm, events, force, frames, sync, gripper, scalar)]


def cases_of(driver: Driver[Any]) -> list[Case]:
    def make() -> list[Case]:
        settings = SETTINGS.get(driver.kind)
        own = arm.ExampleArmSettings(host=own_address(), limits=LIMITS)
        return cases(driver, settings or own, BOUNDS)

    return each_apart(make)


@pytest.mark.quick(3)
@pytest.mark.parametrize("driver", EXAMPLES, ids=lambda driver: driver.name)
def test_an_example_keeps_every_rule(driver: Driver[Any]) -> None:
    broken, not_tried = try_all(cases_of(driver))
    assert not broken, "\n".join(broken.values())
    without_clock = {"times fall back"} if driver is scalar.DRIVER else set()
    assert set(not_tried) == without_clock


@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.quick(2)
@pytest.mark.parametrize("broken", BROKEN, ids=lambda broken: broken.driver.name)
def test_a_broken_driver_is_caught_by_the_rules_about_its_defect(broken: Broken) -> None:
    found, _ = try_all(cases_of(broken.driver))
    assert set(found) == set(broken.rules), "\n".join(found.values())
    check_message(broken, found)
    gc.collect()  # what a broken driver leaves open is closed here, where nobody minds


@pytest.mark.quick(15)
@pytest.mark.parametrize("broken", WRONG_VALUES, ids=lambda broken: broken.driver.name)
def test_a_driver_with_wrong_values_is_caught_by_the_rules_about_them(broken: Broken) -> None:
    own = [case for case in cases_of(broken.driver) if case.rule.name in broken.rules]
    found, _ = try_all(own)
    assert set(found) == set(broken.rules), "\n".join(found.values())
    check_message(broken, found)


def test_each_broken_driver_has_a_name_of_its_own() -> None:
    names = [broken.driver.name for broken in (*BROKEN, *WRONG_VALUES)]
    assert len(names) == len(set(names))


def check_message(broken: Broken, found: dict[str, str]) -> None:
    """Assert that the first rule names the driver, itself, and what is wrong."""
    message = found[broken.rules[0]]
    assert message.startswith(f"{broken.driver.name} breaks the rule '{broken.rules[0]}'")
    assert re.search(broken.seen, message.split("right:")[0])
