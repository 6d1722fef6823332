"""Forces on the plate while the arm moves: the limit that stops it, and the end of a press.

A press to a force is stopped ahead of it. The normal force is taken on the straight line through
its last 10 ms, which filters noise, and that line is followed through all that passes until the arm
is at rest: the age of the newest sample, and the arm's reaction and braking.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from sliplab.protocols.program import Move, Position, Step, Twist, step_seconds
from sliplab.rigs.core.capabilities import ForceSensor, Pose, RigError
from sliplab.rigs.core.host_clock import OR_BUSY, StallTimer
from sliplab.rigs.core.plate_frame import PlateFrame
from sliplab.rigs.core.pose import angle_deg, distance_mm
from sliplab.storage.streams import WrenchChunk

POLL_S = 0.02
"""Interval at which forces are read, s: how late a limit, an overload or the end of a press may be
seen. A simulated rig without a limit reads them with its other streams."""
SILENT_S = 0.25
"""Longest time without a new sample, s, besides the delay that the rig file states."""
BLIND_MM = 1.0
"""Longest motion in contact without any change of the readings, mm."""
RIM_MM_PER_DEG = 0.2
"""Motion of the skin's rim (a radius of some 11 mm) in a turn on the spot."""
DEVICE = "force sensor"
_DRIFT = 5e-4
"""Largest difference of the rates of two clocks, as a share."""
_OUTWARD_MM = 0.01
"""Depth by which a motion goes outwards: there contact may end, and an ideal sensor reads zero."""
_SAME_N = 1e-6
"""Largest difference of normal forces that are the same, N: a mounting rounds."""
_LINE_NS = 10_000_000
_FEWEST = 5
"""Samples through which a straight line is laid: those of the last 10 ms, at least five."""
_I64 = npt.NDArray[np.int64]
_F64 = npt.NDArray[np.float64]


class ForceLimitError(RigError):
    """A force on the plate above the rig's limit."""


