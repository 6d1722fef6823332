"""Times at which pixels meet thresholds, for a tile of pixels at once.

On a monotone piece time is a function of distance. A cubic through both ends is the first guess;
then one step of Chebyshev's method, which is Newton's with the curvature, is nearly always enough.
What is not good enough yet waits in a second tile for more of them; what never gets good is left
to `crossings.solve`. Fields and lanes as in `pixel_lanes`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sliplab.rigs.scene import pieces as of
from sliplab.rigs.scene.crossings import solve
from sliplab.rigs.scene.edges import CUT, FAR, TAIL
from sliplab.rigs.scene.pixel_lanes import STRIDE
from sliplab.rigs.scene.smooth import logarithm

X, Y, TARGET, TIME, LOW, HIGH, FINE, HEAD, STEP, GOOD, SINCE, INVERSE = (
    STRIDE * k for k in range(12)
)
"""Of every root: column and row; the rim distance that is met; when, ns after the block's begin,
and the limits of that; how long a step of the search may be after which it is good; a packed event
at the block's begin (52 bits, which a float64 holds); the step of the path; whether the time is
good; when that step begins and one over its length."""
C = 12 * STRIDE
"""First of the step's twelve coefficients."""
WAIT_FIELDS = 24
STEP_FIELDS = 14
BEGIN, END, LAST, LEVEL, RISE, LANE, SCALE_A, SCALE_B, NEXT = (STRIDE * k for k in range(24, 33))
"""Of every pixel that fires: distances at both ends of the piece; rim distance of the last event
before; reference level; what an event adds to it; lane in the pixels' tile; slopes of time over
distance at both ends; rim distance of the next event."""
FIRE_FIELDS = 33
_ROUNDS = 6
_TICK = float(1 << 25)  # a nanosecond in a packed event


@njit(cache=True, nogil=True, error_model="numpy")
def begin_piece(fire, n, piece):  # type: ignore[no-untyped-def]
    """What does not change from one threshold to the next: limits, and slopes at both ends."""
    a, b = piece[of.BEGIN], piece[of.END]
    for j in range(n):
        fire[LOW + j], fire[HIGH + j], fire[FINE + j] = a, b, piece[of.FINE]
    x0, y0, r0 = piece[of.X0], piece[of.Y0], piece[of.R0]
    x1, y1, r1 = piece[of.X1], piece[of.Y1], piece[of.R1]
    vx0, vy0, vr0 = piece[of.VX0], piece[of.VY0], piece[of.VR0]
    vx1, vy1, vr1 = piece[of.VX1], piece[of.VY1], piece[of.VR1]
    for j in range(n):
        x, y, begin, end = fire[X + j], fire[Y + j], fire[BEGIN + j], fire[END + j]
        rise = end - begin
        away = begin + r0
        slope = -((x - x0) * vx0 + (y - y0) * vy0) - vr0 * away
        fire[SCALE_A + j] = rise * away / slope if slope * rise > 0.0 else b - a
        away = end + r1
        slope = -((x - x1) * vx1 + (y - y1) * vy1) - vr1 * away
        fire[SCALE_B + j] = rise * away / slope if slope * rise > 0.0 else b - a


@njit(cache=True, nogil=True, error_model="numpy")
def guess(fire, n, piece, pace):  # type: ignore[no-untyped-def]
    """First guesses of time, and of the step in which it lies.

    Args:
        pace: one over the length of the piece's first step, 1/ns.
    """
    a, b, k0 = piece[of.BEGIN], piece[of.END], piece[of.K0]
    length, final = b - a, piece[of.K1] - 1.0
    for j in range(n):
        s = (fire[TARGET + j] - fire[BEGIN + j]) / (fire[END + j] - fire[BEGIN + j])
        # a target that was met before the piece, by rounding, is met at its begin
        s = s if s > 0.0 else 0.0
        u = 1.0 - s
        t = a + s * (
            s * (3.0 - 2.0 * s) * length
            + u * (u * fire[SCALE_A + j] - s * fire[SCALE_B + j])
        )  # fmt: skip
        t = min(max(t, a), b)
        fire[TIME + j] = t
        fire[STEP + j] = np.floor(min(k0 + (t - a) * pace, final))


@njit(cache=True, nogil=True, error_model="numpy")
def next_thresholds(fire, n, contrast, edge):  # type: ignore[no-untyped-def]
    """After an event at TARGET: the new reference level, and the rim distance of the next event.

    As `edges.rim_of`, with a logarithm that has no branches.
    """
    rounding = 1e-9 * contrast
    scale = (1.0 - 2.0 * TAIL) / contrast
    for j in range(n):
        level = fire[LEVEL + j] + fire[RISE + j]
        fire[LEVEL + j] = level
        level += fire[RISE + j]
        share = TAIL + min(max(level, 0.0), contrast) * scale
        log = logarithm((1.0 - share) / share)
        low = CUT * edge if level >= -rounding else FAR
        high = -CUT * edge if level <= contrast + rounding else -FAR
        rim = edge * log
        rim = high if level >= contrast - rounding else rim
        fire[NEXT + j] = low if level <= rounding else rim


