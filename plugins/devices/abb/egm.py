"""Poses from ABB's Externally Guided Motion: UDP packets that the controller streams.

abb-motion-program-exec's RAPID module starts the stream with every motion program. The time of a
pose is the controller's (`feedBack.time`, s and us). The planned pose is the commanded one and has
no noise, so segment starts and ends are detected from it where it is sent. UDP guarantees neither
sender, order nor delivery: address, sequence number, time and pose of every packet are checked.
"""

from __future__ import annotations

import math
import socket
import struct
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from abb_robot_client.egm import EGM
from google.protobuf.message import DecodeError

from sliplab.rigs.core.capabilities import Pose
from sliplab.rigs.core.pose import from_quaternion
from sliplab.rigs.core.pose_stream import PoseCheck, PoseJumpError

_BUFFER_BYTES = 1 << 20
_SO_TIMESTAMPNS = 35
"""Linux socket option and message type: wall-clock time at which the kernel received a packet."""
_TIMESPEC = struct.Struct("@ll")
_OLDEST_NS = 10_000_000_000
"""Largest age; a packet that seems older was stamped before the wall clock was set."""
LATE_NS = 1_000_000_000
"""A packet this much older than the last was not delayed: the controller's clock jumped back."""
_LATEST_NS = 1 << 62
"""Largest time that fits into a recording."""
_SHORTEST_NS = 2_000_000
"""Shortest period of packets; a controller has 4 ms."""
_NUMBERS = 1 << 32
"""Sequence numbers before they begin at 0 again."""
_FURTHEST_MM = 1e5
_UNIT_TOLERANCE = 0.01
"""Largest deviation of a quaternion from length 1; the controller sends doubles."""


class EgmFault(RuntimeError):
    """The stream is unusable: no times, or times or poses that jump; the text says which."""


@dataclass(frozen=True)
class EgmPose:
    """One packet."""

    t_ns: int
    host_ns: int
    """Arrival time at this computer, from the kernel where possible, monotonic clock."""
    measured: Pose
    planned: Pose
    """Commanded pose; the measured one where the controller does not send it."""


@dataclass
class EgmCounts:
    """Lost and rejected packets since the port was opened."""

    lost: int = 0
    """Missing sequence numbers."""
    late: int = 0
    """Packets out of order, or duplicates."""
    malformed: int = 0
    """Packets from the controller without a complete, finite pose."""
    implausible: int = 0
    """Poses that the arm cannot have reached, or times that cannot have passed."""
    foreign: int = 0
    """Packets from any other address."""


class _StampedSocket(socket.socket):
    """A UDP socket that reports the arrival time of the last packet, not only its reading time."""

    arrived_ns = 0

    def stamp(self) -> None:
        """Request arrival times from the kernel; Linux only."""
        if sys.platform == "linux":
            with suppress(OSError):
                self.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)

    def recvfrom(self, size: int, flags: int = 0) -> tuple[bytes, Any]:
        """Return the next packet and its sender."""
        data, notes, _, sender = self.recvmsg(size, socket.CMSG_SPACE(_TIMESPEC.size), flags)
        arrived_ns, real_ns = _both_clocks()
        for level, kind, note in notes:
            if (level, kind) == (socket.SOL_SOCKET, _SO_TIMESTAMPNS):
                seconds, ns = _TIMESPEC.unpack(note[: _TIMESPEC.size])
                age_ns = real_ns - (seconds * 1_000_000_000 + ns)
                arrived_ns -= age_ns if 0 <= age_ns < _OLDEST_NS else 0
        # packets are read in the order of their arrival, whatever became of the real-time clock
        self.arrived_ns = max(self.arrived_ns, arrived_ns)
        return data, sender


def _both_clocks() -> tuple[int, int]:
    """Return the monotonic and the real-time clock of one moment, ns.

    Of two readings the shorter: between its calls a process may lose its core for milliseconds.
    """
    found = []
    for _ in range(2):
        here_ns, real_ns = time.monotonic_ns(), time.time_ns()
        found.append((time.monotonic_ns() - here_ns, here_ns, real_ns))
    _, here_ns, real_ns = min(found)
    return here_ns, real_ns


