"""Devices that report what is not so: no number, the same again and again, elsewhere, or done."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sliplab.plugins.simulation.arm import MockArm
from sliplab.plugins.simulation.force import MockForceSensor
from sliplab.rigs.core.capabilities import ArmState, Pose, Progress
from sliplab.storage.streams import WrenchChunk
from tests.patching import put

OF_ARM = ("pose_nan", "pose_frozen", "pose_away", "pose_creep", "path_done")
OF_FORCE = ("force_nan", "force_high", "force_silent", "force_frozen")
FALSE_PLACES = {"pose_away", "pose_frozen", "pose_creep"}
"""Lies from which motion is planned to places that are not where they seem."""
AWAY_MM = 30.0
CREEP_MM_S = 5.0
"""How fast a reported pose leaves the true one: no speed that is beyond a limit."""
HIGH_N = 100.0


@dataclass
class Lie:
    """One device reports what is not so.

    Attributes:
        kind: one of `OF_ARM` and `OF_FORCE`; empty while all is true.
        axis: in which of six numbers, or directions.
        until_s: when it ends, on the clock `now_s`.
        pose: the last false pose.
    """

    now_s: Callable[[], float]
    kind: str = ""
    axis: int = 0
    until_s: float = 0.0
    pose: Pose | None = None
    _since_s: float = 0.0
    _load: WrenchChunk | None = None

    def begin(self, kind: str, seconds: float, axis: int = 0) -> None:
        """Let a device lie from now on."""
        self.kind, self.axis, self._since_s = kind, axis, self.now_s()
        self.until_s, self.pose, self._load = self._since_s + seconds, None, None

    @property
    def active(self) -> str:
        """The kind of the lie now; empty for none."""
        if self.now_s() > self.until_s:
            self.kind = ""
        return self.kind

    @property
    def frozen(self) -> Pose | None:
        """The pose that is reported again and again."""
        return self.pose if self.active == "pose_frozen" else None

    def install(self) -> None:
        """Let every arm and force sensor of this process lie when it is time."""
        pose, progress, read = MockArm.pose, MockArm.progress, MockForceSensor.read

        def reported(arm: MockArm) -> Pose:
            true, kind = pose(arm), self.active
            if kind not in {"pose_nan", *FALSE_PLACES}:
                return true
            if kind != "pose_frozen" or self.pose is None:
                self.pose = self._false(true, kind)
            return self.pose

        def progressed(arm: MockArm) -> Progress:
            true = progress(arm)
            if self.active != "path_done" or true.done or not true.state.healthy:
                return true
            now = arm.now_ns()
            return Progress(ArmState.READY, (*true.finished, (now, now)), True)

        def forces(sensor: MockForceSensor) -> WrenchChunk:
            true, kind = read(sensor), self.active
            if kind == "force_silent":
                return WrenchChunk.empty()
            if not len(true) or not kind.startswith("force"):
                return true
            force_n = true.force_n.copy()
            if kind == "force_nan":
                force_n[-1, self.axis % 3] = np.nan
            elif kind == "force_high":
                force_n[:, self.axis % 3] += HIGH_N if self.axis < 3 else -HIGH_N
            else:
                self._load = self._load or true
                force_n[:] = self._load.force_n[-1]
            return replace(true, force_n=force_n)

        put(MockArm, "pose", reported)
        put(MockArm, "progress", progressed)
        put(MockForceSensor, "read", forces)

    def _false(self, true: Pose, kind: str) -> Pose:
        """Return what is reported instead of a true pose."""
        if kind == "pose_frozen":
            return true
        numbers = [*true.xyz_mm, *true.rotvec_deg]
        if kind == "pose_nan":
            numbers[self.axis] = float("nan")
        elif kind == "pose_away":
            numbers[:3] = (each + AWAY_MM for each in numbers[:3])
        else:
            sign = 1 if self.axis < 3 else -1
            numbers[self.axis % 3] += sign * CREEP_MM_S * (self.now_s() - self._since_s)
        x, y, z, a, b, c = numbers
        return Pose((x, y, z), (a, b, c))
