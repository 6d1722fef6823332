"""Which packets of a Universal Robots controller count as poses, fed by hand."""

from __future__ import annotations

import time

import pytest

from sliplab.plugins.devices.ur.driver import UrArm
from sliplab.plugins.devices.ur.rtde import Packet, RtdeError
from sliplab.plugins.devices.ur.settings import SILENCE_S
from sliplab.rigs.core.fakes import HOME
from sliplab.rigs.core.pose_stream import PoseJumpError
from tests.plugins.devices.conftest import ur_settings

START_NS = 10**12
PERIOD_S = 0.008


class Fed:
    """An arm that is given packets, 8 ms apart on the host's clock."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.arm, self.number = UrArm(ur_settings("127.0.0.1")), 0
        self._now_ns = START_NS
        monkeypatch.setattr(time, "monotonic_ns", lambda: self._now_ns)

    def take(self, x_mm: float, t_s: float | None = None) -> None:
        self.number += 1
        self._now_ns += round(PERIOD_S * 1e9)
        t_s = self.number * PERIOD_S if t_s is None else t_s
        pose, still = (x_mm / 1000, 0.0, 0.3, 3.14159, 0.0, 0.0), (0.0,) * 6
        self.arm._take(Packet(self._now_ns, (t_s, *pose, *still, *still, 0, 3, 0, 2, 7, 1.0, 0)))

    @property
    def poses(self) -> list[float]:
        return [float(x) for x in self.arm.read_poses().xyz_mm[:, 0].round(3)]


@pytest.fixture
def fed(monkeypatch: pytest.MonkeyPatch) -> Fed:
    return Fed(monkeypatch)


def test_pose_that_the_arm_cannot_have_reached_is_dropped(fed: Fed) -> None:
    for x_mm in (400.0, 400.1, 1399.0, 400.2):
        fed.take(x_mm)
    assert fed.poses == [400.0, 400.1, 400.2]
    assert fed.arm.describe() == {"poses_missing": 1, "poses_implausible": 1}


def test_arm_that_stays_where_it_jumped_is_a_fault(fed: Fed) -> None:
    fed.take(400.0)
    fed.take(1399.0)
    with pytest.raises(PoseJumpError, match=r"jumped by 999\.0 mm"):
        fed.take(1399.0)


def test_clock_that_stops_is_silence_although_packets_come(fed: Fed) -> None:
    fed.take(HOME.xyz_mm[0])
    for _ in range(round(SILENCE_S / PERIOD_S)):
        fed.take(HOME.xyz_mm[0] + 0.1, PERIOD_S)
    assert fed.poses == [HOME.xyz_mm[0]]
    with pytest.raises(RtdeError, match="its clock has stopped for 1 s"):
        fed.take(HOME.xyz_mm[0] + 0.1, PERIOD_S)
