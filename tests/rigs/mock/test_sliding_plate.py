"""The plate on its slider: it slips, falls, and is caught."""

import numpy as np
import pytest

from rigs.mock.devices import MockDevices, build_mock
from tests.rigs.mock.driving import SMALL, gravity


def heights_mm(devices: MockDevices) -> tuple[np.ndarray, np.ndarray]:
    """True times, ns, and heights of the plate in all rows since the trial began."""
    track = devices.world.physics.track
    t_ns, rows = track.between(0, track.end_ns)
    return t_ns, rows[:, -1]


def test_a_gravity_trial_slips_then_falls_and_comes_again_the_same() -> None:
    devices = build_mock(SMALL)
    first = gravity(devices, 5)
    assert first["first_slip_ns"] < first["incipient_ns"] < first["gross_ns"]
    lead_s = (first["gross_ns"] - first["incipient_ns"]) * 1e-9
    assert 0.4 < lead_s < 2.0
    marker = first["images"][:, 5:45, 130:175]
    assert marker[0].max() > 150  # the ArUco marker stands in its corner
    assert not np.array_equal(marker[0] > 100, marker[-1] > 100)
    height = heights_mm(devices)[1]
    assert height.min() == pytest.approx(-25.0)
    again = gravity(devices, 5)
    assert np.array_equal(first["images"], again["images"])
    assert np.array_equal(first["events"].t_us, again["events"].t_us)
    assert first["per_papilla_ns"] == again["per_papilla_ns"]


def test_catching_stops_the_plate_where_it_is() -> None:
    devices = build_mock(SMALL)
    devices.begin_trial(1)
    devices.plate.act("raise", 0.0)
    devices.plate.act("release", 0.0)
    devices.clock.wait(0.03)
    devices.plate.act("catch", 0.0)
    devices.clock.wait(1.0)
    devices.world.advance()
    t_ns, height = heights_mm(devices)
    assert np.all(height[t_ns >= 30_000_000] == height[-1])
    assert height[-1] == pytest.approx(-0.5 * 9810 * 0.03**2, rel=0.1)
    devices.plate.act("raise", 0.5)
    devices.clock.wait(1.0)
    devices.world.advance()
    assert heights_mm(devices)[1][-1] == 0.0
