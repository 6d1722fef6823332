"""How long a collection still takes, from what its trials took so far."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from sliplab.flows.running.console import duration
from sliplab.protocols import Plan, Trial


class Remaining:
    """Planned seconds of what is left, times how much longer than planned it went so far.

    A counter of trials would not do: a slow slide takes many times as long as a fast one.

    Args:
        real_time: whether trials take at least their planned time; known before the first one.
        clock: seconds of a clock that only goes forwards.
    """

    def __init__(
        self,
        plan: Plan,
        trials: Sequence[Trial],
        *,
        real_time: bool,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._plan, self._clock, self._real_time = plan, clock, real_time
        self._left = sum(plan.seconds(trial) for trial in trials)
        self._planned_done = 0.0
        self._began = clock()

    def add(self, trials: Sequence[Trial]) -> None:
        """More trials came in."""
        self._left += sum(self._plan.seconds(trial) for trial in trials)

    def done(self, trial: Trial) -> None:
        """One trial is over, whatever became of it."""
        self._left -= self._plan.seconds(trial)
        self._planned_done += self._plan.seconds(trial)

    def pause(self, seconds: float) -> None:
        """Time that went by in a pause does not count."""
        self._began += seconds

    @property
    def seconds(self) -> float | None:
        """Seconds still to go; None while nothing is known."""
        if self._planned_done:
            return self._left * (self._clock() - self._began) / self._planned_done
        return self._left if self._real_time else None

    def __str__(self) -> str:
        seconds = self.seconds
        return "" if seconds is None else f"{duration(max(seconds, 0.0))} left"
