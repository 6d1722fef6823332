"""Rates of false alarms, by the hour in which nothing slips."""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np
import numpy.typing as npt

from sliplab.analysis.metrics.intervals import rate_interval
from sliplab.storage.schema.evaluation import AlarmRate

ENOUGH = 24
"""Trials or worlds from which on intervals of rates hold, whatever the rates (`rate_interval`)."""


def few_words(clusters: int) -> str:
    """Return a warning where so few trials or worlds cannot bound a rate surely; else nothing."""
    if clusters >= ENOUGH:
        return ""
    return (
        f"below {ENOUGH} trials or worlds, here {clusters}, such an interval is too narrow where a "
        "few of them have most alarms"
    )


def alarm_rate(
    alarms: npt.ArrayLike, hours: npt.ArrayLike, strata: Sequence[Hashable] | None = None
) -> AlarmRate:
    """Return a rate with its interval, over trials or worlds.

    Args:
        alarms, hours: (n,), of each trial or world; there are some hours.
        strata: as of `rate_interval`.
    """
    counts, times = np.asarray(alarms, np.float64), np.asarray(hours, np.float64)
    low, high = rate_interval(counts, times, strata) or (None, None)
    total, time = round(float(counts.sum())), float(times.sum())
    return AlarmRate(
        alarms=total, hours=time, value=total / time, low=low, high=high, clusters=len(counts)
    )
