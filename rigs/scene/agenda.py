"""Which pixels have to be looked at in a block: each waits until its marker has moved far enough.

A pixel whose rim distance is 0.3 px off its next threshold cannot fire before the marker has
moved, and grown, by 0.3 px together. So every pixel near a rim stands in a list of its marker,
under the length of way at which it must be looked at again, and a block takes out only those that
fall due: what stands still costs nothing, and a slow slide costs by its events, not by its time.

Agenda arrays, of n markers: `way` (n, 3): how far each has moved since its list was made, how far
the list reaches, and the same bound in buckets; `head` (n, buckets) and `following` (n, slots)
are linked lists of slots, -1 ends; `place` (n, slots): column << 12 | row of the pixel in a slot.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rigs.scene.edges import CUT, OFF, ON

REACH_PX = 8.0
"""How far a marker moves before its list is made again."""
BUCKETS = 256
MOVED, REACH = 0, 1
_SPARE_PX = 1e-6  # pixels are looked at that much early, so that rounding can hide none


@njit(cache=True, nogil=True, error_model="numpy")
def slack_of(gap, on, off, reach):  # type: ignore[no-untyped-def]
    """How far a marker must move, px, before a pixel `gap` px off its rim may fire.

    Beyond the edge (`reach`) the pixel may be another marker's: then only the way to it counts.
    """
    if abs(gap) >= reach:
        return abs(gap) - reach
    return min(gap - on, off - gap)


@njit(cache=True, nogil=True, error_model="numpy")
def put(i, slots, slack, count, way, head, following):  # type: ignore[no-untyped-def]
    """Let `count` slots of marker i wait until it has moved by their `slack`, px, from now on.

    What falls due beyond the list's reach is dropped: the next list will have it.
    """
    for k in range(count):
        due = way[i, MOVED] + slack[k] - _SPARE_PX
        if due < way[i, REACH]:
            bucket = max(int(due * (BUCKETS / REACH_PX)), 0)
            following[i, slots[k]] = head[i, bucket]
            head[i, bucket] = slots[k]


@njit(cache=True, nogil=True, error_model="numpy")
def take(i, begin, end, place, head, following, taken, pixels):  # type: ignore[no-untyped-def]
    """Take all slots out that fall due while marker i's way goes from `begin` to `end`, px.

    Returns:
        how many there are; they stand in `taken`, their pixels in `pixels`.
    """
    n = 0
    first = int(begin * (BUCKETS / REACH_PX))
    last = min(int(end * (BUCKETS / REACH_PX)), BUCKETS - 1)
    for bucket in range(first, last + 1):
        slot = head[i, bucket]
        head[i, bucket] = -1
        while slot >= 0:
            taken[n] = slot
            pixels[n] = place[i, slot]
            n += 1
            slot = following[i, slot]
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def near_rim(column, row, radius, band, height, width, place):  # type: ignore[no-untyped-def]
    """Pixels within `band` px of a disc's rim, into `place`; how many there are.

    Where there are more than `place` has room for, the rest is counted and not kept.
    """
    n, room = 0, place.shape[0]
    outer, inner = radius + band, max(radius - band, 0.0)
    for y in range(max(int(np.ceil(row - outer)), 0), min(int(np.floor(row + outer)) + 1, height)):
        across = (y - row) * (y - row)
        wide = np.sqrt(max(outer * outer - across, 0.0))
        hole = np.sqrt(max(inner * inner - across, 0.0))
        left = max(int(np.ceil(column - wide)), 0)
        right = min(int(np.floor(column + wide)), width - 1)
        hole_left, hole_right = int(np.floor(column - hole)), int(np.ceil(column + hole))
        x = left
        while x <= right:
            if hole_left < x < hole_right:
                x = hole_right
                continue
            if n < room:
                place[n] = x << 12 | y
            n += 1
            x += 1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def make_list(  # type: ignore[no-untyped-def]
    i, column, row, radius, state, edge, way, head, following, place, taken, pixels, slack
):
    """Make marker i's list anew, where it is now; False where it has too few slots.

    Args:
        taken, pixels, slack: scratch, not shorter than the slots.
    """
    reach = CUT * edge
    way[i, MOVED], way[i, REACH] = 0.0, REACH_PX
    head[i] = -1
    band = reach + REACH_PX
    n = near_rim(column, row, radius, band, state.shape[0], state.shape[1], pixels)
    enough = n <= place.shape[1]
    if enough:
        for slot in range(n):
            place[i, slot] = pixels[slot]
            x, y = pixels[slot] >> 12, pixels[slot] & 4095
            dx, dy = x - column, y - row
            gap = np.sqrt(dx * dx + dy * dy) - radius
            taken[slot] = slot
            slack[slot] = slack_of(gap, state[y, x, ON], state[y, x, OFF], reach)
        put(i, taken, slack, n, way, head, following)
    else:
        way[i, REACH] = -1.0
    return enough
