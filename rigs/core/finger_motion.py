"""Motion of a gripper's fingers: reaction, finite speed and acceleration, stall at a force.

Fingers that close stall where the force on them would pass the limit of their move, and stay there:
the gear of a parallel gripper is self-locking. Forces are not known here; the contact simulation
reports where the limit is reached (`stall`). Simulated fingers and the fakes of grippers share this
motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from threading import Lock

import numpy as np
import numpy.typing as npt

from sliplab.rigs.core.fake_motion import STILL, Ramp

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
_EVER_NS = -(1 << 62)


@dataclass(frozen=True)
class _Leg:
    """One move of the fingers, from one opening to another, mm; it applies from `since_ns`."""

    since_ns: int
    start_ns: int
    begin_mm: float
    end_mm: float
    ramp: Ramp
    force_n: float

    @property
    def end_ns(self) -> int:
        return self.start_ns + round(self.ramp.seconds * 1e9)

    def at(self, t_ns: I64) -> F64:
        """Return openings at times, (n,)."""
        share = self.ramp.shares((t_ns - self.start_ns) / 1e9)
        result: F64 = self.begin_mm + share * (self.end_mm - self.begin_mm)
        return result


class FingerMotion:
    """Opening between a gripper's fingers over time; thread-safe.

    Args:
        opening_mm: at first.
        reaction_ns: from a command to the beginning of its motion, or of its braking.
        acceleration_mm_s2: of the opening, when it speeds up and when it brakes.
    """

    def __init__(self, opening_mm: float, reaction_ns: int, acceleration_mm_s2: float) -> None:
        self._reaction_ns, self._acceleration = reaction_ns, acceleration_mm_s2
        self._lock = Lock()
        self._legs = [_Leg(_EVER_NS, _EVER_NS, opening_mm, opening_mm, STILL, 0.0)]
        self._stalled = False

    @property
    def stalled(self) -> bool:
        """True where the last move ended at its force."""
        return self._stalled

    @property
    def target_mm(self) -> float:
        """Opening at which the last move ends, or has ended."""
        return self._legs[-1].end_mm

    @property
    def last_force_n(self) -> float:
        """Force limit of the last move."""
        return self._legs[-1].force_n

    def opening_mm(self, t_ns: I64) -> F64:
        """Return the openings at increasing times, (n,)."""
        legs = self._legs
        begins = np.searchsorted(t_ns, np.array([leg.since_ns for leg in legs], np.int64))
        edges = [*begins.tolist(), len(t_ns)]
        edges[0] = 0
        result = np.empty(len(t_ns))
        for leg, first, last in zip(legs, edges[:-1], edges[1:], strict=True):
            result[first:last] = leg.at(t_ns[first:last])
        return result

    def moving(self, now_ns: int) -> bool:
        """Return whether a move has not ended, or not begun."""
        return now_ns < self._legs[-1].end_ns

    def move(self, to_mm: float, speed_mm_s: float, force_n: float, now_ns: int) -> None:
        """Go to an opening, from rest at the one that is reached when the fingers react.

        Args:
            force_n: at which closing fingers stall.
        """
        with self._lock:
            self._stalled = False
            start_ns, begin_mm, _ = self._reacting(now_ns)
            ramp = Ramp(abs(to_mm - begin_mm), speed_mm_s, self._acceleration)
            self._follow(_Leg(start_ns, start_ns, begin_mm, to_mm, ramp, force_n))

    def stop(self, now_ns: int) -> None:
        """Brake to rest."""
        with self._lock:
            start_ns, here_mm, speed_mm_s = self._reacting(now_ns)
            leg = self._legs[-1]
            braking_mm = speed_mm_s * speed_mm_s / (2.0 * self._acceleration)
            way_mm = braking_mm if leg.end_mm > leg.begin_mm else -braking_mm
            # a ramp down is the second half of a move twice as long that began in the past
            ramp = Ramp(2.0 * braking_mm, speed_mm_s, self._acceleration) if braking_mm else STILL
            began_ns = start_ns - round(ramp.seconds / 2 * 1e9)
            ends = here_mm - way_mm, here_mm + way_mm
            self._follow(_Leg(start_ns, began_ns, *ends, ramp, leg.force_n))

    def stall(self, at_ns: int) -> None:
        """Hold the fingers where they are at a time, because the force of their move is reached."""
        with self._lock:
            here_mm = float(self.opening_mm(np.array([at_ns], np.int64))[0])
            leg = self._legs[-1]
            self._stalled = True
            self._follow(_Leg(at_ns, at_ns, here_mm, here_mm, STILL, leg.force_n))

    def closing_force_n(self, first_ns: int, last_ns: int) -> float | None:
        """Return the force limit of a move that closes the fingers between two times, or None."""
        for leg in reversed(self._legs):
            closes = leg.end_mm < leg.begin_mm
            if closes and leg.since_ns < last_ns and first_ns < leg.end_ns:
                return leg.force_n
            if leg.since_ns <= first_ns:
                break
        return None

    def restart(self, now_ns: int) -> None:
        """Count times from `now_ns` on; the fingers continue their motion."""
        with self._lock:
            last = self._legs[-1]
            self._legs = [
                _Leg(
                    _EVER_NS,
                    last.start_ns - now_ns,
                    last.begin_mm,
                    last.end_mm,
                    last.ramp,
                    last.force_n,
                )
            ]

    def _reacting(self, now_ns: int) -> tuple[int, float, float]:
        """Return when a command of now takes effect, and opening (mm) and speed (mm/s) then."""
        start_ns = now_ns + self._reaction_ns
        leg = self._legs[-1]
        here_mm = float(self.opening_mm(np.array([start_ns], np.int64))[0])
        return start_ns, here_mm, leg.ramp.at((start_ns - leg.start_ns) / 1e9)[1]

    def _follow(self, leg: _Leg) -> None:
        self._legs = [*(old for old in self._legs if old.since_ns < leg.since_ns), leg]
