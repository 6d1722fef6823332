"""Reports of an arm's driver during a path, with the true motion of its fake."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sliplab.plugins.driver_kit.arm_bench import ArmBench
from sliplab.plugins.driver_kit.rule import RuleViolation
from sliplab.rigs.core.capabilities import Pose, Progress, Segment
from sliplab.rigs.core.pose import F64, angle_deg, distance_mm, segment_seconds
from sliplab.storage.streams import PoseChunk

STEP_S = 0.002
"""Step at which the true motion is evaluated, s."""
OFFSET_READS, OFFSET_EVERY_S = 10, 0.01
"""Reads of the driver's clock, of which a busy computer may delay some, and time between them."""


@dataclass(frozen=True)
class DriverCall:
    """One call of the driver.

    Attributes:
        begin_s, end_s: true time of the controller's clock before and after the call, s.
        moving: True if the arm truly moved before and after it.
    """

    name: str
    begin_s: float
    end_s: float
    moving: bool
    value: Any

    @property
    def seconds(self) -> float:
        """Duration of the call, s."""
        return self.end_s - self.begin_s


@dataclass
class Report:
    """All that a driver reported during a path.

    Attributes:
        begin_s, end_s: true time of the controller's clock before and after the path, s.
        start: the call of `start`.
        before: the true pose before the path.
        offset_ns: the driver's clock minus the true one, ns.
    """

    begin_s: float
    before: Pose
    offset_ns: int
    start: DriverCall | None = None
    end_s: float = 0.0
    answers: list[DriverCall] = field(default_factory=list)

    def of(self, name: str) -> list[DriverCall]:
        """Return the calls of one name, in order."""
        return [answer for answer in self.answers if answer.name == name]

    @property
    def progress(self) -> Progress:
        """The last progress."""
        found: Progress = self.of("progress")[-1].value
        return found

    @property
    def chunks(self) -> list[PoseChunk]:
        """The poses of every read that returned some."""
        return [a.value for a in self.of("read_poses") if len(a.value)]

    def true_s(self, t_ns: int) -> float:
        """Convert a time that the driver reported to the true time of the controller's clock, s."""
        return (t_ns - self.offset_ns) / 1e9


@dataclass(frozen=True)
class TrueMotion:
    """The true motion, n times at steps of `STEP_S`."""

    t_s: F64
    """Controller's clock, s, shape (n,)."""
    poses: list[Pose]

    def shares(self, begin: Pose, segment: Segment) -> F64:
        """Return the shares of a segment that were travelled, shape (n,)."""
        turns = segment.turn_deg_s is not None
        measure = angle_deg if turns else distance_mm
        whole = measure(begin, segment.to)
        return np.array([measure(begin, pose) / whole for pose in self.poses])


def true_course(bench: ArmBench, begin_s: float, end_s: float) -> TrueMotion:
    """Return the true motion between two times of the controller's clock, s."""
    t_s = np.arange(begin_s, end_s, STEP_S)
    return TrueMotion(t_s, [bench.true_pose(at) for at in t_s.tolist()])


def ask(bench: ArmBench, name: str, work: Callable[[], Any]) -> DriverCall:
    """Make a call of the driver. Raises Seen or RigError."""
    before, begin_s = bench.moving(), bench.clock_s()
    value = bench.call(name, work)
    end_s = bench.clock_s()
    return DriverCall(name, begin_s, end_s, before and bench.moving(), value)


def clock_offset_ns(bench: ArmBench) -> int:
    """Return the driver's clock minus the true one, ns; a stale answer of `now_ns` is too low."""
    reads: list[DriverCall] = []
    for _ in range(OFFSET_READS):
        reads.append(ask(bench, "now_ns", bench.arm.now_ns))
        bench.wait(OFFSET_EVERY_S)
    return max(read.value - round(read.end_s * 1e9) for read in reads)


def follow(bench: ArmBench, *path: Segment) -> Report:
    """Follow a path to its end, and record all reports of the driver meanwhile.

    Raises:
        Seen: it does not end in time.
        RigError: raised by the driver.
    """
    arm, before = bench.arm, bench.place()
    bench.call("read_poses", arm.read_poses)
    report = Report(bench.clock_s(), before, clock_offset_ns(bench))
    begin, seconds = before, 0.0
    for segment in path:
        seconds, begin = seconds + segment_seconds(begin, segment), segment.to
    report.start = ask(bench, "start", lambda: arm.start(path))

    def done() -> bool:
        for name in ("state", "pose", "progress", "read_poses"):
            report.answers.append(ask(bench, name, getattr(arm, name)))
        return report.progress.done

    if not bench.until(done, 1.5 * seconds + bench.bounds.news_s):
        raise RuleViolation(
            f"progress was not done {bench.bounds.news_s:g} s after the path was due"
        )
    report.end_s = bench.clock_s()
    return report
