"""The papillae as springs that slide steadily, fitted to how far the tips lag behind their bases.

A tip in steady slip pulls with T = mu N. Its papilla is a bent column: with the bend b,
N = k_n (d - 0.6 b^2 / h) and T = b (k_b - 1.2 N / h), and the lag is b + c T with the compliance c of
shear and base (the potential of `rigs.scene.slip`; a beam's shortening and softening). Lags have
no scale of force: they tell friction, and the base's compliances over the skin's. Forces add it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from sliplab.storage.streams import F64, I64

SHORTENING = 0.6
"""A guided column of height h bent by b is shorter by 0.6 b^2 / h: the integral of half the squared
slope of its cubic shape."""
_LEAST_STIFFNESS = 0.05
_NEWTON = 15


@dataclass(frozen=True)
class Guess:
    """What is known or supposed of the skin before the pilot.

    Attributes:
        height_mm: of the centre papilla. radius_mm: of a papilla. spacing_mm: between rings.
        bending: 12 for a guided end, 3 for a free one. poisson_ratio: of the skin.
        kinetic, youngs_modulus_mpa, base_normal_n_per_m, base_tangential_n_per_m, layer_step_mm:
            where the fit begins. It holds each within `LOOSE` if the data say nothing.
    """

    height_mm: float = 10.1
    radius_mm: float = 2.0
    bending: float = 12.0
    poisson_ratio: float = 0.49
    kinetic: float = 0.85
    youngs_modulus_mpa: float = 0.6
    base_normal_n_per_m: float = 150.0
    base_tangential_n_per_m: float = 200.0
    layer_step_mm: float = 1.1


LOOSE = 0.4
"""Prior standard deviation of the logarithm of each common quantity."""
LOOSE_ZERO_MM = 0.1
SCATTER = 0.06
"""Prior standard deviation of a papilla's friction, relative, and of its height, mm."""


@dataclass(frozen=True)
class Lags:
    """Steady lags of m papillae at l depths, and forces where there are any.

    Attributes:
        depth_mm: (l,). ring: (m,).
        lag_mm: NaN where not known, 0 where a papilla does not touch, (l, m). error_mm: (l, m).
        normal_n: normal force at rest, (l,); NaN without. ratio: of the forces in gross slip.
        stiffness_n_per_mm: of all tips together while they stick, (l,).
    """

    depth_mm: F64
    ring: I64
    lag_mm: F64
    error_mm: F64
    normal_n: F64
    ratio: float
    stiffness_n_per_mm: F64


@dataclass(frozen=True)
class Fit:
    """Fitted springs.

    Attributes:
        kinetic: friction. normal_compliance, tangential_compliance: Young's modulus over the base's
            stiffnesses, 1/mm. layer_step_mm. zero_mm: depth beyond the reported one.
        youngs_modulus_mpa: NaN without forces.
        friction: of each papilla over the mean, (m,). raised_mm: height over its ring's, (m,).
        errors: standard errors of `friction` and `raised_mm`, (2, m).
        misfit: root mean square of residuals over their errors.
    """

    kinetic: float
    normal_compliance: float
    tangential_compliance: float
    layer_step_mm: float
    zero_mm: float
    youngs_modulus_mpa: float
    friction: F64
    raised_mm: F64
    errors: F64
    misfit: float


def lag_of(
    mu: F64, height_mm: F64, deep_mm: F64, base_normal: float, base_tangential: float, guess: Guess
) -> F64:
    """Steady lag of papillae, mm; forces over Young's modulus, so that compliances are in 1/mm.

    Args:
        mu, height_mm: (m,). deep_mm: indentation, (..., m).
    """
    area, inertia, nu = _section(guess)
    bending = guess.bending * inertia / height_mm**3
    compliance = _shear(height_mm, area, nu) + base_tangential
    along = 1.0 / (height_mm / area + base_normal)
    shorter = SHORTENING / height_mm
    deep = np.maximum(deep_mm, 0.0)
    bend = mu * along * deep / bending
    for _ in range(_NEWTON):
        normal = along * np.maximum(deep - shorter * bend**2, 0.0)
        falls = np.where(normal > 0.0, -2.0 * along * shorter * bend, 0.0)
        spring = bending - 2.0 * shorter * normal
        least = _LEAST_STIFFNESS * bending
        soft = spring < least
        slope = np.where(soft, least, spring - 2.0 * shorter * bend * falls) - mu * falls
        miss = bend * np.where(soft, least, spring) - mu * normal
        bend = np.maximum(bend - miss / slope, 0.0)
    normal = along * np.maximum(deep - shorter * bend**2, 0.0)
    result: F64 = bend + compliance * mu * normal
    return result


