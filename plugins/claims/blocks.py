"""A mean and its uncertainty from blocks: trials of one block may resemble each other.

Only blocks count as independent. Their scatter about a straight trend gives the standard error, so
a steady drift does not widen it. Neighbouring blocks may resemble each other, too: their
correlation widens it. The statistic is Student's t, with a correction for skewed blocks by a
monotone cubic (Hall 1992, On the removal of skewness by transformation).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri, stdtr

from sliplab.protocols.claims import LEAST_BLOCKS

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
_MOST_CORRELATION = 0.9
_LEAST_CHANCE = 1e-300


@dataclass(frozen=True)
class Limit:
    """Limits that an estimate must exceed at a look.

    Attributes:
        boundary: of the standard normal statistic, by all looks.
        steady: of the same where the trend so far continues to the planned end.
        blocks: planned number of them.
    """

    boundary: float
    steady: float
    blocks: float


@dataclass(frozen=True)
class MeanEstimate:
    """An estimate of a mean between 0 and 1.

    Attributes:
        value: NaN where nothing is known. is_difference: of two means, from -1 to 1.
        scores: (k,) what each block adds to the difference of the estimate from the true mean,
            times k, in the order taken.
    """

    value: float
    scores: F64
    is_difference: bool = False

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return len(self.scores)

    @cached_property
    def _place(self) -> F64:
        return np.asarray(np.arange(self.blocks) - 0.5 * (self.blocks - 1), np.float64)

    @cached_property
    def _slope(self) -> float:
        """Change of the estimate from one block to the next."""
        return float(self.scores @ self._place) / float(self._place @ self._place)

    @cached_property
    def _rest(self) -> F64:
        """Scores without their trend over time."""
        return np.asarray(self.scores - self.scores.mean() - self._slope * self._place)

    @cached_property
    def standard_error(self) -> float:
        """Standard error of the estimate, with the correlation of neighbouring blocks."""
        k, rest = self.blocks, self._rest
        total = float(rest @ rest)
        if total <= 1e-24 * k:
            return 0.0
        # the mean and the trend that were taken off lower the correlation by about 2 / k
        near = float(rest[1:] @ rest[:-1]) / total + 2.0 / k
        near = min(max(near, 0.0), _MOST_CORRELATION)
        return math.sqrt(total / (k - 2) / k * (1.0 + near) / (1.0 - near))

    def is_beyond(self, mean: float, limit: Limit, *, above: bool) -> bool:
        """Return whether the true mean is above a value, or below it, as surely as asked.

        The mean is that of the whole campaign: where the blocks so far have a trend, it must be
        beyond the value if that trend continues, too.
        """
        if not np.isfinite(limit.boundary) or self.evidence(mean, above=above) < limit.boundary:
            return False
        further = 0.5 * (limit.blocks - self.blocks)
        if further <= 0.0 or self.standard_error == 0.0:
            return True
        away = self.value + self._slope * further - mean
        spread = math.sqrt(self.blocks / float(self._place @ self._place)) * further
        error = self.standard_error * math.sqrt(1.0 + spread**2)
        return (away if above else -away) / error >= limit.steady

    def evidence(self, mean: float, *, above: bool) -> float:
        """Return a standard normal statistic that is large if the true mean is beyond a value.

        Args:
            above: the true mean is above `mean`, else below.
        """
        if self.blocks < LEAST_BLOCKS or math.isnan(self.value):
            return -math.inf
        away = self.value - mean if above else mean - self.value
        if self.standard_error == 0.0:
            return self._of_equal_blocks(mean, above=above) if away > 0.0 else -math.inf
        statistic = away / self.standard_error
        spread = math.sqrt(float(self._rest @ self._rest) / (self.blocks - 2))
        skewness = float((self._rest**3).mean()) / spread**3
        bend = (skewness if above else -skewness) / (6.0 * math.sqrt(self.blocks))
        statistic += bend + 2.0 * bend * statistic**2 + 4.0 / 3.0 * bend**2 * statistic**3
        return _normal(float(stdtr(self.blocks - 2, -statistic)))

    def _of_equal_blocks(self, mean: float, *, above: bool) -> float:
        """Return the statistic where all blocks have one value.

        A block reaches `value` with a chance of at most mean / value (Markov), independently.
        """
        if self.is_difference:
            return math.inf
        part = mean / self.value if above else (1.0 - mean) / (1.0 - self.value)
        return _normal(max(part, 0.0) ** self.blocks)

    def minus(self, other: MeanEstimate) -> MeanEstimate:
        """Return the estimate of the difference of two means, of the same blocks."""
        return MeanEstimate(self.value - other.value, self.scores - other.scores, True)


def _normal(chance: float) -> float:
    """Return the standard normal value that is exceeded with a chance."""
    return -float(ndtri(min(max(chance, _LEAST_CHANCE), 1.0)))


def of_trials(value: float, off: F64, weights: F64, blocks: I64, count: int) -> MeanEstimate:
    """Return an estimate that is a weighted sum over trials.

    Args:
        value: the estimate. off: (n,) what each trial is off its expectation; weights: (n,) of each
            in the estimate. blocks: (n,) number of each trial's block, from 0; count: of blocks.
    """
    parts = np.bincount(blocks, weights * off, minlength=count)
    return MeanEstimate(value, np.asarray(count * parts, np.float64))


def block_share(off: F64, blocks: I64, least: int = 3) -> tuple[float, float]:
    """Return the share of blocks in the variance of residuals, and its square root in their unit.

    By the method of moments of one-way analysis of variance (Searle, Casella and McCulloch 1992,
    Variance Components, section 3.6); none where there are fewer than `least` blocks of two trials.

    Args:
        off: (n,) residuals; those that are not finite are left out. blocks: (n,) of each.
        least: 2 or more.
    """
    there = np.isfinite(off)
    _, number, sizes = np.unique(blocks[there], return_inverse=True, return_counts=True)
    n, groups = len(number), len(sizes)
    if groups < least or n < 2 * groups:
        return 0.0, 0.0
    means = np.bincount(number, off[there]) / sizes
    inside = float(((off[there] - means[number]) ** 2).sum()) / (n - groups)
    total_mean = float(off[there].mean())
    between = float((sizes * (means - total_mean) ** 2).sum()) / (groups - 1)
    size = (n - float((sizes**2).sum()) / n) / (groups - 1)
    variance = max((between - inside) / size, 0.0)
    if variance == 0.0:
        return 0.0, 0.0
    return variance / (variance + inside), float(np.sqrt(variance))
