"""Raw estimates of the contact's parameters from a pilot's slides, each by one effect's physics.

They are summary statistics: close to a parameter, or to what the data tell of several, cheap, and
computed in the same way from recorded and from simulated slides. What is left of bias is taken away
by comparing them with those of simulated worlds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares, minimize_scalar
from scipy.signal import lfilter

from sliplab.analysis.twin.contact_slips import (
    AFTER_S,
    LEAST_PATH_MM,
    SETTLES_S,
    Slips,
    find_slips,
    mean_seen,
)
from sliplab.analysis.twin.contact_springs import Fit, Guess, Lags, fit_springs
from sliplab.analysis.twin.pilot import PilotTrial
from sliplab.storage.streams import F64, I64

C128 = npt.NDArray[np.complex128]

NOT_LOGGED = ("depth_zero_mm", "static_drop", "static_drop_per_speed", "ratio_per_speed")
"""Estimates that may be negative; all others are positive, and their logarithm is taken."""

VARIATION, CORRELATION_MM, TREMOR_MM = 0.05, 0.5, 0.007
"""Supposed for weights only: friction's variation along a path, its length, the arm's tremor."""
LEAST_STRETCH_MM = 0.15
"""Slips of springs that were stretched less tell more of the tremor than of friction."""
LEAST_LAG_MM = 0.8
"""Lags that are smaller fluctuate by the tremor as much as by friction."""
LEAST_PULLING_MM = 0.3
"""Rings whose tips lag less pull too little for their stiffness to be told from forces."""
PATH_STEP_MM = 0.1
BAND_HZ = (2.2, 10.0)
"""Where an arm's tremor is looked for: friction along a path varies more slowly."""
TONES = 4
STRENGTHENING, WEAK_MM_S = 0.01, 0.1
"""Friction at the speed w is taken to grow by 0.01 ln(1 + w / 0.1 mm/s)."""
UNSURE = 0.4
"""A tone whose error is a larger share of its mean strength is left out of that slide."""
SAME_HZ = 0.07
"""Tones that are closer are one: slides take a dozen seconds."""


@dataclass(frozen=True)
class Growth:
    """How a lag grows after a slip while the stretched spring relaxes.

    Attributes:
        maxwell: stiffness of the relaxing branch over the other. relaxation_s: its time.
        drop: of the force where a tip lets go, relative, at the mean speed; drop_per_speed: its
            slope over the logarithm of speed.
    """

    maxwell: float = 0.25
    relaxation_s: float = 1.0
    drop: float = 0.0
    drop_per_speed: float = 0.0

    def __call__(self, stuck_s: F64, after_s: F64, log_speed: F64) -> F64:
        """Lag over the stretch at the slip; arguments broadcast.

        A standard linear solid that is stretched at constant speed for t pulls with
        k (u + q), q = m v tau (1 - e^(-t/tau)). From then on lag + q is constant, and q decays with
        the time tau (1 + m).

        Args:
            stuck_s: from the start of the slide to the slip. log_speed: over the mean speed.
        """
        share = stuck_s / self.relaxation_s
        begin = self.maxwell * -np.expm1(-share) / share
        left = np.exp(-after_s / (self.relaxation_s * (1.0 + self.maxwell)))
        drop = self.drop + self.drop_per_speed * log_speed
        result: F64 = (1.0 - drop) * (1.0 + begin) - begin * left
        return result


def contact_estimates(trials: Sequence[PilotTrial], guess: Guess | None = None) -> dict[str, float]:
    """Return the estimates by name, NaN where these slides do not tell.

    Args:
        guess: design of the skin, and where the fit of its springs begins.
    """
    guess = guess or Guess()
    slips = find_slips(trials)
    if slips is None:
        return {}
    ring, place = rings_of(slips)
    fitted = fit_growth(slips)
    growth = fitted or Growth()
    table = steady_lags(slips, growth)
    lags = lags_of(slips, ring, table, growth)
    return {
        "position_scatter_mm": place_scatter(ring, place),
        "relaxation_maxwell": fitted.maxwell if fitted else np.nan,
        "relaxation_s": fitted.relaxation_s if fitted else np.nan,
        "static_drop": fitted.drop if fitted else np.nan,
        "static_drop_per_speed": fitted.drop_per_speed if fitted else np.nan,
        **path_estimates(slips, growth, table),
        **force_estimates(slips, lags),
        **spring_estimates(fit_springs(lags, guess), ring),
        **tremor_estimates(slips),
    }


