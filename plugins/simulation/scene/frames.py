"""Images of the tips through the plate, drawn at exact positions at the least cost.

Papillae are white discs, the sliding plate shows its ArUco marker, and reflections may be
added to both.

At the speeds of a slide nothing moves a tenth of a pixel while the shutter is open, and such frames
cost nothing extra. A falling plate and a tip that jumps are smeared: the picture is the mean over
places along the path (midpoint rule).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.scene.discs import (
    MARGIN_PX,
    SHIFTS,
    add_noise,
    draw_discs,
    draw_still,
)
from sliplab.plugins.simulation.scene.lens import Lens
from sliplab.plugins.simulation.scene.optics import Reflections
from sliplab.plugins.simulation.scene.randomness import generator, key
from sliplab.protocols.later import Later
from sliplab.storage.kernels import njit

if TYPE_CHECKING:
    import cv2
else:
    cv2 = Later("cv2")

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
U8 = npt.NDArray[np.uint8]

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)


MODULES = 6
"""Cells along a side of a DICT_4X4_50 marker, its black border included."""


@dataclass(frozen=True)
class Print:
    """A printed marker and its place. Lengths mm."""

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
        """Project the marker's centre for the plate's heights, (..., 2) from (...,)."""
        place = np.empty((*np.shape(height_mm), 2))
        place[..., 0], place[..., 1] = self._printed.centre_mm
        place[..., 1] += height_mm
        return self._lens.project(place)

    def view(self, heights_mm: F64, width: int, height: int) -> tuple[int, int, U8] | None:
        """The mean picture over heights of the plate, (s,): left, top and the patch (h, w).

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


def draw_reflections(
    reflections: Reflections, width: int, height: int, px_per_mm: float, seed: int
) -> U8:
    """Draw what the reflections of a trial add to every picture, grey levels, (height, width).

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


PositionsAt = Callable[[I64], tuple[F64, F64]]
"""From times, ns, (k,), to tips (k, n, 2) and heights of the plate (k,), in mm.

Times rise within an exposure, and from exposure to exposure: none is before the first or after the
last of them.
"""

STILL_PX = 0.1
"""Shorter paths than this are drawn at their mean position."""
BEND_PX = 0.025
"""Unless they bend: of a kink in the path, Simpson's rule misses up to an eighth of the bend."""
_STEP_PX = 0.25
_FEWEST, _MOST = 32, 128


@dataclass(frozen=True)
class ExposurePath:
    """Positions at equal shares of one exposure."""

    tips_mm: F64
    """(s, n, 2)."""
    plate_mm: F64
    """(s,)."""


@dataclass(frozen=True)
class Exposures:
    """Mean positions over each of m exposures, and the paths of those in which something moved."""

    tips_mm: F64
    """(m, n, 2)."""
    plate_mm: F64
    """(m,)."""
    paths: Mapping[int, ExposurePath] = field(default_factory=dict)
    """By index of the exposure."""


def expose(positions_at: PositionsAt, mid_ns: I64, exposure_ns: int, px_per_mm: float) -> Exposures:
    """Return positions during exposures of `exposure_ns` about `mid_ns` (increasing, (m,)).

    Positions that hardly change are averaged by Simpson's rule over beginning, middle and end.
    """
    half = exposure_ns // 2
    # one call for everything: the call is what costs
    tips, plate = positions_at((mid_ns[:, None] + np.array([-half, 0, half], np.int64)).ravel())
    tips, plate, farthest, bent = _average(
        tips.reshape(-1, 3, *tips.shape[1:]), plate.reshape(-1, 3), px_per_mm
    )
    smeared = np.flatnonzero((farthest >= STILL_PX) | (bent >= BEND_PX))
    if not len(smeared):
        return Exposures(tips, plate)
    counts = np.clip(np.ceil(farthest[smeared] / _STEP_PX).astype(np.int64), _FEWEST, _MOST)
    paths: dict[int, ExposurePath] = {}
    for count in np.unique(counts).tolist():
        # paths with the same number of positions are evaluated together
        here = smeared[counts == count]
        # midpoints of equal shares, to a nanosecond
        shares = (2 * np.arange(count, dtype=np.int64) + 1) * (2 * half) // (2 * count)
        along, heights = positions_at((mid_ns[here, None] - half + shares).ravel())
        along = along.reshape(-1, count, *along.shape[1:])
        heights = heights.reshape(-1, count)
        tips[here], plate[here] = along.mean(axis=1), heights.mean(axis=1)
        paths.update(zip(here.tolist(), map(ExposurePath, along, heights), strict=True))
    return Exposures(tips, plate, paths)


