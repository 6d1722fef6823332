"""Where the markers are between the rows that the contact model gives: cubic curves in time.

The time of an event is as exact as the path. At 3 px/s a microsecond is 3e-6 px, which straight
lines between rows miss by far; a cubic through the rows with slopes from three of them is of third
order at the ends of a block and better inside. A block never looks past its own rows, so that
cutting a stream at the borders of blocks changes nothing.
"""

from __future__ import annotations

import numpy as np
from numba import njit

COLUMN, ROW, RADIUS = 0, 1, 2
"""First index of the path's coordinates, all in px."""


@njit(cache=True, nogil=True, error_model="numpy")
def markers_in_image(  # type: ignore[no-untyped-def]
    loads, layout_mm, px_per_mm, shift_mm_per_n, growth_mm_per_n, radius_mm, middle_x, middle_y
):
    """Column, row and radius of every marker under `loads`, px, (n, 3, m).

    A papilla is dragged along by friction, which is opposite to its force on the plate.

    Args:
        loads: tangential force on the plate x, y and normal force, N, (m, 3 n).
        layout_mm: places of the papillae, (n, 2).
        middle_x, middle_y: the picture's centre, px.
    """
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
def slope_weights(t, chord, weights):  # type: ignore[no-untyped-def]
    """What the differences before and after row k count for the slope there: `weights` (2, m).

    Three-point parabolic differences on uneven steps h0, h1: (h1 d0 + h0 d1) / (h0 + h1). At both
    ends row 0 of `weights` belongs to the next difference inwards and row 1 to the one after it:
    the same parabola, seen from its end. Two rows are joined by a straight line.

    Args:
        t: times of the block's rows, (m,), strictly rising.
        chord: join rows by straight lines: the weights are not used then.
    """
    last = t.shape[0] - 1
    if chord or last < 2:
        weights[0, : last + 1] = 1.0
        weights[1, : last + 1] = 0.0
        return
    for k in range(1, last):
        whole = t[k + 1] - t[k - 1]
        weights[0, k] = (t[k + 1] - t[k]) / whole
        weights[1, k] = (t[k] - t[k - 1]) / whole
    weights[1, 0] = -(t[1] - t[0]) / (t[2] - t[0])
    weights[1, last] = -(t[last] - t[last - 1]) / (t[last] - t[last - 2])
    weights[0, 0], weights[0, last] = 1.0 - weights[1, 0], 1.0 - weights[1, last]


@njit(cache=True, nogil=True, error_model="numpy")
def fit_curve(t, place, weights, chord, curve):  # type: ignore[no-untyped-def]
    """One coordinate as cubics between the rows: `curve` (4, m), written; its end is curve[0, m - 1].

    Between rows k and k + 1, with tau = time - t[k] and s = tau / (t[k + 1] - t[k]), it is
    curve[0] + tau (curve[1] + s (curve[2] + s curve[3])).

    Args:
        place: the coordinate at the rows, (m,).
        weights: of `slope_weights`.
    """
    last = t.shape[0] - 1
    rate, slope = curve[2], curve[1]
    for k in range(last):
        curve[0, k] = place[k]
        rate[k] = (place[k + 1] - place[k]) / (t[k + 1] - t[k])
    curve[0, last] = place[last]
    if chord or last < 2:
        slope[:last] = rate[:last]
        curve[2:, :last] = 0.0
        return
    slope[0] = weights[0, 0] * rate[0] + weights[1, 0] * rate[1]
    end = weights[0, last] * rate[last - 1] + weights[1, last] * rate[last - 2]
    for k in range(1, last):
        slope[k] = weights[0, k] * rate[k - 1] + weights[1, k] * rate[k]
    # in place: the rate of a step is needed until its own two coefficients are known
    for k in range(last):
        after = slope[k + 1] if k + 1 < last else end
        chord_rate = rate[k]
        curve[2, k] = 3.0 * chord_rate - 2.0 * slope[k] - after
        curve[3, k] = slope[k] + after - 2.0 * chord_rate


@njit(cache=True, nogil=True, error_model="numpy")
def step_rates(t, curves, size, tree):  # type: ignore[no-untyped-def]
    """Bounds of the rates in each step, and the length of the marker's way in the block.

    A step's rates stay between the control points of the derivative as a Bezier curve.

    Args:
        curves: column, row and radius, (3, 4, m).
        size: leaves of `tree`, a power of two, not less than the steps.
        tree: (6, 2 size): lowest rates of column, row and radius and the highest ones; the leaves
            from `size` on are written, px/ns. See `join_rates`.

    Returns:
        the lengths of the ways of column, row and radius, at most and together, px.
    """
    last = t.shape[0] - 1
    whole = 0.0
    for c in range(3):
        for k in range(last):
            first = curves[c, 1, k]
            middle = first + curves[c, 2, k]
            end = middle + curves[c, 2, k] + 3.0 * curves[c, 3, k]
            low, high = min(first, min(middle, end)), max(first, max(middle, end))
            tree[c, size + k], tree[3 + c, size + k] = low, high
            whole += max(high, -low) * (t[k + 1] - t[k])
        for k in range(last, size):
            tree[c, size + k], tree[3 + c, size + k] = np.inf, -np.inf
    return whole


@njit(cache=True, nogil=True, error_model="numpy")
def join_rates(size, tree):  # type: ignore[no-untyped-def]
    """Fill a tree from its leaves: node j holds for all steps below it; 2 j and 2 j + 1 are below."""
    for c in range(3):
        for j in range(size - 1, 0, -1):
            tree[c, j] = min(tree[c, 2 * j], tree[c, 2 * j + 1])
            tree[3 + c, j] = max(tree[3 + c, 2 * j], tree[3 + c, 2 * j + 1])
