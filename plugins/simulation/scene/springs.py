"""Constants and state of the papillae, and the levels of physics, for the contact solver.

A scene should hold only the physics that it needs, so the physics come in levels:

L0  closed-form onsets, for labels and plans only (`scene.onsets`).
L1  linear springs with Coulomb friction: return mapping.
L2  and large deflection: a bent papilla is shorter, and an axially loaded one softer (buckling).
L3  and relaxation after pressing, static over kinetic friction, friction rising with speed, creep,
    stick-slip.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.scene.friction import friction_field
from sliplab.plugins.simulation.scene.skin import SHORTENING, Skin

F64 = npt.NDArray[np.float64]

FREE, STUCK, SLIDING = 0.0, 1.0, 2.0
LEVELS = (1, 2, 3)


# columns of the tables that the kernels work on: one row a papilla. Tables and not tuples of
# arrays, because numba counts references at each access to an array inside a tuple
LAYOUT_X, LAYOUT_Y, GAP, ALONG, BENDING, COMPLIANCE, ACROSS, SHORTER = range(8)
(
    PLACE_X,
    PLACE_Y,
    BASE_X,
    BASE_Y,
    BRANCH_X,
    BRANCH_Y,
    FORCE_X,
    FORCE_Y,
    NORMAL,
    NORMAL_BRANCH,
    INDENTATION,
    BENT,
    PATH,
    SLIPPED,
    MODE,
    SPEED,
    SLID_S,
    EARLIER,
) = range(18)


class Law(NamedTuple):
    """Parameters that all papillae have in common."""

    static_excess: float
    """Static over kinetic friction, less one."""
    strengthening: float
    """Friction at sliding speed w is kinetic times 1 + strengthening ln(1 + w / weak_mm_s)."""
    weak_mm_s: float
    maxwell: float
    """Stiffness of the relaxing branch over the relaxed stiffness."""
    relaxation_s: float
    damping_s: float
    """Viscous part of the tangential spring over its stiffness."""
    exact_turns: bool
    """Follow the tractrix where the direction turns; else project onto the cone (first order)."""
    creep_mm_s: float = 0.0
    """Speed at which a stuck tip creeps at its static limit; it falls by e for each `creep_share`
    of the limit below it (Heslot et al. 1994, Phys. Rev. E 49, 4973; Ruina 1983)."""
    creep_share: float = 0.05
    least_mm_s: float = 0.0
    """A tip that slides slower than this sticks: where friction falls with speed, no steady sliding
    exists (Armstrong-Helouvry et al. 1994, Automatica 30, 1083)."""
    curvature: float = 0.0
    """Of the plate, 1/mm: convex towards the sensor, highest where x = y = 0."""


@dataclass(frozen=True)
class Springs:
    """Constants of n papillae during a trial."""

    table: F64
    """A row each: place in the sensor's plane (x, y, mm); indentation at which the tip touches
    (mm); relaxed stiffness along the papilla (N/mm); relaxed bending stiffness across it (N/mm);
    compliance of shear and base across it (mm/N); relaxed stiffness across the unloaded papilla,
    all in series (N/mm); loss of height over its squared bend (1/mm, 0 in level L1), (n, 8)."""
    friction: F64
    """Kinetic coefficient along each tip's path (`scene.friction`), shape (n, knots, 4)."""
    law: Law
    spots: F64 = field(default_factory=lambda: np.empty((0, 4)))
    """Round spots on the plate on which friction differs: x, y and radius in mm, and the factor
    on it; (k, 4)."""

    @property
    def layout(self) -> F64:
        """Places in the sensor's plane, mm, (n, 2)."""
        return self.table[:, LAYOUT_X : LAYOUT_Y + 1]

    @property
    def gap(self) -> F64:
        """Indentation at which each tip touches, mm, (n,)."""
        return self.table[:, GAP]

    @property
    def normal(self) -> F64:
        """Relaxed stiffness along the papilla, N/mm, (n,)."""
        return self.table[:, ALONG]

    @property
    def tangential(self) -> F64:
        """Relaxed stiffness across the unloaded papilla, N/mm, (n,)."""
        return self.table[:, ACROSS]

    def damped(self, damping_s: float) -> Springs:
        """The same springs with another damping."""
        return replace(self, law=self.law._replace(damping_s=damping_s))


