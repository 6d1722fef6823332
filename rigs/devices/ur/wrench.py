"""The wrench at the tool that a Universal Robots controller reports with every pose (RTDE).

`actual_TCP_force`: force and torque on the tool in the axes of the arm's base, the payload's
weight taken off, stamped by the controller's clock. It comes with the arm's own stream: one more
field of each packet, without a separate connection.
"""

from __future__ import annotations

import threading
from collections import deque

import numpy as np

from sliplab.protocols.timing import ForceGrade
from sliplab.rigs.core.capabilities import Arm, ArmState, Mounting, RigError
from sliplab.rigs.core.pose_stream import BACKLOG_SAMPLES
from sliplab.rigs.devices.ur.driver import UrArm
from sliplab.rigs.devices.ur.settings import UrWrenchSettings
from sliplab.storage.streams import Json, WrenchChunk

DEVICE = "force sensor"
Row = tuple[int, int, tuple[float, ...]]
"""Controller's clock and host's, ns; force in N and torque in N m."""


class UrWrench:
    """The wrench of an arm; a `ForceSensor` of `rigs.core.capabilities`.

    Raises:
        RigError: the rig's arm is of another driver.
    """

    mounting = Mounting(axes="base", feels="arm")
    grade: ForceGrade = "arm clock"

    def __init__(self, settings: UrWrenchSettings, arm: Arm) -> None:
        if not isinstance(arm, UrArm):
            raise RigError(DEVICE, "ur_wrench needs the arm of driver: ur")
        self._arm = arm
        self.zeroing = settings.bias
        self._rows: deque[Row] = deque(maxlen=BACKLOG_SAMPLES)
        self._lock = threading.Lock()
        self._streaming = False
        self._dropped = 0
        arm.on_wrench = self._take

    def connect(self) -> None:
        """See that the arm is connected.

        Raises:
            RigError: it is not.
        """
        self._check()
        if self.zeroing == "session":
            self.zero()

    def start(self) -> None:
        """Begin to keep samples."""
        with self._lock:
            self._rows.clear()
            self._dropped = 0
        self._streaming = True

    def read(self) -> WrenchChunk:
        """Samples since the last call.

        Raises:
            RigError: the arm's stream has ended.
        """
        with self._lock:
            rows = list(self._rows)
            self._rows.clear()
        if self._streaming:
            self._check()
        if not rows:
            return WrenchChunk.empty()
        values = np.array([row[2] for row in rows], np.float64)
        return WrenchChunk(
            np.array([row[0] for row in rows], np.int64),
            np.array([row[1] for row in rows], np.int64),
            values[:, :3].copy(),
            values[:, 3:].copy(),
        )

    def zero(self) -> None:
        """Take the present load for zero (the controller's `zero_ftsensor`)."""
        self._arm.zero_force()

    def stop(self) -> None:
        """Store no more samples; those received can still be read."""
        self._streaming = False

    def close(self) -> None:
        """Nothing to give back: the connection is the arm's."""
        self.stop()

    def describe(self) -> Json:
        """Samples that were not read in time."""
        return {"dropped": self._dropped}

    def _check(self) -> None:
        if self._arm.state() is ArmState.DISCONNECTED:
            raise RigError(DEVICE, "the arm that measures it is not connected")

    def _take(self, t_ns: int, host_ns: int, values: tuple[float, ...]) -> None:
        """In the thread of the arm's stream."""
        if self._streaming:
            with self._lock:
                self._dropped += len(self._rows) == BACKLOG_SAMPLES
                self._rows.append((t_ns, host_ns, values))
