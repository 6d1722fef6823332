"""When the moving rim of a disc makes pixels fire: the kernels behind `rigs.scene.events`.

The log intensity of a disc falls with the distance g from its rim as a logistic of scale w, cut
at five w so that it is flat beyond. Each pixel therefore keeps not levels but rim distances: the
next at which it fires positive (`on`), negative (`off`), and where it fired last. Over one chord
of the disc's path the distance |x - c(t)| - r(t) is convex in time, so a pixel first gains, then
loses light, and each event is the proper root of |x - c0 - v t| = r0 + g + b t.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rigs.scene.sorting import sort_tail

CUT = 5.0
"""Where the logistic edge ends, in units of its scale."""
_TAIL = 1.0 / (1.0 + np.exp(CUT))
_FAR = 1e6  # px; stands for a rim distance that is never reached
_LONGEST_CHORD_PX = 4.0


@njit(cache=True, nogil=True)
def level_at(distance, contrast, edge):  # type: ignore[no-untyped-def]
    """Log intensity over the background at a distance from the rim, px outwards."""
    if distance >= CUT * edge:
        return 0.0
    if distance <= -CUT * edge:
        return contrast
    share = 1.0 / (1.0 + np.exp(distance / edge))
    return contrast * (share - _TAIL) / (1.0 - 2.0 * _TAIL)


@njit(cache=True, nogil=True)
def rim_of(level, contrast, edge):  # type: ignore[no-untyped-def]
    """Distance from the rim at which a level is met; far away if it never is.

    The two flat levels are met where the edge ends, so that what a disc does to a pixel in
    coming is undone, event by event, when it goes.
    """
    rounding = 1e-9 * contrast
    if level <= rounding:
        return CUT * edge if level >= -rounding else _FAR
    if level >= contrast - rounding:
        return -CUT * edge if level <= contrast + rounding else -_FAR
    share = _TAIL + level / contrast * (1.0 - 2.0 * _TAIL)
    return edge * np.log((1.0 - share) / share)


@njit(cache=True, nogil=True)
def reset_pixels(discs, contrast, edge, threshold, on, off, last, level, fired):  # type: ignore[no-untyped-def]
    """Let every pixel take the image of `discs` (column, row, radius; (n, 3)) as reference."""
    height, width = threshold.shape
    for y in range(height):
        for x in range(width):
            on[y, x] = rim_of(threshold[y, x], contrast, edge)
            off[y, x], last[y, x] = _FAR, CUT * edge
            level[y, x] = 0.0
            fired[y, x] = -np.inf
    for i in range(discs.shape[0]):
        column, row, radius = discs[i, 0], discs[i, 1], discs[i, 2]
        reach = radius + CUT * edge
        for y in range(max(int(row - reach), 0), min(int(row + reach) + 2, height)):
            for x in range(max(int(column - reach), 0), min(int(column + reach) + 2, width)):
                away = np.hypot(x - column, y - row) - radius
                here = level_at(away, contrast, edge)
                if here > level[y, x]:
                    level[y, x] = here
                    last[y, x] = rim_of(here, contrast, edge)
                    on[y, x] = rim_of(here + threshold[y, x], contrast, edge)
                    off[y, x] = rim_of(here - threshold[y, x], contrast, edge)


@njit(cache=True, nogil=True)
def _straight(path, i, a, b, chord_px):  # type: ignore[no-untyped-def]
    """Whether marker i's steps a to b lie on their chord, in space and in time."""
    along = np.empty(3)
    for c in range(3):
        along[c] = path[b, i, c] - path[a, i, c]
    if np.hypot(along[0], along[1]) + abs(along[2]) > _LONGEST_CHORD_PX:
        return False
    for k in range(a + 1, b):
        share = (k - a) / (b - a)
        off_x = path[k, i, 0] - path[a, i, 0] - share * along[0]
        off_y = path[k, i, 1] - path[a, i, 1] - share * along[1]
        off_r = path[k, i, 2] - path[a, i, 2] - share * along[2]
        if np.hypot(off_x, off_y) + abs(off_r) > chord_px:
            return False
    return True


@njit(cache=True, nogil=True)
def _root(dx, dy, vx, vy, rim, growth, low, high, falling):  # type: ignore[no-untyped-def]
    """The time in [low, high] at which |d - v t| = rim + growth t, where it is crossed once.

    `falling`: the rim comes over the pixel (the smaller root), or leaves it (the larger one).
    """
    a = vx * vx + vy * vy - growth * growth
    half_b = -(dx * vx + dy * vy + rim * growth)
    c = dx * dx + dy * dy - rim * rim
    spread = np.sqrt(max(half_b * half_b - a * c, 0.0))
    # both roots without cancellation: q / a and c / q
    q = -(half_b + spread) if half_b > 0.0 else -half_b + spread
    first = q / a if a != 0.0 else np.inf
    second = c / q if q != 0.0 else np.inf
    best, miss = low if falling else high, np.inf
    for candidate in (first, second):
        if candidate == candidate and abs(candidate) < np.inf:
            outside = max(low - candidate, candidate - high, 0.0)
            if outside < miss:
                # roots outside by more than rounding belong to the other branch
                miss = outside
                best = min(max(candidate, low), high)
    return best