def moved(path_px: F64) -> npt.NDArray[np.bool_]:
    """Return which of n discs need their path `path_px`, (s, n, 2), drawn: (n,)."""
    count = len(path_px)
    steps = _length(np.diff(path_px, axis=0)).sum(axis=0)
    # from the first midpoint to the last is less than the whole path
    result: npt.NDArray[np.bool_] = steps * count >= STILL_PX * (count - 1)
    return result


def _length(vector: F64) -> F64:
    result: F64 = np.hypot(vector[..., 0], vector[..., 1])
    return result


@njit(cache=True, nogil=True, error_model="numpy")
def _average(tips: F64, plate: F64, px_per_mm: float) -> tuple[F64, F64, F64, F64]:
    """Simpson's mean of tips (m, 3, n, 2) and plate (m, 3) over beginning, middle and end.

    Also the longest path in each exposure, and its largest bend, px, (m,).
    """
    m, _, n, _ = tips.shape
    mean, height = np.empty((m, n, 2)), np.empty(m)
    travel, bend = np.empty(m), np.empty(m)
    for k in range(m):
        low, middle, high = plate[k]
        height[k] = (low + 4.0 * middle + high) / 6.0
        farthest = abs(middle - low) + abs(high - middle)
        bent = abs(low - 2.0 * middle + high)
        for i in range(n):
            (x0, y0), (x1, y1), (x2, y2) = tips[k, 0, i], tips[k, 1, i], tips[k, 2, i]
            mean[k, i, 0] = (x0 + 4.0 * x1 + x2) / 6.0
            mean[k, i, 1] = (y0 + 4.0 * y1 + y2) / 6.0
            first = math.sqrt((x1 - x0) ** 2 + (y1 - y0) ** 2)
            second = math.sqrt((x2 - x1) ** 2 + (y2 - y1) ** 2)
            farthest = max(farthest, first + second)
            bow_x, bow_y = x0 - 2.0 * x1 + x2, y0 - 2.0 * y1 + y2
            bent = max(bent, math.sqrt(bow_x**2 + bow_y**2))
        travel[k], bend[k] = px_per_mm * farthest, px_per_mm * bent
    return mean, height, travel, bend


@dataclass(frozen=True)
class FrameOptics:
    """The outside camera and the markers that it sees. Lengths mm, levels 0 to 255; see `Lens`."""

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
            optics.px_per_mm,
            width,
            height,
            tilt_deg=optics.tilt_deg,
            k1=optics.k1,
            distance_mm=optics.distance_mm,
        )
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
        paths: Mapping[int, ExposurePath] | None = None,
    ) -> None:
        """Fill `images`, (k, height, width), uint8.

        Args:
            tips_mm: places of the tips in the world, (k, n, 2), means over the exposure.
            plate_mm: height of the sliding plate with its marker, (k,); None: a plate without.
            number: the frames' numbers, which with `seed` decide on their noise, (k,).
            paths: what moved during the exposure, by index of the image.
        """
        if seed != self._seed:
            self._prepare(seed)
        optics, paths = self.optics, paths or {}
        levels = optics.ground_level, optics.tip_level, self._dark, self._bright
        keys = np.uint64(self._key) ^ (number.astype(np.uint64) * _GOLDEN)
        centres, radii = self.centre_px(tips_mm), self.radius_px(tips_mm)
        still = np.ones(len(images), np.bool_)
        still[list(paths)] = False
        draw_still(images, centres, radii, still, *levels, keys)
        for index, exposed in paths.items():
            path = self.centre_px(exposed.tips_mm)
            draw_discs(
                images[index], centres[index], radii[index], path, moved(path), *levels, keys[index]
            )
        if plate_mm is not None:
            for index, image in enumerate(images):
                heights = paths[index].plate_mm if index in paths else plate_mm[index : index + 1]
                self._stick(image, heights, keys[index])
        if self._light is not None:
            for image in images:
                cv2.add(image, self._light, dst=image)

    def _prepare(self, seed: int) -> None:
        """Draw what belongs to the trial: a noise tile, and what the plate mirrors."""
        optics = self.optics
        self._seed, self._key = seed, key(seed, "frame noise")
        # one tile a trial: a picture only ever shows shifted patches of it
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
