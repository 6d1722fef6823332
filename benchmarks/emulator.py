"""A rival for `rigs.scene.events`: events from frames, the way the public emulators make them.

Ours, written from how those emulators are described (v2e: Hu, Liu and Delbruck 2021; ESIM: Rebecq,
Gehrig and Scaramuzza 2018), and compiled: every millisecond the whole scene is drawn, its logarithm
is taken, and each pixel whose log intensity has gone by its threshold from its own reference fires,
at a time on the straight line between the two frames. The same discs, thresholds and dead time as
the analytic way, and neither noise nor a read-out. All simulated.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rigs.scene.edges import CUT, level_at
from rigs.scene.events import EventOptics, Events
from storage.streams import F64

FRAME_NS = 1_000_000


def emulate(path: F64, optics: EventOptics, threshold: F64) -> Events:
    """Events of discs that are drawn every millisecond, in order of time.

    Args:
        path: column, row and radius of every disc in every frame, px, (m, n, 3).
        optics: picture, edges, contrast and dead time.
        threshold: of every pixel, (height, width).

    Returns:
        time (ns from the first frame), column, row, polarity, (k,) each.
    """
    room = 1 << 18
    while True:
        t_ns, x, y, p, n = _emulate(
            np.ascontiguousarray(path), optics.contrast, optics.edge_px,
            round(optics.refractory_us * 1e3), threshold, room,
        )  # fmt: skip
        if n <= room:
            break
        # rarely: all is done again, with room enough
        room = n
    order = np.argsort(t_ns[:n], kind="stable")
    return t_ns[order], x[order], y[order], p[order]


@njit(cache=True, nogil=True, error_model="numpy")
def _draw(discs, contrast, edge, picture):  # type: ignore[no-untyped-def]
    """Intensity of the discs over that of the ground, into `picture` (height, width)."""
    height, width = picture.shape
    picture[:] = 1.0
    for i in range(discs.shape[0]):
        column, row, radius = discs[i, 0], discs[i, 1], discs[i, 2]
        reach = radius + CUT * edge
        for y in range(max(int(row - reach), 0), min(int(row + reach) + 2, height)):
            for x in range(max(int(column - reach), 0), min(int(column + reach) + 2, width)):
                dx, dy = x - column, y - row
                level = level_at(np.sqrt(dx * dx + dy * dy) - radius, contrast, edge)
                if level > 0.0:
                    picture[y, x] = np.exp(level)


@njit(cache=True, nogil=True, error_model="numpy")
def _take_logarithm(picture, levels):  # type: ignore[no-untyped-def]
    height, width = picture.shape
    for y in range(height):
        for x in range(width):
            levels[y, x] = np.log(picture[y, x])


@njit(cache=True, nogil=True, error_model="numpy")
def _compare(  # type: ignore[no-untyped-def]
    before, now, reference, threshold, fired, start_ns, refractory_ns, t_ns, xs, ys, ps, begin
):
    """Events between two frames, written from `begin` on while there is room; all are counted."""
    n, (height, width), room = begin, threshold.shape, t_ns.shape[0]
    for y in range(height):
        for x in range(width):
            change, step = now[y, x] - reference[y, x], threshold[y, x]
            # a level met to within rounding is met, as it is for the analytic way
            while abs(change) >= step - 2e-9:
                sign = 1.0 if change > 0.0 else -1.0
                reference[y, x] += sign * step
                change = now[y, x] - reference[y, x]
                share = (reference[y, x] - before[y, x]) / (now[y, x] - before[y, x])
                t = start_ns + np.int64(min(max(share, 0.0), 1.0) * FRAME_NS)
                if t - fired[y, x] >= refractory_ns:
                    fired[y, x] = t
                    if n < room:
                        t_ns[n], xs[n], ys[n], ps[n] = t, x, y, sign > 0.0
                    n += 1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def _emulate(path, contrast, edge, refractory_ns, threshold, room):  # type: ignore[no-untyped-def]
    """Events, in room for so many, and how many there are."""
    picture = np.empty(threshold.shape)
    levels = np.empty((2, *threshold.shape))
    _draw(path[0], contrast, edge, picture)
    _take_logarithm(picture, levels[0])
    reference = levels[0].copy()
    fired = np.full(threshold.shape, -(1 << 62))
    t_ns, ps = np.empty(room, np.int64), np.empty(room, np.uint8)
    xs, ys, n = np.empty(room, np.uint16), np.empty(room, np.uint16), 0
    for frame in range(1, path.shape[0]):
        _draw(path[frame], contrast, edge, picture)
        _take_logarithm(picture, levels[frame % 2])
        n = _compare(
            levels[(frame + 1) % 2], levels[frame % 2], reference, threshold, fired,
            (frame - 1) * FRAME_NS, refractory_ns, t_ns, xs, ys, ps, n,
        )  # fmt: skip
    return t_ns, xs, ys, ps, n
