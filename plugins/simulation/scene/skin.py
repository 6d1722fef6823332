"""The papillae as springs: geometry and stiffness of the soft skin, from its measures.

A dozen and a half columns on a compliant base carry everything that a slip experiment shows; no
finite elements are needed. Young's modulus and the base's stiffnesses are fitted guesses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.scene.randomness import generator

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]

SHORTENING = 0.6
"""A column with guided ends and height h whose tip moved aside by b is shorter by 0.6 b^2 / h:
half the integral of the squared slope of its cubic shape."""


@dataclass(frozen=True)
class SkinGeometry:
    """Design of a skin. Lengths mm, modulus MPa (N/mm2), base stiffnesses N/m.

    A base stiffness of None is a rigid base.
    """

    ring_counts: tuple[int, ...] = (1, 6, 12)
    heights_mm: tuple[float, ...] = (10.1, 9.0, 7.9)
    spacing_mm: float = 5.6
    radius_mm: float = 2.0
    youngs_modulus_mpa: float = 0.6
    poisson_ratio: float = 0.49
    bending: float = 12.0
    base_normal_n_per_m: float | None = 150.0
    base_tangential_n_per_m: float | None = 200.0
    height_scatter_mm: float = 0.0
    position_scatter_mm: float = 0.0
    friction_scatter: float = 0.0


@dataclass(frozen=True)
class Skin:
    """n papillae as made; ring by ring from the centre, counterclockwise from +x."""

    layout_mm: F64
    """Places in the sensor's plane, shape (n, 2)."""
    gap_mm: F64
    """Depth at which each tip touches, over that of the highest one, shape (n,)."""
    ring: I64
    """Layer, 0 is the centre, shape (n,)."""
    height_mm: F64
    """Of each papilla as made, shape (n,)."""
    normal_n_per_mm: F64
    """Along the papilla, base included."""
    bending_n_per_mm: F64
    """Across the unloaded papilla, of its bending alone."""
    compliance_mm_per_n: F64
    """Across the papilla, in series with its bending: shear, and the base."""
    friction_factor: F64
    """This tip's friction over the mean, shape (n,)."""

    def __len__(self) -> int:
        return len(self.ring)

    @property
    def tangential_n_per_mm(self) -> F64:
        """Stiffness across the unloaded papilla, everything in series, shape (n,)."""
        return 1.0 / (1.0 / self.bending_n_per_mm + self.compliance_mm_per_n)


@dataclass(frozen=True)
class MeasuredGeometry:
    """Measured geometry of n papillae, instead of a drawn one.

    Attributes:
        height_mm: (n,). friction_factor: over the mean, (n,). offset_mm: from the design's places,
            (n, 2).
    """

    height_mm: F64
    friction_factor: F64
    offset_mm: F64


def make_skin(geometry: SkinGeometry, seed: int, made: MeasuredGeometry | None = None) -> Skin:
    """A skin with the fabrication scatter that belongs to `seed`, or with a measured one.

    The skin without scatter is the same after a turn by 60 degrees if every ring's count can
    be divided by 6.
    """
    places, heights, ring = [], [], []
    for layer, count in enumerate(geometry.ring_counts):
        for index in range(count):
            angle = 2 * math.pi * index / count
            radius = layer * geometry.spacing_mm
            places.append((radius * math.cos(angle), radius * math.sin(angle)))
            heights.append(geometry.heights_mm[layer])
            ring.append(layer)
    n = len(ring)
    if made is None:
        rng = generator(seed, "skin")
        height = np.array(heights) + geometry.height_scatter_mm * rng.uniform(-1.0, 1.0, n)
        wander = np.clip(rng.standard_normal((n, 2)), -2.0, 2.0)
        grip = np.clip(rng.standard_normal(n), -2.0, 2.0)
        made = MeasuredGeometry(
            height, 1.0 + geometry.friction_scatter * grip, geometry.position_scatter_mm * wander
        )
    height = made.height_mm
    return Skin(
        layout_mm=np.array(places) + made.offset_mm,
        gap_mm=height.max() - height,
        ring=np.array(ring, np.int64),
        normal_n_per_mm=normal_stiffness(geometry, height),
        height_mm=height,
        bending_n_per_mm=bending_stiffness(geometry, height),
        compliance_mm_per_n=series_compliance(geometry, height),
        friction_factor=made.friction_factor,
    )


def normal_stiffness(geometry: SkinGeometry, height_mm: F64) -> F64:
    """Stiffness along the papilla, N/mm: 1/k = h / (E A) + 1/k_base."""
    area = math.pi * geometry.radius_mm**2
    column = height_mm / (geometry.youngs_modulus_mpa * area)
    return 1.0 / (column + _base_mm_per_n(geometry.base_normal_n_per_m))


def bending_stiffness(geometry: SkinGeometry, height_mm: F64) -> F64:
    """Bending stiffness across the papilla, N/mm: c E I / h^3 with I = pi r^4 / 4."""
    inertia = math.pi * geometry.radius_mm**4 / 4
    return geometry.bending * geometry.youngs_modulus_mpa * inertia / height_mm**3


def series_compliance(geometry: SkinGeometry, height_mm: F64) -> F64:
    """Compliance of shear and base across the papilla, mm/N: h / (kappa G A) + 1/k_base.

    kappa = 6 (1 + nu) / (7 + 6 nu) (Cowper 1966, circular section), G = E / (2 (1 + nu)).
    """
    nu = geometry.poisson_ratio
    area = math.pi * geometry.radius_mm**2
    kappa = 6 * (1 + nu) / (7 + 6 * nu)
    shear = geometry.youngs_modulus_mpa / (2 * (1 + nu))
    return height_mm / (kappa * shear * area) + _base_mm_per_n(geometry.base_tangential_n_per_m)


def _base_mm_per_n(stiffness_n_per_m: float | None) -> float:
    return 0.0 if stiffness_n_per_m is None else 1000.0 / stiffness_n_per_m
