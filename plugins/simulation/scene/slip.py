"""Equations of one papilla: its bend and forces as a column, and the slip of its tip in a step.

A papilla is a bent and compressed column on a soft base. Large deflection comes from one potential,
so that it cannot create energy: with the bend b, the papilla is compressed by
c = depth - 0.6 b^2 / h, and N = k_n c, T = b (k_b - 1.2 N / h). The second term is the softening of
an axially loaded column, which buckles at 10 E I / h^2 (exact: pi^2 E I / h^2); the stiffness left
is clamped at 5 % of k_b.

The unknowns of a slip are its length and the bend, the equations that spring and base together are
as long as the stretch that is left, and that the force lies on the friction cone at the end of the
slip. What `scene.contact` computes for many tips at once has no branches. Where Newton's
method does not get there, because friction has a kink at rest or falls more steeply than the spring
pulls, `march_to_slip` does, slowly.

All vectors are split along the slip and across it; across it the tip does not move.
"""

from __future__ import annotations

import numpy as np

from sliplab.plugins.simulation.scene.branchless import logarithm
from sliplab.plugins.simulation.scene.friction import KNOT_MM, grip_at
from sliplab.plugins.simulation.scene.springs import Law
from sliplab.storage.kernels import njit
from sliplab.storage.streams import F64

