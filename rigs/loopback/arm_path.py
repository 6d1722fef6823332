"""The simulated world's arm path, where a fake's controller moves the arm.

A fake tells of every new line that its tool centre point follows; the world looks back on
them, ramps and all. True time runs on through all trials; the world counts from its trial's begin.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sliplab.rigs.core.capabilities import Pose, RigError, Segment
from sliplab.rigs.core.fake_motion import STILL, Line, StraightMotion
from sliplab.rigs.mock.path import EVERY, ArmPath, ContactPlane, Leg, stirred
from sliplab.storage.clockmap import ClockMap

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]


@dataclass(frozen=True)
class _Way:
    """A line and the states at its ends; it holds from `since_ns`, true time of all trials."""

    line: Line
    since_ns: int
    end_ns: int
    begin: F64
    end: F64


class FakeArmPath(ArmPath):
    """An arm path that follows the tool centre point of a fake.

    Args:
        plane: the true contact plane.
        pose: where the arm stands.
        controller: true time of all trials to the arm controller's clock, ns.

    Attributes:
        motion: what the fake moves.
        cut_ns: true time of the trial at which something in the world stopped the arm; None until
            then. The fake has to stop too.
    """

    def __init__(self, plane: ContactPlane, pose: Pose, controller: ClockMap) -> None:
        super().__init__(plane, pose)
        self._controller = controller
        self._past_ns = 0
        self._lock = threading.Lock()
        rest = Line(pose, pose, STILL, 0.0)
        self._ways = [_Way(rest, -(1 << 62), -(1 << 62), self._rest, self._rest)]
        self.motion = StraightMotion(pose, self._on_line)
        self.cut_ns: int | None = None

    def begin(self, past_ns: int) -> None:
        """A trial begins: its time 0 is the true time `past_ns`; older ways are forgotten."""
        with self._lock:
            self._past_ns, self.cut_ns = past_ns, None
            kept = [way for way in self._ways if way.since_ns > past_ns]
            self._ways = [*self._ways[: len(self._ways) - len(kept)][-1:], *kept]

    def restart(self, now_ns: int) -> None:
        """The ways go on; `begin` forgets them."""

    def follow(self, segments: Sequence[Segment], now_ns: int) -> list[Leg]:
        """Nobody but the fake moves this arm.

        Raises:
            RigError: always.
        """
        raise RigError("arm", "is moved by its controller")

    def cut(self, now_ns: int) -> None:
        """Stop the arm by something in the world: see `cut_ns`."""
        if self.cut_ns is None:
            self.cut_ns = now_ns

    def commanded(self, t_ns: I64, columns: slice = EVERY) -> F64:
        """States at rising true times of the trial, shape (n, 11) or those columns."""
        with self._lock:
            ways, past_ns = self._ways, self._past_ns
        result = np.empty((len(t_ns), columns.stop - columns.start))
        total = np.asarray(t_ns, np.int64) + past_ns
        begins = np.searchsorted(total, np.array([way.since_ns for way in ways], np.int64))
        edges = [*begins.tolist(), len(total)]
        edges[0] = 0
        for way, first, last in zip(ways, edges[:-1], edges[1:], strict=True):
            if first < last:
                seconds = self._controller.to_reference(total[first:last]) / 1e9
                share = way.line.ramp.shares(seconds - way.line.start_s)[:, None]
                begin, end = way.begin[columns], way.end[columns]
                result[first:last] = begin + share * (end - begin)
        return result

    def stirred(self, t_ns: I64) -> F64:
        """Return how much the arm trembles at rising times, 0 to 1."""
        with self._lock:
            ways, past_ns = self._ways, self._past_ns
        ends = [*(way.since_ns for way in ways[1:]), 1 << 62]
        moves = [
            (way.since_ns - past_ns, min(way.end_ns, end) - past_ns)
            for way, end in zip(ways, ends, strict=True)
            if way.since_ns < min(way.end_ns, end)
        ]
        return stirred(moves, t_ns)

    def moving(self, now_ns: int) -> bool:
        """Return whether the tool centre point is on its way at a true time of the trial."""
        with self._lock:
            total = now_ns + self._past_ns
            way = [way for way in self._ways if way.since_ns <= total][-1]
            return total < way.end_ns

    def _on_line(self, line: Line, t_s: float) -> None:
        since = self._controller.to_device(round(t_s * 1e9))
        end = self._controller.to_device(round((line.start_s + line.ramp.seconds) * 1e9))
        begin_state, end_state = self._state(line.begin), self._state(line.end)
        with self._lock:
            # times never run back: a line that replaces another within its cycle holds instead
            earlier = [way for way in self._ways if way.since_ns < since]
            self._ways = [*earlier, _Way(line, since, end, begin_state, end_state)]
