"""Pixels that may fire in a block: a list of each marker's pixels, and a cheap test.

When a list is made, every pixel near the rim keeps the direction u to it, its distance rho and how
far its next thresholds are. Once the marker has moved by D and grown by G, the pixel's distance
from the rim has fallen by q = u.D - (u x D)^2 / (2 rho) + G, to third order in D / rho. So a block
is one pass of a few single precision operations a pixel, without branches, over all that may fire,
and what cannot fire costs nothing more. A marker that has moved by `REACH_PX` gets a new list.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.scene.edges import CUT, OFF, ON
from sliplab.storage.kernels import njit
from sliplab.storage.streams import F32, F64, I64, U8

REACH_PX = 1.5
"""Distance that a marker may move, and grow, before its list is made again."""
UX, UY, BEND, RISE, FALL = 0, 1, 2, 3, 4
_COUNT, _NEAREST = 3, 4
_NEVER_PX = 1e6
_SPARE_PX = np.float32(2e-6)  # rounding of single precision cannot hide a pixel


class RimLists(NamedTuple):
    """Lists of n markers with room for s pixels each."""

    origin: F64
    """Column, row and radius when the list was made, how many pixels there are (0: no list), and
    the least rho, (n, 5)."""
    aim: F32
    """Both components of u, 1 / (2 rho), and what q must rise to and fall to (negated) for a
    positive and a negative event, (n, 5, s)."""
    place: npt.NDArray[np.int32]
    """Column << 12 | row, (n, s)."""


def no_lists(markers: int, slots: int) -> RimLists:
    """Room for lists, none of which is made yet."""
    return RimLists(
        np.zeros((markers, 5)),
        np.empty((markers, 5, slots), np.float32),
        np.empty((markers, slots), np.int32),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def near_rim(
    column: float, row: float, radius: float, band: float, height: int, width: int, pixels: I64
) -> int:
    """Pixels within `band` px of a disc's rim, into `pixels`; how many there are.

    Where there are more than `pixels` has room for, the rest is counted and dropped.
    """
    n, room = 0, pixels.shape[0]
    outer, inner = radius + band, max(radius - band, 0.0)
    for y in range(max(int(np.ceil(row - outer)), 0), min(int(np.floor(row + outer)) + 1, height)):
        across = (y - row) * (y - row)
        wide = np.sqrt(max(outer * outer - across, 0.0))
        hole = np.sqrt(max(inner * inner - across, 0.0))
        left = max(int(np.ceil(column - wide)), 0)
        right = min(int(np.floor(column + wide)), width - 1)
        hole_left, hole_right = int(np.floor(column - hole)), int(np.ceil(column + hole))
        if hole_right - hole_left < 2:
            hole_left, hole_right = right + 1, right + 1
        for x in range(left, min(hole_left, right) + 1):
            if n < room:
                pixels[n] = x << 12 | y
            n += 1
        for x in range(max(hole_right, left), right + 1):
            if n < room:
                pixels[n] = x << 12 | y
            n += 1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def thresholds(gap: float, on: float, off: float, reach: float) -> tuple[float, float]:
    """Distance by which a pixel must fall for a positive, and rise for a negative event, px.

    Outside the edge (`reach`) the pixel may be another marker's: only the distance up to the edge
    counts then.
    """
    if gap >= reach:
        return gap - reach, _NEVER_PX
    return gap - on, off - gap


@njit(cache=True, nogil=True, error_model="numpy")
def make_list(
    i: int,
    column: float,
    row: float,
    radius: float,
    state: F64,
    edge: float,
    pixels: I64,
    origin: F64,
    aim: F32,
    place: npt.NDArray[np.int32],
) -> bool:
    """Rebuild marker i's list at its present place; False where it cannot have one.

    There is none where the list has too few slots, or the disc is so small that the rim's
    curvature matters.

    Args:
        state: of every pixel, (height, width, 4).
        pixels: scratch, at least as many as slots.
    """
    reach = CUT * edge
    band = reach + REACH_PX
    n = near_rim(column, row, radius, band, state.shape[0], state.shape[1], pixels)
    fits = n <= place.shape[1] and radius > band + 2.0 * REACH_PX
    if fits:
        near, n = n, 0
        for k in range(near):
            x, y = pixels[k] >> 12, pixels[k] & 4095
            dx, dy = x - column, y - row
            away = np.sqrt(dx * dx + dy * dy)
            gap = away - radius
            rise, fall = thresholds(gap, state[y, x, ON], state[y, x, OFF], reach)
            if min(rise, fall) <= 1.05 * REACH_PX:
                inverse = 1.0 / away
                place[i, n] = pixels[k]
                aim[i, UX, n], aim[i, UY, n] = dx * inverse, dy * inverse
                aim[i, BEND, n] = 0.5 * inverse
                aim[i, RISE, n], aim[i, FALL, n] = rise, fall
                n += 1
        for k in range(n, (n + 7) // 8 * 8):
            aim[i, UX, k], aim[i, UY, k], aim[i, BEND, k] = 0.0, 0.0, 0.0
            aim[i, RISE, k], aim[i, FALL, k] = _NEVER_PX, _NEVER_PX
    origin[i, 0], origin[i, 1], origin[i, 2] = column, row, radius
    origin[i, _COUNT] = n if fits else 0.0
    origin[i, _NEAREST] = radius - band
    return fits


@njit(cache=True, nogil=True, error_model="numpy")
def reaches(i: int, column: float, row: float, radius: float, strays: float, origin: F64) -> bool:
    """Return whether marker i's list still holds if it strays so far from (column, row, radius)."""
    dx, dy = column - origin[i, 0], row - origin[i, 1]
    moved = np.sqrt(dx * dx + dy * dy) + abs(radius - origin[i, 2])
    return origin[i, _COUNT] > 0.0 and moved + strays <= REACH_PX


