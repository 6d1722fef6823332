"""Change of a parameter along a campaign: a line through fits of its reference trials.

Each fit has its own uncertainty, and references differ by more than that: by the variation from
trial to trial, and by the scene's errors. So the line is a random-effects regression, weighted by
1 / (v + tau^2), v being a fit's variance and tau^2 the scatter beyond it (method of moments,
DerSimonian and Laird 1986; with a covariate, Thompson and Sharp 1999). The interval of its slope is
that of Knapp and Hartung (2003), which holds for few references; it is never narrower than the
fits' own variances make it (Röver et al. 2015).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from sliplab.plugins.twin.posterior import IDENTIFIED, Bank, FittedBank, ParameterPosterior, fitted
from sliplab.storage.streams import F64

FEWEST = 3
"""References below which a line has no interval."""


@dataclass(frozen=True)
class DriftLine:
    """A straight line through k fits.

    Attributes:
        start: at the first place. slope: per place; low, high: its 95 % interval.
        p: probability of a slope as far from 0, if there is none.
        scatter: standard deviation of fits about the line beyond their own variances.
    """

    start: float
    slope: float
    low: float
    high: float
    p: float
    scatter: float


def line_through(places: F64, values: F64, variances: F64) -> DriftLine:
    """Return the line through values with variances, all (k,), at increasing places.

    Raises:
        ValueError: fewer than `FEWEST` values, or all at one place.
    """
    k = len(places)
    if k < FEWEST or np.ptp(places) == 0.0:
        raise ValueError(f"a line takes at least {FEWEST} values, at more than one place")
    x = np.column_stack([np.ones(k), places - places[0]])

    def solved(weight: F64) -> tuple[F64, F64, F64]:
        inverse = np.linalg.inv(x.T @ (weight[:, None] * x))
        best = inverse @ (x.T @ (weight * values))
        return inverse, best, values - x @ best

    weight = 1.0 / variances
    inverse, _, rest = solved(weight)
    # what is left of each weight once the line has taken its part
    leverage = np.einsum("ij,jk,ik->i", x, inverse, x) * weight
    beyond = float(rest @ (weight * rest)) - (k - 2)
    scatter = max(beyond / float(np.sum(weight * (1.0 - leverage))), 0.0)
    weight = 1.0 / (variances + scatter)
    inverse, best, rest = solved(weight)
    seen = max(float(rest @ (weight * rest)) / (k - 2), 1.0)
    slope, error = float(best[1]), float(np.sqrt(seen * inverse[1, 1]))
    reach = float(student.ppf(0.975, k - 2)) * error
    p = 2.0 * float(student.sf(abs(slope) / error, k - 2))
    return DriftLine(
        float(best[0]), slope, slope - reach, slope + reach, p, float(np.sqrt(scatter))
    )


@dataclass(frozen=True)
class Drift:
    """One parameter along a campaign, k references; logarithms.

    Attributes:
        values: of the references; their standard deviations are `errors`, both (k,).
        identified: single references tell of it.
    """

    parameter: str
    values: F64
    errors: F64
    identified: bool
    line: DriftLine


def drifts(bank: Bank, observed: F64, places: F64) -> list[Drift]:
    """Return each parameter's change over references, in the bank's order.

    Priors are uniform, so posteriors are not drawn towards their middle, and lines keep their
    slope; but beyond a prior's bounds nothing is found.

    Args:
        observed: statistics of each reference, (k, q), NaN where one has not got it.
        places: of the references in the campaign, (k,), increasing.

    Raises:
        ValueError: fewer than `FEWEST` references, or too few worlds.
    """
    fits: dict[bytes, FittedBank] = {}
    found: list[tuple[ParameterPosterior, ...]] = []
    for row in observed:
        usable = np.isfinite(row)
        if usable.tobytes() not in fits:
            fits[usable.tobytes()] = fitted(bank, usable)
        found.append(fits[usable.tobytes()].at(row).estimates)
    result = []
    for j, name in enumerate(bank.parameters):
        values = np.array([one[j].median for one in found])
        errors = np.array([one[j].sd for one in found])
        left = float(np.median([one[j].left for one in found]))
        line = line_through(places, values, errors**2)
        result.append(Drift(name, values, errors, left <= IDENTIFIED, line))
    return result