# -- rest places -------------------------------------------------------------------------------


def rest_places(slips: Slips) -> F64:
    """Return each marker's place in the last 0.5 s of each hold, mm, (k, m, 2), NaN where unseen.

    Slides begin at different places of the plate: they are shifted onto those of
    one slide.
    """
    places = np.array([
        mean_seen(trial.tips_mm[(trial.frame_s < 0.0) & (trial.frame_s >= -0.5)])
        for trial in slips.trials
    ])  # fmt: skip
    here = places[int(np.argmax(np.isfinite(places[:, :, 0]).sum(axis=1)))]
    for place in places:
        shift = (place - here)[np.isfinite(place - here).all(axis=1)]
        place -= np.median(shift, axis=0) if len(shift) else np.nan
    return places


def rings_of(slips: Slips) -> tuple[I64, F64]:
    """Return each marker's ring, 0 for the centre and -1 where it was never seen, and its place,
    (m, 2): `rest_places`."""
    place = mean_seen(rest_places(slips))
    seen = np.isfinite(place).all(axis=1)
    ring = np.full(len(place), -1)
    if not seen.any():
        return ring, place
    # the marker that is nearest to the middle of all is the centre
    off = np.hypot(*(place[seen] - np.median(place[seen], axis=0)).T)
    far = np.hypot(*(place[seen] - place[seen][np.argmin(off)]).T)
    order = np.argsort(far)
    steps = np.diff(far[order])
    jumps = steps > 0.5 * steps.max(initial=0.0)
    inside = np.zeros(len(far), np.int64)
    inside[order] = np.concatenate([[0], np.cumsum(jumps)])
    ring[seen] = inside
    return ring, place


def place_scatter(ring: I64, place: F64) -> float:
    """Standard deviation of places about a lattice of rings, mm: the best place, turn and scale."""
    lattice = np.full(place.shape, np.nan)
    seen = np.isfinite(place).all(axis=1)
    if seen.sum() < 4 or not np.any(seen & (ring == 0)):
        return float("nan")
    middle = place[seen & (ring == 0)].mean(axis=0)
    for r in np.unique(ring[seen]):
        these = np.flatnonzero(seen & (ring == r))
        angle = np.arctan2(*(place[these] - middle).T[::-1])
        if r == 0 or len(these) < 2:
            lattice[these] = 0.0 if r == 0 else np.nan
            continue
        turns = np.sort(angle)
        step = np.median(np.diff(np.append(turns, turns[0] + 2 * np.pi)))
        count = max(round(2 * np.pi / step), 1)
        step = 2 * np.pi / count
        lead = np.angle(np.mean(np.exp(1j * count * angle))) / count
        index = np.round((angle - lead) / step)
        turn = lead + index * step
        lattice[these] = r * np.column_stack([np.cos(turn), np.sin(turn)])
    use = np.isfinite(lattice).all(axis=1)
    z, w = (points[use] @ [1.0, 1.0j] for points in (lattice, place))
    design = np.column_stack([z, np.ones(len(z))])
    best, *_ = np.linalg.lstsq(design, w, rcond=None)
    rest = np.abs(w - design @ best)
    free = 2 * len(w) - 4
    return float(np.sqrt(np.sum(rest**2) / free)) if free > 0 else float("nan")


# -- after a slip ------------------------------------------------------------------------------


