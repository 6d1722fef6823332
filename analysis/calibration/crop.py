"""Locate the skin in the event camera's picture: the circle round all that fires when it moves.

Every marker fires along its rim while the skin is moved about, so where events are is the layout
smeared by the motion. The smallest circle round it does not mind that some papillae bear more than
others, which biases a mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Counts = NDArray[np.int64]

STEP_PX = 20
"""A crop is a multiple of this, the side of a pooled cell."""
_BLUR_PX = 9
_SHARE = 0.1
"""Share of the highest blurred count above which a cell belongs to the skin."""
_LEAST_EVENTS = 2000
_ROUND = 0.6
"""Least ratio of the narrowest to the widest spread of what fires."""


class CropError(ValueError):
    """A histogram in which no skin can be found; the text says what to do."""


@dataclass(frozen=True)
class Crop:
    """A square of the picture.

    Attributes:
        centre_px: column and row of the skin's centre.
        size_px: side of the square that holds the skin, a multiple of `STEP_PX`.
        diameter_px: of the circle round all that fired.
        residual_px: distance between the centres found in the two halves.
    """

    centre_px: tuple[float, float]
    size_px: int
    diameter_px: float
    residual_px: float


def find_crop(counts: Counts, margin_px: float = 0.0) -> Crop:
    """The square round the skin.

    Args:
        counts: events of each pixel in two halves of a recording in which the skin was pressed
            and moved about, (2, height, width).
        margin_px: added on every side.

    Raises:
        CropError: too few events, nothing round among them, or a square that leaves the picture.
    """
    if counts.ndim != 3 or counts.shape[0] != 2:
        raise CropError(f"counts have the shape {counts.shape}: must be (2, height, width)")
    if counts.sum() < _LEAST_EVENTS:
        raise CropError(
            f"{int(counts.sum())} events, at least {_LEAST_EVENTS} are needed: was the skin moved?"
        )
    halves = [_circle(half) for half in counts]
    x, y, radius = _circle(counts.sum(axis=0))
    apart = float(np.hypot(halves[0][0] - halves[1][0], halves[0][1] - halves[1][1]))
    size = int(np.ceil(2 * (radius + margin_px) / STEP_PX)) * STEP_PX
    height, width = counts.shape[1:]
    if not (size / 2 <= x + 0.5 <= width - size / 2 and size / 2 <= y + 0.5 <= height - size / 2):
        raise CropError(
            f"a square of {size} px round ({x:.0f}, {y:.0f}) leaves the picture of "
            f"{width} x {height} px: the camera does not see the whole skin in its middle"
        )
    return Crop((x, y), size, 2 * radius, apart)


def _circle(counts: Counts) -> tuple[float, float, float]:
    """Centre and radius of the smallest circle round what fires, px."""
    # a hot pixel fires alone: no pixel counts for more than the busiest of its neighbours
    capped = np.minimum(counts, 65_535).astype(np.uint16)
    ring = np.ones((3, 3), np.uint8)
    ring[1, 1] = 0
    alone = np.minimum(capped, cv2.dilate(capped, ring)).astype(np.float32)
    smooth = cv2.blur(alone, (_BLUR_PX, _BLUR_PX))
    mask = (smooth > _SHARE * float(np.quantile(smooth[smooth > 0], 0.99))).astype(np.uint8)
    # what is smaller than a marker's rim is noise
    mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((_BLUR_PX, _BLUR_PX), np.uint8))
    rows, columns = np.nonzero(mask)
    if len(rows) < _BLUR_PX**2:
        raise CropError("events are all over the picture, or nowhere together: no skin is seen")
    places = np.column_stack([columns, rows]).astype(np.float32)
    narrow, wide = np.linalg.eigvalsh(np.cov(places.T)) ** 0.5
    if narrow < _ROUND * wide:
        raise CropError("what fires is long and not round: no skin is seen, or a part of it only")
    (x, y), radius = cv2.minEnclosingCircle(places)
    return float(x), float(y), float(radius)
