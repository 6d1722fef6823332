"""The simulated arm's position at any time: true plate, commanded legs, deviation.

Rotation vectors are in degrees; a state is xyz, rotation vector and the sensor's six numbers
relative to the true plate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.fault_book import NEVER, FaultBook
from sliplab.plugins.simulation.settings import PlatePosition
from sliplab.rigs.core.capabilities import Pose, Segment
from sliplab.rigs.core.fake_motion import Ramp
from sliplab.rigs.core.faults import ArmOffPath

F64 = npt.NDArray[np.float64]


@lru_cache(maxsize=64)
def matrix(rotvec_deg: tuple[float, float, float]) -> F64:
    """Rotation matrix of a rotation vector in degrees (Rodrigues), shape (3, 3); do not modify.

    Cached, because a tool seldom rotates.
    """
    vector = np.radians(np.asarray(rotvec_deg, np.float64))
    angle = float(np.sqrt(vector @ vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross)


def rotvec_deg(rotation: F64) -> tuple[float, float, float]:
    """Rotation vector of a matrix, degrees; for angles below 180."""
    axis = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    sine = 0.5 * float(np.sqrt(axis @ axis))
    angle = math.atan2(sine, 0.5 * (float(np.trace(rotation)) - 1.0))
    scale = 0.5 if sine < 1e-12 else 0.5 * angle / sine
    x, y, z = np.degrees(axis * scale).tolist()
    return x, y, z


class TrueSurface:
    """The true surface of the plate in the arm's base frame: x right, y up, z into the plate.

    These axes are right-handed as the outside camera sees them, from behind.
    """

    def __init__(self, origin_mm: F64, rotation: F64, tip_mm: F64 | None = None) -> None:
        """`tip_mm`: true position of the tip from the reported tool centre point, tool axes."""
        self.origin_mm = origin_mm
        self.rotation = rotation
        self.tip_mm = np.zeros(3) if tip_mm is None else tip_mm

    @classmethod
    def from_settings(
        cls, contact: PlatePosition, tip_mm: Sequence[float] = (0, 0, 0)
    ) -> TrueSurface:
        """Tilt the nominal plane about an axis in it, and offset it along its normal."""
        nominal = matrix(contact.nominal_rotvec_deg)
        azimuth = math.radians(contact.tilt_axis_deg)
        tilt = matrix(
            (
                contact.tilt_deg * math.cos(azimuth),
                contact.tilt_deg * math.sin(azimuth),
                0.0,
            )
        )
        rotation = nominal @ tilt
        origin = np.asarray(contact.nominal_origin_mm) + contact.offset_mm * rotation[:, 2]
        return cls(origin, rotation, np.asarray(tip_mm, np.float64))

    def pose(self, x_mm: float, y_mm: float, depth_mm: float) -> Pose:
        """Return the tool pose that places the sensor there, parallel to the plate."""
        place = np.array([x_mm, y_mm, depth_mm]) - self.tip_mm
        x, y, z = (self.origin_mm + self.rotation @ place).tolist()
        return Pose((x, y, z), rotvec_deg(self.rotation))

    def sensor(self, pose: Pose) -> F64:
        """Return x, y, depth (mm) of the highest tip, slopes of depth over the layout, turn, (6,).

        The turn is the angle of the tool about the plate's normal, rad, from x to y.
        """
        tool = self.rotation.T @ matrix(pose.rotvec_deg)
        place = self.rotation.T @ (np.asarray(pose.xyz_mm) - self.origin_mm) + tool @ self.tip_mm
        return np.array([*place, tool[2, 0], tool[2, 1], math.atan2(tool[1, 0], tool[0, 0])])

    def turned_deg(self, pose: Pose, twist_rad: float = 0.0) -> float:
        """Angle between the tool's axes and the plate's, after the tool turned about its own z."""
        turn = matrix((0.0, 0.0, math.degrees(twist_rad)))
        trace = float(np.trace(self.rotation.T @ matrix(pose.rotvec_deg) @ turn.T))
        return math.degrees(math.acos(min(max(0.5 * (trace - 1.0), -1.0), 1.0)))


I64 = npt.NDArray[np.int64]
_LOOK_BACK_NS = 1_000_000
_MOVING_MM = 1e-9
_X, _Y, _DEPTH = 6, 7, 8
"""Columns of an arm state: the sensor's position on the plate, and its depth."""


