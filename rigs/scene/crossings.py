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

from rigs.scene.agenda import slack_of
from rigs.scene.edges import CUT, LAST, LEVEL, OFF, ON, rim_of

_DONE_PX = 1e-10
_NEWTON = 1e-5  # of the piece: after a step as small as that the next error is below 1e-9


@njit(cache=True, nogil=True, error_model="numpy")
def step_at(t, rows, guess):  # type: ignore[no-untyped-def]
    """The step of the path that holds the time `t`, looked for from `guess` on."""
    last = rows.shape[0] - 2
    k = min(max(guess, 0), last)
    while k < last and t > rows[k + 1]:
        k += 1
    while k > 0 and t < rows[k]:
        k -= 1
    return k


@njit(cache=True, nogil=True, error_model="numpy")
def distance_at(x, y, t, k, rows, curve):  # type: ignore[no-untyped-def]
    """Distance of a pixel from the rim at time `t` in step `k`, px, and its rate, px/ns."""
    tau = t - rows[k]
    s = tau / (rows[k + 1] - rows[k])
    dx = x - (curve[0, 0, k] + tau * (curve[0, 1, k] + s * (curve[0, 2, k] + s * curve[0, 3, k])))
    dy = y - (curve[1, 0, k] + tau * (curve[1, 1, k] + s * (curve[1, 2, k] + s * curve[1, 3, k])))
    r = curve[2, 0, k] + tau * (curve[2, 1, k] + s * (curve[2, 2, k] + s * curve[2, 3, k]))
    vx = curve[0, 1, k] + s * (2.0 * curve[0, 2, k] + 3.0 * s * curve[0, 3, k])
    vy = curve[1, 1, k] + s * (2.0 * curve[1, 2, k] + 3.0 * s * curve[1, 3, k])
    growth = curve[2, 1, k] + s * (2.0 * curve[2, 2, k] + 3.0 * s * curve[2, 3, k])
    away = np.sqrt(dx * dx + dy * dy)
    closing = (dx * vx + dy * vy) / away if away > 0.0 else np.sqrt(vx * vx + vy * vy)
    return away - r, -closing - growth


@njit(cache=True, nogil=True, error_model="numpy")
def _root(x, y, target, low, high, guess, falling, rows, curve):  # type: ignore[no-untyped-def]
    """Time in [low, high] at which the monotone distance meets `target`: bracketed Newton."""
    t = min(max(guess, low), high)
    length = rows[rows.shape[0] - 1]
    close = _NEWTON * length
    k = step_at(t, rows, int(t / length * (rows.shape[0] - 1)))
    for _ in range(100):
        value, rate = distance_at(x, y, t, k, rows, curve)
        miss = value - target
        if (miss > 0.0) == falling:
            low = t
        else:
            high = t
        before, t = t, t - miss / rate
        # also where the rate is 0 and t is no number
        if not low <= t <= high:
            t = 0.5 * (low + high)
            if high - low < 1e-9 * length:
                break
        elif abs(t - before) < close:
            break
        k = step_at(t, rows, k)
    return t