def fit_growth(slips: Slips) -> Growth | None:
    """Fit how lags grow after the slips, all together; None without enough of them."""
    use = slips.slid & (slips.stretch_mm >= LEAST_STRETCH_MM)
    k, j = np.nonzero(use)
    ratio = slips.after_mm[k, j] / slips.stretch_mm[k, j][:, None]
    known = np.isfinite(ratio)
    if known.sum() < 40:
        return None
    speed = slips.speed_mm_s[k][:, None]
    log_speed = np.log(speed / np.exp(np.mean(np.log(slips.speed_mm_s))))
    wander = VARIATION**2 * -np.expm1(-((speed * AFTER_S / CORRELATION_MM) ** 2))
    error = np.sqrt(2e-3**2 + 2 * wander + (TREMOR_MM / slips.stretch_mm[k, j][:, None]) ** 2)
    stuck = np.maximum(slips.slipped_s[k, j], 1e-3)[:, None]

    def growth(x: F64) -> Growth:
        return Growth(float(np.exp(x[0])), float(np.exp(x[1])), float(x[2]), float(x[3]))

    def residuals(x: F64) -> F64:
        return ((growth(x)(stuck, AFTER_S, log_speed) - ratio) / error)[known]

    several = np.ptp(log_speed) > 0.05
    begin = np.array([np.log(0.25), 0.0, 0.0, 0.0])
    free = slice(0, 4 if several else 3)

    def reduced(x: F64) -> F64:
        full = begin.copy()
        full[free] = x
        return residuals(full)

    low, high = np.array([-5.0, -3.0, -0.5, -0.5]), np.array([1.5, 2.5, 0.5, 0.5])
    solved = least_squares(
        reduced, begin[free], bounds=(low[free], high[free]), loss="soft_l1", f_scale=3.0,
        max_nfev=30,
    )  # fmt: skip
    full = begin.copy()
    full[free] = solved.x
    return growth(full)


@dataclass(frozen=True)
class SteadyLags:
    """Lags in steady slip: mean over a slide, mm, NaN where not known, 0 for a papilla in the air,
    and the path over which it was taken, mm; both (k, m)."""

    lag_mm: F64
    path_mm: F64


def settled_lags(slips: Slips, i: int, growth: Growth) -> tuple[F64, F64]:
    """Lag of one slide's tips while they slide, as if the springs had relaxed, (n, m), else NaN;
    and the frames' times."""
    t, lag = slips.frame_s[i], slips.lag_mm[i]
    after = t[:, None] - slips.slipped_s[i]
    mean = np.exp(np.mean(np.log(slips.speed_mm_s)))
    log_speed = np.full(1, np.log(slips.speed_mm_s[i] / mean))
    stuck = np.maximum(slips.slipped_s[i], 1e-3)
    with np.errstate(invalid="ignore", over="ignore"):
        now = growth(stuck, after, log_speed)
        share = now / growth(stuck, np.full(1, np.inf), log_speed)
        settled = np.where((after > SETTLES_S) & slips.slid[i], lag / share, np.nan)
    return settled, t


def steady_lags(slips: Slips, growth: Growth) -> SteadyLags:
    """Return every papilla's mean lag in every slide."""
    shape = slips.slipped_s.shape
    lag, path = np.full(shape, np.nan), np.zeros(shape)
    for i in range(shape[0]):
        settled, _ = settled_lags(slips, i, growth)
        seen = np.isfinite(settled)
        way = np.where(seen, slips.path_mm[i], np.nan)
        for j in np.flatnonzero(seen.any(axis=0)):
            path[i, j] = np.nanmax(way[:, j]) - np.nanmin(way[:, j])
        lag[i] = np.where(path[i] >= LEAST_PATH_MM, mean_seen(settled), np.nan)
        lag[i, slips.free[i]] = 0.0
    return SteadyLags(lag, path)


def lags_of(slips: Slips, ring: I64, table: SteadyLags, growth: Growth) -> Lags:
    """Return the lags by depth, weighted by their paths, and the forces by depth."""
    levels, which = slips.depths
    m = len(ring)
    lag, error = np.full((len(levels), m), np.nan), np.full((len(levels), m), np.nan)
    normal, stiffness = np.full(len(levels), np.nan), np.full(len(levels), np.nan)
    held = np.array([normal_at_rest(trial) for trial in slips.trials])
    slope = initial_slopes(slips, growth)
    for level in range(len(levels)):
        these = which == level
        values, path = table.lag_mm[these], np.where(slips.free[these], 1.0, table.path_mm[these])
        weight = np.where(np.isfinite(values), path, 0.0)
        total = weight.sum(axis=0)
        known = total > 0.0
        mean = (np.where(weight > 0.0, values, 0.0) * weight).sum(axis=0)[known] / total[known]
        lag[level, known] = mean
        independent = np.maximum(total[known] / (1.8 * CORRELATION_MM), 1.0)
        error[level, known] = np.hypot(1.2 * VARIATION * mean / np.sqrt(independent), 4e-3)
        normal[level], stiffness[level] = mean_seen(held[these]), mean_seen(slope[these])
    gross = gross_forces(slips)
    ratio = float(mean_seen(gross[:, 0] / gross[:, 1]))
    kept = np.array([mean_seen((gross[:, 1] / held)[which == k]) for k in range(len(levels))])
    pull = ring_stiffness(slips, ring, growth)
    for r in range(pull.shape[1]):
        pull[~(mean_seen(lag[:, ring == r], axis=1) >= LEAST_PULLING_MM), r] = np.nan
    return Lags(levels, ring, lag, error, normal, ratio, kept, stiffness, pull)


