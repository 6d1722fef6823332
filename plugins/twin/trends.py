"""Trends from the first slide of a pilot to the last, which worlds do not model.

Each number is a change over the whole pilot in units of its standard error, by regression on
the slides' order. Slides of one depth are compared, and those since one measurement of depth zero:
an error of it changes forces and lags as wear does.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import norm
from scipy.stats import t as student

from sliplab.plugins.twin.contact_forces import gross_forces
from sliplab.plugins.twin.contact_lags import SteadyLags
from sliplab.plugins.twin.contact_slips import SlideSlips, find_slips, mean_seen
from sliplab.plugins.twin.pilot import PilotTrial
from sliplab.storage.streams import F64

ALIKE = 0.005
"""Changes by this share are within what slides differ by anyway."""
FEWEST = 8
LEAST = 1e-300
"""Probability that a deviate of 37 has."""


def trend(values: F64, order: F64, others: F64) -> float:
    """Return how far a change of values over their order is from none; NaN with too few.

    Student's t of the slope, as the standard normal deviate that is as improbable.

    Args:
        values: (k,), NaN where not known. order: (k,), 0 to 1. others: (k, c), what values depend
            on besides.
    """
    known = np.isfinite(values) & np.isfinite(others).all(axis=1)
    design = np.column_stack([order, np.ones(len(order)), others])[known]
    if known.sum() < FEWEST:
        return float("nan")
    best, _, rank, _ = np.linalg.lstsq(design, values[known], rcond=1e-9)
    free = int(known.sum()) - rank
    rest = values[known] - design @ best
    inverse = np.linalg.pinv(design.T @ design, rcond=1e-9)
    if free < 3 or rank < 2:
        return float("nan")
    error = np.sqrt(np.sum(rest**2) / free * inverse[0, 0])
    distance = abs(float(best[0])) / float(np.hypot(error, ALIKE))
    # few slides and many conditions leave few degrees of freedom
    return float(norm.isf(max(student.sf(distance, free), LEAST)))


LAG, PULL, RATIO = "lag_trend", "pull_trend", "ratio_trend"


def contact_trends(slips: SlideSlips, steady: SteadyLags) -> dict[str, float]:
    """Return the trends of lags, of forces over lags, and of friction force over normal force."""
    order, others = _conditions(slips)
    _, which = slips.depths
    lag = np.where(slips.free | ~(steady.lag_mm > 0.0), np.nan, steady.lag_mm)
    # each papilla against itself at that depth
    off = np.full(lag.shape, np.nan)
    for level in np.unique(which):
        own = np.log(lag[which == level])
        off[which == level] = own - mean_seen(own)
    lagging = mean_seen(off, axis=1)
    gross = gross_forces(slips)
    with np.errstate(invalid="ignore", divide="ignore"):
        pull, ratio = np.log(gross[:, 0]), np.log(gross[:, 0] / gross[:, 1])
    return {
        LAG: trend(lagging, order, others),
        PULL: trend(pull - lagging, order, others),
        RATIO: trend(ratio, order, others),
    }


def shift_trend(trials: Sequence[PilotTrial], shift_px: F64) -> float:
    """Return the trend of the event image's shift at a slide's end over the tips' lags.

    Both go with the forces on the papillae, the lags by their stiffness.

    Args:
        shift_px: of each trial, (k,).
    """
    slips = find_slips(trials)
    if slips is None or len(slips.trials) < len(trials):
        return float("nan")
    lags = np.array([mean_seen(lag[-10:]).sum() for lag in slips.lag_mm])
    order, others = _conditions(slips, with_speed=False)
    with np.errstate(invalid="ignore", divide="ignore"):
        return trend(np.log(shift_px / lags), order, others)


def plain_trend(values: Sequence[float] | F64) -> float:
    """Return the trend of the logarithms of values that depend on nothing but their order."""
    with np.errstate(invalid="ignore", divide="ignore"):
        logarithm = np.log(np.array(values, np.float64))
    logarithm[~np.isfinite(logarithm)] = np.nan
    return trend(logarithm, _order(len(logarithm)), np.empty((len(logarithm), 0)))


def _order(k: int) -> F64:
    return np.arange(k) / max(k - 1, 1)


def _conditions(slips: SlideSlips, with_speed: bool = True) -> tuple[F64, F64]:
    """Return the slides' order, 0 to 1, (k,), and what forces depend on besides, (k, c)."""
    levels, which = slips.depths
    _, block = np.unique([trial.zero_mm for trial in slips.trials], return_inverse=True)
    columns = [which == level for level in range(1, len(levels))]
    columns += [block == number for number in range(1, int(block.max()) + 1)]
    if with_speed:
        columns.append(np.log(slips.speed_mm_s))
    return _order(len(which)), np.array(columns, np.float64).reshape(-1, len(which)).T
