"""A clock as offset and drift that wanders at random: Kalman filter and smoother.

The two-state clock model of the field: the drift is a random walk, the offset its integral. How
fast it wanders is not known, so results are averaged over rates, each weighted by how well it
explains the events. A clock that does not wander gives least squares and its interval.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import special

from sliplab.analysis.clocks.clock_line import theil_sen
from sliplab.storage.kernels import njit

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_RATES = 10.0 ** np.arange(-2.0, 10.5, 0.5)
_WANDER = 0.3e-6 / 1e9**0.5
"""Largest random walk of the drift, per square root of ns: 0.3 ppm in a second, 18 in an hour."""
_STRAIGHT = 0.9
"""Prior probability of a clock that wanders too little to be seen."""
_FEW = 12
"""A clock with fewer events is taken not to wander."""
_DIFFUSE = 1e8
_CHUNK = 200_000


@dataclass(frozen=True)
class Step:
    """A jump before event `at` by `size` ns, and the log-likelihood that it gains."""

    at: int
    size: float
    gain: float


@dataclass(frozen=True)
class ClockState:
    """A clock between events of one stretch.

    Attributes:
        x: (n,) ascending, ns.
        gained: (n,) what the other clock gained there, less the line, ns.
        slope, level: of the line y - x = level + slope (x - x[0]).
        sigma: scatter of the events about the smoothed clock, ns.
    """

    x: Floats
    gained: Floats
    slope: float
    level: float

    @staticmethod
    def through(x: Floats, y: Floats) -> ClockState:
        """The clock through pairs of events, x ascending, both in ns."""
        slope, level = theil_sen(x - x[0], y - x)
        return ClockState(x, y - x - level - slope * (x - x[0]), slope, level)

    @property
    def rate(self) -> float:
        """Mean gain of the other clock, a share."""
        t = self.x - self.x.mean()
        return self.slope + float((t * self.gained).sum() / max(float((t * t).sum()), 1.0))

    @cached_property
    def _fits(self) -> tuple[Floats, Floats, Floats]:
        """Rates, the log-likelihood of each, and the events' variance with it, in scales."""
        # the fastest that a crystal wanders, in squared scales
        fastest = (_WANDER * self._span**1.5 / self._scale) ** 2
        wander = _RATES[fastest >= _RATES] if self.x.size >= _FEW else _RATES[:0]
        rates = np.concatenate([[0.0], wander])
        z, t = self.gained / self._scale, self._t
        fits = [_filtered(t, z, rate) for rate in rates]
        return rates, np.array([-0.5 * fit[0] for fit in fits]), np.array([fit[1] for fit in fits])

    @cached_property
    def _weights(self) -> tuple[Floats, Floats, Floats]:
        """Rates, their probabilities and the events' variance with each, in squared ns."""
        rates, score, variances = self._fits
        prior = np.full(rates.size, (1 - _STRAIGHT) / max(rates.size - 1, 1))
        prior[0] = _STRAIGHT
        weights = prior * np.exp(score - score.max())
        weights /= weights.sum()
        kept = weights > 1e-3
        return rates[kept], weights[kept] / weights[kept].sum(), variances[kept] * self._scale**2

    def jump(self, least: int) -> Step | None:
        """Return the most likely jump, if a clock that wanders explains the events less well.

        A step at an event gains the square of its auxiliary residual (de Jong and Penzer 1998) in
        likelihood; it must do so beyond what any rate of wandering gains.

        Args:
            least: events on either side.
        """
        rates, score, variances = self._fits
        if self.x.size < max(2 * least, _FEW):
            return None
        z, seen = self.gained / self._scale, np.ones(self.x.size, np.bool_)
        best = None
        n = self.x.size - 2
        for rate, one, variance in zip(rates, score, variances, strict=True):
            _, _, step, size = _smoothed(self._t, z, seen, rate)
            k = least + int(np.abs(step[least : step.size - least + 1]).argmax())
            # the variance shrinks by what the step explains
            share = min(float(step[k]) ** 2 / (n * variance), 1 - 1e-9)
            gain = one - 0.5 * n * np.log1p(-share) - score.max()
            if gain > (best.gain if best else 0.0):
                best = Step(k, float(size[k]) * self._scale, gain)
        return best

    @property
    def outside(self) -> Bools:
        """Events further than 5 sigma from the clock."""
        mean, _ = self.at(self.x)
        rest = self.gained - (mean - self.level - self.slope * (self.x - self.x[0]))
        result: Bools = np.abs(rest) > 5.0 * self.sigma
        return result

    @cached_property
    def _t(self) -> Floats:
        result: Floats = (self.x - self.x[0]) / self._span
        return result

    @property
    def _span(self) -> float:
        return max(float(self.x[-1] - self.x[0]), 1.0)

    @cached_property
    def _scale(self) -> float:
        return max(1.4826 * float(np.median(np.abs(self.gained - np.median(self.gained)))), 0.3)

    @property
    def sigma(self) -> float:
        """Scatter of the events, ns."""
        _, weights, variances = self._weights
        return float((weights @ variances) ** 0.5)

    def at(self, x: Floats) -> tuple[Floats, Floats]:
        """Gain of the other clock at ascending x, and half its interval of 95 %, ns."""
        parts = [self._at(x[k : k + _CHUNK]) for k in range(0, x.size, _CHUNK)]
        if not parts:
            return np.empty(0), np.empty(0)
        mean, half = (np.concatenate(column) for column in zip(*parts, strict=True))
        return mean, half

    def _at(self, x: Floats) -> tuple[Floats, Floats]:
        rates, weights, variances = self._weights
        every = np.concatenate([self.x, x])
        order = np.argsort(every, kind="stable")
        t = (every[order] - self.x[0]) / self._span
        seen = order < self.x.size
        z = np.zeros(every.size)
        z[seen] = self.gained / self._scale
        place = np.empty(order.size, np.int64)
        place[order] = np.arange(order.size)
        asked = place[self.x.size :]
        means, spreads = [], []
        for rate, variance in zip(rates, variances, strict=True):
            mean, spread, _, _ = _smoothed(t, z, seen, rate)
            means.append(mean[asked] * self._scale)
            spreads.append(spread[asked] * variance)
        mean = weights @ np.array(means)
        spread = weights @ (np.array(spreads) + (np.array(means) - mean) ** 2)
        half = float(special.stdtrit(max(self.x.size - 2, 1), 0.975)) * np.sqrt(spread)
        return self.level + self.slope * (x - self.x[0]) + mean, half


