"""A straight line through pulses of which a quarter may be wrong, and how far it can be trusted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_HUBER = 1.345
# sqrt of the 95 % quantile of chi-squared with 2 degrees: both ends of a fitted line at once
_BAND_95 = 2.4477
_STRETCHES = 8
_RUNS = (8, 16)
_ENDS = (4, 8, 16, 32)


def theil_sen(x: Floats, y: Floats) -> tuple[float, float]:
    """Median of the slopes between pulses half the train apart, and the median level at x = 0.

    Not all pairs, as in Theil (1950) and Sen (1968): the near ones say little of the slope, and
    there are n**2 of them. It stands a quarter of bad points.
    """
    order = np.argsort(x, kind="stable")
    x, y = x[order], y[order]
    half = x.size // 2
    run = x[half : 2 * half] - x[:half]
    far = run > 0
    slope = float(np.median((y[half : 2 * half] - y[:half])[far] / run[far])) if far.any() else 0.0
    return slope, float(np.median(y - slope * x))


@dataclass(frozen=True)
class Line:
    """A fitted y = slope x + level: residuals (n,), which of them count, and their sigma."""

    slope: float
    level: float
    residuals: Floats
    inside: NDArray[np.bool_]
    sigma: float


def robust_line(x: Floats, y: Floats) -> Line:
    """Theil-Sen, then Huber's M-estimate by reweighting, on what lies inside 5 robust sigma."""
    slope, level = theil_sen(x, y)
    inside = np.ones(x.size, np.bool_)
    sigma = 1.0
    for _ in range(20):
        residuals = y - slope * x - level
        # the stamps' resolution is a floor: without jitter the median deviation is zero
        sigma = max(1.4826 * float(np.median(np.abs(residuals))), 250.0)
        inside = np.abs(residuals) <= 5 * sigma
        weights = np.where(
            inside, np.minimum(1.0, _HUBER * sigma / np.maximum(np.abs(residuals), 1e-9)), 0.0
        )
        total = weights.sum()
        x_mean, y_mean = (weights * x).sum() / total, (weights * y).sum() / total
        spread = (weights * (x - x_mean) ** 2).sum()
        new_slope = float((weights * (x - x_mean) * (y - y_mean)).sum() / spread)
        new_level = float(y_mean - new_slope * x_mean)
        moved = abs(new_level - level) + abs(new_slope - slope) * float(np.abs(x).max())
        slope, level = new_slope, new_level
        if moved < 0.01:
            break
    residuals = y - slope * x - level
    return Line(slope, level, residuals, inside, sigma)


def line_uncertainty(x: Floats, line: Line) -> float:
    """Half the width of the line's 95 % band (Working, Hotelling 1929) at the train's far end.

    Where the mean residual of an eighth of the train is more than chance, the clocks did not run
    straight, and the band is wider by that much; so where that of a few pulses is far more than
    chance, next to a jump. At the ends it counts twice: of a clock that drifts away, the mean shows
    half.
    """
    order = np.argsort(x[line.inside], kind="stable")
    inner = x[line.inside][order]
    residuals = line.residuals[line.inside][order]
    sigma = float(np.sqrt((residuals**2).sum() / max(1, inner.size - 2)))
    mean = float(inner.mean())
    spread = float(((inner - mean) ** 2).sum())
    far = max(abs(float(x.min()) - mean), abs(float(x.max()) - mean))
    # Huber's weights cost 5 % of the efficiency; the map's integers add 1 ns
    band = 1.0 + _BAND_95 * sigma * float(np.sqrt((1 / inner.size + far**2 / spread) / 0.95))
    # scatter between neighbours is free of any bend
    local = float(np.sqrt((np.diff(residuals) ** 2).mean() / 2))
    stretches = np.array_split(residuals, _STRETCHES)
    bend = max(abs(float(part.mean())) - 3 * local / part.size**0.5 for part in stretches)
    for count in _RUNS:
        sums = np.cumsum(np.concatenate([[0.0], residuals]))
        means = np.abs(sums[count:] - sums[:-count]) / count
        bend = max(bend, float(means.max(initial=0.0)) - 5 * local / count**0.5)
    for count in _ENDS:
        for end in (residuals[:count], residuals[-count:]):
            bend = max(bend, 2 * (abs(float(end.mean())) - 3 * local / end.size**0.5))
    return band + max(0.0, bend)
