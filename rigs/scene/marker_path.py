"""Where the markers are between the rows that the contact model gives: cubic curves in time.

The time of an event is as exact as the path. At 3 px/s a microsecond is 3e-6 px, which straight
lines between rows miss by far; cubic Hermite curves with slopes from four rows are of fourth order.
A block never looks past its own rows, so that cutting a stream at the borders of blocks changes
nothing.
"""

from __future__ import annotations

import numpy as np
from numba import njit

COLUMN, ROW, RADIUS = 0, 1, 2
"""First index of the path's coordinates, all in px."""


@njit(cache=True, nogil=True, error_model="numpy")
def markers_in_image(loads, layout_mm, projection):  # type: ignore[no-untyped-def]
    """Column, row and radius of every marker under `loads`, px, (n, 3, m).

    A papilla is dragged along by friction, which is opposite to its force on the plate.

    Args:
        loads: tangential force on the plate x, y and normal force, N, (m, 3 n).
        layout_mm: places of the papillae, (n, 2).
        projection: px/mm, how far a marker moves, mm/N, how much it grows, mm/N, its radius
            without force, mm, and column and row of the picture's centre, px.
    """
    px_per_mm, shift_mm_per_n, growth_mm_per_n, radius_mm, middle_x, middle_y = projection
    count, rows = layout_mm.shape[0], loads.shape[0]
    path = np.empty((count, 3, rows))
    drag, growth = px_per_mm * shift_mm_per_n, px_per_mm * growth_mm_per_n
    for i in range(count):
        x, y = middle_x + px_per_mm * layout_mm[i, 0], middle_y - px_per_mm * layout_mm[i, 1]
        radius = px_per_mm * radius_mm
        for k in range(rows):
            path[i, COLUMN, k] = x - drag * loads[k, 3 * i]
            path[i, ROW, k] = y + drag * loads[k, 3 * i + 1]
            path[i, RADIUS, k] = radius + growth * loads[k, 3 * i + 2]
    return path


@njit(cache=True, nogil=True, error_model="numpy")
def largest(bits, begin, end):  # type: ignore[no-untyped-def]
    """The largest of numbers not below 0, given by their bits: integers have a vector maximum."""
    most = np.int64(0)
    for k in range(begin, end):
        most = max(most, bits[k])
    return most


@njit(cache=True, nogil=True, error_model="numpy")
def stands_still(path, i, begin, stop):  # type: ignore[no-untyped-def]
    """Whether marker i is the same, to the bit, in all rows from `begin` up to and with `stop`."""
    for c in range(3):
        if path[i, c, begin] != path[i, c, stop]:
            return False
    moves = 0
    for c in range(3):
        for k in range(begin, stop):
            moves += path[i, c, k] != path[i, c, k + 1]
    return moves == 0


@njit(cache=True, nogil=True, error_model="numpy")
def slope_weights(t, first, last, shift, inverse, weights):  # type: ignore[no-untyped-def]
    """What rows count for the slope at each row of a block, which looks at no other rows.

    The slope is that of the cubic through the four nearest rows (Lagrange), at both ends of a
    block a one-sided one; through all of them where a block has fewer.

    Args:
        t: times of rows, ns, (r,).
        first, last: the block's first and last row in `t`.
        shift: those of row k stand in column k + shift, as a border's row has one of each block.
        inverse: 1 over the length of each step, (r,), written.
        weights: (4, columns), 1/ns, of the rows from `nearest_row` on; written.
    """
    points = min(last - first + 1, 4)
    for k in range(first, last):
        inverse[k] = 1.0 / (t[k + 1] - t[k])
    for k in range(first, last + 1):
        low = nearest_row(k, first, last)
        own = 0.0
        for j in range(points):
            weights[j, k + shift] = 0.0
            if low + j != k:
                weight = 1.0 / (t[low + j] - t[k])
                for m in range(points):
                    if m != j and low + m != k:
                        weight *= (t[k] - t[low + m]) / (t[low + j] - t[low + m])
                weights[j, k + shift] = weight
                own -= weight
        weights[k - low, k + shift] = own


@njit(cache=True, nogil=True, error_model="numpy")
def nearest_row(k, first, last):  # type: ignore[no-untyped-def]
    """The first of the rows through which the slope at row k is taken."""
    return max(min(k - 1, last - 3), first)