@njit(cache=True, nogil=True, error_model="numpy")
def monotone_events(  # type: ignore[no-untyped-def]
    x, y, a, b, ga, gb, rate_a, rate_b, rows, curve, state, step, contrast, edge, origin, code,
    out, n,
):  # fmt: skip
    """Events of a pixel between the times a and b, on which its distance goes from ga to gb.

    The first guess of each time is the cubic through both ends in which time is a function of
    distance; on a smooth path a single Newton step then does.

    Args:
        rate_a, rate_b: rates of the distance at both ends, px/ns; 0 where they are not known.
        state: of this pixel, written.
        step: its threshold.
        code: what stands below the time (ns after `origin`) in a packed event; see `sorting`.

    Returns:
        how many events `out` holds now.
    """
    falling = gb < ga
    rise = gb - ga
    scale_a = rise / rate_a if rate_a * rise > 0.0 else b - a
    scale_b = rise / rate_b if rate_b * rise > 0.0 else b - a
    low = a
    # a pixel that is out of this disc's reach may be another one's
    allowed = falling or ga < CUT * edge
    target = state[y, x, ON] if falling else state[y, x, OFF]
    while allowed and (target >= gb if falling else target <= gb):
        at = low
        if (target < ga) if falling else (target > ga):
            s = (target - ga) / rise
            u = 1.0 - s
            guess = a + s * (s * (3.0 - 2.0 * s) * (b - a) + u * (u * scale_a - s * scale_b))
            at = _root(x, y, target, low, b, guess, falling, rows, curve)
        if falling:
            state[y, x, LEVEL] += step
            state[y, x, OFF], state[y, x, LAST] = state[y, x, LAST], target
            next_target = rim_of(state[y, x, LEVEL] + step, contrast, edge)
            state[y, x, ON] = next_target
        else:
            state[y, x, LEVEL] -= step
            state[y, x, ON], state[y, x, LAST] = state[y, x, LAST], target
            next_target = rim_of(state[y, x, LEVEL] - step, contrast, edge)
            state[y, x, OFF] = next_target
        target = next_target
        out[n] = (np.int64(at + origin) << 25) | code | np.int64(falling)
        n += 1
        low = at
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def turning(turn_px, away):  # type: ignore[no-untyped-def]
    """How far a unit vector may turn whose end, `away` px off, moves by `turn_px`.

    |u - u'| <= 2 |e - e'| / (|e| + |e'|) (Dunkl and Williams 1964), and never above 2.
    """
    share = turn_px / away if away > 0.0 else 1.0
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
def events_of_pixels(  # type: ignore[no-untyped-def]
    pixels, count, rows, curve, size, tree, threshold, contrast, edge, origin, stack, parts, state,
    slack, out, n,
):  # fmt: skip
    """Events of pixels over a whole block, however their distances go; see the module's text.

    Args:
        pixels: column << 12 | row, the first `count` of them.
        rows: times of the block's rows, ns after its begin, (m,).
        curve: column, row and radius between them, (3, 4, m); see `marker_path.fit_curve`.
        size, tree: bounds of the rates; see `marker_path.join_rates`.
        threshold, state: of all pixels, (height, width) and (height, width, 4); written.
        origin: ns to add to every time.
        stack, parts: scratch, (64, 3) of integers and (128, 2).
        slack: px that the marker may move before each pixel can fire again; written.
        out: packed events, written from `n` on.

    Returns:
        how many events `out` holds now.
    """
    last = rows.shape[0] - 1
    reach = CUT * edge
    for index in range(count):
        x, y = pixels[index] >> 12, pixels[index] & 4095
        code = np.int64(x) << 13 | np.int64(y) << 1
        step = threshold[y, x]
        ga = _at_row(x, y, 0, curve)
        stack[0, 0], stack[0, 1], stack[0, 2] = 1, 0, size
        depth = 1
        while depth > 0:
            depth -= 1
            node, begin, end = stack[depth, 0], stack[depth, 1], min(stack[depth, 2], last)
            length = rows[end] - rows[begin]
            # the end of a piece is the beginning of the next one, to the bit
            dx, dy = x - curve[0, 0, end], y - curve[1, 0, end]
            away = np.sqrt(dx * dx + dy * dy)
            gb = away - curve[2, 0, end]
            inverse = 1.0 / away if away > 0.0 else 0.0
            slowest, fastest = _node_rates(node, dx * inverse, dy * inverse, away, length, tree)
            on, off = state[y, x, ON], state[y, x, OFF]
            if slowest >= 0.0 or fastest <= 0.0:
                if on >= gb or (off <= gb and ga < reach):
                    rate_a = distance_at(x, y, rows[begin], begin, rows, curve)[1]
                    rate_b = distance_at(x, y, rows[end], end - 1, rows, curve)[1]
                    n = monotone_events(
                        x, y, rows[begin], rows[end], ga, gb, rate_a, rate_b, rows, curve, state,
                        step, contrast, edge, origin, code, out, n,
                    )  # fmt: skip
            elif may_reach(ga, gb, slowest, fastest, length, on, off, reach):
                if end - begin > 1:
                    half = begin + (stack[depth, 2] - begin) // 2
                    if half < end:
                        stack[depth, 0], stack[depth, 1] = 2 * node + 1, half
                        depth += 1
                    stack[depth, 0], stack[depth, 1], stack[depth, 2] = 2 * node, begin, half
                    depth += 1
                    continue
                n = _events_in_step(
                    x, y, begin, ga, gb, rows, curve, state, step, contrast, edge, origin, code,
                    parts, out, n,
                )  # fmt: skip
            ga = gb
        slack[index] = slack_of(ga, state[y, x, ON], state[y, x, OFF], reach)
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def _at_row(x, y, k, curve):  # type: ignore[no-untyped-def]
    """Distance of a pixel from the rim at row k, px."""
    dx, dy = x - curve[0, 0, k], y - curve[1, 0, k]
    return np.sqrt(dx * dx + dy * dy) - curve[2, 0, k]


