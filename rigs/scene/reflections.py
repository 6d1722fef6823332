"""Light mirrored by the acrylic: soft blobs and streaks that stand still while the skin moves.

A nuisance to be switched on, so that a label that only holds in the dark is noticed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sliplab.rigs.scene.randomness import generator

U8 = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Reflections:
    """How many there are, and how bright: levels in grey values, lengths mm."""

    count: int = 0
    level: float = 10.0
    size_mm: float = 3.0


def draw_reflections(
    reflections: Reflections, width: int, height: int, px_per_mm: float, seed: int
) -> U8:
    """What the reflections of a trial add to every picture, grey levels, (height, width).

    Each is a Gaussian with its standard deviation along one axis about `size_mm` and across it
    between a fifth of that and as much, at a random place and angle; together they reach at most
    `level`.
    """
    rng = generator(seed, "reflections")
    light = np.zeros((height, width))
    rows, columns = np.ogrid[:height, :width]
    for _ in range(reflections.count):
        x, y = rng.uniform(0.0, width), rng.uniform(0.0, height)
        angle, peak = rng.uniform(0.0, math.pi), rng.uniform(0.5, 1.0)
        along = rng.uniform(0.6, 1.4) * reflections.size_mm * px_per_mm
        across = rng.uniform(0.2, 1.0) * along
        cosine, sine = math.cos(angle), math.sin(angle)
        u = (cosine * (columns - x) + sine * (rows - y)) / along
        v = (cosine * (rows - y) - sine * (columns - x)) / across
        light += peak * np.exp(-0.5 * (u * u + v * v))
    grey: U8 = np.rint(reflections.level * np.minimum(light, 1.0)).astype(np.uint8)
    return grey
