"""The profile of a marker's rim, and what a pixel keeps of it: the rim distances of its events.

The log intensity of a disc falls with the distance g from its rim as a logistic of scale w, cut
at five w so that it is flat beyond. Each pixel therefore keeps not levels but rim distances: the
next at which it fires positive, the next at which it fires negative, and where it fired last.
"""

from __future__ import annotations

import numpy as np

from sliplab.storage.kernels import njit
from sliplab.storage.streams import F64

CUT = 5.0
"""End of the logistic edge, in units of its scale."""
ON, OFF, LAST, LEVEL = 0, 1, 2, 3
"""Columns of a pixel's state: rim distance (px) of its next positive and negative event and of
its last one, and its reference level of log intensity."""
TAIL = 1.0 / (1.0 + np.exp(CUT))
"""Value of the logistic where the edge ends."""
FAR = 1e6
"""Rim distance that is never reached, px."""


@njit(cache=True, nogil=True, error_model="numpy")
def level_at(distance: float, contrast: float, edge: float) -> float:
    """Log intensity over the background at a distance from the rim, px outwards."""
    if distance >= CUT * edge:
        return 0.0
    if distance <= -CUT * edge:
        return contrast
    share = 1.0 / (1.0 + np.exp(distance / edge))
    return contrast * (share - TAIL) / (1.0 - 2.0 * TAIL)


@njit(cache=True, nogil=True, error_model="numpy")
def rim_of(level: float, contrast: float, edge: float) -> float:
    """Distance from the rim at which a level is met; a large number if it never is.

    The two flat levels are met where the edge ends, so that what a disc does to a pixel in
    coming is undone, event by event, when it goes.
    """
    rounding = 1e-9 * contrast
    if level <= rounding:
        return CUT * edge if level >= -rounding else FAR
    if level >= contrast - rounding:
        return -CUT * edge if level <= contrast + rounding else -FAR
    share = TAIL + level / contrast * (1.0 - 2.0 * TAIL)
    return edge * np.log((1.0 - share) / share)


@njit(cache=True, nogil=True, error_model="numpy")
def dark_pixels(threshold: F64, contrast: float, edge: float) -> F64:
    """State of pixels that see no disc, (height, width, 4), for their thresholds."""
    height, width = threshold.shape
    state = np.empty((height, width, 4))
    for y in range(height):
        for x in range(width):
            state[y, x, ON] = rim_of(threshold[y, x], contrast, edge)
            state[y, x, OFF] = FAR
            state[y, x, LAST] = CUT * edge
            state[y, x, LEVEL] = 0.0
    return state


@njit(cache=True, nogil=True, error_model="numpy")
def memorise_discs(
    discs: F64, contrast: float, edge: float, threshold: F64, state: F64, seen: F64
) -> None:
    """Set the reference of the pixels that see one of `discs` to its image.

    Args:
        discs: column, row and radius, px, (n, 3).
        threshold: of every pixel, (height, width).
        state: of every pixel, written where a disc reaches.
        seen: rectangles in which discs have been, see `darken`; widened.
    """
    height, width = threshold.shape
    for i in range(discs.shape[0]):
        column, row, radius = discs[i, 0], discs[i, 1], discs[i, 2]
        reach = radius + CUT * edge
        widen(i, column, row, reach + 1.0, seen)
        for y in range(max(int(row - reach), 0), min(int(row + reach) + 2, height)):
            for x in range(max(int(column - reach), 0), min(int(column + reach) + 2, width)):
                dx, dy = x - column, y - row
                away = np.sqrt(dx * dx + dy * dy) - radius
                here = level_at(away, contrast, edge)
                if here > state[y, x, LEVEL]:
                    step = threshold[y, x]
                    state[y, x, LEVEL] = here
                    state[y, x, LAST] = rim_of(here, contrast, edge)
                    state[y, x, ON] = rim_of(here + step, contrast, edge)
                    state[y, x, OFF] = rim_of(here - step, contrast, edge)


@njit(cache=True, nogil=True, error_model="numpy")
def darken(seen: F64, dark: F64, state: F64) -> None:
    """Reset pixels to the dark background.

    Args:
        seen: rectangles in which discs have been: left, right, top, bottom, px, (n, 4); emptied.
        dark: state of pixels that see no disc, (height, width, 4).
        state: of every pixel, written inside the rectangles.
    """
    height, width = state.shape[0], state.shape[1]
    for i in range(seen.shape[0]):
        if seen[i, 0] <= seen[i, 1]:
            left, right = max(int(seen[i, 0]), 0), min(int(seen[i, 1]) + 2, width)
            for y in range(max(int(seen[i, 2]), 0), min(int(seen[i, 3]) + 2, height)):
                for x in range(left, right):
                    for c in range(4):
                        state[y, x, c] = dark[y, x, c]
        seen[i, 0], seen[i, 1], seen[i, 2], seen[i, 3] = np.inf, -np.inf, np.inf, -np.inf


@njit(cache=True, nogil=True, error_model="numpy")
def widen(i: int, column: float, row: float, reach: float, seen: F64) -> None:
    """Widen rectangle i of `seen` to hold all within `reach` px of a place."""
    seen[i, 0], seen[i, 1] = min(seen[i, 0], column - reach), max(seen[i, 1], column + reach)
    seen[i, 2], seen[i, 3] = min(seen[i, 2], row - reach), max(seen[i, 3], row + reach)
