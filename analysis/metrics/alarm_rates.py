"""Rates of false alarms, by the hour in which nothing slips."""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np
import numpy.typing as npt

from sliplab.analysis.metrics.intervals import rate_interval
from sliplab.storage.schema.evaluation import AlarmRate

ENOUGH = {"alarms": 24, "errors": 36}
"""Trials or worlds from which on intervals of rates and of shares of windows hold, even where a few
have most alarms or errors (`rate_interval`, `benchmarks/interval_coverage.py`)."""


def few_words(clusters: int, counted: str = "alarms") -> str:
    """Return a warning where so few trials or worlds bound nothing surely; else nothing.

    Args:
        counted: a key of `ENOUGH`.
    """
    if clusters >= ENOUGH[counted]:
        return ""
    return (
        f"below {ENOUGH[counted]} trials or worlds, here {clusters}, such an interval is too "
        f"narrow where a few of them have most {counted}"
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
