"""The simulated world's arm path when a fake's controller moves the arm.

A fake reports every new line that its tool centre point follows, and the world evaluates them with
their ramps. Total time is true time across all trials; the world counts from the trial's start.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.path import EVERY, ArmPath, Leg, TrueSurface, tremor_envelope
from sliplab.rigs.core.capabilities import Pose, RigError, Segment
from sliplab.rigs.core.fake_motion import STILL, StraightMotion, StraightMove
from sliplab.storage.clockmap import ClockMap

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]


@dataclass(frozen=True)
class _TimedLine:
    """A line that applies from `since_ns`, total true time, and the states at its ends."""

    line: StraightMove
    since_ns: int
    end_ns: int
    begin: F64
    end: F64


class FakeArmPath(ArmPath):
    """An arm path that follows a fake's tool centre point.

    Args:
        plane: the true contact plane.
        pose: initial pose of the arm.
        controller: total true time to the arm controller's clock, ns.

    Attributes:
        motion: the motion that the fake commands.
        cut_ns: true time of the trial at which a simulated fault stopped the arm; None before. The
            fake has to stop too.
    """

    def __init__(self, plane: TrueSurface, pose: Pose, controller: ClockMap) -> None:
        super().__init__(plane, pose)
        self._controller = controller
        self._past_ns = 0
        self._lock = threading.Lock()
        rest = StraightMove(pose, pose, STILL, 0.0)
        self._lines = [_TimedLine(rest, -(1 << 62), -(1 << 62), self._rest, self._rest)]
        self.motion = StraightMotion(pose, self._on_line)
        self.cut_ns: int | None = None

    def begin(self, past_ns: int) -> None:
        """Begin a trial whose time 0 is the total time `past_ns`; older lines are discarded."""
        with self._lock:
            self._past_ns, self.cut_ns = past_ns, None
            retained = [line for line in self._lines if line.since_ns > past_ns]
            self._lines = [*self._lines[: len(self._lines) - len(retained)][-1:], *retained]

    def restart(self, now_ns: int) -> None:
        """Keep the lines, which continue; `begin` discards them."""

    def follow(self, segments: Sequence[Segment], now_ns: int) -> list[Leg]:
        """Refuse a path, because only the fake moves this arm.

        Raises:
            RigError: always.
        """
        raise RigError("arm", "is moved by its controller")

    def cut(self, now_ns: int) -> None:
        """Stop the arm by a simulated fault; see `cut_ns`."""
        if self.cut_ns is None:
            self.cut_ns = now_ns

    def commanded(self, t_ns: I64, columns: slice = EVERY) -> F64:
        """Return the states at increasing true times of the trial, (n, 12) or those columns."""
        with self._lock:
            lines, past_ns = self._lines, self._past_ns
        result = np.empty((len(t_ns), columns.stop - columns.start))
        total = np.asarray(t_ns, np.int64) + past_ns
        begins = np.searchsorted(total, np.array([line.since_ns for line in lines], np.int64))
        edges = [*begins.tolist(), len(total)]
        edges[0] = 0
        for timed, first, last in zip(lines, edges[:-1], edges[1:], strict=True):
            if first < last:
                seconds = self._controller.to_reference(total[first:last]) / 1e9
                share = timed.line.ramp.shares(seconds - timed.line.start_s)[:, None]
                begin, end = timed.begin[columns], timed.end[columns]
                result[first:last] = begin + share * (end - begin)
        return result

    def tremor(self, t_ns: I64) -> F64:
        """Return the tremor's envelope at increasing times, 0 to 1."""
        with self._lock:
            lines, past_ns = self._lines, self._past_ns
        ends = [*(line.since_ns for line in lines[1:]), 1 << 62]
        moves = [
            (line.since_ns - past_ns, min(line.end_ns, end) - past_ns)
            for line, end in zip(lines, ends, strict=True)
            if line.since_ns < min(line.end_ns, end)
        ]
        return tremor_envelope(moves, t_ns)

    def moving(self, now_ns: int) -> bool:
        """Return whether the tool centre point is moving at a true time of the trial."""
        with self._lock:
            total = now_ns + self._past_ns
            current = [line for line in self._lines if line.since_ns <= total][-1]
            return total < current.end_ns

    def _on_line(self, line: StraightMove, t_s: float) -> None:
        since = self._controller.to_device(round(t_s * 1e9))
        end = self._controller.to_device(round((line.start_s + line.ramp.seconds) * 1e9))
        begin_state, end_state = self._state(line.begin), self._state(line.end)
        with self._lock:
            # times never decrease: a line that replaces another within its cycle supersedes it
            earlier = [line for line in self._lines if line.since_ns < since]
            self._lines = [*earlier, _TimedLine(line, since, end, begin_state, end_state)]