PASSES = 8
"""Newton steps that are tried; two do while rows are close."""
_MARCH_MM = KNOT_MM / 8.0
"""Distance between the places at which the balance of a tip is evaluated one by one."""
_MOST_PLACES = 4096.0
_STEADY = 1.25
"""Ratio of successive speeds up to which a line or a parabola through both predicts the next."""
_CLOSE_SPEED = 1e-3
"""A change of the speed, over that at which friction begins to rise, like `CLOSE`."""


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def strengthened(
    grip: float, slope: float, slip: float, quick: float, lag: float, law: Law
) -> tuple[float, float]:
    """A coefficient of friction and its slope over the slip, raised by the speed of sliding.

    The speed at the end of the step is `quick` (1/s) times the slip plus `lag` (mm/s).
    """
    speed = quick * slip + lag
    speed = speed if speed > 0.0 else 0.0
    share = 1.0 / law.weak_mm_s
    whole = 1.0 + speed * share
    more = 1.0 + law.strengthening * logarithm(whole)
    rate = law.strengthening * share * quick / whole if speed > 0.0 else 0.0
    return grip * more, slope * more + grip * rate


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def along_slip(
    new_x: float,
    new_y: float,
    old_x: float,
    old_y: float,
    branch_x: float,
    branch_y: float,
    soft: float,
    damp: float,
    per_s: float,
    swerve: float,
    unit_x: float,
    unit_y: float,
    quick: float,
    lag: float,
) -> tuple[float, float, float, float, float, float]:
    """Arguments of `force_after` for a tip whose slip has the direction `unit`.

    Args:
        new_x, new_y, old_x, old_y: stretch at both ends of the step if the tip did not slip, mm.
        branch_x, branch_y: what is left of the relaxing branch, N.
        soft, damp: stiffness of that branch for this step, N/mm, and of the damper, N s/mm.
        per_s: one over the length of the step, 1/s.
        swerve: the base's speed along y at the end of the step over its mean one, mm/s.

    Returns:
        `ahead` to `soft_y` of `force_after`.
    """
    rate_x, rate_y = (new_x - old_x) * per_s, (new_y - old_y) * per_s + swerve
    x, y = branch_x - soft * old_x + damp * rate_x, branch_y - soft * old_y + damp * rate_y
    ahead, aside = new_x * unit_x + new_y * unit_y, new_y * unit_x - new_x * unit_y
    rest_x, rest_y = x * unit_x + y * unit_y, y * unit_x - x * unit_y
    # the damper feels what is left of the base's speed when the tip's is taken away
    return (
        ahead,
        aside,
        rest_x - damp * (lag + quick * ahead),
        rest_y,
        soft + damp * quick,
        soft,
    )


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def first_slip(
    moved_x: float,
    moved_y: float,
    unit_x: float,
    unit_y: float,
    slides: float,
    bent: float,
    bending: float,
    shortening: float,
    compliance: float,
    pressed: float,
    pressing: float,
    rough: bool,
) -> tuple[float, float, float]:
    """Slip and bend at which the search begins, and the longest plausible slip, mm.

    `slides` and `bent` are the predicted ones. A tip that slips much farther than its base moved
    jumped over rough friction: the search may have missed where it is caught first.
    """
    moved = moved_x * unit_x + moved_y * unit_y
    _, _, slope, _ = column(bent, bending, shortening, pressed, pressing)
    change = (moved - slides) / (1.0 + compliance * slope)
    known = slides >= 0.0
    slip = slides if known else moved
    after = bent + (change if known else 0.0)
    far = 2.0 * max(moved, _MARCH_MM)
    return (
        slip if slip > 0.0 else 0.0,
        after if after > 0.0 else 0.0,
        far if rough else np.inf,
    )


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def onto_cone(
    force_x: float, force_y: float, unit_x: float, unit_y: float, limit: float
) -> tuple[float, float]:
    """A force along and across the slip, made as large as `limit`, in x and y."""
    size = np.sqrt(force_x * force_x + force_y * force_y)
    scale = limit / size if size > 0.0 else 0.0
    x, y = force_x * scale, force_y * scale
    return x * unit_x - y * unit_y, x * unit_y + y * unit_x


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def force_after(
    slip: float,
    bent: float,
    ahead: float,
    aside: float,
    rest_x: float,
    rest_y: float,
    soft_x: float,
    soft_y: float,
    pressed: float,
    pressing: float,
    bending: float,
    shortening: float,
) -> tuple[float, float, float]:
    """Force of a tip that slipped and is bent, and its normal force, N.

    Args:
        slip, bent: mm.
        ahead, aside: stretch along the slip and across it before the slip, mm.
        rest_x, rest_y, soft_x, soft_y: what relaxation and damping add, N, and per stretch, N/mm.
        pressed, pressing, bending, shortening: as in `column`.

    Returns:
        force along the slip and across it; normal force.
    """
    left = ahead - slip
    spring, normal, _, _ = column(bent, bending, shortening, pressed, pressing)
    stretch = np.sqrt(left * left + aside * aside)
    secant = spring / stretch if stretch > 0.0 else 0.0
    return (secant + soft_x) * left + rest_x, (secant + soft_y) * aside + rest_y, normal


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def slip_step(
    slip: float,
    bent: float,
    ahead: float,
    aside: float,
    rest_x: float,
    rest_y: float,
    soft_x: float,
    soft_y: float,
    pressed: float,
    pressing: float,
    bending: float,
    shortening: float,
    compliance: float,
    grip: float,
    grip_slope: float,
    quick: float,
    weak: float,
) -> tuple[float, float, bool, bool, float]:
    """One Newton step towards the slip that leaves the force on the friction cone.

    Args:
        slip to shortening: as in `force_after`.
        compliance: of what is in series with the bend, mm/N.
        grip, grip_slope: friction at the end of the slip, and its slope over it, 1/mm.
        quick, weak: slope of the speed over the slip, 1/s, and the speed at which friction begins
            to rise, mm/s.

    Returns:
        slip, bend, whether it is the solution, whether it may still converge, and how fast the
        force falls to the cone with the slip, N/mm.
    """
    left = ahead - slip
    spring, normal, slope, normal_slope = column(bent, bending, shortening, pressed, pressing)
    stretch = np.sqrt(left * left + aside * aside)
    per_stretch = 1.0 / stretch
    cosine, sine, secant = left * per_stretch, aside * per_stretch, spring * per_stretch
    force_x, force_y = (secant + soft_x) * left + rest_x, (secant + soft_y) * aside + rest_y
    force = np.sqrt(force_x * force_x + force_y * force_y)
    per_force = 1.0 / force
    unit_x, unit_y = force_x * per_force, force_y * per_force
    # to first order in the changes of slip and bend
    per_open = 1.0 / (1.0 + compliance * slope)
    miss = bent + compliance * spring - stretch
    by_bend = ((unit_x * cosine + unit_y * sine) * slope - grip * normal_slope) * per_open
    steepness = (
        by_bend * cosine
        + unit_x * soft_x
        + secant * sine * (unit_x * sine - unit_y * cosine)
        + grip_slope * normal
    )
    change = (force - grip * normal - by_bend * miss) / steepness
    bend = -(miss + cosine * change) * per_open
    # the next changes would be of the order of the squares of these: rounding
    found = (
        abs(change) <= CLOSE * stretch
        and abs(bend) <= CLOSE * stretch
        and abs(change) * quick <= _CLOSE_SPEED * weak
    )
    slip, bent = slip + change, bent + bend
    # what friction holds pulls along the slip
    hopeful = steepness > 0.0 and slip >= 0.0 and bent >= 0.0 and force_x > 0.0
    return slip, bent, found, hopeful, steepness