class ToolDeviation:
    """Deviation of the tool from its commanded position, as an arm state to be added."""

    def __init__(
        self, book: FaultBook, plane: TrueSurface, commanded: Callable[[I64], F64]
    ) -> None:
        """`commanded`: maps increasing true times, ns, (n,) to states, (n, 12)."""
        self._book, self._plane, self._commanded = book, plane, commanded
        self._frozen_ns = NEVER

    def __bool__(self) -> bool:
        return bool(self._book.of(ArmOffPath))

    def freeze(self, at_ns: int) -> None:
        """Freeze the deviation, because the arm has stopped."""
        self._frozen_ns = min(self._frozen_ns, at_ns)

    def at(self, t_ns: I64) -> F64:
        """Return deviations at true times, (n, 12): positions of tool and sensor, mm."""
        result = np.zeros((len(t_ns), 12))
        for fault, begin, end in self._book.spans(ArmOffPath):
            t = np.minimum(t_ns, self._frozen_ns)
            offset_mm = fault.mm * np.clip((t - begin) / (end - begin), 0.0, 1.0)
            if offset_mm.any():
                lateral = offset_mm[:, None] * self._direction(fault, begin)
                result[:, :3] += lateral @ self._plane.rotation[:, :2].T
                result[:, _X : _Y + 1] += lateral
        return result

    def _direction(self, fault: ArmOffPath, at_ns: int) -> F64:
        """Unit vector on the plate, (2,)."""
        if fault.direction_deg is not None:
            angle = math.radians(fault.direction_deg)
            return np.array([math.cos(angle), math.sin(angle)])
        # from the past motion, because the future path may still change
        states = self._commanded(np.array([at_ns - _LOOK_BACK_NS, at_ns], np.int64))
        x, y = (states[1] - states[0])[_X : _Y + 1].tolist()
        length = math.hypot(x, y)
        return np.array([0.0, 1.0]) if length < _MOVING_MM else np.array([-y, x]) / length


TURN_DEG_PER_S = 30.0
FADE_NS = 200_000_000
"""Time in which a tremor builds up and decays."""
EVERY = slice(0, 12)
TOOL, SENSOR = slice(0, 6), slice(6, 12)
"""Columns of a state."""
TURN = 11
"""Column of a state: the angle about the plate's normal, rad."""


@dataclass(frozen=True, eq=False)
class Leg:
    """One straight move; states are xyz, rotation vector, then the sensor's six numbers."""

    start_ns: int
    end_ns: int
    start: F64
    end: F64
    planned: tuple[int, F64] | None = None
    """Planned end time and state of a leg that was cut short."""
    turns: bool = False
    """A turn on the spot: orientations follow the shortest rotation, not a line."""
    ramp: Ramp | None = None
    """Acceleration and braking; None: full speed from the start to the end."""

    def at(self, t_ns: I64, columns: slice = EVERY) -> F64:
        """Return states at times within the leg, shape (n, 12) or those columns."""
        end_ns, end = self.planned or (self.end_ns, self.end)
        start = self.start[columns]
        if self.ramp is None:
            share = (t_ns - self.start_ns) / (end_ns - self.start_ns)
        else:
            share = self.ramp.shares((t_ns - self.start_ns) / 1e9)
        result: F64 = start + share[:, None] * (end[columns] - start)
        if self.turns and columns.start == 0:
            from scipy.spatial.transform import Rotation  # a plan is read without it

            begin = Rotation.from_rotvec(self.start[3:6], degrees=True)
            turn = (begin.inv() * Rotation.from_rotvec(end[3:6], degrees=True)).as_rotvec()
            turned = begin * Rotation.from_rotvec(share[:, None] * turn)
            result[:, 3:6] = turned.as_rotvec(degrees=True)
        return result


