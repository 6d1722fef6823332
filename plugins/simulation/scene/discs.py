"""White discs on a dark ground, drawn pixel by pixel: sharp, or smeared along their path.

Rims are anti-aliased so exactly that a centroid is right to a thousandth of a pixel, and noise is
drawn only round discs: over the whole image it would cost more than everything else.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sliplab.storage.kernels import njit
from sliplab.storage.streams import F64, U8

SHIFTS = 128
"""Margin of a noise tile over anything drawn from it: the number of possible shifts."""
MARGIN_PX = 6.0
"""Margin of the noise beyond a disc's rim."""
HALF_DIAGONAL = 0.7072
"""Of a pixel: how far from its centre a rim can still cut it."""


@njit(cache=True, nogil=True)
def _mix(value: np.uint64) -> np.uint64:
    """The finaliser of SplitMix64 (Steele, Lea and Flood 2014)."""
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@njit(cache=True, nogil=True)
def _shift(frame_key: np.uint64, index: int) -> tuple[int, int]:
    """Place in the noise tile at which a patch of a picture begins: row and column, 0 to 127."""
    turn = _mix(frame_key + np.uint64(index))
    return int(turn & np.uint64(127)), int((turn >> np.uint64(8)) & np.uint64(127))


@njit(cache=True, nogil=True)
def add_noise(image: U8, noise: npt.NDArray[np.int8], frame_key: np.uint64) -> None:
    """Add a shifted patch of the tile `noise` (int8, (h, w), repeated) to `image` in place."""
    down, along = _shift(frame_key, 0)
    height, width = noise.shape
    for y in range(image.shape[0]):
        row = noise[(y + down) % height]
        for x in range(min(image.shape[1], width - along)):
            image[y, x] += row[x + along]
        for x in range(width - along, image.shape[1]):
            image[y, x] += row[(x + along) % width]


@njit(cache=True, nogil=True)
def _covered(dx: float, dy: float, radius: float) -> float:
    """Share of a unit pixel at (dx, dy) >= 0 from a disc's centre that lies inside the disc.

    The rim is taken as straight within the pixel; a distance alone would shift centroids by
    several thousandths of a pixel.
    """
    away = np.sqrt(dx * dx + dy * dy)
    # the rim's normal; along an axis its small part may be any small number
    low, high = max(min(dx, dy) / away, 1e-6), max(dx, dy) / away
    inside = radius - away
    # what a line cuts off a unit square: a triangle, less the triangle that sticks out of it
    whole = max(0.5 * (high + low) - abs(inside), 0.0)
    beyond = max(0.5 * (high - low) - abs(inside), 0.0)
    cut = (whole - beyond) * (whole + beyond) / (2.0 * low * high)
    return 1.0 - cut if inside > 0.0 else cut


@njit(cache=True, nogil=True)
def _row(
    cx: float, across: float, outer: float, inner: float, width: int
) -> tuple[int, int, int, int]:
    """A disc's row `across` pixels from its centre: first, last, and its whole pixels (end open).

    `outer` and `inner` are the radii between which pixels may be cut by the rim.
    """
    wide = np.sqrt(max(outer * outer - across * across, 0.0))
    first, last = max(int(np.ceil(cx - wide)), 0), min(int(np.floor(cx + wide)), width - 1)
    if abs(across) >= inner:
        return first, last, last + 1, last + 1
    full = np.sqrt(inner * inner - across * across)
    begin = min(max(int(np.ceil(cx - full)), first), last + 1)
    return first, last, begin, max(min(int(np.floor(cx + full)), last) + 1, begin)


@njit(cache=True, nogil=True)
def _copy(target: U8, source: U8) -> None:
    """Copy a short row; assigning a slice to a slice costs three times as much."""
    for x in range(target.size):
        target[x] = source[x]


@njit(cache=True, nogil=True)
def _ground(
    image: U8, low_x: int, low_y: int, high_x: int, high_y: int, dark: U8, down: int, along: int
) -> None:
    """Noisy ground in a box; the noise sticks to the box wherever the picture cuts it off."""
    height, width = image.shape
    left, right = max(low_x, 0), min(high_x + 1, width)
    if left >= right:
        return
    rows, columns = dark.shape
    fits = high_x - low_x + along < columns and high_y - low_y + down < rows
    for y in range(max(low_y, 0), min(high_y + 1, height)):
        if fits:
            begin = left - low_x + along
            _copy(image[y, left:right], dark[y - low_y + down, begin : begin + right - left])
            continue
        for x in range(left, right):
            image[y, x] = dark[(y - low_y + down) % rows, (x - low_x + along) % columns]


@njit(cache=True, nogil=True)
def _sharp(
    image: U8,
    cx: float,
    cy: float,
    radius: float,
    ground: int,
    level: int,
    dark: U8,
    bright: U8,
    down: int,
    along: int,
) -> None:
    """One static disc; row + down, column + along are its places in the noise tiles."""
    height, width = image.shape
    outer, inner = radius + HALF_DIAGONAL, radius - HALF_DIAGONAL
    for y in range(max(int(np.ceil(cy - outer)), 0), min(int(cy + outer) + 1, height)):
        first, last, begin, end = _row(cx, y - cy, outer, inner, width)
        if begin < end:
            _copy(image[y, begin:end], bright[y + down, begin + along : end + along])
        for side in range(2):
            low = first if side == 0 else end
            high = begin if side == 0 else last + 1
            for x in range(low, high):
                share = _covered(abs(x - cx), abs(y - cy), radius)
                noise = np.int64(dark[y + down, x + along]) - ground
                image[y, x] = int(ground + share * (level - ground) + 0.5) + noise


