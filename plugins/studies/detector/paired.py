"""Test whether two settings differ by more than their seeds do.

Each seed gives both settings the same initial weights and order of samples, so differences are
paired by seed. They say nothing about other trials: all
seeds are evaluated on the same ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student


@dataclass(frozen=True)
class PairedDifference:
    """A mean difference over seeds.

    Attributes:
        mean: of the differences; None without a seed that has both.
        low, high: Student's interval of the mean; None with fewer than two seeds.
        seeds: how many have both.
    """

    mean: float | None
    low: float | None
    high: float | None
    seeds: int

    @property
    def significant(self) -> bool | None:
        """Significance: the interval excludes zero; None if there is no interval."""
        if self.low is None or self.high is None:
            return None
        return self.low > 0 or self.high < 0


def paired_difference(
    ours: Sequence[float | None], theirs: Sequence[float | None], level: float = 0.95
) -> PairedDifference:
    """Ours less theirs, seed by seed.

    Args:
        ours, theirs: a figure of each seed in the same order; None where a seed has none.
        level: of the interval.

    Raises:
        ValueError: not as many.
    """
    both = [a - b for a, b in zip(ours, theirs, strict=True) if a is not None and b is not None]
    n = len(both)
    if not n:
        return PairedDifference(None, None, None, 0)
    mean = float(np.mean(both))
    if n == 1:
        return PairedDifference(mean, None, None, 1)
    half = float(student.ppf(0.5 + level / 2, n - 1)) * float(np.std(both, ddof=1)) / n**0.5
    return PairedDifference(mean, mean - half, mean + half, n)
