"""Pixels side by side: which of many meet thresholds on a piece of a marker's path, and when.

One pixel's events wait for each other; those of many do not, and where their numbers lie side
by side a compiler does four or eight of them at a time. So all that a pixel needs stands in a
tile, one field after the other with a lane for each pixel, and is worked on in loops without
branches. Fields are constant distances apart, which is how the compiler knows that lanes do not
touch each other.

A tile of pixels goes through all pieces of a look. Those of its pixels that fire on a piece are
gathered in a tile of roots, one threshold after the other.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sliplab.rigs.scene import pieces as of

LANES = 256
STRIDE = LANES + 8
"""From one field to the next; a bit more than there are lanes, so that fields do not all compete
for the same sets of the cache."""
X, Y, ON, OFF, LAST, LEVEL, STEP, BEGIN, END, KIND, CODE = (STRIDE * k for k in range(11))
"""Fields of a tile of pixels: column and row; as in `edges`, four; the threshold; distance from the
rim at the begin and at the end of a piece, px; what happens on it; column and row in a packed
event."""
PIXEL_FIELDS = 11
NOTHING, COMES, GOES, DOUBT = 0.0, 1.0, 2.0, 3.0
"""Kinds: meets no threshold; falls monotonely to its positive one, rises to its negative one; may
meet any number."""
_DONE_PX = 1e-10


@njit(cache=True, nogil=True, error_model="numpy")
def place_pixels(tile, n, column, row, radius):  # type: ignore[no-untyped-def]
    """Distances from the rim at the begin of the first piece."""
    for j in range(n):
        dx, dy = tile[X + j] - column, tile[Y + j] - row
        tile[END + j] = np.sqrt(dx * dx + dy * dy) - radius


@njit(cache=True, nogil=True, error_model="numpy")
def classify(tile, n, piece, reach):  # type: ignore[no-untyped-def]
    """What each of n pixels does on a piece.

    Args:
        reach: distance from the rim beyond which a pixel may be another disc's, px.
    """
    x1, y1, r1, stray = piece[of.X1], piece[of.Y1], piece[of.R1], piece[of.STRAY]
    half_x, half_y = 0.5 * (piece[of.X0] - x1), 0.5 * (piece[of.Y0] - y1)
    mean_x, mean_y, mean_r = piece[of.MX], piece[of.MY], piece[of.MR]
    apart, speed, length = piece[of.DEVIATION], piece[of.SPEED], piece[of.END] - piece[of.BEGIN]
    # no point of the path is farther from the middle of its ends than half its length
    way = 0.5 * speed * length
    for j in range(n):
        dx, dy = tile[X + j] - x1, tile[Y + j] - y1
        away = np.sqrt(dx * dx + dy * dy)
        begin, end = tile[END + j], away - r1
        on, off = tile[ON + j], tile[OFF + j]
        dx, dy = dx - half_x, dy - half_y
        inverse = 1.0 / max(np.sqrt(dx * dx + dy * dy), 1e-3)
        mean = -(dx * mean_x + dy * mean_y) * inverse - mean_r
        # how far a direction turns on the way: see `crossings.turning`
        share = way * inverse
        spread = apart + (1.34 * share if share <= 0.5 else 2.0) * speed
        slowest, fastest = mean - spread, mean + spread
        turns = (slowest < 0.0) & (fastest > 0.0) & (2.0 * spread * length > _DONE_PX)
        # as `crossings.may_reach`, without its division
        width, product = 2.0 * spread, slowest * fastest * length
        least = begin * fastest - end * slowest + product
        most = end * fastest - begin * slowest - product
        reaches = (least <= on * width) | ((most >= off * width) & (least < reach * width))
        falls = end < begin
        meets = (on >= end) if falls else ((off <= end) & (begin < reach))
        sure = (COMES if falls else GOES) if meets else NOTHING
        kind = (DOUBT if reaches else NOTHING) if turns else sure
        near = (min(begin, end) - stray <= on) | (max(begin, end) + stray >= off)
        tile[KIND + j] = kind if near else NOTHING
        tile[BEGIN + j], tile[END + j] = begin, end