@njit(cache=True, nogil=True)
def _fire(  # type: ignore[no-untyped-def]
    x, y, start, vx, vy, growth, t0, dt, contrast, edge, refractory, threshold,
    on, off, last, level, fired, out_t, out_x, out_y, out_p, n,
):  # fmt: skip
    """Events of one pixel while a disc goes straight by; returns how many there are in all."""
    dx, dy, r0 = x - start[0], y - start[1], start[2]
    ex, ey = dx - vx, dy - vy
    speed = np.hypot(vx, vy)
    along, distance1 = dx * vx + dy * vy, np.hypot(ex, ey)
    # the time at which the pixel is deepest in the disc
    turn = 1.0
    if -along - growth * np.hypot(dx, dy) >= 0.0:
        turn = 0.0
    elif -(ex * vx + ey * vy) - growth * distance1 > 0.0 and speed > abs(growth):
        ratio = growth / speed
        aside = abs(dx * vy - dy * vx) / speed
        past = aside * ratio / np.sqrt(1.0 - ratio * ratio)
        turn = min(max((past + along / speed) / speed, 0.0), 1.0)
    deepest = np.hypot(dx - turn * vx, dy - turn * vy) - r0 - turn * growth
    step = threshold[y, x]
    at = 0.0
    while on[y, x] >= deepest:
        at = _root(dx, dy, vx, vy, r0 + on[y, x], growth, at, turn, True)
        level[y, x] += step
        off[y, x], last[y, x] = last[y, x], on[y, x]
        on[y, x] = rim_of(level[y, x] + step, contrast, edge)
        when = t0 + at * dt
        if when - fired[y, x] >= refractory:
            fired[y, x] = when
            out_t[n], out_x[n], out_y[n], out_p[n] = np.int64(when), x, y, 1
            n += 1
    at = turn
    while off[y, x] <= distance1 - r0 - growth:
        at = _root(dx, dy, vx, vy, r0 + off[y, x], growth, at, 1.0, False)
        level[y, x] -= step
        on[y, x], last[y, x] = last[y, x], off[y, x]
        off[y, x] = rim_of(level[y, x] - step, contrast, edge)
        when = t0 + at * dt
        if when - fired[y, x] >= refractory:
            fired[y, x] = when
            out_t[n], out_x[n], out_y[n], out_p[n] = np.int64(when), x, y, 0
            n += 1
    return n


@njit(cache=True, nogil=True)
def _visit(  # type: ignore[no-untyped-def]
    start, end, t0, dt, contrast, edge, refractory, threshold, on, off, last, level, fired,
    may, out_t, out_x, out_y, out_p, n,
):  # fmt: skip
    """Events of one disc that goes straight from `start` to `end` (column, row, radius)."""
    height, width = threshold.shape
    cx, cy, r0 = start[0], start[1], start[2]
    vx, vy, growth = end[0] - cx, end[1] - cy, end[2] - r0
    speed = np.hypot(vx, vy)
    mid_x, mid_y = cx + 0.5 * vx, cy + 0.5 * vy
    reach = CUT * edge + 0.5 * speed
    outer = max(r0, end[2]) + reach
    inner = max(min(r0, end[2]) - reach, 0.0)
    # how far below the distances at both ends a pixel's distance can come in between
    bend = speed * speed / (8.0 * max(inner, 0.125)) if inner > 0.0 else speed
    for y in range(max(int(np.ceil(mid_y - outer)), 0), min(int(mid_y + outer) + 1, height)):
        across = y - mid_y
        wide = np.sqrt(max(outer * outer - across * across, 0.0))
        hole = np.sqrt(max(inner * inner - across * across, 0.0))
        left = max(int(np.ceil(mid_x - wide)), 0)
        right = min(int(np.floor(mid_x + wide)), width - 1)
        hole_left, hole_right = int(np.floor(mid_x - hole)), int(np.ceil(mid_x + hole))
        whole = hole_right - hole_left < 8
        dy = y - cy
        ey = dy - vy
        dy2, ey2 = dy * dy, ey * ey
        for part in range(1 if whole else 2):
            first = left if part == 0 else max(hole_right, left)
            past = right + 1 if whole or part == 1 else min(hole_left, right) + 1
            if first >= past:
                continue
            next_on, next_off = on[y, first:past], off[y, first:past]
            offset = first - cx
            # which pixels may fire at all: without branches, so that it runs on whole vectors
            for k in range(past - first):
                dx = offset + k
                ex = dx - vx
                square0, square1 = dx * dx + dy2, ex * ex + ey2
                near, far0 = next_on[k] + (r0 + bend), next_off[k] + r0
                near0, near1, far1 = max(near, 0.0), max(near + growth, 0.0), far0 + growth
                may[k] = (
                    (square0 <= near0 * near0) | (square1 <= near1 * near1)
                    | (square0 >= far0 * far0) | (square1 >= far1 * far1)
                )  # fmt: skip
            for k in range(past - first):
                if may[k]:
                    n = _fire(
                        first + k, y, start, vx, vy, growth, t0, dt, contrast, edge, refractory,
                        threshold, on, off, last, level, fired, out_t, out_x, out_y, out_p, n,
                    )  # fmt: skip
    return n