@njit(cache=True, nogil=True, error_model="numpy")
def _slope(place, k, first, last, weights, w):  # type: ignore[no-untyped-def]
    """Slope of a coordinate at row k of a block, by its weights in column w."""
    # differences: of what stands still, the slope is 0 to the bit
    here, low = place[k], nearest_row(k, first, last)
    slope = 0.0
    for j in range(min(last - first + 1, 4)):
        slope += weights[j, w] * (place[low + j] - here)
    return slope


@njit(cache=True, nogil=True, error_model="numpy")
def fit_block(path, i, row, first, last, shift, chord, inverse, weights, curve):  # type: ignore[no-untyped-def]
    """Marker i as cubics between the rows of one block.

    Between rows k and k + 1, with tau = time - t[k] and s = tau / (t[k + 1] - t[k]), a coordinate
    is c0 + tau (c1 + s (c2 + s c3)), px; a column of `curve` has these of column, row and radius.

    Args:
        path: column, row and radius of each marker, (n, 3, m).
        row: row of `path` that is the block's first.
        first, last: the block's first and last row.
        chord: join rows by straight lines.
        shift, inverse, weights: of `slope_weights`.
        curve: (12, r), written for steps `first` to `last` - 1; the places also at `last`.
    """
    n = last - first
    w = first + shift
    before, after, far = weights[0, w : w + n], weights[2, w : w + n], weights[3, w : w + n]
    per_step = inverse[first:last]
    for c in range(3):
        place = curve[4 * c, first : last + 1]
        slope, bend, twist = (
            curve[4 * c + 1, first:last], curve[4 * c + 2, first:last], curve[4 * c + 3, first:last]
        )  # fmt: skip
        place[:] = path[i, c, row : row + n + 1]
        if chord:
            for k in range(n):
                slope[k], bend[k], twist[k] = (place[k + 1] - place[k]) * per_step[k], 0.0, 0.0
            continue
        slope[0] = _slope(place, 0, 0, n, weights, w)
        for k in range(1, n - 1):
            here = place[k]
            slope[k] = (
                before[k] * (place[k - 1] - here) + after[k] * (place[k + 1] - here)
                + far[k] * (place[k + 2] - here)
            )  # fmt: skip
        if n > 1:
            slope[n - 1] = _slope(place, n - 1, 0, n, weights, w + n - 1)
        for k in range(n - 1):
            rate, own, next_one = (place[k + 1] - place[k]) * per_step[k], slope[k], slope[k + 1]
            bend[k] = 3.0 * rate - 2.0 * own - next_one
            twist[k] = own + next_one - 2.0 * rate
        rate, own = (place[n] - place[n - 1]) * per_step[n - 1], slope[n - 1]
        final = _slope(place, n, 0, n, weights, w + n)
        bend[n - 1], twist[n - 1] = 3.0 * rate - 2.0 * own - final, own + final - 2.0 * rate


@njit(cache=True, nogil=True, error_model="numpy")
def bound_rates(curve, first, last, base, tree):  # type: ignore[no-untyped-def]
    """Bounds of a block's rates as a tree.

    A step's rates stay between the control points of the derivative as a Bezier curve. Node 1
    holds for the whole block; below node j are 2 j and 2 j + 1; the
    leaves are a power of two.

    Args:
        first, last: the block's first and last row.
        base: where the tree's node 0 is.
        tree: (nodes, 7): lowest rates of column, row and radius, the highest ones, px/ns, and the
            fastest speed of the centre; written.
    """
    size = 1
    while size < last - first:
        size *= 2
    leaves = base + size - first
    for c in range(3):
        for k in range(first, last):
            begin = curve[4 * c + 1, k]
            middle = begin + curve[4 * c + 2, k]
            end = middle + curve[4 * c + 2, k] + 3.0 * curve[4 * c + 3, k]
            tree[leaves + k, c] = min(begin, min(middle, end))
            tree[leaves + k, 3 + c] = max(begin, max(middle, end))
        for k in range(last, first + size):
            tree[leaves + k, c], tree[leaves + k, 3 + c] = np.inf, -np.inf
        for j in range(size - 1, 0, -1):
            a, b = base + 2 * j, base + 2 * j + 1
            tree[base + j, c] = min(tree[a, c], tree[b, c])
            tree[base + j, 3 + c] = max(tree[a, 3 + c], tree[b, 3 + c])
    for j in range(base + 1, base + 2 * size):
        x, y = max(tree[j, 3], -tree[j, 0]), max(tree[j, 4], -tree[j, 1])
        tree[j, 6] = np.sqrt(x * x + y * y)


