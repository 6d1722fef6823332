"""The papillae as springs that slide steadily, fitted to how far the tips lag behind their bases.

A tip in steady slip pulls with T = mu N. Its papilla is a bent column: with the bend b,
N = k_n (d - 0.6 b^2 / h) and T = b (k_b - 1.2 N / h), and the lag is b + c T, c the compliance of
shear and base (the potential of `scene.slip`; a beam's shortening and softening). Lags have
no scale of force: they determine friction, and the ratio of the base's compliances to the skin's.
Forces add the scale.
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
_NEWTON = 20


@dataclass(frozen=True)
class Guess:
    """Prior knowledge and assumptions of the skin before the pilot.

    Attributes:
        height_mm: of the centre papilla. radius_mm: of a papilla. spacing_mm: between rings.
        bending: 12 for a guided end, 3 for a free one. poisson_ratio: of the skin.
        kinetic, youngs_modulus_mpa, base_normal_n_per_m, base_tangential_n_per_m, layer_step_mm:
            where the fit begins. It holds each within `LOOSE` if the data say nothing.
        zero_mm: largest error of depth zero, which is where the centre papilla touches.
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
    zero_mm: float = 0.1


LOOSE = 0.4
"""Prior standard deviation of the logarithm of each common quantity."""
SCATTER = 0.06
"""Prior standard deviation of a papilla's friction, relative, and of its height, mm."""


@dataclass(frozen=True)
class Lags:
    """Steady lags of m papillae at l depths, and forces where there are any.

    Attributes:
        depth_mm: (l,). ring: (m,), -1 for a papilla that is not there.
        lag_mm: NaN where not known, 0 where a papilla does not touch, (l, m). error_mm: (l, m).
        normal_n: normal force at rest, (l,); NaN without. ratio: of the forces in gross slip.
        kept: ratio of normal force in gross slip to that at rest, (l,).
        stiffness_n_per_mm: of all tips together while they stick, (l,).
        pull_n_per_mm: force over lag of each ring's tips, (l, rings).
    """

    depth_mm: F64
    ring: I64
    lag_mm: F64
    error_mm: F64
    normal_n: F64
    ratio: float
    retained: F64
    stiffness_n_per_mm: F64
    pull_n_per_mm: F64


@dataclass(frozen=True)
class Fit:
    """Fitted springs.

    Attributes:
        kinetic: friction. normal_compliance, tangential_compliance: Young's modulus over the base's
            stiffnesses, 1/mm. layer_step_mm. zero_mm: indentation of the centre papilla beyond the
            reported depth.
        youngs_modulus_mpa: NaN without forces.
        friction: of each papilla over the mean, (m,). raised_mm: height over its ring's, (m,).
        gap_mm: depth at which each touches over that of the centre, (m,).
        friction_error, gap_error_mm: standard errors, (m,).
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
    gap_mm: F64
    friction_error: F64
    gap_error_mm: F64
    misfit: float


def steady(
    mu: F64, height_mm: F64, deep_mm: F64, base_normal: float, base_tangential: float, guess: Guess
) -> tuple[F64, F64]:
    """Return lag, mm, and normal force over Young's modulus, mm2, of papillae in steady slip.

    Args:
        mu, height_mm: (m,). deep_mm: indentation, (..., m).
        base_normal, base_tangential: compliances of the base times Young's modulus, 1/mm.
    """
    area, inertia, nu = _section(guess)
    bending = guess.bending * inertia / height_mm**3
    compliance = _shear(height_mm, area, nu) + base_tangential
    along = 1.0 / (height_mm / area + base_normal)
    shorter = SHORTENING / height_mm
    deep = np.maximum(deep_mm, 0.0)
    # between no bend, whose spring does not pull, and the one that lifts the tip off the plate
    low, high = np.zeros(np.broadcast_shapes(deep.shape, shorter.shape)), np.sqrt(deep / shorter)
    bend = np.minimum(mu * along * deep / bending, high)
    for _ in range(_NEWTON):
        normal = along * np.maximum(deep - shorter * bend**2, 0.0)
        falls = np.where(normal > 0.0, -2.0 * along * shorter * bend, 0.0)
        spring = bending - 2.0 * shorter * normal
        least = _LEAST_STIFFNESS * bending
        soft = spring < least
        slope = np.where(soft, least, spring - 2.0 * shorter * bend * falls) - mu * falls
        miss = bend * np.where(soft, least, spring) - mu * normal
        low, high = np.where(miss < 0.0, bend, low), np.where(miss < 0.0, high, bend)
        with np.errstate(divide="ignore", invalid="ignore"):
            found = bend - miss / slope
        bend = np.where((found >= low) & (found <= high), found, 0.5 * (low + high))
    normal = along * np.maximum(deep - shorter * bend**2, 0.0)
    return bend + compliance * mu * normal, normal


def _section(guess: Guess) -> tuple[float, float, float]:
    return np.pi * guess.radius_mm**2, np.pi * guess.radius_mm**4 / 4, guess.poisson_ratio


def _shear(height_mm: F64, area: float, nu: float) -> F64:
    """Compliance of shear times Young's modulus, 1/mm (Cowper 1966)."""
    kappa = 6 * (1 + nu) / (7 + 6 * nu)
    result: F64 = height_mm * 2 * (1 + nu) / (kappa * area)
    return result


