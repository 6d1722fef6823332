"""Samples that an arm's controller streams: which to believe, and a bounded buffer of them.

One thread writes (`add`), others read. Nothing is resampled: a sample is the content of one packet.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from threading import Condition

import numpy as np

from sliplab.rigs.core.capabilities import Pose
from sliplab.rigs.core.pose import short_rotvec_deg
from sliplab.storage.streams import PoseChunk, PulseChunk

BACKLOG_SAMPLES = 60_000
"""Buffered poses: two minutes at 500 per second. Older ones are dropped and counted."""
BACKLOG_PULSES = 60_000
"""Buffered pulses."""
FASTEST_MM_S, FASTEST_DEG_S = 1000.0, 1000.0
"""Largest plausible speeds, those of an arm that is guided by hand; or twice the rig's limit."""
STEP_MM, STEP_DEG = 1.0, 1.0
"""Largest step of a pose within no time: noise."""
AHEAD_NS = 1_000_000_000
"""Largest lead that a stamp may gain over the host's clock since the last one."""
MOST_DROPPED = 3
"""Poses in a row that are not believed, after which none is, whether or not they agree."""
BURST_NS = 50_000_000
"""Largest time by which packets that arrive in a burst may seem too close to each other."""

Stamped = tuple[int, int, tuple[Pose, ...]]
"""Poses with their time on the controller's clock, and of their arrival on the host's, ns."""


class PoseJumpError(RuntimeError):
    """Consecutive poses that the arm cannot have reached, or impossible time stamps."""


class PoseCheck:
    """Holds each pose against the last one: how far the arm can have come, how much time can pass.

    A single pose beyond that is an invalid packet, to be dropped. A second one that continues it
    shows that the arm or its clock did jump; `MOST_DROPPED` in a row show that nothing is known.

    Args:
        limit_mm_s: limit of the speed of a path.

    Attributes:
        active: False while the tool is set, which moves its centre point.
        dropped: number of poses that were not believed.
    """

    def __init__(self, limit_mm_s: float = 0.0) -> None:
        self._fastest_mm_s = max(2 * limit_mm_s, FASTEST_MM_S)
        self._last: Stamped | None = None
        self._held: Stamped | None = None
        self._row = 0
        self.active = True
        self.dropped = 0

    def believes(self, t_ns: int, host_ns: int, *poses: Pose) -> bool:
        """Return whether the next poses are plausible; they are remembered if so.

        Args:
            t_ns: their time on the controller's clock.
            host_ns: their arrival on the host's clock.
            poses: places of one or more points, in the same order each time.

        Raises:
            PoseJumpError: the second ones in a row that are not, or the third if these differ.
        """
        new = t_ns, host_ns, poses
        why = self._jump(self._last, new) if self.active else None
        if why is None:
            self._last, self._held, self._row = new, None, 0
            return True
        self.dropped += 1
        self._row += 1
        continues = self._held is not None and self._jump(self._held, new) is None
        if continues or self._row == MOST_DROPPED:
            raise PoseJumpError(why)
        self._held = new
        return False

    def _jump(self, before: Stamped | None, new: Stamped) -> str | None:
        """Return what cannot have happened between two samples."""
        if before is None:
            return None
        passed_ns, waited_ns = new[0] - before[0], new[1] - before[1]
        if passed_ns < 0 or passed_ns - waited_ns > AHEAD_NS:
            return f"its clock jumped by {passed_ns / 1e9:.3f} s"
        seconds = min(passed_ns, max(waited_ns, 0) + BURST_NS) / 1e9
        for one, other in zip(before[2], new[2], strict=True):
            gone_mm = math.dist(one.xyz_mm, other.xyz_mm)
            if not gone_mm <= STEP_MM + self._fastest_mm_s * seconds:
                return f"its pose jumped by {gone_mm:.1f} mm in {seconds:.3f} s"
            turn_deg = _turn_deg(one.rotvec_deg, other.rotvec_deg)
            if not turn_deg <= STEP_DEG + FASTEST_DEG_S * seconds:
                return f"its pose jumped by {turn_deg:.1f} deg in {seconds:.3f} s"
        return None


def _turn_deg(one: tuple[float, float, float], other: tuple[float, float, float]) -> float:
    """Return the angle between two rotation vectors, degrees; `pose.angle_deg` is too slow here."""
    if one == other:
        return 0.0
    dot = sum(a * b for a, b in zip(_quaternion(one), _quaternion(other), strict=True))
    return math.degrees(2 * math.acos(min(abs(dot), 1.0)))


def _quaternion(rotvec_deg: tuple[float, float, float]) -> tuple[float, float, float, float]:
    half = math.radians(math.hypot(*rotvec_deg)) / 2
    factor = math.radians(0.5) * (math.sin(half) / half if half else 1.0)
    x, y, z = rotvec_deg
    return math.cos(half), factor * x, factor * y, factor * z


@dataclass(frozen=True)
class Sample:
    """One controller cycle."""

    t_ns: int
    """Controller clock."""
    host_ns: int
    """Host's monotonic clock at reception."""
    xyz_mm: tuple[float, float, float]
    rotvec_deg: tuple[float, float, float]
    sync: bool = False
    """Level of the sync line."""

    @property
    def pose(self) -> Pose:
        """The sample's pose with a rotation vector of at most 180 degrees."""
        a, b, c = short_rotvec_deg(np.array([self.rotvec_deg]))[0].tolist()
        return Pose(self.xyz_mm, (a, b, c))


class PoseStream:
    """Samples and pulses that were received and not read yet."""

    def __init__(self) -> None:
        self._samples: deque[Sample] = deque(maxlen=BACKLOG_SAMPLES)
        self._pulses: deque[int] = deque(maxlen=BACKLOG_PULSES)
        self._changed = Condition()
        self._last: Sample | None = None
        self.dropped = 0
        """Number of samples that were not read in time."""

    @property
    def last(self) -> Sample | None:
        """The newest sample."""
        return self._last

    def add(self, sample: Sample) -> None:
        """Add one sample; a rising edge of the sync level is a pulse at its time."""
        with self._changed:
            if self._last is not None and sample.sync and not self._last.sync:
                self._pulses.append(sample.t_ns)
            if len(self._samples) == BACKLOG_SAMPLES:
                self.dropped += 1
            self._samples.append(sample)
            self._last = sample
            self._changed.notify_all()

    def wake(self) -> None:
        """Make waiting threads check their conditions again after another change."""
        with self._changed:
            self._changed.notify_all()

    def wait_for(self, condition: Callable[[], bool], within_s: float) -> bool:
        """Return whether `condition` became true within `within_s`; checked with every sample."""
        with self._changed:
            return self._changed.wait_for(condition, within_s)

    def read(self) -> PoseChunk:
        """Samples since the last call."""
        with self._changed:
            samples = list(self._samples)
            self._samples.clear()
        n = len(samples)
        rotvec = np.array([s.rotvec_deg for s in samples], np.float64).reshape(n, 3)
        return PoseChunk(
            np.array([s.t_ns for s in samples], np.int64),
            np.array([s.host_ns for s in samples], np.int64),
            np.array([s.xyz_mm for s in samples], np.float64).reshape(n, 3),
            short_rotvec_deg(rotvec),
        )

    def read_pulses(self) -> PulseChunk:
        """Controller times of rising edges since the last call."""
        with self._changed:
            pulses = list(self._pulses)
            self._pulses.clear()
        return PulseChunk(np.array(pulses, np.int64))
