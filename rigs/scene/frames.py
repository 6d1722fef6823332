"""Pictures of the tips through the plate, drawn at exact places as cheaply as can be.

Papillae are white discs, the sliding plate shows its ArUco marker, and a nuisance of reflections
may be laid over both. What moves while the shutter is open is smeared.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt

from sliplab.rigs.scene.discs import MARGIN_PX, SHIFTS, add_noise, draw_discs, draw_still
from sliplab.rigs.scene.exposure import Way, moved
from sliplab.rigs.scene.lens import Lens
from sliplab.rigs.scene.plate_marker import PlateMarker, Print
from sliplab.rigs.scene.randomness import generator, key
from sliplab.rigs.scene.reflections import Reflections, draw_reflections

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
U8 = npt.NDArray[np.uint8]

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)


@dataclass(frozen=True)
class FrameOptics:
    """What the outside camera sees, and how. Lengths mm, levels 0 to 255; see `Lens`."""

    px_per_mm: float = 20.0
    tip_radius_mm: float = 1.0
    tip_level: int = 200
    ground_level: int = 25
    noise: float = 1.5
    marker_id: int = 0
    marker_side_mm: float = 6.0
    marker_centre_mm: tuple[float, float] = (16.6, 16.6)
    tilt_deg: tuple[float, float] = (0.0, 0.0)
    k1: float = 0.0
    distance_mm: float = 300.0
    reflections: Reflections = field(default_factory=Reflections)


class PlateView:
    """A camera fixed in the world, its picture's centre on the plate's origin, y up."""

    def __init__(self, optics: FrameOptics, width: int, height: int) -> None:
        self.optics, self.width, self.height = optics, width, height
        self.lens = Lens(
            optics.px_per_mm, width, height, tilt_deg=optics.tilt_deg, k1=optics.k1,
            distance_mm=optics.distance_mm,
        )  # fmt: skip
        printed = Print(optics.marker_id, optics.marker_side_mm, optics.marker_centre_mm)
        self.marker = PlateMarker(printed, self.lens, optics.ground_level, optics.tip_level)
        # a tilt enlarges the near side by a few percent
        reach = 1.5 * optics.px_per_mm * optics.tip_radius_mm + MARGIN_PX
        self._tile = SHIFTS + max(2 * math.ceil(reach) + 2, self.marker.size_px + 2)
        self._seed: int | None = None

    def centre_px(self, place_mm: F64) -> F64:
        """Column and row of places in the plate's plane, (..., 2) from (..., 2)."""
        return self.lens.project(place_mm)

    def radius_px(self, place_mm: F64) -> F64:
        """Radius of a tip's spot seen there, (...,) from (..., 2)."""
        return self.optics.tip_radius_mm * self.lens.scale(place_mm)

    def draw(
        self,
        images: U8,
        tips_mm: F64,
        plate_mm: F64 | None,
        number: I64,
        seed: int,
        ways: Mapping[int, Way] | None = None,
    ) -> None:
        """Fill `images`, (k, height, width), uint8.

        Args:
            tips_mm: places of the tips in the world, (k, n, 2), means over the exposure.
            plate_mm: height of the sliding plate with its marker, (k,); None: a plate without.
            number: the frames' numbers, which with `seed` decide on their noise, (k,).
            ways: what moved during the exposure, by index of the picture.
        """
        if seed != self._seed:
            self._prepare(seed)
        optics, ways = self.optics, ways or {}
        looks = optics.ground_level, optics.tip_level, self._dark, self._bright
        keys = np.uint64(self._key) ^ (number.astype(np.uint64) * _GOLDEN)
        centres, radii = self.centre_px(tips_mm), self.radius_px(tips_mm)
        still = np.ones(len(images), np.bool_)
        still[list(ways)] = False
        draw_still(images, centres, radii, still, *looks, keys)
        for index, way in ways.items():
            path = self.centre_px(way.tips_mm)
            draw_discs(
                images[index], centres[index], radii[index], path, moved(path), *looks, keys[index]
            )
        if plate_mm is not None:
            for index, image in enumerate(images):
                heights = ways[index].plate_mm if index in ways else plate_mm[index : index + 1]
                self._stick(image, heights, keys[index])
        if self._light is not None:
            for image in images:
                cv2.add(image, self._light, dst=image)

    def _prepare(self, seed: int) -> None:
        """What belongs to the trial: a noise tile, and what the plate mirrors."""
        optics = self.optics
        self._seed, self._key = seed, key(seed, "frame noise")
        # one tile a trial: a picture only ever shows shifted pieces of it
        draw = generator(seed, "frame noise").standard_normal((self._tile, self._tile))
        grey = np.rint(np.clip(draw, -4.0, 4.0) * optics.noise)
        self._noise = grey.astype(np.int8)
        self._dark = (optics.ground_level + grey).astype(np.uint8)
        self._bright = (optics.tip_level + grey).astype(np.uint8)
        self._light: U8 | None = None
        if optics.reflections.count and optics.reflections.level:
            self._light = draw_reflections(
                optics.reflections, self.width, self.height, optics.px_per_mm, seed
            )

    def _stick(self, image: U8, heights_mm: F64, frame_key: np.uint64) -> None:
        steps = np.abs(np.diff(heights_mm)).sum() * self.optics.px_per_mm
        if steps < 0.05:
            heights_mm = heights_mm.mean(keepdims=True)
        piece = self.marker.view(heights_mm, self.width, self.height)
        if piece is None:
            return
        left, top, grey = piece
        add_noise(grey, self._noise, frame_key)
        image[top : top + grey.shape[0], left : left + grey.shape[1]] = grey
