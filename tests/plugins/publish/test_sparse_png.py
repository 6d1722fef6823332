"""PNG of images that are nearly all black."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from sliplab.plugins.publish.sparse_png import sparse_png


@pytest.mark.parametrize(
    ("height", "width", "share"),
    [(480, 640, 0.0), (480, 640, 1e-4), (1, 1, 1.0), (1, 87, 0.02), (7, 5, 0.5), (61, 83, 1.0)],
)
@pytest.mark.parametrize("seed", range(8))
def test_image_is_read_as_it_was_written(height: int, width: int, share: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    flat = np.zeros(height * width * 3, np.uint8)
    places = np.flatnonzero(rng.random(flat.size) < share)
    # a zero among the values is a level like any other
    flat[places] = rng.integers(0, 256, places.size)
    data = sparse_png(places, flat[places], height, width)
    read = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(read[..., ::-1].reshape(-1), flat)
