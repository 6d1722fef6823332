"""Poses from ABB's Externally Guided Motion: UDP packets that the controller sends by itself.

abb-motion-program-exec's RAPID module starts the stream with every motion program. The time of a
pose is the controller's (`feedBack.time`, s and us); its planned pose is the commanded one and has
no noise, so a segment's start and end are read from it where it is sent.
"""

from __future__ import annotations

import socket
import time
from dataclasses import dataclass
from typing import Any

from abb_robot_client.egm import EGM

from rigs.arms.pose import from_quaternion
from rigs.capabilities import Pose

_BUFFER_BYTES = 1 << 20


@dataclass(frozen=True)
class EgmPose:
    """One packet."""

    t_ns: int
    host_ns: int
    measured: Pose
    planned: Pose
    """Commanded; the measured one where the controller does not send it."""


class EgmReceiver:
    """Listens on one UDP port.

    Args:
        bind: address of the network card that the controller sends to.
        port: UDP port that the controller sends to.

    Raises:
        OSError: the port is taken.
    """

    def __init__(self, bind: str, port: int) -> None:
        self._egm = EGM(port=0)
        self._egm.socket.close()
        link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
            link.bind((bind, port))
        except OSError:
            link.close()
            raise
        self._egm.socket = link

    def read(self, within_s: float) -> EgmPose | None:
        """The next packet with a pose, or None after `within_s`."""
        came, state = self._egm.receive_from_robot(within_s)
        if not came or state.cartesian is None:
            return None
        host_ns = time.monotonic_ns()
        clock = state.robot_message.feedBack.time
        t_ns = clock.sec * 1_000_000_000 + clock.usec * 1_000
        measured = _pose(state.cartesian)
        planned = measured if state.cartesian_planned is None else _pose(state.cartesian_planned)
        return EgmPose(t_ns, host_ns, measured, planned)

    def close(self) -> None:
        """Give the port back."""
        self._egm.close()


def _pose(cartesian: tuple[Any, Any]) -> Pose:
    return from_quaternion(*cartesian)
