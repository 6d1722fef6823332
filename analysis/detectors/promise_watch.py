"""A running detector watches its promise of false alarms, and says when it is contradicted.

While nothing slips, alarms at the promised rate or less make the process

    M = mean over r of  r ** alarms * exp(-(r - 1) * promised rate * time)

a supermartingale that begins at 1: each term is the likelihood ratio of r times the rate. So M ever
reaches 20 with a probability of at most 5 %, however long and often one looks (Ville 1939; Wald
1945; mixtures: Robbins 1970). At that moment the promise counts as contradicted, for good. At five
times the promised rate that takes 0.8 of the promised mean time between alarms, in 95 % of runs up
to 3 (tests/analysis/detectors/test_promise_watch.py).

The bound holds where alarms come one by one, at a rate that what came before does not raise above
the promised one. Bursts contradict a promise that holds in the mean; that is meant, since the
promise was made of alarms an hour on this skin. Evidence that stays above the level for over a
second is a burst: an alarm each second, as where levels are set.
"""

from __future__ import annotations

import math

from sliplab.analysis.detectors.alarms import ALARM_US, US_PER_HOUR

RATIOS = (1.5, 2.0, 3.0, 5.0, 10.0)
"""Rates, by the promised one, that M looks for."""
CONTRADICTED = 1 / 0.05


class PromiseWatch:
    """Counts a detector's alarms in time without slip.

    Args:
        per_hour: promised false alarms an hour, at most.
        level: of the evidence above which is an alarm, as where levels are set; a label may last
            longer. None: the label alone is one.

    Attributes:
        alarms: each lasts a second, as in `analysis.detectors.alarms`.
        broken_h: time at which the promise was contradicted; None while it is not.
    """

    def __init__(self, per_hour: float, level: float | None = None) -> None:
        self.per_hour, self.level, self.alarms = per_hour, level, 0
        self.broken_h: float | None = None
        self._us = 0
        self._until_us: int | None = None
        self._alarm_us: int | None = None

    @property
    def hours(self) -> float:
        """Watched time."""
        return self._us / US_PER_HOUR

    def add(self, start_us: int, end_us: int, slip: bool) -> None:
        """Take a decision on a time in which nothing slips; times may overlap, and have gaps."""
        begin_us = start_us if self._until_us is None else max(start_us, self._until_us)
        self._us += max(end_us - begin_us, 0)
        self._until_us = end_us
        if not slip or (self._alarm_us is not None and end_us < self._alarm_us + ALARM_US):
            return
        self._alarm_us = end_us
        self.alarms += 1
        if self.broken_h is None and self.evidence >= CONTRADICTED:
            self.broken_h = self.hours

    @property
    def evidence(self) -> float:
        """M of the module."""
        promised = self.per_hour * self.hours
        logs = [self.alarms * math.log(r) - (r - 1) * promised for r in RATIOS]
        return (
            math.exp(min(max(logs), 700.0))
            / len(logs)
            * sum(math.exp(each - max(logs)) for each in logs)
        )

    @property
    def words(self) -> str:
        """What was counted, and whether it contradicts the promise."""
        counted = f"{self.alarms} alarms in {self.hours:.3g} h"
        if self.broken_h is None:
            return f"{counted} do not contradict at most {self.per_hour:g} an hour"
        return (
            f"{counted} contradict at most {self.per_hour:g} false alarms an hour (95 % sure since "
            f"{self.broken_h:.3g} h)"
        )