class ForceWatch:
    """A force sensor that is read for its limit; it streams from now on.

    A force that is not finite is a fault. Where a decision hangs on the readings (there is a limit,
    or a press ends at a force) so is a sensor without a newer sample for `SILENT_S`; a sample that
    was on its way for longer than the fastest one by as much is no news. So are forces that stay
    exactly the same while the arm moves `BLIND_MM` in contact, and not outwards, and a normal force
    that is while it goes so much deeper: a single axis may be dead. Clear of the plate an ideal
    simulated sensor is constant; in contact none is.

    Args:
        limit_n: largest force on the plate, in any direction; None for no limit.
        delay_s: shortest time from a load to the host that has its sample.
        longest_s: longest such time.
        now_ns: clock by which silence is measured; left out, the host's.
        zeroed: False where the present load was not taken for zero: the limit then applies to the
            difference from the first readings.
        leaving: True while the arm moves clear of the plate, perhaps from a force above the limit:
            it may not rise.
    """

    def __init__(
        self,
        sensor: ForceSensor,
        plate: PlateFrame,
        limit_n: float | None,
        delay_s: float = 0.0,
        *,
        longest_s: float = 0.0,
        now_ns: Callable[[], int] | None = None,
        zeroed: bool = True,
        leaving: bool = False,
    ) -> None:
        self._sensor, self._limit_n, self._delay_s = sensor, limit_n, delay_s
        self._silent_s, self._now_ns = SILENT_S + longest_s, now_ns
        self._zeroed, self._leaving = zeroed, leaving
        self._to_plate = np.array(plate.force_matrix(sensor.mounting))
        self.needed = limit_n is not None
        """A decision hangs on the readings."""
        self.start()

    def start(self) -> None:
        """Start the sensor's stream; earlier samples are discarded."""
        self._stall = StallTimer(self._now_ns)
        self._t_ns: _I64 = np.empty(0, np.int64)
        self._host_ns: _I64 = np.empty(0, np.int64)
        self._normal_n: _F64 = np.empty(0)
        self._first_n: _F64 | None = None
        self._last: _F64 | None = None
        self._last_normal_n: float | None = None
        self._fresh_ns: int | None = None
        self._soonest_ns = np.inf
        self._changed_at: tuple[Pose, float] | None = None
        self._pressed_at: tuple[float, float] | None = None
        self._sensor.start()

    @property
    def fresh(self) -> bool:
        """True once a sample has arrived."""
        return self._last is not None

    @property
    def normal_n(self) -> float:
        """Normal force on the plate, mean of the last 10 ms that were read; 0 before."""
        return float(self._normal_n.mean()) if len(self._normal_n) else 0.0

    def read(self) -> WrenchChunk:
        """Return the forces since the last call.

        Raises:
            ForceLimitError: the limit is exceeded.
            RigError: the sensor is at fault, or its readings cannot be used.
        """
        chunk = self._sensor.read()
        self._check_shape(chunk)
        if len(chunk):
            finite = np.isfinite(chunk.force_n).all(axis=1)
            if not finite.all():
                bad = chunk.force_n[~finite][0].tolist()
                raise _unusable(f"reads a force that is no number: {bad} N")
            forces = chunk.force_n @ self._to_plate.T
            self._keep(chunk, forces[:, 2])
            self._check_limit(forces)
        if self.needed:
            silent_s = self._stall.waited_s((self._fresh_ns,))
            if silent_s > self._silent_s:
                why = "no sample came" if self._fresh_ns is None else "no newer sample came"
                raise _unusable(f"{why} for {silent_s:.2f} s", OR_BUSY)
        return chunk

    def follow(self, pose: Pose, depth_mm: float) -> None:
        """Hold the readings so far against a motion of the arm that they should show.

        Args:
            pose: measured now.
            depth_mm: in contact, with what the fingers add; negative clear of the plate.

        Raises:
            RigError: the readings have not changed at all, or the normal force has not.
        """
        self._follow_motion(pose, depth_mm)
        self._follow_depth(depth_mm)

    def _follow_motion(self, pose: Pose, depth_mm: float) -> None:
        """Raise RigError if the arm moved in contact, and the readings have not changed at all."""
        before = self._changed_at
        if before is None or depth_mm <= 0 or depth_mm < before[1] - _OUTWARD_MM:
            self._changed_at = pose, depth_mm
            return
        moved_mm = max(distance_mm(before[0], pose), depth_mm - before[1])
        if before[0].rotvec_deg != pose.rotvec_deg:
            moved_mm = max(moved_mm, RIM_MM_PER_DEG * angle_deg(before[0], pose))
        if self.needed and moved_mm > BLIND_MM:
            raise _unusable(f"reads exactly the same since the arm moved {moved_mm:.1f} mm")

    def _follow_depth(self, depth_mm: float) -> None:
        """Raise RigError if the arm went deeper in contact and the normal force did not change."""
        before = self._pressed_at
        if before is None or depth_mm <= 0 or depth_mm < before[0]:
            if self._last_normal_n is not None:
                self._pressed_at = depth_mm, self._last_normal_n
            return
        deeper_mm = depth_mm - before[0]
        if self.needed and deeper_mm > BLIND_MM:
            raise _unusable(f"reads the same normal force since the arm went {deeper_mm:.1f} mm in")

    def _check_shape(self, chunk: WrenchChunk) -> None:
        """Raise RigError if a chunk does not hold one force for each time, as numbers."""
        if not isinstance(chunk, WrenchChunk):
            raise _unusable(f"returned {type(chunk).__name__}, not a WrenchChunk")
        count = len(chunk)
        for name, _, shape, _ in WrenchChunk.KIND.columns.values():
            values = getattr(chunk, name)
            if not isinstance(values, np.ndarray) or values.dtype.kind not in "iuf":
                kind = getattr(values, "dtype", type(values).__name__)
                raise _unusable(f"returned {name} as {kind}, not as an array of numbers")
            if values.shape != (count, *shape):
                raise _unusable(
                    f"returned {name} of the shape {values.shape}, not {(count, *shape)}"
                )

    def _check_limit(self, forces: _F64) -> None:
        """Raise ForceLimitError if one of the forces on the plate, (n, 3), is above the limit."""
        if self._limit_n is None:
            return
        if self._first_n is None:
            self._first_n = forces[0].copy()
            if self._leaving:
                self._limit_n = max(self._limit_n, float(np.linalg.norm(forces, axis=1).max()))
        loads = forces if self._zeroed else forces - self._first_n
        most = float(np.linalg.norm(loads, axis=1).max())
        if not most <= self._limit_n:
            since = "" if self._zeroed else " more than at first (the sensor is not zeroed yet)"
            raise ForceLimitError(
                DEVICE,
                f"{most:.2f} N on the plate{since}, above limits.force = {self._limit_n:g} N of "
                "the rig; the arm was stopped: press less, or see what it touches",
            )

    def seconds_to(self, force_n: float, now_ns: int) -> float:
        """Return the time until the normal force reaches `force_n` at its present rate.

        The rate is a least-squares line through the last 10 ms. A sample's age is measured against
        the one with the least delay among them: later ones were delayed in transit.

        Args:
            now_ns: the host's clock.

        Returns:
            seconds, negative if it is passed; infinite while the force does not rise to it.
        """
        if len(self._t_ns) < 2:
            return np.inf
        age_s = (self._t_ns - (now_ns - int((self._host_ns - self._t_ns).min()))) * 1e-9
        age_s -= self._delay_s
        middle_s, mean_n = age_s.mean(), self._normal_n.mean()
        off_s = age_s - middle_s
        rate = float(off_s @ (self._normal_n - mean_n) / (off_s @ off_s))
        missing_n = force_n - (mean_n - rate * middle_s)
        if rate <= 0:
            return -np.inf if missing_n <= 0 else np.inf
        return float(missing_n / rate)

    def _keep(self, chunk: WrenchChunk, normal_n: _F64) -> None:
        """Keep what the line is laid through: samples newer than all before them."""
        if self._last is None or (chunk.force_n != self._last).any():
            self._changed_at = None
        if self._pressed_at and (np.abs(normal_n - self._pressed_at[1]) > _SAME_N).any():
            self._pressed_at = None
        self._last, self._last_normal_n = chunk.force_n[-1].copy(), float(normal_n[-1])
        t_ns, host_ns = chunk.t_ns, chunk.host_ns
        floor = self._t_ns[-1:] if len(self._t_ns) else np.array([np.iinfo(np.int64).min])
        newer = t_ns > np.maximum.accumulate(np.concatenate([floor, t_ns[:-1]]))
        if not newer.all():
            t_ns, host_ns, normal_n = t_ns[newer], host_ns[newer], normal_n[newer]
        if len(t_ns):
            on_way_ns = host_ns - t_ns
            passed_ns = int(t_ns[-1] - self._t_ns[-1]) if len(self._t_ns) else 0
            soonest_ns = self._soonest_ns + _DRIFT * passed_ns
            self._soonest_ns = min(soonest_ns, float(on_way_ns.min()))
            if on_way_ns[-1] - self._soonest_ns <= 1e9 * self._silent_s:
                self._fresh_ns = int(t_ns[-1])
        t_ns = np.concatenate([self._t_ns, t_ns])
        first = int(np.searchsorted(t_ns, t_ns[-1] - _LINE_NS, side="right"))
        retained = slice(max(min(first, len(t_ns) - _FEWEST), 0), None)
        self._t_ns = t_ns[retained]
        self._host_ns = np.concatenate([self._host_ns, host_ns])[retained]
        self._normal_n = np.concatenate([self._normal_n, normal_n])[retained]


