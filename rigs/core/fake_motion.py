"""Motion of a fake's tool centre point: straight lines at constant speed, with speed ramps.

A fake reads its pose from a `StraightMotion` alone; a simulated scene subscribes to its lines
(`on_line`) and so follows the same moves.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from threading import Lock

import numpy as np
import numpy.typing as npt

from sliplab.rigs.core.capabilities import Pose
from sliplab.rigs.core.pose import angle_deg, between, distance_mm, straight_path

F64 = npt.NDArray[np.float64]
_OFF_LINE_MM = 0.01
ON_THE_SPOT_MM = 1e-6
"""Way of the tool centre point below which a move is a turn."""


@dataclass(frozen=True)
class Ramp:
    """Trapezoidal speed profile: distance over time along one line, mm and s."""

    length: float
    speed: float
    acceleration: float

    @property
    def peak(self) -> float:
        """The highest speed reached; a short move never reaches `speed`."""
        return min(self.speed, math.sqrt(self.length * self.acceleration))

    @property
    def seconds(self) -> float:
        """Duration of the whole move."""
        if self.length == 0:
            return 0.0
        return self.length / self.peak + self.peak / self.acceleration

    def at(self, t: float) -> tuple[float, float]:
        """Distance travelled and speed at `t` after the start."""
        if t <= 0 or self.length == 0:
            return 0.0, 0.0
        if t >= self.seconds:
            return self.length, 0.0
        up = self.peak / self.acceleration
        left = self.seconds - t
        if t < up:
            return self.acceleration * t * t / 2, self.acceleration * t
        if left < up:
            return self.length - self.acceleration * left * left / 2, self.acceleration * left
        return self.peak * (t - up / 2), self.peak

    def shares(self, t: F64) -> F64:
        """Shares of the distance travelled at times after the start, (n,)."""
        if self.length == 0:
            return np.ones(len(t))
        up = self.peak / self.acceleration
        t = np.clip(t, 0.0, self.seconds)
        left = self.seconds - t
        gone = self.peak * (t - up / 2)
        gone = np.where(left < up, self.length - self.acceleration * left * left / 2, gone)
        gone = np.where(t < up, self.acceleration * t * t / 2, gone)
        result: F64 = np.where(left == 0.0, 1.0, gone / self.length)
        return result


STILL = Ramp(0.0, 1.0, 1.0)
"""A move of no length."""


@dataclass(frozen=True)
class StraightMove:
    """One straight move that starts at a given time, s."""

    begin: Pose
    end: Pose
    ramp: Ramp
    start_s: float

    def pose(self, t_s: float) -> Pose:
        """Return where the tool centre point is."""
        gone, _ = self.ramp.at(t_s - self.start_s)
        if self.ramp.length == 0 or gone >= self.ramp.length:
            return self.end
        return self._path(gone / self.ramp.length)

    @cached_property
    def _path(self) -> Callable[[float], Pose]:
        return straight_path(self.begin, self.end)


class StraightMotion:
    """A tool centre point that can be sent along straight lines, on a clock in seconds.

    Thread-safe; times must not decrease.

    Args:
        on_line: called with every new line and the time from which it applies, s, in the thread
            that commands the move.
    """

    def __init__(
        self, at: Pose, on_line: Callable[[StraightMove, float], None] = lambda line, t_s: None
    ) -> None:
        self._lock, self._on_line = Lock(), on_line
        self._line = StraightMove(at, at, STILL, 0.0)
        self._rest_s = 0.0

    def pose(self, t_s: float) -> Pose:
        """Return where the tool centre point is."""
        with self._lock:
            return self._line.pose(t_s)

    def moving(self, t_s: float) -> bool:
        """Return whether the tool centre point is moving."""
        with self._lock:
            return t_s < self._rest_s

    def move(self, to: Pose, speed_mm_s: float, acceleration_mm_s2: float, t_s: float) -> None:
        """Start a move to `to`; a rotation in place counts its degrees as mm."""
        with self._lock:
            begin = self._line.pose(t_s)
            length = distance_mm(begin, to)
            if length < ON_THE_SPOT_MM:
                length = angle_deg(begin, to) or length
            self._follow(
                StraightMove(begin, to, Ramp(length, speed_mm_s, acceleration_mm_s2), t_s), t_s
            )

    def extend(self, to: Pose, speed_mm_s: float, t_s: float) -> bool:
        """Continue to `to` without stopping, if it lies straight ahead at the same speed.

        Returns:
            Whether the line was extended; if not, nothing has changed.
        """
        with self._lock:
            line = self._line
            if t_s >= self._rest_s or line.ramp.peak != speed_mm_s:
                return False
            if distance_mm(line.begin, to) < ON_THE_SPOT_MM:
                return False
            ramp = replace(line.ramp, length=distance_mm(line.begin, to))
            on_line = between(line.begin, to, line.ramp.length / ramp.length if ramp.length else 0)
            braking = speed_mm_s / ramp.acceleration
            if distance_mm(on_line, line.end) > _OFF_LINE_MM or t_s > self._rest_s - braking:
                return False
            self._follow(replace(line, end=to, ramp=ramp), t_s)
            return True

    def stop(self, deceleration_mm_s2: float, t_s: float) -> None:
        """Brake to rest on the line, at its end at the latest."""
        with self._lock:
            if t_s >= self._rest_s:
                return
            line = self._line
            gone, speed = line.ramp.at(t_s - line.start_s)
            braking_mm = min(speed * speed / (2 * deceleration_mm_s2), line.ramp.length - gone)
            share = (gone + braking_mm) / line.ramp.length
            target = between(line.begin, line.end, share)
            if braking_mm <= 0 or speed <= 0:
                here = line.pose(t_s)
                self._follow(StraightMove(here, here, STILL, t_s), t_s)
                return
            # A ramp down is the second half of a move twice as long that began in the past.
            brake = speed * speed / (2 * braking_mm)
            past = _pose_before(line, gone, braking_mm)
            ramp = Ramp(2 * braking_mm, speed, brake)
            self._follow(StraightMove(past, target, ramp, t_s - ramp.seconds / 2), t_s)

    def _follow(self, line: StraightMove, t_s: float) -> None:
        self._line, self._rest_s = line, line.start_s + line.ramp.seconds
        self._on_line(line, t_s)


def _pose_before(line: StraightMove, gone: float, distance_mm: float) -> Pose:
    """Return the pose `distance_mm` before the current one, extrapolated before the start."""
    return between(line.begin, line.end, (gone - distance_mm) / line.ramp.length)


@dataclass(frozen=True)
class ControllerClock:
    """A controller's clock, which times the cycles of a fake."""

    now_s: Callable[[], float]
    """The controller's time, s."""
    rate: float = 1.0
    """Controller seconds per host second. More than 1 makes tests of slow slides fast."""


def running_clock(
    rate: float = 1.0,
    offset_s: float = 1000.0,
    host_s: Callable[[], float] = time.monotonic,
) -> ControllerClock:
    """Return the clock of a controller that is switched on now.

    Args:
        rate: controller seconds per host second.
        offset_s: its time now.
        host_s: the host's monotonic clock, s.
    """
    began = host_s()
    return ControllerClock(lambda: offset_s + (host_s() - began) * rate, rate)
