"""Expected figures of trials that were not taken, by factors and without interactions.

Effects of levels are shrunk to their mean by ridge regression, as random effects are; leaving one
trial out chooses by how much. The spread of a trial is expected in the same way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from sliplab.plugins.claims.blocks import F64

_RIDGES = (0.1, 1.0, 10.0, 100.0)
_LOG_OF_NORMAL = -0.635
"""Mean logarithm of the size of a standard normal value."""


def coded(levels: npt.NDArray[np.int64]) -> F64:
    """Return a column of each level: 1 where a trial has it; (N, levels)."""
    columns = [levels[:, [k]] == np.unique(levels[:, k]) for k in range(levels.shape[1])]
    return np.hstack(columns).astype(np.float64)


@dataclass(frozen=True)
class Expectation:
    """Mean and standard deviation that each trial of a grid is expected to have.

    Attributes:
        mean, spread: (N,) float64, or a row of it for each round.
    """

    mean: F64
    spread: F64

    def below(self, value: float) -> F64:
        """Return the chance of a figure of at most `value`, in the same shape."""
        return np.asarray(ndtr((value - self.mean) / self.spread))


def expectation(code: F64, taken: npt.NDArray[np.int64], y: F64) -> Expectation:
    """Fit effects to taken trials.

    Args:
        code: (N, p) from `coded`. taken: (n,) numbers. y: (n,) figures; NaN where unknown,
            infinite where nothing was detected: taken for the most extreme of the others.
    """
    known = ~np.isnan(y)
    finite = y[np.isfinite(y)]
    if len(finite) < 2:
        centre = float(finite[0]) if len(finite) else 0.0
        return Expectation(np.full(len(code), centre), np.full(len(code), max(abs(centre), 1.0)))
    rows = code[taken[known]]
    y = np.clip(y[known], finite.min(), finite.max())
    mean, residual = _ridge(rows, y, code)
    scale = max(float(np.sqrt(np.mean(residual**2))), 1e-9 * max(float(np.abs(y).max()), 1.0))
    size = np.log(np.maximum(np.abs(residual), 1e-3 * scale))
    spread, _ = _ridge(rows, size, code)
    return Expectation(mean, np.clip(np.exp(spread - _LOG_OF_NORMAL), 0.2 * scale, 5.0 * scale))


def _ridge(rows: F64, y: F64, code: F64) -> tuple[F64, F64]:
    """Return predictions for `code`, and the leave-one-out residuals of `rows`."""
    centre = y.mean()
    u, s, vt = np.linalg.svd(rows - rows.mean(axis=0), full_matrices=False)
    best: tuple[float, F64, F64] | None = None
    for ridge in _RIDGES:
        shrunk = s**2 / (s**2 + ridge)
        leverage = (u**2 @ shrunk) + 1.0 / len(y)
        fitted = centre + u @ (shrunk * (u.T @ (y - centre)))
        off = (y - fitted) / np.maximum(1.0 - leverage, 0.05)
        error = float(np.mean(off**2))
        if best is None or error < best[0]:
            weight = vt.T @ (s / (s**2 + ridge) * (u.T @ (y - centre)))
            best = error, centre + (code - rows.mean(axis=0)) @ weight, off
    assert best is not None
    return best[1], best[2]
