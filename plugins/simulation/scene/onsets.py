"""Level L0: when papillae let go, in closed form or nearly so, without simulating anything.

While a tip sticks its force is a known function of time, so its slip is one root of one function:
exact for even friction, at any level of physics, for thousands of tips in a millisecond. Plans
use it for expected onsets, and to decide whether a scene needs a higher level.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.scene.skin import SHORTENING, Skin

F64 = npt.NDArray[np.float64]

_BISECTIONS = 46
_NEWTON = 7


@dataclass(frozen=True)
class Material:
    """Friction and relaxation; fields as in `scene.springs.make_springs`."""

    kinetic: float
    static_excess: float = 0.0
    relaxation_share: float = 0.0
    relaxation_s: float = 1.0


def slide_onsets(
    skin: Skin,
    material: Material,
    level: int,
    depth_mm: npt.ArrayLike,
    speed_mm_s: npt.ArrayLike,
    press_mm_s: npt.ArrayLike = 2.0,
    settled_s: npt.ArrayLike = 2.0,
    grip: F64 | None = None,
) -> F64:
    """Compute when each tip lets go after the start of straight slides, s, (..., n); infinite if it
    never touches. Depth, speeds and times broadcast: one slide each.

    Level 1 is u = mu N / k_t. Level 2 takes the bent column's potential
    (`scene.contact`), level 3 also static friction and the linear solid's relaxation
    since the pressing, k v (t + m tau (1 - e^(-t/tau))).

    Args:
        press_mm_s: speed of the pressing; what relaxes afterwards depends on it.
        settled_s: from the end of the pressing to the start of the slide.
        grip: each tip's friction over its mean, (n,); 1 by default.
    """
    depth, speed, press, settled = (
        np.asarray(value, np.float64)[..., None]
        for value in (depth_mm, speed_mm_s, press_mm_s, settled_s)
    )
    deep = depth - skin.gap_mm
    touching = deep > 0.0
    deep = np.maximum(deep, 0.0)
    mu = material.kinetic * skin.friction_factor * (1.0 if grip is None else grip)
    maxwell, tau = 0.0, material.relaxation_s
    if level >= 3:
        mu = mu * (1.0 + material.static_excess)
        maxwell = material.relaxation_share / (1.0 - material.relaxation_share)
    shorter = SHORTENING / skin.height_mm if level >= 2 else np.zeros(len(skin))
    pressing_s = deep / press
    branch = (
        maxwell
        * skin.normal_n_per_mm
        * press
        * tau
        * -np.expm1(-pressing_s / tau)
        * np.exp(-settled / tau)
    )
    k_t = skin.tangential_n_per_mm

    def beyond(t_s: F64) -> F64:
        """Force less limit; rises with time."""
        pressed = skin.normal_n_per_mm * deep + branch * np.exp(-t_s / tau)
        bend = _bend(skin, shorter, speed * t_s, pressed)
        normal = np.maximum(pressed - skin.normal_n_per_mm * shorter * bend**2, 0.0)
        spring = bend * (skin.bending_n_per_mm - 2.0 * shorter * normal)
        relaxing = maxwell * k_t * speed * tau * -np.expm1(-t_s / tau)
        return spring + relaxing - mu * normal

    # stretched to twice this a tip would exceed its linear friction limit
    high = 4.0 * np.max(mu * skin.normal_n_per_mm * deep / k_t, axis=-1, keepdims=True) / speed
    high = np.broadcast_to(high + 1.0, np.broadcast_shapes(high.shape, deep.shape))
    low = np.zeros(high.shape)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        out = beyond(middle) > 0.0
        high, low = np.where(out, middle, high), np.where(out, low, middle)
    return np.where(touching, 0.5 * (low + high), np.inf)


def _bend(skin: Skin, shorter: F64, stretch: F64, pressed: F64) -> F64:
    """Bend of columns whose tips are `stretch` mm off, by Newton on a monotone cubic."""
    soft = 1.0 + skin.compliance_mm_per_n * (skin.bending_n_per_mm - 2.0 * shorter * pressed)
    cubic = skin.compliance_mm_per_n * 2.0 * shorter**2 * skin.normal_n_per_mm
    bend = stretch / np.maximum(soft, 0.1)
    for _ in range(_NEWTON):
        bend = bend - (bend * (soft + cubic * bend**2) - stretch) / (soft + 3.0 * cubic * bend**2)
    return bend


def retraction_onsets(
    skin: Skin,
    kinetic: float,
    mass_kg: float,
    depth_mm: float,
    speed_mm_s: float,
    gravity_m_s2: float = 9.81,
) -> tuple[float, float]:
    """First slip and fall of a hanging plate after the start of a retraction, s; level 1.

    Stuck tips share the weight W by their stiffness, y = W / sum k, and tip i lets go at the
    depth gap + k y / (mu k_n); the plate falls when all friction together is W.

    Returns:
        both infinite if the plate never hung on the skin.
    """
    weight = mass_kg * gravity_m_s2
    mu = kinetic * skin.friction_factor
    touching = depth_mm > skin.gap_mm
    k_n, k_t, gap = skin.normal_n_per_mm, skin.tangential_n_per_mm, skin.gap_mm
    if np.sum((mu * k_n * (depth_mm - gap))[touching]) <= weight:
        return np.inf, np.inf
    share = weight / np.sum(k_t[touching])
    lets_go = (gap + k_t * share / (mu * k_n))[touching]
    first = max((depth_mm - float(lets_go.max())) / speed_mm_s, 0.0)
    low, high = 0.0, depth_mm
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        carried = float(np.sum(mu * k_n * np.maximum(middle - gap, 0.0)))
        low, high = (low, middle) if carried > weight else (middle, high)
    return first, (depth_mm - 0.5 * (low + high)) / speed_mm_s
