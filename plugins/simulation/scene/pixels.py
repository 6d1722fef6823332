"""Events of many pixels at once: which meet thresholds on a segment of a marker's path, and when.

One pixel's events depend on each other; those of many do not, and where their numbers are adjacent
in memory a compiler processes four or eight of them at a time. So all data of a pixel are in a
tile, one field after the other with a lane for each pixel, and are processed in loops without
branches. Fields are constant distances apart, which is how the compiler knows that lanes do not
touch each other.

A tile of pixels goes through all segments of a path. Those of its pixels that fire on a segment are
gathered in a tile of roots, one threshold after the other. On a monotone segment time is a function
of distance. A cubic through both ends is the first guess; then one step of Chebyshev's method,
which is Newton's with the curvature, is nearly always enough. What is not good enough yet waits in
a second tile for more of them. What is not monotone, and what never gets good, is left to
`crossings`, one pixel at a time.

The result on a segment depends on the rows of its block alone, to the bit, and pixels do not
wait for each other, so neither the cut of a trial into calls nor the order of pixels matters.
"""

from __future__ import annotations

import numpy as np

from sliplab.plugins.simulation.scene.branchless import logarithm
from sliplab.plugins.simulation.scene.crossings import (
    events_of_segment,
    solve,
    time_between,
    turning,
)
from sliplab.plugins.simulation.scene.edges import CUT, FAR, LAST, LEVEL, OFF, ON, TAIL
from sliplab.plugins.simulation.scene.marker_path import (
    Segment,
    Segments,
    bound_rates,
)
from sliplab.storage.kernels import njit
from sliplab.storage.streams import F64, I64

LANES = 256
STRIDE = LANES + 8
"""From one field to the next; a bit more than there are lanes, so that fields do not all compete
for the same sets of the cache."""
(
    P_X,
    P_Y,
    P_ON,
    P_OFF,
    P_LAST,
    P_LEVEL,
    P_STEP,
    P_BEGIN,
    P_END,
    P_KIND,
    P_CODE,
) = (STRIDE * k for k in range(11))
"""Fields of a tile of pixels: column and row; as in `edges`, four; the threshold; distance from the
rim at the begin and at the end of a segment, px; what happens on it; column and row in a packed
event."""
PIXEL_FIELDS = 11
NOTHING, COMES, GOES, DOUBT = 0.0, 1.0, 2.0, 3.0
"""Kinds: meets no threshold; falls monotonely to its positive one, rises to its negative one; may
meet any number."""
_DONE_PX = 1e-10


@njit(cache=True, nogil=True, error_model="numpy")
def place_pixels(tile: F64, n: int, column: float, row: float, radius: float) -> None:
    """Distances from the rim at the begin of the first segment."""
    for j in range(n):
        dx, dy = tile[P_X + j] - column, tile[P_Y + j] - row
        tile[P_END + j] = np.sqrt(dx * dx + dy * dy) - radius


@njit(cache=True, nogil=True, error_model="numpy")
def classify(tile: F64, n: int, segment: Segment, reach: float) -> None:
    """Classify what each of n pixels does on a segment.

    Args:
        reach: distance from the rim beyond which a pixel may be another disc's, px.
    """
    x1, y1, r1, stray = segment.x1, segment.y1, segment.r1, segment.stray
    half_x, half_y = 0.5 * (segment.x0 - x1), 0.5 * (segment.y0 - y1)
    mean_x, mean_y, mean_r = segment.mx, segment.my, segment.mr
    apart, speed, length = (
        segment.deviation,
        segment.speed,
        segment.end - segment.begin,
    )
    # no point of the path is farther from the middle of its ends than half its length
    half_path = 0.5 * speed * length
    for j in range(n):
        dx, dy = tile[P_X + j] - x1, tile[P_Y + j] - y1
        away = np.sqrt(dx * dx + dy * dy)
        begin, end = tile[P_END + j], away - r1
        on, off = tile[P_ON + j], tile[P_OFF + j]
        dx, dy = dx - half_x, dy - half_y
        inverse = 1.0 / max(np.sqrt(dx * dx + dy * dy), 1e-3)
        mean = -(dx * mean_x + dy * mean_y) * inverse - mean_r
        share = half_path * inverse
        spread = apart + turning(share) * speed
        slowest, fastest = mean - spread, mean + spread
        turns = (slowest < 0.0) & (fastest > 0.0) & (2.0 * spread * length > _DONE_PX)
        # as `crossings.may_reach`, without its division
        width, product = 2.0 * spread, slowest * fastest * length
        least = begin * fastest - end * slowest + product
        most = end * fastest - begin * slowest - product
        reaches = (least <= on * width) | ((most >= off * width) & (least < reach * width))
        falls = end < begin
        meets = (on >= end) if falls else ((off <= end) & (begin < reach))
        sure = (COMES if falls else GOES) if meets else NOTHING
        kind = (DOUBT if reaches else NOTHING) if turns else sure
        near = (min(begin, end) - stray <= on) | (max(begin, end) + stray >= off)
        tile[P_KIND + j] = kind if near else NOTHING
        tile[P_BEGIN + j], tile[P_END + j] = begin, end


