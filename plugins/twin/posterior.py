"""Posterior of a simulated rig's parameters given a pilot, by regression on simulated worlds.

A bank holds worlds drawn from a uniform prior and the statistics that each would have shown. The
parameters are regressed on the statistics (semi-automatic approximate Bayesian computation,
Fearnhead and Prangle 2012; regression adjustment, Beaumont et al. 2002, with a spread that changes
over the prior, Blum and François 2010). What the regression missed in worlds that it was not
fitted to, near to what is predicted from the pilot, is the posterior's shape. So an interval holds
95 % of the worlds of the bank however good the regression is (split conformal prediction, Vovk et
al. 2005; Lei et al. 2018): a poor one only makes it wide.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from sliplab.plugins.twin.regression import Regression, regression, sparse_weights
from sliplab.storage.streams import F64

Bools = npt.NDArray[np.bool_]

FEWEST = 100
"""Worlds below which a 95 % interval would hang on the one or two worst."""
IDENTIFIED = 0.5
"""Largest share of the prior's interval that is left where a parameter counts as identified."""
_FOLDS = 10
_NEAR = 0.5
"""Share of the bank, nearest in what is predicted, that gives an interval its shape; at least
`FEWEST`."""
_NOTHING = 0.02
"""Share of variance explained in worlds not fitted to, below which the prediction is dropped."""
_SEEN = 0.8
"""Share of the worlds in which a statistic must be defined to be used."""
_FAR = 5.0
"""Standard deviations at which a statistic is cut off: one wild value must not outweigh all."""
_LEVELS = (0.025, 0.5, 0.975)


@dataclass(frozen=True)
class Bank:
    """Simulated worlds, drawn independently and uniformly between bounds.

    Attributes:
        parameters: names, p of them. statistics: names, q of them.
        theta: parameters of k worlds, (k, p), usually logarithms.
        s: their statistics, (k, q), NaN where undefined.
        lower, upper: bounds of the prior, (p,).

    Raises:
        ValueError: shapes do not fit, or a parameter is not finite or not within its bounds.
    """

    parameters: tuple[str, ...]
    statistics: tuple[str, ...]
    theta: F64
    s: F64
    lower: F64
    upper: F64

    def __post_init__(self) -> None:
        k, p, q = len(self.theta), len(self.parameters), len(self.statistics)
        shapes = (self.theta.shape, self.s.shape, self.lower.shape, self.upper.shape)
        if shapes != ((k, p), (k, q), (p,), (p,)):
            raise ValueError(f"a bank of {p} parameters and {q} statistics has arrays {shapes}")
        if not (self.lower < self.upper).all():
            raise ValueError("a lower bound of the bank's prior is not below its upper bound")
        slack = 1e-9 * (self.upper - self.lower)
        inside = (self.theta >= self.lower - slack) & (self.theta <= self.upper + slack)
        if not inside.all():
            name = self.parameters[int(np.argmin(inside.all(axis=0)))]
            raise ValueError(f"a world of the bank has {name} outside its prior's bounds")

    def __len__(self) -> int:
        return len(self.theta)

    def unit(self, theta: F64) -> F64:
        """Return parameters with their bounds at -1 and 1."""
        result: F64 = (2.0 * theta - self.lower - self.upper) / (self.upper - self.lower)
        return np.clip(result, -1.0, 1.0)

    def scaled(self, unit: F64) -> F64:
        """Return parameters of which -1 and 1 are the bounds."""
        return self.lower + 0.5 * (unit + 1.0) * (self.upper - self.lower)


@dataclass(frozen=True)
class ParameterPosterior:
    """The posterior of one parameter.

    Attributes:
        median, sd: its location and spread. low, high: its 95 % interval.
        prior_low, prior_high: the prior's 95 % interval.
        left: width of the interval over that of the prior's.
        identified: whether that is at most `IDENTIFIED`.
        carriers: statistics that the estimate rests on and their shares, largest first; those of
            at least a tenth.
    """

    parameter: str
    median: float
    sd: float
    low: float
    high: float
    prior_low: float
    prior_high: float
    left: float
    identified: bool
    carriers: tuple[tuple[str, float], ...]


@dataclass(frozen=True)
class Posterior:
    """The joint posterior of a bank's parameters, given one observation.

    Attributes:
        estimates: one a parameter, in the bank's order.
        samples: (k, p), one a world of the bank; their marginals are those of the estimates.
    """

    estimates: tuple[ParameterPosterior, ...]
    samples: F64


