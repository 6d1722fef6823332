"""Paths of the markers between the rows that the contact model gives: cubic curves in time.

The time of an event is as exact as the path. At 3 px/s a microsecond is 3e-6 px, which straight
lines between rows miss by far; cubic Hermite curves with slopes from four rows are of fourth order.
A block never uses rows of another one, so that cutting a stream at the borders of blocks changes
nothing.

A block is cut into segments on which a pixel's distance from the rim is monotone, or nearly: there
a threshold is met once or not at all. Whether it is follows from the mean velocity and from how far
the velocity strays from it (the derivative of a cubic is a Bezier curve and stays in the hull of
its control points), and from how far the direction to the pixel can turn. So blocks of fast markers
are cut up: their discs turn a pixel's direction too far in one go.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sliplab.storage.kernels import njit
from sliplab.storage.streams import F64, I64

COLUMN, ROW, RADIUS = 0, 1, 2
"""First index of the path's coordinates, all in px."""
UNEVEN = 8.0
"""Rows nearly coincide if the longest adjacent step is longer by more than this factor."""


@njit(cache=True, nogil=True, error_model="numpy")
def markers_in_image(
    loads: F64, layout_mm: F64, projection: tuple[float, float, float, float, float, float]
) -> F64:
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
def largest(values: F64, row: int, n: int) -> float:
    """The largest of the first n of a row of numbers that are not below 0.

    Of their bits, as integers, for only these have a maximum that is done side by side.
    """
    bits, most = values.view(np.int64)[row], np.int64(0)
    for k in range(n):
        most = max(most, bits[k])
    bits[0] = most
    return values[row, 0]


@njit(cache=True, nogil=True, error_model="numpy")
def stands_still(path: F64, i: int, begin: int, stop: int) -> bool:
    """Return whether marker i is the same, to the bit, in all rows from `begin` to `stop`."""
    for c in range(3):
        if path[i, c, begin] != path[i, c, stop]:
            return False
    moves = 0
    for c in range(3):
        for k in range(begin, stop):
            moves += path[i, c, k] != path[i, c, k + 1]
    return moves == 0


@njit(cache=True, nogil=True, error_model="numpy")
def slope_weights(t: F64, first: int, last: int, shift: int, inverse: F64, weights: F64) -> None:
    """Weigh the rows for the slope at each row of a block, from its own rows alone.

    The slope is that of the cubic through the four nearest rows (Lagrange), at both ends of a
    block a one-sided one; through all of them where a block has fewer. Rows that nearly coincide
    with this one, or with a nearer one, are left out: a tip that comes free in a short step would
    swing the curve far out in the long adjacent one.

    Args:
        t: times of rows, ns, (r,).
        first, last: the block's first and last row in `t`.
        shift: those of row k are in column k + shift, as a border's row has one of each block.
        inverse: 1 over the length of each step, (r,), written.
        weights: (4, columns), 1/ns, of the rows from `nearest_row` on; written.
    """
    points = min(last - first + 1, 4)
    used = np.empty(4, np.bool_)
    for k in range(first, last):
        inverse[k] = 1.0 / (t[k + 1] - t[k])
    for k in range(first, last + 1):
        low = nearest_row(k, first, last)
        _without_twins(t, low, k, points, used)
        own = 0.0
        for j in range(points):
            weights[j, k + shift] = 0.0
            if low + j != k and used[j]:
                weight = 1.0 / (t[low + j] - t[k])
                for m in range(points):
                    if m != j and low + m != k and used[m]:
                        weight *= (t[k] - t[low + m]) / (t[low + j] - t[low + m])
                weights[j, k + shift] = weight
                own -= weight
        weights[k - low, k + shift] = own


@njit(cache=True, nogil=True, error_model="numpy")
def _without_twins(t: F64, low: int, k: int, points: int, used: npt.NDArray[np.bool_]) -> None:
    """Mark of the rows from `low` on those that do not nearly coincide with row k or a nearer one.

    Args:
        used: (points,), written.
    """
    longest = 0.0
    for j in range(points - 1):
        longest = max(longest, t[low + j + 1] - t[low + j])
    least = longest / UNEVEN
    for j in range(points):
        used[j] = low + j == k or abs(t[low + j] - t[k]) >= least
    for j in range(points):
        for m in range(points):
            far = abs(t[low + j] - t[k]) > abs(t[low + m] - t[k])
            if used[j] and used[m] and far and abs(t[low + j] - t[low + m]) < least:
                used[j] = False


@njit(cache=True, nogil=True, error_model="numpy")
def nearest_row(k: int, first: int, last: int) -> int:
    """The first of the rows through which the slope at row k is taken."""
    return max(min(k - 1, last - 3), first)


