"""Bounded buffer of the samples that an arm's controller streams.

One thread writes (`add`), others read. Nothing is resampled: a sample is the content of one packet.
"""

from __future__ import annotations

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
