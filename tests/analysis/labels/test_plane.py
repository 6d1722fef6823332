"""A plate seen askew: its own marker tells how, and displacements on it come out right."""

from __future__ import annotations

import numpy as np

from sliplab.analysis.labels.plane import Perspective, plane_of
from sliplab.plugins.simulation.scene.lens import Lens

SIDE = 832
HALF = 3.0 * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])


def seen(tilt: tuple[float, float], noise: float = 0.02) -> tuple[Lens, np.ndarray, np.ndarray]:
    """Lens, heights of a plate that falls 20 mm, and its marker's corners, (n, 4, 2) px."""
    lens = Lens(20.0, SIDE, SIDE, tilt_deg=tilt)
    heights = -np.concatenate((np.zeros(40), np.linspace(0, 1, 30) ** 2 * 20.0))
    places = np.array([15.0, 14.0]) + HALF + np.zeros((len(heights), 1, 1))
    places[:, :, 1] += heights[:, None]
    corners = lens.project(places)
    return lens, heights, corners + np.random.default_rng(1).normal(0, noise, corners.shape)


def test_straight_on_nothing_is_found() -> None:
    _, heights, corners = seen((0.0, 0.0))
    assert plane_of(corners, np.ones(len(heights), np.bool_), (SIDE, SIDE)) is None
    assert plane_of(corners[:1], np.ones(1, np.bool_), (SIDE, SIDE)) is None


def test_displacement_on_a_tilted_plate_is_the_papillas_own() -> None:
    lens, heights, corners = seen((6.0, -4.0))
    plane = plane_of(corners, np.ones(len(heights), np.bool_), (SIDE, SIDE))
    assert isinstance(plane, Perspective)
    # a papilla that falls with the plate, and does not slip on it
    ride = np.stack((np.full(len(heights), -11.0), heights + 5.0), axis=-1)
    marker, plate = (
        lens.project(ride),
        lens.project(np.stack((np.full(len(heights), 15.0), heights + 14.0), axis=-1)),
    )
    naive = (marker - plate) - (marker - plate)[0]
    flat = plane.flat(marker) - plane.flat(plate)
    assert np.hypot(*naive.T).max() > 5.0
    assert np.hypot(*(flat - flat[0]).T).max() < 0.3
    # at the centre a pixel stays a pixel, but for the tilt's cosine
    a, b = plane.flat(lens.project(np.array([[-0.5, 0.0], [0.5, 0.0]])))
    assert abs(np.hypot(*(b - a)) - 20.0) < 0.2