class ArmPath:
    """Legs in order of time; the arm is at rest between and after them.

    Attributes:
        ramp_mm_s2: acceleration of legs that begin or end in contact; infinite without ramps.
    """

    def __init__(self, plane: TrueSurface, pose: Pose) -> None:
        self._plane = plane
        self._rest = self._state(pose)
        self.legs: list[Leg] = []
        self.deviation: ToolDeviation | None = None
        self.ramp_mm_s2 = math.inf

    def restart(self, now_ns: int) -> None:
        """Discard the legs; the arm rests at its commanded position at `now_ns`."""
        self._rest = self.commanded(np.array([now_ns], np.int64))[0]
        self.legs = []

    def follow(self, segments: Sequence[Segment], now_ns: int) -> list[Leg]:
        """Append legs that begin at `now_ns`, and return them."""
        state, begin, legs = self.commanded(np.array([now_ns], np.int64))[0], now_ns, []
        for segment in segments:
            target = self._state(segment.to)
            travel = math.dist(state[:3], target[:3]) / segment.speed_mm_s
            turn = math.dist(state[3:6], target[3:6]) / TURN_DEG_PER_S
            if segment.turn_deg_s is not None:
                turn = abs(math.degrees(_unwound(target, state) - state[TURN])) / segment.turn_deg_s
                target[TURN] = _unwound(target, state)
            ramp = self._ramp(state, target, segment.speed_mm_s) if travel > turn else None
            seconds = max(travel, turn) if ramp is None else ramp.seconds
            end = begin + round(seconds * 1e9)
            turns = segment.turn_deg_s is not None
            legs.append(Leg(begin, end, state, target, turns=turns, ramp=ramp))
            state, begin = target, end
        self.legs += legs
        return legs

    def _ramp(self, state: F64, target: F64, speed_mm_s: float) -> Ramp | None:
        """Return the ramp of a leg from one state to another; None if it has none."""
        clear = max(state[_DEPTH], target[_DEPTH]) <= 0.0
        if clear or math.isinf(self.ramp_mm_s2):
            return None
        return Ramp(math.dist(state[:3], target[:3]), speed_mm_s, self.ramp_mm_s2)

    def cut(self, now_ns: int) -> None:
        """Stop at `now_ns`."""
        retained = [leg for leg in self.legs if leg.start_ns < now_ns]
        if retained and retained[-1].end_ns > now_ns:
            leg = retained[-1]
            here = leg.at(np.array([now_ns], np.int64))[0]
            # the path up to here stays bit-identical
            planned = leg.planned or (leg.end_ns, leg.end)
            retained[-1] = replace(leg, end_ns=now_ns, end=here, planned=planned)
        self.legs = retained
        if self.deviation is not None:
            self.deviation.freeze(now_ns)

    def states(self, t_ns: I64, columns: slice = EVERY) -> F64:
        """Return xyz (mm), rotation vector (deg) and sensor vector at increasing times, (n, 12).

        Args:
            columns: columns to return, such as `TOOL`.
        """
        states = self.commanded(t_ns, columns)
        return states + self.deviation.at(t_ns)[:, columns] if self.deviation else states

    def commanded(self, t_ns: I64, columns: slice = EVERY) -> F64:
        """Return the same as `states` without the deviation."""
        result = np.empty((len(t_ns), columns.stop - columns.start))
        # each leg applies from its start to that of the next
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

    def tremor(self, t_ns: I64) -> F64:
        """Return the tremor's envelope at increasing times, 0 to 1; it decays after a motion."""
        return tremor_envelope([(leg.start_ns, leg.end_ns) for leg in self.legs], t_ns)

    def moving(self, now_ns: int) -> bool:
        """Return whether a leg has not ended."""
        return bool(self.legs) and self.legs[-1].end_ns > now_ns

    def _state(self, pose: Pose) -> F64:
        return np.concatenate([pose.xyz_mm, pose.rotvec_deg, self._plane.sensor(pose)])


def _unwound(target: F64, state: F64) -> float:
    """The turn of `target` as the nearest one to that of `state`, rad."""
    return float(state[TURN] + math.remainder(target[TURN] - state[TURN], 2.0 * math.pi))


def tremor_envelope(moves: Sequence[tuple[int, int]], t_ns: I64) -> F64:
    """Return the tremor's envelope, 0 to 1, at increasing times (n,), for moves (start, end)."""
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