@dataclass(frozen=True)
class Tips:
    """The state of n tips; the kernels write it in place, the properties are views."""

    state: F64
    """A row each, columns as named in this module, (n, 18); the last three are the mean speed
    of sliding in the last step (mm/s), how long the tip slid in it (s), and the mean speed in the
    step before if that was as long (else negative)."""

    @property
    def place(self) -> F64:
        """Tip in the plate's frame, mm, (n, 2)."""
        return self.state[:, PLACE_X : PLACE_Y + 1]

    @property
    def base(self) -> F64:
        """Unloaded tip (sensor plus layout) in the plate's frame, mm, (n, 2)."""
        return self.state[:, BASE_X : BASE_Y + 1]

    @property
    def force(self) -> F64:
        """Tangential force on the plate, N, (n, 2)."""
        return self.state[:, FORCE_X : FORCE_Y + 1]

    @property
    def normal(self) -> F64:
        """Normal force, N, (n,)."""
        return self.state[:, NORMAL]

    @property
    def bent(self) -> F64:
        """Deflection less that of shear and base, mm, (n,)."""
        return self.state[:, BENT]

    @property
    def path(self) -> F64:
        """Length of the path slid since the trial began, mm, (n,)."""
        return self.state[:, PATH]

    @property
    def slipped_s(self) -> F64:
        """Time of the last change from stick to slip, s, located in its step; NaN: never, (n,)."""
        return self.state[:, SLIPPED]

    @property
    def mode(self) -> F64:
        """FREE, STUCK or SLIDING, (n,)."""
        return self.state[:, MODE]

    def copy(self) -> Tips:
        """Return a copy of the state."""
        return Tips(self.state.copy())


def new_tips(n: int) -> Tips:
    """`n` tips clear of the plate."""
    state = np.zeros((n, 18))
    state[:, SLIPPED] = np.nan
    state[:, INDENTATION] = np.nan  # where it came from is not known
    return Tips(state)


def make_springs(
    skin: Skin,
    knots: F64,
    level: int = 3,
    *,
    static_excess: float = 0.0,
    strengthening: float = 0.0,
    weak_mm_s: float = 0.1,
    creep_mm_s: float = 0.0,
    creep_share: float = 0.05,
    least_mm_s: float = 0.0,
    curvature: float = 0.0,
    relaxation_share: float = 0.0,
    relaxation_s: float = 1.0,
    damping_s: float = 0.0,
    exact_turns: bool = True,
) -> Springs:
    """Springs of a skin at a level of physics; what the level does not have is left out.

    Args:
        knots: kinetic friction along each tip's path (`scene.friction.friction_knots`).
        relaxation_share: share of a suddenly applied force that relaxes away, below 1; the
            skin's own stiffnesses are those that remain.

    Raises:
        ValueError: an unknown level.
    """
    if level not in LEVELS:
        raise ValueError(f"level = {level}: must be one of {LEVELS}")
    rich = level == 3
    shorter = SHORTENING / skin.height_mm if level >= 2 else 0.0
    table = np.empty((len(skin), 8))
    table[:, LAYOUT_X : LAYOUT_Y + 1] = skin.layout_mm
    table[:, GAP], table[:, ALONG] = skin.gap_mm, skin.normal_n_per_mm
    table[:, BENDING], table[:, COMPLIANCE] = skin.bending_n_per_mm, skin.compliance_mm_per_n
    table[:, ACROSS], table[:, SHORTER] = skin.tangential_n_per_mm, shorter
    law = Law(
        static_excess=float(static_excess) if rich else 0.0,
        strengthening=float(strengthening) if rich else 0.0,
        weak_mm_s=float(weak_mm_s),
        maxwell=relaxation_share / (1.0 - relaxation_share) if rich else 0.0,
        relaxation_s=float(relaxation_s),
        damping_s=float(damping_s),
        exact_turns=exact_turns,
        creep_mm_s=float(creep_mm_s) if rich else 0.0,
        creep_share=float(creep_share),
        least_mm_s=float(least_mm_s) if rich else 0.0,
        curvature=float(curvature),
    )
    return Springs(table, friction_field(knots), law)


def track_width(n: int) -> int:
    """Columns of a track of `n` tips: each x and y; each path; each last slip; the plate."""
    return 4 * n + 1