@njit(cache=True, nogil=True, error_model="numpy")
def march_to_slip(
    guess: float,
    ahead: float,
    aside: float,
    rest_x: float,
    rest_y: float,
    soft_x: float,
    soft_y: float,
    pressed: float,
    pressing: float,
    bending: float,
    shortening: float,
    compliance: float,
    field: F64,
    i: int,
    path: float,
    quick: float,
    lag: float,
    law: Law,
) -> tuple[float, float]:
    """Return the first slip after which friction holds the force, and the bend, mm.

    Steps forward until the force is below the limit, then regula falsi.
    """
    bent, slip, below, above = guess, 0.0, 0.0, 0.0
    low, high, side = 0.0, -1.0, 0
    rough = field.shape[1] > 1
    most = max(abs(ahead), 1e-9)
    march = most / 16.0
    if rough:
        march = max(min(march, _MARCH_MM), most / _MOST_PLACES)
    # a spring that is let go may carry its tip beyond the place under its base
    tries = int(2.0 * most / march) + 2
    for _ in range(tries + ITERATIONS):
        left = ahead - slip
        stretch = np.sqrt(left * left + aside * aside)
        bent = bend_for(stretch, bent, bending, shortening, compliance, pressed, pressing)
        force_x, force_y, normal = force_after(
            slip,
            bent,
            ahead,
            aside,
            rest_x,
            rest_y,
            soft_x,
            soft_y,
            pressed,
            pressing,
            bending,
            shortening,
        )
        grip, _ = grip_at(field, i, path + slip)
        grip, _ = strengthened(grip, 0.0, slip, quick, lag, law)
        over = np.sqrt(force_x * force_x + force_y * force_y) - grip * normal
        if over > 0.0 and force_x > 0.0:
            low, below = slip, over
            above = 0.5 * above if side == 1 else above
            side = 1
        else:
            high, above = slip, min(over, -1e-300)
            below = 0.5 * below if side == -1 else below
            side = -1
        if high < 0.0:
            if slip >= 2.0 * most:
                break
            slip += march
            continue
        if high - low <= 1e-15 * most or abs(over) <= 1e-16:
            break
        slip = (low * above - high * below) / (above - below)
        slip = slip if low < slip < high else 0.5 * (low + high)
    return slip, bent


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def slows_down(
    slid_s: float,
    speed: float,
    fx: float,
    fy: float,
    moved_x: float,
    moved_y: float,
    h: float,
    law: Law,
) -> bool:
    """Return whether a tip's earlier speeds do not predict its next one: see `relaxed_speed`.

    Args:
        slid_s, speed: of the step before: its duration, s (0: none), and its mean speed, mm/s.
        fx, fy: force on the sliding tip, N.
        moved_x, moved_y, h: how far the base moves, mm, in how many seconds.
    """
    along = _STEADY * (fx * moved_x + fy * moved_y)
    slid = speed * h
    fast = along <= 0.0 or slid * slid * (fx * fx + fy * fy) > along * along
    return slid_s == 0.0 and fast and law.strengthening > 0.0 and law.damping_s == 0.0


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def is_steady(earlier: float, speed: float) -> bool:
    """Return whether the speeds of two steps, mm/s, predict the next one."""
    return earlier <= _STEADY * speed