@dataclass(frozen=True)
class _Spread:
    """Size of a regression's errors as a function of its predictions.

    Attributes:
        weights, constant: of the logarithm of the errors' size on predictions and squares.
        skilled: columns of the predictions that are used.
        at_worlds: sizes at the bank's worlds, (k, p).
    """

    weights: F64
    constant: F64
    skilled: Bools
    at_worlds: F64

    def at(self, unit: F64) -> F64:
        """Return sizes (p,) where `unit` (p,) is predicted, not beyond those of the bank."""
        logarithm = _terms(unit[None, self.skilled]) @ self.weights + self.constant
        worlds = self.at_worlds
        result: F64 = np.clip(np.exp(logarithm[0]), worlds.min(axis=0), worlds.max(axis=0))
        return result


@dataclass(frozen=True)
class FittedBank:
    """A bank with its regression: gives the posterior of any observation with these statistics.

    Attributes:
        bank: of the worlds.
        used: statistics that the regression uses, (q,). centre, scale: of these.
        regression: on all worlds.
        predicted: of each world without it, (k, p), unit. errors: truth less that.
        skilled: parameters of which something is learned, (p,).
        spread: of the errors. axes: principal axes of the errors, (p, p). axis_spread: along these.
    """

    bank: Bank
    used: Bools
    centre: F64
    scale: F64
    regression: Regression
    predicted: F64
    errors: F64
    skilled: Bools
    spread: _Spread
    axes: F64
    axis_spread: _Spread

    def at(self, observed: F64) -> Posterior:
        """Return the posterior of observed statistics (q,).

        Raises:
            ValueError: another number of statistics, or one that is used is missing.
        """
        missing = self.used & ~np.isfinite(_checked(self.bank, observed))
        if missing.any():
            name = self.bank.statistics[int(np.argmax(missing))]
            raise ValueError(f"the statistic {name}, which the fit uses, was not observed")
        x = _standard(observed[None, self.used], self.centre, self.scale)
        unit = np.where(self.skilled, self.regression(x)[0], self.predicted.mean(axis=0))
        # errors along their axes, so that a combination that is well known stays so
        along = self.errors @ self.axes
        vectors = along / self.axis_spread.at_worlds * self.axis_spread.at(unit) @ self.axes.T
        ranks = np.argsort(np.argsort(vectors, axis=0, kind="stable"), axis=0)
        levels = (ranks + 0.5) / len(self.bank)
        size = self.spread.at(unit)
        samples = np.empty_like(self.errors)
        marks = np.empty((len(_LEVELS), len(unit)))
        for j in range(len(unit)):
            if not self.skilled[j]:
                samples[:, j], marks[:, j] = 2.0 * levels[:, j] - 1.0, 2.0 * np.array(_LEVELS) - 1.0
                continue
            near = self._near(j, unit[j])
            sizes = np.sort(self.errors[near, j] / self.spread.at_worlds[near, j])
            samples[:, j] = unit[j] + size[j] * _quantiles(sizes, levels[:, j])
            marks[:, j] = unit[j] + size[j] * _quantiles(sizes, np.array(_LEVELS))
        samples = self.bank.scaled(np.clip(samples, -1.0, 1.0))
        low, median, high = self.bank.scaled(np.clip(marks, -1.0, 1.0))
        return Posterior(
            tuple(
                self._estimate(j, low[j], median[j], high[j], float(samples[:, j].std()))
                for j in range(len(unit))
            ),
            samples,
        )

    def _near(self, j: int, unit: float) -> npt.NDArray[np.intp]:
        """Return the worlds that give parameter j its shape where `unit` is predicted."""
        distance = np.abs(self.predicted[:, j] - unit)
        count = max(FEWEST, round(_NEAR * len(self.bank)))
        return np.argsort(distance, kind="stable")[:count]

    def _estimate(
        self, j: int, low: float, median: float, high: float, sd: float
    ) -> ParameterPosterior:
        lower, upper = float(self.bank.lower[j]), float(self.bank.upper[j])
        tail = _LEVELS[0] * (upper - lower)
        # where little is learned, the chance of the bank may make it wider than the prior's
        left = min(float(high - low) / (upper - lower - 2.0 * tail), 1.0)
        carriers: tuple[tuple[str, float], ...] = ()
        if self.skilled[j]:
            power = self.regression.weights[:, j] ** 2
            names = np.array(self.bank.statistics)[self.used]
            order = np.argsort(-power, kind="stable")
            shares = power / max(float(power.sum()), 1e-300)
            carriers = tuple((str(names[i]), float(shares[i])) for i in order if shares[i] >= 0.1)
        return ParameterPosterior(
            self.bank.parameters[j],
            float(median),
            sd,
            float(low),
            float(high),
            lower + tail,
            upper - tail,
            left,
            left <= IDENTIFIED,
            carriers,
        )