@njit(cache=True, nogil=True, error_model="numpy")
def _filtered(t: Floats, z: Floats, rate: float) -> tuple[float, float]:
    """Return -2 log likelihood, and the events' variance at which it is least."""
    level, drift = 0.0, 0.0
    p00, p01, p11 = _DIFFUSE, 0.0, _DIFFUSE
    squares = logs = 0.0
    used = 0
    for k in range(t.size):
        if k:
            h = t[k] - t[k - 1]
            level += h * drift
            p00 += h * (2.0 * p01 + h * p11) + rate * h**3 / 3.0
            p01 += h * p11 + rate * h**2 / 2.0
            p11 += rate * h
        s = p00 + 1.0
        v = z[k] - level
        used += 1
        if used > 2:
            squares += v * v / s
            logs += np.log(s)
        g0, g1 = p00 / s, p01 / s
        level += g0 * v
        drift += g1 * v
        p11 -= g1 * p01
        p00, p01 = g0, g1
    n = max(used - 2, 1)
    variance = max(squares / n, 1e-12)
    return n * np.log(variance) + logs, variance


@njit(cache=True, nogil=True, error_model="numpy")
def _smoothed(
    t: Floats, z: Floats, seen: Bools, rate: float
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the mean at each time, and its variance for events of variance 1; and steps.

    Of a step just before each time its estimate in standard deviations, and its size.

    Args:
        t: (n,) ascending.
        z, seen: (n,) events' values; times that are only asked for are not seen.
    """
    n = t.size
    state = np.empty((n, 2))
    cov = np.empty((n, 3))
    level, drift = 0.0, 0.0
    p00, p01, p11 = _DIFFUSE, 0.0, _DIFFUSE
    for k in range(n):
        if k:
            h = t[k] - t[k - 1]
            level += h * drift
            p00 += h * (2.0 * p01 + h * p11) + rate * h**3 / 3.0
            p01 += h * p11 + rate * h**2 / 2.0
            p11 += rate * h
        if seen[k]:
            s = p00 + 1.0
            v = z[k] - level
            g0, g1 = p00 / s, p01 / s
            level += g0 * v
            drift += g1 * v
            p11 -= g1 * p01
            p00, p01 = g0, g1
        state[k, 0], state[k, 1] = level, drift
        cov[k, 0], cov[k, 1], cov[k, 2] = p00, p01, p11
    mean, spread = np.empty(n), np.empty(n)
    step, size = np.zeros(n), np.zeros(n)
    # backwards by the adjoint (Durbin and Koopman 2001), which needs no inverse
    r0 = r1 = 0.0
    n00 = n01 = n11 = 0.0
    for k in range(n - 1, -1, -1):
        # r and n belong to what comes after the event at k; the filtered state is smoothed by them
        c00, c01 = cov[k, 0], cov[k, 1]
        mean[k] = state[k, 0] + c00 * r0 + c01 * r1
        spread[k] = c00 - (c00 * c00 * n00 + 2.0 * c00 * c01 * n01 + c01 * c01 * n11)
        if k == 0:
            break
        h = t[k] - t[k - 1]
        q00, q01, q11 = cov[k - 1, 0], cov[k - 1, 1], cov[k - 1, 2]
        b0, b1 = state[k - 1, 0], state[k - 1, 1]
        level = b0 + h * b1
        p00 = q00 + h * (2.0 * q01 + h * q11) + rate * h**3 / 3.0
        p01 = q01 + h * q11 + rate * h**2 / 2.0
        if seen[k]:
            s = p00 + 1.0
            v = z[k] - level
            g0, g1 = p00 / s, p01 / s
            # L = I - g (1 0); 1 - g0 would lose digits where nothing was known before
            u = 1.0 / s
            a0 = u * v + u * r0 - g1 * r1
            m0 = u * n00 - g1 * n01
            m1 = u * n01 - g1 * n11
            n00 = u + u * m0 - g1 * m1
            n01 = m1
            r0 = a0
        if n00 > 0.0:
            step[k], size[k] = r0 / np.sqrt(n00), r0 / n00
        # through the transition: F' r, F' N F
        r1 = r1 + h * r0
        n11 = n11 + 2.0 * h * n01 + h * h * n00
        n01 = n01 + h * n00
    return mean, np.maximum(spread, 0.0), step, size