@njit(cache=True, nogil=True, error_model="numpy")
def relaxed_speed(
    force: float,
    rise: float,
    before: float,
    after: float,
    cone: float,
    steepness: float,
    slid_s: float,
    law: Law,
) -> float:
    """Speed of a tip that slid for `slid_s` seconds and without a usable speed history, mm/s.

    With x = (|f| / cone - 1) / strengthening the speed is weak (e^x - 1), and x' = a - b (e^x - 1)
    while rates are constant: a linear equation for e^-x, solved exactly, because a tip that lets go
    may be a thousand times as fast at first as at the end of the step.

    Args:
        force, rise: size of the force, and by how much it rises if the tip does not slip, N.
        before, after: the cone's radii at both ends if it does not, N.
        cone, steepness: the cone's radius and steepness (see `slip_step`) during the slip.

    Returns:
        the speed; negative: friction falls with the slip faster than the spring pulls.
    """
    scale = 1.0 / (law.strengthening * cone)
    over = max((force / before - 1.0) / law.strengthening, 0.0)
    a = (rise - (after - before) * force / before) * scale
    b = law.weak_mm_s * steepness * scale * slid_s
    # the sum may be negative: the speed grows
    sum_, slow = a + b, np.exp(-over)
    gain = -np.expm1(-sum_) / sum_ if sum_ != 0.0 else 1.0
    slow = slow * np.exp(-sum_) + b * gain
    return max(law.weak_mm_s * (1.0 / slow - 1.0), 0.0) if b > 0.0 else -1.0


@njit(cache=True, nogil=True, error_model="numpy")
def force_kept(force: float, cone: float, damp: float, law: Law) -> float:
    """Share of its force that a tip keeps in the moment in which it lets go.

    It slides at once at the speed w at which the damper and friction together hold the force:
    `damp` w + cone (1 + strengthening ln(1 + w / weak)) = force, all in N and mm/s.
    """
    over = force - cone
    if over <= 0.0 or (damp == 0.0 and law.strengthening > 0.0):
        return 1.0
    if law.strengthening == 0.0:
        return cone / force
    speed = 0.0
    for _ in range(ITERATIONS):
        # the sum is concave: Newton's steps from below never pass the root
        whole = 1.0 + speed / law.weak_mm_s
        rise = cone * law.strengthening
        miss = over - damp * speed - rise * np.log(whole)
        change = miss / (damp + rise / (law.weak_mm_s * whole))
        speed += change
        if change <= 1e-12 * speed:
            break
    return 1.0 - damp * speed / force


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def predicted_speed(
    slid_s: float, per_s: float, earlier_s: float, speed: float, earlier: float
) -> tuple[float, float, float]:
    """Speed at the end of a step from the slip in it and the mean speeds of the steps before.

    A line through two of them, a parabola through three if all took as long. `per_s` is
    1 / `slid_s`.

    Returns:
        quick and lag of `strengthened`, and the slip, mm, if the tip slid on as it did
        (negative: not known).
    """
    known = earlier_s > 0.0
    even = earlier_s == slid_s and earlier >= 0.0
    ahead = slid_s / (slid_s + earlier_s)
    weight, lag = (
        (11.0 / 6.0, earlier / 3.0 - 7.0 / 6.0 * speed) if even else (1.0 + ahead, -ahead * speed)
    )
    weight, lag = (weight, lag) if known else (1.0, 0.0)
    slides = (2.0 * speed - earlier) * slid_s if known and even else -1.0
    return weight * per_s, lag, slides


