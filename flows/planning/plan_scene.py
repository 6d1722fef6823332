"""What a simulated rig makes of a plan: its level of physics, and the slip to expect."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sliplab.protocols import Plan
from sliplab.rigs.levels import Choice, choose_level, slip_expected
from sliplab.rigs.rig_file import RigFile


@dataclass(frozen=True)
class Scene:
    """The level, why, and `rigs.levels.slip_expected`."""

    choice: Choice
    expected: dict[str, Any] | None

    def as_json(self) -> dict[str, Any]:
        """As part of the plan's JSON."""
        return {
            "level": self.choice.name,
            "reason": self.choice.reason,
            "expected": self.expected,
        }

    def as_pairs(self) -> dict[str, str]:
        """For a person to read."""
        pairs = {"physics": f"{self.choice.name}: {self.choice.reason}"}
        if self.expected is not None:
            for key, title in (
                ("first_slip_s", "first slip after the start (s)"),
                ("incipient_s", "incipient slip lasts (s)"),
            ):
                low, high = self.expected[key]
                pairs[title] = f"{low:.2f} to {high:.2f} (simulated, friction taken as even)"
        return pairs


def scene_of(rig: RigFile, plan: Plan) -> Scene | None:
    """None for a real rig."""
    choice = choose_level(rig, plan)
    return None if choice is None else Scene(choice, slip_expected(rig, plan))
