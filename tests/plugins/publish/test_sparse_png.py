"""PNG of images that are nearly all black."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from sliplab.plugins.publish.sparse_png import sparse_pngs


@pytest.mark.quick(13)
@pytest.mark.parametrize(
    ("height", "width", "share"),
    [(480, 640, 0.0), (480, 640, 1e-4), (1, 1, 1.0), (1, 87, 0.02), (7, 5, 0.5), (61, 83, 1.0)],
)
@pytest.mark.parametrize("seed", range(8))
def test_images_are_read_as_they_were_written(
    height: int, width: int, share: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    flat = np.zeros((3, height * width * 3), np.uint8)
    images, places = np.nonzero((rng.random(flat.shape) < share) & [[True], [False], [True]])
    # a zero among the values is a level like any other
    flat[images, places] = rng.integers(0, 256, places.size)
    edges = np.searchsorted(images, range(4))
    packed = sparse_pngs(places, flat[images, places], edges, height, width)
    for data, image in zip(packed, flat, strict=True):
        read = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(read[..., ::-1].reshape(-1), image)
