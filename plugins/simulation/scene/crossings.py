"""Crossings of one pixel's next thresholds by the rim of a moving disc, however the disc moves.

For pixels whose distance is not known to be monotone on a whole segment; `pixels` has the others.

g(t) = |x - c(t)| - r(t) is the pixel's distance from the rim. Every root is searched on a part
of time on which g is proven to be monotone: its rate lies between bounds from the control points
of the path's derivative (a Bezier curve stays in their hull) and from how far the direction to
the pixel can turn. Where the sign of the rate is not certain, the same bounds say how far g may
lie beyond both ends of the part; if that reaches no threshold the part is done, else it is
halved. So a reversal is found however short it is, and a tangent pixel has two crossings or none.
"""

from __future__ import annotations

import numpy as np

from sliplab.plugins.simulation.scene.edges import CUT, rim_of
from sliplab.storage.kernels import njit
from sliplab.storage.streams import F64, I64

_DONE_PX = 1e-10


@njit(cache=True, nogil=True, error_model="numpy")
def step_at(t: float, since: F64, until: F64, guess: int) -> int:
    """The step of the path that holds the time `t` of its block, searched from `guess` on."""
    k = guess
    while t > until[k]:
        k += 1
    while t < since[k]:
        k -= 1
    return k


@njit(cache=True, nogil=True, error_model="numpy")
def distance_at(
    x: float, y: float, t: float, k: int, since: F64, inverse: F64, curve: F64
) -> tuple[float, float, float]:
    """Distance of a pixel from the rim at a time `t` of its block, in step k, px, and its rate.

    Returns:
        the distance, and the rate as a product of two: the rate times the distance from the
        centre, and that distance (so that the caller may avoid the division).
    """
    tau = t - since[k]
    s = tau * inverse[k]
    dx = x - (curve[0, k] + tau * (curve[1, k] + s * (curve[2, k] + s * curve[3, k])))
    dy = y - (curve[4, k] + tau * (curve[5, k] + s * (curve[6, k] + s * curve[7, k])))
    r = curve[8, k] + tau * (curve[9, k] + s * (curve[10, k] + s * curve[11, k]))
    vx = curve[1, k] + s * (2.0 * curve[2, k] + 3.0 * s * curve[3, k])
    vy = curve[5, k] + s * (2.0 * curve[6, k] + 3.0 * s * curve[7, k])
    growth = curve[9, k] + s * (2.0 * curve[10, k] + 3.0 * s * curve[11, k])
    away = np.sqrt(dx * dx + dy * dy)
    return away - r, -(dx * vx + dy * vy) - growth * away, away


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def turning(share: float) -> float:
    """Bound the turn of a unit vector whose end moves by a `share` of its distance.

    |u - u'| <= 2 |e - e'| / (|e| + |e'|) (Dunkl and Williams 1964), and never above 2.
    """
    return 1.34 * share if share <= 0.5 else 2.0


