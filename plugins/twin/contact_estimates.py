"""Raw estimates of the contact's parameters from a pilot's slides, each by one effect's physics.

They are summary statistics: close to a parameter, or to what the data tell of several, cheap, and
computed in the same way from recorded and from simulated slides. What is left of bias is taken away
by comparing them with those of simulated worlds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sliplab.plugins.twin.contact_forces import (
    force_estimates,
    gross_forces,
    initial_slopes,
    normal_at_rest,
    ring_stiffness,
)
from sliplab.plugins.twin.contact_lags import (
    CORRELATION_MM,
    VARIATION,
    Growth,
    SteadyLags,
    fit_growth,
    settled_lags,
    steady_lags,
)
from sliplab.plugins.twin.contact_places import place_scatter, rest_places, rings_of
from sliplab.plugins.twin.contact_slips import SlideSlips, find_slips, mean_seen
from sliplab.plugins.twin.contact_springs import Fit, Guess, Lags, fit_springs
from sliplab.plugins.twin.contact_tremor import tremor_estimates
from sliplab.plugins.twin.pilot import PilotTrial
from sliplab.storage.streams import F64, I64

NOT_LOGGED = ("depth_zero_mm", "static_drop", "static_drop_per_speed", "ratio_per_speed")
"""Estimates that may be negative; all others are positive, and their logarithm is taken."""

LEAST_LAG_MM = 0.8
"""Lags that are smaller fluctuate by the tremor as much as by friction."""
LEAST_PULLING_MM = 0.3
"""Rings whose tips lag less pull too little for their stiffness to show in forces."""
PATH_STEP_MM = 0.1


@dataclass(frozen=True)
class ContactSlides:
    """Slides as every estimate of the contact needs them.

    Attributes:
        ring: of each marker, 0 for the centre and -1 where it was never seen, (m,).
        place_mm: of each at rest, (m, 2).
        growth: of lags after a slip; `fitted` where the slides show it, else assumed.
        steady: lags in steady slip. lags: the same by depth, with forces. springs: fitted to these.
    """

    slips: SlideSlips
    ring: I64
    place_mm: F64
    growth: Growth
    fitted: bool
    steady: SteadyLags
    lags: Lags
    springs: Fit | None


def read_contact(trials: Sequence[PilotTrial], guess: Guess | None = None) -> ContactSlides | None:
    """Return the contact in slides; None without markers.

    Args:
        guess: design of the skin, and where the fit of its springs begins.
    """
    slips = find_slips(trials)
    if slips is None:
        return None
    ring, place = rings_of(slips)
    fitted = fit_growth(slips)
    growth = fitted or Growth()
    steady = steady_lags(slips, growth)
    lags = lags_of(slips, ring, steady, growth)
    springs = fit_springs(lags, guess or Guess())
    return ContactSlides(slips, ring, place, growth, fitted is not None, steady, lags, springs)


def contact_estimates(contact: ContactSlides) -> dict[str, float]:
    """Return the estimates by name, NaN where these slides do not determine them."""
    growth = contact.growth if contact.fitted else Growth(*[float("nan")] * 4)
    return {
        "position_scatter_mm": place_scatter(contact.ring, contact.place_mm),
        "relaxation_maxwell": growth.maxwell,
        "relaxation_s": growth.relaxation_s,
        "static_drop": growth.drop,
        "static_drop_per_speed": growth.drop_per_speed,
        **path_estimates(contact.slips, contact.growth, contact.steady),
        **force_estimates(contact.slips, contact.lags),
        **spring_estimates(contact.springs, contact.ring),
        **tremor_estimates(contact.slips),
    }


def lags_of(slips: SlideSlips, ring: I64, table: SteadyLags, growth: Growth) -> Lags:
    """Return the lags by depth, weighted by their paths, and the forces by depth."""
    levels, which = slips.depths
    m = len(ring)
    lag, error = np.full((len(levels), m), np.nan), np.full((len(levels), m), np.nan)
    normal, stiffness = np.full(len(levels), np.nan), np.full(len(levels), np.nan)
    held = np.array([normal_at_rest(trial) for trial in slips.trials])
    slope = initial_slopes(slips, growth)
    for level in range(len(levels)):
        these = which == level
        values, path = table.lag_mm[these], np.where(slips.free[these], 1.0, table.path_mm[these])
        weight = np.where(np.isfinite(values), path, 0.0)
        total = weight.sum(axis=0)
        known = total > 0.0
        mean = (np.where(weight > 0.0, values, 0.0) * weight).sum(axis=0)[known] / total[known]
        lag[level, known] = mean
        independent = np.maximum(total[known] / (1.8 * CORRELATION_MM), 1.0)
        error[level, known] = np.hypot(1.2 * VARIATION * mean / np.sqrt(independent), 4e-3)
        normal[level], stiffness[level] = mean_seen(held[these]), mean_seen(slope[these])
    gross = gross_forces(slips)
    ratio = float(mean_seen(gross[:, 0] / gross[:, 1]))
    retained = np.array([mean_seen((gross[:, 1] / held)[which == k]) for k in range(len(levels))])
    pull = ring_stiffness(slips, ring, growth)
    for r in range(pull.shape[1]):
        pull[~(mean_seen(lag[:, ring == r], axis=1) >= LEAST_PULLING_MM), r] = np.nan
    return Lags(levels, ring, lag, error, normal, ratio, retained, stiffness, pull)


def spring_estimates(fit: Fit | None, ring: I64) -> dict[str, float]:
    """Return the fitted springs' estimates of the common parameters and of the scatters."""
    names = (
        "kinetic",
        "normal_compliance_per_mm",
        "tangential_compliance_per_mm",
        "layer_step_mm",
        "depth_zero_mm",
        "youngs_modulus_mpa",
        "friction_scatter",
        "height_scatter_mm",
        "height_reach_mm",
    )
    if fit is None:
        return dict.fromkeys(names, float("nan"))
    outer = ring > 0
    friction, raised = np.log(fit.friction[outer]), fit.raised_mm[outer]
    inside = ring[outer]
    for values in (friction, raised):
        for r in np.unique(inside):
            values[inside == r] -= values[inside == r].mean()
    free = max(len(inside) - len(np.unique(inside)), 1)
    reach = max((np.ptp(raised[inside == r]) / 2 for r in np.unique(inside)), default=np.nan)
    shown = (
        fit.kinetic,
        fit.normal_compliance,
        fit.tangential_compliance,
        fit.layer_step_mm,
        fit.zero_mm,
        fit.youngs_modulus_mpa,
        float(np.sqrt(np.sum(friction**2) / free)),
        float(np.sqrt(np.sum(raised**2) / free)),
        float(reach),
    )
    return dict(zip(names, shown, strict=True))


