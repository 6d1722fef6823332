"""A block's path in pieces of time, with what is known of the marker's rate on each of them.

On a piece on which a pixel's distance is monotone a threshold is met once or not at all. Whether it
is follows from the mean velocity and from how far the velocity strays from it (the derivative of a
cubic is a Bezier curve and stays in the hull of its control points), and from how far the direction
to the pixel can turn. So blocks of fast markers are cut up: their discs turn a pixel's direction
too far in one go.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sliplab.rigs.scene.marker_path import largest

K0, K1, BEGIN, END, ZERO, STRAY, NODE, BLOCK = 0, 1, 2, 3, 4, 5, 6, 7
"""First step and the step behind the last one; when the piece begins and ends, ns after its block;
when the block begins, ns after the first row; how far the marker strays from its chord at most, px;
the node of the block's tree that is this piece; the block."""
MX, MY, MR, DEVIATION, SPEED = 8, 9, 10, 11, 12
"""Mean rates of column, row and radius, how far rates stray from them together, and the highest
speed of the centre, px/ns."""
X1, Y1, R1, R0 = 13, 14, 15, 16
"""Column, row and radius at the end, and the radius at the beginning, px."""
X0, Y0 = 17, 18
VX0, VY0, VR0, VX1, VY1, VR1 = 19, 20, 21, 22, 23, 24
"""Rates at the beginning and at the end, px/ns."""
FINE = 25
"""How long a step of Newton's method may be after which a time is good, ns."""
FIELDS = 26
_MOST_PX = 2.0
_CLOSE = 1e-4  # of the block: after a step as small as that the next error is below 1e-7


@njit(cache=True, nogil=True, error_model="numpy")
def deviation(first, last, mean_x, mean_y, mean_r, curve, spread):  # type: ignore[no-untyped-def]
    """How far rates in some steps stray from their means, px/ns: of the centre, and of the radius.

    Args:
        first, last: first step, and the step behind the last one.
        spread: scratch, (4, at least the steps).
    """
    n = last - first
    ax, bx, cx = curve[1, first:last], curve[2, first:last], curve[3, first:last]
    ay, by, cy = curve[5, first:last], curve[6, first:last], curve[7, first:last]
    ar, br, cr = curve[9, first:last], curve[10, first:last], curve[11, first:last]
    square, growth = spread[0], spread[1]
    for k in range(n):
        x, y = ax[k] - mean_x, ay[k] - mean_y
        most = x * x + y * y
        x, y = x + bx[k], y + by[k]
        most = max(most, x * x + y * y)
        x, y = x + (bx[k] + 3.0 * cx[k]), y + (by[k] + 3.0 * cy[k])
        square[k] = max(most, x * x + y * y)
    for k in range(n):
        r = ar[k] - mean_r
        most = abs(r)
        r += br[k]
        most = max(most, abs(r))
        growth[k] = max(most, abs(r + (br[k] + 3.0 * cr[k])))
    return np.sqrt(largest(spread, 0, n)), largest(spread, 1, n)


@njit(cache=True, nogil=True, error_model="numpy")
def cut_block(first, last, block, zero, reach, since, until, curve, spread, pieces, n):  # type: ignore[no-untyped-def]
    """Cut a block into pieces in which the marker does not move far.

    What is done follows from the block's own rows alone.

    Args:
        first, last: the block's first and last row.
        zero: when it begins, ns after the first row of all.
        reach: how far from the rim the edge ends, px.
        since, until: when each step begins and ends, ns after the begin of its block.
        spread: scratch, see `deviation`.
        pieces: (most, FIELDS), written from `n` on; room for as many as there are steps.

    Returns:
        how many pieces there are now.
    """
    size, parts, done = 1, 1, first
    while size < last - first:
        size *= 2
    length = until[last - 1]
    while done < last:
        k0, k1 = done, min(done + size // parts, last)
        begin, end = since[k0], until[k1 - 1]
        inverse = 1.0 / (end - begin)
        mean_x = (curve[0, k1] - curve[0, k0]) * inverse
        mean_y = (curve[4, k1] - curve[4, k0]) * inverse
        mean_r = (curve[8, k1] - curve[8, k0]) * inverse
        apart, grows = deviation(k0, k1, mean_x, mean_y, mean_r, curve, spread)
        speed = np.sqrt(mean_x * mean_x + mean_y * mean_y) + apart
        if done == first and parts == 1:
            way = (speed + abs(mean_r) + grows) * length
            while parts < size and way > parts * _MOST_PX:
                parts *= 2
            if parts > 1:
                continue
        piece = pieces[n]
        piece[K0], piece[K1], piece[BEGIN], piece[END] = k0, k1, begin, end
        piece[ZERO], piece[BLOCK] = zero, block
        # on a way that begins and ends as the mean does; and by so much is a pixel that is not
        # nearer than the edge at both ends of a chord nearer in between
        chord = (mean_x * mean_x + mean_y * mean_y) * (end - begin) ** 2
        bow = 0.5 * (apart + grows) * (end - begin)
        left = min(curve[8, k0], curve[8, k1]) - bow - reach - 0.5 * np.sqrt(chord)
        piece[STRAY] = bow + (0.125 * chord / left if left > 0.0 else np.inf)
        piece[NODE] = parts + (k0 - first) // (size // parts)
        piece[MX], piece[MY], piece[MR] = mean_x, mean_y, mean_r
        piece[DEVIATION], piece[SPEED] = apart + grows, speed
        piece[X0], piece[Y0], piece[R0] = curve[0, k0], curve[4, k0], curve[8, k0]
        piece[X1], piece[Y1], piece[R1] = curve[0, k1], curve[4, k1], curve[8, k1]
        piece[VX0], piece[VY0], piece[VR0] = curve[1, k0], curve[5, k0], curve[9, k0]
        e = k1 - 1
        piece[VX1] = curve[1, e] + 2.0 * curve[2, e] + 3.0 * curve[3, e]
        piece[VY1] = curve[5, e] + 2.0 * curve[6, e] + 3.0 * curve[7, e]
        piece[VR1] = curve[9, e] + 2.0 * curve[10, e] + 3.0 * curve[11, e]
        piece[FINE] = _CLOSE * length
        n += 1
        done = k1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def farthest(piece):  # type: ignore[no-untyped-def]
    """How long the ways of centre and radius are on a piece, at most and together, px."""
    return (piece[SPEED] + abs(piece[MR]) + piece[DEVIATION]) * (piece[END] - piece[BEGIN])
