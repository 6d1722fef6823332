"""A clock's line through pulses of which some may be wrong: straight, or bent as the clock is.

A crystal that warms up drifts by a few ppm more at the end of a trial than at its beginning; a
straight line is then wrong by a hundred microseconds and does not know it. So the line gets as many
pieces as its residuals ask for, by a test on their means, and no more. It also says how far it may
be wrong: the 95 % quantile of the largest error anywhere between the first and the last pulse.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache, reduce

import numpy as np
from numpy.typing import NDArray
from scipy import special

from analysis.timeline.pulse_kernels import (
    median,
    normal_equations,
    places_of,
    quantile,
    residuals_at,
)

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_HUBER = 1.345
_GATE = 5.0
_MAX_PIECES = 64
_PIECE_PULSES = 30
_BLOCK_PULSES = 12
_CHANCE = 1e-4
"""How often a straight clock is given more pieces than it needs."""
_RUNS = (8, 16, 32)
_DRAWS = 4096
_SLOPES = 81
_UNITS = 0.6
"""How many units stamps may lie from a line that their unit explains: half of one, and jitter."""


def theil_sen(x: Floats, y: Floats) -> tuple[float, float]:
    """Median of the slopes between pulses half the train apart, and the median level at x = 0.

    Not all pairs, as in Theil (1950) and Sen (1968): the near ones say little of the slope, and
    there are n**2 of them. It stands a quarter of bad points.
    """
    half = x.size // 2
    run = x[half : 2 * half] - x[:half]
    far = run > 0
    gained = y[half : 2 * half] - y[:half]
    if far.all():
        slope = median(gained / run) if half else 0.0
    else:
        slope = median(gained[far] / run[far]) if far.any() else 0.0
    return slope, median(y - slope * x)


@dataclass(frozen=True)
class ClockLine:
    """Straight lines that join at knots, and how well pulses lie on them.

    Attributes:
        knots, values: (k + 1,) x and y of the knots, first and last pulse included, ns.
        residuals: (n,) y less the line at every pulse, ns.
        inside: (n,) whether a pulse lies on the line, within 5 sigma.
        sigma: scatter of the pulses on the line, ns.
        uncertainty: largest error of the line from the first to the last knot, 95 %, ns.
        sudden: how far the line may be off next to where its slope changes faster than a clock
            bends, as it does when the clock jumps, ns.
        straightened: whether what is left over looks like chance.
    """

    knots: Floats
    values: Floats
    residuals: Floats
    inside: Bools
    sigma: float
    uncertainty: float
    sudden: float
    straightened: bool

    @cached_property
    def residual_p95(self) -> float:
        """95th percentile of the absolute residuals of the pulses on the line, ns."""
        return quantile(np.abs(self.residuals[self.inside]), 0.95)

    @cached_property
    def slopes(self) -> Floats:
        """Slope of each piece, (k,)."""
        result: Floats = np.diff(self.values) / np.diff(self.knots)
        return result


def fit_line(x: Floats, y: Floats, resolution: float, bend_per_ns: float) -> ClockLine:
    """The line of a clock through pulses at rising x, with as few pieces as the residuals allow.

    Args:
        x: (n,) times of the pulses, rising, ns.
        y: (n,) what the other clock gained there, ns.
        resolution: unit of the stamps, ns: means that differ by less than half of it are no bend.
        bend_per_ns: by how much a slope may change in a nanosecond.
    """
    slope, level = theil_sen(x, y)
    floor = max(0.3 * resolution, 0.5)
    rough = y - slope * x - level
    # scatter between neighbours is free of any bend
    local = max(1.4826 * median(np.abs(rough[1:] - rough[:-1])) / 2**0.5, floor)
    knots = x[[0, -1]]
    values = slope * knots + level
    while True:
        values, residuals, inside, sigma = _robust(x, y, knots, values, floor)
        straight = _is_chance(residuals[inside], knots.size, min(local, sigma), resolution / 2)
        pieces = knots.size - 1
        if straight or 2 * pieces > min(_MAX_PIECES, int(inside.sum()) // _PIECE_PULSES):
            break
        at = np.flatnonzero(inside)
        ends = np.linspace(0, at.size - 1, 2 * pieces + 1).round().astype(np.int64)
        finer = x[at[ends]]
        finer[0], finer[-1] = x[0], x[-1]
        values, knots = np.interp(finer, knots, values), finer
    return _judged(x, knots, values, residuals, inside, sigma, resolution, bend_per_ns, straight)


def line_within_unit(x: Floats, y: Floats, resolution: float, drift: float) -> ClockLine | None:
    """The straight line that is never further from a stamp than its unit explains.

    Stamps cut to a unit in step with the ticks, such as 2 ms and 10 ms, stand still until the
    clocks have drifted past a unit's edge, and then all move by one unit: in a short train a
    regression takes that for a drift. Every stamp bounds the clock all the same.

    Args:
        drift: the most that the slope may be, either way.

    Returns:
        None if no slope that is allowed does it. Its uncertainty holds for every error within
        the unit: half of it, and how far the stamps lie from the line.
    """
    slopes = np.linspace(-drift, drift, _SLOPES)
    spans = np.array([np.ptp(y - slope * x) for slope in slopes])
    near = np.flatnonzero(spans <= spans.min() + 1.0)
    slope = float(slopes[near[near.size // 2]])
    rest = y - slope * x
    level, away = float(rest.max() + rest.min()) / 2, float(np.ptp(rest)) / 2
    if away > _UNITS * resolution:
        return None
    knots = x[[0, -1]]
    residuals = rest - level
    sigma = max(float(np.sqrt((residuals**2).mean())), 0.5)
    everything = np.ones(x.size, np.bool_)
    uncertainty = 1.0 + resolution / 2 + away
    return ClockLine(
        knots, slope * knots + level, residuals, everything, sigma, uncertainty, 0.0, True
    )


def _robust(
    x: Floats, y: Floats, knots: Floats, values: Floats, floor: float
) -> tuple[Floats, Floats, Bools, float]:
    """Huber's M-estimate of the values at knots on what lies inside 5 robust sigma."""
    piece, share = places_of(x, knots)
    residuals = y - np.interp(x, knots, values)
    for _ in range(20):
        size = np.abs(residuals)
        sigma = max(1.4826 * median(size), floor)
        inside = size <= _GATE * sigma
        matrix, right = normal_equations(
            piece, share, y, residuals, _GATE * sigma, _HUBER * sigma, knots.size
        )
        new: Floats = np.linalg.solve(_held(matrix), right)
        moved = float(np.abs(new - values).max())
        values = new
        residuals = residuals_at(piece, share, y, values)
        if moved < 1e-3 * sigma:
            break
    sigma = float(np.sqrt((residuals[inside] ** 2).sum() / max(1, inside.sum() - knots.size)))
    return values, residuals, inside, max(sigma, floor)