@njit(cache=True, nogil=True, error_model="numpy")
def may_reach(
    ga: float,
    gb: float,
    slowest: float,
    fastest: float,
    length: float,
    on: float,
    off: float,
    reach: float,
) -> bool:
    """Return whether a distance from ga to gb in `length` ns can meet a threshold in between.

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
def _at_row(x: float, y: float, k: int, curve: F64) -> float:
    """Distance of a pixel from the rim at row k, px."""
    dx, dy = x - curve[0, k], y - curve[4, k]
    return np.sqrt(dx * dx + dy * dy) - curve[8, k]


@njit(cache=True, nogil=True, error_model="numpy")
def _node_rates(
    node: int, dx: float, dy: float, away: float, length: float, tree: F64
) -> tuple[float, float]:
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
def _part_rates(
    x: float, y: float, sa: float, sb: float, k: int, h: float, curve: F64
) -> tuple[float, float]:
    """Bounds of the distance's rate on the part sa to sb of step k.

    The control points of the part of a quadratic Bezier curve are its blossom at (sa, sa),
    (sa, sb) and (sb, sb).
    """
    tau = sa * h
    dx = x - (curve[0, k] + tau * (curve[1, k] + sa * (curve[2, k] + sa * curve[3, k])))
    dy = y - (curve[4, k] + tau * (curve[5, k] + sa * (curve[6, k] + sa * curve[7, k])))
    away = np.sqrt(dx * dx + dy * dy)
    inverse = 1.0 / away if away > 0.0 else 0.0
    ux, uy = dx * inverse, dy * inverse
    low, high, speed = np.inf, -np.inf, 0.0
    for p, q in ((sa, sa), (sa, sb), (sb, sb)):
        vx = curve[1, k] + (p + q) * curve[2, k] + 3.0 * p * q * curve[3, k]
        vy = curve[5, k] + (p + q) * curve[6, k] + 3.0 * p * q * curve[7, k]
        growth = curve[9, k] + (p + q) * curve[10, k] + 3.0 * p * q * curve[11, k]
        rate = -(ux * vx + uy * vy) - growth
        low, high = min(low, rate), max(high, rate)
        speed = max(speed, np.sqrt(vx * vx + vy * vy))
    turn = (turning(speed * (sb - sa) * h * inverse) if away > 0.0 else 2.0) * speed
    return low - turn, high + turn


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def time_between(s: float, length: float, scale_a: float, scale_b: float) -> float:
    """Time, ns, at a share `s` of the distance that a monotone segment covers in `length` ns.

    The cubic through both ends; `scale_a`, `scale_b`: its slopes there, ns.
    """
    u = 1.0 - s
    return s * (s * (3.0 - 2.0 * s) * length + u * (u * scale_a - s * scale_b))


@njit(cache=True, nogil=True, error_model="numpy")
def solve(
    x: float,
    y: float,
    target: float,
    falling: bool,
    low: float,
    high: float,
    t: float,
    k: int,
    fine: float,
    since: F64,
    until: F64,
    inverse: F64,
    curve: F64,
) -> float:
    """Find when a distance that falls (or rises) is `target`, between the times `low` and `high`.

    Args:
        t, k: a first guess, ns after the block's begin, and a step near it.
        fine: how long a step of Newton's method may be after which a time is good, ns.
    """
    for _ in range(100):
        k = step_at(t, since, until, k)
        value, slope, away = distance_at(x, y, t, k, since, inverse, curve)
        miss = value - target
        if (miss > 0.0) == falling:
            low = t
        else:
            high = t
        before, t = t, t - miss * away / slope
        # also where the slope is 0 and t is no number
        if not low <= t <= high:
            t = 0.5 * (low + high)
            if high - low < 1e-5 * fine:
                break
        elif abs(t - before) < fine:
            break
    return t


@njit(cache=True, nogil=True, error_model="numpy")
def events_of_segment(
    x: float,
    y: float,
    on: float,
    off: float,
    last_one: float,
    level: float,
    step: float,
    ga: float,
    segment: np.record,
    base: int,
    begin: int,
    final: int,
    since: F64,
    until: F64,
    inverse: F64,
    curve: F64,
    tree: F64,
    contrast: float,
    edge: float,
    head: int,
    stack: F64,
    out: I64,
    n: int,
) -> tuple[float, float, float, float, int]:
    """Events of one pixel on a segment of a block, for any course of its distance.

    Args:
        on, off, last_one, level: the pixel's state, see `edges`; step: its threshold.
        ga: its distance at the begin.
        segment: see `marker_path.SEGMENT`.
        base, begin, final: where the tree of the block begins; the block's first and last row.
        since, until, inverse, curve: see `marker_path.cut_block` and `fit_blocks`.
        tree: of `marker_path.bound_rates`.
        head: packed event at the begin of the block.
        stack: scratch, (160, 3).
        out: packed events, written from `n` on.

    Returns:
        the pixel's state, and how many events `out` holds now.
    """
    reach = CUT * edge
    last, node, size = segment.k1, segment.node, 1
    while size < final - begin:
        size *= 2
    while node > 1:
        node, size = node // 2, size // 2
    # parts yet to be done, the next one on top: a node of the tree with its steps, or, with a
    # number not above 0, a step with the part of it from sa to sb
    stack[0, 0], stack[0, 1], stack[0, 2] = (
        segment.node,
        segment.k0,
        segment.k0 + size,
    )
    depth = 1
    while depth > 0:
        depth -= 1
        node = int(stack[depth, 0])
        sa, sb = stack[depth, 1], stack[depth, 2]
        # the end of a part is the beginning of the next one, to the bit
        if node > 0:
            k, end = int(sa), min(int(sb), last)
            a, b = since[k], until[end - 1]
            dx, dy = x - curve[0, end], y - curve[4, end]
            away = np.sqrt(dx * dx + dy * dy)
            gb = away - curve[8, end]
            slowest, fastest = _node_rates(base + node, dx, dy, away, b - a, tree)
        else:
            k = -node
            end, h = k + 1, until[k] - since[k]
            a, b = since[k] + sa * h, since[k] + sb * h
            if sb == 1.0:
                b, gb = until[k], _at_row(x, y, k + 1, curve)
            else:
                gb = distance_at(x, y, b, k, since, inverse, curve)[0]
            slowest, fastest = _part_rates(x, y, sa, sb, k, h, curve)
        if slowest < 0.0 < fastest and (fastest - slowest) * (b - a) > _DONE_PX:
            if depth > 156 or not may_reach(ga, gb, slowest, fastest, b - a, on, off, reach):
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
        rise, begun = gb - ga, a
        # on a monotone part time is a function of distance; a cubic through both ends is the first
        # guess, after which a smooth path needs one step of Newton's method
        _, slope_a, away_a = distance_at(x, y, a, k, since, inverse, curve)
        _, slope_b, away_b = distance_at(x, y, b, end - 1, since, inverse, curve)
        scale_a = rise * away_a / slope_a if slope_a * rise > 0.0 else b - a
        scale_b = rise * away_b / slope_b if slope_b * rise > 0.0 else b - a
        while (target >= gb) if falling else (target <= gb):
            if (target < ga) if falling else (target > ga):
                s = (target - ga) / rise
                t = a + time_between(s, b - a, scale_a, scale_b)
                t = min(max(t, begun), b)
                begun = solve(
                    x,
                    y,
                    target,
                    falling,
                    begun,
                    b,
                    t,
                    k,
                    segment.fine,
                    since,
                    until,
                    inverse,
                    curve,
                )
            if falling:
                level += step
                off, last_one = last_one, target
                target = rim_of(level + step, contrast, edge)
                on = target
            else:
                level -= step
                on, last_one = last_one, target
                target = rim_of(level - step, contrast, edge)
                off = target
            out[n] = (head + (np.int64(begun) << 25)) | np.int64(falling)
            n += 1
        ga = gb
    return on, off, last_one, level, n