# -- along the path ----------------------------------------------------------------------------


def path_estimates(slips: SlideSlips, growth: Growth, table: SteadyLags) -> dict[str, float]:
    """Return the variation of friction along the paths and its length, from lags in steady slip."""
    steps = 16
    total, count = np.zeros(steps), np.zeros(steps)
    for i in range(len(slips.trials)):
        settled, _ = settled_lags(slips, i, growth)
        rows = []
        for j in np.flatnonzero(table.lag_mm[i] >= LEAST_LAG_MM):
            seen = np.isfinite(settled[:, j])
            path_mm = slips.path_mm[i][seen, j]
            grid = np.arange(path_mm.min(), path_mm.max(), PATH_STEP_MM)
            rows.append(np.interp(grid, path_mm, settled[seen, j] / table.lag_mm[i, j] - 1.0))
        if not rows:
            continue
        longest = max(len(row) for row in rows)
        padded, there = np.zeros((len(rows), longest)), np.zeros((len(rows), longest))
        for row, values in enumerate(rows):
            padded[row, : len(values)], there[row, : len(values)] = values, 1.0
        for d in range(min(steps, longest)):
            total[d] += np.sum(padded[:, : longest - d] * padded[:, d:])
            count[d] += np.sum(there[:, : longest - d] * there[:, d:])
    if count[0] == 0.0 or np.any(count < 1.0):
        return {"path_variation": float("nan"), "correlation_mm": float("nan")}
    covariance = total / count
    return {
        "path_variation": float(np.sqrt(covariance[0])),
        "correlation_mm": _length_of(covariance),
    }


def _length_of(covariance: F64) -> float:
    """Distance at which a covariance, in steps of `PATH_STEP_MM`, has fallen by 1/e, mm."""
    below = np.flatnonzero(covariance < covariance[0] / np.e)
    if not len(below):
        return float("nan")
    k = int(below[0])
    high, low = covariance[k - 1], covariance[k]
    share = (high - covariance[0] / np.e) / (high - low)
    return float((k - 1 + share) * PATH_STEP_MM)


# -- each papilla ------------------------------------------------------------------------------


@dataclass(frozen=True)
class PapillaEstimates:
    """m papillae as a pilot shows them, with standard errors.

    Attributes:
        ring: 0 is the centre, (m,).
        place_mm: from their mean, (m, 2); place_error_mm: along an axis, (m,).
        gap_mm: depth at which each touches over that of the centre one, (m,); its error.
        friction: of each over the mean, (m,); its error.
    """

    ring: I64
    place_mm: F64
    place_error_mm: F64
    gap_mm: F64
    gap_error_mm: F64
    friction: F64
    friction_error: F64


def papillae(contact: ContactSlides) -> PapillaEstimates | None:
    """Return a pilot's estimates of each papilla; None without a fit."""
    fit, ring, place = contact.springs, contact.ring, contact.place_mm
    if fit is None:
        return None
    apart = np.linalg.norm(rest_places(contact.slips) - place, axis=2)
    seen = np.maximum(np.isfinite(apart).sum(axis=0), 2)
    error = np.sqrt(mean_seen(apart**2) / 2 / (seen - 1))
    return PapillaEstimates(
        ring,
        place - mean_seen(place),
        error,
        fit.gap_mm,
        fit.gap_error_mm,
        fit.friction / fit.friction.mean(),
        fit.friction_error,
    )