@njit(cache=True, nogil=True, error_model="numpy")
def may_fire(
    i: int,
    column: float,
    row: float,
    radius: float,
    dx: float,
    dy: float,
    dr: float,
    stray: float,
    origin: F64,
    aim: F32,
    place: npt.NDArray[np.int32],
    hit: U8,
    slots: I64,
    pixels: I64,
) -> int:
    """Find the pixels that may fire while marker i goes from (column, row, radius) by (dx, dy, dr).

    Args:
        stray: largest distance of the path from its chord, px.
        hit: scratch, bytes, a multiple of eight of them, as many as slots.
        slots, pixels: slots and places of these pixels, written.

    Returns:
        how many there are.
    """
    from_x, from_y = column - origin[i, 0], row - origin[i, 1]
    to_x, to_y = from_x + dx, from_y + dy
    moved = np.sqrt(max(from_x * from_x + from_y * from_y, to_x * to_x + to_y * to_y)) + stray
    nearest = origin[i, _NEAREST]
    left = nearest - moved
    # what the second order leaves out: a b^2 / (2 rho (rho - a)) and b^4 / (8 (rho - a)^3) with
    # a^2 + b^2 = D^2; twice, for a pixel's thresholds may have been renewed in between
    rest = 0.385 * moved**3 / (2.0 * nearest * left) + moved**4 / (8.0 * left**3)
    # along the chord the bending term is a parabola; this is how far it and a line are apart
    bow = 0.25 * (dx * dx + dy * dy) / nearest
    margin = np.float32(stray * (1.0 + moved / left) + 2.0 * rest + bow) + _SPARE_PX
    x, y = np.float32(from_x + 0.5 * dx), np.float32(from_y + 0.5 * dy)
    grown = np.float32(radius + 0.5 * dr - origin[i, 2])
    half_x, half_y, half_r = np.float32(0.5 * dx), np.float32(0.5 * dy), np.float32(0.5 * dr)
    count = int(origin[i, _COUNT])
    ux, uy, bend, rise, fall = aim[i, UX], aim[i, UY], aim[i, BEND], aim[i, RISE], aim[i, FALL]
    # slots behind the last one have thresholds that are never met
    for k in range((count + 7) // 8 * 8):
        across = ux[k] * y - uy[k] * x
        bent = across * bend[k]
        turn = ux[k] * half_y - uy[k] * half_x
        # halfway, and how far from that at both ends
        middle = ux[k] * x + uy[k] * y + grown - across * bent
        far = abs(ux[k] * half_x + uy[k] * half_y + half_r - (bent + bent) * turn) + margin
        hit[k] = (middle + far >= rise[k]) | (far - middle >= fall[k])
    n = 0
    groups = hit.view(np.uint64)
    for group in range((count + 7) // 8):
        if groups[group] != 0:
            for k in range(8 * group, 8 * group + 8):
                slots[n], pixels[n] = k, place[i, k]
                n += hit[k]
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def renew(
    i: int,
    column: float,
    row: float,
    radius: float,
    slots: I64,
    pixels: I64,
    gaps: F64,
    count: int,
    state: F64,
    edge: float,
    origin: F64,
    aim: F32,
) -> None:
    """Give slots new thresholds after their pixels were computed.

    Args:
        column, row, radius: where marker i is now.
        gaps: how far each pixel is from the rim now, px.
    """
    reach = CUT * edge
    x, y = np.float32(column - origin[i, 0]), np.float32(row - origin[i, 1])
    dr = np.float32(radius - origin[i, 2])
    for index in range(count):
        k, gap = slots[index], gaps[index]
        across = aim[i, UX, k] * y - aim[i, UY, k] * x
        q = aim[i, UX, k] * x + aim[i, UY, k] * y - across * across * aim[i, BEND, k] + dr
        px, py = pixels[index] >> 12, pixels[index] & 4095
        rise, fall = thresholds(gap, state[py, px, ON], state[py, px, OFF], reach)
        aim[i, RISE, k], aim[i, FALL, k] = rise + q, fall - q
