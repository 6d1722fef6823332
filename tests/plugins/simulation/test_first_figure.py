"""The event rate over a trial tells the story of the papers' first figure, corner by corner."""

import numpy as np
import pytest

from sliplab.plugins.simulation.devices import MockDevices, build_mock
from sliplab.plugins.simulation.settings import MockSettings
from sliplab.rigs.core.capabilities import Segment

QUIET = {"noise_hz": 0.0, "hot_pixels": 0, "readout_hz": 0}
CORNERS = [(2.4, 0.6, 0), (2.4, 1.6, 225), (3.4, 1.6, 90), (2.8, 1.0, 315), (3.4, 0.8, 180)]


def go(devices: MockDevices, x: float, y: float, depth: float, speed: float) -> None:
    devices.arm.start([Segment(devices.world.plane.pose(x, y, depth), speed)])
    while not devices.arm.progress().done:
        devices.clock.wait(0.05)


def rates(depth: float, speed: float, direction: float, seed: int) -> dict[str, float]:
    """Positive signal events a second by phase of one simulated slide, noise left out."""
    devices = build_mock(MockSettings.model_validate({"seed": 1, "event_camera": QUIET}))
    angle = np.radians(direction)
    half = 7.5 * np.array([np.cos(angle), np.sin(angle)])
    devices.arm.connect()
    go(devices, *-half, -2.0, 50.0)
    devices.begin_trial(seed)
    go(devices, *-half, depth, 2.0)
    devices.clock.wait(0.2)
    devices.events.start()
    devices.sync.start(100.0, 4321)
    times, begin = [], devices.clock.now_ns()
    devices.clock.wait(2.0)
    start = devices.clock.now_ns()
    devices.arm.start([Segment(devices.world.plane.pose(*half, depth), speed)])
    while not devices.arm.progress().done:
        devices.clock.wait(0.5)
        chunk = devices.events.read()
        true = devices.world.clocks.event_camera.to_device(chunk.t_us[chunk.p == 1] * 1000)
        times.append((true - start) * 1e-9)
    end = (devices.clock.now_ns() - start) * 1e-9
    truth, box = devices.truth(start), devices.sync.clock
    first, gross = ((box.to_device(truth[k]) - start) * 1e-9 for k in ("first_slip_ns", "gross_ns"))
    t_s = np.concatenate(times)
    third = (gross - first) / 3
    spans = {
        "settling": ((begin - start) * 1e-9, (begin - start) * 1e-9 + 0.5),
        "rest": (-1.0, 0.0),
        "loading": (0.5 * first, first),
        "early": (first, first + third),
        "late": (gross - third, gross),
        "gross": (gross, end),
    }
    return {
        name: np.count_nonzero((t_s >= a) & (t_s < b)) / (b - a) for name, (a, b) in spans.items()
    }


@pytest.mark.parametrize(("depth", "speed", "direction"), CORNERS)
def test_low_at_rest_sharp_before_slip_falling_then_low(
    depth: float, speed: float, direction: float
) -> None:
    found = rates(depth, speed, direction, seed=int(10 * depth + direction))
    # a little creep after pressing, then almost nothing
    assert found["rest"] <= found["settling"] < 0.05 * found["loading"]
    assert found["rest"] < 300
    assert found["loading"] > 5000
    assert found["loading"] > found["early"] > found["late"]
    # low in gross slip, and yet not silent
    assert 300 < found["gross"] < 0.35 * found["loading"]
