"""The ArUco marker on the sliding plate: printed once, then placed by fractions of a pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from sliplab.rigs.scene.lens import Lens

F64 = npt.NDArray[np.float64]
U8 = npt.NDArray[np.uint8]

MODULES = 6
"""Cells along a side of a DICT_4X4_50 marker, its black border included."""


@dataclass(frozen=True)
class Print:
    """What is printed where. Lengths mm."""

    marker_id: int
    side_mm: float
    """Of the black square; a white quiet zone of one module goes round it."""
    centre_mm: tuple[float, float]
    """In the plate's plane, when the plate's height is 0."""

    @property
    def whole_mm(self) -> float:
        """Side with the quiet zone."""
        return self.side_mm * (MODULES + 2) / MODULES


class PlateMarker:
    """A marker seen through a lens; grey levels as given."""

    def __init__(self, printed: Print, lens: Lens, dark: int, bright: int) -> None:
        self._printed, self._lens, self._dark = printed, lens, dark
        self._patch = _patch(printed, lens.px_per_mm, dark, bright)

    @property
    def size_px(self) -> int:
        """Side of the marker with its quiet zone, whole pixels at the centre's scale."""
        return len(self._patch)

    def centre_px(self, height_mm: F64) -> F64:
        """Where the marker's centre is seen for the plate's heights, (..., 2) from (...,)."""
        place = np.empty((*np.shape(height_mm), 2))
        place[..., 0], place[..., 1] = self._printed.centre_mm
        place[..., 1] += height_mm
        return self._lens.project(place)

    def view(self, heights_mm: F64, width: int, height: int) -> tuple[int, int, U8] | None:
        """The mean picture over heights of the plate, (s,): left, top and the piece (h, w).

        None where nothing of it lies in a picture of `width` x `height`.
        """
        quads = self._quads(heights_mm)
        low = np.maximum(np.floor(quads.min(axis=(0, 1))), 0).astype(int)
        high = np.minimum(np.ceil(quads.max(axis=(0, 1))) + 1, [width, height]).astype(int)
        (left, top), (right, bottom) = low.tolist(), high.tolist()
        if left >= right or top >= bottom:
            return None
        size = (right - left, bottom - top)
        pieces = (self._place(quad - low, size) for quad in quads)
        if len(quads) == 1:
            return left, top, next(pieces)
        total = np.zeros(size[::-1], np.float32)
        for piece in pieces:
            cv2.accumulate(piece, total)
        return left, top, np.rint(total / len(quads)).astype(np.uint8)

    def _quads(self, heights_mm: F64) -> F64:
        """Corners of the quiet zone in the picture, (s, 4, 2): clockwise from the top left."""
        half = 0.5 * self._printed.whole_mm
        corners = half * np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])
        places = np.array(self._printed.centre_mm) + corners + np.zeros((len(heights_mm), 1, 1))
        places[:, :, 1] += heights_mm[:, None]
        return self._lens.project(places)

    def _place(self, quad: F64, size: tuple[int, int]) -> U8:
        """The patch with its corners on `quad`, in a picture of (width, height) `size`."""
        end = len(self._patch) - 0.5
        corners = np.array([[-0.5, -0.5], [end, -0.5], [end, end], [-0.5, end]], np.float32)
        seen = quad.astype(np.float32)
        how: dict[str, Any] = {
            "flags": cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            "borderMode": cv2.BORDER_CONSTANT,
            "borderValue": float(self._dark),
        }
        if self._lens.straight:
            inverse = cv2.getAffineTransform(seen[:3], corners[:3])
            piece = cv2.warpAffine(self._patch, inverse, size, **how)
        else:
            # a radial term is as good as projective over so small a square
            inverse = cv2.getPerspectiveTransform(seen, corners)
            piece = cv2.warpPerspective(self._patch, inverse, size, **how)
        return np.asarray(piece, np.uint8)


def _patch(printed: Print, px_per_mm: float, dark: int, bright: int) -> U8:
    """The marker with a quiet zone of one module, at about the camera's resolution."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    fine = cv2.aruco.generateImageMarker(dictionary, printed.marker_id, 64 * MODULES)
    fine = cv2.copyMakeBorder(fine, 64, 64, 64, 64, cv2.BORDER_CONSTANT, value=255)
    side = max(round(px_per_mm * printed.whole_mm), 8)
    small = cv2.resize(fine, (side, side), interpolation=cv2.INTER_AREA)
    result: U8 = np.rint(dark + small / 255.0 * (bright - dark)).astype(np.uint8)
    return result
