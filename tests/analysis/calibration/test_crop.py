"""Locating the skin in the event camera's image."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sliplab.analysis.calibration.crop import CropError, find_crop

Counts = NDArray[np.int64]


def seen(
    centre: tuple[float, float],
    *,
    scale: float = 14.0,
    uneven: float = 0.0,
    noise: float = 0.0,
    rings: tuple[int, ...] = (1, 6, 12),
    seed: int = 1,
) -> Counts:
    """Markers whose rims fire, on the right `uneven` times as much more as on the left."""
    rng = np.random.default_rng(seed)
    counts = np.zeros((2, 480, 640), np.int64)
    for half in counts:
        for ring, count in enumerate(rings):
            for angle in 2 * np.pi * np.arange(count) / count:
                place = centre + ring * 5.6 * scale * np.array([np.cos(angle), np.sin(angle)])
                n = round(600 * (1.0 + uneven * (np.cos(angle) > 0)))
                way = rng.uniform(0, 2 * np.pi, n)
                rim = 1.2 * scale + rng.normal(0, 2.0, n)
                rim_x, rim_y = place[0] + rim * np.cos(way), place[1] + rim * np.sin(way)
                x, y = np.rint(rim_x).astype(int), np.rint(rim_y).astype(int)
                inside = (x >= 0) & (x < 640) & (y >= 0) & (y < 480)
                np.add.at(half, (y[inside], x[inside]), 1)
        half += rng.poisson(noise, half.shape)
    return counts


@pytest.mark.parametrize("centre", [(319.5, 239.5), (333.0, 232.0), (300.0, 250.0)])
@pytest.mark.parametrize("uneven", [0.0, 3.0])
def test_the_centre_is_found_whatever_bears_more(
    centre: tuple[float, float], uneven: float
) -> None:
    crop = find_crop(seen(centre, uneven=uneven))
    assert np.hypot(crop.centre_px[0] - centre[0], crop.centre_px[1] - centre[1]) < 2.5
    assert crop.residual_px < 3.0
    assert crop.size_px % 20 == 0
    outer = 2 * (11.2 + 1.2) * 14
    assert outer - 8 < crop.diameter_px < outer + 20
    assert crop.diameter_px <= crop.size_px < crop.diameter_px + 20


def test_hot_pixels_and_noise_do_not_pull() -> None:
    counts = seen((319.5, 239.5), noise=0.02)
    for x, y in ((5, 5), (630, 470), (10, 400), (600, 20)):
        counts[:, y, x] += 50_000
    crop = find_crop(counts)
    assert np.hypot(crop.centre_px[0] - 319.5, crop.centre_px[1] - 239.5) < 2.5


def test_a_margin_makes_the_square_larger() -> None:
    plain, wide = (find_crop(seen((319.5, 239.5)), margin) for margin in (0.0, 20.0))
    assert wide.size_px - plain.size_px in {20, 40, 60}


@pytest.mark.parametrize(
    ("counts", "says"),
    [
        (np.zeros((2, 480, 640), np.int64), "was the skin moved"),
        (np.zeros((480, 640), np.int64), "must be"),
        (np.eye(480, 640, dtype=np.int64)[None].repeat(2, 0) * 100, "no skin is seen"),
        (seen((560.0, 239.5)), "leaves the picture"),
        (seen((319.5, 239.5), scale=25.0), "leaves the picture"),
    ],
    ids=["nothing", "one half", "a line", "at the edge", "too near"],
)
def test_what_is_no_skin_is_refused(counts: Counts, says: str) -> None:
    with pytest.raises(CropError, match=says):
        find_crop(counts)
