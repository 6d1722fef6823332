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
def stands_still(path, i, begin, stop):  # type: ignore[no-untyped-def]
    """Whether marker i is the same, to the bit, in all rows from `begin` up to and with `stop`."""
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
def fit_block(path, i, row, first, last, shift, chord, inverse, weights, curve):  # type: ignore[no-untyped-def]
    """Marker i as cubics between the rows of one block.

    Between rows k and k + 1, with tau = time - t[k] and s = tau / (t[k + 1] - t[k]), a coordinate
    is c0 + tau (c1 + s (c2 + s c3)), px; a row of `curve` has these of column, row and radius.

    Args:
        path: column, row and radius of each marker, (n, 3, m).
        row: row of `path` that is the block's first.
        first, last: the block's first and last row.
        chord: join rows by straight lines.
        shift, inverse, weights: of `slope_weights`.
        curve: (r, 12), written for steps `first` to `last` - 1; the places also at `last`.
    """
    points = min(last - first + 1, 4)
    for c in range(3):
        for k in range(first, last + 1):
            curve[k, 4 * c] = path[i, c, row + k - first]
        for k in range(first, last + 1):
            # differences: of what stands still, the slope is 0 to the bit
            here, low, w = curve[k, 4 * c], nearest_row(k, first, last), k + shift
            slope = weights[0, w] * (curve[low, 4 * c] - here)
            slope += weights[1, w] * (curve[low + 1, 4 * c] - here)
            if points > 2:
                slope += weights[2, w] * (curve[low + 2, 4 * c] - here)
            if points > 3:
                slope += weights[3, w] * (curve[low + 3, 4 * c] - here)
            curve[k, 4 * c + 1] = slope
        for k in range(first, last):
            rate = (curve[k + 1, 4 * c] - curve[k, 4 * c]) * inverse[k]
            if chord:
                curve[k, 4 * c + 1], curve[k, 4 * c + 2], curve[k, 4 * c + 3] = rate, 0.0, 0.0
            else:
                slope, after = curve[k, 4 * c + 1], curve[k + 1, 4 * c + 1]
                curve[k, 4 * c + 2] = 3.0 * rate - 2.0 * slope - after
                curve[k, 4 * c + 3] = slope + after - 2.0 * rate


@njit(cache=True, nogil=True, error_model="numpy")
def bound_rates(t, curve, first, last, size, base, tree):  # type: ignore[no-untyped-def]
    """Bounds of a block's rates as a tree, and how far the marker goes in it.

    A step's rates stay between the control points of the derivative as a Bezier curve. Node 1
    holds for the whole block; below node j are 2 j and 2 j + 1; leaves begin at `size`.

    Args:
        first, last: the block's first and last row in `t`.
        size: leaves, a power of two, not less than the steps.
        base: where the tree's node 0 is.
        tree: (nodes, 7): lowest rates of column, row and radius, the highest ones, px/ns, and the
            fastest speed of the centre; written.

    Returns:
        the lengths of the ways of column, row and radius, at most and together, px.
    """
    whole = 0.0
    leaves = base + size - first
    for c in range(3):
        for k in range(first, last):
            begin = curve[k, 4 * c + 1]
            middle = begin + curve[k, 4 * c + 2]
            end = middle + curve[k, 4 * c + 2] + 3.0 * curve[k, 4 * c + 3]
            low, high = min(begin, min(middle, end)), max(begin, max(middle, end))
            tree[leaves + k, c], tree[leaves + k, 3 + c] = low, high
            whole += max(high, -low) * (t[k + 1] - t[k])
        for k in range(last, first + size):
            tree[leaves + k, c], tree[leaves + k, 3 + c] = np.inf, -np.inf
        for j in range(size - 1, 0, -1):
            a, b = base + 2 * j, base + 2 * j + 1
            tree[base + j, c] = min(tree[a, c], tree[b, c])
            tree[base + j, 3 + c] = max(tree[a, 3 + c], tree[b, 3 + c])
    for j in range(base + 1, base + 2 * size):
        x, y = max(tree[j, 3], -tree[j, 0]), max(tree[j, 4], -tree[j, 1])
        tree[j, 6] = np.sqrt(x * x + y * y)
    return whole


@njit(cache=True, nogil=True, error_model="numpy")
def excursion(t, curve, first, last):  # type: ignore[no-untyped-def]
    """How far a marker strays between two rows, px: (from its start, from the chord to its end).

    The control points of its cubics hold the path, and distances from a point or from a segment
    are convex, so the farthest control point bounds them. Growth counts like a move.
    """
    x, y, r = curve[first, 0], curve[first, 4], curve[first, 8]
    dx, dy, dr = curve[last, 0] - x, curve[last, 4] - y, curve[last, 8] - r
    square = dx * dx + dy * dy + dr * dr
    scale = 1.0 / square if square > 0.0 else 0.0
    far, far_r = dx * dx + dy * dy, abs(dr)
    off, off_r = 0.0, 0.0
    for k in range(first, last):
        third = (t[k + 1] - t[k]) / 3.0
        for j in range(3):
            # the control points of step k: its first one, and the two between its ends
            a, b = third * j, third * (j == 2)
            px = curve[k, 0] + a * curve[k, 1] + b * curve[k, 2] - x
            py = curve[k, 4] + a * curve[k, 5] + b * curve[k, 6] - y
            pr = curve[k, 8] + a * curve[k, 9] + b * curve[k, 10] - r
            far, far_r = max(far, px * px + py * py), max(far_r, abs(pr))
            s = min(max((px * dx + py * dy + pr * dr) * scale, 0.0), 1.0)
            ex, ey = px - s * dx, py - s * dy
            off, off_r = max(off, ex * ex + ey * ey), max(off_r, abs(pr - s * dr))
    return np.sqrt(far) + far_r, np.sqrt(off) + off_r