def _held(matrix: Floats) -> Floats:
    """Normal equations in which a piece with a single pulse in it hangs on its neighbours."""
    n = matrix.shape[0]
    matrix.flat[:: n + 1] += 1e-12 * matrix.trace() / n
    return matrix


def _is_chance(residuals: Floats, parameters: int, sigma: float, slack: float) -> bool:
    """Whether the means of stretches of the train are as small as chance makes them."""
    blocks = min(max(8, 4 * (parameters - 1)), residuals.size // _BLOCK_PULSES)
    if blocks <= parameters:
        return True
    edges = np.linspace(0, residuals.size, blocks + 1).round().astype(np.int64)
    counts = np.diff(edges)
    means = np.add.reduceat(residuals, edges[:-1]) / counts
    # a unit that nothing shakes hides what is smaller
    excess = np.maximum(np.abs(means) - (slack if slack > sigma else 0.0), 0.0)
    square = float((excess**2 * counts).sum()) / sigma**2
    return square <= float(special.chdtri(blocks - parameters, _CHANCE))


def _judged(
    x: Floats, knots: Floats, values: Floats, residuals: Floats, inside: Bools, sigma: float,
    resolution: float, bend_per_ns: float, straight: bool,
) -> ClockLine:  # fmt: skip
    """The line with its uncertainty."""
    inner, n = residuals[inside], knots.size
    piece, share = places_of(x[inside], knots)
    none = np.zeros(inner.size)
    matrix = _held(normal_equations(piece, share, none, none, np.inf, np.inf, n)[0])
    # asymptotic variance of Huber's estimate (Huber 1964): E psi^2 / (E psi')^2
    limit = _HUBER * sigma
    linear = max(float((np.abs(inner) < limit).mean()), 0.1)
    variance = float((np.minimum(np.abs(inner), limit) ** 2).mean()) / linear**2
    variance *= inner.size / max(1, inner.size - n)
    covariance = variance * np.linalg.inv(matrix)
    root = np.linalg.cholesky(covariance + (1e-12 * covariance.trace() / n + 1e-6) * np.eye(n))
    # between knots the error is no larger than at one of them
    errors = _draws(n) @ root.T
    np.abs(errors, out=errors)
    # numpy is slow where it takes the largest of two
    largest = errors.max(axis=1) if n > 8 else reduce(np.maximum, errors.T)
    band = float(np.partition(largest, int(0.95 * _DRAWS))[int(0.95 * _DRAWS)])
    band *= float(special.stdtrit(max(1, inner.size - n), 0.975)) / 1.959964
    sag, sudden = 0.0, 0.0
    if n > 2:
        run = np.diff(knots)
        # slopes' changes as a linear function of the values
        to_change = np.zeros((n - 2, n))
        here = np.arange(n - 2)
        to_change[here, here], to_change[here, here + 2] = 1 / run[:-1], 1 / run[1:]
        to_change[here, here + 1] = -1 / run[:-1] - 1 / run[1:]
        changes = np.abs(to_change @ values)
        chance = np.sqrt(np.einsum("ij,jk,ik->i", to_change, covariance, to_change))
        spans, longest = 0.5 * (run[:-1] + run[1:]), np.maximum(run[:-1], run[1:])
        # a parabola sags by an eighth of the slope's change over a piece; what changes faster than
        # clocks bend may be a jump, of which half is wrong next to it
        smooth = np.minimum(changes, bend_per_ns * spans)
        faster = np.maximum(changes - chance - smooth, 0.0) * longest / 2
        sag = float((smooth * longest / 8 + faster).max())
        sudden = float(faster.max())
    uncertainty = 1.0 + band + sag + _left_over(inner, sigma) + _locked(inner, resolution)
    return ClockLine(knots, values, residuals, inside, sigma, uncertainty, sudden, straight)


def _left_over(residuals: Floats, sigma: float) -> float:
    """By how much the mean of a few pulses in a row is off beyond chance, as next to a jump, ns."""
    sums = np.concatenate([[0.0], np.cumsum(residuals)])
    worst = 0.0
    for count in _RUNS:
        if count <= residuals.size:
            means, chance = np.abs(sums[count:] - sums[:-count]) / count, sigma / count**0.5
            # of a clock that drifts away at an end, the mean shows half
            at_end = 2.0 * (max(float(means[0]), float(means[-1])) - 3.0 * chance)
            worst = max(worst, float(means.max()) - 5.0 * chance, at_end)
    return worst


def _locked(residuals: Floats, resolution: float) -> float:
    """What stamps cut to a unit hide where nothing shakes them, ns.

    Jitter spreads stamps over units, and their mean finds the middle; what is left falls as
    exp(-2 pi^2 sigma^2 / unit^2) (Widrow and Kollar 2008), and is half a unit without any jitter.
    """
    if resolution == 0.0 or residuals.size < 2:
        return 0.0
    shaken = 1.4826 * median(np.abs(residuals[1:] - residuals[:-1])) / 2**0.5 / resolution
    return 0.5 * resolution * float(np.exp(-2 * np.pi**2 * shaken**2))


@lru_cache(maxsize=_MAX_PIECES)
def _draws(n: int) -> Floats:
    """Normal numbers, the same ones always, (draws, n)."""
    return np.random.default_rng(n).standard_normal((_DRAWS, n))