class EgmReceiver:
    """Receives the packets of one controller on a UDP port.

    Args:
        bind: address of the network card that the controller sends to.
        port: UDP port that the controller sends to.
        sender: address or name of the controller; other packets are counted and dropped.
        limit_mm_s: limit of the speed of a path.

    Attributes:
        counts: lost and rejected packets.
        check: holds poses against the last ones.

    Raises:
        OSError: the port is taken, or the sender's name cannot be resolved.
    """

    def __init__(self, bind: str, port: int, sender: str, limit_mm_s: float = 0.0) -> None:
        self.counts = EgmCounts()
        self.check = PoseCheck(limit_mm_s)
        self._sender = socket.gethostbyname(sender)
        self._last: tuple[int, int] | None = None  # sequence number, time in ns
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
        """Return the next packet's pose; None after `within_s`, or for a rejected packet.

        Raises:
            EgmFault: packets carry no time, or the clock or the poses jumped.
        """
        self._egm.egm_addr = None
        try:
            came, state = self._egm.receive_from_robot(within_s)
        except DecodeError:
            came, state = True, None
        if not came or self._egm.egm_addr is None:
            return None
        if self._egm.egm_addr[0] != self._sender:
            self.counts.foreign += 1
            return None
        if state is None or state.cartesian is None:
            self.counts.malformed += 1
            return None
        measured = _pose(state.cartesian)
        planned = measured if state.cartesian_planned is None else _pose(state.cartesian_planned)
        if measured is None or planned is None:
            self.counts.malformed += 1
            return None
        message = state.robot_message
        if not message.feedBack.HasField("time"):
            raise EgmFault("its EGM packets carry no time stamp: RobotWare 6.07 or newer is needed")
        clock = message.feedBack.time
        t_ns = clock.sec * 1_000_000_000 + clock.usec * 1_000
        if t_ns > _LATEST_NS:
            self.counts.malformed += 1
            return None
        number, host_ns = message.header.seqno, self._link.arrived_ns
        if not self._is_next(number, t_ns):
            return None
        try:
            believed = self.check.believes(t_ns, host_ns, measured, planned)
        except PoseJumpError as error:
            raise EgmFault(str(error)) from None
        finally:
            self.counts.implausible = self.check.dropped
        if not believed:
            return None
        self._count_lost(number, t_ns)
        return EgmPose(t_ns, host_ns, measured, planned)

    def close(self) -> None:
        """Release the port."""
        self._egm.close()

    def _is_next(self, number: int, t_ns: int) -> bool:
        """Return whether a packet is newer than the last one."""
        if self._last is None:
            return True
        last, last_ns = self._last
        back_ns = last_ns - t_ns
        if back_ns > LATE_NS or (back_ns > 0 and 0 < (number - last) % _NUMBERS < _NUMBERS // 2):
            raise EgmFault(f"the controller's clock jumped back by {back_ns / 1e9:.3f} s")
        if back_ns >= 0:
            self.counts.late += 1
            return False
        return True

    def _count_lost(self, number: int, t_ns: int) -> None:
        """Count the packets that are missing before this one, the newest."""
        if self._last is not None:
            missing = (number - self._last[0]) % _NUMBERS - 1
            # more than fit into the time: the controller restarted its count, as with each program
            if 0 < missing <= (t_ns - self._last[1]) // _SHORTEST_NS:
                self.counts.lost += missing
        self._last = number, t_ns


def _pose(cartesian: tuple[Any, Any]) -> Pose | None:
    """Convert a position in mm and a quaternion to a pose; None if they are invalid."""
    xyz_mm, wxyz = cartesian[0].tolist(), cartesian[1].tolist()
    if not all(math.isfinite(value) and abs(value) < _FURTHEST_MM for value in (*xyz_mm, *wxyz)):
        return None
    if abs(math.hypot(*wxyz) - 1) > _UNIT_TOLERANCE:
        return None
    return from_quaternion(xyz_mm, wxyz)