@njit(cache=True, nogil=True, error_model="numpy")
def off_chord(t, curve, first, last, spread):  # type: ignore[no-untyped-def]
    """How far a marker strays at most from the chord between two rows, px; growth counts.

    The rows' distances from the chord, and how far a cubic is from the line between its rows: that
    is h s (1 - s) (c2 + c3 (1 + s)).

    Args:
        spread: scratch, (4, at least the rows).
    """
    n = last - first
    x, y, r = curve[0, first], curve[4, first], curve[8, first]
    dx, dy, dr = curve[0, last] - x, curve[4, last] - y, curve[8, last] - r
    square = dx * dx + dy * dy + dr * dr
    scale = 1.0 / square if square > 0.0 else 0.0
    px, py, pr = curve[0, first:last], curve[4, first:last], curve[8, first:last]
    bx, by, br = curve[2, first:last], curve[6, first:last], curve[10, first:last]
    cx, cy, cr = curve[3, first:last], curve[7, first:last], curve[11, first:last]
    begin, end = t[first:last], t[first + 1 : last + 1]
    far, far_r, arch, arch_r = spread[0], spread[1], spread[2], spread[3]
    for k in range(n):
        gx, gy, gr = px[k] - x, py[k] - y, pr[k] - r
        s = min(max((gx * dx + gy * dy + gr * dr) * scale, 0.0), 1.0)
        gx, gy = gx - s * dx, gy - s * dy
        far[k] = gx * gx + gy * gy
        far_r[k] = abs(gr - s * dr)
    for k in range(n):
        quarter = 0.25 * (end[k] - begin[k])
        ex, ey, er = bx[k] + cx[k], by[k] + cy[k], br[k] + cr[k]
        ex, ey = max(abs(ex), abs(ex + cx[k])), max(abs(ey), abs(ey + cy[k]))
        arch[k] = quarter * quarter * (ex * ex + ey * ey)
        arch_r[k] = quarter * max(abs(er), abs(er + cr[k]))
    bits = spread.view(np.int64)
    for c in range(4):
        bits[c, 0] = largest(bits[c], 0, n)
    return np.sqrt(far[0]) + far_r[0] + np.sqrt(arch[0]) + arch_r[0]


@njit(cache=True, nogil=True, error_model="numpy")
def excursion(curve, first, blocks, stray):  # type: ignore[no-untyped-def]
    """How far a marker strays in some blocks, px: (from its start, from the chord to its end).

    Distances from a point or from a segment are convex, so that on a block's chord they are largest
    at an end. Growth counts like a move.

    Args:
        first: first row of each block, and the last row of all.
        stray: of each block, see `off_chord`.
    """
    begin, end = first[0], first[blocks]
    x, y, r = curve[0, begin], curve[4, begin], curve[8, begin]
    dx, dy, dr = curve[0, end] - x, curve[4, end] - y, curve[8, end] - r
    square = dx * dx + dy * dy + dr * dr
    scale = 1.0 / square if square > 0.0 else 0.0
    far, off, before, before_off = 0.0, 0.0, 0.0, 0.0
    for block in range(blocks):
        k = first[block + 1]
        px, py, pr = curve[0, k] - x, curve[4, k] - y, curve[8, k] - r
        after = np.sqrt(px * px + py * py) + abs(pr)
        s = min(max((px * dx + py * dy + pr * dr) * scale, 0.0), 1.0)
        ex, ey = px - s * dx, py - s * dy
        after_off = np.sqrt(ex * ex + ey * ey) + abs(pr - s * dr)
        far = max(far, max(before, after) + stray[block])
        off = max(off, max(before_off, after_off) + stray[block])
        before, before_off = after, after_off
    return far, off