@njit(cache=True, nogil=True, error_model="numpy")
def inner_weights(first: I64, blocks: int, weights: F64, inner: F64) -> None:
    """Weights of rows inside blocks, where a slope is taken through one row before and two after.

    Args:
        first: first row of each block, and the last row of all.
        weights: of `slope_weights`.
        inner: (3, r), what the three rows count, written; 0 at the two rows at each end of a block.
    """
    for block in range(blocks):
        begin, end = first[block], first[block + 1]
        for k in range(begin, end):
            inside = begin < k < end - 1
            inner[0, k] = weights[0, k + block] if inside else 0.0
            inner[1, k] = weights[2, k + block] if inside else 0.0
            inner[2, k] = weights[3, k + block] if inside else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _slope(c: int, k: int, first: int, last: int, shift: int, weights: F64, curve: F64) -> float:
    """Slope of coordinate c at row k of a block."""
    # differences: the slope of a coordinate at rest is 0 to the bit
    here, low, slope = curve[4 * c, k], nearest_row(k, first, last), 0.0
    for j in range(min(last - first + 1, 4)):
        slope += weights[j, k + shift] * (curve[4 * c, low + j] - here)
    return slope


@njit(cache=True, nogil=True, error_model="numpy")
def fit_blocks(
    path: F64,
    i: int,
    row: int,
    first: I64,
    blocks: int,
    chord: bool,
    inverse: F64,
    weights: F64,
    inner: F64,
    curve: F64,
) -> None:
    """Marker i as cubics between the rows of some blocks.

    Between rows k and k + 1, with tau = time - t[k] and s = tau / (t[k + 1] - t[k]), a coordinate
    is c0 + tau (c1 + s (c2 + s c3)), px; a column of `curve` has these of column, row and radius.

    Args:
        path: column, row and radius of each marker, (n, 3, m).
        row: row of `path` that is the first of all.
        first: first row of each block, and the last row of all.
        chord: join rows by straight lines.
        inverse, weights, inner: of `slope_weights` and `inner_weights`.
        curve: (12, r), written for every step; the places also at the last row.
    """
    total = first[blocks]
    for c in range(3):
        source, place = path[i, c, row:], curve[4 * c]
        for k in range(total + 1):
            place[k] = source[k]
        if chord:
            for k in range(total):
                rate = (curve[4 * c, k + 1] - curve[4 * c, k]) * inverse[k]
                curve[4 * c + 1, k], curve[4 * c + 2, k], curve[4 * c + 3, k] = rate, 0.0, 0.0
            continue
        for k in range(total - 2):
            here = curve[4 * c, k + 1]
            curve[4 * c + 1, k + 1] = (
                inner[0, k + 1] * (curve[4 * c, k] - here)
                + inner[1, k + 1] * (curve[4 * c, k + 2] - here)
                + inner[2, k + 1] * (curve[4 * c, k + 3] - here)
            )
        for block in range(blocks):
            begin, end = first[block], first[block + 1]
            curve[4 * c + 1, begin] = _slope(c, begin, begin, end, block, weights, curve)
            if end - begin > 1:
                curve[4 * c + 1, end - 1] = _slope(c, end - 1, begin, end, block, weights, curve)
        for k in range(total - 1):
            rate = (curve[4 * c, k + 1] - curve[4 * c, k]) * inverse[k]
            slope, after = curve[4 * c + 1, k], curve[4 * c + 1, k + 1]
            curve[4 * c + 2, k] = 3.0 * rate - 2.0 * slope - after
            curve[4 * c + 3, k] = slope + after - 2.0 * rate
        # a block's last slope uses its own rows, not those of the next block
        for block in range(blocks):
            begin, end = first[block], first[block + 1]
            after = _slope(c, end, begin, end, block, weights, curve)
            rate = (curve[4 * c, end] - curve[4 * c, end - 1]) * inverse[end - 1]
            slope = curve[4 * c + 1, end - 1]
            curve[4 * c + 2, end - 1] = 3.0 * rate - 2.0 * slope - after
            curve[4 * c + 3, end - 1] = slope + after - 2.0 * rate


@njit(cache=True, nogil=True, error_model="numpy")
def bound_rates(curve: F64, first: int, last: int, base: int, tree: F64) -> None:
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
def excursion(t: F64, curve: F64, last: int, spread: F64) -> tuple[float, float]:
    """Bound how far a marker strays up to a row, px: (from its start, from the chord to its end).

    At most: the rows' distances from the chord, and how far a cubic is from the line between its
    rows, which is h s (1 - s) (c2 + c3 (1 + s)). Growth counts like a move.

    Args:
        spread: scratch, (4, at least the rows).
    """
    x, y, r = curve[0, 0], curve[4, 0], curve[8, 0]
    dx, dy, dr = curve[0, last] - x, curve[4, last] - y, curve[8, last] - r
    square = dx * dx + dy * dy + dr * dr
    scale = 1.0 / square if square > 0.0 else 0.0
    for k in range(last):
        gx, gy, gr = curve[0, k] - x, curve[4, k] - y, curve[8, k] - r
        s = min(max((gx * dx + gy * dy + gr * dr) * scale, 0.0), 1.0)
        gx, gy = gx - s * dx, gy - s * dy
        spread[0, k] = gx * gx + gy * gy
        spread[1, k] = abs(gr - s * dr)
    for k in range(last):
        quarter = 0.25 * (t[k + 1] - t[k])
        ex, ey = curve[2, k] + curve[3, k], curve[6, k] + curve[7, k]
        er = curve[10, k] + curve[11, k]
        ex, ey = max(abs(ex), abs(ex + curve[3, k])), max(abs(ey), abs(ey + curve[7, k]))
        spread[2, k] = quarter * quarter * (ex * ex + ey * ey)
        spread[3, k] = quarter * max(abs(er), abs(er + curve[11, k]))
    most = np.sqrt(largest(spread, 0, last)) + largest(spread, 1, last)
    most += np.sqrt(largest(spread, 2, last)) + largest(spread, 3, last)
    return np.sqrt(dx * dx + dy * dy) + abs(dr) + most, most