(
    R_X,
    R_Y,
    R_TARGET,
    R_TIME,
    R_LOW,
    R_HIGH,
    R_FINE,
    R_HEAD,
    R_STEP,
    R_GOOD,
    R_SINCE,
    R_INVERSE,
) = (STRIDE * k for k in range(12))
"""Of every root: column and row; the rim distance that is met; when, ns after the block's begin,
and the limits of that; how long a step of the search may be after which it is good; a packed event
at the block's begin (52 bits, which a float64 holds); the step of the path; whether the time is
good; when that step begins and one over its length."""
R_C = 12 * STRIDE
"""First of the step's twelve coefficients."""
WAIT_FIELDS = 24
STEP_FIELDS = 14
(
    R_BEGIN,
    R_END,
    R_LAST,
    R_LEVEL,
    R_RISE,
    R_LANE,
    R_SCALE_A,
    R_SCALE_B,
    R_NEXT,
) = (STRIDE * k for k in range(24, 33))
"""Of every pixel that fires: distances at both ends of the segment; rim distance of the last event
before; reference level; what an event adds to it; lane in the pixels' tile; slopes of time over
distance at both ends; rim distance of the next event."""
FIRE_FIELDS = 33
_ROUNDS = 6
_TICK = float(1 << 25)  # a nanosecond in a packed event


@njit(cache=True, nogil=True, error_model="numpy")
def begin_segment(fire: F64, n: int, segment: Segment) -> None:
    """Set up the values common to all thresholds: limits, and slopes at both ends."""
    a, b = segment.begin, segment.end
    for j in range(n):
        fire[R_LOW + j], fire[R_HIGH + j], fire[R_FINE + j] = a, b, segment.fine
    x0, y0, r0 = segment.x0, segment.y0, segment.r0
    x1, y1, r1 = segment.x1, segment.y1, segment.r1
    vx0, vy0, vr0 = segment.vx0, segment.vy0, segment.vr0
    vx1, vy1, vr1 = segment.vx1, segment.vy1, segment.vr1
    for j in range(n):
        x, y, begin, end = (
            fire[R_X + j],
            fire[R_Y + j],
            fire[R_BEGIN + j],
            fire[R_END + j],
        )
        rise = end - begin
        away = begin + r0
        slope = -((x - x0) * vx0 + (y - y0) * vy0) - vr0 * away
        fire[R_SCALE_A + j] = rise * away / slope if slope * rise > 0.0 else b - a
        away = end + r1
        slope = -((x - x1) * vx1 + (y - y1) * vy1) - vr1 * away
        fire[R_SCALE_B + j] = rise * away / slope if slope * rise > 0.0 else b - a


@njit(cache=True, nogil=True, error_model="numpy")
def guess(fire: F64, n: int, segment: Segment, pace: float) -> None:
    """First guesses of time, and of the step in which it lies.

    Args:
        pace: one over the length of the segment's first step, 1/ns.
    """
    a, b, k0 = segment.begin, segment.end, segment.k0
    length, final = b - a, segment.k1 - 1.0
    for j in range(n):
        s = (fire[R_TARGET + j] - fire[R_BEGIN + j]) / (fire[R_END + j] - fire[R_BEGIN + j])
        # a target that was met before the segment, by rounding, is met at its begin
        s = s if s > 0.0 else 0.0
        t = a + time_between(s, length, fire[R_SCALE_A + j], fire[R_SCALE_B + j])
        t = min(max(t, a), b)
        fire[R_TIME + j] = t
        fire[R_STEP + j] = np.floor(min(k0 + (t - a) * pace, final))


