"""Pictures of the tips through the plate, drawn at exact places as cheaply as can be.

Markers are white discs with anti-aliased rims; the ArUco marker of the sliding plate is a
pre-rendered patch, shifted by fractions of a pixel. Noise is only drawn where something is looked
at: over the whole picture it would cost more than everything else.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from numba import njit

from rigs.scene.randomness import generator, key

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
U8 = npt.NDArray[np.uint8]

_SHIFTS = 128
_GOLDEN = 0x9E3779B97F4A7C15
_MASK = 0xFFFFFFFFFFFFFFFF
_MARGIN_PX = 6.0
_MODULES = 6


@dataclass(frozen=True)
class FrameOptics:
    """What the outside camera sees, and how. Lengths mm, levels 0 to 255."""

    px_per_mm: float = 12.0
    tip_radius_mm: float = 2.0
    tip_level: int = 200
    ground_level: int = 25
    noise: float = 1.5
    marker_id: int = 0
    marker_side_mm: float = 6.6
    marker_centre_mm: tuple[float, float] = (15.8, 15.8)


class PlateView:
    """A camera fixed in the world, its picture's centre on the plate's origin, y up."""

    def __init__(self, optics: FrameOptics, width: int, height: int) -> None:
        self.optics, self.width, self.height = optics, width, height
        self._patch = _marker_patch(optics)
        reach = optics.px_per_mm * optics.tip_radius_mm + _MARGIN_PX
        size = _SHIFTS + max(2 * math.ceil(reach) + 2, self._patch.shape[0] + 2)
        self._noise = np.zeros((size, size), np.int8)
        self._dark = self._bright = np.zeros((size, size), np.uint8)
        self._seed: int | None = None
        self._key = 0

    def centre_px(self, place_mm: F64) -> F64:
        """Column and row of places in the plate's plane, (..., 2) from (..., 2)."""
        result = np.empty_like(place_mm)
        result[..., 0] = 0.5 * (self.width - 1) + self.optics.px_per_mm * place_mm[..., 0]
        result[..., 1] = 0.5 * (self.height - 1) - self.optics.px_per_mm * place_mm[..., 1]
        return result

    def draw(self, images: U8, tips_mm: F64, plate_mm: F64 | None, number: I64, seed: int) -> None:
        """Fill `images`, (k, height, width), uint8.

        Args:
            tips_mm: places of the tips in the world, (k, n, 2).
            plate_mm: height of the sliding plate with its marker, (k,); None: a plate without.
            number: the frames' numbers, which with `seed` decide on their noise, (k,).
        """
        if seed != self._seed:
            self._seed, self._key = seed, key(seed, "frame noise")
            # one tile a trial: a picture only ever shows shifted pieces of it
            draw = generator(seed, "frame noise").standard_normal(self._noise.shape)
            grey = np.rint(np.clip(draw, -4.0, 4.0) * self.optics.noise)
            self._noise = grey.astype(np.int8)
            self._dark = (self.optics.ground_level + grey).astype(np.uint8)
            self._bright = (self.optics.tip_level + grey).astype(np.uint8)
        optics = self.optics
        radius = optics.px_per_mm * optics.tip_radius_mm
        centres = self.centre_px(tips_mm)
        for index in range(len(images)):
            frame_key = np.uint64(self._key ^ (int(number[index]) * _GOLDEN & _MASK))
            draw_discs(
                images[index], centres[index], radius, optics.ground_level, optics.tip_level,
                _MARGIN_PX, self._dark, self._bright, frame_key,
            )  # fmt: skip
            if plate_mm is not None:
                self._stick(images[index], float(plate_mm[index]), frame_key)

    def _stick(self, image: U8, plate_mm: float, frame_key: np.uint64) -> None:
        optics = self.optics
        place = np.array(optics.marker_centre_mm) + np.array([0.0, plate_mm])
        column, row = self.centre_px(place).tolist()
        side = self._patch.shape[0]
        # the patch has whole pixels; its true side has not
        scale = optics.px_per_mm * optics.marker_side_mm * (_MODULES + 2) / _MODULES / side
        half = 0.5 * scale * side
        left, right = max(round(column - half), 0), min(round(column + half) + 1, self.width)
        top, bottom = max(round(row - half), 0), min(round(row + half) + 1, self.height)
        if left >= right or top >= bottom:
            return
        shift = 0.5 * (side - 1)
        # from pixels of the cut-out to pixels of the patch
        inverse = np.array([
            [1 / scale, 0.0, shift + (left - column) / scale],
            [0.0, 1 / scale, shift + (top - row) / scale],
        ])  # fmt: skip
        piece = cv2.warpAffine(
            self._patch, inverse, (right - left, bottom - top),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        add_noise(piece, self._noise, frame_key)
        image[top:bottom, left:right] = piece


def _marker_patch(optics: FrameOptics) -> U8:
    """The marker with a quiet zone of one module, at about the camera's resolution."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    fine = cv2.aruco.generateImageMarker(dictionary, optics.marker_id, 64 * _MODULES)
    fine = cv2.copyMakeBorder(fine, 64, 64, 64, 64, cv2.BORDER_CONSTANT, value=255)
    side = round(optics.px_per_mm * optics.marker_side_mm * (_MODULES + 2) / _MODULES)
    small = cv2.resize(fine, (max(side, 8), max(side, 8)), interpolation=cv2.INTER_AREA)
    span = optics.tip_level - optics.ground_level
    result: U8 = np.rint(optics.ground_level + small / 255.0 * span).astype(np.uint8)
    return result


@njit(cache=True, nogil=True)
def _mix(value):  # type: ignore[no-untyped-def]
    """The finaliser of SplitMix64 (Steele, Lea and Flood 2014)."""
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@njit(cache=True, nogil=True)
def _shift(frame_key, index):  # type: ignore[no-untyped-def]
    """Where in the noise tile a piece of a picture begins: row and column, 0 to 127."""
    turn = _mix(frame_key + np.uint64(index))
    return int(turn & np.uint64(127)), int((turn >> np.uint64(8)) & np.uint64(127))


@njit(cache=True, nogil=True)
def add_noise(image, noise, frame_key):  # type: ignore[no-untyped-def]
    """Add a shifted piece of the tile `noise` (int8) to `image` in place."""
    down, along = _shift(frame_key, 0)
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            image[y, x] += noise[y + down, x + along]


@njit(cache=True, nogil=True)
def _covered(dx, dy, radius):  # type: ignore[no-untyped-def]
    """Share of a unit pixel at (dx, dy) >= 0 from a disc's centre that lies inside the disc.

    The rim is taken as straight within the pixel; a distance alone would shift centroids by
    several thousandths of a pixel.
    """
    away = np.sqrt(dx * dx + dy * dy)
    inside = radius - away
    low, high = min(dx, dy) / away, max(dx, dy) / away
    corner = 0.5 * (low + high) - abs(inside)
    if corner <= 0.0:
        return 1.0 if inside > 0.0 else 0.0
    if abs(inside) <= 0.5 * (high - low):
        return 0.5 + inside / high
    cut = corner * corner / (2.0 * low * high)
    return 1.0 - cut if inside > 0.0 else cut


@njit(cache=True, nogil=True)
def draw_discs(image, centres, radius, ground, level, margin, dark, bright, frame_key):  # type: ignore[no-untyped-def]
    """Discs with anti-aliased rims and noise in squares round them, on an even ground.

    `dark` and `bright` are the noise tile on the ground's level and on the discs', so that most
    pixels are copied.
    """
    height, width = image.shape
    image[:] = ground
    reach, outer, inner = radius + margin, radius + 0.75, radius - 0.75
    for i in range(centres.shape[0]):
        cx, cy = centres[i, 0], centres[i, 1]
        down, along = _shift(frame_key, i + 1)
        # the noise sticks to the disc's square wherever the picture cuts it off
        down -= int(np.floor(cy - reach))
        along -= int(np.floor(cx - reach))
        left, right = max(int(np.floor(cx - reach)), 0), min(int(cx + reach) + 1, width)
        for y in range(max(int(np.floor(cy - reach)), 0), min(int(cy + reach) + 1, height)):
            if left < right:
                image[y, left:right] = dark[y + down, left + along : right + along]
    for i in range(centres.shape[0]):
        cx, cy = centres[i, 0], centres[i, 1]
        down, along = _shift(frame_key, i + 1)
        down -= int(np.floor(cy - reach))
        along -= int(np.floor(cx - reach))
        for y in range(max(int(np.ceil(cy - outer)), 0), min(int(cy + outer) + 1, height)):
            across = (y - cy) * (y - cy)
            wide = np.sqrt(max(outer * outer - across, 0.0))
            full = np.sqrt(max(inner * inner - across, 0.0))
            first, last = max(int(np.ceil(cx - wide)), 0), min(int(np.floor(cx + wide)), width - 1)
            flat_from, flat_to = int(np.ceil(cx - full)), int(np.floor(cx + full))
            if full == 0.0:
                flat_from, flat_to = last + 1, last
            left, right = max(flat_from, first), min(flat_to, last) + 1
            if left < right:
                image[y, left:right] = bright[y + down, left + along : right + along]
            for side in range(2):
                begin = first if side == 0 else max(flat_to + 1, flat_from, first)
                end = min(flat_from, last + 1) if side == 0 else last + 1
                for x in range(begin, end):
                    share = _covered(abs(x - cx), abs(y - cy), radius)
                    noise = np.int64(dark[y + down, x + along]) - ground
                    image[y, x] = int(ground + share * (level - ground) + 0.5) + noise
