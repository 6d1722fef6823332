"""The wrench of a UR arm on a fake: in the arm's own stream, by the arm's own clock."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sliplab.plugins.devices.ur import WRENCH_DRIVER
from sliplab.plugins.devices.ur.rtde import OUTPUTS
from sliplab.plugins.devices.ur.settings import UrWrenchSettings
from sliplab.rigs.core.capabilities import ForceSensor, RigError
from sliplab.rigs.core.fakes import Kind
from sliplab.rigs.core.plate_frame import PlateFrame
from tests.patching import loose
from tests.plugins.devices.conftest import MakeUr
from tests.rigs.waiting import fault_of, gather

pytestmark = pytest.mark.realtime


def test_it_reads_the_wrench_with_the_arms_times(ur_pair: MakeUr) -> None:
    arm, robot = ur_pair(connected=False, measures=True)
    robot.program.tool_load = lambda t_s: (math.sin(t_s), -2.0, 5.0, 0.1, 0.2, 0.3)
    sensor = WRENCH_DRIVER.build(UrWrenchSettings(), arm)
    assert isinstance(sensor, ForceSensor)
    assert sensor.grade == "arm clock"
    arm.connect()
    sensor.connect()
    assert len(sensor.read()) == 0
    arm.read_poses()
    sensor.start()
    found = gather(sensor.read, 40)
    poses = arm.read_poses()
    assert np.all(np.diff(found.t_ns) == 8_000_000)
    assert np.isin(found.t_ns, poses.t_ns).all()
    assert np.allclose(found.force_n[:, 0], np.sin(found.t_ns / 1e9), atol=1e-6)
    assert np.allclose(found.force_n[:, 1:], [-2.0, 5.0])
    assert np.allclose(found.torque_nm, [0.1, 0.2, 0.3])


def test_the_plates_reaction_is_the_force_on_the_plate(ur_pair: MakeUr) -> None:
    frame = PlateFrame.taught([(400, 0, 300), (400, 60, 300), (400, 0, 360)])
    pushed = frame.axes.T @ np.array([0.5, 0.0, 3.0])  # on the plate, in the base
    arm, robot = ur_pair(connected=False, measures=True)
    robot.program.tool_load = lambda t_s: (*(-pushed).tolist(), 0.0, 0.0, 0.0)
    sensor = WRENCH_DRIVER.build(UrWrenchSettings(), arm)
    arm.connect()
    sensor.start()
    on_plate = np.array(frame.force_matrix(sensor.mounting)) @ gather(sensor.read, 3).force_n[-1]
    assert on_plate == pytest.approx([0.5, 0.0, 3.0], abs=1e-9)


def test_zero_takes_the_load_away(ur_pair: MakeUr) -> None:
    arm, robot = ur_pair(connected=False, measures=True)
    robot.program.tool_load = lambda t_s: (0.0, 0.0, 5.0, 0.0, 0.0, 0.0)
    sensor = WRENCH_DRIVER.build(UrWrenchSettings(bias="session"), arm)
    arm.connect()
    sensor.connect()
    sensor.start()
    assert gather(sensor.read, 10).force_n[-1] == pytest.approx([0.0, 0.0, 0.0])
    assert robot.program.refused == []


def test_a_lost_link_is_a_fault(ur_pair: MakeUr) -> None:
    arm, robot = ur_pair(connected=False, measures=True)
    sensor = WRENCH_DRIVER.build(UrWrenchSettings(), arm)
    with pytest.raises(RigError, match="the arm that measures it is not connected"):
        sensor.connect()
    arm.connect()
    sensor.start()
    gather(sensor.read, 5)
    robot.inject(Kind.LINK_CUT)
    fault_of(sensor.read, 5.0)


def test_an_arm_without_it_is_asked_for_nothing_more(ur_pair: MakeUr) -> None:
    _, robot = ur_pair()
    assert list(OUTPUTS) in [client._names for client in robot._clients]


def test_another_arm_has_none() -> None:
    with pytest.raises(RigError, match="needs the arm of driver: ur"):
        loose(WRENCH_DRIVER).build(UrWrenchSettings(), object())


def test_an_arm_that_was_built_without_it_has_none(ur_pair: MakeUr) -> None:
    arm, _ = ur_pair(connected=False)
    with pytest.raises(RigError, match="was built without its wrench"):
        WRENCH_DRIVER.build(UrWrenchSettings(), arm)