def spring_estimates(fit: Fit | None, ring: I64) -> dict[str, float]:
    """Return what the fitted springs say of the common parameters and of the scatters."""
    names = (
        "kinetic", "normal_compliance_per_mm", "tangential_compliance_per_mm", "layer_step_mm",
        "depth_zero_mm", "youngs_modulus_mpa", "friction_scatter", "height_scatter_mm",
        "height_reach_mm",
    )  # fmt: skip
    if fit is None:
        return dict.fromkeys(names, float("nan"))
    outer = ring > 0
    friction, raised = np.log(fit.friction[outer]), fit.raised_mm[outer]
    inside = ring[outer]
    for values in (friction, raised):
        for r in np.unique(inside):
            values[inside == r] -= values[inside == r].mean()
    free = max(len(inside) - len(np.unique(inside)), 1)
    reach = max((np.ptp(raised[inside == r]) / 2 for r in np.unique(inside)), default=np.nan)
    told = (
        fit.kinetic, fit.normal_compliance, fit.tangential_compliance, fit.layer_step_mm,
        fit.zero_mm, fit.youngs_modulus_mpa, float(np.sqrt(np.sum(friction**2) / free)),
        float(np.sqrt(np.sum(raised**2) / free)), float(reach),
    )  # fmt: skip
    return dict(zip(names, told, strict=True))


# -- along the path ----------------------------------------------------------------------------


def path_estimates(slips: Slips, growth: Growth, table: SteadyLags) -> dict[str, float]:
    """Return the variation of friction along the paths and its length, from lags in steady slip."""
    steps = 16
    total, count = np.zeros(steps), np.zeros(steps)
    for i in range(len(slips.trials)):
        settled, _ = settled_lags(slips, i, growth)
        rows = []
        for j in np.flatnonzero(table.lag_mm[i] >= LEAST_LAG_MM):
            seen = np.isfinite(settled[:, j])
            way = slips.path_mm[i][seen, j]
            grid = np.arange(way.min(), way.max(), PATH_STEP_MM)
            rows.append(np.interp(grid, way, settled[seen, j] / table.lag_mm[i, j] - 1.0))
        if not rows:
            continue
        longest = max(len(row) for row in rows)
        padded, there = np.zeros((len(rows), longest)), np.zeros((len(rows), longest))
        for row, values in enumerate(rows):
            padded[row, : len(values)], there[row, : len(values)] = values, 1.0
        for d in range(min(steps, longest)):
            total[d] += np.sum(padded[:, : longest - d] * padded[:, d:])
            count[d] += np.sum(there[:, : longest - d] * there[:, d:])
    if count[0] == 0.0 or np.any(count < 1.0):
        return {"path_variation": float("nan"), "correlation_mm": float("nan")}
    covariance = total / count
    return {
        "path_variation": float(np.sqrt(covariance[0])),
        "correlation_mm": _length_of(covariance),
    }


def _length_of(covariance: F64) -> float:
    """Distance at which a covariance, in steps of `PATH_STEP_MM`, has fallen by 1/e, mm."""
    below = np.flatnonzero(covariance < covariance[0] / np.e)
    if not len(below):
        return float("nan")
    k = int(below[0])
    high, low = covariance[k - 1], covariance[k]
    share = (high - covariance[0] / np.e) / (high - low)
    return float((k - 1 + share) * PATH_STEP_MM)