@njit(cache=True, nogil=True)
def _most(start, end, contrast, edge, lowest):  # type: ignore[no-untyped-def]
    """An upper bound of the events of one chord; `lowest` threshold of all pixels."""
    speed = np.hypot(end[0] - start[0], end[1] - start[1])
    side = 2.0 * (max(start[2], end[2]) + CUT * edge) + speed + 3.0
    hole = max(min(start[2], end[2]) - CUT * edge - 0.5 * speed - 2.0, 0.0)
    # the profile is steepest at the rim: a quarter of the contrast over its scale
    change = min(0.26 * contrast / edge * (speed + abs(end[2] - start[2])), contrast)
    return int(side * side - 3.0 * hole * hole) * 2 * (int(change / lowest) + 2)


@njit(cache=True, nogil=True)
def trace(  # type: ignore[no-untyped-def]
    path, first_step, step_ns, block, chord_px, contrast, edge, refractory, threshold,
    lowest, on, off, last, level, fired, noise_t, noise_x, noise_y, noise_p,
):  # fmt: skip
    """Signal and noise of all discs along `path`, sorted by time.

    Args:
        path: column, row and radius of each disc at each step, px, (m + 1, n, 3).
        first_step: number of the first row on the global grid; blocks of `block` steps are cut
            there, and nothing crosses their borders.
        refractory: ns.
        lowest: the lowest threshold of all.
        threshold, on, off, last, level, fired: the pixels' state, (height, width), written.
        noise_t, noise_x, noise_y, noise_p: noise of the same span of time, sorted.

    Returns:
        true time (ns, int64), column, row (uint16), polarity (uint8), each (k,).
    """
    capacity = 1 << 14
    out_t = np.empty(capacity, np.int64)
    out_x, out_y = np.empty(capacity, np.uint16), np.empty(capacity, np.uint16)
    out_p = np.empty(capacity, np.uint8)
    n, noise_at, rows = 0, 0, path.shape[0] - 1
    stack = np.empty((64, 2), np.int64)
    may = np.empty(threshold.shape[1], np.bool_)
    begin = 0
    while begin < rows:
        stop = min(begin + block - (first_step + begin) % block, rows)
        block_from = n
        for i in range(path.shape[1]):
            stack[0, 0], stack[0, 1] = begin, stop
            depth = 1
            while depth > 0:
                depth -= 1
                a, b = stack[depth, 0], stack[depth, 1]
                if b - a > 1 and not _straight(path, i, a, b, chord_px):
                    half = (a + b) // 2
                    stack[depth, 0], stack[depth, 1] = half, b
                    stack[depth + 1, 0], stack[depth + 1, 1] = a, half
                    depth += 2
                    continue
                still = True
                for c in range(3):
                    still = still and path[a, i, c] == path[b, i, c]
                if still:
                    continue
                room = n + _most(path[a, i], path[b, i], contrast, edge, lowest)
                if room > capacity:
                    capacity = 2 * room
                    out_t = _larger(out_t, capacity)
                    out_x, out_y = _larger(out_x, capacity), _larger(out_y, capacity)
                    out_p = _larger(out_p, capacity)
                n = _visit(
                    path[a, i], path[b, i], float((first_step + a) * step_ns),
                    float((b - a) * step_ns), contrast, edge, refractory, threshold,
                    on, off, last, level, fired, may, out_t, out_x, out_y, out_p, n,
                )  # fmt: skip
        end_ns = (first_step + stop) * step_ns
        noise_to = noise_at
        while noise_to < noise_t.shape[0] and noise_t[noise_to] < end_ns:
            noise_to += 1
        extra = noise_to - noise_at
        if n + extra > capacity:
            capacity = 2 * (n + extra)
            out_t = _larger(out_t, capacity)
            out_x, out_y = _larger(out_x, capacity), _larger(out_y, capacity)
            out_p = _larger(out_p, capacity)
        out_t[n : n + extra] = noise_t[noise_at:noise_to]
        out_x[n : n + extra] = noise_x[noise_at:noise_to]
        out_y[n : n + extra] = noise_y[noise_at:noise_to]
        out_p[n : n + extra] = noise_p[noise_at:noise_to]
        n, noise_at = n + extra, noise_to
        sort_tail(out_t, out_x, out_y, out_p, block_from, n, (first_step + begin) * step_ns)
        begin = stop
    return out_t[:n].copy(), out_x[:n].copy(), out_y[:n].copy(), out_p[:n].copy()


@njit(cache=True, nogil=True)
def _larger(array, capacity):  # type: ignore[no-untyped-def]
    grown = np.empty(capacity, array.dtype)
    grown[: array.shape[0]] = array
    return grown