@njit(cache=True, nogil=True)
def _smeared(
    image: U8,
    path: F64,
    radius: float,
    ground: int,
    level: int,
    dark: U8,
    low_x: int,
    low_y: int,
    high_x: int,
    high_y: int,
    down: int,
    along: int,
) -> None:
    """Draw the mean of one disc over its positions `path`, (s, 2)."""
    height, width = image.shape
    rows, columns = dark.shape
    left, right = max(low_x, 0), min(high_x + 1, width)
    top, bottom = max(low_y, 0), min(high_y + 1, height)
    if left >= right or top >= bottom:
        return
    outer, inner = radius + HALF_DIAGONAL, radius - HALF_DIAGONAL
    # each place adds its rim, and +1 and -1 where its whole pixels begin and end
    rim = np.zeros((bottom - top, right - left + 1))
    whole = np.zeros((bottom - top, right - left + 1))
    for k in range(path.shape[0]):
        cx, cy = path[k, 0], path[k, 1]
        for y in range(max(int(np.ceil(cy - outer)), 0), min(int(cy + outer) + 1, height)):
            first, last, begin, end = _row(cx, y - cy, outer, inner, width)
            if begin < end:
                whole[y - top, begin - left] += 1.0
                whole[y - top, end - left] -= 1.0
            for x in range(first, begin):
                rim[y - top, x - left] += _covered(abs(x - cx), abs(y - cy), radius)
            for x in range(end, last + 1):
                rim[y - top, x - left] += _covered(abs(x - cx), abs(y - cy), radius)
    per_place = 1.0 / path.shape[0]
    for y in range(top, bottom):
        inside = 0.0
        for x in range(left, right):
            inside += whole[y - top, x - left]
            share = per_place * (inside + rim[y - top, x - left])
            if share > 0.0:
                grey = dark[(y - low_y + down) % rows, (x - low_x + along) % columns]
                noise = np.int64(grey) - ground
                image[y, x] = int(ground + share * (level - ground) + 0.5) + noise


@njit(cache=True, nogil=True)
def draw_discs(
    image: U8,
    centres: F64,
    radii: F64,
    paths: F64,
    smeared: npt.NDArray[np.bool_],
    ground: int,
    level: int,
    dark: U8,
    bright: U8,
    frame_key: np.uint64,
) -> None:
    """Discs with anti-aliased rims, and noise in boxes round them, on an even ground.

    Args:
        image: (h, w) uint8, filled.
        centres: (n, 2) column and row; positions of still discs, or the mean of their path.
        radii: (n,) px.
        paths: (s, n, 2) positions along the exposure, used where `smeared`, (n,), is true.
        ground, level: grey levels.
        dark, bright: the noise tile on the ground's level and on the discs', uint8, so that most
            pixels are copied.
        frame_key: uint64, decides on the noise.
    """
    image[:] = ground
    n = centres.shape[0]
    boxes = np.empty((n, 4), np.int64)
    for i in range(n):
        reach = radii[i] + MARGIN_PX
        low_x = high_x = centres[i, 0]
        low_y = high_y = centres[i, 1]
        if smeared[i]:
            for k in range(paths.shape[0]):
                low_x, high_x = min(low_x, paths[k, i, 0]), max(high_x, paths[k, i, 0])
                low_y, high_y = min(low_y, paths[k, i, 1]), max(high_y, paths[k, i, 1])
        boxes[i, 0], boxes[i, 1] = int(np.floor(low_x - reach)), int(np.floor(low_y - reach))
        boxes[i, 2], boxes[i, 3] = int(high_x + reach), int(high_y + reach)
        down, along = _shift(frame_key, i + 1)
        _ground(image, boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3], dark, down, along)
    for i in range(n):
        down, along = _shift(frame_key, i + 1)
        left, top = boxes[i, 0], boxes[i, 1]
        if smeared[i]:
            _smeared(
                image,
                paths[:, i],
                radii[i],
                ground,
                level,
                dark,
                left,
                top,
                boxes[i, 2],
                boxes[i, 3],
                down,
                along,
            )
        else:
            _sharp(
                image,
                centres[i, 0],
                centres[i, 1],
                radii[i],
                ground,
                level,
                dark,
                bright,
                down - top,
                along - left,
            )


@njit(cache=True, nogil=True)
def draw_still(
    images: U8,
    centres: F64,
    radii: F64,
    drawn: npt.NDArray[np.bool_],
    ground: int,
    level: int,
    dark: U8,
    bright: U8,
    frame_keys: npt.NDArray[np.uint64],
) -> None:
    """`draw_discs` for those of k pictures, `drawn` (k,), in which nothing is smeared.

    `centres` are (k, n, 2), `radii` (k, n), `frame_keys` (k,) uint64.
    """
    n = centres.shape[1]
    nowhere, still = np.empty((0, n, 2)), np.zeros(n, np.bool_)
    for k in range(images.shape[0]):
        if drawn[k]:
            draw_discs(
                images[k],
                centres[k],
                radii[k],
                nowhere,
                still,
                ground,
                level,
                dark,
                bright,
                frame_keys[k],
            )
