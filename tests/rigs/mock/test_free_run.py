"""The cycles of a camera that runs by itself: numbers and times agree, whatever its clock does."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplab.rigs.mock.settings import Clocks, FrameCamera, MockSettings
from sliplab.rigs.mock.sync import FreeRun
from sliplab.rigs.mock.world import World

CASES: tuple[list[dict[str, Any]], ...] = (
    [],
    [{"kind": "clock_drift", "ppm": 9000, "since": "trial", "at_s": 1.0}],
    [
        {"kind": "clock_drift", "ppm": -9000, "since": "trial", "at_s": 0.0},
        {"kind": "clock_jump", "seconds": -3.0, "since": "trial", "at_s": 0.4},
        {"kind": "clock_drift", "ppm": 500, "since": "trial", "at_s": 2.5},
        {"kind": "clock_restart", "since": "trial", "at_s": 3.0},
    ],
)


def running(faults: list[dict[str, Any]], rate_hz: float = 100.0, after_s: float = 0.7) -> FreeRun:
    """A camera that was started some time into a trial."""
    world = World(
        MockSettings.model_validate(
            {
                "clocks": Clocks(frame_camera_ppm=20_000).model_dump(),
                "frame_camera": FrameCamera(rate_hz=rate_hz).model_dump(),
                "faults": [{**fault, "device": "frame_camera"} for fault in faults],
            }
        )
    )
    camera = FreeRun(world)
    world.begin_trial(5)
    world.pass_time(round(after_s * 1e9))
    camera.start()
    return camera


@pytest.mark.parametrize("faults", CASES)
@settings(max_examples=20, deadline=None)
@given(tick=st.integers(0, 1000), rate_hz=st.sampled_from([24.0, 100.0, 997.3]))
def test_a_tick_is_where_its_time_is(
    faults: list[dict[str, Any]], tick: int, rate_hz: float
) -> None:
    camera = running(faults, rate_hz)
    at = int(camera.true_ns(np.array([tick]))[0])
    assert camera.tick_at(at) == tick
    assert camera.tick_at(at + 1) == tick + 1
    assert camera.ticks(0, at).tolist() == list(range(tick + 1))
    assert camera.ticks(tick, at - 1).tolist() == []


@pytest.mark.parametrize("faults", CASES)
def test_cycles_are_counted_by_the_cameras_own_clock(faults: list[dict[str, Any]]) -> None:
    camera = running(faults)
    true_ns = camera.true_ns(np.arange(600))
    assert 700_000_000 <= true_ns[0] < 710_300_000
    world = camera._world
    clock = world.clocks.frame_camera
    shown = clock.to_reference(true_ns)
    jumps = np.abs(np.diff(shown) - 10_000_000) > 1_000_000
    assert jumps.sum() == sum(fault["kind"] == "clock_restart" for fault in faults)
    # two drifts in one second are a product in the cycles and a sum in what the clock shows
    assert np.diff(shown)[~jumps] == pytest.approx(10_000_000, abs=2500)


def test_nothing_comes_before_a_start_or_after_a_stop() -> None:
    camera = running([])
    camera._world.pass_time(1_000_000_000)
    camera.stop()
    assert camera.ticks(0, 9_000_000_000).size == pytest.approx(100, abs=3)
    camera._world.begin_trial(6)
    assert camera.ticks(0, 9_000_000_000).size == 0
    assert camera.tick_at(5) == 0
    assert not camera.bits(np.arange(3)).any()