# -- the arm's tremor --------------------------------------------------------------------------


def tremor_estimates(slips: Slips) -> dict[str, float]:
    """Return the largest amplitude of the arm's tremor over the slides, and its frequency.

    All sliding tips lag by it together; friction of their own averages out and is slow. Its tones
    are the same in all slides along one axis: they are found in all together, by orthogonal
    matching pursuit, and then fitted in each slide. A tone along the plate is heard in the slides
    along one axis only; one of the depth, which changes the lags in proportion to friction, in all.
    """
    axis = np.abs(slips.way[:, 0]) < np.abs(slips.way[:, 1])
    found = []
    for side in (False, True):
        series = [common_lag(slips, i) for i in np.flatnonzero(axis == side).tolist()]
        known = [one for one in series if one is not None]
        if len(known) >= 3:
            tones, amplitude, error = _tones([(t, lag) for t, lag, _ in known])
            followed = np.array([follows for *_, follows in known])[:, None]
            turning = 2 * np.pi * tones * followed * STRENGTHENING
            averaged = np.sinc(tones * np.median(np.diff(known[0][0])))
            followed_mm = amplitude * np.hypot(1.0, turning) / averaged
            height = np.sqrt(np.mean(followed_mm**2, axis=0))
            found.append((tones, height, followed_mm, error < UNSURE * height))
    along: list[float] = []
    own_tones: list[float] = []
    power = weighted = 0.0
    for number, (tones, height, amplitude, sure) in enumerate(found):
        power += float(np.sum(height**2))
        weighted += float(np.sum(height**2 * np.log(tones)))
        others = [tone for k, one in enumerate(found) if k != number for tone in one[0].tolist()]
        own = [
            k
            for k in range(len(tones))
            if not any(abs(tones[k] - tone) < SAME_HZ for tone in others)
        ]
        if own:
            k = max(own, key=lambda k: height[k])
            along += amplitude[sure[:, k], k].tolist()
            own_tones.append(float(tones[k]))
    strength = [float(np.sqrt(np.sum(row**2))) for *_, amplitude, _ in found for row in amplitude]
    return {
        "tremor_mm": _largest(along),
        "tremor_along_mean_mm": float(np.mean(along)) if along else float("nan"),
        "tremor_all_mm": _largest(strength),
        "tremor_hz": float(np.exp(weighted / power)) if power > 0.0 else float("nan"),
        # one axis' tones alone are others than both axes'
        "tremor_along_hz": float(np.sqrt(np.prod(own_tones)))
        if len(own_tones) == 2
        else float("nan"),
    }


def _largest(values: Sequence[float]) -> float:
    """Mean of the four largest values; NaN without."""
    return float(np.mean(np.sort(values)[-4:])) if len(values) else float("nan")