def _unusable(text: str, cause: str = "") -> RigError:
    return RigError(DEVICE, f"{text}; the arm was stopped: check the sensor and its cable{cause}")


@dataclass
class PressPlaces:
    """The places of a program, where a press ends at its force and not at the planned depth.

    Attributes:
        at: place at which the last step ends.
        pressed_mm: depth at which a press to a force ended; None before one.
    """

    at: Position
    pressed_mm: float | None = None
    _shallower_mm: float = field(default=0.0, init=False)

    def step(self, planned: Step) -> Step:
        """Return a step that is less deep, where it is in contact, by as much as the press was."""
        if not self._shallower_mm or not isinstance(planned, Move | Twist):
            return planned
        if planned.to.depth_mm <= 0:
            return planned
        to = replace(planned.to, depth_mm=planned.to.depth_mm - self._shallower_mm)
        return replace(planned, to=to)

    def taken(self, step: Step, position: Callable[[], Position]) -> None:
        """Follow a step that was taken; `position` is asked where a press has ended."""
        self.at = step_seconds(step, self.at)[1]
        if isinstance(step, Move) and step.until_force_n is not None:
            self.pressed_mm = position().depth_mm
            self._shallower_mm = step.to.depth_mm - self.pressed_mm
            self.at = replace(self.at, depth_mm=self.pressed_mm)
