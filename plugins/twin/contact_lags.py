"""Lags of sliding tips: their growth while springs relax, and their values in steady slip.

A tip that let go follows its base at the distance at which its spring pulls with friction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from sliplab.plugins.twin.contact_slips import (
    AFTER_S,
    LEAST_PATH_MM,
    SETTLES_S,
    SlideSlips,
    mean_seen,
)
from sliplab.storage.streams import F64

VARIATION, CORRELATION_MM, TREMOR_MM = 0.05, 0.5, 0.007
"""Supposed for weights only: friction's variation along a path, its length, the arm's tremor."""
LEAST_STRETCH_MM = 0.15
"""Slips of springs that were stretched less depend more on the tremor than on friction."""


@dataclass(frozen=True)
class Growth:
    """Growth of a lag after a slip while the stretched spring relaxes.

    Attributes:
        maxwell: stiffness of the relaxing branch over the other. relaxation_s: its time.
        drop: of the force where a tip lets go, relative, at the mean speed; drop_per_speed: its
            slope over the logarithm of speed.
    """

    maxwell: float = 0.25
    relaxation_s: float = 1.0
    drop: float = 0.0
    drop_per_speed: float = 0.0

    def __call__(self, stuck_s: F64, after_s: F64, log_speed: F64) -> F64:
        """Lag over the stretch at the slip; arguments broadcast.

        A standard linear solid that is stretched at constant speed for t pulls with
        k (u + q), q = m v tau (1 - e^(-t/tau)). From then on lag + q is constant, and q decays with
        the time tau (1 + m).

        Args:
            stuck_s: from the start of the slide to the slip. log_speed: over the mean speed.
        """
        share = stuck_s / self.relaxation_s
        begin = self.maxwell * -np.expm1(-share) / share
        left = np.exp(-after_s / (self.relaxation_s * (1.0 + self.maxwell)))
        drop = self.drop + self.drop_per_speed * log_speed
        result: F64 = (1.0 - drop) * (1.0 + begin) - begin * left
        return result


def fit_growth(slips: SlideSlips) -> Growth | None:
    """Fit how lags grow after the slips, all together; None without enough of them."""
    use = slips.slid & (slips.stretch_mm >= LEAST_STRETCH_MM)
    k, j = np.nonzero(use)
    ratio = slips.after_mm[k, j] / slips.stretch_mm[k, j][:, None]
    known = np.isfinite(ratio)
    if known.sum() < 40:
        return None
    speed = slips.speed_mm_s[k][:, None]
    log_speed = np.log(speed / np.exp(np.mean(np.log(slips.speed_mm_s))))
    wander = VARIATION**2 * -np.expm1(-((speed * AFTER_S / CORRELATION_MM) ** 2))
    error = np.sqrt(2e-3**2 + 2 * wander + (TREMOR_MM / slips.stretch_mm[k, j][:, None]) ** 2)
    stuck = np.maximum(slips.slipped_s[k, j], 1e-3)[:, None]

    def growth(x: F64) -> Growth:
        return Growth(float(np.exp(x[0])), float(np.exp(x[1])), float(x[2]), float(x[3]))

    def residuals(x: F64) -> F64:
        return ((growth(x)(stuck, AFTER_S, log_speed) - ratio) / error)[known]

    several = np.ptp(log_speed) > 0.05
    begin = np.array([np.log(0.25), 0.0, 0.0, 0.0])
    free = slice(0, 4 if several else 3)

    def reduced(x: F64) -> F64:
        full = begin.copy()
        full[free] = x
        return residuals(full)

    low, high = np.array([-5.0, -3.0, -0.5, -0.5]), np.array([1.5, 2.5, 0.5, 0.5])
    solved = least_squares(
        reduced,
        begin[free],
        bounds=(low[free], high[free]),
        loss="soft_l1",
        f_scale=3.0,
        max_nfev=30,
    )
    full = begin.copy()
    full[free] = solved.x
    return growth(full)


@dataclass(frozen=True)
class SteadyLags:
    """Lags in steady slip: mean over a slide, mm, NaN where not known, 0 for a papilla in the air,
    and the path over which it was taken, mm; both (k, m)."""

    lag_mm: F64
    path_mm: F64


def settled_lags(slips: SlideSlips, i: int, growth: Growth) -> tuple[F64, F64]:
    """Lag of one slide's tips while they slide, as if the springs had relaxed, (n, m), else NaN;
    and the frames' times."""
    t, lag = slips.frame_s[i], slips.lag_mm[i]
    after = t[:, None] - slips.slipped_s[i]
    mean = np.exp(np.mean(np.log(slips.speed_mm_s)))
    log_speed = np.full(1, np.log(slips.speed_mm_s[i] / mean))
    stuck = np.maximum(slips.slipped_s[i], 1e-3)
    with np.errstate(invalid="ignore", over="ignore"):
        now = growth(stuck, after, log_speed)
        share = now / growth(stuck, np.full(1, np.inf), log_speed)
        settled = np.where((after > SETTLES_S) & slips.slid[i], lag / share, np.nan)
    return settled, t


def steady_lags(slips: SlideSlips, growth: Growth) -> SteadyLags:
    """Return every papilla's mean lag in every slide."""
    shape = slips.slipped_s.shape
    lag, path = np.full(shape, np.nan), np.zeros(shape)
    for i in range(shape[0]):
        settled, _ = settled_lags(slips, i, growth)
        seen = np.isfinite(settled)
        path_mm = np.where(seen, slips.path_mm[i], np.nan)
        for j in np.flatnonzero(seen.any(axis=0)):
            path[i, j] = np.nanmax(path_mm[:, j]) - np.nanmin(path_mm[:, j])
        lag[i] = np.where(path[i] >= LEAST_PATH_MM, mean_seen(settled), np.nan)
        lag[i, slips.free[i]] = 0.0
    return SteadyLags(lag, path)
