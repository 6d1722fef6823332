"""The plate on its slider: it slips, falls, and is caught."""

from typing import Any

import numpy as np
import pytest

from benchmarks.holds import run
from sliplab.plugins.simulation.devices import MockDevices, build_mock
from sliplab.protocols import Plan, PlannedTrial
from sliplab.protocols.plan import load_plan
from sliplab.rigs.rig_file import load_rig_file
from tests.conftest import ROOT
from tests.plugins.simulation.driving import SMALL, gravity


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


QUARTER_MM = 0.025
"""A quarter of the 2 px at which a papilla counts as slipped, at 20 px/mm."""
HEAVY = {"gravity": "mass=0.245kg", "disturbance": "disturbance=100", "pilot_gravity": "0.245kg"}


def hold_still(plan: Plan, trial: PlannedTrial) -> dict[str, Any]:
    """Run a trial on the simulated rig, as a campaign's first attempt, and check its hold."""
    truth = run(load_rig_file(ROOT / "rigs" / "rehearsal.yaml")[0], plan, trial)
    held = truth["from_hold"]
    assert max(held["hold_slip_mm"]) < QUARTER_MM, trial.id
    assert held["first_slip_ns"] > truth["reference_ns"], trial.id
    assert held["reference_ns"] == pytest.approx(truth["reference_ns"] - 2e9, abs=1e7)
    for onset in ("incipient_ns", "gross_ns"):  # where displacements count from does not matter
        assert held[onset] == pytest.approx(truth[onset], abs=1e6)
    return held


@pytest.mark.long
@pytest.mark.parametrize("name", HEAVY)
def test_the_heaviest_trials_of_shipped_protocols_hold_still(name: str) -> None:
    plan = load_plan(ROOT / "protocols" / f"{name}.yaml")
    heavy = [trial for trial in plan if HEAVY[name] in trial.id]
    for trial in heavy[:: len(heavy) // 3]:
        hold_still(plan, trial)


@pytest.mark.long
@pytest.mark.parametrize("name", HEAVY)
def test_all_trials_of_shipped_protocols_hold_still(name: str) -> None:
    plan = load_plan(ROOT / "protocols" / f"{name}.yaml", ["disturbance=125"] * (name[0] == "d"))
    for trial in plan:
        hold_still(plan, trial)


def test_the_truth_from_the_hold_sees_a_slip_that_the_truth_from_the_motion_hides() -> None:
    devices = build_mock(SMALL)
    devices.world.mass_kg = 0.26
    gravity(devices, 5)
    track = devices.world.physics.track
    t_ns, rows = track.between(0, track.end_ns)
    released = int(t_ns[np.flatnonzero(rows[:, -1] < 0.0)[0]])
    motion = released + 2_000_000_000
    found = devices.truth(motion, released)
    held = found["from_hold"]
    n = len(held["per_papilla_ns"])
    tips = track.at(np.array([released, motion]))[:, : 2 * n].reshape(2, n, 2)
    np.testing.assert_allclose(held["hold_slip_mm"], np.linalg.norm(tips[1] - tips[0], axis=1))
    threshold = 2.0 / SMALL.frame_camera.px_per_mm
    assert max(held["hold_slip_mm"]) > 0.2 * threshold
    assert held["first_slip_ns"] < found["reference_ns"] <= found["first_slip_ns"]
    assert held["incipient_ns"] <= found["incipient_ns"]
