"""The simulated arm and the person beside it: segments as they end, refusals, a changed mass."""

from typing import Any

import pytest

from sliplab.plugins.simulation.devices import build_mock
from sliplab.rigs.core.capabilities import ArmFault, ArmState, RigError, Segment
from tests.plugins.simulation.driving import SMALL


@pytest.fixture
def devices() -> Any:
    """A small simulated rig."""
    return build_mock(SMALL)


def test_the_arm_reports_its_segments_as_they_end(devices: Any) -> None:
    with pytest.raises(ArmFault, match="disconnected"):
        devices.arm.start([])
    devices.arm.connect()
    pose = devices.world.plane.pose
    devices.arm.start([Segment(pose(0, 0, -50), 10.0), Segment(pose(5, 0, -50), 5.0)])
    assert devices.arm.state() is ArmState.MOVING
    with pytest.raises(RigError, match="moving"):
        devices.arm.start([])
    devices.clock.wait(1.5)
    progress = devices.arm.progress()
    assert len(progress.finished) == 1
    assert not progress.done
    start, end = progress.finished[0]
    assert end - start == pytest.approx(1e9, rel=1e-4)
    devices.clock.wait(0.5)
    progress = devices.arm.progress()
    assert progress.done
    assert progress.finished[1][0] == progress.finished[0][1]
    assert devices.arm.now_ns() == progress.finished[1][1]
    assert devices.arm.pose().xyz_mm == pytest.approx(pose(5, 0, -50).xyz_mm)
    devices.arm.start([Segment(pose(0, 0, -50), 5.0)])
    devices.clock.wait(0.5)
    devices.arm.stop()
    devices.arm.stop()
    assert devices.arm.state() is ArmState.READY
    assert devices.arm.pose().xyz_mm == pytest.approx(pose(2.5, 0, -50).xyz_mm)
    assert devices.arm.progress().finished == ()


def test_a_tool_that_looks_away_is_refused_near_the_plate(devices: Any) -> None:
    devices.arm.connect()
    place = devices.world.plane.pose(0, 0, 0)
    with pytest.raises(ArmFault, match="rotated"):
        devices.arm.start([Segment(type(place)(place.xyz_mm, (0.0, 0.0, 0.0)), 5.0)])


def test_a_trial_does_not_begin_in_motion(devices: Any) -> None:
    devices.arm.connect()
    devices.arm.start([Segment(devices.world.plane.pose(0, 0, -50), 1.0)])
    with pytest.raises(RigError, match="moving"):
        devices.begin_trial(1)


def test_the_operator_mounts_a_mass_and_clears_a_stop(devices: Any) -> None:
    assert devices.operator.ask("changeover", "Mount the plate.", "0.245 kg")
    assert devices.plate.mass_kg() == 0.245
    assert devices.operator.ask("clean", "Clean the skin.", "")
    assert devices.plate.mass_kg() == 0.245
    with pytest.raises(RigError, match="expected a mass such as"):
        devices.operator.ask("changeover", "Mount the plate.", "heavy")
    assert [asked.task for asked in devices.operator.asked] == ["changeover", "clean", "changeover"]


@pytest.mark.parametrize(
    ("action", "seconds"), [("drop", 1.0), ("release", -1.0), ("catch", float("nan"))]
)
def test_the_plate_does_nothing_that_is_not_simulated(action: Any, seconds: float) -> None:
    devices = build_mock(SMALL)
    with pytest.raises(RigError, match="is not simulated"):
        devices.plate.act(action, seconds)


def test_a_task_that_is_not_simulated_is_not_confirmed() -> None:
    with pytest.raises(RigError, match="task 'sweep the floor' is not simulated"):
        build_mock(SMALL).operator.ask("sweep the floor", "Sweep the floor.", "done")