@njit(cache=True, nogil=True, error_model="numpy")
def next_thresholds(fire: F64, n: int, contrast: float, edge: float) -> None:
    """After an event at TARGET: the new reference level, and the rim distance of the next event.

    As `edges.rim_of`, with a logarithm that has no branches.
    """
    rounding = 1e-9 * contrast
    scale = (1.0 - 2.0 * TAIL) / contrast
    for j in range(n):
        level = fire[R_LEVEL + j] + fire[R_RISE + j]
        fire[R_LEVEL + j] = level
        level += fire[R_RISE + j]
        share = TAIL + min(max(level, 0.0), contrast) * scale
        log = logarithm((1.0 - share) / share)
        low = CUT * edge if level >= -rounding else FAR
        high = -CUT * edge if level <= contrast + rounding else -FAR
        rim = edge * log
        rim = high if level >= contrast - rounding else rim
        fire[R_NEXT + j] = low if level <= rounding else rim


@njit(cache=True, nogil=True, error_model="numpy")
def pack_steps(n: int, since: F64, inverse: F64, curve: F64, steps: F64) -> None:
    """Pack what `fetch` needs of each step: `steps` (r, STEP_FIELDS), written."""
    for k in range(n):
        steps[k, 0], steps[k, 1] = since[k], inverse[k]
        for c in range(12):
            steps[k, 2 + c] = curve[c, k]


@njit(cache=True, nogil=True, error_model="numpy")
def fetch(roots: F64, n: int, since: F64, until: F64, steps: F64) -> None:
    """Find the step in which each time lies, and fetch its coefficients."""
    for j in range(n):
        k, t = np.uint64(roots[R_STEP + j]), roots[R_TIME + j]
        while t > until[k]:
            k += np.uint64(1)
        while t < since[k]:
            k -= np.uint64(1)
        roots[R_STEP + j] = k
        for c in range(STEP_FIELDS):
            roots[R_SINCE + STRIDE * c + j] = steps[k, c]


@njit(cache=True, nogil=True, error_model="numpy")
def refine(roots: F64, n: int) -> None:
    """One step of Chebyshev's method; the packed event replaces SINCE."""
    for j in range(n):
        t, target = roots[R_TIME + j], roots[R_TARGET + j]
        inverse = roots[R_INVERSE + j]
        tau = t - roots[R_SINCE + j]
        s = tau * inverse
        b, c, d = (
            roots[R_C + STRIDE + j],
            roots[R_C + 2 * STRIDE + j],
            roots[R_C + 3 * STRIDE + j],
        )
        dx = roots[R_X + j] - (roots[R_C + j] + tau * (b + s * (c + s * d)))
        vx = b + s * (2.0 * c + 3.0 * s * d)
        ax = 2.0 * c + 6.0 * s * d
        b, c, d = (
            roots[R_C + 5 * STRIDE + j],
            roots[R_C + 6 * STRIDE + j],
            roots[R_C + 7 * STRIDE + j],
        )
        dy = roots[R_Y + j] - (roots[R_C + 4 * STRIDE + j] + tau * (b + s * (c + s * d)))
        vy = b + s * (2.0 * c + 3.0 * s * d)
        ay = 2.0 * c + 6.0 * s * d
        b, c, d = (
            roots[R_C + 9 * STRIDE + j],
            roots[R_C + 10 * STRIDE + j],
            roots[R_C + 11 * STRIDE + j],
        )
        r = roots[R_C + 8 * STRIDE + j] + tau * (b + s * (c + s * d))
        vr = b + s * (2.0 * c + 3.0 * s * d)
        ar = 2.0 * c + 6.0 * s * d
        away = np.sqrt(dx * dx + dy * dy)
        per_away = 1.0 / away
        toward = (dx * vx + dy * vy) * per_away
        slope = -toward - vr
        per_slope = 1.0 / slope
        step = (target - (away - r)) * per_slope
        bend = (vx * vx + vy * vy - toward * toward) * per_away
        bend -= ((dx * ax + dy * ay) * per_away + ar) * inverse
        share = -0.5 * bend * per_slope * step
        low, high, fine = roots[R_LOW + j], roots[R_HIGH + j], roots[R_FINE + j]
        new = t + step * (1.0 + share)
        inside = (new - roots[R_SINCE + j]) * inverse
        # the next error is that of a cubic method; a longer step must not leave the path's step
        good = (share * share * abs(step) <= 3e-4 * fine) & (
            (abs(step) <= fine) | ((abs(step) <= 20.0 * fine) & (inside >= 0.0) & (inside <= 1.0))
        )
        new = new if new > low else low
        new = new if new < high else high
        roots[R_TIME + j] = new
        roots[R_GOOD + j] = 1.0 if good else 0.0
        roots[R_SINCE + j] = roots[R_HEAD + j] + np.floor(new) * _TICK


