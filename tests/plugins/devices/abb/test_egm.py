"""Which packets of a UDP port are poses of the controller, and how the others are counted."""

from __future__ import annotations

import math
import socket
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from abb_robot_client._egm_protobuf import egm_pb2

from sliplab.plugins.devices.abb import egm
from sliplab.plugins.devices.abb.egm import EgmCounts, EgmFault, EgmPose, EgmReceiver
from sliplab.rigs.core.capabilities import Pose
from tests.plugins.devices.conftest import egm_message
from tests.rigs.waiting import own_address

ROBOT = own_address()
HERE = Pose((400.0, 1.0, 300.0), (180.0, 0.0, 0.0))
Take = Callable[..., EgmPose | None]


def packet(number: int, t_s: float | None, pose: Pose = HERE) -> egm_pb2.EgmRobot:
    return egm_message(number, t_s, pose)


@pytest.fixture
def receiver() -> Iterator[EgmReceiver]:
    made = EgmReceiver(ROBOT, 6510, ROBOT)
    yield made
    made.close()


@pytest.fixture
def take(receiver: EgmReceiver) -> Iterator[Take]:
    """Sends one packet to the receiver and returns what it makes of it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as robot:
        robot.bind((ROBOT, 0))

        def send(data: egm_pb2.EgmRobot | bytes, link: socket.socket = robot) -> EgmPose | None:
            raw = data if isinstance(data, bytes) else data.SerializeToString()
            link.sendto(raw, (ROBOT, 6510))
            return receiver.read(5.0)

        yield send


def test_a_packet_of_the_controller_is_a_pose(take: Take, receiver: EgmReceiver) -> None:
    came = take(packet(1, 12.345678))
    assert came.t_ns == 12_345_678_000
    assert came.measured.xyz_mm == HERE.xyz_mm
    assert receiver.counts == EgmCounts()


FAR = [packet(1, 1.0, Pose((x, 0.0, 0.0), HERE.rotvec_deg)) for x in (math.nan, math.inf, 1e9)]


@pytest.mark.parametrize("data", [b"", b"\xff" * 40, b"hello", *FAR])
def test_what_is_no_packet_is_dropped_and_the_next_one_is_read(
    take: Take, receiver: EgmReceiver, data: egm_pb2.EgmRobot | bytes
) -> None:
    assert take(data) is None
    assert receiver.counts == EgmCounts(malformed=1)
    assert take(packet(2, 2.0)) is not None


def test_a_rotation_that_is_none_is_dropped(take: Take, receiver: EgmReceiver) -> None:
    still = packet(1, 1.0)
    still.feedBack.cartesian.orient.u1 = 0.0
    still.feedBack.cartesian.orient.u0 = 0.0
    assert take(still) is None
    assert receiver.counts == EgmCounts(malformed=1)


def test_other_senders_are_not_believed(take: Take, receiver: EgmReceiver) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((own_address(), 0))
        assert take(packet(1, 1.0, Pose((9999.0, 9999.0, 9999.0), HERE.rotvec_deg)), other) is None
        assert take(b"\xff" * 40, other) is None
    assert receiver.counts == EgmCounts(foreign=2)


def test_lost_late_and_doubled_packets_are_counted(take: Take, receiver: EgmReceiver) -> None:
    assert take(packet(10, 1.000)) is not None
    assert take(packet(14, 1.016)) is not None
    assert receiver.counts == EgmCounts(lost=3)
    assert take(packet(12, 1.008)) is None
    assert take(packet(14, 1.016)) is None
    assert receiver.counts == EgmCounts(lost=3, late=2)
    assert take(packet(0, 1.500)) is not None  # counted anew with the next program
    assert take(packet(1, 1.504)) is not None
    assert receiver.counts == EgmCounts(lost=3, late=2)


@pytest.mark.parametrize(("number", "t_s"), [(2, 95.0), (2, 99.999), (0, 95.0)])
def test_a_clock_that_goes_back_is_a_fault(take: Take, number: int, t_s: float) -> None:
    assert take(packet(1, 100.0)) is not None
    with pytest.raises(EgmFault, match=rf"clock jumped back by {100 - t_s:.3f} s"):
        take(packet(number, t_s))


def test_packets_without_time_are_a_fault(take: Take) -> None:
    with pytest.raises(EgmFault, match=r"carry no time.*RobotWare 6\.07"):
        take(packet(1, None))


AHEAD = Pose((1399.0, 1.0, 300.0), HERE.rotvec_deg)
TURNED = Pose(HERE.xyz_mm, (90.0, 0.0, 0.0))


@pytest.mark.parametrize("pose", [AHEAD, TURNED])
def test_pose_that_the_arm_cannot_have_reached_is_dropped(
    take: Take, receiver: EgmReceiver, pose: Pose
) -> None:
    assert take(packet(1, 1.000)) is not None
    for number in range(1, 10):
        assert take(packet(2 * number, 1 + 0.008 * number, pose)) is None
        came = take(packet(2 * number + 1, 1.004 + 0.008 * number))
        assert came.measured.xyz_mm == HERE.xyz_mm
    assert receiver.counts == EgmCounts(implausible=9, lost=9)


def test_planned_pose_is_checked_too(take: Take, receiver: EgmReceiver) -> None:
    assert take(packet(1, 1.000)) is not None
    jumped = packet(2, 1.004)
    jumped.planned.cartesian.CopyFrom(packet(2, 1.004, AHEAD).feedBack.cartesian)
    assert take(jumped) is None
    assert receiver.counts == EgmCounts(implausible=1)


def test_arm_that_stays_where_it_jumped_is_a_fault(take: Take) -> None:
    assert take(packet(1, 1.000)) is not None
    assert take(packet(2, 1.004, AHEAD)) is None
    with pytest.raises(EgmFault, match=r"its pose jumped by 999\.0 mm"):
        take(packet(3, 1.008, AHEAD))


def test_pose_is_not_believed_for_a_time_that_has_not_passed(take: Take, receiver: Any) -> None:
    assert take(packet(1, 1.000)) is not None
    assert take(packet(2, 1.990, AHEAD)) is None  # at 1 m/s, it says
    assert take(packet(3, 3600.0)) is None
    assert take(packet(4, 2.0**62)) is None
    assert take(packet(5, 1.016)) is not None
    assert receiver.counts == EgmCounts(implausible=2, malformed=1, lost=3)


def test_clock_that_stays_ahead_is_a_fault(take: Take) -> None:
    assert take(packet(1, 1.000)) is not None
    assert take(packet(2, 11.004)) is None
    with pytest.raises(EgmFault, match=r"its clock jumped by 10\.0"):
        take(packet(3, 11.008))


def test_slow_motion_after_lost_packets_is_believed(take: Take) -> None:
    assert take(packet(1, 1.0)) is not None
    assert take(packet(26, 1.1, Pose((404.0, 1.0, 300.0), HERE.rotvec_deg))) is not None


@pytest.mark.parametrize(
    ("numbers", "lost"),
    [
        ([2**32 - 2, 2**32 - 1, 0, 1], 0),
        ([2**32 - 2, 1, 2], 2),
        ([7, 2**31, 2**31 + 1], 0),
        ([7, 2**32 - 1, 0], 0),
        ([3_000_000_000, 0, 1], 0),
    ],
)
def test_sequence_numbers_wrap_and_restart(
    take: Take, receiver: EgmReceiver, numbers: list[int], lost: int
) -> None:
    for at, number in enumerate(numbers):
        assert take(packet(number, 1.0 + 0.012 * at)) is not None
    assert receiver.counts == EgmCounts(lost=lost)


class _Preempted:
    """The clocks of a process that once loses its core for 50 ms while it reads them."""

    def __init__(self) -> None:
        self.loses, self._lost_ns = False, 0

    def monotonic_ns(self) -> int:
        return time.monotonic_ns() + self._lost_ns

    def time_ns(self) -> int:
        self._lost_ns += 50_000_000 * self.loses
        self.loses = False
        return time.time_ns() + self._lost_ns


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux stamps packets")
def test_arrivals_are_those_of_the_kernel_also_where_a_process_loses_its_core(
    take: Take, monkeypatch: pytest.MonkeyPatch
) -> None:
    clocks = _Preempted()
    monkeypatch.setattr(egm, "time", clocks)
    first = take(packet(1, 0.1))
    clocks.loses = True
    second = take(packet(2, 0.104))
    assert first is not None
    assert second is not None
    assert first.host_ns < second.host_ns