@njit(cache=True, nogil=True, error_model="numpy")
def pack_steps(n, since, inverse, curve, steps):  # type: ignore[no-untyped-def]
    """What `fetch` needs of each step, side by side: `steps` (r, STEP_FIELDS), written."""
    for k in range(n):
        steps[k, 0], steps[k, 1] = since[k], inverse[k]
        for c in range(12):
            steps[k, 2 + c] = curve[c, k]


@njit(cache=True, nogil=True, error_model="numpy")
def fetch(roots, n, since, until, steps):  # type: ignore[no-untyped-def]
    """Find the step in which each time lies, and fetch what is known of it."""
    for j in range(n):
        k, t = np.uint64(roots[STEP + j]), roots[TIME + j]
        while t > until[k]:
            k += np.uint64(1)
        while t < since[k]:
            k -= np.uint64(1)
        roots[STEP + j] = k
        for c in range(STEP_FIELDS):
            roots[SINCE + STRIDE * c + j] = steps[k, c]


@njit(cache=True, nogil=True, error_model="numpy")
def refine(roots, n):  # type: ignore[no-untyped-def]
    """One step of Chebyshev's method; where SINCE was, the packed event stands then."""
    for j in range(n):
        t, target = roots[TIME + j], roots[TARGET + j]
        inverse = roots[INVERSE + j]
        tau = t - roots[SINCE + j]
        s = tau * inverse
        b, c, d = roots[C + STRIDE + j], roots[C + 2 * STRIDE + j], roots[C + 3 * STRIDE + j]
        dx = roots[X + j] - (roots[C + j] + tau * (b + s * (c + s * d)))
        vx = b + s * (2.0 * c + 3.0 * s * d)
        ax = 2.0 * c + 6.0 * s * d
        b, c, d = roots[C + 5 * STRIDE + j], roots[C + 6 * STRIDE + j], roots[C + 7 * STRIDE + j]
        dy = roots[Y + j] - (roots[C + 4 * STRIDE + j] + tau * (b + s * (c + s * d)))
        vy = b + s * (2.0 * c + 3.0 * s * d)
        ay = 2.0 * c + 6.0 * s * d
        b, c, d = roots[C + 9 * STRIDE + j], roots[C + 10 * STRIDE + j], roots[C + 11 * STRIDE + j]
        r = roots[C + 8 * STRIDE + j] + tau * (b + s * (c + s * d))
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
        low, high, fine = roots[LOW + j], roots[HIGH + j], roots[FINE + j]
        new = t + step * (1.0 + share)
        inside = (new - roots[SINCE + j]) * inverse
        # the next error is that of a cubic method; a longer step must not leave the path's step
        good = (share * share * abs(step) <= 3e-4 * fine) & (
            (abs(step) <= fine) | ((abs(step) <= 20.0 * fine) & (inside >= 0.0) & (inside <= 1.0))
        )
        new = new if new > low else low
        new = new if new < high else high
        roots[TIME + j] = new
        roots[GOOD + j] = 1.0 if good else 0.0
        roots[SINCE + j] = roots[HEAD + j] + np.floor(new) * _TICK


@njit(cache=True, nogil=True, error_model="numpy")
def finish(wait, n, since, until, steps, inverse, curve, out, count):  # type: ignore[no-untyped-def]
    """More steps for the n roots that wait, until all of them are events.

    Returns:
        how many events `out` holds now.
    """
    for _ in range(_ROUNDS):
        fetch(wait, n, since, until, steps)
        refine(wait, n)
        left = 0
        for j in range(n):
            if wait[GOOD + j] > 0.0:
                out[count] = np.int64(wait[SINCE + j])
                count += 1
            else:
                move(wait, j, wait, left)
                left += 1
        n = left
        if n == 0:
            return count
    for j in range(n):
        t = solve(
            wait[X + j], wait[Y + j], wait[TARGET + j], np.int64(wait[HEAD + j]) & 1 > 0,
            wait[LOW + j], wait[HIGH + j], wait[TIME + j], np.int64(wait[STEP + j]), wait[FINE + j],
            since, until, inverse, curve,
        )  # fmt: skip
        out[count] = np.int64(wait[HEAD + j] + np.floor(t) * _TICK)
        count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def move(source, j, target, k):  # type: ignore[no-untyped-def]
    """Let lane k of `target` hold the root in lane j of `source`."""
    for field in range(9):
        target[STRIDE * field + k] = source[STRIDE * field + j]
