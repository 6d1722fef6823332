"""Where the simulated arm is at any time: the legs that it was told to follow, and rest."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from sliplab.rigs.core.capabilities import Pose, Segment
from sliplab.rigs.mock.deviation import Deviation
from sliplab.rigs.mock.geometry import ContactPlane

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
TURN_DEG_PER_S = 30.0
FADE_NS = 200_000_000
"""How long a tremor takes to build up and to die away."""
EVERY = slice(0, 11)
TOOL, SENSOR = slice(0, 6), slice(6, 11)
"""Columns of a state."""


@dataclass(frozen=True, eq=False)
class Leg:
    """One straight move; `state` vectors are xyz, rotation vector, then the sensor's five."""

    start_ns: int
    end_ns: int
    start: F64
    end: F64
    planned: tuple[int, F64] | None = None
    """When and where it would have ended, had the arm not been stopped."""

    def at(self, t_ns: I64, columns: slice = EVERY) -> F64:
        """States at times within the leg, shape (n, 11) or those columns."""
        end_ns, end = self.planned or (self.end_ns, self.end)
        start = self.start[columns]
        share = (t_ns - self.start_ns) / (end_ns - self.start_ns)
        result: F64 = start + share[:, None] * (end[columns] - start)
        return result


class ArmPath:
    """Legs in order of time, with rest between and after them."""

    def __init__(self, plane: ContactPlane, pose: Pose) -> None:
        self._plane = plane
        self._rest = self._state(pose)
        self.legs: list[Leg] = []
        self.deviation: Deviation | None = None

    def restart(self, now_ns: int) -> None:
        """Forget the legs; the arm stands where it should be at `now_ns`."""
        self._rest = self.commanded(np.array([now_ns], np.int64))[0]
        self.legs = []

    def follow(self, segments: Sequence[Segment], now_ns: int) -> list[Leg]:
        """Append legs that begin at `now_ns`; returns them."""
        state, begin, legs = self.commanded(np.array([now_ns], np.int64))[0], now_ns, []
        for segment in segments:
            target = self._state(segment.to)
            travel = math.dist(state[:3], target[:3]) / segment.speed_mm_s
            turn = math.dist(state[3:6], target[3:6]) / TURN_DEG_PER_S
            end = begin + round(max(travel, turn) * 1e9)
            legs.append(Leg(begin, end, state, target))
            state, begin = target, end
        self.legs += legs
        return legs

    def cut(self, now_ns: int) -> None:
        """Stand still from `now_ns` on."""
        kept = [leg for leg in self.legs if leg.start_ns < now_ns]
        if kept and kept[-1].end_ns > now_ns:
            leg = kept[-1]
            here = leg.at(np.array([now_ns], np.int64))[0]
            # the way there stays the same to the bit
            planned = leg.planned or (leg.end_ns, leg.end)
            kept[-1] = replace(leg, end_ns=now_ns, end=here, planned=planned)
        self.legs = kept
        if self.deviation is not None:
            self.deviation.freeze(now_ns)

    def states(self, t_ns: I64, columns: slice = EVERY) -> F64:
        """xyz (mm), rotation vector (deg) and sensor vector at rising times, shape (n, 11).

        Args:
            columns: those wanted, such as `TOOL`.
        """
        states = self.commanded(t_ns, columns)
        return states + self.deviation.at(t_ns)[:, columns] if self.deviation else states

    def commanded(self, t_ns: I64, columns: slice = EVERY) -> F64:
        """The same, as the arm was told: without its deviation."""
        result = np.empty((len(t_ns), columns.stop - columns.start))
        # each leg holds from its start to that of the next
        begins = np.searchsorted(t_ns, np.array([leg.start_ns for leg in self.legs], np.int64))
        edges = [*begins.tolist(), len(t_ns)]
        result[: edges[0]] = self._rest[columns]
        for leg, first, last in zip(self.legs, edges[:-1], edges[1:], strict=True):
            if first < last:
                ended = first + int(np.searchsorted(t_ns[first:last], leg.end_ns))
                if first < ended:
                    result[first:ended] = leg.at(t_ns[first:ended], columns)
                result[ended:last] = leg.end[columns]
        return result

    def stirred(self, t_ns: I64) -> F64:
        """How much the arm trembles at rising times, 0 to 1: it fades in and out with motion."""
        return stirred([(leg.start_ns, leg.end_ns) for leg in self.legs], t_ns)

    def moving(self, now_ns: int) -> bool:
        """Whether a leg is yet to end."""
        return bool(self.legs) and self.legs[-1].end_ns > now_ns

    def _state(self, pose: Pose) -> F64:
        return np.concatenate([pose.xyz_mm, pose.rotvec_deg, self._plane.sensor(pose)])


def stirred(moves: Sequence[tuple[int, int]], t_ns: I64) -> F64:
    """Strength of the tremor, 0 to 1, at rising times (n,), for moves from one time to another."""
    if not len(t_ns):
        return np.zeros(0)
    runs: list[tuple[int, int]] = []
    for start, end in moves:
        if runs and runs[-1][1] == start:
            runs[-1] = (runs[-1][0], end)
        else:
            runs.append((start, end))
    result = np.zeros(len(t_ns))
    for start, end in runs:
        if start > t_ns[-1] or end + FADE_NS < t_ns[0]:
            continue
        risen = np.clip((np.minimum(t_ns, end) - start) / FADE_NS, 0.0, 1.0)
        fallen = np.maximum(t_ns - end, 0) / FADE_NS
        np.maximum(result, risen - fallen, out=result)
    return result