def fitted(bank: Bank, usable: Bools | None = None) -> FittedBank:
    """Return a bank with its regression.

    Args:
        usable: statistics that may be used, (q,); all by default.

    Raises:
        ValueError: fewer than `FEWEST` worlds.
    """
    if len(bank) < FEWEST:
        raise ValueError(f"the bank has {len(bank)} worlds; a posterior takes at least {FEWEST}")
    centre, scale, used = _scales(bank.s)
    if usable is not None:
        used &= usable
    centre, scale = centre[used], scale[used]
    x, y = _standard(bank.s[:, used], centre, scale), bank.unit(bank.theta)
    predicted = np.empty_like(y)
    for own in _folds(len(bank)):
        predicted[own] = regression(x[~own], y[~own])(x[own])
    skilled = ((y - predicted) ** 2).mean(axis=0) < (1.0 - _NOTHING) * y.var(axis=0)
    predicted = np.where(skilled, predicted, y.mean(axis=0))
    errors = y - predicted
    axes = np.linalg.eigh(np.atleast_2d(np.cov(errors.T)))[1]
    return FittedBank(
        bank,
        used,
        centre,
        scale,
        regression(x, y),
        predicted,
        errors,
        skilled,
        _spread(predicted, errors, skilled),
        axes,
        _spread(predicted, errors @ axes, skilled),
    )


def posterior(bank: Bank, observed: F64) -> Posterior:
    """Return the posterior of a bank's parameters given observed statistics (q,), some NaN.

    Raises:
        ValueError: fewer than `FEWEST` worlds, or another number of statistics.
    """
    return fitted(bank, np.isfinite(_checked(bank, observed))).at(observed)


def widened(found: Posterior, slopes: F64, error: float) -> tuple[ParameterPosterior, ...]:
    """Return estimates whose intervals allow for one more unknown that no statistic depends on.

    Args:
        slopes: of the parameters over the unknown, (p,). error: largest size of it, of which all
            values are as likely.
    """
    unknown = np.linspace(-error, error, 201)
    result = []
    for estimate, slope, samples in zip(
        found.estimates, slopes.tolist(), found.samples.T, strict=True
    ):
        if slope != 0.0 and error > 0.0:
            low, high = np.quantile(samples[:, None] + slope * unknown, (_LEVELS[0], _LEVELS[2]))
            low, high = min(low, estimate.low), max(high, estimate.high)
            estimate = replace(estimate, low=float(low), high=float(high))
        result.append(estimate)
    return tuple(result)


def _checked(bank: Bank, observed: F64) -> F64:
    if observed.shape != (len(bank.statistics),):
        raise ValueError(
            f"{observed.shape} statistics were observed; the bank has {len(bank.statistics)}"
        )
    return observed


def _scales(s: F64) -> tuple[F64, F64, Bools]:
    """Return median and spread of statistics (k, q), and which of them can be used.

    The spread is a normal distribution's with the same quartiles, so that wild values do not count.
    """
    finite = np.where(np.isfinite(s), s, np.nan)
    enough = np.isfinite(s).mean(axis=0) >= _SEEN
    filled = np.where(enough, finite, 0.0)
    lower, centre, upper = np.nanpercentile(filled, [25, 50, 75], axis=0)
    # most values of a count may be the same: then the spread of the others counts
    reach = np.nanmax(np.abs(filled - centre), axis=0)
    part = np.where(reach > 0.0, reach, 1.0)
    deviation = part * np.nanstd((filled - centre) / part, axis=0)
    scale = (upper - lower) / 1.349
    scale = np.where(scale > 1e-9 * deviation, scale, deviation)
    return centre, scale, enough & (scale > 1e-12 * np.maximum(1.0, np.abs(centre)))


def _standard(s: F64, centre: F64, scale: F64) -> F64:
    """Return statistics in units of their spread, cut off at `_FAR`; 0 for a missing one."""
    x = np.clip((s - centre) / scale, -_FAR, _FAR)
    return np.where(np.isfinite(x), x, 0.0)


def _spread(predicted: F64, errors: F64, skilled: Bools) -> _Spread:
    """Fit the size of errors (k, p) to what was predicted (k, p)."""
    # an error near 0 has no logarithm worth fitting
    size = np.log(np.abs(errors) + np.maximum(0.02 * errors.std(axis=0), 1e-9))
    terms = _terms(predicted[:, skilled])
    # a world must not have part in the size that its own error is compared with
    logarithms = np.empty_like(size)
    for own in _folds(len(errors)):
        weights, constant = sparse_weights(terms[~own], size[~own])
        logarithms[own] = terms[own] @ weights + constant
    return _Spread(*sparse_weights(terms, size), skilled, np.exp(logarithms))


def _folds(k: int) -> Iterator[Bools]:
    """Yield the worlds of each part of a bank, (k,)."""
    for part in range(_FOLDS):
        yield np.arange(k) % _FOLDS == part


def _terms(unit: F64) -> F64:
    return np.column_stack([unit, unit**2])


def _quantiles(ordered: F64, levels: F64) -> F64:
    """Return quantiles of n sorted values so that a further value is below one with its level."""
    n = len(ordered)
    result: F64 = np.interp(levels * (n + 1) - 1, np.arange(n), ordered)
    return result
