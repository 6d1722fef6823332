"""Estimates from a force sensor's samples during slides; NaN without one."""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter

from sliplab.plugins.twin.contact_lags import Growth
from sliplab.plugins.twin.contact_slips import SETTLES_S, SlideSlips, mean_seen
from sliplab.plugins.twin.contact_springs import Lags
from sliplab.plugins.twin.pilot import PilotTrial
from sliplab.storage.streams import F64, I64


def normal_at_rest(trial: PilotTrial) -> float:
    """Normal force in the last 0.2 s before the slide, N; NaN without a force sensor."""
    if trial.forces is None:
        return float("nan")
    t = trial.forces.t_s
    return float(mean_seen(trial.forces.force_n[(t >= -0.2) & (t < 0.0), 2]))


def initial_slopes(slips: SlideSlips, growth: Growth) -> F64:
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
        pull = trial.forces.force_n[:, :2] @ slips.direction[i]
        pull = pull[rows] - pull[before].mean() if before.any() else pull[rows]
        # what a unit stiffness pulls with while it relaxes
        tau, m = growth.relaxation_s, growth.maxwell
        unit = slips.speed_mm_s[i] * (t[rows] + m * tau * -np.expm1(-t[rows] / tau))
        result[i] = float(np.sum(pull * unit) / np.sum(unit**2))
    return result


def gross_forces(slips: SlideSlips) -> F64:
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
            result[i] = slips.direction[i] @ [x, y], normal
    return result


def ring_stiffness(slips: SlideSlips, ring: I64, growth: Growth) -> F64:
    """Return force over lag of each ring's tips by depth, N/mm, (levels, rings); NaN if unknown.

    Stuck or sliding, a tip pulls with its spring, and its lag is seen: the measured force along
    the slide is a sum of the rings' lags, with their stiffnesses as factors. Relaxation is modelled
    as a separate lag, q' = -q / tau + m lag'.
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
        stretch = relaxing(lag, t, growth)
        total = np.column_stack([stretch[:, ring == r].sum(axis=1) for r in rings])
        before = (trial.forces.t_s >= -0.2) & (trial.forces.t_s < 0.0)
        pull = trial.forces.force_n[:, :2] @ slips.direction[i]
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


def relaxing(lag_mm: F64, t_s: F64, growth: Growth) -> F64:
    """Return lags with their remaining relaxation; a tip's pull is proportional to them, (n, m)."""
    step = (t_s[-1] - t_s[0]) / (len(t_s) - 1)
    decay = np.exp(-step / growth.relaxation_s)
    gain = growth.maxwell * growth.relaxation_s / step * (1.0 - decay)
    steps = np.diff(lag_mm, axis=0, prepend=0.0)
    result: F64 = lag_mm + lfilter([gain], [1.0, -decay], steps, axis=0)
    return result


def _filled(t_s: F64, values: F64) -> F64:
    """Return values with gaps interpolated linearly; zeros without any value."""
    seen = np.isfinite(values)
    return np.interp(t_s, t_s[seen], values[seen]) if seen.any() else np.zeros(len(t_s))


def force_estimates(slips: SlideSlips, lags: Lags) -> dict[str, float]:
    """Return estimates from the forces at the deepest level; NaN without a force sensor."""
    gross = gross_forces(slips)
    share, time = hold_relaxation(slips)
    return {
        "normal_n": float(lags.normal_n[-1]),
        "normal_lost": 1.0 - float(lags.retained[-1]),
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


def hold_relaxation(slips: SlideSlips) -> tuple[float, float]:
    """Return share and time of the normal force's relaxation in the hold; NaN without forces.

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
