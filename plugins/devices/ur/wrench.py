"""The wrench at the tool that a Universal Robots controller reports with every pose (RTDE).

`actual_TCP_force`: force and torque on the tool in the axes of the arm's base, the payload's
weight taken off, stamped by the controller's clock. It comes with the arm's own stream: one more
field of each packet, without a separate connection.
"""

from __future__ import annotations

import numpy as np

from sliplab.plugins.devices.ur.driver import UrArm
from sliplab.plugins.devices.ur.settings import UrWrenchSettings
from sliplab.protocols.timing import ForceGrade
from sliplab.rigs.core.capabilities import Arm, ArmState, Mounting, RigError
from sliplab.storage.streams import Json, WrenchChunk

DEVICE = "force sensor"


class UrWrench:
    """The wrench of an arm; a `ForceSensor` of `rigs.core.capabilities`.

    Raises:
        RigError: the rig's arm is of another driver, or was not built to send its wrench.
    """

    mounting = Mounting(axes="base", feels="arm")
    grade: ForceGrade = "arm clock"

    def __init__(self, settings: UrWrenchSettings, arm: Arm) -> None:
        if not isinstance(arm, UrArm):
            raise RigError(DEVICE, "ur_wrench needs the arm of driver: ur")
        if arm.wrenches is None:
            raise RigError(DEVICE, "the arm was built without its wrench")
        self._arm, self._log = arm, arm.wrenches
        self.zeroing = settings.bias

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
        self._log.start()

    def read(self) -> WrenchChunk:
        """Samples since the last call.

        Raises:
            RigError: the arm's stream has ended.
        """
        rows = self._log.read()
        if self._log.streaming:
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
        self._log.stop()

    def close(self) -> None:
        """Nothing to give back: the connection is the arm's."""
        self.stop()

    def describe(self) -> Json:
        """Samples that were not read in time."""
        return {"dropped": self._log.dropped}

    def _check(self) -> None:
        if self._arm.state() is ArmState.DISCONNECTED:
            raise RigError(DEVICE, "the arm that measures it is not connected")