SEGMENT = np.dtype(
    [
        # first step and the step behind the last one; the node of the block's tree that is this
        # segment; the block
        ("k0", "i8"),
        ("k1", "i8"),
        ("node", "i8"),
        ("block", "i8"),
        # when the segment begins and ends, ns after its block; when the block begins, ns after the
        # first row; how far the marker strays from its chord at most, px
        ("begin", "f8"),
        ("end", "f8"),
        ("zero", "f8"),
        ("stray", "f8"),
        # mean rates of column, row and radius; how far rates stray from them together; the highest
        # speed of the centre, px/ns
        ("mx", "f8"),
        ("my", "f8"),
        ("mr", "f8"),
        ("deviation", "f8"),
        ("speed", "f8"),
        # column, row and radius at both ends, px, and their rates there, px/ns
        ("x0", "f8"),
        ("y0", "f8"),
        ("r0", "f8"),
        ("x1", "f8"),
        ("y1", "f8"),
        ("r1", "f8"),
        ("vx0", "f8"),
        ("vy0", "f8"),
        ("vr0", "f8"),
        ("vx1", "f8"),
        ("vy1", "f8"),
        ("vr1", "f8"),
        # how long a step of Newton's method may be after which a time is good, ns
        ("fine", "f8"),
    ]
)
"""A part of a marker's path on which it does not move far."""
Segment = np.record
Segments = npt.NDArray[np.record]
"""As kernels see one of them, and several."""
_MOST_PX = 2.0
_CLOSE = 1e-4  # of the block: after a step as small as that the next error is below 1e-7


@njit(cache=True, nogil=True, error_model="numpy")
def deviation(
    first: int, last: int, mean_x: float, mean_y: float, mean_r: float, curve: F64, spread: F64
) -> tuple[float, float]:
    """Bound how far rates stray from their means, px/ns: of the centre, and of the radius.

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
def cut_block(
    first: int,
    last: int,
    block: int,
    zero: float,
    reach: float,
    since: F64,
    until: F64,
    curve: F64,
    spread: F64,
    segments: Segments,
    n: int,
) -> int:
    """Cut a block into segments on which the marker does not move far.

    The result depends on the block's own rows alone.

    Args:
        first, last: the block's first and last row.
        zero: when it begins, ns after the first row of all.
        reach: how far from the rim the edge ends, px.
        since, until: when each step begins and ends, ns after the begin of its block.
        spread: scratch, see `deviation`.
        segments: `SEGMENT`, written from `n` on; room for as many as there are steps.

    Returns:
        how many segments there are now.
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
            travel = (speed + abs(mean_r) + grows) * length
            while parts < size and travel > parts * _MOST_PX:
                parts *= 2
            if parts > 1:
                continue
        segment = segments[n]
        segment.k0, segment.k1, segment.begin, segment.end = k0, k1, begin, end
        segment.zero, segment.block = zero, block
        # the path begins and ends as the mean does. A pixel that is beyond the edge at both ends of
        # a chord may come nearer by this much in between
        chord = (mean_x * mean_x + mean_y * mean_y) * (end - begin) ** 2
        bow = 0.5 * (apart + grows) * (end - begin)
        left = min(curve[8, k0], curve[8, k1]) - bow - reach - 0.5 * np.sqrt(chord)
        segment.stray = bow + (0.125 * chord / left if left > 0.0 else np.inf)
        segment.node = parts + (k0 - first) // (size // parts)
        segment.mx, segment.my, segment.mr = mean_x, mean_y, mean_r
        segment.deviation, segment.speed = apart + grows, speed
        segment.x0, segment.y0, segment.r0 = curve[0, k0], curve[4, k0], curve[8, k0]
        segment.x1, segment.y1, segment.r1 = curve[0, k1], curve[4, k1], curve[8, k1]
        segment.vx0, segment.vy0, segment.vr0 = (
            curve[1, k0],
            curve[5, k0],
            curve[9, k0],
        )
        e = k1 - 1
        segment.vx1 = curve[1, e] + 2.0 * curve[2, e] + 3.0 * curve[3, e]
        segment.vy1 = curve[5, e] + 2.0 * curve[6, e] + 3.0 * curve[7, e]
        segment.vr1 = curve[9, e] + 2.0 * curve[10, e] + 3.0 * curve[11, e]
        segment.fine = _CLOSE * length
        n += 1
        done = k1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def farthest(segment: Segment) -> float:
    """Bound the length of the paths of centre and radius on a segment, together, px."""
    return (segment.speed + abs(segment.mr) + segment.deviation) * (segment.end - segment.begin)