@njit(cache=True, nogil=True, error_model="numpy")
def finish(
    wait: F64,
    n: int,
    since: F64,
    until: F64,
    steps: F64,
    inverse: F64,
    curve: F64,
    out: I64,
    count: int,
) -> int:
    """More steps for the n roots that wait, until all of them are events.

    Returns:
        how many events `out` holds now.
    """
    for _ in range(_ROUNDS):
        fetch(wait, n, since, until, steps)
        refine(wait, n)
        left = 0
        for j in range(n):
            if wait[R_GOOD + j] > 0.0:
                out[count] = np.int64(wait[R_SINCE + j])
                count += 1
            else:
                move(wait, j, wait, left)
                left += 1
        n = left
        if n == 0:
            return count
    for j in range(n):
        t = solve(
            wait[R_X + j],
            wait[R_Y + j],
            wait[R_TARGET + j],
            np.int64(wait[R_HEAD + j]) & 1 > 0,
            wait[R_LOW + j],
            wait[R_HIGH + j],
            wait[R_TIME + j],
            np.int64(wait[R_STEP + j]),
            wait[R_FINE + j],
            since,
            until,
            inverse,
            curve,
        )
        out[count] = np.int64(wait[R_HEAD + j] + np.floor(t) * _TICK)
        count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def move(source: F64, j: int, target: F64, k: int) -> None:
    """Copy the root in lane j of `source` to lane k of `target`."""
    for field in range(9):
        target[STRIDE * field + k] = source[STRIDE * field + j]