_MOST_CREEP = 40.0
"""Logarithm of a creep speed over that at the limit: far beyond it, where the tip lets go."""


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def creep_slip(
    start: float, end: float, before: float, after: float, steepness: float, h: float, law: Law
) -> float:
    """Return how far a stuck tip creeps in a step of `h` s, mm.

    With x = (|f| / limit - 1) / creep_share the speed is creep_mm_s e^x, and x' = a - b e^x while
    rates are constant: a linear equation for e^-x, solved exactly.

    Args:
        start, end: size of the force at both ends if the tip does not creep, N.
        before, after: static limit at both ends, N.
        steepness: by how much the force falls with the slip, N/mm.
    """
    first = (start / before - 1.0) / law.creep_share if before > 0.0 else -1.0 / law.creep_share
    last = (end / after - 1.0) / law.creep_share if after > 0.0 else -1.0 / law.creep_share
    first, last = min(first, _MOST_CREEP), min(last, _MOST_CREEP)
    rise = last - first
    # the mean of e^x on the way, without cancellation
    even = abs(rise) < 1e-6
    mean = np.exp(last) * (1.0 if even else -np.expm1(-rise) / rise)
    length = law.creep_share * after / steepness
    # never beyond the place at which the spring is loose
    return min(length * np.log1p(law.creep_mm_s * h / length * mean), end / steepness)


_LEAST_STIFFNESS = 0.05
ITERATIONS = 60
CLOSE = 1e-7
"""A change of the bend, over the bend, after which Newton's next one would be rounding."""


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def column(
    bent: float, bending: float, shortening: float, pressed: float, pressing: float
) -> tuple[float, float, float, float]:
    """Tangential and normal force of a bent column, and their slopes over the bend.

    N = pressed - pressing * shortening * bent^2, not negative.
    """
    loss = pressing * shortening * bent
    normal = pressed - loss * bent
    normal_slope = -2.0 * loss
    if normal <= 0.0:
        normal, normal_slope = 0.0, 0.0
    stiffness = bending - 2.0 * shortening * normal
    slope = stiffness - 2.0 * shortening * bent * normal_slope
    if stiffness < _LEAST_STIFFNESS * bending:
        stiffness = slope = _LEAST_STIFFNESS * bending
    return stiffness * bent, normal, slope, normal_slope


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def first_bend(
    stretch: float, guess: float, bending: float, shortening: float, compliance: float
) -> float:
    """Begin of the search for a bend: its solution, if the papilla is not shortened."""
    straight = stretch / (1.0 + compliance * bending)
    return straight if shortening == 0.0 else min(guess, stretch)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def bend_step(
    bent: float,
    low: float,
    high: float,
    stretch: float,
    bending: float,
    shortening: float,
    compliance: float,
    pressed: float,
    pressing: float,
) -> tuple[float, float, float, bool]:
    """One guarded Newton step towards the bend at a stretch.

    Returns:
        the bend, its bracket, and whether it is the solution.
    """
    force, _, slope, _ = column(bent, bending, shortening, pressed, pressing)
    miss = bent + compliance * force - stretch
    found = abs(miss) <= 1e-14 * stretch
    low, high = (low, bent) if miss > 0.0 else (bent, high)
    after = bent - miss / (1.0 + compliance * slope)
    after = after if low <= after <= high else 0.5 * (low + high)
    near = abs(after - bent) <= CLOSE * stretch
    return (bent if found else after), low, high, found or near


@njit(cache=True, nogil=True, error_model="numpy")
def bend_for(
    stretch: float,
    guess: float,
    bending: float,
    shortening: float,
    compliance: float,
    pressed: float,
    pressing: float,
) -> float:
    """The bend of a papilla whose tip is `stretch` mm from under its base."""
    low, high = 0.0, stretch
    bent = first_bend(stretch, guess, bending, shortening, compliance)
    for _ in range(ITERATIONS):
        bent, low, high, found = bend_step(
            bent, low, high, stretch, bending, shortening, compliance, pressed, pressing
        )
        if found:
            break
    return bent


@njit(cache=True, nogil=True, error_model="numpy")
def relaxing(h: float, relaxation_s: float) -> tuple[float, float]:
    """Decay of the relaxing branch over `h` s, and its gain for a linear motion in that time.

    q' = -q / tau + k x' with x' constant gives q+ = q e^(-h/tau) + k tau (1 - e^(-h/tau)) dx / h.
    """
    share = h / relaxation_s
    return np.exp(-share), -np.expm1(-share) / share
