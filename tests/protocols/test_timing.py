"""Timing of a rig: what is read, what marks a start, and limits that name their key."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from sliplab.protocols.timing import WIRED, Delay, SyncGates, Timing


def test_only_a_regular_train_has_a_start_marker() -> None:
    assert Timing(code="regular").start_marker_ns(100.0) == 160e6
    assert Timing(code="lfsr").start_marker_ns(100.0) is None
    assert Timing(code="irregular").start_marker_ns(100.0) is None


@pytest.mark.parametrize(
    ("timing", "reads"),
    [
        ({}, False),
        ({"frames": "exposure line"}, False),
        ({"frames": "device time stamps"}, True),
        ({"frames": "host arrival"}, True),
        ({"arm": "host time"}, True),
    ],
)
def test_clocks_are_read_where_a_wire_is_missing(timing: dict[str, str], reads: bool) -> None:
    assert Timing.model_validate(timing).reads_clocks is reads


def test_every_grade_has_a_gate() -> None:
    gates = SyncGates()
    for grade in ("hardware trigger", "exposure line"):
        assert grade in WIRED
        assert gates.limit_s(grade) == 0.001
    assert "digital input" in WIRED
    assert gates.limit_s("digital input") < gates.limit_s("device time stamps")
    assert gates.limit_s("device time stamps") < gates.limit_s("host time")
    assert gates.limit_s("host time") < gates.limit_s("host arrival")


def test_a_delay_has_a_shortest_and_a_longest() -> None:
    with pytest.raises(ValidationError, match="must be above shortest_us"):
        Delay(shortest_us=10, longest_us=10)
    with pytest.raises(ValidationError):
        Timing.model_validate({"frames": "by eye"})