@njit(cache=True, nogil=True, error_model="numpy")
def _node_rates(node, ux, uy, away, length, tree):  # type: ignore[no-untyped-def]
    """Bounds of the distance's rate over the steps of a node; (ux, uy): direction at its end."""
    low_x, high_x, low_y, high_y = tree[0, node], tree[3, node], tree[1, node], tree[4, node]
    half_x, half_y = 0.5 * (high_x - low_x), 0.5 * (high_y - low_y)
    middle_x, middle_y = low_x + half_x, low_y + half_y
    middle = -(ux * middle_x + uy * middle_y)
    half = abs(ux) * half_x + abs(uy) * half_y
    fast_x, fast_y = abs(middle_x) + half_x, abs(middle_y) + half_y
    speed = np.sqrt(fast_x * fast_x + fast_y * fast_y)
    half += turning(speed * length, away) * speed
    return middle - half - tree[5, node], middle + half - tree[2, node]


@njit(cache=True, nogil=True, error_model="numpy")
def _events_in_step(  # type: ignore[no-untyped-def]
    x, y, k, first, final, rows, curve, state, step, contrast, edge, origin, code, parts, out, n
):
    """Events of a pixel in step k, on which its distance goes from `first` to `final`, by halves."""
    h = rows[k + 1] - rows[k]
    ga = first
    parts[0, 0], parts[0, 1] = 0.0, 1.0
    depth = 1
    while depth > 0:
        depth -= 1
        sa, sb = parts[depth, 0], parts[depth, 1]
        a, b, length = rows[k] + sa * h, rows[k] + sb * h, (sb - sa) * h
        gb = distance_at(x, y, b, k, rows, curve)[0]
        if sb == 1.0:
            b, gb = rows[k + 1], final
        slowest, fastest = _rates(x, y, sa, sb, length, k, h, curve)
        whole = (fastest - slowest) * length < _DONE_PX or depth > 120
        if whole or slowest >= 0.0 or fastest <= 0.0:
            n = monotone_events(
                x, y, a, b, ga, gb, 0.0, 0.0, rows, curve, state, step, contrast, edge, origin,
                code, out, n,
            )  # fmt: skip
        elif may_reach(ga, gb, slowest, fastest, length, state[y, x, ON], state[y, x, OFF], CUT * edge):
            half = 0.5 * (sa + sb)
            parts[depth, 0], parts[depth, 1] = half, sb
            parts[depth + 1, 0], parts[depth + 1, 1] = sa, half
            depth += 2
            continue
        ga = gb
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def _rates(x, y, sa, sb, length, k, h, curve):  # type: ignore[no-untyped-def]
    """Bounds of the distance's rate on the part sa to sb of step k.

    The control points of the part of a quadratic Bezier curve are its blossom at (sa, sa),
    (sa, sb) and (sb, sb).
    """
    tau = sa * h
    dx = x - (curve[0, 0, k] + tau * (curve[0, 1, k] + sa * (curve[0, 2, k] + sa * curve[0, 3, k])))
    dy = y - (curve[1, 0, k] + tau * (curve[1, 1, k] + sa * (curve[1, 2, k] + sa * curve[1, 3, k])))
    away = np.sqrt(dx * dx + dy * dy)
    inverse = 1.0 / away if away > 0.0 else 0.0
    ux, uy = dx * inverse, dy * inverse
    low, high, speed = np.inf, -np.inf, 0.0
    for p, q in ((sa, sa), (sa, sb), (sb, sb)):
        vx = curve[0, 1, k] + (p + q) * curve[0, 2, k] + 3.0 * p * q * curve[0, 3, k]
        vy = curve[1, 1, k] + (p + q) * curve[1, 2, k] + 3.0 * p * q * curve[1, 3, k]
        growth = curve[2, 1, k] + (p + q) * curve[2, 2, k] + 3.0 * p * q * curve[2, 3, k]
        rate = -(ux * vx + uy * vy) - growth
        low, high = min(low, rate), max(high, rate)
        speed = max(speed, np.sqrt(vx * vx + vy * vy))
    turn = turning(speed * length, away) * speed
    return low - turn, high + turn
