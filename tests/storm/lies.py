"""Devices that report what is not so: no number, the same again and again, or elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sliplab.rigs.core.capabilities import Pose
from sliplab.rigs.mock.arm import MockArm
from sliplab.rigs.mock.force import MockForceSensor
from sliplab.storage.streams import WrenchChunk

OF_ARM = ("pose_nan", "pose_frozen", "pose_away")
OF_FORCE = ("force_nan", "force_high", "force_silent")
AWAY_MM = 30.0
HIGH_N = 100.0


@dataclass
class Lie:
    """One device reports what is not so.

    Attributes:
        kind: one of `OF_ARM` and `OF_FORCE`; empty while all is true.
        until_s: when it ends, on the clock `now_s`.
    """

    now_s: Callable[[], float]
    kind: str = ""
    until_s: float = 0.0
    _frozen: Pose | None = None

    def begin(self, kind: str, seconds: float) -> None:
        """Let a device lie from now on."""
        self.kind, self.until_s, self._frozen = kind, self.now_s() + seconds, None

    @property
    def active(self) -> str:
        """The kind of the lie now; empty for none."""
        if self.now_s() > self.until_s:
            self.kind = ""
        return self.kind

    @property
    def frozen(self) -> Pose | None:
        """The pose that is reported again and again."""
        return self._frozen if self.active == "pose_frozen" else None

    def install(self) -> None:
        """Let every arm and force sensor of this process lie when it is time."""
        pose, read = MockArm.pose, MockForceSensor.read

        def reported(arm: MockArm) -> Pose:
            true, kind = pose(arm), self.active
            if kind == "pose_nan":
                return replace(true, xyz_mm=(*true.xyz_mm[:2], float("nan")))
            if kind == "pose_away":
                x, y, z = true.xyz_mm
                return replace(true, xyz_mm=(x + AWAY_MM, y + AWAY_MM, z + AWAY_MM))
            if kind == "pose_frozen":
                self._frozen = self._frozen or true
                return self._frozen
            return true

        def forces(sensor: MockForceSensor) -> WrenchChunk:
            true, kind = read(sensor), self.active
            if kind == "force_silent":
                return WrenchChunk.empty()
            if kind == "force_nan":
                return replace(true, force_n=np.full_like(true.force_n, np.nan))
            return replace(true, force_n=true.force_n + HIGH_N) if kind == "force_high" else true

        MockArm.pose = reported  # type: ignore[method-assign]
        MockForceSensor.read = forces  # type: ignore[method-assign]