def common_lag(slips: Slips, i: int) -> tuple[F64, F64, float] | None:
    """Return times and mean lag of the tips that slide early in a slide, 25 a second, mm; and the
    mean lag over the speed, s.

    Small lags count more: friction of the tip itself has less part in them. Friction that rises
    with speed, d mu / mu = s dw / (w + weak), keeps a tip with the lag l from following the tremor:
    it follows by 1 / (1 + i omega s l / (w + weak)).
    """
    t, lag = slips.frame_s[i], slips.lag_mm[i]
    begins = np.sort(slips.slipped_s[i][np.isfinite(slips.slipped_s[i])])
    if len(begins) < 3:
        return None
    begin = begins[max(len(begins) // 3, 2)] + SETTLES_S
    use = np.flatnonzero(slips.slipped_s[i] < begin)
    rows = (t >= begin) & np.isfinite(lag[:, use]).all(axis=1)
    four = rows.sum() // 4 * 4
    if four < 100:
        return None
    seen = lag[rows][:four][:, use]
    weight = 1.0 / np.maximum(np.abs(seen.mean(axis=0)), LEAST_STRETCH_MM) ** 2
    common = (seen @ weight / weight.sum()).reshape(-1, 4).mean(axis=1)
    behind = float(np.mean(common)) / (slips.speed_mm_s[i] + WEAK_MM_S)
    return t[rows][:four].reshape(-1, 4).mean(axis=1), common, behind


def _tones(series: Sequence[tuple[F64, F64]]) -> tuple[F64, F64, F64]:
    """Return the frequencies of the tones that series have in common, (TONES,), and their
    amplitudes in each with standard errors, (len(series), TONES)."""
    grid = np.arange(*BAND_HZ, 0.03)
    waves = [_waves(t, grid) for t, _ in series]
    trends = [_legendre(t) for t, _ in series]
    tones: list[float] = []
    rest = [_without(values, trend)[0] for (_, values), trend in zip(series, trends, strict=True)]
    amplitude, error = np.zeros((2, len(series), TONES))
    for number in range(TONES):
        power = np.zeros(len(grid))
        for wave, r in zip(waves, rest, strict=True):
            power += np.abs(wave @ r) ** 2 / len(r)
        tones.append(_peak(grid, power))
        for row, ((t, values), trend) in enumerate(zip(series, trends, strict=True)):
            phase = 2 * np.pi * np.array(tones) * t[:, None]
            design = np.column_stack([trend, np.cos(phase), np.sin(phase)])
            rest[row], best = _without(values, design)
            pair = best[trend.shape[1] :].reshape(2, number + 1)
            amplitude[row, : number + 1] = np.hypot(*pair)
            if number == TONES - 1:
                spread = np.diag(np.linalg.pinv(design.T @ design))[trend.shape[1] :]
                free = max(len(t) - design.shape[1], 1)
                noise = np.sum(rest[row] ** 2) / free
                error[row] = np.sqrt(noise * spread.reshape(2, TONES).mean(axis=0))
    return np.array(tones), amplitude, error


def _peak(grid_hz: F64, power: F64) -> float:
    """Frequency of the largest power, by a parabola through it and its neighbours."""
    k = int(np.clip(np.argmax(power), 1, len(grid_hz) - 2))
    before, here, after = power[k - 1 : k + 2]
    bend = before - 2.0 * here + after
    shift = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
    return float(grid_hz[k] + np.clip(shift, -0.5, 0.5) * (grid_hz[1] - grid_hz[0]))


def _waves(t_s: F64, grid_hz: F64) -> C128:
    """exp(-2 pi i f t) on an even grid of frequencies, (len(grid), n): each from the one before."""
    step = np.exp(-2j * np.pi * (grid_hz[1] - grid_hz[0]) * t_s)
    rows = np.tile(step, (len(grid_hz), 1))
    rows[0] = np.exp(-2j * np.pi * grid_hz[0] * t_s)
    result: C128 = np.multiply.accumulate(rows, axis=0)
    return result


def _legendre(t_s: F64) -> F64:
    """Polynomials that take the slow changes of a series out: a degree for each second, (n, k)."""
    span = t_s[-1] - t_s[0]
    degree = int(np.clip(2.0 * span, 3, 20))
    result: F64 = np.polynomial.legendre.legvander(2.0 * (t_s - t_s[0]) / span - 1.0, degree)
    return result


def _without(values: F64, design: F64) -> tuple[F64, F64]:
    best = np.asarray(np.linalg.lstsq(design, values, rcond=1e-6)[0], np.float64)
    return values - design @ best, best


# -- forces ------------------------------------------------------------------------------------


def normal_at_rest(trial: PilotTrial) -> float:
    """Normal force in the last 0.2 s before the slide, N; NaN without a force sensor."""
    if trial.forces is None:
        return float("nan")
    t = trial.forces.t_s
    return float(mean_seen(trial.forces.force_n[(t >= -0.2) & (t < 0.0), 2]))


def initial_slopes(slips: Slips, growth: Growth) -> F64:
    """Tangential stiffness of the sticking tips together, relaxed, N/mm, (k,); NaN where none."""
    result = np.full(len(slips.trials), np.nan)
    for i, trial in enumerate(slips.trials):
        slid = slips.slipped_s[i][slips.slid[i]]
        if trial.forces is None or not len(slid):
            continue
        until = 0.9 * float(slid.min())
        t = trial.forces.t_s
        rows = (t > 0.02) & (t < until)
        if rows.sum() < 50 or until * slips.speed_mm_s[i] < 0.1:
            continue
        before = (t >= -0.2) & (t < 0.0)
        pull = trial.forces.force_n[:, :2] @ slips.way[i]
        pull = pull[rows] - pull[before].mean() if before.any() else pull[rows]
        # what a unit stiffness pulls with while it relaxes
        tau, m = growth.relaxation_s, growth.maxwell
        unit = slips.speed_mm_s[i] * (t[rows] + m * tau * -np.expm1(-t[rows] / tau))
        result[i] = float(np.sum(pull * unit) / np.sum(unit**2))
    return result


def gross_forces(slips: Slips) -> F64:
    """Force along the slide and normal force in gross slip, N, (k, 2); NaN where there is none."""
    result = np.full((len(slips.trials), 2), np.nan)
    for i, trial in enumerate(slips.trials):
        stuck = ~np.isfinite(slips.slipped_s[i]) & np.isfinite(slips.path_mm[i]).any(axis=0)
        if trial.forces is None or stuck.any() or not slips.slid[i].any():
            continue
        begin = float(np.nanmax(slips.slipped_s[i])) + SETTLES_S
        t = trial.forces.t_s
        rows = (t >= begin) & (t <= trial.slide_s)
        if rows.sum() < 50:
            continue
        x, y, normal = trial.forces.force_n[rows].mean(axis=0)
        if normal > 0.0:
            result[i] = slips.way[i] @ [x, y], normal
    return result


def ring_stiffness(slips: Slips, ring: I64, growth: Growth) -> F64:
    """Force over lag of each ring's tips at each depth, N/mm, (levels, rings); NaN where not known.

    Stuck or sliding, a tip pulls with its spring, and its lag is seen: the measured force along
    the slide is a sum of the rings' lags, with their stiffnesses as factors. What relaxes is
    counted in as a lag of its own, q' = -q / tau + m lag'.
    """
    levels, which = slips.depths
    rings = np.arange(ring.max(initial=0) + 1)
    result = np.full((len(levels), len(rings)), np.nan)
    square = np.zeros((len(levels), len(rings), len(rings)))
    product = np.zeros((len(levels), len(rings)))
    for i, trial in enumerate(slips.trials):
        t = slips.frame_s[i]
        if trial.forces is None or len(t) < 10:
            continue
        lag = np.column_stack([_filled(t, column) for column in slips.lag_mm[i].T])
        step = (t[-1] - t[0]) / (len(t) - 1)
        decay = np.exp(-step / growth.relaxation_s)
        gain = growth.maxwell * growth.relaxation_s / step * (1.0 - decay)
        steps = np.diff(lag, axis=0, prepend=0.0)
        stretch = lag + lfilter([gain], [1.0, -decay], steps, axis=0)
        total = np.column_stack([stretch[:, ring == r].sum(axis=1) for r in rings])
        before = (trial.forces.t_s >= -0.2) & (trial.forces.t_s < 0.0)
        pull = trial.forces.force_n[:, :2] @ slips.way[i]
        # means over frames
        edge = np.searchsorted(trial.forces.t_s, np.append(t, t[-1] + step) - step / 2)
        whole = np.concatenate([[0.0], np.cumsum(pull)])
        count = np.diff(edge)
        seen = count > 0
        mean = (whole[edge[1:]] - whole[edge[:-1]])[seen] / count[seen]
        mean -= float(mean_seen(pull[before]))
        square[which[i]] += total[seen].T @ total[seen]
        product[which[i]] += mean @ total[seen]
    for level in range(len(levels)):
        touching = np.diag(square[level]) > 1.0
        if touching.any() and np.isfinite(product[level]).all():
            use = np.ix_(touching, touching)
            best, *_ = np.linalg.lstsq(square[level][use], product[level][touching], rcond=1e-9)
            result[level, touching] = np.where(best > 0.0, best, np.nan)
    return result


def _filled(t_s: F64, values: F64) -> F64:
    """Values with lines through what is missing; zeros where there are none."""
    seen = np.isfinite(values)
    return np.interp(t_s, t_s[seen], values[seen]) if seen.any() else np.zeros(len(t_s))


def force_estimates(slips: Slips, lags: Lags) -> dict[str, float]:
    """Return estimates from the forces at the deepest level; NaN without a force sensor."""
    gross = gross_forces(slips)
    share, time = hold_relaxation(slips)
    return {
        "normal_n": float(lags.normal_n[-1]),
        "normal_lost": 1.0 - float(lags.kept[-1]),
        "ratio": lags.ratio,
        "ratio_per_speed": _slope(np.log(slips.speed_mm_s), gross[:, 0] / gross[:, 1]),
        "stiffness_n_per_mm": float(lags.stiffness_n_per_mm[-1]),
        "hold_relaxing_share": share,
        "hold_relaxation_s": time,
    } | {f"pull_ring{r}_n_per_mm": float(k) for r, k in enumerate(lags.pull_n_per_mm[-1])}


def _slope(x: F64, y: F64) -> float:
    known = np.isfinite(y)
    if known.sum() < 3 or np.ptp(x[known]) < 0.05:
        return float("nan")
    return float(np.polynomial.polynomial.polyfit(x[known], y[known], 1)[1])


def hold_relaxation(slips: Slips) -> tuple[float, float]:
    """Return share and time of what relaxes of the normal force in the hold; NaN without forces.

    One time for all slides, a final force and a relaxing one for each: least squares with these
    two projected out. The share is that at the start of the hold over what remains.
    """
    series = []
    for trial in slips.trials:
        if trial.forces is None:
            continue
        t, normal = trial.forces.t_s, trial.forces.force_n[:, 2]
        count = max(int((0.0 - trial.hold_s) / 0.02), 1)
        bins = np.floor((t - trial.hold_s) / 0.02).astype(np.int64)
        inside = (bins >= 0) & (bins < count)
        number = np.bincount(bins[inside], minlength=count)
        total = np.bincount(bins[inside], normal[inside], minlength=count)
        full = number > 0
        if full.sum() >= 20:
            centre = (np.arange(count) + 0.5) * 0.02
            series.append((centre[full], total[full] / number[full]))
    if not series:
        return float("nan"), float("nan")

    def solved(log_time: float) -> tuple[float, float, float]:
        miss = left = rest = 0.0
        for t, normal in series:
            design = np.column_stack([np.ones(len(t)), np.exp(-t / np.exp(log_time))])
            best, *_ = np.linalg.lstsq(design, normal, rcond=None)
            miss += float(np.sum((normal - design @ best) ** 2))
            rest, left = rest + float(best[0]), left + float(best[1])
        return miss, left, rest

    best = minimize_scalar(
        lambda x: solved(x)[0], bounds=(np.log(0.1), np.log(10.0)), method="bounded"
    )
    _, left, rest = solved(best.x)
    share = left / rest if rest > 0.0 else float("nan")
    return (share if share > 0.0 else float("nan")), float(np.exp(best.x))


# -- each papilla ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Papillae:
    """m papillae as a pilot shows them, with standard errors.

    Attributes:
        ring: 0 is the centre, (m,).
        place_mm: from their mean, (m, 2); place_error_mm: along an axis, (m,).
        gap_mm: depth at which each touches over that of the centre one, (m,); its error.
        friction: of each over the mean, (m,); its error.
    """

    ring: I64
    place_mm: F64
    place_error_mm: F64
    gap_mm: F64
    gap_error_mm: F64
    friction: F64
    friction_error: F64


def papillae(trials: Sequence[PilotTrial], guess: Guess | None = None) -> Papillae | None:
    """Return what a pilot tells of each papilla; None where it tells nothing."""
    guess = guess or Guess()
    slips = find_slips(trials)
    if slips is None:
        return None
    ring, place = rings_of(slips)
    places = rest_places(slips)
    apart = np.linalg.norm(places - place, axis=2)
    seen = np.maximum(np.isfinite(apart).sum(axis=0), 2)
    error = np.sqrt(mean_seen(apart**2) / 2 / (seen - 1))
    growth = fit_growth(slips) or Growth()
    fit = fit_springs(lags_of(slips, ring, steady_lags(slips, growth), growth), guess)
    if fit is None:
        return None
    return Papillae(
        ring, place - mean_seen(place), error, fit.gap_mm, fit.gap_error_mm,
        fit.friction / fit.friction.mean(), fit.friction_error,
    )  # fmt: skip