def fit_springs(lags: Lags, guess: Guess) -> Fit | None:
    """Fit the springs to lags by least squares with weak priors; None without enough lags."""
    m = len(lags.ring)
    if np.isfinite(lags.lag_mm).sum() < 3:
        return None
    size = COMMON + 2 * m

    def residuals(x: F64) -> F64:
        return _residuals(x[None], lags, guess)[0]

    def slopes(x: F64) -> F64:
        moved = _residuals(np.vstack([x, x + _STEP * np.eye(size)]), lags, guess)
        return ((moved[1:] - moved[0]) / _STEP).T

    x = np.zeros(size)
    # far from the solution everything looks like an outlier
    for outlier in (30.0, 3.0):
        solved = least_squares(
            residuals, x, slopes, method="trf", loss="soft_l1", f_scale=outlier, max_nfev=40
        )
        x = solved.x
    common, zero, friction, raised = _unpacked(solved.x[None], guess)
    mu, normal, tangential, step, young = common[0].tolist()
    spread = np.linalg.inv(solved.jac.T @ solved.jac)
    centre = lags.ring == 0
    gap = step * lags.ring - raised[0] + raised[0, centre].mean()
    slope = np.zeros((m, size))
    slope[:, _LAYER_STEP] = LOOSE * step * lags.ring
    slope[:, COMMON + m :] = SCATTER * (centre / centre.sum() - np.eye(m))
    return Fit(
        mu,
        normal,
        tangential,
        step,
        float(zero[0]),
        young if np.isfinite(lags.normal_n).any() else float("nan"),
        friction[0],
        raised[0],
        gap,
        SCATTER * np.sqrt(np.diag(spread)[COMMON : COMMON + m]),
        np.sqrt(np.einsum("jp,pq,jq->j", slope, spread, slope)),
        float(np.sqrt(np.mean(solved.fun[: int(np.isfinite(lags.lag_mm).sum())] ** 2))),
    )


COMMON, _LAYER_STEP = 6, 3
"""Unknowns that all papillae have in common, and which of them is the layers' step."""
_STEP = 1e-5


def _unpacked(x: F64, guess: Guess) -> tuple[F64, F64, F64, F64]:
    """Return common quantities (b, 5), depth zero (b,), friction and raised heights (b, m)."""
    young = guess.youngs_modulus_mpa
    start = np.log(
        [
            guess.kinetic,
            1000 * young / guess.base_normal_n_per_m,
            1000 * young / guess.base_tangential_n_per_m,
            guess.layer_step_mm,
            young,
        ]
    )
    m = (x.shape[1] - COMMON) // 2
    own = SCATTER * x[:, COMMON:]
    zero = guess.zero_mm / 3**0.5 * x[:, 5]  # as it scatters if no error is more likely
    return np.exp(start + LOOSE * x[:, :5]), zero, np.exp(own[:, :m]), own[:, m:]


def _residuals(x: F64, lags: Lags, guess: Guess) -> F64:
    """Return misfits over their errors, the priors' too, for b sets of unknowns: (b, n)."""
    common, zero, friction, raised = _unpacked(x, guess)
    mu, normal, tangential, step, young = (column[:, None, None] for column in common.T)
    height = guess.height_mm - step * lags.ring + raised[:, None]
    # depth zero is where the centre papilla touches, as that came out
    centre = lags.ring == 0
    zero = zero - raised[:, centre].sum(axis=1) / max(int(centre.sum()), 1)
    deep = lags.depth_mm[:, None] + zero[:, None, None] - (guess.height_mm - height)
    grip = mu * friction[:, None]
    lag, pressed = steady(grip, height, deep, normal, tangential, guess)
    known = np.isfinite(lags.lag_mm)
    parts = [((lag - lags.lag_mm) / lags.error_mm)[:, known], x]
    if np.isfinite(lags.normal_n).any():
        area, inertia, nu = _section(guess)
        there = lags.ring >= 0
        pressed = pressed * there
        along = there / (height / area + normal)
        bending = height**3 / (guess.bending * inertia)
        across = there / (bending + _shear(height, area, nu) + tangential)
        resting = (along * np.maximum(deep, 0.0)).sum(axis=2)
        sticks = np.where(deep > 0.0, across, 0.0).sum(axis=2)
        in_ring = lags.ring[:, None] == np.arange(lags.ring.max() + 1)
        pull = young * ((grip * pressed) @ in_ring) / np.maximum(lag @ in_ring, 1e-6)
        retained = pressed.sum(axis=2) / resting
        ratio = (grip * pressed).sum(axis=2) / pressed.sum(axis=2)
        # a ring of few papillae has a small part in the force
        few = np.tile(0.1 / in_ring.sum(axis=0), len(lags.depth_mm))
        for model, seen, error in (
            (young[:, 0] * resting, lags.normal_n, 0.003),
            (retained, lags.retained, 0.002),
            (young[:, 0] * sticks, lags.stiffness_n_per_mm, 0.02),
            (pull.reshape(len(x), -1), lags.pull_n_per_mm.ravel(), few),
            (ratio, np.full(len(lags.depth_mm), lags.ratio), 0.003),
        ):
            known = np.isfinite(seen)
            parts.append(
                (model[:, known] / seen[known] - 1.0) / np.broadcast_to(error, seen.shape)[known]
            )
    return np.concatenate(parts, axis=1)
