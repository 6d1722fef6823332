"""When the rim of a moving disc crosses one pixel's next thresholds: roots on a cubic path.

g(t) = |x - c(t)| - r(t) is the pixel's distance from the rim. Every root is looked for on a piece
of time on which g is proven to be monotone: its rate lies between bounds from the control points
of the path's derivative (a Bezier curve stays in their hull) and from how far the direction to
the pixel can turn. Where the sign of the rate is not certain, the same bounds say how far g may
lie beyond both ends of the piece; if that reaches no threshold the piece is done, else it is
halved. So a reversal is found however short it is, and a tangent pixel has two crossings or none.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rigs.scene.edges import CUT, LAST, LEVEL, OFF, ON, rim_of

_DONE_PX = 1e-10
_NEWTON = 1e-4  # of the block: after a step as small as that the next error is below 1e-7


@njit(cache=True, nogil=True, error_model="numpy")
def step_at(t, zero, rows, guess):  # type: ignore[no-untyped-def]
    """The step of the path that holds the time `t` after `zero`, looked for from `guess` on."""
    last = rows.shape[0] - 2
    k = min(max(guess, 0), last)
    while k < last and t > rows[k + 1] - zero:
        k += 1
    while k > 0 and t < rows[k] - zero:
        k -= 1
    return k


@njit(cache=True, nogil=True, error_model="numpy")
def distance_at(x, y, t, k, zero, rows, inverse, curve):  # type: ignore[no-untyped-def]
    """Distance of a pixel from the rim at a time `t` after `zero`, in step k, px, and its rate.

    Returns:
        the distance, and the rate as a product of two: the rate times the distance from the
        centre, and that distance (of which the caller may spare the division).
    """
    tau = t - (rows[k] - zero)
    s = tau * inverse[k]
    dx = x - (curve[k, 0] + tau * (curve[k, 1] + s * (curve[k, 2] + s * curve[k, 3])))
    dy = y - (curve[k, 4] + tau * (curve[k, 5] + s * (curve[k, 6] + s * curve[k, 7])))
    r = curve[k, 8] + tau * (curve[k, 9] + s * (curve[k, 10] + s * curve[k, 11]))
    vx = curve[k, 1] + s * (2.0 * curve[k, 2] + 3.0 * s * curve[k, 3])
    vy = curve[k, 5] + s * (2.0 * curve[k, 6] + 3.0 * s * curve[k, 7])
    growth = curve[k, 9] + s * (2.0 * curve[k, 10] + 3.0 * s * curve[k, 11])
    away = np.sqrt(dx * dx + dy * dy)
    return away - r, -(dx * vx + dy * vy) - growth * away, away


@njit(cache=True, nogil=True, error_model="numpy")
def turning(share):  # type: ignore[no-untyped-def]
    """How far a unit vector may turn whose end moves by a `share` of its distance.

    |u - u'| <= 2 |e - e'| / (|e| + |e'|) (Dunkl and Williams 1964), and never above 2.
    """
    return 1.34 * share if share <= 0.5 else 2.0


@njit(cache=True, nogil=True, error_model="numpy")
def may_reach(ga, gb, slowest, fastest, length, on, off, reach):  # type: ignore[no-untyped-def]
    """Whether a distance from ga to gb in `length` ns can meet a threshold in between.

    Its rate lies between `slowest` <= 0 and `fastest` >= 0: both lines from each end bound it.
    """
    spread = fastest - slowest
    if spread <= 0.0:
        least, most = min(ga, gb), max(ga, gb)
    else:
        product = slowest * fastest * length
        least = (ga * fastest - gb * slowest + product) / spread
        most = (gb * fastest - ga * slowest - product) / spread
    return least <= on or (most >= off and least < reach)


@njit(cache=True, nogil=True, error_model="numpy")
def _at_row(x, y, k, curve):  # type: ignore[no-untyped-def]
    """Distance of a pixel from the rim at row k, px."""
    dx, dy = x - curve[k, 0], y - curve[k, 4]
    return np.sqrt(dx * dx + dy * dy) - curve[k, 8]


@njit(cache=True, nogil=True, error_model="numpy")
def _node_rates(node, dx, dy, away, length, tree):  # type: ignore[no-untyped-def]
    """Bounds of the distance's rate over the steps of a node; (dx, dy): to the pixel at its end."""
    inverse = 1.0 / away if away > 0.0 else 0.0
    ux, uy = dx * inverse, dy * inverse
    low_x, high_x = ux * tree[node, 0], ux * tree[node, 3]
    low_y, high_y = uy * tree[node, 1], uy * tree[node, 4]
    least = min(low_x, high_x) + min(low_y, high_y)
    most = max(low_x, high_x) + max(low_y, high_y)
    speed = tree[node, 6]
    turn = (turning(speed * length * inverse) if away > 0.0 else 2.0) * speed
    return -most - tree[node, 5] - turn, -least - tree[node, 2] + turn


@njit(cache=True, nogil=True, error_model="numpy")
def _part_rates(x, y, sa, sb, k, h, curve):  # type: ignore[no-untyped-def]
    """Bounds of the distance's rate on the part sa to sb of step k.

    The control points of the part of a quadratic Bezier curve are its blossom at (sa, sa),
    (sa, sb) and (sb, sb).
    """
    tau = sa * h
    dx = x - (curve[k, 0] + tau * (curve[k, 1] + sa * (curve[k, 2] + sa * curve[k, 3])))
    dy = y - (curve[k, 4] + tau * (curve[k, 5] + sa * (curve[k, 6] + sa * curve[k, 7])))
    away = np.sqrt(dx * dx + dy * dy)
    inverse = 1.0 / away if away > 0.0 else 0.0
    ux, uy = dx * inverse, dy * inverse
    low, high, speed = np.inf, -np.inf, 0.0
    for p, q in ((sa, sa), (sa, sb), (sb, sb)):
        vx = curve[k, 1] + (p + q) * curve[k, 2] + 3.0 * p * q * curve[k, 3]
        vy = curve[k, 5] + (p + q) * curve[k, 6] + 3.0 * p * q * curve[k, 7]
        growth = curve[k, 9] + (p + q) * curve[k, 10] + 3.0 * p * q * curve[k, 11]
        rate = -(ux * vx + uy * vy) - growth
        low, high = min(low, rate), max(high, rate)
        speed = max(speed, np.sqrt(vx * vx + vy * vy))
    turn = (turning(speed * (sb - sa) * h * inverse) if away > 0.0 else 2.0) * speed
    return low - turn, high + turn


@njit(cache=True, nogil=True, error_model="numpy")
def events_of_pixels(  # type: ignore[no-untyped-def]
    pixels, count, rows, inverse, curve, first, blocks, stray, tree, threshold, contrast, edge,
    origin, stack, state, gaps, out, n,
):  # fmt: skip
    """Events of pixels over some blocks, however their distances go; see the module's text.

    What is done in a block follows from its own rows alone, to the bit. One long function, because
    handing arrays on costs numba more than a root does.

    Args:
        pixels: column << 12 | row, the first `count` of them.
        rows, inverse, curve: see `marker_path.fit_block`.
        first: first row of each block, and the last row of all, (blocks + 1,).
        stray: how far the marker is from the chord of each block at most, px.
        tree: of `marker_path.bound_rates`; that of block b begins at 4 first[b].
        threshold, state: of all pixels, (height, width) and (height, width, 4); written.
        origin: ns to add to every time.
        stack: scratch, (160, 3).
        gaps: distance of each pixel from the rim at the end, px; written.
        out: packed events as in `sorting`, written from `n` on.

    Returns:
        how many events `out` holds now.
    """
    reach = CUT * edge
    for index in range(count):
        # all that is not in the cache is asked for at once, and not one pixel after the other
        x, y = pixels[index] >> 12, pixels[index] & 4095
        gaps[index] = state[y, x, LEVEL] + threshold[y, x]
    for index in range(count):
        x, y = pixels[index] >> 12, pixels[index] & 4095
        code = np.int64(x) << 13 | np.int64(y) << 1
        ga = _at_row(x, y, first[0], curve)
        for block in range(blocks):
            begin, last = first[block], first[block + 1]
            gb = _at_row(x, y, last, curve)
            if (
                min(ga, gb) - stray[block] > state[y, x, ON]
                and max(ga, gb) + stray[block] < state[y, x, OFF]
            ):
                ga = gb
                continue
            # times count from the block's begin, wherever it lies in `rows`
            final, zero, base = gb, rows[begin], 4 * begin
            length, start = rows[last] - zero, np.int64(zero + origin)
            size = 1
            while size < last - begin:
                size *= 2
            # pieces yet to be done, the next one on top: a node of the tree with its steps, or,
            # with a number not above 0, a step with the part of it from sa to sb
            stack[0, 0], stack[0, 1], stack[0, 2] = 1.0, begin, begin + size
            depth = 1
            while depth > 0:
                depth -= 1
                node = int(stack[depth, 0])
                sa, sb = stack[depth, 1], stack[depth, 2]
                # the end of a piece is the beginning of the next one, to the bit
                if node > 0:
                    k, end = int(sa), min(int(sb), last)
                    a, b = rows[k] - zero, rows[end] - zero
                    dx, dy = x - curve[end, 0], y - curve[end, 4]
                    away = np.sqrt(dx * dx + dy * dy)
                    gb = away - curve[end, 8]
                    slowest, fastest = _node_rates(base + node, dx, dy, away, b - a, tree)
                else:
                    k = -node
                    end, h = k + 1, rows[k + 1] - rows[k]
                    a, b = rows[k] - zero + sa * h, rows[k] - zero + sb * h
                    if sb == 1.0:
                        b, gb = rows[k + 1] - zero, _at_row(x, y, k + 1, curve)
                    else:
                        gb = distance_at(x, y, b, k, zero, rows, inverse, curve)[0]
                    slowest, fastest = _part_rates(x, y, sa, sb, k, h, curve)
                on, off = state[y, x, ON], state[y, x, OFF]
                if slowest < 0.0 < fastest and (fastest - slowest) * (b - a) > _DONE_PX:
                    if depth > 156 or not may_reach(
                        ga, gb, slowest, fastest, b - a, on, off, reach
                    ):
                        ga = gb
                    elif node > 0 and end - k > 1:
                        half = k + (int(sb) - k) // 2
                        if half < end:
                            stack[depth, 0], stack[depth, 1] = 2 * node + 1, half
                            depth += 1
                        stack[depth, 0], stack[depth, 1], stack[depth, 2] = 2 * node, k, half
                        depth += 1
                    else:
                        low, high = (0.0, 1.0) if node > 0 else (sa, sb)
                        middle = 0.5 * (low + high)
                        stack[depth, 0], stack[depth, 1], stack[depth, 2] = -k, middle, high
                        depth += 1
                        stack[depth, 0], stack[depth, 1], stack[depth, 2] = -k, low, middle
                        depth += 1
                    continue
                falling = gb < ga
                target = on if falling else off
                # a pixel that is out of this disc's reach may be another one's
                if (target < gb) if falling else (target > gb or ga >= reach):
                    ga = gb
                    continue
                rise, step, level = gb - ga, threshold[y, x], state[y, x, LEVEL]
                # on a monotone piece time is a function of distance; a cubic through both ends is
                # the first guess, after which a smooth path needs one step of Newton's method
                _, slope_a, away_a = distance_at(x, y, a, k, zero, rows, inverse, curve)
                _, slope_b, away_b = distance_at(x, y, b, end - 1, zero, rows, inverse, curve)
                scale_a = rise * away_a / slope_a if slope_a * rise > 0.0 else b - a
                scale_b = rise * away_b / slope_b if slope_b * rise > 0.0 else b - a
                begun = a
                while (target >= gb) if falling else (target <= gb):
                    t = begun
                    if (target < ga) if falling else (target > ga):
                        s = (target - ga) / rise
                        u = 1.0 - s
                        t = a + s * (
                            s * (3.0 - 2.0 * s) * (b - a) + u * (u * scale_a - s * scale_b)
                        )
                        low, high = begun, b
                        t = min(max(t, low), high)
                        for _ in range(100):
                            k = step_at(t, zero, rows, k)
                            value, slope, away = distance_at(x, y, t, k, zero, rows, inverse, curve)
                            miss = value - target
                            if (miss > 0.0) == falling:
                                low = t
                            else:
                                high = t
                            before, t = t, t - miss * away / slope
                            # also where the slope is 0 and t is no number
                            if not low <= t <= high:
                                t = 0.5 * (low + high)
                                if high - low < 1e-9 * length:
                                    break
                            elif abs(t - before) < _NEWTON * length:
                                break
                    if falling:
                        level += step
                        state[y, x, OFF], state[y, x, LAST] = state[y, x, LAST], target
                        target = rim_of(level + step, contrast, edge)
                        state[y, x, ON] = target
                    else:
                        level -= step
                        state[y, x, ON], state[y, x, LAST] = state[y, x, LAST], target
                        target = rim_of(level - step, contrast, edge)
                        state[y, x, OFF] = target
                    out[n] = ((start + np.int64(t)) << 25) | code | np.int64(falling)
                    n += 1
                    begun = t
                state[y, x, LEVEL] = level
                ga = gb
            ga = final
        gaps[index] = ga
    return n
