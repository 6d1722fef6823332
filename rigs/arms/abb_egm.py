"""Poses from ABB's Externally Guided Motion: UDP packets that the controller sends by itself.

abb-motion-program-exec's RAPID module starts the stream with every motion program. The time of a
pose is the controller's (`feedBack.time`, s and us); its planned pose is the commanded one and has
no noise, so a segment's start and end are read from it where it is sent.
"""

from __future__ import annotations

import socket
import struct
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from abb_robot_client.egm import EGM

from rigs.arms.pose import from_quaternion
from rigs.capabilities import Pose

_BUFFER_BYTES = 1 << 20
_SO_TIMESTAMPNS = 35
"""Linux's option, and the type of its message: when the kernel took a packet, by the wall clock."""
_TIMESPEC = struct.Struct("@ll")
_OLDEST_NS = 10_000_000_000
"""A packet said to be older than this was stamped before the wall clock was set."""


@dataclass(frozen=True)
class EgmPose:
    """One packet."""

    t_ns: int
    host_ns: int
    """When it arrived at this computer, as well as its kernel knows, on the monotonic clock."""
    measured: Pose
    planned: Pose
    """Commanded; the measured one where the controller does not send it."""


class _StampedSocket(socket.socket):
    """A UDP socket that knows when the packet read last arrived, not only when it was read."""

    arrived_ns = 0

    def stamp(self) -> None:
        """Ask the kernel for arrival times, where it is Linux."""
        if sys.platform == "linux":
            with suppress(OSError):
                self.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)

    def recvfrom(self, size: int, flags: int = 0) -> tuple[bytes, Any]:
        """The next packet and its sender."""
        data, notes, _, sender = self.recvmsg(size, socket.CMSG_SPACE(_TIMESPEC.size), flags)
        self.arrived_ns = time.monotonic_ns()
        for level, kind, note in notes:
            if (level, kind) == (socket.SOL_SOCKET, _SO_TIMESTAMPNS):
                seconds, ns = _TIMESPEC.unpack(note[: _TIMESPEC.size])
                age_ns = time.time_ns() - (seconds * 1_000_000_000 + ns)
                self.arrived_ns -= age_ns if 0 <= age_ns < _OLDEST_NS else 0
        return data, sender


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
        link = _StampedSocket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
            link.stamp()
            link.bind((bind, port))
        except OSError:
            link.close()
            raise
        self._egm.socket = self._link = link

    def read(self, within_s: float) -> EgmPose | None:
        """The next packet with a pose, or None after `within_s`."""
        came, state = self._egm.receive_from_robot(within_s)
        if not came or state.cartesian is None:
            return None
        clock = state.robot_message.feedBack.time
        t_ns = clock.sec * 1_000_000_000 + clock.usec * 1_000
        measured = _pose(state.cartesian)
        planned = measured if state.cartesian_planned is None else _pose(state.cartesian_planned)
        return EgmPose(t_ns, self._link.arrived_ns, measured, planned)

    def close(self) -> None:
        """Give the port back."""
        self._egm.close()


def _pose(cartesian: tuple[Any, Any]) -> Pose:
    return from_quaternion(*cartesian)
