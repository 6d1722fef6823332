"""Rules in words: in the reference, and in a failure."""

from __future__ import annotations

from dataclasses import replace

import pytest

from sliplab.plugins.driver_kit import (
    arm_rules,
    gripper_rules,
    motion_rules,
    stream_rules,
    sync_rules,
)
from sliplab.plugins.driver_kit.arm_bench import ArmBench
from sliplab.plugins.driver_kit.conformance import cases, conformance
from sliplab.plugins.driver_kit.examples import arm, events, frames
from sliplab.plugins.driver_kit.rule import Bounds, NotTried, Rule, RuleBroken, RuleViolation
from sliplab.plugins.driver_kit.rule_tables import rule_tables
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.driver import FrameCameraDriver
from tests.plugins.devices.arms import LIMITS
from tests.rigs.waiting import own_address

KINDS = (
    arm_rules.RULES,
    motion_rules.RULES,
    stream_rules.RULES,
    stream_rules.CLOCK_RULES,
    stream_rules.HOST_RULES,
    stream_rules.EVENT_RULES,
    stream_rules.FRAME_RULES,
    stream_rules.FORCE_RULES,
    sync_rules.RULES,
    gripper_rules.RULES,
)


def arm_settings() -> arm.ExampleArmSettings:
    return arm.ExampleArmSettings(host=own_address(), limits=LIMITS)


def test_the_reference_lists_every_rule() -> None:
    listed = [line for line in rule_tables().splitlines() if line.startswith("| ")]
    rows = [f"| {rule.name} | {rule.right} |" for rules in KINDS for rule in rules.all]
    assert [line for line in listed if line in rows] == rows


def test_each_kind_has_the_rules_that_apply_to_it() -> None:
    names = [case.rule.name for case in cases(frames.DRIVER, frames.ExampleFramesSettings())]
    assert "region" in names
    assert "overload" not in names
    assert "stop while moving" not in names
    assert len(names) == len(set(names))


def test_a_failure_names_the_rule_what_was_seen_and_what_would_be_right() -> None:
    with (
        ArmBench(arm.DRIVER, arm_settings(), Bounds()) as bench,
        pytest.raises(RuleBroken) as error,
    ):
        Rule("poise", "the arm keeps its poise", _dances).hold("my_arm", bench)
    assert str(error.value).splitlines() == [
        "my_arm breaks the rule 'poise'",
        "  seen:  the arm danced",
        "  right: the arm keeps its poise",
    ]


def test_a_fault_that_the_driver_made_up_names_the_call() -> None:
    def check(bench: ArmBench) -> None:
        def refuse() -> None:
            raise RigError("arm", "is not in the mood")

        bench.call("start", refuse)

    with (
        ArmBench(arm.DRIVER, arm_settings(), Bounds()) as bench,
        pytest.raises(RuleBroken, match="start raised RigError where nothing was wrong: arm: is"),
    ):
        Rule("poise", "the arm keeps its poise", check).hold("my_arm", bench)


def test_another_exception_than_a_rig_error_is_a_finding() -> None:
    with (
        ArmBench(arm.DRIVER, arm_settings(), Bounds()) as bench,
        pytest.raises(RuleViolation, match=r"stop raised ZeroDivisionError.*which is no RigError"),
    ):
        bench.call("stop", lambda: 1 // 0)


def test_a_driver_without_a_fake_is_not_tried() -> None:
    silent: FrameCameraDriver = replace(frames.DRIVER, fake=None)
    with pytest.raises(NotTried, match="example_frames declares no `fake`"):
        cases(silent, frames.ExampleFramesSettings())[0]()
    camera = replace(events.DRIVER, fake=None)
    with pytest.raises(NotTried, match="declares no `fake`"):
        cases(camera, events.ExampleEventsSettings())[0]()


def test_limits_in_the_plates_frame_are_refused_with_what_to_write() -> None:
    plate = {"centre_mm": (0, 0, 0), "right_mm": (10, 0, 0), "above_mm": (0, 10, 0)}
    settings = arm.ExampleArmSettings(
        host=own_address(), limits={**LIMITS, "frame": "plate", "plate": plate}
    )
    with pytest.raises(ValueError, match=r"limits\.frame: must be base"):
        cases(arm.DRIVER, settings)[0]()


def test_a_failure_in_pytest_is_the_message_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    silly = Rule("poise", "the arm keeps its poise", _dances)
    monkeypatch.setattr(arm_rules.RULES, "all", [silly])
    monkeypatch.setattr(motion_rules.RULES, "all", [])
    test = conformance(arm.DRIVER, arm_settings())
    (case,) = cases(arm.DRIVER, arm_settings())
    with pytest.raises(pytest.fail.Exception, match="breaks the rule 'poise'") as error:
        test(case)
    assert error.value.pytrace is False


def _dances(bench: ArmBench) -> None:
    raise RuleViolation("the arm danced")