def _section(guess: Guess) -> tuple[float, float, float]:
    return np.pi * guess.radius_mm**2, np.pi * guess.radius_mm**4 / 4, guess.poisson_ratio


def _shear(height_mm: F64, area: float, nu: float) -> F64:
    """Compliance of shear times Young's modulus, 1/mm (Cowper 1966)."""
    kappa = 6 * (1 + nu) / (7 + 6 * nu)
    result: F64 = height_mm * 2 * (1 + nu) / (kappa * area)
    return result


def fit_springs(lags: Lags, guess: Guess) -> Fit | None:
    """Fit the springs to lags by least squares with weak priors; None without any lag."""
    m = len(lags.ring)
    known = np.isfinite(lags.lag_mm)
    if known.sum() < 3:
        return None
    forces = bool(np.isfinite(lags.normal_n).any())
    young = guess.youngs_modulus_mpa
    start = np.log([
        guess.kinetic, 1000 * young / guess.base_normal_n_per_m,
        1000 * young / guess.base_tangential_n_per_m, guess.layer_step_mm, young,
    ])  # fmt: skip
    area, inertia, nu = _section(guess)

    def unpacked(x: F64) -> tuple[F64, float, F64, F64, F64, F64]:
        common = np.exp(start + LOOSE * x[:5])
        zero = LOOSE_ZERO_MM * x[5]
        friction = np.exp(SCATTER * x[6 : 6 + m])
        raised = SCATTER * x[6 + m :]
        height = guess.height_mm - common[3] * lags.ring + raised
        deep = lags.depth_mm[:, None] + zero - (guess.height_mm - height)
        return common, zero, friction, raised, height, deep

    def residuals(x: F64) -> F64:
        common, _, friction, _, height, deep = unpacked(x)
        found = lag_of(common[0] * friction, height, deep, common[1], common[2], guess)
        parts = [((found - lags.lag_mm) / lags.error_mm)[known], x]
        if forces:
            young = common[4]
            along = young / (height / area + common[1])
            across = young / (
                height**3 / (guess.bending * inertia) + _shear(height, area, nu) + common[2]
            )
            normal = (along * np.maximum(deep, 0.0)).sum(axis=1)
            sticks = np.where(deep > 0.0, across, 0.0).sum(axis=1)
            for model, seen in ((normal, lags.normal_n), (sticks, lags.stiffness_n_per_mm)):
                there = np.isfinite(seen) & (seen > 0.0)
                parts.append((model[there] / seen[there] - 1.0) / 0.01)
            if np.isfinite(lags.ratio):
                parts.append(np.array([(common[0] / lags.ratio - 1.0) / 0.005]))
        return np.concatenate(parts)

    size = 6 + 2 * m
    solved = least_squares(residuals, np.zeros(size), method="trf", loss="soft_l1", f_scale=3.0,
                           max_nfev=30, x_scale=1.0)  # fmt: skip
    common, zero, friction, raised, _, _ = unpacked(solved.x)
    spread = np.linalg.inv(solved.jac.T @ solved.jac)
    error = SCATTER * np.sqrt(np.diag(spread)[6:]).reshape(2, m)
    count = int(known.sum())
    return Fit(
        float(common[0]), float(common[1]), float(common[2]), float(common[3]), float(zero),
        float(common[4]) if forces else float("nan"), friction, raised, error,
        float(np.sqrt(np.mean(solved.fun[:count] ** 2))),
    )  # fmt: skip
