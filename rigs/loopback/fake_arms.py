"""The stand-in that belongs to an arm's settings, listening where the driver will look."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from sliplab.rigs.core.capabilities import Pose
from sliplab.rigs.core.fake_faults import Kind
from sliplab.rigs.core.fake_motion import StraightMotion
from sliplab.rigs.devices.settings import ArmSettings
from sliplab.rigs.devices.ur.settings import UrSettings

REACH_MM = 2_000.0
"""Limits of the stand-in itself; those of the rig file are the driver's to hold."""


class StandingArm(Protocol):
    """A stand-in of an arm's controller."""

    def start(self) -> None:
        """Open its ports. Raises OSError."""

    def happen(self, kind: Kind) -> None:
        """Make something go wrong now."""

    def restore(self) -> None:
        """A person has put everything right."""

    def pose(self) -> Pose:
        """Where its tool centre point is now."""

    def moving(self) -> bool:
        """Whether it is on its way now."""

    def close(self) -> None:
        """Give its ports back."""


@dataclass(frozen=True)
class DrivenClock:
    """A controller's clock that somebody else drives."""

    seconds: Callable[[], float]
    rate: float = 1.0

    def now_s(self) -> float:
        """The controller's time, s."""
        return self.seconds()


def standing_arm(
    settings: ArmSettings,
    motion: StraightMotion,
    now_s: Callable[[], float],
    sync: Callable[[float], bool],
) -> StandingArm:
    """A stand-in for the arm that `settings` describe, started.

    Args:
        motion: where its tool centre point is.
        now_s: its controller's clock, s.
        sync: level of the sync line at a time of that clock.

    Raises:
        OSError: a port is taken.
    """
    arm: StandingArm
    clock = DrivenClock(now_s)
    if isinstance(settings, UrSettings):
        from sliplab.rigs.devices.ur.fake import UrStandIn

        bit = 1 << settings.sync_input
        arm = UrStandIn(
            settings.host,
            motion,
            cycle_hz=settings.frequency_hz,
            digital_inputs=lambda t_s: bit if sync(t_s) else 0,
            reach_mm=REACH_MM,
            clock=clock,
        )
    elif settings.driver == "abb":
        from sliplab.rigs.devices.abb.fake import AbbStandIn

        arm = AbbStandIn(
            settings.host,
            settings.rws_port,
            ("127.0.0.1", settings.egm_port),
            motion,
            egm_point=settings.egm_point,
            clock=clock,
        )
    else:
        from sliplab.rigs.devices.abb.fake_socket import RapidStandIn

        arm = RapidStandIn(settings.host, settings.port, motion=motion, clock=clock)
    arm.start()
    return arm
