"""Which time stamp is chosen, and that its grade claims no more than can be checked."""

from __future__ import annotations

from typing import Any

import pytest

from sliplab.rigs.devices.basler.frame_time import Abilities, FrameStamping, choose

ALL = Abilities(
    chunk=True, result=True, event=True, latch=True, sync_level=True, exposure_line=True
)


@pytest.mark.parametrize(
    ("has", "trigger", "expected"),
    [
        (ALL, "hardware", FrameStamping("chunk", "hardware trigger")),
        (ALL, "free run", FrameStamping("chunk", "exposure line")),
        (
            Abilities(chunk=True, latch=True),
            "hardware",
            FrameStamping("chunk", "device time stamps"),
        ),
        (
            Abilities(result=True, latch=True),
            "free run",
            FrameStamping("grab result", "device time stamps"),
        ),
        (
            Abilities(event=True, exposure_line=True),
            "free run",
            FrameStamping("exposure end event", "exposure line"),
        ),
        (Abilities(event=True), "free run", FrameStamping("host arrival", "host arrival")),
        (Abilities(latch=True), "free run", FrameStamping("host arrival", "host arrival")),
        (
            Abilities(exposure_line=True, sync_level=True),
            "hardware",
            FrameStamping("host arrival", "host arrival"),
        ),
        (Abilities(chunk=True), "software", FrameStamping("host arrival", "host arrival")),
    ],
)
def test_the_best_that_the_camera_has(
    has: Abilities, trigger: Any, expected: FrameStamping
) -> None:
    assert choose(has, trigger) == expected


def test_the_middle_lies_after_a_start_and_before_an_end() -> None:
    assert FrameStamping("chunk", "hardware trigger").middle_ns(1000, 30) == 1030
    assert FrameStamping("grab result", "exposure line").middle_ns(1000, 30) == 1030
    assert FrameStamping("exposure end event", "exposure line").middle_ns(1000, 30) == 970
    assert FrameStamping("host arrival", "host arrival").middle_ns(1000, 30) == 1000