@njit(cache=True, nogil=True, error_model="numpy")
def events_of_pixels(
    pixels: I64,
    count: int,
    segments: Segments,
    first: I64,
    since: F64,
    until: F64,
    inverse: F64,
    curve: F64,
    steps: F64,
    tree: F64,
    threshold: F64,
    contrast: float,
    edge: float,
    origin: int,
    stack: F64,
    tile: F64,
    fire: F64,
    wait: F64,
    state: F64,
    gaps: F64,
    out: I64,
    n: int,
) -> int:
    """Events of pixels over some blocks.

    Args:
        pixels: column << 12 | row, the first `count` of them.
        segments: of the blocks, in order, see `marker_path.SEGMENT`.
        first: first row of each block, and the last row of all, (blocks + 1,).
        since, until: when each step begins and ends, ns after the begin of its block.
        inverse, curve: see `marker_path.fit_blocks`.
        steps: when each step begins, one over its length, and its coefficients, (r, 14).
        tree: scratch for `marker_path.bound_rates`; that of block b begins at 4 first[b].
        threshold, state: of all pixels, (height, width) and (height, width, 4); written.
        origin: ns to add to every time.
        stack: scratch, (160, 3).
        tile, fire, wait: scratch, tiles of the fields above.
        gaps: distance of each pixel from the rim at the end, px; written.
        out: packed events as in `readout`, written from `n` on.

    Returns:
        how many events `out` holds now.
    """
    reach, amount = CUT * edge, segments.shape[0]
    waiting = np.int64(0)  # with a literal numba compiles what is called with it twice
    active = np.empty(LANES + 1, np.int64)
    for index in range(amount):
        # a tree's node 0, which it has no use for, says whether there is one
        tree[4 * first[segments[index].block], 0] = 0.0
    for at in range(0, count, LANES):
        size = min(count - at, LANES)
        for j in range(size):
            pixel = pixels[at + j]
            x, y = pixel >> 12, pixel & 4095
            tile[P_X + j], tile[P_Y + j] = x, y
            tile[P_ON + j], tile[P_OFF + j] = (
                state[y, x, ON],
                state[y, x, OFF],
            )
            tile[P_LAST + j] = state[y, x, LAST]
            tile[P_LEVEL + j] = state[y, x, LEVEL]
            tile[P_STEP + j] = threshold[y, x]
            tile[P_CODE + j] = x << 13 | y << 1
        place_pixels(tile, size, segments[0].x0, segments[0].y0, segments[0].r0)
        for number in range(amount):
            segment = segments[number]
            classify(tile, size, segment, reach)
            head = (segment.zero + origin) * float(1 << 25)
            firing = np.int64(0)
            busy = 0
            for j in range(size):
                active[busy] = j
                busy += tile[P_KIND + j] != NOTHING
            for index in range(busy):
                j = active[index]
                kind = tile[P_KIND + j]
                if kind == DOUBT:
                    block = segment.block
                    begin, final = first[block], first[block + 1]
                    if tree[4 * begin, 0] == 0.0:
                        bound_rates(curve, begin, final, 4 * begin, tree)
                        tree[4 * begin, 0] = 1.0
                    on, off, last, level, n = events_of_segment(
                        tile[P_X + j],
                        tile[P_Y + j],
                        tile[P_ON + j],
                        tile[P_OFF + j],
                        tile[P_LAST + j],
                        tile[P_LEVEL + j],
                        tile[P_STEP + j],
                        tile[P_BEGIN + j],
                        segment,
                        4 * begin,
                        begin,
                        final,
                        since,
                        until,
                        inverse,
                        curve,
                        tree,
                        contrast,
                        edge,
                        np.int64(head + tile[P_CODE + j]),
                        stack,
                        out,
                        n,
                    )
                    tile[P_ON + j], tile[P_OFF + j] = on, off
                    tile[P_LAST + j], tile[P_LEVEL + j] = last, level
                    continue
                falls = kind == COMES
                fire[R_X + firing] = tile[P_X + j]
                fire[R_Y + firing] = tile[P_Y + j]
                fire[R_BEGIN + firing] = tile[P_BEGIN + j]
                fire[R_END + firing] = tile[P_END + j]
                fire[R_TARGET + firing] = tile[(P_ON if falls else P_OFF) + j]
                fire[R_LAST + firing] = tile[P_LAST + j]
                fire[R_LEVEL + firing] = tile[P_LEVEL + j]
                step = tile[P_STEP + j]
                fire[R_RISE + firing] = step if falls else -step
                fire[R_HEAD + firing] = head + tile[P_CODE + j] + falls
                fire[R_LANE + firing] = j
                firing += 1
            if firing == 0:
                continue
            begin_segment(fire, firing, segment)
            pace = inverse[segment.k0]
            while firing > 0:
                guess(fire, firing, segment, pace)
                fetch(fire, firing, since, until, steps)
                refine(fire, firing)
                if waiting + firing > LANES:
                    n = finish(wait, waiting, since, until, steps, inverse, curve, out, n)
                    waiting = np.int64(0)
                for j in range(firing):
                    if fire[R_GOOD + j] > 0.0:
                        out[n] = np.int64(fire[R_SINCE + j])
                        n += 1
                    else:
                        move(fire, j, wait, waiting)
                        waiting += 1
                next_thresholds(fire, firing, contrast, edge)
                firing = settle(tile, fire, firing)
        for j in range(size):
            pixel = pixels[at + j]
            x, y = pixel >> 12, pixel & 4095
            state[y, x, ON], state[y, x, OFF] = (
                tile[P_ON + j],
                tile[P_OFF + j],
            )
            state[y, x, LAST] = tile[P_LAST + j]
            state[y, x, LEVEL] = tile[P_LEVEL + j]
            gaps[at + j] = tile[P_END + j]
    if waiting > 0:
        n = finish(wait, waiting, since, until, steps, inverse, curve, out, n)
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def settle(tile: F64, fire: F64, n: int) -> int:
    """After an event of each of n pixels: those that have another one go on, the others go back.

    Returns:
        how many go on.
    """
    left = 0
    for j in range(n):
        target, following = fire[R_TARGET + j], fire[R_NEXT + j]
        end, comes = fire[R_END + j], fire[R_RISE + j] > 0.0
        if (following >= end) if comes else (following <= end):
            for field in (
                R_X,
                R_Y,
                R_HEAD,
                R_BEGIN,
                R_END,
                R_LEVEL,
                R_RISE,
                R_LANE,
                R_SCALE_A,
                R_SCALE_B,
            ):
                fire[field + left] = fire[field + j]
            fire[R_LAST + left], fire[R_TARGET + left] = target, following
            left += 1
        else:
            lane = int(fire[R_LANE + j])
            before = fire[R_LAST + j]
            tile[P_ON + lane] = following if comes else before
            tile[P_OFF + lane] = before if comes else following
            tile[P_LAST + lane], tile[P_LEVEL + lane] = (
                target,
                fire[R_LEVEL + j],
            )
    return left
