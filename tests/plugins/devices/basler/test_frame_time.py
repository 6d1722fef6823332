"""Which time stamp is chosen, and that its grade claims no more than can be checked."""

from __future__ import annotations

from typing import Any

import pytest

from sliplab.plugins.devices.basler.frame_time import Abilities, FrameStamping, choose
from tests.protocols.planning import rows

# what the camera has | its trigger | the time stamp, and its grade
BEST = """
    chunk result event latch sync_level exposure_line | hardware | chunk | hardware trigger
    chunk result event latch sync_level exposure_line | free run | chunk | exposure line
    chunk latch | hardware | chunk | device time stamps
    result latch | free run | grab result | device time stamps
    event exposure_line | free run | exposure end event | exposure line
    event | free run | host arrival | host arrival
    latch | free run | host arrival | host arrival
    exposure_line sync_level | hardware | host arrival | host arrival
    chunk | software | host arrival | host arrival
"""


@pytest.mark.parametrize(("has", "trigger", "stamp", "grade"), rows(BEST))
def test_the_best_that_the_camera_has(has: str, trigger: Any, stamp: Any, grade: Any) -> None:
    found = choose(Abilities(**dict.fromkeys(has.split(), True)), trigger)
    assert found == FrameStamping(stamp, grade)


def test_the_middle_lies_after_a_start_and_before_an_end() -> None:
    assert FrameStamping("chunk", "hardware trigger").middle_ns(1000, 30) == 1030
    assert FrameStamping("grab result", "exposure line").middle_ns(1000, 30) == 1030
    assert FrameStamping("exposure end event", "exposure line").middle_ns(1000, 30) == 970
    assert FrameStamping("host arrival", "host arrival").middle_ns(1000, 30) == 1000
