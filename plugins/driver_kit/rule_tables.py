"""The rules for drivers as tables, for the documentation."""

from __future__ import annotations

from typing import Any

from sliplab.plugins.driver_kit import (
    arm_rules,
    gripper_rules,
    motion_rules,
    stream_rules,
    sync_rules,
)
from sliplab.plugins.driver_kit.rule import Rules

_RULES: dict[str, tuple[Rules[Any], ...]] = {
    "Arms": (arm_rules.RULES, motion_rules.RULES),
    "Cameras, sensors and sync boxes": (stream_rules.RULES,),
    "Cameras with a clock, and force sensors": (stream_rules.CLOCK_RULES,),
    "Frame cameras and sensors": (stream_rules.HOST_RULES,),
    "Event cameras": (stream_rules.EVENT_RULES,),
    "Frame cameras": (stream_rules.FRAME_RULES,),
    "Force sensors": (stream_rules.FORCE_RULES,),
    "Sync boxes": (sync_rules.RULES,),
    "Grippers": (gripper_rules.RULES,),
}


def rule_tables() -> str:
    """Return a Markdown section with a table of rules for each kind of device."""
    sections = []
    for title, rules in _RULES.items():
        rows = [f"| {rule.name} | {rule.right} |" for each in rules for rule in each.all]
        sections.append(
            "\n".join([f"## {title}", "", "| rule | right is |", "| --- | --- |", *rows])
        )
    return "\n\n".join(sections) + "\n"
